"""Per-vertex visibility by rays, without an acceleration structure: every ray against every triangle.

For small meshes. Visibility is kept as bits, one per vertex and direction, in the local frame of the vertex.
"""

import math

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchref._precision import in_float64
from torchref.harmonics.sh import sh_basis


def hemisphere_directions(num_directions: int) -> Float[Tensor, "d 3"]:
    """Spherical Fibonacci points with z > 0, float64: heights (i + 1/2)/d, azimuths i times the golden angle.

    References:
      Keinert et al., "Spherical Fibonacci Mapping", 2015.
    """
    points = []
    for i in range(num_directions):
        z, phi = (i + 0.5) / num_directions, i * math.pi * (3.0 - math.sqrt(5.0))
        s = math.sqrt(1.0 - z * z)
        points.append((s * math.cos(phi), s * math.sin(phi), z))
    return torch.tensor(points, dtype=torch.float64)


def trace_visibility(
    positions: Float[Tensor, "v 3"],
    frames: Float[Tensor, "v 3 3"],
    faces: Int[Tensor, "t 3"],
    directions: Float[Tensor, "d 3"],
    *,
    points: Int[Tensor, " p"] | None = None,
    relative_offset: float = 1e-4,
) -> UInt8[Tensor, "p bytes"]:
    """1 where the ray from a vertex meets no triangle, packed with the first direction in the highest bit.

    A ray starts off the surface along the normal, by `relative_offset` of the bounding box's diagonal.
    """
    diagonal = torch.linalg.norm(positions.amax(0) - positions.amin(0))
    triangles = positions[faces.long()].double()
    rows = []
    for vertex in range(len(positions)) if points is None else points.tolist():
        origin = positions[vertex] + relative_offset * diagonal * frames[vertex, :, 2]
        rays = (directions.to(frames) @ frames[vertex].T).double()
        rows.append(_pack(~_any_hit(origin.double(), rays, triangles)))
    return torch.stack(rows)


def projection_table(directions: Float[Tensor, "d 3"], *, order: int) -> Float[Tensor, "d k"]:
    """Weights from visibility over equal-area hemisphere directions to SH: y_i(s) · 2π/d."""
    return sh_basis(directions, order=order) * (2.0 * math.pi / len(directions))


def unpack_visibility(bits: UInt8[Tensor, "*b bytes"], *, num_directions: int) -> Float[Tensor, "*b d"]:
    """Bits to 0.0 and 1.0, float32."""
    columns = [(bits[..., i // 8] >> (7 - i % 8)) & 1 for i in range(num_directions)]
    return torch.stack(columns, dim=-1).to(torch.float32)


@in_float64
def project_visibility(bits: UInt8[Tensor, "*b bytes"], table: Float[Tensor, "d k"]) -> Float[Tensor, "*b k"]:
    """Σ of the table's rows over the directions that see the sky."""
    visible = unpack_visibility(bits, num_directions=len(table)).to(table)
    return torch.einsum("...d,dk->...k", visible, table)


def _pack(visible: Tensor) -> UInt8[Tensor, " bytes"]:
    padded = torch.cat([visible, visible.new_zeros(-len(visible) % 8)]).reshape(-1, 8).to(torch.uint8)
    return sum(padded[:, i] << (7 - i) for i in range(8))


def _any_hit(origin: Float[Tensor, "3"], rays: Float[Tensor, "d 3"], triangles: Float[Tensor, "t 3 3"]) -> Tensor:
    """Which rays meet a triangle ahead: origin + s·ray = a + u e1 + v e2, solved by Cramer's rule."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    away = (origin - a).expand(len(rays), -1, -1)
    ray = rays[:, None, :].expand(-1, len(triangles), -1)
    e1, e2 = e1.expand_as(ray), e2.expand_as(ray)

    def det(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return (x * torch.linalg.cross(y, z)).sum(-1)

    whole = det(-ray, e1, e2)
    s, u, v = (
        part / torch.where(whole == 0, torch.inf, whole)
        for part in (det(away, e1, e2), det(-ray, away, e2), det(-ray, e1, away))
    )
    return ((s > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (whole != 0)).any(-1)
