"""Quadrature rules in float64, for what the partner package has in closed form."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def gauss_legendre(num_nodes: int, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights (..., n) on the intervals [low, high] (...,); exact up to degree 2n - 1.

    A node is written as high - (high - low)·u, so that one close to `high` keeps its relative distance to it.
    """
    t, w = (torch.as_tensor(a, device=high.device) for a in np.polynomial.legendre.leggauss(num_nodes))
    width = (high - low)[..., None]
    return high[..., None] - width * (1.0 - t) / 2.0, width * w / 2.0


def gauss_jacobi(exponent: Float[Tensor, "*b"], num_nodes: int) -> tuple[Tensor, Tensor]:
    """Distances u from 1 and weights w (..., n) with Σ w g(1-u) = ∫_0^1 x^α g(x) dx, for degrees < 2n.

    The nodes are the eigenvalues of the three-term recurrence of the polynomials that are orthogonal under
    x^α, the weights the squared first components of the eigenvectors times the mass 1/(α+1). Written in u = 1
    - x, nodes that crowd at x = 1 for a large exponent keep their relative precision. Differentiable in α.

    References:
      Golub and Welsch, "Calculation of Gauss Quadrature Rules", 1969, with the Jacobi recurrence of
      (1-t)^0 (1+t)^α moved from [-1, 1] to [0, 1].
    """
    alpha = exponent[..., None]
    k = torch.arange(num_nodes, dtype=exponent.dtype, device=exponent.device).expand(*exponent.shape, num_nodes)
    later = k[..., 1:]
    first = 1.0 / (alpha + 2.0)  # the general term is 0/0 at k = 0, α = 0
    diagonal = torch.cat(
        [
            first,
            (2.0 * later * (later + alpha + 1.0) + alpha) / ((2.0 * later + alpha) * (2.0 * later + alpha + 2.0)),
        ],
        dim=-1,
    )
    beside = (
        later
        * (later + alpha)
        / ((2.0 * later + alpha) * torch.sqrt((2.0 * later + alpha + 1.0) * (2.0 * later + alpha - 1.0)))
    )
    matrix = torch.diag_embed(diagonal) - torch.diag_embed(beside, offset=1) - torch.diag_embed(beside, offset=-1)
    u, vectors = torch.linalg.eigh(matrix)
    return u, vectors[..., 0, :] ** 2 / (alpha + 1.0)


def sphere(degree: int, device: torch.device) -> tuple[Float[Tensor, "q 3"], Float[Tensor, " q"]]:
    """Unit directions and weights that integrate polynomials up to `degree` over the sphere exactly."""
    z, w = np.polynomial.legendre.leggauss(degree // 2 + 1)
    num_azimuths = degree + 1
    phi = 2.0 * np.pi * (np.arange(num_azimuths) + 0.5) / num_azimuths
    s = np.sqrt((1.0 - z) * (1.0 + z))
    directions = np.stack([np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones_like(phi))], axis=-1)
    weights = np.repeat(w, num_azimuths) * (2.0 * np.pi / num_azimuths)
    return torch.as_tensor(directions.reshape(-1, 3), device=device), torch.as_tensor(weights, device=device)
