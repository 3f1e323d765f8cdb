"""The run-time model of a character: pose features to zonal lobes of visibility, step 1 of the run time.

One point, one group, one joint at a time. Checking a model file is the partner's; `load_pose_model` trusts it.
"""

import json
import pathlib
from dataclasses import dataclass
from typing import Literal

import safetensors
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.animation.skeleton import (
    Pose,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
)
from torchref.harmonics.zh_fit import axis_from_chart, reference_frames
from torchref.vecmath import normalize, safe_sqrt


@dataclass(frozen=True)
class FeatureBasis:
    """How a pose becomes k components for each of g groups: raw features - mean, on principal axes."""

    kind: Literal["surroundings", "exponential_map", "euler", "given"]
    size: float
    joints: Int[Tensor, " i"]
    bones: Int[Tensor, " g"]
    falloff: Float[Tensor, "g i"]
    reference: Float[Tensor, "i 4"]
    translations: Float[Tensor, "i 3"]
    mean: Float[Tensor, "g n"]
    basis: Float[Tensor, "g n k"]


@dataclass(frozen=True)
class PoseModel:
    """What predicts visibility.

    Of the 6c columns of `weights` the first 2c are chart coordinates, lobe by lobe; row 0 is the bias.
    `groups[p]` is the group of point p, `points[v]` the point of mesh vertex v.
    """

    features: FeatureBasis
    weights: Float[Tensor, "m d p"]
    axes: Float[Tensor, "p c 3"]
    offset: Float[Tensor, "p 16"]
    groups: Int[Tensor, " p"]
    points: Int[Tensor, " v"]
    visible: Bool[Tensor, " p"]


@in_float64
def surroundings(
    globals: Float[Tensor, "*b j 4 4"],
    *,
    bones: Int[Tensor, " g"],
    joints: Int[Tensor, " i"],
    falloff: Float[Tensor, "g i"],
    size: float,
) -> Float[Tensor, "*b g n"]:
    """Where the other joints are, and how turned, in the frame of each bone: 3 + 1 + 9 numbers a joint.

    Frames are the columns of the joint matrices, made unit. With p the place of a joint in the bone's frame,
    r = |p| and a = size/9: a p / (r² + a²), a / (2r + a), and a quarter of the joint's axes times `falloff`.
    """
    a, frames, places = size / 9.0, normalize(globals[..., :3, :3].mT).mT, globals[..., :3, 3]
    rows = []
    for g, bone in enumerate(bones.tolist()):
        row, home = [], frames[..., bone, :, :].mT
        for i, joint in enumerate(joints.tolist()):
            p = torch.einsum("...ij,...j->...i", home, places[..., joint, :] - places[..., bone, :])
            r2 = (p * p).sum(-1, keepdim=True)
            turn = (home @ frames[..., joint, :, :]).flatten(-2)
            row += [a * p / (r2 + a * a), a / (2.0 * safe_sqrt(r2) + a), falloff[g, i] / 4.0 * turn]
        rows.append(torch.cat(row, dim=-1))
    return torch.stack(rows, dim=-2)


@in_float64
def joint_angles(
    pose: Pose,
    *,
    joints: Int[Tensor, " i"],
    reference: Float[Tensor, "i 4"],
    translations: Float[Tensor, "i 3"],
    size: float,
    euler: bool,
) -> Float[Tensor, "*b n"]:
    """Per joint: 3 angles from the reference rotation, 3 shifts in body sizes, 3 logarithms of scale."""
    row = []
    for i, joint in enumerate(joints.tolist()):
        turn = quaternion_multiply(quaternion_conjugate(reference[i]), pose.rotation[..., joint, :])
        angles = _euler_angles(turn) if euler else quaternion_to_rotation_vector(turn)
        shift = (pose.translation[..., joint, :] - translations[i]) / size
        row += [angles, shift, torch.log(pose.scale[..., joint, :])]
    return torch.cat(row, dim=-1)


def _euler_angles(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3"]:
    """x, y, z with R = Rx(x) Ry(y) Rz(z), read off R: its first row and last column hold single products."""
    r = quaternion_to_matrix(q)
    y = torch.asin(r[..., 0, 2].clamp(-1.0, 1.0))
    x, z = torch.atan2(-r[..., 1, 2], r[..., 2, 2]), torch.atan2(-r[..., 0, 1], r[..., 0, 0])
    return torch.stack([x, y, z], dim=-1)


@in_float64
def raw_features(basis: FeatureBasis, pose: Pose, globals: Float[Tensor, "*b j 4 4"]) -> Float[Tensor, "*b g n"]:
    """The features of a pose before projection, for every kind but "given"."""
    if basis.kind == "surroundings":
        return surroundings(globals, bones=basis.bones, joints=basis.joints, falloff=basis.falloff, size=basis.size)
    angles = joint_angles(
        pose,
        joints=basis.joints,
        reference=basis.reference,
        translations=basis.translations,
        size=basis.size,
        euler=basis.kind == "euler",
    )
    return angles[..., None, :]


@in_float64
def project_features(basis: FeatureBasis, raw: Float[Tensor, "*b g n"]) -> Float[Tensor, "*b g k"]:
    """(raw - mean) · basis, group by group."""
    return torch.einsum("...gn,gnk->...gk", raw - basis.mean, basis.basis)


@in_float64
def predict_numbers(model: PoseModel, components: Float[Tensor, "g k"]) -> Float[Tensor, "p d"]:
    """The 6c numbers of each point: bias + components of its group · weights."""
    each = zip(model.weights.unbind(-1), model.groups.tolist(), strict=True)
    rows = [w[0] + components[group] @ w[1:] for w, group in each]
    return torch.stack(rows)


@in_float64
def lobes_from_numbers(
    numbers: Float[Tensor, "*b d"], axes: Float[Tensor, "*#b c 3"]
) -> tuple[Float[Tensor, "*b c 3"], Float[Tensor, "*b c 4"]]:
    """Unit axes, from charts laid around the reference axes, and coefficients."""
    num_lobes = axes.shape[-2]
    chart = numbers[..., : 2 * num_lobes].unflatten(-1, (num_lobes, 2))
    coefficients = numbers[..., 2 * num_lobes :].unflatten(-1, (num_lobes, 4))
    return axis_from_chart(chart, reference_frames(axes)), coefficients


@in_float64
def predict_lobes(
    model: PoseModel, components: Float[Tensor, "g k"]
) -> tuple[Float[Tensor, "p c 3"], Float[Tensor, "p c 4"]]:
    """Step 1: axes and coefficients of the lobes of every point for one pose.

    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.3, step 1.
    """
    return lobes_from_numbers(predict_numbers(model, components), model.axes)


def load_pose_model(path: str | pathlib.Path) -> tuple[PoseModel, dict]:
    """The model in a file that jaxrender wrote, and its header.

    The file is in the safetensors format; its metadata hold one JSON object, "header".
    """
    with safetensors.safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["header"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}
    features = {name.removeprefix("features."): x for name, x in arrays.items() if name.startswith("features.")}
    basis = FeatureBasis(kind=header["feature_kind"], size=header["feature_size"], **features)
    rest = {name: x for name, x in arrays.items() if not name.startswith("features.")}
    return PoseModel(features=basis, **rest), header
