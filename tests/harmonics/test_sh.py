"""Spherical harmonics against the printed table, SciPy, e3nn, quadrature and the laws of rotation."""

import functools

import e3nn_jax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import special
from scipy.spatial.transform import Rotation

from jaxrender import harmonics
from jaxrender.harmonics import sh as sh_module
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import ROUNDING, TIGHT

ORDERS = range(1, 11)

sh_basis = jax.jit(harmonics.sh_basis, static_argnames="order")
sh_rotate = jax.jit(harmonics.sh_rotate)
sh_product = jax.jit(harmonics.sh_product, static_argnames="order")
sh_to_layout = jax.jit(harmonics.sh_to_layout, static_argnames="layout")
sh_from_layout = jax.jit(harmonics.sh_from_layout, static_argnames="layout")


@pytest.fixture
def directions(rng):
    """The poles and the other axes, some directions next to the poles, and random ones."""
    near = [[1e-7, 0, 1], [1e-4, 1e-4, -1]]
    v = np.concatenate([np.eye(3), -np.eye(3), near, rng.normal(size=(20, 3))])
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def ulps(dtype):
    """Formulas agree to a few thousand roundings in float64; in float32 the result is off by tens of them."""
    return TIGHT if dtype == np.float64 else ROUNDING


# --- Basis


def test_basis_is_the_definition(directions, dtype):
    """Orders 1 to 10, compiled together."""
    every_order = jax.jit(lambda d: [harmonics.sh_basis(d, order=order) for order in ORDERS])
    for order, got in zip(ORDERS, every_order(jnp.asarray(directions, dtype)), strict=True):
        assert got.dtype == dtype
        expected = oracles.real_harmonics(directions, order)
        assert_close(got, expected, ulps=ulps(dtype), dtype=dtype, what=f"order {order}")


def test_basis_is_the_printed_table(directions, x64):
    x, y, z = directions.T
    p = np.sqrt(np.pi)
    s = np.sqrt
    table = [
        1 / (2 * p) + 0 * x, -s(3) * y / (2 * p), s(3) * z / (2 * p), -s(3) * x / (2 * p),
        s(15) * x * y / (2 * p), -s(15) * y * z / (2 * p), s(5) * (3 * z**2 - 1) / (4 * p),
        -s(15) * x * z / (2 * p), s(15) * (x**2 - y**2) / (4 * p), -s(70) * y * (3 * x**2 - y**2) / (8 * p),
        s(105) * x * y * z / (2 * p), -s(42) * y * (5 * z**2 - 1) / (8 * p), s(7) * z * (5 * z**2 - 3) / (4 * p),
        -s(42) * x * (5 * z**2 - 1) / (8 * p), s(105) * z * (x**2 - y**2) / (4 * p),
        -s(70) * x * (x**2 - 3 * y**2) / (8 * p),
    ]  # fmt: skip
    assert_close(sh_basis(directions, order=4), np.stack(table, axis=-1), ulps=TIGHT)
    # Constants as printed, to ten digits.
    at_axes = sh_basis(np.eye(3), order=2)
    assert at_axes[0, 0] == pytest.approx(0.2820947918, abs=5e-11)
    assert [float(at_axes[i, j]) for i, j in ((1, 1), (2, 2), (0, 3))] == pytest.approx(
        [-0.4886025119, 0.4886025119, -0.4886025119], abs=5e-11
    )


def test_basis_is_made_of_scipys_complex_harmonics(directions, x64):
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    got = np.asarray(sh_basis(directions, order=10))
    for l in range(10):
        for m in range(l + 1):
            complex_y = special.sph_harm_y(l, m, theta, phi)
            norm = np.sqrt(2.0) if m else 1.0
            # arccos next to the poles loses half the digits of the polar angle.
            np.testing.assert_allclose(got[:, l * (l + 1) + m], norm * complex_y.real, atol=1e-7)
            if m:
                np.testing.assert_allclose(got[:, l * (l + 1) - m], norm * complex_y.imag, atol=1e-7)


@pytest.mark.parametrize("order", [1, 4, 10])
def test_basis_is_orthonormal(order, x64):
    nodes, weights = oracles.sphere_rule(2 * order)
    y = np.asarray(sh_basis(nodes, order=order))
    assert_close(y.T @ (weights[:, None] * y), np.eye(order**2), ulps=TIGHT)


def test_addition_theorem(directions, x64):
    y = np.asarray(sh_basis(directions, order=10))
    for l in range(10):
        band = y[:, l * l : (l + 1) ** 2]
        cosines = np.clip(directions @ directions.T, -1, 1)
        expected = (2 * l + 1) / (4 * np.pi) * special.eval_legendre(l, cosines)
        assert_close(band @ band.T, expected, ulps=TIGHT)


def test_parity(directions, x64):
    sign = np.repeat((-1.0) ** np.arange(6), 2 * np.arange(6) + 1)
    assert_close(sh_basis(-directions, order=6), sign * np.asarray(sh_basis(directions, order=6)), ulps=4)


def test_basis_has_gradients_at_the_poles(directions):
    with jax.enable_x64(True):
        check_grads(functools.partial(sh_basis, order=5), (directions[:8],), order=1, modes=["rev"])
    total = jax.jit(jax.grad(lambda d: jnp.sum(harmonics.sh_basis(d, order=5) ** 3)))
    assert np.isfinite(np.asarray(total(jnp.asarray(directions)))).all()


def test_vmap_is_a_loop(rng):
    d = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    batched = sh_basis(d, order=4)
    assert batched.shape == (2, 3, 16)
    assert_close(jax.vmap(lambda x: harmonics.sh_basis(x, order=4))(d), batched, ulps=4, dtype=np.float32)
    assert_close(harmonics.sh_basis(d[1, 2], order=4), batched[1, 2], ulps=4, dtype=np.float32)


def test_projection_and_evaluation_are_inverse(rng, x64):
    nodes, weights = oracles.sphere_rule(8)
    v = rng.normal(size=(2, 25))
    values = harmonics.sh_evaluate(v[:, None, :], nodes[None])
    assert values.shape == (2, len(nodes))
    assert_close(values, v @ oracles.real_harmonics(nodes, 5).T, ulps=TIGHT)
    assert_close(harmonics.sh_project(values, nodes, weights, order=5), v, ulps=TIGHT)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: harmonics.sh_basis(jnp.zeros((4, 2)), order=3), "directions: expected shape"),
        (lambda: harmonics.sh_basis(jnp.zeros(3), order=0), "order: expected a value >= 1, got 0"),
        (lambda: harmonics.sh_evaluate(jnp.zeros(15), jnp.zeros(3)), "sh: expected 9 coefficients for order 3"),
        (lambda: harmonics.sh_rotate(jnp.zeros(16), jnp.zeros((2, 2))), "rotation: expected shape"),
        (lambda: harmonics.sh_convolve_zonal(jnp.zeros(16), jnp.zeros(3)), "kernel: expected shape"),
        (lambda: harmonics.sh_to_layout(jnp.zeros(16), "opengl"), "layout: expected one of gaussian_splatting"),
        (lambda: harmonics.sh_from_layout(jnp.zeros(16), "opengl"), "layout: expected one of"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# --- Rotation


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5, 6, 8, 10])
def test_rotation_turns_the_function(order, rng, dtype):
    """f'(s) = f(Rᵀ s), judged by values at many directions."""
    v, nodes = rng.normal(size=(3, order**2)), oracles.sphere_rule(2 * order)[0]
    turns = Rotation.random(3, random_state=order).as_matrix()
    got = np.asarray(sh_rotate(jnp.asarray(v, dtype), jnp.asarray(turns, dtype)), np.float64)
    for i in range(3):
        expected = oracles.real_harmonics(nodes @ turns[i], order) @ v[i]
        # nodes @ R are the rows Rᵀ s.
        assert_close(oracles.real_harmonics(nodes, order) @ got[i], expected, ulps=ulps(dtype), dtype=dtype)


@pytest.mark.parametrize("order", [4, 7])
def test_rotations_form_a_group(order, rng, x64):
    v = rng.normal(size=order**2)
    a, b = Rotation.random(2, random_state=5).as_matrix()
    assert_close(sh_rotate(v, np.eye(3)), v, ulps=TIGHT)
    assert_close(sh_rotate(sh_rotate(v, b), a), sh_rotate(v, a @ b), ulps=TIGHT)
    assert_close(sh_rotate(sh_rotate(v, a), a.T), v, ulps=TIGHT)
    # Bands do not mix, so each keeps its length.
    lengths = [np.linalg.norm(np.split(np.asarray(x), np.arange(1, order) ** 2)[-1]) for x in (v, sh_rotate(v, a))]
    assert_close(lengths[1], lengths[0], ulps=TIGHT)


@pytest.mark.parametrize("order", [4, 6])
def test_rotation_about_z_turns_pairs_of_m(order, rng, x64):
    angle, v = 0.7, rng.normal(size=order**2)
    got = sh_rotate(v, Rotation.from_euler("z", angle).as_matrix())
    expected = v.copy()
    for l in range(order):
        for m in range(1, l + 1):
            plus, minus = l * (l + 1) + m, l * (l + 1) - m
            c, s = np.cos(m * angle), np.sin(m * angle)
            expected[plus], expected[minus] = c * v[plus] - s * v[minus], s * v[plus] + c * v[minus]
    assert_close(got, expected, ulps=TIGHT)


def test_rotation_moves_a_lobe_to_its_turned_axis(rng, x64):
    z, axis = rng.normal(size=6), np.array([0.6, 0.0, 0.8])
    turn = Rotation.random(random_state=2).as_matrix()
    moved = harmonics.sh_rotate(harmonics.zh_to_sh(z, axis), turn)
    assert_close(moved, harmonics.zh_to_sh(z, turn @ axis), ulps=TIGHT)


@pytest.mark.parametrize("order", [4, 5])
def test_rotation_batches_and_jit(order, rng):
    v = jnp.asarray(rng.normal(size=(2, 1, order**2)), jnp.float32)
    turns = jnp.asarray(Rotation.random(3, random_state=1).as_matrix()[None], jnp.float32)
    got = sh_rotate(v, turns)
    assert got.shape == (2, 3, order**2)
    one = jax.jit(jax.vmap(jax.vmap(harmonics.sh_rotate, (None, 0)), (0, None)))(v[:, 0], turns[0])
    assert_close(one, got, ulps=16, dtype=np.float32)


@pytest.mark.parametrize("order", [3, 5])
def test_rotation_has_gradients(order, rng, x64):
    """By finite differences on either side of the order where the method changes."""
    v, r = rng.normal(size=order**2), Rotation.random(random_state=3).as_matrix()
    check_grads(sh_rotate, (v, r), order=1, modes=["rev"])


def test_jit_is_eager(rng):
    v, r = jnp.asarray(rng.normal(size=9), jnp.float32), jnp.eye(3)[:, jnp.array([1, 2, 0])]
    for function in (harmonics.sh_rotate, lambda v, r: harmonics.sh_basis(r, order=3) @ v):
        assert_close(jax.jit(function)(v, r), function(v, r), ulps=16, dtype=np.float32)
    w = v[:4]
    assert_close(sh_product(v, w), harmonics.sh_product(v, w), ulps=16, dtype=np.float32)


def test_rotation_axes_are_well_conditioned():
    """The digits lost in float32: 12 at order 10 means one of seven."""
    for order, limit in ((2, 2.0), (4, 4.0), (6, 6.0), (10, 13.0)):
        axes, analysis = sh_module.rotation_table(order)
        y = oracles.real_harmonics(axes, order)
        blocks = [y[:, l * l : (l + 1) ** 2] for l in range(order)]
        assert max(np.linalg.cond(block) for block in blocks) < limit
        for l, block in enumerate(blocks):
            assert_close(block.T @ analysis[:, l * l : (l + 1) ** 2], np.eye(2 * l + 1), ulps=TIGHT)


# --- Product and convolution


@pytest.mark.parametrize(("order", "num_nonzeros", "num_unique"), [(3, 83, 25), (4, 353, 77)])
def test_product_of_unit_vectors_is_the_triple_product_tensor(order, num_nonzeros, num_unique, x64):
    unit = np.eye(order**2)
    tensor = np.asarray(sh_product(unit[:, None], unit[None]))
    assert_close(tensor, oracles.triple_products(order), ulps=TIGHT)
    nonzero = np.argwhere(np.abs(tensor) > 1e-10)
    assert len(nonzero) == num_nonzeros
    assert len(np.unique(np.sort(nonzero, axis=1), axis=0)) == num_unique


@pytest.mark.parametrize(("order_a", "order_b"), [(1, 1), (1, 4), (3, 4), (4, 3), (6, 5)])
def test_whole_product_multiplies_values(order_a, order_b, directions, rng, dtype):
    a, b = rng.normal(size=order_a**2), rng.normal(size=(2, order_b**2))
    order = order_a + order_b - 1
    whole = sh_product(jnp.asarray(a[None], dtype), jnp.asarray(b, dtype), order=order)
    assert whole.dtype == dtype
    values = [v @ oracles.real_harmonics(directions, o).T for v, o in ((a, order_a), (b, order_b))]
    got = np.asarray(whole, np.float64) @ oracles.real_harmonics(directions, order).T
    assert_close(got, values[0] * values[1], ulps=ulps(dtype), dtype=dtype)
    # The truncated products are its head; the default is the order of the first.
    head = sh_product(jnp.asarray(a[None], dtype), jnp.asarray(b, dtype))
    assert_close(head, whole[:, : order_a**2], ulps=ulps(dtype), dtype=dtype)


def test_band_0_of_a_product_is_the_inner_product(rng, x64):
    a, b = rng.normal(size=(2, 16))
    assert float(sh_product(a, b, order=1)[0]) == pytest.approx(a @ b / np.sqrt(4 * np.pi), rel=1e-13)
    assert_close(sh_product(a, b), sh_product(b, a), ulps=TIGHT)


def test_convolution_of_a_point_is_the_kernel(rng, x64):
    """δ_d has the coefficients y(d); smeared out it is the kernel about d."""
    kernel, d = rng.normal(size=5), np.array([0.48, -0.6, 0.64])
    got = harmonics.sh_convolve_zonal(sh_basis(d, order=5), kernel)
    assert_close(got, harmonics.zh_to_sh(kernel, d), ulps=TIGHT)


def test_convolution_with_the_cosine_is_irradiance(rng, x64):
    """Under sky radiance L a surface with normal n receives ∫ L max(0, n·s) ds, here by brute force."""
    light = rng.normal(size=16)
    irradiance = harmonics.sh_convolve_zonal(light, harmonics.clamped_cosine_zh(order=4))
    nodes, weights = oracles.sphere_rule(400)
    radiance = oracles.real_harmonics(nodes, 4) @ light
    for n in np.eye(3):
        # The kink of the cosine leaves 1e-5 of quadrature error at 201 x 401 nodes.
        expected = weights @ (radiance * np.maximum(nodes @ n, 0.0))
        assert float(harmonics.sh_evaluate(irradiance, n)) == pytest.approx(expected, abs=1e-4)


# --- Layouts of other libraries


@pytest.mark.parametrize("layout", sh_module.LAYOUTS)
@pytest.mark.parametrize("order", [1, 5])
def test_layouts_round_trip(layout, order, rng, dtype):
    v = jnp.asarray(rng.normal(size=(2, order**2)), dtype)
    theirs = sh_to_layout(v, layout)
    assert theirs.dtype == (np.result_type(dtype, np.complex64) if layout == "scipy" else dtype)
    assert_close(sh_from_layout(theirs, layout), v, ulps=ROUNDING, dtype=dtype)


def test_scipy_layout_is_the_same_function(directions, rng, x64):
    v = rng.normal(size=36)
    c = np.asarray(sh_to_layout(v, "scipy"))
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    value = sum(c[l * (l + 1) + m] * special.sph_harm_y(l, m, theta, phi) for l in range(6) for m in range(-l, l + 1))
    # arccos next to the poles loses half the digits of the polar angle.
    np.testing.assert_allclose(value, oracles.real_harmonics(directions, 6) @ v, atol=1e-6)


def test_e3nn_layout_is_the_same_function(directions, rng, x64):
    v = rng.normal(size=36)
    # Library code, not written for strict promotion.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs = e3nn_jax.spherical_harmonics(
            e3nn_jax.s2_irreps(5), jnp.asarray(directions), normalize=False, normalization="integral"
        ).array
    value = np.asarray(theirs) @ np.asarray(sh_to_layout(v, "e3nn"))
    assert_close(value, oracles.real_harmonics(directions, 6) @ v, ulps=TIGHT)


def test_positive_layout_drops_the_sign(rng, x64):
    v = rng.normal(size=16)
    flipped = np.flatnonzero(np.asarray(sh_to_layout(v, "positive")) == -v)
    assert flipped.tolist() == [1, 3, 5, 7, 9, 11, 13, 15]


def test_gaussian_splatting_layout_is_ours(rng):
    """The constants of the 3D Gaussian Splatting shader are SH_C1 = 0.4886 with signs -y, +z, -x."""
    v = jnp.asarray(rng.normal(size=16), jnp.float32)
    assert (sh_to_layout(v, "gaussian_splatting") == v).all()
    d = np.array([0.2, 0.3, 0.9])
    degree_1 = 0.4886025119029199 * np.array([-d[1], d[2], -d[0]])
    assert_close(sh_basis(jnp.asarray(d), order=2)[1:], degree_1, ulps=8, dtype=np.float32)
