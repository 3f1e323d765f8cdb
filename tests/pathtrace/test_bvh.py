"""The tree as a record: hostile meshes, boxes after a refit, and when a tree is built anew."""

import jax
import numpy as np
import pytest

from jaxrender.checks import InputError
from jaxrender.pathtrace.bvh import build_bvh, bvh_cost, filled, refit_bvh, update_bvh
from jaxrender.pathtrace.bvh_build import EMPTY
from jaxrender.pathtrace.rays import trace_rays
from tests.support.rays import sphere, triangle_soup


def box_of(bvh, corners, node, slot):
    """Lower and upper corner of what a slot contains, by recursion down to the triangles."""
    code = int(bvh.children[node, slot])
    if code >= 0:
        below = [box_of(bvh, corners, code, s) for s in range(8) if int(bvh.children[code, s]) != EMPTY]
        return np.min([low for low, _ in below], axis=0), np.max([high for _, high in below], axis=0)
    faces = np.asarray(bvh.leaf_faces[~code])
    inside = corners[faces[faces >= 0]].reshape(-1, 3)
    return inside.min(axis=0), inside.max(axis=0)


def check_boxes(bvh, vertices, faces):
    bvh = jax.tree.map(np.asarray, bvh)
    corners = vertices[faces]
    for node in range(len(bvh.children)):
        for slot in range(8):
            got = bvh.boxes[node, :3, slot], bvh.boxes[node, 3:, slot]
            if bvh.children[node, slot] == EMPTY:
                assert (got[0] == np.inf).all() and (got[1] == -np.inf).all()
            else:
                np.testing.assert_array_equal(got, box_of(bvh, corners, node, slot))


def test_boxes_are_the_bounds_of_what_they_contain(rng):
    vertices, faces, _, _ = triangle_soup(rng)
    check_boxes(build_bvh(vertices, faces), vertices, faces)


def test_a_refit_gives_the_bounds_of_the_moved_mesh(rng):
    vertices, faces, _, _ = triangle_soup(rng)
    moved = (vertices + rng.uniform(-0.3, 0.3, vertices.shape)).astype(np.float32)
    check_boxes(jax.jit(refit_bvh)(build_bvh(vertices, faces), moved), moved, faces)


def test_a_refit_to_the_same_vertices_changes_no_bit(rng):
    vertices, faces = sphere(2)
    bvh = build_bvh(vertices, faces)
    back = jax.jit(refit_bvh)(jax.jit(refit_bvh)(bvh, vertices * np.float32(1.7)), vertices)
    jax.tree.map(np.testing.assert_array_equal, back, bvh)


def test_a_refitted_tree_finds_what_a_new_one_finds(rng):
    vertices, faces, origins, directions = triangle_soup(rng, 256)
    moved = (vertices + rng.uniform(-0.3, 0.3, vertices.shape)).astype(np.float32)
    refitted, built = update_bvh(build_bvh(vertices, faces), moved, rebuild_above=np.inf), build_bvh(moved, faces)
    hits = [trace_rays(x, origins, directions) for x in (refitted, built)]
    assert 40 < (np.asarray(hits[0].triangle) >= 0).sum() < 230
    jax.tree.map(np.testing.assert_array_equal, *hits)


def test_cost_is_the_sum_over_boxes(rng):
    """Against a loop in float64."""
    vertices, faces, _, _ = triangle_soup(rng)
    bvh = build_bvh(vertices, faces)

    def area(low, high):
        x, y, z = np.float64(high) - np.float64(low)
        return x * y + y * z + z * x

    root = area(vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1)))
    expected = 1.0
    for node, children in enumerate(np.asarray(bvh.children)):
        for slot, code in enumerate(children):
            if code != EMPTY:
                weight = 1 if code >= 0 else (np.asarray(bvh.leaf_faces[~code]) >= 0).sum()
                expected += area(*np.split(np.asarray(bvh.boxes[node, :, slot]), 2)) / root * weight
    np.testing.assert_allclose(bvh_cost(bvh), expected, rtol=1e-5)  # a sum over 60 boxes in float32
    np.testing.assert_allclose(bvh.built_cost, expected, rtol=1e-5)


def test_update_refits_small_changes_and_rebuilds_after_large_ones(rng):
    vertices, faces, _, _ = triangle_soup(rng)
    bvh = build_bvh(vertices, faces)
    near = update_bvh(bvh, vertices * np.float32(1.1))
    np.testing.assert_array_equal(near.leaf_faces, bvh.leaf_faces)
    # Every triangle somewhere else: the tree's heaps are torn apart.
    apart = rng.permutation(vertices.reshape(-1, 3, 3)).reshape(-1, 3)
    far = update_bvh(bvh, apart)
    jax.tree.map(np.testing.assert_array_equal, far, build_bvh(apart, faces))
    assert far.built_cost < bvh_cost(refit_bvh(bvh, apart)) / 2
    kept = update_bvh(bvh, apart, rebuild_above=1e9)
    np.testing.assert_array_equal(kept.children, bvh.children)


def test_faces_that_get_an_area_are_taken_in():
    flat = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 5, 0], [1, 5, 0], [0, 6, 0]], np.float32)
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    bvh = build_bvh(flat, faces)
    open_ = flat.copy()
    open_[2] = [0, 1, 0]
    origin, down = np.array([[0.2, 0.2, 1]], np.float32), np.array([[0, 0, -1]], np.float32)
    assert int(trace_rays(bvh, origin, down).triangle[0]) == -1
    assert int(trace_rays(update_bvh(bvh, open_, rebuild_above=np.inf), origin, down).triangle[0]) == 0


@pytest.mark.parametrize("count", [0, 3])
def test_a_mesh_without_faces_is_missed(count):
    bvh = build_bvh(np.zeros((count, 3), np.float32), np.zeros((0, 3), np.int32))
    ray = np.ones((2, 3), np.float32)
    np.testing.assert_array_equal(trace_rays(bvh, ray, ray).triangle, [-1, -1])
    np.testing.assert_array_equal(trace_rays(bvh, ray, ray, query="any"), [False, False])
    assert bvh_cost(bvh) == 1
    assert update_bvh(bvh, np.ones((count, 3), np.float32)).faces.shape == (0, 3)


def test_faces_without_area_are_left_out(rng):
    vertices, faces, origins, directions = triangle_soup(rng, 256)
    on_a_line = np.stack([vertices[0], 0.5 * (vertices[0] + vertices[1]), vertices[1]])
    more = np.concatenate([vertices, on_a_line, vertices[:1]])
    degenerate = np.array([[7, 7, 7], [7, 7, 9], [0, 183, 5], [180, 181, 182]], np.int32)
    bvh = build_bvh(more, np.concatenate([degenerate[:2], faces, degenerate[2:]]))
    present = np.unique(bvh.leaf_faces)
    assert not np.isin([0, 1, 62], present).any() and np.isin(np.arange(2, 62), present).all()
    alone, among = (trace_rays(x, origins, directions) for x in (build_bvh(vertices, faces), bvh))
    np.testing.assert_array_equal(among.triangle, np.where(alone.triangle >= 0, alone.triangle + 2, -1))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_corner_that_is_not_finite_is_named(rng, value):
    vertices, faces, _, _ = triangle_soup(rng)
    bvh = build_bvh(vertices, faces)
    spoiled = vertices.copy()
    spoiled[25, 1] = value
    for build in (lambda: build_bvh(spoiled, faces), lambda: update_bvh(bvh, spoiled)):
        with pytest.raises(InputError, match=r"mesh: vertices: expected finite corners.* first triangle 8"):
            build()
    # A vertex that no face uses may be anything.
    with jax.debug_nans(False):
        built = build_bvh(np.append(vertices, [[value] * 3], axis=0), faces)
    np.testing.assert_array_equal(built.boxes, bvh.boxes)


def test_faces_past_the_vertices_are_refused(rng):
    vertices, faces, _, _ = triangle_soup(rng)
    for bad in (-1, 180):
        faces[3, 1] = bad
        with pytest.raises(InputError, match="expected indices from 0 to 179"):
            build_bvh(vertices, faces)
    with pytest.raises(ValueError, match="faces: expected shape"):
        build_bvh(vertices, faces[:, :2])


def test_another_number_of_vertices_is_refused(rng):
    vertices, faces, _, _ = triangle_soup(rng)
    bvh = build_bvh(vertices, faces)
    for change in (refit_bvh, update_bvh):
        with pytest.raises(ValueError, match="vertices and those of the tree"):
            change(bvh, vertices[:-1])


def test_trees_come_in_few_sizes():
    sizes = {len(filled(np.zeros((n, 2)), 1)) for n in range(1, 4097)}
    assert len(sizes) <= 1 + 6 * 8
    for n in (1, 8, 9, 33, 1000, 4096):
        rows = filled(np.zeros((n, 2)), 1)
        assert n <= len(rows) <= max(64, 1.125 * n) and (rows[:n] == 0).all() and (rows[n:] == 1).all()
