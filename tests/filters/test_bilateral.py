"""jaxrender.filters.bilateral and valid: brute force, OpenCV, known results, masks, derivatives, bad input."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from jaxrender.filters.bilateral import cross_bilateral_filter
from jaxrender.filters.valid import valid_pixels

# Compiling is nearly all of the time here.
_quickly = {"xla_backend_optimization_level": 0}
_compiled = jax.jit(cross_bilateral_filter, static_argnames="radius", compiler_options=_quickly)

SIGMAS = {"sigma_spatial": 2.0, "sigma_features": np.array([0.3, 0.5])}


def run(image, features, *, radius: int, **sigmas) -> np.ndarray:
    wide = np.float64 if image.dtype == np.float64 else np.float32
    sigmas = {name: np.asarray(x, wide) for name, x in (SIGMAS | sigmas).items()}
    return np.asarray(_compiled(image, features, radius=radius, **sigmas))


def noise(*shape: int, seed: int = 1, dtype=np.float64) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=shape).astype(dtype)


def brute_force(image, features, *, radius, sigma_spatial=2.0, sigma_features=SIGMAS["sigma_features"]) -> np.ndarray:
    """The sums of the paper, pixel by pixel, over finite pixels."""
    image, features = np.asarray(image, np.float64), np.asarray(features, np.float64)
    known = np.isfinite(features).all(-1)
    valid = known & np.isfinite(image).all(-1)
    result = np.zeros_like(image)
    for y, x in np.ndindex(valid.shape):
        total = 0.0
        for v, u in np.ndindex(valid.shape):
            if max(abs(v - y), abs(u - x)) > radius or not valid[v, u]:
                continue
            weight = math.exp(-((v - y) ** 2 + (u - x) ** 2) / (2.0 * sigma_spatial**2))
            if known[y, x]:
                weight *= np.exp(-((features[y, x] - features[v, u]) ** 2) / (2.0 * sigma_features**2)).prod()
            total += weight
            result[y, x] += weight * image[v, u]
        result[y, x] /= total or 1.0
    return result


def with_holes(*images: np.ndarray) -> list[np.ndarray]:
    """A pixel without features, one without image, one with neither, and no number at all in a corner."""
    image, features = (x.copy() for x in images)
    features[2, 3, 0], image[4, 4, 1], image[0, 0], features[0, 0, 1] = np.nan, np.inf, np.nan, -np.inf
    image[-3:, -3:], features[-2:, -2:] = np.nan, np.nan
    return [image, features]


# --- Against loops and OpenCV. Many images are of one size: so they share their compiled programs.


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_the_sum_of_the_paper(dtype):
    with jax.enable_x64(dtype == np.float64):
        image, features = noise(8, 9, 3, dtype=dtype), noise(8, 9, 2, seed=2, dtype=dtype)
        expected = brute_force(image, features, radius=3)
        np.testing.assert_allclose(run(image, features, radius=3), expected, rtol=64 * np.finfo(dtype).eps)


@pytest.mark.parametrize(("shape", "radius"), [((1, 6), 3), ((5, 1), 1), ((1, 1), 4), ((4, 3), 0), ((3, 5), 30)])
def test_small_images(shape, radius):
    image, features = noise(*shape, 3, dtype=np.float32), noise(*shape, 2, seed=2, dtype=np.float32)
    np.testing.assert_allclose(
        run(image, features, radius=radius), brute_force(image, features, radius=radius), rtol=1e-5
    )


@pytest.mark.parametrize("radius", [1, 3, 20])
def test_pixels_that_are_not_finite_are_left_out_and_filled(radius):
    image, features = with_holes(noise(8, 9, 3, dtype=np.float32), noise(8, 9, 2, seed=2, dtype=np.float32))
    found, expected = run(image, features, radius=radius), brute_force(image, features, radius=radius)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    empty = (expected == 0.0).all(-1)
    assert empty.sum() == (4 if radius == 1 else 0)


def test_optimised_programs_give_the_same():
    """And the order in which pixels are summed does not depend on what is beside the window."""
    image, features = noise(20, 33, 3, dtype=np.float32), noise(20, 33, 2, seed=2, dtype=np.float32)
    sigmas = {name: np.asarray(x, np.float32) for name, x in SIGMAS.items()}
    whole = jax.jit(cross_bilateral_filter, static_argnames="radius")(image, features, radius=3, **sigmas)
    piece = run(image[5:13, 4:13], features[5:13, 4:13], radius=3)
    np.testing.assert_allclose(piece[3:-3, 3:-3], whole[8:10, 7:10], rtol=1e-6)


def test_it_is_opencvs():
    """Where that means the same: a guide of one channel, since of three it adds up the absolute differences, no border,
    and a window whose corners weigh nothing (its windows are discs, here of 5 sigma)."""
    cv2 = pytest.importorskip("cv2")
    image, guide = noise(24, 27, 3, dtype=np.float32), noise(24, 27, 1, seed=2, dtype=np.float32)
    expected = cv2.ximgproc.jointBilateralFilter(guide, image, d=13, sigmaColor=0.3, sigmaSpace=1.2)
    found = run(image, guide, radius=6, sigma_spatial=1.2, sigma_features=[0.3])
    np.testing.assert_allclose(found[6:-6, 6:-6], expected[6:-6, 6:-6], atol=1e-5)


# --- Known results


def test_constants_pass():
    image = np.full((8, 9, 3), [0.2, 5e3, 1e-4], np.float32)
    np.testing.assert_allclose(run(image, noise(8, 9, 2, dtype=np.float32), radius=3), image, rtol=1e-6)


def test_alike_pixels_make_a_gaussian_blur():
    image = noise(8, 9, 3, dtype=np.float32)
    blur = [
        scipy.ndimage.gaussian_filter(x.astype(np.float64), 2.0, radius=3, mode="constant")
        for x in (*np.moveaxis(image, -1, 0), np.ones(image.shape[:2]))
    ]
    expected = np.stack(blur[:3], -1) / blur[3][..., None]
    np.testing.assert_allclose(run(image, np.full((8, 9, 2), 0.7, np.float32), radius=3), expected, rtol=1e-5)
    nothing = run(image, np.zeros((8, 9, 0), np.float32), radius=3, sigma_features=np.ones(0))
    np.testing.assert_allclose(nothing, expected, rtol=1e-5)


def test_edges_in_features_are_walls():
    image, features = noise(8, 9, 3, dtype=np.float32), np.zeros((8, 9, 2), np.float32)
    features[:, 5:, 1] = 20.0
    found = run(image, features, radius=3)
    for part in (np.s_[:, :5], np.s_[:, 5:]):
        np.testing.assert_allclose(found[part], brute_force(image[part], features[part], radius=3), rtol=1e-5)


def test_a_feature_of_infinite_sigma_does_not_count():
    image, features = noise(8, 9, 3, dtype=np.float32), noise(8, 9, 2, dtype=np.float32)
    found = run(image, features, radius=3, sigma_features=[0.3, np.inf])
    expected = brute_force(image, features[..., :1], radius=3, sigma_features=np.array([0.3]))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_it_is_linear_and_mirrored_images_give_mirrored_results(x64):
    image, other, features = noise(8, 9, 3), noise(8, 9, 3, seed=2), noise(8, 9, 2, seed=3)
    found, mixed = (run(i, features, radius=3) for i in (image, 2.0 * image - 3.0 * other))
    np.testing.assert_allclose(mixed, 2.0 * found - 3.0 * run(other, features, radius=3), atol=1e-13)
    for turn in (lambda x: x[::-1], lambda x: x[:, ::-1]):
        np.testing.assert_allclose(run(turn(image), turn(features), radius=3), turn(found), atol=1e-13)


@pytest.mark.parametrize("value", [1e30, 3e38])
def test_huge_features_are_far_away(value):
    """A sky at the largest depth there is: its pixels are alike, and no others are like them."""
    image, features = noise(8, 9, 3, dtype=np.float32), np.zeros((8, 9, 2), np.float32)
    features[:3, :, 0], features[3:, :4, 1] = value, -value
    found = run(image, features, radius=3)
    for part in (np.s_[:3], np.s_[3:, :4], np.s_[3:, 4:]):
        alike = np.zeros((*image[part].shape[:2], 2))
        np.testing.assert_allclose(found[part], brute_force(image[part], alike, radius=3), rtol=1e-5)


def test_derivatives_of_huge_features_are_finite():
    image, features = noise(3, 4, 1, dtype=np.float32), np.zeros((3, 4, 1), np.float32)
    features[0, 1:, 0] = 1e30, 3e38, -3e38

    def total(features, sigma):
        return jnp.sum(cross_bilateral_filter(image, features, radius=2, sigma_spatial=2.0, sigma_features=sigma))

    for slope in jax.jit(jax.grad(total, argnums=(0, 1)), compiler_options=_quickly)(features, np.float32(1e-3)):
        assert np.isfinite(slope).all()


def test_weights_too_small_count_as_none():
    """A pixel without a colour that is like no other."""
    image, features = np.full((8, 9, 3), 2.0, np.float32), np.zeros((8, 9, 2), np.float32)
    image[4, 5], features[4, 5] = np.nan, 3.0
    for sigma, expected in ((1.0, 2.0), (0.1, 0.0)):
        found = run(image, features, radius=3, sigma_features=[sigma, sigma])
        np.testing.assert_allclose(found[4, 5], expected, rtol=1e-6)


# --- Types, programs, batches


@pytest.mark.parametrize("half", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_summed_in_float32(half):
    image, features = (np.asarray(noise(8, 9, c, seed=c), half) for c in (3, 2))
    image[0, 0] = 6e4
    found, wide = run(image, features, radius=3), run(np.float32(image), np.float32(features), radius=3)
    assert found.dtype == half
    np.testing.assert_array_equal(found, wide.astype(half))


def test_the_result_has_the_type_of_the_image(x64):
    image, features = noise(7, 9, 3, dtype=np.float32), noise(7, 9, 2, seed=2)
    found = np.asarray(_compiled(image, features, radius=2, **SIGMAS))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, brute_force(image, features, radius=2), rtol=1e-7)


def test_with_and_without_jit_and_in_batches():
    images, features = noise(2, 8, 9, 3, dtype=np.float32), noise(2, 8, 9, 2, seed=2, dtype=np.float32)
    smooth = functools.partial(cross_bilateral_filter, radius=3, **{k: jnp.float32(s) for k, s in SIGMAS.items()})
    together = jax.jit(jax.vmap(smooth), compiler_options=_quickly)(images, features)
    for k in range(2):
        np.testing.assert_allclose(together[k], run(images[k], features[k], radius=3), rtol=1e-6)
    np.testing.assert_allclose(together[0], smooth(jnp.asarray(images[0]), jnp.asarray(features[0])), rtol=1e-6)


# --- Derivatives


def dense(image, features, radius, sigma_spatial, sigma_features):
    """All weights as a matrix; of derivatives, JAX's own."""
    h, w = image.shape[:2]
    y, x = (jnp.asarray(i.reshape(-1), jnp.float64) for i in np.mgrid[:h, :w])
    dy, dx = (i[:, None] - i[None, :] for i in (y, x))
    f = features.reshape(h * w, -1) / sigma_features[None]
    away = jnp.sum((f[:, None] - f[None, :]) ** 2, -1) + (dy**2 + dx**2) / sigma_spatial**2
    weights = jnp.where(jnp.maximum(abs(dy), abs(dx)) <= radius, jnp.exp(-0.5 * away), 0.0)
    return (weights @ image.reshape(h * w, -1) / weights.sum(1, keepdims=True)).reshape(image.shape)


def test_derivatives_are_those_of_all_weights(x64, rng):
    values = [noise(5, 7, 2), noise(5, 7, 3, seed=2), np.float64(1.7), np.array([0.3, 0.5, 0.4])]
    along = rng.normal(size=(5, 7, 2))

    def slopes(function):
        return jax.jit(
            jax.grad(lambda *v: jnp.sum(function(*v) ** 2 * along), argnums=(0, 1, 2, 3)), compiler_options=_quickly
        )(*values)

    ours = slopes(lambda i, f, s, t: cross_bilateral_filter(i, f, radius=2, sigma_spatial=s, sigma_features=t))
    for found, expected in zip(ours, slopes(lambda i, f, s, t: dense(i, f, 2, s, t)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


def test_derivatives_are_finite_differences_beside_holes(x64, rng):
    values = [*with_holes(noise(8, 9, 3), noise(8, 9, 2, seed=2)), np.float64(1.7), np.array([0.3, 0.5])]
    weights = rng.normal(size=(8, 9, 3))

    def total(values):
        image, features, spatial, sigmas = values
        found = cross_bilateral_filter(image, features, radius=3, sigma_spatial=spatial, sigma_features=sigmas)
        return jnp.sum(found * weights)

    value, slopes = (jax.jit(f, compiler_options=_quickly) for f in (total, jax.grad(total)))
    found = slopes(values)
    for k, slope in enumerate(found):
        assert np.isfinite(slope).all()
        along = rng.normal(size=np.shape(slope))
        ends = [value([v + s * 1e-5 * along if k == i else v for i, v in enumerate(values)]) for s in (-1, 1)]
        np.testing.assert_allclose(np.sum(slope * along), (ends[1] - ends[0]) / 2e-5, rtol=1e-7)
    known = np.isfinite(values[1]).all(-1)
    valid = known & np.isfinite(values[0]).all(-1)
    assert not np.asarray(found[0])[~valid].any() and not np.asarray(found[1])[~known].any()


def test_the_derivative_needs_the_memory_of_a_few_images():
    """Planes, sums, and four weights at a time; not all 289."""
    image, features = jnp.zeros((96, 96, 3)), jnp.zeros((96, 96, 4))

    def total(image, features):
        return jnp.sum(cross_bilateral_filter(image, features, radius=8, sigma_spatial=2.0, sigma_features=0.3) ** 2)

    slopes = jax.jit(jax.grad(total, argnums=(0, 1)), compiler_options=_quickly)
    needed = slopes.lower(image, features).compile().memory_analysis().temp_size_in_bytes
    assert needed < 20 * image.nbytes, needed / image.nbytes


# --- Which pixels count, bad input


def test_valid_pixels_are_finite_in_all_channels_of_all_images():
    image, features = np.ones((2, 3, 3), np.float32), np.ones((2, 3, 1), np.float32)
    image[0, 1, 2], features[1, 0, 0] = np.nan, -np.inf
    np.testing.assert_array_equal(valid_pixels(image), [[True, False, True], [True, True, True]])
    np.testing.assert_array_equal(valid_pixels(image, features), [[True, False, True], [False, True, True]])
    assert valid_pixels(jnp.ones((2, 3, 0))).all()
    with pytest.raises(ValueError, match="images: expected at least one, got none"):
        valid_pixels()
    with pytest.raises(ValueError, match=r"images\[1\]: height and width: expected \(2, 3\), got \(2, 4\)"):
        valid_pixels(image, jnp.ones((2, 4, 3)))


@pytest.mark.parametrize(
    ("image", "features", "options", "message"),
    [
        ((4, 5), (4, 5, 2), {}, r"image: shape: expected \(h, w, c\), not empty, got \(4, 5\)"),
        ((0, 5, 3), (0, 5, 2), {}, r"image: shape: .*got \(0, 5, 3\)"),
        ((4, 5, 3), (5, 4, 2), {}, r"features: height and width: expected \(4, 5\), got \(5, 4\)"),
        ((4, 5, 3), (4, 5, 2), {"radius": -1}, "radius: expected a value >= 0, got -1"),
        ((4, 5, 3), (4, 5, 2), {"radius": 2.5}, "radius: expected a whole number >= 0, got 2.5"),
        ((4, 5, 3), (4, 5, 2), {"sigma_spatial": 0.0}, r"sigma_spatial: expected a value > 0, got 0.0"),
        ((4, 5, 3), (4, 5, 2), {"sigma_features": math.nan}, "sigma_features: expected a value > 0, got nan"),
        ((4, 5, 3), (4, 5, 2), {"sigma_features": jnp.ones(3)}, r"sigma_features: .*shape \(2,\), got shape \(3,\)"),
        ((4, 5, 3), (4, 5, 2), {"sigma_spatial": jnp.ones(1)}, r"sigma_spatial: .*shape \(\), got shape \(1,\)"),
    ],
)
def test_bad_input_is_refused(image, features, options, message):
    options = {"radius": 2, "sigma_spatial": 2.0, "sigma_features": 0.3} | options
    with pytest.raises(ValueError, match=message):
        cross_bilateral_filter(jnp.zeros(image), jnp.zeros(features), **options)


def test_whole_numbers_are_refused():
    with pytest.raises(TypeError, match="image: expected floating-point numbers, got int32"):
        cross_bilateral_filter(
            jnp.zeros((2, 2, 3), jnp.int32), jnp.zeros((2, 2, 1)), radius=1, sigma_spatial=1.0, sigma_features=1.0
        )
