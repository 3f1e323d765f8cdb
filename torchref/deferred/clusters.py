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
    unlike = _table(normal, position, depth, material_id, slope, normal_scale, plane_scale)
    found = [
        _greedy(square, _members(there), [int(first_sample(there))], tolerance=1.0, count=len(there))
        for square, there in zip(unlike, covered.reshape(-1, covered.shape[-1]), strict=True)
    ]
    return torch.tensor(found, dtype=torch.int32).reshape(covered.shape)


@in_float64
def cluster_quads(
    normal: Float[Tensor, "*b q 3"],
    position: Float[Tensor, "*b q 3"],
    depth: Float[Tensor, "*b q"],
    material_id: Int[Tensor, "*b q"],
    covered: Bool[Tensor, "*b q"],
    seeds: Int[Tensor, "*b 4"],
    *,
    count: int,
    normal_scale: float | Float[Tensor, ""],
    plane_scale: float | Float[Tensor, ""],
    apart_scale: float | Float[Tensor, ""],
) -> Int[Tensor, "*b q"]:
    """The same for windows of two by two pixels, with four taken to begin with, until `count` are."""
    # A window is two pixels wide.
    slope = 2.0 * apart_scale * torch.ones(*covered.shape[:-1], 2)
    unlike = _table(normal, position, depth, material_id, slope, normal_scale, plane_scale)
    windows = zip(unlike, covered.reshape(-1, covered.shape[-1]), seeds.reshape(-1, 4), strict=True)
    found = [
        # An empty pixel's turn is lost, not handed on.
        _greedy(square, _members(there), own[own >= 0].tolist(), tolerance=0.0, count=count - int((own < 0).sum()))
        for square, there, own in windows
    ]
    return torch.tensor(found, dtype=torch.int32).reshape(covered.shape)


def _table(normal, position, depth, material_id, slope, normal_scale, plane_scale) -> Float[Tensor, "p n n"]:
    """Squares of how unlike sub-samples (rows) are to those that may be taken (columns)."""
    n = depth.shape[-1]
    places = sample_positions(math.isqrt(n))
    found = []
    for i in range(math.prod(depth.shape[:-1])):
        normals, points = (values.reshape(-1, n, 3)[i] for values in (normal, position))
        material, depths = (values.reshape(-1, n)[i] for values in (material_id, depth))
        steps = slope.reshape(-1, 2)[i] * (places[:, None] - places)
        apart = points[:, None] - points
        off = torch.minimum((apart * normals).sum(-1).abs(), (apart * normals[:, None]).sum(-1).abs())
        turned = torch.linalg.norm(normals[:, None] - normals, dim=-1)
        square = (normal_scale * turned) ** 2 + (plane_scale * off / depths) ** 2 + (steps**2).sum(-1)
        found.append(torch.where(material[:, None] == material, square, math.inf))
    return torch.stack(found)


def _members(there: Bool[Tensor, " n"]) -> list[int]:
    return torch.nonzero(there)[:, 0].tolist()


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


def _greedy(
    unlike: Float[Tensor, "n n"], members: list[int], taken: list[int], *, tolerance: float, count: int
) -> list[int]:
    """Takes the most unlike member until none is more unlike than the tolerance, or so many are taken."""
    nearest = {i: float(unlike[i, taken].min()) for i in members}
    while members and max(nearest.values()) > tolerance and len(taken) < count:
        farthest = max(members, key=nearest.__getitem__)
        taken = [*taken, farthest]
        nearest = {i: float(unlike[i, taken].min()) for i in members}
    return [min(taken, key=lambda k: float(unlike[i, k])) if i in members else -1 for i in range(len(unlike))]
