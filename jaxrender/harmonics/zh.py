"""Zonal harmonics: functions that are circular about an axis, one coefficient per band.

Pointwise: any leading axes. A lobe is f(s) = Σ_l z_l √((2l+1)/4π) P_l(d·s) with unit axis d. The lobe with
axis -d and coefficients (-1)^l z_l is the same function. Differentiable in all arrays.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.checks import check_last_axis, check_order
from jaxrender.harmonics.sh import bands, basis_columns, sh_basis
from jaxrender.vecmath import constant_like


def zh_to_sh(coefficients: Float[Array, "*#b l"], axis: Float[Array, "*#b 3"]) -> Float[Array, "*b k"]:
    """Coefficients of a lobe turned to a unit axis: v_lm = √(4π/(2l+1)) z_l y_lm(d).

    Raises:
      ValueError: if an axis has not three components.
    References:
      Sloan, Luna, Snyder, "Local, Deformable Precomputed Radiance Transfer", 2005; Nowrouzezahrai et al.,
      "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", eq. 1 for one lobe.
    """
    check_last_axis("axis", axis, 3)
    order = coefficients.shape[-1]
    factors = constant_like(np.sqrt(4 * math.pi / (2 * np.arange(order) + 1)), coefficients)
    return (coefficients * factors)[..., bands(order)] * sh_basis(axis, order=order)


def lobes_to_sh(coefficients: Float[Array, "*#b c l"], axes: Float[Array, "*#b c 3"]) -> Float[Array, "*b k"]:
    """Sum of c lobes as SH coefficients (Shadowed Relighting, eq. 1, with c lobes, not c+1).

    Raises:
      ValueError: if an axis has not three components.
    """
    check_last_axis("axes", axes, 3)
    order = coefficients.shape[-1]
    factors = constant_like(np.sqrt(4 * math.pi / (2 * np.arange(order) + 1)), coefficients)
    scaled = coefficients * factors
    columns: list = []
    # Lobe by lobe and column by column: `zh_to_sh` would hold c vectors for each sum.
    for lobe in range(axes.shape[-2]):
        basis = basis_columns(*(axes[..., lobe, i] for i in range(3)), order=order)
        part = [scaled[..., lobe, l] * y for l, y in zip(bands(order), basis, strict=True)]
        columns = [a + b for a, b in zip(columns, part, strict=True)] if columns else part
    return jnp.moveaxis(jnp.stack(columns), 0, -1)


def legendre(x: Float[Array, "*b"], *, order: int) -> Float[Array, "*b l"]:
    """P_0 .. P_{order-1} at x, by Bonnet's recurrence."""
    values = [jnp.ones_like(x), x]
    for l in range(1, order - 1):
        values.append(((2 * l + 1) * x * values[l] - l * values[l - 1]) / (l + 1))
    return jnp.stack(values[:order], axis=-1)


def zh_evaluate(
    coefficients: Float[Array, "*#b l"], axis: Float[Array, "*#b 3"], directions: Float[Array, "*#b 3"]
) -> Float[Array, "*b"]:
    """The lobe's value f(s) = Σ_l z_l √((2l+1)/4π) P_l(d·s) at unit directions."""
    order = coefficients.shape[-1]
    factors = constant_like(np.sqrt((2 * np.arange(order) + 1) / (4 * math.pi)), coefficients)
    cosine = jnp.sum(axis * directions, axis=-1)
    return jnp.sum(coefficients * factors * legendre(cosine, order=order), axis=-1)


def _moments_on_hemisphere(power: int, order: int) -> np.ndarray:
    """z_l = 2π ∫_0^1 x^power √((2l+1)/4π) P_l(x) dx, exact by Gauss-Legendre on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(order + power)
    x, w = 0.5 * (nodes + 1.0), 0.5 * weights
    p = np.stack([np.polynomial.legendre.Legendre.basis(l)(x) for l in range(order)])
    return 2 * math.pi * np.sqrt((2 * np.arange(order) + 1) / (4 * math.pi)) * (p @ (w * x**power))


def clamped_cosine_zh(*, order: int) -> Float[Array, " l"]:
    """Zonal coefficients of max(0, cos θ).

    Raises:
      ValueError: if order < 1.
    """
    check_order(order)
    return jnp.asarray(_moments_on_hemisphere(1, order), dtype=float)


def hemisphere_zh(*, order: int) -> Float[Array, " l"]:
    """Zonal coefficients of the upper hemisphere's indicator: the visibility of an unoccluded point.

    Raises:
      ValueError: if order < 1.
    """
    check_order(order)
    return jnp.asarray(_moments_on_hemisphere(0, order), dtype=float)


def phong_zh(exponent: Float[Array, "*b"], *, order: int) -> Float[Array, "*b l"]:
    """Zonal coefficients of the normalised Phong lobe (α+1)/2π max(0, cos θ)^α, for real α >= 0.

    z_l = √((2l+1)/4π) ρ_l with ρ_l = (α+1) ∫_0^1 x^α P_l(x) dx, a product of ratios of modulus below 1:
    accurate in float32 at any exponent, and smooth in it.

    Raises:
      ValueError: if order < 1.
    References:
      Ramamoorthi, Hanrahan, "Frequency Space Environment Map Rendering", 2002.
    """
    check_order(order)
    moments = [jnp.ones_like(exponent), (exponent + 1.0) / (exponent + 2.0)]
    for l in range(2, order):
        moments.append(moments[l - 2] * (exponent - (l - 2.0)) / (exponent + (l + 1.0)))
    factors = np.sqrt((2 * np.arange(order) + 1) / (4 * math.pi))
    rho = jnp.stack(moments[:order], axis=-1)
    return rho * constant_like(factors, rho)
