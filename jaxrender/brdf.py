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
      glTF 2.0 specification, appendix B.3.
    """
    n_i, n_o, i_o = (dot(a, b) for a, b in ((n, wi), (n, wo), (wi, wo)))
    specular, schlick = ggx(n_i, n_o, i_o, roughness)
    f0 = 0.04 * (1.0 - metallic) + base_color * metallic
    fresnel = f0 + (1.0 - f0) * schlick
    above = (n_i > 0.0) & (n_o > 0.0)
    diffuse = jnp.where(above, (1.0 - metallic) * base_color / math.pi, 0.0)
    return (1.0 - fresnel) * diffuse + fresnel * specular


def ggx(
    n_i: Float[Array, "*b"], n_o: Float[Array, "*b"], i_o: Float[Array, "*b"], roughness: Float[Array, "*b"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """The mirror of rough facets from cosines alone: D V, and Schlick's (1 - o·h)⁵; 0 below the horizon.

    With the half vector h = (wi + wo)/|wi + wo|: |wi + wo|² = 2 + 2 wi·wo, n·h = (n·wi + n·wo)/|wi + wo|.

    Args:
      n_i, n_o, i_o: n·wi, n·wo, wi·wo.
      roughness: perceptual; α = roughness², kept at 10⁻³ or more.
    Returns:
      D V, which has to be multiplied by the Fresnel reflectance F0 + (1 - F0)(1 - o·h)⁵; and the latter's power.
    References:
      glTF 2.0 specification, appendix B.3: eqs. of D (Trowbridge-Reitz), V (Smith, height-correlated), F (Schlick).
    """
    above = (n_i > 0.0) & (n_o > 0.0)
    n_i, n_o = (jnp.where(above, cosine, 1.0) for cosine in (n_i, n_o))
    half2 = jnp.maximum(2.0 + 2.0 * i_o, 1e-12)
    n_h2 = jnp.minimum((n_i + n_o) ** 2 / half2, 1.0)
    alpha2 = jnp.maximum(roughness * roughness, 1e-3) ** 2
    d = alpha2 / (math.pi * (n_h2 * (alpha2 - 1.0) + 1.0) ** 2)
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
