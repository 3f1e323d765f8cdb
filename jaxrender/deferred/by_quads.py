"""A canvas, filled with a fixed number of samples for each quad of 2 x 2 pixels: the rival that needs no lists.

Shading is decoupled from pixels: a sample may serve all four of them, and a pixel all samples of its quad. The first
sample of each covered pixel is taken; then, of all sub-samples of the quad, the one that is most unlike all taken ones,
until the budget is spent. No setting is a tolerance: time is the same for every view, quality is not.

References:
  Fixed budgets for visibility and shading of a quad: Liktor, Dachsbacher, "Decoupled Deferred Shading for Hardware
  Rasterization", I3D 2012; the choice by attributes is that of `clusters`.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxrender.deferred.canvas import Canvas, leads
from jaxrender.deferred.clusters import cluster_quads
from jaxrender.deferred.point_lists import WINDOWS_PER_BLOCK, WINDOWS_PER_CALL, by_block, in_calls
from jaxrender.deferred.sampling import ShadingPoints, cluster_points, first_sample, window_size
from jaxrender.deferred.subsamples import SubSamples


@dataclass(frozen=True)
class QuadBudget:
    """How many samples a quad gets, and how unlike its sub-samples are (`Clusters`).

    Attributes:
      count: of samples, at least 4.
      normal, plane: as in `Clusters`.
      apart: times the distance in pixels.
    """

    count: int = 8
    normal: float = 8.0
    plane: float = 300.0
    apart: float = 1.0


def shade_by_quads(canvas: Canvas, method: QuadBudget) -> None:
    """Shades `count` samples of each quad, fewer where fewer are covered."""
    n = canvas.covered.shape[-1]
    if not 4 <= method.count <= 4 * n:
        raise ValueError(f"count: expected a number from 4 to {4 * n}, got {method.count}")
    quarters = _quarter(n)
    pixel, place = _quad_places(*canvas.covered.shape)
    covered = canvas.covered.reshape(-1)[place] & (pixel >= 0)[:, quarters]
    some = covered.any(axis=1)
    pixel, place, covered = pixel[some], place[some], covered[some]
    scales = tuple(np.float32(v) for v in (method.normal, method.plane, method.apart))
    fixed = canvas.samples, *scales
    owner = in_calls(_cluster_quads, WINDOWS_PER_CALL, place, covered, fixed=fixed, count=method.count)
    quad, sample = leads(owner)
    owners = owner[quad]
    alone = np.count_nonzero(owners == sample[:, None], axis=1) == 1
    radiance, _, _, _ = canvas.shade(_quad_points, place[quad, sample], alone, owners, sample)
    # What each sample is of each of the four pixels.
    used = np.stack([(owners[:, quarters == k] == sample[:, None]).sum(axis=1) for k in range(4)], axis=1)
    row, quarter = np.nonzero(used)
    own, total = pixel[quad[row], quarter], np.maximum(canvas.windows.sum(axis=1), 1)
    order = np.argsort(own, kind="stable")
    row, quarter, own = row[order], quarter[order], own[order]
    weight = (used[row, quarter] / total[own]).astype(np.float32)
    canvas.put(np.arange(len(canvas.image)), own, radiance[row], weight)


def _quarter(n: int) -> Int[np.ndarray, " 4n"]:
    """Which of a quad's pixels its sub-samples, row by row, are in."""
    size = window_size(n)
    y, x = np.divmod(np.arange(4 * n), 2 * size)
    return 2 * (y // size) + x // size


def _quad_places(height: int, width: int, n: int) -> tuple[Int[np.ndarray, "q 4"], Int[np.ndarray, "q 4n"]]:
    """Pixels of each quad (-1 beyond the image), and where its sub-samples, row by row, are in the image."""
    size = window_size(n)
    top, left = (v.reshape(-1, 1) for v in np.mgrid[:height:2, :width:2])
    row, column = top + [0, 0, 1, 1], left + [0, 1, 0, 1]
    inside = (row < height) & (column < width)
    pixel = np.where(inside, row * width + column, 0)
    y, x = np.divmod(np.arange(4 * n), 2 * size)
    place = pixel[:, _quarter(n)] * n + y % size * size + x % size
    return np.where(inside, pixel, -1).astype(np.int32), place.astype(np.int32)


@functools.partial(jax.jit, static_argnames="count")
def _cluster_quads(
    samples: SubSamples, normal_scale, plane_scale, apart_scale, place, covered, *, count: int
) -> Int[Array, "q 4n"]:
    n = place.shape[-1] // 4
    quarter = _quarter(n)
    mine = np.stack([np.flatnonzero(quarter == k) for k in range(4)])

    def group(block: tuple[Array, Array]) -> Int[Array, "b 4n"]:
        place, covered = block
        found, _ = samples.look(place)
        # The first sample of each pixel, as a number in the quad; -1 for an empty one.
        first = first_sample(covered[:, mine])
        seeds = jnp.where(covered[:, mine].any(axis=-1), jnp.asarray(mine)[jnp.arange(4), first], -1)
        return cluster_quads(
            found.normal, found.position, found.depth, found.material_id, covered, seeds, count=count,
            normal_scale=normal_scale, plane_scale=plane_scale, apart_scale=apart_scale,
        ).astype(jnp.int16)  # fmt: skip

    return by_block(group, WINDOWS_PER_BLOCK, place, covered)


def _quad_points(_n: int, owner, sample) -> ShadingPoints:
    """As of one window twice as wide and high as a pixel."""
    points = cluster_points(owner.astype(jnp.int32), sample)
    return ShadingPoints(weight=points.weight, shift=2.0 * points.shift, spread=2.0 * points.spread)
