"""Distances of an image or a table of numbers from its reference, and the colors of a heat map.

Values are linear or display-encoded, whichever the caller reports; `peak` is the largest one possible.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchref._precision import in_float64
from torchref._srgb import decode_srgb
from torchref.vecmath import safe_div, safe_sqrt

# "inferno" (Smith and van der Walt, 2015, CC0) at 0, 0.1, ..., 1, as in the published table of 256 sRGB colors.
_INFERNO = (
    "000004",
    "160b39",
    "420a68",
    "6a176e",
    "932667",
    "bc3754",
    "dd513a",
    "f37819",
    "fca50a",
    "f6d746",
    "fcffa4",
)

# Side and standard deviation, in pixels, of the window of SSIM.
_WINDOW, _SIGMA = 11, 1.5


@in_float64
def mse(image: Float[Tensor, "*b"], reference: Float[Tensor, "*b"]) -> Float[Tensor, ""]:
    """Mean of the squared differences."""
    return ((image - reference) ** 2).mean()


@in_float64
def psnr(image: Float[Tensor, "*b"], reference: Float[Tensor, "*b"], *, peak: float = 1.0) -> Float[Tensor, ""]:
    """10 log₁₀(peak² / mse) in dB; infinite for equal images."""
    return 10.0 * torch.log10(peak**2 / mse(image, reference))


@in_float64
def relative_l2(values: Float[Tensor, "*b"], reference: Float[Tensor, "*b"]) -> Float[Tensor, ""]:
    """‖values − reference‖ / ‖reference‖; 0 for an all-zero reference."""
    return safe_div(safe_sqrt(((values - reference) ** 2).sum()), safe_sqrt((reference**2).sum()))


@in_float64
def flicker(frames: Float[Tensor, "f h w c"]) -> Float[Tensor, ""]:
    """Mean over all values of their variance over the frames, over f - 1."""
    return frames.var(dim=0, correction=1).mean()


@in_float64
def warped_flicker(
    image: Float[Tensor, "h w c"],
    previous: Float[Tensor, "h w c"],
    *,
    places_px: Float[Tensor, "h w 2"],
    matches: Bool[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """√ mean (image - previous at places)² over the pixels that match, pixel by pixel; 0 if there are none."""
    height, width = image.shape[:2]
    squares = []
    for row, column in matches.nonzero().tolist():
        x, y = places_px[row, column] - 0.5
        left, top = int(torch.floor(x)), int(torch.floor(y))
        before = 0.0
        for j in (top, top + 1):
            for i in (left, left + 1):
                texel = previous[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]
                before = before + (1 - (x - i).abs()) * (1 - (y - j).abs()) * texel
        squares.append((image[row, column] - before) ** 2)
    return torch.stack(squares).mean().sqrt() if squares else (0.0 * image).sum()


def ssim(
    image: Float[Tensor | np.ndarray, "h w c"],
    reference: Float[Tensor | np.ndarray, "h w c"],
    *,
    peak: float = 1.0,
) -> float:
    """Mean structural similarity, window by window from the definition; the partner asks scikit-image.

    Moments are weighted by a Gaussian of sigma 1.5 cut to 11 x 11 pixels, and only windows inside the image count:
    (2 μx μy + c₁)(2 σxy + c₂) / ((μx² + μy² + c₁)(σx² + σy² + c₂)), c₁ = (0.01 peak)², c₂ = (0.03 peak)².

    References:
      Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural
      similarity", IEEE TIP 13(4), 2004, eq. 13 to 16.
    """
    steps = torch.arange(_WINDOW, dtype=torch.float64) - _WINDOW // 2
    gauss = torch.exp(-0.5 * (steps / _SIGMA) ** 2)
    weights = torch.outer(gauss, gauss) / gauss.sum() ** 2
    x, y = (
        torch.as_tensor(picture, dtype=torch.float64).unfold(0, _WINDOW, 1).unfold(1, _WINDOW, 1)
        for picture in (image, reference)
    )

    def mean(of: Tensor) -> Tensor:
        return (of * weights).sum((-2, -1))

    mean_x, mean_y = mean(x), mean(y)
    away_x, away_y = x - mean_x[..., None, None], y - mean_y[..., None, None]
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    luminance = (2.0 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2.0 * mean(away_x * away_y) + c2) / (mean(away_x**2) + mean(away_y**2) + c2)
    return float((luminance * structure).mean())


@in_float64
def heatmap(values: Float[Tensor, "*b"], *, low: float = 0.0, high: float | None = None) -> Float[Tensor, "*b 3"]:
    """Colors of "inferno" from `low` to `high` (the largest value if None), linear RGB; green for NaN.

    Between eleven nodes the sRGB color is a straight line.
    """
    lost = torch.isnan(values)
    values = torch.where(lost, low, values)
    top = values.max() if high is None else torch.tensor(high, dtype=values.dtype, device=values.device)
    place = 10.0 * safe_div(values - low, (top - low).expand(values.shape)).clamp(0.0, 1.0)
    bytes_of = [[int(code[i : i + 2], 16) for i in (0, 2, 4)] for code in _INFERNO]
    nodes = torch.tensor(bytes_of, dtype=values.dtype, device=values.device) / 255.0
    # Linear B-splines: each node has a hat of width 1 on either side.
    srgb = 0.0
    for node, color in enumerate(nodes):
        srgb = srgb + (1.0 - (place - node).abs()).clamp(min=0.0)[..., None] * color
    linear = decode_srgb(srgb)
    green = torch.tensor([0.0, 1.0, 0.0], dtype=values.dtype, device=values.device)
    return torch.where(lost[..., None], green, linear)
