"""The run-time model of a character: pose features to zonal lobes of visibility, run-time step 1.

A model has one linear map per shading point, from k pose components (and a constant) to 6c numbers: two chart
coordinates and four zonal coefficients for each of c lobes. Points are grouped, usually by the bone they hang
on most, and every group may see the pose through features of its own. A constant SH vector per point takes
what the lobes leave on average over the training poses. Differentiable from the pose on; Euler angles are not where
they are singular.
"""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from safetensors import SafetensorError, safe_open

from jaxrender.animation.skeleton import (
    Pose,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_rotation_vector,
)
from jaxrender.checks import bad_input, check_finite
from jaxrender.harmonics.zh_fit import axis_from_chart, reference_frames
from jaxrender.vecmath import einsum, safe_div, safe_sqrt

FORMAT, FORMAT_VERSION = "jaxrender-pose-visibility", 2
FeatureKind = Literal["surroundings", "exponential_map", "euler", "given"]
FEATURE_KINDS = ("surroundings", "exponential_map", "euler", "given")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FeatureBasis:
    """How a pose becomes k components per group: raw features, minus their mean, on principal axes.

    `surroundings` has g groups with a bone each and looks from that bone at the `joints`; the other kinds have
    one group. `falloff[g, i]` scales the orientation part of joint i for group g, `size` is the body's extent,
    and `reference` holds the local rotations from which exponential maps and Euler angles are measured.
    """

    kind: FeatureKind = field(metadata={"static": True})
    size: float = field(metadata={"static": True})
    joints: Int[Array, " i"]
    bones: Int[Array, " g"]
    falloff: Float[Array, "g i"]
    reference: Float[Array, "i 4"]
    translations: Float[Array, "i 3"]
    mean: Float[Array, "g n"]
    basis: Float[Array, "g n k"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseModel:
    """Everything needed to predict visibility; a pytree of arrays.

    Attributes:
      weights: (k+1, 6c, p); row 0 is the bias, then one row per component. Of the 6c columns the first 2c are
        chart coordinates, lobe by lobe, then four coefficients per lobe.
      axes: the reference axis of each lobe's chart, in the vertex frame.
      offset: constant SH visibility added to the lobes.
      groups: the group of each point. points: the point of each mesh vertex.
      visible: False for points that see next to nothing in all training poses (inner surfaces).
    """

    features: FeatureBasis
    weights: Float[Array, "m d p"]
    axes: Float[Array, "p c 3"]
    offset: Float[Array, "p 16"]
    groups: Int[Array, " p"]
    points: Int[Array, " v"]
    visible: Bool[Array, " p"]

    @property
    def num_lobes(self) -> int:
        """c, the number of lobes of each point."""
        return self.axes.shape[-2]


def surroundings(
    globals: Float[Array, "*b j 4 4"],
    *,
    bones: Int[Array, " g"],
    joints: Int[Array, " i"],
    falloff: Float[Array, "g i"],
    size: float,
) -> Float[Array, "*b g n"]:
    """The body as each bone sees it: where the joints are and how they are turned, in the bone's own frame.

    For joint i at p with |p| = r in the frame of bone g, and length a = size / 9: the direction weighted like a
    solid angle, a p / (r² + a²); the nearness a / (2r + a); and a quarter of the joint's axes relative to the
    bone, times `falloff`. Joint angles would have to be multiplied out to get there: visibility is much closer
    to linear in these numbers (docs/performance.md). They do not change when the
    whole body moves.

    Args:
      globals: world from joint; only the directions of their axes count, not the scales.
      size: extent of the body, in the units of `globals`.
    Returns:
      n = 13 numbers per joint: 3 + 1 + 9.
    """
    a = size / 9.0
    positions, turns = globals[..., :3, 3], _unit_columns(globals[..., :3, :3])
    at, turned = positions[..., joints, :], turns[..., joints, :, :]
    home, frame = positions[..., bones, :], turns[..., bones, :, :]
    p = einsum("...gji,...gkj->...gki", frame, at[..., None, :, :] - home[..., :, None, :])
    r2 = jnp.sum(p * p, axis=-1, keepdims=True)
    axes = einsum("...gji,...kjl->...gkil", frame, turned)
    fall = falloff.reshape((1,) * (axes.ndim - 4) + (*falloff.shape, 1, 1))
    axes = 0.25 * fall * axes
    parts = [a * p / (r2 + a * a), a / (2.0 * safe_sqrt(r2) + a), axes.reshape(*axes.shape[:-2], 9)]
    together = jnp.concatenate(parts, axis=-1)
    return together.reshape(*together.shape[:-2], -1)


def _unit_columns(matrix: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    lengths = safe_sqrt(jnp.sum(matrix * matrix, axis=-2, keepdims=True))
    return safe_div(matrix, jnp.broadcast_to(lengths, matrix.shape))


def joint_angles(
    pose: Pose,
    *,
    joints: Int[Array, " i"],
    reference: Float[Array, "i 4"],
    translations: Float[Array, "i 3"],
    size: float,
    euler: bool,
) -> Float[Array, "*b n"]:
    """Joint by joint: rotation from the reference as an exponential map (or Euler angles), shift and log scale.

    Args:
      euler: intrinsic x-y-z angles instead, the literal "joint angles" of the paper; singular at y = ±π/2.
    Returns:
      n = 9 numbers per joint: 3 angles in radians, 3 translations relative to `translations` in body sizes, 3 scales.
    """
    turn = pose.rotation[..., joints, :]
    turn = quaternion_multiply(jnp.broadcast_to(quaternion_conjugate(reference), turn.shape), turn)
    angles = _euler_angles(turn) if euler else quaternion_to_rotation_vector(turn)
    shift = pose.translation[..., joints, :]
    shift = (shift - jnp.broadcast_to(translations, shift.shape)) / size
    scale = jnp.log(jnp.maximum(jnp.abs(pose.scale[..., joints, :]), 1e-6))
    together = jnp.concatenate([angles, shift, scale], axis=-1)
    return together.reshape(*together.shape[:-2], -1)


def _euler_angles(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Intrinsic x-y-z angles of unit quaternions (x, y, z, w): R = Rx Ry Rz."""
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    sine = jnp.clip(2.0 * (x * z + w * y), -1.0, 1.0)
    a = jnp.arctan2(2.0 * (w * x - y * z), 1.0 - 2.0 * (x * x + y * y))
    c = jnp.arctan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y * y + z * z))
    return jnp.stack([a, jnp.arcsin(sine), c], axis=-1)


def raw_features(basis: FeatureBasis, pose: Pose, globals: Float[Array, "*b j 4 4"]) -> Float[Array, "*b g n"]:
    """The features of a pose before projection, for every kind but `given`."""
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


def project_features(basis: FeatureBasis, raw: Float[Array, "*b g n"]) -> Float[Array, "*b g k"]:
    """Components of raw features on the principal axes of the training poses."""
    centred = raw - jnp.broadcast_to(basis.mean, raw.shape)
    return einsum("...gn,gnk->...gk", centred, basis.basis)


def predict_numbers(model: PoseModel, components: Float[Array, "g k"]) -> Float[Array, "p d"]:
    """The 6c numbers of each point for one pose: bias + components · weights."""
    own = components.T[:, model.groups]
    rows = jnp.concatenate([jnp.ones_like(own[:1]), own])

    def add(numbers, row):
        # Weights may be stored as float16; the sum is made in the components' precision.
        factor, weights = row
        return numbers + factor[None] * weights.astype(own.dtype), None

    # All points of a row are one run of memory: 1.0 ms for 10k points, 8.1 ms with the points in front.
    start = jnp.zeros(model.weights.shape[1:], own.dtype)
    return jax.lax.scan(add, start, (rows, model.weights))[0].T


def lobes_from_numbers(
    numbers: Float[Array, "*b d"], axes: Float[Array, "*#b c 3"]
) -> tuple[Float[Array, "*b c 3"], Float[Array, "*b c 4"]]:
    """Unit axes and coefficients from the model's 6c numbers, charts laid around the reference axes."""
    c = axes.shape[-2]
    chart = numbers[..., : 2 * c].reshape(*numbers.shape[:-1], c, 2)
    frames = jnp.broadcast_to(reference_frames(axes), (*numbers.shape[:-1], c, 3, 3))
    coefficients = numbers[..., 2 * c :].reshape(*numbers.shape[:-1], c, 4)
    return axis_from_chart(chart, frames), coefficients


def predict_lobes(
    model: PoseModel, components: Float[Array, "g k"]
) -> tuple[Float[Array, "p c 3"], Float[Array, "p c 4"]]:
    """Step 1: lobe axes (unit) and coefficients of every point for one pose. Differentiable in the components.

    References:
      Nowrouzezahrai et al., "Shadowed Relighting of Dynamic Geometry with 1D BRDFs", section 4.3, step 1.
    """
    numbers = predict_numbers(model, components).astype(model.axes.dtype)
    return lobes_from_numbers(numbers, model.axes)


_ARRAYS = ("weights", "axes", "offset", "groups", "points", "visible")
_FEATURE_ARRAYS = ("joints", "bones", "falloff", "reference", "translations", "mean", "basis")

# Number of axes of each array in a file, for those that are not floating point their kind, and numbers a joint.
_RANKS = {
    "weights": 3, "axes": 3, "offset": 2, "groups": 1, "points": 1, "visible": 1, "features.joints": 1,
    "features.bones": 1, "features.falloff": 2, "features.reference": 2, "features.translations": 2,
    "features.mean": 2, "features.basis": 3,
}  # fmt: skip
_INDICES = ("groups", "points", "features.joints", "features.bones")
_PER_JOINT = {"surroundings": 13, "exponential_map": 9, "euler": 9}


def model_arrays(model: PoseModel) -> dict[str, np.ndarray]:
    """The arrays of a model by the names they have in its file."""
    arrays = {name: np.asarray(getattr(model, name)) for name in _ARRAYS}
    features = {f"features.{name}": np.asarray(getattr(model.features, name)) for name in _FEATURE_ARRAYS}
    return arrays | features


def read_model_file(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Arrays and JSON header of a model file, checked for format, version, types, shapes and values.

    Raises:
      InputError: if anything is not as it should be.
    """
    try:
        with safe_open(path, framework="np") as file:
            header = json.loads((file.metadata() or {}).get("header", "null"))
            names = sorted(set(file.keys()) & _RANKS.keys())
            arrays = {name: file.get_tensor(name) for name in names}
    except OSError as error:
        bad_input(path, "file", expected="a readable file", got=error.strerror or str(error))
    except (SafetensorError, ValueError, RecursionError) as error:
        bad_input(path, "file", expected="a safetensors file with a JSON header", got=str(error))
    except (TypeError, AttributeError) as error:  # number types that NumPy does not have
        bad_input(path, "tensors", expected="types that NumPy knows", got=str(error))
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        got = header.get("format") if isinstance(header, dict) else "no header"
        bad_input(path, "format", expected=FORMAT, got=got)
    if header.get("version") != FORMAT_VERSION:
        bad_input(path, "version", expected=FORMAT_VERSION, got=header.get("version"))
    if header.get("feature_kind") not in FEATURE_KINDS:
        expected = f"one of {', '.join(FEATURE_KINDS)}"
        bad_input(path, "feature_kind", expected=expected, got=header.get("feature_kind"))
    size = header.get("feature_size")
    if isinstance(size, bool) or not isinstance(size, int | float) or not 0 < size < 1e30:
        bad_input(path, "feature_size", expected="a positive number", got=size)
    _check_types(path, arrays)
    _check_shapes(path, arrays, header["feature_kind"])
    _check_values(path, arrays)
    return arrays, header


def _check_types(path: Path, arrays: dict[str, np.ndarray]) -> None:
    for name, rank in _RANKS.items():
        if name not in arrays:
            bad_input(path, name, expected="a tensor of this name", got="none")
        allowed = ["int32", "int64"] if name in _INDICES else ["float32", "float16"]
        allowed, array = ["bool"] if name == "visible" else allowed, arrays[name]
        if array.dtype.name not in allowed:
            bad_input(path, name, expected=" or ".join(allowed), got=array.dtype.name)
        if array.ndim != rank:
            bad_input(path, name, expected=f"{rank} axes", got=f"shape {array.shape}")


def _check_shapes(path: Path, arrays: dict[str, np.ndarray], kind: str) -> None:
    m, (p, c, _) = len(arrays["weights"]), arrays["axes"].shape
    (g, n), i = arrays["features.mean"].shape, len(arrays["features.joints"])
    if m < 1 or c < 1:
        bad_input(path, "weights", expected="a bias row and at least one lobe", got=f"{m} rows, {c} lobes")
    if kind != "surroundings" and g != 1:
        bad_input(path, "features.mean", expected=f"one group for {kind}", got=f"{g} groups")
    n = _PER_JOINT[kind] * i if kind in _PER_JOINT else n
    shapes = {
        "weights": (m, 6 * c, p), "axes": (p, c, 3), "offset": (p, 16), "groups": (p,), "visible": (p,),
        "features.bones": (g,), "features.falloff": (g, i), "features.reference": (i, 4),
        "features.translations": (i, 3), "features.mean": (g, n), "features.basis": (g, n, m - 1),
    }  # fmt: skip
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            bad_input(path, name, expected=f"shape {shape}", got=f"shape {arrays[name].shape}")


def _check_values(path: Path, arrays: dict[str, np.ndarray]) -> None:
    limits = {"groups": len(arrays["features.mean"]), "points": len(arrays["axes"])}
    for name, array in arrays.items():
        if name in _INDICES:
            limit = limits.get(name, 2**31)
            if array.size and (array.min() < 0 or array.max() >= limit):
                got = f"{array.min()}..{array.max()}"
                bad_input(path, name, expected=f"indices from 0 to {limit - 1}", got=got)
        elif array.dtype != bool:
            check_finite(path, name, array)


def load_pose_model(path: str | Path) -> tuple[PoseModel, dict]:
    """Reads a model file; returns the model and its header (settings, errors, character hash).

    Raises:
      InputError: if the file is not such a model, or its arrays do not fit together.
    """
    arrays, header = read_model_file(Path(path))
    basis = FeatureBasis(
        kind=header["feature_kind"],
        size=float(header["feature_size"]),
        **{name: jnp.asarray(arrays[f"features.{name}"]) for name in _FEATURE_ARRAYS},
    )
    return PoseModel(features=basis, **{name: jnp.asarray(arrays[name]) for name in _ARRAYS}), header


def model_hash(model: PoseModel) -> str:
    """SHA-256 over the arrays, for reports and tests of reproducibility."""
    digest = hashlib.sha256()
    for name, array in sorted(model_arrays(model).items()):
        digest.update(name.encode() + array.tobytes())
    return digest.hexdigest()
