"""Packed G-buffers and G-buffers in files: what is lost, and what other renderers call it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.camera import Camera
from jaxrender.checks import InputError
from jaxrender.deferred import (
    CENTER,
    draw_gbuffer,
    gbuffer_from_layers,
    gbuffer_layers,
    ordered_grid,
    pack_gbuffer,
    scene_textures,
    see,
    standard_pattern,
    unpack_gbuffer,
)
from jaxrender.deferred.packing import decode_octahedral, encode_octahedral
from jaxrender.io import known_layers, read_exr_layers, write_exr
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.scene import whole_scene_camera
from tests.support import oracles

SIZE = {"height": 40, "width": 56}


def drawn(samples=CENTER):
    scene = builtin_scene(num_vertices=1500)
    camera = whole_scene_camera(scene, aspect=56 / 40)
    fragments = see(scene, camera, **SIZE, samples=samples)
    return draw_gbuffer(scene, fragments, textures=scene_textures(scene)), camera


def degrees(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1)))


def test_octahedral_map_is_inverted_and_folds_where_the_survey_folds(rng):
    n = oracles.unit(rng.normal(size=(20000, 3))).astype(np.float32)
    p = np.asarray(encode_octahedral(jnp.asarray(n)))
    assert np.abs(p).max() <= 1.0
    np.testing.assert_allclose(decode_octahedral(jnp.asarray(p)), n, atol=4 * np.finfo(np.float32).eps)
    axes = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    expected = [[1, 0], [0, 1], [0, 0], [-1, 0], [0, -1], [1, 1]]
    np.testing.assert_array_equal(np.asarray(encode_octahedral(jnp.asarray(axes))), expected)
    assert np.isfinite(np.asarray(encode_octahedral(jnp.zeros((1, 3))))).all()


@pytest.mark.parametrize(("bits", "mean", "worst"), [(8, 0.335, 0.96), (16, 0.0013, 0.0038)])
def test_angles_lost_are_those_of_the_survey(bits, mean, worst, rng):
    n = oracles.unit(rng.normal(size=(200_000, 3)))
    gbuffer, _ = drawn()
    flat = jnp.asarray(n, jnp.float32)
    own = dataclasses.replace(gbuffer, normal=flat, geometric_normal=flat)
    codes = pack_gbuffer(own, normal_bits=bits).normal
    assert codes.dtype == np.uint8 and codes.shape == (200_000, 2, bits // 8)
    weights = 256.0 ** np.arange(bits // 8)
    p = 2.0 * np.sum(np.asarray(codes, np.float64) * weights, axis=-1) / (2.0**bits - 1) - 1.0
    back = np.concatenate([p, 1 - np.abs(p).sum(axis=1, keepdims=True)], axis=1)
    lower = back[:, 2] < 0
    back[lower, :2] = (1 - np.abs(p[lower][:, ::-1])) * np.where(p[lower] >= 0, 1, -1)
    found = degrees(oracles.unit(back), n)
    assert 0.98 * mean < found.mean() < 1.02 * mean and 0.8 * worst < found.max() < worst


@pytest.mark.parametrize("samples", [CENTER, ordered_grid(2), standard_pattern(4)])
@pytest.mark.parametrize(("normal_bits", "depth_bits"), [(8, 16), (16, 24)])
def test_what_is_packed_comes_back(samples, normal_bits, depth_bits):
    gbuffer, camera = drawn(samples)
    packed = pack_gbuffer(gbuffer, samples=samples, normal_bits=normal_bits, depth_bits=depth_bits)
    back = unpack_gbuffer(packed, camera)
    some = np.asarray(gbuffer.coverage)
    assert 0.1 < some.mean() < 0.99
    for name in ("material_id", "triangle_id"):
        np.testing.assert_array_equal(getattr(back, name), getattr(gbuffer, name))
    far = float(gbuffer.depth.max())
    step = far / (2**depth_bits - 1)
    # Half a step, and the rounding of float32.
    np.testing.assert_allclose(back.depth, gbuffer.depth, atol=0.5 * step + 1e-6 * far)
    # Along a ray a position moves by at most 1/cos of the depth. Rays go through the pixel's centre, positions lie on
    # triangles with corners snapped to 1/256 px: off by up to 1/360 px, of 40 in the field of view.
    view = 2.0 * np.tan(float(camera.fov_y_radians) / 2) * far / 40
    np.testing.assert_allclose(back.position, gbuffer.position, atol=0.8 * step + view / 360 + 2e-6 * far)
    np.testing.assert_allclose(back.uv, gbuffer.uv, atol=1e-5)
    np.testing.assert_allclose(back.duv_dx, gbuffer.duv_dx, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(back.color, gbuffer.color, atol=0.5 / 255 + 1e-6)
    angles = degrees(np.asarray(back.normal)[some], np.asarray(gbuffer.normal)[some])
    assert angles.max() < (0.97 if normal_bits == 8 else 0.05)
    for name in ("position", "normal", "geometric_normal", "uv", "depth", "color"):
        assert (np.asarray(getattr(back, name))[~some] == 0).all(), name
    size = sum(np.asarray(getattr(packed, f.name)).nbytes for f in dataclasses.fields(packed)[:9])
    assert size / some.size <= 40 if normal_bits == 16 else size / some.size <= 33 + 8


def test_a_gbuffer_survives_a_file(tmp_path):
    gbuffer, camera = drawn()
    write_exr(tmp_path / "g.exr", gbuffer_layers(gbuffer, sample=0))
    layers = known_layers(read_exr_layers(tmp_path / "g.exr"))
    back = gbuffer_from_layers(layers, name="g.exr")
    for name in ("position", "depth", "uv", "material_id", "triangle_id"):
        np.testing.assert_array_equal(getattr(back, name), getattr(gbuffer, name), err_msg=name)
    np.testing.assert_allclose(back.normal, gbuffer.normal, atol=1e-6)
    # Differences within a material against exact derivatives: alike away from borders.
    close = np.abs(np.asarray(back.duv_dx - gbuffer.duv_dx)).max(axis=-1) < 0.15 * np.abs(gbuffer.duv_dx).max()
    assert close.mean() > 0.95
    del layers["position"]
    again = gbuffer_from_layers(layers, camera=camera)
    np.testing.assert_allclose(again.position, gbuffer.position, atol=2e-4)
    with pytest.raises(InputError, match=r"g\.exr: layers: expected both depth and position, if no camera is given"):
        gbuffer_from_layers(layers, name="g.exr")
    with pytest.raises(InputError, match="expected normal, and depth or position, got depth"):
        gbuffer_from_layers({"depth": layers["depth"]})


@pytest.mark.parametrize(
    "names",
    [
        {"normal": "ViewLayer.Normal", "depth": "ViewLayer.Depth", "position": "ViewLayer.Position",
         "uv": "ViewLayer.UV", "albedo": "ViewLayer.DiffCol"},  # Blender
        {"normal": "sh_normal", "geometric_normal": "geo_normal", "position": "position", "uv": "uv", "depth": "dd.y",
         "albedo": "albedo"},  # Mitsuba
        {"normal": "Ns", "geometric_normal": "N", "position": "P", "albedo": "Albedo"},  # pbrt
        {"normal": "N", "position": "P", "depth": "Z", "albedo": "diffuse_albedo"},  # Arnold
    ],
)  # fmt: skip
def test_layers_of_other_renderers_are_known(names, rng, tmp_path):
    counts = {"depth": 1, "uv": 2}
    values = {ours: rng.uniform(0.1, 1, (4, 5, counts.get(ours, 3))).astype(np.float32) for ours in names}
    write_exr(tmp_path / "x.exr", {theirs: values[ours] for ours, theirs in names.items()})
    found = known_layers(read_exr_layers(tmp_path / "x.exr"))
    assert set(found) == set(names)
    for ours in names:
        np.testing.assert_array_equal(found[ours], values[ours][..., : found[ours].shape[-1]])


def test_distance_along_rays_becomes_depth():
    gbuffer, camera = drawn()
    layers = {name: v for name, v in known_layers(gbuffer_layers(gbuffer, sample=0)).items() if name != "position"}
    away = np.linalg.norm(np.asarray(gbuffer.position)[:, :, 0] - np.asarray(camera.eye), axis=-1, keepdims=True)
    some = np.asarray(gbuffer.coverage)
    back = gbuffer_from_layers({**layers, "depth": np.where(some, away, 0.0)}, camera=camera, depth_kind="distance")
    np.testing.assert_allclose(back.depth, gbuffer.depth, rtol=2e-4, atol=1e-6)
    with pytest.raises(InputError, match="the camera of a depth along rays"):
        gbuffer_from_layers({**layers, "position": layers["normal"]}, depth_kind="distance")


def test_uv_with_alpha_as_blender_writes_it(tmp_path, rng):
    """Channels U, V and A of one pass: U and V belong together."""
    u, v, a = rng.uniform(size=(3, 4, 5, 1)).astype(np.float32)
    write_exr(tmp_path / "x.exr", {"ViewLayer.UV.U": u, "ViewLayer.UV.V": v, "ViewLayer.UV.A": a})
    found = known_layers(read_exr_layers(tmp_path / "x.exr"))
    np.testing.assert_array_equal(found["uv"], np.concatenate([u, v], axis=-1))


def test_nothing_far_away_counts(rng):
    """Blender's background depth of 1e10, infinities and NaN are empty; a camera looks along its axis."""
    normal = np.tile(np.float32([0, 0, 1]), (2, 3, 1))
    depth = np.float32([[[2.0], [1e10], [np.inf]], [[np.nan], [0.0], [3.0]]])
    camera = Camera(*(jnp.asarray(v, jnp.float32) for v in ([0.0, 0, 0], [0.0, 0, -1], [0.0, 1, 0])), jnp.float32(1.0))
    gbuffer = gbuffer_from_layers({"normal": normal, "depth": depth}, camera=camera)
    np.testing.assert_array_equal(np.asarray(gbuffer.coverage)[..., 0], [[1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(np.asarray(gbuffer.position)[..., 0, 2], [[-2, 0, 0], [0, 0, -3]], atol=1e-6)
