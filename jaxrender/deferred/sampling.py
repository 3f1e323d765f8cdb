"""Counts or clusters of each pixel -> which sub-samples are shaded, where, and how much each of them counts.

Pointwise over windows: the n = m x m sub-samples of a pixel are an axis, row by row from the upper left. Nothing here
has a gradient but `resolve_samples`, which takes lists.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_at_least

_PRINTED = {
    2: ((0, 2), (3, 1)),
    3: ((2, 6, 3), (5, 0, 8), (1, 7, 4)),
    4: ((1, 8, 2, 10), (12, 4, 14, 6), (3, 11, 0, 9), (15, 7, 13, 5)),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ShadingPoints:
    """Where samples are shaded, and what they stand for.

    Attributes:
      weight: share of the pixel's covered part; those of a pixel add up to 1.
      shift: (x, y) in pixels from the sub-sample to the middle of what it stands for.
      spread: (xx, xy, yy) of the symmetric matrix that makes the footprint of the sample of the footprint of the pixel:
        1/m times the identity for a sub-sample that stands for itself, the identity for one that stands for all.
    """

    weight: Float[Array, "*b"]
    shift: Float[Array, "*b 2"]
    spread: Float[Array, "*b 3"]


@functools.cache
def index_matrix(size: int) -> Int[np.ndarray, "m m"]:
    """The order in which the sub-samples of a window are taken: entry 0 first.

    As printed for m = 2, 3 and 4. For other powers of two Bayer's recursion, with the entry nearest the middle swapped
    with 0. For the rest the farthest point each time: first the cell nearest the middle; then the cell whose nearest
    chosen one (on the torus) is farthest, of equals the one that keeps the mean of all chosen nearest the middle, then
    the one in the widest gap (lowest Gaussian energy, σ = m/4), then the first.

    References:
      Holländer et al., 2013, figure 3; Bayer, 1973.
    """
    check_at_least("size", size, 1)
    if size in _PRINTED:
        matrix = np.array(_PRINTED[size])
    elif size & (size - 1) == 0:
        matrix = _bayer(size)
    else:
        matrix = _farthest_points(size)
    matrix.setflags(write=False)
    return matrix


def _bayer(size: int) -> np.ndarray:
    matrix = np.zeros((1, 1), int)
    while len(matrix) < size:
        matrix = np.block([[4 * matrix, 4 * matrix + 2], [4 * matrix + 3, 4 * matrix + 1]])
    # Of the four cells around the middle, the lower right one, as in the printed 4 x 4.
    middle = size // 2, size // 2
    if size > 1:
        start = np.unravel_index(np.argmin(matrix), matrix.shape)
        matrix[start], matrix[middle] = matrix[middle], 0
    return matrix


def _farthest_points(size: int) -> np.ndarray:
    place = np.arange(size) - 0.5 * (size - 1)
    y, x = (v.reshape(-1) for v in np.meshgrid(place, place, indexing="ij"))
    away = lambda a: np.minimum(np.abs(a[:, None] - a[None]), size - np.abs(a[:, None] - a[None]))  # noqa: E731
    distance2 = away(x) ** 2 + away(y) ** 2
    energy = np.exp(-distance2 / (2.0 * (size / 4.0) ** 2))
    order = [int(np.argmin(np.round(x**2 + y**2, 9)))]
    while len(order) < size * size:
        nearest = distance2[order].min(axis=0)
        drift = (x[order].sum() + x) ** 2 + (y[order].sum() + y) ** 2
        keys = np.stack([-nearest, np.round(drift, 9), np.round(energy[order].sum(axis=0), 9)])
        keys[:, order] = np.inf
        order.append(int(np.lexsort(keys[::-1])[0]))
    matrix = np.empty(size * size, int)
    matrix[order] = np.arange(size * size)
    return matrix.reshape(size, size)


def sample_positions(size: int) -> Float[np.ndarray, "n 2"]:
    """(x, y) of the sub-samples from the middle of the pixel, in pixels."""
    place = (np.arange(size) + 0.5) / size - 0.5
    return np.stack(np.meshgrid(place, place), axis=-1).reshape(-1, 2)


def sample_rank(covered: Bool[Array, "*b n"]) -> Int[Array, "*b n"]:
    """The turn of each covered sub-sample in the order of the index matrix; empty ones are skipped, and have n."""
    n = covered.shape[-1]
    order = np.argsort(index_matrix(window_size(n)).reshape(-1))
    turn = jnp.cumsum(covered[..., order], axis=-1, dtype=jnp.int32) - 1
    return jnp.where(covered, turn[..., np.argsort(order)], n)


def first_sample(covered: Bool[Array, "*b n"]) -> Int[Array, "*b"]:
    """The sub-sample that is shaded first; 0 in an empty window."""
    return jnp.argmin(sample_rank(covered), axis=-1).astype(jnp.int32)


def prefix_points(count: Int[Array, "*b"], *, size: int) -> ShadingPoints:
    """What each of the first K samples in the order of the index matrix counts: 1/K, with 1/K of the footprint.

    With K of the m² samples of a window, each must cover m²/K times the area of its own cell: gradients are those of a
    cell times √(m²/K), which is 1/√K of those of the pixel. All K are moved by as much as their middle misses that of
    the pixel, so that textures stay where they are.

    Args:
      count: K, of the samples' pixels.
      size: m.
    """
    order = np.argsort(index_matrix(size).reshape(-1))
    middle = np.cumsum(sample_positions(size)[order], axis=0) / np.arange(1, size * size + 1)[:, None]
    share = 1.0 / count.astype(jnp.float32)
    # √(1/m²) is 1/m but for rounding.
    scale = jnp.where(count == size * size, 1.0 / size, jnp.sqrt(share))
    # All samples need no moving; no rounding of the sum may do it.
    middle[-1] = 0.0
    return ShadingPoints(
        weight=share,
        shift=-jnp.asarray(middle, jnp.float32)[jnp.clip(count - 1, 0, size * size - 1)],
        spread=jnp.stack([scale, jnp.zeros_like(scale), scale], axis=-1),
    )


def cluster_points(owner: Int[Array, "*b n"], sample: Int[Array, "*b"]) -> ShadingPoints:
    """Share, middle and extent of what a sub-sample stands for.

    The footprint of a cluster is that of a box of the same second moments: those of its sub-samples and of their cells.

    Args:
      owner: for each sub-sample of the pixel the one that stands for it; -1 where empty.
      sample: the sub-sample, one of the owners.
    """
    n = owner.shape[-1]
    size = window_size(n)
    mine = owner == sample[..., None]
    x, y = (jnp.broadcast_to(jnp.asarray(v, jnp.float32), mine.shape) for v in sample_positions(size).T)
    count = jnp.maximum(jnp.sum(mine, axis=-1), 1).astype(jnp.float32)
    total = lambda values: jnp.sum(jnp.where(mine, values, 0.0), axis=-1) / count  # noqa: E731
    mean_x, mean_y = total(x), total(y)
    dx, dy = x - mean_x[..., None], y - mean_y[..., None]
    # 12 is what turns the variance of a uniform distribution into the square of its width.
    cell = 1.0 / n
    xx, xy, yy = 12.0 * total(dx * dx) + cell, 12.0 * total(dx * dy), 12.0 * total(dy * dy) + cell
    # The square root of a 2 x 2 matrix: (A + √det A) / √(trace A + 2 √det A).
    root = jnp.sqrt(jnp.maximum(xx * yy - xy * xy, 0.0))
    scale = 1.0 / jnp.sqrt(xx + yy + 2.0 * root)
    spread = jnp.stack([(xx + root) * scale, xy * scale, (yy + root) * scale], axis=-1)
    own = jnp.broadcast_to(jnp.asarray([1.0 / size, 0.0, 1.0 / size], jnp.float32), spread.shape)
    here = jnp.asarray(sample_positions(size), jnp.float32)[sample]
    return ShadingPoints(
        weight=count / jnp.maximum(jnp.sum(owner >= 0, axis=-1), 1).astype(jnp.float32),
        shift=jnp.stack([mean_x, mean_y], axis=-1) - here,
        spread=jnp.where((count == 1.0)[..., None], own, spread),
    )


def resolve_samples(
    values: Float[Array, "b c"], weight: Float[Array, " b"], pixel: Int[Array, " b"], *, num_pixels: int
) -> Float[Array, "p c"]:
    """Σ w v over the samples of each pixel, in any order; 0 for a pixel without. Differentiable in values and weights.

    Args:
      values: radiance, or whatever is averaged.
      pixel: whose sample each one is; out of range for one that is nobody's.
    """
    return jax.ops.segment_sum(values * weight[:, None], pixel, num_segments=num_pixels)


def window_size(n: int) -> int:
    """m of n = m x m sub-samples."""
    size = round(n**0.5)
    if size * size != n:
        raise ValueError(f"sub-samples: expected m x m, got {n}")
    return size
