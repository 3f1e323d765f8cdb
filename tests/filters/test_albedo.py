"""jaxrender.filters.albedo: light without texture and back, where albedo tells nothing, derivatives, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters.albedo import demodulate, remodulate


@pytest.fixture
def light(rng):
    return jnp.asarray(rng.uniform(0.0, 5.0, (5, 6, 3)), jnp.float32)


@pytest.fixture
def albedo(rng):
    return jnp.asarray(rng.uniform(0.01, 1.0, (5, 6, 3)), jnp.float32)


def test_each_undoes_the_other(light, albedo):
    np.testing.assert_allclose(demodulate(light * albedo, albedo), light, rtol=1e-6)
    np.testing.assert_allclose(remodulate(demodulate(light, albedo), albedo), light, rtol=1e-6)


def test_they_are_linear(light, albedo):
    dark = albedo.at[1].set(0.0).at[2, :, 0].set(1e-4)
    other = light[::-1]
    for function in (demodulate, remodulate):
        both = 2.0 * function(light, dark) - function(other, dark)
        np.testing.assert_allclose(function(2.0 * light - other, dark), both, rtol=1e-5, atol=1e-4)


def test_a_dark_channel_takes_the_light_of_the_others():
    radiance, albedo = jnp.array([[[1.0, 4.0, 0.3]]]), jnp.array([[[0.5, 1.0, 5e-4]]])
    np.testing.assert_allclose(demodulate(radiance, albedo), [[[2.0, 4.0, 3.0]]])
    # By its own albedo again: what a channel reflects of such light.
    np.testing.assert_allclose(remodulate(demodulate(radiance, albedo), albedo), [[[1.0, 4.0, 1.5e-3]]])
    np.testing.assert_allclose(demodulate(radiance, albedo, floor=1e-4)[0, 0, 2], 600.0, rtol=1e-6)
    np.testing.assert_allclose(demodulate(radiance, albedo, floor=0.7), [[[4.0, 4.0, 4.0]]])


@pytest.mark.parametrize("shade", [[0.0, 0.0, 0.0], [9e-4, 1e-4, 0.0], [0.5, np.nan, 0.5], [np.inf, 0.5, 0.5]])
def test_without_an_albedo_radiance_stays(light, albedo, shade):
    with jax.debug_nans(False):
        broken = albedo.at[2, 3].set(jnp.array(shade))
        divided = demodulate(light, broken)
        np.testing.assert_array_equal(divided[2, 3], light[2, 3])
        np.testing.assert_array_equal(remodulate(divided, broken)[2, 3], light[2, 3])
    np.testing.assert_array_equal(divided.at[2, 3].set(0.0), demodulate(light, albedo).at[2, 3].set(0.0))


def test_derivatives_are_finite_beside_the_floor(light, albedo):
    dark = albedo.at[0].set(0.0).at[1, :, 1].set(0.0)
    slope = jax.grad(lambda x: jnp.sum(demodulate(x, dark)))(light)
    # Of a dark channel nothing is used; the others count for themselves and a half for it.
    np.testing.assert_allclose(slope[0], 1.0)
    np.testing.assert_allclose(slope[1], np.array([1.5, 0.0, 1.5]) / np.where(dark[1] > 0.0, dark[1], 1.0), rtol=1e-6)
    assert np.isfinite(jax.grad(lambda a: jnp.sum(demodulate(light, a)))(dark)).all()


@pytest.mark.parametrize(("function", "names"), [(demodulate, "radiance and albedo"), (remodulate, "light and albedo")])
def test_shapes_that_differ(light, albedo, function, names):
    with pytest.raises(ValueError, match=names):
        function(light, albedo[:4])
