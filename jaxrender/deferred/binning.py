"""Screen triangles -> for every tile of the image, the list of triangles that may touch it.

A triangle is cut into the rows of tiles it crosses, a row into the tiles between the ends of the triangle's part in
it. Both are conservative by a quarter of a pixel; exact coverage is decided sample by sample.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxrender.checks import check_at_least
from jaxrender.deferred.clipping import GUARD_PX
from jaxrender.deferred.samples import Samples
from jaxrender.deferred.triangles import SUBPIXELS, ScreenTriangles

# In snapped units; far more than float32 loses on an edge within ±2²¹ units.
_MARGIN = 64.0


@dataclass(frozen=True)
class TileGrid:
    """Tiles of `size` x `size` pixels over an image, row by row."""

    height: int
    width: int
    size: int

    @property
    def rows(self) -> int:
        return -(-self.height // self.size)

    @property
    def columns(self) -> int:
        return -(-self.width // self.size)

    @property
    def count(self) -> int:
        return self.rows * self.columns

    def corner(self, tile: Int[Array, "*b"]) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
        """Upper left corner (x, y) of a tile, in snapped units from the middle of the image."""
        x, y = tile % self.columns * self.size, tile // self.columns * self.size
        return x * SUBPIXELS - self.width * SUBPIXELS // 2, y * SUBPIXELS - self.height * SUBPIXELS // 2


def tile_grid(height: int, width: int, samples: Samples) -> tuple[TileGrid, Samples]:
    """Tiles over the sample cells of an image, and the pattern in a cell: an ordered grid is a larger image.

    A tile has 256 lanes, or a little more or less.
    """
    check_at_least("height", height, 0)
    check_at_least("width", width, 0)
    h, w, count = height * samples.grid, width * samples.grid, len(samples.offsets)
    if max(h, w) > 2 * (GUARD_PX - 1):
        raise ValueError(f"height, width: expected at most {2 * (GUARD_PX - 1)} samples a side, got {h} x {w}")
    return TileGrid(h, w, 16 if count == 1 else 8 if count <= 4 else 4), Samples(offsets=samples.offsets)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spans:
    """Runs of tiles: `count` tiles from `first` on, in row `row`, of `triangle`. Unused entries have count 0."""

    triangle: Int[Array, " r"]
    first: Int[Array, " r"]
    count: Int[Array, " r"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TileLists:
    """Where the pairs of each tile are, among pairs sorted by tile: from start[i] on, count[i] of them."""

    start: Int[Array, " tiles"]
    count: Int[Array, " tiles"]


def rows_of_triangles(
    triangles: ScreenTriangles, grid: TileGrid, samples: Samples
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """First row of tiles and number of rows (0 if its box holds no sample) of each triangle, in drawing order."""
    low, high = _sample_range(triangles.xy, grid, samples)
    first, last = low[:, 1] // grid.size, high[:, 1] // grid.size
    some = triangles.valid & (high >= low).all(axis=1)
    return first[triangles.order], jnp.where(some, last - first + 1, 0)[triangles.order]


def _sample_range(xy: Int[Array, "n 3 2"], grid: TileGrid, samples: Samples):
    """First and last pixel (x, y), inside the image, with a sample within the box of each triangle."""
    size = np.array([grid.width, grid.height])
    offsets = np.array(samples.offsets) * (SUBPIXELS // 16) + SUBPIXELS // 2
    to_corner = (size * SUBPIXELS // 2).astype(np.int32)
    smallest, largest = xy.min(axis=1) + to_corner[None], xy.max(axis=1) + to_corner[None]
    low = -((offsets.max(axis=0).astype(np.int32)[None] - smallest) // SUBPIXELS)
    high = (largest - offsets.min(axis=0).astype(np.int32)[None]) // SUBPIXELS
    return jnp.maximum(low, 0), jnp.minimum(high, (size - 1).astype(np.int32)[None])


def spans(
    triangles: ScreenTriangles,
    grid: TileGrid,
    samples: Samples,
    *,
    first_row: Int[Array, " n"],
    num_rows: Int[Array, " n"],
    max_spans: int,
) -> Spans:
    """The run of tiles of each triangle in each of its rows; at most `max_spans` of them."""
    item, step, used = _expand(num_rows, max_spans)
    triangle, row = triangles.order[item], first_row[item] + step
    top = (row * (grid.size * SUBPIXELS) - grid.height * SUBPIXELS // 2).astype(jnp.float32) - _MARGIN
    bottom = top + (grid.size * SUBPIXELS + 2.0 * _MARGIN)
    left, right = _extent(triangles.xy[triangle].astype(jnp.float32), top[:, None], bottom[:, None])
    low, high = _sample_range(triangles.xy[triangle], grid, samples)
    shift, unit = grid.width * SUBPIXELS / 2, grid.size * SUBPIXELS
    tile_of = lambda x: jnp.floor((x + shift) / unit).astype(jnp.int32)  # noqa: E731
    start = jnp.maximum(tile_of(left - _MARGIN), low[:, 0] // grid.size)
    end = jnp.minimum(tile_of(right + _MARGIN), high[:, 0] // grid.size)
    count = jnp.where(used, jnp.maximum(end - start + 1, 0), 0)
    return Spans(triangle=triangle, first=row * grid.columns + start, count=count)


def _extent(xy, top, bottom):
    """Smallest and largest x of each triangle between two horizontal lines; empty (+∞, -∞) if it is not there."""
    start, end = xy, jnp.roll(xy, -1, axis=1)
    dy = end[..., 1] - start[..., 1]
    slope = (end[..., 0] - start[..., 0]) / jnp.where(dy == 0.0, 1.0, dy)
    # Each edge from where it enters the strip to where it leaves it; a horizontal edge is one of its ends twice.
    y_low = jnp.maximum(jnp.minimum(start[..., 1], end[..., 1]), top)
    y_high = jnp.minimum(jnp.maximum(start[..., 1], end[..., 1]), bottom)
    crosses, flat = y_low <= y_high, dy == 0.0
    x_a = jnp.where(flat, start[..., 0], start[..., 0] + slope * (y_low - start[..., 1]))
    x_b = jnp.where(flat, end[..., 0], start[..., 0] + slope * (y_high - start[..., 1]))
    left = jnp.where(crosses, jnp.minimum(x_a, x_b), jnp.inf).min(axis=1)
    right = jnp.where(crosses, jnp.maximum(x_a, x_b), -jnp.inf).max(axis=1)
    return left, right


def pairs(runs: Spans, *, max_pairs: int, num_tiles: int) -> tuple[Int[Array, " p"], Int[Array, " p"]]:
    """Tile and triangle of each pair, in order of the triangles; unused pairs name tile `num_tiles`."""
    run, step, used = _expand(runs.count, max_pairs)
    tile = jnp.where(used, runs.first[run] + step, num_tiles)
    return tile, runs.triangle[run]


def sort_pairs(tile: Int[Array, " p"], triangle: Int[Array, " p"]) -> tuple[Int[Array, " p"], Int[Array, " p"]]:
    """The pairs by tile; within a tile the triangles keep their order."""
    order = jnp.argsort(tile, stable=True)
    return tile[order], triangle[order]


def tile_lists(tile: Int[Array, " p"], *, num_tiles: int) -> TileLists:
    """Where each tile's pairs begin once they are sorted; they need not be sorted here."""
    count = jnp.zeros(num_tiles, jnp.int32).at[tile].add(1, mode="drop")
    return TileLists(start=jnp.cumsum(count) - count, count=count)


def total(counts: Int[Array, " n"]) -> Int[Array, ""]:
    """The sum, or the greatest int32 where it is larger than that."""
    most = np.iinfo(np.int32).max
    roughly = jnp.sum(counts.astype(jnp.float32))
    return jnp.where(roughly < 0.99 * most, jnp.sum(counts, dtype=jnp.int32), most)


def _expand(counts: Int[Array, " n"], size: int):
    """`counts[i]` entries for each i: which i, the number within it, and whether the entry is used."""
    ends = jnp.cumsum(counts)
    item = jnp.repeat(jnp.arange(len(counts), dtype=jnp.int32), counts, total_repeat_length=size)
    at = jnp.arange(size, dtype=jnp.int32)
    return item, at - (ends - counts)[item], at < ends[-1]
