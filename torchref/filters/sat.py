"""Sums, means and variances over windows, each from the pixels of its own window."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.filters._windows import windows
from torchref.filters.valid import valid_pixels


@in_float64
def summed_area_table(image: Float[Tensor, "h w c"]) -> Float[Tensor, "h+1 w+1 c"]:
    """table[y, x] = Σ image[:y, :x]."""
    height, width, channels = image.shape
    sums = [image[:y, :x].sum((0, 1)) for y in range(height + 1) for x in range(width + 1)]
    return torch.stack(sums).reshape(height + 1, width + 1, channels)


@in_float64
def box_sum_from_table(table: Float[Tensor, "h w c"], *, radius: int) -> Float[Tensor, "h-1 w-1 c"]:
    """Lower right corner and upper left one, less the two others."""
    height, width, channels = table.shape[0] - 1, table.shape[1] - 1, table.shape[2]
    sums = []
    for rows, columns in windows(height, width, radius=radius):
        top, bottom, left, right = rows.start, min(rows.stop, height), columns.start, min(columns.stop, width)
        sums.append(table[bottom, right] + table[top, left] - table[top, right] - table[bottom, left])
    return torch.stack(sums).reshape(height, width, channels)


@in_float64
def box_mean(image: Float[Tensor, "h w c"], *, radius: int) -> Float[Tensor, "h w c"]:
    """Mean of the window's finite pixels, 0 if it has none."""
    return _of_each_window(image, radius, lambda pixels: pixels.mean(0))


@in_float64
def box_variance(image: Float[Tensor, "h w c"], *, radius: int) -> Float[Tensor, "h w c"]:
    """Mean squared distance of the window's finite pixels from their mean."""
    return _of_each_window(image, radius, lambda pixels: ((pixels - pixels.mean(0)) ** 2).mean(0))


def _of_each_window(image, radius, function):
    """function(pixels (n, c)) -> (c,) of the finite pixels of each window, or 0."""
    valid, results = valid_pixels(image), []
    for window in windows(*valid.shape, radius=radius):
        pixels = image[window][valid[window]]
        results.append(function(pixels) if len(pixels) else pixels.sum(0))
    return torch.stack(results).reshape(image.shape)
