"""Colors of texels that no one sees: painting programs leave them black, and filters would mix that in at the edges."""

import numpy as np
from jaxtyping import UInt8


def bleed_colors(texels: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    """RGB of fully transparent texels from the visible ones around them; everything else stays.

    Visible colors, weighted by alpha, are averaged 2 x 2 down to one texel; what has none takes that of the finest
    coarser level that has.

    References:
      Pull-push: Gortler et al., "The Lumigraph", 1996, section 3.4.
    """
    alpha = texels[..., 3:].astype(np.float32)
    if not (alpha == 0).any() or not alpha.any():
        return texels
    levels = [np.concatenate([texels[..., :3] * alpha, alpha], axis=-1)]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halved(levels[-1]))
    colors = levels[-1][..., :3] / levels[-1][..., 3:]
    for level in levels[-2::-1]:
        h, w = level.shape[:2]
        above = colors.repeat(2, axis=0).repeat(2, axis=1)[:h, :w]
        weight = level[..., 3:]
        colors = np.where(weight > 0, level[..., :3] / np.maximum(weight, 1e-6), above)
    hidden = np.concatenate([np.round(colors), np.zeros_like(alpha)], axis=-1).astype(np.uint8)
    return np.where(alpha > 0, texels, hidden)


def _halved(level: np.ndarray) -> np.ndarray:
    """Sums of 2 x 2; an odd size is filled up with nothing."""
    even = np.pad(level, ((0, level.shape[0] % 2), (0, level.shape[1] % 2), (0, 0)))
    return even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
