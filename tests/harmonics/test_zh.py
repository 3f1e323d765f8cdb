"""Zonal harmonics: the standard vectors, lobes turned to an axis, and their identities."""

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import special

from jaxrender import harmonics
from jaxrender.harmonics.zh import legendre
from jaxrender.harmonics.zh_fit import optimal_linear_direction
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import ROUNDING, TIGHT

PI = np.pi

lobes_to_sh = jax.jit(harmonics.lobes_to_sh)
phong_zh = jax.jit(harmonics.phong_zh, static_argnames="order")
zh_evaluate = jax.jit(harmonics.zh_evaluate)
zh_to_sh = jax.jit(harmonics.zh_to_sh)


# --- Standard vectors


def test_clamped_cosine_is_the_printed_vector(x64):
    got = harmonics.clamped_cosine_zh(order=5)
    assert_close(got, np.sqrt(PI) * np.array([1 / 2, 1 / np.sqrt(3), np.sqrt(5) / 8, 0, -1 / 16]), ulps=TIGHT)
    factors = np.asarray(got) * np.sqrt(4 * PI / (2 * np.arange(5) + 1))
    assert_close(factors, PI * np.array([1, 2 / 3, 1 / 4, 0, -1 / 24]), ulps=TIGHT)


def test_hemisphere_is_the_printed_vector(x64):
    got = harmonics.hemisphere_zh(order=4)
    assert_close(got, np.array([np.sqrt(PI), np.sqrt(3 * PI) / 2, 0, -np.sqrt(7 * PI) / 8]), ulps=TIGHT)
    assert_close(got, np.array([1.772454, 1.534990, 0, -0.586184]), ulps=1, dtype=np.float16)


@pytest.mark.parametrize("exponent", [0.0, 0.37, 1.0, 2.0, 3.7, 16.0, 200.5])
def test_phong_is_the_printed_vector_and_the_integral(exponent, x64):
    got = np.asarray(phong_zh(jnp.asarray(exponent), order=10))
    a = exponent
    rho = [
        1, (a + 1) / (a + 2), a / (a + 3), (a + 1) * (a - 1) / ((a + 2) * (a + 4)),
        a * (a - 2) / ((a + 3) * (a + 5)),
    ]  # fmt: skip
    assert_close(got[:5], np.sqrt((2 * np.arange(5) + 1) / (4 * PI)) * np.array(rho), ulps=TIGHT)

    # (α+1)/2π ∫ cos^α y_l0, with the integral as an exact sum of fractions.
    column = [oracles.phong_entry(Fraction(exponent), l, 0, 0) for l in range(10)]
    assert_close(got, (a + 1) / (2 * PI) * np.sqrt(4 * PI) * np.array(column), ulps=TIGHT)


def test_phong_joins_the_other_vectors(x64):
    """α = 0 is the hemisphere / 2π, α = 1 the clamped cosine / π."""
    got = phong_zh(jnp.asarray([0.0, 1.0]), order=8)
    assert_close(got[0], harmonics.hemisphere_zh(order=8) / (2 * PI), ulps=TIGHT)
    assert_close(got[1], harmonics.clamped_cosine_zh(order=8) / PI, ulps=TIGHT)


@pytest.mark.parametrize("exponent", [0.0, 0.37, 1.0, 7.0, 20.0, 1000.0, 1e5])
def test_phong_in_float32(exponent):
    """Each product of ratios is a few roundings off: 18 of them at band 9."""
    got = phong_zh(jnp.asarray(exponent, jnp.float32), order=10)
    with jax.enable_x64(True):
        expected = phong_zh(jnp.asarray(float(np.float32(exponent))), order=10)
    assert got.dtype == jnp.float32
    assert_close(got, expected, ulps=ROUNDING / 2, dtype=np.float32, entrywise=True)


def test_phong_gradient_at_integers_where_factors_vanish(x64):
    exponents = jnp.asarray([0.5, 1.0, 2.0, 3.0, 6.0, 40.0])
    check_grads(functools.partial(phong_zh, order=8), (exponents,), order=1)


# --- Lobes


@pytest.mark.parametrize("order", [1, 2, 4, 10])
def test_lobe_is_the_zonal_function_of_the_angle(order, rng, x64):
    """f(s) = Σ_l z_l √((2l+1)/4π) P_l(d·s), by definition and by either kernel."""
    z, axis = rng.normal(size=order), oracles.unit(rng.normal(size=3))
    s = np.concatenate([axis[None], -axis[None], oracles.unit(rng.normal(size=(10, 3)))])
    terms = [
        z[l] * np.sqrt((2 * l + 1) / (4 * PI)) * special.eval_legendre(l, np.clip(s @ axis, -1, 1))
        for l in range(order)
    ]
    assert_close(zh_evaluate(z[None], axis[None], s), sum(terms), ulps=TIGHT)
    assert_close(oracles.real_harmonics(s, order) @ np.asarray(zh_to_sh(z, axis)), sum(terms), ulps=TIGHT)


def test_lobe_along_z_has_the_zonal_coefficients(rng, x64):
    z = rng.normal(size=5)
    expected = np.zeros(25)
    expected[[0, 2, 6, 12, 20]] = z
    assert_close(zh_to_sh(z, np.array([0.0, 0.0, 1.0])), expected, ulps=TIGHT)


def test_antipodal_lobe_is_the_same(rng, x64):
    z, axis = rng.normal(size=(3, 6)), oracles.unit(rng.normal(size=(3, 3)))
    flipped = z * (-1.0) ** np.arange(6)
    assert_close(zh_to_sh(flipped, -axis), zh_to_sh(z, axis), ulps=TIGHT)


def test_length_of_a_lobe_does_not_depend_on_its_axis(rng, x64):
    z = rng.normal(size=4)
    lengths = np.linalg.norm(np.asarray(zh_to_sh(z[None], oracles.unit(rng.normal(size=(7, 3))))), axis=-1)
    assert_close(lengths, np.full(7, np.linalg.norm(z)), ulps=TIGHT)


def test_lobes_add_up(rng, x64):
    z, axes = rng.normal(size=(4, 3, 4)), oracles.unit(rng.normal(size=(4, 3, 3)))
    expected = sum(np.asarray(zh_to_sh(z[:, i], axes[:, i])) for i in range(3))
    assert_close(lobes_to_sh(z, axes), expected, ulps=TIGHT)


def test_optimal_linear_direction_of_a_lobe_is_its_axis(rng, x64):
    axes = oracles.unit(rng.normal(size=(6, 3)))
    v = zh_to_sh(harmonics.clamped_cosine_zh(order=4)[None], axes)
    assert_close(optimal_linear_direction(v), axes, ulps=TIGHT)
    # Whatever the other bands hold, it is the gradient of band 1.
    w = rng.normal(size=16)
    best = optimal_linear_direction(w)
    band_1 = oracles.real_harmonics(oracles.unit(rng.normal(size=(500, 3))), 2)[:, 1:] @ w[1:4]
    assert float(oracles.real_harmonics(np.asarray(best), 2)[1:] @ w[1:4]) >= band_1.max()


def test_legendre_is_scipys(x64):
    x = np.linspace(-1, 1, 21)
    expected = np.stack([special.eval_legendre(l, x) for l in range(10)], axis=-1)
    assert_close(legendre(x, order=10), expected, ulps=TIGHT)
    assert legendre(x, order=1).shape == (21, 1)


def test_gradients_match_finite_differences(rng, x64):
    z, axis, s = rng.normal(size=(2, 4)), oracles.unit(rng.normal(size=(2, 3))), oracles.unit(rng.normal(size=(2, 3)))
    check_grads(zh_to_sh, (z, axis), order=1, modes=["rev"])
    check_grads(zh_evaluate, (z, axis, s), order=1, modes=["rev"])


def test_shapes_dtypes_batches(rng):
    z = jnp.asarray(rng.normal(size=(5, 2, 4)), jnp.float32)
    axes = jnp.asarray(oracles.unit(rng.normal(size=(5, 2, 3))), jnp.float32)
    got = lobes_to_sh(z, axes)
    assert got.shape == (5, 16)
    assert got.dtype == jnp.float32
    assert_close(harmonics.lobes_to_sh(z, axes), got, ulps=8, dtype=np.float32)
    assert_close(jax.vmap(harmonics.lobes_to_sh)(z, axes), got, ulps=8, dtype=np.float32)
    assert_close(jnp.stack([lobes_to_sh(z[i], axes[i]) for i in range(5)]), got, ulps=8, dtype=np.float32)
    assert harmonics.clamped_cosine_zh(order=3).dtype == jnp.float32
    assert phong_zh(jnp.ones((2, 3)), order=4).shape == (2, 3, 4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: harmonics.zh_to_sh(jnp.zeros(4), jnp.zeros(2)), "axis: expected shape"),
        (lambda: harmonics.clamped_cosine_zh(order=0), "order: expected a value >= 1"),
        (lambda: harmonics.hemisphere_zh(order=0), "order: expected a value >= 1"),
        (lambda: harmonics.phong_zh(jnp.ones(()), order=0), "order: expected a value >= 1"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
