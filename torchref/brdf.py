"""Reflectance of surfaces: f(wi, wo) without the cosine, for unit directions that leave the surface.

Pointwise, from the vectors themselves: half vectors and mirror images. 0 below the horizon.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.vecmath import dot, normalize, safe_div, safe_sqrt


@in_float64
def lambert(albedo: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """albedo / π."""
    return albedo / math.pi


@in_float64
def phong(
    wi: Float[Tensor, "*b 3"],
    wo: Float[Tensor, "*b 3"],
    n: Float[Tensor, "*b 3"],
    *,
    specular: Float[Tensor, "*b 3"],
    exponent: Float[Tensor, "*b 1"],
) -> Float[Tensor, "*b 3"]:
    """specular (α+2)/2π max(0, r·wi)^α, with r the mirror image of wo about n.

    References:
      Lafortune, Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", 1994.
    """
    r = 2.0 * dot(n, wo) * n - wo
    towards = dot(r, wi)
    seen = _above(wi, wo, n) & (towards > 0)
    lobe = (exponent + 2.0) / (2.0 * math.pi) * torch.where(seen, towards, 1.0) ** exponent
    return specular * torch.where(seen, lobe, 0.0)


@in_float64
def metallic_roughness(
    wi: Float[Tensor, "*b 3"],
    wo: Float[Tensor, "*b 3"],
    n: Float[Tensor, "*b 3"],
    *,
    base_color: Float[Tensor, "*b 3"],
    metallic: Float[Tensor, "*b 1"],
    roughness: Float[Tensor, "*b 1"],
) -> Float[Tensor, "*b 3"]:
    """mix(dielectric, metal, metallic): a metal's mirror has its color, a dielectric's has 4 % and lies over Lambert.

    References:
      glTF 2.0 specification, appendix B.3.5, as it stands since 2024: before that its last lines mixed the Fresnel
      terms first, which takes light from half metals (issue 2386 of KhronosGroup/glTF).
    """
    specular, schlick = _mirror(wi, wo, n, roughness)
    metal = (base_color + (1.0 - base_color) * schlick) * specular
    fresnel = 0.04 + (1.0 - 0.04) * schlick
    dielectric = (1.0 - fresnel) * base_color / math.pi + fresnel * specular
    return torch.where(_above(wi, wo, n), (1.0 - metallic) * dielectric + metallic * metal, 0.0)


@in_float64
def ggx(
    n_i: Float[Tensor, "*b"],
    n_o: Float[Tensor, "*b"],
    i_o: Float[Tensor, "*b"],
    roughness: Float[Tensor, "*b"],
    *,
    sin2_h: Float[Tensor, "*b"] | None = None,
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """D V and (1 - o·h)⁵ for any three unit vectors with the cosines n·wi, n·wo and wi·wo; 0 below the horizon.

    Args:
      sin2_h: |n × h|², if it is not that of the cosines.
    """
    wi, wo, n = _vectors_with_cosines(n_i, n_o, i_o)
    specular, schlick = _mirror(wi, wo, n, roughness[..., None], None if sin2_h is None else sin2_h[..., None])
    above = _above(wi, wo, n)
    return torch.where(above, specular, 0.0)[..., 0], torch.where(above, schlick, 0.0)[..., 0]


@in_float64
def phong_lobe(
    n_i: Float[Tensor, "*b"], n_o: Float[Tensor, "*b"], i_o: Float[Tensor, "*b"], exponent: Float[Tensor, "*b"]
) -> Float[Tensor, "*b"]:
    """`phong` of specular 1 for any three unit vectors with these cosines."""
    wi, wo, n = _vectors_with_cosines(n_i, n_o, i_o)
    return phong(wi, wo, n, specular=torch.ones_like(wi), exponent=exponent[..., None])[..., 0]


def _mirror(
    wi: Float[Tensor, "*b 3"], wo: Float[Tensor, "*b 3"], n: Float[Tensor, "*b 3"], roughness: Float[Tensor, "*b 1"],
    sin2_h: Float[Tensor, "*b 1"] | None = None,
) -> tuple[Float[Tensor, "*b 1"], Float[Tensor, "*b 1"]]:  # fmt: skip
    """D V of rough facets, α = max(roughness², 10⁻³), and Schlick's power.

    References:
      glTF 2.0 specification, appendix B.3.2 (D of Trowbridge and Reitz, height-correlated V of Smith) and B.3.4.
    """
    alpha2 = (roughness**2).clamp(min=1e-3) ** 2
    h = normalize(wi + wo)
    n_h, n_i, n_o = dot(n, h), dot(n, wi).abs(), dot(n, wo).abs()
    n_h2 = n_h**2 if sin2_h is None else 1.0 - sin2_h
    d = alpha2 / (math.pi * (n_h2 * (alpha2 - 1.0) + 1.0) ** 2)
    shadowing = n_o * torch.sqrt(alpha2 + (1.0 - alpha2) * n_i**2) + n_i * torch.sqrt(alpha2 + (1.0 - alpha2) * n_o**2)
    return d * safe_div(torch.ones_like(n_i), 2.0 * shadowing), (1.0 - dot(wo, h).abs()) ** 5


def _above(wi: Float[Tensor, "*b 3"], wo: Float[Tensor, "*b 3"], n: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b 1"]:
    return (dot(n, wi) > 0) & (dot(n, wo) > 0)


def _vectors_with_cosines(n_i: Tensor, n_o: Tensor, i_o: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """n up, wi over the x axis, and wo turned about n until its angle to wi is right."""
    s_i, s_o = safe_sqrt(1.0 - n_i**2), safe_sqrt(1.0 - n_o**2)
    turn = safe_div(i_o - n_i * n_o, s_i * s_o)
    zero = torch.zeros_like(n_i)
    wi = torch.stack([s_i, zero, n_i], dim=-1)
    wo = torch.stack([s_o * turn, s_o * safe_sqrt(1.0 - turn**2), n_o], dim=-1)
    return wi, wo, torch.stack([zero, zero, zero + 1.0], dim=-1)
