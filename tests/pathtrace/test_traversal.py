"""The traversal against a loop over triangles, against Embree, and on the hard rays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxrender.pathtrace import traversal
from jaxrender.pathtrace.bvh import build_bvh, refit_bvh
from jaxrender.pathtrace.embree import EmbreeScene
from jaxrender.pathtrace.rays import trace_rays
from jaxrender.pathtrace.traversal import any_hit, closest_hit
from jaxrender.pathtrace.wavefront import Plan
from tests.support import oracles
from tests.support.rays import brute_force, rays_at_edges, sphere, triangle_soup

EPS = float(np.finfo(np.float32).eps)


@pytest.fixture
def soup(rng):
    return triangle_soup(rng, 250)


def test_closest_hit_is_that_of_a_loop_over_triangles(soup):
    vertices, faces, origins, directions = soup
    hits = trace_rays(build_bvh(vertices, faces), origins, directions)
    face, t, uv = brute_force(vertices, faces, origins, directions)
    hit = face >= 0
    assert 50 < hit.sum() < 225  # both answers are asked for
    np.testing.assert_array_equal(hits.triangle, face)
    # Rounding of float32 coordinates of size 4, over the cosine between ray and face, which is 0.01 at worst here.
    np.testing.assert_allclose(hits.t, t, atol=4 * EPS / 0.01)
    np.testing.assert_allclose(hits.barycentrics, uv, atol=4 * EPS / 0.01)


def test_any_hit_is_whether_there_is_a_closest_one(soup):
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    limit = np.random.default_rng(1).uniform(-1, 4, len(origins)).astype(np.float32)
    for max_distance in (None, limit):
        found = trace_rays(bvh, origins, directions, query="any", max_distance=max_distance)
        closest = trace_rays(bvh, origins, directions, max_distance=max_distance)
        np.testing.assert_array_equal(found, np.asarray(closest.triangle) >= 0)


def test_hits_from_max_distance_on_do_not_count(soup):
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    _, t, _ = brute_force(vertices, faces, origins, directions)
    limit = (t * np.random.default_rng(1).uniform(0.5, 1.5, len(t))).astype(np.float32)
    hit = np.asarray(trace_rays(bvh, origins, directions, max_distance=limit).triangle) >= 0
    assert 25 < hit.sum() < np.isfinite(t).sum() - 25
    np.testing.assert_array_equal(hit, t < limit)


def _is_of_even_face(leaf_faces, place, barycentrics):
    inside = (barycentrics >= -1e-3).all(axis=-1) & (barycentrics.sum(axis=-1) <= 1.001)
    return (place >= 0) & inside & (leaf_faces[jnp.maximum(place, 0)] % 2 == 0)


def test_hits_that_are_not_accepted_are_passed(soup):
    """As if the other half of the faces were not there."""
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    accept = jax.tree_util.Partial(_is_of_even_face, bvh.leaf_faces.reshape(-1))
    face, t, _ = brute_force(vertices, faces[::2], origins, directions)
    o, d = jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32)
    hits = closest_hit(bvh, o, d, accept=accept)
    assert 25 < (face >= 0).sum() < 225
    np.testing.assert_array_equal(hits.triangle, np.where(face >= 0, 2 * face, -1))
    np.testing.assert_allclose(hits.t, t, atol=4 * EPS / 0.01)
    np.testing.assert_array_equal(any_hit(bvh, o, d, accept=accept), face >= 0)


def test_max_distance_is_open():
    """At t = 2 exactly, and the values that mean nothing."""
    bvh = build_bvh(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    limit = np.array([np.inf, np.nextafter(np.float32(2), 3), 2, 0, -1, np.nan], np.float32)
    origins, directions = np.full((6, 3), [0, 0, 2], np.float32), np.full((6, 3), [0, 0, -1], np.float32)
    expected = [True, True, False, False, False, False]
    with jax.debug_nans(False):
        found = trace_rays(bvh, origins, directions, query="any", max_distance=limit)
        hits = trace_rays(bvh, origins, directions, max_distance=limit)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(hits.t, np.where(expected, 2, np.inf))
    np.testing.assert_array_equal(hits.triangle, np.where(expected, 0, -1))


def test_both_sides_count_and_hits_behind_do_not():
    bvh = build_bvh(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    origins = np.array([[0, 0, 2], [0, 0, -2], [5, 0, 2], [0, 0, 1], [0, 0, 0]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, 3]], np.float32)
    np.testing.assert_array_equal(trace_rays(bvh, origins, directions).triangle, [0, 0, -1, -1, 0])


def test_directions_of_any_length(soup):
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    unit, long = (trace_rays(bvh, origins, directions * np.float32(k)) for k in (1, 256))
    np.testing.assert_array_equal(unit.triangle, long.triangle)
    np.testing.assert_allclose(unit.t, 256 * np.asarray(long.t), rtol=8 * EPS)


def test_rays_that_are_no_rays_miss(soup):
    vertices, faces, origins, directions = soup
    origins, directions = origins[:6].copy(), directions[:6].copy()
    origins[0, 1], origins[1, 0], directions[2, 2], directions[3, 0] = np.nan, np.inf, np.nan, -np.inf
    directions[4] = 0
    with jax.debug_nans(False):
        hits = trace_rays(build_bvh(vertices, faces), origins, directions)
    assert (np.asarray(hits.triangle)[:5] == -1).all() and (np.asarray(hits.t)[:5] == np.inf).all()


def test_rays_along_the_axes_and_in_the_planes_of_boxes():
    """A grid of squares: directions with zeros, origins on the boxes' sides."""
    box = trimesh.creation.box().subdivide().subdivide()
    bvh = build_bvh(np.asarray(box.vertices), np.asarray(box.faces))
    steps = np.linspace(-0.5, 0.5, 9)[1:-1]  # not on the silhouette
    x, y = (g.reshape(-1) for g in np.meshgrid(steps, steps))
    for axis in range(3):
        for sign in (1.0, -1.0):
            origins = np.roll(np.stack([x, y, np.full_like(x, -2.0 * sign)], axis=-1), axis, axis=-1)
            directions = np.broadcast_to(np.roll([0, 0, sign], axis), origins.shape)
            hits = trace_rays(bvh, origins.astype(np.float32), directions.astype(np.float32))
            np.testing.assert_array_equal(hits.t, 1.5)


@pytest.mark.parametrize("shift", [0.0, 1000.0])
def test_no_ray_slips_through_a_closed_mesh(rng, shift):
    """50,000 rays from inside at edges and corners, near the world's origin and a thousand radii from it."""
    vertices, faces = sphere(3)
    vertices = vertices + np.float32(shift)
    inside = np.array([0.13, -0.21, 0.07]) + shift
    hits = trace_rays(build_bvh(vertices, faces), *rays_at_edges(rng, vertices, faces, inside, 50_000))
    assert (np.asarray(hits.triangle) < 0).sum() == 0
    # Directions have the rounding of coordinates of size `shift`; faces are met at 60 degrees or steeper from here.
    np.testing.assert_allclose(hits.t, 1.0, atol=16 * EPS * (1 + shift))


def test_no_ray_slips_through_a_seam(rng):
    """Each triangle has vertices of its own: what neighbours share is positions only."""
    vertices, faces = sphere(3)
    torn = vertices[faces[:, [1, 2, 0]]].reshape(-1, 3)
    bvh = build_bvh(torn, np.arange(len(torn)).reshape(-1, 3))
    hits = trace_rays(bvh, *rays_at_edges(rng, vertices, faces, [0.13, -0.21, 0.07], 50_000))
    assert (np.asarray(hits.triangle) < 0).sum() == 0


@pytest.mark.parametrize("any_", [False, True])
def test_blocks_and_buckets_change_nothing(soup, monkeypatch, any_):
    """One bucket for all, against blocks of 100 in buckets of 100 and 20."""
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    answers = []
    for plan in (Plan(500, 2, 500), Plan(100, 5, 20)):
        monkeypatch.setattr(traversal, "plan_for_backend", lambda plan=plan: plan)
        ask = any_hit if any_ else closest_hit
        answers.append(jax.jit(lambda *x, ask=ask: ask(*x))(bvh, origins, directions))
    jax.tree.map(np.testing.assert_array_equal, *answers)


def test_no_rays_are_no_hits(soup):
    vertices, faces, _, _ = soup
    bvh = build_bvh(vertices, faces)
    none = np.zeros((0, 3), np.float32)
    assert trace_rays(bvh, none, none).barycentrics.shape == (0, 2)
    assert jax.jit(closest_hit)(bvh, none, none).triangle.shape == (0,)
    assert trace_rays(bvh, none, none, query="any").shape == (0,)


def test_float64_rays_get_float64_hits(soup, x64):
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    origins, directions = origins.astype(np.float64), directions.astype(np.float64)
    hits = trace_rays(bvh, origins, directions)
    face, t, uv = brute_force(vertices, faces, origins, directions)
    np.testing.assert_array_equal(hits.triangle, face)
    np.testing.assert_allclose(hits.t, t, rtol=1e-12)
    np.testing.assert_allclose(hits.barycentrics, uv, atol=1e-12)


def test_vmap_is_a_loop(soup):
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    o, d = origins[:40].reshape(4, 10, 3), directions[:40].reshape(4, 10, 3)
    batched = jax.jit(jax.vmap(closest_hit, in_axes=(None, 0, 0)))(bvh, o, d)
    flat = trace_rays(bvh, origins[:40], directions[:40])
    np.testing.assert_array_equal(batched.triangle.reshape(-1), flat.triangle)
    assert (np.asarray(flat.triangle) >= 0).sum() > 5
    # Several poses of one mesh.
    poses = jnp.stack([vertices, vertices + np.float32(0.3)])
    found = jax.jit(jax.vmap(lambda v: any_hit(refit_bvh(bvh, v), o[0], d[0])))(poses)
    for pose, answer in zip(poses, found, strict=True):
        np.testing.assert_array_equal(answer, trace_rays(build_bvh(pose, faces), o[0], d[0], query="any"))


def test_gradients_are_those_of_differences(soup, x64):
    """Of t and (u, v) of all hits in a random direction of the space of vertices, origins and directions."""
    vertices, faces, origins, directions = soup
    rng = np.random.default_rng(9)
    bvh = build_bvh(vertices, faces)
    rays = [x.astype(np.float64) for x in (origins, directions)]
    weights = rng.normal(size=(250, 3))

    def loss(tree, o, d):
        hits = trace_rays(tree, o, d)
        values = jnp.concatenate([hits.t[:, None], hits.barycentrics], axis=-1)
        return jnp.sum(jnp.where((hits.triangle >= 0)[:, None], weights * values, 0.0))

    slopes = jax.grad(loss, argnums=(1, 2))(bvh, *rays)
    steps = [rng.normal(size=x.shape) for x in rays]
    h = 1e-7
    up, down = (loss(bvh, *(x + s * h * dx for x, dx in zip(rays, steps, strict=True))) for s in (1, -1))
    expected = float(up - down) / (2 * h)
    got = sum(float(jnp.sum(g * dx)) for g, dx in zip(slopes, steps, strict=True))
    assert abs(expected) > 1
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_gradients_reach_the_vertices_through_a_refit():
    """A square at height z above rays that look up: dt/dz = 1 for each that hits, and nothing for those that miss."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    bvh = build_bvh(square, np.array([[0, 1, 2], [0, 2, 3]]))
    origins = np.array([[0.1, 0.3, -2], [-0.5, -0.2, -2], [3, 0, -2]], np.float32)
    up = np.full((3, 3), [0, 0, 1], np.float32)

    def total(vertices):
        hits = trace_rays(refit_bvh(bvh, vertices), origins, up)
        return jnp.sum(jnp.where(hits.triangle >= 0, hits.t, 0.0))

    value, slope = jax.value_and_grad(total)(jnp.asarray(square))
    assert value == 4
    np.testing.assert_allclose(jnp.sum(slope, axis=0), [0, 0, 2], atol=1e-6)


def test_shapes_are_checked(soup):
    vertices, faces, origins, directions = soup
    bvh = build_bvh(vertices, faces)
    with pytest.raises(ValueError, match="origins: expected shape"):
        closest_hit(bvh, origins[None], directions[None])
    with pytest.raises(ValueError, match="origins and directions"):
        any_hit(bvh, origins, directions[:3])
    with pytest.raises(ValueError, match="max_distance and origins"):
        closest_hit(bvh, origins, directions, max_distance=jnp.ones(3))


def test_memory_is_bounded_whatever_the_number_of_rays(soup, monkeypatch):
    """What a program needs beside its inputs and outputs does not grow with the rays, once they fill blocks."""
    vertices, faces, _, _ = soup
    bvh, block = build_bvh(vertices, faces), 4096
    monkeypatch.setattr(traversal, "plan_for_backend", lambda: Plan(block, 4, block))

    def needed(blocks):
        rays = jax.ShapeDtypeStruct((blocks * block, 3), jnp.float32)
        return jax.jit(any_hit).lower(bvh, rays, rays).compile().memory_analysis().temp_size_in_bytes

    few, many = needed(2), needed(8)
    assert (many - few) / (6 * block) < 64  # copies of origins and directions
    assert few < 1000 * block


@pytest.mark.data
@pytest.mark.parametrize("name", ["bunny.ply", "dragon_100k.ply"])
def test_embree_finds_the_same_on_a_scan(rng, shared_data, name):
    mesh = trimesh.load(shared_data / "meshes" / name, process=False)
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origins = rng.uniform(low, high, (1024, 3)).astype(np.float32)
    directions = oracles.unit(rng.normal(size=origins.shape)).astype(np.float32)
    ours, theirs = (
        trace_rays(scene, origins, directions) for scene in (build_bvh(vertices, faces), EmbreeScene(vertices, faces))
    )
    same = np.asarray(ours.triangle) == theirs.triangle
    hit = theirs.triangle >= 0
    assert hit.sum() > 100 and (~hit).sum() > 100
    # Rays within rounding of an edge.
    assert (~same).sum() <= 4
    size = np.linalg.norm(high - low)
    np.testing.assert_allclose(np.asarray(ours.t)[same & hit], theirs.t[same & hit], atol=100 * EPS * size)
