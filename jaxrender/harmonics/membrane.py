"""The thin translucent sheet: diffuse light from the front, shadowed, and through the back, unshadowed.

Differentiable in all arrays.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.harmonics.brdf_operator import apply_operator, phong_operator
from jaxrender.harmonics.zh import clamped_cosine_zh
from jaxrender.vecmath import constant_like


def back_lobe(*, order: int = 4) -> Float[Array, " k"]:
    """Transfer of the unoccluded back side in the normal frame: (1/π) max(0, -cos θ), the tabulated lobe.

    Mirroring a zonal function across the tangent plane negates its odd bands.

    Raises:
      ValueError: if order < 1.
    """
    sign = np.where(np.arange(order) % 2, -1.0, 1.0) / math.pi
    zonal = clamped_cosine_zh(order=order) * jnp.asarray(sign, dtype=float)
    centres = np.arange(order) * (np.arange(order) + 1)
    return jnp.zeros(order**2, dtype=zonal.dtype).at[centres].set(zonal)


def membrane_transfer(
    visibility: Float[Array, "*b k"], transmission: Float[Array, "*#b c"], *, order: int = 4
) -> Float[Array, "*b c k"]:
    """Transfer vectors of the membrane per channel, t = (1/π) M¹ v + τ · back lobe.

    Args:
      visibility: SH visibility in the vertex frame (z = normal), zero below the surface.
      transmission: τ in [0, 1], colour of the light that passes, times the local thinness.
    Raises:
      ValueError: if order < 1.
    References:
      Sloan, Luna, Snyder, "Local, Deformable Precomputed Radiance Transfer", 2005, eq. 22; Nowrouzezahrai et
      al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.1.
    """
    one = jnp.ones((), dtype=visibility.dtype)
    front = apply_operator(phong_operator(one, order=order) / math.pi, visibility)
    front = front[..., None, :]
    return front + transmission[..., :, None] * constant_like(back_lobe(order=order), front)
