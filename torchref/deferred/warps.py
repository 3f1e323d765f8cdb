"""Lockstep execution: quads packed into warps, what branches and loops cost there, and tiles shared by rasterisers.

Lanes are filled one after another, four to a quad.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Num, Shaped
from torch import Tensor

from torchref._precision import in_float64
from torchref.deferred.quads import num_pixels


@dataclass(frozen=True)
class Warps:
    """Quads, covered pixels and different triangles of each warp."""

    quads: Int[Tensor, " n"]
    pixels: Int[Tensor, " n"]
    triangles: Int[Tensor, " n"]
    warp_size: int

    @property
    def utilisation(self) -> Float[Tensor, " n"]:
        """Covered pixels / lanes."""
        return self.pixels / self.warp_size


def pack_quads(triangle_id: Int[Tensor, " q"], mask: Int[Tensor, " q"], *, warp_size: int = 32) -> Warps:
    """Warps of the next `warp_size` / 4 quads each."""
    ids, masks = (v.split(warp_size // 4) if len(v) else () for v in (triangle_id, mask))
    return Warps(
        quads=torch.tensor([len(own) for own in ids], dtype=torch.int64),
        pixels=torch.tensor([int(num_pixels(own).sum()) for own in masks], dtype=torch.int64),
        triangles=torch.tensor([len(set(own.tolist())) for own in ids], dtype=torch.int64),
        warp_size=warp_size,
    )


def screen_lanes(
    values: Shaped[Tensor, "h w"], *, warp_size: int = 32, order: str = "rows"
) -> Shaped[Tensor, "n lanes"]:
    """Pixels quad after quad: row by row, or block of a warp by block."""
    h, w = values.shape
    rows, columns = (h + 1) // 2, (w + 1) // 2
    if order == "rows":
        places = [(r, c) for r in range(rows) for c in range(columns)]
    else:
        down, across = {4: (1, 1), 8: (1, 2), 16: (2, 2), 32: (2, 4), 64: (4, 4), 128: (4, 8)}[warp_size]
        places = [
            (top + r, left + c)
            for top in range(0, rows, down)
            for left in range(0, columns, across)
            for r in range(down)
            for c in range(across)
        ]
    row, column = torch.tensor(places, dtype=torch.int64).reshape(-1, 2).T
    return quad_lanes(values, row, column, warp_size=warp_size)


def quad_lanes(
    values: Shaped[Tensor, "h w"], row: Int[Tensor, " q"], column: Int[Tensor, " q"], *, warp_size: int = 32
) -> Shaped[Tensor, "n lanes"]:
    """The four pixels of each quad, one quad after another; 0 outside the image and in lanes left over."""
    h, w = values.shape
    lanes = values.new_zeros(-(-4 * len(row) // warp_size) * warp_size)
    for n, (r, c) in enumerate(zip(row.tolist(), column.tolist(), strict=True)):
        for lane in range(4):
            i, j = 2 * r + lane // 2, 2 * c + lane % 2
            if i < h and j < w:
                lanes[4 * n + lane] = values[i, j]
    return lanes.reshape(-1, warp_size)


def covered_lanes(mask: Int[Tensor, " q"], *, warp_size: int = 32) -> Bool[Tensor, "n lanes"]:
    """Bit by bit of the masks, one quad after another."""
    lanes = torch.zeros(-(-4 * len(mask) // warp_size) * warp_size, dtype=torch.bool)
    for n, bits in enumerate(mask.tolist()):
        for lane in range(4):
            lanes[4 * n + lane] = bool(bits >> lane & 1)
    return lanes.reshape(-1, warp_size)


@dataclass(frozen=True)
class WarpCost:
    """Turns that served a lane, and turns paid for all lanes, by warp."""

    useful: Num[Tensor, " n"]
    paid: Num[Tensor, " n"]

    @property
    def efficiency(self) -> Float[Tensor, ""]:
        """Useful / paid over all warps; 1 if nothing is paid."""
        paid = self.paid.sum()
        return self.useful.sum() / paid if paid > 0 else torch.ones(())


@in_float64
def loop_cost(trip_counts: Num[Tensor, "n lanes"], covered: Bool[Tensor, "n lanes"]) -> WarpCost:
    """Each warp turns as often as its longest lane."""
    useful = [trips[own].sum() for trips, own in zip(trip_counts, covered, strict=True)]
    paid = [len(trips) * trips.max() for trips in trip_counts]
    none = trip_counts.new_zeros(0)
    return WarpCost(useful=torch.stack(useful) if useful else none, paid=torch.stack(paid) if paid else none)


@in_float64
def warp_cost(trip_counts: Num[Tensor, "h w"], *, warp_size: int = 32, order: str = "rows") -> WarpCost:
    """A loop in a full-screen pass."""
    lanes = screen_lanes(trip_counts, warp_size=warp_size, order=order)
    return loop_cost(lanes, torch.ones(lanes.shape, dtype=torch.bool))


@in_float64
def branch_cost(
    taken: Bool[Tensor, "h w"],
    *,
    then_cost: float = 1.0,
    else_cost: float = 1.0,
    warp_size: int = 32,
    order: str = "rows",
) -> WarpCost:
    """Every side that a lane of a warp wants is run by all of it."""
    inside = screen_lanes(torch.ones_like(taken), warp_size=warp_size, order=order)
    useful, paid = [], []
    for wants, real in zip(screen_lanes(taken, warp_size=warp_size, order=order), inside, strict=True):
        want, decline = int(wants[real].sum()), int((~wants[real]).sum())
        useful.append(want * then_cost + decline * else_cost)
        paid.append(warp_size * ((want > 0) * then_cost + (decline > 0) * else_cost))
    return WarpCost(*(torch.tensor(turns, dtype=torch.float64) for turns in (useful, paid)))


@dataclass(frozen=True)
class RasterBalance:
    """Work of each rasteriser, and the most over the mean."""

    work: Float[Tensor, " r"]
    imbalance: Float[Tensor, ""]


def raster_owners(height: int, width: int, *, num_rasters: int = 4, tile_size: int = 16) -> Int[Tensor, "h w"]:
    """Tiles dealt out along each row; odd rows start half a round later."""
    owners = torch.zeros(height, width, dtype=torch.int64)
    for i in range(height):
        for j in range(width):
            start = num_rasters // 2 if i // tile_size % 2 else 0
            owners[i, j] = (start + j // tile_size) % num_rasters
    return owners


@in_float64
def raster_balance(work: Float[Tensor, "h w"], *, num_rasters: int = 4, tile_size: int = 16) -> RasterBalance:
    """The sums over what each one owns."""
    owners = raster_owners(*work.shape, num_rasters=num_rasters, tile_size=tile_size)
    each = torch.stack([work[owners == r].sum() for r in range(num_rasters)])
    total = each.sum()
    imbalance = each.max() * num_rasters / total if total > 0 else torch.ones((), dtype=each.dtype)
    return RasterBalance(work=each, imbalance=imbalance)
