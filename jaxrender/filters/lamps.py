"""Lamps that are seen themselves, which no guide tells from the wall around them, and other patches of bright light."""

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

# Times the median light: brighter patches stand out.
_BRIGHT = 16.0
# Of the pixels of a lamp, half differ by less from a neighbour, as a share of their sum; noise of 4 % makes as much.
_FLAT = 0.01
# Side of the windows in which patches are looked for: what fills half of one.
_SIDE = 5


def seen_lamps(light: Float[np.ndarray, "h w c"]) -> Bool[np.ndarray, "h w"]:
    """Where a lamp is seen itself: it must not be spread over what is around it, and needs no filter.

    A bright patch without noise, with the bright pixels next to it. Light that falls on something has noise, and is not
    taken for a lamp however bright it is.
    """
    luminance = _luminance(light)
    flat = scipy.ndimage.median_filter(_steps(luminance), size=_SIDE, mode="nearest") < _FLAT
    lamps = scipy.ndimage.binary_dilation(bright_patches(light) & flat, iterations=_SIDE // 2)
    return lamps & (luminance > _BRIGHT * _median(luminance))


def bright_patches(light: Float[np.ndarray, "h w c"]) -> Bool[np.ndarray, "h w"]:
    """Where the median of 5 x 5 pixels is many times as bright as the picture's: lamps, sun on the floor."""
    luminance = _luminance(light)
    return scipy.ndimage.median_filter(luminance, size=_SIDE, mode="nearest") > _BRIGHT * _median(luminance)


def _luminance(light: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w"]:
    return np.nan_to_num(light, nan=0.0).mean(axis=-1, dtype=np.float32)


def _median(luminance: Float[np.ndarray, "h w"]) -> float:
    """Of what is lit; infinite if nothing is."""
    lit = luminance[luminance > 0.0]
    return float(np.median(lit)) if lit.size else np.inf


def _steps(luminance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """To the next pixel of the row or of the column, whichever is less: the difference as a share of the sum."""
    padded = np.pad(luminance, ((0, 1), (0, 1)), mode="edge")
    steps = []
    for other in (padded[1:, :-1], padded[:-1, 1:]):
        total = np.abs(luminance) + np.abs(other)
        steps.append(np.abs(luminance - other) / np.maximum(total, np.finfo(np.float32).tiny))
    return np.minimum(*steps)
