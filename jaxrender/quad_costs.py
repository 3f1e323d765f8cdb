"""What shading an image in quads costs, in numbers: Quads -> QuadCosts.

References:
  Giesen, "A Trip Through the Graphics Pipeline", part 8.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxrender.deferred.quads import Quads, helper_share, helper_share_by_size, quad_overdraw, quad_statistics
from jaxrender.deferred.warps import ORDERS, WarpCost, branch_cost, pack_quads, raster_balance, warp_cost

WARP_SIZES = (32, 64)
RASTERS = (1, 2, 4)
#: Side of the tiles that rasterisers take in turn, in quads: 16 pixels.
TILE_QUADS = 8
#: Groups of triangles by size, by powers of two; the last one holds those of 2048 pixels and more.
NUM_SIZES = 12


@dataclass(frozen=True)
class SizeGroup:
    """Triangles of `first` to `last` pixels (None: and more): how many, and the share of helpers among their lanes."""

    first: int
    last: int | None
    triangles: int
    helper_share: float


@dataclass(frozen=True)
class WarpFill:
    """Quads packed into warps of `lanes`, in API order.

    Attributes:
      warps: how many.
      utilisation: mean part of the lanes that cover a pixel.
      triangles: mean number of different ones in a warp.
    """

    lanes: int
    warps: int
    utilisation: float
    triangles: float


@dataclass(frozen=True)
class QuadWork:
    """The work of a list of quads.

    Attributes:
      triangles: of the mesh, with a pixel in the list.
      pixels: covered, each counted once for every triangle on it.
      quads: of four lanes each.
      helper_share: of the lanes, 1 - pixels / (4·quads).
      overdraw_mean, overdraw_max: quads at a place of the image, over the places that have one.
      by_size: triangles by the number of their pixels.
      warps: for each of WARP_SIZES.
    """

    triangles: int
    pixels: int
    quads: int
    helper_share: float
    overdraw_mean: float
    overdraw_max: int
    by_size: tuple[SizeGroup, ...]
    warps: tuple[WarpFill, ...]


@dataclass(frozen=True)
class Lockstep:
    """A full-screen pass in warps of `lanes`, filled in `order`: turns of lanes, and the part of them with own work."""

    lanes: int
    order: str
    useful: int
    paid: int
    efficiency: float


@dataclass(frozen=True)
class QuadCosts:
    """What an image costs.

    Attributes:
      all, visible: work of all quads, and of what is left of them after a perfect early depth test.
      loop: a full-screen pass that goes through the list of a pixel's fragments (all triangles on it, as
        order-independent transparency keeps them).
      branch: a full-screen pass with one path for alpha-tested materials and another for all else, a turn each.
      masked_share: pixels that see an alpha-tested material, of all pixels.
      raster_imbalance: number of rasterisers that take tiles in turn -> quads of the busiest over their mean.
    """

    all: QuadWork
    visible: QuadWork
    loop: tuple[Lockstep, ...]
    branch: tuple[Lockstep, ...]
    masked_share: float
    raster_imbalance: dict[int, float]


def quad_costs(quads: Quads, visible: Quads, masked: Bool[Array, "h w"], *, num_triangles: int) -> QuadCosts:
    """Counts it all. Not for use inside `jit`.

    Args:
      quads, visible: of `quad_coverage` and `visible_quads`.
      masked: pixels that see an alpha-tested material.
      num_triangles: of the mesh.
    """
    height, width = masked.shape
    trips = pixel_layers(quads, height=height, width=width)
    passes = [(lanes, order) for lanes in WARP_SIZES for order in ORDERS]
    loops = (warp_cost(trips, warp_size=lanes, order=order) for lanes, order in passes)
    branches = (branch_cost(masked, warp_size=lanes, order=order) for lanes, order in passes)
    work = overdraw_of(quads).astype(float)
    balance = {n: raster_balance(work, num_rasters=n, tile_size=TILE_QUADS) for n in RASTERS}
    return QuadCosts(
        all=quad_work(quads, num_triangles=num_triangles),
        visible=quad_work(visible, num_triangles=num_triangles),
        loop=tuple(_lockstep(*which, cost) for which, cost in zip(passes, loops, strict=True)),
        branch=tuple(_lockstep(*which, cost) for which, cost in zip(passes, branches, strict=True)),
        masked_share=float(np.mean(masked)) if masked.size else 0.0,
        raster_imbalance={n: float(found.imbalance) for n, found in balance.items()},
    )


def quad_work(quads: Quads, *, num_triangles: int) -> QuadWork:
    """The work of one list of quads."""
    each = quad_statistics(quads.triangle_id, quads.mask, num_triangles=num_triangles)
    pixels, count = jnp.sum(each.pixels), jnp.sum(each.quads)
    overdraw = np.asarray(overdraw_of(quads))
    shares, triangles = helper_share_by_size(each.pixels, each.quads, num_sizes=NUM_SIZES)
    return QuadWork(
        triangles=int(jnp.sum(triangles)),
        pixels=int(pixels),
        quads=int(count),
        helper_share=float(helper_share(pixels, count)),
        overdraw_mean=_mean(overdraw[overdraw > 0]),
        overdraw_max=int(overdraw.max(initial=0)),
        by_size=tuple(
            SizeGroup(2**k, 2 ** (k + 1) - 1 if k < NUM_SIZES - 1 else None, int(triangles[k]), float(shares[k]))
            for k in range(NUM_SIZES)
        ),
        warps=tuple(_warp_fill(quads, lanes) for lanes in WARP_SIZES),
    )


def overdraw_of(quads: Quads) -> Int[Array, "rows columns"]:
    """Quads shaded at each place of the image."""
    return quad_overdraw(quads.row, quads.column, rows=quads.rows, columns=quads.columns)


def pixel_layers(quads: Quads, *, height: int, width: int) -> Int[Array, "h w"]:
    """Triangles on each pixel: lanes of quads that are no helpers there."""
    layers = jnp.zeros((height, width), jnp.int32)
    for lane in range(4):
        at = 2 * quads.row + lane // 2, 2 * quads.column + lane % 2
        layers = layers.at[at].add(quads.mask >> lane & 1, mode="drop")
    return layers


def _warp_fill(quads: Quads, lanes: int) -> WarpFill:
    warps = pack_quads(quads.triangle_id, quads.mask, warp_size=lanes)
    return WarpFill(lanes, len(warps.quads), _mean(warps.utilisation), _mean(warps.triangles))


def _lockstep(lanes: int, order: str, cost: WarpCost) -> Lockstep:
    # Sums of a large image leave float32 and int32.
    useful, paid = (int(np.sum(np.asarray(turns, np.int64))) for turns in (cost.useful, cost.paid))
    return Lockstep(lanes, order, useful, paid, useful / paid if paid else 1.0)


def _mean(values) -> float:
    values = np.asarray(values, np.float64)
    return float(values.mean()) if values.size else 0.0
