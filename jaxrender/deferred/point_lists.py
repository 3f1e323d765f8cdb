"""Work on lists of points or windows, which have any length: in calls of one size, on all cores, block by block."""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jaxrender.deferred.raster import room_for
from jaxrender.machine import on_all_cores

#: Points that are shaded by one call, and at a time; windows that are clustered by one call, and at a time.
POINTS_PER_CALL, POINTS_PER_BLOCK, WINDOWS_PER_CALL, WINDOWS_PER_BLOCK = 1 << 16, 1024, 1 << 14, 256


def in_calls(
    function: Callable[..., Any], size: int, *arguments: np.ndarray, fixed: tuple[Any, ...] = (), **static: Any
) -> Any:
    """function(*fixed, *arguments, **static) by calls of one size, at most `size`, on all cores; the last is filled up.

    Args:
      function: jitted, pointwise over `arguments`; gives NumPy arrays here.
    """
    total = len(arguments[0])
    # Two blocks at least: XLA compiles a loop of one turn to other code, which rounds in other places.
    size = min(size, max(2, -(-room_for(total) // POINTS_PER_BLOCK)) * POINTS_PER_BLOCK)

    def cut(start: int) -> list[np.ndarray]:
        own = [values[start : start + size] for values in arguments]
        missing = size - len(own[0])
        return [np.concatenate([values, np.zeros((missing, *values.shape[1:]), values.dtype)]) for values in own]

    if not total:
        shapes = jax.eval_shape(functools.partial(function, **static), *fixed, *cut(0))
        return jax.tree.map(lambda shape: np.zeros((0, *shape.shape[1:]), shape.dtype), shapes)
    program = _program(function, (*fixed, *cut(0)), static)

    def call(start: int) -> Any:
        return jax.tree.map(lambda values: np.asarray(values)[: total - start], program(*fixed, *cut(start)))

    calls = list(on_all_cores(call, range(0, total, size), compiled=True))
    return jax.tree.map(lambda *values: np.concatenate(values), *calls)


#: Programs that were used last, by function, options, and the types of all arguments.
_PROGRAMS: OrderedDict[Any, Callable[..., Any]] = OrderedDict()
_MOST_PROGRAMS = 64
_COMPILING = threading.Lock()


def _program(function: Any, arguments: tuple[Any, ...], static: dict[str, Any]) -> Callable[..., Any]:
    """The function, compiled for such arguments before any thread calls it: no two of them may compile at once."""
    leaves, structure = jax.tree.flatten(arguments)
    types = tuple((jnp.shape(leaf), jnp.result_type(leaf), getattr(leaf, "sharding", None)) for leaf in leaves)
    key = function, tuple(static.items()), structure, types
    with _COMPILING:
        if key not in _PROGRAMS:
            _PROGRAMS[key] = function.lower(*arguments, **static).compile()
        _PROGRAMS.move_to_end(key)
        while len(_PROGRAMS) > _MOST_PROGRAMS:
            _PROGRAMS.popitem(last=False)
        return _PROGRAMS[key]


def by_block(function: Callable[[Any], Any], block: int, *arguments: Any) -> Any:
    """function(arguments) block by block on a processor, whose caches are small; at once elsewhere."""
    if jax.default_backend() != "cpu":
        return function(arguments)
    cut = jax.tree.map(lambda values: values.reshape(-1, block, *values.shape[1:]), arguments)
    found = jax.lax.map(function, cut)
    return jax.tree.map(lambda values: values.reshape(-1, *values.shape[2:]), found)


def covered_pixels(covered: Bool[np.ndarray, "h w n"]) -> Int[np.ndarray, " p"]:
    """The pixels where anything is, in the order of `screen_order`."""
    order = screen_order(*covered.shape[:2])
    return order[covered.any(axis=-1).reshape(-1)[order]]


@functools.lru_cache(maxsize=4)
def screen_order(height: int, width: int) -> Int[np.ndarray, " p"]:
    """All pixels, tile by tile of 16 x 16, in blocks of 8 x 4: neighbours in a list look alike."""
    y, x = np.mgrid[:height, :width]
    keys = (x % 8, y % 4, x // 8 % 2, y // 4 % 4, x // 16, y // 16)
    order = np.lexsort([key.reshape(-1) for key in keys]).astype(np.int32)
    order.setflags(write=False)
    return order
