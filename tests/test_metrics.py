"""Metrics against closed forms, NumPy and matplotlib's color table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.metrics import flip, heatmap, mse, psnr, relative_l2, ssim


def test_known_values():
    image, reference = jnp.full((4, 6, 3), 0.6), jnp.full((4, 6, 3), 0.5)
    # (0.6 - 0.5) in float32 carries one rounding of 0.6, 6e-8 of 0.1: 6e-7 relative, twice that squared.
    assert mse(image, reference) == pytest.approx(0.01, rel=2e-6)
    assert psnr(image, reference) == pytest.approx(20.0, abs=1e-5)
    assert psnr(image * 255.0, reference * 255.0, peak=255.0) == pytest.approx(20.0, abs=1e-5)
    assert relative_l2(image, reference) == pytest.approx(0.2, rel=2e-6)


def test_equal_and_empty_references():
    image = jnp.linspace(0.0, 1.0, 12).reshape(2, 2, 3)
    assert psnr(image, image) == np.inf
    assert relative_l2(image, image) == 0
    assert relative_l2(image, jnp.zeros_like(image)) == 0
    assert np.isfinite(jax.grad(relative_l2)(image, image)).all()


def test_gradient_of_mse(rng):
    image, reference = (jnp.asarray(rng.random((3, 5, 2)), jnp.float32) for _ in range(2))
    np.testing.assert_allclose(
        jax.grad(mse)(image, reference), 2 * (image - reference) / image.size, rtol=1e-6, atol=1e-9
    )


def test_ssim_of_equal_and_of_noisy_images(rng):
    image = rng.random((16, 20, 3)).astype(np.float32)
    noisy = image + rng.normal(scale=0.2, size=image.shape).astype(np.float32)
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    assert 0.1 < ssim(noisy, image) < 0.95


def test_ssim_of_constants_is_the_luminance_term():
    # Without variance only (2ab + c1) / (a² + b² + c1) remains, c1 = (0.01 peak)².
    a, b, c1 = 0.25, 0.75, 1e-4
    image, reference = np.full((12, 12, 1), a), np.full((12, 12, 1), b)
    assert ssim(image, reference) == pytest.approx((2 * a * b + c1) / (a * a + b * b + c1), rel=1e-9)


def test_flip_of_equal_images_and_of_the_largest_difference(rng):
    pytest.importorskip("flip_evaluator")
    image = rng.random((16, 20, 3)).astype(np.float32)
    assert flip(image, image) == flip(jnp.asarray(image), jnp.asarray(image)) == 0.0
    # The scale's end is the difference of the primaries green and blue.
    green, blue = (np.broadcast_to(np.eye(3, dtype=np.float32)[i], (16, 20, 3)) for i in (1, 2))
    assert flip(green, blue) == pytest.approx(1.0, abs=1e-5)


def test_flip_is_symmetric_and_forgives_what_is_too_fine_to_see(rng):
    pytest.importorskip("flip_evaluator")
    image = 0.3 + 0.4 * rng.random((24, 32, 3)).astype(np.float32)
    noisy = image + 0.1 * rng.standard_normal(image.shape).astype(np.float32)
    assert flip(image, noisy) == pytest.approx(flip(noisy, image), rel=1e-5)
    assert flip(image, noisy, pixels_per_degree=100.0) < flip(image, noisy, pixels_per_degree=10.0)


def test_flip_checks_its_arguments():
    pytest.importorskip("flip_evaluator")
    with pytest.raises(ValueError, match="one shape"):
        flip(np.zeros((4, 5, 3)), np.zeros((4, 6, 3)))
    with pytest.raises(ValueError, match="image"):
        flip(np.zeros((4, 5, 1)), np.zeros((4, 5, 1)))
    with pytest.raises(ValueError, match="pixels_per_degree: expected a value > 0"):
        flip(np.zeros((4, 5, 3)), np.zeros((4, 5, 3)), pixels_per_degree=0.0)


@pytest.mark.parametrize("metric", [mse, psnr, relative_l2, ssim])
def test_shapes_must_agree(metric):
    with pytest.raises(ValueError, match="expected one shape"):
        metric(jnp.zeros((12, 12, 3)), jnp.zeros((12, 13, 3)))


def test_ssim_refuses_tiny_images():
    with pytest.raises(ValueError, match="height and width"):
        ssim(np.zeros((10, 20, 1)), np.zeros((10, 20, 1)))


def test_heatmap_follows_inferno():
    matplotlib = pytest.importorskip("matplotlib")
    values = np.linspace(0.0, 1.0, 101).astype(np.float32)
    linear = np.asarray(heatmap(jnp.asarray(values)), np.float64)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    expected = np.asarray(matplotlib.colormaps["inferno"](np.linspace(0, 1, 101)))[:, :3]
    # At the nodes the bytes agree; between them the straight line leaves the curve by 0.034 at most.
    np.testing.assert_allclose(srgb[::10], expected[::10], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(srgb, expected, atol=0.035)


def test_heatmap_scale_clamps_and_marks_nan():
    colors = np.asarray(heatmap(jnp.asarray([[-1.0, 0.5], [2.0, 9.0]]), low=0.0, high=2.0))
    assert colors.shape == (2, 2, 3)
    np.testing.assert_array_equal(colors[1, 0], colors[1, 1])
    np.testing.assert_array_equal(colors[0, 0], np.asarray(heatmap(jnp.asarray([0.0]), high=2.0))[0])
    jax.config.update("jax_debug_nans", False)
    try:
        np.testing.assert_array_equal(heatmap(jnp.asarray([np.nan, 1.0]))[0], [0, 1, 0])
    finally:
        jax.config.update("jax_debug_nans", True)


def test_heatmap_of_a_constant():
    np.testing.assert_array_equal(heatmap(jnp.zeros(3)), np.broadcast_to(heatmap(jnp.zeros(1))[0], (3, 3)))
