"""jaxrender.filters.atrous: brute force, known results, masks, derivatives, bad input."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters.atrous import atrous_filter

# Compiling is nearly all of the time here.
_quickly = {"xla_backend_optimization_level": 0}
_compiled = jax.jit(atrous_filter, static_argnames="num_levels", compiler_options=_quickly)

SIGMAS = np.array([0.4, 0.7])
SPLINE = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0


def run(image, features, *, num_levels: int, sigma_features=SIGMAS, sigma_color=None) -> np.ndarray:
    wide = np.float64 if image.dtype == np.float64 else np.float32
    color = None if sigma_color is None else wide(sigma_color)
    sigmas = np.asarray(sigma_features, wide)
    return np.asarray(_compiled(image, features, num_levels=num_levels, sigma_features=sigmas, sigma_color=color))


def noise(*shape: int, seed: int = 1, dtype=np.float32) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=shape).astype(dtype)


def brute_force(image, features, *, num_levels, sigma_features=SIGMAS, sigma_color=None) -> np.ndarray:
    """The algorithm of the paper, pixel by pixel; and what is documented of pixels that are not finite."""
    image, features = np.asarray(image, np.float64), np.asarray(features, np.float64)
    known = np.isfinite(features).all(-1)
    filled = known & np.isfinite(image).all(-1)
    image = np.where(filled[..., None], image, 0.0)
    for level in range(num_levels):
        sums, totals = np.zeros_like(image), np.zeros(filled.shape)
        for y, x in np.ndindex(filled.shape):
            for j, i in np.ndindex(5, 5):
                v, u = y + (j - 2) * 2**level, x + (i - 2) * 2**level
                if not (0 <= v < filled.shape[0] and 0 <= u < filled.shape[1]) or not filled[v, u]:
                    continue
                if not known[v, u] and (v, u) != (y, x):
                    continue
                weight = SPLINE[j] * SPLINE[i]
                if known[y, x]:
                    weight *= math.exp(-np.sum(((features[y, x] - features[v, u]) / sigma_features) ** 2))
                    if filled[y, x] and sigma_color is not None:
                        weight *= math.exp(-np.sum((image[y, x] - image[v, u]) ** 2) / (sigma_color / 2**level) ** 2)
                totals[y, x] += weight
                sums[y, x] += weight * image[v, u]
        filled = totals > 0.0
        image = sums / np.where(filled, totals, 1.0)[..., None]
    return image


def with_holes(*images: np.ndarray) -> list[np.ndarray]:
    """A pixel without features, one without image, one with neither, and a corner of six by six without image."""
    image, features = (x.copy() for x in images)
    features[2, 3, 0], image[4, 4, 1], image[0, 0], features[0, 0, 1] = np.nan, np.inf, np.nan, -np.inf
    image[-6:, -6:] = np.nan
    return [image, features]


# --- Against loops


@pytest.mark.parametrize("sigma_color", [None, 0.6])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_the_algorithm_of_the_paper(dtype, sigma_color):
    with jax.enable_x64(dtype == np.float64):
        image, features = noise(8, 9, 3, dtype=dtype), noise(8, 9, 2, seed=2, dtype=dtype)
        expected = brute_force(image, features, num_levels=3, sigma_color=sigma_color)
        found = run(image, features, num_levels=3, sigma_color=sigma_color)
        np.testing.assert_allclose(found, expected, rtol=64 * np.finfo(dtype).eps)


@pytest.mark.parametrize(("shape", "levels"), [((1, 7), 2), ((6, 1), 3), ((1, 1), 1), ((2, 3), 8)])
def test_small_images(shape, levels):
    """Of eight levels, six have steps that lead out of the image."""
    image, features = noise(*shape, 3), noise(*shape, 2, seed=2)
    found = run(image, features, num_levels=levels, sigma_color=0.6)
    np.testing.assert_allclose(found, brute_force(image, features, num_levels=levels, sigma_color=0.6), rtol=1e-5)


@pytest.mark.parametrize("sigma_color", [None, 0.6])
@pytest.mark.parametrize("levels", [1, 3])
def test_pixels_that_are_not_finite_are_left_out_and_filled(levels, sigma_color):
    """One level leaves 4 x 4 pixels of the hole empty, the second fills all."""
    image, features = with_holes(noise(8, 9, 3), noise(8, 9, 2, seed=2))
    found = run(image, features, num_levels=levels, sigma_color=sigma_color)
    assert np.isfinite(found).all()
    expected = brute_force(image, features, num_levels=levels, sigma_color=sigma_color)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert (expected == 0.0).all(-1).sum() == (16 if levels == 1 else 0)


def test_optimised_programs_give_the_same():
    image, features = noise(40, 50, 3), noise(40, 50, 2, seed=2)
    whole = jax.jit(lambda i, f: atrous_filter(i, f, num_levels=3, sigma_features=0.5, sigma_color=0.8))
    sigmas = np.full(2, 0.5)
    expected = run(image, features, num_levels=3, sigma_features=sigmas, sigma_color=0.8)
    np.testing.assert_allclose(whole(image, features), expected, rtol=1e-5)


# --- Known results


def test_constants_pass():
    image = np.full((8, 9, 3), [0.2, 5e3, 1e-4], np.float32)
    for color in (None, 0.6):
        np.testing.assert_allclose(run(image, noise(8, 9, 2), num_levels=3, sigma_color=color), image, rtol=1e-6)


@pytest.mark.parametrize("levels", [1, 3])
def test_alike_pixels_make_a_b_spline_of_the_documented_support(levels):
    """A point becomes the splines of all levels, one after the other: 4 (2ⁿ - 1) + 1 pixels a side, and 0 beyond."""
    taps = [np.zeros(4 * 2**level + 1) for level in range(levels)]
    for level, row in enumerate(taps):
        row[:: 2**level] = SPLINE
    spline = functools.reduce(np.convolve, taps)
    side = 4 * (2**levels - 1) + 1
    assert spline.size == side and spline.min() > 0.0
    # Large enough for no window of a pixel that the point reaches to be cropped.
    image, expected = np.zeros((2, 2 * side + 1, 2 * side + 3, 1), np.float32)
    image[side, side + 1], expected[side // 2 + 1 :][:side, side // 2 + 2 :][:, :side, 0] = (
        1.0,
        np.outer(spline, spline),
    )
    found = run(image, np.ones_like(image), num_levels=levels, sigma_features=[1.0])
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_edges_in_features_are_walls():
    image, features = noise(8, 9, 3), np.zeros((8, 9, 2), np.float32)
    features[:, 5:, 1] = 20.0
    found = run(image, features, num_levels=3)
    for part in (np.s_[:, :5], np.s_[:, 5:]):
        np.testing.assert_allclose(found[part], brute_force(image[part], features[part], num_levels=3), rtol=1e-5)


def test_features_weigh_as_documented():
    """Two pixels a step of one sigma apart: weights 6/16 and 4/16 e⁻¹. The bilateral filter's would be e^(-1/2)."""
    image, features = np.float32([[[0.0], [1.0]]]), np.float32([[[0.0], [0.3]]])
    found = run(image, features, num_levels=1, sigma_features=[0.3])
    other = 4.0 * math.exp(-1.0)
    np.testing.assert_allclose(found[0, 0], other / (6.0 + other), rtol=1e-6)


def test_sigma_of_color_halves_from_level_to_level():
    """Pixels four apart, between them none that gives, meet on the second level: at half of sigma, with 1/16."""
    image, features = np.zeros((1, 5, 1), np.float32), np.zeros((1, 5, 1), np.float32)
    image[0, 4], features[0, 1:4] = 0.3, np.nan
    found = run(image, features, num_levels=2, sigma_features=[1.0], sigma_color=0.6)
    np.testing.assert_allclose(found[0, 0], 0.3 * math.exp(-1.0) / (6.0 + math.exp(-1.0)), rtol=1e-5)


def test_it_is_linear_without_a_color_weight_and_mirrored_images_give_mirrored_results(x64):
    image, other, features = (noise(8, 9, c, seed=s, dtype=np.float64) for c, s in ((3, 1), (3, 2), (2, 3)))
    found, mixed = (run(i, features, num_levels=3) for i in (image, 2.0 * image - 3.0 * other))
    np.testing.assert_allclose(mixed, 2.0 * found - 3.0 * run(other, features, num_levels=3), atol=1e-13)
    for turn in (lambda x: x[::-1], lambda x: x[:, ::-1]):
        np.testing.assert_allclose(run(turn(image), turn(features), num_levels=3), turn(found), atol=1e-13)


# --- Types, programs, batches


@pytest.mark.parametrize("half", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_summed_in_float32(half):
    image, features = (np.asarray(noise(8, 9, c, seed=c), half) for c in (3, 2))
    found, wide = run(image, features, num_levels=3), run(np.float32(image), np.float32(features), num_levels=3)
    assert found.dtype == half
    np.testing.assert_array_equal(found, wide.astype(half))


def test_with_and_without_jit_and_in_batches():
    images, features = noise(2, 8, 9, 3), noise(2, 8, 9, 2, seed=2)
    smooth = functools.partial(
        atrous_filter, num_levels=3, sigma_features=jnp.asarray(SIGMAS, jnp.float32), sigma_color=jnp.float32(0.6)
    )
    together = jax.jit(jax.vmap(smooth), compiler_options=_quickly)(images, features)
    for k in range(2):
        np.testing.assert_allclose(together[k], run(images[k], features[k], num_levels=3, sigma_color=0.6), rtol=1e-6)
    np.testing.assert_allclose(together[0], smooth(jnp.asarray(images[0]), jnp.asarray(features[0])), rtol=1e-6)


# --- Derivatives


@pytest.mark.parametrize("sigma_color", [None, 0.6])
def test_derivatives_are_finite_differences_beside_holes(x64, rng, sigma_color):
    image, features = (noise(8, 9, c, seed=c, dtype=np.float64) for c in (3, 2))
    values = [*with_holes(image, features), SIGMAS] + ([] if sigma_color is None else [np.float64(sigma_color)])
    weights = rng.normal(size=(8, 9, 3))

    def total(values):
        image, features, sigmas, *color = values
        color = dict(zip(["sigma_color"], color, strict=False))
        return jnp.sum(atrous_filter(image, features, num_levels=3, sigma_features=sigmas, **color) * weights)

    value, slopes = (jax.jit(f, compiler_options=_quickly) for f in (total, jax.grad(total)))
    found = slopes(values)
    for k, slope in enumerate(found):
        assert np.isfinite(slope).all()
        along = rng.normal(size=np.shape(slope))
        ends = [value([v + s * 1e-5 * along if k == i else v for i, v in enumerate(values)]) for s in (-1, 1)]
        np.testing.assert_allclose(np.sum(slope * along), (ends[1] - ends[0]) / 2e-5, rtol=1e-6)
    known = np.isfinite(values[1]).all(-1)
    valid = known & np.isfinite(values[0]).all(-1)
    assert not np.asarray(found[0])[~valid].any() and not np.asarray(found[1])[~known].any()


def test_the_derivative_needs_the_memory_of_a_few_images():
    """What the levels start from, planes, sums, and four weights at a time; not the 72 weights of three levels."""
    image, features = jnp.zeros((128, 128, 3)), jnp.zeros((128, 128, 4))

    def total(image, features):
        return jnp.sum(atrous_filter(image, features, num_levels=3, sigma_features=0.3, sigma_color=1.0) ** 2)

    slopes = jax.jit(jax.grad(total, argnums=(0, 1)), compiler_options=_quickly)
    needed = slopes.lower(image, features).compile().memory_analysis().temp_size_in_bytes
    assert needed < 24 * image.nbytes, needed / image.nbytes


# --- Bad input


@pytest.mark.parametrize(
    ("image", "features", "options", "message"),
    [
        ((4, 5), (4, 5, 2), {}, r"image: shape: expected \(h, w, c\), not empty, got \(4, 5\)"),
        ((4, 5, 3), (5, 4, 2), {}, r"features: height and width: expected \(4, 5\), got \(5, 4\)"),
        ((4, 5, 3), (4, 5, 2), {"num_levels": 0}, "num_levels: expected a value >= 1, got 0"),
        ((4, 5, 3), (4, 5, 2), {"sigma_features": -1.0}, r"sigma_features: expected a value > 0, got -1.0"),
        ((4, 5, 3), (4, 5, 2), {"sigma_color": 0.0}, r"sigma_color: expected a value > 0, got 0.0"),
        ((4, 5, 3), (4, 5, 2), {"sigma_features": jnp.ones(3)}, r"sigma_features: .*shape \(2,\), got shape \(3,\)"),
    ],
)
def test_bad_input_is_refused(image, features, options, message):
    with pytest.raises(ValueError, match=message):
        atrous_filter(jnp.zeros(image), jnp.zeros(features), **({"num_levels": 2, "sigma_features": 0.3} | options))


def test_whole_numbers_are_refused():
    with pytest.raises(TypeError, match="features: expected floating-point numbers, got int32"):
        atrous_filter(jnp.zeros((2, 2, 3)), jnp.zeros((2, 2, 1), jnp.int32), num_levels=1, sigma_features=1.0)
