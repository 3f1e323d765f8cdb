"""Pixels that are numbers."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def valid_pixels(*images: Float[Tensor, "h w _"]) -> Bool[Tensor, "h w"]:
    """Whether all channels of all images are finite."""
    return torch.isfinite(torch.cat(images, dim=-1)).all(-1)
