"""The study: all methods on some visible points, and the goals they decide."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from fitting.checkpoint import NOTHING_KEPT, Checkpoint
from fitting.config import FitSettings
from fitting.errors import SH, ByPart
from fitting.fit import blocks, model_components, predict_sh
from fitting.ridge import some_points
from fitting.stages import Track, no_tracking
from fitting.study.features import Angles, angle_rows, gains, ridge_curve, with_angles
from fitting.study.figures import figure3, figure5
from fitting.study.ground import Ground, MethodRow, linear_pose, make_ground, method_row, thin
from fitting.study.lobes import (
    LOBE_COUNTS,
    STUDY_BLOCK,
    lobe_rows,
    paper_label,
    point_axes,
    raw_label,
    refined_label,
    refined_lobes,
    subset_rows,
)
from fitting.study.without_lobes import KernelPose, baseline_rows, linear_rows
from fitting.training_data import TrainingData
from jaxrender.harmonics.pose_model import PoseModel

# Fits of every frame on its own are slow: the rows that need them see this many points.
SUBSET_POINTS = 96


@dataclass(frozen=True)
class Goal:
    """A goal of docs/performance.md; `value` and `met` are None where the data cannot tell."""

    name: str
    value: float | None
    limit: float
    met: bool | None


@dataclass(frozen=True)
class Study:
    """Competing methods on the same points and frames.

    Attributes:
      points: the points studied, indices into the data's.
      rows: methods on all frames; shading is explained in `light_sets`.
      subset_rows: those that need independent fits of every frame, with others for comparison, on fewer points.
      figure3, figure5: per series `target` and `norm` in words, the per-frame `curve`, and `global` by set.
      ridge_curve: linear SH model, one row per penalty.
      gains: linear-16 variants on the way to unseen motion.
    """

    points: Int[np.ndarray, " n"]
    rows: list[MethodRow]
    subset_rows: list[MethodRow]
    goals: list[Goal]
    figure3: list[dict]
    figure5: list[dict]
    ridge_curve: list[dict]
    gains: list[dict]


def run_study(
    data: TrainingData,
    model: PoseModel,
    fit: FitSettings,
    *,
    ridge: float,
    max_points: int,
    angles: Angles | None,
    track: Track = no_tracking,
    checkpoint: Checkpoint = NOTHING_KEPT,
) -> Study:
    """All methods on `max_points` visible points."""
    points = some_points(data, max_points)
    ground = make_ground(thin(data, points), fit, ridge)
    linear = ground.linear.predict(ground.sh)
    kernel = KernelPose(ground.data, ground.linear.weights).predict(ground.sh)
    offset = fit.offset
    refined = {c: refined_lobes(ground, c, offset=offset, track=track, checkpoint=checkpoint) for c in LOBE_COUNTS}
    axes = {c: point_axes(ground, c) for c in LOBE_COUNTS}
    own = predict_sh(model, model_components(model, data.raw), points)
    rows = [
        *baseline_rows(ground),
        *linear_rows(ground, linear),
        *angle_rows(ground, angles),
        *lobe_rows(ground, refined, axes),
        method_row(ground, "the trained model", 6 * model.num_lobes, own),
        method_row(ground, "Gaussian kernel, 16 SH", 16, kernel, note="the nonlinear reference"),
    ]
    few, both, subset = _subset(ground, refined, axes, angles, track, checkpoint)
    return Study(
        points=points,
        rows=rows,
        subset_rows=subset,
        goals=goals(rows, subset, fit),
        figure3=figure3(ground, linear),
        figure5=figure5(few, both),
        ridge_curve=ridge_curve(ground),
        gains=gains(ground, kernel, angles),
    )


def _subset(
    ground: Ground,
    refined: dict[int, SH],
    axes: dict[int, np.ndarray],
    angles: Angles | None,
    track: Track,
    checkpoint: Checkpoint,
) -> tuple[Ground, dict[tuple[int, bool], SH], list[MethodRow]]:
    """`subset_rows` on whole blocks of points, spread over the groups; and their ground and refined predictions."""
    found = [block.points for block in blocks(ground.data.groups, ground.all_points, size=STUDY_BLOCK)]
    count = max(1, SUBSET_POINTS // STUDY_BLOCK)
    some = np.sort(np.concatenate(sorted(found, key=len)[-2 * count :][::2]))
    fit = ground.fit
    few = make_ground(thin(ground.data, some), fit, ground.linear.ridge)
    both = {(c, fit.offset): refined[c][:, some] for c in LOBE_COUNTS}
    both |= {
        (c, not fit.offset): refined_lobes(few, c, offset=not fit.offset, track=track, checkpoint=checkpoint)
        for c in LOBE_COUNTS
    }
    paper = linear_pose(with_angles(few.data, angles), fit, ground.linear.ridge) if angles else None
    rows = subset_rows(few, both, {c: a[some] for c, a in axes.items()}, paper, track, checkpoint)
    return few, both, rows


def goals(rows: list[MethodRow], subset: list[MethodRow], fit: FitSettings) -> list[Goal]:
    """The project's goals for the fit, checked."""
    table, small = ({row.method: row for row in some} for some in (rows, subset))
    linear, two, three = table["linear, 16 SH"], *(table[refined_label(c, fit.offset)] for c in (2, 3))
    small_two = small[refined_label(2, fit.offset)]
    paper = small.get(paper_label(2), small[raw_label(2)])
    found = []
    for name, row, sh_limit, shading_limit in (("2 lobes", two, 1.20, 1.03), ("3 lobes", three, 1.0, 1.0)):
        found.append(_ratio_goal(f"{name} / linear-16, SH, segments", row.sh, linear.sh, sh_limit))
        for light in ("directional", "environment"):
            mine, its = getattr(row, light), getattr(linear, light)
            found.append(_ratio_goal(f"{name} / linear-16, {light} shading, segments", mine, its, shading_limit))
    found.append(
        _ratio_goal("2 lobes / the paper's way (θ, φ of single fits), SH, segments", small_two.sh, paper.sh, 0.42)
    )
    found.append(_goal("trained model, SH, unseen clips", table["the trained model"].sh["clips"], 0.19))
    return found


def _ratio_goal(name: str, mine: ByPart, other: ByPart, limit: float) -> Goal:
    a, b = mine["segments"], other["segments"]
    return _goal(name, a / max(b, 1e-12) if a is not None and b is not None else None, limit)


def _goal(name: str, value: float | None, limit: float) -> Goal:
    return Goal(name, value, limit, None if value is None else value <= limit)
