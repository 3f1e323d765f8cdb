"""The linear pose model A X = B: ridge regression with a bias, one factorisation for all right-hand sides."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from jaxrender.checks import check_at_least
from jaxrender.vecmath import matmul, safe_div, safe_sqrt


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LinearFit:
    """Solution of A X = B: prediction is features @ weights + bias.

    `rank` is the numerical rank of the centred and scaled features and `residual` the relative Frobenius residual of
    the centred targets, 0 for a perfect fit, 1 for no better than the mean.
    """

    weights: Float[Array, "j n"]
    bias: Float[Array, " n"]
    rank: Int[Array, ""]
    residual: Float[Array, ""]


def fit_linear(
    features: Float[Array, "f j"], targets: Float[Array, "f n"], *, ridge: float | Float[Array, ""]
) -> LinearFit:
    """Least squares with a penalty λ|X|², λ = ridge · trace(AᵀA) / j; the bias is free.

    A is the features with every column centred and divided by its standard deviation over the frames, so that the
    unit of a feature does not matter; the weights are handed back in the features' own units. A column that changes
    by no more than a few roundings of its values counts as constant and gets no weight.

    One QR factorisation serves all n right-hand sides: of [A; √λ I] where there are more frames than features,
    of [Aᵀ; √λ I] (the dual form X = Aᵀ(AAᵀ + λI)⁻¹B) where there are fewer. The normal equations are never
    formed, which keeps float32 as good as float64 at the condition numbers of joint angles (1e4). Directions
    whose singular value is zero up to rounding (eps · max(f, j) · the largest) get no weight, so that at
    ridge = 0 the solution is the shortest one, per standard deviation. Differentiable in all arguments where
    ridge > 0.

    Args:
      features: pose features, one row per frame.
      targets: anything linear in pose, one column per unknown function.
      ridge: >= 0, relative to the mean eigenvalue of AᵀA.
    Raises:
      ValueError: if the numbers of frames differ, or there is no frame or no feature.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 3.1.
    """
    if features.shape[0] != targets.shape[0]:
        raise ValueError(f"targets: expected {features.shape[0]} frames as in features, got {targets.shape[0]}")
    check_at_least("frames", features.shape[0], 1)
    check_at_least("columns of features", features.shape[1], 1)
    mean_b = jnp.mean(targets, axis=0)
    b = targets - mean_b[None, :]
    a, mean_a, per_unit = _standardised(features)
    frames, columns = a.shape
    tall = a if frames >= columns else a.T
    root = safe_sqrt(jnp.asarray(ridge, dtype=a.dtype) * jnp.sum(a * a) / columns)
    largest, empty, rank = _empty_directions(jax.lax.stop_gradient(tall), root)

    # Directions without content would divide by rounding noise: they are filled, and projected out afterwards.
    penalty = root * jnp.eye(len(empty), dtype=a.dtype) + largest * empty
    q, r = jnp.linalg.qr(jnp.concatenate([tall, penalty]))
    if frames >= columns:
        weights = solve_triangular(r, matmul(q[:frames].T, b))
        weights = weights - matmul(empty, weights)
    else:
        inner = solve_triangular(r, solve_triangular(r, b - matmul(empty, b), trans=1))
        weights = matmul(a.T, inner - matmul(empty, inner))
    error = safe_sqrt(safe_div(jnp.sum((matmul(a, weights) - b) ** 2), jnp.sum(b * b)))
    weights = weights * per_unit[:, None]
    return LinearFit(weights, mean_b - matmul(mean_a, weights), rank, error)


def _standardised(features: Float[Array, "f j"]) -> tuple[Array, Array, Array]:
    """Columns of mean 0 and standard deviation 1, their means, and the factors they were scaled by, 0 if constant."""
    # From the first row on: the mean of large, nearly equal numbers would round their differences away.
    first = features[:1]
    shift = jnp.mean(features - first, axis=0, keepdims=True)
    centred = features - first - shift
    spread = safe_sqrt(jnp.mean(centred * centred, axis=0))
    rounding = 4.0 * float(jnp.finfo(features.dtype).eps) * jnp.max(jnp.abs(features), axis=0)
    per_unit = safe_div(jnp.ones_like(spread), jnp.where(spread > rounding, spread, jnp.zeros_like(spread)))
    return centred * per_unit[None, :], (first + shift)[0], per_unit


def _empty_directions(tall: Float[Array, "n m"], root: Float[Array, ""]) -> tuple[Array, Array, Array]:
    """Largest singular value (1 if all are 0), projector on the directions without content, and the rank.

    A direction that the ridge, by its root, holds down already is left alone, which keeps it differentiable.
    """
    _, singular, directions = jnp.linalg.svd(tall, full_matrices=False)
    cutoff = singular[0] * (max(tall.shape) * float(jnp.finfo(tall.dtype).eps))
    full = singular > cutoff
    chosen = jnp.where((full | (root > cutoff))[:, None], jnp.zeros_like(directions), directions)
    largest = jnp.where(singular[0] > 0, singular[0], jnp.ones_like(cutoff))
    return largest, matmul(chosen.T, chosen), jnp.sum(full)


def predict_linear(fit: LinearFit, features: Float[Array, "*b j"]) -> Float[Array, "*b n"]:
    """features @ weights + bias; differentiable in all three."""
    predicted = matmul(features, fit.weights)
    return predicted + jnp.broadcast_to(fit.bias, predicted.shape)
