"""Vectors and frames on any leading axes; zero vectors give zeros, with zero gradients."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64


@in_float64
def dot(a: Float[Tensor, "*#b 3"], b: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*#b 1"]:
    """Inner product along the last axis, which stays with size 1."""
    return torch.einsum("...i,...i->...", a, b)[..., None]


@in_float64
def safe_sqrt(x: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """√x for x > 0, else 0 with gradient 0."""
    return torch.where(x > 0, torch.sqrt(torch.where(x > 0, x, 1.0)), 0.0)


@in_float64
def safe_div(a: Float[Tensor, "..."], b: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """a / b, and 0 with gradient 0 where b = 0."""
    return torch.where(b == 0, 0.0, a / torch.where(b == 0, 1.0, b))


@in_float64
def normalize(v: Float[Tensor, "*b n"]) -> Float[Tensor, "*b n"]:
    """v / |v|; a zero vector stays zero."""
    return safe_div(v, safe_sqrt((v * v).sum(-1, keepdim=True)))


@in_float64
def orthonormal_tangent(n: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """A unit vector orthogonal to the unit vector n.

    It is what the shortest rotation of ±z (the pole on the side of n) into n makes of the x axis.

    References:
      Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017, b1 of listing 3.
    """
    pole = torch.where(n[..., 2:] >= 0, 1.0, -1.0)
    # Rotation of p = (0, 0, pole) into n applied to x: with e = n + p, R v = v - (e·v / (1 + p·n)) e for v ⟂
    # p.
    x = torch.tensor([1.0, 0.0, 0.0], dtype=n.dtype, device=n.device)
    e = n + pole * torch.tensor([0.0, 0.0, 1.0], dtype=n.dtype, device=n.device)
    return x - n[..., :1] / (1.0 + pole * n[..., 2:]) * e


@in_float64
def frame_from_normal_tangent(normal: Float[Tensor, "*b 3"], tangent: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """World-from-local rotation with columns tangent, bitangent, normal.

    The tangent is first made orthogonal to the unit normal; one parallel to it, that is with less than 1e-12
    of its squared length left, gives way to `orthonormal_tangent`.
    """
    across = tangent - dot(tangent, normal) * normal
    lost = dot(across, across) <= 1e-12 * dot(tangent, tangent).clamp(min=1e-30)
    t = normalize(torch.where(lost, orthonormal_tangent(normal), across))
    return torch.stack([t, torch.linalg.cross(normal, t), normal], dim=-1)


@in_float64
def reflection_frame(wo: Float[Tensor, "*b 3"], n: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """World-from-reflection rotation whose z axis is the mirror image of `wo` about n."""
    r = normalize(2.0 * dot(wo, n) * n - wo)
    return frame_from_normal_tangent(r, orthonormal_tangent(r))
