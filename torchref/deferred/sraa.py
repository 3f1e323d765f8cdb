"""Subpixel reconstruction, one sub-sample after another."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64


@in_float64
def sraa(
    shading: Float[Tensor, "h w 3"],
    depth: Float[Tensor, "h w n"],
    normal: Float[Tensor, "h w n 3"],
    covered: Bool[Tensor, "h w n"],
    first: Int[Tensor, "h w"],
    *,
    size: int,
    sigma_depth: float,
    sigma_normal: float,
    sigma_space: float = math.inf,
) -> Float[Tensor, "h w 3"]:
    """Mean over the covered sub-samples of a softmax over the shaded samples of the 3 x 3 pixels around."""
    height, width = first.shape
    chosen = first.clamp(0, size**2 - 1).tolist()

    def position(y: int, x: int, k: int) -> Tensor:
        row, column = divmod(k, size)
        return torch.tensor([x + (column + 0.5) / size, y + (row + 0.5) / size], dtype=depth.dtype)

    def light_of(y: int, x: int, k: int) -> Tensor:
        logs, lights = [], []
        for v in range(max(y - 1, 0), min(y + 2, height)):
            for u in range(max(x - 1, 0), min(x + 2, width)):
                j = chosen[v][u]
                if covered[v, u, j]:
                    by_depth = torch.abs(depth[v, u, j] / depth[y, x, k] - 1) / sigma_depth
                    by_normal = (1 - normal[v, u, j] @ normal[y, x, k]) / sigma_normal
                    away = position(v, u, j) - position(y, x, k)
                    logs.append(-torch.maximum(by_depth, by_normal) - away @ away / (2 * sigma_space**2))
                    lights.append(shading[v, u])
        return torch.softmax(torch.stack(logs), 0) @ torch.stack(lights) if logs else shading[y, x]

    pixels = []
    for y in range(height):
        for x in range(width):
            lights = [light_of(y, x, k) for k in range(size**2) if covered[y, x, k]]
            pixels.append(sum(lights) / len(lights) if lights else shading[y, x])
    return torch.stack(pixels).reshape(shading.shape) if pixels else shading
