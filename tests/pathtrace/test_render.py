"""The path tracer against light that is known: furnaces, closed spheres, lamps over a floor, and against itself."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.camera import Camera
from jaxrender.pathtrace import TraceSettings, move, prepare, render, render_direct, render_indirect
from jaxrender.pathtrace.guide_rays import pooled, trace_guides
from jaxrender.pathtrace.render import filter_incident
from jaxrender.scene import DIRECTIONAL, MASK, POINT, SPOT, SceneImage
from tests.support.rooms import light, matt, polygon_irradiance, room, sphere, square

SIZE = {"height": 20, "width": 24}
WHITE = np.ones((4, 8, 3), np.float32)
PLAIN = TraceSettings(method="none", direct="plain", ao_rays=0, model="lambert")


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Several blocks in a picture of 480 pixels, the last one not full."""
    monkeypatch.setattr("jaxrender.pathtrace.programs.BLOCK", 128)


def camera(eye, target, fov=0.7):
    vectors = [jnp.asarray(v, jnp.float32) for v in (eye, target, (0.0, 1.0, 0.0))]
    return Camera(*vectors, jnp.float32(fov))


def floor(color=(0.6, 0.5, 0.4), **changed):
    return square((0, 0, 0), (3, 0, 0), (0, 0, -3), matt(color, **changed))


ABOVE = camera((0.0, 4.0, 2.5), (0.0, 0.0, 0.0))


def z_test(values, truth, *, sigmas=5.0):
    """The mean over samples (first axis) is the truth at every pixel, within what the samples' own spread allows."""
    n = len(values)
    mean, spread = values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(n)
    assert (np.abs(mean - truth) <= sigmas * spread + 1e-4 * np.abs(truth) + 1e-6).all()


@pytest.mark.parametrize("model", ["lambert", "phong", "metallic_roughness"])
def test_white_furnace(model):
    """A sphere in light that is 1 from everywhere gives back its albedo if it is matt, and never more than it gets."""
    scene = room(sphere(matt((0.8, 0.5, 0.2), roughness=0.5, metallic=0.3)))
    world = prepare(scene, environment=WHITE)
    settings = dataclasses.replace(PLAIN, model=model, bounces=1, light_samples=4)
    runs = [
        trace_guides(world, camera((0, 0, 4), (0, 0, 0)), settings=dataclasses.replace(settings, seed=s), **SIZE)
        for s in range(16)
    ]
    on = runs[0].normal.any(axis=-1)
    assert 100 < on.sum() < 400
    direct = np.stack([run.direct[on] for run in runs])
    if model == "lambert":
        z_test(direct.mean(axis=1), np.array([0.8, 0.5, 0.2]), sigmas=4.0)
    assert (direct.mean(axis=(0, 1)) <= 1.0).all() and direct.mean() > 0.2
    # A convex body lights itself through the gaps between its flat faces and smooth normals only.
    assert np.mean([run.indirect[on].mean() for run in runs]) < 0.01
    np.testing.assert_allclose(runs[0].emission[~on], 1.0)


@pytest.mark.parametrize("scattered_model", ["lambert", "phong"])
def test_closed_sphere_adds_up_its_bounces(scattered_model):
    """Within a sphere that emits 1 and reflects r, light is 1 + r + r^2 + ...: emission, direct, each bounce."""
    r = 0.5
    inside = sphere(matt((r, r, r), emissive=(1.0, 1.0, 1.0), roughness=1.0), radius=2.0, inside=True)
    world = prepare(room(inside))
    eye = camera((0.0, 0.0, 0.0), (0.0, 0.2, -1.0), fov=1.5)
    found = {
        bounces: trace_guides(
            world, eye, settings=dataclasses.replace(PLAIN, bounces=bounces, samples_per_pixel=16, light_samples=4,
                                                     model=scattered_model), **SIZE,
        )
        for bounces in (1, 3)
    }  # fmt: skip
    np.testing.assert_allclose(found[1].emission, 1.0, rtol=1e-5)
    if scattered_model == "lambert":
        np.testing.assert_allclose(found[1].direct.mean(), r, rtol=5e-3)
        np.testing.assert_allclose(found[1].indirect.mean(), r**2, rtol=5e-3)
        np.testing.assert_allclose(found[3].indirect.mean(), r**2 + r**3 + r**4, rtol=1e-2)
    # Whatever the reflection, each bounce gives back at most all light.
    assert found[3].indirect.mean() > found[1].indirect.mean()


def test_roulette_leaves_the_mean():
    """With so many bounces that paths end by chance the sum is still that of the series."""
    r = 0.7
    world = prepare(room(sphere(matt((r, r, r), emissive=(1.0,) * 3), radius=2.0, inside=True)))
    settings = dataclasses.replace(PLAIN, bounces=12, samples_per_pixel=16)
    found = trace_guides(world, camera((0, 0, 0), (0, 0, -1)), settings=settings, height=20, width=24)
    np.testing.assert_allclose(found.indirect.mean(), sum(r**k for k in range(2, 14)), rtol=0.01)


@pytest.mark.parametrize("kind", [POINT, SPOT, DIRECTIONAL])
def test_lights_without_extent_are_exact(kind):
    """One sample gives albedo / pi times the irradiance, 0 in the shadow of a plate."""
    lamp = light(kind, position=(0.5, 2.0, 0.3), direction=(0.0, -1.0, 0.0), intensity=(5.0, 4.0, 3.0), cos_inner=0.9,
                 cos_outer=0.7)  # fmt: skip
    plate = square((-0.4, 1.0, 0.0), (0.3, 0, 0), (0, 0, -0.3), matt((0.1, 0.1, 0.1)))
    world = prepare(room(floor(), plate, lights=lamp))
    found = trace_guides(world, ABOVE, settings=PLAIN, **SIZE)
    on_floor = np.abs(found.position[..., 1]) < 1e-5
    p = found.position[on_floor].astype(np.float64)
    away = np.array([0.5, 2.0, 0.3]) - p
    distance = np.linalg.norm(away, axis=-1)
    cosine = away[:, 1] / distance
    if kind == DIRECTIONAL:
        away, falloff, cosine = np.array([[0.0, 1.0, 0.0]]) * np.ones_like(p), np.ones(len(p)), np.ones(len(p))
    else:
        falloff = distance**-2
    if kind == SPOT:
        falloff = falloff * np.clip((cosine - 0.7) / 0.2, 0.0, 1.0) ** 2
    expected = np.array([0.6, 0.5, 0.4]) / np.pi * np.array([5.0, 4.0, 3.0]) * (falloff * cosine)[:, None]
    at_plate = p + away * (1.0 - p[:, 1:2]) / away[:, 1:2]
    shadow = np.abs(at_plate[:, [0, 2]] - [-0.4, 0.0]).max(axis=1)
    lit, dark = shadow > 0.31, shadow < 0.29
    assert lit.sum() > 100 and dark.sum() > 5
    direct = found.direct[on_floor]
    np.testing.assert_allclose(direct[lit], expected[lit], rtol=2e-4, atol=1e-6)
    assert not direct[dark].any()


@pytest.mark.parametrize("double_sided", [False, True])
@pytest.mark.parametrize("bounces", [0, 1])
def test_a_lamp_over_a_floor(double_sided, bounces):
    """Against Lambert's formula for polygons, drawn only and found both ways; a lamp turned away is dark."""
    lamp = square((0.3, 1.5, 0.2), (0.4, 0, 0), (0, 0, 0.5), matt((0, 0, 0), emissive=(3.0, 2.0, 1.0),
                                                                   double_sided=double_sided))  # fmt: skip
    away = square((0.3, 1.5, 0.2), (0.4, 0, 0), (0, 0, -0.5), matt((0, 0, 0), emissive=(3.0, 2.0, 1.0),
                                                                    double_sided=double_sided))  # fmt: skip
    settings = dataclasses.replace(PLAIN, bounces=bounces, light_samples=4)
    eye = camera((0.0, 1.0, 4.0), (0.0, 0.0, 0.5), fov=0.5)
    traces = [
        trace_guides(prepare(room(floor(), lamp)), eye, settings=dataclasses.replace(settings, seed=seed), **SIZE)
        for seed in range(24)
    ]
    on_floor = (np.abs(traces[0].position[..., 1]) < 1e-5) & traces[0].normal.any(axis=-1)
    points = traces[0].position[on_floor].astype(np.float64)
    corners = np.asarray(lamp[0])
    irradiance = np.array([polygon_irradiance(p, np.array([0.0, 1.0, 0.0]), corners) for p in points])
    truth = np.array([0.6, 0.5, 0.4]) / np.pi * np.array([3.0, 2.0, 1.0]) * irradiance[:, None]
    z_test(np.stack([trace.direct[on_floor] for trace in traces]), truth)
    turned = trace_guides(prepare(room(floor(), away)), eye, settings=settings, **SIZE).direct[on_floor]
    assert turned.any() == double_sided


def test_variance_falls_with_samples_and_is_told():
    """1/n at least (the samples are spread evenly); and `variance` is that of the mean."""
    ball = sphere(matt((0.7, 0.7, 0.7)), radius=0.5)
    world = prepare(room(floor(), (ball[0] + np.array([0.0, 0.6, 0.0]), *ball[1:])), environment=WHITE)

    def incident(spp, seed):
        settings = dataclasses.replace(PLAIN, samples_per_pixel=spp, seed=seed, bounces=1)
        return trace_guides(world, ABOVE, settings=settings, **SIZE)

    spread = {}
    for spp in (2, 8):
        runs = [incident(spp, seed) for seed in range(12)]
        spread[spp] = np.stack([run.incident for run in runs]).var(axis=0, ddof=1).mean()
    told = np.mean([run.variance.mean() for run in runs])
    assert spread[8] < 0.3 * spread[2]
    # Samples of a sequence are not independent: the estimate from their spread is on the safe side.
    assert 0.7 * spread[8] < told < 4.0 * spread[8]


def test_same_seed_same_picture_and_blocks_do_not_show(monkeypatch):
    world = prepare(room(floor(), sphere(matt((0.7, 0.3, 0.2)), radius=0.5)), environment=WHITE)
    settings = TraceSettings(samples_per_pixel=2, bounces=2, seed=3)
    first, second = (render(world, ABOVE, settings=settings, **SIZE) for _ in range(2))
    np.testing.assert_array_equal(first.image, second.image)
    monkeypatch.setattr("jaxrender.pathtrace.programs.BLOCK", 512)
    np.testing.assert_array_equal(render(world, ABOVE, settings=settings, **SIZE).image, first.image)
    other = render(world, ABOVE, settings=dataclasses.replace(settings, seed=4), **SIZE)
    assert not np.array_equal(other.image, first.image)


@pytest.mark.parametrize("direct", ["plain", "ratio"])
def test_parts_add_up_and_agree_with_many_samples(direct):
    """Either way of adding up direct light comes to the same picture, with the same parts."""
    lamp = square((0.3, 1.5, 0.2), (0.4, 0, 0), (0, 0, 0.5), matt((0, 0, 0), emissive=(3.0, 3.0, 3.0)))
    scene = room(floor(), sphere(matt((0.7, 0.3, 0.2)), radius=0.4), lamp, lights=light(POINT, position=(1, 2, 1)))
    world = prepare(scene, environment=0.2 * WHITE)
    settings = TraceSettings(samples_per_pixel=16, light_samples=4, direct=direct, model="lambert")
    found = render(world, ABOVE, settings=settings, **SIZE)
    np.testing.assert_allclose(found.image, found.direct + found.indirect + found.emission, rtol=1e-5, atol=1e-6)
    reference = render(world, ABOVE, settings=dataclasses.replace(PLAIN, samples_per_pixel=128, seed=9), **SIZE)
    np.testing.assert_allclose(found.direct.mean(axis=(0, 1)), reference.direct.mean(axis=(0, 1)), rtol=0.02)
    np.testing.assert_allclose(found.indirect.mean(axis=(0, 1)), reference.indirect.mean(axis=(0, 1)), rtol=0.05)


def test_a_smooth_mirror_shows_the_lamp_either_way():
    """Polished metal: the lamp's image in it is found by scattered rays, also where shadows go by ratio."""
    metal = matt((1.0, 0.9, 0.8), metallic=1.0, roughness=0.1)
    lamp = square((0.0, 2.0, -2.0), (0.8, 0, 0), (0, 0.5, 0.5), matt((0, 0, 0), emissive=(4.0, 4.0, 4.0)))
    world = prepare(room(square((0, 0, 0), (3, 0, 0), (0, 0, -3), metal), lamp))
    eye = camera((0.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    means = {}
    for direct in ("plain", "ratio"):
        settings = TraceSettings(samples_per_pixel=16, bounces=1, direct=direct, method="none")
        means[direct] = render(world, eye, settings=settings, **SIZE).direct
    assert means["plain"].mean() > 0.05 and means["plain"].max() > 2.0
    np.testing.assert_allclose(means["ratio"].mean(), means["plain"].mean(), rtol=0.02)
    # Neither is a mess of spikes: the image of the lamp, at most as bright as the lamp.
    assert all(image.max() < 4.5 for image in means.values())


def test_reflections_in_metal_survive_the_filter():
    """A polished floor before striped walls: narrow windows where it mirrors, unless a radius is set."""
    stripes = np.zeros((8, 8, 3), np.uint8)
    stripes[:, ::2] = 230
    paint = matt((1.0, 1.0, 1.0), base_color_texture=0)
    wall = square((0.0, 1.0, -2.0), (3, 0, 0), (0, 1, 0), paint)
    metal = square((0, 0, 0), (3, 0, 0), (0, 0, -3), matt((0.9, 0.9, 0.9), metallic=1.0, roughness=0.05))
    image = SceneImage("stripes", stripes, ("repeat", "repeat"), True)
    sun = light(DIRECTIONAL, direction=(0.0, -0.3, -1.0), intensity=(3.0, 3.0, 3.0))
    world = prepare(room(metal, wall, lights=sun, images=(image,)))
    eye = camera((0.0, 1.0, 3.0), (0.0, 0.0, 0.0))
    settings = TraceSettings(samples_per_pixel=4, bounces=1, ao_rays=0)
    guides = trace_guides(world, eye, settings=settings, **SIZE)
    truth = trace_guides(world, eye, settings=dataclasses.replace(settings, samples_per_pixel=64, seed=3), **SIZE)
    mirrors = guides.sharpness[..., 0] > 0.9
    assert mirrors.sum() > 100 and guides.incident[mirrors].std() > 0.1
    matt_everywhere = dataclasses.replace(guides, sharpness=np.zeros_like(guides.sharpness))
    errors = [
        np.mean((filter_incident(one, settings)[0] - truth.incident)[mirrors] ** 2) for one in (guides, matt_everywhere)
    ]
    assert errors[0] < 0.2 * errors[1]
    set_radius = dataclasses.replace(settings, radius=2)
    given = [filter_incident(one, set_radius)[0] for one in (guides, matt_everywhere)]
    np.testing.assert_array_equal(*given)


def test_the_filter_is_cross_validated_from_16_samples_on():
    """And where it is asked for; what is set stays."""
    world = prepare(room(floor(), sphere(matt((0.7, 0.3, 0.2)), radius=0.5)), environment=WHITE)
    settings = TraceSettings(samples_per_pixel=2, bounces=1, ao_rays=0, model="lambert")
    guides = trace_guides(world, ABOVE, settings=settings, **SIZE)

    def told(**changed):
        return filter_incident(guides, dataclasses.replace(settings, **changed))[1]["how"]

    assert [told(), told(auto=True), told(auto=False, samples_per_pixel=16)] == ["rule", "cross-validation", "rule"]
    assert told(samples_per_pixel=16) == "cross-validation" and told(radius=2, eps=1.0, auto=True) == "given"


def test_holes_let_light_through():
    """A masked plate with a hole: eye rays, shadow rays and bounces pass it."""
    texels = np.full((16, 16, 4), 255, np.uint8)
    texels[4:12, 4:12, 3] = 0
    image = SceneImage("plate", texels, ("clamp", "clamp"), True)
    plate = square((0, 1.0, 0), (1, 0, 0), (0, 0, -1), matt((0.2, 0.2, 0.2), alpha_mode=MASK, base_color_texture=0,
                                                              double_sided=True))  # fmt: skip
    world = prepare(room(floor(), plate, lights=light(DIRECTIONAL), images=[image]))
    found = trace_guides(world, camera((0.0, 6.0, 0.01), (0.0, 0.0, 0.0), fov=0.6), settings=PLAIN, **SIZE)
    y, x, z = found.position[..., 1], found.position[..., 0], found.position[..., 2]
    through = np.maximum(np.abs(x), np.abs(z)) < 0.4
    assert through.sum() > 5 and (np.abs(y[through]) < 1e-5).all()
    assert (found.direct[through].max(axis=-1) > 0.1).all()
    ring = (np.maximum(np.abs(x), np.abs(z)) > 0.6) & (np.maximum(np.abs(x), np.abs(z)) < 0.95)
    assert (y[ring] > 0.99).sum() > 20


def many_kinds(lift=0.0):
    """A plate with a hole, a textured floor, a ball, a lamp, a light; the plate, ball and lamp are lifted."""
    texels = np.full((16, 16, 4), 255, np.uint8)
    texels[4:12, 4:12, 3], texels[:, ::2, 1] = 0, 90
    up = np.array([0.0, lift, 0.0])
    holed = matt((0.8, 0.7, 0.6), alpha_mode=MASK, base_color_texture=0, double_sided=True)
    plate = square(up + (0, 1, 0), (0.7, 0, 0), (0, 0, -0.7), holed)
    lamp = square(up + (0.3, 1.8, 0.2), (0.4, 0, 0), (0, 0, 0.5), matt((0, 0, 0), emissive=(3.0, 3.0, 3.0)))
    ball = sphere(matt((0.7, 0.3, 0.2)), radius=0.4)
    return room(
        floor(base_color_texture=0), plate, (ball[0] + up, *ball[1:]), lamp, lights=light(POINT, position=(1, 2, 1)),
        images=[SceneImage("plate", texels, ("clamp", "clamp"), True)],
    )  # fmt: skip


def assert_same_traces(found, truth):
    """Up to rounding; but rays that graze an edge may pass it on either side."""
    for name in ("arrived", "unshadowed", "sharp", "met", "incident", "albedo", "normal", "depth", "ao"):
        ours, theirs = getattr(found, name), getattr(truth, name)
        differ = (np.abs(ours - theirs) > 1e-4 + 1e-3 * np.abs(theirs)).any(axis=-1)
        assert differ.mean() < 0.01, name


def test_both_backends_make_one_picture_also_of_a_scene_that_moved():
    """Compiles the renderer for both. In the end the trees are refitted, not built anew."""
    settings = dataclasses.replace(PLAIN, bounces=1, samples_per_pixel=2, ao_rays=1)
    scene = many_kinds()
    ours, theirs = (prepare(scene, environment=0.2 * WHITE, rays=rays) for rays in ("jax", "embree"))
    found, truth = (render(world, ABOVE, settings=settings, **SIZE) for world in (ours, theirs))
    assert_same_traces(found.guides, truth.guides)
    assert (np.abs(found.image - truth.image) < 1e-4 + 1e-3 * truth.image).all(axis=-1).mean() > 0.98
    position = truth.guides.position
    through = np.abs(position[..., [0, 2]]).max(axis=-1) < 0.3
    assert (np.abs(position[through][:, 1]) < 0.41).any() and (position[..., 1] > 0.99).sum() > 20
    lifted = many_kinds(0.2)
    ours, theirs = (move(world, lifted) for world in (ours, theirs))
    found, truth = (trace_guides(world, ABOVE, settings=settings, **SIZE) for world in (ours, theirs))
    assert_same_traces(found, truth)
    anew = prepare(lifted, environment=0.2 * WHITE, rays="jax")
    assert float(ours.rays.solid.built_cost) != float(anew.rays.solid.built_cost)


def test_pools_of_samples_are_those_of_one_run():
    """Sums over sample numbers 0 and 1 to 3 are those over 0 to 3; variance and halves as well."""
    world = prepare(room(floor(), sphere(matt((0.7, 0.3, 0.2)), radius=0.5)), environment=WHITE)
    settings = dataclasses.replace(PLAIN, bounces=1)
    one = trace_guides(world, ABOVE, settings=settings, **SIZE)
    # Scattered rays share their light with as many others as the run has: apart, without that.
    lone = [trace_guides(world, ABOVE, settings=settings, first_sample=k, **SIZE) for k in range(4)]
    both = pooled(lone[0], lone[1], counts=(1, 1))
    four = pooled(both, pooled(lone[2], lone[3], counts=(1, 1)), counts=(2, 2))
    values = np.stack([run.incident for run in lone])
    np.testing.assert_array_equal(one.incident, lone[0].incident)
    np.testing.assert_allclose(four.incident, values.mean(axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(four.variance, values.var(axis=0, ddof=1) / 4, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(both.odd, lone[1].incident)


def test_occlusion_without_bounces_and_in_several_runs_is_of_rays_of_its_own():
    """Rays of ambient occlusion where there are no paths; those of a later run are others."""
    assert TraceSettings(samples_per_pixel=16, bounces=0).num_ao_rays == 8
    assert TraceSettings(samples_per_pixel=16, bounces=1).num_ao_rays == 0
    world = prepare(room(floor(), sphere(matt((0.7, 0.3, 0.2)), radius=0.5)), environment=WHITE)
    settings = dataclasses.replace(PLAIN, bounces=0, ao_rays=2)
    runs = [trace_guides(world, ABOVE, settings=settings, first_sample=k, **SIZE).ao for k in (0, 1)]
    four = trace_guides(world, ABOVE, settings=dataclasses.replace(settings, ao_rays=4), **SIZE).ao
    np.testing.assert_allclose(four, np.mean(runs, axis=0), atol=1e-6)
    assert (runs[0] != runs[1]).any() and four.min() < 0.9


def test_direct_and_indirect_alone():
    world = prepare(room(floor(), sphere(matt((0.7, 0.3, 0.2)), radius=0.5)), environment=WHITE)
    guides = trace_guides(world, ABOVE, settings=PLAIN, **SIZE)
    alone = trace_guides(world, ABOVE, settings=dataclasses.replace(PLAIN, bounces=0), **SIZE)
    np.testing.assert_array_equal(render_direct(world, ABOVE, settings=PLAIN, **SIZE), alone.direct)
    incident, albedo = render_indirect(world, ABOVE, settings=PLAIN, **SIZE)
    np.testing.assert_array_equal(incident * albedo, guides.indirect)


def test_a_scene_without_light_gets_a_sun_and_says_so():
    world = prepare(room(floor()))
    assert world.emitters.groups == ("lights", "environment")
    assert world.notes == ("no lights, a sun and a sky were added",)
    assert not prepare(room(floor()), environment=WHITE).notes


def test_a_lamp_without_extent_is_light_enough():
    """No light is soft: there are no ratios to look up, and direct light is that of the guide rays."""
    lamp = light(POINT, position=(0.0, 2.0, 0.0), intensity=(9.0, 9.0, 9.0))
    world = prepare(room(floor(), lights=lamp))
    found = render(world, ABOVE, settings=TraceSettings(samples_per_pixel=2, bounces=1), **SIZE)
    assert world.emitters.groups == ("lights",) and found.guides.arrived.shape == (*found.image.shape[:2], 0)
    # Straight under the lamp: I / d² · albedo / π.
    np.testing.assert_allclose(found.direct.max(axis=(0, 1)), 9.0 / 4.0 * np.array([0.6, 0.5, 0.4]) / np.pi, rtol=0.05)


def test_a_world_that_moves_is_the_one_built_anew():
    """Lamp and ball move; textures and surroundings are kept."""

    def pose(x):
        lamp = square((x, 1.5, 0.2), (0.4, 0, 0), (0, 0, 0.5), matt((0, 0, 0), emissive=(3.0, 3.0, 3.0)))
        ball = sphere(matt((0.7, 0.3, 0.2)), radius=0.4)
        return room(floor(), (ball[0] + np.array([0.0, 0.3 + x, 0.0]), *ball[1:]), lamp)

    first = prepare(pose(0.0), environment=0.3 * WHITE)
    moved = move(first, pose(0.5))
    anew = prepare(pose(0.5), environment=0.3 * WHITE)
    found, truth = (trace_guides(world, ABOVE, settings=PLAIN, **SIZE) for world in (moved, anew))
    for name in ("arrived", "incident", "normal", "emission"):
        np.testing.assert_array_equal(getattr(found, name), getattr(truth, name))
    assert moved.extent == first.extent and moved.emitters.groups == ("area", "environment")
    with pytest.raises(ValueError, match=r"scene\.faces: expected"):
        move(first, room(floor()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bounces": -1}, "bounces: expected"), ({"bounces": 65}, "bounces: expected at most 64, got 65"),
        ({"samples_per_pixel": 0}, "samples_per_pixel: expected"), ({"light_samples": 0}, "light_samples: expected"),
        ({"model": "toon"}, "model: expected"), ({"method": "box"}, "method: expected"),
        ({"direct": "both"}, "direct: expected"), ({"ao_rays": -1}, "ao_rays: expected"),
    ],
)  # fmt: skip
def test_settings_out_of_range_are_named(change, message):
    world = prepare(room(floor()))
    with pytest.raises(ValueError, match=message):
        render(world, ABOVE, settings=dataclasses.replace(PLAIN, **change), **SIZE)
    with pytest.raises(ValueError, match="height: expected"):
        render(world, ABOVE, height=0, width=4)


def test_bad_scenes_are_refused():
    scene = room(floor())
    spoiled = dataclasses.replace(scene, positions=scene.positions.at[0, 0].set(jnp.inf))
    with pytest.raises(ValueError, match=r"scene\.positions: expected finite numbers"):
        prepare(spoiled)


def test_a_camera_inside_geometry_sees_something():
    world = prepare(room(sphere(matt((0.5, 0.5, 0.5)))), environment=WHITE)
    found = render(world, camera((0, 0, 0), (0, 0, -1)), settings=TraceSettings(), **SIZE)
    assert np.isfinite(found.image).all()


def test_nothing_in_view_is_the_surroundings():
    world = prepare(room(sphere(matt((0.5, 0.5, 0.5)))), environment=0.25 * WHITE)
    found = render(world, camera((0, 0, 4), (0, 0, 8)), settings=TraceSettings(samples_per_pixel=2), **SIZE)
    np.testing.assert_allclose(found.image, 0.25, rtol=1e-6)
