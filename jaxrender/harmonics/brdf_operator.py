"""A 1D BRDF as a linear operator on SH coefficients, in the frame whose z is the lobe's axis.

The operator of a kernel f(cos θ) on the upper hemisphere H² is M[i, j] = ∫_{H²} f(cos θ) y_i y_j ds. It
multiplies a function by the clamped lobe and projects, exactly: it is not the truncated product of two SH
vectors. M is symmetric and couples only coefficients of equal m, so it commutes with rotations about z.
Pointwise: any leading axes of exponents. Differentiable in all arrays.
"""

import functools
import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special

from jaxrender.checks import check_at_least, check_order
from jaxrender.vecmath import constant_like, einsum, matmul


def _degree_and_abs_m(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """l, m and |m| of each coefficient."""
    l = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    m = np.arange(order**2) - l * (l + 1)
    return l, m, np.abs(m)


def _legendre_part(order: int, mu: int, x: np.ndarray) -> np.ndarray:
    """Q_l^mu(x) for l = mu..order-1, where y_{l,mu} has modulus Q (1-x²)^{mu/2} times 1 or √2 cos(mu φ)."""
    diagonal = math.prod((2 * i + 1) / (2 * i) for i in range(1, mu + 1)) / (4 * math.pi)
    q, previous = [np.full_like(x, math.sqrt(diagonal))], np.zeros_like(x)
    for l in range(mu + 1, order):
        a = math.sqrt((4 * l * l - 1) / (l * l - mu * mu))
        b = math.sqrt(((l - 1) ** 2 - mu * mu) / (4 * (l - 1) ** 2 - 1))
        previous, new = q[-1], a * (x * q[-1] - b * previous)
        q.append(new)
    return np.stack(q)


@functools.lru_cache
def _linearisation(order: int) -> np.ndarray:
    """g[mu, n, i, j]: 2π Q_l Q_l' = Σ_n g G_n^mu(x).

    G_n^mu is the Gegenbauer polynomial of index mu + 1/2 with G(1) = 1. The products of two of them have
    non-negative coefficients in the same family, so the sum below does not cancel where the operator is small
    (large α): float32 keeps its relative accuracy.
    """
    _, m, abs_m = _degree_and_abs_m(order)
    table = np.zeros((order, 2 * order - 1, order**2, order**2))
    for mu in range(order):
        lam = mu + 0.5
        x, w = special.roots_gegenbauer(2 * order, lam)
        n = np.arange(2 * order - 1)[:, None]
        g = special.eval_gegenbauer(n, lam, x) / special.eval_gegenbauer(n, lam, 1.0)
        q = _legendre_part(order, mu, x)
        product = 2 * math.pi * np.einsum("ax,bx,nx,x->nab", q, q, g, w) / (g * g @ w)[:, None, None]
        product[np.abs(product) < 1e-13] = 0.0
        for sign in {mu, -mu}:
            index = np.flatnonzero(m == sign)
            assert (abs_m[index] == mu).all()
            table[mu][:, index[:, None], index[None, :]] = product
    return table


def _phong_moments(exponent: Float[Array, "*b"], *, order: int) -> list:
    """I_n^mu = ∫_0^1 x^α (1-x²)^mu G_n^mu(x) dx as a list over n of (..., mu) arrays.

    I_0 = ½ B((α+1)/2, mu+1), I_1 = ½ B((α+2)/2, mu+1), and I_{n+2} = I_n (α-n)/(α+n+2mu+3): the numerator
    vanishes where x^α is itself of lower degree and equal parity (orthogonality), the denominator holds the
    poles. Only ratios below 1 are multiplied, so nothing overflows and each moment has a relative error of a
    few roundings.
    """
    a = jnp.repeat(exponent[..., None], order, axis=-1)
    mu = constant_like(np.arange(order), a)
    moments = []
    for parity in (0.0, 1.0):
        beta = 1.0 / (a + (1.0 + parity))
        for i in range(1, order):
            beta = beta * jnp.where(mu >= i, 2.0 * i / (a + (1.0 + parity + 2 * i)), jnp.ones_like(a))
        moments.append(beta)
    for n in range(2 * order - 3):
        moments.append(moments[n] * (a - float(n)) / (a + 2.0 * mu + (n + 3.0)))
    return moments[: 2 * order - 1]


def phong_operator(exponent: Float[Array, "*b"], *, order: int = 4) -> Float[Array, "*b k k"]:
    """M^α[lm, l'm'] = ∫_{H²} cos^α θ y_lm y_l'm' ds, without the factor (α+1)/2π of `phong_normalization`.

    Exact for every real α >= 0 (and down to α > -1), smooth and differentiable in α. In float32 each entry
    is within 1e-6 of its own magnitude up to order 10; nothing overflows, and entries below 1e-36 (|m| >= 8 at α
    of some 1e5) fade to 0.

    Args:
      exponent: α, any leading axes (one per vertex, say).
      order: number of bands, k = order².
    Raises:
      ValueError: if order < 1.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", eq. 2 and appendix A, in
      the closed form for any order; the appendix' list has two errors and a gap (docs/paper.md).
    """
    check_order(order)
    exponent = jnp.asarray(exponent)
    moments = jnp.stack(_phong_moments(exponent, order=order), axis=-1)
    table = jnp.asarray(_linearisation(order), dtype=moments.dtype)
    return einsum("...mn,mnij->...ij", moments, table)


def phong_normalization(exponent: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """(α+1)/2π, which makes the lobe cos^α integrate to 1 over the hemisphere; 1/π is Lambert's (α = 1)."""
    return (exponent + 1.0) * (1.0 / (2.0 * math.pi))


def brdf_operator(
    kernel: Callable[[Float[Array, " n"]], Float[Array, " n"]], *, order: int = 4, num_nodes: int = 64
) -> Float[Array, "k k"]:
    """The same operator for any kernel f(cos θ), by Gauss-Legendre quadrature in cos θ on [0, 1].

    Exact when f is a polynomial of degree <= 2·num_nodes - 2·order + 1; for a sharp lobe take more nodes.
    Differentiable in whatever the kernel closes over.

    Args:
      kernel: vectorised f, called once with `num_nodes` cosines in (0, 1).
    Raises:
      ValueError: if order < 1 or num_nodes < order.
    """
    check_order(order)
    check_at_least("num_nodes", num_nodes, order)
    nodes, weights = np.polynomial.legendre.leggauss(num_nodes)
    x, w = 0.5 * (nodes + 1.0), 0.5 * weights
    values = kernel(jnp.asarray(x, dtype=float))
    _, m, _ = _degree_and_abs_m(order)
    table = np.zeros((order**2, order**2, num_nodes))
    for mu in range(order):
        q = _legendre_part(order, mu, x)
        product = 2 * math.pi * w * (1 - x * x) ** mu * q[:, None] * q[None, :]
        for sign in {mu, -mu}:
            index = np.flatnonzero(m == sign)
            table[index[:, None], index[None, :]] = product
    return matmul(jnp.asarray(table, dtype=values.dtype), values)


def apply_operator(operator: Float[Array, "*#b k k"], sh: Float[Array, "*#b k"]) -> Float[Array, "*b k"]:
    """M v along the last axes; leading axes broadcast, rank for rank."""
    return einsum("...ij,...j->...i", operator, sh)
