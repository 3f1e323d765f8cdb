"""glTF 2.0 and GLB -> `Scene`: every mesh of the default scene in world space, materials, lights and cameras.

The scene stands still: skinned meshes are shown in the pose of their nodes (`gltf_animated` plays the clips), morph
targets are not applied. Supported of a mesh: everything `read_gltf` supports, with or without indices, normals,
tangents, two or more sets of texture coordinates, KHR_texture_transform and vertex colors; KHR_lights_punctual.
"""

import math
import os
import pathlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxrender.animation.animated_scene import camera_at
from jaxrender.camera import Camera
from jaxrender.io.gltf_accessors import LARGEST_NUMBER, one_a_vertex, read_floats
from jaxrender.io.gltf_container import Container, printable
from jaxrender.io.gltf_meshes import (
    checked_influences,
    read_influences,
    read_normals,
    read_triangles,
    unit_normals,
)
from jaxrender.io.gltf_nodes import NodeGraph, Palette, read_nodes, scene_nodes
from jaxrender.io.gltf_scene_materials import Coordinates, MaterialTable, read_materials
from jaxrender.io.gltf_textures import MissingTexture, transformed
from jaxrender.io.surfaces import SceneSurface, merged_scene, no_lights, on_device
from jaxrender.scene import DIRECTIONAL, POINT, SPOT, Lights, Scene

_LIGHTS = "KHR_lights_punctual"


@dataclass(frozen=True)
class GltfPart:
    """A primitive on a node, in the space of its mesh.

    `joints` are the entries of the palette that carry each vertex, and `weights` their shares; one row for all vertices
    of a rigid mesh.
    """

    surface: SceneSurface
    joints: Int[np.ndarray, "_ k"]
    weights: Float[np.ndarray, "_ k"]
    where: str


@dataclass(frozen=True)
class GltfScene:
    """The scene of a file before it takes a pose.

    `light_nodes` and `camera_nodes` are those of the default scene with a light, and with a perspective camera, in the
    order of `Scene.lights` and `Scene.cameras`.
    """

    source: Container
    graph: NodeGraph
    palette: Palette
    table: MaterialTable
    parts: list[GltfPart]
    light_nodes: list[int]
    camera_nodes: list[int]


def read_gltf_scene(path: str | os.PathLike) -> Scene:
    """Reads a scene from a .gltf or .glb file.

    The file may be anything, as in `read_gltf`. Material ids are indices into the materials of the file; one more
    stands for the default material, if a primitive needs it.

    Raises:
      InputError: naming the file, the field, what was expected and what came.
    """
    return rest_scene(open_gltf_scene(path))


def open_gltf_scene(path: str | os.PathLike) -> GltfScene:
    """Everything that `read_gltf_scene` needs of a file but the pose."""
    source = Container(pathlib.Path(path))
    graph = read_nodes(source)
    nodes = scene_nodes(source, graph)
    instances = [
        (node, primitive, where)
        for node in nodes
        if source.gltf.nodes[node].mesh is not None
        for primitive, where in _primitives(source, node)
    ]
    table = read_materials(source, with_default=any(primitive.material is None for _, primitive, _ in instances))
    palette = Palette(source)
    read = [_read_part(source, *instance, palette, table) for instance in instances]
    parts = [part for part in read if part is not None]
    if not parts:
        left_out = "; ".join(source.notes) or "no mesh in the scene"
        source.bad("meshes", expected="at least one triangle", got=left_out)
    return GltfScene(
        source, graph, palette, table, parts, _light_nodes(source, nodes), _camera_nodes(source, nodes)
    )  # fmt: skip


def rest_scene(opened: GltfScene) -> Scene:
    """The scene in the pose of its nodes, in world space."""
    source, table, world = opened.source, opened.table, opened.graph.world_matrices()
    with np.errstate(all="ignore"):
        palette = world[opened.palette.nodes] @ opened.palette.inverse_binds()
    return merged_scene(
        [_moved(source, part.surface, _blended(source, part, palette), part.where) for part in opened.parts],
        material=table.material,
        material_names=table.names,
        images=table.images,
        lights=_read_lights(source, opened.light_nodes, world),
        cameras=_read_cameras(source, opened.camera_nodes, world),
        name=printable(source.path.stem),
        notes=source.notes,
    )


def _primitives(source: Container, node: int) -> list[tuple[Any, str]]:
    index = source.gltf.nodes[node].mesh
    mesh = source.item("meshes", index, f"nodes[{node}].mesh")
    return [(p, f"meshes[{index}].primitives[{i}]") for i, p in enumerate(mesh.primitives)]


def _read_part(
    source: Container, node: int, primitive: Any, where: str, palette: Palette, table: MaterialTable
) -> GltfPart | None:
    """One primitive, or None if it has no triangles."""
    triangles = read_triangles(source, primitive, where)
    if triangles is None:
        return None
    if primitive.targets:
        source.note("meshes with morph targets, shown without them")
    attributes, positions, faces = triangles
    if not len(faces):
        return None
    v = len(positions)
    if primitive.material is None:
        material_id = len(table.names) - 1
    else:
        source.item("materials", primitive.material, f"{where}.material")
        material_id = primitive.material
    normals = read_normals(source, attributes, v, where)
    uv = _read_uv(source, attributes, table.coordinates[material_id], v, where)
    colors = _read_colors(source, attributes, v, where)
    tangents = _read_tangents(source, attributes, v, where)
    joints, weights = _read_carriers(source, node, attributes, palette, v, where)
    if "NORMAL" not in attributes:
        # glTF asks for flat shading: every corner is a vertex of its own.
        corners = faces.ravel()
        positions, normals, uv, colors = (x[corners] for x in (positions, normals, uv, colors))
        tangents = None
        if len(joints) > 1:
            joints, weights = joints[corners], weights[corners]
        faces = np.arange(len(corners)).reshape(-1, 3)
    normals = unit_normals(source, positions, normals, faces)
    surface = SceneSurface(positions, normals, tangents, uv, colors, faces, np.full(len(faces), material_id))
    return GltfPart(surface, joints, weights, where)


def _read_uv(source: Container, attributes: dict, wanted: Coordinates, num_vertices: int, where: str) -> np.ndarray:
    """The coordinates that a material's textures want, transformed; TEXCOORD_0 for one without; else zeros."""
    name = wanted.attribute or "TEXCOORD_0"
    if name not in attributes:
        if wanted.attribute:
            source.note(f"textured meshes without {printable(name)}")
        return np.zeros((num_vertices, 2), np.float32)
    uv = read_floats(source, attributes[name], ("VEC2",), f"{where}.{name}")
    uv = one_a_vertex(source, uv, num_vertices, f"{where}.{name}")
    if not wanted.transform:
        return uv
    try:
        return transformed(uv, wanted.transform).astype(np.float32)
    except MissingTexture as reason:
        source.note(f"texture transforms left out ({reason})")
        return uv


def _read_colors(source: Container, attributes: dict, num_vertices: int, where: str) -> np.ndarray:
    colors = np.ones((num_vertices, 4), np.float32)
    if "COLOR_0" in attributes:
        values = read_floats(source, attributes["COLOR_0"], ("VEC3", "VEC4"), f"{where}.COLOR_0")
        values = one_a_vertex(source, values, num_vertices, f"{where}.COLOR_0")
        colors[:, : values.shape[1]] = np.clip(values, 0.0, 1.0)
    return colors


def _read_tangents(source: Container, attributes: dict, num_vertices: int, where: str) -> np.ndarray | None:
    if "TANGENT" not in attributes:
        return None
    tangents = read_floats(source, attributes["TANGENT"], ("VEC4",), f"{where}.TANGENT")
    return one_a_vertex(source, tangents, num_vertices, f"{where}.TANGENT")


def _read_carriers(
    source: Container, node: int, attributes: dict, palette: Palette, num_vertices: int, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """`GltfPart.joints` and `weights`."""
    skin = source.gltf.nodes[node].skin
    if skin is None:
        return np.full((1, 1), palette.rigid(node)), np.ones((1, 1), np.float32)
    first, num_joints = palette.skin(skin, f"nodes[{node}].skin")
    joints, weights = read_influences(source, attributes, num_vertices, where)
    joints, weights = checked_influences(source, joints, weights, np.arange(num_vertices), num_joints, where)
    return joints + first, weights


def _blended(source: Container, part: GltfPart, palette: np.ndarray) -> np.ndarray:
    """World from mesh: one matrix, or with a skin one for each vertex."""
    source.spend(16 * len(part.joints), part.where)
    blended = np.zeros((len(part.joints), 4, 4))
    with np.errstate(all="ignore"):
        for k in range(part.weights.shape[1]):
            blended += part.weights[:, k, None, None] * palette[part.joints[:, k]]
    return blended


def _moved(source: Container, surface: SceneSurface, matrices: np.ndarray, where: str) -> SceneSurface:
    """The surface in world space. Faces that the transform mirrors are turned round: the outside stays outside."""
    linear = matrices[:, :3, :3]
    with np.errstate(all="ignore"):
        positions = np.einsum("vij,vj->vi", linear, surface.positions) + matrices[:, :3, 3]
        if not (np.abs(positions) <= LARGEST_NUMBER).all():
            source.bad(f"{where}, in world space", expected=f"within {LARGEST_NUMBER:g}", got="beyond or NaN")
        # Cofactors are the inverse transpose times the determinant, and are there for a flattened mesh too.
        rows = [np.cross(linear[:, (i + 1) % 3], linear[:, (i + 2) % 3]) for i in range(3)]
        cofactors = np.stack(rows, axis=1)
        determinant = np.sum(linear[:, 0] * cofactors[:, 0], axis=-1)
        sign = np.broadcast_to(np.where(determinant < 0, -1.0, 1.0), len(positions))
        normals = sign[:, None] * np.einsum("vij,vj->vi", cofactors, surface.normals)
    mirrored = sign[surface.faces].sum(axis=1) < 0
    faces = np.where(mirrored[:, None], surface.faces[:, [0, 2, 1]], surface.faces)
    tangents = surface.tangents
    if tangents is not None:
        along = np.einsum("vij,vj->vi", linear, tangents[:, :3])
        tangents = np.concatenate([along, sign[:, None] * np.where(tangents[:, 3:] < 0, -1.0, 1.0)], axis=1)
    return SceneSurface(positions, _unit(normals), tangents, surface.uv, surface.colors, faces, surface.material_id)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Rows at length 1; +z where there is none."""
    scale = np.abs(vectors).max(axis=-1, keepdims=True)
    good = (scale > 0) & np.isfinite(scale)
    vectors = np.where(good, vectors / np.where(good, scale, 1.0), [[0.0, 0.0, 1.0]])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _light_nodes(source: Container, nodes: list[int]) -> list[int]:
    return [node for node in nodes if source.gltf.nodes[node].extensions.get(_LIGHTS) is not None]


def _camera_nodes(source: Container, nodes: list[int]) -> list[int]:
    """Those with a perspective camera; says that there are others."""
    found = []
    for node in nodes:
        index = source.gltf.nodes[node].camera
        if index is None:
            continue
        if source.item("cameras", index, f"nodes[{node}].camera").perspective is None:
            source.note("orthographic cameras left out")
        else:
            found.append(node)
    return found


def _read_cameras(source: Container, nodes: list[int], world: np.ndarray) -> tuple[Camera, ...]:
    """The perspective cameras on nodes; scale and the file's own clipping planes do not count."""
    cameras = []
    for node in nodes:
        field = f"cameras[{source.gltf.nodes[node].camera}]"
        record = source.item("cameras", source.gltf.nodes[node].camera, f"nodes[{node}].camera")
        fov = _number(source, record.perspective.yfov, None, f"{field}.perspective.yfov")
        if not 0.0 < fov < math.pi:
            source.bad(f"{field}.perspective.yfov", expected="an angle between 0 and π", got=fov)
        eye, _, up, backward = _placed(source, world[node], f"nodes[{node}]")
        cameras.append(camera_at(eye, up, backward, fov))
    return tuple(cameras)


def _read_lights(source: Container, nodes: list[int], world: np.ndarray) -> Lights:
    """The lights of KHR_lights_punctual on nodes."""
    declared = _dictionary(source.gltf.extensions.get(_LIGHTS)).get("lights", [])
    rows = []
    for node in nodes:
        where = f"nodes[{node}].{_LIGHTS}.light"
        index = _dictionary(source.gltf.nodes[node].extensions.get(_LIGHTS)).get("light")
        if not isinstance(declared, list) or type(index) is not int or not 0 <= index < len(declared):
            source.bad(where, expected="the index of a light", got=index)
        source.spend(16, where)
        rows.append(_light(source, _dictionary(declared[index]), world[node], node, f"{_LIGHTS}.lights[{index}]"))
    return _stacked(rows) if rows else no_lights()


@dataclass(frozen=True)
class _Light:
    """A row of `Lights`."""

    kind: int
    position: np.ndarray
    direction: np.ndarray
    intensity: np.ndarray
    range: float
    cos_inner: float
    cos_outer: float


def _light(source: Container, record: dict, world: np.ndarray, node: int, field: str) -> _Light:
    kinds = {"directional": DIRECTIONAL, "point": POINT, "spot": SPOT}
    kind = record.get("type")
    if not isinstance(kind, str) or kind not in kinds:
        source.bad(f"{field}.type", expected="directional, point or spot", got=kind)
    color = record.get("color", [1.0, 1.0, 1.0])
    if not isinstance(color, list) or len(color) != 3:
        source.bad(f"{field}.color", expected="3 numbers", got=color)
    rgb = np.array([_number(source, c, None, f"{field}.color") for c in color])
    intensity = _number(source, record.get("intensity"), 1.0, f"{field}.intensity")
    distance = _number(source, record.get("range"), math.inf, f"{field}.range")
    spot = _dictionary(record.get("spot"))
    inner = _number(source, spot.get("innerConeAngle"), 0.0, f"{field}.spot.innerConeAngle")
    outer = _number(source, spot.get("outerConeAngle"), math.pi / 4, f"{field}.spot.outerConeAngle")
    if kind == "spot" and not 0.0 <= inner < outer <= 0.5 * math.pi + 1e-6:
        source.bad(f"{field}.spot", expected="0 <= innerConeAngle < outerConeAngle <= π/2", got=f"{inner}, {outer}")
    if intensity < 0.0 or (rgb < 0.0).any() or distance <= 0.0:
        source.bad(field, expected="intensity and color >= 0, range > 0", got=f"{intensity}, {color}, {distance}")
    eye, _, _, backward = _placed(source, world, f"nodes[{node}]")
    return _Light(
        kinds[kind],
        np.zeros(3) if kind == "directional" else eye,
        np.array([0.0, 0.0, -1.0]) if kind == "point" else -backward,
        intensity * rgb,
        distance,
        math.cos(inner) if kind == "spot" else -1.0,
        math.cos(outer) if kind == "spot" else -1.0,
    )


def _stacked(rows: list[_Light]) -> Lights:
    """Lights one by one -> the record of them all."""
    columns = {name: np.array([getattr(row, name) for row in rows]) for name in vars(rows[0])}
    return Lights(**{name: on_device(column) for name, column in columns.items()})


def _placed(source: Container, world: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Origin and unit axes x, y, z of a node."""
    if not (np.abs(world) <= LARGEST_NUMBER).all():
        source.bad(f"{where}, in world space", expected=f"within {LARGEST_NUMBER:g}", got="beyond or NaN")
    x, y, z = _unit(world[:3, :3].T)
    return world[:3, 3], x, y, z


def _number(source: Container, value: Any, default: float | None, where: str) -> float:
    """A finite number; a missing one is the default, if there is one."""
    if value is None and default is not None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST_NUMBER:
        source.bad(where, expected="a finite number", got=value)
    return float(value)


def _dictionary(value: Any) -> dict:
    return value if isinstance(value, dict) else {}
