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
    """Luminance is at most `factor` times the median of those > 0, the largest channel 2 `factor`; which were more."""
    rec_709 = torch.tensor([0.2126, 0.7152, 0.0722] if image.shape[-1] == 3 else [1.0], dtype=image.dtype)
    luminance, largest = (torch.where(valid_pixels(image), x, 0.0) for x in ((image * rec_709).sum(-1), image.amax(-1)))
    scales = torch.minimum(_scales(luminance, factor, radius), _scales(largest, 2 * factor, radius))
    return torch.where((scales < 1)[..., None], image * scales[..., None], image), scales < 1


def _scales(measure: Float[Tensor, "h w"], factor: float, radius: int) -> Float[Tensor, "h w"]:
    """What brings each pixel down to its limit, 1 if it is below."""
    scales = torch.ones_like(measure)
    for y, line in enumerate(measure):
        for x, light in enumerate(line):
            window = measure[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1].detach()
            lit = window[window > 0]
            if light > 0 and light > factor * lit.quantile(0.5):
                scales[y, x] = factor * lit.quantile(0.5) / light
    return scales
