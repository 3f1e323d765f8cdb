"""The linear solve, the metric and the refinement of a block; the choice of the ridge; principal components."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.config import FitSettings
from fitting.features import fit_basis
from fitting.fit import fit_block
from fitting.motion import MIXED, SEGMENT, TRAIN
from fitting.ridge import RIDGES, choose_ridge, held_out_folds, touched_by
from fitting.solve import (
    PoseRows,
    apply_linear,
    lobe_metric,
    lobe_targets,
    mean_residual,
    refine_block,
    solve_linear,
    synthesize,
)
from jaxrender.vecmath import normalize

NUM_FRAMES, NUM_COMPONENTS, NUM_POINTS = 40, 5, 3


@pytest.fixture
def rows(rng):
    """Components made principal under the frames' weights, so that AᵀWA is diagonal."""
    weights = rng.uniform(0.2, 1.0, NUM_FRAMES)
    raw = rng.normal(size=(NUM_FRAMES, NUM_COMPONENTS)) * [3.0, 2.0, 1.0, 0.5, 0.1]
    raw -= weights @ raw / weights.sum()
    values, vectors = np.linalg.eigh((raw * weights[:, None]).T @ raw)
    parts = raw @ vectors, weights, values, 0.05 * values.mean()
    return PoseRows(*(jnp.asarray(part, jnp.float32) for part in parts))


@pytest.fixture
def axes(rng):
    return normalize(jnp.asarray(rng.normal(size=(NUM_POINTS, 2, 3)) + [0, 0, 2], jnp.float32))


def test_the_solve_is_weighted_ridge_regression(rng, rows):
    targets = rng.normal(size=(NUM_FRAMES, 4, 2)).astype(np.float32)
    got = solve_linear(rows, jnp.asarray(targets))
    a, w = np.asarray(rows.components, np.float64), np.asarray(rows.weights, np.float64)
    design = np.concatenate([np.ones((NUM_FRAMES, 1)), a], axis=1)
    # The bias is not penalised.
    penalty = np.diag([0.0] + [float(rows.ridge)] * NUM_COMPONENTS)
    flat = targets.reshape(NUM_FRAMES, -1).astype(np.float64)
    expected = np.linalg.solve((design * w[:, None]).T @ design + penalty, (design * w[:, None]).T @ flat)
    np.testing.assert_allclose(np.asarray(got).reshape(NUM_COMPONENTS + 1, -1), expected, atol=2e-5)
    predicted = apply_linear(rows.components, got)
    np.testing.assert_allclose(np.asarray(predicted).reshape(NUM_FRAMES, -1), design @ expected, atol=1e-4)


def test_the_metric_is_the_mean_of_squared_derivatives(rng, axes):
    numbers = jnp.asarray(0.3 * rng.normal(size=(4, NUM_POINTS, 12)), jnp.float32)
    frame_weights = jnp.asarray([1.0, 2.0, 0.5, 1.0], jnp.float32)
    got = np.asarray(lobe_metric(numbers, axes, frame_weights), np.float64)
    expected = np.zeros_like(got)
    for f, p in np.ndindex(4, NUM_POINTS):
        own = lambda x, p=p: synthesize(x[None, None], axes[p : p + 1])[0, 0]  # noqa: E731
        jacobian = np.asarray(jax.jacfwd(own)(numbers[f, p]), np.float64)
        expected[p] += float(frame_weights[f]) / 4.5 * jacobian.T @ jacobian
    for p in range(NUM_POINTS):
        expected[p] += 1e-3 * np.trace(expected[p]) / 12 * np.eye(12)
    np.testing.assert_allclose(got, expected, atol=1e-5)


def objective(weights, rows, sh, axes, metric, offset):
    """What the refinement minimises, per point, in float64."""
    predicted = np.asarray(synthesize(apply_linear(rows.components, weights), axes), np.float64)
    residual, w = predicted - np.asarray(sh), np.asarray(rows.weights, np.float64)
    if offset:
        residual -= np.einsum("f,fpk->pk", w / w.sum(), residual)[None]
    slopes = np.asarray(weights, np.float64)[1:]
    penalty = float(rows.ridge) * np.einsum("mpd,pde,mpe->p", slopes, np.asarray(metric, np.float64), slopes)
    return np.einsum("f,fpk->p", w, residual**2) + penalty


@pytest.mark.parametrize("offset", [False, True])
def test_refinement_goes_down_and_says_how_far(rng, rows, axes, offset):
    truth = jnp.asarray(0.2 * rng.normal(size=(NUM_COMPONENTS + 1, NUM_POINTS, 12)), jnp.float32)
    sh = synthesize(apply_linear(rows.components, truth), axes) + jnp.asarray(
        0.02 * rng.normal(size=(NUM_FRAMES, NUM_POINTS, 16)), jnp.float32
    )
    start = solve_linear(rows, lobe_targets(sh, axes))
    metric = lobe_metric(apply_linear(rows.components, start), axes, rows.weights)
    inverse = jnp.asarray(np.linalg.inv(np.asarray(metric, np.float64)), jnp.float32)
    before = objective(start, rows, sh, axes, metric, offset)
    weights, value = refine_block(start, rows, sh, axes, metric, inverse, num_steps=40, offset=offset)
    after = objective(weights, rows, sh, axes, metric, offset)
    np.testing.assert_allclose(value, after, rtol=1e-3)
    assert (after < 0.6 * before).all()
    # No direction leads further down by much: it is a minimum.
    for _ in range(4):
        towards = jnp.asarray(1e-3 * rng.normal(size=weights.shape), jnp.float32)
        assert (objective(weights + towards, rows, sh, axes, metric, offset) > 0.98 * after).all()


def test_the_offset_is_what_is_left_on_average(rng, rows):
    sh, predicted = (jnp.asarray(rng.normal(size=(NUM_FRAMES, NUM_POINTS, 16)), jnp.float32) for _ in range(2))
    left = mean_residual(sh, predicted, rows.weights)
    rest = np.einsum("f,fpk->pk", np.asarray(rows.weights), np.asarray(sh - predicted - left[None]))
    np.testing.assert_allclose(rest, 0.0, atol=1e-4)


def test_a_block_of_what_lobes_can_do_is_fitted(rng, rows, axes):
    """Lobes that move with the pose, and a constant: three starts and two rounds find them."""
    truth = 0.05 * rng.normal(size=(NUM_COMPONENTS + 1, NUM_POINTS, 12))
    truth[0, :, 4:] += 1.0
    sh = synthesize(apply_linear(rows.components, jnp.asarray(truth, jnp.float32)), axes)
    sh = np.asarray(sh) + 0.1 * rng.normal(size=(1, NUM_POINTS, 16)).astype(np.float32)
    weak = dataclasses.replace(rows, ridge=jnp.float32(1e-4))
    weights, found, offset = fit_block(weak, sh, FitSettings(refine_steps=60))
    predicted = np.asarray(synthesize(apply_linear(rows.components, jnp.asarray(weights)), jnp.asarray(found))) + offset
    assert np.sqrt(((predicted - sh) ** 2).sum() / (sh**2).sum()) < 0.05


def test_principal_components_are_those_of_the_weighted_rows(rng, data):
    weights = rng.uniform(0.1, 1.0, len(data.part)) * (data.part == TRAIN)
    basis, moments = fit_basis(data.basis, data.raw, weights, 6)
    for g in range(data.raw.shape[1]):
        used = weights > 0
        rows, w = data.raw[used, g].astype(np.float64), weights[used]
        centred = rows - w @ rows / w.sum()
        values = np.linalg.eigvalsh((centred * w[:, None]).T @ centred)[::-1]
        rank = int((values > 1e-12 * values[0]).sum())
        np.testing.assert_allclose(moments[g][: min(6, rank)], values[: min(6, rank)], rtol=1e-5)
        axes = np.asarray(basis.basis)[g].astype(np.float64)
        gram = axes.T @ axes
        np.testing.assert_allclose(gram, np.diag((moments[g] > 0).astype(float)), atol=1e-5)
        scores = centred @ axes
        np.testing.assert_allclose((scores * w[:, None]).T @ scores, np.diag(moments[g]), atol=1e-4 * values[0])


def test_folds_leave_out_ends_of_clips_and_what_gives_them_away(data):
    folds = held_out_folds(data)
    assert len(folds) == 1  # two clips: none can be left out whole
    (tail,) = folds
    train = np.flatnonzero(data.part == TRAIN)
    clips = [train[data.clip[train] == c] for c in (0, 1)]
    last = np.concatenate([frames[int(np.ceil(0.8 * len(frames))) :] for frames in clips])
    assert set(np.flatnonzero(tail)) == set(last)
    source = np.repeat(np.arange(len(data.part))[:, None], 3, axis=1)
    mixed = np.flatnonzero(data.part == MIXED)
    source[mixed] = train[0]
    source[mixed[1], 2] = train[-1]
    hidden = touched_by(dataclasses.replace(data, source=source), tail)
    assert set(np.flatnonzero(hidden)) == set(np.flatnonzero(tail)) | {mixed[1]}


def test_the_ridge_grows_with_noise(data):
    fit = FitSettings(num_components=8)
    clean = choose_ridge(data, fit)
    rng = np.random.default_rng(4)
    rough = data.raw + rng.normal(size=data.raw.shape).astype(np.float32) * data.raw.std()
    noisy = choose_ridge(dataclasses.replace(data, raw=rough), fit)
    assert clean in RIDGES
    assert noisy > clean
    assert (data.part == SEGMENT).any()  # held out, and not looked at by the choice
    spoiled = data.bits.copy()
    spoiled[data.part == SEGMENT] = 0
    assert choose_ridge(dataclasses.replace(data, bits=spoiled), fit) == clean
