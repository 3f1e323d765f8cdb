"""Methods without lobes: constant predictions, linear models of other targets, and a Gaussian kernel."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from fitting.errors import SH
from fitting.ridge import held_out_folds, touched_by
from fitting.study.ground import Ground, MethodRow, method_row, unoccluded_sh
from fitting.training_data import TrainingData

KERNEL_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)


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
        folds = held_out_folds(self.data)
        if not folds:
            return KERNEL_RIDGES[1]
        groups = np.unique(self.data.groups)
        scores = np.zeros((len(folds), len(KERNEL_RIDGES)))
        for g in groups[:: max(1, len(groups) // 4)][:4]:
            own = targets[:, self.data.groups == g].reshape(len(targets), -1).astype(np.float64)
            for i, left_out in enumerate(folds):
                used = (self.weights > 0) & ~touched_by(self.data, left_out)
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
