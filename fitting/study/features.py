"""What each step towards unseen motion brings: features, mixed poses, penalties, a kernel."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from fitting.config import FitSettings
from fitting.errors import SH, by_part, sum_errors
from fitting.ridge import RIDGES, choose_ridge
from fitting.study.ground import Ground, MethodRow, linear_pose, method_row
from fitting.training_data import TrainingData
from jaxrender.harmonics.pose_model import FeatureBasis


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


def angle_rows(ground: Ground, angles: Angles | None) -> list[MethodRow]:
    if angles is None:
        return []
    data = with_angles(ground.data, angles)
    ridge = choose_ridge(data, ground.fit, max_points=200)
    predicted = linear_pose(data, ground.fit, ridge).predict(ground.sh)
    return [method_row(ground, "linear, 16 SH, joint angles", 16, predicted, note=f"ridge {ridge:.3g}")]
