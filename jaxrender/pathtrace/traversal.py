"""Rays through a bounding volume hierarchy, as pure JAX.

A ray keeps the children that it still has to see: nodes in its current group (node << 8 | one bit per child) and in a
stack of such groups, and the leaves of one group. In each step it tests the triangles of one leaf and, when no leaf is
left, visits one node. Bits stand in the order of the ray's octant, about from near to far. All of it is float32.

References:
  Ylitie, Karras, Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", HPG 2017, sec. 4.
  Ize, "Robust BVH Ray Traversal", JCGT 2(2), 2013 (a slab test that loses no hit to rounding).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_last_axis, check_same_shape
from jaxrender.pathtrace.bvh import Bvh
from jaxrender.pathtrace.bvh_build import WIDTH
from jaxrender.pathtrace.hit_parameters import hit_parameters
from jaxrender.pathtrace.hits import Hits
from jaxrender.pathtrace.ray_triangle import hit_distance, ray_plane_axes
from jaxrender.pathtrace.wavefront import Plan, State, in_blocks, plan_for_backend, run_wavefront

#: Near and far value of a slab have a relative error of up to 1.8e-7 each.
_FAR_INFLATION = 1.0 + 4e-7
#: Components below this count as this, so that no slab is 0 · inf.
_SMALLEST_COMPONENT = 1e-18


#: Whether hits count: accept(place, barycentrics) of n hits, by 2 · leaf + place in the leaf (-1 is none), with the
#: corners in the order of the leaves; a `jax.tree_util.Partial` of a function and its arrays.
Accept = jax.tree_util.Partial


class Nodes(NamedTuple):
    """The arrays that a step reads: boxes (m, 6, 8), codes of the children (8 m), triangles of the leaves."""

    boxes: Float[Array, "m 6 8"]
    children: Int[Array, " m8"]
    triangles: Float[Array, "l 2 3 3"]


class Rays(NamedTuple):
    """Rays with what a step needs of them; bit i of `octant` is set where direction i is negative."""

    origin: Float[Array, "k 3"]
    direction: Float[Array, "k 3"]
    inverse: Float[Array, "k 3"]
    plane_axes: Float[Array, "k 2 3"]
    octant: Int[Array, " k"]


class Search(NamedTuple):
    """How far each ray has come. Groups are 0 where nothing is left; `found` is 2 · leaf + place in the leaf, or -1."""

    group: Int[Array, " k"]
    leaves: Int[Array, " k"]
    height: Int[Array, " k"]
    t: Float[Array, " k"]
    found: Int[Array, " k"]


def closest_hit(
    bvh: Bvh,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    *,
    max_distance: Float[Array, " n"] | None = None,
    accept: Accept | None = None,
) -> Hits:
    """The first face along each ray, from either side, with 0 <= t < max_distance.

    Rays go between two neighbouring faces nowhere. They are traced in float32, in blocks, with about 500 bytes for each
    ray of a block. Then t and the barycentrics are computed from the plane of the face found, in the origins' dtype;
    there, they are differentiable in the tree's vertices, the origins and the directions (see `hit_parameters`). The
    face has no gradient. A ray that is not finite, or has no direction, or a max_distance of NaN, misses.

    Args:
      max_distance: in units of the direction's length.
      accept: which hits count, such as those that are not in a hole; rays go on through the others. All by default.
    Raises:
      ValueError: for shapes other than those above.
    """
    limit = checked_limit(origins, directions, max_distance)
    found = _find(bvh, origins, directions, limit, accept, stop_at_first=False)
    return _hits_on_faces(found, bvh.leaf_faces, bvh.vertices, bvh.faces, origins, directions)


def any_hit(
    bvh: Bvh,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    *,
    max_distance: Float[Array, " n"] | None = None,
    accept: Accept | None = None,
) -> Bool[Array, " n"]:
    """Whether each ray meets a face with 0 <= t < max_distance: `closest_hit` that stops at the first it finds."""
    limit = checked_limit(origins, directions, max_distance)
    return _find(bvh, origins, directions, limit, accept, stop_at_first=True) >= 0


def checked_limit(origins: Array, directions: Array, max_distance: Array | None) -> Float[Array, " n"]:
    """max_distance in float32, or inf; after a check of the shapes."""
    for name, x in (("origins", origins), ("directions", directions)):
        check_last_axis(name, x, 3)
        if x.ndim != 2:
            raise ValueError(f"{name}: expected shape (n, 3), got {tuple(x.shape)}")
    check_same_shape("origins and directions", origins, directions)
    if max_distance is None:
        return jnp.full(origins.shape[:1], jnp.inf, jnp.float32)
    check_same_shape("max_distance and origins without the last axis", max_distance, origins[:, 0])
    return jax.lax.stop_gradient(max_distance).astype(jnp.float32)


@jax.jit
def _hits_on_faces(found, leaf_faces, vertices, faces, origins, directions) -> Hits:
    triangle = jnp.where(found >= 0, leaf_faces.reshape(-1)[jnp.maximum(found, 0)], -1)
    if not faces.shape[0]:
        return finished_hits(triangle, jnp.zeros((*triangle.shape, 3, 3), origins.dtype), origins, directions)
    corners = vertices[faces[jnp.maximum(triangle, 0)]].astype(origins.dtype)
    return finished_hits(triangle, corners, origins, directions)


def finished_hits(
    triangle: Int[Array, " n"],
    corners: Float[Array, "n 3 3"],
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    *,
    instance: Int[Array, " n"] | None = None,
) -> Hits:
    """Hits whose t and barycentrics are those in the planes of the corners; inf and 0 for misses."""
    hit = triangle >= 0
    # A triangle without area: planes that are not met could give any value, and NaN.
    corners = jnp.where(hit[:, None, None], corners, 0.0)
    t, barycentrics = hit_parameters(corners, origins, directions)
    # A plane through the origin may give a negative rounding error.
    t = jnp.where(hit, jnp.maximum(t, 0.0), jnp.inf)
    return Hits(triangle, t, jnp.where(hit[:, None], barycentrics, 0.0), instance)


def _find(
    bvh: Bvh, origins: Array, directions: Array, limit: Array, accept: Accept | None, *, stop_at_first: bool
) -> Int[Array, " n"]:
    nodes = Nodes(bvh.boxes, bvh.children.reshape(-1), bvh.leaf_triangles)
    nodes, origins, directions = jax.lax.stop_gradient((nodes, origins, directions))
    rays = origins.astype(jnp.float32), directions.astype(jnp.float32), limit
    return _search(nodes, *rays, accept, depth=bvh.depth, stop_at_first=stop_at_first, plan=plan_for_backend())


@functools.partial(jax.jit, static_argnames=("depth", "stop_at_first", "plan"))
def _search(nodes: Nodes, origins, directions, limit, accept, *, depth: int, stop_at_first: bool, plan: Plan):
    """The wavefront, apart from the rest: its program depends on the mesh through the size of the tree only."""

    def trace(o, d, limit):
        rays, limit = prepared_rays(o, d, limit)
        search = started_search(nodes, rays, jnp.zeros_like(rays.octant), limit)
        state = State((rays, search), jnp.zeros((depth, len(limit)), jnp.int32))
        return run_wavefront(step, lambda s: is_active(s.each[1]), lambda s: s.each[1].found, state, plan)

    def step(state: State) -> State:
        rays, search = state.each
        search = tested_leaf(nodes, rays, search, accept=accept)
        if stop_at_first:
            search = stopped(search, search.found >= 0)
        search, stack = visited_node(nodes, rays, search, state.stack)
        return State((rays, search), stack)

    return in_blocks(trace, (origins, directions, limit), plan)


def prepared_rays(origins: Array, directions: Array, limit: Array) -> tuple[Rays, Float[Array, " k"]]:
    """Rays ready for steps, and their limits; rays that can meet nothing get the limit 0."""
    good = jnp.all(jnp.isfinite(origins) & jnp.isfinite(directions), axis=-1) & jnp.any(directions != 0, axis=-1)
    good &= limit > 0
    o, d = jnp.where(good[:, None], origins, 0.0), jnp.where(good[:, None], directions, 1.0)
    smallest = jnp.where(d < 0, -_SMALLEST_COMPONENT, _SMALLEST_COMPONENT).astype(d.dtype)
    inverse = 1.0 / jnp.where(jnp.abs(d) < _SMALLEST_COMPONENT, smallest, d)
    octant = jnp.sum(jnp.where(d < 0, jnp.array([[1, 2, 4]], jnp.int32), 0), axis=-1, dtype=jnp.int32)
    return Rays(o, d, inverse, ray_plane_axes(d), octant), jnp.where(good, limit, 0.0)


def started_search(nodes: Nodes, rays: Rays, root: Int[Array, " k"], limit: Float[Array, " k"]) -> Search:
    """A search that has visited the root, or nothing to do where the limit is 0."""
    group, leaves = _met_children(nodes, rays, root, limit)
    search = Search(group, leaves, jnp.zeros_like(group), limit, jnp.full_like(group, -1))
    return stopped(search, limit <= 0)


def is_active(search: Search) -> Bool[Array, " k"]:
    """Whether a ray has anything left to see."""
    return (search.group | search.leaves | search.height) != 0


def stopped(search: Search, stop: Bool[Array, " k"]) -> Search:
    """The search with nothing left to see for some rays."""
    group, leaves, height = (jnp.where(stop, 0, x) for x in (search.group, search.leaves, search.height))
    return search._replace(group=group, leaves=leaves, height=height)


def tested_leaf(nodes: Nodes, rays: Rays, search: Search, *, accept: Accept | None = None) -> Search:
    """The search after the triangles of the next leaf, for rays that have one."""
    some = search.leaves != 0
    leaf = jnp.where(some, ~next_child(nodes, search.leaves, rays.octant), 0)
    corners, t, found = nodes.triangles[leaf], search.t, search.found
    for place in range(corners.shape[1]):
        distance = hit_distance(corners[:, place], rays.origin, rays.direction, rays.plane_axes)
        nearer = some & (distance >= 0) & (distance < t)
        if accept is not None:
            _, barycentrics = hit_parameters(corners[:, place], rays.origin, rays.direction)
            nearer &= accept(jnp.where(nearer, 2 * leaf + place, -1), barycentrics)
        t, found = jnp.where(nearer, distance, t), jnp.where(nearer, 2 * leaf + place, found)
    return search._replace(leaves=without_next(search.leaves), t=t, found=found)


def visited_node(
    nodes: Nodes,
    rays: Rays,
    search: Search,
    stack: Int[Array, "depth k"],
    *,
    floor: Int[Array, " k"] | None = None,
    root: Int[Array, " k"] | None = None,
) -> tuple[Search, Int[Array, "depth k"]]:
    """The search and the stack after the next node, for rays that have a node and no leaf.

    Args:
      floor: the height below which the stack is not touched; 0 if not given.
      root: a node to visit first, or -1, for rays that have no group.
    """
    levels = jnp.arange(stack.shape[0], dtype=jnp.int32)[:, None]
    pop = (search.leaves == 0) & (search.group == 0) & (search.height > (0 if floor is None else floor))
    if root is not None:
        pop &= root < 0
    height = search.height - pop.astype(jnp.int32)
    top = jnp.sum(jnp.where(levels == height[None], stack, 0), axis=0, dtype=jnp.int32)
    group = jnp.where(pop, top, search.group)
    goes = (search.leaves == 0) & (group != 0)
    node = jnp.where(goes, next_child(nodes, group, rays.octant), 0)
    rest = without_next(group)
    push = goes & (rest != 0)
    stack = jnp.where(push[None] & (levels == height[None]), rest[None], stack)
    if root is not None:
        node, goes = jnp.where(root >= 0, root, node), goes | (root >= 0)
    met, leaves = _met_children(nodes, rays, node, search.t)
    group, leaves = jnp.where(goes, met, group), jnp.where(goes, leaves, search.leaves)
    return search._replace(group=group, leaves=leaves, height=height + push.astype(jnp.int32)), stack


def next_child(nodes: Nodes, group: Int[Array, " k"], octant: Int[Array, " k"]) -> Int[Array, " k"]:
    """The code of the child at the lowest bit of each group; of any child where the group is 0."""
    bits = group & 255
    place = jax.lax.population_count((bits & -bits) - 1)
    return nodes.children[(group >> 8) * WIDTH + ((place ^ octant) & (WIDTH - 1))]


def without_next(group: Int[Array, " k"]) -> Int[Array, " k"]:
    """Each group without the child at its lowest bit; 0 if that was the last one."""
    rest = group & (group - 1)
    return jnp.where(rest & 255 != 0, rest, 0)


def _met_children(nodes: Nodes, rays: Rays, node: Array, t: Array) -> tuple[Array, Array]:
    """Those children whose boxes the rays meet before t: a group of nodes and one of leaves."""
    box, origin, inverse = nodes.boxes[node], rays.origin[..., None], rays.inverse[..., None]
    low, high = (box[:, :3] - origin) * inverse, (box[:, 3:] - origin) * inverse
    # By the sign, not by minimum and maximum: so the far side of an empty box comes before its near side.
    near = jnp.max(jnp.where(inverse > 0, low, high), axis=1)
    far = jnp.min(jnp.where(inverse > 0, high, low), axis=1) * _FAR_INFLATION
    met = jnp.maximum(near, 0.0) <= jnp.minimum(far, t[:, None])
    slots = jnp.arange(WIDTH, dtype=jnp.int32)[None]
    bits = jnp.where(met, 1 << (slots ^ rays.octant[:, None]), 0)
    is_leaf = nodes.children.reshape(-1, WIDTH)[node] < 0
    masks: list[Any] = [jnp.sum(jnp.where(kind, bits, 0), axis=-1, dtype=jnp.int32) for kind in (~is_leaf, is_leaf)]
    group, leaves = (jnp.where(mask != 0, node << 8 | mask, 0) for mask in masks)
    return group, leaves
