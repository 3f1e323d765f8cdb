"""The Phong operator against exact fractions, the printed formulas and values, quadrature, and its identities."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxrender import harmonics
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import TIGHT

phong_operator = jax.jit(harmonics.phong_operator, static_argnames="order")


def entry(matrix, name):
    """An entry by hexadecimal row and column."""
    return float(matrix[int(name[0], 16), int(name[1], 16)])


# --- Known values


@pytest.mark.parametrize("exponent", oracles.PHONG_TABLE)
def test_table_of_values(exponent, x64):
    matrix = phong_operator(jnp.asarray(exponent))
    for name, value in oracles.PHONG_TABLE[exponent].items():
        assert entry(matrix, name) == pytest.approx(value, abs=5.1e-8), name  # printed to seven decimals


@pytest.mark.parametrize("exponent", [0.0, 0.37, 1.0, 2.0, 3.7, 16.0, 200.5, 1000.0])
def test_printed_closed_forms(exponent, x64):
    """All 20 entries with the errata put right: M_66 is missing from the list, "M_0B" is M_0C."""
    matrix = np.asarray(phong_operator(jnp.asarray(exponent)))
    forms = oracles.phong_closed_forms(exponent)
    assert len(forms) == 20
    for name, value in forms.items():
        assert entry(matrix, name) == pytest.approx(value, rel=1e-13, abs=1e-16), name
    # The blocks of |m| > 0 stand once for each sign of m, and the rest is zero.
    twins = {"11": "33", "15": "37", "1B": "3D", "55": "77", "5B": "7D", "BB": "DD", "44": "88", "4A": "8E",
             "AA": "EE", "99": "FF"}  # fmt: skip
    full = np.zeros((16, 16))
    for name, value in forms.items():
        for pair in (name, twins.get(name, name)):
            i, j = int(pair[0], 16), int(pair[1], 16)
            full[i, j] = full[j, i] = value
    assert_close(matrix, full, ulps=TIGHT)


def test_erratum_66_and_0c(x64):
    matrix = phong_operator(jnp.asarray(4.0))
    assert entry(matrix, "66") == pytest.approx(5 * (16 + 8 + 3) / (2 * 5 * 7 * 9), rel=1e-14)
    assert entry(matrix, "0C") == pytest.approx(np.sqrt(7) * 3 / (2 * 6 * 8), rel=1e-14)
    assert entry(matrix, "0B") == 0.0


@pytest.mark.parametrize("exponent", [1.0, 2.0, 5.3])
def test_lobe_is_clamped_before_the_power(exponent, x64):
    """(max(0, cos θ))^α, not max(0, cos^α θ): an even power would let the lower hemisphere in."""
    nodes, weights = oracles.sphere_rule(600)
    lobe = np.maximum(nodes[:, 2], 0.0) ** exponent
    y = oracles.real_harmonics(nodes, 4)
    brute = y.T @ ((weights * lobe)[:, None] * y)
    # The kink at the horizon: error of Gauss-Legendre with 301 nodes, worst for α = 1.
    np.testing.assert_allclose(phong_operator(jnp.asarray(exponent)), brute, atol=2e-5)


@pytest.mark.parametrize(("exponent", "nonzeros"), [(0.0, 36), (1.0, 42), (0.5, 44), (2.0, 44), (20.0, 44)])
def test_number_of_nonzeros(exponent, nonzeros, x64):
    assert int((jnp.abs(phong_operator(jnp.asarray(exponent))) > 1e-15).sum()) == nonzeros


def test_normalised_operator_on_the_whole_sphere_is_the_lobe(x64):
    """M^α 1 · (α+1)/2π has the zonal coefficients of the normalised lobe; α = 1 is the clamped cosine / π."""
    exponents = jnp.asarray([0.0, 0.37, 1.0, 20.0])
    ones = jnp.zeros(36).at[0].set(np.sqrt(4 * np.pi))
    transfer = harmonics.apply_operator(phong_operator(exponents, order=6), ones[None])
    transfer = harmonics.phong_normalization(exponents)[:, None] * transfer
    z = jnp.asarray([0.0, 0.0, 1.0])
    lobes = harmonics.zh_to_sh(harmonics.phong_zh(exponents, order=6), z[None])
    assert_close(transfer, lobes, ulps=TIGHT)
    assert_close(transfer[2], harmonics.zh_to_sh(harmonics.clamped_cosine_zh(order=6) / np.pi, z), ulps=TIGHT)


def test_normalization_makes_the_lobe_integrate_to_1(x64):
    exponents = jnp.asarray([0.0, 0.37, 1.0, 1000.0])
    # M_00 = ∫ cos^α / 4π.
    integrals = 4 * np.pi * harmonics.phong_normalization(exponents) * phong_operator(exponents)[:, 0, 0]
    assert_close(integrals, np.ones(4), ulps=8)


# --- Any order, any exponent, either precision


@functools.cache
def exact(exponent):
    """Order 10, of the float32 number next to the exponent."""
    return oracles.phong_matrix(float(np.float32(exponent)), 10)


ALL_EXPONENTS = [0.0, 0.37, 1.0, 2.0, 2.5, 20.0, 200.5, 1000.0, 1e5]


@pytest.mark.parametrize("exponent", ALL_EXPONENTS)
def test_float32_keeps_each_entry_to_1e_6_of_itself(exponent):
    """Up to order 10; entries below 1e-36 (only at 1e5, |m| >= 8) leave the range of float32 on their way."""
    expected = exact(exponent)
    got = np.asarray(phong_operator(jnp.asarray(exponent, jnp.float32), order=10))
    assert got.dtype == np.float32
    error = np.abs(got - expected)
    normal = np.abs(expected) > 1e-36
    assert (error[normal] <= 1e-6 * np.abs(expected[normal])).all()
    # Where an exact entry vanishes nothing but the rounding of its terms may be left.
    assert error[~normal].max() <= 1e-7 * expected.max()


@pytest.mark.parametrize("order", [1, 2, 3, 5, 7, 10])
def test_every_order_in_float64(order, x64):
    exponents = [0.0, 0.37, 20.0, 1000.0]
    got = phong_operator(jnp.asarray(exponents, jnp.float32).astype(jnp.float64), order=order)
    assert got.shape == (4, order**2, order**2)
    for matrix, exponent in zip(got, exponents, strict=True):
        assert_close(matrix, exact(exponent)[: order**2, : order**2], ulps=TIGHT)


def test_exponents_down_to_minus_1(x64):
    exponent = -0.75
    assert_close(phong_operator(jnp.asarray(exponent)), oracles.phong_matrix(exponent, 4), ulps=TIGHT)


# --- Identities


@pytest.mark.parametrize("exponent", [0.0, 0.6, 1.0, 13.0, 700.0])
def test_recurrence_in_the_exponent(exponent, x64):
    """x y_lm = A(l+1,m) y_l+1,m + A(l,m) y_l-1,m raises the exponent by one."""
    order = 6
    low = np.asarray(phong_operator(jnp.asarray(exponent), order=order))
    high = np.asarray(phong_operator(jnp.asarray(exponent + 1.0), order=order))

    def a(l, m):
        return np.sqrt((l * l - m * m) / (4 * l * l - 1))

    for l in range(order - 1):
        for m in range(-l, l + 1):
            row = a(l + 1, m) * low[(l + 1) * (l + 2) + m]
            if l > abs(m):
                row = row + a(l, m) * low[(l - 1) * l + m]
            assert_close(high[l * (l + 1) + m], row, ulps=TIGHT, what=f"row {l}, {m}")


def test_commutes_with_rotations_about_z(rng, x64):
    operator, v = phong_operator(jnp.asarray(7.3), order=6), rng.normal(size=36)
    turn = jnp.asarray(Rotation.from_euler("z", 1.1).as_matrix())
    before = harmonics.apply_operator(operator, harmonics.sh_rotate(v, turn))
    after = harmonics.sh_rotate(harmonics.apply_operator(operator, v), turn)
    assert_close(before, after, ulps=TIGHT)


def test_symmetric_positive_and_decreasing_in_the_exponent(x64):
    low, high = np.asarray(phong_operator(jnp.asarray([1.5, 1.7]), order=5))
    assert_close(low, low.T, ulps=4)
    # cos^α >= cos^α' >= 0 on the hemisphere for α < α'; rounding of the smallest eigenvalue.
    assert np.linalg.eigvalsh(high).min() > -1e-15
    assert np.linalg.eigvalsh(low - high).min() > -1e-15


def test_gradient_matches_finite_differences(x64):
    """At integers too, where a factor of the moments passes through zero."""
    exponents = jnp.asarray([0.0, 0.37, 1.0, 2.0, 3.0, 4.0, 6.0, 20.0, 200.5])
    check_grads(functools.partial(phong_operator, order=5), (exponents,), order=1, modes=["fwd", "rev"])


@pytest.mark.parametrize("exponent", [0.0, 2.0, 2.5, 20.0, 1000.0])
def test_gradient_in_float32(exponent):
    slope = jax.jit(jax.jacfwd(lambda a: harmonics.phong_operator(a, order=6)))
    got = slope(jnp.asarray(exponent, jnp.float32))
    with jax.enable_x64(True):
        expected = slope(jnp.asarray(exponent))
    # The derivative is a sum over ten factors, of terms as large as itself.
    assert_close(got, expected, ulps=64, dtype=np.float32)


def test_batches_of_exponents(rng):
    exponents = jnp.asarray(rng.uniform(0, 90, size=(2, 3)), jnp.float32)
    got = phong_operator(exponents)
    assert got.shape == (2, 3, 16, 16)
    assert_close(harmonics.phong_operator(exponents), got, ulps=8, dtype=np.float32)
    mapped = jax.jit(jax.vmap(jax.vmap(harmonics.phong_operator)))(exponents)
    assert_close(mapped, got, ulps=8, dtype=np.float32)
    assert_close(phong_operator(exponents[1, 2]), got[1, 2], ulps=8, dtype=np.float32)


# --- Any kernel


@pytest.mark.parametrize("exponent", [0, 1, 5])
def test_generic_operator_is_exact_for_polynomials(exponent, x64):
    got = harmonics.brdf_operator(lambda x: x**exponent, order=6, num_nodes=8)
    assert_close(got, phong_operator(jnp.asarray(float(exponent)), order=6), ulps=TIGHT)


def test_generic_operator_is_exact_up_to_the_promised_degree(x64):
    order, num_nodes = 4, 5
    degree = 2 * num_nodes - 2 * order + 1
    for above in (0, 1):
        exponent = degree + above
        got = harmonics.brdf_operator(lambda x, n=exponent: x**n, order=order, num_nodes=num_nodes)
        error = np.abs(got - phong_operator(jnp.asarray(float(exponent)), order=order)).max()
        assert (error > 1e-7) == bool(above), f"degree {exponent}: {error}"


def test_generic_operator_is_quadrature_on_the_sphere(x64):
    kernel = lambda x: 0.05 / ((1.0 - x * x) + 0.05)  # noqa: E731
    got = harmonics.brdf_operator(kernel, order=5, num_nodes=128)
    # The weights of NumPy's Gauss-Legendre rules are good to some 1e-13, and the oracle's has 400 nodes.
    assert_close(got, oracles.operator_matrix(kernel, 5), ulps=8 * TIGHT)
    assert harmonics.brdf_operator(kernel).shape == (16, 16)


def test_generic_operator_is_differentiable_in_the_kernel(x64):
    operator = jax.jit(lambda a: harmonics.brdf_operator(lambda x: x**a, order=3, num_nodes=64))
    check_grads(operator, (jnp.asarray(3.0),), order=1, modes=["rev"])
    slopes = [
        jax.jit(jax.jacfwd(f))(jnp.asarray(3.0)) for f in (operator, lambda a: harmonics.phong_operator(a, order=3))
    ]
    # x³ log x has its third derivative at the horizon only: 64 nodes leave 1e-9.
    np.testing.assert_allclose(slopes[0], slopes[1], atol=1e-8)


def test_apply_operator_broadcasts(rng, x64):
    operators, vectors = rng.normal(size=(1, 3, 9, 9)), rng.normal(size=(2, 1, 9))
    expected = np.einsum("bcij,bcj->bci", np.broadcast_to(operators, (2, 3, 9, 9)), np.broadcast_to(vectors, (2, 3, 9)))
    assert_close(harmonics.apply_operator(operators, vectors), expected, ulps=TIGHT)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="order: expected a value >= 1"):
        harmonics.phong_operator(jnp.asarray(1.0), order=0)
    with pytest.raises(ValueError, match="num_nodes: expected a value >= 4, got 3"):
        harmonics.brdf_operator(lambda x: x, num_nodes=3)
