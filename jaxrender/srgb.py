"""The transfer function of sRGB, IEC 61966-2-1; pointwise, for arrays of NumPy and of JAX alike."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Values = TypeVar("Values", jax.Array, np.ndarray)


def encode_srgb(linear: Values) -> Values:
    """Linear values to sRGB, clamped to [0, 1]. Differentiable inside."""
    xp = _library(linear)
    linear = xp.clip(linear, 0.0, 1.0)
    # The floor keeps the slope of the root finite where the other branch is taken.
    curved = 1.055 * xp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return xp.where(linear <= 0.0031308, 12.92 * linear, curved)


def decode_srgb(srgb: Values) -> Values:
    """sRGB values in [0, 1] to linear ones, the inverse of `encode_srgb`."""
    xp = _library(srgb)
    return xp.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _library(values: Any) -> Any:
    return jnp if isinstance(values, jax.Array) else np
