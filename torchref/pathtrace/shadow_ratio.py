"""Soft shadows from few rays: the share of a lamp that is seen."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.filters.guided import guided_filter


@in_float64
def shadow_ratio(
    arrived: Float[Tensor, "h w 3"], unshadowed: Float[Tensor, "h w 3"], channels: Float[Tensor, "h w g"],
    eps: Float[Tensor, " g"], *, radius: int,
) -> Float[Tensor, "h w 3"]:  # fmt: skip
    """Two filtered images, one over the other, within [0, 1]; 1 where the second has no light.

    References:
      Heitz, Hill, McGuire, "Combining Analytic Direct Illumination and Stochastic Shadows", I3D 2018, eq. 6.
    """
    if radius > 0:
        arrived, unshadowed = (guided_filter(channels, x, radius=radius, eps=eps) for x in (arrived, unshadowed))
    dark = unshadowed <= 1e-6
    return torch.where(dark, 1.0, arrived / torch.where(dark, 1.0, unshadowed)).clamp(0.0, 1.0)


def ratio_radius(shadow_rays: int, *, group: str) -> int:
    """3 rays^(-3/5) for lamps, 12 rays^(-1/2) for the surroundings, to the next whole number, at least 1."""
    first, power = {"area": (3.0, 3 / 5), "environment": (12.0, 1 / 2)}[group]
    return max(1, round(first / shadow_rays**power))
