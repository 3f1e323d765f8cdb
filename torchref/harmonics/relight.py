"""Visibility × light × BRDF -> radiance: steps 2 to 5 of the run time, after the lobes have been synthesised.

Pointwise over vertices, with any leading axes "*v"; `m` lobes, `c` color channels. Light is one world-space
SH vector per channel, shared by all vertices.

References:
  Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", sections 4.1 to 4.3.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.harmonics.brdf_operator import apply_operator, phong_normalization, phong_operator
from torchref.harmonics.membrane import membrane_transfer
from torchref.harmonics.sh import sh_rotate
from torchref.harmonics.zh import lobes_to_sh
from torchref.vecmath import normalize, reflection_frame


@in_float64
def rotate_lobes(axes: Float[Tensor, "*v c 3"], rotation: Float[Tensor, "*v 3 3"]) -> Float[Tensor, "*v c 3"]:
    """Step 2: R d for each axis d of a vertex."""
    return torch.einsum("...ij,...cj->...ci", rotation, axes)


@in_float64
def phong_transfer(visibility: Float[Tensor, "*v k"], exponent: Float[Tensor, "*#v"]) -> Float[Tensor, "*v k"]:
    """Step 4: t = (α+1)/2π M^α v, where z is the axis of the Phong lobe (eq. 2)."""
    order = round(visibility.shape[-1] ** 0.5)
    operator = phong_normalization(exponent)[..., None, None] * phong_operator(exponent, order=order)
    return apply_operator(operator, visibility)


@in_float64
def shade_transfer(
    transfer: Float[Tensor, "*v k"],
    world_from_local: Float[Tensor, "*v 3 3"],
    light: Float[Tensor, "c k"],
    albedo: Float[Tensor, "*v c"],
) -> Float[Tensor, "*v c"]:
    """Step 5 as printed: l = rotate(light) into the frame of each vertex, then albedo · (t·l) per channel."""
    local_light = sh_rotate(light, world_from_local.transpose(-1, -2)[..., None, :, :])
    return albedo * torch.einsum("...k,...ck->...c", transfer, local_light)


@in_float64
def relight(
    axes: Float[Tensor, "*v m 3"],
    coefficients: Float[Tensor, "*v m l"],
    frames: Float[Tensor, "*v 3 3"],
    positions: Float[Tensor, "*v 3"],
    light: Float[Tensor, "c k"],
    exponent: Float[Tensor, "*#v"],
    albedo: Float[Tensor, "*v c"],
    eye: Float[Tensor, "3"],
    *,
    offset: Float[Tensor, "*v k"] | None = None,
) -> Float[Tensor, "*v c"]:
    """Shadowed Phong reflection towards the eye, all in the frame around the mirrored view direction.

    `offset` is visibility in the vertex frame that comes on top of the lobes.
    """
    mirror = reflection_frame(normalize(eye - positions), frames[..., 2])
    local_from_vertex = mirror.transpose(-1, -2) @ frames
    visibility = lobes_to_sh(coefficients, rotate_lobes(axes, local_from_vertex))
    if offset is not None:
        visibility = visibility + sh_rotate(offset, local_from_vertex)
    return shade_transfer(phong_transfer(visibility, exponent), mirror, light, albedo)


@in_float64
def relight_diffuse(
    axes: Float[Tensor, "*v m 3"],
    coefficients: Float[Tensor, "*v m l"],
    frames: Float[Tensor, "*v 3 3"],
    light: Float[Tensor, "c k"],
    albedo: Float[Tensor, "*v c"],
    *,
    offset: Float[Tensor, "*v k"] | None = None,
) -> Float[Tensor, "*v c"]:
    """Shadowed diffuse reflection: exponent 1 about the normal, where the lobes already are."""
    lambert = torch.ones((), dtype=axes.dtype, device=axes.device)
    visibility = lobes_to_sh(coefficients, axes) + (0.0 if offset is None else offset)
    return shade_transfer(phong_transfer(visibility, lambert), frames, light, albedo)


@in_float64
def membrane(
    axes: Float[Tensor, "*v m 3"],
    coefficients: Float[Tensor, "*v m l"],
    frames: Float[Tensor, "*v 3 3"],
    light: Float[Tensor, "c k"],
    albedo: Float[Tensor, "*v c"],
    transmission: Float[Tensor, "*#v c"],
    *,
    offset: Float[Tensor, "*v k"] | None = None,
) -> Float[Tensor, "*v c"]:
    """A thin sheet: shadowed diffuse light from the front, and unshadowed light that passes from behind."""
    order = coefficients.shape[-1]
    visibility = lobes_to_sh(coefficients, axes) + (0.0 if offset is None else offset)
    transfer = membrane_transfer(visibility, transmission, order=order)
    channels = [
        shade_transfer(transfer[..., c, :], frames, light[c : c + 1], albedo[..., c : c + 1])
        for c in range(light.shape[0])
    ]
    return torch.cat(channels, dim=-1)
