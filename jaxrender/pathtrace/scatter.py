"""Reflection at a point: value of the BRDF, directions drawn from it, and their density.

Densities are per solid angle around the point. `wo` and `wi` leave the surface; light only ever crosses to the side of
the triangle from which it came. For fixed random numbers all functions are differentiable in the material.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from jaxrender import vec3
from jaxrender.brdf import ggx, phong_lobe
from jaxrender.pathtrace.hit_points import HitSurface
from jaxrender.vec3 import Scalar, Vec3, dot, normalize, reflect

MODELS = ("metallic_roughness", "phong", "lambert")

#: Normals for shading are turned towards the eye until their cosine to it is at least this: at silhouettes they may
#: face away, and a surface that is seen would be black.
LEAST_COSINE = 0.01


class Reflector(NamedTuple):
    """A point of a surface, as light sees it.

    Attributes:
      normal: for shading; geometric_normal: of the triangle; both unit and on the side of wo (but for `normal` of the
        model "lambert", which does without).
      wo: unit, towards where the path comes from.
      diffuse: reflectance of the matt part. mirror: F0 of the glossy part, 0 for a model without.
      roughness: perceptual, alpha its square.
      matt_share: how often a direction is drawn from the matt part.
    """

    position: Vec3
    normal: Vec3
    geometric_normal: Vec3
    wo: Vec3
    diffuse: Vec3
    mirror: Vec3
    roughness: Scalar
    matt_share: Scalar


class Scattered(NamedTuple):
    """A direction drawn from a BRDF: f cos / density (0 where the direction is of no use), and the density."""

    wi: Vec3
    weight: Vec3
    density: Scalar


def make_reflector(surface: HitSurface, direction: Vec3, *, model: str) -> Reflector:
    """The reflection of one of `MODELS` at hits (`hit_points.hit_surface`).

    Args:
      direction: of the rays that hit, towards the surface.
      model: as in `deferred.shade`: "metallic_roughness", "phong" (exponent 2/α² - 2, no Fresnel term) or "lambert" of
        the base color alone.
    """
    wo = -direction
    base, metallic, normal = surface.base_color, surface.metallic, surface.normal
    diffuse, mirror = base, base * 0.0
    if model != "lambert":
        diffuse, mirror = base * (1.0 - metallic), base * metallic + 0.04 * (1.0 - metallic)
        away = jnp.where(surface.triangle >= 0, LEAST_COSINE - dot(normal, wo), 0.0)
        normal = normalize(normal + wo * jnp.maximum(away, 0.0))
    fresnel = mirror
    if model == "metallic_roughness":
        grazing = jnp.clip(1.0 - dot(normal, wo), 0.0, 1.0) ** 5
        fresnel = mirror + (1.0 - mirror) * grazing
    matt, glossy = vec3.mean(diffuse), vec3.mean(fresnel)
    total = matt + glossy
    share = jnp.clip(matt / jnp.where(total > 0.0, total, 1.0), 0.1, 0.9)
    share = jnp.where(glossy > 0.0, jnp.where(matt > 0.0, share, 0.0), 1.0)
    return Reflector(
        surface.position, normal, surface.geometric_normal, wo, diffuse, mirror, surface.roughness, share
    )  # fmt: skip


def reflectance(at: Reflector) -> Vec3:
    """An estimate of the share of light that is given back, in [0, 1]: what indirect light is divided by.

    Of a matt surface it is exact. The glossy part counts with its reflectance at normal incidence. At least 1e-3, so
    that it can be divided by.
    """
    return Vec3(*(jnp.clip(c, 1e-3, 1.0) for c in at.diffuse + at.mirror))


def evaluate(at: Reflector, wi: Vec3, *, model: str) -> Vec3:
    """f(wi, wo) times the cosine of wi; 0 below the horizon of the triangle or of the shading normal.

    References:
      glTF 2.0 specification, appendix B.3 (see `jaxrender.brdf`).
    """
    n_i, n_o, i_o = dot(at.normal, wi), dot(at.normal, at.wo), dot(wi, at.wo)
    cosine = jnp.where(_leaves(at, wi), jnp.maximum(n_i, 0.0), 0.0)
    if model == "lambert":
        return at.diffuse * (cosine / math.pi)
    if model == "phong":
        lobe = phong_lobe(n_i, n_o, i_o, _exponent(at.roughness))
        return (at.diffuse / math.pi + at.mirror * lobe) * cosine
    half = wi + at.wo
    off_axis = half - at.normal * dot(at.normal, half)
    sin2_h = dot(off_axis, off_axis) / jnp.maximum(dot(half, half), 1e-12)
    lobe, schlick = ggx(n_i, n_o, i_o, at.roughness, sin2_h=sin2_h)
    matt = jnp.where(n_o > 0.0, 0.96 * (1.0 - schlick) / math.pi, 0.0)
    return (at.diffuse * matt + (at.mirror + (1.0 - at.mirror) * schlick) * lobe) * cosine


def density(at: Reflector, wi: Vec3, *, model: str) -> Scalar:
    """Density per solid angle with which `draw` finds wi."""
    matt = jnp.maximum(dot(at.normal, wi), 0.0) / math.pi
    if model == "lambert":
        return matt
    glossy = _phong_density(at, wi) if model == "phong" else _facet_density(at, wi)
    return at.matt_share * matt + (1.0 - at.matt_share) * glossy


def draw(at: Reflector, u: Scalar, v: Scalar, choice: Scalar, *, model: str) -> Scattered:
    """A direction by the BRDF: matt part by the cosine, glossy part by visible facets or by the lobe.

    Args:
      u, v, choice: uniform in [0, 1).
    References:
      Dupuy, Benyoub, "Sampling Visible GGX Normals with Spherical Caps", HPG 2023; Lafortune, Willems, 1994.
    """
    wi = _cosine_direction(at.normal, u, v)
    if model != "lambert":
        glossy = _phong_direction(at, u, v) if model == "phong" else _facet_direction(at, u, v)
        wi = vec3.where(choice < at.matt_share, wi, glossy)
    p = density(at, wi, model=model)
    f = evaluate(at, wi, model=model)
    weight = vec3.where(p > 1e-9, f / jnp.maximum(p, 1e-9), 0.0)
    return Scattered(wi, weight, p)


def _leaves(at: Reflector, wi: Vec3) -> Array:
    """Whether wi and wo are on the same side of the triangle, as light must not leak through by a bent normal."""
    return dot(at.geometric_normal, wi) > 0.0


def _exponent(roughness: Scalar) -> Scalar:
    return 2.0 / jnp.maximum(roughness * roughness, 1e-3) ** 2 - 2.0


def _cosine_direction(n: Vec3, u: Scalar, v: Scalar) -> Vec3:
    radius, azimuth = jnp.sqrt(u), (2.0 * math.pi) * v
    t, b = vec3.tangents(n)
    return normalize(
        t * (radius * jnp.cos(azimuth)) + b * (radius * jnp.sin(azimuth)) + n * jnp.sqrt(jnp.maximum(1.0 - u, 0.0))
    )


def _phong_direction(at: Reflector, u: Scalar, v: Scalar) -> Vec3:
    cosine = jnp.maximum(1.0 - u, 1e-7) ** (1.0 / (_exponent(at.roughness) + 1.0))
    sine, azimuth = jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 0.0)), (2.0 * math.pi) * v
    axis = normalize(reflect(at.wo, at.normal))
    t, b = vec3.tangents(axis)
    return normalize(t * (sine * jnp.cos(azimuth)) + b * (sine * jnp.sin(azimuth)) + axis * cosine)


def _phong_density(at: Reflector, wi: Vec3) -> Scalar:
    exponent = _exponent(at.roughness)
    cosine = dot(normalize(reflect(at.wo, at.normal)), wi)
    lobe = jnp.where(cosine > 0.0, jnp.where(cosine > 0.0, cosine, 1.0) ** exponent, 0.0)
    return lobe * (exponent + 1.0) / (2.0 * math.pi)


def _facet_direction(at: Reflector, u: Scalar, v: Scalar) -> Vec3:
    """wo mirrored at a facet that it sees."""
    alpha = jnp.maximum(at.roughness * at.roughness, 1e-3)
    t, b = vec3.tangents(at.normal)
    wo = Vec3(dot(t, at.wo), dot(b, at.wo), jnp.maximum(dot(at.normal, at.wo), 1e-4))
    stretched = normalize(Vec3(alpha * wo.x, alpha * wo.y, wo.z))
    z = (1.0 - u) * (1.0 + stretched.z) - stretched.z
    sine, azimuth = jnp.sqrt(jnp.clip(1.0 - z * z, 0.0, 1.0)), (2.0 * math.pi) * v
    cap = Vec3(sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), z) + stretched
    h = normalize(Vec3(alpha * cap.x, alpha * cap.y, jnp.maximum(cap.z, 0.0)))
    facet = t * h.x + b * h.y + at.normal * h.z
    return normalize(reflect(at.wo, facet))


def _facet_density(at: Reflector, wi: Vec3) -> Scalar:
    """D G1 / (4 n·wo): of visible facets, turned into one of mirrored directions."""
    alpha2 = jnp.maximum(at.roughness * at.roughness, 1e-3) ** 2
    half = wi + at.wo
    off_axis = half - at.normal * dot(at.normal, half)
    sin2 = dot(off_axis, off_axis) / jnp.maximum(dot(half, half), 1e-12)
    d = alpha2 / (math.pi * (sin2 * (1.0 - alpha2) + alpha2) ** 2)
    n_o = jnp.maximum(dot(at.normal, at.wo), 1e-4)
    seen = (dot(at.normal, half) > 0.0) & (dot(at.wo, half) > 0.0)
    return jnp.where(seen, 0.5 * d / (n_o + jnp.sqrt(n_o * n_o * (1.0 - alpha2) + alpha2)), 0.0)
