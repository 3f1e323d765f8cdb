"""Light without the texture it falls on."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64


@in_float64
def demodulate(
    radiance: Float[Tensor, "h w c"], albedo: Float[Tensor, "h w c"], *, floor: float = 1e-3
) -> Float[Tensor, "h w c"]:
    """Radiance over albedo; a channel too dark to tell takes the mean of the others, and without any, radiance."""
    light = []
    for values, shades in zip(radiance.flatten(0, 1), albedo.flatten(0, 1), strict=True):
        tells = (shades >= floor) & torch.isfinite(shades).all()
        if tells.any():
            divided = values / shades.where(tells, torch.ones_like(shades))
            values = divided.where(tells, divided[tells].mean())
        light.append(values)
    return torch.stack(light).reshape(radiance.shape)


@in_float64
def remodulate(
    light: Float[Tensor, "h w c"], albedo: Float[Tensor, "h w c"], *, floor: float = 1e-3
) -> Float[Tensor, "h w c"]:
    """Light times albedo, where the albedo is finite and a channel of it is at least the floor."""
    seen = torch.isfinite(albedo).all(-1, keepdim=True) & (albedo >= floor).any(-1, keepdim=True)
    return light.where(~seen, light * albedo.where(seen, torch.ones_like(albedo)))
