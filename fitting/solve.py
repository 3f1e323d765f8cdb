"""From baked visibility to the model's weights: the linear solve and the joint refinement, block by block.

Points of one group share their pose features; a block is a fixed number of points of one group, so that one compiled
function serves them all and memory stays bounded. The features are principal components, hence AᵀWA is diagonal
and the ridge solve a division: the factorisation is the one of `fit_basis`.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxrender.harmonics.pose_model import lobes_from_numbers
from jaxrender.harmonics.visibility import project_visibility
from jaxrender.harmonics.zh import lobes_to_sh
from jaxrender.harmonics.zh_fit import solve_lobe_coefficients

BLOCK = 64
ORDER = 4


def padded(rows: Shaped[np.ndarray, "n *b"], size: int) -> Shaped[np.ndarray, "size *b"]:
    """Up to `size` rows, filled up with repetitions of the last: one compiled function then serves all blocks."""
    return np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseRows:
    """The training poses as one group sees them, with the penalty.

    `components` are the principal components of each frame, `moments` their weighted second moments, `ridge` the
    penalty λ in the same units, `weights` the frames' weights.
    """

    components: Float[Array, "f k"]
    weights: Float[Array, " f"]
    moments: Float[Array, " k"]
    ridge: Float[Array, ""]


def solve_linear(rows: PoseRows, targets: Float[Array, "f *n"]) -> Float[Array, "m *n"]:
    """Weighted ridge regression on principal components; row 0 of the result is the bias."""
    flat = targets.reshape(targets.shape[0], -1)
    mean = rows.weights @ flat / jnp.sum(rows.weights)
    slopes = (rows.components * rows.weights[:, None]).T @ (flat - mean[None, :])
    slopes = slopes / (rows.moments + rows.ridge + jnp.finfo(flat.dtype).tiny)[:, None]
    return jnp.concatenate([mean[None, :], slopes]).reshape(-1, *targets.shape[1:])


def apply_linear(components: Float[Array, "f k"], weights: Float[Array, "m *n"]) -> Float[Array, "f *n"]:
    """Predictions of `solve_linear`'s weights."""
    flat = weights.reshape(weights.shape[0], -1)
    return (components @ flat[1:] + flat[:1]).reshape(-1, *weights.shape[1:])


def lobe_targets(sh: Float[Array, "f p 16"], axes: Float[Array, "p c 3"]) -> Float[Array, "f p d"]:
    """The 6c numbers of every frame for fixed axes: zero chart coordinates and the best coefficients."""
    spread = jnp.broadcast_to(axes, (*sh.shape[:-1], *axes.shape[-2:]))
    coefficients, _ = solve_lobe_coefficients(sh, spread, order=ORDER)
    chart = jnp.zeros((*sh.shape[:-1], 2 * axes.shape[-2]), sh.dtype)
    return jnp.concatenate([chart, coefficients.reshape(*sh.shape[:-1], -1)], axis=-1)


def synthesize(numbers: Float[Array, "f p d"], axes: Float[Array, "p c 3"]) -> Float[Array, "f p 16"]:
    """SH visibility of the 6c numbers."""
    turned, coefficients = lobes_from_numbers(numbers, jnp.broadcast_to(axes, (*numbers.shape[:-1], *axes.shape[-2:])))
    return lobes_to_sh(coefficients, turned)


def mean_residual(
    sh: Float[Array, "f p 16"], predicted: Float[Array, "f p 16"], frame_weights: Float[Array, " f"]
) -> Float[Array, "p 16"]:
    """What the lobes leave on average: the constant SH vector of each point."""
    return jnp.einsum("f,fpk->pk", frame_weights / jnp.sum(frame_weights), sh - predicted)


def lobe_metric(numbers: Float[Array, "f p d"], axes: Float[Array, "p c 3"], frame_weights) -> Float[Array, "p d d"]:
    """Mean over frames of JᵀJ, with J the derivative of SH visibility in a point's 6c numbers.

    In this metric a step, or the penalty, has the size of the change in SH that it causes; it does not depend on
    how lobes are parametrised. A little of the mean diagonal is added: the split of z_0 between lobes has no effect.
    """
    d = numbers.shape[-1]

    def along(tangent):
        direction = jnp.broadcast_to(tangent, numbers.shape)
        return jax.jvp(lambda n: synthesize(n, axes), (numbers,), (direction,))[1]

    jacobian = jax.vmap(along)(jnp.eye(d, dtype=numbers.dtype))
    metric = jnp.einsum("dfpk,efpk,f->pde", jacobian, jacobian, frame_weights / jnp.sum(frame_weights))
    floor = 1e-3 * jnp.trace(metric, axis1=1, axis2=2) / d
    return metric + floor[:, None, None] * jnp.eye(d, dtype=metric.dtype)[None]


def _objective(weights, rows, sh, axes, penalty_metric, offset_on):
    """Per point: weighted squared SH error plus λ times the weights in the metric; and the gradient."""
    predicted, pull = jax.vjp(lambda n: synthesize(n, axes), apply_linear(rows.components, weights))
    residual = predicted - sh
    residual = residual + offset_on * mean_residual(sh, predicted, rows.weights)[None]
    weighted = rows.weights[:, None, None] * residual
    in_metric = rows.ridge * jnp.einsum("mpd,pde->mpe", weights[1:], penalty_metric)
    value = jnp.sum(weighted * residual, axis=(0, 2)) + jnp.sum(weights[1:] * in_metric, axis=(0, 2))
    (numbers,) = pull(weighted)
    slopes = rows.components.T @ numbers.reshape(len(numbers), -1)
    slopes = slopes.reshape(weights[1:].shape) + in_metric
    return value, jnp.concatenate([jnp.sum(numbers, axis=0)[None], slopes])


def refine_block(
    weights: Float[Array, "m p d"],
    rows: PoseRows,
    sh: Float[Array, "f p 16"],
    axes: Float[Array, "p c 3"],
    penalty_metric: Float[Array, "p d d"],
    inverse_metric: Float[Array, "p d d"],
    *,
    num_steps: int,
    offset: bool,
) -> tuple[Float[Array, "m p d"], Float[Array, " p"]]:
    """Minimises the error of the whole map pose -> lobes -> SH over the weights; every point has its own step size.

    The Gauss-Newton matrix Σ_f a_f a_fᵀ ⊗ J_fᵀ J_f is replaced by (AᵀWA + λ) ⊗ mean JᵀJ, which is inverted once: one
    diagonal factor, one d x d matrix per point. With momentum, and with steps that raise a point's error taken back
    and shortened, about thirty steps reach what a first-order method needs some hundreds for.

    Returns:
      weights, and the objective of each point.
    """
    gram = jnp.concatenate([jnp.sum(rows.weights)[None], rows.moments + rows.ridge])
    on = jnp.asarray(1.0 if offset else 0.0, sh.dtype)

    def step(state, _):
        weights, value, gradient, velocity, length = state
        descent = jnp.einsum("mpd,pde->mpe", gradient, inverse_metric) / (gram + 1e-12)[:, None, None]
        trial_velocity = 0.6 * velocity - descent
        trial = weights + length[None, :, None] * trial_velocity
        new_value, new_gradient = _objective(trial, rows, sh, axes, penalty_metric, on)
        better = new_value < value
        keep = better[None, :, None]
        state = (
            jnp.where(keep, trial, weights),
            jnp.where(better, new_value, value),
            jnp.where(keep, new_gradient, gradient),
            jnp.where(keep, trial_velocity, jnp.zeros_like(velocity)),
            jnp.where(better, jnp.minimum(1.2 * length, 1.0), 0.4 * length),
        )
        return state, None

    value, gradient = _objective(weights, rows, sh, axes, penalty_metric, on)
    start: Any = (weights, value, gradient, jnp.zeros_like(weights), jnp.full_like(value, 0.7))
    end, _ = jax.lax.scan(step, start, None, length=num_steps)
    return end[0], end[1]


def block_sh(bits: np.ndarray, table: np.ndarray) -> Float[np.ndarray, "f p 16"]:
    """SH visibility of a block's packed bits."""
    return _project(bits, table.astype(np.float32))


_project = jax.jit(project_visibility)
