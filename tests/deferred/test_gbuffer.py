"""G-buffers: bands that do not show, motion against projected points, batches of cameras and poses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxrender.camera import Camera, clip_from_world, project_px
from jaxrender.deferred import (
    CENTER,
    Budget,
    clip_positions,
    draw_gbuffer,
    draw_late,
    gbuffer_from_layers,
    make_gbuffer,
    ordered_grid,
    raster,
    rasterize,
    rasterize_triangles,
    rasterize_within,
    scene_textures,
    see,
    standard_pattern,
)
from jaxrender.deferred import gbuffer as gbuffer_module
from jaxrender.io import known_layers, read_exr_layers
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.scene import whole_scene_camera

SIZE = {"height": 45, "width": 61}
WITHIN = jax.jit(
    rasterize_within,
    static_argnames=("budget", "height", "width", "samples", "cull"),
)
FIELDS = ("triangle_id", "screen_id", "barycentrics", "depth", "w")


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(num_vertices=1500)


@pytest.mark.parametrize("samples", [CENTER, ordered_grid(2), ordered_grid(3), standard_pattern(8)])
def test_strips_and_bands_do_not_show(scene, samples, monkeypatch):
    """An image in many strips and bands, the last ones cut off, is the image in one."""
    camera = whole_scene_camera(scene, aspect=61 / 45)
    textures = scene_textures(scene)
    whole = see(scene, camera, **SIZE, samples=samples)
    one = draw_gbuffer(scene, whole, textures=textures)
    monkeypatch.setattr(raster, "TILES_PER_STRIP", 8)
    monkeypatch.setattr(gbuffer_module, "SAMPLES_PER_BAND", 61 * samples.count * 7)
    pieces = see(scene, camera, **SIZE, samples=samples)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)
    for many in (draw_gbuffer(scene, pieces, textures=textures), make_gbuffer(scene, pieces, textures=textures)):
        for field in dataclasses.fields(one):
            a, b = getattr(many, field.name), getattr(one, field.name)
            if b is not None:
                # The same operations, fused by the compiler as the shape suits it: a few roundings apart.
                np.testing.assert_allclose(a, b, atol=3e-5, rtol=1e-4, err_msg=field.name)


@pytest.mark.parametrize("samples", [CENTER, ordered_grid(2), standard_pattern(4)])
def test_motion_is_that_of_the_points(scene, samples):
    """The eye moves, and so does the body: the surface point seen now is looked up in the previous picture."""
    camera = whole_scene_camera(scene, aspect=61 / 45)
    before = dataclasses.replace(camera, eye=camera.eye + jnp.asarray([0.3, -0.1, 0.2]))
    sway = 0.1 * jnp.sin(3.0 * scene.positions[:, 1:2]) * jnp.asarray([[1.0, 0.0, 0.5]])
    previous = dataclasses.replace(scene, positions=scene.positions + sway)
    fragments = see(scene, camera, **SIZE, samples=samples)
    gbuffer = make_gbuffer(scene, fragments, previous_clip=clip_positions(previous, before, **SIZE))
    some = np.asarray(gbuffer.coverage)
    corners = np.asarray(fragments.faces)[np.asarray(fragments.triangle_id)[some]]
    b = np.asarray(fragments.barycentrics, np.float64)[some]
    weights = np.stack([1 - b.sum(axis=1), b[:, 0], b[:, 1]], axis=1)
    then = np.sum(weights[..., None] * np.asarray(previous.positions, np.float64)[corners], axis=1)
    now = np.sum(weights[..., None] * np.asarray(scene.positions, np.float64)[corners], axis=1)
    at = lambda c, p: np.asarray(project_px(c, jnp.asarray(p, jnp.float32), **SIZE)[0])  # noqa: E731
    # The sample's own place, against that of its point with snapped corners: up to 1/360 px of the pixel grid beside.
    unit = 1.0 / samples.grid
    np.testing.assert_allclose(
        np.asarray(gbuffer.motion)[some], at(camera, now) - at(before, then), atol=0.006 * unit + 2e-3
    )
    assert np.abs(np.asarray(gbuffer.motion)[some]).max() > 1.0 and (np.asarray(gbuffer.motion)[~some] == 0).all()
    still = make_gbuffer(scene, fragments, previous_clip=clip_positions(scene, camera, **SIZE))
    assert np.abs(np.asarray(still.motion)).max() < 0.006 * unit + 1e-3
    assert make_gbuffer(scene, fragments).motion is None


def test_batches_of_cameras_and_poses(scene):
    """`vmap` of the pure form over views and over poses is each picture by itself."""
    cameras = [whole_scene_camera(scene, aspect=61 / 45, azimuth_radians=a) for a in (0.2, 2.0)]
    matrices = jnp.stack([clip_from_world(c, **SIZE, near=jnp.float32(0.5), far=jnp.float32(40.0)) for c in cameras])
    points = jnp.pad(scene.positions, ((0, 0), (0, 1)), constant_values=1.0)
    poses = jnp.stack([points, points * jnp.asarray([[0.8, 1.1, 0.9, 1.0]])])
    budget = Budget(max_clipped=64, max_spans=8192, max_pairs=8192)

    def draw(points, matrix):
        clip = jnp.einsum("vi,ji->vj", points, matrix, precision="highest")
        fragments, demand = rasterize_within(clip, scene.faces, budget, **SIZE, cull="back")
        return clip, (fragments.triangle_id, fragments.depth, fragments.barycentrics), demand.exceeds(budget)

    clips, pictures, over = jax.jit(jax.vmap(draw))(poses, matrices)
    assert not np.asarray(over).any()
    for k in range(2):
        alone = rasterize(clips[k], scene.faces, **SIZE, cull="back")
        np.testing.assert_array_equal(pictures[0][k], alone.triangle_id)
        np.testing.assert_allclose(pictures[1][k], alone.depth, atol=1e-6)
        np.testing.assert_allclose(pictures[2][k], alone.barycentrics, atol=2e-5)
        assert 0.1 < float(alone.coverage.mean()) < 0.99


def test_a_multilayer_file_of_others_is_read(shared_data):
    """OpenEXR's own multi-channel beach ball has a left view with depth; it has no normals, and the message says so."""
    path = shared_data / "openexr_multichannel" / "beachball_singlepart.0001.exr"
    known = known_layers(read_exr_layers(path))
    assert "depth" in known
    with pytest.raises(ValueError, match="normal"):
        gbuffer_from_layers(known, camera=Camera(*(jnp.zeros(3) for _ in range(3)), jnp.float32(1.0)), name=str(path))


@pytest.mark.parametrize(("height", "width"), [(0, 5), (4, 0), (0, 0)])
def test_images_without_pixels(scene, height, width):
    size = {"height": height, "width": width}
    camera = whole_scene_camera(scene)
    fragments = see(scene, camera, **size)
    for gbuffer in (make_gbuffer(scene, fragments), draw_gbuffer(scene, fragments)):
        assert gbuffer.position.shape == (height, width, 1, 3) and gbuffer.triangle_id.shape == (height, width, 1)
    within, demand = WITHIN(clip_positions(scene, camera, height=4, width=4), scene.faces, Budget(8, 8, 8), **size)
    assert within.depth.shape == (height, width, 1) and not bool(demand.exceeds(Budget(0, 0, 0)))


def test_the_pure_form_on_nothing_and_on_wrong_indices(scene):
    clip = clip_positions(scene, whole_scene_camera(scene, aspect=61 / 45), **SIZE)
    none, demand = WITHIN(clip, scene.faces[:0], Budget(0, 0, 0), **SIZE)
    assert not bool(none.coverage.any()) and not bool(demand.exceeds(Budget(0, 0, 0)))
    budget = Budget(64, 8192, 8192)
    wrong = scene.faces.at[::2, 1].set(len(clip)).at[1::4, 2].set(-1)
    got, _ = WITHIN(clip, wrong, budget, **SIZE)
    kept = np.asarray(((wrong >= 0) & (wrong < len(clip))).all(axis=1))
    expected = rasterize(clip, scene.faces, **SIZE, drawn=jnp.asarray(kept))
    assert 0 < kept.sum() < len(kept) and bool(expected.coverage.any())
    np.testing.assert_array_equal(got.triangle_id, expected.triangle_id)


def test_more_pairs_than_there_are_numbers_for_are_refused():
    """4,101 rectangles over 16,352² samples: 4.3 thousand millions of pairs."""
    corners = jnp.asarray([[-1, -1, 0.5, 1], [1, -1, 0.5, 1], [1, 1, 0.5, 1], [-1, 1, 0.5, 1]], jnp.float32)
    faces = jnp.tile(jnp.asarray([[0, 1, 2], [0, 2, 3]], jnp.int32), (4101, 1))
    with pytest.raises(ValueError, match="fewer than 2\\^31 pairs"):
        rasterize(corners, faces, height=16352, width=16352)


@pytest.mark.parametrize("side", [64, 97])
def test_closed_meshes_have_as_many_fronts_as_backs(side, rng):
    """Along every line of sight a closed surface is entered as often as it is left, sample by sample."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    lumps = 1.0 + 0.5 * np.sin(7 * sphere.vertices @ rng.normal(size=(3, 1)))
    points = sphere.vertices * lumps * [0.6, 0.5, 0.3] + [0.0, 0.0, 0.5]
    clip = jnp.asarray(np.concatenate([points, np.ones((len(points), 1))], axis=1), jnp.float32)
    faces, size = jnp.asarray(sphere.faces, jnp.int32), {"height": side, "width": side}
    triangles = raster.screen_triangles(clip, faces, **size)
    nothing = rasterize_triangles(dataclasses.replace(triangles, valid=triangles.valid & False), faces, **size)
    fronts, backs = np.zeros(side * side, int), np.zeros(side * side, int)
    front = np.asarray(triangles.front)

    def count(late):
        place, own = np.asarray(late.place), np.asarray(late.screen_id)
        np.add.at(fronts, place[(own >= 0) & front[own]], 1)
        np.add.at(backs, place[(own >= 0) & ~front[own]], 1)
        return np.zeros(len(place), bool), np.asarray(late.depth)

    draw_late(nothing, triangles, count)
    np.testing.assert_array_equal(fronts, backs)
    assert (fronts > 0).mean() > 0.2 and fronts.max() > 1
