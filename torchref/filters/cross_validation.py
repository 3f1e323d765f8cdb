"""How well a filter predicts pixels it has not seen."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.filters.sat import box_mean

_PROBE_RADIUS = 8


@in_float64
def own_share(probe: Float[Tensor, "h w"], filtered_probe: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The mean of z (A z) around each pixel, in [0, 0.9]."""
    return box_mean((probe * filtered_probe)[..., None], radius=_PROBE_RADIUS)[..., 0].clamp(0.0, 0.9)


@in_float64
def leave_one_out_error(
    image: Float[Tensor, "h w c"],
    filtered: Float[Tensor, "h w c"],
    share: Float[Tensor, "h w"],
    *,
    weight: Float[Tensor, "h w c"],
) -> Float[Tensor, ""]:
    """Weighted mean of ((image - filtered) / (1 - share))² where that is finite."""
    error = (image - filtered) / (1 - share[..., None])
    finite = torch.isfinite(error)
    return (weight[finite] * error[finite] ** 2).sum() / weight[finite].sum()
