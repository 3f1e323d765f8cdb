"""Errors of a trained model and, as a study, of the methods it competes with, on the same data.

Relative L2 of a set of frames: √(Σ|predicted - baked|² / Σ|baked|²) over its frames and points, `global`; or the
mean over frames and points of |predicted - baked| / max(|baked|, floor), `mean_relative`. Baked means the SH
projection of the traced bits. Sets: `train`, `segments` (the held-out end of each training clip) and `clips`
(clips held out whole); a set without frames is None. Mixed poses are never measured on.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.motion import CLIP, SEGMENT, TRAIN
from fitting.solve import ORDER

PARTS = {"train": TRAIN, "segments": SEGMENT, "clips": CLIP}
# |v| of an unoccluded point is 2.4 at order 4; below this a point and frame counts as if it had this norm.
NORM_FLOOR = 0.2
_BAND_STARTS = np.arange(ORDER) ** 2

ByPart = dict[str, float | None]
SH = Float[np.ndarray, "f n 16"]


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
        return relative(self.error[frames].sum(), self.truth[frames].sum()) if frames.any() else None

    def mean_relative(self, frames: Bool[np.ndarray, " f"]) -> float | None:
        return float(self.relative[frames].mean() / self.num_points) if frames.any() else None

    def by_band(self, frames: Bool[np.ndarray, " f"]) -> list[float] | None:
        """Band by band: error of the band over the baked norm of the same band."""
        if not frames.any():
            return None
        return [relative(e, t) for e, t in zip(self.error[frames].sum(0), self.truth[frames].sum(0), strict=True)]

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


def relative(error: float, truth: float) -> float:
    return float(math.sqrt(error / max(truth, 1e-12)))


def part_masks(part: Int[np.ndarray, " f"]) -> dict[str, Bool[np.ndarray, " f"]]:
    return {name: part == number for name, number in PARTS.items()}


def by_part(sums: ErrorSums, part: Int[np.ndarray, " f"]) -> ByPart:
    """Global relative L2 of each set of frames."""
    return {name: sums.global_error(mask) for name, mask in part_masks(part).items()}
