"""Which triangles a ray meets; pointwise, in float64, where edges are as good as exact."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64


@in_float64
def ray_plane_axes(directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2 3"]:
    """The axes after that of the largest component, each sheared along it until it is orthogonal to the direction."""
    flat = directions.reshape(-1, 3)
    rows = []
    for d in flat:
        k = int(d.abs().argmax())
        for axis in ((k + 1) % 3, (k + 2) % 3):
            slope = torch.zeros_like(d[axis]) if d[k] == 0 else d[axis] / d[k]
            rows.append(torch.eye(3, dtype=d.dtype)[axis] - slope * torch.eye(3, dtype=d.dtype)[k])
    return torch.stack(rows).reshape(*directions.shape[:-1], 2, 3)


@in_float64
def hit_distance(
    corners: Float[Tensor, "*b 3 3"],
    origins: Float[Tensor, "*b 3"],
    directions: Float[Tensor, "*b 3"],
    plane_axes: Float[Tensor, "*b 2 3"],
) -> Float[Tensor, "*b"]:
    """t from the triple products of the ray and the edges, and inf where they differ in sign.

    Here each edge's plane through the ray is asked for in space; `plane_axes`, in which jaxrender does that, are not
    used.
    """
    del plane_axes
    a, b, c = (corners - origins[..., None, :]).unbind(-2)
    sides = torch.stack([(directions * torch.linalg.cross(p, q)).sum(-1) for p, q in ((a, b), (b, c), (c, a))], dim=-1)
    plane = torch.linalg.cross(b - a, c - a)
    across = (plane * directions).sum(-1)
    met = ((sides >= 0).all(-1) | (sides <= 0).all(-1)) & (across != 0)
    return torch.where(met, (plane * a).sum(-1) / torch.where(met, across, 1.0), torch.inf)
