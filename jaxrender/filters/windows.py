"""Sums over windows by doubling: sums of 1, 2, 4, ... neighbours, of which a window is put together.

No difference is ever taken, and a window is summed in the same order wherever it lies. Its error is a few roundings of
what is in it, whatever else the image holds, and a piece of an image gives the same numbers as the whole.
"""

import functools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def neighbour_sums(values: Float[Array, "..."], *, length: int, axis: int = -1) -> Float[Array, "..."]:
    """Sums of `length` neighbours along an axis of n entries: out[i] = values[i] + ... + values[i + length - 1].

    The result has n - length + 1 entries there. An entry costs log₂(length) additions, and one more for each further
    binary digit of `length`. Differentiable; the derivative is a sum of the same kind.
    """
    size = values.shape[axis]

    def part(x, start, stop):
        return lax.slice_in_dim(x, start, stop, axis=axis)

    sums, step, start = values, 1, 0  # `sums` are of `step` neighbours
    pieces = []
    while step <= length:
        if length & step:
            pieces.append(part(sums, start, start + size - length + 1))
            start += step
        rest = sums.shape[axis]
        if 2 * step <= length:
            sums = part(sums, 0, rest - step) + part(sums, step, rest)
        step *= 2
    return functools.reduce(jnp.add, pieces)


def box_sums(planes: Float[Array, "*b h w"], *, radius: int) -> Float[Array, "*b h w"]:
    """Sums over windows of (2 radius + 1)² pixels, cropped at the border."""
    for axis in (-2, -1):
        reach = min(radius, planes.shape[axis] - 1)  # of more than the image nothing is left after cropping
        borders = [(0, 0)] * planes.ndim
        borders[axis] = (reach, reach)
        planes = neighbour_sums(jnp.pad(planes, borders), length=2 * reach + 1, axis=axis)
    return planes


def window_counts(height: int, width: int, *, radius: int) -> tuple[Float[Array, " h"], Float[Array, " w"]]:
    """Rows and columns of the cropped window around each row and column; their product counts its pixels. float32."""

    def counts(size):
        at = jnp.arange(size)
        return (jnp.minimum(at + radius, size - 1) - jnp.maximum(at - radius, 0) + 1).astype(jnp.float32)

    return counts(height), counts(width)
