"""Triangles whose shader has a say in what is seen: it discards fragments, writes coverage, or another depth.

Their depth test comes after the shader (late). All their fragments that the rest of the picture does not hide are
listed, the shader looks at the list, and `resolve` keeps the nearest. The list is as long as there are fragments, so
that looking through many layers of leaves costs no more passes than one.

What is seen has no gradient.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.deferred.binning import TileGrid, tile_grid
from jaxrender.deferred.coverage import Lanes, barycentrics_at, cover, depth_at
from jaxrender.deferred.fill import Work
from jaxrender.deferred.raster import Fragments, bin_triangles, room_for
from jaxrender.deferred.samples import Samples
from jaxrender.deferred.triangles import ScreenTriangles
from jaxrender.machine import on_all_cores

# Pairs of tile and triangle, and fragments, that are looked at together.
_PAIRS_PER_CHUNK, _FRAGMENTS_PER_BLOCK = 4096, 1 << 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FragmentList:
    """n samples of triangles, whether they end up in front or not. Unused entries have triangle -1.

    Attributes:
      place: of the sample in an image (h, w, s), counted through.
      triangle_id, screen_id, barycentrics, depth, w: as in `Fragments`.
    """

    place: Int[Array, " n"]
    triangle_id: Int[Array, " n"]
    screen_id: Int[Array, " n"]
    barycentrics: Float[Array, "n 2"]
    depth: Float[Array, " n"]
    w: Float[Array, " n"]


#: Which fragments of a list are kept, and the window depth of each.
Shader = Callable[[FragmentList], tuple[Bool[Array, " n"], Float[Array, " n"]]]


def draw_late(fragments: Fragments, triangles: ScreenTriangles, shader: Shader) -> Fragments:
    """Draws more triangles into a picture, each of their fragments only if the shader says so.

    Not for use inside `jit`.

    Args:
      fragments: of `rasterize_triangles`: what was drawn early.
      triangles: of the same `screen_triangles`, with other ones valid.
      shader: a compiled function; fragments that it does not keep, or puts outside [0, 1], are dropped. It sees all
        that the early ones do not hide by the triangle's own depth: if it brings any nearer, draw nothing early. It
        is called from several threads.
    """
    height, width, _ = fragments.triangle_id.shape
    if not fragments.triangle_id.size:
        return fragments
    grid, pattern = tile_grid(height, width, fragments.samples)
    work = bin_triangles(triangles, grid, pattern)
    found = _candidates(fragments, work, grid, pattern)
    block = min(_FRAGMENTS_PER_BLOCK, room_for(len(found[0])))

    def look(start: int) -> FragmentList:
        own = (_padded(values[start : start + block], block) for values in found)
        used = np.arange(block) < len(found[0]) - start
        listed = _listed(work, triangles.source, used, *own, size=grid.size, pattern=pattern)
        keep, depth = (np.asarray(values) for values in shader(listed))
        keep = keep & used & (depth >= 0.0) & (depth <= 1.0)
        return jax.tree.map(lambda values: np.asarray(values)[keep], dataclasses.replace(listed, depth=depth))

    kept = list(on_all_cores(look, range(0, len(found[0]), block)))
    num_kept = sum(len(some.place) for some in kept)
    if not num_kept:
        return fragments
    late = jax.tree.map(lambda *values: _padded(np.concatenate(values), room_for(num_kept)), *kept)
    used = np.arange(len(late.place)) < num_kept
    return _resolve_jit(fragments, dataclasses.replace(late, triangle_id=np.where(used, late.triangle_id, -1)))


def _padded(values: np.ndarray, size: int) -> np.ndarray:
    return np.pad(values, ((0, size - len(values)), *((0, 0) for _ in values.shape[1:])))


def _candidates(fragments: Fragments, work: Work, grid: TileGrid, pattern: Samples) -> tuple[np.ndarray, ...]:
    """Pair, lane and place of all samples that are covered and not hidden."""
    tile = np.repeat(np.arange(grid.count, dtype=np.int32), np.asarray(work.lists.count))
    limit = np.asarray(fragments.depth).reshape(-1)

    def look(start: int) -> tuple[np.ndarray, ...]:
        pair = np.minimum(np.arange(start, start + _PAIRS_PER_CHUNK, dtype=np.int32), len(tile) - 1)
        inside, z = (np.asarray(v)[: len(tile) - start] for v in _cover(work, pair, size=grid.size, pattern=pattern))
        item, lane = np.nonzero(inside)
        place, in_image = _places(tile[start + item], lane, grid, fragments)
        item, lane, place = item[in_image], lane[in_image], place[in_image]
        seen = z[item, lane] <= limit[place]
        return tuple(values[seen].astype(np.int32) for values in (start + item, lane, place))

    none = tuple(np.zeros(0, np.int32) for _ in range(3))
    found = on_all_cores(look, range(0, len(tile), _PAIRS_PER_CHUNK))
    return tuple(np.concatenate(values) for values in zip(none, *found, strict=True))


def _places(tile: np.ndarray, lane: np.ndarray, grid: TileGrid, fragments: Fragments) -> tuple[np.ndarray, np.ndarray]:
    """Where lanes of tiles lie in an image, counted through, and whether they do."""
    h, w, _ = fragments.triangle_id.shape
    m, s = fragments.samples.grid, len(fragments.samples.offsets)
    row = tile // grid.columns * grid.size + lane // s // grid.size
    column = tile % grid.columns * grid.size + lane // s % grid.size
    cell = ((row // m * w + column // m) * m + row % m) * m + column % m
    return cell * s + lane % s, (row < h * m) & (column < w * m)


@functools.partial(jax.jit, static_argnames=("size", "pattern"))
def _cover(work: Work, pair, *, size: int, pattern: Samples):
    return cover(work.pairs, work.triangles, pair, Lanes.of(size, pattern))


@functools.partial(jax.jit, static_argnames=("size", "pattern"))
def _listed(work: Work, source, used, pair, lane, place, *, size: int, pattern: Samples) -> FragmentList:
    """A list of fragments from their pairs and lanes."""
    lanes, screen_id = Lanes.of(size, pattern), work.pairs.triangle[pair]
    here, steps = work.pairs.planes[pair], work.triangles.planes[screen_id]
    x, y = (jnp.asarray(places[0])[lane].astype(here.dtype) for places in (lanes.x, lanes.y))
    barycentrics, w = barycentrics_at(here, steps, x, y)
    return FragmentList(
        place=place, triangle_id=jnp.where(used, source[screen_id], -1), screen_id=jnp.where(used, screen_id, -1),
        barycentrics=barycentrics, depth=depth_at(here[:, 0], work.triangles.depth[screen_id], x, y), w=w,
    )  # fmt: skip


def resolve(fragments: Fragments, late: FragmentList) -> Fragments:
    """The late depth test: the nearest of what was there and of a list; of equally deep ones the first in API order."""
    size, shape = fragments.triangle_id.size, fragments.triangle_id.shape
    order = fragments.triangles.order
    rank = jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=order.dtype))
    rank_of = lambda screen_id: jnp.where(screen_id >= 0, rank[screen_id], len(order))  # noqa: E731
    place = jnp.where(late.triangle_id >= 0, late.place, size)
    early = fragments.depth.reshape(-1)
    nearest = early.at[place].min(late.depth, mode="drop")
    tied = late.depth == nearest.at[place].get(mode="fill", fill_value=-1.0)
    first = jnp.where(early == nearest, rank_of(fragments.screen_id.reshape(-1)), len(order))
    first = first.at[jnp.where(tied, place, size)].min(rank_of(late.screen_id), mode="drop")
    wins = tied & (rank_of(late.screen_id) == first.at[place].get(mode="fill", fill_value=-1))
    entry = jnp.full(size, -1, jnp.int32)
    entry = entry.at[jnp.where(wins, place, size)].set(jnp.arange(len(place), dtype=jnp.int32), mode="drop")
    entry = entry.reshape(shape)

    def pick(name: str) -> Array:
        old, new = getattr(fragments, name), getattr(late, name)[jnp.maximum(entry, 0)]
        return jnp.where((entry >= 0).reshape(*shape, *(1,) * (old.ndim - 3)), new, old)

    names = ("triangle_id", "screen_id", "barycentrics", "depth", "w")
    seen: dict[str, Any] = {name: pick(name) for name in names}
    return dataclasses.replace(fragments, **seen)


_resolve_jit = jax.jit(resolve)


# --- Coverage written by a shader

# Thresholds of 4 x 4 pixels, each as far as can be from its neighbours (Bayer, 1973).
_DITHER = (np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) + 0.5) / 16.0


def alpha_to_coverage(
    alpha: Float[Array, " n"], place: Int[Array, " n"], *, num_samples: int, width: int
) -> Bool[Array, " n"]:
    """Which fragments are kept so that about alpha of each pixel's samples are: transparency without an order.

    Samples are taken in a fixed order; the last one is decided by a 4 x 4 ordered dither, so that flat areas show more
    shades than there are samples.

    Args:
      alpha: in [0, 1], of each fragment.
      place: of `FragmentList`.
      num_samples: of a pixel.
      width: of the image, in pixels.
    """
    pixel, sample = place // num_samples, place % num_samples
    dither = jnp.asarray(_DITHER, alpha.dtype)[pixel // width % 4, pixel % width % 4]
    turn = sample * _stride(num_samples) % num_samples
    return alpha > (turn.astype(alpha.dtype) + dither) / num_samples


def _stride(count: int) -> int:
    """The number nearest to the golden section of `count` that is coprime to it: neighbours come up far apart."""
    return min((k for k in range(1, count + 1) if math.gcd(k, count) == 1), key=lambda k: abs(k - 0.618 * count))
