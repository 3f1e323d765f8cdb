"""Joints and clips: what moves a character, and how to get from a time to joint matrices.

Pointwise: quaternion and matrix kernels take any leading axes. Quaternions are (x, y, z, w), the order of
glTF; matrices act on column vectors. Lengths are metres, times seconds, angles radians. Clips and
skeletons are data of the program (NumPy, static under `jit`); poses are pytrees of arrays.
"""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.vecmath import normalize

Path = Literal["translation", "rotation", "scale"]
Interpolation = Literal["STEP", "LINEAR", "CUBICSPLINE"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pose:
    """Local transform of every joint, M = T R S, relative to its parent."""

    translation: Float[Array, "*b j 3"]
    rotation: Float[Array, "*b j 4"]
    scale: Float[Array, "*b j 3"]


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A forest of joints: every node that carries or moves a part of the character.

    A parent stands before its children; the parent of a root is -1. `rest` is the pose of joints that no
    clip moves.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Pose


@dataclass(frozen=True, eq=False)
class Channel:
    """Keys of one property of one joint.

    `times` increase strictly. `values` is (k, c), with c = 4 for a rotation and 3 otherwise; for CUBICSPLINE
    it is (k, 3, c): in-tangent, value, out-tangent of each key, tangents per second.
    """

    joint: int
    path: Path
    interpolation: Interpolation
    times: Float[np.ndarray, " k"]
    values: Float[np.ndarray, "k *c"]


@dataclass(frozen=True, eq=False)
class Clip:
    """One motion: from `start` on, `duration` seconds long (0 for a clip with one key)."""

    name: str
    channels: tuple[Channel, ...]
    start: float
    duration: float


def quaternion_multiply(a: Float[Array, "*#b 4"], b: Float[Array, "*#b 4"]) -> Float[Array, "*b 4"]:
    """Hamilton product a b: the rotation b, then a."""
    ax, ay, az, aw = (a[..., i] for i in range(4))
    bx, by, bz, bw = (b[..., i] for i in range(4))
    return jnp.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """The inverse rotation of a unit quaternion."""
    return jnp.concatenate([-q[..., :3], q[..., 3:]], axis=-1)


def quaternion_to_matrix(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a unit quaternion."""
    x, y, z, w = (q[..., i] for i in range(4))
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_vector_to_quaternion(rotation_vector: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Exponential map: the unit quaternion of the rotation by |r| radians about r / |r|.

    Smooth everywhere, r = 0 included: near it the series in |r|² take over.

    References:
      Grassia, "Practical Parameterization of Rotations Using the Exponential Map", JGT 3(3), 1998, eq. 3.
    """
    square = jnp.sum(rotation_vector * rotation_vector, axis=-1, keepdims=True)
    small = square < _root_eps(square)
    angle = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    factor = jnp.where(small, 0.5 - square / 48.0 + square * square / 3840.0, jnp.sin(0.5 * angle) / angle)
    w = jnp.where(small, 1.0 - square / 8.0 + square * square / 384.0, jnp.cos(0.5 * angle))
    return jnp.concatenate([factor * rotation_vector, w], axis=-1)


def quaternion_to_rotation_vector(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Logarithm: the rotation vector of a unit quaternion, of length at most π.

    Of q and -q, which are one rotation, the shorter way is taken, so the result jumps to its opposite
    where the angle passes π; it is smooth elsewhere, the identity included.
    """
    q = jnp.where(q[..., 3:] < 0, -q, q)
    v, w = q[..., :3], q[..., 3:]
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    small = square < _root_eps(square)
    sine = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    # 2 asin(s) / s for a unit quaternion; atan2 keeps the accuracy that asin loses towards π.
    series = 2.0 + square / 3.0 + 0.15 * square * square
    return jnp.where(small, series, 2.0 * jnp.arctan2(sine, w) / sine) * v


def slerp(a: Float[Array, "*#b 4"], b: Float[Array, "*#b 4"], t: Float[Array, "*#b 1"]) -> Float[Array, "*b 4"]:
    """Spherical interpolation from the unit quaternion a (t = 0) to b (t = 1), the short way round.

    Where a and b are nearly one rotation it is the normalised linear interpolation; the switch lies where
    the two differ by less than the rounding error. Differentiable except where a and b are half a turn
    apart, where the way round switches.

    References:
      glTF 2.0, appendix C.4; the angle between the quaternions is taken from their difference and sum
      (Kahan), as acos loses half the digits for close keys.
    """
    b = jnp.where(jnp.sum(a * b, axis=-1, keepdims=True) < 0, -b, b)
    difference = jnp.sum((b - a) ** 2, axis=-1, keepdims=True)
    small = difference < float(jnp.finfo(a.dtype).eps)
    safe = jnp.where(small, jnp.ones_like(difference), difference)
    total = jnp.sum((b + a) ** 2, axis=-1, keepdims=True)
    angle = 2.0 * jnp.arctan2(jnp.sqrt(safe), jnp.sqrt(total))
    from_a = jnp.where(small, 1.0 - t, jnp.sin(angle * (1.0 - t)) / jnp.sin(angle))
    from_b = jnp.where(small, t, jnp.sin(angle * t) / jnp.sin(angle))
    return normalize(from_a * a + from_b * b)


def cubic_spline(
    start: Float[Array, "*#b c"],
    out_tangent: Float[Array, "*#b c"],
    end: Float[Array, "*#b c"],
    in_tangent: Float[Array, "*#b c"],
    t: Float[Array, "*#b 1"],
    *,
    span: Float[Array, "*#b 1"],
) -> Float[Array, "*b c"]:
    """Cubic Hermite segment at t in [0, 1], with tangents per second and a segment of `span` seconds.

    References:
      glTF 2.0, appendix C.5.
    """
    t2, t3 = t * t, t * t * t
    return (
        (2.0 * t3 - 3.0 * t2 + 1.0) * start
        + span * (t3 - 2.0 * t2 + t) * out_tangent
        + (3.0 * t2 - 2.0 * t3) * end
        + span * (t3 - t2) * in_tangent
    )


def sample_keys(
    key_times: Float[Array, " k"],
    values: Float[Array, "k *c"],
    times: Float[Array, " f"],
    *,
    interpolation: Interpolation,
    rotation: bool,
) -> Float[Array, "f n"]:
    """One sampler at `times`: before the first and after the last key it keeps that key's value.

    Differentiable in the values, and in the times between keys.

    Args:
      key_times: seconds, strictly increasing.
      values: as in `Channel`.
      rotation: whether the values are unit quaternions: linear then means `slerp`, and a spline is
        normalised.
    References:
      glTF 2.0, section 3.11 and appendix C.
    """
    last = key_times.shape[0] - 1
    knots = values[:, 1] if interpolation == "CUBICSPLINE" else values
    before = jnp.clip(jnp.searchsorted(key_times, times, side="right") - 1, 0, last)
    if last == 0 or interpolation == "STEP":
        return knots[before]
    before = jnp.minimum(before, last - 1)
    after = before + 1
    span = (key_times[after] - key_times[before])[:, None]
    t = jnp.clip((times - key_times[before])[:, None] / span, 0.0, 1.0)
    if interpolation == "CUBICSPLINE":
        curve = cubic_spline(knots[before], values[before, 2], knots[after], values[after, 0], t, span=span)
        curve = normalize(curve) if rotation else curve
    elif rotation:
        curve = slerp(knots[before], knots[after], t)
    else:
        curve = (1.0 - t) * knots[before] + t * knots[after]
    # The last key as it is stored: slerp may arrive at its opposite, which is the same rotation.
    return jnp.where((times >= key_times[last])[:, None], knots[last:], curve)


@functools.partial(jax.jit, static_argnames=("interpolation", "rotation"))
def _sample_batch(key_times, values, times, *, interpolation: Interpolation, rotation: bool):
    def sample(key_times, values):
        return sample_keys(key_times, values, times, interpolation=interpolation, rotation=rotation)

    return jax.vmap(sample, out_axes=1)(key_times, values)


def sample_clip(clip: Clip, skeleton: Skeleton, times: Float[Array, " f"]) -> Pose:
    """The pose of every joint at each time (seconds, in the clip's own time), in the dtype of `times`.

    Joints and properties without a channel keep their rest value.
    """
    times = jnp.asarray(times)
    num_frames, num_joints, dtype = times.shape[0], len(skeleton.parents), times.dtype
    pose = {
        path: jnp.broadcast_to(jnp.asarray(getattr(skeleton.rest, path), dtype=dtype), (num_frames, num_joints, size))
        for path, size in (("translation", 3), ("rotation", 4), ("scale", 3))
    }
    # Frames are padded to whole steps of 64 and channels and keys in `_batches`, so that the clips of a character share
    # a few compiled samplers; eagerly, op by op, a first call took seconds per clip.
    padded_times = jnp.concatenate([times, jnp.repeat(times[-1:], -num_frames % 64)])
    for joints, path, interpolation, key_times, values in _batches(clip.channels):
        keys = jnp.asarray(key_times, dtype=dtype), jnp.asarray(values, dtype=dtype)
        sampled = _sample_batch(*keys, padded_times, interpolation=interpolation, rotation=path == "rotation")
        pose[path] = pose[path].at[:, joints].set(sampled[:num_frames])
    return Pose(**pose)


def local_matrices(pose: Pose) -> Float[Array, "*b j 4 4"]:
    """M = T R S of every joint, parent from joint."""
    linear = quaternion_to_matrix(pose.rotation) * pose.scale[..., None, :]
    top = jnp.concatenate([linear, pose.translation[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1], dtype=top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def global_matrices(pose: Pose, *, parents: Sequence[int]) -> Float[Array, "*b j 4 4"]:
    """World from joint for every joint: the product of local matrices from its root down.

    Args:
      parents: as in `Skeleton`.
    Raises:
      ValueError: if a parent does not stand before its child.
    """
    levels = _levels(parents)
    local = local_matrices(pose)
    current = local[..., np.asarray(levels[0], dtype=np.int32), :, :]
    done = [current]
    for above, level in pairwise(levels):
        row = {joint: i for i, joint in enumerate(above)}
        parent_rows = np.asarray([row[parents[joint]] for joint in level], dtype=np.int32)
        # Full precision: a matrix unit that rounds to 10 bits would shake the fingers by millimetres.
        current = jnp.matmul(
            current[..., parent_rows, :, :],
            local[..., np.asarray(level, dtype=np.int32), :, :],
            precision=jax.lax.Precision.HIGHEST,
        )
        done.append(current)
    joint_order = np.argsort(np.concatenate([np.asarray(level) for level in levels]))
    return jnp.concatenate(done, axis=-3)[..., joint_order, :, :]


def _levels(parents: Sequence[int]) -> list[list[int]]:
    """Joints by depth, so that each level of the tree is one batched product."""
    depth: list[int] = []
    for joint, parent in enumerate(parents):
        if not -1 <= parent < joint:
            raise ValueError(f"parents: expected -1 or a joint before {joint}, got {parent} at {joint}")
        depth.append(0 if parent < 0 else depth[parent] + 1)
    levels: list[list[int]] = [[] for _ in range(max(depth, default=0) + 1)]
    for joint, level in enumerate(depth):
        levels[level].append(joint)
    return levels


def _batches(
    channels: Sequence[Channel],
) -> Iterator[tuple[np.ndarray, Path, Interpolation, np.ndarray, np.ndarray]]:
    """Joints, key times and values of the channels that one batched call can sample, stacked."""

    def kind(channel: Channel) -> tuple[Path, Interpolation]:
        return channel.path, channel.interpolation

    for (path, interpolation), group in groupby(sorted(channels, key=kind), key=kind):
        members = list(group)
        num_keys = max(len(channel.times) for channel in members)
        num_keys = 1 if num_keys == 1 else max(64, 1 << (num_keys - 1).bit_length())
        members += members[-1:] * (-len(members) % 16)
        padded = [_padded(channel, num_keys) for channel in members]
        joints = np.asarray([channel.joint for channel in members], dtype=np.int32)
        yield joints, path, interpolation, np.stack([t for t, _ in padded]), np.stack([v for _, v in padded])


def _padded(channel: Channel, num_keys: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and values with the last key repeated later and later, which leaves the curve as it is."""
    missing = num_keys - len(channel.times)
    if not missing:
        return channel.times, channel.values
    last = channel.times[-1]
    later = last + (1.0 + 1e-6 * np.abs(last)) * np.arange(1, missing + 1)
    times = np.append(channel.times, later.astype(channel.times.dtype))
    values = np.concatenate([channel.values, np.repeat(channel.values[-1:], missing, axis=0)])
    if channel.interpolation == "CUBICSPLINE":
        values[-missing - 1, 2] = 0.0
        values[-missing:, (0, 2)] = 0.0
    return times, values


def _root_eps(x: Array) -> float:
    """Below this square of an angle, series to the fourth power are exact to rounding."""
    return float(jnp.finfo(x.dtype).eps) ** 0.5
