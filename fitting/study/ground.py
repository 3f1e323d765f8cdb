"""What every method of the study starts from and is measured by."""

import dataclasses
import functools
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fitting.config import FitSettings
from fitting.dataset import ShadingPoints
from fitting.errors import NORM_FLOOR, SH, ByPart, by_part, part_masks, relative, sum_errors
from fitting.features import fit_basis
from fitting.motion import TRAIN
from fitting.solve import ORDER, PoseRows
from fitting.training_data import TrainingData, project
from jaxrender.harmonics.brdf_operator import phong_operator
from jaxrender.harmonics.light import project_environment, sh_area_light
from jaxrender.harmonics.sh import sh_basis, sh_rotate
from jaxrender.harmonics.visibility import hemisphere_directions
from jaxrender.harmonics.zh import hemisphere_zh, zh_to_sh
from jaxrender.latlong import environment_directions


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


def thin(data: TrainingData, points: Int[np.ndarray, " n"]) -> TrainingData:
    """Some points of the data."""
    return dataclasses.replace(
        data,
        points=ShadingPoints(data.points.vertices[points], np.arange(len(points))),
        groups=data.groups[points],
        bits=data.bits[:, points],
        visible=data.visible[points],
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
        errors[name] = {label: relative(error[m].sum(), truth[m].sum()) if m.any() else None for label, m in masks}
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
