"""The bounding volume hierarchy of a triangle mesh: built on the host, refitted as a pure function of the vertices."""

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrender.checks import bad_input, check_last_axis, check_same_shape
from jaxrender.pathtrace.bvh_build import EMPTY, WIDTH, build_tree

LEAF_SIZE = 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bvh:
    """An 8-wide tree over the triangles of one mesh.

    Nodes and leaves are filled up to a few sizes, so that a rebuilt tree finds the programs compiled for the old one.

    Attributes:
      vertices, faces: the mesh, in float32 and int32; hits name its faces.
      boxes: those of each node's children: lower x, y, z, upper x, y, z; inf and -inf where there is no child.
      children: codes of the children: a node >= 0 (never 0, the root), ~leaf < 0, or `bvh_build.EMPTY`.
      leaf_faces: the faces of each leaf; -1 is none.
      leaf_corners: the vertices of these faces, each face's in an order that neighbours share (see `ray_triangle`).
      leaf_triangles: the positions of these corners; 0 where there is no face.
      built_cost: `bvh_cost` when the tree was built.
      depth: at least the nodes on the longest way down: the entries of a ray's stack.
    """

    vertices: Float[Array, "v 3"]
    faces: Int[Array, "t 3"]
    boxes: Float[Array, "m 6 8"]
    children: Int[Array, "m 8"]
    leaf_faces: Int[Array, "l 2"]
    leaf_corners: Int[Array, "l 2 3"]
    leaf_triangles: Float[Array, "l 2 3 3"]
    built_cost: Float[Array, ""]
    depth: int = field(metadata={"static": True})


def build_bvh(vertices: Float[np.ndarray | Array, "v 3"], faces: Int[np.ndarray | Array, "t 3"]) -> Bvh:
    """A tree over a mesh, on the host: 100,000 triangles take about a second. The mesh may be empty.

    Faces without area (seen in float64) are in no leaf and are never hit. If a later pose gives them an area they
    need a new tree, which `update_bvh` sees to.

    Raises:
      InputError: if a face names a vertex that is not there, or has a corner that is not finite.
      ValueError: for shapes other than (v, 3) and (t, 3), and for more than about 30 million triangles.
    """
    check_last_axis("vertices", vertices, 3)
    check_last_axis("faces", faces, 3)
    positions, indices = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    _check_mesh(positions, indices)
    corners = positions[indices]
    kept = np.flatnonzero(_twice_area(corners) > 0)
    tree = build_tree(corners[kept].min(axis=1), corners[kept].max(axis=1), leaf_size=LEAF_SIZE)
    # One more entry each, for the -1 of an empty place.
    leaf_faces = filled(np.append(kept, -1)[tree.leaves], -1)
    leaf_corners = np.append(_shared_order(positions, indices), np.zeros((1, 3), np.int32), axis=0)[leaf_faces]
    children = filled(tree.children, EMPTY)
    bvh = Bvh(
        vertices=jnp.asarray(positions),
        faces=jnp.asarray(indices),
        boxes=jnp.zeros((len(children), 6, WIDTH), jnp.float32),
        children=jnp.asarray(children),
        leaf_faces=jnp.asarray(leaf_faces, jnp.int32),
        leaf_corners=jnp.asarray(leaf_corners, jnp.int32),
        leaf_triangles=jnp.zeros((*leaf_corners.shape, 3), jnp.float32),
        built_cost=jnp.zeros((), jnp.float32),
        depth=-(-tree.depth // 4) * 4,
    )
    bvh = _refit(bvh, bvh.vertices)
    return replace(bvh, built_cost=_cost(bvh))


def refit_bvh(bvh: Bvh, vertices: Float[Array, "v 3"]) -> Bvh:
    """The same tree around moved vertices; pure, for use inside `jit`.

    Boxes are bit-equal to those of a tree that was built for these vertices and came out with the same shape. Gradients
    flow through the vertices of the result, not through its boxes. A vertex that is not finite makes the boxes around
    it miss every ray.

    Raises:
      ValueError: if the number of vertices is another one.
    """
    check_same_shape("vertices and those of the tree", vertices, bvh.vertices)
    vertices = vertices.astype(bvh.vertices.dtype)
    some = (bvh.leaf_faces >= 0)[..., None, None]
    if vertices.shape[0]:
        triangles = jnp.where(some, jax.lax.stop_gradient(vertices)[bvh.leaf_corners], 0.0)
    else:
        triangles = jnp.zeros_like(bvh.leaf_triangles)
    low = jnp.min(jnp.where(some, triangles, jnp.inf), axis=(1, 2))
    high = jnp.max(jnp.where(some, triangles, -jnp.inf), axis=(1, 2))
    boxes = refit_boxes(bvh.children, low, high, depth=bvh.depth)
    return replace(bvh, vertices=vertices, leaf_triangles=triangles, boxes=boxes)


def refit_boxes(
    children: Int[Array, "m 8"], leaf_lower: Float[Array, "l 3"], leaf_upper: Float[Array, "l 3"], *, depth: int
) -> Float[Array, "m 6 8"]:
    """Boxes of all children from those of the leaves: `depth` rounds, in each of which nodes take in their children."""
    is_leaf, is_node = ((children < 0) & (children != EMPTY))[..., None], (children >= 0)[..., None]
    leaf, node = jnp.where(is_leaf[..., 0], ~children, 0), jnp.where(is_node[..., 0], children, 0)
    low = jnp.where(is_leaf, leaf_lower[leaf], jnp.inf)
    high = jnp.where(is_leaf, leaf_upper[leaf], -jnp.inf)

    def take_in(_, boxes):
        return (
            jnp.where(is_node, jnp.min(boxes[0], axis=1)[node], low),
            jnp.where(is_node, jnp.max(boxes[1], axis=1)[node], high),
        )

    low, high = jax.lax.fori_loop(0, depth, take_in, (low, high))
    return jnp.swapaxes(jnp.concatenate([low, high], axis=-1), 1, 2)


def bvh_cost(bvh: Bvh) -> Float[Array, ""]:
    """Expected work for a ray that meets the box of the mesh: nodes visited plus triangles tested; pure.

    It is the sum over the boxes of their area, relative to the root's, times 1 for a node and the number of its
    triangles for a leaf. When a mesh deforms its boxes come to overlap, and the cost rises. 1 for a mesh without area.
    """
    lower, upper = bvh.boxes[:, :3], bvh.boxes[:, 3:]
    x, y, z = jnp.moveaxis(jnp.maximum(upper - lower, 0.0), 1, 0)
    area = x * y + y * z + z * x
    x, y, z = jnp.maximum(jnp.max(upper[0], axis=-1) - jnp.min(lower[0], axis=-1), 0.0)
    root = x * y + y * z + z * x
    triangles = jnp.sum(bvh.leaf_faces >= 0, axis=-1).astype(area.dtype)
    leaf = jnp.where((bvh.children < 0) & (bvh.children != EMPTY), ~bvh.children, 0)
    weight = jnp.where(bvh.children >= 0, 1.0, triangles[leaf])
    return 1.0 + jnp.sum(area / jnp.where(root > 0, root, 1.0) * weight)


def update_bvh(bvh: Bvh, vertices: Float[np.ndarray | Array, "v 3"], *, rebuild_above: float = 1.5) -> Bvh:
    """The tree around moved vertices, on the host: refitted, or built anew where a refit would not do.

    That is where the cost rises above `rebuild_above` times what it was when the tree was built, and where a face
    without area, which is in no leaf, has got one.

    Raises:
      InputError: if a corner of a face is not finite.
      ValueError: if the number of vertices is another one.
    """
    check_same_shape("vertices and those of the tree", vertices, bvh.vertices)
    positions, faces = np.asarray(vertices, np.float32), np.asarray(bvh.faces)
    _check_mesh(positions, faces)
    left_out = np.ones(len(faces) + 1, bool)
    left_out[np.asarray(bvh.leaf_faces)] = False
    left_out = left_out[:-1]
    if not (_twice_area(positions[faces[left_out]]) > 0).any():
        refitted = _refit(bvh, jnp.asarray(positions))
        if _cost(refitted) <= rebuild_above * bvh.built_cost:
            return refitted
    return build_bvh(positions, faces)


_refit = jax.jit(refit_bvh)
_cost = jax.jit(bvh_cost)


def _check_mesh(positions: np.ndarray, faces: np.ndarray) -> None:
    if not len(faces):
        return
    if not 0 <= faces.min() <= faces.max() < len(positions):
        got = f"{faces.min()}..{faces.max()}"
        bad_input("mesh", "faces", expected=f"indices from 0 to {len(positions) - 1}", got=got)
    finite = np.isfinite(positions).all(axis=-1)[faces].all(axis=-1)
    if not finite.all():
        first = int(np.argmin(finite))
        got = f"{(~finite).sum()} triangles with NaN or Inf, first triangle {first}"
        bad_input("mesh", "vertices", expected="finite corners", got=got)


def _twice_area(corners: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, " t"]:
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1)


def _shared_order(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The corners of each face, sorted by position: vertices on one spot count as one."""
    _, rank = np.unique(positions + np.float32(0), axis=0, return_inverse=True)
    order = np.argsort(rank.reshape(-1)[faces], axis=-1)
    return np.take_along_axis(faces, order, axis=-1)


def filled(rows: Int[np.ndarray, "n *rest"], value: int) -> Int[np.ndarray, "more *rest"]:
    """The rows, and rows of `value` up to the next of the sizes 64, 72, ..., 128, 144, ..., 256, 288, and so on."""
    step = 1 << max(6, (len(rows) - 1).bit_length()) - 4
    more = -len(rows) % step if len(rows) > 64 else 64 - len(rows)
    return np.concatenate([rows, np.full((more, *rows.shape[1:]), value, rows.dtype)])
