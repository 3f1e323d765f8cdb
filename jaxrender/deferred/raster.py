"""Triangles -> Fragments: which triangle each sample of the image sees, where on it, and how deep.

The rules are those of Direct3D 11: corners snapped to 8 sub-pixel bits, exact edge functions, the top-left rule,
depth interpolated linearly on the screen, nearest depth wins and the first triangle wins a tie. Coverage, triangle
ids and depth order have no gradient; barycentrics have one (`interpolate.barycentrics`).

Tiles are worked on in lockstep: a chunk of tiles, of about equally long lists, takes its first triangles, then its
second ones, and so on. All samples of a tile are lanes of one vector, and nothing is scattered.
"""

import dataclasses
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
    project_triangles,
)
from jaxrender.machine import num_cores
from jaxrender.vecmath import safe_div


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
        """Whether something was left out for want of room."""
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
    plan = _plan(grid, pattern, tiles_per_chunk)
    cells = fill_strips(triangles, lists, jnp.arange(plan.num_strips), plan)
    fragments = _assemble(faces, triangles, cells, plan, samples)
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


@dataclass(frozen=True)
class _Plan:
    """How the image is cut: strips of rows of tiles, in which chunks of tiles are worked on in lockstep.

    A strip is small enough for a processor's cache, and holds enough tiles to sort them by the length of their lists.
    """

    grid: TileGrid
    pattern: Samples
    rows_per_strip: int
    tiles_per_chunk: int

    @property
    def num_strips(self) -> int:
        return -(-self.grid.rows // self.rows_per_strip)

    @property
    def tiles_per_strip(self) -> int:
        return self.rows_per_strip * self.grid.columns


def _plan(grid: TileGrid, pattern: Samples, tiles_per_chunk: int, *, tiles_per_strip: int = 2048) -> _Plan:
    return _Plan(grid, pattern, max(1, tiles_per_strip // max(grid.columns, 1)), tiles_per_chunk)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cells:
    """The fields of `Fragments` over the cells of an image: rows, columns, samples of the pattern."""

    triangle_id: Int[Array, "*b s"]
    screen_id: Int[Array, "*b s"]
    barycentrics: Float[Array, "*b s 2"]
    depth: Float[Array, "*b s"]
    w: Float[Array, "*b s"]


def fill_strips(
    triangles: ScreenTriangles,
    lists: TileLists,
    strips: Int[Array, " k"],
    plan: _Plan,
    *,
    beyond: Float[Array, "rows columns s"] | None = None,
) -> Cells:
    """Runs the depth test over some strips of the image; cells (k, rows, columns, s).

    Args:
      beyond: of every cell of all strips, the depth that a sample has to be deeper than.
    """
    lanes, planes = _Lanes.of(plan.grid, plan.pattern), _planes(triangles)
    return jax.lax.map(lambda strip: _fill_strip(triangles, planes, lists, strip, plan, lanes, beyond), strips)


def _fill_strip(
    triangles, planes, lists: TileLists, strip: Int[Array, ""], plan: _Plan, lanes: "_Lanes", beyond
) -> Cells:
    """One strip: its tiles in order of their work, chunk by chunk, and back in their places."""
    n, chunk = plan.tiles_per_strip, plan.tiles_per_chunk
    tile = strip * n + jnp.arange(n, dtype=jnp.int32)
    tile = jnp.where(tile < plan.grid.count, tile, -1)
    order = jnp.argsort(-jnp.where(tile >= 0, lists.count[tile], 0), stable=True)
    chunks = jnp.concatenate([tile[order], jnp.full(-n % chunk, -1, jnp.int32)]).reshape(-1, chunk)
    size, s = plan.grid.size, len(plan.pattern.offsets)
    limits = jnp.zeros((n, 1), jnp.float32)
    if beyond is not None:
        rows = plan.rows_per_strip * size
        own = jax.lax.dynamic_slice_in_dim(beyond, strip * rows, rows)
        own = own.reshape(plan.rows_per_strip, size, plan.grid.columns, size, s).swapaxes(1, 2)
        limits = own.reshape(n, size * size * s)[order]
    limits = jnp.pad(limits, ((0, -n % chunk), (0, 0))).reshape(*chunks.shape, -1)
    fill = lambda own: _fill_chunk(  # noqa: E731
        triangles, planes, lists, own[0], own[1], plan.grid, lanes, beyond is not None
    )
    filled = jax.lax.map(fill, (chunks, limits))
    place = jnp.zeros(n, jnp.int32).at[order].set(jnp.arange(n, dtype=jnp.int32))

    def put(values: Array) -> Array:
        rest = values.shape[3:]
        tiles = values.reshape(-1, *values.shape[2:])[place]
        rows = tiles.reshape(plan.rows_per_strip, plan.grid.columns, size, size, s, *rest).swapaxes(1, 2)
        return rows.reshape(plan.rows_per_strip * size, plan.grid.columns * size, s, *rest)

    return jax.tree.map(put, filled)


def _planes(triangles: ScreenTriangles) -> Float[Array, "n 3 4"]:
    """What is linear on the screen, at the corners: window depth, 1/w, and b_1/w and b_2/w of the source triangle."""
    over_w = safe_div(jnp.ones_like(triangles.w), triangles.w)
    weights = triangles.weights[..., 1:] * over_w[..., None]
    return jnp.concatenate([triangles.z[..., None], over_w[..., None], weights], axis=-1)


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
    triangles, planes, lists: TileLists, tile: Int[Array, " n"], limits, grid: TileGrid, lanes: _Lanes, limited: bool
) -> Cells:
    """The triangles of each tile's list, one after another, for n tiles side by side; cells (n, lanes)."""
    x, y = (corner + lanes.base for corner in grid.corner(tile))
    start, count = lists.start[tile], jnp.where(tile >= 0, lists.count[tile], 0)
    zero = jnp.zeros((len(tile), len(lanes.x)), jnp.float32)

    def step(state):
        turn, winner, depth, held = state
        active = turn < count
        triangle = lists.triangles[jnp.where(active, start + turn, 0)]
        inside, z, values = _cover(triangles, planes, triangle, x, y, lanes)
        # The far plane belongs to the picture; lists are in drawing order, so that the first one keeps a tie.
        wins = inside & active[:, None] & (z > limits if limited else z >= 0.0) & (z <= 1.0) & (z < depth)
        held = [jnp.where(wins, new, old) for new, old in zip(values, held, strict=True)]
        return turn + 1, jnp.where(wins, triangle[:, None], winner), jnp.where(wins, z, depth), held

    empty = jnp.int32(0), jnp.full(zero.shape, -1, jnp.int32), zero + 2.0, [zero + 1.0, zero, zero]
    _, winner, depth, (over_w, b1, b2) = jax.lax.while_loop(lambda state: state[0] < jnp.max(count), step, empty)
    covered = winner >= 0
    barycentrics = jnp.clip(jnp.stack([b1, b2], axis=-1) / over_w[..., None], 0.0, 1.0)
    return Cells(
        triangle_id=jnp.where(covered, triangles.source[winner], -1),
        screen_id=winner,
        barycentrics=barycentrics,
        depth=jnp.where(covered, depth, 1.0),
        w=jnp.where(covered, 1.0 / over_w, 0.0),
    )


def _cover(triangles, planes, triangle: Int[Array, " n"], x: Int[Array, " n"], y: Int[Array, " n"], lanes: _Lanes):
    """Whether the samples of each tile lie in its triangle; its depth there, and the other three planes."""
    area, corners = triangles.area[triangle], planes[triangle]
    c, dx, dy, value = edges(triangles.xy[triangle], x, y, unit=lanes.unit)
    # The sign bit of the three together is set as soon as one is negative.
    sign = functools.reduce(
        jnp.bitwise_or,
        (c[:, k, None] + dx[:, k, None] * lanes.y[None] - dy[:, k, None] * lanes.x[None] for k in range(3)),
    )
    # Corner k lies opposite to edge k+1. Values at the tile come from exact edge functions, so that a plane is as
    # good far from the corners as near to them; from there on it is 16 pixels at most.
    weights, to_right, down = (
        jnp.roll(v, -1, axis=1)[..., None] / area[:, None, None]
        for v in (value, -lanes.unit * dy.astype(area.dtype), lanes.unit * dx.astype(area.dtype))
    )
    here, slope_x, slope_y = (jnp.sum(v * corners, axis=1) for v in (weights, to_right, down))
    along_x, along_y = (steps.astype(np.float32)[None] for steps in (lanes.x, lanes.y))
    z, *rest = (here[:, k, None] + slope_x[:, k, None] * along_x + slope_y[:, k, None] * along_y for k in range(4))
    # On a sliver the plane may be steep beyond float32; no point of a triangle is deeper than its corners.
    z = jnp.clip(z, corners[:, :, 0].min(axis=1)[:, None], corners[:, :, 0].max(axis=1)[:, None])
    return sign >= 0, z, rest


def _assemble(
    faces: Int[Array, "t 3"], triangles: ScreenTriangles, cells: Cells, plan: _Plan, samples: Samples
) -> Fragments:
    """Strips of cells (k, rows, columns, s) -> pixels; an ordered grid has m x m cells a pixel."""
    m, h, w = samples.grid, plan.grid.height // samples.grid, plan.grid.width // samples.grid
    s = len(samples.offsets)

    def image(values: Array) -> Array:
        rest = values.shape[4:]
        rows = values.shape[0] * values.shape[1]
        whole = values.reshape(rows, *values.shape[2:])[: plan.grid.height, : plan.grid.width]
        pixels = whole.reshape(h, m, w, m, s, *rest).swapaxes(1, 2)
        return pixels.reshape(h, w, m * m * s, *rest)

    own = jax.tree.map(image, cells)
    return Fragments(
        triangle_id=own.triangle_id, screen_id=own.screen_id, barycentrics=own.barycentrics, depth=own.depth, w=own.w,
        faces=faces, triangles=triangles, samples=samples,
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
    drawn: Bool[Array, " t"] | None = None,
    two_sided: Bool[Array, " t"] | None = None,
    beyond: Float[Array, "h w s"] | None = None,
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
      drawn: which triangles to draw; all by default.
      two_sided: triangles that are never culled.
      beyond: window depth that a sample has to be deeper than: with the depth of one picture the next layer behind it.
    Raises:
      ValueError: if an index is out of range, or the image is too large.
    References:
      Direct3D 11 functional specification, sections 3.4 and 15; Giesen, "A Trip Through the Graphics Pipeline", part 8.
    """
    check_last_axis("clip", clip, 4)
    check_last_axis("faces", faces, 3)
    _check_indices(faces, len(clip))
    h, w, grid, pattern = _frame(height, width, samples)
    if not (h and w):
        one = rasterize(clip, faces, height=1, width=1, samples=samples)
        crop = lambda name: getattr(one, name)[:0].reshape(height, width, *getattr(one, name).shape[2:])  # noqa: E731
        fields = ("triangle_id", "screen_id", "barycentrics", "depth", "w")
        return dataclasses.replace(one, **{name: crop(name) for name in fields})
    if not len(faces):
        clip, faces, drawn, two_sided = jnp.zeros((1, 4), jnp.float32), jnp.zeros((1, 3), jnp.int32), None, None
    clip, faces = jnp.asarray(clip, jnp.float32), jnp.asarray(faces, jnp.int32)
    room = _room(int(_count_clipped(clip, faces, height=h, width=w)))
    masks = {"drawn": drawn, "two_sided": two_sided}
    triangles, first_row, num_rows, total = _set_up(clip, faces, grid, pattern, masks, cull=cull, max_clipped=room)
    runs, total = _spans(triangles, grid, pattern, first_row, num_rows, max_spans=_room(int(total)))
    tile, triangle = _pairs(runs, max_pairs=_room(int(total)), num_tiles=grid.count)
    lists = _sorted_lists(tile, triangle, grid.count)
    # On a processor several strips are under way at once; on another device the whole image is one.
    on_cpu = jax.default_backend() == "cpu"
    plan = _plan(grid, pattern, 128) if on_cpu else _plan(grid, pattern, 16384, tiles_per_strip=grid.count)
    parts = (
        np.array_split(np.arange(plan.num_strips), max(1, min(plan.num_strips, 4 * num_cores()))) if on_cpu else [[0]]
    )
    limits = None if beyond is None else _cells_of(beyond, plan, samples)
    fill = lambda own: jax.block_until_ready(  # noqa: E731
        _fill(triangles, lists, jnp.asarray(own, jnp.int32), plan, beyond=limits)
    )
    with ThreadPoolExecutor(num_cores() if on_cpu else 1) as threads:
        filled = list(threads.map(fill, parts))
    cells = jax.tree.map(lambda *values: jnp.concatenate(values), *filled)
    return _assemble_jit(faces, triangles, cells, plan, samples)


@functools.partial(jax.jit, static_argnames=("plan", "samples"))
def _cells_of(image: Float[Array, "h w s"], plan: _Plan, samples: Samples) -> Float[Array, "rows columns s"]:
    """The reverse of `_assemble`: an image by pixels -> by cells, filled up to whole strips."""
    (h, w, _), m, s = image.shape, samples.grid, len(samples.offsets)
    cells = image.reshape(h, w, m, m, s).swapaxes(1, 2).reshape(h * m, w * m, s)
    size = plan.grid.size
    rows, columns = plan.num_strips * plan.rows_per_strip * size, plan.grid.columns * size
    return jnp.pad(cells, ((0, rows - h * m), (0, columns - w * m), (0, 0)))


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
def _set_up(clip, faces, grid, pattern, masks, *, cull, max_clipped):
    clipped, _ = clip_triangles(clip, faces, height=grid.height, width=grid.width, max_clipped=max_clipped)
    triangles = project_triangles(clipped, height=grid.height, width=grid.width, cull=cull, **masks)
    first_row, num_rows = rows_of_triangles(triangles, grid, pattern)
    return triangles, first_row, num_rows, jnp.sum(num_rows)


@functools.partial(jax.jit, static_argnames=("grid", "pattern", "max_spans"))
def _spans(triangles, grid, pattern, first_row, num_rows, *, max_spans):
    runs = spans(triangles, grid, pattern, first_row=first_row, num_rows=num_rows, max_spans=max_spans)
    return runs, jnp.sum(runs.count)


_pairs = jax.jit(pairs, static_argnames=("max_pairs", "num_tiles"))
_sort_pairs = jax.jit(sort_pairs, static_argnames="num_tiles")
_tile_lists = jax.jit(tile_lists, static_argnames="num_tiles")
_fill = jax.jit(fill_strips, static_argnames="plan")
_assemble_jit = jax.jit(_assemble, static_argnames=("plan", "samples"))


def _sorted_lists(tile: Int[Array, " p"], triangle: Int[Array, " p"], num_tiles: int) -> TileLists:
    """`sort_pairs`; on a CPU by NumPy's radix sort of 16-bit keys, which is ten times faster than XLA's sort."""
    if jax.default_backend() != "cpu":
        return _sort_pairs(tile, triangle, num_tiles=num_tiles)
    keys = np.asarray(tile)
    order = np.argsort((keys & 0xFFFF).astype(np.uint16), kind="stable")
    if num_tiles >= 1 << 16:
        order = order[np.argsort((keys[order] >> 16).astype(np.uint16), kind="stable")]
    return _tile_lists(tile, jnp.asarray(np.asarray(triangle)[order]), num_tiles=num_tiles)
