"""Training: bake visibility, choose the ridge, solve, refine. Returns a result and prints nothing."""

import dataclasses
import functools
import hashlib
import itertools
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fitting.config import FitSettings, TrainSettings
from fitting.dataset import (
    BakeStatistics,
    PosedMesh,
    ShadingPoints,
    VisibilityStore,
    bake,
    character_frames,
    choose_points,
    mean_visibility,
    sequence_frames,
)
from fitting.features import all_raw_features, feature_groups, fit_basis, unfitted_basis
from fitting.motion import MIXED, SEGMENT, TRAIN, Motion, sample_motion
from fitting.solve import (
    BLOCK,
    ORDER,
    PoseRows,
    apply_linear,
    block_sh,
    lobe_metric,
    lobe_targets,
    mean_residual,
    refine_block,
    solve_linear,
    synthesize,
)
from jaxrender.animation.skinning import Character
from jaxrender.checks import bad_input
from jaxrender.harmonics.pose_model import FeatureBasis, PoseModel
from jaxrender.harmonics.visibility import hemisphere_directions, projection_table
from jaxrender.harmonics.zh_fit import spread_start_axes
from jaxrender.machine import num_cores
from jaxrender.scene import MeshSequence

# Points that see less than this share of their hemisphere in the training frames, on average, are inner surfaces.
INVISIBLE_BELOW = 0.02
RIDGES = tuple(10.0 ** (-0.5 * i) for i in range(8, -1, -1))
NUM_STARTS = 3

Track = Callable[[Iterator, int, str], Iterator]


def no_tracking(items: Iterator, _count: int, _label: str) -> Iterator:
    return items


@dataclass(frozen=True)
class TrainingData:
    """Baked visibility and the poses it belongs to; f frames, p points, g groups.

    `part` says what each frame is for (fitting.motion), `clip` which clip it is from, `source` which frames the limbs
    of a mixed pose are from.
    """

    name: str
    points: ShadingPoints
    groups: Int[np.ndarray, " p"]
    bits: UInt8[np.ndarray, "f p bytes"]
    raw: Float[np.ndarray, "f g n"]
    basis: FeatureBasis
    part: Int[np.ndarray, " f"]
    clip: Int[np.ndarray, " f"]
    num_directions: int
    visible: Bool[np.ndarray, " p"]
    source: Int[np.ndarray, "f j"] | None = None

    def frame_weights(self, mixed_weight: float) -> Float[np.ndarray, " f"]:
        """1 for training frames, `mixed_weight` for mixed poses, 0 for what is held out."""
        return np.where(self.part == TRAIN, 1.0, np.where(self.part == MIXED, mixed_weight, 0.0))

    @property
    def table(self) -> Float[np.ndarray, "d 16"]:
        return projection_table(hemisphere_directions(self.num_directions), order=ORDER)

    def sh(self, points: Int[np.ndarray, " n"]) -> Float[np.ndarray, "f n 16"]:
        """Baked SH visibility of some points in all frames."""
        return np.asarray(block_sh(self.bits[:, points], self.table))


@dataclass
class Timings:
    """Seconds per stage, in the order they ran."""

    seconds: dict[str, float] = field(default_factory=dict)

    def stage(self, name: str) -> "_Stage":
        return _Stage(self, name)


class _Stage:
    def __init__(self, timings: Timings, name: str):
        self.timings, self.name = timings, name

    def __enter__(self) -> None:
        self.started = time.perf_counter()

    def __exit__(self, *_) -> None:
        self.timings.seconds[self.name] = time.perf_counter() - self.started


@dataclass(frozen=True)
class TrainResult:
    model: PoseModel
    data: TrainingData
    ridge: float
    bake: BakeStatistics
    timings: Timings
    motion: Motion | None


def bake_character(
    character: Character, settings: TrainSettings, store: Path, *, track: Track = no_tracking
) -> tuple[TrainingData, BakeStatistics, Motion]:
    """Bakes every frame of a character's motion, or what is missing of it in the store."""
    motion = sample_motion(character, settings.bake, settings.split)
    points = choose_points(character, settings.bake.max_points, seed=settings.bake.seed)
    bones, groups = feature_groups(character, points.vertices, settings.fit.features)
    basis = unfitted_basis(character, motion, settings.fit.features, bones)
    raw = all_raw_features(basis, character, motion)
    frames = character_frames(character, motion)
    arrays = [np.asarray(values) for values in jax.tree.leaves(motion.pose)]
    source = _source_hash(character.content_hash, [*arrays, points.vertices, np.asarray(character.faces)])
    data, statistics = _bake(
        character.name, frames, character.faces, points, groups, raw, basis, motion.part, motion.clip,
        source, settings, store, track,
    )  # fmt: skip
    return dataclasses.replace(data, source=motion.source), statistics, motion


def bake_sequence(
    sequence: MeshSequence, settings: TrainSettings, store: Path, *, name: str = "sequence", track: Track = no_tracking
) -> tuple[TrainingData, BakeStatistics]:
    """The same for a mesh sequence without a skeleton; its feature matrix drives the model as it is.

    Raises:
      InputError: if a feature or vertex is not finite, or no feature varies over the training frames.
    """
    frames = sequence_frames(sequence)
    num_frames, num_vertices = sequence.vertices.shape[:2]
    part = np.full(num_frames, TRAIN)
    part[int(np.ceil(num_frames * (1.0 - settings.split.segment_share))) :] = SEGMENT
    raw = np.asarray(sequence.features, np.float32)[:, None, :]
    if (part == TRAIN).sum() < 2:
        bad_input(name, "frames", expected="at least 2 to train on", got=int((part == TRAIN).sum()))
    if not np.ptp(raw[part == TRAIN], axis=0).max() > 0:
        bad_input(name, "features", expected="at least one column that varies", got="constant columns only")
    empty = jnp.zeros(0, jnp.int32)
    basis = FeatureBasis(
        kind="given", size=1.0, joints=empty, bones=jnp.zeros(1, jnp.int32), falloff=jnp.zeros((1, 0)),
        reference=jnp.zeros((0, 4)), translations=jnp.zeros((0, 3)), mean=jnp.zeros((1, 0)), basis=jnp.zeros((1, 0, 0)),
    )  # fmt: skip
    vertices = np.arange(num_vertices)
    arrays = (sequence.vertices, sequence.frames, sequence.faces)
    source = _source_hash(name, [np.asarray(array) for array in arrays])
    return _bake(
        name, frames, sequence.faces, ShadingPoints(vertices, vertices), np.zeros(num_vertices, np.int32), raw, basis,
        part, np.zeros(num_frames, int), source, settings, store, track,
    )  # fmt: skip


def _bake(name, frames, faces, points, groups, raw, basis, part, clip, source, settings, store_path, track):
    store = VisibilityStore(
        store_path, num_frames=len(part), num_points=len(points.vertices), bake=settings.bake, source=source
    )
    statistics = bake(
        store, frames, faces, points.vertices, settings.bake, track=lambda items, count: track(items, count, "bake")
    )
    bits = store.read()
    visible = mean_visibility(bits[part == TRAIN], settings.bake.num_directions).mean(axis=0) >= INVISIBLE_BELOW
    if not visible.any():
        bad_input(name, "vertices", expected="some that see out of the mesh", got="every vertex inside")
    data = TrainingData(
        name,
        points,
        groups,
        bits,
        raw,
        basis,
        np.asarray(part),
        np.asarray(clip),
        settings.bake.num_directions,
        visible,
    )
    return data, statistics


def _source_hash(name: str, arrays: list[np.ndarray]) -> str:
    digest = hashlib.sha256(name.encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


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


def choose_ridge(data: TrainingData, fit: FitSettings, *, max_points: int = 1200) -> float:
    """The penalty whose linear SH model does best on motion left out of the training frames.

    Folds: the last fifth of every training clip, and each of up to four training clips left out whole. The score is
    the logarithm of the first error plus the mean one of the others, so that neither known nor unknown motion decides
    alone.
    """
    weights = data.frame_weights(fit.mixed_weight)
    points = _some_points(data, max_points)
    folds = _folds(data)
    if not folds:
        return RIDGES[len(RIDGES) // 2]
    sh = data.sh(points)
    scores = np.zeros((len(folds), len(RIDGES)))
    totals = np.zeros(len(folds))
    basis, _ = fit_basis(data.basis, data.raw, weights, fit.num_components)
    for g in np.unique(data.groups[points]):
        own = sh[:, data.groups[points] == g].reshape(len(sh), -1).astype(np.float64)
        a = (data.raw[:, g] - np.asarray(basis.mean)[g]) @ np.asarray(basis.basis)[g].astype(np.float64)
        for i, left_out in enumerate(folds):
            # A mixed pose with a limb of a left-out frame would give it away.
            hidden = left_out if data.source is None else left_out[data.source].any(axis=1)
            w = np.where(hidden, 0.0, weights)
            mean_a, mean_b = w @ a / w.sum(), w @ own / w.sum()
            centred, rest = a - mean_a, own - mean_b
            gram, moment = centred.T @ (w[:, None] * centred), centred.T @ (w[:, None] * rest)
            values, vectors = np.linalg.eigh(gram)
            rotated, seen = vectors.T @ moment, centred[left_out] @ vectors
            for k, ridge in enumerate(RIDGES):
                x = rotated / (np.maximum(values, 0) + ridge * np.trace(gram) / len(gram))[:, None]
                scores[i, k] += np.sum((seen @ x - rest[left_out]) ** 2)
            totals[i] += np.sum(own[left_out] ** 2)
    logs = np.log(scores / totals[:, None] + 1e-12)
    known, unknown = logs[0], logs[1:].mean(axis=0) if len(logs) > 1 else 0.0
    return RIDGES[int(np.argmin(known + unknown))]


def _folds(data: TrainingData) -> list[Bool[np.ndarray, " f"]]:
    train = data.part == TRAIN
    clips = [c for c in np.unique(data.clip[train]) if (train & (data.clip == c)).sum() >= 5]
    tail = np.zeros(len(train), bool)
    for c in clips:
        frames = np.flatnonzero(train & (data.clip == c))
        tail[frames[int(np.ceil(0.8 * len(frames))) :]] = True
    whole = [train & (data.clip == c) for c in clips[:: max(1, len(clips) // 4)][:4]] if len(clips) >= 3 else []
    return ([tail] if tail.any() else []) + whole


def _some_points(data: TrainingData, count: int) -> Int[np.ndarray, " n"]:
    """Visible points, evenly spread over the list."""
    visible = np.flatnonzero(data.visible)
    return visible[np.linspace(0, len(visible) - 1, min(count, len(visible))).astype(int)]


@dataclass(frozen=True)
class Block:
    """Up to BLOCK points of one group, padded with repetitions of the last."""

    group: int
    points: Int[np.ndarray, " n"]

    @property
    def padded(self) -> Int[np.ndarray, " block"]:
        return np.concatenate([self.points, np.repeat(self.points[-1:], BLOCK - len(self.points))])


def blocks(groups: Int[np.ndarray, " p"], points: Int[np.ndarray, " n"]) -> list[Block]:
    """The points cut into blocks of one group each."""
    cut = []
    for g in np.unique(groups[points]):
        own = points[groups[points] == g]
        cut += [Block(int(g), own[i : i + BLOCK]) for i in range(0, len(own), BLOCK)]
    return cut


def pose_rows(
    data: TrainingData, basis: FeatureBasis, moments: Float[np.ndarray, "g k"], weights: Float[np.ndarray, " f"],
    group: int, ridge: float,
) -> PoseRows:  # fmt: skip
    """The weighted training poses of one group."""
    used = weights > 0
    components = (data.raw[used, group] - np.asarray(basis.mean)[group]) @ np.asarray(basis.basis)[group]
    lam = ridge * moments[group].sum() / moments.shape[1]
    return PoseRows(*(jnp.asarray(x, jnp.float32) for x in (components, weights[used], moments[group], lam)))


def fit_model(data: TrainingData, fit: FitSettings, *, ridge: float, track: Track = no_tracking) -> PoseModel:
    """Solves for all visible points, block by block, and assembles the model."""
    weights = data.frame_weights(fit.mixed_weight)
    basis, moments = fit_basis(data.basis, data.raw, weights, fit.num_components)
    used, k, p = weights > 0, moments.shape[1], len(data.points.vertices)
    numbers = np.zeros((p, k + 1, 6 * fit.num_lobes), np.float16 if fit.half_precision else np.float32)
    axes = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (p, fit.num_lobes, 1))
    offset = np.zeros((p, ORDER**2), np.float32)
    todo = blocks(data.groups, np.flatnonzero(data.visible))
    bits = data.bits[used]

    def solve(block: Block):
        rows = pose_rows(data, basis, moments, weights, block.group, ridge)
        return fit_block(rows, block_sh(bits[:, block.padded], data.table), fit)

    # XLA runs each block on its calling thread (jaxrender.machine); two blocks at a time keep two cores busy.
    # The first block alone compiles what all share.
    first = solve(todo[0])
    with ThreadPoolExecutor(num_cores()) as threads:
        solutions = itertools.chain([first], threads.map(solve, todo[1:]))
        for block in track(iter(todo), len(todo), "fit"):
            solved, n = next(solutions), len(block.points)
            numbers[block.points] = np.swapaxes(solved[0], 0, 1)[:n]
            axes[block.points], offset[block.points] = solved[1][:n], solved[2][:n]
    return PoseModel(
        features=basis,
        weights=jnp.asarray(numbers),
        axes=jnp.asarray(axes),
        offset=jnp.asarray(offset),
        groups=jnp.asarray(data.groups, jnp.int32),
        points=jnp.asarray(data.points.of_vertex, jnp.int32),
        visible=jnp.asarray(data.visible),
    )


def fit_block(
    rows: PoseRows, sh: Float[np.ndarray, "f p 16"], fit: FitSettings
) -> tuple[Float[np.ndarray, "m p d"], Float[np.ndarray, "p c 3"], Float[np.ndarray, "p 16"]]:
    """Weights, reference axes and offset of one block.

    Several greedy starts are refined for a third of the steps, the best of each point goes on for two rounds, each
    with the metric of where it stands.
    """
    starts = _starts(sh, num_lobes=fit.num_lobes, count=NUM_STARTS if fit.refine_steps else 1)
    best: Any = None
    for axes in starts:
        weights = _initial(rows, sh, axes)
        metric = _metric(rows, weights, axes)
        trial = weights, axes, metric, jnp.zeros(sh.shape[1])
        if fit.refine_steps:
            first = -(-fit.refine_steps // 3)
            weights, value = _refine(rows, sh, weights, axes, metric, metric, num_steps=first, offset=fit.offset)
            trial = weights, axes, metric, value
        best = trial if best is None else _better(best, trial)
    weights, axes, penalty, _ = best
    for _ in range(2 if fit.refine_steps else 0):
        metric = _metric(rows, weights, axes)
        weights, _ = _refine(
            rows, sh, weights, axes, penalty, metric, num_steps=-(-fit.refine_steps // 3), offset=fit.offset
        )
    offset = _offset(rows, sh, weights, axes) if fit.offset else jnp.zeros((sh.shape[1], ORDER**2))
    return np.asarray(weights), np.asarray(axes), np.asarray(offset)


_starts = jax.jit(functools.partial(spread_start_axes, order=ORDER), static_argnames=("num_lobes", "count"))
_initial = jax.jit(lambda rows, sh, axes: solve_linear(rows, lobe_targets(sh, axes)))
_refine_jit = jax.jit(refine_block, static_argnames=("num_steps", "offset"))


@jax.jit
def _metric_of_some(rows, weights, axes):
    # A mean over frames; every fourth frame tells it well enough.
    some = slice(None, None, 4)
    return lobe_metric(apply_linear(rows.components[some], weights), axes, rows.weights[some])


def _metric(rows, weights, axes) -> np.ndarray:
    return np.asarray(_metric_of_some(rows, weights, axes))


def _refine(rows, sh, weights, axes, penalty, metric, *, num_steps, offset):
    inverse = np.linalg.inv(np.asarray(metric, np.float64)).astype(np.float32)
    return _refine_jit(weights, rows, sh, axes, penalty, inverse, num_steps=num_steps, offset=offset)


@jax.jit
def _better(a, b):
    """Per point, the one of two solutions (weights, axes, metric, value) with the lower value."""
    take = b[3] < a[3]
    pick = lambda x, y, axis: jnp.where(take.reshape((1,) * axis + (-1,) + (1,) * (x.ndim - axis - 1)), y, x)  # noqa: E731
    return pick(a[0], b[0], 1), pick(a[1], b[1], 0), pick(a[2], b[2], 0), pick(a[3], b[3], 0)


@jax.jit
def _offset(rows, sh, weights, axes):
    predicted = synthesize(apply_linear(rows.components, weights), axes)
    return mean_residual(sh, predicted, rows.weights)


def predict_sh(
    model: PoseModel, components: Float[np.ndarray, "f g k"], points: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "f n 16"]:
    """The model's SH visibility of some points in many poses, in blocks."""
    result = np.zeros((len(components), len(points), ORDER**2), np.float32)
    where = np.full(len(np.asarray(model.groups)), -1)
    where[points] = np.arange(len(points))
    weights, axes, offset = (np.asarray(x) for x in (model.weights, model.axes, model.offset))
    for block in blocks(np.asarray(model.groups), points):
        own = block.padded
        numbers = np.swapaxes(weights[own].astype(np.float32), 0, 1)
        sh = _predict_block(components[:, block.group], numbers, axes[own], offset[own])
        result[:, where[block.points]] = np.asarray(sh)[:, : len(block.points)]
    return result


@jax.jit
def _predict_block(components, weights, axes, offset):
    return synthesize(apply_linear(components, weights), axes) + offset[None]


__all__ = ["PosedMesh", "TrainResult", "TrainingData", "bake_character", "bake_sequence", "choose_ridge", "fit_model"]
