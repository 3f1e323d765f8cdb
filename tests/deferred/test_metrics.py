"""Sample counts against loops over windows, windows whose count is known, and laws of order, background and borders."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxrender.deferred.metrics import (
    BALANCED,
    SampleMetrics,
    average_over_frames,
    balanced_counts,
    depth_sample_count,
    normal_sample_count,
    sample_count,
    shading_sample_count,
    shading_steps,
    tile_maximum,
)

SIZES = (1, 2, 3, 4, 5)
JUNK = (np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0)

# Compiling is nearly all of the time here. NumPy arrays go in as they are: NaN in them is no result.
_OPTIONS = {"xla_backend_optimization_level": 0}
depth_count = jax.jit(depth_sample_count, static_argnames=("scale", "plane_corrected"), compiler_options=_OPTIONS)
normal_count = jax.jit(normal_sample_count, static_argnames="scale", compiler_options=_OPTIONS)
_THRESHOLDS = ("scale", "edge_threshold", "min_threshold")
shading_count = jax.jit(shading_sample_count, static_argnames=_THRESHOLDS, compiler_options=_OPTIONS)
steps = jax.jit(shading_steps, compiler_options=_OPTIONS)


def grid(size: int) -> np.ndarray:
    """(x, y) of the cells of a window, row by row."""
    y, x = np.mgrid[:size, :size].reshape(2, -1)
    return np.stack([x, y], axis=-1).astype(float)


def some(rng, *shape: int) -> np.ndarray:
    """Full windows, empty ones, and all between."""
    return rng.uniform(size=shape) < rng.choice([0.0, 0.2, 0.6, 1.0], size=(*shape[:-1], 1))


def unit(values) -> np.ndarray:
    values = np.asarray(values, np.float64)
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def bent(rng, *shape: int, bend: float = 0.4) -> np.ndarray:
    """Normals around an axis of each window."""
    return unit(unit(rng.normal(size=(*shape[:-1], 1, 3))) + bend * rng.normal(size=(*shape, 3)))


def with_junk(rng, values: np.ndarray, covered: np.ndarray) -> np.ndarray:
    junk = rng.choice(JUNK, size=values.shape).astype(values.dtype)
    return np.where(covered.reshape(covered.shape + (1,) * (values.ndim - covered.ndim)), values, junk)


def depth_by_loop(depth, covered, *, plane: bool = False) -> np.ndarray:
    """Mean squared residual of the least squares fit to the covered cells, window by window."""
    result = np.zeros(covered.shape[:-1])
    for i in np.ndindex(result.shape):
        own = np.asarray(depth[i], np.float64)[covered[i]]
        if len(own) > 1:
            basis = np.ones((len(own), 1))
            if plane:
                basis = np.concatenate([basis, grid(math.isqrt(covered.shape[-1]))[covered[i]]], axis=1)
            left = own - basis @ np.linalg.lstsq(basis, own, rcond=None)[0]
            result[i] = np.mean(left**2)
    return result


def cone_by_loop(normal, covered) -> np.ndarray:
    """√(1 - min |n̄ · n|), window by window."""
    result = np.zeros(covered.shape[:-1])
    for i in np.ndindex(result.shape):
        own = np.asarray(normal[i], np.float64)[covered[i]]
        if len(own) > 1:
            mean = own.mean(axis=0)
            result[i] = math.sqrt(max(1.0 - min(abs(n @ mean) / np.linalg.norm(mean) for n in own), 0.0))
    return result


def cross(values, y: int, x: int, covered) -> list:
    """Values left, right, above and below that are there."""
    places = [(y, x - 1), (y, x + 1), (y - 1, x), (y + 1, x)]
    inside = [(i, j) for i, j in places if 0 <= i < values.shape[0] and 0 <= j < values.shape[1]]
    return [(place, values[place]) for place in inside if covered[place] and np.isfinite(values[place])]


def shading_by_loop(luminance, covered, *, scale=16.0, edge_threshold=1 / 8, min_threshold=1 / 16) -> np.ndarray:
    result = np.zeros(luminance.shape)
    for y, x in np.ndindex(luminance.shape):
        if covered[y, x] and np.isfinite(luminance[y, x]):
            values = [luminance[y, x], *(value for _, value in cross(luminance, y, x, covered))]
            contrast = max(values) - min(values)
            if contrast >= min_threshold and contrast >= edge_threshold * max(values):
                result[y, x] = scale * contrast
    return result


def steps_by_loop(luminance, covered) -> np.ndarray:
    result = np.zeros((*luminance.shape, 2))
    for y, x in np.ndindex(luminance.shape):
        if covered[y, x] and np.isfinite(luminance[y, x]):
            for (i, _), value in cross(luminance, y, x, covered):
                axis = 0 if i == y else 1
                result[y, x, axis] = max(result[y, x, axis], abs(value - luminance[y, x]))
    return result


# --- Depth


@pytest.mark.parametrize("size", SIZES)
def test_k_d_is_the_variance_of_a_window(size, dtype, rng):
    depth, covered = rng.uniform(size=(4, 5, size**2)).astype(dtype), some(rng, 4, 5, size**2)
    found = depth_count(depth, scale=3.0, covered=covered)
    assert found.dtype == dtype and found.shape == (4, 5)
    np.testing.assert_allclose(found, 3.0 * depth_by_loop(depth, covered), rtol=0, atol=32 * np.finfo(dtype).eps)
    full = depth_by_loop(depth, np.ones(covered.shape, bool))
    np.testing.assert_allclose(depth_count(depth, scale=3.0), 3.0 * full, rtol=0, atol=32 * np.finfo(dtype).eps)


@pytest.mark.parametrize("size", SIZES)
def test_plane_corrected_k_d_is_what_the_best_plane_leaves(size, dtype, rng):
    """Roughly, since windows are here that have few cells, or all on a line: see the tests of planes for those."""
    depth, covered = rng.uniform(size=(5, 8, size**2)).astype(dtype), some(rng, 5, 8, size**2)
    found = depth_count(depth, scale=3.0, covered=covered, plane_corrected=True)
    np.testing.assert_allclose(found, 3.0 * depth_by_loop(depth, covered, plane=True), rtol=0, atol=1e-4)
    full = np.ones(covered.shape, bool)
    found = depth_count(depth, scale=3.0, plane_corrected=True)
    atol = 1e-11 if dtype == np.float64 else 64 * np.finfo(dtype).eps
    np.testing.assert_allclose(found, 3.0 * depth_by_loop(depth, full, plane=True), rtol=0, atol=atol)


@pytest.mark.parametrize("size", [2, 3, 4, 5])
def test_windows_whose_depth_variance_is_known(size):
    """Values 0 and s in the shares 1 - p and p have the variance s² p (1 - p)."""
    x, y = grid(size).T
    n, s, c = size**2, 0.3, 5.0

    def count(depth, **options):
        return float(depth_count(depth.astype(np.float32), scale=c, **options))

    def approximately(value):
        return pytest.approx(value, rel=1e-5, abs=1e-8)

    assert count(np.full(n, 0.7)) == approximately(0.0)
    for column in range(1, size):
        share = column / size
        assert count(s * (x < column)) == approximately(c * s**2 * share * (1 - share)), "an edge"
    if size % 2 == 0:
        assert count(s * (x < size / 2)) == approximately(c * s**2 / 4), "a half/half step"
    odd = (n // 2) / n
    assert count(s * ((x + y) % 2)) == approximately(c * s**2 * odd * (1 - odd)), "a checkerboard"
    for cell in range(n):
        alone = count(s * (np.arange(n) == cell))
        assert alone == approximately(c * s**2 * (n - 1) / n**2), "what covers one sub-sample"


@pytest.mark.parametrize("size", [2, 3, 4, 5])
def test_a_slope_has_a_known_variance_and_none_without_its_plane(size):
    """g per sub-pixel: g² (m² - 1) / 12; G per pixel, that is g = G / m: G² (1 - 1/m²) / 12."""
    x, y = grid(size).T
    for g in ((0.1, 0.0), (0.0, -0.07), (0.05, 0.02)):
        depth = (0.4 + g[0] * x + g[1] * y).astype(np.float32)
        variance = (g[0] ** 2 + g[1] ** 2) * (size**2 - 1) / 12
        assert float(depth_count(depth, scale=2.0)) == pytest.approx(2.0 * variance, rel=1e-5)
        assert float(depth_count(depth, scale=2.0, plane_corrected=True)) < 1e-11
    per_pixel = np.float32(0.3) * x.astype(np.float32) / size
    assert float(depth_count(per_pixel, scale=1.0)) == pytest.approx(0.09 * (1 - 1 / size**2) / 12, rel=1e-5)


def test_a_plane_under_something_does_not_matter(rng, x64):
    depth, covered = rng.uniform(size=(20, 16)), rng.uniform(size=(20, 16)) < 0.8
    tilted = depth + grid(4) @ [0.3, -0.2] + 5.0
    found, before = (depth_count(d, scale=1.0, covered=covered, plane_corrected=True) for d in (tilted, depth))
    np.testing.assert_allclose(found, before, atol=1e-9)
    assert (np.asarray(before) > 0.01).all() and (np.asarray(depth_count(tilted, scale=1.0)) > 0.05).all()


@pytest.mark.parametrize("size", [2, 3, 4])
def test_a_plane_of_few_cells_does_not_count(size, dtype, rng):
    """Also where two or three cells, or all of a diagonal, are all that is there."""
    n = size**2
    pairs = [[i, j] for i in range(n) for j in range(i)]
    more = [rng.permutation(n)[:k].tolist() for k in (3, 3, 3, 4) for _ in range(20)]
    cells = [*pairs, *more, list(range(0, n, size + 1)), list(range(size - 1, n - 1, max(size - 1, 1)))]
    covered = np.zeros((len(cells), n), bool)
    for row, own in enumerate(cells):
        covered[row, own] = True
    for g in ((1.0, 0.5), (1.0, 1.0), (-0.3, 2.0)):
        depth = np.broadcast_to(grid(size) @ g, covered.shape).astype(dtype)
        left = np.asarray(depth_count(depth, scale=1.0, covered=covered, plane_corrected=True))
        bound = 1e-6 * np.maximum(depth_by_loop(depth, covered), 1e-6)
        worst = np.argmax(left / bound)
        assert (left <= bound).all(), f"cells {cells[worst]}, slope {g}: {left[worst]} of {bound[worst] * 1e6} is left"


def test_k_d_is_at_most_a_quarter(rng):
    depth = np.concatenate([rng.uniform(size=(50, 9)), rng.integers(0, 2, (50, 9))]).astype(np.float32)
    for plane_corrected in (False, True):
        found = np.asarray(depth_count(depth, scale=4.0, plane_corrected=plane_corrected))
        assert (found >= 0.0).all() and (found <= 1.0).all()
    assert float(depth_count(np.repeat([0.0, 1.0], 8).astype(np.float32), scale=4.0)) == 1.0


def test_a_step_of_one_level_of_8_bits():
    """Reference sheet, section 7: a half/half step has variance 3.8e-6, which is noise in an 8-bit channel."""
    depth = np.repeat([127, 128], 8).astype(np.float32) / np.float32(255)
    assert float(depth_count(depth, scale=1.0)) == pytest.approx(3.8e-6, abs=0.05e-6)


@pytest.mark.parametrize("size", [2, 3, 4, 5])
def test_a_small_variance_far_away_keeps_its_digits(size, rng):
    """At depth 1e4 float32 has steps of 1e-3, and its squares have steps of 8: E[d²] - E[d]² would be lost."""
    depth = (1e4 + rng.normal(scale=0.5, size=(50, size**2))).astype(np.float32)
    every = np.ones(depth.shape, bool)
    found = np.asarray(depth_count(depth, scale=1.0))
    expected = depth_by_loop(depth, every)
    # An error e of the mean adds e² to the variance; the sum of n depths has an error of a few n eps.
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=(4 * 1e4 * np.finfo(np.float32).eps) ** 2)
    one_pass = (depth**2).mean(axis=1) - depth.mean(axis=1) ** 2
    assert np.median(np.abs(one_pass - expected)) > 100 * np.median(np.abs(found - expected))
    assert float(depth_count(np.full(size**2, 12345.678, np.float32), scale=1.0)) < 1e-5


# --- Normals


@pytest.mark.parametrize("size", SIZES)
def test_k_n_is_the_cone_around_the_mean(size, dtype, rng):
    normal, covered = bent(rng, 4, 5, size**2).astype(dtype), some(rng, 4, 5, size**2)
    found = normal_count(normal, scale=16.0, covered=covered)
    assert found.dtype == dtype and found.shape == (4, 5)
    atol = 64 * 16 * np.finfo(dtype).eps
    np.testing.assert_allclose(found, 16.0 * cone_by_loop(normal, covered), rtol=0, atol=atol)
    expected = 16.0 * cone_by_loop(normal, np.ones(covered.shape, bool))
    np.testing.assert_allclose(normal_count(normal, scale=16.0), expected, rtol=0, atol=atol)


@pytest.mark.parametrize(
    ("degrees", "cone"),
    [(1, 0.012), (5, 0.062), (10, 0.123), (30, 0.366), (45, 0.541), (60, 0.707), (90, 1.0)],
)
def test_the_numbers_of_the_reference_sheet(degrees, cone):
    """Section 7. Two normals along the axis, two turned away from it to either side."""
    t = np.radians(degrees)
    window = [[0, 0, 1], [0, 0, 1], [math.sin(t), 0, math.cos(t)], [-math.sin(t), 0, math.cos(t)]]
    found = float(normal_count(np.array(window, np.float32), scale=1.0))
    assert found == pytest.approx(cone, abs=0.0006)
    assert found == pytest.approx(math.sqrt(1.0 - math.cos(t)), abs=1e-6)


def test_an_edge_between_two_planes_is_half_of_their_angle():
    for degrees in (2, 90, 178):
        t = math.radians(degrees)
        window = np.array([[0, 0, 1]] * 8 + [[math.sin(t), 0, math.cos(t)]] * 8, np.float32)
        assert float(normal_count(window, scale=16.0)) == pytest.approx(16 * math.sqrt(1 - math.cos(t / 2)), rel=1e-5)


def test_small_angles_keep_their_digits():
    """1 - cos of 0.01 degrees has no digit left in float32; √(1 - cos t) is t/√2."""
    for degrees in (0.3, 0.03, 0.003):
        t = math.radians(degrees)
        window = np.array([[0, 0, 1], [0, 0, 1], [t, 0, 1], [-t, 0, 1]], np.float32)
        assert float(normal_count(window, scale=1.0)) == pytest.approx(t / math.sqrt(2), rel=1e-4)


def test_equal_normals_have_no_count(rng):
    normal = np.repeat(unit(rng.normal(size=(50, 1, 3))), 9, axis=1).astype(np.float32)
    np.testing.assert_allclose(normal_count(normal, scale=16.0), 0.0, atol=16 * 1e-6)


def test_back_faces_fold_over(rng):
    """Of normals n and -n all lie on one axis; turning some of a bent window changes the mean, not the rule."""
    n = unit(rng.normal(size=(20, 1, 3)))
    signs = np.where(np.arange(9) < 3, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(normal_count((n * signs).astype(np.float32), scale=16.0), 0.0, atol=16 * 1e-6)
    turned = bent(rng, 20, 9, bend=0.05) * signs
    expected = 16.0 * cone_by_loop(turned, np.ones((20, 9), bool))
    np.testing.assert_allclose(normal_count(turned.astype(np.float32), scale=16.0), expected, rtol=0, atol=1e-4)


def test_normals_that_cancel_out_have_the_full_count(dtype, rng):
    tilted = unit(rng.normal(size=3))
    across = unit(np.cross(tilted, [1.0, 0.0, 0.0]))
    for window in ([tilted, -tilted, across, -across], [tilted, tilted, -tilted, -tilted]):
        window = np.array(window, dtype)
        assert float(normal_count(window, scale=16.0)) == 16.0
        assert float(normal_count(window, scale=16.0, covered=np.array([True, False, False, False]))) == 0.0
        slope = jax.jit(jax.grad(lambda n: normal_sample_count(n, scale=16.0)))(window)
        assert np.isfinite(slope).all()


def test_k_n_lies_between_0_and_c(rng):
    normal = unit(rng.normal(size=(200, 4, 3))).astype(np.float32)
    found = np.asarray(normal_count(normal, scale=7.0, covered=some(rng, 200, 4)))
    assert (found >= 0.0).all() and (found <= 7.0).all()


# --- Order, background


@pytest.mark.parametrize("size", [2, 3, 4])
def test_the_order_of_sub_samples_does_not_matter(size, rng):
    depth, normal = rng.uniform(size=(6, size**2)).astype(np.float32), bent(rng, 6, size**2).astype(np.float32)
    covered = rng.uniform(size=(6, size**2)) < 0.7
    before = depth_count(depth, scale=4.0, covered=covered), normal_count(normal, scale=4.0, covered=covered)
    for _ in range(10):
        order = rng.permutation(size**2)
        by_depth = depth_count(depth[:, order], scale=4.0, covered=covered[:, order])
        by_normal = normal_count(normal[:, order], scale=4.0, covered=covered[:, order])
        np.testing.assert_allclose(by_depth, before[0], atol=1e-6)
        np.testing.assert_allclose(by_normal, before[1], atol=1e-5)


@pytest.mark.parametrize("size", [2, 3, 4])
def test_without_its_plane_a_window_may_be_turned_and_mirrored(size, rng):
    depth = rng.uniform(size=(6, size, size)).astype(np.float32)
    covered = np.ones((6, size, size), bool)
    covered[:3, 0, 1] = False

    def count(turn):
        return depth_count(
            turn(depth).reshape(6, -1), scale=4.0, covered=turn(covered).reshape(6, -1), plane_corrected=True
        )

    before = count(lambda v: v)
    for k in range(4):
        for transpose in (False, True):
            found = count(lambda v, k=k, t=transpose: np.rot90(v.swapaxes(1, 2) if t else v, k, axes=(1, 2)))
            np.testing.assert_allclose(found, before, atol=3e-6)


@pytest.mark.parametrize("size", [2, 3, 4])
def test_what_lies_in_empty_sub_samples_does_not_matter(size, dtype, rng):
    """Neither for counts, nor for their slopes, which are 0 there."""
    depth, normal = rng.uniform(size=(40, size**2)).astype(dtype), bent(rng, 40, size**2).astype(dtype)
    covered = some(rng, 40, size**2)
    kernels = {
        "depth": (depth, lambda v: depth_sample_count(v, scale=4.0, covered=covered)),
        "plane": (depth, lambda v: depth_sample_count(v, scale=4.0, covered=covered, plane_corrected=True)),
        "normal": (normal, lambda v: normal_sample_count(v, scale=4.0, covered=covered)),
    }
    for name, (values, kernel) in kernels.items():
        compiled = jax.jit(kernel, compiler_options=_OPTIONS)
        slope = jax.jit(jax.grad(lambda v, kernel=kernel: kernel(v).sum()), compiler_options=_OPTIONS)
        wild = with_junk(rng, values, covered)
        np.testing.assert_array_equal(compiled(wild), compiled(values), err_msg=name)
        np.testing.assert_array_equal(slope(wild), slope(values), err_msg=name)
        np.testing.assert_array_equal(np.asarray(slope(wild))[~covered], 0.0, err_msg=name)


@pytest.mark.parametrize("size", [2, 3])
def test_background_never_raises_a_count(size):
    """A window of one surface has count 0, however much of it is empty, and whatever is there."""
    n = size**2
    covered = (np.arange(2**n)[:, None] >> np.arange(n)) % 2 > 0
    normal = np.broadcast_to(np.array([0.6, 0.0, 0.8]), (2**n, n, 3))
    for junk in JUNK:
        depth = np.where(covered, 0.5, junk).astype(np.float32)
        np.testing.assert_allclose(depth_count(depth, scale=2e4, covered=covered), 0.0, atol=1e-9)
        corrected = depth_count(depth, scale=2e4, covered=covered, plane_corrected=True)
        np.testing.assert_allclose(corrected, 0.0, atol=1e-9)
        wild = np.where(covered[..., None], normal, junk).astype(np.float32)
        np.testing.assert_allclose(normal_count(wild, scale=16.0, covered=covered), 0.0, atol=1e-5)


def test_fewer_than_two_sub_samples_have_count_0(rng):
    depth, normal = rng.uniform(size=(4, 4)).astype(np.float32), unit(rng.normal(size=(4, 4, 3))).astype(np.float32)
    for covered in (np.eye(4, dtype=bool), np.zeros((4, 4), bool)):
        for plane_corrected in (False, True):
            found = depth_count(depth, scale=1e4, covered=covered, plane_corrected=plane_corrected)
            np.testing.assert_array_equal(found, 0.0)
        np.testing.assert_array_equal(normal_count(normal, scale=16.0, covered=covered), 0.0)
    assert float(depth_count(np.zeros(1, np.float32), scale=1.0)) == 0.0
    assert float(normal_count(np.ones((1, 3), np.float32), scale=1.0)) == 0.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_covered_value_that_is_not_finite_makes_count_0(wrong, rng):
    depth, normal = rng.uniform(size=(4, 4)).astype(np.float32), unit(rng.normal(size=(4, 4, 3))).astype(np.float32)
    for plane_corrected in (False, True):
        wild = np.where(np.eye(4, dtype=bool), np.float32(wrong), depth)
        np.testing.assert_array_equal(depth_count(wild, scale=1e4, plane_corrected=plane_corrected), 0.0)
    for axis in range(3):
        wild = np.where(np.eye(4, dtype=bool)[..., None] & (np.arange(3) == axis), np.float32(wrong), normal)
        np.testing.assert_array_equal(normal_count(wild, scale=16.0), 0.0, err_msg="normals")


# --- Shading


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1), (2, 2), (6, 7)])
def test_k_s_and_steps_are_those_of_the_cross(shape, dtype, rng):
    for contrast in (1.0, 0.2):
        luminance = (0.5 + contrast * (rng.uniform(size=shape) - 0.5)).astype(dtype)
        for covered in (np.ones(shape, bool), rng.uniform(size=shape) < 0.6):
            wild = with_junk(rng, luminance, covered)
            for options in ({}, {"edge_threshold": 0.3, "min_threshold": 0.2}):
                expected = shading_by_loop(luminance, covered, **options)
                np.testing.assert_allclose(
                    shading_count(wild, scale=16.0, covered=covered, **options), expected, rtol=4 * np.finfo(dtype).eps
                )
            np.testing.assert_allclose(steps(wild, covered=covered), steps_by_loop(luminance, covered), rtol=1e-6)
        np.testing.assert_array_equal(
            shading_count(luminance, scale=16.0), shading_count(luminance, scale=16.0, covered=np.ones(shape, bool))
        )
        np.testing.assert_array_equal(steps(luminance), steps(luminance, covered=np.ones(shape, bool)))


def test_an_isolated_bright_pixel_counts_with_those_beside_it():
    """The centre is part of the range: else it would have none itself. Diagonal neighbours are no part of it."""
    luminance = np.zeros((3, 3), np.float32)
    luminance[1, 1] = 0.6
    plus = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]])
    np.testing.assert_allclose(shading_count(luminance, scale=10.0), 6.0 * plus, rtol=1e-6)
    expected = np.zeros((3, 3, 2))
    expected[1, :, 0] = expected[:, 1, 1] = 0.6
    np.testing.assert_allclose(steps(luminance), expected, rtol=1e-6)


def test_the_thresholds_are_reached_when_they_are_equalled():
    """Powers of two, so that nothing is rounded."""
    below = lambda value: np.nextafter(np.float32(value), np.float32(0))  # noqa: E731
    least = lambda r: shading_count(np.array([[0.0, r]], np.float32), scale=16.0, min_threshold=1 / 16)  # noqa: E731
    np.testing.assert_array_equal(least(1 / 16), [[1.0, 1.0]])
    np.testing.assert_array_equal(least(below(1 / 16)), [[0.0, 0.0]])
    share = lambda low: shading_count(np.array([[low, 1.0]], np.float32), scale=16.0, edge_threshold=1 / 8)  # noqa: E731
    np.testing.assert_array_equal(share(7 / 8), [[2.0, 2.0]])
    np.testing.assert_array_equal(share(np.nextafter(np.float32(7 / 8), np.float32(1))), [[0.0, 0.0]])
    everything = shading_count(np.array([[0.5, 0.5]], np.float32), scale=16.0, edge_threshold=0.0, min_threshold=0.0)
    np.testing.assert_array_equal(everything, [[0.0, 0.0]])


def test_an_edge_changes_the_shading_along_one_axis():
    y, x = np.mgrid[:6, :8]
    upright = np.where(x < 4, 0.2, 0.9).astype(np.float32)
    found = np.asarray(steps(upright))
    assert (found[..., 1] == 0.0).all()
    np.testing.assert_allclose(found[..., 0], np.where((x == 3) | (x == 4), 0.7, 0.0), rtol=1e-6)
    np.testing.assert_array_equal(steps(np.ascontiguousarray(upright.T)), found.swapaxes(0, 1)[..., ::-1])
    ramp = np.asarray(steps((0.01 * x + 0.02 * y).astype(np.float32)))
    np.testing.assert_allclose(ramp, np.broadcast_to([0.01, 0.02], ramp.shape), rtol=1e-5)


@pytest.mark.parametrize("junk", JUNK)
def test_empty_pixels_are_no_neighbours_of_the_shading(junk):
    luminance = np.full((3, 3), 0.5, np.float32)
    covered = np.ones((3, 3), bool)
    covered[1, 1] = covered[0, 2] = False
    luminance[~covered] = junk
    np.testing.assert_array_equal(shading_count(luminance, scale=16.0, covered=covered), 0.0)
    np.testing.assert_array_equal(steps(luminance, covered=covered), 0.0)


# --- Counts


@pytest.mark.parametrize("size", SIZES)
def test_whole_counts_are_rounded_up_and_clamped(size):
    n = size * size
    metric = np.array([-1e9, -0.5, 0.0, 1e-6, 1.0, 1.000001, 2.5, n - 0.5, n, n + 0.01, 1e30, np.inf], np.float32)
    expected = [min(max(math.ceil(min(m, 1e6)), 1), n) for m in metric.tolist()]
    found = jax.jit(lambda m: sample_count(m, size=size))(metric)
    assert found.dtype == jnp.int32 and found.tolist() == expected


def test_the_largest_metric_decides(rng):
    metrics = [rng.uniform(-2, 12, (4, 5)).astype(np.float32) for _ in range(3)]
    expected = np.clip(np.ceil(np.max(metrics, axis=0)), 1, 9)
    for order in ((0, 1, 2), (2, 0, 1)):
        np.testing.assert_array_equal(sample_count(*(jnp.asarray(metrics[i]) for i in order), size=3), expected)


@pytest.mark.parametrize("allowed", [(1, 2, 4, 9), (9,), (3, 9), tuple(range(1, 10))])
def test_allowed_counts_are_the_next_ones_up(allowed):
    metric = np.linspace(-1, 11, 49).astype(np.float32)
    expected = [min(k for k in allowed if k >= min(max(math.ceil(m), 1), 9)) for m in metric.tolist()]
    assert jax.jit(lambda m: sample_count(m, size=3, allowed=allowed))(metric).tolist() == expected


def test_balanced_counts():
    """Reference sheet, section 13, for the printed matrices; 1 and m² are always there."""
    assert balanced_counts(2) == (1, 2, 4) and balanced_counts(3) == (1, 5, 9)
    assert balanced_counts(4) == (1, 2, 6, 8, 10, 14, 16)
    assert balanced_counts(5) == (1, 2, 4, 8, 16, 25) and balanced_counts(8) == (1, 2, 4, 8, 16, 32, 64)
    for size in range(1, 12):
        counts = balanced_counts(size)
        assert counts[0] == 1 and counts[-1] == size**2 and list(counts) == sorted(set(counts))
        assert sample_count(jnp.ones(1), size=size, allowed=counts).tolist() == [1]
    assert set(BALANCED) == {1, 2, 3, 4}


def test_the_settings_are_frozen():
    settings = SampleMetrics()
    assert not settings.plane_corrected and settings.scale == 1.0, "as in the paper"
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.scale = 2.0


@pytest.mark.parametrize("shape", [(1, 1), (6, 6), (7, 13), (5, 12), (2, 3)])
def test_tiles_get_their_largest_count(shape, rng):
    count = rng.integers(1, 17, shape).astype(np.int32)
    for tile in (1, 2, 6, 20):
        found = np.asarray(jax.jit(tile_maximum, static_argnames="tile")(count, tile=tile))
        assert found.dtype == np.int32
        for y, x in np.ndindex(shape):
            top, left = y // tile * tile, x // tile * tile
            assert found[y, x] == count[top : top + tile, left : left + tile].max()


def test_an_average_over_frames_rises_at_once_and_falls_slowly(rng):
    """A single peak of height 1 is share^k after k frames."""
    metric, previous = rng.uniform(size=(2, 5, 6))
    found = average_over_frames(jnp.asarray(metric, jnp.float32), jnp.asarray(previous, jnp.float32), share=0.7)
    np.testing.assert_allclose(found, np.maximum(metric, 0.7 * previous + 0.3 * metric), rtol=1e-6)
    value = jnp.zeros((1, 1))
    for frame in range(12):
        value = average_over_frames(jnp.full((1, 1), float(frame == 3)), value, share=0.8)
        expected = 0.8 ** (frame - 3) if frame >= 3 else 0.0
        np.testing.assert_allclose(value, [[expected]], rtol=1e-5)
    same = jnp.asarray(metric, jnp.float32)
    np.testing.assert_allclose(average_over_frames(same, same), same, rtol=1e-6)
    np.testing.assert_array_equal(average_over_frames(same, 2.0 * same, share=0.0), same)


# --- Slopes, batches, large images, bad input


def check_slopes(kernel, *arguments) -> None:
    """Against finite differences."""
    check_grads(jax.jit(kernel), tuple(map(jnp.asarray, arguments)), order=1, modes=("rev",))


@pytest.mark.parametrize("plane_corrected", [False, True])
def test_slopes_of_k_d(plane_corrected, rng, x64):
    depth, covered = rng.uniform(size=(3, 9)), rng.uniform(size=(3, 9)) < 0.8
    options = {"covered": jnp.asarray(covered), "plane_corrected": plane_corrected}
    check_slopes(lambda d, c: depth_sample_count(d, scale=c, **options), depth, 3.0)


def test_slopes_of_k_n(rng, x64):
    """Of normals that are normalised first. The farthest one decides: others have a slope by the axis alone."""
    covered = jnp.asarray(rng.uniform(size=(3, 9)) < 0.8)

    def kernel(v, c):
        normal = v / jnp.sqrt(jnp.sum(v * v, axis=-1, keepdims=True))
        return normal_sample_count(normal, scale=c, covered=covered)

    check_slopes(kernel, bent(rng, 3, 9), 3.0)


def test_equal_normals_have_no_slope(dtype, rng):
    slope = jax.jit(jax.grad(lambda n: normal_sample_count(n, scale=16.0)), compiler_options=_OPTIONS)
    for normal in (np.array([0.0, 0.0, 1.0]), *unit(rng.normal(size=(6, 3)))):
        window = np.repeat(normal[None], 9, axis=0).astype(dtype)
        np.testing.assert_array_equal(slope(window), 0.0, err_msg=f"normal {normal}")


def test_flat_windows_have_no_slope():
    slope = jax.jit(jax.grad(lambda d: depth_sample_count(d, scale=2e4, plane_corrected=True)))
    np.testing.assert_array_equal(slope(np.full(16, 0.25, np.float32)), 0.0)


def test_slopes_of_k_s_and_steps(rng, x64):
    luminance, covered = rng.uniform(size=(5, 6)), jnp.asarray(rng.uniform(size=(5, 6)) < 0.8)
    check_slopes(lambda v, c: shading_sample_count(v, scale=c, covered=covered), luminance, 3.0)
    check_slopes(lambda v: shading_steps(v, covered=covered), luminance)
    flat = jax.jit(jax.grad(lambda v: shading_sample_count(v, scale=16.0).sum() + shading_steps(v).sum()))
    assert np.isfinite(flat(np.ones((4, 4)))).all()


def test_slopes_of_k_s_with_junk_beside(rng):
    covered = rng.uniform(size=(5, 6)) < 0.6
    wild = with_junk(rng, rng.uniform(size=(5, 6)).astype(np.float32), covered)

    def total(v):
        return shading_sample_count(v, scale=3.0, covered=covered).sum() + shading_steps(v, covered=covered).sum()

    slope = np.asarray(jax.jit(jax.grad(total), compiler_options=_OPTIONS)(wild))
    assert np.isfinite(slope).all()
    np.testing.assert_array_equal(slope[~covered], 0.0)


def test_slopes_of_the_average_over_frames(rng, x64):
    check_slopes(average_over_frames, *rng.uniform(size=(2, 4, 5)))


KERNELS = {
    "depth": lambda d, c: depth_sample_count(d, scale=3.0, covered=c, plane_corrected=True),
    "normal": lambda n, c: normal_sample_count(n, scale=3.0, covered=c),
    "shading": lambda v, c: shading_sample_count(v, scale=3.0, covered=c),
    "steps": lambda v, c: shading_steps(v, covered=c),
    "count": lambda v, c: tile_maximum(sample_count(16 * v, size=4), tile=3),
    "average": lambda v, c: average_over_frames(v, v[::-1]),
}


@pytest.mark.parametrize("name", KERNELS)
def test_vmap_is_a_loop_and_jit_is_eager(name, rng):
    values = bent(rng, 3, 4, 9) if name == "normal" else rng.uniform(size=(3, 4, 9))
    values, covered = values.astype(np.float32), rng.uniform(size=(3, 4, 9)) < 0.8
    kernel = KERNELS[name]
    compiled = jax.jit(kernel, compiler_options=_OPTIONS)
    loop = np.stack([compiled(v, c) for v, c in zip(values, covered, strict=True)])
    np.testing.assert_allclose(kernel(jnp.asarray(values[0]), jnp.asarray(covered[0])), loop[0], atol=1e-6)
    whole = jax.jit(jax.vmap(kernel), compiler_options=_OPTIONS)(values, covered)
    np.testing.assert_allclose(whole, loop, atol=1e-6)
    if name in ("depth", "normal"):
        np.testing.assert_allclose(compiled(values, covered), loop, atol=1e-6, err_msg="leading axes")


@pytest.mark.parametrize("n", [4, 9, 16])
def test_a_large_image_has_the_counts_of_its_windows(n, rng):
    """As optimised: jaxlib 0.10.2 compiles some sums of products with a broadcast factor wrongly, at this size only."""
    normal, depth = bent(rng, 120, 250, n).astype(np.float32), rng.uniform(size=(120, 250, n)).astype(np.float32)
    covered = rng.uniform(size=(120, 250, n)) < 0.8
    there = covered[..., None] & (covered.sum(-1) > 1)[..., None, None]
    wide = np.where(there, normal.astype(np.float64), 0.0)
    mean = unit(wide.sum(2) + np.where(there.any(2), 0.0, 1.0))
    cosine = np.where(there[..., 0], np.abs((wide * mean[:, :, None]).sum(-1)), 1.0)
    expected = np.sqrt(np.clip(1.0 - cosine.min(-1), 0, 1))
    found = jax.jit(lambda v, c: normal_sample_count(v, scale=1.0, covered=c))(normal, covered)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
    count = np.maximum(covered.sum(-1), 1)
    mean = np.where(covered, depth, 0.0).sum(-1) / count
    expected = np.where(covered, (depth - mean[..., None]) ** 2, 0.0).sum(-1) / count
    for plane_corrected in (False, True):
        options = {"scale": 1.0, "plane_corrected": plane_corrected}
        found = np.asarray(jax.jit(lambda d, c, o=options: depth_sample_count(d, covered=c, **o))(depth, covered))
        if plane_corrected:
            assert (found <= expected + 1e-6).all()
            expected = depth_by_loop(depth[:4], covered[:4], plane=True)
            found = found[:4]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


ZERO = jnp.zeros


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: depth_sample_count(ZERO((2, 4)), scale=1.0, covered=ZERO((2, 3), bool)),
            "sub-samples and covered: exp",
        ),
        (
            lambda: depth_sample_count(ZERO((2, 5)), scale=1.0, plane_corrected=True),
            "sub-samples: expected m x m, got 5",
        ),
        (lambda: normal_sample_count(ZERO((4, 2)), scale=1.0), r"normal: expected shape \(..., 3\), got \(4, 2\)"),
        (lambda: normal_sample_count(ZERO((4, 3)), scale=1.0, covered=ZERO(3, bool)), "sub-samples and covered"),
        (lambda: shading_sample_count(ZERO((4, 3)), scale=1.0, covered=ZERO((3, 4), bool)), "covered: expected one"),
        (lambda: shading_sample_count(ZERO(4), scale=1.0), "luminance: "),
        (lambda: shading_steps(ZERO((4, 3)), covered=ZERO((3, 4), bool)), "covered: expected one shape"),
        (lambda: shading_steps(ZERO(4)), "luminance: "),
        (lambda: sample_count(ZERO(4), size=0), "size: expected a value >= 1, got 0"),
        (lambda: sample_count(size=2), "metrics: "),
        (lambda: sample_count(ZERO(4), ZERO(3), size=2), "metrics: expected one shape"),
        (lambda: sample_count(ZERO(4), size=2, allowed=()), "allowed: expected ascending counts .* 4"),
        (lambda: sample_count(ZERO(4), size=2, allowed=(1, 2)), "allowed: expected ascending counts .* 4"),
        (lambda: sample_count(ZERO(4), size=2, allowed=(2, 1, 4)), "allowed"),
        (lambda: sample_count(ZERO(4), size=2, allowed=(1, 1, 4)), "allowed"),
        (lambda: sample_count(ZERO(4), size=2, allowed=(0, 4)), "allowed"),
        (lambda: sample_count(ZERO(4), size=2, allowed=(1, 5)), "allowed"),
        (lambda: balanced_counts(0), "size: expected a value >= 1"),
        (lambda: tile_maximum(ZERO((4, 4), jnp.int32), tile=0), "tile: expected a value >= 1"),
        (lambda: average_over_frames(ZERO((4, 4)), ZERO((4, 3))), "metric and previous: expected one shape"),
        (lambda: average_over_frames(ZERO((4, 4)), ZERO((4, 4)), share=1.0), r"share: expected .* \[0, 1\)"),
        (lambda: average_over_frames(ZERO((4, 4)), ZERO((4, 4)), share=math.nan), "share: "),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
