"""What goes into the methods: meshes, meshes that move, and scenes with materials and lights."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchref._precision import in_float64
from torchref.camera import Camera, frame_bounds
from torchref.vecmath import frame_from_normal_tangent, normalize

#: Values of `Material.alpha_mode`.
OPAQUE, MASK, BLEND = 0, 1, 2
#: Values of `Lights.kind`.
DIRECTIONAL, POINT, SPOT = 0, 1, 2


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; seen from outside, the corners of a face run counter-clockwise."""

    vertices: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]
    faces: Int[Tensor, "t 3"]


@dataclass(frozen=True)
class MeshSequence:
    """A mesh in f frames with what drives it; columns of `frames` are tangent, bitangent, normal (world from local)."""

    vertices: Float[Tensor, "f v 3"]
    frames: Float[Tensor, "f v 3 3"]
    faces: Int[Tensor, "t 3"]
    features: Float[Tensor, "f j"]

    @property
    def normals(self) -> Float[Tensor, "f v 3"]:
        return self.frames[..., 2]


@dataclass(frozen=True)
class Material:
    """Materials of glTF 2.0 by id: factors for what textures give, and for each texture a layer, or -1."""

    base_color: Float[Tensor, "*m 4"]
    metallic: Float[Tensor, "*m"]
    roughness: Float[Tensor, "*m"]
    emissive: Float[Tensor, "*m 3"]
    normal_scale: Float[Tensor, "*m"]
    occlusion_strength: Float[Tensor, "*m"]
    alpha_mode: Int[Tensor, "*m"]
    alpha_cutoff: Float[Tensor, "*m"]
    double_sided: Bool[Tensor, "*m"]
    base_color_texture: Int[Tensor, "*m"]
    metallic_roughness_texture: Int[Tensor, "*m"]
    normal_texture: Int[Tensor, "*m"]
    occlusion_texture: Int[Tensor, "*m"]
    emissive_texture: Int[Tensor, "*m"]


@dataclass(frozen=True)
class Lights:
    """n lights of KHR_lights_punctual; `direction` is the way the light travels, `range` may be inf."""

    kind: Int[Tensor, " n"]
    position: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    intensity: Float[Tensor, "n 3"]
    range: Float[Tensor, " n"]
    cos_inner: Float[Tensor, " n"]
    cos_outer: Float[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class SceneImage:
    """A decoded picture, and how it is wrapped in u and v."""

    name: str
    texels: UInt8[np.ndarray, "h w c"]
    wrap: tuple[str, str]
    srgb: bool


@dataclass(frozen=True)
class Scene:
    """One triangle mesh in the world with a material for each triangle, and lights.

    The bitangent of a normal map is w cross(normal, tangent), w the fourth number of `tangents`.
    """

    positions: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]
    tangents: Float[Tensor, "v 4"]
    uv: Float[Tensor, "v 2"]
    colors: Float[Tensor, "v 4"]
    faces: Int[Tensor, "t 3"]
    material_id: Int[Tensor, " t"]
    material: Material
    lights: Lights
    cameras: tuple[Camera, ...]
    name: str
    images: tuple[SceneImage, ...] = ()
    material_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@in_float64
def scene_bounds(scene: Scene) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Lowest and highest coordinates of the vertices that have triangles."""
    used = scene.positions[scene.faces.unique().long()]
    return used.amin(dim=0), used.amax(dim=0)


def whole_scene_camera(
    scene: Scene, *, aspect: int | float = 1.0, azimuth_radians: float = 0.6, elevation_radians: float = 0.35,
    bounds: tuple[Float[Tensor, "3"], Float[Tensor, "3"]] | None = None,
) -> Camera:  # fmt: skip
    """`frame_bounds` of the scene's box, or of another one."""
    low, high = bounds or scene_bounds(scene)
    return frame_bounds(low, high, azimuth_radians=azimuth_radians, elevation_radians=elevation_radians, aspect=aspect)


@in_float64
def inside_camera(scene: Scene, *, fov_y_radians: float = 1.05) -> Camera:
    """In the middle of the scene's box but for its longer side, x or z: 0.85 of the way along it, looking to 0.15.

    Both ends of the view are a fifth of the way up.
    """
    low, high = scene_bounds(scene)
    across, _, ahead = (high - low).unbind()
    share = torch.tensor([0.5, 0.2, 0.5], dtype=low.dtype, device=low.device)
    step = torch.zeros_like(share)
    step[0 if across >= ahead else 2] = 0.35
    eye, target = (low + (share + sign * step) * (high - low) for sign in (1, -1))
    fov = torch.as_tensor(fov_y_radians, dtype=low.dtype, device=low.device)
    return Camera(eye, target, torch.tensor([0.0, 1.0, 0.0], dtype=low.dtype, device=low.device), fov)


@in_float64
def vertex_normals(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "t 3"]) -> Float[Tensor, "*b v 3"]:
    """Direction of Σ area · normal over the faces of each vertex; 0 for a vertex without faces.

    Twice area · normal of a triangle is a × b + b × c + c × a, whichever corner comes first.
    """
    corners = vertices[..., faces.long(), :]
    doubled = torch.linalg.cross(corners, corners.roll(-1, dims=-2)).sum(-2)
    touches = torch.nn.functional.one_hot(faces.long(), vertices.shape[-2]).sum(1).to(vertices.dtype)
    return normalize(torch.einsum("tv,...td->...vd", touches, doubled))


@in_float64
def make_mesh_sequence(
    vertices: Float[Tensor, "f v 3"], faces: Int[Tensor, "t 3"], features: Float[Tensor, "f j"]
) -> MeshSequence:
    """Frames around the normals of each vertex, with the tangent along an edge that is the same in all frames.

    It is the edge to the next corner in the last face that has the vertex for its first corner; if there is none, for
    its second, and then for its third. A vertex without faces has no edge, and its tangent is that of a normal of 0.
    """
    ends: dict[int, tuple[int, int, int]] = {}
    for row, face in enumerate(faces.tolist()):
        for corner, vertex in enumerate(face):
            found = -corner, row, face[(corner + 1) % 3]
            ends[vertex] = max(found, ends.get(vertex, found))
    neighbour = torch.tensor([ends[v][2] if v in ends else v for v in range(vertices.shape[1])], device=vertices.device)
    edges = vertices[:, neighbour] - vertices
    frames = frame_from_normal_tangent(vertex_normals(vertices, faces), edges)
    return MeshSequence(vertices, frames, faces, features)
