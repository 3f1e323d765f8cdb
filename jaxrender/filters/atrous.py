"""Edge-avoiding à-trous filter: a small kernel with holes, again and again, each time with holes twice as wide.

One image `(h, w, c)`; batches by `vmap`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.checks import check_whole
from jaxrender.filters.bilateral import (
    Likeness,
    finite,
    from_planes,
    half_window,
    pair_sums,
    sigma_values,
    to_planes,
    weighted_mean,
    working_dtype,
)
from jaxrender.filters.valid import check_images, valid_pixels

# (6, 4, 1) / 16 as shares of the first: by these a cubic B-spline is a sum of five of half its width.
_SPLINE = np.array([1.0, 2.0 / 3.0, 1.0 / 6.0])


def atrous_filter(
    image: Float[Array, "h w c"],
    features: Float[Array, "h w f"],
    *,
    num_levels: int,
    sigma_features: float | Float[Array, "..."],
    sigma_color: float | Float[Array, ""] | None = None,
) -> Float[Array, "h w c"]:
    """Mean over a window of 4 (2^num_levels - 1) + 1 pixels a side at 25 pixels a level, that stops at edges.

    On level i = 0, 1, ... each pixel becomes the weighted mean of the 5 x 5 pixels at multiples of 2^i pixels from it,
    those beyond the border left out. The weight is that of the cubic B-spline, (1, 4, 6, 4, 1) / 16 in either
    direction, times Π exp(-(F(p) - F(q))² / sigma²) over the features F, times exp(-|c(p) - c(q)|² / sigma_i²) for the
    colours c that the level starts from. sigma_i = 2^-i sigma_color; the sigmas of features are the same on all levels.
    These sigmas are √2 times those of `cross_bilateral_filter`.

    A pixel with a NaN or Inf in image or features gives nothing to others, and its colour weighs nothing. It takes the
    first mean that it finds. From then on it is like all others if its features are finite; else its means, of its own
    value and of others, stay by the spline alone, and it never gives. A pixel that finds nothing on any level is 0.

    Linear in the image if there is no sigma_color. Differentiable, in reverse mode, in image, features and sigmas, at
    the memory of an image per level.

    Args:
      image: any range. Half precision is summed in float32; the result has the type of the image.
      num_levels: >= 1; 4 to 6 are usual. Steps may exceed the image.
      sigma_features: in units of the features, > 0; one number, or one for each. With inf a feature does not count.
      sigma_color: in units of the image, > 0; None leaves the colour out.
    Raises:
      ValueError: if image and features differ in height or width or are empty, a sigma has another shape or is a number
        <= 0, or num_levels < 1.
      TypeError: if image or features do not hold floating-point numbers.
    References:
      Dammertz, Sewtz, Hanika, Lensch, "Edge-Avoiding À-Trous Wavelet Transform for fast Global Illumination Filtering",
      HPG 2010 (its colour sigma, too, halves from level to level; its details are dropped).
    """
    check_images(image=image, features=features)
    check_whole("num_levels", num_levels, 1)
    dtype = working_dtype(image, features)
    height, width, channels = image.shape
    offsets, log_taps, gap = _taps(height, width, num_levels)
    reach = int(offsets.max())

    valid, known = valid_pixels(image, features), valid_pixels(features)
    scales = 1.0 / sigma_values("sigma_features", sigma_features, features.shape[2:], dtype)
    alike = Likeness(to_planes(finite(features, known, dtype), gap), scales, to_planes(known[..., None], gap)[0])
    color_scale = None if sigma_color is None else 1.0 / sigma_values("sigma_color", sigma_color, (), dtype)

    def level(state, taps):
        colors, has_value = state
        offsets, log_taps, growth = taps
        gives = has_value & alike.known
        likenesses = [alike]
        if color_scale is not None:
            likenesses.append(Likeness(tuple(colors), jnp.full(channels, color_scale * growth), gives))
        values = [jnp.where(gives, v, 0.0) for v in (*colors, jnp.ones_like(colors[0]))]
        around = pair_sums(values, likenesses, offsets, log_taps, reach=reach)
        own = [*colors, has_value.astype(dtype)]
        return weighted_mean([o + a for o, a in zip(own, around, strict=True)]), None

    start = list(to_planes(finite(image, valid, dtype), gap)), to_planes(valid[..., None], gap)[0]
    tables = (
        jnp.asarray(offsets, jnp.int32),
        jnp.asarray(log_taps, dtype),
        jnp.asarray(2.0 ** np.arange(num_levels), dtype),
    )
    # Kept for the derivative is what each level starts from.
    (colors, _), _ = jax.lax.scan(jax.checkpoint(level, prevent_cse=False), start, tables)
    return from_planes(colors, height, width).astype(image.dtype)


def _taps(height: int, width: int, num_levels: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Of each level, the offsets along planes and the logarithms of their weights, that of the centre being 1; the gap.

    Offsets that lead out of the image wherever they start become 0, with a weight of 0.
    """
    y, x = half_window(2, 2)
    steps = 2 ** np.arange(num_levels)[:, None]
    inside = (y * steps < height) & (abs(x) * steps < width)
    gap = int(np.max(abs(x) * steps, initial=0, where=inside))
    offsets = np.where(inside, (y * (width + gap) + x) * steps, 0)
    return offsets, np.where(inside, np.log(_SPLINE[y] * _SPLINE[abs(x)]), -np.inf), gap
