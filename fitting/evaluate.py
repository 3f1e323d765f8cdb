"""Errors of a trained model on all visible points, and the study of its competitors on some of them."""

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.checkpoint import NOTHING_KEPT, Arrays, Checkpoint
from fitting.config import FitSettings
from fitting.errors import ErrorSums, part_masks, relative_errors, sum_errors
from fitting.fit import model_components, predict_sh
from fitting.motion import MIXED, TRAIN
from fitting.solve import BLOCK
from fitting.stages import Track, no_tracking
from fitting.study import Study, run_study
from fitting.training_data import TrainingData, project
from jaxrender.harmonics.pose_model import FeatureBasis, PoseModel


@dataclass(frozen=True)
class FrameErrors:
    """One entry per measured frame: its index in the data, set, clip, and errors over the points."""

    index: Int[np.ndarray, " f"]
    part: Int[np.ndarray, " f"]
    clip: Int[np.ndarray, " f"]
    curve: dict[str, Float[np.ndarray, " f"]]


@dataclass(frozen=True)
class Evaluation:
    """Tables for the report; `as_dict` is ready for JSON once arrays are spelled out (console.to_jsonable).

    Attributes:
      errors: per set `global`, `mean_relative` and `bands` (each band against its own norm), or None.
      baseline: the same of the mean visibility over the training frames, no pose at all.
      clips: one row per clip and set.
      point_errors: per point the RMS relative error over the frames that `painted_on` names; NaN where invisible.
    """

    name: str
    num_points: int
    invisible_share: float
    ridge: float
    errors: dict[str, dict | None]
    baseline: dict[str, dict | None]
    clips: list[dict]
    frames: FrameErrors
    point_errors: Float[np.ndarray, " p"]
    painted_on: str
    study: "Study | None"

    def as_dict(self) -> dict:
        return dataclasses.asdict(self)

    def summary(self) -> dict[str, float | None]:
        """The few numbers that travel with the model."""
        found = {name: None if row is None else row["global"] for name, row in self.errors.items()}
        return found | {"invisible_share": self.invisible_share}


def evaluate(
    data: TrainingData,
    model: PoseModel,
    fit: FitSettings,
    *,
    ridge: float,
    max_points: int = 600,
    study: bool = True,
    angles: tuple[Float[np.ndarray, "f 1 n"], FeatureBasis] | None = None,
    clip_names: tuple[str, ...] = (),
    track: Track = no_tracking,
    checkpoint: Checkpoint = NOTHING_KEPT,
) -> Evaluation:
    """Measures `model` on all visible points and, if `study`, its competitors on some of them.

    Args:
      ridge: the penalty the model was trained with; the study's linear models take it too.
      max_points: points of the study.
      angles: joint-angle features of the same frames (one group) and their unfitted basis, for comparison.
      clip_names: by the numbers in `data.clip`; else "clip 0" and so on.
      checkpoint: keeps the parts that take seconds, and gives back those of an interrupted run.
    """
    real = np.flatnonzero(data.part != MIXED)
    part, clip = data.part[real], data.clip[real]
    sums, mean_sums, point_errors, painted_on = _measure_model(data, model, real, track, checkpoint)
    return Evaluation(
        name=data.name,
        num_points=len(data.visible),
        invisible_share=float(1.0 - np.mean(data.visible)),
        ridge=ridge,
        errors=_part_tables(sums, part),
        baseline=_part_tables(mean_sums, part),
        clips=_clip_rows(sums, part, clip, clip_names),
        frames=FrameErrors(real, part, clip, sums.frame_curve()),
        point_errors=point_errors,
        painted_on=painted_on,
        study=run_study(
            data, model, fit, ridge=ridge, max_points=max_points, angles=angles, track=track, checkpoint=checkpoint
        )
        if study
        else None,
    )


def _measure_model(
    data: TrainingData, model: PoseModel, real: Int[np.ndarray, " f"], track: Track, checkpoint: Checkpoint
):
    """Errors of the model and of the mean, and the error of each point, a few blocks at a time."""
    components = model_components(model, data.raw[real])
    part = data.part[real]
    held_out = part != TRAIN
    painted = held_out if held_out.any() else ~held_out
    points = np.flatnonzero(data.visible)
    points = points[np.argsort(data.groups[points], kind="stable")]
    chunks = np.array_split(points, max(1, len(points) // (8 * BLOCK)))

    def measure(chunk: Int[np.ndarray, " n"]) -> Arrays:
        baked = project(data.bits[real], chunk, data.table)
        predicted = predict_sh(model, components, chunk)
        mean = np.broadcast_to(baked[part == TRAIN].mean(axis=0), baked.shape)
        relative = relative_errors(predicted[painted], baked[painted])
        own, its = vars(sum_errors(predicted, baked)), vars(sum_errors(mean, baked))
        by_kind = {
            f"{kind}.{key}": value for kind, sums in (("own", own), ("mean", its)) for key, value in sums.items()
        }
        return by_kind | {"points": np.sqrt(np.mean(relative**2, axis=0))}

    stage = checkpoint.stage("measure", data, model)
    # Sums of floats depend on their order, and kept parts come first: they are put in order before they are added.
    found = dict(stage.parts(chunks, measure, track=track, label="measure"))
    point_errors = np.full(len(data.visible), np.nan)
    for number, chunk in enumerate(chunks):
        point_errors[chunk] = found[number]["points"]
    own, mean = (
        functools.reduce(ErrorSums.__add__, [_error_sums(found[i], kind) for i in range(len(chunks))])
        for kind in ("own", "mean")
    )
    return own, mean, point_errors, "held-out frames" if held_out.any() else "training frames"


def _error_sums(part: Arrays, kind: str) -> ErrorSums:
    error, truth, relative, squares, count = (part[f"{kind}.{field.name}"] for field in dataclasses.fields(ErrorSums))
    return ErrorSums(error, truth, relative, squares, int(count))


def _part_tables(sums: ErrorSums, part: Int[np.ndarray, " f"]) -> dict[str, dict | None]:
    return {name: _error_table(sums, mask) for name, mask in part_masks(part).items()}


def _error_table(sums: ErrorSums, frames: Bool[np.ndarray, " f"]) -> dict | None:
    if not frames.any():
        return None
    return {
        "frames": int(frames.sum()),
        "global": sums.global_error(frames),
        "mean_relative": sums.mean_relative(frames),
        "bands": sums.by_band(frames),
    }


def _clip_rows(sums: ErrorSums, part, clip, names: tuple[str, ...]) -> list[dict]:
    rows = []
    for number in np.unique(clip):
        name = names[number] if 0 <= number < len(names) else f"clip {number}"
        for label, mask in part_masks(part).items():
            table = _error_table(sums, mask & (clip == number))
            if table:
                rows.append({"clip": name, "part": label, **table})
    return rows
