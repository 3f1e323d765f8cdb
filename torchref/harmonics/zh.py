"""Zonal harmonics: lobes that are round about an axis, one coefficient z_l per band.

Pointwise: any leading axes. A lobe about the unit axis d is f(s) = Σ_l z_l √((2l+1)/4π) P_l(d·s).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchref import _quadrature
from torchref._precision import in_float64
from torchref.harmonics.sh import sh_basis


@in_float64
def zh_to_sh(coefficients: Float[Tensor, "*#b l"], axis: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b k"]:
    """v_lm = √(4π/(2l+1)) z_l y_lm(d).

    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", eq. 1, one lobe.
    """
    order = coefficients.shape[-1]
    y = sh_basis(axis, order=order)
    bands = [
        math.sqrt(4.0 * math.pi / (2 * l + 1)) * coefficients[..., l : l + 1] * y[..., l * l : (l + 1) ** 2]
        for l in range(order)
    ]
    return torch.cat(bands, dim=-1)


@in_float64
def lobes_to_sh(coefficients: Float[Tensor, "*#b c l"], axes: Float[Tensor, "*#b c 3"]) -> Float[Tensor, "*b k"]:
    """The sum of c lobes; eq. 1 of the same paper, with x running over c lobes and not c + 1 as printed."""
    return zh_to_sh(coefficients, axes).sum(-2)


@in_float64
def legendre(x: Float[Tensor, "*b"], *, order: int) -> Float[Tensor, "*b l"]:
    """P_0 .. P_{order-1} at x: P_l(x) = 2^-l Σ_k C(l,k)² (x-1)^(l-k) (x+1)^k."""
    columns = [
        torch.zeros_like(x)
        + sum(math.comb(l, k) ** 2 * (x - 1.0) ** (l - k) * (x + 1.0) ** k for k in range(l + 1)) / 2.0**l
        for l in range(order)
    ]
    return torch.stack(columns, dim=-1)


@in_float64
def zh_evaluate(
    coefficients: Float[Tensor, "*#b l"], axis: Float[Tensor, "*#b 3"], directions: Float[Tensor, "*#b 3"]
) -> Float[Tensor, "*b"]:
    """The lobe at unit directions: Σ_l z_l √((2l+1)/4π) P_l(d·s)."""
    order = coefficients.shape[-1]
    p = legendre((axis * directions).sum(-1), order=order)
    return (coefficients * _band_scale(order, p.device) * p).sum(-1)


def zonal_integral(
    nodes: Float[Tensor, "*b q"], weights: Float[Tensor, "*b q"], *, order: int
) -> Float[Tensor, "*b l"]:
    """z_l = 2π Σ_q w_q √((2l+1)/4π) P_l(x_q): the ZH of a function of x = cos θ that the weights carry."""
    p = legendre(nodes, order=order) * _band_scale(order, nodes.device)
    return 2.0 * math.pi * torch.einsum("...q,...ql->...l", weights, p)


@in_float64
def clamped_cosine_zh(*, order: int) -> Float[Tensor, " l"]:
    """z_l of max(0, cos θ), by Gauss-Legendre quadrature on [0, 1], which is exact here."""
    x, w = _upper_half(order + 1)
    return zonal_integral(x, w * x, order=order)


@in_float64
def hemisphere_zh(*, order: int) -> Float[Tensor, " l"]:
    """z_l of the indicator of the upper hemisphere: the visibility of a vertex that nothing shadows."""
    x, w = _upper_half(order + 1)
    return zonal_integral(x, w, order=order)


@in_float64
def phong_zh(exponent: Float[Tensor, "*b"], *, order: int) -> Float[Tensor, "*b l"]:
    """z_l of the normalized Phong lobe (α+1)/2π max(0, cos θ)^α, by quadrature under the weight x^α."""
    u, w = _quadrature.gauss_jacobi(exponent, order)
    return (exponent[..., None] + 1.0) / (2.0 * math.pi) * zonal_integral(1.0 - u, w, order=order)


def _upper_half(num_nodes: int) -> tuple[Tensor, Tensor]:
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    return _quadrature.gauss_legendre(num_nodes, ends[0], ends[1])


def _band_scale(order: int, device: torch.device) -> Float[Tensor, " l"]:
    scales = [math.sqrt((2 * l + 1) / (4.0 * math.pi)) for l in range(order)]
    return torch.tensor(scales, dtype=torch.float64, device=device)
