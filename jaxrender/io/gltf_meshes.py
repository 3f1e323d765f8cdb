"""glTF primitives -> triangle surfaces with normals, albedo and influences."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64

from jaxrender.io.gltf_accessors import read_floats, read_integers
from jaxrender.io.gltf_container import Container
from jaxrender.io.gltf_materials import read_albedo

# A triangle whose height is this share of its longest side is a line, as far as float32 can tell.
_FLATNESS = 1e-7
_WEIGHT_TOLERANCE = 1e-2
# A mesh may be instanced and an accessor read very often: this much of `Container.spend` each time.
_COST_OF_A_PRIMITIVE = 1000
_POINTS_AND_LINES, _TRIANGLES, _STRIP, _FAN = (0, 1, 2, 3), 4, 5, 6


@dataclass(frozen=True)
class Surface:
    """One primitive. `joints` count within the skin of its node; `weights` sum to 1."""

    vertices: Float32[np.ndarray, "v 3"]
    normals: Float32[np.ndarray, "v 3"]
    faces: Int64[np.ndarray, "t 3"]
    albedo: Float32[np.ndarray, "v 3"]
    joints: Int64[np.ndarray, "v k"]
    weights: Float32[np.ndarray, "v k"]


def read_surface(source: Container, primitive: Any, num_joints: int | None, where: str) -> Surface | None:
    """The triangles of a primitive, or None if it has none.

    Args:
      num_joints: of the skin of its node; None for a rigid mesh, which gets weight 1 on entry 0.
    """
    if primitive.targets:
        source.bad(f"{where}.targets", expected="no morph targets (not supported)", got=len(primitive.targets))
    triangles = read_triangles(source, primitive, where)
    if triangles is None:
        return None
    attributes, vertices, faces = triangles
    faces = _without_flat_ones(source, vertices, faces)
    if not len(faces):
        return None
    if num_joints is None:
        joints, weights = np.zeros((len(vertices), 1), np.int64), np.ones((len(vertices), 1), np.float32)
    else:
        joints, weights = read_influences(source, attributes, len(vertices), where)
    surface = Surface(
        vertices=vertices,
        normals=read_normals(source, attributes, len(vertices), where),
        faces=faces,
        albedo=read_albedo(source, attributes, primitive.material, len(vertices), where),
        joints=joints,
        weights=weights,
    )
    # Without normals glTF asks for flat shading: every corner is a vertex of its own.
    flat = "NORMAL" not in attributes
    kept = faces.ravel() if flat else np.unique(faces)
    surface = _gathered(surface, kept, flat=flat)
    normals = unit_normals(source, surface.vertices, surface.normals, surface.faces)
    joints, weights = checked_influences(source, surface.joints, surface.weights, kept, num_joints or 1, where)
    return replace(surface, normals=normals, joints=joints, weights=weights)


def read_triangles(
    source: Container, primitive: Any, where: str
) -> tuple[dict[str, Any], Float32[np.ndarray, "v 3"], Int64[np.ndarray, "t 3"]] | None:
    """The attributes of a primitive by name, its positions and faces; None if it is of points or lines."""
    attributes = _attributes(source, primitive, where)
    source.spend(_COST_OF_A_PRIMITIVE, where)
    if "KHR_draco_mesh_compression" in primitive.extensions:
        if source.item("accessors", attributes["POSITION"], f"{where}.POSITION").bufferView is None:
            source.bad(where, expected="uncompressed data", got="Draco only (KHR_draco_mesh_compression)")
    if primitive.mode in _POINTS_AND_LINES:
        source.note("primitives of points or lines left out")
        return None
    vertices = read_floats(source, attributes["POSITION"], ("VEC3",), f"{where}.POSITION")
    return attributes, vertices, _read_faces(source, primitive, len(vertices), where)


def _attributes(source: Container, primitive: Any, where: str) -> dict[str, Any]:
    found = primitive.attributes
    named = vars(found) if hasattr(found, "__dict__") else {}
    named = {name: index for name, index in named.items() if index is not None}
    if "POSITION" not in named:
        source.bad(f"{where}.attributes", expected="a POSITION", got=", ".join(sorted(named)) or "none")
    return named


def _read_faces(source: Container, primitive: Any, num_vertices: int, where: str) -> np.ndarray:
    if primitive.indices is None:
        corners = np.arange(num_vertices)
    else:
        corners = read_integers(source, primitive.indices, ("SCALAR",), f"{where}.indices")[:, 0]
        if corners.max() >= num_vertices:
            source.bad(f"{where}.indices", expected=f"indices below {num_vertices}", got=corners.max())
    mode = _TRIANGLES if primitive.mode is None else primitive.mode
    if mode == _TRIANGLES:
        if len(corners) % 3:
            source.bad(f"{where}.indices", expected="a multiple of 3 corners", got=len(corners))
        return corners.reshape(-1, 3)
    start = np.arange(max(len(corners) - 2, 0))
    if mode == _STRIP:  # every second triangle is wound the other way round
        odd = start % 2
        return np.stack([corners[start], corners[start + 1 + odd], corners[start + 2 - odd]], axis=-1)
    if mode == _FAN:
        return np.stack([corners[start + 1], corners[start + 2], np.broadcast_to(corners[0], start.shape)], axis=-1)
    return source.bad(f"{where}.mode", expected="0 to 6", got=mode)


def _without_flat_ones(source: Container, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces that have an area."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    longest = np.max([((q - p) ** 2).sum(-1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    keep = area > _FLATNESS * longest
    source.note("zero-area faces dropped", int((~keep).sum()))
    return faces[keep]


def read_normals(source: Container, attributes: dict[str, Any], num_vertices: int, where: str) -> np.ndarray:
    """The normals of the file, zeros if it has none."""
    if "NORMAL" not in attributes:
        return np.zeros((num_vertices, 3), np.float32)
    normals = read_floats(source, attributes["NORMAL"], ("VEC3",), f"{where}.NORMAL")
    if len(normals) != num_vertices:
        source.bad(f"{where}.NORMAL", expected=f"{num_vertices} elements, as POSITION has", got=len(normals))
    return normals


def read_influences(
    source: Container, attributes: dict[str, Any], num_vertices: int, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights of all sets side by side, as the file has them."""
    joints: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    while f"JOINTS_{len(joints)}" in attributes or not joints:
        n = len(joints)
        for name in (f"JOINTS_{n}", f"WEIGHTS_{n}"):
            if name not in attributes:
                source.bad(f"{where}.attributes", expected=f"{name} on a skinned mesh", got="none")
        joints.append(read_integers(source, attributes[f"JOINTS_{n}"], ("VEC4",), f"{where}.JOINTS_{n}"))
        weights.append(read_floats(source, attributes[f"WEIGHTS_{n}"], ("VEC4",), f"{where}.WEIGHTS_{n}"))
        for values in (joints[-1], weights[-1]):
            if len(values) != num_vertices:
                expected = f"{num_vertices} elements, as POSITION has"
                source.bad(f"{where}.JOINTS_{n}, WEIGHTS_{n}", expected=expected, got=len(values))
    return np.concatenate(joints, axis=1), np.concatenate(weights, axis=1)


def _gathered(surface: Surface, kept: np.ndarray, *, flat: bool) -> Surface:
    """The surface with vertices `kept` only: one a corner if `flat`, else each once, in order."""
    if flat:
        faces = np.arange(len(kept)).reshape(-1, 3)
    else:
        faces = np.searchsorted(kept, surface.faces)
    return Surface(
        vertices=surface.vertices[kept],
        normals=surface.normals[kept],
        faces=faces,
        albedo=surface.albedo[kept],
        joints=surface.joints[kept],
        weights=surface.weights[kept],
    )


def unit_normals(
    source: Container, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray
) -> Float32[np.ndarray, "v 3"]:
    """The normals at length 1; where there is none, that of a face at the vertex."""
    normals = normals.astype(np.float64)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    lost = length[:, 0] < 1e-6
    if not lost.all():
        source.note("zero normals replaced by face normals", int(lost.sum()))
    of_face = np.zeros_like(normals)
    of_face[faces.ravel()] = np.repeat(_face_normals(vertices, faces), 3, axis=0)
    return np.where(lost[:, None], of_face, normals / np.where(lost[:, None], 1.0, length)).astype(np.float32)


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> Float64[np.ndarray, "t 3"]:
    """Unit normals of faces; that of a face without area is +z."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    return np.where(length > 0, cross / np.where(length > 0, length, 1.0), [[0.0, 0.0, 1.0]])


def checked_influences(
    source: Container, joints: np.ndarray, weights: np.ndarray, original: np.ndarray, num_joints: int, where: str
) -> tuple[Int64[np.ndarray, "v k"], Float32[np.ndarray, "v k"]]:
    """Joints and weights that sum to 1, the largest first, without columns that no vertex needs.

    InputError names the first vertex that is wrong.
    """
    for wrong, field, expected, values in (
        ((weights < 0).any(axis=1), "WEIGHTS", "weights >= 0", weights),
        ((joints >= num_joints) & (weights > 0), "JOINTS", f"indices below {num_joints}", joints),
        (np.abs(weights.sum(axis=1) - 1.0) > _WEIGHT_TOLERANCE, "WEIGHTS", "a sum of 1", weights),
    ):
        vertices = np.flatnonzero(wrong.reshape(len(weights), -1).any(axis=1))
        if len(vertices):
            row = vertices[0]
            got = f"{values[row].tolist()} at vertex {original[row]}"
            source.bad(f"{where}.{field}", expected=expected, got=got)
    total = weights.astype(np.float64).sum(axis=1, keepdims=True)
    # 8-bit weights are off by up to 1/128; rounding of float32 ones is not worth a word.
    source.note("vertices whose weights were renormalized", int((np.abs(total - 1.0) > 1e-5).sum()))
    largest_first = np.argsort(-weights, axis=1, kind="stable")
    largest_first = largest_first[:, : int((weights > 0).sum(axis=1).max())]
    weights = np.take_along_axis(weights / total, largest_first, axis=1).astype(np.float32)
    joints = np.take_along_axis(joints, largest_first, axis=1)
    return np.where(weights > 0, joints, 0), weights
