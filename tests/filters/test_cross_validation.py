"""jaxrender.filters.cross_validation: own shares against filter matrices, errors against pixels that are left out."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxrender.filters.bilateral import cross_bilateral_filter
from jaxrender.filters.cross_validation import leave_one_out_error, own_share
from jaxrender.filters.guided import guided_filter
from jaxrender.filters.sat import box_mean
from tests.filters.oracle import of_windows

# Compiling is nearly all of the time here.
_compiled = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
_shares = _compiled(jax.vmap(own_share, in_axes=-1))


def impulses(height: int, width: int) -> np.ndarray:
    """One channel for each pixel: 1 there, 0 elsewhere."""
    return np.eye(height * width, dtype=np.float32).reshape(height, width, -1)


def diagonal(image_filter, height: int, width: int) -> np.ndarray:
    """A_ii of a filter that takes each channel by itself."""
    matrix = np.asarray(_compiled(image_filter)(jnp.asarray(impulses(height, width)))).reshape(height * width, -1)
    return np.diagonal(matrix).reshape(height, width)


def left_out(image_filter, image) -> np.ndarray:
    """At each pixel what the filter makes of the image without it."""
    image_filter = _compiled(jax.vmap(image_filter))
    height, width, _ = image.shape
    holes = np.moveaxis(impulses(height, width), -1, 0)[..., None] > 0.0
    with jax.debug_nans(False):
        images = jnp.where(jnp.asarray(holes), jnp.nan, jnp.asarray(image)[None])
        filtered = np.asarray(image_filter(images))
    return (filtered * holes).sum(0)


@pytest.mark.parametrize(("kind", "size"), [("guided", (6, 7)), ("box", (3, 40))])
def test_shares_are_the_diagonal_of_the_filter(rng, kind, size):
    """The mean over probes (Hadamard's, with signs) in which any two pixels are orthogonal is exact.

    A half of the image stays as it is, so that no share is cut.
    """
    guide = jnp.asarray(rng.uniform(size=(*size, 3)), jnp.float32)
    filters = {"guided": partial(guided_filter, guide, radius=2, eps=0.01), "box": partial(box_mean, radius=1)}
    image_filter = lambda x: 0.5 * x + 0.5 * filters[kind](x)  # noqa: E731
    exact = diagonal(image_filter, *size)
    count = size[0] * size[1]
    order = 1 << (count - 1).bit_length()
    signs = rng.choice([-1, 1], size=(count, 1)) * scipy.linalg.hadamard(order)[:count]
    probes = jnp.asarray(signs.reshape(*size, order), jnp.float32)
    shares = _shares(probes, _compiled(image_filter)(probes))
    assert shares.min() > 0.0 and shares.max() < 0.9
    expected = of_windows(exact[..., None], 8, lambda pixels: pixels.mean(0))[..., 0]
    np.testing.assert_allclose(shares.mean(0), expected, rtol=1e-4)


def test_shares_are_cut():
    ones = jnp.ones((3, 4))
    cut = _shares(jnp.stack([ones, ones], axis=-1), jnp.stack([ones, -ones], axis=-1))
    np.testing.assert_allclose(cut[0], 0.9)
    np.testing.assert_allclose(cut[1], 0.0)
    with pytest.raises(ValueError, match="probe and filtered_probe"):
        own_share(ones, ones[:2])


@pytest.mark.parametrize("kind", ["box", "bilateral"])
def test_errors_are_those_of_pixels_left_out(rng, kind):
    """Exact for weighted means, whose weights without a pixel are the same but for their sum."""
    image, guide = (jnp.asarray(rng.uniform(size=(6, 7, n)), jnp.float32) for n in (2, 2))
    image_filter = {
        "box": partial(box_mean, radius=1),
        "bilateral": lambda x: cross_bilateral_filter(x, guide, radius=2, sigma_spatial=1.0, sigma_features=0.3),
    }[kind]
    share, weight = jnp.asarray(diagonal(image_filter, 6, 7)), jnp.asarray(rng.uniform(size=(6, 7, 2)), jnp.float32)
    error = leave_one_out_error(image, _compiled(image_filter)(image), share, weight=weight)
    truly = (np.asarray(image) - left_out(image_filter, image)) ** 2
    np.testing.assert_allclose(error, np.average(truly, weights=weight), rtol=1e-4)


def test_errors_of_the_guided_filter_are_near_those(rng):
    """Exact in each window but for the ridge, n eps, which has one pixel less; a pixel's windows differ in its share.

    With shares h of a window of n pixels, e / (1 - h) is averaged over windows, and not e and h by themselves: that is
    some h² = 0.01 of the error for h near 0.1, and twice that of its square.
    """
    guide = np.cumsum(rng.uniform(size=(9, 11, 1)), axis=1) / 11.0
    image = np.sin(3.0 * guide) + 0.3 * rng.normal(size=guide.shape)
    image_filter = partial(guided_filter, jnp.asarray(guide, jnp.float32), radius=2, eps=0.01)
    image = jnp.asarray(image, jnp.float32)
    weight, filtered = jnp.ones_like(image), _compiled(image_filter)(image)
    truly = float(np.mean((np.asarray(image) - left_out(image_filter, image)) ** 2))
    share = jnp.asarray(diagonal(image_filter, 9, 11))
    assert 0.05 < float(share.mean()) < 0.25
    found = float(leave_one_out_error(image, filtered, share, weight=weight))
    naive = float(leave_one_out_error(image, filtered, jnp.zeros_like(share), weight=weight))
    assert abs(found / truly - 1.0) < 0.02 < 0.1 < abs(naive / truly - 1.0)


def test_weights_and_pixels_that_are_not_finite():
    image, filtered = jnp.array([[[1.0, 0.0], [5.0, 0.0]]]), jnp.array([[[0.0, 2.0], [5.0, 3.0]]])
    share, weight = jnp.array([[0.5, 0.0]]), jnp.array([[[3.0, 1.0], [1.0, 0.0]]])
    error = partial(leave_one_out_error, share=share, weight=weight)
    np.testing.assert_allclose(error(image, filtered), (3 * 4.0 + 1 * 16.0) / 5.0)
    with jax.debug_nans(False):
        np.testing.assert_allclose(error(image.at[0, 0, 1].set(jnp.nan), filtered), 3 * 4.0 / 4.0)
    with pytest.raises(ValueError, match="image and filtered"):
        error(image, filtered[:, :1])
