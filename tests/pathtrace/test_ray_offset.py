"""Origins off the surface: far enough for rounding, not further, at any distance from the world's origin."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace.bvh import build_bvh
from jaxrender.pathtrace.ray_offset import offset_origin
from jaxrender.pathtrace.rays import trace_rays
from tests.support import oracles
from tests.support.rays import sphere

SCALES = (1e-3, 1e-1, 1.0, 1e2, 1e4)


def left_surface(rng, scale):
    """Points on a ball of size 1 at `scale` from the world's origin, their normals, and directions off the ball."""
    vertices, faces = sphere(2)
    vertices = (vertices * min(scale, 1) + scale * np.array([0.6, -1.0, 0.8])).astype(np.float32)
    chosen = rng.integers(0, len(faces), 256)
    corners = vertices[faces[chosen]].astype(np.float64)
    weights = rng.dirichlet(np.ones(3), 256)
    points = np.einsum("nk,nkj->nj", weights, corners).astype(np.float32)
    normals = oracles.unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).astype(np.float32)
    away = oracles.unit(rng.normal(size=normals.shape))
    away *= np.sign(np.sum(away * normals, axis=-1, keepdims=True))
    steep = np.abs(np.sum(away * normals, axis=-1)) > 0.02
    return (vertices, faces), points[steep], normals[steep], away[steep].astype(np.float32)


@pytest.mark.parametrize("scale", SCALES)
def test_a_ray_does_not_meet_the_face_it_left(rng, scale):
    mesh, points, normals, away = left_surface(rng, scale)
    bvh = build_bvh(*mesh)
    bare = np.asarray(trace_rays(bvh, points, away, query="any"))
    off = np.asarray(trace_rays(bvh, offset_origin(points, normals, away), away, query="any"))
    assert bare.mean() > 0.1  # there is something to avoid
    assert not off.any()
    # And inwards, normals turned: all meet the far side, and none the face they left.
    inside = offset_origin(points, normals, -away)
    hits = trace_rays(bvh, inside, -away)
    assert (np.asarray(hits.triangle) >= 0).all()
    assert (np.linalg.norm(inside + np.asarray(hits.t)[:, None] * -away - points, axis=-1) > 1e-3 * min(scale, 1)).all()


@pytest.mark.parametrize("scale", SCALES)
def test_the_offset_follows_the_rounding_of_the_position(rng, scale):
    points = (scale * rng.uniform(-1, 1, (1000, 3))).astype(np.float32)
    normals, directions = (oracles.unit(rng.normal(size=(1000, 3))).astype(np.float32) for _ in range(2))
    moved = np.asarray(offset_origin(points, normals, directions)) - points
    side = np.sign(np.sum(normals * directions, axis=-1, keepdims=True))
    assert (moved * normals * side >= 0).all()
    large = np.abs(points) > 0.04
    # Units of rounding double at powers of two, which a step may cross.
    assert (np.abs(moved)[large] <= 2 * 256 * np.spacing(np.abs(points))[large]).all()
    assert (np.abs(moved)[np.abs(points) < 1 / 32] <= 1.01 / 65536).all()


def test_known_steps():
    """At 1 the spacing is 2^-23, so 256 of it are 2^-15; at -2 it is twice that; at 0 the step is 2^-16."""
    position = np.array([[1, -2, 0]] * 3, np.float32)
    got = offset_origin(position, np.eye(3, dtype=np.float32), np.ones((3, 3), np.float32))
    np.testing.assert_array_equal(got - position, np.diag([2.0**-15, 2.0**-15, 2.0**-16]).astype(np.float32))


def test_the_gradient_is_the_identity(rng, dtype):
    position, normal, direction = rng.normal(size=(3, 3)).astype(dtype)
    slope = jax.jacobian(offset_origin)(jnp.asarray(position), normal, direction)
    np.testing.assert_array_equal(slope, np.eye(3))
