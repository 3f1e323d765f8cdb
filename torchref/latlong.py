"""Latitude-longitude images: row 0 is the zenith (+Y), the middle looks down -Z, columns turn towards +X."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.vec3 import Scalar, Vec3


def environment_directions(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Directions (h, w, 3) of the pixel centres, and solid angles (h, w)."""
    theta = math.pi * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    sin, cos, phi = torch.sin(theta)[:, None], torch.cos(theta)[:, None], azimuths(width)
    directions = torch.stack([sin * torch.sin(phi), cos * torch.ones_like(phi), -sin * torch.cos(phi)], dim=-1)
    return directions, solid_angles(height, width)[:, None].expand(height, width)


def azimuths(width: int) -> Tensor:
    """2π times the place of a column's middle in the image, less the half turn of the middle of the image."""
    return 2.0 * math.pi * ((torch.arange(width, dtype=torch.float64) + 0.5) / width - 0.5)


def solid_angles(height: int, width: int) -> Tensor:
    """The zone between two cosines has 2π times their difference, and a row shares it by its columns."""
    edges = torch.cos(math.pi * torch.arange(height + 1, dtype=torch.float64) / height)
    return -edges.diff() * 2.0 * math.pi / width


@in_float64
def to_angles(direction: Vec3) -> tuple[Scalar, Scalar]:
    """The polar angle from both of its legs, which keeps its digits at the poles; and the azimuth."""
    x, y, z = direction
    return torch.atan2(torch.hypot(x, z), y), torch.atan2(x, -z)


@in_float64
def to_direction(cosine: Scalar, azimuth: Scalar) -> Vec3:
    """(sin θ sin φ, cos θ, -sin θ cos φ)."""
    sine = torch.sin(torch.acos(cosine))
    return Vec3(sine * torch.sin(azimuth), cosine, -sine * torch.cos(azimuth))


@in_float64
def look_up_smoothly(image: Float[Tensor, "h w c"], direction: Vec3) -> Float[Tensor, "*b c"]:
    """Σ max(0, 1 - |distance in rows|) max(0, 1 - |distance in columns|) value, over all pixels' middles."""
    height, width = image.shape[:2]
    polar, azimuth = to_angles(direction)
    y = (polar / math.pi * height - 0.5).clamp(0.0, height - 1.0)[..., None]
    x = ((azimuth / (2.0 * math.pi) + 0.5) * width - 0.5)[..., None]
    apart = torch.remainder(x - torch.arange(width), width)
    of_row = (1.0 - (y - torch.arange(height)).abs()).clamp(min=0.0)
    of_column = (1.0 - torch.minimum(apart, width - apart)).clamp(min=0.0)
    return torch.einsum("...h,...w,hwc->...c", of_row, of_column, image)
