"""The fit of all points, block by block: greedy axes, linear solve, joint refinement, offset."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from fitting.checkpoint import NOTHING_KEPT, Arrays, Checkpoint, Stage
from fitting.config import FitSettings
from fitting.features import fit_basis
from fitting.solve import (
    BLOCK,
    ORDER,
    PoseRows,
    apply_linear,
    block_sh,
    lobe_metric,
    lobe_targets,
    mean_residual,
    padded,
    refine_block,
    solve_linear,
    synthesize,
)
from fitting.stages import Track, no_tracking
from fitting.training_data import TrainingData
from jaxrender.harmonics.pose_model import FeatureBasis, PoseModel
from jaxrender.harmonics.zh_fit import spread_start_axes

NUM_STARTS = 3


@dataclass(frozen=True)
class Block:
    """Up to `size` points of one group; `padded` has exactly so many."""

    group: int
    points: Int[np.ndarray, " n"]
    size: int

    @property
    def padded(self) -> Int[np.ndarray, " size"]:
        return padded(self.points, self.size)


def blocks(groups: Int[np.ndarray, " p"], points: Int[np.ndarray, " n"], *, size: int = BLOCK) -> list[Block]:
    """The points cut into blocks of one group each."""
    cut = []
    for g in np.unique(groups[points]):
        own = points[groups[points] == g]
        cut += [Block(int(g), own[i : i + size], size) for i in range(0, len(own), size)]
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


def fit_model(
    data: TrainingData,
    fit: FitSettings,
    *,
    ridge: float,
    track: Track = no_tracking,
    checkpoint: Checkpoint = NOTHING_KEPT,
) -> PoseModel:
    """Solves for all visible points, block by block, and assembles the model.

    Args:
      checkpoint: keeps each block when it is solved, and gives back those of an interrupted run.
    """
    weights = data.frame_weights(fit.mixed_weight)
    stage = checkpoint.stage("fit", data, fit, ridge)
    basis, moments = _kept_basis(data, weights, fit, stage)
    used, k, p = weights > 0, moments.shape[1], len(data.points.vertices)
    numbers = np.zeros((k + 1, 6 * fit.num_lobes, p), np.float16 if fit.half_precision else np.float32)
    axes = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (p, fit.num_lobes, 1))
    offset = np.zeros((p, ORDER**2), np.float32)
    todo = blocks(data.groups, np.flatnonzero(data.visible))
    bits = data.bits[used]

    def solve(block: Block) -> Arrays:
        rows = pose_rows(data, basis, moments, weights, block.group, ridge)
        return block_arrays(fit_block(rows, block_sh(bits[:, block.padded], data.table), fit))

    for number, solved in stage.parts(todo, solve, track=track, label="fit"):
        points, n = todo[number].points, len(todo[number].points)
        numbers[..., points] = np.swapaxes(solved["weights"], 1, 2)[..., :n]
        axes[points], offset[points] = solved["axes"][:n], solved["offset"][:n]
    return PoseModel(
        features=basis,
        weights=jnp.asarray(numbers),
        axes=jnp.asarray(axes),
        offset=jnp.asarray(offset),
        groups=jnp.asarray(data.groups, jnp.int32),
        points=jnp.asarray(data.points.of_vertex, jnp.int32),
        visible=jnp.asarray(data.visible),
    )


def _kept_basis(
    data: TrainingData, weights: Float[np.ndarray, " f"], fit: FitSettings, stage: Stage
) -> tuple[FeatureBasis, Float[np.ndarray, "g k"]]:
    """`fit_basis` once per run: its last bits may depend on the number of cores, and all blocks need the same ones."""

    def compute() -> Arrays:
        basis, moments = fit_basis(data.basis, data.raw, weights, fit.num_components)
        return {"mean": np.asarray(basis.mean), "basis": np.asarray(basis.basis), "moments": moments}

    found = stage.part("basis", compute)
    axes = dataclasses.replace(data.basis, mean=jnp.asarray(found["mean"]), basis=jnp.asarray(found["basis"]))
    return axes, found["moments"]


def block_arrays(solved: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Arrays:
    """What `fit_block` returns, by name."""
    return dict(zip(("weights", "axes", "offset"), solved, strict=True))


def fit_block(
    rows: PoseRows, sh: Float[np.ndarray, "f p 16"], fit: FitSettings
) -> tuple[Float[np.ndarray, "m p d"], Float[np.ndarray, "p c 3"], Float[np.ndarray, "p 16"]]:
    """Weights, reference axes and offset of one block.

    Several greedy starts are refined for a third of the steps, the best of each point goes on for two rounds, each
    with the metric of where it stands.
    """
    starts = start_axes(sh, num_lobes=fit.num_lobes, count=NUM_STARTS if fit.refine_steps else 1)
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


start_axes = jax.jit(functools.partial(spread_start_axes, order=ORDER), static_argnames=("num_lobes", "count"))
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


def model_components(model: PoseModel, raw: Float[np.ndarray, "f g n"]) -> Float[np.ndarray, "f g k"]:
    """The model's pose components of raw features."""
    mean, basis = np.asarray(model.features.mean), np.asarray(model.features.basis)
    return np.matmul((raw - mean).transpose(1, 0, 2), basis).transpose(1, 0, 2).astype(np.float32)


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
        numbers = np.swapaxes(weights[..., own], 1, 2).astype(np.float32)
        sh = predict_block(components[:, block.group], numbers, axes[own], offset[own])
        result[:, where[block.points]] = np.asarray(sh)[:, : len(block.points)]
    return result


@jax.jit
def predict_block(components, weights, axes, offset):
    return synthesize(apply_linear(components, weights), axes) + offset[None]
