"""Normals of a window, first shading and lights -> how many samples the highlights of a pixel need.

k_n asks for samples wherever a surface bends, in the dark as well; this metric asks only where some light's highlight
may change over the normals of the window. Pointwise over windows; differentiable almost everywhere. Not in the paper.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrender.deferred.fxaa import luma
from jaxrender.deferred.metrics import normal_cone
from jaxrender.deferred.shade import incoming
from jaxrender.scene import Lights
from jaxrender.srgb import encode_srgb
from jaxrender.vecmath import dot, normalize, safe_sqrt

#: Reflectance of what is no metal, seen head-on.
_F0 = 0.04


def highlight_sample_count(
    normal: Float[Array, "*b n 3"],
    position: Float[Array, "*b 3"],
    roughness: Float[Array, "*b"],
    light: Float[Array, "*b"],
    lights: Lights,
    eye: Float[Array, "3"],
    *,
    scale: float | Float[Array, ""],
    covered: Bool[Array, "*b n"] | None = None,
) -> Float[Array, "*b"]:
    """k_h = c (e(L + r) - e(L)): the step, display-encoded, from the first shading L to it and all that may be added.

    r = Σ over lights of E F0 (max D - min D) V n·l, where D (Trowbridge-Reitz) is taken at the smallest and largest
    angle that a half vector can have with a normal of the window's cone, V = 1/(4 n·l n·v) and F0 = 4 %: the highlights
    of metals are stronger, and those at grazing angles.

    Args:
      normal: unit, of the sub-samples; covered: which of them are there, all by default.
      position: of the sample that was shaded first; roughness: perceptual, there.
      light: L, linear luma of the first shading.
      scale: c >= 0.
    """
    axis, chord = normal_cone(normal, covered=covered)
    half_angle = 2.0 * jnp.arcsin(jnp.sqrt(0.5 * jnp.clip(chord, 0.0, 1.0)))
    wo = normalize(jnp.broadcast_to(eye, position.shape) - position)
    n_o = jnp.maximum(dot(axis, wo)[..., 0], 1e-2)
    alpha2 = jnp.maximum(roughness * roughness, 1e-3) ** 2

    def add(total: Array, one: Lights) -> tuple[Array, None]:
        wi, irradiance = incoming(one, position)
        half = normalize(wi + wo)
        off_axis = half - dot(axis, half) * axis
        angle = jnp.arctan2(safe_sqrt(dot(off_axis, off_axis))[..., 0], dot(axis, half)[..., 0])
        near, far = jnp.maximum(angle - half_angle, 0.0), jnp.minimum(angle + half_angle, 0.5 * math.pi)
        change = _facets(near, alpha2) - _facets(far, alpha2)
        lit = dot(axis, wi)[..., 0] > -jnp.sin(half_angle)
        return total + jnp.where(lit & (near < far), luma(irradiance) * change, 0.0), None

    total, _ = jax.lax.scan(add, jnp.zeros_like(roughness), lights)
    brighter = light + _F0 * total / (4.0 * n_o)
    return scale * (encode_srgb(brighter) - encode_srgb(light))


def _facets(angle: Float[Array, "*b"], alpha2: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """D of Trowbridge and Reitz, at the angle between normal and half vector."""
    sin2 = jnp.sin(angle) ** 2
    return alpha2 / (math.pi * (sin2 * (1.0 - alpha2) + alpha2) ** 2)
