"""What goes into the methods: meshes, and meshes that move."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.vecmath import frame_from_normal_tangent, normalize


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
