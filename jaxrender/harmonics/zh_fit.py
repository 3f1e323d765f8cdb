"""SH coefficients to their best few zonal lobes.

Pointwise: any leading axes. For given axes the lobe coefficients are a small linear problem per band and are
eliminated in closed form (variable projection), so that the search runs over the axes only, two numbers a lobe.
These live in a chart around a reference axis that has no pole and no wrap where axes go.
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
from jaxtyping import Array, Float

from jaxrender.checks import check_at_least, check_order
from jaxrender.harmonics.sh import bands, basis_columns, sh_basis
from jaxrender.harmonics.zh import legendre, lobes_to_sh
from jaxrender.vecmath import constant_like, normalize, orthonormal_tangent

# Added to the Gram matrices' diagonals, and its effect taken back by one refinement step: lobes that nearly
# coincide share their coefficients evenly (the minimum-norm solution) instead of blowing up against each other.
DAMPING = 1e-4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ZHLobes:
    """c zonal lobes and the squared SH error that they leave."""

    axes: Float[Array, "*b c 3"]
    coefficients: Float[Array, "*b c l"]
    residual: Float[Array, "*b"]


def axis_from_chart(chart: Float[Array, "*#b 2"], reference: Float[Array, "*#b 3 3"]) -> Float[Array, "*b 3"]:
    """Unit axis from stereographic coordinates about the reference frame's z column.

    d = R (2q, 1 - |q|²) / (1 + |q|²) with q = chart / 2, so that small coordinates are angles in radians. Rational
    and smooth; only the point opposite to the reference is at infinity.
    """
    q = 0.5 * chart
    q2 = jnp.sum(q * q, axis=-1, keepdims=True)
    local = jnp.concatenate([2.0 * q, 1.0 - q2], axis=-1) / (1.0 + q2)
    return jnp.einsum("...ij,...j->...i", reference, local)


def chart_from_axis(axis: Float[Array, "*#b 3"], reference: Float[Array, "*#b 3 3"]) -> Float[Array, "*b 2"]:
    """The inverse of `axis_from_chart`; huge but finite next to the opposite of the reference axis."""
    local = jnp.einsum("...ij,...i->...j", reference, axis)
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


def _lobe_responses(sh, axes, order):
    """h[.., i, l] = √(4π/(2l+1)) Σ_m y_lm(d_i) v_lm: the light that band l of v sends along each axis."""
    members = np.eye(order)[bands(order)] * np.sqrt(4 * math.pi / (2 * np.arange(order) + 1))
    products = sh_basis(axes, order=order) * sh[..., None, :]
    return products @ jnp.asarray(members, dtype=sh.dtype)


def _cholesky(matrix: list[list]) -> list[list]:
    """Lower factor of a small symmetric matrix given as nested lists of arrays, elementwise over everything else."""
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


class SmallCholesky(lineax.AbstractLinearSolver):
    """Cholesky for a positive definite operator of a few unknowns, in plain elementwise arithmetic.

    Under `vmap` a factorisation per vertex would be one LAPACK call each: slow at two unknowns, and batches of such
    calls inside a loop were seen to block XLA's CPU thread pool for good (jax 0.10.2, two cores).
    """

    def init(self, operator, options):
        matrix = operator.as_matrix()
        return _cholesky([[matrix[i, j] for j in range(len(matrix))] for i in range(len(matrix))])

    def compute(self, state, vector, options):
        flat, unflatten = jax.flatten_util.ravel_pytree(vector)
        return unflatten(jnp.stack(_solve_factored(state, list(flat)))), lineax.RESULTS.successful, {}

    def transpose(self, state, options):
        return state, options

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True


def solve_lobe_coefficients(
    sh: Float[Array, "*#b k"], axes: Float[Array, "*#b c 3"], *, order: int
) -> tuple[Float[Array, "*b c l"], Float[Array, "*b"]]:
    """The best coefficients for given axes, and the squared SH error left.

    Band l decouples: G z_l = h_l with Gram matrix G_ij = P_l(d_i·d_j) and h_i = √(4π/(2l+1)) Σ_m y_lm(d_i) v_lm.
    Band 0 only knows the sum of the z_0, and lobes that coincide only the sum of theirs: these are split evenly.
    Differentiable in both arguments.
    """
    check_order(order)
    num_lobes = axes.shape[-2]
    h = _lobe_responses(sh, axes, order)
    cosines = jnp.einsum("...ia,...ja->...ij", axes, axes)
    gram = legendre(jnp.clip(cosines, -1.0, 1.0), order=order)
    damped = [
        [gram[..., i, j, :] + (DAMPING if i == j else 0.0) for j in range(num_lobes)] for i in range(num_lobes)
    ]
    rhs = [h[..., i, :] for i in range(num_lobes)]
    low = _cholesky(damped)
    z = _solve_factored(low, rhs)
    left = [rhs[i] - sum(gram[..., i, j, :] * z[j] for j in range(num_lobes)) for i in range(num_lobes)]
    z = [a + b for a, b in zip(z, _solve_factored(low, left), strict=True)]
    coefficients = jnp.stack(z, axis=-2)
    error = lobes_to_sh(coefficients, axes) - sh
    return coefficients, jnp.sum(error * error, axis=-1)


@functools.lru_cache
def _start_axes(count: int) -> np.ndarray:
    """Unit axes spread over the upper hemisphere (Fibonacci), where visibility has its lobes."""
    i = np.arange(count)
    z = 1.0 - (i + 0.5) / count
    phi, r = i * (math.pi * (3 - math.sqrt(5))), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def greedy_axes(sh: Float[Array, "*b n k"], *, num_lobes: int, order: int, first: int) -> Float[Array, "*b c 3"]:
    """Start axes by matching pursuit over a fixed set of 48 directions, shared by the n vectors of a vertex.

    Args:
      first: rank of the direction taken for the first lobe (0 = the best one); varying it gives several starts.
    """
    candidates = jnp.asarray(_start_axes(48), dtype=sh.dtype)
    basis = sh_basis(candidates, order=order)
    basis = basis * constant_like(np.sqrt(4 * math.pi / (2 * bands(order) + 1)), basis)
    members = jnp.asarray(np.eye(order)[bands(order)], dtype=sh.dtype)
    axes = jnp.zeros((*sh.shape[:-2], 0, 3), dtype=sh.dtype)
    rest = sh
    for i in range(num_lobes):
        response = jnp.einsum("...nk,dk,kl->...ndl", rest, basis, members)
        score = jnp.sum(response**2, axis=(-3, -1))
        ranked = jnp.argsort(-score, axis=-1)
        axis = candidates[ranked[..., first if i == 0 else 0]]
        axes = jnp.concatenate([axes, axis[..., None, :]], axis=-2)
        spread = jnp.broadcast_to(axes[..., None, :, :], (*sh.shape[:-1], i + 1, 3))
        coefficients, _ = solve_lobe_coefficients(sh, spread, order=order)
        rest = sh - lobes_to_sh(coefficients, spread)
    return axes


def _refine_axes(sh, reference, *, order, anchor, num_steps):
    """Levenberg-Marquardt over the chart coordinates of one set of axes that serves all n rows of sh (n, k)."""

    def residual(chart, _):
        axes = axis_from_chart(chart, reference)
        coefficients, _ = solve_lobe_coefficients(sh, jnp.broadcast_to(axes, (sh.shape[0], *axes.shape)), order=order)
        left = lobes_to_sh(coefficients, jnp.broadcast_to(axes, (sh.shape[0], *axes.shape))) - sh
        return left, math.sqrt(anchor) * chart, math.sqrt(anchor) * 0.1 * coefficients

    solver = optimistix.LevenbergMarquardt(rtol=1e-5, atol=1e-6, linear_solver=lineax.Normal(SmallCholesky()))
    start = jnp.zeros((reference.shape[0], 2), dtype=sh.dtype)
    found = optimistix.least_squares(residual, solver, start, max_steps=num_steps, throw=False)
    return axis_from_chart(found.value, reference)


def fit_shared_axes(
    sh: Float[Array, "*b n k"], *, num_lobes: int, order: int, num_starts: int = 4, num_steps: int = 20
) -> Float[Array, "*b c 3"]:
    """One set of axes per vertex that serves all of its n coefficient vectors, each with its own coefficients.

    With fixed axes only the second moments Σ_f v_f v_fᵀ of each band matter; they are factored, so that the search
    costs the same for 300 frames as for 7.
    """
    check_at_least("num_lobes", num_lobes, 1)
    blocks = jnp.einsum("...ni,...nj->...ij", sh, sh)
    virtual = _virtual_vectors(blocks, order) / math.sqrt(sh.shape[-2])
    lead = sh.shape[:-2]

    def one(rows):
        starts = jnp.stack(
            [greedy_axes(rows, num_lobes=num_lobes, order=order, first=2 * i) for i in range(num_starts)]
        )

        def refined(axes):
            better = _refine_axes(rows, reference_frames(axes), order=order, anchor=0.0, num_steps=num_steps)
            spread = jnp.broadcast_to(better, (rows.shape[0], *better.shape))
            return better, jnp.sum(solve_lobe_coefficients(rows, spread, order=order)[1])

        axes, errors = jax.vmap(refined)(starts)
        return axes[jnp.argmin(errors)]

    found = jax.vmap(one)(virtual.reshape(-1, *virtual.shape[-2:]))
    return _towards_normal(found).reshape(*lead, num_lobes, 3)


def spread_start_axes(
    sh: Float[Array, "f p k"], *, num_lobes: int, order: int, count: int
) -> Float[Array, "s p c 3"]:
    """Start axes for p points with f vectors each, by matching pursuit from `count` different first directions."""
    by_point = jnp.swapaxes(sh, 0, 1)
    virtual = _virtual_vectors(jnp.einsum("pfi,pfj->pij", by_point, by_point), order)
    greedy = jax.vmap(lambda first: greedy_axes(virtual, num_lobes=num_lobes, order=order, first=first))
    return _towards_normal(greedy(jnp.arange(count)))


def _virtual_vectors(moments: Float[Array, "*b k k"], order: int) -> Float[Array, "*b n k"]:
    """2·order-1 vectors with the same second moments within each band as the given ones."""
    rows = []
    for l in range(order):
        span = range(l * l, (l + 1) ** 2)
        ridge = 1e-6 * jnp.trace(moments, axis1=-2, axis2=-1) + jnp.finfo(moments.dtype).tiny
        low = _cholesky([[moments[..., i, j] + (ridge if i == j else 0.0) for j in span] for i in span])
        factor = jnp.stack([jnp.stack(row, axis=-1) for row in low], axis=-2)
        pad = [(0, 0)] * (factor.ndim - 1) + [(0, 2 * (order - 1 - l))]
        rows.append(jnp.pad(factor, pad))
    return jnp.swapaxes(jnp.concatenate(rows, axis=-2), -1, -2)


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

    Without `anchor_axes` every vector is fitted on its own from several starts, and the best is kept: the least
    error, but axes may jump between neighbouring frames. With them the search starts there, and a penalty anchor ·
    (|chart|² + 0.01 |z|²) holds the axes near and the coefficients small, so that lobe order and sign stay
    consistent from frame to frame and a linear model can follow them.

    Args:
      num_lobes: c; one lobe has 6 degrees of freedom, two have 11, three nearly always all 16 of order 4.
      anchor_axes: unit axes around which the charts are laid, one set per vertex.
      anchor: strength of the penalty, relative to squared SH coefficients; used only with `anchor_axes`.
    References:
      Sloan, Luna, Snyder, "Local, Deformable Precomputed Radiance Transfer", 2005, section on lobe fitting.
    """
    check_order(order, sh.shape[-1])
    check_at_least("num_lobes", num_lobes, 1)
    flat = sh.reshape(-1, sh.shape[-1])

    def free(vector):
        rows = vector[None, :]
        return fit_shared_axes(rows, num_lobes=num_lobes, order=order, num_starts=num_starts, num_steps=num_steps)

    def anchored(vector, axes):
        return _refine_axes(vector[None, :], reference_frames(axes), order=order, anchor=anchor, num_steps=num_steps)

    if anchor_axes is None:
        axes = jax.vmap(free)(flat)
    else:
        anchors = jnp.broadcast_to(anchor_axes, (*sh.shape[:-1], num_lobes, 3))
        axes = jax.vmap(anchored)(flat, anchors.reshape(-1, num_lobes, 3))
    coefficients, residual = solve_lobe_coefficients(flat, axes, order=order)
    lead = sh.shape[:-1]
    return ZHLobes(
        axes.reshape(*lead, num_lobes, 3), coefficients.reshape(*lead, num_lobes, order), residual.reshape(lead)
    )
