"""Box and guided filters in plain NumPy and float64, window by window, from their definitions."""

from collections.abc import Callable, Iterator

import numpy as np


def windows(height: int, width: int, radius: int) -> Iterator[tuple[int, int, tuple[slice, slice]]]:
    """Each pixel and its window, cropped at the border."""
    for y, x in np.ndindex(height, width):
        yield y, x, np.s_[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]


def of_windows(image: np.ndarray, radius: int, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """function(pixels (n, c)) -> (c,) of the finite pixels of each window; 0 where there are none."""
    result, valid = np.zeros(image.shape), np.isfinite(image).all(-1)
    for y, x, window in windows(*valid.shape, radius):
        if valid[window].any():
            result[y, x] = function(image[window][valid[window]].astype(np.float64))
    return result


def window_sums(plane: np.ndarray, radius: int, rows: np.ndarray) -> np.ndarray:
    """Sums of the windows around some rows of a large plane: of columns one by one, then a running sum in float64."""
    width, x = plane.shape[1], np.arange(plane.shape[1])
    columns = [plane[max(y - radius, 0) : y + radius + 1].sum(0, dtype=np.float64) for y in rows]
    running = np.pad(np.cumsum(columns, axis=1), ((0, 0), (1, 0)))
    return running[:, np.minimum(x + radius + 1, width)] - running[:, np.maximum(x - radius, 0)]


def guided_filter(guide: np.ndarray, image: np.ndarray, *, radius: int, eps) -> np.ndarray:
    """Least squares in each window, the ridge as more rows of the system; then the mean over covering windows.

    A window without a valid pixel predicts the mean of the image in 8 bits.
    """
    height, width, g = guide.shape
    valid = np.isfinite(guide).all(-1) & np.isfinite(image).all(-1)
    eps = np.broadcast_to(np.asarray(eps, np.float64), guide.shape)
    fits = np.zeros((height, width, g + 1, image.shape[2]))
    fits[:, :, g] = in_8_bits(image[valid].mean(0)) if valid.any() else 0.0
    for y, x, window in windows(height, width, radius):
        inside, wanted = guide[window][valid[window]], image[window][valid[window]]
        n = len(inside)
        if n > 0:
            ridge = np.pad(np.diag(np.sqrt(n * eps[y, x])), ((0, 0), (0, 1)))
            system = np.concatenate([np.pad(inside, ((0, 0), (0, 1)), constant_values=1.0), ridge])
            right = np.concatenate([wanted, np.zeros((g, image.shape[2]))])
            fits[y, x] = np.linalg.lstsq(system, right, rcond=None)[0]
    seen = np.where(np.isfinite(guide).all(-1, keepdims=True), guide, of_windows(guide, radius, mean))
    result = np.zeros(image.shape)
    for y, x, window in windows(height, width, radius):
        result[y, x] = np.append(seen[y, x], 1.0) @ fits[window].mean((0, 1))
    return result


def mean(pixels: np.ndarray) -> np.ndarray:
    return pixels.mean(0)


def variance(pixels: np.ndarray) -> np.ndarray:
    return pixels.var(0)


def in_8_bits(values: np.ndarray) -> np.ndarray:
    """Rounded to eight significant binary digits."""
    digits, exponent = np.frexp(values)
    return np.ldexp(np.round(digits * 256.0) / 256.0, exponent)
