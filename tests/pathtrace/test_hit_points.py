"""Surfaces where rays end: against the G-buffer's kernels, on both sides, and where nothing is hit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.gbuffer import AttributeTable, mapped_normal, smooth_points
from jaxrender.deferred.material_textures import pack_materials
from jaxrender.deferred.shade import look_up_surface
from jaxrender.pathtrace.hit_points import gather_corners, hit_surface, interpolate, surface_table
from jaxrender.vecmath import normalize
from tests.pathtrace.made_up import make_scene, plain_material, rows, small_scene, vec
from tests.support import oracles

N = 400
INTERPOLATE, HIT = jax.jit(interpolate), jax.jit(hit_surface)


@pytest.fixture
def small(rng):
    return small_scene(rng)


def hits(rng, scene, count=N):
    """Triangles, points on them and directions from either side, with normals of the vertices well on the front.

    Elsewhere the triangle's own normal takes their place, which the G-buffer does not do.
    """
    triangle = rng.integers(0, len(scene.faces), 20 * count).astype(np.int32)
    weights = rng.dirichlet([1.0, 1.0, 1.0], len(triangle))
    corners = np.asarray(scene.faces)[triangle]
    p, n = np.asarray(scene.positions)[corners], np.asarray(scene.normals)[corners]
    flat = oracles.unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    smooth = oracles.unit(np.einsum("nk,nka->na", weights, n))
    kept = np.flatnonzero((flat * smooth).sum(1) > 0.05)[:count]
    direction = oracles.unit(rng.normal(size=(count, 3)))
    assert len(kept) == count
    dtype = jnp.result_type(float)
    return jnp.asarray(triangle[kept]), jnp.asarray(weights[kept, 1:], dtype), vec(direction)


def gbuffer_of(scene, triangle, barycentrics, direction):
    """The G-buffer's fields at the same points, seen from the side of the rays, on the finest level."""
    corners = [
        jnp.concatenate(
            [getattr(scene, name) for name in ("positions", "normals", "uv", "colors", "tangents")], axis=1
        )[scene.faces[:, k]]
        for k in range(3)
    ]
    a, b, c = corners
    p = scene.positions[scene.faces]
    flat = normalize(jnp.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    front = jnp.sum(flat[triangle] * jnp.stack(direction, axis=-1), axis=1) < 0.0
    n = len(triangle)
    table = AttributeTable(
        corner=jnp.concatenate([a, b - a, c - a], axis=1), flat=flat, material_id=scene.material_id,
        slopes=jnp.zeros((n, 6), a.dtype), front=front,
    )  # fmt: skip
    buffer, tangent, _ = smooth_points(
        table, triangle, jnp.arange(n, dtype=jnp.int32), barycentrics, jnp.ones(n, a.dtype)
    )
    return buffer, tangent


def test_attributes_are_those_of_the_gbuffer(small, rng, x64):
    scene, textures = small_scene(rng)
    table = surface_table(scene, textures=textures)
    triangle, barycentrics, direction = hits(rng, scene)
    points = INTERPOLATE(table, gather_corners(table, triangle), triangle, barycentrics, direction, None)
    buffer, tangent = gbuffer_of(scene, triangle, barycentrics, direction)
    for mine, theirs in (
        (points.position, buffer.position), (points.normal, buffer.normal),
        (points.geometric_normal, buffer.geometric_normal), (points.color, buffer.color[:, :3]),
        (points.tangent, normalize(tangent[:, :3])),
    ):  # fmt: skip
        np.testing.assert_allclose(rows(mine), theirs, atol=1e-12)
    for mine, theirs in (
        (points.u, buffer.uv[:, 0]), (points.v, buffer.uv[:, 1]), (points.alpha, buffer.color[:, 3]),
        (points.handedness, tangent[:, 3]), (points.material_id, buffer.material_id),
    ):  # fmt: skip
        np.testing.assert_allclose(mine, theirs, atol=1e-12)
    assert 0.3 < np.mean(points.front) < 0.7
    # Either side is seen from where the ray comes.
    assert (np.sum(rows(points.geometric_normal) * rows(direction), axis=1) < 0.0).all()


@pytest.mark.parametrize("packed", [False, True])
def test_materials_textures_and_normal_maps_are_those_of_deferred_shading(packed, rng, x64):
    scene, textures = small_scene(rng)
    if packed:
        # One texture for each material, so that they fit side by side.
        none = jnp.full(4, -1, jnp.int32)
        material = dataclasses.replace(
            scene.material, normal_texture=jnp.asarray([2, -1, -1, -1], jnp.int32), occlusion_texture=none,
            base_color_texture=jnp.asarray([2, -1, 0, -1], jnp.int32), emissive_texture=jnp.asarray([-1, 0, 0, -1]),
            metallic_roughness_texture=none,
        )  # fmt: skip
        scene = dataclasses.replace(scene, material=material)
    own = pack_materials(textures, scene.material) if packed else textures
    assert own is not None
    table = surface_table(scene, textures=own)
    triangle, barycentrics, direction = hits(rng, scene)
    found = HIT(table, triangle, barycentrics, direction)
    buffer, tangent = gbuffer_of(scene, triangle, barycentrics, direction)
    surface = jax.jit(look_up_surface)(buffer, scene.material, textures)
    for name in ("base_color", "emissive"):
        np.testing.assert_allclose(rows(getattr(found, name)), getattr(surface, name), atol=1e-12)
    for name in ("metallic", "roughness"):
        np.testing.assert_allclose(getattr(found, name), getattr(surface, name)[:, 0], atol=1e-12)
    np.testing.assert_allclose(found.alpha, surface.alpha, atol=1e-12)
    turned = jax.jit(mapped_normal)(buffer, tangent, scene.material, textures)
    np.testing.assert_allclose(rows(found.normal), turned, atol=1e-12)
    assert np.abs(np.asarray(turned) - np.asarray(buffer.normal)).max() > 0.1


def test_attributes_that_say_nothing_are_left_out_and_mean_the_same(rng):
    scene = make_scene(rng.normal(size=(6, 3)), [[0, 1, 2], [3, 4, 5]], material=plain_material())
    table = surface_table(scene)
    assert table.attributes == ("position", "normal") and table.slots == ()
    triangle, barycentrics = jnp.asarray([0, 1], jnp.int32), jnp.full((2, 2), 0.25, jnp.float32)
    found = HIT(table, triangle, barycentrics, vec([[0.0, 0.0, 1.0]] * 2))
    p = np.asarray(scene.positions)[np.asarray(scene.faces)]
    np.testing.assert_allclose(rows(found.position), np.einsum("k,nka->na", [0.5, 0.25, 0.25], p), atol=1e-6)
    assert (rows(found.base_color) == 1.0).all() and (np.asarray(found.alpha) == 1.0).all()


def test_where_nothing_is_hit_all_numbers_are_0(small):
    scene, textures = small
    for own, width in ((surface_table(scene, textures=textures), 0.1), (surface_table(scene), None)):
        triangle = jnp.full(3, -1, jnp.int32)
        arguments = triangle, jnp.full((3, 2), 0.3, jnp.float32), vec([[0.0, 0.0, 1.0]] * 3)
        wide = None if width is None else jnp.full(3, width, jnp.float32)
        points = INTERPOLATE(own, gather_corners(own, triangle), *arguments, wide)
        surface = HIT(own, *arguments, width=wide)
        for record in (points, surface):
            for name, value in record._asdict().items():
                expected = -1 if name == "triangle" else 0
                assert all((np.asarray(x) == expected).all() for x in jax.tree.leaves(value)), name


def test_a_normal_that_looks_to_the_back_gives_way_to_the_triangle(rng):
    scene = make_scene(rng.normal(size=(3, 3)), [[0, 1, 2]], material=plain_material())
    scene = dataclasses.replace(scene, normals=-scene.normals)
    table = surface_table(scene)
    flat = -np.asarray(scene.normals)[0]
    for sign in (1.0, -1.0):
        direction = vec([-sign * flat])
        found = HIT(table, jnp.zeros(1, jnp.int32), jnp.full((1, 2), 0.2, jnp.float32), direction)
        np.testing.assert_allclose(rows(found.normal)[0], sign * flat, atol=1e-6)
        assert bool(found.front[0]) == (sign > 0.0)


@pytest.mark.parametrize("lean", [0.0, 1.2])
def test_the_width_in_uv_is_the_rays_over_the_root_of_the_cosine(lean):
    """A square of side 4 on which uv runs from 0 to 2: half a unit of uv a metre."""
    positions = np.array([[0.0, 0, 0], [4.0, 0, 0], [4.0, 4.0, 0], [0.0, 4.0, 0]])
    scene, textures = small_scene(np.random.default_rng(1))
    material = plain_material(1, base_color_texture=np.zeros(1, np.int32))
    scene = make_scene(positions, [[0, 1, 2], [0, 2, 3]], material=material, uv=positions[:, :2] * 0.5)
    table = surface_table(scene, textures=textures)
    triangle = jnp.asarray([0, 1], jnp.int32)
    direction = vec([[np.sin(lean), 0.0, -np.cos(lean)]] * 2)
    points = INTERPOLATE(
        table, gather_corners(table, triangle), triangle, jnp.full((2, 2), 0.3, jnp.float32), direction,
        jnp.full(2, 0.08, jnp.float32),
    )  # fmt: skip
    np.testing.assert_allclose(points.uv_width, 0.08 * 0.5 / np.sqrt(np.cos(lean)), rtol=1e-5)


def test_a_wide_ray_sees_the_mean_of_the_texture(small, rng):
    scene, textures = small
    material = plain_material(1, base_color_texture=np.zeros(1, np.int32))
    scene = make_scene(rng.normal(size=(3, 3)), [[0, 1, 2]], material=material, uv=rng.normal(size=(3, 2)))
    table = surface_table(scene, textures=textures)
    arguments = (
        jnp.zeros(5, jnp.int32),
        jnp.asarray(rng.uniform(0.0, 0.5, (5, 2)), jnp.float32),
        vec(np.eye(3)[[2] * 5]),
    )
    wide = HIT(table, *arguments, width=jnp.full(5, 1e4, jnp.float32))
    last = np.asarray(textures.texels)[int(textures.offset[0, -1])]
    np.testing.assert_allclose(rows(wide.base_color), np.tile(last[:3], (5, 1)), rtol=1e-5)
    fine, narrow = HIT(table, *arguments), HIT(table, *arguments, width=jnp.zeros(5, jnp.float32))
    np.testing.assert_allclose(rows(fine.base_color), rows(narrow.base_color), rtol=1e-5)


def test_gradients_in_positions_normals_and_colors_are_those_of_finite_differences(rng, x64):
    scene, textures = small_scene(rng)
    triangle, barycentrics, direction = hits(rng, scene, 60)
    mix = rng.normal(size=(4, 60, 3))
    names = ("positions", "normals", "tangents")

    def value(arrays):
        moved = dataclasses.replace(scene, **dict(zip(names, arrays, strict=True)))
        found = hit_surface(surface_table(moved, textures=textures), triangle, barycentrics, direction)
        seen = (found.position, found.normal, found.geometric_normal, found.base_color)
        return sum(jnp.sum(c * m[:, k]) for v, m in zip(seen, mix, strict=True) for k, c in enumerate(v))

    arrays = [getattr(scene, name) for name in names]
    compiled, slopes = jax.jit(value), jax.jit(jax.grad(value))(arrays)
    for i, name in enumerate(names):
        step, h = rng.normal(size=arrays[i].shape), 1e-6
        moved = [[*arrays[:i], arrays[i] + s * h * step, *arrays[i + 1 :]] for s in (1.0, -1.0)]
        slope = (compiled(moved[0]) - compiled(moved[1])) / (2.0 * h)
        assert abs(slope) > 1e-3, name
        np.testing.assert_allclose(jnp.sum(slopes[i] * step), slope, rtol=1e-5, err_msg=name)


def test_gradients_in_positions_are_finite_without_texture_coordinates_and_area(rng):
    """Roots of 0 in the density of texture coordinates must not spoil what does not depend on it."""
    positions = np.concatenate([rng.normal(size=(3, 3)), np.ones((3, 3))])
    scene = make_scene(positions, [[0, 1, 2], [3, 4, 5]], material=plain_material())

    def value(positions):
        table = surface_table(dataclasses.replace(scene, positions=positions))
        triangle, places = jnp.zeros(1, jnp.int32), jnp.full((1, 2), 0.2, jnp.float32)
        return sum(jnp.sum(c) for c in hit_surface(table, triangle, places, vec([[0.0, 0.6, 0.8]])).position)

    expected = np.zeros((6, 3))
    expected[:3] = np.array([0.6, 0.2, 0.2])[:, None]
    np.testing.assert_allclose(jax.jit(jax.grad(value))(scene.positions), expected, rtol=1e-5, atol=1e-6)
