"""Reflectance of surfaces: f(wi, wo) without the cosine, for unit directions that leave the surface.

All functions are pointwise over any leading axes, differentiable in everything, and 0 below the horizon.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender.vecmath import dot


def lambert(albedo: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """albedo / π."""
    return albedo / math.pi


def phong(
    wi: Float[Array, "*b 3"],
    wo: Float[Array, "*b 3"],
    n: Float[Array, "*b 3"],
    *,
    specular: Float[Array, "*b 3"],
    exponent: Float[Array, "*b 1"],
) -> Float[Array, "*b 3"]:
    """specular times `phong_lobe`: normalised so that no direction gives back more than it gets."""
    return specular * phong_lobe(dot(n, wi), dot(n, wo), dot(wi, wo), exponent)


def metallic_roughness(
    wi: Float[Array, "*b 3"],
    wo: Float[Array, "*b 3"],
    n: Float[Array, "*b 3"],
    *,
    base_color: Float[Array, "*b 3"],
    metallic: Float[Array, "*b 1"],
    roughness: Float[Array, "*b 1"],
) -> Float[Array, "*b 3"]:
    """The glTF material: a Fresnel blend of Lambert and GGX, 4 % reflectance for dielectrics.

    Args:
      roughness: perceptual; α = roughness², kept at 10⁻³ or more.
    References:
      glTF 2.0 specification, appendix B.3.5, as corrected in 2024 (KhronosGroup/glTF, issue 2386).
    """
    n_i, n_o, i_o = (dot(a, b) for a, b in ((n, wi), (n, wo), (wi, wo)))
    v = wi + wo
    off_axis = v - dot(n, v) * n
    sin2_h = dot(off_axis, off_axis) / jnp.maximum(dot(v, v), 1e-12)
    specular, schlick = ggx(n_i, n_o, i_o, roughness, sin2_h=sin2_h)
    f0 = 0.04 * (1.0 - metallic) + base_color * metallic
    above = (n_i > 0.0) & (n_o > 0.0)
    # The matt part lies under a dielectric's mirror: 1 - (0.04 + 0.96 (1 - o·h)⁵) of the light gets there.
    diffuse = jnp.where(above, 0.96 * (1.0 - schlick) * (1.0 - metallic) * base_color / math.pi, 0.0)
    return diffuse + (f0 + (1.0 - f0) * schlick) * specular


def ggx(
    n_i: Float[Array, "*b"],
    n_o: Float[Array, "*b"],
    i_o: Float[Array, "*b"],
    roughness: Float[Array, "*b"],
    *,
    sin2_h: Float[Array, "*b"] | None = None,
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """The mirror of rough facets from cosines alone: D V, and Schlick's (1 - o·h)⁵; 0 below the horizon.

    With the half vector h = (wi + wo)/|wi + wo|: |wi + wo|² = 2 + 2 wi·wo, n·h = (n·wi + n·wo)/|wi + wo|.

    Args:
      n_i, n_o, i_o: n·wi, n·wo, wi·wo.
      roughness: perceptual; α = roughness², kept at 10⁻³ or more.
      sin2_h: 1 - (n·h)². From cosines alone it loses digits near the peak of smooth surfaces (1 % of D at roughness
        0.1 in float32); from vectors, |n × h|², it does not.
    Returns:
      D V, which has to be multiplied by the Fresnel reflectance F0 + (1 - F0)(1 - o·h)⁵; and the latter's power.
    References:
      glTF 2.0 specification, appendix B.3: eqs. of D (Trowbridge-Reitz), V (Smith, height-correlated), F (Schlick).
    """
    above = (n_i > 0.0) & (n_o > 0.0)
    n_i, n_o = (jnp.where(above, cosine, 1.0) for cosine in (n_i, n_o))
    half2 = jnp.maximum(2.0 + 2.0 * i_o, 1e-12)
    sin2 = jnp.clip(1.0 - (n_i + n_o) ** 2 / half2, 0.0, 1.0) if sin2_h is None else sin2_h
    alpha2 = jnp.maximum(roughness * roughness, 1e-3) ** 2
    # (n·h)² (α² - 1) + 1
    d = alpha2 / (math.pi * (sin2 * (1.0 - alpha2) + alpha2) ** 2)
    v = 0.5 / (n_i * _smith(n_o, alpha2) + n_o * _smith(n_i, alpha2))
    schlick = jnp.maximum(1.0 - 0.5 * jnp.sqrt(half2), 0.0) ** 5
    return jnp.where(above, d * v, 0.0), jnp.where(above, schlick, 0.0)


def phong_lobe(
    n_i: Float[Array, "*b"], n_o: Float[Array, "*b"], i_o: Float[Array, "*b"], exponent: Float[Array, "*b"]
) -> Float[Array, "*b"]:
    """(α+2)/2π max(0, r·wi)^α from cosines alone, with r the mirror image of wo: r·wi = 2 (n·wo)(n·wi) - wi·wo.

    References:
      Lafortune, Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", 1994.
    """
    cosine = 2.0 * n_o * n_i - i_o
    seen = (cosine > 0.0) & (n_i > 0.0) & (n_o > 0.0)
    lobe = jnp.where(seen, jnp.where(seen, cosine, 1.0) ** exponent, 0.0)
    return lobe * (exponent + 2.0) / (2.0 * math.pi)


def _smith(cosine: Float[Array, "*b"], alpha2: Float[Array, "*b"]) -> Float[Array, "*b"]:
    return jnp.sqrt(cosine * cosine * (1.0 - alpha2) + alpha2)
