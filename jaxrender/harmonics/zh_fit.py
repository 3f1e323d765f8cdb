"""SH coefficients to their best few zonal lobes.

Pointwise: any leading axes. For given axes the lobe coefficients are a small linear problem per band and are
eliminated in closed form (variable projection), so that the search runs over the axes only, two numbers a
lobe. These live in a chart around a reference axis that has no pole and no wrap where axes go.

Differentiable in coefficients and axes, the start axes aside; a search is so at the optimum where it ends (implicit
differentiation), hence as well as it has converged.
"""

import functools
import math
from dataclasses import dataclass

import jax
import jax.flatten_util
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jaxtyping import Array, Float, Int

from jaxrender.checks import check_at_least, check_order
from jaxrender.harmonics.sh import bands, sh_basis
from jaxrender.vecmath import constant_like, einsum, normalize, orthonormal_tangent

# Share of |z|² in the penalty of an anchored fit.
COEFFICIENT_DAMPING = 0.01

# Directions of the upper hemisphere, where visibility has its lobes, among which starts are looked for.
NUM_CANDIDATES = 48


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ZHLobes:
    """c zonal lobes and the squared SH error that they leave."""

    axes: Float[Array, "*b c 3"]
    coefficients: Float[Array, "*b c l"]
    residual: Float[Array, "*b"]


def axis_from_chart(chart: Float[Array, "*#b 2"], reference: Float[Array, "*#b 3 3"]) -> Float[Array, "*b 3"]:
    """Unit axis from stereographic coordinates about the reference frame's z column.

    d = R (2q, 1 - |q|²) / (1 + |q|²) with q = chart / 2, so that small coordinates are angles in radians.
    Rational and smooth; only the point opposite to the reference is at infinity.
    """
    q = 0.5 * chart
    q2 = q[..., :1] ** 2 + q[..., 1:] ** 2
    x, y, z = (reference[..., i] for i in range(3))
    # Column by column: a sum over a last axis of 3 took 2.2 instead of 0.2 ms for 20k lobes.
    return (2.0 * q[..., :1] * x + 2.0 * q[..., 1:] * y + (1.0 - q2) * z) / (1.0 + q2)


def chart_from_axis(axis: Float[Array, "*#b 3"], reference: Float[Array, "*#b 3 3"]) -> Float[Array, "*b 2"]:
    """The inverse of `axis_from_chart`; huge but finite next to the opposite of the reference axis."""
    local = jnp.sum(reference * axis[..., :, None], axis=-2)
    return 2.0 * local[..., :2] / jnp.maximum(1.0 + local[..., 2:], 1e-6)


def reference_frames(axes: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """A frame around each unit axis, which is its z column."""
    x = orthonormal_tangent(axes)
    return jnp.stack([x, jnp.cross(axes, x), axes], axis=-1)


def optimal_linear_direction(sh: Float[Array, "*b k"]) -> Float[Array, "*b 3"]:
    """The direction of band 1, (-v_3, -v_1, v_2) normalised: the best axis for an order-2 lobe.

    References:
      Sloan, Luna, Snyder, "Local, Deformable Precomputed Radiance Transfer", 2005.
    """
    return normalize(jnp.stack([-sh[..., 3], -sh[..., 1], sh[..., 2]], axis=-1))


def _lobe_basis(axes: Float[Array, "*b 3"], order: int) -> Float[Array, "*b k"]:
    """b_lm(d) = √(4π/(2l+1)) y_lm(d), what a lobe of unit coefficients along d is in SH; |b| = 1 in each band.

    So the Gram matrix of lobes is the band sum of their products, P_l(d_i·d_j) by the addition theorem.
    """
    basis = sh_basis(axes, order=order)
    return basis * constant_like(np.sqrt(4 * math.pi / (2 * bands(order) + 1)), basis)


def _by_band(products: Float[Array, "*b k"], order: int) -> Float[Array, "*b l"]:
    """Sums over m, band by band."""
    return jnp.stack([jnp.sum(products[..., l * l : (l + 1) ** 2], axis=-1) for l in range(order)], axis=-1)


def _cholesky(matrix: list[list]) -> list[list]:
    """Lower factor of a small symmetric matrix given as nested lists of arrays, elementwise over all else."""
    n = len(matrix)
    low = [[jnp.zeros_like(matrix[0][0])] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            s = matrix[i][j]
            for k in range(j):
                s = s - low[i][k] * low[j][k]
            low[i][j] = jnp.sqrt(s) if i == j else s / low[j][j]
    return low


def _solve_factored(low: list[list], rhs: list) -> list:
    """Forward and back substitution with `_cholesky`'s factor."""
    n, y = len(rhs), list(rhs)
    for i in range(n):
        for k in range(i):
            y[i] = y[i] - low[i][k] * y[k]
        y[i] = y[i] / low[i][i]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            y[i] = y[i] - low[k][i] * y[k]
        y[i] = y[i] / low[i][i]
    return y


class _SmallNormalEquations(lineax.AbstractLinearSolver):
    """Least squares of a few unknowns by their normal equations and `_cholesky`, in plain elementwise arithmetic.

    The damping of Levenberg-Marquardt keeps them well conditioned. Under `vmap` a factorisation per vertex would
    be one LAPACK call each: slow at two unknowns, and batches of such calls, or of dot products, inside a loop
    were seen to block or crash XLA's CPU thread pool (jax 0.10.2, two cores).
    """

    def init(self, operator, options):
        """Factors the normal equations; the state is the matrix and its factor."""
        matrix = operator.as_matrix()
        n = matrix.shape[1]
        return matrix, _cholesky([[jnp.sum(matrix[:, i] * matrix[:, j]) for j in range(n)] for i in range(n)])

    def compute(self, state, vector, options):
        """Solves for one right-hand side."""
        matrix, low = state
        flat, _ = jax.flatten_util.ravel_pytree(vector)
        solution = _solve_factored(low, list(jnp.sum(matrix * flat[:, None], axis=0)))
        return jnp.stack(solution), lineax.RESULTS.successful, {}

    def transpose(self, state, options):
        """Not needed by the search."""
        raise NotImplementedError

    def conj(self, state, options):
        """The same: all is real."""
        return state, options

    def assume_full_rank(self):
        """Always, thanks to the damping."""
        return True


def _band_solver(basis: Float[Array, "*b c k"], damping: float, order: int):
    """Gram matrices (..., c, c, l) of lobes, and the solver (..., c, l) -> (..., c, l) of each, damped."""
    gram = _by_band(basis[..., :, None, :] * basis[..., None, :, :], order)
    c = basis.shape[-2]
    low = _cholesky([[gram[..., i, j, :] + (damping if i == j else 0.0) for j in range(c)] for i in range(c)])

    def solve(rhs):
        return jnp.stack(_solve_factored(low, [rhs[..., i, :] for i in range(c)]), axis=-2)

    return gram, solve


def _synthesize(coefficients: Float[Array, "*#b c l"], basis: Float[Array, "*#b c k"], order: int):
    """The sum of lobes in SH, from `_lobe_basis` of their axes."""
    return jnp.sum(coefficients[..., bands(order)] * basis, axis=-2)


def _damped_coefficients(sh, basis, damping, order):
    """Minimum of |Σ lobes - v|² + damping |z|² over z."""
    _, solve = _band_solver(basis, damping, order)
    return solve(_by_band(basis * sh[..., None, :], order))


def _best_coefficients(sh, basis, order):
    """Least squares; of all its solutions the shortest.

    The Gram matrices are damped by δ, and one refinement takes the effect back to (δ/λ)² for an eigenvalue λ,
    while lobes that coincide share their coefficients evenly, up to eps/δ of rounding. Band 0, where lobes are
    all alike, is split exactly.
    """
    gram, solve = _band_solver(basis, _damping(basis.dtype), order)
    rhs = _by_band(basis * sh[..., None, :], order)
    z = solve(rhs)
    z = z + solve(rhs - jnp.sum(gram * z[..., None, :, :], axis=-2))
    return jnp.concatenate([rhs[..., :1] / basis.shape[-2], z[..., 1:]], axis=-1)


def _damping(dtype) -> float:
    return 0.25 * math.sqrt(jnp.finfo(dtype).eps)


def solve_lobe_coefficients(
    sh: Float[Array, "*#b k"], axes: Float[Array, "*#b c 3"], *, order: int
) -> tuple[Float[Array, "*b c l"], Float[Array, "*b"]]:
    """The best coefficients for given axes, and the squared SH error left.

    Band l decouples: G z_l = h_l with Gram matrix G_ij = P_l(d_i·d_j) and h_i = √(4π/(2l+1)) Σ_m y_lm(d_i)
    v_lm. Band 0 only knows the sum of the z_0, and lobes that coincide only the sum of theirs: these are split
    evenly. Differentiable in both arguments.

    Raises:
      ValueError: if order < 1, or there are not order² SH coefficients.
    """
    check_order(order, sh.shape[-1])
    basis = _lobe_basis(axes, order)
    coefficients = _best_coefficients(sh, basis, order)
    error = _synthesize(coefficients, basis, order) - sh
    return coefficients, jnp.sum(error * error, axis=-1)


@functools.lru_cache
def _start_axes(count: int) -> np.ndarray:
    """Unit axes spread over the upper hemisphere (Fibonacci)."""
    i = np.arange(count)
    z = 1.0 - (i + 0.5) / count
    phi, r = i * (math.pi * (3 - math.sqrt(5))), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def greedy_axes(
    sh: Float[Array, "*b n k"], *, num_lobes: int, order: int, first: int | Int[Array, ""]
) -> Float[Array, "*b c 3"]:
    """Start axes by matching pursuit over a fixed set of directions, shared by the n vectors of a vertex.

    Args:
      first: rank of the direction taken for the first lobe (0 = the best one); varying it gives several starts.
    """
    candidates = jnp.asarray(_start_axes(NUM_CANDIDATES), dtype=sh.dtype)
    table = _lobe_basis(candidates, order)
    by_band = table[:, :, None] * jnp.asarray(np.eye(order)[bands(order)], dtype=sh.dtype)[None]
    chosen = jnp.zeros((*sh.shape[:-2], 0), dtype=int)
    rest = sh
    for i in range(num_lobes):
        score = jnp.sum(einsum("...nk,dkl->...ndl", rest, by_band) ** 2, axis=(-3, -1))
        best = jnp.argsort(-score, axis=-1)[..., first] if i == 0 else jnp.argmax(score, axis=-1)
        chosen = jnp.concatenate([chosen, best[..., None]], axis=-1)
        if i + 1 < num_lobes:
            basis = table[chosen][..., None, :, :]
            z = _damped_coefficients(sh, basis, _damping(sh.dtype), order)
            rest = sh - _synthesize(z, basis, order)
    return candidates[chosen]


def _misfit(chart, sh, reference, order, anchor):
    """Residuals, flat, of one set of axes that serves all rows of sh (n, k); with `anchor`, the penalties too."""
    damping = anchor * COEFFICIENT_DAMPING
    basis = _lobe_basis(axis_from_chart(chart.reshape(-1, 2), reference), order)[None]
    coefficients = _damped_coefficients(sh, basis, max(damping, _damping(sh.dtype)), order)
    parts = [_synthesize(coefficients, basis, order) - sh]
    if anchor > 0:
        parts += [math.sqrt(anchor) * chart, math.sqrt(damping) * coefficients]
    return jnp.concatenate([part.reshape(-1) for part in parts])


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _misfit_with_matrix(chart, sh, reference, order, anchor):
    """`_misfit`, but linearised into the matrix of its Jacobian in the 2c numbers of `chart`.

    An optimiser keeps the linearised function from step to step: so it is a few numbers, not all that the
    chain rule passes on the way.
    """
    return _misfit(chart, sh, reference, order, anchor)


@_misfit_with_matrix.defjvp
def _misfit_tangent(order, anchor, primals, tangents):
    def twice(chart):
        value = _misfit(chart, *primals[1:], order, anchor)
        return value, value

    jacobian, value = jax.jacfwd(twice, has_aux=True)(primals[0])
    return value, jnp.sum(jacobian * tangents[0][None], axis=1)


def _refine_axes(sh, start, *, order, anchor, num_steps):
    """Levenberg-Marquardt over the chart coordinates of axes (c, 3) that serve all rows of sh (n, k)."""
    reference = reference_frames(start)
    solver = optimistix.LevenbergMarquardt(rtol=1e-5, atol=1e-6, linear_solver=_SmallNormalEquations())
    found = optimistix.least_squares(
        lambda chart, data: _misfit_with_matrix(chart, *data, order, anchor),
        solver,
        jnp.zeros(2 * start.shape[0], dtype=sh.dtype),
        args=(sh, reference),
        max_steps=num_steps,
        throw=False,
    )
    return axis_from_chart(found.value.reshape(-1, 2), reference)


def fit_shared_axes(
    sh: Float[Array, "*b n k"], *, num_lobes: int, order: int, num_starts: int = 4, num_steps: int = 20
) -> Float[Array, "*b c 3"]:
    """One set of axes per vertex that serves all of its n coefficient vectors, each with its own coefficients.

    With fixed axes only the second moments Σ_f v_f v_fᵀ of each band matter; they are factored, so that the
    search costs the same for 300 frames as for 7.

    Raises:
      ValueError: if num_lobes or order < 1, or there are not order² SH coefficients.
    """
    check_at_least("num_lobes", num_lobes, 1)
    check_order(order, sh.shape[-1])
    rows = _few_rows(sh.reshape(-1, *sh.shape[-2:]), order) / math.sqrt(sh.shape[-2])

    def refined(vectors, start):
        axes = _refine_axes(vectors, start, order=order, anchor=0.0, num_steps=num_steps)
        return axes, jnp.sum(solve_lobe_coefficients(vectors, axes[None], order=order)[1])

    starts = _starts(rows, num_lobes=num_lobes, order=order, count=num_starts)
    axes, errors = jax.vmap(jax.vmap(refined), in_axes=(None, 0))(rows, starts)
    best = jnp.argmin(errors, axis=0)
    found = jnp.take_along_axis(axes, best[None, :, None, None], axis=0)[0]
    return _towards_normal(found).reshape(*sh.shape[:-2], num_lobes, 3)


def _starts(rows: Float[Array, "v n k"], *, num_lobes: int, order: int, count: int):
    """`count` sets of start axes per vertex, (s, v, c, 3)."""
    greedy = functools.partial(greedy_axes, rows, num_lobes=num_lobes, order=order)
    return jax.vmap(lambda first: greedy(first=first))(2 * jnp.arange(count))


def spread_start_axes(sh: Float[Array, "f p k"], *, num_lobes: int, order: int, count: int) -> Float[Array, "s p c 3"]:
    """Start axes for p points with f vectors each, by matching pursuit from `count` different first directions."""
    rows = _few_rows(jnp.swapaxes(sh, 0, 1), order)
    greedy = functools.partial(greedy_axes, rows, num_lobes=num_lobes, order=order)
    return _towards_normal(jax.vmap(lambda first: greedy(first=first))(jnp.arange(count)))


def _few_rows(sh: Float[Array, "v n k"], order: int) -> Float[Array, "v m k"]:
    """At most 2·order-1 vectors with the same second moments within each band as the n given ones.

    They are the columns of the Cholesky factors of Σ v vᵀ, of all bands at once, each padded with zeros; a
    pivot that is zero up to rounding marks a direction without content.
    """
    size = 2 * order - 1
    if sh.shape[-2] <= size:
        return sh
    l, m = bands(order), np.arange(order**2) - bands(order) ** 2
    index = np.zeros((order, size), dtype=int)
    used = np.zeros((order, size))
    index[l, m], used[l, m] = np.arange(order**2), 1.0
    padded = sh[..., index]
    padded = padded * constant_like(used, padded)
    left = einsum("vnli,vnlj->vlij", padded, padded)
    smallest = 1e-6 * jnp.trace(left, axis1=-2, axis2=-1) + jnp.finfo(sh.dtype).tiny
    columns = []
    for j in range(size):
        pivot = left[..., j, j]
        full = pivot > smallest
        scale = jnp.where(full, jax.lax.rsqrt(jnp.where(full, pivot, jnp.ones_like(pivot))), 0.0)
        columns.append(left[..., j] * scale[..., None])
        left = left - columns[-1][..., :, None] * columns[-1][..., None, :]
    return jnp.stack(columns, axis=1)[..., l, m]


def _towards_normal(axes: Float[Array, "*b c 3"]) -> Float[Array, "*b c 3"]:
    """Of the two antipodal axes of a lobe, the one on the side of the local normal."""
    return jnp.where(axes[..., 2:] < 0, -axes, axes)


def fit_zh_lobes(
    sh: Float[Array, "*b k"],
    *,
    num_lobes: int,
    order: int,
    anchor_axes: Float[Array, "*#b c 3"] | None = None,
    anchor: float = 0.1,
    num_starts: int = 4,
    num_steps: int = 12,
) -> ZHLobes:
    """Fits c zonal lobes to each coefficient vector: the best axes by Levenberg-Marquardt, coefficients eliminated.

    Without `anchor_axes` every vector is fitted on its own from several starts, and the best is kept: the
    least error, but axes may jump between neighbouring frames. With them the search starts there, and a
    penalty anchor · (|chart|² + 0.01 |z|²) holds the axes near and the coefficients small, so that lobe order
    and sign stay consistent from frame to frame and a linear model can follow them.

    Args:
      num_lobes: c; one lobe has 6 degrees of freedom, two have 11, three nearly always all 16 of order 4.
      anchor_axes: unit axes around which the charts are laid, one set per vertex.
      anchor: strength of the penalty, relative to squared SH coefficients; used only with `anchor_axes`.
    Raises:
      ValueError: if num_lobes or order < 1, anchor < 0, or there are not order² SH coefficients.
    References:
      Sloan, Luna, Snyder, "Local, Deformable Precomputed Radiance Transfer", 2005, section on lobe fitting.
    """
    check_order(order, sh.shape[-1])
    check_at_least("num_lobes", num_lobes, 1)
    check_at_least("anchor", anchor, 0.0)
    flat = sh.reshape(-1, sh.shape[-1])
    if anchor_axes is None:
        anchor = 0.0
        axes = fit_shared_axes(
            flat[:, None], num_lobes=num_lobes, order=order, num_starts=num_starts, num_steps=num_steps
        )
    else:
        anchors = jnp.broadcast_to(anchor_axes, (*sh.shape[:-1], num_lobes, 3)).reshape(-1, num_lobes, 3)
        search = functools.partial(_refine_axes, order=order, anchor=anchor, num_steps=num_steps)
        axes = jax.vmap(search)(flat[:, None], anchors)
    basis = _lobe_basis(axes, order)
    if anchor > 0:
        coefficients = _damped_coefficients(flat, basis, anchor * COEFFICIENT_DAMPING, order)
    else:
        coefficients = _best_coefficients(flat, basis, order)
    residual = jnp.sum((_synthesize(coefficients, basis, order) - flat) ** 2, axis=-1)
    lead = sh.shape[:-1]
    return ZHLobes(
        axes.reshape(*lead, num_lobes, 3),
        coefficients.reshape(*lead, num_lobes, order),
        residual.reshape(lead),
    )
