"""Instances against the same scene as one mesh, made by transforming every vertex."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.checks import InputError
from jaxrender.pathtrace.bvh import build_bvh
from jaxrender.pathtrace.instances import build_instances, closest_hit_of_instances, move_instances
from jaxrender.pathtrace.rays import trace_rays
from tests.support import oracles
from tests.support.rays import brute_force, sphere, triangle_soup

EPS = float(np.finfo(np.float32).eps)


def transforms(rng, count, spread=6.0):
    """Turned, mirrored by chance, scaled by 0.3 to 1 along each axis, and moved."""
    turn, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    linear = turn * rng.uniform(0.3, 1, (count, 1, 3))
    return np.concatenate([linear, rng.uniform(-spread, spread, (count, 3, 1))], axis=-1).astype(np.float32)


def flattened(meshes, index, world_from_object):
    """One mesh for all, and (instance, triangle of the object) of each of its faces."""
    vertices, faces, names, start = [], [], [], 0
    for instance, (kind, m) in enumerate(zip(index, world_from_object.astype(np.float64), strict=True)):
        points, triangles = meshes[kind]
        vertices.append(points @ m[:, :3].T + m[:, 3])
        faces.append(triangles + start)
        start += len(points)
        names += [(instance, face) for face in range(len(triangles))]
    return np.concatenate(vertices), np.concatenate(faces), np.array(names)


@pytest.fixture
def scene(rng):
    """30 instances of a soup and of a ball, the parts they are made of, and 250 rays between them."""
    meshes = [triangle_soup(rng)[:2], sphere(0)]
    index, placed = rng.integers(0, 2, 30), transforms(rng, 30)
    instanced = build_instances([build_bvh(*mesh) for mesh in meshes], index, placed)
    origins = rng.uniform(-7, 7, (250, 3)).astype(np.float32)
    directions = oracles.unit(rng.uniform(-6, 6, (250, 3)) - origins).astype(np.float32)
    return instanced, (meshes, index, placed), origins, directions


def check_same(hits, flat, origins, directions):
    vertices, faces, names = flat
    face, t, uv = brute_force(vertices, faces, origins, directions)
    hit = face >= 0
    assert 50 < hit.sum() < 200
    np.testing.assert_array_equal(hits.instance, np.where(hit, names[face, 0], -1))
    np.testing.assert_array_equal(hits.triangle, np.where(hit, names[face, 1], -1))
    # Coordinates of size 10 over the cosine between ray and face, 0.01 at worst; triangles of size 0.2.
    np.testing.assert_allclose(hits.t, t, atol=10 * EPS / 0.01)
    np.testing.assert_allclose(hits.barycentrics, uv, atol=10 * EPS / 0.01 / 0.2)


def test_instances_are_met_like_one_mesh(scene):
    instanced, parts, origins, directions = scene
    check_same(trace_rays(instanced, origins, directions), flattened(*parts), origins, directions)


def test_any_hit_and_max_distance(scene):
    instanced, _, origins, directions = scene
    t = np.asarray(trace_rays(instanced, origins, directions).t)
    limit = (np.where(np.isfinite(t), t, 1.0) * np.random.default_rng(2).uniform(0.5, 1.5, len(t))).astype(np.float32)
    for max_distance in (None, limit):
        found = trace_rays(instanced, origins, directions, query="any", max_distance=max_distance)
        closest = trace_rays(instanced, origins, directions, max_distance=max_distance)
        np.testing.assert_array_equal(found, np.asarray(closest.triangle) >= 0)
        np.testing.assert_array_equal(found, t < (np.inf if max_distance is None else limit))


def test_instances_that_move_and_change_shape(scene, rng):
    instanced, (meshes, index, _), origins, directions = scene
    placed = transforms(rng, 30)
    meshes = [(points * np.float32(1.2), faces) for points, faces in meshes]
    vertices = np.concatenate([points for points, _ in meshes])
    moved = jax.jit(lambda s, m, v: move_instances(s, m, vertices=v))(instanced, placed, vertices)
    check_same(trace_rays(moved, origins, directions), flattened(meshes, index, placed), origins, directions)


def test_the_box_of_an_instance_contains_it(scene):
    """All vertices, in float64, within the box of its leaf in the tree above."""
    instanced, parts, _, _ = scene
    vertices, faces, names = flattened(*parts)
    codes, boxes = np.asarray(instanced.children), np.asarray(instanced.boxes)
    for node, slot in np.argwhere((codes < 0) & (codes > np.iinfo(np.int32).min)):
        inside = vertices[faces[names[:, 0] == ~codes[node, slot]]].reshape(-1, 3)
        assert (inside >= boxes[node, :3, slot]).all() and (inside <= boxes[node, 3:, slot]).all()


def test_one_instance_many_and_none(rng):
    ball = build_bvh(*sphere(1))
    identity = np.eye(3, 4, dtype=np.float32)[None]
    origins, directions = np.full((5, 3), [0, 0, 3], np.float32), np.full((5, 3), [0.01, 0.02, -1], np.float32)
    alone = trace_rays(ball, origins, directions)
    one = trace_rays(build_instances([ball], np.zeros(1, int), identity), origins, directions)
    np.testing.assert_array_equal(one.triangle, alone.triangle)
    np.testing.assert_array_equal(one.t, alone.t)
    # Three on one spot: one of them is met.
    many = build_instances([ball], np.zeros(3, int), np.repeat(identity, 3, axis=0))
    np.testing.assert_array_equal(trace_rays(many, origins, directions).t, alone.t)
    none = build_instances([ball], np.zeros(0, int), identity[:0])
    np.testing.assert_array_equal(trace_rays(none, origins, directions).triangle, -1)
    assert not np.asarray(trace_rays(none, origins, directions, query="any")).any()
    empty = build_bvh(np.zeros((0, 3)), np.zeros((0, 3), int))
    mixed = build_instances([empty, ball], np.array([0, 1, 0]), np.repeat(identity, 3, axis=0))
    np.testing.assert_array_equal(trace_rays(mixed, origins, directions).instance, 1)


def test_gradients_in_the_transform(scene, x64):
    """Of all t in the transforms, against differences."""
    instanced, _, origins, directions = scene
    origins, directions = origins.astype(np.float64), directions.astype(np.float64)

    def loss(m):
        hits = closest_hit_of_instances(replace(instanced, world_from_object=m), origins, directions)
        return jnp.sum(jnp.where(hits.triangle >= 0, hits.t, 0.0))

    placed = instanced.world_from_object.astype(np.float64)
    step = np.random.default_rng(3).normal(size=placed.shape)
    h = 1e-7
    value, slope = jax.jit(loss), jax.jit(jax.grad(loss))
    expected = (value(placed + h * step) - value(placed - h * step)) / (2 * h)
    assert abs(float(expected)) > 1
    np.testing.assert_allclose(jnp.sum(slope(placed) * step), expected, rtol=1e-5)


def test_bad_instances_are_named():
    ball = build_bvh(*sphere(0))
    good = np.repeat(np.eye(3, 4, dtype=np.float32)[None], 3, axis=0)
    flat, spoiled = good.copy(), good.copy()
    flat[1, 2, 2], spoiled[2, 0, 3] = 0, np.nan
    index = np.zeros(3, int)
    with pytest.raises(InputError, match=r"instance 1: world_from_object: .* flattens space"):
        build_instances([ball], index, flat)
    with pytest.raises(InputError, match=r"instance 2: world_from_object: .* NaN or Inf"):
        build_instances([ball], index, spoiled)
    with pytest.raises(InputError, match=r"instance 0: object_index: expected indices from 0 to 0, got 1"):
        build_instances([ball], index + 1, good)
    with pytest.raises(ValueError, match=r"world_from_object: expected shape \(3, 3, 4\)"):
        build_instances([ball], index, good[:2])
    with pytest.raises(ValueError, match="objects: expected at least one"):
        build_instances([], index, good)
    with pytest.raises(ValueError, match="world_from_object and that of the scene"):
        move_instances(build_instances([ball], index, good), good[:2])
