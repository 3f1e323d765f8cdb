"""A rasteriser as the specification tells it: triangle by triangle, every sample of the image, 64-bit integers.

What a triangle needs to be clipped is cut as a polygon in float64; each piece is snapped and filled by the same rule.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref.deferred.samples import CENTER, Samples

_GUARD_PX = 8191


@dataclass(frozen=True)
class Fragments:
    """What each sample sees: `triangle_id` (-1: nothing), perspective-correct weights of corners 1 and 2, window depth
    (1: nothing), clip w (0: nothing). `clip` and `faces` are the geometry, `height`, `width`, `samples` the image.
    """

    triangle_id: Int[Tensor, "h w s"]
    barycentrics: Float[Tensor, "h w s 2"]
    depth: Float[Tensor, "h w s"]
    w: Float[Tensor, "h w s"]
    clip: Float[Tensor, "v 4"]
    faces: Int[Tensor, "t 3"]
    samples: Samples

    @property
    def coverage(self) -> Bool[Tensor, "h w s"]:
        return self.triangle_id >= 0


def rasterize(
    clip: Float[Tensor, "v 4"],
    faces: Int[Tensor, "t 3"],
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    cull: str = "none",
) -> Fragments:
    """Which triangle each sample of an image sees.

    References:
      Direct3D 11 functional specification, 3.4.
    """
    shape = (height, width, samples.count)
    best, ids = torch.full(shape, 2.0, dtype=torch.float64), torch.full(shape, -1, dtype=torch.int64)
    weights, own_w = torch.zeros(*shape, 3, dtype=torch.float64), torch.zeros(shape, dtype=torch.float64)
    at = sample_places(height, width, samples)
    m = samples.grid
    for t, face in enumerate(faces.tolist()):
        corners = clip[face].to(torch.float64)
        for piece, mix in _pieces(corners, height * m, width * m):
            covered, z, b, w = _fill(piece, mix, at, height * m, width * m, cull)
            wins = covered & (z >= 0) & (z <= 1) & (z < best)
            best, ids = torch.where(wins, z, best), torch.where(wins, t, ids)
            weights, own_w = torch.where(wins[..., None], b, weights), torch.where(wins, w, own_w)
    found = ids >= 0
    dtype = clip.dtype
    depth = torch.where(found, best, torch.ones_like(best)).to(dtype)
    return Fragments(ids, weights[..., 1:].to(dtype), depth, own_w.to(dtype), clip, faces, samples)


def sample_places(height: int, width: int, samples: Samples) -> Int[Tensor, "h w s 2"]:
    """Sample positions (x, y) in 1/256 of a cell, from the middle of the image; a cell is a pixel, or one of its m²."""
    m = samples.grid
    rows, columns = torch.arange(height), torch.arange(width)
    found = []
    for j in range(m):
        for i in range(m):
            for dx, dy in samples.offsets:
                x = (columns * m + i) * 256 + 128 + 16 * dx - width * m * 128
                y = (rows * m + j) * 256 + 128 + 16 * dy - height * m * 128
                found.append(torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1))
    return torch.stack(found, dim=2)


def _pieces(corners: Tensor, height: int, width: int):
    """The triangle itself, or the triangles that are left of it inside the near plane and the guard band."""
    if not bool(torch.isfinite(corners).all()):
        return []
    gx, gy = 2.0 * _GUARD_PX / max(width, 1), 2.0 * _GUARD_PX / max(height, 1)
    planes = [[0, 0, 1, 0], [-1, 0, 0, gx], [1, 0, 0, gx], [0, -1, 0, gy], [0, 1, 0, gy]]
    polygon = list(zip(corners, torch.eye(3, dtype=corners.dtype), strict=True))
    if all(float(torch.tensor(p, dtype=corners.dtype) @ c) >= 0 for p in planes for c in corners) and bool(
        (corners[:, 3] > 0).all()
    ):
        return [(corners, torch.eye(3, dtype=corners.dtype))]
    for plane in planes:
        normal, kept = torch.tensor(plane, dtype=corners.dtype), []
        for (p, mix), (q, other) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            a, b = float(normal @ p), float(normal @ q)
            if a >= 0:
                kept.append((p, mix))
            if (a >= 0) != (b >= 0):
                s = a / (a - b)
                kept.append((p + s * (q - p), mix + s * (other - mix)))
        polygon = kept
    fan = [(polygon[0], polygon[i], polygon[i + 1]) for i in range(1, len(polygon) - 1)]
    return [tuple(torch.stack(part) for part in zip(*three, strict=True)) for three in fan]


def _fill(corners: Tensor, mix: Tensor, at: Tensor, height: int, width: int, cull: str):
    """Coverage, window depth, weights in the source triangle and clip w of one triangle at all samples."""
    nothing = torch.zeros(at.shape[:-1], dtype=torch.bool)
    w = corners[:, 3]
    # The viewport transform is made in float32, as a pipeline makes it, so that both snap the same number.
    half = torch.tensor([width * 128.0, -height * 128.0])
    xy = torch.round((corners[:, :2].float() / w[:, None].float()) * half).to(torch.int64)
    area = _cross(xy[1] - xy[0], xy[2] - xy[0])
    front = bool(area < 0)
    if int(area) == 0 or (cull == "back" and not front) or (cull == "front" and front):
        zero = torch.zeros(at.shape[:-1], dtype=torch.float64)
        return nothing, zero, torch.zeros(*at.shape[:-1], 3, dtype=torch.float64), zero
    order = [0, 2, 1] if front else [0, 1, 2]
    inside = ~nothing
    screen = torch.zeros(*at.shape[:-1], 3, dtype=torch.float64)
    for k in range(3):
        a, b = xy[order[k]], xy[order[(k + 1) % 3]]
        e = _cross(b - a, at - a)
        top_or_left = (a[1] == b[1] and b[0] > a[0]) or b[1] < a[1]
        inside &= (e >= 0) if top_or_left else (e > 0)
        screen[..., order[(k + 2) % 3]] = e.to(torch.float64) / abs(int(area))
    over_w = screen / w
    total = over_w.sum(-1, keepdim=True)
    return inside, screen @ (corners[:, 2] / w), (over_w / total) @ mix, 1.0 / total[..., 0]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
