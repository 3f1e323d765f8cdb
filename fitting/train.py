"""Training: bake visibility, choose the ridge, solve, refine. Returns a result and prints nothing."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fitting.checkpoint import UNFINISHED, Checkpoint, remove_parts
from fitting.config import FitSettings, TrainSettings
from fitting.dataset import BakeStatistics, remove_store
from fitting.fit import fit_model
from fitting.lock import only_writer
from fitting.motion import Motion
from fitting.ridge import choose_ridge
from fitting.stages import Timings, Track, no_tracking
from fitting.training_data import TrainingData, bake_character, bake_sequence, character_identity
from jaxrender.animation.skinning import Character
from jaxrender.harmonics.pose_model import PoseModel
from jaxrender.scene import MeshSequence

STORE = "bake.zarr"


@dataclass(frozen=True)
class TrainResult:
    model: PoseModel
    data: TrainingData
    ridge: float
    bake: BakeStatistics
    timings: Timings
    motion: Motion | None


def character_run(character: Character, settings: TrainSettings, folder: Path, *, restart: bool = False) -> Checkpoint:
    """The kept parts of a training run in `folder`; call it, and use them, under `only_writer(folder)`.

    Args:
      restart: throws away the bake and the parts of an earlier run, whatever they are of.
    Raises:
      InputError: if parts of a run of another character or of other settings are there.
    """
    if restart:
        remove_parts(folder / UNFINISHED)
        remove_store(folder / STORE)
    run = {"character": character_identity(character), **settings.as_dict()}
    return Checkpoint(folder / UNFINISHED, run=run)


def train_character(
    character: Character,
    settings: TrainSettings,
    folder: Path,
    *,
    track: Track = no_tracking,
    checkpoint: Checkpoint | None = None,
) -> TrainResult:
    """From a character to its model; the bake is kept in `folder`, so that a second run continues from it.

    What the fit has done is kept too, until the function returns.

    Args:
      checkpoint: from `character_run`; its parts then stay.
    Raises:
      InputError: if the character cannot be trained on, if `folder` holds something of another character or of other
        settings, or if another run writes to it.
      OSError: if the disk is full; what was finished before is kept.
    """
    timings = Timings()
    with only_writer(folder), _kept(checkpoint or character_run(character, settings, folder), checkpoint) as parts:
        with timings.stage("bake"):
            data, statistics, motion = bake_character(character, settings, folder / STORE, track=track)
        return _train(data, statistics, motion, settings.fit, timings, track, parts)


def train_sequence(
    sequence: MeshSequence, settings: TrainSettings, folder: Path, *, name: str = "sequence", track: Track = no_tracking
) -> TrainResult:
    """From an animated mesh and a feature matrix to its model; keeps and raises as `train_character` does."""
    timings = Timings()
    with only_writer(folder):
        run = Checkpoint(folder / UNFINISHED, run={"mesh sequence": name, **settings.as_dict()})
        with _kept(run) as parts:
            with timings.stage("bake"):
                data, statistics = bake_sequence(sequence, settings, folder / STORE, name=name, track=track)
            return _train(data, statistics, None, settings.fit, timings, track, parts)


@contextlib.contextmanager
def _kept(parts: Checkpoint, own: Checkpoint | None = None) -> Iterator[Checkpoint]:
    """Removes the parts when the block is done, unless they are the caller's own."""
    yield parts
    if own is None:
        parts.finish()


def _train(
    data: TrainingData,
    statistics: BakeStatistics,
    motion: Motion | None,
    fit: FitSettings,
    timings: Timings,
    track: Track,
    parts: Checkpoint,
) -> TrainResult:
    with timings.stage("choose ridge"):
        ridge = _ridge(data, fit, parts) if fit.ridge is None else fit.ridge
    with timings.stage("solve and refine" if fit.refine_steps else "solve"):
        timings.rays = statistics.num_traced
        model = fit_model(data, fit, ridge=ridge, track=track, checkpoint=parts)
    return TrainResult(model, data, ridge, statistics, timings, motion)


def _ridge(data: TrainingData, fit: FitSettings, parts: Checkpoint) -> float:
    found = parts.stage("ridge", data, fit).part("ridge", lambda: {"ridge": np.array(choose_ridge(data, fit))})
    return float(found["ridge"])
