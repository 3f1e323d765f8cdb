"""Triangles -> Fragments: which triangle each sample of the image sees, where on it, and how deep.

The rules are those of Direct3D 11: corners snapped to 8 sub-pixel bits, exact edge functions, the top-left rule,
depth interpolated linearly on the screen, nearest depth wins and the first triangle wins a tie. Coverage, triangle
ids and depth order have no gradient; barycentrics have one (`interpolate.differentiable_barycentrics`).
"""

import functools
import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_last_axis
from jaxrender.deferred.bands import in_bands
from jaxrender.deferred.binning import (
    TileGrid,
    pairs,
    rows_of_triangles,
    sort_pairs,
    spans,
    tile_grid,
    tile_lists,
    total,
)
from jaxrender.deferred.clipping import clip_triangles, sort_out
from jaxrender.deferred.coverage import Lanes, barycentrics_at, set_up_pairs, set_up_triangles
from jaxrender.deferred.fill import Plan, Work, fill_strip
from jaxrender.deferred.samples import CENTER, Samples
from jaxrender.deferred.triangles import ScreenTriangles, project_triangles
from jaxrender.machine import num_cores

# Tiles of a strip, and those worked on in lockstep: what a core's cache holds.
TILES_PER_STRIP, TILES_PER_CHUNK = 2048, 128

# A point to the right of any picture, in place of a mesh without triangles.
_ASIDE = np.array([[4.0, 0.0, 0.0, 1.0]])


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
    tiles_per_chunk: int = TILES_PER_CHUNK,
) -> tuple[Fragments, Demand]:
    """The pure form, for `jit` and `vmap`: fixed capacity, and the demand beside the result.

    Args as in `rasterize`, but for indices out of range: such triangles are skipped. If the demand exceeds the budget,
    some triangles are missing from the image.
    """
    if not len(faces):
        clip, faces = jnp.asarray(_ASIDE, clip.dtype), jnp.zeros((1, 3), faces.dtype)
    if not height * width:
        one, demand = rasterize_within(clip, faces, budget, height=1, width=1, samples=samples, cull=cull)
        return _nothing(height, width, faces, one.triangles, samples), jax.tree.map(jnp.zeros_like, demand)
    grid, pattern = tile_grid(height, width, samples)
    h, w = grid.height, grid.width
    in_range = ((faces >= 0) & (faces < len(clip))).all(axis=1)
    known = jnp.where(in_range[:, None], faces, 0)
    room = [max(limit, 1) for limit in (budget.max_clipped, budget.max_spans, budget.max_pairs)]
    clipped, num_clipped = clip_triangles(clip, known, height=h, width=w, max_clipped=room[0])
    triangles = project_triangles(clipped, height=h, width=w, cull=cull, drawn=in_range)
    first_row, num_rows = rows_of_triangles(triangles, grid, pattern)
    runs = spans(triangles, grid, pattern, first_row=first_row, num_rows=num_rows, max_spans=room[1])
    tile, triangle = pairs(runs, max_pairs=room[2], num_tiles=grid.count)
    tile, triangle = sort_pairs(tile, triangle)
    plan = _plan(grid, pattern, samples, tiles_per_chunk, TILES_PER_STRIP)
    work = _work(triangles, tile, triangle, grid, pattern)
    fill = lambda i: _resolve(triangles.source, work, *fill_strip(work, i, plan), plan, samples)  # noqa: E731
    strips = jax.lax.map(fill, jnp.arange(plan.num_strips, dtype=jnp.int32))
    images = {name: values.reshape(-1, *values.shape[2:])[:height] for name, values in strips.items()}
    fragments = Fragments(**images, faces=faces, triangles=triangles, samples=samples)
    return fragments, Demand(num_clipped, total(num_rows), total(runs.count))


def _nothing(height: int, width: int, faces, triangles: ScreenTriangles, samples: Samples) -> Fragments:
    """An image without pixels."""
    shape = height, width, samples.count
    none, zero = jnp.full(shape, -1, jnp.int32), jnp.zeros(shape, jnp.float32)
    return Fragments(none, none, jnp.zeros((*shape, 2), jnp.float32), zero, zero, faces, triangles, samples)


def _plan(grid: TileGrid, pattern: Samples, samples: Samples, tiles_per_chunk: int, tiles_per_strip: int) -> Plan:
    """Strips of whole rows of tiles that are whole rows of pixels as well."""
    step = samples.grid // math.gcd(samples.grid, grid.size)
    rows = max(1, round(tiles_per_strip / grid.columns / step)) * step
    return Plan(grid, pattern, rows, tiles_per_chunk)


def _work(
    triangles: ScreenTriangles, tile: Int[Array, " p"], triangle: Int[Array, " p"], grid: TileGrid, pattern: Samples
) -> Work:
    """The pairs, sorted by tile, set up for the depth test."""
    lanes = Lanes.of(grid.size, pattern)
    pairs = set_up_pairs(triangles, tile, triangle, grid, lanes)
    return Work(set_up_triangles(triangles, lanes), pairs, tile_lists(tile, num_tiles=grid.count))


def _resolve(
    source: Int[Array, " n"], work: Work, pair: Int[Array, "r c s"], depth: Float[Array, "r c s"], plan: Plan,
    samples: Samples,
) -> dict[str, Array]:  # fmt: skip
    """The images of `Fragments` from the pairs that a strip's samples see.

    By cells -> by pixels: an ordered grid has m x m cells a pixel.
    """
    m, s, width = samples.grid, len(samples.offsets), plan.grid.width // samples.grid
    image = lambda v: v[:, : plan.grid.width].reshape(-1, m, width, m, s).swapaxes(1, 2).reshape(-1, width, m * m * s)  # noqa: E731
    lanes = Lanes.of(plan.grid.size, plan.pattern)
    shape = plan.grid.size, plan.grid.size, s
    x, y = (np.tile(v.reshape(shape), (plan.rows_per_strip, plan.grid.columns, 1)) for v in (lanes.x, lanes.y))
    pair, depth, x, y = image(pair), image(depth), image(x), image(y)
    own, some = jnp.maximum(pair, 0), pair >= 0
    screen_id = work.pairs.triangle[own]
    barycentrics, w = barycentrics_at(
        work.pairs.planes[own], work.triangles.planes[screen_id], *(jnp.asarray(v, depth.dtype) for v in (x, y))
    )
    return {
        "triangle_id": jnp.where(some, source[screen_id], -1),
        "screen_id": jnp.where(some, screen_id, -1),
        "barycentrics": jnp.where(some[..., None], barycentrics, 0.0),
        "depth": jnp.where(some, depth, 1.0),
        "w": jnp.where(some, w, 0.0),
    }


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
    Raises:
      ValueError: if an index is out of range, or the image is too large.
    References:
      Direct3D 11 functional specification, sections 3.4 and 15; Giesen, "A Trip Through the Graphics Pipeline", part 8.
    """
    triangles = screen_triangles(
        clip, faces, height=height, width=width, samples=samples, cull=cull, drawn=drawn, two_sided=two_sided
    )
    return rasterize_triangles(triangles, faces, height=height, width=width, samples=samples)


def screen_triangles(
    clip: Float[Array, "v 4"],
    faces: Int[Array, "t 3"],
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    cull: str = "none",
    drawn: Bool[Array, " t"] | None = None,
    two_sided: Bool[Array, " t"] | None = None,
) -> ScreenTriangles:
    """The first half of `rasterize`: clipped, projected and snapped; for several passes over the same triangles."""
    check_last_axis("clip", clip, 4)
    check_last_axis("faces", faces, 3)
    _check_indices(faces, len(clip))
    if not len(faces):
        clip, faces, drawn, two_sided = jnp.asarray(_ASIDE, jnp.float32), jnp.zeros((1, 3), jnp.int32), None, None
    # An image without pixels still has its triangles.
    grid, _ = tile_grid(max(height, 1), max(width, 1), samples)
    clip, faces = jnp.asarray(clip, jnp.float32), jnp.asarray(faces, jnp.int32)
    room = room_for(int(_count_clipped(clip, faces, height=grid.height, width=grid.width)))
    masks = {"drawn": drawn, "two_sided": two_sided}
    return _set_up(clip, faces, masks, height=grid.height, width=grid.width, cull=cull, max_clipped=room)


def rasterize_triangles(
    triangles: ScreenTriangles, faces: Int[Array, "t 3"], *, height: int, width: int, samples: Samples = CENTER
) -> Fragments:
    """The second half of `rasterize`, for triangles of `screen_triangles` with the same sizes and samples."""
    grid, pattern = tile_grid(height, width, samples)
    faces = jnp.asarray(faces, jnp.int32)
    if not grid.count:
        return _nothing(height, width, faces, triangles, samples)
    work = bin_triangles(triangles, grid, pattern)
    # On a processor several strips are under way at once; on another device the whole image is one.
    on_cpu = jax.default_backend() == "cpu"
    if on_cpu:
        # As many strips as keep all cores busy to the end.
        num_strips = -(-grid.count // (TILES_PER_STRIP * num_cores())) * num_cores()
        plan = _plan(grid, pattern, samples, TILES_PER_CHUNK, -(-grid.count // num_strips))
    else:
        plan = _plan(grid, pattern, samples, 16384, grid.count)
    rows = plan.rows_per_strip * grid.size // samples.grid

    def fill(start: int) -> dict[str, Array]:
        # Two programs: as one, XLA would repeat the depth test's last steps for each of the images.
        pair, depth = _fill(work, np.int32(start // rows), plan)
        return _resolve_jit(triangles.source, work, pair, depth, plan, samples)

    images = in_bands(fill, range(0, height, rows), height=height)
    return Fragments(**images, faces=faces, triangles=triangles, samples=samples)


def tile_pairs(
    triangles: ScreenTriangles, grid: TileGrid, pattern: Samples
) -> tuple[Int[Array, " p"], Int[Array, " p"]]:
    """Tile and triangle of all pairs that may touch, in drawing order; unused ones, at the end, name grid.count."""
    first_row, num_rows, num_spans = _rows(triangles, grid, pattern)
    runs, num_pairs = _spans(triangles, grid, pattern, first_row, num_rows, max_spans=room_for(int(num_spans)))
    return _pairs(runs, max_pairs=room_for(int(num_pairs)), num_tiles=grid.count)


def bin_triangles(triangles: ScreenTriangles, grid: TileGrid, pattern: Samples) -> Work:
    """Pairs of tile and triangle, as many as there are, sorted by tile."""
    tile, triangle = _sorted_pairs(*tile_pairs(triangles, grid, pattern), grid.count)
    return _work_jit(triangles, tile, triangle, grid, pattern)


def _check_indices(faces: Int[Array, "t 3"], num_vertices: int) -> None:
    if len(faces):
        low, high = int(faces.min()), int(faces.max())
        if low < 0 or high >= num_vertices:
            raise ValueError(f"faces: expected indices from 0 to {num_vertices - 1}, got {low} to {high}")


def room_for(count: int) -> int:
    """At least `count`, in steps of a quarter or less or of 256: frames of a film compile few different programs.

    Raises:
      ValueError: if `count` is beyond int32.
    """
    if count >= np.iinfo(np.int32).max:
        raise ValueError("triangles: expected fewer than 2^31 pairs of triangle and tile, got more: draw fewer at once")
    step = max(256, 1 << max(count.bit_length() - 3, 0))
    return -(-max(count, 1) // step) * step


@functools.partial(jax.jit, static_argnames=("height", "width"))
def _count_clipped(clip, faces, *, height, width):
    return jnp.sum(sort_out(clip, faces, height=height, width=width)[1])


@functools.partial(jax.jit, static_argnames=("height", "width", "cull", "max_clipped"))
def _set_up(clip, faces, masks, *, height, width, cull, max_clipped):
    clipped, _ = clip_triangles(clip, faces, height=height, width=width, max_clipped=max_clipped)
    return project_triangles(clipped, height=height, width=width, cull=cull, **masks)


@functools.partial(jax.jit, static_argnames=("grid", "pattern"))
def _rows(triangles, grid, pattern):
    first_row, num_rows = rows_of_triangles(triangles, grid, pattern)
    return first_row, num_rows, total(num_rows)


@functools.partial(jax.jit, static_argnames=("grid", "pattern", "max_spans"))
def _spans(triangles, grid, pattern, first_row, num_rows, *, max_spans):
    runs = spans(triangles, grid, pattern, first_row=first_row, num_rows=num_rows, max_spans=max_spans)
    return runs, total(runs.count)


_pairs = jax.jit(pairs, static_argnames=("max_pairs", "num_tiles"))
_sort_pairs = jax.jit(sort_pairs)
_work_jit = jax.jit(_work, static_argnames=("grid", "pattern"))
_fill = jax.jit(fill_strip, static_argnames="plan")
_resolve_jit = jax.jit(_resolve, static_argnames=("plan", "samples"))


def _sorted_pairs(
    tile: Int[Array, " p"], triangle: Int[Array, " p"], num_tiles: int
) -> tuple[Int[Array, " p"], Int[Array, " p"]]:
    """`sort_pairs`; on a CPU by NumPy's radix sort of 16-bit keys, which is ten times faster than XLA's sort."""
    if jax.default_backend() != "cpu":
        return _sort_pairs(tile, triangle)
    keys = np.asarray(tile)
    order = np.argsort((keys & 0xFFFF).astype(np.uint16), kind="stable")
    if num_tiles >= 1 << 16:
        order = order[np.argsort((keys[order] >> 16).astype(np.uint16), kind="stable")]
    return jnp.asarray(keys[order]), jnp.asarray(np.asarray(triangle)[order])
