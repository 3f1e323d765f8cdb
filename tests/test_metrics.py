"""Metrics against closed forms, NumPy and matplotlib's color table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.metrics import flicker, flip, heatmap, mse, psnr, relative_l2, ssim, warped_flicker


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


def test_flicker_of_noise_is_its_variance(rng):
    """Of frames apart, and of each and the one before: with a standard deviation of 3, 9 and 3 √2."""
    noise = 3.0 * rng.standard_normal((6, 50, 60, 3)).astype(np.float32) + rng.random((50, 60, 3)).astype(np.float32)
    frames = jnp.asarray(noise)
    # The variance of a variance over n values is 2 / n of its square, for normal ones.
    spread = 9.0 * np.sqrt(2.0 / (5 * 50 * 60 * 3))
    assert abs(float(flicker(frames)) - 9.0) < 5.0 * spread
    assert float(flicker(jnp.broadcast_to(frames[:1], frames.shape))) < 1e-12
    y, x = np.meshgrid(np.arange(50) + 0.5, np.arange(60) + 0.5, indexing="ij")
    still = {"places_px": jnp.asarray(np.stack([x, y], axis=-1), jnp.float32), "matches": jnp.ones((50, 60), bool)}
    found = float(warped_flicker(frames[1], frames[0], **still))
    assert abs(found**2 - 18.0) < 5.0 * 18.0 * np.sqrt(2.0 / (50 * 60 * 3))
    with pytest.raises(ValueError, match="frames: number: expected a value >= 2, got 1"):
        flicker(frames[:1])


def test_a_picture_that_moves_as_a_whole_does_not_flicker():
    """A plane of colors, moved by a fraction of a pixel; what came into view counts only if it is said to match."""
    y, x = np.meshgrid(np.arange(8) + 0.5, np.arange(9) + 0.5, indexing="ij")
    plane = lambda x, y: jnp.asarray(np.stack([0.1 * x, 0.2 * y, 0.05 * (x + y)], axis=-1), jnp.float32)  # noqa: E731
    moved = np.stack([x - 1.25, y + 0.5], axis=-1)
    inside = (moved[..., 0] >= 0.5) & (moved[..., 1] <= 7.5)
    places = jnp.asarray(moved, jnp.float32)
    image, previous = plane(x - 1.25, y + 0.5), plane(x, y)
    assert float(warped_flicker(image, previous, places_px=places, matches=jnp.asarray(inside))) < 1e-6
    assert float(warped_flicker(image, previous, places_px=places, matches=jnp.ones_like(inside))) > 1e-2
    assert float(warped_flicker(image, previous, places_px=places, matches=jnp.zeros_like(inside))) == 0.0


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
