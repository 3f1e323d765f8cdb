"""Summed-area tables, and window means and variances that are right in float32.

One image at a time, (h, w, c). A table of float32 sums loses what the sum of all pixels rounds off: at 4096 x 4096 the
variance of 3 x 3 pixels of noise can be wrong by several times its own value. It is here to be looked at. `box_mean`
and `box_variance` sum each window on its own (`windows.py`) and cost no more.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrender import checks
from jaxrender.filters.precision import planes_of, working
from jaxrender.filters.valid import valid_pixels
from jaxrender.filters.windows import box_sums


def summed_area_table(image: Float[Array, "h w c"]) -> Float[Array, "h+1 w+1 c"]:
    """table[y, x] = the sum of image[:y, :x]: the raw table, in the image's own precision.

    The rounding of an entry grows with the sum of all pixels, and a window is a difference of four entries. In float32
    with noise in [0, 1] at 1024 x 1024, a variance of 3 x 3 pixels from such sums is wrong by 1e-3 on average and by
    1e-2 at worst. Differentiable. One NaN spoils all entries below and to the right of it.

    References:
      Crow, "Summed-Area Tables for Texture Mapping", SIGGRAPH 1984.
    """
    return jnp.pad(jnp.cumsum(jnp.cumsum(image, axis=0), axis=1), ((1, 0), (1, 0), (0, 0)))


def box_sum_from_table(table: Float[Array, "h w c"], *, radius: int) -> Float[Array, "h-1 w-1 c"]:
    """Sums over windows of (2 radius + 1)² pixels, cropped at the border, from the four corners in the table."""
    checks.check_whole("radius", radius, 0)
    height, width = table.shape[0] - 1, table.shape[1] - 1
    y, x = jnp.arange(height), jnp.arange(width)
    top, bottom = jnp.maximum(y - radius, 0), jnp.minimum(y + radius + 1, height)
    left, right = jnp.maximum(x - radius, 0), jnp.minimum(x + radius + 1, width)
    rows = table[bottom] - table[top]
    return rows[:, right] - rows[:, left]


def box_mean(image: Float[Array, "h w c"], *, radius: int) -> Float[Array, "h w c"]:
    """Mean over the window of (2 radius + 1)² pixels around each pixel, cropped at the border.

    Pixels with a NaN or an infinity in any channel are left out; a window without any other pixel gives 0. The error
    is below 2 log₂(2 radius + 1) + 4 roundings of the mean magnitude in the window. Half precision is summed in
    float32. Differentiable.

    Args:
      radius: in pixels, >= 0; may exceed the image.
    Raises:
      ValueError: if radius < 0.
    """
    checks.check_whole("radius", radius, 0)
    valid = valid_pixels(image)
    means, _ = _window_means(planes_of(jnp.where(valid[..., None], image, jnp.zeros_like(image))), valid, radius)
    return jnp.moveaxis(means, 0, -1).astype(image.dtype)


def box_variance(image: Float[Array, "h w c"], *, radius: int) -> Float[Array, "h w c"]:
    """Variance over the same windows as `box_mean`, per channel, divided by the number of pixels; never below 0.

    Taken of the image less its own mean, so that an offset costs no precision. In float32 the error is below 1e-6 of
    the square of the image's range. Differentiable where the variance is not 0 by rounding; the derivative there is 0.
    """
    checks.check_whole("radius", radius, 0)
    valid = valid_pixels(image)
    planes = planes_of(jnp.where(valid[..., None], image, jnp.zeros_like(image)))
    planes = jnp.where(valid[None], planes - mean_of(planes, valid)[:, None, None], jnp.zeros_like(planes))
    means, inverse = _window_means(planes, valid, radius)
    variance = box_sums(planes * planes, radius=radius) * inverse[None] - means * means
    return jnp.moveaxis(jnp.maximum(variance, jnp.zeros_like(variance)), 0, -1).astype(image.dtype)


def mean_of(planes: Float[Array, "c h w"], valid: Bool[Array, "h w"]) -> Float[Array, " c"]:
    """The mean of the valid pixels of each plane; 0 if there are none. A second pass takes off its rounding."""
    count = jnp.maximum(jnp.sum(valid.astype(planes.dtype)), jnp.ones((), planes.dtype))
    mean = jnp.sum(jnp.where(valid[None], planes, jnp.zeros_like(planes)), axis=(1, 2)) / count
    rest = jnp.where(valid[None], planes - mean[:, None, None], jnp.zeros_like(planes))
    return mean + jnp.sum(rest, axis=(1, 2)) / count


def _window_means(planes, valid, radius: int):
    """Means over windows of planes that are 0 where not valid, and 1 / (number of valid pixels), 0 for none."""
    counts = box_sums(valid.astype(working(planes.dtype)), radius=radius)
    inverse = jnp.where(counts > 0.0, 1.0 / jnp.maximum(counts, jnp.ones_like(counts)), jnp.zeros_like(counts))
    return box_sums(planes, radius=radius) * inverse[None], inverse
