"""Run-time shading: lobes, light, view and BRDF to vertex colors (steps 2 to 5; step 1 is the pose model's).

Pointwise over vertices, with any leading axes "*v". Light is one SH vector per color channel in world axes and is
shared by all vertices. Everything is linear in light and albedo, and differentiable in all float arguments.
Colors are not clamped: order-4 light rings, and a strongly directional one may leave small negative values.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.checks import check_last_axis
from jaxrender.harmonics.brdf_operator import apply_operator, phong_normalization, phong_operator
from jaxrender.harmonics.membrane import back_lobe
from jaxrender.harmonics.sh import bands, basis_columns, order_of, sh_rotate, sphere_quadrature
from jaxrender.harmonics.zh import lobes_to_sh, phong_zh, zh_to_sh
from jaxrender.vecmath import constant_like, dot, einsum, matmul, normalize


def rotate_lobes(axes: Float[Array, "*v c 3"], rotation: Float[Array, "*v 3 3"]) -> Float[Array, "*v c 3"]:
    """Step 2: turns the axes of each vertex's lobes by its rotation."""
    return einsum("...ij,...cj->...ci", rotation, axes)


def phong_transfer(visibility: Float[Array, "*v k"], exponent: Float[Array, "*#v"]) -> Float[Array, "*v k"]:
    """Step 4: t = (α+1)/2π M^α v, for visibility in the frame whose z is the lobe's axis.

    Args:
      exponent: α >= 0, a scalar or one per vertex.
    Raises:
      ValueError: if the number of coefficients is no square.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", eq. 2.
    """
    exponent = jnp.asarray(exponent, dtype=visibility.dtype)
    operator = phong_operator(exponent, order=order_of(visibility))
    operator = phong_normalization(exponent)[..., None, None] * operator
    if exponent.ndim == 0:
        return matmul(visibility, operator)
    return apply_operator(operator, visibility)


def shade_transfer(
    transfer: Float[Array, "*v k"],
    world_from_local: Float[Array, "*v 3 3"],
    light: Float[Array, "c k"],
    albedo: Float[Array, "*v c"],
) -> Float[Array, "*v c"]:
    """Step 5: albedo times the inner product of transfer and light, both in one frame.

    The light would have to be turned into each vertex's frame, once per channel; the one transfer vector is turned
    into the world instead, which is the same product.

    Raises:
      ValueError: if the number of coefficients is no square, or a matrix is not 3 x 3.
    """
    return albedo * matmul(sh_rotate(transfer, world_from_local), light.T)


def _world_visibility(
    axes: Float[Array, "*v m 3"],
    coefficients: Float[Array, "*v m l"],
    frames: Float[Array, "*v 3 3"],
    *,
    offset: Float[Array, "*v k"] | None = None,
) -> Float[Array, "*v k"]:
    """SH visibility in world axes: the sum of the lobes and of `offset`, both given in the vertex frame."""
    visibility = lobes_to_sh(coefficients, rotate_lobes(axes, frames))
    return visibility if offset is None else visibility + sh_rotate(offset, frames)


def _integrate_lobe(
    visibility: Float[Array, "*v k"],
    axis: Float[Array, "*v 3"],
    kernel: Float[Array, "*#v z"],
    light: Float[Array, "c k"],
) -> Float[Array, "*v c"]:
    """∫ V(s) L(s) f(s·axis) ds per channel, exact for visibility and light of n bands: steps 2 to 5 in one.

    V L is of 2n-1 bands, so no more of the kernel matters, and the integral is the convolution of V L with it at the
    axis: Σ_jk V_j D_jk √(4π/(2l+1)) f_l y_k(axis), k = (l, m), with one matrix D_jk = ∫ L y_j y_k for all vertices.
    The same number comes out of (M V)·L in a frame around the axis, with the operator M of the kernel; but no vertex
    needs an operator of its own, nor the rotation of its light or transfer (10k vertices on two cores: 1.2 instead of
    7.8 ms for all of `relight`).

    Args:
      visibility, light: in world axes. axis: unit.
      kernel: zonal coefficients of f up to 2n-1 bands, for all vertices (leading axes of size 1) or one each.
    """
    order = order_of(visibility)
    num_bands = 2 * order - 1
    check_last_axis("kernel", kernel, num_bands)
    # Coefficients come first from here on, so that all vertices of one coefficient are one array.
    basis = jnp.stack(basis_columns(axis[..., 0], axis[..., 1], axis[..., 2], order=num_bands))
    kernel = kernel.reshape((1,) * (axis.ndim - kernel.ndim) + kernel.shape)
    kernel = kernel * constant_like(np.sqrt(4 * math.pi / (2 * np.arange(num_bands) + 1)), kernel)
    lobe = jnp.moveaxis(kernel, -1, 0)[bands(num_bands)] * basis
    convolved = einsum("cjk,k...->cj...", _multiplication_by(light), lobe)
    # Behind a barrier, or the compiler computes the visibility anew for every channel.
    visibility = jax.lax.optimization_barrier(jnp.moveaxis(visibility, -1, 0))
    return einsum("cj...,j...->...c", convolved, visibility)


def _multiplication_by(light: Float[Array, "c k"]) -> Float[Array, "c k m"]:
    """D[c, j, k] = ∫ L_c y_j y_k ds with j in the bands of the light and k in all bands of the product, exact."""
    order = order_of(light)
    nodes, weights = sphere_quadrature(4 * order - 4)
    table = np.stack(basis_columns(*nodes.T, order=2 * order - 1))
    weighted, basis = (jnp.asarray(t, dtype=light.dtype) for t in (table[: order**2] * weights, table))
    radiance = matmul(light, basis[: order**2])
    return einsum("cn,jn,kn->cjk", radiance, weighted, basis)


def relight(
    axes: Float[Array, "*v m 3"],
    coefficients: Float[Array, "*v m l"],
    frames: Float[Array, "*v 3 3"],
    positions: Float[Array, "*v 3"],
    light: Float[Array, "c k"],
    exponent: Float[Array, "*#v"],
    albedo: Float[Array, "*v c"],
    eye: Float[Array, " 3"],
    *,
    offset: Float[Array, "*v k"] | None = None,
) -> Float[Array, "*v c"]:
    """Self-shadowed color of each vertex under the normalised Phong BRDF.

    Args:
      axes, coefficients: m zonal lobes of visibility in the vertex frame.
      frames: world-from-vertex rotations, z = normal.
      positions: world positions; the viewer is local: each vertex has its own direction to `eye`.
      light: world SH radiance per channel.
      exponent: α >= 0, a scalar or one per vertex. 1 is a lobe as wide as the diffuse one, about the mirror direction.
      offset: SH visibility in the vertex frame to be added to the lobes (`PoseModel.offset`).
    Raises:
      ValueError: if the light's coefficients are no square number, or its bands not those of the lobes.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.3, steps 2 to 5. The
      frame that lobes, offset and light meet in is the world's, not that of the reflection (see `_integrate_lobe`).
    """
    visibility = _world_visibility(axes, coefficients, frames, offset=offset)
    wo = normalize(jnp.broadcast_to(eye, positions.shape) - positions)
    normal = frames[..., 2]
    mirrored = 2.0 * dot(normal, wo) * normal - wo
    kernel = phong_zh(jnp.asarray(exponent, dtype=light.dtype), order=2 * order_of(light) - 1)
    return albedo * _integrate_lobe(visibility, mirrored, kernel, light)


def relight_diffuse(
    axes: Float[Array, "*v m 3"],
    coefficients: Float[Array, "*v m l"],
    frames: Float[Array, "*v 3 3"],
    light: Float[Array, "c k"],
    albedo: Float[Array, "*v c"],
    *,
    offset: Float[Array, "*v k"] | None = None,
) -> Float[Array, "*v c"]:
    """Lambert shading with self-shadows: the lobe of α = 1 about the normal. `offset` is as in `relight`.

    Raises:
      ValueError: if the light's coefficients are no square number, or its bands not those of the lobes.
    """
    visibility = _world_visibility(axes, coefficients, frames, offset=offset)
    return albedo * _integrate_lobe(visibility, frames[..., 2], _lambert(light), light)


def membrane(
    axes: Float[Array, "*v m 3"],
    coefficients: Float[Array, "*v m l"],
    frames: Float[Array, "*v 3 3"],
    light: Float[Array, "c k"],
    albedo: Float[Array, "*v c"],
    transmission: Float[Array, "*#v c"],
    *,
    offset: Float[Array, "*v k"] | None = None,
) -> Float[Array, "*v c"]:
    """A thin translucent sheet: shadowed diffuse light in front, unshadowed light through the back.

    Args:
      transmission: τ per channel in [0, 1], one for all vertices (c,) or one each.
      offset: as in `relight`; the light through the back does not see it.
    Raises:
      ValueError: if the light's coefficients are no square number, or its bands not those of the lobes.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.1 (light in the
      normal frame, no reflection).
    """
    order = order_of(light)
    visibility = _world_visibility(axes, coefficients, frames, offset=offset)
    normal = frames[..., 2]
    front = _integrate_lobe(visibility, normal, _lambert(light), light)
    # The back lobe turned to the normal and dotted with the light; its bands are the diagonal of the zonal ones.
    back = back_lobe(order=order).astype(light.dtype)[np.arange(order) * (np.arange(order) + 1)]
    through = matmul(zh_to_sh(constant_like(back, normal), normal), light.T)
    return albedo * (front + jnp.broadcast_to(transmission, albedo.shape) * through)


def _lambert(light: Float[Array, "c k"]) -> Float[Array, " z"]:
    """Zonal coefficients of max(0, cos θ)/π, the Phong lobe of α = 1."""
    return phong_zh(jnp.ones((), dtype=light.dtype), order=2 * order_of(light) - 1)
