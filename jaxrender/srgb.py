"""The transfer function of sRGB, IEC 61966-2-1; pointwise, for NumPy arrays on the way to and from bytes."""

import numpy as np
from jaxtyping import Float


def encode_srgb(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Linear values to sRGB, clamped to [0, 1]."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """sRGB values in [0, 1] to linear ones, the inverse of `encode_srgb`."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
