"""What goes into the methods: meshes, and meshes that move."""

from dataclasses import dataclass

import jax
from jaxtyping import Array, Float, Int


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
