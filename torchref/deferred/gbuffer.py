"""Fragments and a scene -> GBuffer: every attribute blended from the three corners of each sample's triangle."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.deferred.interpolate import blend, corner_matrix, corner_weights, interpolate
from torchref.deferred.raster import Fragments, sample_places
from torchref.deferred.texture import Textures, sample_texture_grad
from torchref.scene import Scene
from torchref.vecmath import normalize


@dataclass(frozen=True)
class GBuffer:
    """The surface at each sample, 0 where it is empty, ids -1 there. Normals are on the side of the eye.

    duv_dx and duv_dy are per pixel to the right and downwards. motion is in pixels, None without a previous picture.
    """

    position: Float[Tensor, "*b 3"]
    normal: Float[Tensor, "*b 3"]
    geometric_normal: Float[Tensor, "*b 3"]
    uv: Float[Tensor, "*b 2"]
    duv_dx: Float[Tensor, "*b 2"]
    duv_dy: Float[Tensor, "*b 2"]
    color: Float[Tensor, "*b 4"]
    depth: Float[Tensor, "*b"]
    material_id: Int[Tensor, "*b"]
    triangle_id: Int[Tensor, "*b"]
    motion: Float[Tensor, "*b 2"] | None = None

    @property
    def coverage(self) -> Bool[Tensor, "*b"]:
        return self.triangle_id >= 0


@in_float64
def make_gbuffer(
    scene: Scene,
    fragments: Fragments,
    *,
    textures: Textures | None = None,
    max_anisotropy: int = 8,
    previous_clip: Float[Tensor, "v 4"] | None = None,
) -> GBuffer:
    """The scene at all samples."""
    some, triangle = fragments.coverage[..., None], fragments.triangle_id.clamp(min=0)
    position, normal, uv, color, tangent = (
        interpolate(fragments, values)
        for values in (scene.positions, scene.normals, scene.uv, scene.colors, scene.tangents)
    )
    duv_dx, duv_dy = (blend(fragments, scene.uv, slopes) for slopes in _weight_slopes(fragments))
    material_id = torch.where(fragments.coverage, scene.material_id[triangle], -1)
    normal = normalize(normal)
    if textures is not None:
        layer = torch.where(fragments.coverage, scene.material.normal_texture[material_id.clamp(min=0)], -1)
        mapped = layer >= 0
        if mapped.any():
            texel = sample_texture_grad(
                textures, uv[mapped], duv_dx[mapped], duv_dy[mapped], layer=layer[mapped],
                max_anisotropy=max_anisotropy,
            )  # fmt: skip
            scale = scene.material.normal_scale[material_id[mapped]]
            normal = normal.index_put((mapped,), _turned(normal[mapped], tangent[mapped], texel[..., :3], scale))
    a, b, c = scene.positions[scene.faces[triangle]].unbind(-2)
    side = some * torch.where(torch.linalg.det(corner_matrix(fragments)) > 0, 1.0, -1.0)[..., None]
    return GBuffer(
        position=position,
        normal=side * normal,
        geometric_normal=side * normalize(torch.linalg.cross(b - a, c - a)),
        uv=uv,
        duv_dx=duv_dx,
        duv_dy=duv_dy,
        color=color,
        depth=fragments.w,
        material_id=material_id,
        triangle_id=fragments.triangle_id,
        motion=None if previous_clip is None else _motion(fragments, previous_clip),
    )


def _weight_slopes(fragments: Fragments) -> tuple[Float[Tensor, "h w s 3"], Float[Tensor, "h w s 3"]]:
    """Derivatives of the corners' weights b per pixel, to the right and downwards.

    With the corners (x, y, w) as columns of M, a place (X, Y) in NDC has weights b = s / Σ s, s = M⁻¹ (X, Y, 1), and
    Σ s = 1/w. The quotient rule gives db = w (ds - b Σ ds), where ds is M⁻¹ times the step.
    """
    h, w, _ = fragments.triangle_id.shape
    inverse, b = torch.linalg.inv(corner_matrix(fragments)), corner_weights(fragments)
    steps = inverse[..., 0] * (2.0 / w), inverse[..., 1] * (-2.0 / h)
    right, down = (fragments.w[..., None] * (ds - b * ds.sum(-1, keepdim=True)) for ds in steps)
    return right, down


def _turned(normal: Tensor, tangent: Tensor, texel: Tensor, scale: Tensor) -> Tensor:
    """The normal that a normal map gives in the frame of tangent, bitangent and normal.

    References:
      glTF 2.0 specification, 3.9.3 (normal textures) and 3.7.2.1 (the bitangent).
    """
    t = normalize(tangent[..., :3])
    bitangent = torch.linalg.cross(normal, t) * tangent[..., 3:]
    x, y, z = (2.0 * texel - 1.0).unbind(-1)
    frame = torch.stack([t, bitangent, normal], dim=-1)
    return normalize(torch.einsum("...ij,...j->...i", frame, torch.stack([scale * x, scale * y, z], dim=-1)))


def _motion(fragments: Fragments, previous_clip: Float[Tensor, "v 4"]) -> Float[Tensor, "h w s 2"]:
    """Pixel coordinates of the samples, less those of the same points of the surface in the previous picture."""
    h, w, _ = fragments.triangle_id.shape
    size = torch.tensor([w, h], dtype=torch.float64)
    here = sample_places(h, w, fragments.samples) / (256.0 * fragments.samples.grid) + size / 2.0
    x, y, _, depth = interpolate(fragments, previous_clip).unbind(-1)
    seen = fragments.coverage & (depth > 0)
    depth = torch.where(seen, depth, 1.0)
    there = torch.stack([(1.0 + x / depth) / 2.0, (1.0 - y / depth) / 2.0], dim=-1) * size
    return torch.where(seen[..., None], here - there, 0.0)
