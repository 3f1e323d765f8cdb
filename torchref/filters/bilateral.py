"""Cross-bilateral filter, window by window."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.filters.valid import valid_pixels

# Less than this is no weight.
_NOTHING = 1e-30


@in_float64
def cross_bilateral_filter(
    image: Float[Tensor, "h w c"],
    features: Float[Tensor, "h w f"],
    *,
    radius: int,
    sigma_spatial: float | Float[Tensor, ""],
    sigma_features: float | Float[Tensor, "..."],
) -> Float[Tensor, "h w c"]:
    """J(p) = Σ G(|p - q|) Π G(F(p) - F(q)) I(q) / Σ G(|p - q|) Π G(F(p) - F(q)), without pixels that are not finite."""
    valid, known = valid_pixels(image, features), valid_pixels(features)
    image = image.where(valid[..., None], torch.zeros_like(image))
    features = features.where(known[..., None], torch.zeros_like(features))
    height, width = valid.shape
    result = []
    for y in range(height):
        for x in range(width):
            rows = torch.arange(max(y - radius, 0), min(y + radius + 1, height))
            columns = torch.arange(max(x - radius, 0), min(x + radius + 1, width))
            window = rows[:, None], columns
            away = ((rows[:, None] - y) ** 2 + (columns - x) ** 2).to(image.dtype)
            weight = torch.exp(-away / (2 * sigma_spatial**2)) * valid[window]
            if known[y, x]:
                away = features[y, x] - features[window]
                weight = weight * torch.exp(-(away**2) / (2 * sigma_features**2)).prod(-1)
            mean = (weight[..., None] * image[window]).sum((0, 1)) / weight.sum().clamp(min=_NOTHING)
            result.append(mean if weight.sum() > _NOTHING else torch.zeros_like(mean))
    return torch.stack(result).reshape(image.shape)
