"""PLY and OBJ -> `Scene`, read by trimesh from bytes that we have read ourselves.

Colors of an MTL (Kd, Ke) are linear, as in most renderers; vertex colors are 8-bit sRGB. Textures are not read. Where
normals are missing, a PLY (a scan, as a rule) gets smooth ones and an OBJ flat ones. Every material is double-sided.
"""

import io
import pathlib
import warnings
from typing import Any

import numpy as np
import trimesh

from jaxrender.checks import bad_input, check_finite
from jaxrender.io.gltf_accessors import LARGEST_NUMBER
from jaxrender.io.gltf_container import printable, read_file
from jaxrender.io.gltf_scene_materials import plain_materials
from jaxrender.io.surfaces import SceneSurface, merged_scene, no_lights
from jaxrender.scene import Scene
from jaxrender.srgb import decode_srgb

#: Reflectance where a file says none.
_GRAY = (0.8, 0.8, 0.8)
_MAX_MTL_BYTES = 2**24


class _MaterialFolder(trimesh.resolvers.Resolver):
    """What an OBJ may refer to: material files beside it. Everything else does not exist, pictures included.

    The OBJ reader swallows every exception, so what was asked for in vain is remembered.
    """

    def __init__(self, path: pathlib.Path):
        self._folder = path.parent.resolve()
        self.missing: list[str] = []
        self.outside: list[str] = []

    def get(self, name: str) -> bytes:
        """The bytes of a material file."""
        name = name.strip()
        target = (self._folder / name).resolve()
        if not target.is_relative_to(self._folder):
            self.outside.append(printable(name))
        elif target.suffix.lower() != ".mtl":
            self.missing.append(f"texture {printable(name)} left out (textures of an OBJ are not read)")
        elif not target.is_file() or target.stat().st_size > _MAX_MTL_BYTES:
            self.missing.append(f"material file {printable(name)} left out (missing, or too large)")
        else:
            return target.read_bytes()
        raise FileNotFoundError(name)

    def keys(self) -> list[str]:
        """Nothing is listed."""
        return []

    def write(self, name: str, data: Any) -> None:
        """Nothing is written."""
        raise PermissionError(name)

    def namespaced(self, namespace: str) -> "_MaterialFolder":
        """There are no folders inside."""
        return self


def read_mesh_scene(path: pathlib.Path, *, kind: str) -> Scene:
    """Reads "ply" or "obj" as a scene without cameras and lights.

    Raises:
      InputError: if the file is damaged, has no triangles, NaN or indices out of range.
    """
    surfaces, colors, emissive, names, notes = read_mesh_surfaces(path, kind=kind)
    return merged_scene(
        surfaces,
        material=plain_materials(np.array(colors), np.array(emissive)),
        material_names=tuple(names),
        lights=no_lights(),
        cameras=(),
        name=printable(path.stem),
        notes=tuple(notes),
    )


def read_mesh_surfaces(
    path: pathlib.Path, *, kind: str
) -> tuple[list[SceneSurface], list[Any], list[Any], list[str], list[str]]:
    """Surfaces, and by material the base color, the emission and the name; and notes."""
    folder = _MaterialFolder(path)
    meshes = _meshes(path, kind, folder)
    ids: dict[str, int] = {}
    surfaces: list[SceneSurface] = []
    colors: list[Any] = []
    emissive: list[Any] = []
    for mesh in meshes:
        name, color, glow = _material(mesh)
        if name not in ids:
            ids[name] = len(ids)
            colors.append(color)
            emissive.append(glow)
        surfaces.append(_surface(path, mesh, ids[name], smooth=kind == "ply"))
    return surfaces, colors, emissive, list(ids), folder.missing


def _meshes(path: pathlib.Path, kind: str, folder: _MaterialFolder) -> list[trimesh.Trimesh]:
    """The triangle meshes of a file, with vertices and faces as they stand there."""
    data = read_file(path, path, "file")
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            loaded = trimesh.load_scene(
                io.BytesIO(data), file_type=kind, resolver=folder, process=False, maintain_order=True
            )
    # Whatever a damaged file leads to inside the reader, MemoryError included.
    except Exception as error:
        reason = printable(f"{type(error).__name__}: {error}")
        bad_input(path, "content", expected=f"an intact {kind.upper()}", got=reason)
    if folder.outside:
        bad_input(path, "mtllib, map_Kd", expected="a file inside the folder of the OBJ", got=folder.outside[0])
    meshes = [m for m in loaded.geometry.values() if isinstance(m, trimesh.Trimesh) and len(m.faces)]
    if not meshes:
        bad_input(path, "faces", expected="at least one triangle", got="none")
    return meshes


def _material(mesh: trimesh.Trimesh) -> tuple[str, Any, Any]:
    """Name, reflectance and emission of a mesh; vertex colors are white times themselves."""
    material = getattr(mesh.visual, "material", None)
    options = getattr(material, "kwargs", {})
    if _is_colored(mesh):
        return "vertex colors", (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    return (
        printable(getattr(material, "name", None) or "default"),
        _rgb(options.get("kd"), _GRAY, 1.0),
        _rgb(options.get("ke"), (0.0, 0.0, 0.0), LARGEST_NUMBER),
    )


def _is_colored(mesh: trimesh.Trimesh) -> bool:
    return getattr(mesh.visual, "kind", None) in ("vertex", "face")


def _rgb(value: Any, default: tuple, high: float) -> Any:
    """Three numbers of an MTL in [0, high]; the default for anything else."""
    try:
        rgb = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return default
    return np.clip(rgb, 0.0, high) if rgb.shape == (3,) and np.isfinite(rgb).all() else default


def _surface(path: pathlib.Path, mesh: trimesh.Trimesh, material_id: int, *, smooth: bool) -> SceneSurface:
    positions = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    if faces.min() < 0 or faces.max() >= len(positions):
        bad_input(path, "faces", expected=f"indices below {len(positions)}", got=f"{faces.min()}..{faces.max()}")
    used = positions[np.unique(faces)]
    check_finite(path, "vertices", used)
    if np.abs(used).max() > LARGEST_NUMBER:
        bad_input(path, "vertices", expected=f"numbers up to {LARGEST_NUMBER:g}", got=f"{np.abs(used).max():g}")
    positions = np.nan_to_num(positions, posinf=0.0, neginf=0.0)
    uv, colors = _uv(mesh), _colors(mesh)
    normals = _file_normals(mesh)
    if normals is None and not smooth:
        corners = faces.ravel()
        positions, uv, colors = positions[corners], uv[corners], colors[corners]
        faces = np.arange(len(corners)).reshape(-1, 3)
    of_faces = _area_normals(positions, faces)
    normals = of_faces if normals is None else normals
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    good = (length > 1e-6) & np.isfinite(length)
    normals = np.where(good, normals / np.where(good, length, 1.0), of_faces)
    return SceneSurface(positions, normals, None, uv, colors, faces, np.full(len(faces), material_id))


def _file_normals(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """The vertex normals of the file; trimesh would compute them where there are none."""
    normals = mesh._cache.cache.get("vertex_normals")
    return None if normals is None or np.shape(normals) != np.shape(mesh.vertices) else np.asarray(normals, np.float64)


def _area_normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals from the faces, weighted by area; +z where there is none."""
    a, b, c = (positions[faces[:, i]] for i in range(3))
    weighted = np.cross(b - a, c - a)
    total = np.zeros_like(positions)
    for axis in range(3):
        total[:, axis] = np.bincount(faces.ravel(), np.repeat(weighted[:, axis], 3), len(positions))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), [[0.0, 0.0, 1.0]])


def _uv(mesh: trimesh.Trimesh) -> np.ndarray:
    """Texture coordinates with v down, as in `Scene`; zeros where there are none."""
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or np.shape(uv)[:1] != (len(mesh.vertices),) or np.ndim(uv) != 2 or np.shape(uv)[1] < 2:
        return np.zeros((len(mesh.vertices), 2))
    uv = np.nan_to_num(np.asarray(uv, np.float64)[:, :2], posinf=0.0, neginf=0.0)
    return np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)


def _colors(mesh: trimesh.Trimesh) -> np.ndarray:
    """Vertex colors as linear RGBA; ones where there are none. Colors of faces go to their corners."""
    colors = np.ones((len(mesh.vertices), 4))
    if _is_colored(mesh):
        bytes_ = np.asarray(mesh.visual.vertex_colors, np.float64) / 255.0  # type: ignore[union-attr]
        colors = np.concatenate([decode_srgb(bytes_[:, :3]), bytes_[:, 3:4]], axis=1)
    return colors
