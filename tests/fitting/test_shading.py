"""The jitted shader and the traced truth, on bodies whose light is known."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from fitting.shading import make_shader, open_sky, posed_mesh, traced_visibility, truth_colors
from jaxrender.animation.skeleton import Pose, Skeleton
from jaxrender.animation.skinning import Character, Skin
from jaxrender.harmonics import hemisphere_directions, hemisphere_zh, sh_directional_light, sh_evaluate
from jaxrender.harmonics.pose_model import FeatureBasis, PoseModel, predict_lobes, project_features, raw_features
from jaxrender.harmonics.relight import membrane, relight, relight_diffuse
from tests.support.asserts import assert_close
from tests.support.tolerances import LONG_SUM, ROUNDING

EYE = (1.5, 2.0, 4.0)
TAU = (0.7, 0.4, 0.2)


def character_of(vertices, normals, faces, joint):
    """A rigid part per joint; joint 1 hangs on joint 0."""
    rest = Pose(jnp.zeros((2, 3)), jnp.tile(jnp.asarray([0.0, 0.0, 0.0, 1.0]), (2, 1)), jnp.ones((2, 3)))
    skin = Skin(
        vertices=jnp.asarray(vertices, jnp.float32),
        normals=jnp.asarray(normals, jnp.float32),
        joint_indices=jnp.asarray(joint, jnp.int32)[:, None],
        weights=jnp.ones((len(vertices), 1)),
        palette_joints=jnp.arange(2, dtype=jnp.int32),
        inverse_binds=jnp.tile(jnp.eye(4), (2, 1, 1)),
    )
    albedo = np.linspace(0.2, 0.9, len(vertices) * 3).reshape(-1, 3).astype(np.float32)
    skeleton = Skeleton(("root", "limb"), (-1, 0), rest)
    return Character("test body", skeleton, skin, np.asarray(faces, np.int32), (), albedo, "0")


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.asarray(mesh.vertices)
    return character_of(vertices, vertices, mesh.faces, (vertices[:, 1] > 0).astype(int))


RADIUS, HEIGHT = 0.5, 1.25


@pytest.fixture(scope="module")
def ball_over_plate():
    """A plate at y = 0 with a vertex in its middle, and a ball whose centre is HEIGHT above it."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    corners = np.array([[0, 0, 0], [4, 0, 4], [4, 0, -4], [-4, 0, -4], [-4, 0, 4]])
    plate = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    vertices = np.concatenate([corners, RADIUS * sphere.vertices + [0, HEIGHT, 0]])
    normals = np.concatenate([np.tile([0.0, 1.0, 0.0], (5, 1)), sphere.vertices])
    faces = np.concatenate([plate, sphere.faces + 5])
    return character_of(vertices, normals, faces, np.arange(len(vertices)) >= 5)


def model_of(character, rng, *, num_points=None, wobble=0.0):
    """Unoccluded points, plus `wobble` of anything that depends on the pose."""
    v = len(character.albedo)
    points = np.arange(v) if num_points is None else np.arange(v) % num_points
    p = points.max() + 1
    weights = wobble * rng.normal(size=(2, 12, p))
    weights[0, 4:8] += np.asarray(hemisphere_zh(order=4))[:, None]
    axes = np.tile([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]], (p, 1, 1))
    basis = FeatureBasis(
        kind="surroundings",
        size=2.0,
        joints=jnp.arange(2, dtype=jnp.int32),
        bones=jnp.zeros(1, jnp.int32),
        falloff=jnp.ones((1, 2)),
        reference=jnp.tile(jnp.asarray([0.0, 0.0, 0.0, 1.0]), (2, 1)),
        translations=jnp.zeros((2, 3)),
        mean=jnp.zeros((1, 26)),
        basis=jnp.asarray(rng.normal(size=(1, 26, 1)), jnp.float32),
    )
    return PoseModel(
        features=basis,
        weights=jnp.asarray(weights, jnp.float32),
        axes=jnp.asarray(axes, jnp.float32),
        offset=jnp.asarray(wobble * rng.normal(size=(p, 16)), jnp.float32),
        groups=jnp.zeros(p, jnp.int32),
        points=jnp.asarray(points, jnp.int32),
        visible=jnp.ones(p, bool),
    )


def bent(character, angle):
    """The rest pose with joint 1 turned about z."""
    rest = character.skeleton.rest
    half = 0.5 * jnp.asarray(angle, jnp.float32)
    turned = jnp.stack([jnp.zeros_like(half), jnp.zeros_like(half), jnp.sin(half), jnp.cos(half)])
    return dataclasses.replace(rest, rotation=rest.rotation.at[1].set(turned))


def constant_light(radiance=1.0):
    return jnp.zeros((3, 16)).at[:, 0].set(radiance * math.sqrt(4 * math.pi))


# --- The shader


@pytest.mark.parametrize("material", ["phong", "diffuse", "membrane"])
def test_the_shader_is_the_kernels_in_a_row(ball, rng, material):
    """Skinning, lobes of each vertex's point, offset, kernel and albedo, called one by one."""
    model, pose = model_of(ball, rng, num_points=37, wobble=0.1), bent(ball, 0.8)
    light = jnp.asarray(rng.normal(size=(3, 16)), jnp.float32)
    positions, colors = make_shader(ball, model, material=material)(
        pose, eye=EYE, light=light, exponent=7.5, transmission=TAU
    )
    mesh = jax.tree.map(jnp.asarray, posed_mesh(ball, pose))
    globals = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    globals[1, :2, :2] = [[math.cos(0.8), -math.sin(0.8)], [math.sin(0.8), math.cos(0.8)]]
    components = project_features(model.features, raw_features(model.features, pose, jnp.asarray(globals)))
    axes, coefficients = (x[model.points] for x in predict_lobes(model, components))
    lobes, offset = (axes, coefficients, mesh.frames), model.offset[model.points]
    albedo = jnp.asarray(ball.albedo)
    if material == "phong":
        eye = jnp.asarray(EYE, jnp.float32)
        expected = relight(*lobes, mesh.positions, light, jnp.float32(7.5), albedo, eye, offset=offset)
    elif material == "diffuse":
        expected = relight_diffuse(*lobes, light, albedo, offset=offset)
    else:
        expected = membrane(*lobes, light, albedo, jnp.asarray(TAU), offset=offset)
    assert_close(positions, mesh.positions, ulps=ROUNDING, dtype=np.float32)
    assert_close(colors, expected, ulps=LONG_SUM, dtype=np.float32)


def test_albedo_and_exponent_may_differ_by_vertex(ball, rng):
    model, pose = model_of(ball, rng), bent(ball, 0.0)
    light = jnp.asarray(rng.normal(size=(3, 16)), jnp.float32)
    shade = make_shader(ball, model)
    exponents = np.linspace(0, 50, len(ball.albedo)).astype(np.float32)
    ones = np.ones_like(ball.albedo)
    _, colors = shade(pose, eye=EYE, light=light, exponent=exponents, albedo=ones)
    _, single = shade(pose, eye=EYE, light=light, exponent=float(exponents[40]), albedo=2 * ones)
    assert_close(2 * np.asarray(colors)[40], np.asarray(single)[40], ulps=LONG_SUM, dtype=np.float32)


def test_points_that_see_nothing_are_black_but_for_what_shines_through(ball, rng):
    model, pose = model_of(ball, rng, wobble=0.1), bent(ball, 0.0)
    blind = dataclasses.replace(model, visible=model.visible.at[:80].set(False))
    light = jnp.asarray(rng.normal(size=(3, 16)), jnp.float32)
    for material in ("phong", "diffuse"):
        options = {"eye": EYE, "light": light, "exponent": 3.0}
        _, full = make_shader(ball, model, material=material)(pose, **options)
        _, colors = make_shader(ball, blind, material=material)(pose, **options)
        assert (np.asarray(colors)[:80] == 0).all()
        np.testing.assert_array_equal(np.asarray(colors)[80:], np.asarray(full)[80:])
    shade = make_shader(ball, blind, material="membrane")
    _, dark = shade(pose, eye=EYE, light=constant_light(), transmission=(0.0, 0.0, 0.0))
    _, through = shade(pose, eye=EYE, light=constant_light(), transmission=TAU)
    assert (np.asarray(dark)[:80] == 0).all()
    # The back lobe max(0, -cos)/π under radiance 1 is 1.
    assert_close(np.asarray(through)[:80], ball.albedo[:80] * np.float32(TAU), ulps=ROUNDING, dtype=np.float32)


def test_light_from_plus_x_lights_the_plus_x_side(ball, rng):
    lamp = sh_directional_light(jnp.asarray([1.0, 0.0, 0.0]), jnp.ones(3), order=4)
    shade = make_shader(ball, model_of(ball, rng), material="diffuse")
    positions, colors = shade(bent(ball, 0.0), eye=EYE, light=lamp, albedo=np.ones_like(ball.albedo))
    x, brightness = np.asarray(positions)[:, 0], np.asarray(colors)[:, 1]
    assert brightness[x > 0.9].min() > 0.25 > 0.1 > brightness[x < -0.1].max()


def test_the_shader_is_differentiable_in_light_exponent_eye_and_pose(ball, rng):
    model = model_of(ball, rng, wobble=0.1)
    shade = make_shader(ball, model)
    weights = jnp.asarray(rng.normal(size=ball.albedo.shape), jnp.float32) / 8.0

    def objective(arguments):
        light, exponent, eye, angle = arguments
        _, colors = shade(bent(ball, angle), eye=eye, light=light, exponent=exponent)
        return jnp.sum(weights * colors)

    light = jnp.asarray(rng.normal(size=(3, 16)), jnp.float32)
    at = (light, jnp.float32(4.0), jnp.asarray(EYE), jnp.float32(0.7))
    slopes = jax.grad(objective)(at)
    step, eps = 2.0**-5, np.finfo(np.float32).eps

    def difference(index, along, step):
        ends = [(*at[:index], at[index] + sign * step * along, *at[index + 1 :]) for sign in (1.0, -1.0)]
        return (float(objective(ends[0])) - float(objective(ends[1]))) / (2 * step)

    for index, slope in enumerate(slopes):
        along = jnp.asarray(rng.normal(size=np.shape(at[index])), jnp.float32)
        # Extrapolated from two steps, so that the rounding of the sum (486 terms of size 1/8) over the step is what
        # is left; its weight in the extrapolation is 3.
        expected = (4 * difference(index, along, step / 2) - difference(index, along, step)) / 3
        np.testing.assert_allclose(
            float(jnp.sum(slope * along)), expected, atol=3 * 8 * math.sqrt(486) / 8 * eps / step, rtol=1e-3
        )


def test_an_unknown_material_is_refused(ball, rng):
    with pytest.raises(ValueError, match="material"):
        make_shader(ball, model_of(ball, rng), material="velvet")


# --- The truth


@pytest.mark.parametrize("material", ["phong", "diffuse", "membrane"])
def test_truth_is_the_plain_sum_over_directions(ball_over_plate, rng, material):
    body, count, exponent = ball_over_plate, 64, 5.5
    mesh = posed_mesh(body, bent(body, 0.2))
    points, bits = traced_visibility(body, mesh, num_directions=count)
    light = jnp.asarray(rng.normal(size=(3, 16)), jnp.float32)
    got = truth_colors(
        mesh, points, bits, material=material, eye=EYE, light=light, albedo=body.albedo, exponent=exponent,
        transmission=TAU, num_directions=count,
    )  # fmt: skip
    for vertex in (0, 3, 17, 200):
        frame, at = np.asarray(mesh.frames[vertex], np.float64), np.asarray(mesh.positions[vertex], np.float64)
        normal, to_eye = frame[:, 2], (np.array(EYE) - at) / np.linalg.norm(np.array(EYE) - at)
        mirrored = 2 * (normal @ to_eye) * normal - to_eye
        seen = np.unpackbits(bits[points.of_vertex[vertex]])
        total = np.zeros(3)
        for free, local in zip(seen, hemisphere_directions(count), strict=True):
            toward = jnp.asarray(frame @ local, jnp.float32)[None]
            radiance = np.asarray(sh_evaluate(light, jnp.repeat(toward, 3, axis=0)))
            if material == "phong":
                f = (exponent + 1) / (2 * math.pi) * max(0.0, float(mirrored @ (frame @ local))) ** exponent
            else:
                f = local[2] / math.pi
            total += free * f * radiance
            if material == "membrane":
                total += np.array(TAU) * f * np.asarray(sh_evaluate(light, jnp.repeat(-toward, 3, axis=0)))
        expected = total * 2 * math.pi / count * body.albedo[vertex]
        # The terms of the sum cancel: their scale is that of the light, about 1.
        np.testing.assert_allclose(got[vertex], expected, atol=64 * np.finfo(np.float32).eps)


def test_a_ball_shadows_the_plate_by_its_share_of_the_sky(ball_over_plate):
    """Under even light a ball of radius R whose centre is d above takes (R/d)² of the irradiance."""
    body, count = ball_over_plate, 4096
    mesh = posed_mesh(body, bent(body, 0.0))
    points, bits = traced_visibility(body, mesh, num_directions=count)
    options = {
        "material": "diffuse", "eye": EYE, "light": constant_light(), "albedo": np.ones_like(body.albedo),
        "num_directions": count,
    }  # fmt: skip
    shaded = truth_colors(mesh, points, bits, **options)[0]
    blocked = (RADIUS / HEIGHT) ** 2
    # The outline of the mesh lies up to 1 % inside the ball's; the rim of the shadow passes between directions.
    np.testing.assert_allclose(shaded, 1 - blocked, atol=0.02 * blocked + 8 / count)
    free = truth_colors(mesh, points, open_sky(points, num_directions=count), **options)
    np.testing.assert_allclose(free, 1.0, atol=1e-5)  # Σ cos 2/d over equal strata of cos is 1 up to rounding


def test_truth_under_an_open_sky_is_the_clamped_cosine(ball, rng):
    """Irradiance of an order-4 light on an unshadowed surface: A_l/π = 1, 2/3, 1/4, 0 times its bands."""
    mesh, count = posed_mesh(ball, bent(ball, 0.3)), 2048
    points, _ = traced_visibility(ball, mesh, num_directions=8)
    light = jnp.asarray(rng.normal(size=(3, 16)), jnp.float32)
    got = truth_colors(
        mesh, points, open_sky(points, num_directions=count), material="diffuse", eye=EYE, light=light,
        albedo=np.ones_like(ball.albedo), num_directions=count,
    )  # fmt: skip
    factors = np.repeat([1.0, 2 / 3, 1 / 4, 0.0], [1, 3, 5, 7]).astype(np.float32)
    normals = jnp.asarray(mesh.frames[..., 2])
    expected = np.stack([sh_evaluate((c * factors)[None], normals) for c in light], axis=-1)
    # A spherical Fibonacci lattice of d points misses smooth functions by a few 1/d of their size.
    np.testing.assert_allclose(got, expected, atol=4 / count * float(jnp.abs(light).max()))


def test_exponent_zero_is_the_hemisphere_of_the_mirrored_direction(ball):
    """(α+1)/2π max(0, cos)^α for α = 0 must not count directions behind the mirrored one."""
    mesh, count = posed_mesh(ball, bent(ball, 0.0)), 1024
    points, _ = traced_visibility(ball, mesh, num_directions=8)
    colors = truth_colors(
        mesh, points, open_sky(points, num_directions=count), material="phong", eye=EYE, light=constant_light(),
        albedo=np.ones_like(ball.albedo), exponent=0.0, num_directions=count,
    )  # fmt: skip
    normal = np.asarray(mesh.frames)[..., 2]
    to_eye = np.array(EYE) - np.asarray(mesh.positions)
    cosine = np.sum(normal * to_eye, axis=-1) / np.linalg.norm(to_eye, axis=-1)
    # Two hemispheres whose axes are θ apart share 1 - θ/π of their area.
    expected = 1 - np.arccos(np.clip(cosine, -1, 1)) / math.pi
    np.testing.assert_allclose(colors[:, 0], expected, atol=16 / count)


def test_model_and_truth_agree_where_the_model_is_exact(ball, rng):
    """On a ball the one lobe is the visibility, and what is left is its cut to four bands."""
    model, pose = model_of(ball, rng), bent(ball, 0.4)
    mesh = posed_mesh(ball, pose)
    light = sh_directional_light(jnp.asarray([0.0, 0.6, 0.8]), jnp.ones(3), order=4)
    points, bits = traced_visibility(ball, mesh, num_directions=512)
    for material, limit in (("diffuse", 0.05), ("membrane", 0.05), ("phong", 0.2)):
        options = {"eye": EYE, "light": light, "exponent": 4.0, "transmission": TAU, "albedo": ball.albedo}
        _, modelled = make_shader(ball, model, material=material)(pose, **options)
        truth = truth_colors(mesh, points, bits, material=material, num_directions=512, **options)
        error = np.linalg.norm(np.asarray(modelled) - truth) / np.linalg.norm(truth)
        assert error < limit, (material, error)
