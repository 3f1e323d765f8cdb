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

    `rank` is the numerical rank of the centred features and `residual` the relative Frobenius residual of the
    centred targets, 0 for a perfect fit, 1 for no better than the mean.
    """

    weights: Float[Array, "j n"]
    bias: Float[Array, " n"]
    rank: Int[Array, ""]
    residual: Float[Array, ""]


def fit_linear(
    features: Float[Array, "f j"], targets: Float[Array, "f n"], *, ridge: float | Float[Array, ""]
) -> LinearFit:
    """Least squares with a penalty λ|X|², λ = ridge · trace(AᵀA) / j on centred columns; the bias is free.

    One QR factorisation serves all n right-hand sides: of [A; √λ I] where there are more frames than features,
    of [Aᵀ; √λ I] (the dual form X = Aᵀ(AAᵀ + λI)⁻¹B) where there are fewer. The normal equations are never
    formed, which keeps float32 as good as float64 at the condition numbers of joint angles (1e4). Directions
    whose singular value is zero up to rounding (eps · max(f, j) · the largest) get no weight, so that at
    ridge = 0 the solution is the shortest one.

    Args:
      features: pose features, one row per frame.
      targets: anything linear in pose, one column per unknown function.
      ridge: >= 0, relative to the mean eigenvalue of AᵀA. Differentiable where > 0.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 3.1.
    """
    if features.shape[0] != targets.shape[0]:
        raise ValueError(f"targets: expected {features.shape[0]} frames as in features, got {targets.shape[0]}")
    check_at_least("frames", features.shape[0], 1)
    check_at_least("columns of features", features.shape[1], 1)
    mean_a, mean_b = jnp.mean(features, axis=0), jnp.mean(targets, axis=0)
    a, b = features - mean_a[None, :], targets - mean_b[None, :]
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
    return LinearFit(weights, mean_b - matmul(mean_a, weights), rank, error)


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
    """features @ weights + bias."""
    predicted = matmul(features, fit.weights)
    return predicted + jnp.broadcast_to(fit.bias, predicted.shape)
