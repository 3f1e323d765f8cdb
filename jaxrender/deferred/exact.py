"""Cross products of snapped coordinates, exact without 64-bit types.

Coordinates are int32 within ±2²¹ (±8192 px in 1/256 px), so that differences fit in 22 bits and a sign, and cross
products in 46. A product is a pair (high, low) that stands for high·2²⁴ + low, 0 <= low < 2²⁴. It runs on devices
without int64, and without switching JAX to 64 bits.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_HALF = 12
_MASK = (1 << _HALF) - 1
# What `divide_by` answers instead of anything larger; sums of two such numbers still fit.
LIMIT = 1 << 30


def cross_product(
    ax: Int[Array, "*b"], ay: Int[Array, "*b"], bx: Int[Array, "*b"], by: Int[Array, "*b"], *, bias: Int[Array, "*b"]
) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
    """ax·by - ay·bx - bias as (high, low); |a|, |b| < 2²³, bias 0 or 1."""
    h1, m1, l1 = _product(ax, by)
    h2, m2, l2 = _product(ay, bx)
    middle, low = m1 - m2, l1 - l2 - bias
    middle += low >> _HALF
    high = h1 - h2 + (middle >> _HALF)
    return high, ((middle & _MASK) << _HALF) | (low & _MASK)


def _product(a: Int[Array, "*b"], b: Int[Array, "*b"]):
    """a·b as three int32: units of 2²⁴, 2¹² and 1."""
    a_high, a_low, b_high, b_low = a >> _HALF, a & _MASK, b >> _HALF, b & _MASK
    return a_high * b_high, a_high * b_low + a_low * b_high, a_low * b_low


def divide_by(high: Int[Array, "*b"], low: Int[Array, "*b"], *, bits: int) -> Int[Array, "*b"]:
    """⌊value / 2^bits⌋, clamped to ±2³⁰."""
    fits = jnp.abs(high) < LIMIT >> (24 - bits)
    quotient = (jnp.where(fits, high, 0) << (24 - bits)) + (low >> bits)
    return jnp.where(fits, quotient, jnp.where(high < 0, -LIMIT, LIMIT))


def to_float(high: Int[Array, "*b"], low: Int[Array, "*b"]) -> Float[Array, "*b"]:
    """The value in float32, within 2⁻²³ of it even where the parts cancel."""
    # high·2²⁴ + low with high = -1 and low near 2²⁴ cancels; both terms are exact then, and so is their sum.
    return high.astype(jnp.float32) * jnp.float32(1 << 24) + low.astype(jnp.float32)
