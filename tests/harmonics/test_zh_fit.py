"""Lobe fits: charts, the linear part against NumPy, and what the searches reach on known and random functions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxrender import harmonics
from jaxrender.harmonics import zh_fit
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import LONG_SUM, ROUNDING

ORDER = 4

axis_from_chart = jax.jit(zh_fit.axis_from_chart)
chart_from_axis = jax.jit(zh_fit.chart_from_axis)
solve = jax.jit(functools.partial(harmonics.solve_lobe_coefficients, order=ORDER))

# Compiling is most of the time here, and with less of it the searches end at the same place.
quickly = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def lobes(coefficients, axes):
    return np.asarray(harmonics.lobes_to_sh(jnp.asarray(coefficients), jnp.asarray(axes)))


# --- Charts


def test_chart_round_trip(rng, dtype):
    frames = Rotation.random(40, random_state=1).as_matrix()
    chart = rng.normal(size=(40, 2)) * np.geomspace(1e-6, 3.0, 40)[:, None]
    axes = axis_from_chart(jnp.asarray(chart, dtype), jnp.asarray(frames, dtype))
    assert_close(np.linalg.norm(axes, axis=-1), np.ones(40), ulps=8, dtype=dtype)
    # |chart| = 2 tan(angle/2); rounding of the axis grows by 1 + |chart|²/4, here 10 at most.
    assert_close(chart_from_axis(axes, jnp.asarray(frames, dtype)), chart, ulps=ROUNDING, dtype=dtype)


def test_chart_coordinates_are_angles_at_the_reference(x64):
    for angle in (0.0, 1e-8, 1e-3, 0.5, 3.0):
        axis = axis_from_chart(jnp.asarray([2.0 * np.tan(angle / 2.0), 0.0]), jnp.eye(3))
        assert_close(axis, np.array([np.sin(angle), 0.0, np.cos(angle)]), ulps=8)
    slope = jax.jacfwd(zh_fit.axis_from_chart)(jnp.zeros(2), jnp.eye(3))
    assert_close(slope, np.eye(3)[:, :2], ulps=1)


def test_far_side_of_the_chart_is_large_but_finite():
    far = jnp.asarray([0.0, 0.0, -1.0])
    assert np.isfinite(chart_from_axis(far, jnp.eye(3))).all()
    slopes = jax.jacrev(zh_fit.chart_from_axis)(far, jnp.eye(3))
    assert np.isfinite(slopes).all()


def test_chart_gradients(rng, x64):
    frame = Rotation.random(random_state=2).as_matrix()
    check_grads(axis_from_chart, (rng.normal(size=2), frame), order=1, modes=["rev"])
    check_grads(chart_from_axis, (oracles.unit(rng.normal(size=3)), frame), order=1, modes=["rev"])


def test_reference_frames_are_rotations_about_their_axis(rng, dtype):
    axes = np.concatenate([np.eye(3), -np.eye(3), oracles.unit(rng.normal(size=(20, 3)))])
    frames = np.asarray(zh_fit.reference_frames(jnp.asarray(axes, dtype)), np.float64)
    assert_close(frames[..., 2], axes, ulps=1, dtype=dtype)
    assert_close(frames.swapaxes(1, 2) @ frames, np.broadcast_to(np.eye(3), frames.shape), ulps=16, dtype=dtype)
    assert_close(np.linalg.det(frames), np.ones(26), ulps=16, dtype=dtype)


# --- The linear part


def shortest(v, axes):
    """Least squares band by band through the pseudo-inverse."""
    y = oracles.real_harmonics(axes, ORDER)
    bands = [slice(l * l, (l + 1) ** 2) for l in range(ORDER)]
    designs = [np.sqrt(4 * np.pi / (2 * l + 1)) * y[:, b].T for l, b in enumerate(bands)]
    z = [np.linalg.pinv(design, rcond=1e-9) @ v[b] for design, b in zip(designs, bands, strict=True)]
    return np.stack(z, axis=-1)


def spread_axes(rng, num_lobes):
    """Axes at least 40 degrees from each other and from each other's opposites."""
    while True:
        axes = oracles.unit(rng.normal(size=(num_lobes, 3)))
        if (np.abs(np.triu(axes @ axes.T, 1)) < np.cos(0.7)).all():
            return axes


def test_one_lobe_is_the_closed_form(rng, dtype):
    """z_l = √(4π/(2l+1)) Σ_m y_lm(d) v_lm and residual |v|² - |z|²."""
    v, axis = rng.normal(size=16), oracles.unit(rng.normal(size=3))
    z, residual = solve(jnp.asarray(v, dtype), jnp.asarray(axis[None], dtype))
    y = oracles.real_harmonics(axis, ORDER)
    expected = [np.sqrt(4 * np.pi / (2 * l + 1)) * y[l * l : (l + 1) ** 2] @ v[l * l : (l + 1) ** 2] for l in range(4)]
    # The damping leaves √eps/4 squared, relative to the eigenvalue 1.
    assert_close(z[0], np.array(expected), ulps=16, dtype=dtype)
    assert float(residual) == pytest.approx(v @ v - np.dot(expected, expected), rel=100 * float(jnp.finfo(dtype).eps))


@pytest.mark.parametrize("num_lobes", [1, 2, 3, 4])
def test_least_squares_of_least_length(num_lobes, rng, dtype):
    v, axes = rng.normal(size=16), spread_axes(rng, num_lobes)
    z, residual = solve(jnp.asarray(v, dtype), jnp.asarray(axes, dtype))
    expected = shortest(v, axes)
    # Four lobes are one too many for band 1. There damping δ = √eps/4 leaves eps/δ of rounding, and elsewhere
    # (δ/λ)² with smallest eigenvalues λ around 0.1.
    tolerance = 4e-3 if dtype == np.float32 else 2e-7
    np.testing.assert_allclose(z, expected, atol=tolerance * np.abs(expected).max())
    left = v - lobes(expected, axes)
    assert float(residual) == pytest.approx(left @ left, rel=1e-4 if dtype == np.float32 else 1e-12, abs=1e-5)
    # Band 0 knows the sum only: it is split evenly, and that exactly.
    assert (z[:, 0] == z[0, 0]).all()
    assert float(num_lobes * z[0, 0]) == pytest.approx(v[0], rel=1e-6)


@pytest.mark.parametrize("num_lobes", [1, 2, 3])
def test_known_lobes_are_found_again(num_lobes, rng, dtype):
    axes, z = spread_axes(rng, num_lobes), rng.normal(size=(num_lobes, ORDER))
    z[:, 0] = z[:, 0].mean()
    found, residual = solve(jnp.asarray(lobes(z, axes), dtype), jnp.asarray(axes, dtype))
    np.testing.assert_allclose(found, z, atol=1e-4 if dtype == np.float32 else 1e-9)
    assert float(residual) < (1e-9 if dtype == np.float32 else 1e-18)


slope_of_squares = jax.jit(jax.grad(lambda v, a: jnp.sum(solve(v, a)[0] ** 2), argnums=(0, 1)))


def test_coincident_and_antipodal_lobes_share(rng, dtype):
    """The same axis twice, or an axis and its opposite, get the same lobe each; the third its own."""
    axis, other = spread_axes(rng, 2)
    v = rng.normal(size=16)
    pair = shortest(v, np.stack([axis, other]))
    parity = (-1.0) ** np.arange(ORDER)
    for second, sign in ((axis, np.ones(ORDER)), (-axis, parity)):
        axes = np.stack([axis, second, other])
        z, residual = solve(jnp.asarray(v, dtype), jnp.asarray(axes, dtype))
        # eps/δ of rounding along the direction that the Gram matrix does not see.
        tolerance = 5e-3 if dtype == np.float32 else 1e-6
        np.testing.assert_allclose(z, shortest(v, axes), atol=tolerance)
        np.testing.assert_allclose(z[0] + sign * z[1], np.r_[z[0, 0] + z[1, 0], pair[0, 1:]], atol=tolerance)
        left = v - lobes(pair, np.stack([axis, other]))
        assert float(residual) == pytest.approx(left @ left, rel=1e-4)
        slopes = slope_of_squares(jnp.asarray(v, dtype), jnp.asarray(axes, dtype))
        assert all(np.isfinite(s).all() for s in slopes)


def test_nearly_coincident_lobes_do_not_blow_up(rng):
    """Axes 1e-3 apart could fit a derivative: damping by δ = √eps/4 bounds |z| by 0.9 |v| / √δ, about 100 |v|."""
    axis = oracles.unit(rng.normal(size=3))
    axes, v = np.stack([axis, oracles.unit(axis + 1e-3 * rng.normal(size=3))]), rng.normal(size=(50, 16))
    z, _ = solve(jnp.asarray(v, jnp.float32), jnp.asarray(axes[None], jnp.float32))
    damping = 0.25 * np.sqrt(np.finfo(np.float32).eps)
    assert np.abs(z).max() < np.linalg.norm(v, axis=1).max() / np.sqrt(damping)
    assert max(np.abs(shortest(row, axes)).max() for row in v) > 5.0 * np.abs(z).max()


def test_gradients_of_the_coefficients_match_finite_differences(rng, x64):
    v, axes = rng.normal(size=16), spread_axes(rng, 2)
    check_grads(solve, (v, axes), order=1, modes=["rev"], atol=1e-6, rtol=1e-6)


def test_axes_broadcast_against_vectors(rng):
    v = jnp.asarray(rng.normal(size=(3, 2, 16)), jnp.float32)
    axes = jnp.asarray(np.stack([spread_axes(rng, 2) for _ in range(2)])[None], jnp.float32)
    z, residual = solve(v, axes)
    assert z.shape == (3, 2, 2, ORDER)
    assert residual.shape == (3, 2)
    one = solve(v[1, 1], axes[0, 1])
    assert_close(one, (z[1, 1], residual[1, 1]), ulps=LONG_SUM, dtype=np.float32)
    mapped = jax.jit(jax.vmap(lambda v: zh_fit.solve_lobe_coefficients(v, axes[0], order=ORDER)))(v)
    assert_close(mapped, (z, residual), ulps=LONG_SUM, dtype=np.float32)
    eager = zh_fit.solve_lobe_coefficients(v[0], axes[0], order=ORDER)
    assert_close(eager, (z[0], residual[0]), ulps=LONG_SUM, dtype=np.float32)


# --- Starts


def few_rows(rows):
    return jax.jit(lambda x: zh_fit._few_rows(x, ORDER))(rows)


@pytest.mark.parametrize("rank", [3, 7, 16])
def test_few_vectors_stand_for_many(rank, rng, dtype):
    """For whatever axes, the summed error of the given vectors is that of their replacements."""
    rows = rng.normal(size=(2, 50, rank)) @ rng.normal(size=(rank, 16))
    few = np.asarray(few_rows(jnp.asarray(rows, dtype)), np.float64)
    assert few.shape == (2, 2 * ORDER - 1, 16)
    for l in range(ORDER):
        band = slice(l * l, (l + 1) ** 2)
        moments = [np.einsum("vni,vnj->vij", x[..., band], x[..., band]) for x in (few, rows)]
        # Pivots below 1e-6 of the trace are taken for zero.
        np.testing.assert_allclose(moments[0], moments[1], atol=4e-6 * np.abs(moments[1]).max())
    axes = jnp.asarray(spread_axes(rng, 2), dtype)[None, None]
    sums = [float(jnp.sum(solve(jnp.asarray(x, dtype), axes)[1])) for x in (few, rows)]
    assert sums[0] == pytest.approx(sums[1], rel=1e-4)


def test_few_vectors_are_left_alone(rng):
    rows = jnp.asarray(rng.normal(size=(2, 7, 16)), jnp.float32)
    got = few_rows(rows)
    assert got.shape == rows.shape
    assert got.dtype == rows.dtype
    np.testing.assert_array_equal(got, rows)


def test_greedy_start_is_the_best_candidate(rng, x64):
    v, candidates = rng.normal(size=(5, 3, 16)), zh_fit._start_axes(zh_fit.NUM_CANDIDATES)
    errors = [[sum(float(solve(row, c[None])[1]) for row in rows) for c in candidates] for rows in v[:1]]
    order = np.argsort(errors[0])
    for first in (0, 3):
        got = zh_fit.greedy_axes(v, num_lobes=1, order=ORDER, first=first)
        assert got.shape == (5, 1, 3)
        assert_close(got[0, 0], candidates[order[first]], ulps=1)


def test_greedy_start_finds_lobes_at_candidates(rng, x64):
    """Two lobes along candidates, one much stronger: the stronger first, then the other."""
    candidates = zh_fit._start_axes(zh_fit.NUM_CANDIDATES)
    axes, z = candidates[[3, 40]], np.array([[2.0, 3.0, 2.0, 1.0], [0.3, 0.4, 0.3, 0.2]])
    got = zh_fit.greedy_axes(lobes(z, axes)[None], num_lobes=2, order=ORDER, first=0)
    assert_close(got, axes, ulps=1)


def test_spread_starts_are_several_and_point_up(rng):
    v = jnp.asarray(rng.normal(size=(20, 3, 16)), jnp.float32)
    starts = np.asarray(jax.jit(lambda v: zh_fit.spread_start_axes(v, num_lobes=2, order=ORDER, count=3))(v))
    assert starts.shape == (3, 3, 2, 3)
    assert (starts[..., 2] >= 0).all()
    assert_close(np.linalg.norm(starts, axis=-1), np.ones((3, 3, 2)), ulps=8, dtype=np.float32)
    for point in range(3):
        assert len(np.unique(starts[:, point, 0], axis=0)) == 3


# --- Searches


@functools.cache
def free_fit(num_lobes):
    return quickly(lambda v: harmonics.fit_zh_lobes(v, num_lobes=num_lobes, order=ORDER))


NUM_RANDOM, NUM_KNOWN = 60, 20


@functools.cache
def fitted(num_lobes):
    """60 random visibilities, then 20 sums of known lobes, and their fits; one shape for one compilation."""
    rng = np.random.default_rng(20081)
    axes = np.stack([spread_axes(rng, num_lobes) for _ in range(NUM_KNOWN)])
    axes *= np.where(axes[..., 2:] < 0, -1, 1)
    known = lobes(rng.normal(size=(NUM_KNOWN, num_lobes, ORDER)), axes)
    v = np.concatenate([oracles.visibilities(rng, NUM_RANDOM), known])
    fit = free_fit(num_lobes)(jnp.asarray(v, jnp.float32))
    return v, axes, jax.tree.map(lambda x: np.asarray(x, np.float64), fit)


# Reference: mean relative errors of .31, .09, .001 by another random set; measured here .290, .068, .0013.
@pytest.mark.parametrize(("num_lobes", "limit"), [(1, 0.31), (2, 0.09), (3, 0.005)])
def test_errors_on_random_visibilities(num_lobes, limit):
    v, _, fit = fitted(num_lobes)
    errors = np.sqrt(fit.residual[:NUM_RANDOM]) / np.linalg.norm(v[:NUM_RANDOM], axis=1)
    assert errors.mean() < limit
    # Six or eleven degrees of freedom cannot be enough for all sixteen numbers.
    assert errors.mean() > (0.2 if num_lobes == 1 else 0.03 if num_lobes == 2 else 0.0)


@pytest.mark.parametrize("num_lobes", [1, 2])
def test_known_lobes_are_fitted_exactly(num_lobes):
    v, axes, fit = fitted(num_lobes)
    known = slice(NUM_RANDOM, None)
    errors = np.sqrt(fit.residual[known]) / np.linalg.norm(v[known], axis=1)
    # One lobe has no other minimum near its best start; of two lobes 12 steps may leave some on their way.
    assert (errors < 1e-3).mean() >= (1.0 if num_lobes == 1 else 0.7)
    exact = errors < 1e-4
    cosines = np.abs(np.einsum("vci,vki->vck", fit.axes[known], axes)).max(axis=2)
    assert (cosines[exact] > 1 - 1e-4).all()


@pytest.mark.parametrize("num_lobes", [1, 2])
def test_fit_is_consistent_with_itself(num_lobes):
    v, _, fit = fitted(num_lobes)
    assert_close(np.linalg.norm(fit.axes, axis=-1), np.ones(fit.axes.shape[:-1]), ulps=16, dtype=np.float32)
    assert (fit.axes[..., 2] >= 0).all()
    left = v - lobes(fit.coefficients.astype(np.float32), fit.axes.astype(np.float32))
    np.testing.assert_allclose(np.sum(left**2, axis=1), fit.residual, atol=1e-6 * np.sum(v**2, axis=1).max())
    # The search ends below its first start.
    greedy = zh_fit.greedy_axes(jnp.asarray(v, jnp.float32)[:, None], num_lobes=num_lobes, order=ORDER, first=0)
    started = np.asarray(solve(jnp.asarray(v, jnp.float32), greedy)[1])
    assert (fit.residual <= started + 1e-5 * np.sum(v**2, axis=1)).all()


def test_fits_do_not_feel_their_neighbours(rng):
    """Vectors of a batch go through one loop; each must end as it would alone."""
    v, _, fit = fitted(2)
    shuffle = rng.permutation(len(v))
    again = free_fit(2)(jnp.asarray(v[shuffle], jnp.float32))
    # Compiled loops treat the last rows of a batch by other instructions, so the last bits may differ, and of
    # two starts that end at the same error either may win.
    np.testing.assert_allclose(again.residual, fit.residual[shuffle], atol=1e-5 * np.sum(v**2, axis=1).max())


@functools.cache
def anchored_fit(anchor):
    return quickly(lambda v, a: harmonics.fit_zh_lobes(v, num_lobes=2, order=ORDER, anchor_axes=a, anchor=anchor))


ANCHORS = oracles.unit(np.array([[[0.0, 0.3, 1.0], [0.7, -0.2, 0.6]]])).astype(np.float32)
NUM_FRAMES = 41


def moving_occluder(low=-1.0, high=1.0):
    """A disc that crosses the sky from one angle to another, in closed form: hemisphere minus disc."""
    angle = np.linspace(low, high, NUM_FRAMES)
    d = oracles.unit(np.stack([np.sin(angle), 0.2 * np.ones(NUM_FRAMES), np.cos(angle)], axis=-1))
    sky = harmonics.zh_to_sh(harmonics.hemisphere_zh(order=ORDER), jnp.asarray([0.0, 0.0, 1.0]))
    radius, white = jnp.full(NUM_FRAMES, 0.5), jnp.ones((NUM_FRAMES, 1))
    disc = harmonics.sh_area_light(jnp.asarray(d, jnp.float32), radius, white, order=ORDER)
    return sky[None] - disc[:, 0]


def largest_step(axes):
    """Between neighbouring frames, in degrees."""
    axes = np.asarray(axes, np.float64)
    return np.degrees(np.arccos(np.clip(np.sum(axes[1:] * axes[:-1], axis=-1), -1, 1))).max()


def test_a_converged_search_has_the_gradient_of_its_optimum(rng, x64):
    v, direction, mix = rng.normal(size=16), rng.normal(size=16), rng.normal(size=(2, 3))
    options = {"anchor_axes": jnp.asarray(ANCHORS[0], jnp.float64)}

    @jax.jit
    def along(t):
        fit = harmonics.fit_zh_lobes(v + t * direction, num_lobes=2, order=ORDER, num_steps=60, **options)
        return jnp.sum(mix * fit.axes) + fit.residual

    h = 1e-4
    # The search stops at a step of some 1e-5, which it misses the optimum by the square of, or a little more.
    assert jax.jit(jax.grad(along))(0.0) == pytest.approx(float((along(h) - along(-h)) / (2 * h)), rel=1e-3)


def test_anchored_axes_follow_a_smooth_motion():
    """The occluder moves by 2.9 degrees a frame, and later by 0.7. Axes that only run fast there slow down too."""
    v, slower = moving_occluder(), moving_occluder(-0.1, 0.4)
    fit = anchored_fit(0.1)(v, ANCHORS)
    assert fit.axes.shape == (NUM_FRAMES, 2, 3)
    step = largest_step(fit.axes)
    assert step < 15.0
    assert largest_step(anchored_fit(0.1)(slower, ANCHORS).axes) < 0.4 * step
    # A free fit swaps and turns its lobes.
    assert largest_step(free_fit(2)(jnp.concatenate([v, v])[: NUM_RANDOM + NUM_KNOWN]).axes[:NUM_FRAMES]) > 15.0
    # The anchored ones did move, and the fit is better for it.
    assert float(jnp.sum(fit.residual)) < 0.8 * float(jnp.sum(solve(v, ANCHORS)[1]))


def penalised(v, anchors, axes, z, anchor):
    """The objective as documented: squared error + anchor (|chart|² + 0.01 |z|²), |chart| = 2 tan(angle/2)."""
    cosines = np.sum(axes * anchors, axis=-1)
    left = v - lobes(z, axes)
    chart2 = 4 * (1 - cosines) / (1 + cosines)
    return np.sum(left**2, -1) + anchor * (chart2.sum(-1) + 0.01 * np.sum(z**2, axis=(-1, -2)))


def test_anchored_fit_is_a_minimum_of_its_objective(rng):
    """Neither other coefficients nor slightly turned axes are better."""
    v = moving_occluder()
    fit = jax.tree.map(lambda x: np.asarray(x, np.float64), anchored_fit(0.1)(v, ANCHORS))
    with jax.enable_x64(True):
        v, anchors = np.asarray(v, np.float64), ANCHORS.astype(np.float64)
        here = penalised(v, anchors, fit.axes, fit.coefficients, 0.1)
        for _ in range(6):
            z = fit.coefficients + 1e-2 * rng.normal(size=fit.coefficients.shape)
            assert (penalised(v, anchors, fit.axes, z, 0.1) > here - 1e-7).all()
            axes = oracles.unit(fit.axes + 2e-2 * rng.normal(size=fit.axes.shape))
            # Twelve steps in float32 may stop short of the minimum by 1e-3 of the objective.
            assert (penalised(v, anchors, axes, fit.coefficients, 0.1) > here * (1 - 1e-3)).all()


def test_strong_anchors_hold_and_weak_ones_let_go():
    v = moving_occluder()
    held = anchored_fit(1e4)(v, ANCHORS)
    assert_close(held.axes, np.broadcast_to(ANCHORS, held.axes.shape), ulps=1e3, dtype=np.float32)
    assert np.abs(held.coefficients).max() < 0.1
    loose = anchored_fit(0.0)(v, ANCHORS)
    assert float(jnp.sum(loose.residual)) < float(jnp.sum(anchored_fit(0.1)(v, ANCHORS).residual))
    assert_close(solve(v, loose.axes)[1], loose.residual, ulps=LONG_SUM, dtype=np.float32)


def test_shared_axis_is_the_best_of_the_sphere(rng):
    """One lobe for many vectors maximises Σ_f Σ_l z_l² over its axis, here over 20,000 directions."""
    v = oracles.visibilities(rng, 24).reshape(2, 12, 16)
    shared = quickly(lambda v: harmonics.fit_shared_axes(v, num_lobes=1, order=ORDER))
    axes = shared(jnp.asarray(v, jnp.float32))
    assert axes.shape == (2, 1, 3)
    dense = harmonics.hemisphere_directions(20000)
    y = oracles.real_harmonics(np.concatenate([dense, np.asarray(axes[:, 0], np.float64)]), ORDER)
    kept = sum(
        4 * np.pi / (2 * l + 1) * (v[..., l * l : (l + 1) ** 2] @ y[:, l * l : (l + 1) ** 2].T) ** 2 for l in range(4)
    ).sum(1)
    # Neighbours in the grid are 1e-2 apart, which costs 1e-4 of the sum.
    for vertex in range(2):
        assert kept[vertex, 20000 + vertex] >= kept[vertex, :20000].max() * (1 - 1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda v: harmonics.fit_zh_lobes(v, num_lobes=0, order=4), "num_lobes: expected a value >= 1, got 0"),
        (lambda v: harmonics.fit_zh_lobes(v, num_lobes=1, order=3), "sh: expected 9 coefficients for order 3"),
        (lambda v: harmonics.fit_zh_lobes(v, num_lobes=1, order=4, anchor=-1.0), "anchor: expected a value >= 0"),
        (lambda v: harmonics.fit_shared_axes(v, num_lobes=0, order=4), "num_lobes: expected a value >= 1"),
        (lambda v: harmonics.solve_lobe_coefficients(v, v[..., :3], order=5), "sh: expected 25 coefficients"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(jnp.zeros((2, 16)))
