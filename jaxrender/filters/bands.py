"""Filters on images that are larger than memory, band by band, on all cores, with the same result.

Images are arrays of NumPy or whatever can be cut like them (`numpy.memmap`, a zarr array); a band is read when its turn
comes. A filter looks only so far, its halo: bands overlap by it and are cropped afterwards.
"""

import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender import checks
from jaxrender.filters.guided import filter_centered
from jaxrender.filters.guided_rows import restart_rows
from jaxrender.filters.precision import working
from jaxrender.machine import num_cores, on_all_cores


def in_bands(
    function: Callable[..., Float[Array, "..."]],
    images: Sequence[Float[np.ndarray, "h w _"]],
    *,
    rows: int,
    halo: int | tuple[int, int],
    compiled: bool = False,
) -> Iterator[Float[np.ndarray, "b w _"]]:
    """The bands of function(*images), each `rows` high but for the last, from the top.

    Args:
      function: maps images to one of the same size; jitted by the caller. The same result as on the whole image asks
        that a pixel depends on nothing farther than `halo` rows, and not on where it lies: radius for
        `cross_bilateral_filter` and `box_mean`, 2 (2^num_levels - 1) for `atrous_filter`. For the guided filter see
        `guided_filter_in_bands`.
      halo: rows that a pixel depends on above and below it: one number, or (above, below).
      images: of one height.
      compiled: whether `function` is compiled for all bands; else the first band runs alone, before the others.
    Raises:
      ValueError: if heights differ, rows < 1 or halo < 0.
    """
    checks.check_at_least("rows", rows, 1)
    above, below = (halo, halo) if isinstance(halo, int) else halo
    checks.check_at_least("halo", min(above, below), 0)
    heights = {image.shape[0] for image in images}
    if len(heights) != 1:
        raise ValueError(f"images: expected one height, got {sorted(heights)}")
    (height,) = heights
    wide = jnp.result_type(float) == jnp.float64  # a setting of this thread

    def band(start: int) -> np.ndarray:
        first, last = max(0, start - above), min(height, start + rows + below)
        with jax.enable_x64(wide):
            result = function(*(jnp.asarray(np.asarray(image[first:last])) for image in images))
        return np.asarray(result)[start - first : min(height, start + rows) - first]

    return on_all_cores(band, range(0, height, rows), compiled=compiled)


def guided_filter_in_bands(
    guide: Float[np.ndarray, "h w g"],
    image: Float[np.ndarray, "h w c"],
    *,
    radius: int,
    eps: float | Sequence[float],
    rows: int | None = None,
) -> Iterator[Float[np.ndarray, "b w c"]]:
    """The bands of `guided_filter(guide, image, radius=radius, eps=eps)`, equal to it bit for bit on a CPU.

    Args:
      eps: one number, or one per guide channel.
      rows: of a band; rounded up to where running sums start afresh. By default the image is cut into one band per
        core.
    Raises:
      ValueError: if guide and image differ in height or width, rows < 1, or radius or the shape of eps do not fit.
    """
    if guide.shape[:2] != image.shape[:2]:
        raise ValueError(f"guide and image: expected one height and width, got {guide.shape} and {image.shape}")
    checks.check_whole("radius", radius, 0)
    checks.check_above_0("eps", eps)
    step = restart_rows(min(radius, image.shape[0] - 1))
    if rows is None:
        rows = -(-image.shape[0] // num_cores())
    checks.check_at_least("rows", rows, 1)
    rows = -(-rows // step) * step
    dtype = working(jnp.asarray(np.asarray(image[:1])).dtype)
    centers = [jnp.asarray(center, dtype) for center in _centers(guide, image, rows)]
    ridge = jnp.asarray(eps, dtype)
    rest = tuple(jax.ShapeDtypeStruct(x.shape, dtype) for x in (*centers, ridge))
    programs = {}
    height, (above, below) = image.shape[0], (2 * step, step)
    for start in range(0, height, rows):
        size = min(height, start + rows + below) - max(0, start - above)
        shapes = [jax.ShapeDtypeStruct((size, *x.shape[1:]), jnp.asarray(x[:1]).dtype) for x in (guide, image)]
        programs[size] = _program(*shapes, *rest, radius=radius)
    function = lambda a, b: programs[len(a)](a, b, *centers, ridge)  # noqa: E731
    return in_bands(function, (guide, image), rows=rows, halo=(above, below), compiled=True)


@functools.cache
def _program(guide, image, guide_center, image_center, eps, *, radius: int):
    """The filter for bands of one size, compiled once; programs made by several threads at once can crash."""

    def band(guide, image, guide_center, image_center, eps):
        return filter_centered(guide, image, guide_center, image_center, radius=radius, eps=eps)

    return jax.jit(band).lower(guide, image, guide_center, image_center, eps).compile()


def _centers(guide, image, rows: int) -> list[Float[np.ndarray, " _"]]:
    """`guided.center_of`, summed band by band."""
    channels = guide.shape[-1] + image.shape[-1]
    total, count = np.zeros(channels), 0
    for start in range(0, guide.shape[0], rows):
        pixels = [np.asarray(x[start : start + rows], np.float64) for x in (guide, image)]
        both = np.concatenate(pixels, axis=-1)
        valid = np.isfinite(both).all(axis=-1)
        total, count = total + both[valid].sum(axis=0), count + valid.sum()
    mean = np.asarray(total / max(count, 1), np.float32)
    rounded = np.asarray(jax.lax.reduce_precision(jnp.asarray(mean), 8, 7))
    return [rounded[: guide.shape[-1]], rounded[guide.shape[-1] :]]
