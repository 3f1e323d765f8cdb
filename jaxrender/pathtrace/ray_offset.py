"""Origins that lie off the surface by a little more than rounding; pointwise, on any leading axes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender.vecmath import dot

#: Below this coordinate the units of rounding shrink, but not the errors of the arithmetic that made it.
_NEAR_ZERO = 1.0 / 32.0
_STEP_NEAR_ZERO = 1.0 / 65536.0
_STEPS = 256.0


def offset_origin(
    position: Float[Array, "*b 3"], geometric_normal: Float[Array, "*b 3"], direction: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """The origin for a ray that leaves a surface: moved along the normal, to the side that the direction points to.

    Each coordinate moves by up to 256 units of rounding of float32 at its own magnitude, in which the rays are traced,
    or by up to 1/65536 where it is smaller than 1/32. So scenes are expected in units in which 1e-5 is not visible.
    The best position is that of the hit's barycentrics; origin + t · direction has an error of its own, which grows
    with t. The offset counts as a constant: the derivative in position is the identity.

    Args:
      geometric_normal: unit, of the plane of the triangle, on either side.
      direction: of the new ray, any length > 0.
    References:
      Wächter, Binder, "A Fast and Robust Method for Avoiding Self-Intersection", Ray Tracing Gems, 2019, ch. 6.
    """
    n = jnp.where(dot(geometric_normal, direction) < 0, -geometric_normal, geometric_normal)
    return moved_coordinates(position, n)


def moved_coordinates(position: Float[Array, "*b"], normal: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """`offset_origin` of coordinates one by one, for a normal that is on the side of the new ray."""
    p, n = (jax.lax.stop_gradient(x).astype(jnp.float32) for x in (position, normal))
    steps = (_STEPS * n).astype(jnp.int32)
    near = jnp.abs(p) < _NEAR_ZERO
    # Steps from a number near 0 may leave the numbers.
    bits = jax.lax.bitcast_convert_type(jnp.where(near, 1.0, p), jnp.int32) + jnp.where(p < 0, -steps, steps)
    moved = jnp.where(near, p + _STEP_NEAR_ZERO * n, jax.lax.bitcast_convert_type(bits, jnp.float32))
    return position + (moved - p).astype(position.dtype)
