"""Meshes that stand in a scene many times: a tree over the instances, above the trees of the meshes.

All trees share one set of arrays. A ray that reaches an instance goes on in the space of its object, with its direction
transformed but not normalised, so that t stays what it is in the world, and comes back when it has seen that object.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import bad_input, check_same_shape
from jaxrender.pathtrace import traversal as one_level
from jaxrender.pathtrace.bvh import Bvh, filled, refit_boxes, refit_bvh
from jaxrender.pathtrace.bvh_build import EMPTY, build_tree
from jaxrender.pathtrace.hits import Hits
from jaxrender.pathtrace.traversal import Nodes, Rays, Search, checked_limit, finished_hits
from jaxrender.pathtrace.wavefront import Plan, State, in_blocks, plan_for_backend, run_wavefront
from jaxrender.vecmath import einsum


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class InstancedScene:
    """Objects, and where each stands how often.

    Attributes:
      objects: the trees of all objects as one record, one after the other; its node 0 is no root of them all.
      roots: the node of `objects` at which each instance's tree starts.
      first_face: the number of faces of `objects` before those of each instance's object.
      world_from_object: the affine transform of each instance: world = M[:, :3] · p + M[:, 3].
      boxes, children: the tree over the instances, as in `Bvh`; a leaf is one instance.
      depth: at least the nodes on the longest way down through both trees.
      top_depth: the same through the tree over the instances.
    """

    objects: Bvh
    roots: Int[Array, " i"]
    first_face: Int[Array, " i"]
    world_from_object: Float[Array, "i 3 4"]
    boxes: Float[Array, "m 6 8"]
    children: Int[Array, "m 8"]
    depth: int = field(metadata={"static": True})
    top_depth: int = field(metadata={"static": True})


def build_instances(
    objects: Sequence[Bvh],
    object_index: Int[np.ndarray | Array, " i"],
    world_from_object: Float[np.ndarray | Array, "i 3 4"],
) -> InstancedScene:
    """A scene of i instances, on the host.

    Args:
      object_index: which of the objects each instance is.
      world_from_object: affine; may scale, shear and mirror.
    Raises:
      InputError: if there is no object of that index, or a transform is not finite or flattens space.
      ValueError: for other shapes.
    """
    index, given = np.asarray(object_index, np.int32), np.asarray(world_from_object, np.float32)
    _check_instances(len(objects), index, given)
    merged, first_node, faces_before = _merged(objects)
    transforms = jnp.asarray(given)
    roots, first_face = jnp.asarray(first_node[index]), jnp.asarray(faces_before[index])
    lower, upper = (np.asarray(x) for x in _boxes_now(merged, roots, transforms))
    kept = np.flatnonzero((lower <= upper).all(axis=-1))
    tree = build_tree(lower[kept], upper[kept], leaf_size=1)
    leaf_of = np.append(kept, 0)[tree.leaves[:, 0]]
    is_leaf = (tree.children < 0) & (tree.children != EMPTY)
    children = filled(np.where(is_leaf, ~leaf_of[np.where(is_leaf, ~tree.children, 0)], tree.children), EMPTY)
    depth = -(-tree.depth // 4) * 4
    codes = jnp.asarray(children, jnp.int32)
    boxes = _top_boxes_now(codes, jnp.asarray(lower), jnp.asarray(upper), depth)
    return InstancedScene(merged, roots, first_face, transforms, boxes, codes, depth + merged.depth, depth)


def move_instances(
    scene: InstancedScene, world_from_object: Float[Array, "i 3 4"], *, vertices: Float[Array, "v 3"] | None = None
) -> InstancedScene:
    """The same trees around instances that moved, and around new vertices of all objects; pure, for use inside `jit`.

    Args:
      vertices: of all objects, one after the other; those of before if not given.
    Raises:
      ValueError: if the number of instances or of vertices is another one.
    """
    check_same_shape("world_from_object and that of the scene", world_from_object, scene.world_from_object)
    transforms = world_from_object.astype(jnp.float32)
    objects = scene.objects if vertices is None else refit_bvh(scene.objects, vertices)
    low, high = _instance_boxes(objects, scene.roots, jax.lax.stop_gradient(transforms))
    boxes = _top_boxes(scene.children, low, high, scene.top_depth)
    return replace(scene, objects=objects, world_from_object=transforms, boxes=boxes)


def closest_hit_of_instances(
    scene: InstancedScene,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    *,
    max_distance: Float[Array, " n"] | None = None,
) -> Hits:
    """`traversal.closest_hit` over all instances; `triangle` counts the faces of the instance's own object.

    t and the barycentrics are differentiable in the transforms too. There are no gaps between the faces of an
    instance; between instances that touch, rounding of the transforms may leave some.
    """
    limit = checked_limit(origins, directions, max_distance)
    found, instance = _find(scene, origins, directions, limit, stop_at_first=False)
    return _hits_on_faces(scene, found, instance, origins, directions)


def any_hit_of_instances(
    scene: InstancedScene,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    *,
    max_distance: Float[Array, " n"] | None = None,
) -> Bool[Array, " n"]:
    """`traversal.any_hit` over all instances."""
    limit = checked_limit(origins, directions, max_distance)
    return _find(scene, origins, directions, limit, stop_at_first=True)[0] >= 0


class _TwoLevels(NamedTuple):
    """A ray's search, and what it left behind when it went into an instance (-1 where it is in the tree above)."""

    rays: Rays
    search: Search
    world: Rays
    instance: Int[Array, " k"]
    group: Int[Array, " k"]
    leaves: Int[Array, " k"]
    floor: Int[Array, " k"]
    found_instance: Int[Array, " k"]


def _find(scene, origins, directions, limit, *, stop_at_first: bool) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    if not scene.roots.shape[0]:
        none = jnp.full(limit.shape, -1, jnp.int32)
        return none, none
    # Without the mesh, on whose size the program would otherwise depend.
    objects = replace(scene.objects, vertices=scene.objects.vertices[:0], faces=scene.objects.faces[:0])
    scene, origins, directions = jax.lax.stop_gradient((replace(scene, objects=objects), origins, directions))
    rays = origins.astype(jnp.float32), directions.astype(jnp.float32), limit
    return _search(scene, *rays, stop_at_first=stop_at_first, plan=plan_for_backend())


@functools.partial(jax.jit, static_argnames=("stop_at_first", "plan"))
def _search(scene: InstancedScene, origins, directions, limit, *, stop_at_first: bool, plan: Plan):
    nodes, top_root = _all_nodes(scene)
    object_from_world = _inverted(scene.world_from_object.astype(jnp.float32))

    def trace(o, d, limit):
        rays, limit = one_level.prepared_rays(o, d, limit)
        search = one_level.started_search(nodes, rays, jnp.full_like(rays.octant, top_root), limit)
        none, zero = jnp.full_like(rays.octant, -1), jnp.zeros_like(rays.octant)
        each = _TwoLevels(rays, search, rays, none, zero, zero, zero, none)
        state = State(each, jnp.zeros((scene.depth, len(limit)), jnp.int32))
        return run_wavefront(step, _is_active, lambda s: (s.each.search.found, s.each.found_instance), state, plan)

    def step(state: State) -> State:
        each, root = _entered(nodes, scene.roots, object_from_world, _left(state.each))
        search = one_level.tested_leaf(nodes, each.rays, each.search)
        nearer = search.t < each.search.t
        each = each._replace(found_instance=jnp.where(nearer, each.instance, each.found_instance))
        if stop_at_first:
            done = search.found >= 0
            search, root = one_level.stopped(search, done), jnp.where(done, -1, root)
            each = each._replace(group=jnp.where(done, 0, each.group), leaves=jnp.where(done, 0, each.leaves))
        search, stack = one_level.visited_node(nodes, each.rays, search, state.stack, floor=each.floor, root=root)
        return State(each._replace(search=search), stack)

    return in_blocks(trace, (origins, directions, limit), plan)


@jax.jit
def _hits_on_faces(scene: InstancedScene, found, instance, origins, directions) -> Hits:
    objects, place = scene.objects, jnp.maximum(instance, 0)
    face = jnp.where(found >= 0, objects.leaf_faces.reshape(-1)[jnp.maximum(found, 0)], -1)
    if not objects.faces.shape[0] or not scene.roots.shape[0]:
        corners = jnp.zeros((*face.shape, 3, 3), origins.dtype)
        return finished_hits(face, corners, origins, directions, instance=instance)
    corners = objects.vertices[objects.faces[jnp.maximum(face, 0)]].astype(origins.dtype)
    transform = scene.world_from_object[place].astype(origins.dtype)
    corners = einsum("nij,ncj->nci", transform[..., :3], corners) + transform[:, None, :, 3]
    triangle = jnp.where(found >= 0, face - scene.first_face[place], -1)
    return finished_hits(triangle, corners, origins, directions, instance=instance)


def _is_active(state: State) -> Bool[Array, " k"]:
    each = state.each
    return one_level.is_active(each.search) | ((each.group | each.leaves) != 0)


def _left(each: _TwoLevels) -> _TwoLevels:
    """Back into the tree above for rays that have seen all of their instance."""
    s = each.search
    done = (each.instance >= 0) & ((s.group | s.leaves) == 0) & (s.height == each.floor)

    def back(here, there):
        return jnp.where(done.reshape(-1, *[1] * (here.ndim - 1)), there, here)

    return each._replace(
        rays=jax.tree.map(back, each.rays, each.world),
        search=s._replace(group=back(s.group, each.group), leaves=back(s.leaves, each.leaves)),
        instance=jnp.where(done, -1, each.instance),
        group=jnp.where(done, 0, each.group),
        leaves=jnp.where(done, 0, each.leaves),
        floor=jnp.where(done, 0, each.floor),
    )


def _entered(nodes, roots, object_from_world, each: _TwoLevels) -> tuple[_TwoLevels, Int[Array, " k"]]:
    """Into the next instance for rays in the tree above that have one; also the root to visit there, or -1."""
    s = each.search
    enters = (each.instance < 0) & (s.leaves != 0)
    instance = jnp.where(enters, ~one_level.next_child(nodes, s.leaves, each.rays.octant), 0)
    transform = object_from_world[instance]
    inside = one_level.prepared_rays(
        einsum("kij,kj->ki", transform[..., :3], each.world.origin) + transform[..., 3],
        einsum("kij,kj->ki", transform[..., :3], each.world.direction),
        s.t,
    )[0]

    def pick(there, here):
        return jnp.where(enters.reshape(-1, *[1] * (here.ndim - 1)), there, here)

    entered = each._replace(
        rays=jax.tree.map(pick, inside, each.rays),
        search=s._replace(group=jnp.where(enters, 0, s.group), leaves=jnp.where(enters, 0, s.leaves)),
        instance=pick(instance, each.instance),
        group=pick(s.group, each.group),
        leaves=pick(one_level.without_next(s.leaves), each.leaves),
        floor=pick(s.height, each.floor),
    )
    return entered, jnp.where(enters, roots[instance], -1)


def _all_nodes(scene: InstancedScene) -> tuple[Nodes, int]:
    """The nodes of the objects, then those of the tree above, and its root."""
    objects, first = scene.objects, scene.objects.children.shape[0]
    codes = jnp.where(scene.children >= 0, scene.children + first, scene.children)
    children = jnp.concatenate([objects.children, codes]).reshape(-1)
    return Nodes(jnp.concatenate([objects.boxes, scene.boxes]), children, objects.leaf_triangles), first


def _inverted(transforms: Float[Array, "i 3 4"]) -> Float[Array, "i 3 4"]:
    """Object from world, by the adjugate."""
    rows = [transforms[:, k, :3] for k in range(3)]
    adjugate = jnp.stack([jnp.cross(rows[(k + 1) % 3], rows[(k + 2) % 3]) for k in range(3)], axis=-1)
    determinant = jnp.sum(rows[0] * adjugate[..., 0], axis=-1)
    inverse = adjugate / jnp.where(determinant == 0, 1.0, determinant)[:, None, None]
    return jnp.concatenate([inverse, -einsum("kij,kj->ki", inverse, transforms[..., 3])[..., None]], axis=-1)


def _instance_boxes(objects: Bvh, roots: Array, transforms: Array) -> tuple[Float[Array, "i 3"], Float[Array, "i 3"]]:
    """Boxes in the world around the transformed boxes of each root's children, widened by rounding."""
    low, high = jnp.split(jnp.swapaxes(objects.boxes[roots], 1, 2), 2, axis=-1)
    some = (low <= high).all(axis=-1, keepdims=True)
    low, high = jnp.where(some, low, 0.0), jnp.where(some, high, 0.0)
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    linear, shift = transforms[..., :3], transforms[:, None, :, 3]
    centre_there = einsum("kij,kcj->kci", linear, centre) + shift
    reach = einsum("kij,kcj->kci", jnp.abs(linear), half)
    sizes = einsum("kij,kcj->kci", jnp.abs(linear), jnp.abs(centre) + half) + jnp.abs(shift)
    reach += 8.0 * jnp.finfo(jnp.float32).eps * sizes
    lower = jnp.min(jnp.where(some, centre_there - reach, jnp.inf), axis=1)
    return lower, jnp.max(jnp.where(some, centre_there + reach, -jnp.inf), axis=1)


def _top_boxes(children: Array, lower: Array, upper: Array, depth: int) -> Float[Array, "m 6 8"]:
    # One more, which no leaf names: there may be no instance.
    lower, upper = (jnp.pad(x, ((0, 1), (0, 0))) for x in (lower, upper))
    return refit_boxes(children, lower, upper, depth=depth)


_boxes_now = jax.jit(_instance_boxes)
_top_boxes_now = jax.jit(_top_boxes, static_argnums=3)


def _merged(objects: Sequence[Bvh]) -> tuple[Bvh, np.ndarray, np.ndarray]:
    """All objects as one record, the root of each, and the number of faces before each."""
    counts = [(len(x.vertices), len(x.faces), len(x.children), len(x.leaf_faces)) for x in objects]
    before = np.concatenate([np.zeros((1, 4), np.int32), np.cumsum(np.array(counts, np.int32).reshape(-1, 4), axis=0)])
    parts = []
    for x, (vertex, face, node, leaf) in zip(objects, before.tolist(), strict=False):
        codes = jnp.where(x.children >= 0, x.children + node, jnp.where(x.children == EMPTY, EMPTY, x.children - leaf))
        leaf_faces = jnp.where(x.leaf_faces >= 0, x.leaf_faces + face, -1)
        parts.append(
            replace(
                x, faces=x.faces + vertex, children=codes, leaf_faces=leaf_faces, leaf_corners=x.leaf_corners + vertex
            )
        )
    names = ("vertices", "faces", "boxes", "children", "leaf_faces", "leaf_corners", "leaf_triangles")
    arrays = {name: jnp.concatenate([getattr(x, name) for x in parts]) for name in names}
    cost = jnp.sum(jnp.stack([x.built_cost for x in objects]))
    merged = Bvh(**arrays, built_cost=cost, depth=max(x.depth for x in objects))
    return merged, before[:-1, 2].copy(), before[:-1, 1].copy()


def _check_instances(num_objects: int, index: np.ndarray, transforms: np.ndarray) -> None:
    if not num_objects:
        raise ValueError("objects: expected at least one, got 0")
    if transforms.shape != (len(index), 3, 4):
        raise ValueError(f"world_from_object: expected shape ({len(index)}, 3, 4), got {transforms.shape}")
    outside = (index < 0) | (index >= num_objects)
    if outside.any():
        first = int(np.argmax(outside))
        expected = f"indices from 0 to {num_objects - 1}"
        bad_input(f"instance {first}", "object_index", expected=expected, got=int(index[first]))
    finite = np.isfinite(transforms).all(axis=(1, 2))
    flat = np.linalg.det(np.where(finite[:, None, None], transforms, 1.0)[..., :3].astype(np.float64)) == 0
    for bad, got in ((~finite, "NaN or Inf"), (flat, "a transform that flattens space")):
        if bad.any():
            place = f"instance {int(np.argmax(bad))}"
            bad_input(place, "world_from_object", expected="an invertible transform", got=got)
