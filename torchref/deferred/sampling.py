"""Counts or clusters of each pixel -> which sub-samples are shaded, where, and for how much: window by window.

Sub-samples go row by row from the upper left. Shares, shifts and spreads are float32, as in jaxrender.
"""

import functools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64

_PRINTED = {2: "02 31", 3: "263 508 174", 4: "182a c4e6 3b09 f7d5"}


@dataclass(frozen=True)
class ShadingPoints:
    """Share of the pixel; way from the sub-sample to the middle, in pixels; (xx, xy, yy) of the footprint's matrix."""

    weight: Float[Tensor, "*b"]
    shift: Float[Tensor, "*b 2"]
    spread: Float[Tensor, "*b 3"]


@functools.cache
def index_matrix(size: int) -> Int[Tensor, "m m"]:
    """Printed for m = 2, 3, 4; Bayer's recursion for other powers of two; else the farthest point each time."""
    if size in _PRINTED:
        return torch.tensor([[int(digit, 16) for digit in row] for row in _PRINTED[size].split()])
    if size.bit_count() > 1:
        return _farthest_points(size)
    matrix = torch.tensor([[_bayer(y, x, size) for x in range(size)] for y in range(size)])
    # What the cell to the lower right of the middle has changes places with 0.
    first = int(matrix[size // 2, size // 2])
    return torch.where(matrix == 0, first, torch.where(matrix == first, 0, matrix))


def _bayer(y: int, x: int, size: int) -> int:
    """B_2n[y, x] = 4 B_n[y mod n, x mod n] + B_2[y div n, x div n]."""
    if size == 1:
        return 0
    half = size // 2
    return 4 * _bayer(y % half, x % half, half) + ((0, 2), (3, 1))[y // half][x // half]


def _farthest_points(size: int) -> Int[Tensor, "m m"]:
    # In halves of a cell from the middle, so that all but energies are whole numbers.
    cells = [(2 * y - size + 1, 2 * x - size + 1) for y in range(size) for x in range(size)]

    def distance2(a: tuple[int, int], b: tuple[int, int]) -> int:
        """Squared, around the torus."""
        return sum(min(abs(i - j), 2 * size - abs(i - j)) ** 2 for i, j in zip(a, b, strict=True))

    def drift2(places: list[tuple[int, int]]) -> int:
        return sum(sum(axis) ** 2 for axis in zip(*places, strict=True))

    def energy(cell: tuple[int, int], places: list[tuple[int, int]]) -> float:
        sigma = 2 * size / 4
        return round(math.fsum(math.exp(-distance2(cell, place) / (2 * sigma**2)) for place in places), 9)

    chosen = [min(cells, key=lambda cell: drift2([cell]))]
    while len(chosen) < len(cells):
        left = [cell for cell in cells if cell not in chosen]
        gap = {cell: min(distance2(cell, place) for place in chosen) for cell in left}
        chosen.append(min(left, key=lambda c: (-gap[c], drift2([*chosen, c]), energy(c, chosen))))
    return torch.tensor([chosen.index(cell) for cell in cells]).reshape(size, size)


def sample_positions(size: int) -> Float[Tensor, "n 2"]:
    """(x, y) from the pixel's middle, in pixels."""
    middle = (size - 1) / 2
    places = [((x - middle) / size, (y - middle) / size) for y in range(size) for x in range(size)]
    return torch.tensor(places, dtype=torch.float64)


def sample_rank(covered: Bool[Tensor, "*b n"]) -> Int[Tensor, "*b n"]:
    """How many covered sub-samples come before each in the index matrix; n for one that is empty."""
    n = covered.shape[-1]
    turn = index_matrix(math.isqrt(n)).flatten()
    before = torch.stack([(covered & (turn < turn[i])).sum(-1) for i in range(n)], dim=-1)
    return torch.where(covered, before, n).to(torch.int32)


def first_sample(covered: Bool[Tensor, "*b n"]) -> Int[Tensor, "*b"]:
    """The covered sub-sample of the smallest entry; 0 where there is none."""
    n = covered.shape[-1]
    turn = index_matrix(math.isqrt(n)).flatten()
    return torch.where(covered, turn, n).argmin(-1).to(torch.int32)


def prefix_points(count: Int[Tensor, "*b"], *, size: int) -> ShadingPoints:
    """1/K of the pixel and of its footprint for each of K samples, whose mean is moved to the pixel's middle."""
    places, turn = sample_positions(size), index_matrix(size).flatten()
    shift = torch.stack([-places[turn < k].mean(0) for k in count.flatten().tolist()])
    share = 1.0 / count.double()
    side = share.sqrt()
    return _points(share, shift.reshape(*count.shape, 2), torch.stack([side, torch.zeros_like(side), side], dim=-1))


def cluster_points(owner: Int[Tensor, "*b n"], sample: Int[Tensor, "*b"]) -> ShadingPoints:
    """Share, mean and √(12 · covariance) of all points of the cells that a sub-sample stands for.

    A cell of width 1/m has the covariance 1 / (12 m²) itself.
    """
    n = owner.shape[-1]
    places = sample_positions(math.isqrt(n))
    found = []
    for owners, own in zip(owner.reshape(-1, n), sample.flatten().tolist(), strict=True):
        mine = places[owners == own]
        away = mine - mine.mean(0)
        square = 12.0 * away.T @ away / len(mine) + torch.eye(2, dtype=torch.float64) / n
        values, axes = torch.linalg.eigh(square)
        root = axes @ torch.diag(values.sqrt()) @ axes.T
        spread = torch.stack([root[0, 0], root[0, 1], root[1, 1]])
        found.append((torch.tensor(len(mine) / int((owners >= 0).sum())), mine.mean(0) - places[own], spread))
    weight, shift, spread = (torch.stack(values) for values in zip(*found, strict=True))
    lead = tuple(sample.shape)
    return _points(weight.reshape(lead), shift.reshape(*lead, 2), spread.reshape(*lead, 3))


@in_float64
def resolve_samples(
    values: Float[Tensor, "b c"], weight: Float[Tensor, " b"], pixel: Int[Tensor, " b"], *, num_pixels: int
) -> Float[Tensor, "p c"]:
    """Each pixel's weighted samples, added up one by one."""
    rows = [torch.zeros_like(values[0]) for _ in range(num_pixels)]
    for value, share, owner in zip(values, weight, pixel.tolist(), strict=True):
        if 0 <= owner < num_pixels:
            rows[owner] = rows[owner] + share * value
    return torch.stack(rows)


def _points(weight: Tensor, shift: Tensor, spread: Tensor) -> ShadingPoints:
    return ShadingPoints(weight=weight.float(), shift=shift.float(), spread=spread.float())
