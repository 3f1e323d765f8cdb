"""What goes into the methods: meshes, and meshes that move."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrender.vecmath import frame_from_normal_tangent, normalize


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mesh:
    """One triangle mesh. Faces are counter-clockwise seen from outside."""

    vertices: Float[Array, "v 3"]
    normals: Float[Array, "v 3"]
    faces: Int[Array, "t 3"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MeshSequence:
    """One mesh in f frames, and for each frame the numbers that drive it.

    `frames[f, v]` is the world-from-local rotation of a vertex: local z is its normal, local x is a
    tangent that moves with the surface. Visibility is stored in these frames, so that it does not
    change when the body only turns.
    """

    vertices: Float[Array, "f v 3"]
    frames: Float[Array, "f v 3 3"]
    faces: Int[Array, "t 3"]
    features: Float[Array, "f j"]

    @property
    def normals(self) -> Float[Array, "f v 3"]:
        return self.frames[..., 2]


def vertex_normals(vertices: Float[Array, "*b v 3"], faces: Int[Array, "t 3"]) -> Float[Array, "*b v 3"]:
    """Unit normals: the sum of the face normals around each vertex, weighted by area; 0 at a vertex without faces."""
    a, b, c = (vertices[..., faces[:, i], :] for i in range(3))
    weighted = jnp.cross(b - a, c - a)
    total = jnp.zeros_like(vertices)
    for corner in range(3):
        total = total.at[..., faces[:, corner], :].add(weighted)
    return normalize(total)


def make_mesh_sequence(
    vertices: Float[Array, "f v 3"], faces: Int[Array, "t 3"], features: Float[Array, "f j"]
) -> MeshSequence:
    """A mesh sequence from bare vertices: normals from the faces, tangents along one fixed edge of each vertex.

    The edge moves with the surface, so the frames turn with the body and do not spin against it.

    Args:
      features: what drives the shape, one row per frame; the model is linear in them.
    Raises:
      ValueError: if the numbers of frames differ, or an index in `faces` is out of range.
    """
    if len(vertices) != len(features):
        raise ValueError(f"features: expected {len(vertices)} frames as in vertices, got {len(features)}")
    index = np.asarray(faces)
    if index.size == 0 or index.min() < 0 or index.max() >= vertices.shape[1]:
        got = f"{index.min(initial=0)}..{index.max(initial=0)}"
        raise ValueError(f"faces: expected indices below {vertices.shape[1]}, got {got}")
    neighbour = np.arange(vertices.shape[1])
    for corner in (2, 1, 0):
        neighbour[index[:, corner]] = index[:, (corner + 1) % 3]
    normals = vertex_normals(vertices, faces)
    frames = frame_from_normal_tangent(normals, vertices[:, neighbour] - vertices)
    return MeshSequence(vertices, frames, faces, features)
