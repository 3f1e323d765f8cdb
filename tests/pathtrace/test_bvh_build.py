"""The tree's shape: every primitive in one leaf, boxes that contain, and a depth that hostile input cannot blow up."""

import numpy as np
import pytest

from jaxrender.pathtrace.bvh_build import EMPTY, build_tree


def boxes(rng, count, size=0.1):
    lower = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    return lower, lower + rng.uniform(0, size, (count, 3)).astype(np.float32)


def walk(tree, node=0, depth=1):
    """(leaf, depth) of all leaves below a node, by recursion."""
    for code in tree.children[node]:
        if code >= 0:
            assert code > node  # parents come first
            yield from walk(tree, code, depth + 1)
        elif code != EMPTY:
            yield ~code, depth


@pytest.mark.parametrize("leaf_size", [1, 2, 4])
@pytest.mark.parametrize("count", [1, 2, 3, 8, 17, 1000])
def test_each_primitive_is_in_one_leaf(rng, count, leaf_size):
    tree = build_tree(*boxes(rng, count), leaf_size=leaf_size)
    leaves, depths = zip(*walk(tree), strict=True)
    assert sorted(leaves) == list(range(len(tree.leaves)))
    items = tree.leaves[tree.leaves >= 0]
    np.testing.assert_array_equal(np.sort(items), np.arange(count))
    assert (tree.leaves[:, 0] >= 0).all() and tree.leaves.shape[1] == leaf_size
    assert max(depths) == tree.depth


def test_no_primitives_are_a_root_without_children():
    none = np.zeros((0, 3), np.float32)
    tree = build_tree(none, none, leaf_size=2)
    assert tree.depth == 1 and (tree.children == EMPTY).all() and (tree.leaves == -1).all()


@pytest.mark.parametrize("count", [3, 500])
def test_primitives_on_one_spot_are_halved(count):
    spot = np.full((count, 3), 0.3, np.float32)
    tree = build_tree(spot, spot, leaf_size=2)
    np.testing.assert_array_equal(np.sort(tree.leaves[tree.leaves >= 0]), np.arange(count))
    assert tree.depth <= 9  # halved eight times


def test_sizes_that_grow_by_powers_do_not_make_a_chain():
    """Split by bins alone, each level would take off a few of the largest."""
    lower = (2.0 ** np.linspace(-100, 60, 4000, dtype=np.float32))[:, None] * np.ones(3, np.float32)
    tree = build_tree(lower, lower * 1.001, leaf_size=2)
    np.testing.assert_array_equal(np.sort(tree.leaves[tree.leaves >= 0]), np.arange(4000))
    assert tree.depth <= 2 * 12 + 8 + 12


def test_splits_follow_the_surface_area():
    """Two heaps far apart, of 24 boxes each: no child of the root reaches into both."""
    rng = np.random.default_rng(3)
    lower = rng.uniform(0, 1, (48, 3)) + np.repeat([[0, 0, 0], [50, 0, 0]], 24, axis=0)
    tree = build_tree(lower.astype(np.float32), lower.astype(np.float32) + 0.1, leaf_size=2)
    for code in tree.children[0]:
        if code != EMPTY:
            inside = [~code] if code < 0 else [leaf for leaf, _ in walk(tree, code)]
            items = tree.leaves[inside]
            assert len(set((items[items >= 0] < 24).tolist())) == 1


def test_children_stand_in_their_octant():
    """Eight boxes at the corners of a cube: bit k of the slot is the upper side in axis k."""
    corner = np.array([[slot >> axis & 1 for axis in range(3)] for slot in range(8)], np.float32)
    shuffled = np.random.default_rng(5).permutation(8)
    tree = build_tree(corner[shuffled] * 4, corner[shuffled] * 4 + 1, leaf_size=1)
    np.testing.assert_array_equal(shuffled[tree.leaves[~tree.children[0], 0]], np.arange(8))
