"""GBuffer, materials and lights -> outgoing radiance of each sample, as the reflection equation has it.

Irradiance from all around is a sum over directions of the upper hemisphere. No shadows.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.brdf import lambert, metallic_roughness, phong
from torchref.deferred.gbuffer import GBuffer
from torchref.deferred.texture import Textures, sample_texture_grad
from torchref.harmonics.sh import sh_basis, sh_evaluate
from torchref.scene import DIRECTIONAL, SPOT, Lights, Material
from torchref.vecmath import dot, frame_from_normal_tangent, normalize, orthonormal_tangent, safe_div, safe_sqrt

TEXTURE_SLOTS = ("base_color_texture", "metallic_roughness_texture", "occlusion_texture", "emissive_texture")


@dataclass(frozen=True)
class Surface:
    """The material at each sample: linear RGB, opacity, perceptual roughness, radiance, share of ambient light."""

    base_color: Float[Tensor, "*b 3"]
    alpha: Float[Tensor, "*b"]
    metallic: Float[Tensor, "*b 1"]
    roughness: Float[Tensor, "*b 1"]
    emissive: Float[Tensor, "*b 3"]
    occlusion: Float[Tensor, "*b 1"]


@in_float64
def look_up_surface(
    gbuffer: GBuffer,
    material: Material,
    textures: Textures | None,
    *,
    max_anisotropy: int = 8,
    slots: tuple[str, ...] = TEXTURE_SLOTS,
) -> Surface:
    """Factors times textures times vertex colors; an empty sample has the first material.

    References:
      glTF 2.0 specification, 3.9.2 and 3.9.3.
    """
    own = gbuffer.material_id.clamp(min=0)
    texels = {slot: torch.ones_like(gbuffer.color) for slot in TEXTURE_SLOTS}
    for slot in slots if textures is not None else ():
        layer = getattr(material, slot)[own]
        has = layer >= 0
        if slot in texels and has.any():
            found = sample_texture_grad(
                textures, gbuffer.uv[has], gbuffer.duv_dx[has], gbuffer.duv_dy[has], layer=layer[has],
                max_anisotropy=max_anisotropy,
            )  # fmt: skip
            texels[slot] = texels[slot].index_put((has,), found)
    base, rough, occlusion, emissive = (texels[slot] for slot in TEXTURE_SLOTS)
    color = material.base_color[own] * base * gbuffer.color
    strength = material.occlusion_strength[own][..., None]
    return Surface(
        base_color=color[..., :3],
        alpha=color[..., 3],
        metallic=material.metallic[own][..., None] * rough[..., 2:3],
        roughness=material.roughness[own][..., None] * rough[..., 1:2],
        emissive=material.emissive[own] * emissive[..., :3],
        occlusion=(1.0 - strength) + strength * occlusion[..., :1],
    )


@in_float64
def shade(
    gbuffer: GBuffer,
    surface: Surface,
    lights: Lights,
    eye: Float[Tensor, "3"],
    *,
    ambient: Float[Tensor, "3 k"] | None = None,
    model: str = "metallic_roughness",
) -> Float[Tensor, "*b 3"]:
    """L = L_e + Σ f(wi, wo) E max(0, n·wi) over the lights, plus what comes from all around."""
    n, wo = gbuffer.normal, normalize(eye - gbuffer.position)
    radiance = surface.emissive
    if ambient is not None:
        radiance = radiance + surface.occlusion * _ambient(n, wo, surface, ambient, model)
    for i in range(len(lights.kind)):
        wi, irradiance = incoming(Lights(*(getattr(lights, f.name)[i] for f in fields(lights))), gbuffer.position)
        lit = (dot(gbuffer.geometric_normal, wi) > 0) & (dot(n, wi) > 0)
        arrives = torch.where(lit, dot(n, wi), 0.0) * irradiance
        radiance = radiance + _reflectance(wi, wo, n, surface, model) * arrives
    return torch.where(gbuffer.coverage[..., None], radiance, 0.0)


def _reflectance(wi: Tensor, wo: Tensor, n: Tensor, surface: Surface, model: str) -> Float[Tensor, "*b 3"]:
    base, metallic, roughness = surface.base_color, surface.metallic, surface.roughness
    if model == "lambert":
        return lambert(base)
    if model == "metallic_roughness":
        return metallic_roughness(wi, wo, n, base_color=base, metallic=metallic, roughness=roughness)
    diffuse, mirror = _colors(surface)
    return lambert(diffuse) + phong(wi, wo, n, specular=mirror, exponent=_phong_exponent(roughness))


def _colors(surface: Surface) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Diffuse color and mirror reflectance: those of a dielectric (base, 4 %) and of a metal (black, base), mixed."""
    base, metallic = surface.base_color, surface.metallic
    return base + metallic * (0.0 - base), 0.04 + metallic * (base - 0.04)


def _phong_exponent(roughness: Tensor) -> Tensor:
    """2/α² - 2, α = max(roughness², 10⁻³).

    References:
      Walter et al., "Microfacet Models for Refraction", 2007, 5.2.
    """
    return 2.0 / (roughness**2).clamp(min=1e-3) ** 2 - 2.0


@in_float64
def incoming(light: Lights, position: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Direction to one light (a `Lights` without its leading axis) and the irradiance on a surface that faces it.

    References:
      KHR_lights_punctual, with its recommended attenuation and its reference code for the cone.
    """
    if light.kind == DIRECTIONAL:
        return (-light.direction).expand(position.shape), light.intensity.expand(position.shape)
    away = light.position - position
    distance2, wi = dot(away, away), normalize(away)
    window = (1.0 - (safe_sqrt(distance2) / light.range) ** 4).clamp(0.0, 1.0)
    attenuation = safe_div(window, distance2)
    if light.kind == SPOT:
        width = (light.cos_inner - light.cos_outer).clamp(min=1e-3)
        attenuation = attenuation * ((dot(-wi, light.direction) - light.cos_outer) / width).clamp(0.0, 1.0) ** 2
    return wi, attenuation * light.intensity


def _ambient(n: Tensor, wo: Tensor, surface: Surface, ambient: Float[Tensor, "3 k"], model: str) -> Tensor:
    """Lambert under the irradiance from all around, and for glossy models the blurred mirror image.

    Band l of the light seen in a Phong lobe of exponent s falls off as exp(-l²/2s). Its reflectance is Schlick's, with
    1 - roughness for the largest value.

    References:
      Ramamoorthi, Hanrahan, "Frequency Space Environment Map Rendering", 2002, eq. 20; Lagarde, "Adopting a Physically
      Based Shading Model", 2011.
    """
    if model == "lambert":
        return lambert(surface.base_color) * _irradiance(ambient, n)
    diffuse, f0 = _colors(surface)
    mirrored = 2.0 * dot(n, wo) * n - wo
    sharpness, order = _phong_exponent(surface.roughness).clamp(min=1.0), math.isqrt(ambient.shape[-1])
    band = torch.tensor([float(l) for l in range(order) for _ in range(2 * l + 1)], dtype=torch.float64)
    seen = sh_basis(mirrored, order=order) * torch.exp(-(band**2) / (2.0 * sharpness))
    image = torch.einsum("...k,ck->...c", seen, ambient).clamp(min=0.0)
    largest = torch.maximum(1.0 - surface.roughness, f0)
    fresnel = f0 + (largest - f0) * (1.0 - dot(n, wo).clamp(0.0, 1.0)) ** 5
    return lambert(diffuse) * _irradiance(ambient, n) + fresnel * image


def _irradiance(ambient: Float[Tensor, "3 k"], n: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """∫ L(w) n·w dw over the upper hemisphere; 0 where L is so negative that it would be.

    By Gauss-Legendre nodes in the cosine and equal azimuths in a frame about n, exact for light of this order.
    """
    order = math.isqrt(ambient.shape[-1])
    cosine, weight = np.polynomial.legendre.leggauss(order // 2 + 1)
    cosine, weight = (cosine + 1.0) / 2.0, weight / 2.0
    azimuth = 2.0 * math.pi * np.arange(order) / order
    ring = np.sqrt(1.0 - cosine**2)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)])[:, None]
    local = np.stack([*ring, np.tile(cosine[:, None], order)], axis=-1).reshape(-1, 3)
    solid_angle = torch.as_tensor(np.repeat(weight * cosine, order) * 2.0 * math.pi / order)
    frame = frame_from_normal_tangent(n, orthonormal_tangent(n))
    towards = torch.einsum("...ij,qj->...qi", frame, torch.as_tensor(local))
    light = sh_evaluate(ambient[:, None, :], towards[..., None, :, :])  # (..., 3, q)
    return (light * solid_angle).sum(-1).clamp(min=0.0)
