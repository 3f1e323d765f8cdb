"""One-dimensional BRDF kernels as operators on SH coefficients, in the frame whose z axis is the lobe's.

The operator of f(cos θ) has the entries M[lm, l'm'] = ∫ over the upper hemisphere of f y_lm y_l'm'. They
vanish unless m = m', and y_lm = √2 cos(mφ) or sin(mφ) times a normalized Legendre function N_l^m(cos θ)
leaves M = 2π ∫_0^1 f(x) N_l^m(x) N_l'^m(x) dx.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchref import _quadrature
from torchref._precision import in_float64
from torchref.harmonics.sh import sh_basis


@in_float64
def phong_operator(exponent: Float[Tensor, "*b"], *, order: int = 4) -> Float[Tensor, "*b k k"]:
    """M^α for the kernel cos^α θ, without the factor (α+1)/2π of `phong_normalization`; any real α > -1.

    The rest of the integrand is a polynomial of degree <= 2·order - 2, so `order` nodes under the weight x^α
    are exact.

    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", eq. 2.
    """
    u, weights = _quadrature.gauss_jacobi(exponent, order)
    return _operator(u, weights, order)


@in_float64
def phong_normalization(exponent: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """(α+1)/2π, the factor that makes the lobe integrate to 1."""
    return (exponent + 1.0) / (2.0 * math.pi)


@in_float64
def brdf_operator(
    kernel: Callable[[Float[Tensor, " n"]], Float[Tensor, " n"]], *, order: int = 4, num_nodes: int = 64
) -> Float[Tensor, "k k"]:
    """The operator of any kernel f(cos θ), by Gauss-Legendre quadrature on cos θ in [0, 1].

    Args:
      kernel: called once with `num_nodes` float64 cosines.
    """
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    x, weights = _quadrature.gauss_legendre(num_nodes, ends[0], ends[1])
    return _operator(1.0 - x, weights * kernel(x), order)


@in_float64
def apply_operator(operator: Float[Tensor, "*#b k k"], sh: Float[Tensor, "*#b k"]) -> Float[Tensor, "*b k"]:
    """The matrix-vector product M v."""
    return torch.einsum("...ij,...j->...i", operator, sh)


def _operator(u: Float[Tensor, "*b q"], weights: Float[Tensor, "*b q"], order: int) -> Float[Tensor, "*b k k"]:
    """2π Σ_q w_q N_l^m(1-u_q) N_l'^m(1-u_q) on each block of equal m."""
    # At azimuth 0 only cosines are left: y_l0 = N_l^0, y_lm = √2 N_l^m. sin θ comes from u = 1 - cos θ
    # unrounded.
    along_x = torch.stack([torch.sqrt(u * (2.0 - u)), torch.zeros_like(u), 1.0 - u], dim=-1)
    y = sh_basis(along_x, order=order)
    moments = 2.0 * math.pi * torch.einsum("...q,...qi,...qj->...ij", weights, y, y)
    operator = torch.zeros_like(moments)
    for l in range(order):
        for k in range(order):
            for m in range(-min(l, k), min(l, k) + 1):
                mu, both = abs(m), 1.0 if m == 0 else 0.5
                entry = both * moments[..., l * (l + 1) + mu, k * (k + 1) + mu]
                operator[..., l * (l + 1) + m, k * (k + 1) + m] = entry
    return operator
