"""Rays of a scene on any device: the trees of `bvh`, one of solid triangles and one of those that may have holes."""

import dataclasses
import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender import vec3
from jaxrender.pathtrace.bvh import Bvh, build_bvh, update_bvh
from jaxrender.pathtrace.hit_points import SurfaceTable, surface_table
from jaxrender.pathtrace.hits import Hits
from jaxrender.pathtrace.paths import Rays, ShadowRays
from jaxrender.pathtrace.ray_scene import is_hole, masked_triangles
from jaxrender.pathtrace.traversal import any_hit, closest_hit
from jaxrender.scene import Scene


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TreeRays:
    """A `RayScene` of JAX arrays. A ray sees the solid triangles first, then the masked ones before what it has found.

    Attributes:
      solid, masked: trees of the triangles of each kind; None where there are none, but that an empty scene is solid.
      solid_names, masked_names: the scene's triangles by those of the trees.
      holes: the surface at each place in the leaves of `masked`, corners in the order of the leaves.
    """

    solid: Bvh | None
    masked: Bvh | None
    solid_names: Int[Array, " s"]
    masked_names: Int[Array, " m"]
    holes: SurfaceTable | None

    def closest(self, rays: Rays, wanted: Bool[Array, " n"], *, reach: float = float("inf")) -> Hits:
        """See `RayScene`."""
        return _closest(self, rays, wanted, np.float32(reach))

    def blocked(self, shadow: ShadowRays) -> Bool[Array, " n"]:
        """See `RayScene`."""
        return _blocked(self, shadow)

    def moved(self, scene: Scene, table: SurfaceTable) -> "TreeRays":
        """Refitted, or built anew where a tree has become bad (`update_bvh`)."""
        solid, masked = (None if tree is None else update_bvh(tree, scene.positions)
                         for tree in (self.solid, self.masked))  # fmt: skip
        holes = None if masked is None else _surface_of_leaves(masked, self.masked_names, scene, table)
        return dataclasses.replace(self, solid=solid, masked=masked, holes=holes)


def tree_rays(scene: Scene, table: SurfaceTable) -> TreeRays:
    """Builds the trees, on the host."""
    is_masked, faces = masked_triangles(scene), np.asarray(scene.faces)
    solid = None if is_masked.any() and is_masked.all() else build_bvh(scene.positions, faces[~is_masked])
    masked = build_bvh(scene.positions, faces[is_masked]) if is_masked.any() else None
    solid_names, masked_names = (jnp.asarray(np.flatnonzero(own), jnp.int32) for own in (~is_masked, is_masked))
    holes = None if masked is None else _surface_of_leaves(masked, masked_names, scene, table)
    return TreeRays(solid, masked, solid_names, masked_names, holes)


def _surface_of_leaves(tree: Bvh, names: Int[Array, " m"], scene: Scene, table: SurfaceTable) -> SurfaceTable:
    """What decides about holes, by place in a leaf instead of by triangle."""
    triangle = names[jnp.maximum(tree.leaf_faces.reshape(-1), 0)]
    leaves = dataclasses.replace(scene, faces=tree.leaf_corners.reshape(-1, 3), material_id=scene.material_id[triangle])
    return surface_table(leaves, textures=table.textures, only=("uv", "color"))


@jax.jit
def _closest(trees: TreeRays, rays: Rays, wanted: Bool[Array, " n"], reach: Float[Array, ""]) -> Hits:
    origins, directions = vec3.to_array(rays.origin), vec3.to_array(rays.direction)
    limit, hits = jnp.where(wanted, reach, 0.0), []
    if trees.solid is not None:
        solid = closest_hit(trees.solid, origins, directions, max_distance=limit)
        hits, limit = [_named(solid, trees.solid_names)], jnp.minimum(limit, solid.t)
    if trees.masked is not None:
        masked = closest_hit(trees.masked, origins, directions, max_distance=limit, accept=_accept(trees))
        hits = [_named(masked, trees.masked_names), *hits]
    return functools.reduce(_or, hits)


@jax.jit
def _blocked(trees: TreeRays, shadow: ShadowRays) -> Bool[Array, " n"]:
    origins, directions = vec3.to_array(shadow.origin), vec3.to_array(shadow.direction)
    limit = jnp.where(vec3.largest(shadow.light) > 0.0, shadow.distance, 0.0)
    found = jnp.zeros(limit.shape, bool)
    if trees.solid is not None:
        found = any_hit(trees.solid, origins, directions, max_distance=limit)
    if trees.masked is not None:
        limit = jnp.where(found, 0.0, limit)
        found |= any_hit(trees.masked, origins, directions, max_distance=limit, accept=_accept(trees))
    return found


def _accept(trees: TreeRays) -> jax.tree_util.Partial:
    return jax.tree_util.Partial(_is_solid, trees.holes)


def _is_solid(holes: SurfaceTable, place: Int[Array, " k"], barycentrics: Float[Array, "k 2"]) -> Bool[Array, " k"]:
    return ~is_hole(holes, place, barycentrics)


def _named(hits: Hits, names: Int[Array, " m"]) -> Hits:
    """Hits by the scene's triangles."""
    if not len(names):
        return hits
    return dataclasses.replace(hits, triangle=jnp.where(hits.triangle >= 0, names[jnp.maximum(hits.triangle, 0)], -1))


def _or(first: Hits, second: Hits) -> Hits:
    """The first hit where there is one, else the second."""
    some = first.triangle >= 0
    return Hits(
        jnp.where(some, first.triangle, second.triangle), jnp.where(some, first.t, second.t),
        jnp.where(some[:, None], first.barycentrics, second.barycentrics),
    )  # fmt: skip
