"""Morphological anti-aliasing: every edge is followed to its ends, pixel by pixel. Display-encoded colour."""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref._srgb import encode_srgb
from torchref.deferred.fxaa import luma

# Lumas that differ by less are equal.
_EQUAL = 1.0 / 65536.0


@in_float64
def mlaa(
    image: Float[Tensor, "h w 3"], *, threshold: float = 0.1, max_search_steps: int = 16, linear_light: bool = False
) -> Float[Tensor, "h w 3"]:
    """Mixes pixels by the areas that lines through the ends of edges cut off them."""
    left, top = _edges(luma(image).detach().tolist(), threshold)
    height, width = image.shape[:2]
    # Area of each pixel that goes to a neighbour: (row, column) -> (dy, dx) -> area.
    taken: dict[tuple[int, int], dict[tuple[int, int], float]] = {}
    for y in range(height):
        for x in range(width):
            if top[y][x]:
                areas = _line(lambda v, u: _get(top, v, u), lambda v, u: _get(left, v, u), y, x, 2 * max_search_steps)
                taken.setdefault((y - 1, x), {})[1, 0], taken.setdefault((y, x), {})[-1, 0] = areas
            if left[y][x]:  # the same in the transposed image
                areas = _line(lambda v, u: _get(left, u, v), lambda v, u: _get(top, u, v), x, y, 2 * max_search_steps)
                taken.setdefault((y, x - 1), {})[0, 1], taken.setdefault((y, x), {})[0, -1] = areas
    color = image
    if linear_light:
        color = torch.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    pixels = []
    for y in range(height):
        for x in range(width):
            areas = taken.get((y, x), {})
            pair = max(
                [{way: a for way, a in areas.items() if way[i]} for i in (0, 1)],  # the first of equals
                key=lambda pair: max(pair.values(), default=0.0),
            )
            total = sum(pair.values())
            if total == 0.0:
                pixels.append(image[y, x])
                continue
            mixed = sum(
                (a / total) * ((1 - a) * color[y, x] + a * color[y + dy, x + dx]) for (dy, dx), a in pair.items()
            )
            pixels.append(encode_srgb(mixed) if linear_light else mixed)
    return torch.stack(pixels).reshape(image.shape)


def _edges(light: list[list[float]], threshold: float) -> tuple[list[list[bool]], list[list[bool]]]:
    height, width = len(light), len(light[0])

    def step(y: int, x: int, dy: int, dx: int) -> float:
        """Between a pixel and the one before it; 0 where either is outside."""
        inside = 0 <= y - dy and 0 <= x - dx and y < height and x < width
        return abs(light[y][x] - light[y - dy][x - dx]) if inside else 0.0

    def edge(y: int, x: int, dy: int, dx: int) -> bool:
        own = step(y, x, dy, dx)
        near = max(step(y + i * a, x + i * b, a, b) for a, b in ((1, 0), (0, 1)) for i in (-1, 0, 1))
        return own > threshold - _EQUAL and 2 * own > near - _EQUAL

    return tuple([[edge(y, x, *way) for x in range(width)] for y in range(height)] for way in ((0, 1), (1, 0)))


def _get(edges: list[list[bool]], y: int, x: int) -> bool:
    return 0 <= y < len(edges) and 0 <= x < len(edges[0]) and edges[y][x]


def _line(edge, crossing, y: int, x: int, reach: int) -> tuple[float, float]:
    """Areas in the pixel above an edge and in the one below, of the line that replaces the run around column x."""

    def crossed(boundary: int) -> tuple[bool, bool]:
        return crossing(y - 1, boundary), crossing(y, boundary)

    start, stop = x, x + 1
    while start > x - reach and not any(crossed(start)) and edge(y, start - 1):
        start -= 1
    while stop < x + 1 + reach and not any(crossed(stop)) and edge(y, stop):
        stop += 1
    kinds = {(False, False): "none", (True, False): "up", (False, True): "down", (True, True): "both"}
    ends = kinds[crossed(start)], kinds[crossed(stop)]
    height = {"up": 0.5, "down": -0.5, "none": 0.0}
    if ends == ("both", "both"):
        left = right = 0.0
    elif ends[0] == "both":
        left, right = -height[ends[1]], height[ends[1]]
    elif ends[1] == "both":
        left, right = height[ends[0]], -height[ends[0]]
    else:
        left, right = height[ends[0]], height[ends[1]]

    middle = (start + stop) / 2

    def line(t: float) -> float:
        return left * (middle - t) / (middle - start) if t < middle else right * (t - middle) / (stop - middle)

    # Between the corners of the line, and of the pixel, it is straight and on one side.
    corners = sorted({float(x), min(max(middle, x), x + 1.0), x + 1.0})
    areas = [(b - a) * (line(a) + line(b)) / 2 for a, b in itertools.pairwise(corners)]
    return sum(max(a, 0.0) for a in areas), sum(max(-a, 0.0) for a in areas)
