"""The trained model as a file: safetensors with a JSON header, written whole or not at all."""

import dataclasses
import json
from pathlib import Path
from types import NoneType
from typing import Any

import jax.numpy as jnp
import numpy as np
from safetensors.numpy import save

from fitting.config import TrainSettings
from fitting.solve import ORDER
from fitting.train import TrainResult
from jaxrender.animation.skinning import Character
from jaxrender.checks import bad_input
from jaxrender.harmonics.pose_model import FORMAT, FORMAT_VERSION, PoseModel, load_pose_model, model_arrays
from jaxrender.io.atomic import write_bytes

MODEL_FILE = "model.safetensors"


def model_header(result: TrainResult, settings: TrainSettings, *, source: dict, errors: dict) -> dict:
    """What a reader of the file has to know, and what a person would ask.

    Nothing here depends on the clock or on interruptions: the same run ends with the same file, bit by bit. Times are
    in a file beside it (fitting.stages.TIMES_FILE).

    Args:
      source: name, content hash, input file and mesh size of what the model was trained on.
      errors: the evaluation's numbers.
    """
    model = result.model
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "order": ORDER,
        "num_lobes": model.num_lobes,
        "num_components": len(model.weights) - 1,
        "feature_kind": model.features.kind,
        "feature_size": model.features.size,
        "source": source,
        "settings": settings.as_dict(),
        "ridge": result.ridge,
        "rays": result.bake.num_rays,
        "invisible_points": int((~np.asarray(model.visible)).sum()),
        "errors": errors,
    }


def character_source(character: Character, input_path: Path | None, num_vertices: int) -> dict:
    """Where a character came from, so that `relight` finds it again and can tell another one from it."""
    return {
        "name": character.name,
        "content_hash": character.content_hash,
        "input": str(input_path.resolve()) if input_path else None,
        "num_vertices": num_vertices,
    }


def save_pose_model(path: Path, model: PoseModel, header: dict) -> None:
    """Writes the model; a half-written file is never left behind."""
    arrays = {name: np.ascontiguousarray(array) for name, array in model_arrays(model).items()}
    write_bytes(path, save(arrays, metadata={"header": json.dumps(header, allow_nan=False)}))


def to_half(model: PoseModel) -> PoseModel:
    """The pose matrices in float16: half the size; rounding adds less than a thousandth to the error."""
    return dataclasses.replace(model, weights=model.weights.astype(jnp.float16))


def find_model(path: Path) -> tuple[PoseModel, dict, Path]:
    """Loads a model from its file or from the folder of a training run; returns it, its header and the file."""
    file = path / MODEL_FILE if path.is_dir() else path
    if not file.is_file():
        bad_input(path, "model", expected=f"a model file, or a folder with {MODEL_FILE}", got="none there")
    model, header = load_pose_model(file)
    _check_header(file, header)
    return model, header, file


# Field of the header -> the types it may have.
_HEADER: dict[str, tuple[type, ...]] = {
    "source.name": (str,),
    "source.content_hash": (str,),
    "source.input": (str, NoneType),
    "source.num_vertices": (int,),
    "ridge": (int, float),
    "rays": (int,),
}


def _check_header(file: Path, header: dict) -> None:
    for field, types in _HEADER.items():
        value: Any = header
        for key in field.split("."):
            value = value.get(key, ...) if isinstance(value, dict) else ...
        if not isinstance(value, types) or isinstance(value, bool):
            words = " or ".join("null" if kind is NoneType else kind.__name__ for kind in types)
            bad_input(file, field, expected=words, got="nothing" if value is ... else repr(value)[:60])


def source_file(header: dict, model_file: Path) -> Path | None:
    """The file a model was trained on, where it was or beside the model; None for the built-in character.

    Raises:
      InputError: if it is in neither place.
    """
    name = header["source"]["input"]
    if name is None:
        return None
    found = [place for place in (Path(name), model_file.parent / Path(name).name) if place.is_file()]
    if not found:
        bad_input(model_file, "source.input", expected=f"{name}, or a file of that name beside the model", got="none")
    return found[0]


def check_same_character(character: Character, model: PoseModel, header: dict, path: Path) -> None:
    """Raises InputError unless the model was trained on this character."""
    expected = header["source"]["content_hash"]
    if expected != character.content_hash:
        other = f"{character.name}, {character.content_hash[:12]}"
        bad_input(path, "character", expected=f"the character of hash {expected[:12]}", got=other)
    num_joints, num_vertices = len(character.skeleton.parents), len(character.albedo)
    for name, indices in (("joints", model.features.joints), ("bones", model.features.bones)):
        if len(indices) and int(np.max(indices)) >= num_joints:
            got = int(np.max(indices))
            bad_input(path, f"features.{name}", expected=f"indices below {num_joints}, the joints", got=got)
    if len(model.points) != num_vertices:
        bad_input(path, "points", expected=f"{num_vertices} entries, one a vertex", got=len(model.points))
