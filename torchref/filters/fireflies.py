"""Pixels far brighter than the lit ones around them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.filters.valid import valid_pixels


@in_float64
def clamp_fireflies(
    image: Float[Tensor, "h w c"], *, factor: float = 6.0, radius: int = 2
) -> tuple[Float[Tensor, "h w c"], Bool[Tensor, "h w"]]:
    """Luminance is at most `factor` times the median of the luminances > 0 in the window; whether it was more."""
    rec_709 = torch.tensor([0.2126, 0.7152, 0.0722] if image.shape[-1] == 3 else [1.0], dtype=image.dtype)
    luminance = torch.where(valid_pixels(image), (image * rec_709).sum(-1), 0.0)
    colors, clamped = image.clone(), torch.zeros(luminance.shape, dtype=torch.bool)
    for y, line in enumerate(luminance):
        for x, light in enumerate(line):
            window = luminance[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1].detach()
            lit = window[window > 0]
            if light > 0 and light > factor * lit.quantile(0.5):
                colors[y, x] = image[y, x] * (factor * lit.quantile(0.5) / light)
                clamped[y, x] = True
    return colors, clamped
