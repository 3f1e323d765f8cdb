"""Light as SH vectors, one per colour channel: environment images and lamps.

`project_environment` and `rotate_environment` take one image (h, w, c); the rest is pointwise.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchref import _quadrature
from torchref._precision import in_float64
from torchref.harmonics.sh import sh_basis
from torchref.harmonics.zh import zh_to_sh, zonal_integral
from torchref.latlong import environment_directions


@in_float64
def project_environment(image: Float[Tensor, "h w c"], *, order: int) -> Float[Tensor, "c k"]:
    """One SH vector per channel of a latitude-longitude map: Σ over pixels of radiance · y · solid angle."""
    directions, solid_angle = environment_directions(*image.shape[:2])
    total = 0.0
    for row, s, w in zip(image, directions.to(image.device), solid_angle.to(image.device), strict=True):
        total = total + torch.einsum("wc,wk,w->ck", row, sh_basis(s, order=order), w)
    return total


@in_float64
def sh_directional_light(
    direction: Float[Tensor, "*#b 3"], radiance: Float[Tensor, "*#b c"], *, order: int
) -> Float[Tensor, "*b c k"]:
    """A lamp at infinity: radiance · δ(s - d), hence radiance · y(d); `direction` points to the lamp."""
    return radiance[..., :, None] * sh_basis(direction, order=order)[..., None, :]


@in_float64
def sh_area_light(
    direction: Float[Tensor, "*#b 3"],
    radius_radians: Float[Tensor, "*#b"],
    radiance: Float[Tensor, "*#b c"],
    *,
    order: int,
) -> Float[Tensor, "*b c k"]:
    """Constant radiance inside the cap of an angular radius about a unit direction, nothing outside.

    The cap's ZH are integrals of polynomials over [cos r, 1], where Gauss-Legendre nodes are exact. The
    interval is measured from its end 1, of length 2 sin²(r/2), so that a small cap keeps its solid angle.
    """
    radius = torch.as_tensor(radius_radians, dtype=torch.float64, device=direction.device)
    height = 2.0 * torch.sin(radius / 2.0) ** 2
    u, w = _quadrature.gauss_legendre(order, height, torch.zeros_like(height))  # u = 1 - cos θ
    cap = zonal_integral(1.0 - u, -w, order=order)
    return radiance[..., :, None] * zh_to_sh(cap, direction)[..., None, :]


@in_float64
def sh_window(sh: Float[Tensor, "*b k"], *, width: float) -> Float[Tensor, "*b k"]:
    """Band l times (1 + cos(π l / width))/2 for l < width, and 0 beyond.

    References:
      Sloan, "Stupid Spherical Harmonics (SH) Tricks", 2008, on windowing (Hanning).
    """
    order = math.isqrt(sh.shape[-1])
    gains = [(1.0 + math.cos(math.pi * l / width)) / 2.0 if l < width else 0.0 for l in range(order)]
    per_coefficient = [gain for l, gain in enumerate(gains) for _ in range(2 * l + 1)]
    return sh * torch.tensor(per_coefficient, dtype=sh.dtype, device=sh.device)


def rotate_environment(image: Float[Tensor, "h w c"], angle_radians: float) -> Float[Tensor, "h w c"]:
    """The map turned about +Y by whole columns; positive is counter-clockwise seen from above.

    A point at image azimuth φ (measured from -Z towards +X) moves to φ - angle, since +Y turns +X to -Z.
    """
    width = image.shape[1]
    shift = round(angle_radians * width / (2.0 * math.pi))
    return torch.stack([image[:, (column + shift) % width] for column in range(width)], dim=1)
