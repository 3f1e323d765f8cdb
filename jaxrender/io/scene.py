"""One door for scenes: glTF, GLB, PLY, OBJ, or a scene.json that puts OBJ files together."""

import pathlib

from jaxrender.animation.animated_scene import AnimatedScene
from jaxrender.checks import bad_input
from jaxrender.io.gltf_animated import read_gltf_animated
from jaxrender.io.gltf_scene import read_gltf_scene
from jaxrender.io.mesh_files import read_mesh_scene
from jaxrender.io.scene_json import read_json_scene
from jaxrender.scene import Scene


def load_scene(path: str | pathlib.Path) -> Scene:
    """Reads a scene at rest: one triangle mesh in world space, materials, pictures, lights and cameras.

    Args:
      path: glTF 2.0 (.gltf, .glb), .ply, .obj, or .json as described in `jaxrender.io.scene_json`; GLB and PLY are
        told by content, the others by their ending.
    Raises:
      InputError: if the file is none of these, is damaged, or refers to a file outside its folder. A picture that
        is missing or damaged is a line in `Scene.notes` instead.
      OSError: if it cannot be read.
    """
    path, start, ending = _looked_at(path)
    if _is_gltf(start, ending):
        return read_gltf_scene(path)
    if start[:3] == b"ply":
        return read_mesh_scene(path, kind="ply")
    if ending == ".obj":
        return read_mesh_scene(path, kind="obj")
    if ending == ".json":
        return read_json_scene(path)
    return bad_input(
        path, "file", expected="a scene (glTF, GLB, PLY, OBJ or scene.json)", got=f"ending {ending or 'none'}"
    )


def load_animated_scene(path: str | pathlib.Path) -> AnimatedScene:
    """Reads a scene with the clips that move it: skinned characters, rigid parts, lights and cameras.

    Args:
      path: glTF 2.0 (.gltf, .glb).
    Raises:
      InputError: if the file is no glTF, or as in `load_scene`.
      OSError: if it cannot be read.
    """
    path, start, ending = _looked_at(path)
    if _is_gltf(start, ending):
        return read_gltf_animated(path)
    return bad_input(path, "file", expected="a scene with clips (glTF or GLB)", got=f"ending {path.suffix or 'none'}")


def _looked_at(path: str | pathlib.Path) -> tuple[pathlib.Path, bytes, str]:
    """The path, the first bytes of the file, and its ending in small letters."""
    path = pathlib.Path(path)
    with open(path, "rb") as file:
        return path, file.read(4), path.suffix.lower()


def _is_gltf(start: bytes, ending: str) -> bool:
    return start == b"glTF" or ending in (".gltf", ".glb")
