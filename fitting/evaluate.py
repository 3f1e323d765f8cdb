"""Errors of a trained model and, as a study, of the methods it competes with, on the same data.

Relative L2 of a set of frames: √(Σ|predicted - baked|² / Σ|baked|²) over its frames and points, `global`; or the
mean over frames and points of |predicted - baked| / max(|baked|, floor), `mean_relative`. Baked means the SH
projection of the traced bits. Sets: `train`, `segments` (the held-out end of each training clip) and `clips`
(clips held out whole); a set without frames is None. Mixed poses are never measured on.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fitting.config import FitSettings
from fitting.dataset import ShadingPoints
from fitting.features import fit_basis
from fitting.motion import CLIP, MIXED, SEGMENT, TRAIN
from fitting.solve import BLOCK, ORDER, PoseRows, apply_linear, block_sh, lobe_targets, synthesize
from fitting.train import (
    RIDGES,
    Track,
    TrainingData,
    _folds,
    _some_points,
    choose_ridge,
    fit_block,
    no_tracking,
    predict_sh,
)
from jaxrender.harmonics.brdf_operator import phong_operator
from jaxrender.harmonics.light import environment_directions, project_environment, sh_area_light
from jaxrender.harmonics.pose_model import FeatureBasis, PoseModel, lobes_from_numbers
from jaxrender.harmonics.sh import sh_basis, sh_rotate
from jaxrender.harmonics.visibility import hemisphere_directions
from jaxrender.harmonics.zh import hemisphere_zh, lobes_to_sh, zh_to_sh
from jaxrender.harmonics.zh_fit import spread_start_axes
from jaxrender.machine import num_cores

PARTS = {"train": TRAIN, "segments": SEGMENT, "clips": CLIP}
# |v| of an unoccluded point is 2.4 at order 4; below this a point and frame counts as if it had this norm.
NORM_FLOOR = 0.2
KERNEL_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)
LOBE_COUNTS = (1, 2, 3)
# Fits of every frame on its own are slow: the rows that need them see this many points and every second frame.
SUBSET_POINTS, SUBSET_STEP = 96, 2
# Points of a block in the study, whose points are few per group.
STUDY_BLOCK = 16
_BAND_STARTS = np.arange(ORDER) ** 2

ByPart = dict[str, float | None]
SH = Float[np.ndarray, "f n 16"]


# --- Errors


@dataclass(frozen=True)
class ErrorSums:
    """Squared norms summed over points, frame by frame; adds up over blocks of points.

    `error` and `truth` are per band; `relative` and `relative_squares` sum |error| / max(|truth|, floor) and its
    square.
    """

    error: Float[np.ndarray, "f b"]
    truth: Float[np.ndarray, "f b"]
    relative: Float[np.ndarray, " f"]
    relative_squares: Float[np.ndarray, " f"]
    num_points: int

    def __add__(self, other: "ErrorSums") -> "ErrorSums":
        mine, others = (tuple(getattr(s, f.name) for f in dataclasses.fields(s)) for s in (self, other))
        return ErrorSums(*(a + b for a, b in zip(mine, others, strict=True)))

    def global_error(self, frames: Bool[np.ndarray, " f"]) -> float | None:
        return _relative(self.error[frames].sum(), self.truth[frames].sum()) if frames.any() else None

    def mean_relative(self, frames: Bool[np.ndarray, " f"]) -> float | None:
        return float(self.relative[frames].mean() / self.num_points) if frames.any() else None

    def by_band(self, frames: Bool[np.ndarray, " f"]) -> list[float] | None:
        """Band by band: error of the band over the baked norm of the same band."""
        if not frames.any():
            return None
        return [_relative(e, t) for e, t in zip(self.error[frames].sum(0), self.truth[frames].sum(0), strict=True)]

    def frame_curve(self) -> dict[str, np.ndarray]:
        """Per frame: global error over its points, mean and standard deviation over points of the relative error."""
        mean = self.relative / self.num_points
        variance = np.maximum(self.relative_squares / self.num_points - mean**2, 0.0)
        truth = np.maximum(self.truth.sum(axis=1), 1e-12)
        return {"global": np.sqrt(self.error.sum(axis=1) / truth), "mean": mean, "std": np.sqrt(variance)}


def sum_errors(predicted: SH, baked: SH, *, floor: float = NORM_FLOOR) -> ErrorSums:
    """Error sums of some points."""
    error, truth = _band_squares(predicted - baked), _band_squares(baked)
    relative = relative_errors(predicted, baked, floor=floor)
    e, t, r, r2 = (x.sum(axis=1, dtype=np.float64) for x in (error, truth, relative, relative**2))
    return ErrorSums(e, t, r, r2, num_points=baked.shape[1])


def relative_errors(predicted: SH, baked: SH, *, floor: float = NORM_FLOOR) -> Float[np.ndarray, "f n"]:
    """|predicted - baked| / max(|baked|, floor) of each frame and point."""
    return np.linalg.norm(predicted - baked, axis=-1) / np.maximum(np.linalg.norm(baked, axis=-1), floor)


def _band_squares(values: SH) -> Float[np.ndarray, "f n 4"]:
    return np.add.reduceat(values * values, _BAND_STARTS, axis=-1)


def _relative(error: float, truth: float) -> float:
    return float(math.sqrt(error / max(truth, 1e-12)))


def part_masks(part: Int[np.ndarray, " f"]) -> dict[str, Bool[np.ndarray, " f"]]:
    return {name: part == number for name, number in PARTS.items()}


def by_part(sums: ErrorSums, part: Int[np.ndarray, " f"]) -> ByPart:
    """Global relative L2 of each set of frames."""
    return {name: sums.global_error(mask) for name, mask in part_masks(part).items()}


# --- The trained model


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
) -> Evaluation:
    """Measures `model` on all visible points and, if `study`, its competitors on some of them.

    Args:
      ridge: the penalty the model was trained with; the study's linear models take it too.
      max_points: points of the study.
      angles: joint-angle features of the same frames (one group) and their unfitted basis, for comparison.
      clip_names: by the numbers in `data.clip`; else "clip 0" and so on.
    """
    real = np.flatnonzero(data.part != MIXED)
    part, clip = data.part[real], data.clip[real]
    sums, mean_sums, point_errors, painted_on = _measure_model(data, model, real, track)
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
        study=run_study(data, model, fit, ridge=ridge, max_points=max_points, angles=angles, track=track)
        if study
        else None,
    )


def _measure_model(data: TrainingData, model: PoseModel, real: Int[np.ndarray, " f"], track: Track):
    """Errors of the model and of the mean, and the error of each point, a few blocks at a time."""
    components = model_components(model, data.raw[real])
    part = data.part[real]
    held_out = part != TRAIN
    painted = held_out if held_out.any() else ~held_out
    points = np.flatnonzero(data.visible)
    points = points[np.argsort(data.groups[points], kind="stable")]
    chunks = np.array_split(points, max(1, len(points) // (8 * BLOCK)))
    total, total_mean, point_errors = [], [], np.full(len(data.visible), np.nan)
    for chunk in track(iter(chunks), len(chunks), "measure"):
        baked = project(data.bits[real], chunk, data.table)
        predicted = predict_sh(model, components, chunk)
        total.append(sum_errors(predicted, baked))
        mean = np.broadcast_to(baked[part == TRAIN].mean(axis=0), baked.shape)
        total_mean.append(sum_errors(mean, baked))
        relative = relative_errors(predicted[painted], baked[painted])
        point_errors[chunk] = np.sqrt(np.mean(relative**2, axis=0))
    painted_on = "held-out frames" if held_out.any() else "training frames"
    return (
        functools.reduce(ErrorSums.__add__, total),
        functools.reduce(ErrorSums.__add__, total_mean),
        point_errors,
        painted_on,
    )


def model_components(model: PoseModel, raw: Float[np.ndarray, "f g n"]) -> Float[np.ndarray, "f g k"]:
    """The model's pose components of raw features."""
    mean, basis = np.asarray(model.features.mean), np.asarray(model.features.basis)
    return np.matmul((raw - mean).transpose(1, 0, 2), basis).transpose(1, 0, 2).astype(np.float32)


def project(
    bits: np.ndarray, points: Int[np.ndarray, " n"], table: Float[np.ndarray, "d k"]
) -> Float[np.ndarray, "f n k"]:
    """Coefficients of some points; a block at a time, since unpacked bits take 32 times the memory."""
    result = np.empty((len(bits), len(points), table.shape[1]), np.float32)
    for start in range(0, len(points), BLOCK):
        own = points[start : start + BLOCK]
        padded = np.concatenate([own, np.repeat(own[-1:], BLOCK - len(own))])
        result[:, start : start + len(own)] = np.asarray(block_sh(bits[:, padded], table))[:, : len(own)]
    return result


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


# --- The study: its ground


@dataclass(frozen=True)
class MethodRow:
    """One method. `sh` is global relative L2, the others relative RMS of diffuse shading, by set of frames.

    `numbers` counts what the method stores per point and pose.
    """

    method: str
    numbers: int
    sh: ByPart
    directional: ByPart
    environment: ByPart
    note: str = ""


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
      subset_rows: those that need independent fits of every frame, with others for comparison, on fewer points
        and every second frame (for training as well as for measuring).
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


@dataclass(frozen=True)
class LinearPose:
    """Weighted ridge regression on the principal components of the pose features, group by group."""

    groups: Int[np.ndarray, " n"]
    components: Float[np.ndarray, "f g k"]
    moments: Float[np.ndarray, "g k"]
    weights: Float[np.ndarray, " f"]
    ridge: float

    def predict(self, targets: Float[np.ndarray, "f n d"]) -> Float[np.ndarray, "f n d"]:
        """Fits all targets on the weighted frames and predicts them in every frame."""
        result = np.empty_like(targets)
        used, w = self.weights > 0, self.weights[self.weights > 0]
        for g in np.unique(self.groups):
            own = targets[:, self.groups == g].reshape(len(targets), -1)
            mean = w @ own[used] / w.sum()
            seen = self.components[used, g] * w[:, None]
            penalty = self.moments[g] + self.ridge * self.moments[g].mean() + np.finfo(np.float64).tiny
            slopes = seen.T @ (own[used] - mean) / penalty[:, None]
            predicted = self.components[:, g] @ slopes + mean
            result[:, self.groups == g] = predicted.reshape(len(targets), -1, targets.shape[2])
        return result

    def rows(self, group: int) -> PoseRows:
        """What the joint refinement needs of one group."""
        used, lam = self.weights > 0, self.ridge * self.moments[group].mean()
        parts = (self.components[used, group], self.weights[used], self.moments[group], lam)
        return PoseRows(*(jnp.asarray(part, jnp.float32) for part in parts))


def linear_pose(data: TrainingData, fit: FitSettings, ridge: float) -> LinearPose:
    """The linear model's ground for some data: the same components and penalty as the trained model's."""
    weights = data.frame_weights(fit.mixed_weight)
    basis, moments = fit_basis(data.basis, data.raw, weights, fit.num_components)
    raw, mean, axes = data.raw.astype(np.float64), np.asarray(basis.mean), np.asarray(basis.basis, np.float64)
    components = np.stack([(raw[:, g] - mean[g]) @ axes[g] for g in range(raw.shape[1])], axis=1)
    return LinearPose(data.groups, components, moments, weights, ridge)


@dataclass(frozen=True)
class Ground:
    """What every method of the study starts from: n points, all frames, mixed ones included."""

    data: TrainingData
    fit: FitSettings
    linear: LinearPose
    sh: SH
    cosine: SH

    @property
    def train(self) -> Bool[np.ndarray, " f"]:
        return self.data.part == TRAIN

    @property
    def all_points(self) -> Int[np.ndarray, " n"]:
        return np.arange(self.sh.shape[1])


def make_ground(data: TrainingData, fit: FitSettings, ridge: float) -> Ground:
    """Projects the bits on plain and cosine-weighted SH (∫ V max(0, n·s)/π y, from the bits)."""
    cosine_table = data.table * (hemisphere_directions(data.num_directions)[:, 2:] / math.pi)
    points = np.arange(len(data.groups))
    both = project(data.bits, points, np.concatenate([data.table, cosine_table], axis=1))
    return Ground(data, fit, linear_pose(data, fit, ridge), both[..., :16].copy(), both[..., 16:].copy())


def thin(data: TrainingData, points: Int[np.ndarray, " n"], step: int = 1) -> TrainingData:
    """Some points of the data, in every `step`-th frame."""
    frames = slice(None, None, step)
    return dataclasses.replace(
        data,
        points=ShadingPoints(data.points.vertices[points], np.arange(len(points))),
        groups=data.groups[points],
        bits=data.bits[frames][:, points],
        raw=data.raw[frames],
        part=data.part[frames],
        clip=data.clip[frames],
        visible=data.visible[points],
        source=data.source if step == 1 else None,  # it counts frames, all of them
    )


@functools.lru_cache
def light_sets() -> dict[str, Float[np.ndarray, "n 16"]]:
    """Order-4 lights of the shading errors, fixed in the frame of each vertex (the bake keeps no world frames).

    `directional`: six band-limited lamps spread over the upper hemisphere. `environment`: a procedural sky,
    brighter at the horizon, over dark ground, with a sun that doubles its light; its zenith 0°, 50° and 100° from
    the normal. Truth is Σ V cos/π L over the bits, so it has no truncation but the light's own.
    """
    lamps = np.asarray(sh_basis(jnp.asarray(hemisphere_directions(6), jnp.float32), order=ORDER))
    sky = _sky()
    turns = [Rotation.from_euler("xyz", [90.0 + tilt, 0.0, 35.0 * tilt], degrees=True) for tilt in (0.0, 50.0, 100.0)]
    turned = [sh_rotate(sky, jnp.asarray(turn.as_matrix(), sky.dtype)) for turn in turns]
    return {"directional": lamps, "environment": np.asarray(jnp.stack(turned))}


def _sky() -> Float[jax.Array, " 16"]:
    """The procedural environment, +Y up; luminance only."""
    directions, _ = environment_directions(32, 64)
    up = directions[..., 1]
    radiance = np.where(up > 0, 1.0 - 0.5 * np.maximum(up, 0.0), 0.15)
    sky = project_environment(jnp.asarray(radiance[..., None], jnp.float32), order=ORDER)[0]
    towards = jnp.asarray([0.48, 0.64, 0.6], jnp.float32)
    radius = 0.05
    sun_radiance = np.pi / (np.pi * radius**2)
    sun = sh_area_light(towards, jnp.float32(radius), jnp.full(1, sun_radiance, jnp.float32), order=ORDER)[0]
    return sky + sun


@functools.lru_cache
def diffuse_operator() -> Float[np.ndarray, "16 16"]:
    """M¹/π: visibility to cosine-weighted visibility, exact for what is within order 4."""
    return np.asarray(phong_operator(jnp.float32(1.0), order=ORDER)) / np.float32(math.pi)


def shading_errors(transfer: SH, cosine: SH, part: Int[np.ndarray, " f"]) -> dict[str, ByPart]:
    """Relative RMS of diffuse shading, pooled over the lights of each set, by set of frames."""
    errors = {}
    for name, lights in light_sets().items():
        error = np.asarray(np.sum(((transfer - cosine) @ lights.T) ** 2, axis=(1, 2), dtype=np.float64))
        truth = np.asarray(np.sum((cosine @ lights.T) ** 2, axis=(1, 2), dtype=np.float64))
        masks = part_masks(part).items()
        errors[name] = {label: _relative(error[m].sum(), truth[m].sum()) if m.any() else None for label, m in masks}
    return errors


def method_row(
    ground: Ground, method: str, numbers: int, predicted: SH, *, cosine: bool = False, note: str = ""
) -> MethodRow:
    """Measures predicted SH visibility, or with `cosine` predicted cosine-weighted visibility."""
    transfer = predicted if cosine else predicted @ diffuse_operator()
    target, floor = (ground.cosine, cosine_floor()) if cosine else (ground.sh, NORM_FLOOR)
    sh = by_part(sum_errors(predicted, target, floor=floor), ground.data.part)
    return MethodRow(method, numbers, sh, **shading_errors(transfer, ground.cosine, ground.data.part), note=note)


@functools.lru_cache
def cosine_floor() -> float:
    """The floor of relative errors for cosine-weighted vectors: the same share of an unoccluded point's norm."""
    unoccluded = unoccluded_sh()
    return float(NORM_FLOOR * np.linalg.norm(unoccluded @ diffuse_operator()) / np.linalg.norm(unoccluded))


@functools.lru_cache
def unoccluded_sh() -> Float[np.ndarray, " 16"]:
    up = jnp.asarray([0.0, 0.0, 1.0], jnp.float32)
    return np.asarray(zh_to_sh(jnp.asarray(hemisphere_zh(order=ORDER), jnp.float32), up))


# --- Methods without lobes


def baseline_rows(ground: Ground) -> Iterator[MethodRow]:
    """Predictions that do not look at the pose, and the error of truncation alone."""
    shape = ground.sh.shape
    yield method_row(ground, "unoccluded", 0, np.broadcast_to(unoccluded_sh(), shape))
    yield method_row(ground, "mean visibility", 0, np.broadcast_to(ground.sh[ground.train].mean(axis=0), shape))
    yield method_row(ground, "baked, order 4", 16, ground.sh, note="its shading error is the truncation of V")


def linear_rows(ground: Ground, predicted: SH) -> Iterator[MethodRow]:
    """Linear models of what is not lobes. `predicted` is the linear fit of the 16 SH coefficients."""
    yield method_row(ground, "linear, 16 SH", 16, predicted)
    yield method_row(ground, "linear, PCA 12 of SH", 12, point_pca(ground, 12))
    cosine = global_pca(ground, ground.cosine, 12)
    note = "SH columns against cosine-weighted visibility"
    yield method_row(ground, "linear, PCA 12 of cosine-weighted transfer", 12, cosine, cosine=True, note=note)
    yield method_row(ground, "linear, ambient occlusion", 1, ambient_occlusion(ground))


def point_pca(ground: Ground, count: int) -> SH:
    """Every point's own principal components of its SH vectors over the training frames, linear in pose."""
    mean = ground.sh[ground.train].mean(axis=0)
    centred = ground.sh - mean
    covariance = np.einsum("fni,fnj->nij", centred[ground.train], centred[ground.train], optimize=True)
    axes = np.linalg.eigh(covariance)[1][:, :, -count:].astype(np.float32)
    scores = np.einsum("fni,nij->fnj", centred, axes, optimize=True)
    return mean + np.einsum("fnj,nij->fni", ground.linear.predict(scores), axes, optimize=True)


def global_pca(ground: Ground, targets: SH, count: int) -> SH:
    """Principal components over all points and training frames together, linear in pose.

    References:
      Nowrouzezahrai et al. 2007, reduced cosine-weighted transfer with a linear model of the pose.
    """
    mean = targets[ground.train].mean(axis=(0, 1))
    flat = (targets[ground.train] - mean).reshape(-1, targets.shape[-1])
    axes = np.linalg.eigh(flat.T @ flat)[1][:, -count:]
    return mean + ground.linear.predict((targets - mean) @ axes) @ axes.T


def ambient_occlusion(ground: Ground) -> SH:
    """v = ao · (unoccluded hemisphere), with ao = ∫ V cos/π linear in pose.

    References:
      Kontkanen, Aila, "Ambient Occlusion for Animated Characters", 2006.
    """
    # The constant function is √(4π) y_00, so band 0 of cosine-weighted visibility holds the integral.
    ao = math.sqrt(4 * math.pi) * ground.cosine[..., :1]
    return ground.linear.predict(ao) * unoccluded_sh()


@dataclass(frozen=True)
class KernelPose:
    """Gaussian kernels between all frames and the training frames, group by group: the nonlinear reference."""

    data: TrainingData
    weights: Float[np.ndarray, " f"]

    def kernel(self, group: int, used: Bool[np.ndarray, " f"]) -> Float[np.ndarray, "f t"]:
        """exp(-d²/2σ²) on standardised features, σ the median distance between the frames used."""
        raw = self.data.raw[:, group].astype(np.float64)
        spread = raw[used].std(axis=0)
        # A column that hardly moves would be blown up to noise; it keeps a share of the others' scale instead.
        x = (raw - raw[used].mean(axis=0)) / np.maximum(spread, 0.1 * spread.max() + 1e-12)
        norms = np.sum(x * x, axis=1)
        d2 = np.maximum(norms[:, None] + norms[used] - 2.0 * x @ x[used].T, 0.0)
        off_diagonal = d2[used][~np.eye(used.sum(), dtype=bool)]
        return np.exp(-0.5 * d2 / max(np.median(off_diagonal), 1e-12))

    def predict_group(self, group: int, targets, used, ridges) -> Iterator[np.ndarray]:
        """Predictions in all frames, one per ridge; targets (f, m)."""
        kernel, w = self.kernel(group, used), self.weights[used]
        mean = w @ targets[used] / w.sum()
        for ridge in ridges:
            matrix = kernel[used] + np.diag(ridge / w)
            yield kernel @ scipy.linalg.solve(matrix, targets[used] - mean, assume_a="pos") + mean

    def choose_ridge(self, targets: SH) -> float:
        """By the error on motion left out of the training frames, on up to four groups."""
        folds = _folds(self.data)
        if not folds:
            return KERNEL_RIDGES[1]
        groups = np.unique(self.data.groups)
        scores = np.zeros((len(folds), len(KERNEL_RIDGES)))
        for g in groups[:: max(1, len(groups) // 4)][:4]:
            own = targets[:, self.data.groups == g].reshape(len(targets), -1).astype(np.float64)
            for i, left_out in enumerate(folds):
                used = (self.weights > 0) & ~left_out
                for k, predicted in enumerate(self.predict_group(g, own, used, KERNEL_RIDGES)):
                    scores[i, k] += np.sum((predicted[left_out] - own[left_out]) ** 2)
        return KERNEL_RIDGES[int(np.argmin(np.log(scores + 1e-12).mean(axis=0)))]

    def predict(self, targets: SH) -> SH:
        ridge, used, result = self.choose_ridge(targets), self.weights > 0, np.empty_like(targets)
        for g in np.unique(self.data.groups):
            mine = self.data.groups == g
            own = targets[:, mine].reshape(len(targets), -1).astype(np.float64)
            (predicted,) = self.predict_group(g, own, used, (ridge,))
            result[:, mine] = predicted.reshape(len(targets), -1, targets.shape[-1])
        return result


# --- Lobes


def in_blocks(function: Callable, *arrays: np.ndarray, size: int = 1024):
    """function(*rows) of a compiled function, a fixed number of rows at a time, on all cores."""

    def one(start: int):
        rows = [array[start : start + size] for array in arrays]
        padded = [np.concatenate([r, np.repeat(r[-1:], size - len(r), axis=0)]) for r in rows]
        return np.asarray(function(*padded))[: len(rows[0])]

    with ThreadPoolExecutor(num_cores()) as threads:
        return np.concatenate(list(threads.map(one, range(0, len(arrays[0]), size))))


_from_charts = jax.jit(synthesize)
_fixed_axis_numbers = jax.jit(lobe_targets)
_start_axes = jax.jit(functools.partial(spread_start_axes, order=ORDER), static_argnames=("num_lobes", "count"))


@jax.jit
def _linearize(numbers, axes):
    """SH of each row's 6c numbers (n, 16) and its derivative (n, d, 16)."""

    def along(tangent):
        return jax.jvp(lambda x: synthesize(x[None], axes)[0], (numbers,), (jnp.broadcast_to(tangent, numbers.shape),))[
            1
        ]

    jacobian = jax.vmap(along)(jnp.eye(numbers.shape[-1], dtype=numbers.dtype))
    return synthesize(numbers[None], axes)[0], jnp.swapaxes(jacobian, 0, 1)


def fit_rows(sh, axes, *, penalty: Float[np.ndarray, " d"], num_steps: int = 12) -> Float[np.ndarray, "n d"]:
    """Levenberg-Marquardt over the 6c numbers of each row: |SH - sh|² + Σ penalty x², charts around `axes`.

    `jaxrender.harmonics.fit_zh_lobes` minimises the same with the coefficients eliminated; here the small systems are
    solved outside XLA, because its program takes longer to compile than the study to run.
    """
    numbers = np.asarray(_fixed_axis_numbers(sh[None], axes))[0]

    def normal_equations(x):
        predicted, jacobian = (np.asarray(a) for a in _linearize(x, axes))
        rest = predicted - sh
        value = np.sum(rest * rest, axis=-1) + (x * x) @ penalty
        return value, np.einsum("ndk,nk->nd", jacobian, rest) + penalty * x, jacobian @ jacobian.swapaxes(1, 2)

    value, gradient, matrix = normal_equations(numbers)
    damping, unit = np.full(len(sh), 1e-2, np.float32), np.eye(numbers.shape[1], dtype=np.float32)
    for _ in range(num_steps):
        damped = matrix + (damping[:, None, None] + penalty) * unit
        trial = numbers - np.linalg.solve(damped, gradient[..., None])[..., 0]
        new = normal_equations(trial)
        better = new[0] < value
        numbers = np.where(better[:, None], trial, numbers)
        value, gradient = np.where(better, new[0], value), np.where(better[:, None], new[1], gradient)
        matrix = np.where(better[:, None, None], new[2], matrix)
        damping = np.clip(np.where(better, 0.2 * damping, 8.0 * damping), 1e-5, 1e3)
    return numbers


@jax.jit
def _angles_from_charts(numbers, axes):
    turned, coefficients = lobes_from_numbers(numbers, axes)
    x, y, z = (turned[..., i] for i in range(3))
    angles = jnp.stack([jnp.arccos(jnp.clip(z, -1.0, 1.0)), jnp.arctan2(y, x)], axis=-1)
    lead = numbers.shape[:-1]
    return jnp.concatenate([angles.reshape(*lead, -1), coefficients.reshape(*lead, -1)], axis=-1)


@jax.jit
def _from_angles(numbers):
    c = numbers.shape[-1] // 6
    angles = numbers[..., : 2 * c].reshape(*numbers.shape[:-1], c, 2)
    theta, phi = angles[..., 0], angles[..., 1]
    axes = jnp.stack([jnp.sin(theta) * jnp.cos(phi), jnp.sin(theta) * jnp.sin(phi), jnp.cos(theta)], axis=-1)
    return lobes_to_sh(numbers[..., 2 * c :].reshape(*numbers.shape[:-1], c, ORDER), axes)


def point_axes(ground: Ground, num_lobes: int) -> Float[np.ndarray, "n c 3"]:
    """One set of axes per point for all its training frames: the best of several matching pursuits."""
    starts = np.asarray(_start_axes(ground.sh[ground.train], num_lobes=num_lobes, count=6))
    errors = []
    for axes in starts:
        fitted = np.asarray(_from_charts(_fixed_axis_numbers(ground.sh, axes), axes))
        errors.append(np.sum((fitted - ground.sh)[ground.train] ** 2, axis=(0, 2)))
    return starts[np.argmin(errors, axis=0), ground.all_points]


def free_fits(sh: Float[np.ndarray, "n 16"], num_lobes: int) -> Float[np.ndarray, "n d"]:
    """θ, φ and coefficients of each row fitted on its own, the better of two starts."""
    penalty = np.full(6 * num_lobes, 1e-6, np.float32)

    def block(rows):
        found = []
        for start in np.asarray(_start_axes(rows[None], num_lobes=num_lobes, count=2)):
            numbers = fit_rows(rows, start, penalty=penalty)
            error = np.sum((np.asarray(_linearize(numbers, start)[0]) - rows) ** 2, axis=-1)
            found.append((np.asarray(_angles_from_charts(numbers, start)), error))
        (a, error_a), (b, error_b) = found
        return np.where((error_a <= error_b)[:, None], a, b)

    return in_blocks(block, sh)


def raw_angle_lobes(ground: Ground, num_lobes: int) -> tuple[SH, SH]:
    """Each frame fitted on its own; θ, φ and coefficients linear in pose. Also the fits themselves."""
    f, n, k = ground.sh.shape
    numbers = free_fits(ground.sh.reshape(f * n, k), num_lobes).reshape(f, n, -1)
    return np.asarray(_from_angles(ground.linear.predict(numbers))), np.asarray(_from_angles(numbers))


def anchored_lobes(ground: Ground, axes: Float[np.ndarray, "n c 3"]) -> SH:
    """Each frame fitted near the point's own axes; chart coordinates and coefficients linear in pose.

    The penalty is μ(|chart|² + 0.01 |z|²), μ = 0.01 for one lobe and 0.1 for more.
    """
    (f, n, k), c = ground.sh.shape, axes.shape[1]
    mu = 0.01 if c == 1 else 0.1
    penalty = np.concatenate([np.full(2 * c, mu), np.full(4 * c, 0.01 * mu)]).astype(np.float32)
    repeated = np.broadcast_to(axes, (f, *axes.shape)).reshape(f * n, c, 3)
    fit = functools.partial(fit_rows, penalty=penalty, num_steps=8)
    numbers = in_blocks(fit, ground.sh.reshape(f * n, k), repeated).reshape(f, n, -1)
    return np.asarray(_from_charts(ground.linear.predict(numbers), axes))


def fixed_axis_lobes(ground: Ground, axes: Float[np.ndarray, "n c 3"]) -> SH:
    """Axes fixed per point, coefficients linear in pose."""
    numbers = np.asarray(_fixed_axis_numbers(ground.sh, axes))
    return np.asarray(_from_charts(ground.linear.predict(numbers), axes))


def refined_lobes(ground: Ground, num_lobes: int, *, offset: bool, track: Track) -> SH:
    """The training proper (fit_block) for another number of lobes, in blocks small enough for a few points a group."""
    fit = dataclasses.replace(ground.fit, num_lobes=num_lobes, offset=offset)
    linear, used, result = ground.linear, ground.linear.weights > 0, np.empty_like(ground.sh)
    todo = group_blocks(ground.data.groups, STUDY_BLOCK)

    def solve(own: Int[np.ndarray, " n"]) -> SH:
        padded = np.concatenate([own, np.repeat(own[-1:], STUDY_BLOCK - len(own))])
        rows = linear.rows(int(ground.data.groups[own[0]]))
        weights, axes, constant = fit_block(rows, ground.sh[used][:, padded], fit)
        components = linear.components[:, ground.data.groups[own[0]]].astype(np.float32)
        return np.asarray(_predict_block(components, weights, axes, constant))[:, : len(own)]

    with ThreadPoolExecutor(num_cores()) as threads:
        solved = threads.map(solve, todo)
        for own in track(iter(todo), len(todo), f"{num_lobes} lobes"):
            result[:, own] = next(solved)
    return result


@jax.jit
def _predict_block(components, weights, axes, offset):
    return synthesize(apply_linear(components, weights), axes) + offset[None]


def group_blocks(groups: Int[np.ndarray, " n"], size: int) -> list[Int[np.ndarray, " m"]]:
    """Points of one group each, up to `size` of them."""
    owns = [np.flatnonzero(groups == g) for g in np.unique(groups)]
    return [own[i : i + size] for own in owns for i in range(0, len(own), size)]


def refined_label(num_lobes: int, offset: bool) -> str:
    return f"{num_lobes} lobes, refined" + (" + offset" if offset else "")


def lobe_rows(ground: Ground, refined: dict[int, SH], axes: dict[int, np.ndarray]) -> Iterator[MethodRow]:
    for c in LOBE_COUNTS:
        yield method_row(ground, f"{c} lobes, axes fixed per point", 6 * c, fixed_axis_lobes(ground, axes[c]))
    for c in LOBE_COUNTS:
        yield method_row(ground, refined_label(c, ground.fit.offset), 6 * c, refined[c])


def subset_rows(
    ground: Ground, refined: dict[tuple[int, bool], SH], axes: dict[int, np.ndarray], track: Track
) -> Iterator[MethodRow]:
    """From the paper's way to the refined model on the same few points and frames.

    Args:
      refined: by number of lobes and offset; trained on all frames, given here for the ground's.
      axes: of each point, by number of lobes.
    """
    yield method_row(ground, "mean visibility", 0, np.broadcast_to(ground.sh[ground.train].mean(0), ground.sh.shape))
    yield method_row(ground, "linear, 16 SH", 16, ground.linear.predict(ground.sh))
    for c in track(iter(LOBE_COUNTS), len(LOBE_COUNTS), "fits per frame"):
        predicted, fitted = raw_angle_lobes(ground, c)
        yield method_row(ground, f"{c} lobes, fit per frame, no pose model", 6 * c, fitted)
        yield method_row(ground, f"{c} lobes, raw angles", 6 * c, predicted, note="as the paper prints it")
        yield method_row(ground, f"{c} lobes, anchored charts", 6 * c, anchored_lobes(ground, axes[c]))
        yield method_row(ground, f"{c} lobes, axes fixed per point", 6 * c, fixed_axis_lobes(ground, axes[c]))
        for offset in (False, True):
            note = "trained on all frames"
            yield method_row(ground, refined_label(c, offset), 6 * c, refined[c, offset], note=note)


# --- Figures, curves, gains


def series(name: str, target: str, norm: str, predicted: SH, truth: SH, part, *, floor: float) -> dict:
    """One curve of a figure, over the frames that are not mixed."""
    real = part != MIXED
    sums = sum_errors(predicted[real], truth[real], floor=floor)
    return {"name": name, "target": target, "norm": norm, "curve": sums.frame_curve(), **by_part(sums, part[real])}


def figure3(ground: Ground, plain: SH) -> list[dict]:
    """Plain fit, cosine-weighted fit, and the plain fit convolved analytically (the paper's figure 3).

    The convolved one stands against both truths: it wins or loses by the choice.
    """
    cosine_target = "cosine-weighted visibility from the bits, order 4"
    truncated = "M^1/pi of order-4 visibility"
    norm, cosine_norm = f"max(|v|, {NORM_FLOOR})", f"max(|t|, {cosine_floor():.3f})"
    weighted, convolved = ground.linear.predict(ground.cosine), plain @ diffuse_operator()
    part, low = ground.data.part, cosine_floor()
    return [
        series("plain fit", "order-4 visibility", norm, plain, ground.sh, part, floor=NORM_FLOOR),
        series("cosine-weighted fit", cosine_target, cosine_norm, weighted, ground.cosine, part, floor=low),
        series("plain fit, convolved", cosine_target, cosine_norm, convolved, ground.cosine, part, floor=low),
        series(
            "plain fit, convolved", truncated, cosine_norm, convolved, ground.sh @ diffuse_operator(), part, floor=low
        ),
    ]


def figure5(ground: Ground, refined: dict) -> list[dict]:
    """One lobe against two and three (the paper's figure 5), refined as the model's settings say."""
    norm, part = f"max(|v|, {NORM_FLOOR})", ground.data.part
    named = {f"{c} lobe{'s' * (c > 1)}": refined[c] for c in LOBE_COUNTS}
    return [
        series(name, "order-4 visibility", norm, predicted, ground.sh, part, floor=NORM_FLOOR)
        for name, predicted in named.items()
    ]


def ridge_curve(ground: Ground) -> list[dict]:
    """Global SH error of linear-16 for every penalty."""
    rows = []
    for ridge in RIDGES:
        predicted = dataclasses.replace(ground.linear, ridge=ridge).predict(ground.sh)
        rows.append({"ridge": ridge, **by_part(sum_errors(predicted, ground.sh), ground.data.part)})
    return rows


Angles = tuple[Float[np.ndarray, "f 1 n"], FeatureBasis]


def with_angles(data: TrainingData, angles: Angles) -> TrainingData:
    """The same data seen through joint angles."""
    raw, basis = angles
    return dataclasses.replace(data, raw=raw, basis=basis, groups=np.zeros_like(data.groups))


def with_distant_angles(data: TrainingData, angles: Angles) -> TrainingData:
    """Joint angles divided by 1 + 3·(skeleton distance in body sizes) to each group's bone.

    Under a common ridge this is a penalty that grows with the square of that number.
    """
    raw, basis = angles
    distance = joint_distances(data.basis, np.asarray(basis.joints))
    scale = 1.0 / (1.0 + 3.0 * np.repeat(distance, raw.shape[2] // distance.shape[1], axis=1))
    return dataclasses.replace(data, raw=(raw * scale[None]).astype(np.float32), basis=basis)


def joint_distances(basis: FeatureBasis, joints: Int[np.ndarray, " a"]) -> Float[np.ndarray, "g a"]:
    """Distances along the skeleton in body sizes, from a basis' falloff exp(-3.5 d); at most 4.

    Joints the basis does not know (they carry no skin) count as far as the mean of the others.
    """
    known = -np.log(np.maximum(np.asarray(basis.falloff, np.float64), 1e-6)) / 3.5
    place = {int(joint): i for i, joint in enumerate(np.asarray(basis.joints))}
    columns = [known[:, place[int(j)]] if int(j) in place else known.mean(axis=1) for j in joints]
    return np.stack(columns, axis=1)


def linear_gain(ground: Ground, label: str, data: TrainingData, fit: FitSettings) -> dict:
    """Linear-16 with other features or training poses, its ridge chosen anew."""
    ridge = choose_ridge(data, fit, max_points=200)
    predicted = linear_pose(data, fit, ridge).predict(ground.sh)
    return {"variant": label, "ridge": ridge, **by_part(sum_errors(predicted, ground.sh), ground.data.part)}


def kernel_gain(ground: Ground, label: str, predicted: SH) -> dict:
    return {"variant": label, "ridge": None, **by_part(sum_errors(predicted, ground.sh), ground.data.part)}


def gains(ground: Ground, kernel: SH, angles: Angles | None) -> list[dict]:
    """What each step towards unseen motion brings, on linear-16 and on the kernel reference."""
    data, fit = ground.data, ground.fit
    unmixed = dataclasses.replace(fit, mixed_weight=0.0)
    own = f"{data.basis.kind} features"
    rows = []
    if angles is not None:
        rows += [
            linear_gain(ground, "joint angles", with_angles(data, angles), unmixed),
            linear_gain(ground, "joint angles + mixed poses", with_angles(data, angles), fit),
        ]
    if angles is not None and data.basis.kind == "surroundings":
        far = with_distant_angles(data, angles)
        rows.append(linear_gain(ground, "joint angles, distance penalty + mixed poses", far, fit))
    rows += [linear_gain(ground, own, data, unmixed), linear_gain(ground, f"{own} + mixed poses", data, fit)]
    rows.append(kernel_gain(ground, f"{own} + mixed poses, Gaussian kernel", kernel))
    return rows


# --- The study


def run_study(
    data: TrainingData,
    model: PoseModel,
    fit: FitSettings,
    *,
    ridge: float,
    max_points: int,
    angles: Angles | None,
    track: Track = no_tracking,
) -> Study:
    """All methods on `max_points` visible points."""
    points = _some_points(data, max_points)
    ground = make_ground(thin(data, points), fit, ridge)
    linear = ground.linear.predict(ground.sh)
    kernel = KernelPose(ground.data, ground.linear.weights).predict(ground.sh)
    offset = fit.offset
    refined = {c: refined_lobes(ground, c, offset=offset, track=track) for c in LOBE_COUNTS}
    axes = {c: point_axes(ground, c) for c in LOBE_COUNTS}
    own = predict_sh(model, model_components(model, data.raw), points)
    rows = [
        *baseline_rows(ground),
        *linear_rows(ground, linear),
        *_angle_rows(ground, angles),
        *lobe_rows(ground, refined, axes),
        method_row(ground, "the trained model", 6 * model.num_lobes, own),
        method_row(ground, "Gaussian kernel, 16 SH", 16, kernel, note="the nonlinear reference"),
    ]
    subset = _subset(ground, refined, axes, track)
    return Study(
        points=points,
        rows=rows,
        subset_rows=subset,
        goals=goals(rows, subset, fit),
        figure3=figure3(ground, linear),
        figure5=figure5(ground, refined),
        ridge_curve=ridge_curve(ground),
        gains=gains(ground, kernel, angles),
    )


def _angle_rows(ground: Ground, angles: Angles | None) -> list[MethodRow]:
    if angles is None:
        return []
    data = with_angles(ground.data, angles)
    ridge = choose_ridge(data, ground.fit, max_points=200)
    predicted = linear_pose(data, ground.fit, ridge).predict(ground.sh)
    return [method_row(ground, "linear, 16 SH, joint angles", 16, predicted, note=f"ridge {ridge:.3g}")]


def _subset(ground: Ground, refined: dict[int, SH], axes: dict[int, np.ndarray], track: Track) -> list[MethodRow]:
    """`subset_rows` on whole blocks of points, spread over the groups, and every second frame."""
    found = group_blocks(ground.data.groups, STUDY_BLOCK)
    count = max(1, SUBSET_POINTS // STUDY_BLOCK)
    some = np.sort(np.concatenate(sorted(found, key=len)[-2 * count :][::2]))
    linear, fit = ground.linear, ground.fit
    few = make_ground(thin(ground.data, some), fit, linear.ridge)
    both = {(c, fit.offset): refined[c][:, some] for c in LOBE_COUNTS}
    both |= {(c, not fit.offset): refined_lobes(few, c, offset=not fit.offset, track=track) for c in LOBE_COUNTS}
    thinned = make_ground(thin(ground.data, some, SUBSET_STEP), fit, linear.ridge)
    return list(
        subset_rows(
            thinned, {key: sh[::SUBSET_STEP] for key, sh in both.items()}, {c: a[some] for c, a in axes.items()}, track
        )
    )


def goals(rows: list[MethodRow], subset: list[MethodRow], fit: FitSettings) -> list[Goal]:
    """The project's goals for the fit, checked."""
    table, small = ({row.method: row for row in some} for some in (rows, subset))
    linear, two, three = table["linear, 16 SH"], *(table[refined_label(c, fit.offset)] for c in (2, 3))
    small_two, raw = small[refined_label(2, fit.offset)], small["2 lobes, raw angles"]
    found = []
    for name, row, sh_limit, shading_limit in (("2 lobes", two, 1.20, 1.03), ("3 lobes", three, 1.0, 1.0)):
        found.append(_ratio_goal(f"{name} / linear-16, SH, segments", row.sh, linear.sh, sh_limit))
        for light in ("directional", "environment"):
            mine, its = getattr(row, light), getattr(linear, light)
            found.append(_ratio_goal(f"{name} / linear-16, {light} shading, segments", mine, its, shading_limit))
    found.append(_ratio_goal("2 lobes / raw angles, SH, segments", small_two.sh, raw.sh, 0.42))
    found.append(_goal("trained model, SH, unseen clips", table["the trained model"].sh["clips"], 0.19))
    return found


def _ratio_goal(name: str, mine: ByPart, other: ByPart, limit: float) -> Goal:
    a, b = mine["segments"], other["segments"]
    return _goal(name, a / max(b, 1e-12) if a is not None and b is not None else None, limit)


def _goal(name: str, value: float | None, limit: float) -> Goal:
    return Goal(name, value, limit, None if value is None else value <= limit)
