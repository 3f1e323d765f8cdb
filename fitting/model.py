"""The trained model as a file: safetensors with a JSON header, written whole or not at all."""

import dataclasses
import json
from pathlib import Path

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
        "invisible_points": int((~np.asarray(model.visible)).sum()),
        "errors": errors,
    }


def character_source(character: Character, input_path: Path | None, num_vertices: int) -> dict:
    """Where a character came from, so that `relight` finds it again and can tell another one from it."""
    return {
        "name": character.name,
        "content_hash": character.content_hash,
        "input": str(input_path) if input_path else None,
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
    return model, header, file


def check_same_character(character: Character, header: dict, path: Path) -> None:
    """Raises InputError unless the model was trained on this character."""
    expected = header.get("source", {}).get("content_hash")
    if expected != character.content_hash:
        got = f"{character.name}, {character.content_hash[:12]}"
        bad_input(path, "character", expected=f"the character of hash {str(expected)[:12]}", got=got)
