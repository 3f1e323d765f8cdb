"""The thin translucent sheet: shadowed diffuse light from the front, unshadowed light through the back."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.harmonics.brdf_operator import brdf_operator
from torchref.harmonics.zh import clamped_cosine_zh, zh_to_sh


@in_float64
def back_lobe(*, order: int = 4) -> Float[Tensor, " k"]:
    """SH of (1/π) max(0, -cos θ): the clamped cosine about -z."""
    ahead = clamped_cosine_zh(order=order)
    return zh_to_sh(ahead / math.pi, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64))


@in_float64
def membrane_transfer(
    visibility: Float[Tensor, "*b k"], transmission: Float[Tensor, "*#b c"], *, order: int = 4
) -> Float[Tensor, "*b c k"]:
    """t = (1/π) M¹ v + τ · back lobe per channel, in the vertex frame.

    References:
      Sloan, Luna, Snyder, "Local, Deformable Precomputed Radiance Transfer", 2005, eq. 22; Nowrouzezahrai et
      al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.1.
    """
    diffuse = brdf_operator(lambda cos: cos / math.pi, order=order, num_nodes=order)
    front = torch.einsum("ij,...j->...i", diffuse.to(visibility.device), visibility)
    behind = back_lobe(order=order).to(visibility.device)
    return front[..., None, :] + transmission[..., :, None] * behind
