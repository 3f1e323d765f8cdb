"""The shape of an 8-wide bounding volume hierarchy, from the boxes of its primitives: host code, NumPy, level by level.

A binary tree is split by the surface area heuristic in bins, then collapsed so that a node has up to eight children.

References:
  Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies", RT 2007 (bins).
  Ylitie, Karras, Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", HPG 2017, sec. 3
  (collapse; children in the slot of their octant, so that a ray visits them about from near to far).
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

WIDTH = 8
#: The child code of a slot without a child. Codes >= 0 are nodes, the other negative ones are ~leaf.
EMPTY = np.iinfo(np.int32).min
#: A node's index shares an int32 with the eight bits of its children.
MAX_NODES = 1 << 23
#: The direction of each slot from the middle of its node: bit 0 is the upper side in x, bit 1 in y, bit 2 in z.
_SLOT_SIGNS = np.array([[1.0 if slot >> axis & 1 else -1.0 for axis in range(3)] for slot in range(WIDTH)])


@dataclass(frozen=True)
class Tree:
    """Who contains whom. Node 0 is the root, and a node comes after its parent.

    Attributes:
      children: codes of the slots: a node >= 0, ~leaf < 0, or EMPTY.
      leaves: the primitives of each leaf, filled up with -1.
      depth: nodes on the longest way down.
    """

    children: Int[np.ndarray, "m 8"]
    leaves: Int[np.ndarray, "l s"]
    depth: int


@dataclass(frozen=True)
class _Binary:
    """A binary tree: node i has the children left[i] and left[i] + 1, or is a leaf (left[i] < 0) of order[first...]."""

    left: np.ndarray
    first: np.ndarray
    count: np.ndarray
    order: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def build_tree(lower: Float[np.ndarray, "p 3"], upper: Float[np.ndarray, "p 3"], *, leaf_size: int) -> Tree:
    """A tree over p boxes, with leaves of 1 to `leaf_size` of them; p may be 0.

    Raises:
      ValueError: if the tree would have more than 2²³ nodes (about 30 million triangles).
    """
    if not len(lower):
        return Tree(np.full((1, WIDTH), EMPTY, np.int32), np.full((1, leaf_size), -1, np.int32), 1)
    # Areas of large coordinates overflow in float32.
    binary = _split(lower.astype(np.float64), upper.astype(np.float64), leaf_size)
    is_leaf = binary.left < 0
    leaf_of = np.cumsum(is_leaf) - 1
    entries = binary.first[is_leaf, None] + np.arange(leaf_size)
    inside = np.arange(leaf_size) < binary.count[is_leaf, None]
    leaves = np.where(inside, binary.order[np.minimum(entries, len(lower) - 1)], -1).astype(np.int32)
    children, depth = _collapse(binary, leaf_of)
    if len(children) > MAX_NODES:
        raise ValueError(f"geometry: expected a tree of at most {MAX_NODES} nodes, got {len(children)}")
    return Tree(children, leaves, depth)


def _split(lower: np.ndarray, upper: np.ndarray, leaf_size: int) -> _Binary:
    """Splits level by level until no node has more than `leaf_size` primitives."""
    order = np.arange(len(lower))
    # Past this depth nodes are halved: distances that grow by powers could otherwise give one level per primitive.
    max_levels = 2 * math.ceil(math.log2(len(lower) + 1)) + 8
    first, count = np.zeros(1, np.int64), np.array([len(lower)])
    levels = [(first, count, lower.min(axis=0, keepdims=True), upper.max(axis=0, keepdims=True))]
    lefts, num_nodes = [], 1
    while True:
        inner = count > leaf_size
        left = np.full(len(count), -1)
        left[inner] = num_nodes + 2 * np.arange(inner.sum())
        lefts.append(left)
        if not inner.any():
            break
        first, count = _split_level(order, first[inner], count[inner], lower, upper, len(levels) > max_levels)
        levels.append((first, count, *_boxes(order, first, count, lower, upper)))
        num_nodes += len(count)
    first, count, low, high = (np.concatenate(x) for x in zip(*levels, strict=True))
    return _Binary(np.concatenate(lefts), first, count, order, low, high)


def _places(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The indices first[i]..first[i] + count[i] - 1 of all i, one after the other."""
    starts = np.cumsum(count) - count
    return np.arange(count.sum()) + np.repeat(first - starts, count)


def _boxes(order, first, count, lower, upper) -> tuple[np.ndarray, np.ndarray]:
    items, starts = order[_places(first, count)], np.cumsum(count) - count
    return np.minimum.reduceat(lower[items], starts), np.maximum.reduceat(upper[items], starts)


def _split_level(order, first, count, lower, upper, halve: bool) -> tuple[np.ndarray, np.ndarray]:
    """Splits all nodes of a level, reordering `order` in place; gives first and count of the children, in pairs."""
    places = _places(first, count)
    node = np.repeat(np.arange(len(first)), count)
    items = order[places]
    low, high = lower[items], upper[items]
    right = (places - first[node]) >= count[node] // 2
    if not halve:
        # Many bins where they tell something; in small nodes they cost more than they find.
        for bins, chosen in ((16, count > 12), (8, count <= 12)):
            if chosen.any():
                inside = chosen[node]
                renumbered = (np.cumsum(chosen) - 1)[node[inside]]
                right[inside] = _sides(low[inside], high[inside], renumbered, count[chosen], bins, right[inside])
    order[places] = items[np.argsort(2 * node + right, kind="stable")]
    num_right = np.bincount(node, weights=right, minlength=len(first)).astype(np.int64)
    num_left = count - num_right
    pairs = np.stack([first, first + num_left], axis=-1), np.stack([num_left, num_right], axis=-1)
    return pairs[0].reshape(-1), pairs[1].reshape(-1)


def _sides(low, high, node, count, bins: int, halves: Bool[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
    """Whether each primitive goes to the right child; `halves` where all centres of a node coincide."""
    centre = 0.5 * low + 0.5 * high
    starts = np.cumsum(count) - count
    begin = np.minimum.reduceat(centre, starts)
    extent = np.maximum.reduceat(centre, starts) - begin
    scale = np.divide(bins, extent, out=np.zeros_like(extent), where=extent > 0)
    index = np.minimum(((centre - begin[node]) * scale[node]).astype(np.int32), bins - 1)
    costs = np.stack([_axis_costs(low, high, node, index[:, axis], len(count), bins) for axis in range(3)], axis=1)
    best = costs.reshape(len(count), -1).argmin(axis=-1)
    axis, last_left = best // (bins - 1), best % (bins - 1)
    right = index[np.arange(len(node)), axis[node]] > last_left[node]
    return np.where(np.isinf(costs.reshape(len(count), -1).min(axis=-1))[node], halves, right)


def _axis_costs(low, high, node, index, num_nodes: int, bins: int) -> np.ndarray:
    """The cost (nodes, bins - 1) of a split after each bin: area times count, left plus right; inf if one is empty."""
    key = node * bins + index
    number = np.bincount(key, minlength=num_nodes * bins).reshape(num_nodes, bins)
    sides = []
    for direction in (slice(None), slice(None, None, -1)):
        sizes = []
        for corner in range(3):
            lowest = _binned(np.minimum, low[:, corner], key, number, np.inf)[:, direction]
            highest = _binned(np.maximum, high[:, corner], key, number, -np.inf)[:, direction]
            lowest, highest = np.minimum.accumulate(lowest, axis=1), np.maximum.accumulate(highest, axis=1)
            sizes.append((highest - lowest)[:, :-1])
        n = np.cumsum(number[:, direction], axis=1)[:, :-1]
        x, y, z = (np.where(n > 0, size, 0.0) for size in sizes)
        sides.append(np.where(n > 0, n * (x * y + y * z + z * x), np.inf)[:, direction])
    return sides[0] + sides[1]


def _binned(function: np.ufunc, values, key, number, start: float) -> np.ndarray:
    out = np.full(number.size, start, values.dtype)  # another dtype would take `at` off its fast path
    function.at(out, key, values)
    return out.reshape(number.shape)


def _collapse(binary: _Binary, leaf_of: np.ndarray) -> tuple[Int[np.ndarray, "m 8"], int]:
    """Eight children for each node: the largest is replaced by its own two until there is no room."""
    size = binary.upper - binary.lower
    area = np.where(binary.left >= 0, size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0], -1.0)
    roots, levels, num_nodes = np.zeros(1, np.int64), [], 1
    while len(roots):
        slots = _open_children(binary.left, area, roots)
        slots = _sorted_by_octant(slots, roots, binary.lower, binary.upper)
        inner = (slots >= 0) & (binary.left[slots] >= 0)
        codes = np.where(slots >= 0, ~leaf_of[slots], EMPTY)
        codes[inner] = num_nodes + np.arange(inner.sum())
        levels.append(codes)
        roots = slots[inner]
        num_nodes += len(roots)
    return np.concatenate(levels).astype(np.int32), len(levels)


def _open_children(left, area, roots) -> np.ndarray:
    """The binary nodes (k, 8) that become the children of `roots`; -1 is none."""
    slots = np.full((len(roots), WIDTH), -1)
    slots[:, 0] = roots
    rows = np.arange(len(roots))
    for used in range(1, WIDTH):
        areas = np.where(slots >= 0, area[slots], -1.0)
        pick = areas.argmax(axis=-1)
        can = areas[rows, pick] >= 0
        opened = left[slots[rows, pick]]
        slots[rows[can], pick[can]] = opened[can]
        slots[rows[can], used] = opened[can] + 1
    return slots


def _sorted_by_octant(slots, roots, lower, upper) -> np.ndarray:
    """Puts each child into the free slot whose direction from the node's middle fits best, best fits first."""
    centre = lower + upper
    offset = centre[slots] - centre[roots][:, None]
    fit = np.where((slots >= 0)[..., None], np.einsum("kcx,sx->kcs", offset, _SLOT_SIGNS), -np.inf)
    result, rows = np.full_like(slots, -1), np.arange(len(slots))
    for _ in range(WIDTH):
        best = fit.reshape(len(slots), -1).argmax(axis=-1)
        child, slot = best // WIDTH, best % WIDTH
        some = np.isfinite(fit[rows, child, slot])
        result[rows[some], slot[some]] = slots[rows[some], child[some]]
        fit[rows[some], child[some], :] = -np.inf
        fit[rows[some], :, slot[some]] = -np.inf
    return result
