"""jaxrender.filters.fireflies: brute force, known results, what stays, derivatives, bad input."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters.fireflies import _sorting_network, clamp_fireflies

# Compiling is nearly all of the time here.
_compiled = jax.jit(
    clamp_fireflies, static_argnames=("factor", "radius"), compiler_options={"xla_backend_optimization_level": 0}
)

REC_709 = np.array([0.2126, 0.7152, 0.0722])


def run(image, **options) -> tuple[np.ndarray, np.ndarray]:
    with jax.debug_nans(False):  # what is NaN stays
        return tuple(np.array(x) for x in _compiled(image, **options))


def sparse_noise(height: int, width: int, *, lit: float, seed: int = 1) -> np.ndarray:
    """Exponential noise of mean 1 in a share of the pixels, 0 in the others; coloured."""
    rng = np.random.default_rng(seed)
    light = np.where(rng.uniform(size=(height, width)) < lit, rng.exponential(size=(height, width)) / lit, 0.0)
    return (light[..., None] * rng.uniform(0.5, 1.5, (height, width, 3))).astype(np.float32)


def brute_force(image, *, factor=6.0, radius=2) -> tuple[np.ndarray, np.ndarray]:
    image = np.asarray(image, np.float64)
    measures = [image @ (REC_709 if image.shape[2] == 3 else np.ones(1)), image.max(-1)]
    scale = np.ones(image.shape[:2])
    for measure, times in zip(measures, (factor, 2.0 * factor), strict=True):
        light = np.where(np.isfinite(image).all(-1), measure, 0.0)
        for y, x in np.ndindex(light.shape):
            window = light[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
            limit = times * np.median(window[window > 0.0]) if light[y, x] > 0.0 else math.inf
            if light[y, x] > limit:
                scale[y, x] = min(scale[y, x], limit / light[y, x])
    return np.where((scale < 1.0)[..., None], image * scale[..., None], image), scale < 1.0


def clamped_by_luminance(image) -> np.ndarray:
    """Whether it is the luminance, and not the largest channel, that exceeds its median the more; factor 2."""
    excess = []
    for measure, factor in ((image @ REC_709, 2.0), (image.max(-1), 4.0)):
        gray = brute_force(measure[..., None], factor=factor)[0][..., 0]
        excess.append(np.divide(gray, measure, out=np.ones_like(gray), where=measure > 0.0))
    return excess[0] < excess[1]


# --- Against loops


@pytest.mark.parametrize(("lit", "radius"), [(1.0, 2), (0.5, 2), (0.3, 2), (0.3, 3), (0.6, 0), (0.6, 1)])
def test_it_is_the_median_of_the_lit_pixels(lit, radius):
    image = sparse_noise(11, 13, lit=lit)
    image[4, 4] *= 1e3
    image[3, 7], image[5, 2, 1], image[9, 9] = -0.2, np.nan, [1.0, np.inf, 0.0]
    found, clamped = run(image, factor=2.0, radius=radius)
    expected, where = brute_force(image, factor=2.0, radius=radius)
    np.testing.assert_array_equal(clamped, where)
    assert where.any() == (radius > 0)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (6, 1), (2, 3)])
def test_small_images(shape):
    image = sparse_noise(*shape, lit=0.9)
    for found, expected in zip(run(image, factor=1.5), brute_force(image, factor=1.5), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 9, 12])
def test_the_network_sorts_zeros_and_ones(size):
    """A network that sorts these sorts everything (Knuth, 5.3.4, theorem Z)."""
    rows = (np.arange(2**size)[:, None] >> np.arange(size)) & 1
    expected = np.sort(rows, axis=1)
    for low, high in _sorting_network(size):
        rows[:, low], rows[:, high] = rows[:, [low, high]].min(1), rows[:, [low, high]].max(1)
    np.testing.assert_array_equal(rows, expected)


@pytest.mark.parametrize("size", [25, 49, 121])
def test_the_network_sorts_windows(size, rng):
    rows = rng.integers(0, size, (200, size))
    expected = np.sort(rows, axis=1)
    for low, high in _sorting_network(size):
        rows[:, low], rows[:, high] = rows[:, [low, high]].min(1), rows[:, [low, high]].max(1)
    np.testing.assert_array_equal(rows, expected)


# --- Known results


def test_a_firefly_comes_down_to_the_limit_and_keeps_its_hue():
    image = np.full((9, 9, 3), 0.5, np.float32)
    image[4, 4] = [800.0, 100.0, 20.0]
    found, clamped = run(image)
    assert clamped.sum() == 1 and clamped[4, 4]
    np.testing.assert_allclose(found[4, 4].max(), 2.0 * 6.0 * 0.5, rtol=1e-6)
    np.testing.assert_allclose(found[4, 4] / found[4, 4, 0], image[4, 4] / image[4, 4, 0], rtol=1e-6)
    found[4, 4] = image[4, 4]
    np.testing.assert_array_equal(found, image)


@pytest.mark.parametrize("hue", [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.3], [1.0, 1.0, 1.0]])
def test_saturated_fireflies_are_held_by_their_largest_channel(hue):
    image = np.full((9, 9, 3), 0.1, np.float32)
    image[4, 4] = 20.0 * np.array(hue)
    found, clamped = run(image, factor=16.0)
    assert clamped.sum() == 1
    largest = min(3.2, 1.6 / (np.array(hue) @ REC_709))
    np.testing.assert_allclose(found[4, 4], largest * np.array(hue), rtol=1e-5, atol=1e-7)
    # In light of its own colour it is measured by that.
    blue = np.full((9, 9, 3), [0.01, 0.01, 2.0], np.float32)
    blue[4, 4] = [0.0, 0.0, 20.0]
    assert not run(blue, factor=16.0)[1].any()


def test_twelve_fireflies_in_a_window_of_25_are_all_found():
    image = np.ones((12, 13, 1), np.float32)
    image[4:7, 5:9] = 1e4
    found, clamped = run(image)
    np.testing.assert_array_equal(clamped, image[..., 0] > 1.0)
    np.testing.assert_allclose(found, np.minimum(image, 6.0), rtol=1e-6)


def test_lone_lights_in_the_dark_stay():
    """One in black, and two side by side with all the energy in one."""
    image = np.zeros((9, 20, 3), np.float32)
    image[4, 4], image[4, 14], image[4, 15] = 50.0, 1e-3, 1e3
    found, clamped = run(image)
    assert not clamped.any()
    np.testing.assert_array_equal(found, image)


@pytest.mark.parametrize("lit", [1.0, 0.6, 0.45, 0.1])
def test_sparse_light_keeps_its_energy_however_sparse(lit):
    """The median of all pixels keeps 98, 74, 82 and 100 %, and at 0.45 and 0.1 most of a firefly's energy."""
    image = sparse_noise(96, 128, lit=lit)
    found, clamped = run(image)
    assert 0.965 < found.sum() / image.sum() < 0.99 and 0.0 < clamped.mean() < 0.03
    flies = np.zeros((96, 128), bool)
    flies[5::16, 5::16] = True
    image[flies] = 1e3
    found, clamped = run(image)
    left = found[flies].sum() / image[flies].sum()
    assert left < (0.03 if lit > 0.4 else 0.6), left


def test_constants_and_dark_images_stay():
    for value in (0.0, -1.0, 7.0):
        image = np.full((5, 6, 3), value, np.float32)
        found, clamped = run(image, factor=1.0)
        assert not clamped.any()
        np.testing.assert_array_equal(found, image)


def test_pixels_that_are_not_finite_stay_and_do_not_count():
    image = np.ones((7, 7, 3), np.float32)
    image[2:5, 2:5], image[3, 3] = np.nan, 100.0
    image[3, 4, 0] = np.inf
    found, clamped = run(image)
    np.testing.assert_allclose(found[3, 3], 6.0, rtol=1e-6)
    assert clamped.sum() == 1
    image[3, 3] = found[3, 3]
    np.testing.assert_array_equal(found, image)


def test_one_channel_is_its_own_luminance():
    image = sparse_noise(9, 8, lit=0.8)[..., :1]
    image[3, 3] *= 50.0
    found, clamped = run(image, factor=3.0)
    expected, where = brute_force(image, factor=3.0)
    np.testing.assert_array_equal(clamped, where)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


# --- Types, programs, batches


@pytest.mark.parametrize("half", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_compared_in_float32(half):
    image = sparse_noise(8, 9, lit=0.9)
    image[4, 4] = 6e4
    image = np.asarray(image, half)
    (found, clamped), (wide, where) = run(image, factor=3.0), run(np.float32(image), factor=3.0)
    assert found.dtype == half and clamped.sum() > 1
    np.testing.assert_array_equal(clamped, where)
    np.testing.assert_array_equal(found, wide.astype(half))


def test_with_and_without_jit_and_in_batches():
    images = np.stack([sparse_noise(8, 9, lit=0.7, seed=s) for s in (1, 2)])
    together, where = jax.jit(jax.vmap(lambda i: clamp_fireflies(i, factor=3.0, radius=1)))(images)
    for k in range(2):
        found, clamped = clamp_fireflies(jnp.asarray(images[k]), factor=3.0, radius=1)
        np.testing.assert_array_equal(where[k], clamped)
        np.testing.assert_allclose(together[k], found, rtol=1e-6)
        np.testing.assert_array_equal(run(images[k], factor=3.0, radius=1)[1], clamped)


def test_medians_count_as_constants_in_derivatives(x64, rng):
    """So a clamped pixel c turns as c · (limit / measure), and others as they are."""
    image, along = sparse_noise(8, 9, lit=0.7).astype(np.float64), rng.normal(size=(8, 9, 3))
    slope = jax.jit(jax.grad(lambda i: jnp.sum(clamp_fireflies(i, factor=2.0)[0] * along)))(image)
    found, clamped = brute_force(image, factor=2.0)
    assert clamped.sum() > 3
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = found.sum(-1) / image.sum(-1)
        expected = 0.0
        for by_luminance in (True, False):
            weights = REC_709 if by_luminance else (image == image.max(-1, keepdims=True)).astype(float)
            light = (image * weights).sum(-1)
            own = along * scale[..., None] - ((along * image).sum(-1) * scale / light)[..., None] * weights
            expected = expected + np.where((clamped_by_luminance(image) == by_luminance)[..., None], own, 0.0)
    np.testing.assert_allclose(slope, np.where(clamped[..., None], expected, along), rtol=1e-12, atol=1e-14)


# --- Bad input


@pytest.mark.parametrize(
    ("shape", "options", "message"),
    [
        ((4, 5), {}, r"image: shape: expected \(h, w, c\), not empty, got \(4, 5\)"),
        ((4, 0, 3), {}, r"image: shape: .*got \(4, 0, 3\)"),
        ((4, 5, 4), {}, "image: channels: expected one of 1, 3, got 4"),
        ((4, 5, 3), {"factor": 0.5}, "factor: expected a value >= 1.0, got 0.5"),
        ((4, 5, 3), {"factor": math.nan}, "factor: expected a value >= 1.0, got nan"),
        ((4, 5, 3), {"radius": -1}, "radius: expected one of 0, 1, 2, 3, 4, 5, got -1"),
        ((4, 5, 3), {"radius": 6}, "radius: expected one of 0, 1, 2, 3, 4, 5, got 6"),
    ],
)
def test_bad_input_is_refused(shape, options, message):
    with pytest.raises(ValueError, match=message):
        clamp_fireflies(jnp.zeros(shape), **options)


def test_whole_numbers_are_refused():
    with pytest.raises(TypeError, match="image: expected floating-point numbers, got uint8"):
        clamp_fireflies(jnp.zeros((2, 2, 3), jnp.uint8))
