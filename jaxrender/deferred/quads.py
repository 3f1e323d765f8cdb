"""2x2 quads of pixels: derivatives by differences, helper lanes, and what shading whole quads costs.

Quads are aligned to even pixel coordinates. In an ordered grid of m x m samples they are the quads of the image m times
as large, as supersampling by a larger target shades them; in a multisample pattern, of the pixels. Lanes are numbered
0 upper left, 1 upper right, 2 lower left, 3 lower right.

What is counted here has no gradient; derivatives of values are linear in the values.

References:
  Giesen, "A Trip Through the Graphics Pipeline", part 8; Direct3D 11 functional specification, 16.8 (derivatives).
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrender.checks import check_at_least, check_same_shape
from jaxrender.deferred.binning import TileGrid
from jaxrender.deferred.coverage import Lanes, TriangleRows, cover, set_up_pairs, set_up_triangles
from jaxrender.deferred.interpolate import blend, sample_places, weights_at
from jaxrender.deferred.raster import Fragments, tile_pairs
from jaxrender.deferred.samples import Samples
from jaxrender.deferred.triangles import SUBPIXELS, ScreenTriangles
from jaxrender.metrics import heatmap

# --- Derivatives


def ddx(values: Float[Array, "h w *c"], *, fine: bool = True) -> Float[Array, "h w *c"]:
    """Right minus left pixel of the quad, per pixel to the right.

    It differs between whatever the two pixels hold: at a silhouette that mixes two triangles (`quad_derivatives` does
    not). In an image of odd width the last column has no neighbour in its quad; the helper outside repeats it, and the
    derivative is 0.

    Args:
      fine: each row of the quad has its own difference; otherwise both have that of the top row.
    """
    quads = _in_quads(values)
    across = quads[:, :, :, 1:] - quads[:, :, :, :1]
    across = across if fine else across[:, :1]
    return _in_rows(jnp.broadcast_to(across, quads.shape))[: values.shape[0], : values.shape[1]]


def ddy(values: Float[Array, "h w *c"], *, fine: bool = True) -> Float[Array, "h w *c"]:
    """Lower minus upper pixel of the quad, per pixel downwards; the rest as in `ddx`.

    Args:
      fine: each column of the quad has its own difference; otherwise both have that of the left column.
    """
    quads = _in_quads(values)
    down = quads[:, 1:] - quads[:, :1]
    down = down if fine else down[:, :, :, :1]
    return _in_rows(jnp.broadcast_to(down, quads.shape))[: values.shape[0], : values.shape[1]]


def _in_quads(values: Float[Array, "h w *c"]) -> Float[Array, "rows 2 columns 2 *c"]:
    """By row of quads, row in the quad, column of quads, column in the quad; odd sizes repeat their edge."""
    h, w, *rest = values.shape
    even = jnp.pad(values, ((0, h % 2), (0, w % 2), *((0, 0) for _ in rest)), mode="edge")
    return even.reshape((h + 1) // 2, 2, (w + 1) // 2, 2, *rest)


def _in_rows(quads: Float[Array, "rows 2 columns 2 *c"]) -> Float[Array, "h w *c"]:
    rows, _, columns, _, *rest = quads.shape
    return quads.reshape(2 * rows, 2 * columns, *rest)


def quad_derivatives(
    fragments: Fragments, attributes: Float[Array, "v c"], *, mode: str = "perspective", fine: bool = True
) -> tuple[Float[Array, "h w s c"], Float[Array, "h w s c"]]:
    """d/dx and d/dy, per pixel to the right and downwards, as a shader of each sample's own triangle gets them.

    Pixels of the quad that the triangle does not cover are its helper lanes: its attributes are extrapolated there, so
    that triangles do not mix at silhouettes, nor at the border of an odd image. Samples are compared with those of the
    same index. 0 where a sample is empty. A helper lane beyond a triangle's horizon (w <= 0) gives a wild difference,
    as it does on hardware; `interpolate.attribute_gradients` is the exact derivative.

    Differentiable in the attributes. Their values are exact; differences carry some 1e-7 of them as rounding.

    Args:
      mode: as in `interpolate`; derivatives of flat attributes are 0.
      fine: as in `ddx` and `ddy`.
    """
    h, w, _ = fragments.triangle_id.shape
    m = fragments.samples.grid
    x, y = sample_places(fragments)
    left, top = _first_of_quad(x, w * m), _first_of_quad(y, h * m)
    row, column = (y, x) if fine else (top, left)
    at = lambda x, y: weights_at(fragments, x, y, mode=mode)  # noqa: E731
    across = at(left + SUBPIXELS, row) - at(left, row)
    down = at(column, top + SUBPIXELS) - at(column, top)
    some = fragments.coverage[..., None]
    slopes = (jnp.where(some, float(m) * step, jnp.zeros_like(step)) for step in (across, down))
    dx, dy = (blend(fragments, attributes, slope) for slope in slopes)
    return dx, dy


def _first_of_quad(place: Int[Array, "h w s"], size: int) -> Int[Array, "h w s"]:
    """The same place in the left (upper) pixel of the quad, along an axis of `size` pixels."""
    pixel = (place + size * SUBPIXELS // 2) // SUBPIXELS
    return place - pixel % 2 * SUBPIXELS


# --- The quads that are shaded


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Quads:
    """Quads of single triangles, in the order in which they are handed to the shader.

    Attributes:
      triangle_id: of the mesh.
      screen_id: of the screen triangle; a triangle cut by the near plane is several, and each has its own quads.
      row, column: place, in quads.
      mask: the pixels the triangle covers, 1 to 15: lane i is bit i. The other lanes are helpers.
      rows, columns: quads of the image.
    """

    triangle_id: Int[Array, " q"]
    screen_id: Int[Array, " q"]
    row: Int[Array, " q"]
    column: Int[Array, " q"]
    mask: Int[Array, " q"]
    rows: int = field(metadata={"static": True})
    columns: int = field(metadata={"static": True})


# Pairs of triangle and tile that are looked at together.
_CHUNK = 4096


def quad_coverage(fragments: Fragments) -> Quads:
    """All quads that the triangles of an image touch, whether they end up in front or not.

    That is what a forward shader without any early depth test runs: every covered pixel of every triangle between the
    near and far plane. A pixel counts as covered if one of its samples is. Triangles come in API order; the quads of
    one triangle tile by tile, and row by row in a tile.

    Not for use inside `jit`: the result is as long as there are quads. Memory is bounded by that number; triangles and
    tiles are looked at in chunks.
    """
    h, w, s = fragments.triangle_id.shape
    if not (h and w and s):
        none = jnp.zeros(0, jnp.int32)
        return Quads(none, none, none, none, none, rows=(h + 1) // 2, columns=(w + 1) // 2)
    m, pattern = fragments.samples.grid, Samples(offsets=fragments.samples.offsets)
    grid = TileGrid(h * m, w * m, 16 if pattern.count == 1 else 8)
    tile, triangle = (np.asarray(v) for v in tile_pairs(fragments.triangles, grid, pattern))
    tile, triangle = tile[tile < grid.count], triangle[tile < grid.count]
    rows = _triangle_rows(fragments.triangles, grid, pattern)
    half, found = grid.size // 2, []
    for start in range(0, len(tile), _CHUNK):
        t, k = (np.pad(v[start : start + _CHUNK], (0, max(start + _CHUNK - len(v), 0))) for v in (tile, triangle))
        masks = np.asarray(_quad_masks_jit(fragments.triangles, rows, t, k, grid, pattern))[: len(tile) - start]
        pair, quad = np.nonzero(masks)
        row, column = t[pair] // grid.columns * half + quad // half, t[pair] % grid.columns * half + quad % half
        found.append(np.stack([k[pair], row, column, masks[pair, quad]]).astype(np.int32))
    screen_id, row, column, mask = jnp.asarray(np.concatenate([np.zeros((4, 0), np.int32), *found], axis=1))
    return Quads(
        triangle_id=fragments.triangles.source[screen_id], screen_id=screen_id, row=row, column=column, mask=mask,
        rows=(grid.height + 1) // 2, columns=(grid.width + 1) // 2,
    )  # fmt: skip


def _quad_masks(
    triangles: ScreenTriangles, rows: TriangleRows, tile: Int[Array, " p"], triangle: Int[Array, " p"],
    grid: TileGrid, pattern: Samples,
) -> Int[Array, "p q"]:  # fmt: skip
    """Masks (as in `Quads`) of the quads of a tile, row by row, for p pairs of a tile and a triangle.

    Pixels outside the image are not covered.
    """
    half = grid.size // 2
    lanes = Lanes.of(grid.size, pattern)
    pairs = set_up_pairs(triangles, tile, triangle, grid, lanes)
    inside, _ = cover(pairs, rows, jnp.arange(len(tile), dtype=jnp.int32), lanes)
    pixels = inside.reshape(-1, grid.size, grid.size, len(pattern.offsets)).any(axis=-1)
    steps = jnp.arange(grid.size, dtype=jnp.int32)[None]
    in_rows = (tile // grid.columns * grid.size)[:, None] + steps < grid.height
    in_columns = (tile % grid.columns * grid.size)[:, None] + steps < grid.width
    pixels &= in_rows[:, :, None] & in_columns[:, None, :]
    quads = pixels.reshape(-1, half, 2, half, 2).astype(jnp.int32)
    lane_bits = np.array([[1, 2], [4, 8]], np.int32).reshape(1, 1, 2, 1, 2)
    return jnp.sum(quads * lane_bits, axis=(2, 4)).reshape(-1, half * half)


_triangle_rows = jax.jit(
    lambda triangles, grid, pattern: set_up_triangles(triangles, Lanes.of(grid.size, pattern)),
    static_argnames=("grid", "pattern"),
)
_quad_masks_jit = jax.jit(_quad_masks, static_argnames=("grid", "pattern"))


def visible_quads(fragments: Fragments, quads: Quads) -> Quads:
    """What is left of the quads of an image when each lane has to be visible: after a perfect early depth test.

    So many quads a shader runs after a depth pre-pass, or a deferred one that keeps triangles apart. Not for use inside
    `jit`: quads of which nothing is visible are dropped.

    Args:
      quads: of `quad_coverage(fragments)`.
    """
    seen = np.asarray(visible_masks(fragments, quads))
    (kept,) = np.nonzero(seen)
    some = jax.tree.map(lambda values: values[kept], quads)
    return Quads(
        some.triangle_id, some.screen_id, some.row, some.column, jnp.asarray(seen[kept]),
        rows=quads.rows, columns=quads.columns,
    )  # fmt: skip


def visible_masks(fragments: Fragments, quads: Quads) -> Int[Array, " q"]:
    """The masks of the quads, less the lanes of which no sample is visible; 0 to 15."""
    h, w, s = fragments.triangle_id.shape
    m = fragments.samples.grid
    cells = fragments.screen_id.reshape(h, w, m, m, s // m**2).swapaxes(1, 2).reshape(h * m, w * m, s // m**2)
    mask = jnp.zeros_like(quads.mask)
    for lane in range(4):
        at = 2 * quads.row + lane // 2, 2 * quads.column + lane % 2
        ids = cells.at[at].get(mode="fill", fill_value=-1)
        mask += (ids == quads.screen_id[:, None]).any(axis=-1).astype(mask.dtype) << lane
    return mask & quads.mask


# --- Statistics


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class QuadStatistics:
    """Work by triangle of the mesh.

    Attributes:
      pixels: covered.
      quads: touched; four lanes are shaded for each.
    """

    pixels: Int[Array, " t"]
    quads: Int[Array, " t"]


def num_pixels(mask: Int[Array, "*b"]) -> Int[Array, "*b"]:
    """Covered pixels of a quad, 0 to 4."""
    return (mask & 1) + (mask >> 1 & 1) + (mask >> 2 & 1) + (mask >> 3 & 1)


def quad_statistics(triangle_id: Int[Array, " q"], mask: Int[Array, " q"], *, num_triangles: int) -> QuadStatistics:
    """Pixels and quads of each triangle; quads with an empty mask do not count.

    Args:
      triangle_id, mask: of `Quads`.
      num_triangles: of the mesh.
    """
    count = lambda values: jnp.zeros(num_triangles, jnp.int32).at[triangle_id].add(values.astype(jnp.int32))  # noqa: E731
    return QuadStatistics(pixels=count(num_pixels(mask)), quads=count(mask > 0))


def helper_share(pixels: Int[Array, "*b"], quads: Int[Array, "*b"]) -> Float[Array, "*b"]:
    """Part of the shaded lanes that are helpers, 1 - pixels / (4·quads), in [0, 3/4]; 0 where nothing is shaded."""
    check_same_shape("pixels and quads", pixels, quads)
    lanes = 4.0 * jnp.maximum(quads, 1).astype(float)
    return jnp.where(quads > 0, 1.0 - pixels.astype(float) / lanes, jnp.zeros_like(lanes))


def helper_share_by_size(
    pixels: Int[Array, " t"], quads: Int[Array, " t"], *, num_sizes: int = 12
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """Share of helper lanes among triangles of like size, and how many triangles there are of it.

    Size k holds triangles of 2^k to 2^(k+1) - 1 covered pixels, the last one all that are larger. Triangles without a
    pixel are left out. The document's 25-75 % is that of quads on edges: 3/4 for triangles of a pixel, and next to
    nothing for large ones.

    Args:
      pixels, quads: of `QuadStatistics`.
    """
    check_at_least("num_sizes", num_sizes, 1)
    limits = jnp.asarray(2 ** np.arange(num_sizes), pixels.dtype)
    size = jnp.sum(pixels[:, None] >= limits[None], axis=1) - 1
    total = lambda v: jnp.zeros(num_sizes, v.dtype).at[jnp.where(size < 0, num_sizes, size)].add(v, mode="drop")  # noqa: E731
    return helper_share(total(pixels), total(quads)), total(jnp.ones_like(pixels))


def quad_overdraw(
    row: Int[Array, " q"], column: Int[Array, " q"], *, rows: int, columns: int
) -> Int[Array, "rows columns"]:
    """How many quads were shaded at each place, from the fields of `Quads`."""
    return jnp.zeros((rows, columns), jnp.int32).at[row, column].add(1)


def draw_overdraw(overdraw: Int[Array, "rows columns"], *, high: float | None = None) -> Float[Array, "h w 3"]:
    """Heat map of quads shaded, two pixels to a quad; black for none, pale yellow for `high` (the most, if None)."""
    pixels = jnp.repeat(jnp.repeat(overdraw, 2, axis=0), 2, axis=1)
    return heatmap(pixels.astype(float), high=high)
