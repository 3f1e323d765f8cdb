"""Work on lists of points or windows, which have any length: in calls of one size, on all cores, block by block."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxrender.deferred.raster import room_for
from jaxrender.machine import on_all_cores

#: Points that are shaded by one call, and at a time; windows that are clustered by one call, and at a time.
POINTS_PER_CALL, POINTS_PER_BLOCK, WINDOWS_PER_CALL, WINDOWS_PER_BLOCK = 1 << 16, 1024, 1 << 14, 256


def in_calls(function: Callable[..., Any], size: int, *arguments: np.ndarray) -> Any:
    """function(*arguments) by calls of one size, at most `size`, on all cores; the last one is filled up."""
    total = len(arguments[0])
    # Two blocks at least: XLA compiles a loop of one turn to other code, which rounds in other places.
    size = min(size, max(2, -(-room_for(total) // POINTS_PER_BLOCK)) * POINTS_PER_BLOCK)

    def call(start: int) -> Any:
        own = [values[start : start + size] for values in arguments]
        missing = size - len(own[0])
        filled = [np.concatenate([values, np.zeros((missing, *values.shape[1:]), values.dtype)]) for values in own]
        return jax.tree.map(lambda values: np.asarray(values)[: size - missing], function(*filled))

    calls = list(on_all_cores(call, range(0, max(total, 1), size)))
    return jax.tree.map(lambda *values: np.concatenate(values), *calls)


def by_block(function: Callable[[Any], Any], block: int, *arguments: Any) -> Any:
    """function(arguments) block by block on a processor, whose caches are small; at once elsewhere."""
    if jax.default_backend() != "cpu":
        return function(arguments)
    cut = jax.tree.map(lambda values: values.reshape(-1, block, *values.shape[1:]), arguments)
    found = jax.lax.map(function, cut)
    return jax.tree.map(lambda values: values.reshape(-1, *values.shape[2:]), found)


def covered_pixels(covered: Bool[np.ndarray, "h w n"]) -> Int[np.ndarray, " p"]:
    """The pixels where anything is, in the order of `_screen_order`."""
    order = _screen_order(*covered.shape[:2])
    return order[covered.any(axis=-1).reshape(-1)[order]]


@functools.lru_cache(maxsize=4)
def _screen_order(height: int, width: int) -> Int[np.ndarray, " p"]:
    """All pixels, tile by tile of 16 x 16, in blocks of 8 x 4: neighbours in a list look alike."""
    y, x = np.mgrid[:height, :width]
    keys = (x % 8, y % 4, x // 8 % 2, y // 4 % 4, x // 16, y // 16)
    order = np.lexsort([key.reshape(-1) for key in keys]).astype(np.int32)
    order.setflags(write=False)
    return order
