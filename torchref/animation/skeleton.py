"""Joints and clips: from a time to the matrix of every joint.

Pointwise: quaternion and matrix kernels take any leading axes. Quaternions are (x, y, z, w); matrices act on
column vectors; metres, seconds, radians. Clips and skeletons are NumPy data, poses are tensors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.vecmath import normalize

Path = Literal["translation", "rotation", "scale"]
Interpolation = Literal["STEP", "LINEAR", "CUBICSPLINE"]


@dataclass(frozen=True)
class Pose:
    """Local transform of every joint, M = T R S, relative to its parent."""

    translation: Float[Tensor, "*b j 3"]
    rotation: Float[Tensor, "*b j 4"]
    scale: Float[Tensor, "*b j 3"]


@dataclass(frozen=True)
class Skeleton:
    """A forest of joints; a parent stands before its children, -1 marks a root."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Pose


@dataclass(frozen=True)
class Channel:
    """Keys of one property of one joint: values (k, c), or (k, 3, c) for in-tangent, value, out-tangent."""

    joint: int
    path: Path
    interpolation: Interpolation
    times: Float[np.ndarray, " k"]
    values: Float[np.ndarray, "k *c"]


@dataclass(frozen=True)
class Clip:
    """One motion, `duration` seconds from `start` on."""

    name: str
    channels: tuple[Channel, ...]
    start: float
    duration: float


@in_float64
def quaternion_multiply(a: Float[Tensor, "*#b 4"], b: Float[Tensor, "*#b 4"]) -> Float[Tensor, "*b 4"]:
    """Hamilton product: (u, s)(v, t) = (s v + t u + u × v, s t - u·v)."""
    a, b = torch.broadcast_tensors(a, b)
    u, s, v, t = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = s * v + t * u + torch.linalg.cross(u, v)
    return torch.cat([vector, s * t - (u * v).sum(-1, keepdim=True)], dim=-1)


@in_float64
def quaternion_conjugate(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """(-u, s): the inverse rotation of a unit quaternion."""
    return torch.cat([-q[..., :3], q[..., 3:]], dim=-1)


@in_float64
def quaternion_to_matrix(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """The matrix whose columns are q e q* for the unit vectors e of the axes."""
    axes = torch.cat([torch.eye(3), torch.zeros(3, 1)], dim=-1).to(q)
    turned = quaternion_multiply(quaternion_multiply(q[..., None, :], axes), quaternion_conjugate(q)[..., None, :])
    return turned[..., :3].transpose(-1, -2)


@in_float64
def rotation_vector_to_quaternion(rotation_vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """(r sin(a/2)/a, cos(a/2)) with a = |r|, from the power series in a² (|r| up to a few turns).

    References:
      Grassia, "Practical Parameterization of Rotations Using the Exponential Map", JGT 3(3), 1998, eq. 3.
    """
    h2 = (rotation_vector**2).sum(-1, keepdim=True) / 4.0
    sinc, cos, term = torch.zeros_like(h2), torch.zeros_like(h2), torch.ones_like(h2)
    for n in range(40):  # term = (-1)^n h^2n / (2n)!
        cos = cos + term
        sinc = sinc + term / (2 * n + 1)
        term = -term * h2 / ((2 * n + 1) * (2 * n + 2))
    return torch.cat([rotation_vector / 2.0 * sinc, cos], dim=-1)


@in_float64
def quaternion_to_rotation_vector(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3"]:
    """2 atan2(|u|, s) u / |u| of (u, s), where the sign of q is taken so that s >= 0; length at most π."""
    q = torch.where(q[..., 3:] < 0, -q, q)
    u, s = q[..., :3], q[..., 3:]
    squared = (u * u).sum(-1, keepdim=True)
    small = squared < 1e-12 * s * s  # there atan x = x - x³/3 is exact in float64
    sine = torch.sqrt(torch.where(small, 1.0, squared))
    cosine = torch.where(small, s, 1.0)
    near = (1.0 - squared / (3.0 * cosine**2)) / cosine
    return 2.0 * torch.where(small, near, torch.atan2(sine, s) / sine) * u


@in_float64
def slerp(a: Float[Tensor, "*#b 4"], b: Float[Tensor, "*#b 4"], t: Float[Tensor, "*#b 1"]) -> Float[Tensor, "*b 4"]:
    """a (a* b)^t with the sign of b that makes the way short: the rotation vector of a* b, times t.

    References:
      glTF 2.0, appendix C.4, which writes the same as sin(ω(1-t))/sin ω a + sin(ωt)/sin ω b.
    """
    b = torch.where((a * b).sum(-1, keepdim=True) < 0, -b, b)
    turn = quaternion_to_rotation_vector(quaternion_multiply(quaternion_conjugate(a), b))
    return quaternion_multiply(a, rotation_vector_to_quaternion(t * turn))


@in_float64
def cubic_spline(
    start: Float[Tensor, "*#b c"],
    out_tangent: Float[Tensor, "*#b c"],
    end: Float[Tensor, "*#b c"],
    in_tangent: Float[Tensor, "*#b c"],
    t: Float[Tensor, "*#b 1"],
    *,
    span: Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*b c"]:
    """Cubic Hermite segment at t in [0, 1], as the Bézier curve whose handles are a third of the tangents.

    References:
      glTF 2.0, appendix C.5.
    """
    first, second = start + span * out_tangent / 3.0, end - span * in_tangent / 3.0
    u = 1.0 - t
    return u**3 * start + 3.0 * u * u * t * first + 3.0 * u * t * t * second + t**3 * end


@in_float64
def sample_keys(
    key_times: Float[Tensor, " k"],
    values: Float[Tensor, "k *c"],
    times: Float[Tensor, " f"],
    *,
    interpolation: Interpolation,
    rotation: bool,
) -> Float[Tensor, "f n"]:
    """One sampler at `times`, one time after the other; outside the keys the end values hold.

    References:
      glTF 2.0, section 3.11 and appendix C.
    """
    return torch.stack([_sample_key(key_times, values, time, interpolation, rotation) for time in times])


def _sample_key(key_times: Tensor, values: Tensor, time: Tensor, interpolation: str, rotation: bool) -> Tensor:
    points = values[:, 1] if interpolation == "CUBICSPLINE" else values
    if time <= key_times[0]:
        return points[0]
    if time >= key_times[-1]:
        return points[-1]
    k = int((key_times <= time).sum()) - 1
    span = key_times[k + 1] - key_times[k]
    t = ((time - key_times[k]) / span)[None]
    if interpolation == "STEP":
        return points[k]
    if interpolation == "CUBICSPLINE":
        value = cubic_spline(points[k], values[k, 2], points[k + 1], values[k + 1, 0], t, span=span[None])
        return normalize(value) if rotation else value
    return slerp(points[k], points[k + 1], t) if rotation else (1.0 - t) * points[k] + t * points[k + 1]


def sample_clip(clip: Clip, skeleton: Skeleton, times: Float[Tensor, " f"]) -> Pose:
    """The pose of every joint at each time, in the dtype of `times`; what no channel moves stays at rest."""
    tracks = {
        path: getattr(skeleton.rest, path).to(times).expand(len(times), -1, -1).clone()
        for path in ("translation", "rotation", "scale")
    }
    for channel in clip.channels:
        tracks[channel.path][:, channel.joint] = sample_keys(
            torch.as_tensor(channel.times).to(times),
            torch.as_tensor(channel.values).to(times),
            times,
            interpolation=channel.interpolation,
            rotation=channel.path == "rotation",
        )
    return Pose(**tracks)


@in_float64
def local_matrices(pose: Pose) -> Float[Tensor, "*b j 4 4"]:
    """M = T R S of every joint as the product of three 4 x 4 matrices."""
    lead = torch.broadcast_shapes(pose.translation.shape[:-1], pose.rotation.shape[:-1], pose.scale.shape[:-1])
    translate, rotate, scale = (
        torch.eye(4, dtype=pose.rotation.dtype, device=pose.rotation.device).repeat(*lead, 1, 1) for _ in range(3)
    )
    translate[..., :3, 3] = pose.translation
    rotate[..., :3, :3] = quaternion_to_matrix(pose.rotation)
    scale[..., :3, :3] = torch.diag_embed(pose.scale)
    return translate @ rotate @ scale


@in_float64
def global_matrices(pose: Pose, *, parents: Sequence[int]) -> Float[Tensor, "*b j 4 4"]:
    """World from joint: from each joint up to its root, multiplying on the left."""
    local = local_matrices(pose)
    chains = []
    for joint, parent in enumerate(parents):
        if not -1 <= parent < joint:
            raise ValueError(f"parents: expected parent {joint} in -1..{joint - 1}, got {parent}")
        matrix = local[..., joint, :, :]
        while parent >= 0:
            matrix = local[..., parent, :, :] @ matrix
            parent = parents[parent]
        chains.append(matrix)
    return torch.stack(chains, dim=-3)
