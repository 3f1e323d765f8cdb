"""Windows of a G-buffer -> sub-samples that look alike: greedily, window by window, from a table of all pairs."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.deferred.sampling import first_sample, sample_positions


@in_float64
def cluster_samples(
    normal: Float[Tensor, "*b n 3"],
    position: Float[Tensor, "*b n 3"],
    depth: Float[Tensor, "*b n"],
    material_id: Int[Tensor, "*b n"],
    covered: Bool[Tensor, "*b n"],
    slope: Float[Tensor, "*b 2"],
    *,
    normal_scale: float | Float[Tensor, ""],
    plane_scale: float | Float[Tensor, ""],
) -> Int[Tensor, "*b n"]:
    """The taken sub-sample that each one is least unlike, the earlier of equals; -1 where empty.

    Unlike are materials, without end; else the root of the sum of the squares of: the distance of normals; that of
    either from the tangent plane of the other, the smaller, over the depth of the taken one; slope times way, by axis.
    """
    *lead, n = covered.shape
    places = sample_positions(math.isqrt(n))
    found = []
    for i in range(math.prod(lead)):
        normals, points = (values.reshape(-1, n, 3)[i] for values in (normal, position))
        material, there, depths = (values.reshape(-1, n)[i] for values in (material_id, covered, depth))
        # Rows are of sub-samples, columns of those that may be taken.
        steps = slope.reshape(-1, 2)[i] * (places[:, None] - places)
        apart = points[:, None] - points
        off = torch.minimum((apart * normals).sum(-1).abs(), (apart * normals[:, None]).sum(-1).abs())
        turned = torch.linalg.norm(normals[:, None] - normals, dim=-1)
        square = (normal_scale * turned) ** 2 + (plane_scale * off / depths) ** 2 + (steps**2).sum(-1)
        square = torch.where(material[:, None] == material, square, math.inf)
        found.append(_greedy(square, torch.nonzero(there)[:, 0].tolist(), int(first_sample(there))))
    return torch.tensor(found, dtype=torch.int32).reshape(covered.shape)


@in_float64
def shading_slope(
    steps: Float[Tensor, "*b 2"],
    detail: Float[Tensor, "*b"],
    luma: Float[Tensor, "*b"],
    *,
    contrast_scale: float | Float[Tensor, ""],
    detail_scale: float | Float[Tensor, ""],
) -> Float[Tensor, "*b 2"]:
    """The root of the squares of both: the steps to the pixels beside, and what the material varies in the pixel."""
    return torch.hypot(contrast_scale * steps, (detail_scale * detail * luma)[..., None])


def _greedy(unlike: Float[Tensor, "n n"], members: list[int], first: int) -> list[int]:
    """Takes the most unlike member until none is more unlike than 1."""
    taken: list[int] = []
    farthest, distance = first, math.inf
    while members and distance > 1.0:
        taken.append(farthest)
        nearest = {i: float(unlike[i, taken].min()) for i in members}
        farthest = max(members, key=nearest.__getitem__)
        distance = nearest[farthest]
    return [min(taken, key=lambda k: float(unlike[i, k])) if i in members else -1 for i in range(len(unlike))]
