"""Real spherical harmonics of any order: basis, projection, evaluation, rotation, product, layouts.

Pointwise: any leading axes. Coefficients are orthonormal with the Condon-Shortley sign, index l(l+1)+m,
`order` counts bands. Directions are unit vectors. Everything is polynomial in x, y, z, hence
differentiable everywhere, poles included. Checked to order 10.
"""

import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Inexact

from jaxrender.checks import check_last_axis, check_one_of, check_order
from jaxrender.sh_basis import basis_columns as basis_columns
from jaxrender.vecmath import constant_like, einsum, matmul

LAYOUTS = ("gaussian_splatting", "e3nn", "scipy", "positive")


def order_of(sh: Inexact[Array, "*b k"]) -> int:
    """Number of bands of a coefficient array, from its last axis; ValueError if that is not a square."""
    order = math.isqrt(sh.shape[-1])
    check_order(order, sh.shape[-1])
    return order


def bands(order: int) -> np.ndarray:
    """The band l of each coefficient: (0, 1, 1, 1, 2, ...), shape (order**2,)."""
    return np.repeat(np.arange(order), 2 * np.arange(order) + 1)


def sh_basis(directions: Float[Array, "*b 3"], *, order: int) -> Float[Array, "*b k"]:
    """Evaluates the first `order` bands at unit directions.

    Args:
      directions: unit vectors.
      order: number of bands, >= 1; k = order².
    Raises:
      ValueError: if order < 1, or a direction has not three components.
    References:
      Sloan, "Stupid Spherical Harmonics (SH) Tricks", 2008, appendix A2 (sign and normalisation).
    """
    check_last_axis("directions", directions, 3)
    check_order(order)
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return jnp.stack(basis_columns(x, y, z, order=order), axis=-1)


def sh_project(
    values: Float[Array, "*b n"], directions: Float[Array, "n 3"], weights: Float[Array, " n"], *, order: int
) -> Float[Array, "*b k"]:
    """Quadrature projection c_i = Σ_n w_n f(s_n) y_i(s_n).

    Args:
      values: f at the directions.
      weights: solid angle of each direction, in steradians (4π in all for the sphere).
    Raises:
      ValueError: if order < 1, or a direction has not three components.
    """
    return matmul(values, sh_basis(directions, order=order) * weights[:, None])


def sh_evaluate(sh: Float[Array, "*#b k"], directions: Float[Array, "*#b 3"]) -> Float[Array, "*b"]:
    """f(s) = Σ_i c_i y_i(s) at unit directions; leading axes broadcast, rank for rank.

    Raises:
      ValueError: if the number of coefficients is no square, or a direction has not three components.
    """
    return jnp.sum(sh * sh_basis(directions, order=order_of(sh)), axis=-1)


@functools.lru_cache
def rotation_table(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Fixed axes d_i and the matrix that writes coefficients as Σ_i c_{l,i} P_l-lobes along them.

    Band l of any function is spanned by 2l+1 generic translates of one zonal function (reference:
    Nowrouzezahrai, Simari, Fiume, "Sparse Zonal Harmonic Factorization", 2012). All bands share
    2·order-1 axes, so that rotating means to rotate the axes and to evaluate again.

    Returns:
      axes (2·order-1, 3) and analysis (2·order-1, order²): c_{l,i} = Σ_m analysis[i, lm] f_lm.
    """
    # A handful of seeded spirals over the half sphere; the best conditioned one is kept (3.5 for order 4, 12
    # for order 10). Antipodal axes span the same lobe, so only a half sphere is covered.
    rng = np.random.default_rng(0)
    spirals = [_spiral(2 * order - 1, rng) for _ in range(200 if order > 1 else 1)]
    blocks = [_band_blocks(axes, order) for axes in spirals]
    best = min(range(len(spirals)), key=lambda i: max(np.linalg.cond(block) for block in blocks[i]))
    return spirals[best], np.concatenate([np.linalg.pinv(block.T) for block in blocks[best]], axis=-1)


def _spiral(count: int, rng: np.random.Generator) -> np.ndarray:
    z = (np.arange(count) + rng.uniform(0.1, 0.9)) / count
    phi = np.arange(count) * math.pi * (3 - math.sqrt(5)) * rng.uniform(0.5, 1.5) + rng.uniform(0, 6.3)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def _band_blocks(axes: np.ndarray, order: int) -> list[np.ndarray]:
    """The basis at the axes, (n, 2l+1) for each band l."""
    basis = np.stack(basis_columns(*axes.T, order=order), axis=-1)
    return [basis[:, l * l : (l + 1) ** 2] for l in range(order)]


def sh_rotate(sh: Float[Array, "*#b k"], rotation: Float[Array, "*#b 3 3"]) -> Float[Array, "*b k"]:
    """Rotates a function: f'(s) = f(Rᵀ s), so that a lobe along d moves to R d.

    Exact for every order (up to rounding). Differentiable in both arguments; the rotation is used as it
    comes, so a matrix that is not orthonormal gives another polynomial, not an error.

    Args:
      rotation: rotation matrices, acting on column vectors.
    Raises:
      ValueError: if the number of coefficients is no square, or a matrix is not 3 x 3.
    """
    check_last_axis("rotation", rotation, 3)
    order = order_of(sh)
    if order <= _TENSOR_ORDER:
        return _rotate_as_tensors(sh, rotation, order=order)
    axes, analysis = rotation_table(order)
    turned = einsum("...ij,nj->...ni", rotation, jnp.asarray(axes, dtype=rotation.dtype))
    # Σ_i y_lm(R d_i) · Σ_m' analysis[i, lm'] f_lm', band by band.
    by_band = analysis[:, :, None] * np.eye(order)[bands(order)]
    lobes = einsum("...k,nkl->...nl", sh, jnp.asarray(by_band, dtype=sh.dtype))
    return jnp.sum(sh_basis(turned, order=order) * lobes[..., bands(order)], axis=-2)


# Up to this order every product of a rotation is written out, with all vertices as one array: 10k vectors of order 4
# take 0.5 instead of 6.5 ms on two cores. There are more than order⁴ products, and each one is compiled.
_TENSOR_ORDER = 4


@functools.lru_cache
def _tensor_tables(l: int) -> tuple[list[tuple[int, ...]], np.ndarray, np.ndarray]:
    """Band l as the symmetric traceless tensors of rank l, f(s) = Σ T_{ab...} s_a s_b ...

    Returns:
      the components a <= b <= ..., the matrix from 2l+1 coefficients to these components, and one that leads back.
    """
    components = list(itertools.combinations_with_replacement(range(3), l))
    powers = np.array([[component.count(axis) for axis in range(3)] for component in components])
    repeats = [math.factorial(l) / math.prod(math.factorial(n) for n in row) for row in powers]
    directions, _ = sphere_quadrature(2 * l)
    monomials = np.prod(directions[:, None, :] ** powers, axis=-1) * repeats
    y = np.stack(basis_columns(*directions.T, order=l + 1), axis=-1)[:, l * l :]
    # Monomials of one degree are independent on the sphere, so this system has one solution.
    from_band = np.linalg.lstsq(monomials, y, rcond=None)[0]
    from_band, to_band = (np.where(np.abs(t) < 1e-12, 0.0, t) for t in (from_band, np.linalg.pinv(from_band)))
    return components, from_band, to_band


def _rotate_as_tensors(sh, rotation, *, order: int):
    """Band by band, one index of the tensor after the other: T'_{ab...} = Σ R_ai R_bj ... T_{ij...}."""
    shape = jnp.broadcast_shapes(sh.shape[:-1], rotation.shape[:-2])
    rows = [[rotation[..., a, i] for i in range(3)] for a in range(3)]
    columns = [jnp.broadcast_to(sh[..., 0], shape)]
    for l in range(1, order):
        components, from_band, to_band = _tensor_tables(l)
        band = [sh[..., i] for i in range(l * l, (l + 1) ** 2)]
        # The key of a component: its indices already turned, and those still to turn, both ascending.
        tensor: dict[tuple[tuple[int, ...], tuple[int, ...]], Array] = {
            ((), old): x for old, x in zip(components, _combine(from_band, band), strict=True)
        }
        for _ in range(l):
            tensor = {
                ((*new, a), old): sum(rows[a][i] * tensor[new, tuple(sorted((*old, i)))] for i in range(3))
                for new, old in {(new, old[1:]): None for new, old in tensor}
                for a in range(new[-1] if new else 0, 3)
            }
        columns += _combine(to_band, [tensor[new, ()] for new in components])
    return jnp.moveaxis(jnp.stack(columns), 0, -1)


def _combine(matrix: np.ndarray, columns: list) -> list:
    """Matrix times a vector of arrays, without the products by 0."""
    return [sum(x * float(a) for a, x in zip(row, columns, strict=True) if a != 0) for row in matrix]


@functools.lru_cache
def sphere_quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre × uniform azimuth: directions (n, 3), weights (n,), exact up to `degree`."""
    z, wz = np.polynomial.legendre.leggauss(degree // 2 + 1)
    phi = np.arange(degree + 1) * (2 * math.pi / (degree + 1))
    r = np.sqrt(1 - z * z)[:, None]
    grid = np.broadcast_arrays(r * np.cos(phi), r * np.sin(phi), z[:, None])
    weights = np.repeat(wz * (2 * math.pi / (degree + 1)), degree + 1)
    return np.stack(grid, axis=-1).reshape(-1, 3), weights


def sh_product(
    a: Float[Array, "*#b ka"], b: Float[Array, "*#b kb"], *, order: int | None = None
) -> Float[Array, "*b k"]:
    """Coefficients of the pointwise product f·g, truncated to `order` bands.

    Both are evaluated on a quadrature that is exact for the degree in play, multiplied and projected
    back, which is the triple-product tensor C_ijk without storing it.

    Args:
      order: bands of the result; default: those of `a`. The whole product has order_a + order_b - 1.
    Raises:
      ValueError: if a number of coefficients is no square.
    """
    order_a, order_b = order_of(a), order_of(b)
    order = order_a if order is None else order
    directions, weights = sphere_quadrature(order_a + order_b + order - 3)
    table = np.stack(basis_columns(*directions.T, order=max(order_a, order_b, order)))
    y = jnp.asarray(table, dtype=a.dtype)
    product = matmul(a, y[: order_a**2]) * matmul(b, y[: order_b**2])
    return matmul(product * constant_like(weights, product), y[: order**2].T)


def sh_convolve_zonal(sh: Float[Array, "*#b k"], kernel: Float[Array, "*#b l"]) -> Float[Array, "*b k"]:
    """Convolution with a kernel that is circular about each direction: (k*f)_lm = √(4π/(2l+1)) k_l f_lm.

    Raises:
      ValueError: if the number of coefficients is no square, or the kernel has another number of bands.
    """
    order = order_of(sh)
    check_last_axis("kernel", kernel, order)
    factors = np.sqrt(4 * math.pi / (2 * np.arange(order) + 1))
    return sh * (kernel * constant_like(factors, kernel))[..., bands(order)]


def _sign_of_m(order: int) -> np.ndarray:
    m = np.concatenate([np.arange(-l, l + 1) for l in range(order)])
    return np.where(m % 2, -1.0, 1.0)


@functools.lru_cache
def _e3nn_table(order: int) -> np.ndarray:
    """The orthogonal matrix from our coefficients to those of e3nn, ∫ y'_i y_j, by exact quadrature.

    e3nn measures the polar angle from +y: its basis at (x, y, z) is the all-positive one at (z, x, y).
    """
    directions, weights = sphere_quadrature(2 * order - 2)
    ours = np.stack(basis_columns(*directions.T, order=order), axis=-1)
    theirs = np.stack(basis_columns(*np.roll(directions, 1, axis=1).T, order=order), axis=-1)
    table = _sign_of_m(order)[:, None] * (theirs.T @ (weights[:, None] * ours))
    return np.where(np.abs(table) < 1e-12, 0.0, table)


def sh_to_layout(sh: Float[Array, "*b k"], layout: str) -> Float[Array, "*b k"] | Complex[Array, "*b k"]:
    """Rewrites coefficients for another library, so that they mean the same function there.

    Args:
      layout: `gaussian_splatting` (3D Gaussian Splatting, gsplat: the same as ours), `positive` (the table
        without the sign (-1)^m), `e3nn` (`spherical_harmonics(..., normalization="integral")`, whose polar
        axis is y) or `scipy` (complex coefficients of `scipy.special.sph_harm_y`, index l(l+1)+m).
    Raises:
      ValueError: if the number of coefficients is no square, or the layout is not one of these.
    """
    check_one_of("layout", layout, LAYOUTS)
    order = order_of(sh)
    if layout == "gaussian_splatting":
        return sh
    if layout == "positive":
        return sh * constant_like(_sign_of_m(order), sh)
    if layout == "e3nn":
        return _times(sh, _e3nn_table(order).T)
    real, imaginary = _complex_tables(order)
    return jax.lax.complex(_times(sh, real), _times(sh, imaginary))


def sh_from_layout(sh: Float[Array, "*b k"] | Complex[Array, "*b k"], layout: str) -> Float[Array, "*b k"]:
    """The inverse of `sh_to_layout`. From `scipy` the function is taken to be real.

    Raises:
      ValueError: if the number of coefficients is no square, or the layout is unknown.
    """
    check_one_of("layout", layout, LAYOUTS)
    order = order_of(sh)
    if layout == "gaussian_splatting":
        return sh
    if layout == "positive":
        return sh * constant_like(_sign_of_m(order), sh)
    if layout == "e3nn":
        return _times(sh, _e3nn_table(order))
    real, imaginary = _complex_tables(order)
    return _times(jnp.real(sh), real.T) + _times(jnp.imag(sh), imaginary.T)


def _times(sh: Float[Array, "*b k"], table: np.ndarray) -> Float[Array, "*b k"]:
    return matmul(sh, jnp.asarray(table, dtype=sh.dtype))


def _complex_tables(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Real and imaginary part of the unitary matrix from real to complex coefficients.

    y_{l,m} = √2 Re Y_l^m and y_{l,-m} = √2 Im Y_l^m for m > 0, with Y_l^{-m} = (-1)^m conj(Y_l^m).
    """
    real, imaginary = np.zeros((2, order**2, order**2))
    for l in range(order):
        centre = l * (l + 1)
        real[centre, centre] = 1.0
        for m in range(1, l + 1):
            plus, minus, sign = centre + m, centre - m, (-1.0) ** m
            real[plus, plus], real[plus, minus] = math.sqrt(0.5), sign * math.sqrt(0.5)
            imaginary[minus, plus], imaginary[minus, minus] = -math.sqrt(0.5), sign * math.sqrt(0.5)
    return real, imaginary
