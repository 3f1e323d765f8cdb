"""The ray backend against a plain loop over triangles, and on the hard rays: edges, corners, closed surfaces."""

import numpy as np
import pytest
import trimesh

from jaxrender.pathtrace import embree
from jaxrender.pathtrace.embree import EmbreeScene
from tests.support import oracles
from tests.support.rays import brute_force, triangle_soup


@pytest.fixture
def soup(rng):
    return triangle_soup(rng)


def test_closest_hit_is_that_of_a_loop_over_triangles(soup):
    vertices, faces, origins, directions = soup
    hits = EmbreeScene(vertices, faces).closest_hit(origins, directions)
    face, t, uv = brute_force(vertices, faces, origins, directions)
    hit = face >= 0
    assert 100 < hit.sum() < 450  # both answers are asked for
    np.testing.assert_array_equal(hits.triangle, face)
    # Rounding of float32 coordinates of size 4, over the cosine between ray and face, which is 0.01 at worst here.
    eps = 4 * np.finfo(np.float32).eps
    np.testing.assert_allclose(hits.t[hit], t[hit], atol=eps / 0.01)
    np.testing.assert_allclose(hits.barycentrics[hit], uv[hit], atol=eps / 0.01)


def test_barycentrics_and_distance_give_the_same_point(soup):
    vertices, faces, origins, directions = soup
    hits = EmbreeScene(vertices, faces).closest_hit(origins, directions)
    hit = hits.triangle >= 0
    a, b, c = np.moveaxis(vertices[faces[hits.triangle[hit]]], 1, 0)
    u, v = hits.barycentrics[hit].T[..., None]
    on_face = (1 - u - v) * a + u * b + v * c
    along_ray = origins[hit] + hits.t[hit][:, None] * directions[hit]
    np.testing.assert_allclose(on_face, along_ray, atol=4 * np.finfo(np.float32).eps / 0.01)


def test_any_hit_agrees_with_closest_hit(soup):
    vertices, faces, origins, directions = soup
    scene = EmbreeScene(vertices, faces)
    np.testing.assert_array_equal(
        scene.any_hit(origins, directions), scene.closest_hit(origins, directions).triangle >= 0
    )


def test_pieces_on_several_threads_give_the_same_as_one(soup, monkeypatch):
    vertices, faces, origins, directions = soup
    scene = EmbreeScene(vertices, faces)
    whole, any_whole = scene.closest_hit(origins, directions), scene.any_hit(origins, directions)
    monkeypatch.setattr(embree, "RAYS_PER_TASK", 37)
    cut = scene.closest_hit(origins, directions)
    for name in ("triangle", "t", "barycentrics"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name))
    np.testing.assert_array_equal(scene.any_hit(origins, directions), any_whole)


def test_no_rays_are_no_hits(soup):
    vertices, faces, _, _ = soup
    none = np.zeros((0, 3), np.float32)
    scene = EmbreeScene(vertices, faces)
    assert scene.closest_hit(none, none).triangle.shape == (0,)
    assert scene.any_hit(none, none).shape == (0,)


def test_rays_at_edges_and_corners_do_not_slip_through(rng):
    """A closed surface seen from inside, at 20,000 points of its edges and at all its corners."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices, edges = np.asarray(sphere.vertices), np.asarray(sphere.edges_unique)
    chosen, share = edges[rng.integers(0, len(edges), 20_000)], rng.uniform(0, 1, (20_000, 1))
    targets = np.concatenate([vertices, share * vertices[chosen[:, 0]] + (1 - share) * vertices[chosen[:, 1]]])
    inside = np.broadcast_to([0.13, -0.21, 0.07], targets.shape)
    origins, directions = (np.ascontiguousarray(x, np.float32) for x in (inside, oracles.unit(targets - inside)))
    hits = EmbreeScene(vertices, np.asarray(sphere.faces)).closest_hit(origins, directions)
    assert (hits.triangle < 0).sum() == 0
    distance = np.linalg.norm(targets - inside, axis=-1)
    # The directions are rounded to float32, faces are met at 60 degrees or steeper from here.
    np.testing.assert_allclose(hits.t, distance, rtol=32 * np.finfo(np.float32).eps)


def test_both_sides_of_a_face_are_hit():
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    scene = EmbreeScene(vertices, np.array([[0, 1, 2]], np.int32))
    origins = np.array([[0, 0, 2], [0, 0, -2], [5, 0, 2]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, 1], [0, 0, -1]], np.float32)
    np.testing.assert_array_equal(scene.any_hit(origins, directions), [True, True, False])
    np.testing.assert_array_equal(scene.closest_hit(origins, directions).triangle, [0, 0, -1])


def test_a_hit_behind_the_origin_does_not_count():
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    scene = EmbreeScene(vertices, np.array([[0, 1, 2]], np.int32))
    away = np.array([[0, 0, 1]], np.float32)
    assert not scene.any_hit(away, away).any()


def test_hits_from_max_distance_on_do_not_count():
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    scene = EmbreeScene(vertices, np.array([[0, 1, 2]], np.int32))
    limit = np.array([np.inf, 3, np.nextafter(np.float32(2), 3), 2, 1, 0, -1, np.nan], np.float32)
    origins, directions = np.full((8, 3), [0, 0, 2], np.float32), np.full((8, 3), [0, 0, -1], np.float32)
    expected = [True] * 3 + [False] * 5
    np.testing.assert_array_equal(scene.any_hit(origins, directions, max_distance=limit), expected)
    hits = scene.closest_hit(origins, directions, max_distance=limit)
    np.testing.assert_array_equal(hits.triangle, np.where(expected, 0, -1))
    np.testing.assert_array_equal(hits.t, np.where(expected, 2, np.inf))
    np.testing.assert_array_equal(hits.barycentrics[3:], 0)


def test_arrays_that_embree_would_read_past_are_refused(soup):
    vertices, faces, origins, directions = soup
    scene = EmbreeScene(vertices, faces)
    with pytest.raises(ValueError, match="origins and directions: expected one shape"):
        scene.any_hit(origins, directions[:5])
    with pytest.raises(ValueError, match="max_distance and origins"):
        scene.closest_hit(origins, directions, max_distance=np.ones(3))
