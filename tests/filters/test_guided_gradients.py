"""Derivatives of the guided filter: finite differences, plain autodiff, masked and flat places, memory."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters import guided_filter
from jaxrender.filters.guided import _filtered, filter_planes

# Compiling is nearly all of the time here.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
SIZE = 8, 11
MIX = np.random.default_rng(3).normal(size=(*SIZE, 2))
MASKED = {"guide": [(0, 0), (4, 5)], "image": [(4, 5), (2, 8), (7, 10), (7, 9), (6, 10), (6, 9)]}


def objective(guide, image, eps, *, radius: int = 1, **options):
    """A fixed random mix of the result."""
    filtered = guided_filter(guide, image, radius=radius, eps=eps, **options)
    return jnp.sum(filtered * jnp.asarray(MIX[: image.shape[0]], filtered.dtype))


def value_and_slopes(**options):
    return quick(jax.value_and_grad(functools.partial(objective, **options), argnums=(0, 1, 2)))


def arguments(eps_shape=(), *, masked: bool = True):
    rng = np.random.default_rng(1)
    guide, image = rng.uniform(size=(*SIZE, 3)), rng.normal(size=(*SIZE, 2))
    if masked:  # the last four leave the window in the corner without a pixel
        for k, (y, x) in enumerate(MASKED["guide"]):
            guide[y, x, k] = np.nan
        for k, (y, x) in enumerate(MASKED["image"]):
            image[y, x, k % 2] = np.inf
    return guide, image, rng.uniform(0.01, 0.1, size=eps_shape)


def check_by_finite_differences(function, values):
    """Along a few random directions in each argument by itself."""
    rng = np.random.default_rng(2)
    with jax.debug_nans(False):
        _, slopes = function(*values)
        for k, slope in enumerate(map(np.asarray, slopes)):
            assert np.isfinite(slope).all() and not slope[~np.isfinite(values[k])].any()
            for _ in range(3):
                along = np.where(np.isfinite(values[k]), rng.normal(size=values[k].shape), 0.0)
                step = 1e-5 if k < 2 else 1e-6
                ends = [function(*values[:k], values[k] + s * step * along, *values[k + 1 :])[0] for s in (-1, 1)]
                expected = (ends[1] - ends[0]) / (2.0 * step)
                np.testing.assert_allclose(np.sum(slope * along), expected, rtol=1e-6, atol=1e-7)


def test_derivatives_of_an_image_that_guides_itself(x64):
    """Those to guide and image, added up."""
    guide, _, eps = arguments((3,))
    mix = jnp.asarray(np.random.default_rng(5).normal(size=guide.shape))

    def total(guide, image, eps):
        return jnp.sum(guided_filter(guide, image, radius=1, eps=eps) * mix)

    with jax.debug_nans(False):
        apart = quick(jax.grad(total, argnums=(0, 1, 2)))(guide, guide.copy(), eps)
        found = quick(jax.grad(lambda x, eps: total(x, x, eps), argnums=(0, 1)))(guide, eps)
    np.testing.assert_allclose(found[0], apart[0] + apart[1], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found[1], apart[2], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("eps_shape", [(), (3,), (*SIZE, 1), (*SIZE, 3)])
def test_derivatives_are_finite_differences(eps_shape, x64):
    function = value_and_slopes()
    check_by_finite_differences(function, arguments(eps_shape))
    check_by_finite_differences(function, arguments(eps_shape, masked=False))


@pytest.mark.parametrize(
    "options", [{"subsample": 3, "radius": 4}, {"edge_aware": True}, {"edge_aware": True, "subsample": 2}]
)
def test_derivatives_of_options_are_finite_differences(options, x64):
    """With a guide whose darkest and brightest pixels stay: its range counts as a constant."""
    values, function = arguments((3,)), value_and_slopes(**options)
    ends = np.zeros(values[0].shape, bool)
    ends[3, 3], ends[5, 2] = True, True

    def with_ends(guide, *rest):
        value, (slope, *slopes) = function(np.where(ends, [0.0, 1.0, 0.0], guide), *rest)
        return value, (np.where(ends, 0.0, slope), *slopes)

    check_by_finite_differences(with_ends, values)


@pytest.mark.parametrize("eps_shape", [(3, 1, 1), (3, *SIZE)])
def test_the_rule_is_plain_autodiff_of_the_stages(eps_shape, x64):
    rng = np.random.default_rng(4)
    guide, image, mix = rng.uniform(size=(3, *SIZE)), rng.normal(size=(2, *SIZE)), np.moveaxis(MIX, -1, 0)
    eps, valid = rng.uniform(0.01, 0.1, size=eps_shape), rng.uniform(size=SIZE) < 0.5
    valid[:3, :3] = False
    ours, plain = (
        quick(jax.grad(lambda g, i, v, e, f=f: jnp.sum(f(g, i, v, e) * mix), argnums=(0, 1, 3)))
        for f in (lambda *a: _filtered(*a, 1), functools.partial(filter_planes, radius=1))
    )
    for found, expected in zip(ours(guide, image, valid, eps), plain(guide, image, valid, eps), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_float32_loses_little_and_a_batch_is_its_images():
    """Also where the guide is flat, or nothing is valid."""
    values = [arguments((3,)), arguments((3,), masked=False)]
    values.append((np.full_like(values[0][0], 0.3), *values[1][1:]))
    values.append((np.full_like(values[0][0], np.nan), *values[1][1:]))
    slopes = jax.grad(objective, argnums=(0, 1, 2))
    with jax.debug_nans(False):
        batch = [jnp.asarray(np.stack(x), jnp.float32) for x in zip(*values, strict=True)]
        together = quick(jax.vmap(slopes))(*batch)
        with jax.enable_x64(True):
            exact = [quick(slopes)(*v) for v in values]
    for found, *expected in zip(together, *exact, strict=True):
        assert found.dtype == jnp.float32 and np.isfinite(found).all()
        for one, wanted in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, wanted, rtol=0, atol=2e-5 * max(np.abs(wanted).max(), 1e-3))


def test_memory_on_the_way_back():
    """At most 6 (g + 1) (g + c + 1) planes, and two thirds of what plain autodiff keeps."""
    size, g, c = (256, 256), 3, 3
    guide, image = (jax.ShapeDtypeStruct((k, *size), jnp.float32) for k in (g, c))
    valid, eps = jax.ShapeDtypeStruct(size, bool), jax.ShapeDtypeStruct((g, 1, 1), jnp.float32)
    planes = []
    for function in (lambda *a: _filtered(*a, 8), functools.partial(filter_planes, radius=8)):
        slopes = jax.grad(lambda *a, f=function: jnp.sum(f(*a) ** 2), argnums=(0, 1, 3))
        compiled = quick(slopes).lower(guide, image, valid, eps).compile()
        planes.append(compiled.memory_analysis().temp_size_in_bytes / (4 * size[0] * size[1]))
    assert planes[0] < 6.0 * (g + 1) * (g + c + 1)
    assert planes[0] < planes[1] / 1.5
