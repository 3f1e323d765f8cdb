"""Where a ray meets the plane of a triangle; pointwise."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64


@in_float64
def hit_parameters(
    corners: Float[Tensor, "*b 3 3"], origins: Float[Tensor, "*b 3"], directions: Float[Tensor, "*b 3"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 2"]]:
    """t and (u, v) from Cramer's rule on u (b - a) + v (c - a) - t d = o - a; 0 where there is no solution.

    For a ray in parallel to the plane t is 0 and (u, v) are those of the origin's projection, and for a triangle
    without area all are 0.
    """
    a, b, c = corners.unbind(-2)
    plane = torch.linalg.cross(b - a, c - a)
    hopeless = (plane * directions).sum(-1) == 0
    # In parallel to the plane: t = 0 is asked for, so the plane's normal replaces the ray and its t is dropped.
    ray = torch.where(hopeless[..., None], plane, directions)
    matrix = torch.stack([b - a, c - a, -ray], dim=-1)
    area = (plane == 0).all(-1)
    matrix = torch.where(area[..., None, None], torch.eye(3, dtype=matrix.dtype), matrix)
    u, v, t = torch.linalg.solve(matrix, (origins - a)[..., None])[..., 0].unbind(-1)
    zero = torch.zeros_like(t)
    t, u, v = (torch.where(lost, zero, x) for lost, x in ((hopeless, t), (area, u), (area, v)))
    return t, torch.stack([u, v], dim=-1)
