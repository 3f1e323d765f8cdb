"""A scene of OBJ files that a small JSON puts together: colors, emission and a camera (the Cornell box comes so).

    {"camera": {"origin": [..], "target": [..], "up": [..], "fov_degrees_smaller_axis": 39.3},
     "shapes": [{"file": "floor.obj", "translate": [..], "reflectance": [r, g, b], "emission_radiance": [r, g, b]}]}

`translate` and `emission_radiance` may be missing. Lengths stay in the unit of the file. The camera's angle becomes
the vertical one, which is right for pictures that are at least as wide as high.
"""

import json
import pathlib
from dataclasses import replace
from typing import Any

import numpy as np

from jaxrender.camera import Camera
from jaxrender.checks import bad_input
from jaxrender.io.gltf_accessors import LARGEST_NUMBER
from jaxrender.io.gltf_container import printable, read_file
from jaxrender.io.gltf_scene_materials import plain_materials
from jaxrender.io.mesh_files import read_mesh_surfaces
from jaxrender.io.surfaces import SceneSurface, merged_scene, no_lights, on_device
from jaxrender.scene import Scene

_MAX_SHAPES = 10_000


def read_json_scene(path: pathlib.Path) -> Scene:
    """Reads such a scene; every shape is one material.

    Raises:
      InputError: if the JSON or one of its files is damaged, or a file lies outside the folder.
    """
    document = _parsed(path)
    surfaces: list[SceneSurface] = []
    colors, emissive, names, notes = [], [], [], []
    for i, shape in enumerate(document["shapes"]):
        field = f"shapes[{i}]"
        if not isinstance(shape, dict):
            bad_input(path, field, expected="an object", got=printable(shape))
        file = _inside_folder(path, shape.get("file"), f"{field}.file")
        shift = _numbers(path, shape.get("translate", [0, 0, 0]), 3, f"{field}.translate")
        colors.append(np.clip(_numbers(path, shape.get("reflectance"), 3, f"{field}.reflectance"), 0.0, 1.0))
        glow = _numbers(path, shape.get("emission_radiance", [0, 0, 0]), 3, f"{field}.emission_radiance")
        emissive.append(np.maximum(glow, 0.0))
        names.append(printable(file.stem))
        parts, _, _, _, left_out = read_mesh_surfaces(file, kind="obj")
        notes += left_out
        surfaces += [replace(p, positions=p.positions + shift, material_id=np.full(len(p.faces), i)) for p in parts]
    return merged_scene(
        surfaces,
        material=plain_materials(np.array(colors), np.array(emissive)),
        material_names=tuple(names),
        lights=no_lights(),
        cameras=_cameras(path, document.get("camera")),
        name=printable(path.resolve().parent.name if path.stem == "scene" else path.stem),
        notes=tuple(notes),
    )


def _parsed(path: pathlib.Path) -> dict[str, Any]:
    try:
        document = json.loads(read_file(path, path, "file"))
    except (ValueError, RecursionError) as error:
        bad_input(path, "JSON", expected="a valid document", got=printable(error))
    shapes = document.get("shapes") if isinstance(document, dict) else None
    if not isinstance(shapes, list) or not 0 < len(shapes) <= _MAX_SHAPES:
        bad_input(path, "shapes", expected=f"a list of 1 to {_MAX_SHAPES}", got=printable(shapes))
    return document


def _inside_folder(path: pathlib.Path, name: Any, field: str) -> pathlib.Path:
    if not isinstance(name, str) or not name.lower().endswith(".obj"):
        bad_input(path, field, expected="the name of an OBJ file", got=printable(name))
    folder = path.parent.resolve()
    try:
        target = (folder / name).resolve()
        inside = target.is_relative_to(folder)
    except (OSError, ValueError, RuntimeError):
        inside = False
    if not inside:
        bad_input(path, field, expected="a file inside the folder of the scene", got=printable(name))
    return target


def _cameras(path: pathlib.Path, record: Any) -> tuple[Camera, ...]:
    if record is None:
        return ()
    if not isinstance(record, dict):
        bad_input(path, "camera", expected="an object", got=printable(record))
    vectors = [_numbers(path, record.get(key), 3, f"camera.{key}") for key in ("origin", "target", "up")]
    field = "fov_degrees_smaller_axis"
    (degrees,) = _numbers(path, [record.get(field)], 1, f"camera.{field}")
    if not 0.0 < degrees < 180.0:
        bad_input(path, f"camera.{field}", expected="an angle between 0 and 180", got=degrees)
    eye, target, up = (on_device(v) for v in vectors)
    return (Camera(eye, target, up, on_device(np.radians(degrees))),)


def _numbers(path: pathlib.Path, value: Any, count: int, field: str) -> np.ndarray:
    plain = isinstance(value, list) and all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)
    if not plain or len(value) != count or not all(abs(x) <= LARGEST_NUMBER for x in value):
        bad_input(path, field, expected=f"{count} finite numbers", got=printable(value))
    return np.array(value, np.float64)
