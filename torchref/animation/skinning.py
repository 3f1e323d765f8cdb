"""From joint matrices to the posed surface: linear blend skinning, vertex by vertex as the formula says.

Pointwise in frames: joint matrices may have any leading axes. World space, metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.animation.skeleton import Clip, Skeleton
from torchref.vecmath import frame_from_normal_tangent, normalize, orthonormal_tangent


@dataclass(frozen=True)
class Skin:
    """A surface at rest and how it hangs on the skeleton.

    `palette_joints[p]` is the joint of palette entry p and `inverse_binds[p]` takes the surface at rest into
    it; row v of `joint_indices` names palette entries, `weights` their shares.
    """

    vertices: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]
    joint_indices: Int[Tensor, "v k"]
    weights: Float[Tensor, "v k"]
    palette_joints: Int[Tensor, " p"]
    inverse_binds: Float[Tensor, "p 4 4"]


@dataclass(frozen=True)
class Character:
    """A skinned body with its motions."""

    name: str
    skeleton: Skeleton
    skin: Skin
    faces: Int[Tensor, "t 3"]
    clips: tuple[Clip, ...]
    albedo: Float[Tensor, "v 3"]
    content_hash: str
    unit_scale: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class SkinnedMesh:
    """The posed surface; columns of `frames` are tangent, bitangent, normal (world from local)."""

    positions: Float[Tensor, "*b v 3"]
    frames: Float[Tensor, "*b v 3 3"]


@in_float64
def skinning_matrices(skin: Skin, globals: Float[Tensor, "*b j 4 4"]) -> Float[Tensor, "*b v 3 4"]:
    """World from rest for every vertex: Σ_k w_k G_k B_k, upper three rows."""
    blended = 0.0
    for k in range(skin.weights.shape[1]):
        entry = skin.joint_indices[:, k].long()
        matrix = globals[..., skin.palette_joints.long()[entry], :, :] @ skin.inverse_binds[entry]
        blended = blended + skin.weights[:, k, None, None] * matrix
    return blended[..., :3, :]


@in_float64
def transform_normals(linear: Float[Tensor, "*#b 3 3"], normals: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3"]:
    """Unit normals of a surface mapped by a matrix: along M⁻ᵀ n, from the images of two tangents.

    Images of tangents t × b = n span the new tangent plane, so M t × M b = det(M) M⁻ᵀ n; the sign of det(M)
    is divided out, which keeps an outward normal outward under a mirror. A matrix of rank below 2 gives 0.
    """
    n = normalize(normals)
    t = orthonormal_tangent(n)
    b = torch.linalg.cross(n, t)
    mapped_t, mapped_b = (torch.einsum("...ij,...j->...i", linear, x) for x in (t, b))
    crossed = torch.linalg.cross(mapped_t, mapped_b)
    mirrored = torch.linalg.det(linear)[..., None] < 0
    return normalize(torch.where(mirrored, -crossed, crossed))


@in_float64
def skin_mesh(
    skin: Skin, globals: Float[Tensor, "*b j 4 4"], *, tangents: Float[Tensor, "v 3"] | None = None
) -> SkinnedMesh:
    """x' = Σ_k w_k G_k B_k x, and at each vertex a frame from the skinned normal and a skinned rest tangent.

    References:
      glTF 2.0, section 3.7.3.
    """
    matrices = skinning_matrices(skin, globals)
    linear, offset = matrices[..., :3], matrices[..., 3]
    positions = torch.einsum("...ij,...j->...i", linear, skin.vertices) + offset
    normals = transform_normals(linear, skin.normals)
    at_rest = orthonormal_tangent(skin.normals) if tangents is None else tangents
    tangents = torch.einsum("...ij,...j->...i", linear, at_rest)
    return SkinnedMesh(positions, frame_from_normal_tangent(normals, tangents))
