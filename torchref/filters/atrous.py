"""Edge-avoiding à-trous filter, pixel by pixel."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.filters.valid import valid_pixels

_SPLINE = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)

# Less than this is no weight.
_NOTHING = 1e-30


@in_float64
def atrous_filter(
    image: Float[Tensor, "h w c"],
    features: Float[Tensor, "h w f"],
    *,
    num_levels: int,
    sigma_features: float | Float[Tensor, "..."],
    sigma_color: float | Float[Tensor, ""] | None = None,
) -> Float[Tensor, "h w c"]:
    """Levels of 5 x 5 pixels, 1, 2, 4, ... apart, weighted by spline, features and, if it has a sigma, the colour."""
    known, filled = valid_pixels(features), valid_pixels(image, features)
    image = image.where(filled[..., None], torch.zeros_like(image))
    features = features.where(known[..., None], torch.zeros_like(features))
    for i in range(num_levels):
        sigma = None if sigma_color is None else sigma_color / 2**i
        image, filled = _level(image, features, known, filled, 2**i, sigma_features, sigma)
    return image


def _level(image, features, known, filled, step, sigma_features, sigma_color):
    height, width = known.shape
    result = []
    for y in range(height):
        for x in range(width):
            weighted, total = torch.zeros_like(image[y, x]), torch.zeros((), dtype=image.dtype)
            for j, down in enumerate(_SPLINE):
                for i, right in enumerate(_SPLINE):
                    v, u = y + (j - 2) * step, x + (i - 2) * step
                    itself = (v, u) == (y, x)
                    if not (0 <= v < height and 0 <= u < width and filled[v, u] and (known[v, u] or itself)):
                        continue
                    weight = torch.tensor(down * right, dtype=image.dtype)
                    if known[y, x]:
                        weight = weight * torch.exp(-(((features[y, x] - features[v, u]) / sigma_features) ** 2).sum())
                    if known[y, x] and filled[y, x] and sigma_color is not None:
                        weight = weight * torch.exp(-((image[y, x] - image[v, u]) ** 2).sum() / sigma_color**2)
                    weighted, total = weighted + weight * image[v, u], total + weight
            result.append((weighted / total, True) if total > _NOTHING else (torch.zeros_like(weighted), False))
    values, found = zip(*result, strict=True)
    return torch.stack(values).reshape(image.shape), torch.tensor(found).reshape(filled.shape)
