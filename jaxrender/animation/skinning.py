"""From joint matrices to the posed surface: linear blend skinning of positions, normals and frames.

Pointwise in frames: joint matrices may have any leading axes. World space, metres.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxrender.animation.skeleton import Clip, Skeleton
from jaxrender.vecmath import dot, frame_from_normal_tangent, normalize, orthonormal_tangent


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Skin:
    """A surface at rest and how it hangs on the skeleton.

    A palette entry is one joint with the matrix that takes the surface at rest into that joint's space.
    Row v of `joint_indices` names the palette entries that move vertex v, and `weights`, which sum to 1,
    their shares; unused places have weight 0. The space of `vertices` is the one the inverse bind
    matrices start from, and may differ from entry to entry.
    """

    vertices: Float[Array, "v 3"]
    normals: Float[Array, "v 3"]
    joint_indices: Int[Array, "v k"]
    weights: Float[Array, "v k"]
    palette_joints: Int[Array, " p"]
    inverse_binds: Float[Array, "p 4 4"]


@dataclass(frozen=True, eq=False)
class Character:
    """A skinned body with its motions.

    Faces are counter-clockwise seen from outside, in the posed body. `albedo` is linear RGB. `content_hash`
    is the SHA-256 (hex) of the bytes it was read from. `unit_scale` is metres per unit of the file.
    `notes` say, one line each, what was repaired or left out on reading.
    """

    name: str
    skeleton: Skeleton
    skin: Skin
    faces: Int[Array, "t 3"]
    clips: tuple[Clip, ...]
    albedo: Float[Array, "v 3"]
    content_hash: str
    unit_scale: float = 1.0
    notes: tuple[str, ...] = ()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SkinnedMesh:
    """The posed surface. Columns of `frames` are tangent, bitangent and normal (world from local)."""

    positions: Float[Array, "*b v 3"]
    frames: Float[Array, "*b v 3 3"]


def skinning_matrices(skin: Skin, globals: Float[Array, "*b j 4 4"]) -> Float[Array, "*b v 3 4"]:
    """The blended matrix of every vertex, world from rest: Σ_k w_k G_k B_k, upper three rows.

    Args:
      globals: world from joint, for every joint of the skeleton.
    """
    # Full precision: see `global_matrices`.
    palette = jnp.einsum(
        "...pij,pjk->...pik",
        globals[..., skin.palette_joints, :3, :],
        skin.inverse_binds,
        precision=jax.lax.Precision.HIGHEST,
    )
    num_vertices = skin.weights.shape[0]

    def add_influence(blended, influence):
        joint_index, weight = influence
        weight = weight.reshape((1,) * (palette.ndim - 3) + (num_vertices, 1, 1))
        return blended + weight * palette[..., joint_index, :, :], None

    # One influence at a time, as a loop: a gather of all of them would hold k matrices a vertex, and without
    # the loop the compiler blends anew for every use of the matrix (6.8 instead of 1.5 ms for 10k vertices).
    start = jnp.zeros((*palette.shape[:-3], num_vertices, 3, 4), dtype=palette.dtype)
    return jax.lax.scan(add_influence, start, (skin.joint_indices.T, skin.weights.T))[0]


def transform_normals(linear: Float[Array, "*#b 3 3"], normals: Float[Array, "*#b 3"]) -> Float[Array, "*b 3"]:
    """Unit normals of a surface mapped by `linear`.

    By the cofactor matrix, det(M) M⁻ᵀ: right under any scale and shear without an inverse, and still
    defined where one axis is squeezed to nothing. Its sign is that of the determinant, so that an outward
    normal stays outward under a mirror. Where `linear` has rank below 2 the result is 0.
    """
    m0, m1, m2 = linear[..., 0], linear[..., 1], linear[..., 2]
    cofactors = jnp.stack([jnp.cross(m1, m2), jnp.cross(m2, m0), jnp.cross(m0, m1)], axis=-1)
    mapped = _apply(cofactors, normals)
    return normalize(jnp.where(dot(m0, cofactors[..., 0]) < 0, -mapped, mapped))


def skin_mesh(
    skin: Skin, globals: Float[Array, "*b j 4 4"], *, tangents: Float[Array, "v 3"] | None = None
) -> SkinnedMesh:
    """Linear blend skinning: x' = Σ_k w_k G_k B_k x, with a frame at each vertex that moves with the skin.

    The tangent is the image of a fixed tangent at rest, so the frame does not spin against the surface
    between frames of a motion. Differentiable in the matrices and in the skin.

    Args:
      globals: world from joint, for every joint of the skeleton (`global_matrices`).
      tangents: those at rest, such as the directions of growing u; None takes any.
    References:
      glTF 2.0, section 3.7.3; Magnenat-Thalmann et al., "Joint-Dependent Local Deformations for Hand
      Animation and Object Grasping", Graphics Interface 1988.
    """
    matrices = skinning_matrices(skin, globals)
    leading = matrices.shape[:-3]
    linear = matrices[..., :3]
    tangents = orthonormal_tangent(skin.normals) if tangents is None else tangents
    vertices, normals, tangents = (
        jnp.broadcast_to(rest, (*leading, *rest.shape)) for rest in (skin.vertices, skin.normals, tangents)
    )
    frames = frame_from_normal_tangent(transform_normals(linear, normals), _apply(linear, tangents))
    return SkinnedMesh(positions=_apply(linear, vertices) + matrices[..., 3], frames=frames)


def _apply(linear: Float[Array, "*b 3 3"], x: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """M x, column by column: on small matrices this is many times faster than a batched product."""
    return linear[..., 0] * x[..., 0:1] + linear[..., 1] * x[..., 1:2] + linear[..., 2] * x[..., 2:3]
