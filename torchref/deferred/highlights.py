"""Normals of a window, first shading and lights -> how many samples the highlights of a pixel need."""

import math
from dataclasses import fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchref._precision import in_float64
from torchref._srgb import encode_srgb
from torchref.deferred.fxaa import luma
from torchref.deferred.metrics import normal_cone
from torchref.deferred.shade import incoming
from torchref.scene import Lights
from torchref.vecmath import dot, normalize


@in_float64
def highlight_sample_count(
    normal: Float[Tensor, "*b n 3"],
    position: Float[Tensor, "*b 3"],
    roughness: Float[Tensor, "*b"],
    light: Float[Tensor, "*b"],
    lights: Lights,
    eye: Float[Tensor, "3"],
    *,
    scale: float | Float[Tensor, ""],
    covered: Bool[Tensor, "*b n"] | None = None,
) -> Float[Tensor, "*b"]:
    """c times the step of the encoded luma if every highlight went from its least to its most over the cone.

    The facets' density is 1/(π α² (cos² + sin²/α²)²), α the square of the roughness; F0 is 4 %, V = 1/(4 n·l n·v).

    References:
      Walter et al., "Microfacet Models for Refraction", 2007, eq. 33.
    """
    axis, chord = normal_cone(normal, covered=covered)
    widest = torch.arccos(1.0 - chord)
    alpha = (roughness**2).clamp(min=1e-3)
    to_eye = normalize(eye - position)

    def density(angle: Tensor) -> Tensor:
        return 1.0 / (math.pi * alpha**2 * (torch.cos(angle) ** 2 + (torch.sin(angle) / alpha) ** 2) ** 2)

    total = torch.zeros_like(roughness)
    for k in range(len(lights.kind)):
        one = Lights(*(getattr(lights, field.name)[k] for field in fields(lights)))
        to_light, irradiance = incoming(one, position)
        half = normalize(to_light + to_eye)
        angle = torch.atan2(torch.linalg.norm(torch.linalg.cross(axis, half), dim=-1), dot(axis, half)[..., 0])
        near, far = (angle - widest).clamp(min=0.0), (angle + widest).clamp(max=0.5 * math.pi)
        seen = (near < far) & (dot(axis, to_light)[..., 0] > -torch.sin(widest))
        total = total + torch.where(seen, (density(near) - density(far)) * luma(irradiance), 0.0)
    added = 0.04 * total / (4.0 * dot(axis, to_eye)[..., 0].clamp(min=1e-2))
    return scale * (encode_srgb(light + added) - encode_srgb(light))
