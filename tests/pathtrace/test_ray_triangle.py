"""The pointwise test of a ray and a triangle."""

import itertools

import jax
import numpy as np
import pytest

from jaxrender.pathtrace.ray_triangle import hit_distance, ray_plane_axes
from tests.pathtrace.test_hit_parameters import rays_at_triangles


def distances(corners, origins, directions):
    return hit_distance(corners, origins, directions, ray_plane_axes(directions))


def test_axes_are_orthogonal_to_the_direction(rng, x64):
    directions = np.concatenate([rng.normal(size=(50, 3)), np.eye(3), -np.eye(3), [[1, 1, 1], [0, -2, 2]]])
    axes = np.asarray(ray_plane_axes(directions))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", axes, directions), 0, atol=1e-14)
    # A shear of unit axes: as far apart as these are.
    assert (np.linalg.norm(np.cross(axes[:, 0], axes[:, 1]), axis=-1) >= 1).all()
    np.testing.assert_array_equal(ray_plane_axes(np.zeros(3)), [[0, 1, 0], [0, 0, 1]])


def test_hits_inside_and_misses_outside(rng, x64):
    corners, origins, directions, _ = rays_at_triangles(rng, 300)
    np.testing.assert_allclose(distances(corners, origins, directions), 1, rtol=1e-9)
    # Past an edge by a hundredth of the triangle.
    for outside in ([-0.01, 0.5, 0.51], [0.5, -0.01, 0.51], [0.5, 0.51, -0.01]):
        past = np.einsum("k,nkj->nj", outside, corners) - origins
        assert (np.asarray(distances(corners, origins, past)) == np.inf).all()


def test_the_order_of_corners_does_not_matter_inside(rng, x64):
    corners, origins, directions, _ = rays_at_triangles(rng, 50)
    for order in itertools.permutations(range(3)):
        np.testing.assert_allclose(distances(corners[:, order], origins, directions), 1, rtol=1e-9)


def test_behind_is_negative():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    origin, up = np.array([0.2, 0.2, 3], np.float32), np.array([0, 0, 2], np.float32)
    assert distances(corners, origin, up) == -1.5


@pytest.mark.parametrize(
    "corners",
    [[[0] * 3] * 3, [[0] * 3, [1, 1, 0], [2, 2, 0]], [[0] * 3, [0, 0, 1], [0, 0, 2]], [[0] * 3, [1, 0, 0], [0, 0, 1]]],
)  # fmt: skip
def test_without_area_and_edge_on_are_not_met(corners):
    corners = np.array(corners, np.float32)
    origin, down = np.array([0, 0, 5], np.float32), np.array([0, 0, -1], np.float32)
    assert distances(corners, origin, down) == np.inf


def test_of_two_neighbours_at_least_one_is_met(rng):
    """Float32 rays at points of a shared edge; the two triangles lie on either side of it."""
    n = 20_000
    a, b = rng.uniform(-1, 1, (2, n, 3))
    share = rng.uniform(0, 1, (n, 1))
    target = share * a + (1 - share) * b
    side = rng.normal(size=(n, 3))
    origins = rng.uniform(-9, 9, (n, 3)).astype(np.float32)
    along = b - a
    left, right = target + side, target - side + 0.1 * rng.normal(size=(n, 3))
    # Only pairs that look like a sheet from the origin: the ends on either side of the edge.
    across = np.cross(target - origins, along)
    sheet = np.sum(across * (left - target), -1) * np.sum(across * (right - target), -1) < -0.01
    # The order that both share: a, b, then the third.
    ends = [np.stack([a, b, c], axis=1).astype(np.float32) for c in (left, right)]
    directions = (target - origins).astype(np.float32)
    met = [np.isfinite(jax.jit(distances)(x, origins, directions)) for x in ends]
    assert sheet.sum() > 10_000
    assert (met[0] | met[1])[sheet].all()
    assert 0.3 < met[0][sheet].mean() < 0.7  # so an edge does decide
