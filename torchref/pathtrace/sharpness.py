"""Windows as narrow as the lobes of glossy surfaces."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.pathtrace.scatter import Reflector
from torchref.vec3 import Scalar, dot, to_array


@in_float64
def sharpness(at: Reflector) -> Scalar:
    """s (1 - α): s is the share of the mirror, with Schlick's approximation of Fresnel's equations; α = roughness²."""
    f0, matt = to_array(at.mirror).mean(-1), to_array(at.diffuse).mean(-1)
    weight = (1.0 - dot(at.normal, at.wo)).clamp(0.0, 1.0) ** 5
    mirrored = torch.where(f0 > 0.0, (1.0 - weight) * f0 + weight, 0.0)
    some = mirrored + matt > 0.0
    return torch.where(some, mirrored / torch.where(some, mirrored + matt, 1.0), 0.0) * (1.0 - at.roughness.square())


def window_radii(largest: int, least: float) -> tuple[int, ...]:
    """largest, its quarters rounded down, 1, 0; what follows the first that is not above `least` is left out."""
    if largest <= least:
        return (largest,)
    following = 0 if largest <= 1 else max(1, largest // 4)
    return (largest, *window_radii(following, least))


@in_float64
def blend_windows(
    levels: Float[Tensor, "k h w c"], radii: Float[Tensor, " k"], wanted: Float[Tensor, "h w 1"]
) -> Float[Tensor, "h w c"]:
    """Piecewise linear interpolation over log(1 + radius), constant beyond the ends."""
    x, at = torch.log1p(radii), torch.log1p(wanted)
    at = torch.minimum(torch.maximum(at, x[-1]), x[0])
    result = torch.zeros_like(levels[0])
    for k in range(len(levels)):
        hat = torch.ones_like(at)
        if k > 0:
            hat = torch.minimum(hat, (x[k - 1] - at) / (x[k - 1] - x[k]))
        if k + 1 < len(levels):
            hat = torch.minimum(hat, (at - x[k + 1]) / (x[k] - x[k + 1]))
        result = result + hat.clamp(0.0, 1.0) * levels[k]
    return result
