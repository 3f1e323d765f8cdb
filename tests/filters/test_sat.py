"""Tables, window means and variances: definitions, rounding at full size, masked pixels, derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters import box_mean, box_sum_from_table, box_variance, summed_area_table
from tests.filters import oracle

# Compiling is nearly all of the time for small images.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
moments = jax.jit(
    lambda image, radius: (box_mean(image, radius=radius), box_variance(image, radius=radius)), static_argnums=1
)
quick_moments = quick(
    lambda image, radius: (box_mean(image, radius=radius), box_variance(image, radius=radius)), static_argnums=1
)

window_of_table = jax.jit(lambda image: box_sum_from_table(summed_area_table(image), radius=1))

UNIT = 2.0**-24  # a rounding of float32
SIZE = 4096


def spoiled(image: np.ndarray) -> np.ndarray:
    """A corner, a border pixel and one in the middle are not finite."""
    image = image.copy()
    image[:3, :3, 0], image[4, -1, -1], image[5, 4, 0] = np.nan, np.inf, -np.inf
    return image


def large(name: str) -> np.ndarray:
    """One channel in [0, 1], with spikes, or with a large offset."""
    rng = np.random.default_rng(5)
    noise = rng.random((SIZE, SIZE), dtype=np.float32)
    if name == "spikes":
        noise[rng.integers(0, SIZE, 2000), rng.integers(0, SIZE, 2000)] = 1e4
    return 1000.0 + np.float32(1e-2) * noise if name == "nearly constant" else noise


# --- The raw table


def test_the_table_is_made_of_sums(rng):
    image = rng.integers(-9, 9, size=(5, 7, 2)).astype(np.float32)
    table = summed_area_table(jnp.asarray(image))
    assert table.shape == (6, 8, 2) and table.dtype == jnp.float32
    for y, x in np.ndindex(6, 8):
        np.testing.assert_array_equal(table[y, x], image[:y, :x].sum((0, 1)))


@pytest.mark.parametrize("radius", [0, 1, 3, 50])
def test_four_corners_are_a_window(radius, rng):
    image = rng.integers(-9, 9, size=(6, 9, 2)).astype(np.float32)
    found = box_sum_from_table(summed_area_table(jnp.asarray(image)), radius=radius)
    np.testing.assert_array_equal(found, oracle.of_windows(image, radius, lambda pixels: pixels.sum(0)))


def test_a_nan_spoils_the_table_below_and_to_the_right():
    with jax.debug_nans(False):
        table = np.asarray(summed_area_table(jnp.ones((6, 7, 1)).at[2, 3].set(jnp.nan)))
    np.testing.assert_array_equal(np.isnan(table[..., 0]), np.pad(np.ones((4, 4), bool), ((3, 0), (4, 0))))


def test_a_raw_table_loses_what_the_docstring_says():
    """Variances of 3 x 3 pixels of noise, 0.074 on average, from float32 tables of the values and their squares."""
    for size, least_worst, least_average in ((1024, 5e-3, 5e-4), (SIZE, 0.2, 1e-2)):
        image = large("noise")[:size, :size, None]
        sums, squares = (np.asarray(window_of_table(x)) for x in (image, image**2))
        error = squares / 9.0 - (sums / 9.0) ** 2 - np.asarray(moments(image, 1)[1])
        error = error[1:-1, 1:-1]
        assert np.abs(error).max() > max(least_worst, 1e-5) and np.sqrt(np.mean(error**2)) > least_average
        assert (squares / 9.0 - (sums / 9.0) ** 2)[1:-1, 1:-1].min() < 0.0


# --- Means and variances


@pytest.mark.parametrize("radius", [0, 1, 3, 50])
@pytest.mark.parametrize("shape", [(7, 9, 2), (1, 1, 1), (1, 6, 3), (8, 1, 1)])
def test_they_are_those_of_each_window(shape, radius, rng, x64):
    image = rng.normal(size=shape)
    for x in (image, spoiled(image)) if shape[0] == 7 else (image,):
        with jax.debug_nans(False):
            mean, variance = quick_moments(x, radius)
        np.testing.assert_allclose(mean, oracle.of_windows(x, radius, oracle.mean), atol=1e-14)
        np.testing.assert_allclose(variance, oracle.of_windows(x, radius, oracle.variance), atol=1e-14)
        assert (np.asarray(variance) >= 0.0).all()


def test_a_window_without_valid_pixels_gives_0(rng):
    image = spoiled(rng.normal(size=(7, 9, 2)).astype(np.float32))
    for x in (image, np.full_like(image, np.inf)):
        with jax.debug_nans(False):
            mean, variance = quick_moments(x, 1)
        assert not mean[:2, :2].any() and not variance[:2, :2].any()
        assert np.isfinite(mean).all() and np.isfinite(variance).all()
    assert not mean.any() and not variance.any()


@pytest.mark.parametrize("name", ["noise", "spikes", "nearly constant"])
def test_rounding_at_full_size(name):
    """Against float64. Errors are a few roundings of what is in the window, and so far below the squared range."""
    image, rows = large(name), np.append(np.arange(0, SIZE, 61), SIZE - 1)
    center = image.mean(dtype=np.float64)
    away = image - center
    extent = float(image.max() - image.min())
    ones = np.ones_like(image)
    for radius in (1, 7, 64, 512):
        count = oracle.window_sums(ones, radius, rows)
        first, second = (oracle.window_sums(x, radius, rows) / count for x in (away, away**2))
        mean, variance = (np.asarray(x) for x in moments(image[..., None], radius))
        additions = 2.0 * np.log2(2 * radius + 1) + 4.0
        assert (np.abs(mean[rows, :, 0] - (center + first)) <= additions * UNIT * (center + first)).all()
        error = np.abs(variance[rows, :, 0] - (second - first**2))
        assert error.max() <= 1e-6 * extent**2  # what the docstring says
        assert (error <= 3.0 * (additions + 2.0) * UNIT * second).all()
        assert variance.min() >= 0.0


def test_an_offset_costs_no_precision(rng):
    image = rng.integers(0, 256, size=(40, 30, 1)).astype(np.float32)
    before, after = (quick_moments(x, 2)[1] for x in (image, image + 2.0**15))
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-6 * 255.0**2)


def test_a_variance_is_never_negative(rng):
    """Flat blocks far from the mean of the image, where the difference of moments is rounding alone."""
    image = np.kron(rng.uniform(size=(6, 6, 1)), np.ones((9, 9, 1))).astype(np.float32)
    variance = np.asarray(quick_moments(image, 3)[1])
    assert variance.min() >= 0.0
    np.testing.assert_allclose(variance[4::9, 4::9], 0.0, atol=1e-6)


def test_scaling_constants_and_channels(rng):
    image = rng.uniform(size=(20, 24, 3)).astype(np.float32)
    mean, variance = quick_moments(image, 3)
    scaled = quick_moments(4.0 * image, 3)
    np.testing.assert_array_equal(scaled[0], 4.0 * np.asarray(mean))
    np.testing.assert_array_equal(scaled[1], 16.0 * np.asarray(variance))
    one = quick_moments(image[..., 1:2], 3)
    np.testing.assert_allclose(one[0], mean[..., 1:2], rtol=1e-6)
    np.testing.assert_allclose(one[1], variance[..., 1:2], rtol=1e-5, atol=1e-7)
    constant = quick_moments(np.full((20, 24, 3), 0.7, np.float32), 3)
    np.testing.assert_allclose(constant[0], 0.7, rtol=1e-6)
    assert np.abs(constant[1]).max() < 1e-12


@pytest.mark.parametrize("half", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_summed_in_float32(half, rng):
    """A window of 41² ones overflows float16 sums of squares, and stops bfloat16 at 256."""
    image = jnp.asarray(rng.uniform(size=(50, 45, 2)) + 8.0, half)
    wide = image.astype(jnp.float32)
    for found, expected in zip(quick_moments(image, 20), quick_moments(wide, 20), strict=True):
        assert found.dtype == half
        np.testing.assert_array_equal(found, expected.astype(half))


def test_a_batch_is_its_images_and_jit_changes_nothing(rng):
    images = rng.uniform(size=(3, 9, 8, 2)).astype(np.float32)
    for kernel in (box_mean, box_variance):
        one = functools.partial(kernel, radius=2)
        together = quick(jax.vmap(one))(images)
        for found, image in zip(together, images, strict=True):
            np.testing.assert_allclose(found, quick(one)(image), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(box_mean(jnp.asarray(images[0]), radius=2), quick_moments(images[0], 2)[0], rtol=1e-6)


# --- Derivatives and bad input


def test_derivatives_are_finite_differences(rng, x64):
    image, along, mix = rng.normal(size=(3, 7, 9, 2))
    image = spoiled(image)
    along = np.where(np.isfinite(image), along, 0.0)

    def objective(x):
        return jnp.sum(mix * (box_mean(x, radius=2) + box_variance(x, radius=1)))

    with jax.debug_nans(False):
        value_and_slope = quick(jax.value_and_grad(objective))
        _, slope = value_and_slope(image)
        ends = [value_and_slope(image + sign * 1e-5 * along)[0] for sign in (-1, 1)]
    slope = np.asarray(slope)
    assert not slope[~np.isfinite(image).all(-1)].any()
    np.testing.assert_allclose(np.sum(slope * along), (ends[1] - ends[0]) / 2e-5, rtol=1e-8)


def test_slopes_at_a_constant_image_are_finite():
    slope = quick(jax.grad(lambda x: box_variance(x, radius=1).sum()))(jnp.full((5, 6, 1), 0.3))
    np.testing.assert_allclose(slope, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: box_mean(jnp.zeros((3, 3, 1)), radius=-1), ValueError, "radius: expected a value >= 0, got -1"),
        (lambda: box_variance(jnp.zeros((3, 3, 1)), radius=-2), ValueError, "radius: expected a value >= 0"),
        (lambda: box_sum_from_table(jnp.zeros((3, 3, 1)), radius=-1), ValueError, "radius: expected a value >= 0"),
        (lambda: box_mean(jnp.zeros((3, 3)), radius=1), ValueError, r"shape: expected \(h, w, c\)"),
        (lambda: box_mean(jnp.zeros((0, 3, 1)), radius=1), ValueError, "not empty"),
        (lambda: box_variance(jnp.zeros((3, 3, 1), jnp.int32), radius=1), TypeError, "floating-point"),
    ],
)
def test_bad_input_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()
