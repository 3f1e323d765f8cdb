"""Ridge regression with a bias against NumPy's least squares, closed forms, and float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxrender import harmonics
from tests.support.asserts import assert_close
from tests.support.tolerances import LONG_SUM, TIGHT

fit_linear = jax.jit(harmonics.fit_linear)


def closed_form(features, targets, ridge):
    """Weights and bias through the singular values, in float64."""
    scale = features.std(0)
    a, b = (features - features.mean(0)) / scale, targets - targets.mean(0)
    u, s, vt = np.linalg.svd(a, full_matrices=False)
    kept = s > 1e-10 * s.max(initial=1e-300)
    gain = np.where(kept, s / np.where(kept, s * s + ridge * (s * s).sum() / a.shape[1], 1), 0)
    weights = vt.T @ (gain[:, None] * (u.T @ b)) / scale[:, None]
    return weights, targets.mean(0) - features.mean(0) @ weights


def ulps(dtype):
    # Condition numbers of the random features here are below 30.
    return 16 * TIGHT if dtype == np.float64 else LONG_SUM


@pytest.mark.parametrize("shape", [(40, 6), (7, 12), (8, 8)])
@pytest.mark.parametrize("ridge", [0.0, 1e-3, 1.0, 100.0])
def test_tall_wide_and_square(shape, ridge, rng, dtype):
    features, targets = rng.normal(size=shape) + 2.0, rng.normal(size=(shape[0], 5)) - 1.0
    fit = fit_linear(jnp.asarray(features, dtype), jnp.asarray(targets, dtype), ridge=ridge)
    weights, bias = closed_form(features, targets, ridge)
    assert fit.weights.dtype == fit.bias.dtype == fit.residual.dtype == dtype
    assert_close(fit.weights, weights, ulps=ulps(dtype), dtype=dtype)
    assert_close(fit.bias, bias, ulps=ulps(dtype), dtype=dtype)
    # Centring takes one from the rank of a wide matrix.
    assert int(fit.rank) == min(shape[0] - 1, shape[1])
    left, spread = features @ weights + bias - targets, targets - targets.mean(0)
    expected = np.linalg.norm(left) / np.linalg.norm(spread)
    assert float(fit.residual) == pytest.approx(expected, abs=1e-10 if dtype == np.float64 else 1e-5)


def test_ridge_0_is_least_squares_with_a_column_of_ones(rng, x64):
    features, targets = rng.normal(size=(30, 4)) + 3.0, rng.normal(size=(30, 2))
    whole, *_ = np.linalg.lstsq(np.column_stack([features, np.ones(30)]), targets, rcond=None)
    fit = fit_linear(features, targets, ridge=0.0)
    assert_close(np.vstack([fit.weights, fit.bias]), whole, ulps=16 * TIGHT)


@pytest.mark.parametrize("shape", [(30, 6), (10, 40)])
def test_lost_rank_gives_the_shortest_solution(shape, rng, dtype):
    """Noise of rounding in the empty directions must not be divided by: it would give weights of 1e5."""
    features = rng.normal(size=(shape[0], 2)) @ rng.normal(size=(2, shape[1])) + 1.0
    targets = rng.normal(size=(shape[0], 3))
    fit = fit_linear(jnp.asarray(features, dtype), jnp.asarray(targets, dtype), ridge=0.0)
    assert int(fit.rank) == 2
    assert_close(fit.weights, closed_form(features, targets, 0.0)[0], ulps=ulps(dtype), dtype=dtype)


def test_equal_columns_share_their_weight(rng, dtype):
    column, targets = rng.normal(size=(20, 1)), rng.normal(size=(20, 2))
    for ridge in (0.0, 0.1):
        features = jnp.asarray(np.repeat(column, 3, axis=1), dtype)
        fit = fit_linear(features, jnp.asarray(targets, dtype), ridge=ridge)
        # Three weights w act like one of 3w, which costs 3w² = (3w)² / 3.
        expected = closed_form(column, targets, ridge / 3.0)[0] / 3.0
        assert_close(fit.weights, np.repeat(expected, 3, axis=0), ulps=LONG_SUM, dtype=dtype)


def test_constant_features_predict_the_mean(rng, dtype):
    targets = rng.normal(size=(9, 4))
    for shape in ((9, 3), (9, 20)):
        for ridge in (0.0, 1e-2):
            fit = fit_linear(jnp.full(shape, 7.0, dtype), jnp.asarray(targets, dtype), ridge=ridge)
            assert int(fit.rank) == 0
            assert not np.any(fit.weights)
            assert_close(fit.bias, targets.mean(0), ulps=16, dtype=dtype)
            assert float(fit.residual) == pytest.approx(1.0, abs=1e-6)


def test_one_frame_and_constant_targets(rng, dtype):
    one = fit_linear(jnp.asarray(rng.normal(size=(1, 3)), dtype), jnp.ones((1, 2), dtype), ridge=0.1)
    assert not np.any(one.weights)
    assert one.bias.tolist() == [1.0, 1.0]
    assert float(one.residual) == 0.0
    flat = fit_linear(jnp.asarray(rng.normal(size=(6, 3)), dtype), jnp.full((6, 2), 2.0, dtype), ridge=0.1)
    assert not np.any(flat.weights)
    assert float(flat.residual) == 0.0


def test_bias_is_not_penalised(rng, x64):
    features, targets = rng.normal(size=(20, 3)), rng.normal(size=(20, 2))
    fit = fit_linear(features, targets, ridge=0.5)
    shifted = fit_linear(features + 10.0, targets + 100.0, ridge=0.5)
    assert_close(shifted.weights, fit.weights, ulps=64 * TIGHT)
    predicted = harmonics.predict_linear(shifted, features + 10.0)
    assert_close(predicted, harmonics.predict_linear(fit, features) + 100.0, ulps=TIGHT)
    stiff = fit_linear(features, targets + 100.0, ridge=1e12)
    assert_close(stiff.bias, (targets + 100.0).mean(0), ulps=TIGHT)


@pytest.mark.parametrize("shape", [(40, 6), (7, 12)])
@pytest.mark.parametrize("ridge", [1e-3, 0.5])
def test_the_unit_of_a_feature_does_not_matter(shape, ridge, rng, dtype):
    """Metres or millimetres in one column: its weight changes by 1e3, and nothing else does."""
    features, targets = rng.normal(size=shape) + 2.0, jnp.asarray(rng.normal(size=(shape[0], 3)), dtype)
    unit = np.ones(shape[1])
    unit[1] = 1e3
    fits, predictions = [], []
    for factor in (np.ones(shape[1]), unit):
        scaled = jnp.asarray(features * factor, dtype)
        fits.append(fit_linear(scaled, targets, ridge=ridge))
        predictions.append(harmonics.predict_linear(fits[-1], scaled))
    assert_close(np.asarray(fits[1].weights) * unit[:, None], fits[0].weights, ulps=ulps(dtype), dtype=dtype)
    assert_close(predictions[1], predictions[0], ulps=ulps(dtype), dtype=dtype)
    # The residual is a difference of numbers as large as the targets, and is given as a share of them.
    assert_close(1.0 + fits[1].residual, 1.0 + fits[0].residual, ulps=16, dtype=dtype)
    assert int(fits[1].rank) == int(fits[0].rank) == min(shape[0] - 1, shape[1])


def test_a_constant_column_among_others_gets_no_weight(rng, dtype):
    """Its mean is a rounded one, and what is left after centring must not be blown up to standard deviation 1."""
    features, targets = rng.normal(size=(30, 4)), rng.normal(size=(30, 2))
    features[:, 2] = 1e6 / 3.0
    fit = fit_linear(jnp.asarray(features, dtype), jnp.asarray(targets, dtype), ridge=0.0)
    assert int(fit.rank) == 3
    assert not np.any(fit.weights[2])
    others, bias = closed_form(features[:, [0, 1, 3]], targets, 0.0)
    assert_close(fit.weights[np.array([0, 1, 3])], others, ulps=ulps(dtype), dtype=dtype)
    assert_close(fit.bias, bias, ulps=ulps(dtype), dtype=dtype)


def test_a_small_change_of_a_large_number_counts(rng, x64):
    """A column of 1e6 that moves by 1e-4 is a feature like any other."""
    features, targets = rng.normal(size=(30, 3)), rng.normal(size=(30, 2))
    far = features * np.array([1.0, 1e-4, 1.0]) + np.array([0.0, 1e6, 0.0])
    fit, moved = fit_linear(features, targets, ridge=0.1), fit_linear(far, targets, ridge=0.1)
    # 1e6 carries eps · 1e6 = 2e-10, which is 2e-6 of the change.
    assert_close(1e-4 * np.asarray(moved.weights)[1], fit.weights[1], ulps=1e11)


def test_ridge_is_relative_to_the_size_of_the_features(rng, x64):
    features, targets = rng.normal(size=(20, 3)), rng.normal(size=(20, 2))
    small, large = (fit_linear(scale * features, targets, ridge=0.3) for scale in (1e-3, 1e3))
    assert_close(1e-3 * small.weights, 1e3 * large.weights, ulps=TIGHT)


def correlated_poses(rng, *, num_frames=120, num_angles=60, num_targets=400):
    """Angles of one motion: 6 latent modes and a little noise; condition number of some 1e4."""
    latent = rng.normal(size=(num_frames, 6))
    features = latent @ rng.normal(size=(6, num_angles)) + 3e-3 * rng.normal(size=(num_frames, num_angles))
    targets = latent @ rng.normal(size=(6, num_targets)) + 0.01 * rng.normal(size=(num_frames, num_targets))
    return features, targets


def test_float32_is_as_good_as_float64_on_correlated_angles(rng):
    """Normal equations in float32 miss the optimum here, and double the size of the weights."""
    features, targets = correlated_poses(rng)
    centred = features - features.mean(0)
    assert 3e3 < np.linalg.cond(centred) < 3e4
    single = fit_linear(jnp.asarray(features, jnp.float32), jnp.asarray(targets, jnp.float32), ridge=0.0)
    with jax.enable_x64(True):
        double = fit_linear(features, targets, ridge=0.0)

    def rms(fit):
        left = features @ np.asarray(fit.weights, np.float64) + np.asarray(fit.bias, np.float64) - targets
        return np.sqrt(np.mean(left**2))

    # 120 frames, 61 unknowns: noise of 0.01 leaves 0.007.
    assert rms(double) == pytest.approx(0.01 * np.sqrt(59 / 120), rel=0.02)
    assert rms(single) == pytest.approx(rms(double), rel=1e-3)
    assert np.linalg.norm(single.weights) == pytest.approx(np.linalg.norm(double.weights), rel=1e-2)
    assert int(single.rank) == int(double.rank) == 60
    # What a float32 solution through AᵀA does to the same data.
    a, b = centred.astype(np.float32), (targets - targets.mean(0)).astype(np.float32)
    normal = np.linalg.solve(a.T @ a + 1e-7 * np.trace(a.T @ a) / 60 * np.eye(60, dtype=np.float32), a.T @ b)
    assert np.sqrt(np.mean((a @ normal - b) ** 2)) > 1.05 * rms(single)


def test_ridge_helps_poses_beside_the_training_motion(rng, x64):
    features, targets = correlated_poses(rng)
    train, held = slice(0, 80), slice(80, 120)
    off = features[held] + 0.01 * rng.normal(size=(40, 60))
    errors = []
    for ridge in (0.0, 1e-3, 100.0):
        fit = fit_linear(features[train], targets[train], ridge=jnp.asarray(ridge))
        errors.append(np.sqrt(np.mean((np.asarray(harmonics.predict_linear(fit, off)) - targets[held]) ** 2)))
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 0.5 * errors[2]


@pytest.mark.parametrize("shape", [(9, 4), (5, 8)])
def test_gradients_match_finite_differences(shape, rng, x64):
    def outputs(features, targets, ridge):
        fit = fit_linear(features, targets, ridge=ridge)
        return fit.weights, fit.bias, fit.residual

    arguments = rng.normal(size=shape), rng.normal(size=(shape[0], 2)), np.array(0.2)
    check_grads(outputs, arguments, order=1, modes=["rev"], atol=1e-6, rtol=1e-6)
    # Where rank is lost: filling a lost direction is a first-order change too.
    lost = rng.normal(size=(shape[0], 2)) @ rng.normal(size=(2, shape[1]))
    check_grads(outputs, (lost, *arguments[1:]), order=1, modes=["rev"], atol=1e-6, rtol=1e-6)


def test_gradient_of_a_perfect_fit_is_finite(rng, x64):
    features = rng.normal(size=(8, 2))

    def error(features):
        return harmonics.fit_linear(features, 0.0 * features, ridge=0.1).residual

    assert np.isfinite(jax.grad(error)(features)).all()


def test_jit_vmap_and_traced_ridge(rng):
    a, b = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in ((12, 4), (12, 3)))
    ridges = jnp.asarray([0.01, 1.0], jnp.float32)
    many = jax.jit(jax.vmap(lambda r: harmonics.fit_linear(a, b, ridge=r)))(ridges)
    for i in range(2):
        one = harmonics.fit_linear(a, b, ridge=float(ridges[i]))
        got = jax.tree.map(lambda x, i=i: x[i], many)
        assert_close((got.weights, got.bias), (one.weights, one.bias), ulps=LONG_SUM, dtype=np.float32)
        assert int(got.rank) == int(one.rank) == 4


def test_prediction_takes_leading_axes(rng, x64):
    fit = fit_linear(rng.normal(size=(9, 4)), rng.normal(size=(9, 3)), ridge=0.1)
    new = rng.normal(size=(2, 5, 4))
    predicted = harmonics.predict_linear(fit, jnp.asarray(new))
    assert_close(predicted, new @ np.asarray(fit.weights) + np.asarray(fit.bias), ulps=TIGHT)
    assert harmonics.predict_linear(fit, jnp.asarray(new[0, 0])).shape == (3,)


@pytest.mark.parametrize(
    ("features", "targets", "message"),
    [
        ((4, 2), (5, 2), "targets: expected 4 frames as in features, got 5"),
        ((0, 2), (0, 2), "frames: expected a value >= 1, got 0"),
        ((4, 0), (4, 2), "columns of features: expected a value >= 1, got 0"),
    ],
)
def test_bad_arguments_are_named(features, targets, message):
    with pytest.raises(ValueError, match=message):
        harmonics.fit_linear(jnp.zeros(features), jnp.zeros(targets), ridge=0.0)
