"""Hits of rays -> the surface there, attribute by attribute."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.deferred.texture import Textures, sample_bilinear, sample_trilinear
from torchref.scene import Material
from torchref.vec3 import Scalar, Vec3, from_array, to_array
from torchref.vecmath import dot, normalize

_SIZE = {"position": 3, "normal": 3, "uv": 2, "color": 4, "tangent": 4}
_USUAL = {"uv": (0.0, 0.0), "color": (1.0, 1.0, 1.0, 1.0), "tangent": (0.0, 0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class SurfaceTable:
    """Rows of triangles: attributes of corner 0, differences of corners 1 and 2 from it, normal, density of uv."""

    corners: Float[Tensor, "t c"]
    material_id: Int[Tensor, " t"]
    material: Material
    textures: Textures | None
    attributes: tuple[str, ...]
    slots: tuple[str, ...]


class HitPoints(NamedTuple):
    """Attributes where rays end; 0 where they hit nothing."""

    triangle: Int[Tensor, " n"]
    material_id: Int[Tensor, " n"]
    position: Vec3
    normal: Vec3
    geometric_normal: Vec3
    tangent: Vec3
    handedness: Scalar
    front: Bool[Tensor, " n"]
    u: Scalar
    v: Scalar
    uv_width: Scalar
    color: Vec3
    alpha: Scalar


class HitSurface(NamedTuple):
    """The same with material and textures."""

    triangle: Int[Tensor, " n"]
    position: Vec3
    normal: Vec3
    geometric_normal: Vec3
    front: Bool[Tensor, " n"]
    base_color: Vec3
    alpha: Scalar
    metallic: Scalar
    roughness: Scalar
    emissive: Vec3


@in_float64
def hit_surface(
    table: SurfaceTable,
    triangle: Int[Tensor, " n"],
    barycentrics: Float[Tensor, "n 2"],
    direction: Vec3,
    *,
    width: Scalar | None = None,
) -> HitSurface:
    """The surface where rays end."""
    points = interpolate(table, gather_corners(table, triangle), triangle, barycentrics, direction, width)
    return apply_material(table, points, look_up_texels(table, points, fine=width is None))


@in_float64
def gather_corners(table: SurfaceTable, triangle: Int[Tensor, " n"]) -> Float[Tensor, "c n"]:
    """A column for each hit."""
    return torch.stack([table.corners[max(int(t), 0)] for t in triangle], dim=1)


@in_float64
def interpolate(
    table: SurfaceTable, corners: Float[Tensor, "c n"], triangle: Int[Tensor, " n"], barycentrics: Float[Tensor, "n 2"],
    direction: Vec3, width: Scalar | None,
) -> HitPoints:  # fmt: skip
    """b_0 A_0 + b_1 A_1 + b_2 A_2 of each attribute A.

    References:
      Width in uv: Akenine-Möller et al., "Texture Level of Detail Strategies for Real-Time Ray Tracing", Ray Tracing
      Gems, 2019, eq. 34.
    """
    hit, rows = (triangle >= 0)[:, None], corners.T
    sizes = [_SIZE[name] for name in table.attributes]
    first, step_1, step_2, flat, uv_density = rows.split([sum(sizes)] * 3 + [3, 1], dim=1)
    weights = torch.stack([1.0 - barycentrics.sum(-1), *barycentrics.T], dim=-1)
    values = torch.einsum("nk,nka->na", weights, torch.stack([first, first + step_1, first + step_2], dim=1))
    found = {name: torch.tensor(value, dtype=rows.dtype).expand(len(rows), -1) for name, value in _USUAL.items()}
    found = found | dict(zip(table.attributes, values.split(sizes, dim=1), strict=True))
    found = {name: torch.where(hit, value, 0.0) for name, value in found.items()}
    flat = torch.where(hit, flat, 0.0)
    cosine = dot(flat, to_array(direction))
    side = torch.where(cosine > 0.0, -1.0, 1.0)
    normal = normalize(found["normal"])
    # A normal that does not look to the front of its triangle gives way to the triangle's.
    normal = torch.where(dot(normal, flat) > 1e-3, normal, flat)
    uv_width = torch.zeros_like(uv_density)
    if width is not None:
        uv_width = torch.where(hit, width[:, None] * uv_density / torch.sqrt(cosine.abs().clamp(min=0.05)), 0.0)
    return HitPoints(
        triangle=triangle,
        material_id=torch.where(hit[:, 0], table.material_id[triangle.clamp(min=0).long()], 0).int(),
        position=from_array(found["position"]),
        normal=from_array(side * normal),
        geometric_normal=from_array(side * flat),
        tangent=from_array(side * normalize(found["tangent"][:, :3])),
        handedness=side[:, 0] * found["tangent"][:, 3],
        front=cosine[:, 0] < 0.0,
        u=found["uv"][:, 0],
        v=found["uv"][:, 1],
        uv_width=uv_width[:, 0],
        color=from_array(found["color"][:, :3]),
        alpha=found["color"][:, 3],
    )


@in_float64
def look_up_texels(table: SurfaceTable, points: HitPoints, *, fine: bool) -> dict[str, Float[Tensor, "n 4"]]:
    """One lookup for each slot and hit; the level is log2 of the width in texels of the longer side."""
    if table.textures is None:
        return {}
    found = {}
    for slot in table.slots:
        layers = getattr(table.material, slot)[points.material_id.long()].tolist()
        texels = [_texel(table.textures, points, i, layer, fine) for i, layer in enumerate(layers)]
        found[slot] = torch.stack(texels)
    return found


def _texel(textures: Textures, points: HitPoints, i: int, layer: int, fine: bool) -> Float[Tensor, "4"]:
    uv = torch.stack([points.u[i], points.v[i]])
    if layer < 0:
        return torch.ones(4, dtype=uv.dtype)
    if fine:
        return sample_bilinear(textures, layer, uv, level=0)
    size = max(int(textures.width[layer, 0]), int(textures.height[layer, 0]))
    return sample_trilinear(textures, layer, uv, lod=torch.log2((points.uv_width[i] * size).clamp(min=1e-6)))


@in_float64
def apply_material(table: SurfaceTable, points: HitPoints, texels: dict[str, Float[Tensor, "n 4"]]) -> HitSurface:
    """glTF 2.0, 3.9: factors times textures times vertex colors, and the normal map in its frame."""
    own, hit = points.material_id.long(), points.triangle >= 0
    one = torch.ones(len(own), 4, dtype=points.alpha.dtype)
    base, rough, emissive = (
        texels[name].to(one.dtype) if name in texels else one
        for name in ("base_color_texture", "metallic_roughness_texture", "emissive_texture")
    )
    material = table.material
    color = material.base_color[own] * base * torch.cat([to_array(points.color), points.alpha[:, None]], dim=1)
    color = torch.where(hit[:, None], color, 0.0)
    normal = to_array(points.normal)
    if "normal_texture" in texels:
        x, y, z = (2.0 * texels["normal_texture"].to(one.dtype)[:, :3] - 1.0).unbind(1)
        scale, tangent = material.normal_scale[own], to_array(points.tangent)
        bitangent = points.handedness[:, None] * torch.linalg.cross(normal, tangent)
        frame = torch.stack([tangent, bitangent, normal], dim=-1)
        turned = normalize(torch.einsum("nij,nj->ni", frame, torch.stack([scale * x, scale * y, z], dim=-1)))
        normal = torch.where((material.normal_texture[own] >= 0)[:, None], turned, normal)
    return HitSurface(
        triangle=points.triangle,
        position=points.position,
        normal=from_array(normal),
        geometric_normal=points.geometric_normal,
        front=points.front,
        base_color=from_array(color[:, :3]),
        alpha=color[:, 3],
        metallic=torch.where(hit, material.metallic[own] * rough[:, 2], 0.0),
        roughness=torch.where(hit, material.roughness[own] * rough[:, 1], 0.0),
        emissive=from_array(torch.where(hit[:, None], material.emissive[own] * emissive[:, :3], 0.0)),
    )
