"""The linear pose model A X = B: ridge regression with a free bias, through the singular values of A."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.vecmath import safe_sqrt


@dataclass(frozen=True)
class LinearFit:
    """A X = B solved: prediction is features @ weights + bias.

    `rank` is the numerical rank of the standardised features, `residual` the Frobenius norm of what is left of
    the centred targets relative to theirs.
    """

    weights: Float[Tensor, "j n"]
    bias: Float[Tensor, " n"]
    rank: Int[Tensor, ""]
    residual: Float[Tensor, ""]


def fit_linear(
    features: Float[Tensor, "f j"], targets: Float[Tensor, "f n"], *, ridge: float | Float[Tensor, ""]
) -> LinearFit:
    """Minimises |A X - B|² + λ|X|², λ = ridge · trace(AᵀA) / j, with A the features in standard scores.

    These are (feature - mean) / σ, σ² the mean squared deviation over the frames, and the weights are X / σ. A
    feature with σ <= 4 eps times its largest magnitude is constant: its scores and its weights are 0.

    With A = U S Vᵀ, X = V diag(s / (s² + λ)) Uᵀ B. Singular values below eps · max(f, j) · s_max count as
    zero. eps is that of the dtype the features came in.
    """
    eps = torch.finfo(features.dtype).eps
    weights, bias, rank, residual = _ridge(features, targets, ridge, eps)
    return LinearFit(weights, bias, rank, residual)


@in_float64
def _ridge(features: Tensor, targets: Tensor, ridge: float | Tensor, eps: float):
    mean_a, mean_b = features.mean(0), targets.mean(0)
    deviation, b = features - mean_a, targets - mean_b
    sigma = safe_sqrt((deviation**2).mean(0))
    constant = sigma <= 4.0 * eps * features.abs().amax(0)
    per_sigma = torch.where(constant, 0.0, 1.0 / torch.where(constant, 1.0, sigma))
    a = deviation * per_sigma
    u, s, vt = torch.linalg.svd(a, full_matrices=False)
    penalty = ridge * (s**2).sum() / a.shape[1]
    kept = s > eps * max(a.shape) * s[0]
    gain = torch.where(kept, s / torch.where(kept, s**2 + penalty, 1.0), 0.0)
    weights = vt.T @ (gain[:, None] * (u.T @ b))
    norm = torch.linalg.norm(b)
    left = torch.linalg.norm(b - a @ weights)
    residual = torch.where(norm > 0, left / torch.where(norm > 0, norm, 1.0), 0.0)
    weights = weights * per_sigma[:, None]
    return weights, mean_b - mean_a @ weights, kept.sum().to(torch.int32), residual


@in_float64
def predict_linear(fit: LinearFit, features: Float[Tensor, "*b j"]) -> Float[Tensor, "*b n"]:
    """features @ weights + bias."""
    return torch.einsum("...j,jn->...n", features, fit.weights) + fit.bias
