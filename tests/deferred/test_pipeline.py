"""G-buffer, shading and the whole pipeline: against rays, closed forms and what masks must let through."""

import dataclasses
import json
import math

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender import cli
from jaxrender.camera import Camera, camera_rays
from jaxrender.deferred import make_gbuffer, render_scene, scene_textures, see, standard_pattern
from jaxrender.deferred.shade import Surface, incoming, shade
from jaxrender.io import load_scene, read_exr, write_exr
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.io.exr import read_exr_layers
from jaxrender.io.picture import read_png
from jaxrender.pathtrace.embree import EmbreeScene
from jaxrender.scene import DIRECTIONAL, MASK, POINT, SPOT, Lights, SceneImage, scene_bounds, whole_scene_camera

SIZE = {"height": 60, "width": 80}


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(num_vertices=2000)


def embree_hits(scene, camera):
    rays = EmbreeScene(np.asarray(scene.positions), np.asarray(scene.faces))
    origins, directions = (np.asarray(a).reshape(-1, 3) for a in camera_rays(camera, **SIZE))
    hits = rays.closest_hit(origins, directions)
    return hits, origins + hits.t[:, None] * directions


def test_the_gbuffer_is_what_rays_see(scene):
    camera = whole_scene_camera(scene, aspect=80 / 60)
    fragments = see(scene, camera, **SIZE)
    gbuffer = make_gbuffer(scene, fragments, textures=scene_textures(scene))
    hits, places = embree_hits(scene, camera)
    ids = np.asarray(gbuffer.triangle_id).reshape(-1)
    same = ids == hits.triangle
    assert same.mean() > 0.995
    seen = same & (ids >= 0)
    assert seen.sum() > 500
    np.testing.assert_allclose(np.asarray(gbuffer.position).reshape(-1, 3)[seen], places[seen], atol=6e-3)
    depth = (places - np.asarray(camera.eye)) @ np.asarray(camera.target - camera.eye)
    depth /= np.linalg.norm(np.asarray(camera.target - camera.eye))
    np.testing.assert_allclose(np.asarray(gbuffer.depth).reshape(-1)[seen], depth[seen], rtol=1e-3)
    n = np.asarray(gbuffer.geometric_normal).reshape(-1, 3)[seen]
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, rtol=1e-5)
    # Normals face the eye.
    assert (np.sum(n * (np.asarray(camera.eye) - places[seen]), axis=1) > 0).all()
    shading = np.asarray(gbuffer.normal).reshape(-1, 3)[seen]
    assert (np.sum(n * shading, axis=1) > 0.2).mean() > 0.99


def lights_of(kind, **fields):
    base = {
        "kind": np.int32(kind), "position": np.zeros(3), "direction": np.array([0.0, -1.0, 0.0]),
        "intensity": np.ones(3), "range": np.inf, "cos_inner": -1.0, "cos_outer": -1.0,
    } | fields  # fmt: skip
    return Lights(**{k: jnp.asarray(v, jnp.int32 if k == "kind" else jnp.float32)[None] for k, v in base.items()})


def test_incoming_light_is_that_of_the_extension():
    at = jnp.asarray([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], jnp.float32)

    def one(lights):
        return incoming(Lights(*(getattr(lights, f.name)[0] for f in dataclasses.fields(lights))), at)

    wi, sun = one(lights_of(DIRECTIONAL, intensity=[2.0, 3.0, 4.0]))
    np.testing.assert_allclose(wi, [[0, 1, 0]] * 2)
    np.testing.assert_allclose(sun, [[2, 3, 4]] * 2)
    wi, lamp = one(lights_of(POINT, position=[0.0, 4.0, 0.0], intensity=[16.0, 16.0, 16.0]))
    np.testing.assert_allclose(wi[1], [-0.6, 0.8, 0.0], atol=1e-6)
    np.testing.assert_allclose(lamp[:, 0], [1.0, 16 / 25], rtol=1e-6)
    _, near = one(lights_of(POINT, position=[0.0, 4.0, 0.0], intensity=[16.0, 16.0, 16.0], range=4.5))
    np.testing.assert_allclose(near[:, 0], [1 - (4 / 4.5) ** 4, 0.0], rtol=1e-5)
    cone = {"cos_inner": math.cos(0.2), "cos_outer": math.cos(0.8)}
    _, spot = one(lights_of(SPOT, position=[0.0, 4.0, 0.0], intensity=[16.0, 16.0, 16.0], **cone))
    share = (0.8 - math.cos(0.8)) / (math.cos(0.2) - math.cos(0.8))
    np.testing.assert_allclose(spot[:, 0], [1.0, 16 / 25 * share**2], rtol=1e-5)


def test_many_lights_add_up(scene):
    """256 lights are the sum of the pictures of each half, and none without light is black."""
    camera = whole_scene_camera(scene, aspect=80 / 60)
    fragments = see(scene, camera, **SIZE)
    gbuffer = make_gbuffer(scene, fragments)
    shape = gbuffer.depth.shape
    grey = Surface(
        base_color=jnp.full((*shape, 3), 0.5), alpha=jnp.ones(shape), metallic=jnp.zeros((*shape, 1)),
        roughness=jnp.full((*shape, 1), 0.6), emissive=jnp.zeros((*shape, 3)),
        occlusion=jnp.ones((*shape, 1)),
    )  # fmt: skip
    rng = np.random.default_rng(2)
    number = 256
    lights = Lights(
        kind=jnp.asarray(rng.integers(0, 3, number), jnp.int32),
        position=jnp.asarray(rng.uniform(-3, 3, (number, 3)) + [0, 4, 0], jnp.float32),
        direction=jnp.asarray(np.tile([0.0, -1.0, 0.0], (number, 1)), jnp.float32),
        intensity=jnp.asarray(rng.uniform(0, 1, (number, 3)), jnp.float32),
        range=jnp.full(number, jnp.inf), cos_inner=jnp.full(number, 0.9), cos_outer=jnp.full(number, 0.5),
    )  # fmt: skip
    half = lambda a, b: Lights(*(getattr(lights, f.name)[a:b] for f in dataclasses.fields(lights)))  # noqa: E731
    draw = lambda own: np.asarray(shade(gbuffer, grey, own, camera.eye))  # noqa: E731
    whole, first, second = draw(lights), draw(half(0, 128)), draw(half(128, 256))
    np.testing.assert_allclose(whole, first + second, rtol=1e-4, atol=1e-4)
    assert whole.max() > 1.0
    assert (draw(half(0, 0)) == 0).all()


def test_a_plane_under_the_sun_has_the_brdfs_value(scene):
    """The floor from above: Lambert plus 4 % of a rough mirror, times the sun."""
    camera = Camera(*(jnp.asarray(v, jnp.float32) for v in ([1.0, 3.0, 1.0], [1.0, 0.0, 1.0], [0.0, 0.0, -1.0])),
                    jnp.float32(0.05))  # fmt: skip
    sun = lights_of(DIRECTIONAL, intensity=[2.0, 2.0, 2.0])
    picture = render_scene(scene, camera, height=4, width=4, lights=sun)
    tile = np.asarray(picture.surface.base_color)[1, 1, 0, 0]
    alpha2 = 0.7**4
    expected = 2.0 * (0.96 * tile / np.pi + 0.04 / (4 * np.pi * alpha2))
    np.testing.assert_allclose(picture.image[1, 1], expected, rtol=1e-2)


@pytest.mark.parametrize("samples", [1, 4])
def test_masked_texels_are_looked_through(scene, samples):
    """The floor becomes a grating with holes, twice over: through both holes one sees nothing, else floor."""
    texels = np.zeros((8, 8, 4), np.uint8)
    texels[..., :3], texels[:, :4, 3] = 200, 255
    floor = np.asarray(scene.material_id) == 1
    used = np.unique(np.asarray(scene.faces)[floor])
    deeper = np.asarray(scene.positions).copy()[used] - [0, 0.5, 0]
    faces = np.asarray(scene.faces)[floor]
    again = np.searchsorted(used, faces) + len(scene.positions)
    grow = lambda values, more: jnp.concatenate([values, jnp.asarray(more, values.dtype)])  # noqa: E731
    both = dataclasses.replace(
        scene, positions=grow(scene.positions, deeper), faces=grow(scene.faces, again),
        material_id=grow(scene.material_id, np.ones(len(again))),
        **{name: grow(getattr(scene, name), np.asarray(getattr(scene, name))[used])
           for name in ("normals", "tangents", "uv", "colors")},
        material=dataclasses.replace(scene.material, alpha_mode=jnp.asarray([0, MASK], jnp.int32)),
        images=(SceneImage("grating", texels, ("repeat", "repeat"), True),),
    )  # fmt: skip
    _, high = scene_bounds(both)
    camera = Camera(*(jnp.asarray(v, jnp.float32) for v in ([0.0, 9.0, 0.01], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0])),
                    jnp.float32(0.2))  # fmt: skip
    fragments = see(both, camera, **SIZE, samples=standard_pattern(samples), textures=scene_textures(both))
    ids = np.asarray(fragments.triangle_id)
    # Without textures given, `see` makes those it needs.
    np.testing.assert_array_equal(ids, see(both, camera, **SIZE, samples=standard_pattern(samples)).triangle_id)
    gbuffer = make_gbuffer(both, fragments)
    floors = np.isin(ids, np.flatnonzero(np.asarray(both.material_id) == 1))
    u = np.asarray(gbuffer.uv)[..., 0] % 1.0
    # Nothing but the opaque half of the texture is left, up to the border of bilinear filtering.
    assert floors.any() and (u[floors] < 0.57).all()
    height = np.asarray(gbuffer.position)[..., 1]
    assert (height[floors] > float(high[1]) - 5).all()
    assert {True, False} == set(np.unique(height[floors] < height[floors].max() - 0.25))
    assert (ids < 0).any()


def test_render_writes_png_and_layers(tmp_path, capsys):
    out = tmp_path / "a" / "picture.png"
    assert cli.main(["render", "-o", str(out), "--size", "64", "48", "--samples", "2", "--exr", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["paths"] == [str(out), str(out.with_suffix(".exr"))]
    layers = read_exr_layers(out.with_suffix(".exr"))
    assert {"", "albedo", "normal", "position", "depth", "uv", "materialid", "triangleid"} <= set(layers)
    picture = read_exr(out.with_suffix(".exr"))
    assert picture.shape == (48, 64, 4)
    covered = layers["triangleid"][..., 0] > 0
    assert 0.05 < covered.mean() < 0.95
    assert (picture[covered][:, 3] > 0).all()
    assert picture[covered][:, :3].mean() > 0.05
    # Wherever anything is seen there are an id and a whole normal.
    np.testing.assert_array_equal(covered, picture[..., 3] > 0)
    np.testing.assert_allclose(np.linalg.norm(layers["normal"][covered], axis=-1), 1.0, atol=1e-4)


def test_render_with_a_sky_from_inside(tmp_path, capsys):
    """The sky lights the scene and is what is behind it; alpha as coverage and another model are taken."""
    sky = np.zeros((16, 32, 3), np.float32)
    sky[:8] = [0.2, 0.6, 2.0]
    write_exr(tmp_path / "sky.exr", sky)
    out = tmp_path / "picture.png"
    words = ["--environment", str(tmp_path / "sky.exr"), "--inside", "--transparency", "coverage", "--model", "phong"]
    assert cli.main(["render", "-o", str(out), "--size", "40", "30", *words, "--exr", "--json"]) == 0
    layers = read_exr_layers(out.with_suffix(".exr"))
    alpha = layers[""][..., 3]
    assert 0.02 < alpha.mean() < 0.98
    lit = layers[""][alpha > 0.9]
    assert lit[:, 2].mean() > 2.5 * lit[:, 0].mean() > 0
    shown = read_png(out)
    assert shown[:5][alpha[:5] == 0][:, 2].mean() > shown[:5][alpha[:5] == 0][:, 0].mean() + 0.2


@pytest.mark.parametrize(
    ("words", "share"),
    [([], None), (["--method", "printed", "--budget", "0.6"], 0.6), (["--method", "uniform", "--count", "2"], None)],
)
def test_render_with_fewer_samples(tmp_path, capsys, words, share):
    out = tmp_path / "picture.png"
    arguments = ["--adaptive", "2", "--size", "40", "30", *words, "--exr", "--json"]
    assert cli.main(["render", "-o", str(out), *arguments]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["paths"] == [str(out.with_suffix(end)) for end in (".png", ".exr", ".counts.png")]
    layers = read_exr_layers(out.with_suffix(".exr"))
    count, alpha = layers["samplecount"][..., 0], layers[""][..., 3]
    assert count.max() <= 4 and ((count > 0) == (alpha > 0)).all()
    # Samples that are shaded again count again; in so small a picture that is most of them.
    assert record["sample_share"] <= (share or 1.5)
    assert read_png(out.with_suffix(".counts.png")).shape[:2] == (30, 40)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--budget", "0.3"], "--budget: expected --adaptive M"),
        (["--adaptive", "9"], "--adaptive: expected a number from 1 to 8"),
        (["--adaptive", "2", "--budget", "0.3", "--psnr", "40"], "--budget: expected it alone"),
        (["--adaptive", "2", "--psnr", "nan"], "--psnr: expected decibels"),
        (["--adaptive", "2", "--method", "uniform", "--count", "5"], "--count: expected a number from 1 to 4"),
        (["nowhere.gltf"], "nowhere.gltf"),
        (["--samples", "3"], "--samples: expected one of 1, 2, 4, 8, 16, got 3"),
        (["--size", "0", "4"], "--size"),
        (["-o", "FILE/below.png"], "-o"),
        (["-o", "picture.exr"], "a name ending in .png"),
        (["--eye", "nan", "0", "3"], "finite numbers"),
        (["--eye", "1", "2", "3", "--target", "1", "2", "3"], "another point"),
        (["--eye", "1", "2", "3", "--inside"], "--inside"),
        (["--camera", "3"], "--camera"),
        (["--eye", "0", "0", "1", "--fov-degrees", "180"], "--fov-degrees"),
    ],
)
def test_bad_input_to_render(tmp_path, capsys, arguments, words):
    (tmp_path / "FILE").write_text("x")
    arguments = [a.replace("FILE", str(tmp_path / "FILE")) for a in arguments]
    assert cli.main(["render", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error


def test_sponza_is_seen_as_rays_see_it(shared_data):
    """Opaque part only: ids of the rasteriser against Embree's, from inside the building."""
    scene = load_scene(shared_data / "sponza" / "Sponza.gltf")
    opaque = dataclasses.replace(
        scene, material=dataclasses.replace(
            scene.material, alpha_mode=jnp.zeros_like(scene.material.alpha_mode),
            double_sided=jnp.ones_like(scene.material.double_sided),
        ),
    )  # fmt: skip
    camera = Camera(*(jnp.asarray(v, jnp.float32) for v in ([10.0, 2.0, 0.0], [-5.0, 3.0, 0.0], [0.0, 1.0, 0.0])),
                    jnp.float32(1.0))  # fmt: skip
    fragments = see(opaque, camera, **SIZE)
    hits, _ = embree_hits(opaque, camera)
    agree = np.asarray(fragments.triangle_id).reshape(-1) == hits.triangle
    assert agree.mean() > 0.98
