"""Run-time shading: lobes, light, view and BRDF to vertex colors (steps 2 to 5; step 1 is the pose model's).

Pointwise over vertices, with any leading axes "*v". Light is one SH vector per color channel in world axes and is
shared by all vertices. Everything is linear in light and albedo, and differentiable in all float arguments.
Colors are not clamped: order-4 light rings, and a strongly directional one may leave small negative values.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender.harmonics.brdf_operator import apply_operator, phong_normalization, phong_operator
from jaxrender.harmonics.membrane import membrane_transfer
from jaxrender.harmonics.sh import order_of, sh_rotate
from jaxrender.harmonics.zh import lobes_to_sh
from jaxrender.vecmath import normalize, reflection_frame


def rotate_lobes(axes: Float[Array, "*v c 3"], rotation: Float[Array, "*v 3 3"]) -> Float[Array, "*v c 3"]:
    """Step 2: turns the axes of each vertex's lobes by its rotation."""
    return jnp.einsum("...ij,...cj->...ci", rotation, axes)


def phong_transfer(visibility: Float[Array, "*v k"], exponent: Float[Array, "*#v"]) -> Float[Array, "*v k"]:
    """Step 4: t = (α+1)/2π M^α v, for visibility in the frame whose z is the lobe's axis.

    Args:
      exponent: α >= 0, a scalar or one per vertex.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", eq. 2.
    """
    exponent = jnp.asarray(exponent, dtype=visibility.dtype)
    operator = phong_operator(exponent, order=order_of(visibility))
    operator = phong_normalization(exponent)[..., None, None] * operator
    if exponent.ndim == 0:
        return visibility @ operator
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
    """
    return albedo * (sh_rotate(transfer, world_from_local) @ light.T)


def relight(
    axes: Float[Array, "*v m 3"],
    coefficients: Float[Array, "*v m l"],
    frames: Float[Array, "*v 3 3"],
    positions: Float[Array, "*v 3"],
    light: Float[Array, "c k"],
    exponent: Float[Array, "*#v"],
    albedo: Float[Array, "*v c"],
    eye: Float[Array, " 3"],
) -> Float[Array, "*v c"]:
    """Self-shadowed color of each vertex under the normalised Phong BRDF.

    Args:
      axes, coefficients: m zonal lobes of visibility in the vertex frame.
      frames: world-from-vertex rotations, z = normal.
      positions: world positions; the viewer is local: each vertex has its own direction to `eye`.
      light: world SH radiance per channel.
      exponent: α >= 0, a scalar or one per vertex. 1 is a lobe as wide as the diffuse one, about the mirror direction.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.3, steps 2 to 5.
    """
    wo = normalize(jnp.broadcast_to(eye, positions.shape) - positions)
    world_from_reflection = reflection_frame(wo, frames[..., 2])
    reflection_from_vertex = jnp.einsum("...ji,...jk->...ik", world_from_reflection, frames)
    visibility = lobes_to_sh(coefficients, rotate_lobes(axes, reflection_from_vertex))
    return shade_transfer(phong_transfer(visibility, exponent), world_from_reflection, light, albedo)


def relight_diffuse(
    axes: Float[Array, "*v m 3"],
    coefficients: Float[Array, "*v m l"],
    frames: Float[Array, "*v 3 3"],
    light: Float[Array, "c k"],
    albedo: Float[Array, "*v c"],
) -> Float[Array, "*v c"]:
    """Lambert shading with self-shadows: α = 1 about the normal, no rotation of the lobes needed."""
    one = jnp.ones((), dtype=coefficients.dtype)
    return shade_transfer(phong_transfer(lobes_to_sh(coefficients, axes), one), frames, light, albedo)


def membrane(
    axes: Float[Array, "*v m 3"],
    coefficients: Float[Array, "*v m l"],
    frames: Float[Array, "*v 3 3"],
    light: Float[Array, "c k"],
    albedo: Float[Array, "*v c"],
    transmission: Float[Array, "*#v c"],
) -> Float[Array, "*v c"]:
    """A thin translucent sheet: shadowed diffuse light in front, unshadowed light through the back.

    Args:
      transmission: τ per channel in [0, 1], one for all vertices (c,) or one each.
    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.1 (light in the
      normal frame, no reflection).
    """
    visibility = lobes_to_sh(coefficients, axes)
    transmission = jnp.broadcast_to(transmission, albedo.shape)
    transfer = membrane_transfer(visibility, transmission, order=order_of(visibility))
    channels = transfer.shape[-2]
    turned = sh_rotate(transfer, jnp.repeat(frames[..., None, :, :], channels, axis=-3))
    return albedo * jnp.einsum("...ck,ck->...c", turned, light)
