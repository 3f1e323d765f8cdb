"""Images worked out band by band: on all cores of a processor at once, and never more of them in flight than cores."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxrender.machine import on_all_cores

Tree = TypeVar("Tree")

# What XLA wants of memory it takes over instead of copying it.
_ALIGNMENT = 64


def in_bands(function: Callable[[int], Tree], starts: Sequence[int], *, height: int) -> Tree:
    """function(start) for bands of rows of an image, put together.

    Args:
      function: of the first row of a band; gives arrays whose rows (axis 0) are those of the band, as many for each.
      starts: rows where bands begin; together they hold the image. They may overlap, and reach beyond it.
      height: of the image.
    """
    if len(starts) == 1:
        return jax.tree.map(lambda values: values[:height], function(starts[0]))
    if jax.default_backend() != "cpu":
        bands = [function(start) for start in starts]
        ends = [*starts[1:], height]
        kept = [jax.tree.map(lambda v, n=end - start: v[:n], band)
                for band, start, end in zip(bands, starts, ends, strict=True)]  # fmt: skip
        return jax.tree.map(lambda *values: jnp.concatenate(values), *kept)
    whole: list[Tree] = []

    def put(start: int) -> None:
        band = function(start)
        if not whole:  # the first band, which runs alone, tells shapes and types
            whole.append(jax.tree.map(lambda values: _room(height, values), band))
        for target, values in zip(jax.tree.leaves(whole[0]), jax.tree.leaves(band), strict=True):
            own = target[start : start + len(values)]
            own[...] = np.asarray(values)[: len(own)]

    for _ in on_all_cores(put, starts):
        pass
    return jax.tree.map(jax.device_put, whole[0])


def band_starts(height: int, band: int) -> list[int]:
    """Where bands of `band` rows begin, all of them inside an image at least as high: the last one may overlap."""
    return [min(start, height - band) for start in range(0, height, band)]


def _room(height: int, values: jax.Array) -> np.ndarray:
    """Memory for an image with rows like those of `values`, which XLA can take over without a copy."""
    shape = height, *values.shape[1:]
    num_bytes = int(np.prod(shape)) * values.dtype.itemsize
    raw = np.empty(num_bytes + _ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % _ALIGNMENT
    return raw[start : start + num_bytes].view(values.dtype).reshape(shape)
