"""Training: bake visibility, choose the ridge, solve, refine. Returns a result and prints nothing."""

from dataclasses import dataclass
from pathlib import Path

from fitting.config import TrainSettings
from fitting.dataset import BakeStatistics
from fitting.fit import fit_model
from fitting.motion import Motion
from fitting.ridge import choose_ridge
from fitting.stages import Timings, Track, no_tracking
from fitting.training_data import TrainingData, bake_character, bake_sequence
from jaxrender.animation.skinning import Character
from jaxrender.harmonics.pose_model import PoseModel
from jaxrender.scene import MeshSequence


@dataclass(frozen=True)
class TrainResult:
    model: PoseModel
    data: TrainingData
    ridge: float
    bake: BakeStatistics
    timings: Timings
    motion: Motion | None


def train_character(
    character: Character, settings: TrainSettings, folder: Path, *, track: Track = no_tracking
) -> TrainResult:
    """From a character to its model; the bake is kept in `folder`, so that a second run continues from it."""
    timings = Timings()
    with timings.stage("bake"):
        data, statistics, motion = bake_character(character, settings, folder / "bake.zarr", track=track)
    return _train(data, statistics, motion, settings.fit, timings, track)


def train_sequence(
    sequence: MeshSequence, settings: TrainSettings, folder: Path, *, name: str = "sequence", track: Track = no_tracking
) -> TrainResult:
    """From an animated mesh and a feature matrix to its model."""
    timings = Timings()
    with timings.stage("bake"):
        data, statistics = bake_sequence(sequence, settings, folder / "bake.zarr", name=name, track=track)
    return _train(data, statistics, None, settings.fit, timings, track)


def _train(data, statistics, motion, fit, timings, track) -> TrainResult:
    with timings.stage("choose ridge"):
        ridge = choose_ridge(data, fit) if fit.ridge is None else fit.ridge
    with timings.stage("solve and refine" if fit.refine_steps else "solve"):
        model = fit_model(data, fit, ridge=ridge, track=track)
    return TrainResult(model, data, ridge, statistics, timings, motion)
