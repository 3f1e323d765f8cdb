"""Lockstep execution: quads packed into warps, what branches and loops cost there, and tiles shared by rasterisers.

A warp is `warp_size` lanes, four to a quad, that run the same instruction. A loop runs until its longest lane is
through, both sides of a branch run if one lane wants each: the rest is predicated off, but paid. Nothing here has a
gradient.

References:
  Giesen, "A Trip Through the Graphics Pipeline", part 8. Warps of 32 lanes are NVIDIA's, wavefronts of 64 AMD's.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num, Shaped

from jaxrender.checks import check_at_least, check_one_of, check_same_shape
from jaxrender.deferred.quads import num_pixels

WARP_SIZES = (4, 8, 16, 32, 64, 128)
ORDERS = ("rows", "blocks")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Warps:
    """n warps; the last one may not be full.

    Attributes:
      quads: in each warp.
      pixels: lanes that cover a pixel; the others are helpers, or idle in the last warp.
      triangles: different triangles in each warp, whose attributes it has to hold.
      warp_size: lanes.
    """

    quads: Int[Array, " n"]
    pixels: Int[Array, " n"]
    triangles: Int[Array, " n"]
    warp_size: int = field(metadata={"static": True})

    @property
    def utilisation(self) -> Float[Array, " n"]:
        """Part of the lanes that cover a pixel."""
        return self.pixels / self.warp_size


def pack_quads(triangle_id: Int[Array, " q"], mask: Int[Array, " q"], *, warp_size: int = 32) -> Warps:
    """Fills warps with quads as they come, `warp_size` / 4 to each.

    Where a shader or its state changes, a warp is sent off before it is full: pack each batch by itself.

    Args:
      triangle_id, mask: of `quads.Quads`, in API order.
    """
    check_one_of("warp_size", warp_size, WARP_SIZES)
    size = warp_size // 4
    used = _in_warps(jnp.ones_like(mask), size)
    ids = _in_warps(triangle_id + 1, size)
    same = ids[:, :, None] == ids[:, None, :]
    earlier = jnp.tril(jnp.ones((size, size), bool), k=-1)
    first = ~(same & earlier[None]).any(axis=2) & (used > 0)
    return Warps(
        quads=jnp.sum(used, axis=1), pixels=jnp.sum(_in_warps(num_pixels(mask), size), axis=1),
        triangles=jnp.sum(first, axis=1, dtype=mask.dtype), warp_size=warp_size,
    )  # fmt: skip


def _in_warps(values: Shaped[Array, "q *c"], size: int) -> Shaped[Array, "n size *c"]:
    """Rows of `size`; the last one is filled up with zeros."""
    padding = [(0, -len(values) % size), *((0, 0) for _ in values.shape[1:])]
    return jnp.pad(values, padding).reshape(-1, size, *values.shape[1:])


# --- Which pixel runs in which lane


def screen_lanes(values: Shaped[Array, "h w"], *, warp_size: int = 32, order: str = "rows") -> Shaped[Array, "n lanes"]:
    """Pixels of a full-screen pass by warp and lane; lanes outside the image hold 0.

    Args:
      order: "rows", quads row by row, so that a warp of 32 is a strip of 16 x 2 pixels; or "blocks", a warp of 32 is
        8 x 4 pixels and one of 64 is 8 x 8.
    """
    check_one_of("warp_size", warp_size, WARP_SIZES)
    check_one_of("order", order, ORDERS)
    size = warp_size // 4
    down = 2 ** ((size.bit_length() - 1) // 2) if order == "blocks" else 1
    across = size // down if order == "blocks" else 1
    h, w = values.shape
    whole = jnp.pad(values, ((0, -h % (2 * down)), (0, -w % (2 * across))))
    rows, columns = whole.shape[0] // (2 * down), whole.shape[1] // (2 * across)
    blocks = whole.reshape(rows, down, 2, columns, across, 2).transpose(0, 3, 1, 4, 2, 5)
    return _in_warps(blocks.reshape(-1, 4), size).reshape(-1, warp_size)


def quad_lanes(
    values: Shaped[Array, "h w"], row: Int[Array, " q"], column: Int[Array, " q"], *, warp_size: int = 32
) -> Shaped[Array, "n lanes"]:
    """Pixels of quads as `pack_quads` packs them, helpers included; lanes outside the image hold 0."""
    check_one_of("warp_size", warp_size, WARP_SIZES)
    lane = jnp.arange(4, dtype=row.dtype)[None]
    at = 2 * row[:, None] + lane // 2, 2 * column[:, None] + lane % 2
    pixels = values.at[at].get(mode="fill", fill_value=0)
    return _in_warps(pixels, warp_size // 4).reshape(-1, warp_size)


def covered_lanes(mask: Int[Array, " q"], *, warp_size: int = 32) -> Bool[Array, "n lanes"]:
    """Which lanes of packed quads cover a pixel."""
    check_one_of("warp_size", warp_size, WARP_SIZES)
    bits = mask[:, None] >> jnp.arange(4, dtype=mask.dtype)[None] & 1
    return _in_warps(bits > 0, warp_size // 4).reshape(-1, warp_size)


# --- What lockstep costs


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WarpCost:
    """Turns of lanes, by warp.

    Attributes:
      useful: of lanes that had work of their own.
      paid: of all lanes, while the warp ran.
    """

    useful: Num[Array, " n"]
    paid: Num[Array, " n"]

    @property
    def efficiency(self) -> Float[Array, ""]:
        """Useful part of all that is paid; 1 if nothing is."""
        useful, paid = (jnp.sum(turns.astype(float)) for turns in (self.useful, self.paid))
        return jnp.where(paid > 0.0, useful, 1.0) / jnp.where(paid > 0.0, paid, 1.0)


def loop_cost(trip_counts: Num[Array, "n lanes"], covered: Bool[Array, "n lanes"]) -> WarpCost:
    """A loop in warps of any origin: each runs as long as its longest lane, helpers included.

    Args:
      trip_counts: of each lane, >= 0.
      covered: lanes whose result is kept; only their turns are useful.
    """
    check_same_shape("trip_counts and covered", trip_counts, covered)
    useful = jnp.sum(jnp.where(covered, trip_counts, jnp.zeros_like(trip_counts)), axis=1, dtype=trip_counts.dtype)
    return WarpCost(useful=useful, paid=jnp.max(trip_counts, axis=1) * trip_counts.shape[1])


def warp_cost(trip_counts: Num[Array, "h w"], *, warp_size: int = 32, order: str = "rows") -> WarpCost:
    """A loop of so many turns in each pixel of a full-screen pass.

    Args:
      trip_counts: >= 0, in turns or in any unit of time. Lanes outside the image have none, but are paid.
      order: as in `screen_lanes`.
    """
    lanes = screen_lanes(trip_counts, warp_size=warp_size, order=order)
    return loop_cost(lanes, jnp.ones(lanes.shape, bool))


def branch_cost(
    taken: Bool[Array, "h w"],
    *,
    then_cost: float = 1.0,
    else_cost: float = 1.0,
    warp_size: int = 32,
    order: str = "rows",
) -> WarpCost:
    """An if in a full-screen pass: a warp pays for each side that one of its pixels takes.

    Args:
      then_cost, else_cost: of the two sides, >= 0.
      order: as in `screen_lanes`.
    """
    sides = ((taken, then_cost), (~taken, else_cost))
    one, other = (warp_cost(s.astype(float) * c, warp_size=warp_size, order=order) for s, c in sides)
    return WarpCost(useful=one.useful + other.useful, paid=one.paid + other.paid)


# --- Several rasterisers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RasterBalance:
    """Work of rasterisers that share an image.

    Attributes:
      work: of each.
      imbalance: the most over the mean: how much longer than need be the image takes. 1 if there is no work.
    """

    work: Float[Array, " r"]
    imbalance: Float[Array, ""]


def raster_owners(height: int, width: int, *, num_rasters: int = 4, tile_size: int = 16) -> Int[Array, "h w"]:
    """The rasteriser that owns each pixel: tiles in turn along a row, every other row shifted by half the turn.

    So two form a checkerboard, and of four no two tiles that touch belong to the same one.

    Args:
      tile_size: in pixels, as height and width are.
    """
    check_at_least("num_rasters", num_rasters, 1)
    check_at_least("tile_size", tile_size, 1)
    row = jnp.arange(height, dtype=jnp.int32)[:, None] // tile_size
    column = jnp.arange(width, dtype=jnp.int32)[None] // tile_size
    return (column + row % 2 * (num_rasters // 2)) % num_rasters


def raster_balance(work: Float[Array, "h w"], *, num_rasters: int = 4, tile_size: int = 16) -> RasterBalance:
    """How evenly the work of an image falls on rasterisers that own interleaved tiles.

    Args:
      work: >= 0, say the overdraw of each pixel or quad.
      tile_size: in pixels of `work`.
    """
    owners = raster_owners(*work.shape, num_rasters=num_rasters, tile_size=tile_size)
    mine = owners[None] == jnp.arange(num_rasters, dtype=owners.dtype)[:, None, None]
    each = jnp.sum(jnp.where(mine, work[None], jnp.zeros_like(work)[None]), axis=(1, 2))
    mean = jnp.mean(each)
    some = mean > 0.0
    one = jnp.ones_like(mean)
    return RasterBalance(work=each, imbalance=jnp.where(some, jnp.max(each), one) / jnp.where(some, mean, one))
