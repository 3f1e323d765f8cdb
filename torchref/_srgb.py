"""The transfer function of sRGB, IEC 61966-2-1, and its inverse; values outside [0, 1] are clamped by the first."""

import torch
from torch import Tensor


def encode_srgb(linear: Tensor) -> Tensor:
    """Linear values to sRGB."""
    linear = linear.clamp(0.0, 1.0)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: Tensor) -> Tensor:
    """sRGB values to linear ones."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
