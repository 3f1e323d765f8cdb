"""Triangles -> Fragments: which triangle each sample of the image sees, where on it, and how deep.

The rules are those of Direct3D 11: corners snapped to 8 sub-pixel bits, exact edge functions, the top-left rule,
depth interpolated linearly on the screen, nearest depth wins and the first triangle wins a tie. Coverage, triangle
ids and depth order have no gradient; barycentrics have one (`interpolate.barycentrics`).

Tiles are worked on in lockstep: a chunk of tiles, of about equally long lists, takes its first triangles, then its
second ones, and so on. All samples of a tile are lanes of one vector, and nothing is scattered.
"""

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_at_least, check_last_axis
from jaxrender.deferred.binning import (
    TileGrid,
    TileLists,
    pairs,
    rows_of_triangles,
    sort_pairs,
    spans,
    tile_lists,
)
from jaxrender.deferred.clipping import GUARD_PX, clip_triangles, sort_out
from jaxrender.deferred.samples import CENTER, Samples
from jaxrender.deferred.triangles import (
    SUBPIXELS,
    ScreenTriangles,
    edges,
    perspective_weights,
    project_triangles,
    screen_barycentrics,
)
from jaxrender.machine import num_cores


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fragments:
    """What each sample of an image sees.

    Attributes:
      triangle_id: of the mesh; -1 where the sample is empty.
      screen_id: row of `triangles`; the same, unless the triangle was cut by the near plane or the guard band.
      barycentrics: perspective-correct weights of corners 1 and 2 of the triangle (corner 0 has the rest).
      depth: window depth z/w in [0, 1]; 1 where empty.
      w: clip w, for a perspective camera the linear view depth; 0 where empty.
      faces: of the mesh, as given.
      triangles: the screen triangles the samples were taken of.
      samples: where the pixels were sampled.
    """

    triangle_id: Int[Array, "h w s"]
    screen_id: Int[Array, "h w s"]
    barycentrics: Float[Array, "h w s 2"]
    depth: Float[Array, "h w s"]
    w: Float[Array, "h w s"]
    faces: Int[Array, "t 3"]
    triangles: ScreenTriangles
    samples: Samples = field(metadata={"static": True})

    @property
    def coverage(self) -> Bool[Array, "h w s"]:
        """Which samples are covered."""
        return self.triangle_id >= 0


@dataclass(frozen=True)
class Budget:
    """Room for the work of one image: triangles to cut, runs of tiles, pairs of tile and triangle."""

    max_clipped: int
    max_spans: int
    max_pairs: int


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Demand:
    """What an image would have needed, in the units of `Budget`. More than the budget means that work was dropped."""

    clipped: Int[Array, ""]
    spans: Int[Array, ""]
    pairs: Int[Array, ""]

    def exceeds(self, budget: Budget) -> Bool[Array, ""]:
        return (self.clipped > budget.max_clipped) | (self.spans > budget.max_spans) | (self.pairs > budget.max_pairs)


def rasterize_within(
    clip: Float[Array, "v 4"],
    faces: Int[Array, "t 3"],
    budget: Budget,
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    cull: str = "none",
    tiles_per_chunk: int = 128,
) -> tuple[Fragments, Demand]:
    """The pure form, for `jit` and `vmap`: fixed capacity, and the demand beside the result.

    Args as in `rasterize`. If the demand exceeds the budget, some triangles are missing from the image.
    """
    h, w, grid, pattern = _frame(height, width, samples)
    clipped, num_clipped = clip_triangles(clip, faces, height=h, width=w, max_clipped=budget.max_clipped)
    triangles = project_triangles(clipped, height=h, width=w, cull=cull)
    first_row, num_rows = rows_of_triangles(triangles, grid, pattern)
    runs = spans(triangles, grid, pattern, first_row=first_row, num_rows=num_rows, max_spans=budget.max_spans)
    tile, triangle = pairs(runs, max_pairs=budget.max_pairs, num_tiles=grid.count)
    lists = sort_pairs(tile, triangle, num_tiles=grid.count)
    order = _tiles_by_work(lists.count, tiles_per_chunk)
    tiles = fill_tiles(triangles, lists, order, grid, pattern)
    fragments = _assemble(faces, triangles, order, tiles, grid, samples)
    return fragments, Demand(num_clipped, jnp.sum(num_rows), jnp.sum(runs.count))


def _frame(height: int, width: int, samples: Samples):
    """Size in sample cells, tiles over it, and the pattern within a cell; an ordered grid is a larger image."""
    check_at_least("height", height, 0)
    check_at_least("width", width, 0)
    h, w = height * samples.grid, width * samples.grid
    if max(h, w) > 2 * (GUARD_PX - 1):
        raise ValueError(f"height, width: expected at most {2 * (GUARD_PX - 1)} samples a side, got {h} x {w}")
    pattern = Samples(offsets=samples.offsets)
    return h, w, TileGrid(h, w, _tile_size(len(samples.offsets))), pattern


def _tile_size(num_offsets: int) -> int:
    """256 lanes a tile, or a little more or less."""
    return 16 if num_offsets == 1 else 8 if num_offsets <= 4 else 4


def _tiles_by_work(count: Int[Array, " tiles"], tiles_per_chunk: int) -> Int[Array, "chunks n"]:
    """Tiles with the longest lists first, in chunks; filled up with tile -1."""
    padding = -len(count) % tiles_per_chunk
    order = jnp.argsort(-count, stable=True).astype(jnp.int32)
    return jnp.concatenate([order, jnp.full(padding, -1, jnp.int32)]).reshape(-1, tiles_per_chunk)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TileSamples:
    """The fields of `Fragments` by tile; lanes run over rows, columns and samples of the tile's pixels."""

    screen_id: Int[Array, "chunks n lanes"]
    barycentrics: Float[Array, "chunks n lanes 2"]
    depth: Float[Array, "chunks n lanes"]
    w: Float[Array, "chunks n lanes"]


def fill_tiles(
    triangles: ScreenTriangles, lists: TileLists, order: Int[Array, "chunks n"], grid: TileGrid, pattern: Samples
) -> TileSamples:
    """Runs the depth test of all tiles named in `order`, chunk by chunk."""
    lanes = _Lanes.of(grid, pattern)
    return jax.lax.map(lambda tile: _fill_chunk(triangles, lists, tile, grid, lanes), order)


@dataclass(frozen=True)
class _Lanes:
    """Sample positions in a tile: base + unit·(x, y) snapped units from its corner."""

    base: int
    unit: int
    x: Int[np.ndarray, " lanes"]
    y: Int[np.ndarray, " lanes"]

    @classmethod
    def of(cls, grid: TileGrid, pattern: Samples) -> "_Lanes":
        row, column, sample = np.meshgrid(
            np.arange(grid.size), np.arange(grid.size), np.arange(len(pattern.offsets)), indexing="ij"
        )
        if pattern.offsets == ((0, 0),):
            return cls(SUBPIXELS // 2, SUBPIXELS, column.ravel().astype(np.int32), row.ravel().astype(np.int32))
        dx, dy = np.array(pattern.offsets)[sample.ravel()].T
        x, y = 16 * column.ravel() + 8 + dx, 16 * row.ravel() + 8 + dy
        return cls(0, SUBPIXELS // 16, x.astype(np.int32), y.astype(np.int32))


def _fill_chunk(
    triangles: ScreenTriangles, lists: TileLists, tile: Int[Array, " n"], grid: TileGrid, lanes: _Lanes
) -> TileSamples:
    """The triangles of each tile's list, one after another, for n tiles side by side."""
    x, y = (corner + lanes.base for corner in grid.corner(tile))
    start, count = lists.start[tile], jnp.where(tile >= 0, lists.count[tile], 0)
    shape = (len(tile), len(lanes.x))

    def step(state):
        turn, depth, winner = state
        active = turn < count
        triangle = lists.triangles[jnp.where(active, start + turn, 0)]
        inside, z = _cover(triangles, triangle, x, y, lanes)
        # The far plane belongs to the picture; lists are in drawing order, so that the first one keeps a tie.
        wins = inside & active[:, None] & (z >= 0.0) & (z <= 1.0) & (z < depth)
        return turn + 1, jnp.where(wins, z, depth), jnp.where(wins, triangle[:, None], winner)

    empty = jnp.int32(0), jnp.full(shape, 2.0, jnp.float32), jnp.full(shape, -1, jnp.int32)
    _, depth, winner = jax.lax.while_loop(lambda state: state[0] < jnp.max(count), step, empty)
    return _finish(triangles, winner, depth, x, y, lanes)


def _cover(triangles: ScreenTriangles, triangle: Int[Array, " n"], x, y, lanes: _Lanes):
    """Whether the samples of each tile lie in its triangle, and the triangle's depth there."""
    xy, z, area = triangles.xy[triangle], triangles.z[triangle], triangles.area[triangle]
    c, dx, dy = edges(xy, x, y, unit=lanes.unit)
    # The sign bit of the three together is set as soon as one is negative.
    sign = functools.reduce(
        jnp.bitwise_or,
        (c[:, k, None] + dx[:, k, None] * lanes.y[None] - dy[:, k, None] * lanes.x[None] for k in range(3)),
    )
    corners = xy.astype(z.dtype)
    a, b, za, zb = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], z[:, 1] - z[:, 0], z[:, 2] - z[:, 0]
    slope_x, slope_y = (za * b[:, 1] - zb * a[:, 1]) / area, (zb * a[:, 0] - za * b[:, 0]) / area
    here = z[:, 0] + slope_x * (x.astype(z.dtype) - corners[:, 0, 0]) + slope_y * (y.astype(z.dtype) - corners[:, 0, 1])
    along_x, along_y = (lanes.unit * steps.astype(np.float32)[None] for steps in (lanes.x, lanes.y))
    depth = here[:, None] + slope_x[:, None] * along_x + slope_y[:, None] * along_y
    # On a sliver the plane may be steep beyond float32; no point of a triangle is deeper than its corners.
    return sign >= 0, jnp.clip(depth, z.min(axis=1)[:, None], z.max(axis=1)[:, None])


def _finish(triangles: ScreenTriangles, winner, depth, x, y, lanes: _Lanes) -> TileSamples:
    """Barycentrics and w of the samples that something covers."""
    covered = winner >= 0
    row = jnp.where(covered, winner, 0)
    px, py = x[:, None] + lanes.unit * lanes.x[None], y[:, None] + lanes.unit * lanes.y[None]
    screen = screen_barycentrics(triangles.xy[row], triangles.area[row], px, py)
    weights, w = perspective_weights(screen, triangles.w[row], triangles.weights[row])
    return TileSamples(
        screen_id=winner,
        barycentrics=jnp.where(covered[..., None], weights[..., 1:], 0.0),
        depth=jnp.where(covered, depth, 1.0),
        w=jnp.where(covered, w, 0.0),
    )


def _assemble(
    faces: Int[Array, "t 3"],
    triangles: ScreenTriangles,
    order: Int[Array, "chunks n"],
    tiles: TileSamples,
    grid: TileGrid,
    samples: Samples,
) -> Fragments:
    """Puts the tiles in their places."""
    size, s = grid.size, len(samples.offsets)
    at = jnp.where(order >= 0, order, grid.count).reshape(-1)
    m, h, w = samples.grid, grid.height // samples.grid, grid.width // samples.grid

    def image(values: Array) -> Array:
        rest = values.shape[3:]
        flat = values.reshape(-1, size, size, s, *rest)
        placed = jnp.zeros((grid.count, *flat.shape[1:]), flat.dtype).at[at].set(flat, mode="drop", unique_indices=True)
        rows = placed.reshape(grid.rows, grid.columns, size, size, s, *rest).swapaxes(1, 2)
        cells = rows.reshape(grid.rows * size, grid.columns * size, s, *rest)[: grid.height, : grid.width]
        pixels = cells.reshape(h, m, w, m, s, *rest).swapaxes(1, 2)
        return pixels.reshape(h, w, m * m * s, *rest)

    screen_id = image(tiles.screen_id)
    source = jnp.where(screen_id >= 0, triangles.source[screen_id], -1)
    return Fragments(
        triangle_id=source, screen_id=screen_id, barycentrics=image(tiles.barycentrics), depth=image(tiles.depth),
        w=image(tiles.w), faces=faces, triangles=triangles, samples=samples,
    )  # fmt: skip


# --- The driver: counts first, then gives each stage the room it needs


def rasterize(
    clip: Float[Array, "v 4"],
    faces: Int[Array, "t 3"],
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    cull: str = "none",
) -> Fragments:
    """Which triangle each sample of an image sees.

    Not for use inside `jit`: it counts the work first and gives it the room it needs. `rasterize_within` is the pure
    form. Triangles with corners that are not finite are skipped.

    Args:
      clip: clip-space positions, z in [0, w] (Direct3D, Vulkan, WebGPU). y is up.
      faces: corner indices; counter-clockwise is the front.
      height, width: in pixels; at most 16382 samples a side.
      samples: one in the centre, `ordered_grid(m)` or `standard_pattern(n)`.
      cull: "none", "back" or "front".
    Raises:
      ValueError: if an index is out of range, or the image is too large.
    References:
      Direct3D 11 functional specification, sections 3.4 and 15; Giesen, "A Trip Through the Graphics Pipeline", part 8.
    """
    check_last_axis("clip", clip, 4)
    check_last_axis("faces", faces, 3)
    _check_indices(faces, len(clip))
    h, w, grid, pattern = _frame(height, width, samples)
    if not (h and w and len(faces)):
        faces = jnp.zeros((1, 3), jnp.int32)
        clip = jnp.zeros((1, 4), jnp.float32)
    clip, faces = jnp.asarray(clip, jnp.float32), jnp.asarray(faces, jnp.int32)
    room = _room(int(_count_clipped(clip, faces, height=h, width=w)))
    triangles, first_row, num_rows, total = _set_up(clip, faces, grid, pattern, cull=cull, max_clipped=room)
    runs, total = _spans(triangles, grid, pattern, first_row, num_rows, max_spans=_room(int(total)))
    tile, triangle = _pairs(runs, max_pairs=_room(int(total)), num_tiles=grid.count)
    lists = _sorted_lists(tile, triangle, grid.count)
    on_cpu = jax.default_backend() == "cpu"
    order = np.asarray(_tiles_by_work(lists.count, 128 if on_cpu else 16384))
    parts = num_cores() if on_cpu else 1
    orders = [order[part::parts] for part in range(parts)]
    fill = lambda own: jax.block_until_ready(_fill(triangles, lists, own, grid, pattern))  # noqa: E731
    with ThreadPoolExecutor(parts) as threads:
        filled = list(threads.map(fill, orders))
    tiles = jax.tree.map(lambda *values: jnp.concatenate(values), *filled)
    return _assemble_jit(faces, triangles, jnp.concatenate([jnp.asarray(own) for own in orders]), tiles, grid, samples)


def _check_indices(faces: Int[Array, "t 3"], num_vertices: int) -> None:
    if len(faces):
        low, high = int(faces.min()), int(faces.max())
        if low < 0 or high >= num_vertices:
            raise ValueError(f"faces: expected indices from 0 to {num_vertices - 1}, got {low} to {high}")


def _room(count: int) -> int:
    """At least `count`, in steps of an eighth or less, so that few different programs are compiled."""
    step = 1 << max(count.bit_length() - 4, 0)
    return -(-max(count, 1) // step) * step


@functools.partial(jax.jit, static_argnames=("height", "width"))
def _count_clipped(clip, faces, *, height, width):
    return jnp.sum(sort_out(clip[faces], height=height, width=width)[1])


@functools.partial(jax.jit, static_argnames=("grid", "pattern", "cull", "max_clipped"))
def _set_up(clip, faces, grid, pattern, *, cull, max_clipped):
    clipped, _ = clip_triangles(clip, faces, height=grid.height, width=grid.width, max_clipped=max_clipped)
    triangles = project_triangles(clipped, height=grid.height, width=grid.width, cull=cull)
    first_row, num_rows = rows_of_triangles(triangles, grid, pattern)
    return triangles, first_row, num_rows, jnp.sum(num_rows)


@functools.partial(jax.jit, static_argnames=("grid", "pattern", "max_spans"))
def _spans(triangles, grid, pattern, first_row, num_rows, *, max_spans):
    runs = spans(triangles, grid, pattern, first_row=first_row, num_rows=num_rows, max_spans=max_spans)
    return runs, jnp.sum(runs.count)


_pairs = jax.jit(pairs, static_argnames=("max_pairs", "num_tiles"))
_sort_pairs = jax.jit(sort_pairs, static_argnames="num_tiles")
_tile_lists = jax.jit(tile_lists, static_argnames="num_tiles")
_fill = jax.jit(fill_tiles, static_argnames=("grid", "pattern"))
_assemble_jit = jax.jit(_assemble, static_argnames=("grid", "samples"))


def _sorted_lists(tile: Int[Array, " p"], triangle: Int[Array, " p"], num_tiles: int) -> TileLists:
    """`sort_pairs`; on a CPU by NumPy's radix sort of 16-bit keys, which is ten times faster than XLA's sort."""
    if jax.default_backend() != "cpu":
        return _sort_pairs(tile, triangle, num_tiles=num_tiles)
    keys = np.asarray(tile)
    order = np.argsort((keys & 0xFFFF).astype(np.uint16), kind="stable")
    if num_tiles >= 1 << 16:
        order = order[np.argsort((keys[order] >> 16).astype(np.uint16), kind="stable")]
    return _tile_lists(tile, jnp.asarray(np.asarray(triangle)[order]), num_tiles=num_tiles)
