"""The thin sheet: the tabulated back lobe, and the sum of front and back."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.test_util import check_grads

from jaxrender import harmonics
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import TIGHT

membrane_transfer = jax.jit(harmonics.membrane_transfer, static_argnames="order")


def test_back_lobe_is_the_printed_table(x64):
    """(-1)^l (A_l/π) √((2l+1)/4π) in the zonal places, A_l/π = 1, 2/3, 1/4, 0."""
    expected = np.zeros(16)
    expected[[0, 2, 6, 12]] = np.array([1, -2 / 3, 1 / 4, 0]) * np.sqrt(np.array([1, 3, 5, 7]) / (4 * np.pi))
    assert_close(harmonics.back_lobe(), expected, ulps=TIGHT)


def test_back_lobe_is_the_cosine_of_the_lower_side(x64):
    centres = np.arange(7) * (np.arange(7) + 1)
    expected = oracles.zonal_coefficients(lambda x: -x / np.pi, 7, -1.0, 0.0)
    assert_close(harmonics.back_lobe(order=7)[centres], expected, ulps=TIGHT)


def test_unshadowed_sheet_is_the_closed_form(x64):
    """t_lm = y_lm(n) A_l/π (1 + (-1)^l τ) for visibility 1 all around, here with n = z."""
    everywhere, tau = np.sqrt(4 * np.pi) * np.eye(16)[0], np.array([0.0, 0.3, 1.0])
    y = oracles.real_harmonics(np.array([0.0, 0.0, 1.0]), 4)
    factors = np.repeat([1, 2 / 3, 1 / 4, 0], [1, 3, 5, 7])
    sign = np.repeat([1, -1, 1, -1], [1, 3, 5, 7])
    expected = y * factors * (1 + sign * tau[:, None])
    assert_close(membrane_transfer(everywhere, tau), expected, ulps=TIGHT)


def test_front_is_shadowed_and_back_is_not(rng, x64):
    v, tau = rng.normal(size=(5, 16)), rng.uniform(size=(5, 3))
    got = np.asarray(membrane_transfer(v, tau))
    front = v @ oracles.phong_matrix(1.0, 4).T / np.pi
    assert_close(got, front[:, None] + tau[..., None] * np.asarray(harmonics.back_lobe()), ulps=TIGHT)
    # In full shadow only what comes through is left.
    dark = membrane_transfer(np.zeros(16), np.array([0.25]))
    assert_close(dark[0], 0.25 * np.asarray(harmonics.back_lobe()), ulps=TIGHT)


def test_sheet_under_a_uniform_sky_receives_1_plus_tau(x64):
    everywhere = np.sqrt(4 * np.pi) * np.eye(36)[0]
    transfer = membrane_transfer(everywhere, np.array([0.0, 0.4]), order=6)
    assert_close(transfer @ everywhere, np.array([1.0, 1.4]), ulps=TIGHT)


def test_shapes_batches_and_gradients(rng):
    v = jnp.asarray(rng.normal(size=(4, 16)), jnp.float32)
    tau = jnp.asarray(rng.uniform(size=(1, 3)), jnp.float32)
    got = membrane_transfer(v, tau)
    assert got.shape == (4, 3, 16)
    assert got.dtype == jnp.float32
    assert_close(harmonics.membrane_transfer(v, tau), got, ulps=8, dtype=np.float32)
    mapped = jax.vmap(harmonics.membrane_transfer, in_axes=(0, None))(v, tau[0])
    assert_close(mapped, got, ulps=8, dtype=np.float32)
    assert_close(membrane_transfer(v[2], tau[0]), got[2], ulps=8, dtype=np.float32)
    with jax.enable_x64(True):
        check_grads(membrane_transfer, (rng.normal(size=16), rng.uniform(size=3)), order=1, modes=["rev"])
