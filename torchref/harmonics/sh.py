"""Real spherical harmonics of any order: evaluation, projection, rotation, product, other layouts.

Pointwise: any leading axes. Axis names: `k` = order² coefficients, index l(l+1)+m; `l` = one number per band.
"""

import functools
import math

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchref import _quadrature
from torchref._precision import in_float64

LAYOUTS = ("gaussian_splatting", "e3nn", "scipy", "positive")


@in_float64
def sh_basis(directions: Float[Tensor, "*b 3"], *, order: int) -> Float[Tensor, "*b k"]:
    """y_lm at unit directions.

    Each is the homogeneous polynomial of degree l (so that none of its terms cancels badly at any order)

        Y_l^m = √((2l+1)/4π (l+m)! (l-m)!) Σ_{p+q+s=l, p-q=m} (-(x+iy)/2)^p ((x-iy)/2)^q z^s / (p! q! s!),

    from which y_l0 = Y_l^0, y_lm = √2 Re Y_l^m and y_l-m = √2 Im Y_l^m for m > 0.

    References:
      Varshalovich, Moskalev, Khersonskii, "Quantum Theory of Angular Momentum", sec. 5.1; real basis of
      Sloan, "Stupid Spherical Harmonics (SH) Tricks", 2008, appendix A2.
    """
    x, y, z = directions.unbind(-1)
    powers = [(torch.ones_like(x), torch.zeros_like(x))]  # real and imaginary part of (x + iy)^m
    for _ in range(1, order):
        re, im = powers[-1]
        powers.append((x * re - y * im, x * im + y * re))
    columns = [_real_harmonic(l, m, powers, x * x + y * y, z) for l in range(order) for m in range(-l, l + 1)]
    return torch.stack(columns, dim=-1)


def _real_harmonic(l: int, m: int, powers: list, rho2: Tensor, z: Tensor) -> Tensor:
    mu = abs(m)
    norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l + mu) * math.factorial(l - mu))
    polar = torch.zeros_like(z)
    for q in range((l - mu) // 2 + 1):
        p, s = q + mu, l - mu - 2 * q
        below = math.factorial(p) * math.factorial(q) * math.factorial(s) * 2 ** (p + q)
        polar = polar + (-1) ** p / below * rho2**q * z**s
    re, im = powers[mu]
    return norm * polar * (re if m == 0 else math.sqrt(2.0) * (re if m > 0 else im))


@in_float64
def sh_project(
    values: Float[Tensor, "*b n"],
    directions: Float[Tensor, "n 3"],
    weights: Float[Tensor, " n"],
    *,
    order: int,
) -> Float[Tensor, "*b k"]:
    """c_i = Σ_n w_n f(s_n) y_i(s_n): the integral of f·y_i by the given quadrature."""
    return torch.einsum("...n,n,nk->...k", values, weights, sh_basis(directions, order=order))


@in_float64
def sh_evaluate(sh: Float[Tensor, "*#b k"], directions: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b"]:
    """f(s) = Σ_i c_i y_i(s) at unit directions; leading axes broadcast."""
    return (sh * sh_basis(directions, order=_order(sh))).sum(-1)


@in_float64
def sh_rotate(sh: Float[Tensor, "*#b k"], rotation: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*b k"]:
    """Coefficients of f'(s) = f(Rᵀ s): a lobe along d moves to R d.

    f' is sampled on a quadrature that is exact for its products with the basis, and projected.
    """
    order = _order(sh)
    nodes, weights = _quadrature.sphere(2 * (order - 1), sh.device)
    came_from = torch.einsum("qi,...ij->...qj", nodes, rotation)  # Rᵀ s for each node s
    return sh_project(sh_evaluate(sh[..., None, :], came_from), nodes, weights, order=order)


@in_float64
def sh_product(
    a: Float[Tensor, "*#b ka"], b: Float[Tensor, "*#b kb"], *, order: int | None = None
) -> Float[Tensor, "*b k"]:
    """Coefficients Σ_ij C_ijk a_i b_j of the product, for the first `order` bands (default: those of a)."""
    order = _order(a) if order is None else order
    triple = torch.as_tensor(triple_product_tensor(_order(a), _order(b), order), device=a.device)
    return torch.einsum("ijk,...i,...j->...k", triple, a, b)


@functools.lru_cache(maxsize=16)
def triple_product_tensor(order_a: int, order_b: int, order_out: int) -> np.ndarray:
    """C_ijk = ∫ y_i y_j y_k from Gaunt's integral of three complex harmonics, turned to the real basis."""
    triple = np.zeros((order_a**2, order_b**2, order_out**2))
    for la in range(order_a):
        for lb in range(order_b):
            for lc in range(abs(la - lb), min(la + lb + 1, order_out)):
                if (la + lb + lc) % 2 == 0:
                    block = np.einsum(
                        "am,bn,co,mno->abc", _real_from_complex(la), _real_from_complex(lb),
                        _real_from_complex(lc), _gaunt_block(la, lb, lc),
                    )  # fmt: skip
                    triple[la**2 : (la + 1) ** 2, lb**2 : (lb + 1) ** 2, lc**2 : (lc + 1) ** 2] = block.real
    return triple


def _gaunt_block(la: int, lb: int, lc: int) -> np.ndarray:
    """∫ Y_la^m Y_lb^n Y_lc^o for all m, n, o."""
    block = np.zeros((2 * la + 1, 2 * lb + 1, 2 * lc + 1))
    scale = math.sqrt((2 * la + 1) * (2 * lb + 1) * (2 * lc + 1) / (4 * math.pi)) * _wigner_3j(la, lb, lc, 0, 0)
    for m in range(-la, la + 1):
        for n in range(max(-lb, -lc - m), min(lb, lc - m) + 1):
            block[la + m, lb + n, lc - m - n] = scale * _wigner_3j(la, lb, lc, m, n)
    return block


def _wigner_3j(la: int, lb: int, lc: int, m: int, n: int) -> float:
    """The 3j symbol (la lb lc; m n -m-n) by Racah's formula, whose alternating sum is exact in integers."""
    f, o = math.factorial, -m - n
    low, high = max(0, lb - lc - m, la - lc + n), min(la + lb - lc, la - m, lb + n)
    below = [
        f(t) * f(lc - lb + t + m) * f(lc - la + t - n) * f(la + lb - lc - t) * f(la - t - m) * f(lb - t + n)
        for t in range(low, high + 1)
    ]
    common = math.lcm(*below)
    total = sum((-1) ** t * (common // b) for t, b in enumerate(below, start=low))
    triangle = f(la + lb - lc) * f(la - lb + lc) * f(-la + lb + lc) / f(la + lb + lc + 1)
    states = f(la + m) * f(la - m) * f(lb + n) * f(lb - n) * f(lc + o) * f(lc - o)
    return (-1) ** (la - lb - o) * math.sqrt(triangle * states) * (total / common)


def _real_from_complex(l: int) -> np.ndarray:
    """The unitary matrix U with y_l = U Y_l, rows and columns m = -l .. l."""
    u = np.zeros((2 * l + 1, 2 * l + 1), dtype=complex)
    u[l, l] = 1.0
    for m in range(1, l + 1):
        u[l + m, l + m], u[l + m, l - m] = math.sqrt(0.5), (-1) ** m * math.sqrt(0.5)
        u[l - m, l + m], u[l - m, l - m] = -1j * math.sqrt(0.5), 1j * (-1) ** m * math.sqrt(0.5)
    return u


@in_float64
def sh_convolve_zonal(sh: Float[Tensor, "*#b k"], kernel: Float[Tensor, "*#b l"]) -> Float[Tensor, "*b k"]:
    """(k * f)_lm = √(4π/(2l+1)) k_l f_lm: f convolved with a zonal kernel."""
    order = _order(sh)
    parts = [
        math.sqrt(4.0 * math.pi / (2 * l + 1)) * kernel[..., l : l + 1] * sh[..., l * l : (l + 1) ** 2]
        for l in range(order)
    ]
    return torch.cat(parts, dim=-1)


@in_float64
def sh_to_layout(sh: Float[Tensor, "*b k"], layout: str) -> Float[Tensor, "*b k"] | Complex[Tensor, "*b k"]:
    """The same function in the basis of another library.

    Args:
      layout: "gaussian_splatting" (3D Gaussian Splatting: ours), "positive" (no factor (-1)^m), "e3nn"
        (normalization="integral": the positive table in coordinates whose polar axis is y), "scipy" (complex,
        for `scipy.special.sph_harm_y`).
    """
    if layout == "gaussian_splatting":
        return sh
    if layout == "positive":
        return sh * _sign(sh)
    if layout == "e3nn":
        return _sign(sh) * sh_rotate(sh, _polar_y(sh))
    if layout == "scipy":
        return _per_band(lambda c, u: torch.einsum("...i,im->...m", c.to(u.dtype), u), sh)
    raise ValueError(f"layout: expected one of {', '.join(LAYOUTS)}, got {layout}")


@in_float64
def sh_from_layout(sh: Float[Tensor, "*b k"] | Complex[Tensor, "*b k"], layout: str) -> Float[Tensor, "*b k"]:
    """The inverse of `sh_to_layout`; complex coefficients are taken to be those of a real function."""
    if layout == "gaussian_splatting":
        return sh
    if layout == "positive":
        return sh * _sign(sh)
    if layout == "e3nn":
        return sh_rotate(sh * _sign(sh), _polar_y(sh).T)
    if layout == "scipy":
        return _per_band(lambda c, u: torch.einsum("...m,im->...i", c, u.conj()).real, sh)
    raise ValueError(f"layout: expected one of {', '.join(LAYOUTS)}, got {layout}")


def _order(sh: Tensor) -> int:
    order = math.isqrt(sh.shape[-1])
    if order < 1 or order**2 != sh.shape[-1]:
        raise ValueError(f"sh: expected a square number of coefficients, got {sh.shape[-1]}")
    return order


def _sign(sh: Tensor) -> Tensor:
    """(-1)^m for each coefficient."""
    signs = [(-1.0) ** m for l in range(_order(sh)) for m in range(-l, l + 1)]
    return torch.tensor(signs, dtype=torch.float64, device=sh.device)


def _polar_y(sh: Tensor) -> Tensor:
    """The rotation (x, y, z) -> (z, x, y), which takes the y axis to the z axis."""
    return torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64, device=sh.device)


def _per_band(apply, sh: Tensor) -> Tensor:
    bands = [
        apply(sh[..., l * l : (l + 1) ** 2], torch.as_tensor(_real_from_complex(l), device=sh.device))
        for l in range(_order(sh))
    ]
    return torch.cat(bands, dim=-1)
