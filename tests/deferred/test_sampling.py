"""The printed matrices and the rules of all others, and what samples stand for against sums over sub-samples."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred import samples
from jaxrender.deferred.sampling import (
    _farthest_points,
    cluster_points,
    first_sample,
    index_matrix,
    prefix_points,
    sample_positions,
    sample_rank,
)

PRINTED = {
    2: [[0, 2], [3, 1]],
    3: [[2, 6, 3], [5, 0, 8], [1, 7, 4]],
    4: [[1, 8, 2, 10], [12, 4, 14, 6], [3, 11, 0, 9], [15, 7, 13, 5]],
}

# One window: batches are vmap's, but for the tests of leading axes.
points_of = jax.jit(jax.vmap(cluster_points), compiler_options={"xla_backend_optimization_level": 0})


def order_of(matrix) -> np.ndarray:
    """Cells (row, column) in their order."""
    size = len(matrix)
    return np.stack(np.unravel_index(np.argsort(np.ravel(matrix)), (size, size)), axis=1)


def around(a, b, size: int) -> np.ndarray:
    """Squared distance of cells on the torus."""
    away = np.abs(np.asarray(a) - np.asarray(b))
    return np.sum(np.minimum(away, size - away) ** 2, axis=-1)


def drift(matrix) -> float:
    """Mean over all prefixes of how far the middle of their cells lies from the pixel's, in pixels."""
    size = len(matrix)
    place = (order_of(matrix) + 0.5) / size - 0.5
    return float(np.linalg.norm(np.cumsum(place, axis=0) / np.arange(1, size**2 + 1)[:, None], axis=1).mean())


def random_owners(rng, size: int, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Windows in which some sub-samples stand for others; and one of those in each."""
    n = size**2
    owner, sample = np.full((num, n), -1, np.int32), np.zeros(num, np.int32)
    for row in range(num):
        members = rng.permutation(n)[: rng.integers(1, n + 1)]
        owners = members[: rng.integers(1, len(members) + 1)]
        owner[row, members] = rng.choice(owners, len(members))
        owner[row, owners] = owners
        sample[row] = owners[0]
    return owner, sample


# --- Order


@pytest.mark.parametrize("size", PRINTED)
def test_the_matrices_are_as_printed(size):
    assert index_matrix(size).tolist() == PRINTED[size]


@pytest.mark.parametrize("size", [*range(1, 10), 16])
def test_every_sub_sample_has_its_turn(size):
    matrix = index_matrix(size)
    assert matrix.shape == (size, size) and sorted(matrix.ravel().tolist()) == list(range(size**2))
    with pytest.raises(ValueError, match="read-only"):
        matrix[0, 0] = 5


@pytest.mark.parametrize("size", [1, 3, 4, 5, 6, 7, 8, 9, 16])
def test_the_first_sub_sample_is_next_to_the_middle(size):
    """But that of 2 x 2, none of whose cells is nearer than another."""
    row, column = order_of(index_matrix(size))[0]
    assert abs(row - (size - 1) / 2) <= 0.5 and abs(column - (size - 1) / 2) <= 0.5


def test_the_printed_4_x_4_is_the_recursion_with_0_and_1_swapped():
    b2 = np.array(PRINTED[2])
    b4 = np.block([[4 * b2 + k for k in row] for row in PRINTED[2]])
    swapped = np.where(b4 == 0, 1, np.where(b4 == 1, 0, b4))
    assert swapped.tolist() == PRINTED[4]


@pytest.mark.parametrize("size", [8, 16])
def test_powers_of_two_are_bayers_recursion(size):
    """B_2n[y, x] = 4 B_n[y mod n, x mod n] + B_2[y div n, x div n]; then 0 and the middle entry change places."""
    matrix = np.array(PRINTED[2])
    while len(matrix) < size:
        matrix = np.block([[4 * matrix + k for k in row] for row in PRINTED[2]])
    found = index_matrix(size)
    middle = matrix[size // 2, size // 2]
    assert found[size // 2, size // 2] == 0 and found[0, 0] == middle
    assert np.argwhere(found != matrix).tolist() == [[0, 0], [size // 2, size // 2]]


@pytest.mark.parametrize("size", [5, 6, 7, 9])
def test_others_take_the_farthest_point_each_time(size):
    """On the torus; of equals, what keeps the middle of all closest to that of the pixel."""
    cells = order_of(index_matrix(size))
    for taken in range(1, size**2):
        left = cells[taken:]
        gap = around(left[:, None], cells[None, :taken], size).min(axis=1)
        assert gap[0] == gap.max(), f"entry {taken}"
        mean = (cells[:taken].sum(axis=0) + left) - (taken + 1) * (size - 1) / 2
        shift = np.linalg.norm(mean, axis=1)
        assert shift[0] <= shift[gap == gap.max()].min() + 1e-9, f"entry {taken}"
    assert tuple(cells[0]) == tuple(np.argwhere(_nearest(size))[0])


def _nearest(size: int) -> np.ndarray:
    away = (np.arange(size) - (size - 1) / 2) ** 2
    total = away[:, None] + away
    return total == total.min()


def test_the_farthest_point_rule_gives_the_printed_2_x_2():
    """And only that one: 3 x 3 and 4 x 4 are printed otherwise."""
    assert _farthest_points(2).tolist() == PRINTED[2]
    assert _farthest_points(3).tolist() != PRINTED[3] and _farthest_points(4).tolist() != PRINTED[4]


def test_the_drift_of_prefixes_of_the_reference_sheet():
    """Section 8, m = 8: 0.031 px by farthest points, 0.069 px by the recursion. With 0 in the middle it is 0.061 px."""
    swapped = np.array(index_matrix(8))
    middle = swapped[0, 0]
    recursion = np.where(swapped == 0, middle, np.where(swapped == middle, 0, swapped))
    assert drift(_farthest_points(8)) == pytest.approx(0.031, abs=0.0005)
    assert drift(recursion) == pytest.approx(0.069, abs=0.0005)
    assert drift(swapped) == pytest.approx(0.061, abs=0.0005)


@pytest.mark.parametrize(("size", "cells"), [(2, 1.276), (3, 1.810), (4, 2.430)])
def test_the_distance_of_consecutive_samples_of_the_reference_sheet(size, cells):
    steps = np.linalg.norm(np.diff(order_of(index_matrix(size)), axis=0), axis=1)
    assert steps.mean() == pytest.approx(cells, abs=0.0005)


def test_no_order_of_2_x_2_has_a_larger_distance():
    corners = list(itertools.product((0, 1), repeat=2))
    longest = max(sum(map(math.dist, way, way[1:])) / 3 for way in itertools.permutations(corners))
    assert longest == pytest.approx(1.276, abs=0.0005)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 7])
def test_positions_are_those_of_the_rasterisers_grid(size):
    """From the pixel's middle, there from its corner."""
    found = sample_positions(size)
    np.testing.assert_allclose(found + 0.5, samples.ordered_grid(size).positions_px, atol=1e-12)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-12)
    assert tuple(found[0]) == (found.min(), found.min()) and (size == 1 or found[1, 0] > found[0, 0])


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_empty_sub_samples_have_no_turn(size, rng):
    n = size**2
    covered = rng.uniform(size=(4, 6, n)) < rng.choice([0.0, 0.3, 0.7, 1.0], size=(4, 6, 1))
    rank, first = jax.jit(sample_rank)(covered), jax.jit(first_sample)(covered)
    assert rank.dtype == first.dtype == jnp.int32
    by_turn = np.argsort(np.ravel(index_matrix(size)))
    for i in np.ndindex(4, 6):
        expected, turn = np.full(n, n), 0
        for cell in by_turn:
            if covered[i][cell]:
                expected[cell], turn = turn, turn + 1
        assert rank[i].tolist() == expected.tolist()
        assert first[i] == (np.argmin(expected) if turn else 0)


def test_full_windows_follow_the_matrix():
    for size in (2, 3, 4, 8):
        rank, first = (jax.jit(kernel)(np.ones(size**2, bool)) for kernel in (sample_rank, first_sample))
        assert rank.tolist() == np.ravel(index_matrix(size)).tolist()
        assert index_matrix(size).ravel()[int(first)] == 0


# --- What samples stand for


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_prefixes_share_the_pixel(size):
    """K samples of share 1/K, each with 1/K of the area, moved as one to the middle of the pixel.

    That is 1/m of the width for all of them, all of it for one.
    """
    count = np.arange(1, size**2 + 1, dtype=np.int32)
    points = jax.jit(prefix_points, static_argnames="size")(count, size=size)
    np.testing.assert_allclose(np.asarray(points.weight) * count, 1.0, rtol=1e-6)
    place = sample_positions(size)[np.argsort(index_matrix(size).ravel())]
    for k, shift in zip(count, np.asarray(points.shift), strict=True):
        np.testing.assert_allclose((place[:k] + shift).mean(axis=0), 0.0, atol=1e-7)
    np.testing.assert_array_equal(points.shift[-1], [0.0, 0.0])
    xx, xy, yy = np.asarray(points.spread).T
    np.testing.assert_allclose(xx * yy - xy**2, 1.0 / count, rtol=1e-6)
    np.testing.assert_array_equal(xx, yy)
    np.testing.assert_array_equal(xy, 0.0)
    assert (xx[0], xx[-1]) == (1.0, pytest.approx(1.0 / size, rel=1e-6))
    one = jax.vmap(jax.vmap(lambda k: prefix_points(k, size=size)))(count.reshape(1, -1))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(points), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_cluster_points_are_moments_of_what_they_stand_for(size, rng):
    owner, sample = random_owners(rng, size, 40)
    points, place = points_of(owner, sample), sample_positions(size)
    assert all(v.dtype == jnp.float32 for v in jax.tree.leaves(points))
    for row in range(40):
        mine = place[owner[row] == sample[row]]
        assert points.weight[row] == pytest.approx(len(mine) / np.sum(owner[row] >= 0), rel=1e-6)
        np.testing.assert_allclose(points.shift[row] + place[sample[row]], mine.mean(axis=0), atol=1e-6)
        xx, xy, yy = np.asarray(points.spread[row], np.float64)
        spread = np.array([[xx, xy], [xy, yy]])
        square = 12.0 * np.cov(mine.T, bias=True).reshape(2, 2) + np.eye(2) / size**2
        np.testing.assert_allclose(spread @ spread, square, atol=2e-6)
        assert np.linalg.eigvalsh(spread).min() > 0.0, "of the two roots, the positive one"
        values, axes = np.linalg.eigh(square)
        np.testing.assert_allclose(spread, axes @ np.diag(np.sqrt(values)) @ axes.T, atol=2e-6)


@pytest.mark.parametrize("size", [2, 3, 4])
def test_the_samples_of_a_pixel_make_up_what_is_covered(size, rng):
    """Shares add up to 1; moved to the middle of what they stand for, samples have the mean of all sub-samples."""
    for owner, _ in zip(*random_owners(rng, size, 10), strict=True):
        sample = np.unique(owner[owner >= 0])
        points = points_of(np.tile(owner, (size**2, 1)), np.resize(sample, size**2))
        weight, shift = np.asarray(points.weight)[: len(sample)], np.asarray(points.shift)[: len(sample)]
        assert weight.sum() == pytest.approx(1.0, rel=1e-6)
        place = sample_positions(size)
        middle = (weight[:, None] * (place[sample] + shift)).sum(axis=0)
        np.testing.assert_allclose(middle, place[owner >= 0].mean(axis=0), atol=1e-6)
        radiance = rng.uniform(size=size**2)
        np.testing.assert_allclose(weight @ radiance[sample], radiance[owner[owner >= 0]].mean(), rtol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 8])
def test_all_of_a_window_has_the_pixels_footprint_and_one_its_own(size):
    n = size**2
    sample = np.arange(n, dtype=np.int32)
    alone = points_of(np.tile(sample, (n, 1)), sample)
    np.testing.assert_array_equal(alone.spread, np.tile(np.array([1 / size, 0, 1 / size], np.float32), (n, 1)))
    np.testing.assert_allclose(alone.weight, 1.0 / n, rtol=1e-6)
    np.testing.assert_allclose(alone.shift, 0.0, atol=1e-7)
    every = points_of(np.tile(sample[:, None], (1, n)), sample)
    np.testing.assert_allclose(every.spread, np.tile([1.0, 0.0, 1.0], (n, 1)), atol=1e-6)
    np.testing.assert_array_equal(every.weight, 1.0)
    np.testing.assert_allclose(every.shift, -sample_positions(size), atol=1e-7)


def test_bands_are_as_long_and_as_thin_as_they_are():
    """A column, a row, and a diagonal pair: its footprint is √(1/16 + 12/32) px along the diagonal, 1/4 px across."""
    cells = np.arange(16).reshape(4, 4)
    owner = np.full((3, 16), 15, np.int32)
    owner[0, cells[:, 1]] = owner[1, cells[2]] = 9
    owner[2, [5, 10]] = 5
    xx, xy, yy = np.asarray(points_of(owner, np.array([9, 9, 5], np.int32)).spread).T
    np.testing.assert_allclose([xx[0], yy[0], xx[1], yy[1]], [0.25, 1.0, 1.0, 0.25], rtol=1e-6)
    np.testing.assert_allclose(xy[:2], 0.0, atol=1e-7)
    along = math.sqrt(1 / 16 + 12 * 2 / 64)
    np.testing.assert_allclose(
        [xx[2], xy[2], yy[2]], np.array([along + 0.25, along - 0.25, along + 0.25]) / 2, rtol=1e-6
    )


def test_empty_sub_samples_have_no_part():
    owner = np.array([[-1, 1, 1, -1], [-1, -1, 2, -1]], np.int32)
    points = points_of(owner, np.array([1, 2], np.int32))
    np.testing.assert_array_equal(points.weight, [1.0, 1.0])
    np.testing.assert_allclose(points.shift, [[-0.25, 0.25], [0.0, 0.0]], atol=1e-7)
    np.testing.assert_allclose(points.spread[1], [0.5, 0.0, 0.5])


@pytest.mark.parametrize("lead", [(), (6,), (2, 3)])
def test_leading_axes(lead, rng):
    owner, sample = random_owners(rng, 3, 6)
    whole = points_of(owner, sample)
    cut = (slice(None) if lead else 0,)
    num = math.prod(lead)
    found = cluster_points(jnp.asarray(owner[:num].reshape(*lead, 9)), jnp.asarray(sample[:num].reshape(lead)))
    for one, expected in zip(jax.tree.leaves(found), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(one, np.asarray(expected)[cut].reshape(one.shape), atol=1e-6)


def test_a_large_image_has_the_points_of_its_windows(rng):
    """As optimised, whatever the compiler does at this size."""
    owner, sample = random_owners(rng, 4, 500)
    many = np.tile(owner, (100, 1)), np.tile(sample, 100)
    few = points_of(owner, sample)
    for one, expected in zip(
        jax.tree.leaves(jax.jit(jax.vmap(cluster_points))(*many)), jax.tree.leaves(few), strict=True
    ):
        one = np.asarray(one).reshape(100, *expected.shape)
        np.testing.assert_allclose(one, np.broadcast_to(expected, one.shape), atol=1e-6)


@pytest.mark.parametrize("size", [0, -3, math.nan])
def test_no_matrix_of_no_size(size):
    with pytest.raises(ValueError, match="size: expected a value >= 1"):
        index_matrix(size)


def test_windows_are_square():
    for call in (
        lambda: sample_rank(jnp.ones(5, bool)),
        lambda: first_sample(jnp.ones((2, 3), bool)),
        lambda: cluster_points(jnp.zeros(5, jnp.int32), jnp.zeros((), jnp.int32)),
    ):
        with pytest.raises(ValueError, match="sub-samples: expected m x m, got"):
            call()
