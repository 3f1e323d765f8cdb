"""The linear pose model A X = B: ridge regression with a bias, one factorisation for all right-hand sides."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxrender.checks import check_at_least


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

    One QR factorisation serves all n right-hand sides: of [A; √λ I] where there are more frames than features, of
    [Aᵀ; √λ I] (the dual form X = Aᵀ(AAᵀ + λI)⁻¹B) where there are fewer. The normal equations are never formed,
    which keeps float32 as good as float64 at the condition numbers of joint angles (1e4). At ridge = 0 singular
    directions are cut at the usual relative tolerance.

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
    mean_a, mean_b = jnp.mean(features, axis=0), jnp.mean(targets, axis=0)
    a, b = features - mean_a[None, :], targets - mean_b[None, :]
    frames, columns = a.shape
    lam = jnp.asarray(ridge, dtype=a.dtype) * jnp.sum(a * a) / columns
    # The singular values tell the rank; below the tolerance a direction is noise and gets no weight.
    singular = jnp.linalg.svd(a, compute_uv=False)
    cutoff = jnp.max(singular) * max(a.shape) * jnp.finfo(a.dtype).eps
    floor = jnp.maximum(jnp.sqrt(lam), jnp.maximum(cutoff, jnp.finfo(a.dtype).tiny))
    tall = a if frames >= columns else a.T
    q, r = jnp.linalg.qr(jnp.concatenate([tall, floor * jnp.eye(tall.shape[1], dtype=a.dtype)]))
    if frames >= columns:
        weights = jax.scipy.linalg.solve_triangular(r, q[:frames].T @ b)
    else:
        inner = jax.scipy.linalg.solve_triangular(r, b, trans=1)
        weights = a.T @ jax.scipy.linalg.solve_triangular(r, inner)
    error = jnp.sqrt(jnp.sum((a @ weights - b) ** 2) / jnp.maximum(jnp.sum(b * b), jnp.finfo(b.dtype).tiny))
    return LinearFit(weights, mean_b - mean_a @ weights, jnp.sum(singular > cutoff), error)


def predict_linear(fit: LinearFit, features: Float[Array, "*b j"]) -> Float[Array, "*b n"]:
    """features @ weights + bias."""
    return features @ fit.weights + jnp.broadcast_to(fit.bias, (*features.shape[:-1], fit.bias.shape[0]))
