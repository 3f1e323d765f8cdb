"""Sums over windows: every window by itself, the same wherever it lies."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters.windows import box_sums, neighbour_sums, window_counts

# Compiling is nearly all of the time here.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def plain_box_sums(planes: np.ndarray, radius: int) -> np.ndarray:
    """Of the last two axes, window by window."""
    sums = np.zeros_like(planes)
    for y, x in np.ndindex(planes.shape[-2:]):
        sums[..., y, x] = planes[..., max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1].sum(
            (-2, -1)
        )
    return sums


def plain_corners(planes: np.ndarray, radius: int) -> np.ndarray:
    """Window sums of one plane from a table in float64."""
    height, width = planes.shape
    table = np.pad(planes.astype(np.float64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    y, x = np.arange(height), np.arange(width)
    rows = table[np.minimum(y + radius + 1, height)] - table[np.maximum(y - radius, 0)]
    return rows[:, np.minimum(x + radius + 1, width)] - rows[:, np.maximum(x - radius, 0)]


@pytest.mark.parametrize("axis", [-1, 0, 1])
def test_neighbour_sums_of_all_lengths(axis, rng):
    """Whole numbers, whose sums are exact."""
    values = rng.integers(-1000, 1000, size=(13, 14, 15)).astype(np.float32)
    lengths = range(1, values.shape[axis] + 1)
    sums = quick(lambda x: [neighbour_sums(x, length=length, axis=axis) for length in lengths])(values)
    for length, found in zip(lengths, sums, strict=True):
        windows = np.lib.stride_tricks.sliding_window_view(values, length, axis=axis)
        np.testing.assert_array_equal(found, windows.sum(-1))


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 1), (7, 10), (2, 3, 5, 6)])
def test_box_sums_of_all_radii(shape, rng):
    planes = rng.integers(-1000, 1000, size=shape).astype(np.float32)
    radii = (0, 1, 2, 3, 4, 7, 8, 100)
    sums = quick(lambda x: [box_sums(x, radius=r) for r in radii])(planes)
    for radius, found in zip(radii, sums, strict=True):
        np.testing.assert_array_equal(found, plain_box_sums(planes, radius))


@pytest.mark.parametrize("radius", [0, 1, 4, 100])
def test_counts_are_box_sums_of_one(radius):
    rows, columns = window_counts(9, 4, radius=radius)
    assert rows.dtype == columns.dtype == jnp.float32
    np.testing.assert_array_equal(np.outer(rows, columns), plain_box_sums(np.ones((9, 4)), radius))


def test_a_window_feels_nothing_but_its_own_pixels(rng):
    """Bit for bit: neither what lies outside nor where the window lies changes the order of the sum."""
    radius, compiled = 5, jax.jit(lambda x: box_sums(x, radius=5))
    planes = rng.normal(size=(2, 60, 50)).astype(np.float32)
    whole = np.asarray(compiled(planes))
    spoiled = planes.copy()
    spoiled[:, 30, 25] = 1e30
    outside = np.ones((60, 50), bool)
    outside[30 - radius : 31 + radius, 25 - radius : 26 + radius] = False
    np.testing.assert_array_equal(np.asarray(compiled(spoiled))[:, outside], whole[:, outside])
    part = np.asarray(compiled(planes[:, 7:48, 3:40]))
    np.testing.assert_array_equal(part[:, radius:-radius, radius:-radius], whole[:, 12:43, 8:35])


def test_rounding_is_that_of_a_sum_in_pairs(rng):
    """log₂(length) + 1 additions along each axis are the longest way of a value into the sum."""
    planes, radii = rng.uniform(size=(300, 300)).astype(np.float32), (1, 7, 31, 100)
    sums = quick(lambda x: [box_sums(x, radius=r) for r in radii])(planes)
    for radius, found in zip(radii, sums, strict=True):
        additions = 2.0 * (np.log2(2 * radius + 1) + 1.0)
        exact = plain_corners(planes, radius)
        assert (np.abs(found - exact) <= additions * 2.0**-24 * exact).all(), radius


def test_sums_are_their_own_transpose(rng):
    """A pixel is in the window of another if that is in its own: Σ a box(b) = Σ b box(a). So slopes are box sums."""
    a, b = rng.integers(-50, 50, size=(2, 11, 9)).astype(np.float32)
    summed = quick(lambda x: box_sums(x, radius=3))
    assert np.sum(a * summed(b)) == np.sum(b * summed(a))
    slope = quick(jax.grad(lambda x: jnp.sum(a * box_sums(x, radius=3))))(b)
    np.testing.assert_array_equal(slope, summed(a))
    third = quick(jax.grad(lambda x: neighbour_sums(x, length=5)[2]))(jnp.zeros(9))
    np.testing.assert_array_equal(third, [0, 0, 1, 1, 1, 1, 1, 0, 0])
