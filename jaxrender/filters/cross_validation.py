"""How well a filter predicts pixels it has not seen: a measure of its error that needs no reference.

A linear filter gives pixel i the share A_ii of its own value. Without it the prediction would be off by
(y_i - (A y)_i) / (1 - A_ii), the error of leaving one out. Its mean square is the squared error of the filter plus the
variance of the noise, whatever that is; so the smallest is the best, as long as pixels' noise is independent.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender import checks
from jaxrender.filters.sat import box_mean

#: Own shares are means over such windows: a probe of one pixel tells little.
_PROBE_RADIUS = 8


def own_share(probe: Float[Array, "h w"], filtered_probe: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """A_ii of a linear filter around each pixel, from what it makes of a probe of random signs; in [0, 0.9].

    E[z_i (A z)_i] = A_ii for independent signs z.

    References:
      Girard, "A fast Monte-Carlo cross-validation procedure for large least squares problems with noisy data",
      Numerische Mathematik 56, 1989.
    """
    checks.check_same_shape("probe and filtered_probe", probe, filtered_probe)
    share = box_mean((probe * filtered_probe)[..., None], radius=_PROBE_RADIUS)[..., 0]
    return jnp.clip(share, 0.0, 0.9)


def leave_one_out_error(
    image: Float[Array, "h w c"],
    filtered: Float[Array, "h w c"],
    share: Float[Array, "h w"],
    *,
    weight: Float[Array, "h w c"],
) -> Float[Array, ""]:
    """Weighted mean square of (image - filtered) / (1 - share) over the finite pixels of `image`.

    Only its differences between filters of one image mean anything: the noise itself is in it.

    References:
      Allen, "The relationship between variable selection and data augmentation and a method for prediction",
      Technometrics 16, 1974 (PRESS).
    """
    checks.check_same_shape("image and filtered", image, filtered)
    error = (image - filtered) / (1.0 - share)[..., None]
    finite = jnp.isfinite(error)
    error = jnp.where(finite, error, jnp.zeros_like(error))
    return jnp.sum(weight * error * error) / jnp.sum(weight * finite.astype(weight.dtype))
