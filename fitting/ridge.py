"""The penalty of the linear solve, chosen on motion left out of the training frames."""

import numpy as np
from jaxtyping import Bool, Int

from fitting.config import FitSettings
from fitting.features import fit_basis
from fitting.motion import TRAIN
from fitting.training_data import TrainingData

RIDGES = tuple(10.0 ** (-0.5 * i) for i in range(8, -1, -1))


def choose_ridge(data: TrainingData, fit: FitSettings, *, max_points: int = 1200) -> float:
    """The penalty whose linear SH model does best on motion left out of the training frames.

    Folds: the last fifth of every training clip, and each of up to four training clips left out whole. The score is
    the logarithm of the first error plus the mean one of the others, so that neither known nor unknown motion decides
    alone.
    """
    weights = data.frame_weights(fit.mixed_weight)
    points = some_points(data, max_points)
    folds = held_out_folds(data)
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
            w = np.where(touched_by(data, left_out), 0.0, weights)
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


def held_out_folds(data: TrainingData) -> list[Bool[np.ndarray, " f"]]:
    train = data.part == TRAIN
    clips = [c for c in np.unique(data.clip[train]) if (train & (data.clip == c)).sum() >= 5]
    tail = np.zeros(len(train), bool)
    for c in clips:
        frames = np.flatnonzero(train & (data.clip == c))
        tail[frames[int(np.ceil(0.8 * len(frames))) :]] = True
    whole = [train & (data.clip == c) for c in clips[:: max(1, len(clips) // 4)][:4]] if len(clips) >= 3 else []
    return ([tail] if tail.any() else []) + whole


def touched_by(data: TrainingData, left_out: Bool[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """The frames left out, and the mixed poses with a limb of one of them, which would give it away."""
    return left_out if data.source is None else left_out[data.source].any(axis=1)


def some_points(data: TrainingData, count: int) -> Int[np.ndarray, " n"]:
    """Visible points, evenly spread over the list."""
    visible = np.flatnonzero(data.visible)
    return visible[np.linspace(0, len(visible) - 1, min(count, len(visible))).astype(int)]
