"""Reflectance of surfaces: f(wi, wo) without the cosine, for unit directions that leave the surface.

All functions are pointwise over any leading axes, differentiable in everything, and 0 below the horizon.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender.vecmath import dot, normalize, safe_div


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
    """specular (α+2)/2π max(0, r·wi)^α with r the mirror image of wo: energy-conserving, without the cosine.

    References:
      Lafortune, Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", 1994.
    """
    r = 2.0 * dot(n, wo) * n - wo
    cosine = jnp.maximum(dot(r, wi), 0.0)
    positive = jnp.where(cosine > 0.0, cosine, jnp.ones_like(cosine))
    lobe = jnp.where(cosine > 0.0, positive**exponent, jnp.zeros_like(cosine))
    return specular * lobe * (exponent + 2.0) / (2.0 * math.pi)


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
      glTF 2.0 specification, appendix B.3: eqs. of D (Trowbridge-Reitz), V (Smith, height-correlated), F (Schlick).
    """
    h = normalize(wi + wo)
    n_i, n_o, n_h, o_h = (jnp.maximum(dot(a, b), 0.0) for a, b in ((n, wi), (n, wo), (n, h), (wo, h)))
    alpha2 = jnp.maximum(roughness * roughness, 1e-3) ** 2
    d = alpha2 / (math.pi * (n_h * n_h * (alpha2 - 1.0) + 1.0) ** 2)
    smith = n_i * _smith(n_o, alpha2) + n_o * _smith(n_i, alpha2)
    v = safe_div(jnp.full_like(smith, 0.5), smith)
    f0 = 0.04 * (1.0 - metallic) + base_color * metallic
    fresnel = f0 + (1.0 - f0) * (1.0 - o_h) ** 5
    diffuse = (1.0 - fresnel) * (1.0 - metallic) * base_color / math.pi
    above = (n_i > 0.0) & (n_o > 0.0)
    return jnp.where(above, diffuse + fresnel * d * v, jnp.zeros_like(diffuse))


def _smith(cosine: Float[Array, "*b 1"], alpha2: Float[Array, "*b 1"]) -> Float[Array, "*b 1"]:
    return jnp.sqrt(cosine * cosine * (1.0 - alpha2) + alpha2)
