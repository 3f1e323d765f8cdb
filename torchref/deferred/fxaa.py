"""FXAA 3.11 (quality), pixel by pixel. Display-encoded colour; beyond the border the nearest pixel is read."""

import itertools
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64

# Lengths of the steps from one look at an edge to the next, the last one without a look.
_PRESETS = {
    10: (1.5, 3, 12),
    11: (1, 1.5, 3, 12),
    12: (1, 1.5, 2, 4, 12),
    13: (1, 1.5, 2, 2, 4, 12),
    14: (1, 1.5, 2, 2, 2, 4, 12),
    15: (1, 1.5, 2, 2, 2, 2, 4, 12),
    20: (1.5, 2, 8),
    21: (1, 1.5, 2, 8),
    22: (1, 1.5, 2, 2, 8),
    23: (1, 1.5, 2, 2, 2, 8),
    24: (1, 1.5, 2, 2, 2, 3, 8),
    25: (1, 1.5, 2, 2, 2, 2, 4, 8),
    26: (1, 1.5, 2, 2, 2, 2, 2, 4, 8),
    27: (1, 1.5, 2, 2, 2, 2, 2, 2, 4, 8),
    28: (1, 1.5, 2, 2, 2, 2, 2, 2, 2, 4, 8),
    29: (1, 1.5, 2, 2, 2, 2, 2, 2, 2, 2, 4, 8),
    39: (1, 1, 1, 1, 1, 1.5, 2, 2, 2, 2, 4, 8),
}

# Lumas that differ by less are equal.
_EQUAL = 1.0 / 65536.0


@in_float64
def luma(image: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Rec. 601."""
    return (image * torch.tensor([0.299, 0.587, 0.114], dtype=image.dtype)).sum(-1)


@in_float64
def luma_range(luma: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """max - min, and max, over the pixels at city-block distance 0 and 1."""
    plus = torch.stack([_shifted(luma, dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if abs(dy) + abs(dx) <= 1])
    return plus.amax(0) - plus.amin(0), plus.amax(0)


@in_float64
def fxaa(
    image: Float[Tensor, "h w 3"],
    *,
    preset: int = 12,
    subpix: float = 0.75,
    edge_threshold: float = 0.166,
    edge_threshold_min: float = 0.0833,
) -> Float[Tensor, "h w 3"]:
    """Moves the place where a pixel at an edge is read towards the other side of the edge."""
    light = luma(image)
    contrast, brightest = luma_range(light)
    tent = sum((2 if 0 in (dy, dx) else 1) * _shifted(light, dy, dx) for dy, dx in _around()) / 12
    values = light.detach().tolist()
    rows = []
    for y, line in enumerate(values):
        for x in range(len(line)):
            if contrast[y, x] < max(edge_threshold * float(brightest[y, x].detach()), edge_threshold_min):
                rows.append(image[y, x])
                continue
            (dy, dx), shift = _edge_shift(values, y, x, _PRESETS[preset])
            alone = torch.zeros((), dtype=image.dtype)
            if contrast[y, x] > 0:
                share = torch.clamp(torch.abs(tent[y, x] - light[y, x]) / contrast[y, x], max=1.0)
                alone = subpix * (3 * share**2 - 2 * share**3) ** 2
            shift = torch.clamp(alone, min=shift)
            beside = image[_inside(y + dy, len(values)), _inside(x + dx, len(line))]
            rows.append((1 - shift) * image[y, x] + shift * beside)
    return torch.stack(rows).reshape(image.shape)


def _edge_shift(light: list[list[float]], y: int, x: int, steps: tuple[float, ...]) -> tuple[tuple[int, int], float]:
    """(dy, dx) of the pixel across the edge, and how far the slanted line through the edge's ends reaches over."""

    def at(row: int, column: int) -> float:
        return light[_inside(row, len(light))][_inside(column, len(light[0]))]

    def bend(row: int, column: int, dy: int, dx: int) -> float:
        return abs(at(row - dy, column - dx) - 2 * at(row, column) + at(row + dy, column + dx))

    horizontal = bend(y, x - 1, 1, 0) + 2 * bend(y, x, 1, 0) + bend(y, x + 1, 1, 0)
    vertical = bend(y - 1, x, 0, 1) + 2 * bend(y, x, 0, 1) + bend(y + 1, x, 0, 1)
    across = (1, 0) if horizontal > vertical - _EQUAL else (0, 1)
    change = {side: at(y + side * across[0], x + side * across[1]) - at(y, x) for side in (-1, 1)}
    side = -1 if abs(change[-1]) > abs(change[1]) - _EQUAL else 1
    across, step = (side * across[0], side * across[1]), change[side]

    def profile(along: float) -> float:
        """Mean of the two sides at a distance along the edge, above its value here."""
        low = math.floor(along)
        total = 0.0
        for place, weight in ((low, low + 1 - along), (low + 1, along - low)):
            row, column = y + place * abs(across[1]), x + place * abs(across[0])
            total += weight * (at(row, column) + at(row + across[0], column + across[1])) / 2
        return total - (at(y, x) + step / 2)

    def end(sign: int) -> tuple[float, float]:
        places = list(itertools.accumulate(steps))
        for place in places[:-1]:
            seen = profile(sign * place)
            if abs(seen) > abs(step) / 4 - _EQUAL:
                return place, seen
        return places[-1], seen

    (near, seen), (far, _) = sorted((end(1), end(-1)), key=lambda found: found[0])
    # Only if there the mean has left this pixel's luma is it this pixel's side that ends.
    if (seen < 0) == (step > 0):
        return across, 0.0
    return across, 0.5 - near / (near + far)


def _around() -> list[tuple[int, int]]:
    return [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]


def _shifted(values: Tensor, dy: int, dx: int) -> Tensor:
    h, w = values.shape
    return values[[_inside(y + dy, h) for y in range(h)]][:, [_inside(x + dx, w) for x in range(w)]]


def _inside(i: int, size: int) -> int:
    return min(max(i, 0), size - 1)
