"""The built-in human: a skeleton of 25 joints, 1.75 m tall, and three procedural motions.

Every joint's frame at rest is the world's: x to the left of the body, y up, z ahead. All is computed from the
numbers in this file, so it is the same on every machine up to rounding. NumPy; metres, seconds.
"""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from jaxrender.animation.skeleton import Channel, Clip, Pose, Skeleton

FRAMES_PER_SECOND = 30

# Joint, parent, place in the world at rest. Those on the left have a mirror image on the right.
_JOINTS = (
    ("Hips", "", (0.0, 0.985, 0.0)),
    ("Spine", "Hips", (0.0, 1.08, -0.005)),
    ("Chest", "Spine", (0.0, 1.23, -0.012)),
    ("Neck", "Chest", (0.0, 1.475, -0.025)),
    ("Head", "Neck", (0.0, 1.565, -0.008)),
    ("LeftShoulder", "Chest", (0.035, 1.425, -0.005)),
    ("LeftArm", "LeftShoulder", (0.180, 1.425, -0.015)),
    ("LeftForeArm", "LeftArm", (0.378, 1.227, -0.020)),
    ("LeftHand", "LeftForeArm", (0.552, 1.053, 0.004)),
    ("LeftFingers", "LeftHand", (0.611, 0.994, 0.014)),
    ("LeftThumb", "LeftHand", (0.575, 1.035, 0.038)),
    ("LeftUpLeg", "Hips", (0.092, 0.925, 0.005)),
    ("LeftLeg", "LeftUpLeg", (0.116, 0.505, 0.012)),
    ("LeftFoot", "LeftLeg", (0.135, 0.085, -0.018)),
    ("LeftToeBase", "LeftFoot", (0.152, 0.026, 0.110)),
)


def builtin_skeleton() -> Skeleton:
    """25 joints with the usual names, in an A-pose."""
    joints = list(_JOINTS)
    for name, parent, (x, y, z) in _JOINTS:
        if name.startswith("Left"):
            joints.append((_mirrored(name), _mirrored(parent), (-x, y, z)))
    names = tuple(name for name, _, _ in joints)
    parents = tuple(names.index(parent) if parent else -1 for _, parent, _ in joints)
    places = np.asarray([place for _, _, place in joints])
    offsets = places - np.where(np.asarray(parents)[:, None] >= 0, places[np.asarray(parents)], 0.0)
    return Skeleton(
        names,
        parents,
        Pose(
            translation=jnp.asarray(offsets, dtype=jnp.float32),
            rotation=jnp.tile(jnp.asarray([0, 0, 0, 1], dtype=jnp.float32), (len(names), 1)),
            scale=jnp.ones((len(names), 3), dtype=jnp.float32),
        ),
    )


def _mirrored(name: str) -> str:
    return name.replace("Left", "Right")


def builtin_clips() -> tuple[Clip, Clip, Clip]:
    """ "walk", "turn" and "reach", each a closed loop of two to four seconds, keyed 30 times a second.

    The walk stays on the spot: the planted foot slides back at walking speed, as on a treadmill. In the other
    two both feet stand still.
    """
    return _walk(), _turn(), _reach()


# Walking.

_CYCLE = 1.1  # seconds for two steps
_SPEED = 1.0  # metres per second
_STANCE = 0.62  # share of the cycle a foot is on the ground
_STRIKE = 0.25  # how far ahead of the hips the ankle is when the heel strikes

# The foot turns about the heel until it is flat, and about the ball when the heel rises. Share of the cycle
# since the heel struck; degrees, positive with the toes down. After Perry, "Gait Analysis", 1992, chapter 3.
_FOOT_PITCH = np.array(
    [[0, -18], [0.1, 0], [0.36, 0], [0.48, 14], [0.62, 46], [0.7, 44], [0.82, 8], [0.92, -16], [1, -18]]
)
_HEEL, _BALL = -0.045, 0.125  # ahead of the ankle, on the ground


def _walk() -> Clip:
    num_cycles = 2
    times = np.arange(round(num_cycles * _CYCLE * FRAMES_PER_SECOND) + 1) / FRAMES_PER_SECOND
    phase = times / _CYCLE
    once, twice = 2 * np.pi * phase, 4 * np.pi * phase
    hips = np.stack([0.02 * np.cos(once - 0.6 * np.pi), -0.024 - 0.017 * np.cos(twice - 0.6), 0 * times], axis=-1)
    # At phase 0 the left heel strikes: left hip and right shoulder are ahead.
    turns = {
        "Hips": _degrees(3.0, -6.0 * np.cos(once), 3.0 * np.sin(once)),
        "Spine": _degrees(1.0, 5.0 * np.cos(once), -2.5 * np.sin(once)),
        "Chest": _degrees(-1.0, 8.0 * np.cos(once), -2.0 * np.sin(once)),
        "Neck": _degrees(0.0, -3.0 * np.cos(once), 0.8 * np.sin(once)),
        "Head": _degrees(-2.0 + 0.8 * np.cos(twice), -3.5 * np.cos(once), 0.5 * np.sin(once)),
    }
    for side, swing in (("Left", np.cos(once)), ("Right", -np.cos(once))):
        turns[f"{side}Arm"] = _degrees(24.0 * swing + 2.0, 0.0, 0.0) * _lowered(side, 36.0)
        turns[f"{side}ForeArm"] = _elbow(side, 17.0 - 11.0 * swing)
        turns[f"{side}Hand"] = _elbow(side, 5.0 - 4.0 * swing)
    ankles, feet = {}, {}
    for side, shift in (("Left", 0.0), ("Right", 0.5)):
        ankles[side], feet[side], turns[f"{side}ToeBase"] = _step((phase + shift) % 1.0, side)
    return _clip("walk", times, hips, turns, ankles, feet)


def _foot_pitch(phase: np.ndarray) -> np.ndarray:
    """Radians at each phase."""
    return np.radians(_closed_curve(_FOOT_PITCH[:, 0], _FOOT_PITCH[:, 1], phase))


def _planted(phase: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The ankle of a foot on the ground: it turns about heel or ball, which slides back with the ground."""
    pitch = _foot_pitch(phase)
    pivot = np.where(pitch < 0, _HEEL, _BALL)
    y = rest[1] * np.cos(pitch) + pivot * np.sin(pitch)
    z = pivot - pivot * np.cos(pitch) + rest[1] * np.sin(pitch)
    return np.stack([np.full_like(phase, rest[0]), y, _STRIKE - _SPEED * _CYCLE * phase + z], axis=-1)


def _step(phase: np.ndarray, side: str) -> tuple[np.ndarray, Rotation, Rotation]:
    """Ankle, turn of the foot and of the toes at each phase since the heel struck."""
    rest = _place(f"{side}Foot")
    # Off the ground a smooth curve leads from the lift of the toes through two places to the next strike.
    stance = np.linspace(0.0, _STANCE, 32)
    air = np.array([[rest[0], 0.215, -0.16], [rest[0], 0.135, 0.20]])
    knots = np.concatenate([stance, [0.74, 0.87, 1.0]])
    places = np.concatenate([_planted(stance, rest), air, _planted(np.zeros(1), rest)])
    swing = CubicSpline(knots, places, bc_type="periodic")(phase)
    on_ground = phase < _STANCE
    ankle = np.where(on_ground[:, None], _planted(phase, rest), swing)
    pitch = np.degrees(_foot_pitch(phase))
    # The toes stay on the ground while the heel rises, and straighten soon after.
    bent = np.where(on_ground, np.maximum(pitch, 0.0), 46.0 * np.exp(-(phase - _STANCE) / 0.06))
    return ankle, _degrees(pitch, 0.0, 0.0), _degrees(-0.85 * bent, 0.0, 0.0)


# Standing.


def _turn() -> Clip:
    """Looks over the left and the right shoulder, the arms following."""
    times = np.arange(round(3.2 * FRAMES_PER_SECOND) + 1) / FRAMES_PER_SECOND
    keys = np.array([0.0, 0.8, 1.6, 2.4, 3.2])
    yaw = np.array([0.0, 1.0, 0.0, -1.0, 0.0])

    def turned(degrees: float, pitch: Sequence[int] = (0, 0, 0, 0, 0), roll: float = 0.0) -> Rotation:
        return _keyed(times, keys, _degrees(np.asarray(pitch, float), degrees * yaw, roll * yaw))

    turns = {
        "Hips": turned(12.0),
        "Spine": turned(14.0, roll=-2.0),
        "Chest": turned(18.0, (0, -2, 2, -2, 0)),
        "Neck": turned(20.0),
        "Head": turned(32.0, (0, 8, 0, -10, 0), roll=4.0),
    }
    # Of the arm on the side looked to, and of the other: outward, ahead, bend of the elbow, in degrees.
    neutral, near, far = (12, 0, 20), (55, 5, 35), (12, 50, 80)
    for side, order in (("Left", (near, far)), ("Right", (far, near))):
        outward, ahead, bend = np.array([neutral, order[0], neutral, order[1], neutral], dtype=np.float64).T
        turns[f"{side}Arm"] = _keyed(times, keys, _aimed(side, outward, ahead))
        turns[f"{side}ForeArm"] = _keyed(times, keys, _elbow(side, bend))
    hips = np.array([[0, -0.012, 0], [0.03, -0.02, 0], [0, -0.012, 0], [-0.03, -0.02, 0], [0, -0.012, 0]])
    return _clip("turn", times, _closed_curve(keys, hips, times), turns, *_standing(len(times)))


def _reach() -> Clip:
    """Both arms ahead, up, across the body, then a crouch with the arms ahead."""
    times = np.arange(4 * FRAMES_PER_SECOND + 1) / FRAMES_PER_SECOND
    keys = np.array([0.0, 0.8, 1.6, 2.4, 3.2, 4.0])

    def bent(*pitch_yaw: tuple[int, int]) -> Rotation:
        values = np.asarray([(0, 0), *pitch_yaw, (0, 0)], dtype=np.float64)
        return _keyed(times, keys, _degrees(values[:, 0], values[:, 1], 0.0))

    turns = {
        "Hips": bent((4, 0), (-2, 0), (2, -6), (24, 0)),
        "Spine": bent((6, 0), (-6, 0), (3, -10), (12, 0)),
        "Chest": bent((5, 0), (-8, 0), (2, -12), (8, 0)),
        "Neck": bent((-4, 0), (-8, 0), (0, -4), (-16, 0)),
        "Head": bent((-6, 0), (-14, 0), (6, -8), (-18, 0)),
    }
    # Outward, ahead and bend of the elbow in degrees; across the body is inward while ahead.
    arms = {
        "Left": ([12, 6, 20, -30, 8, 12], [0, 84, 160, 72, 70, 0], [18, 10, 12, 40, 14, 18]),
        "Right": ([12, 6, 20, 14, 8, 12], [0, 84, 160, 30, 70, 0], [18, 10, 12, 60, 14, 18]),
    }
    for side, (outward, ahead, bend) in arms.items():
        turns[f"{side}Arm"] = _keyed(times, keys, _aimed(side, np.asarray(outward), np.asarray(ahead)))
        turns[f"{side}ForeArm"] = _keyed(times, keys, _elbow(side, np.asarray(bend, dtype=np.float64)))
    hips = np.array(
        [
            [0, -0.012, 0],
            [0, -0.02, -0.02],
            [0, -0.01, 0.01],
            [0.02, -0.03, 0],
            [0, -0.33, -0.14],
            [0, -0.012, 0],
        ]
    )
    return _clip("reach", times, _closed_curve(keys, hips, times), turns, *_standing(len(times)))


def _standing(num_frames: int) -> tuple[dict[str, np.ndarray], dict[str, Rotation]]:
    """Both feet flat where they are at rest."""
    ankles = {side: np.tile(_place(f"{side}Foot"), (num_frames, 1)) for side in ("Left", "Right")}
    feet = {side: Rotation.from_rotvec(np.zeros((num_frames, 3))) for side in ("Left", "Right")}
    return ankles, feet


# From poses to a clip.


def _place(name: str) -> Float[np.ndarray, "3"]:
    left = np.asarray(next(place for joint, _, place in _JOINTS if joint == name.replace("Right", "Left")))
    return left * np.array([-1.0, 1.0, 1.0]) if name.startswith("Right") else left


def _degrees(x, y, z) -> Rotation:
    """Turns about x (forward), then z (to the right), then y (to the left), all in the parent's axes."""
    x, y, z = np.broadcast_arrays(x, y, z)
    return Rotation.from_euler("YZX", np.stack([y, z, x], axis=-1), degrees=True)


def _closed_curve(keys: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """A smooth closed curve through values, of which the last is the first again.

    Monotone between keys, so that a flat foot stays flat and the hips do not rise out of reach of the feet.
    """
    around = np.concatenate([keys[:-1] - keys[-1], keys[:-1], keys + keys[-1]])
    return PchipInterpolator(around, np.concatenate([values[:-1], values[:-1], values]))(times)


def _keyed(times: np.ndarray, keys: np.ndarray, rotations: Rotation) -> Rotation:
    """A smooth closed curve through rotations, of which the last is the first again."""
    around = np.concatenate([keys[:-1] - keys[-1], keys[:-1], keys + keys[-1]])
    return RotationSpline(around, Rotation.concatenate([rotations[:-1], rotations[:-1], rotations]))(times)


def _lowered(side: str, degrees: float) -> Rotation:
    """The arm brought in to the body from its place at rest."""
    return Rotation.from_euler("z", -degrees if side == "Left" else degrees, degrees=True)


def _aimed(side: str, outward: np.ndarray, ahead: np.ndarray) -> Rotation:
    """The least turns of an arm that raise it ahead from straight down, then outward, by these degrees."""
    up, out = np.radians(ahead), np.radians(outward)
    across = np.sin(out) if side == "Left" else -np.sin(out)
    aim = np.stack([across, -np.cos(out) * np.cos(up), np.cos(out) * np.sin(up)], axis=-1)
    arm = _place(f"{side}ForeArm") - _place(f"{side}Arm")
    arm = np.broadcast_to(arm / np.linalg.norm(arm), aim.shape)
    axis = np.cross(arm, aim)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, np.sum(arm * aim, axis=-1, keepdims=True))
    return Rotation.from_rotvec(axis / np.maximum(sine, 1e-12) * angle)


def _elbow(side: str, degrees: np.ndarray) -> Rotation:
    """Bends the forearm ahead; the same for the wrist."""
    arm = _place(f"{side}ForeArm") - _place(f"{side}Arm")
    axis = np.cross(arm, [0.0, 0.0, 1.0])
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * axis / np.linalg.norm(axis))


def _clip(
    name: str,
    times: np.ndarray,
    hips: np.ndarray,
    turns: Mapping[str, Rotation],
    ankles: Mapping[str, np.ndarray],
    feet: Mapping[str, Rotation],
) -> Clip:
    """Keys from the hips' shift, the turns of the joints above them, and the place of the feet."""
    turns = dict(turns)
    for side in ("Left", "Right"):
        turns.update(_leg(side, _place("Hips") + hips, turns["Hips"], ankles[side], feet[side]))
    skeleton = builtin_skeleton()
    keys = times.astype(np.float32)
    channels = [Channel(0, "translation", "LINEAR", keys, (_place("Hips") + hips).astype(np.float32))]
    for joint, joint_name in enumerate(skeleton.names):
        if joint_name in turns:
            q = turns[joint_name].as_quat()
            flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0, -1.0, 1.0)
            q = q * np.cumprod(np.concatenate([[1.0 if q[0, 3] >= 0 else -1.0], flips]))[:, None]
            channels.append(Channel(joint, "rotation", "LINEAR", keys, q.astype(np.float32)))
    return Clip(name, tuple(channels), 0.0, float(times[-1]))


def _leg(side: str, hips: np.ndarray, pelvis: Rotation, ankle: np.ndarray, foot: Rotation) -> dict[str, Rotation]:
    """Turns of thigh, shin and foot that put the ankle in its place, the knee ahead.

    Two-bone inverse kinematics; an ankle out of reach is met in direction only.
    """
    thigh = _place(f"{side}Leg") - _place(f"{side}UpLeg")
    shin = _place(f"{side}Foot") - _place(f"{side}Leg")
    upper, lower = np.linalg.norm(thigh), np.linalg.norm(shin)
    socket = hips + pelvis.apply(_place(f"{side}UpLeg") - _place("Hips"))
    way = ankle - socket
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    down = way / length
    length = np.minimum(length, 0.9995 * (upper + lower))
    ahead = pelvis.apply([0.0, 0.0, 1.0])
    axis = np.cross(ahead, down)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    knee_ahead = np.cross(down, axis)
    cosine = (upper**2 + length**2 - lower**2) / (2 * upper * length)
    along = cosine * down + np.sqrt(np.maximum(1 - cosine**2, 0.0)) * knee_ahead
    below = length * down - upper * along
    world_thigh = _frame_turn(axis, along, thigh / upper)
    world_shin = _frame_turn(axis, below / np.linalg.norm(below, axis=-1, keepdims=True), shin / lower)
    return {
        f"{side}UpLeg": pelvis.inv() * world_thigh,
        f"{side}Leg": world_thigh.inv() * world_shin,
        f"{side}Foot": world_shin.inv() * foot,
    }


def _frame_turn(axis: np.ndarray, along: np.ndarray, rest: np.ndarray) -> Rotation:
    """The turn that takes the bone at `rest` along `along` with its hinge, at rest nearly x, on `axis`."""
    rest_axis = np.array([1.0, 0.0, 0.0]) - rest[0] * rest
    rest_axis /= np.linalg.norm(rest_axis)
    axis = axis - np.sum(axis * along, axis=-1, keepdims=True) * along
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    new = np.stack([axis, along, np.cross(axis, along)], axis=-1)
    old = np.stack([rest_axis, rest, np.cross(rest_axis, rest)], axis=-1)
    return Rotation.from_matrix(new @ old.T)
