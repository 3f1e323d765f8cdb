"""The pose a body is grown in: the rest pose with its limbs spread, so that none melts into another.

An arm hanging along the body, or legs that stand close, would be joined by a surface grown around them. The
body is therefore grown with arms and legs apart and bound in that pose; the skeleton keeps its own rest pose.
NumPy float64, metres.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxrender.animation.anatomy import Landmarks, middle
from jaxrender.animation.body_parts import tree_parts, unit
from jaxrender.animation.skeleton import Skeleton

# From straight down. Half way between hanging and level, an arm is bent least by most motions.
_ARM_DEGREES = (50.0, 50.0)
_LEG_DEGREES = (8.0, 25.0)

_MAX_BONES = 400
"""A skeleton with more bones is not spread: the work grows with their square."""


def rest_matrices(skeleton: Skeleton) -> Float[np.ndarray, "j 4 4"]:
    """World from joint at rest, in float64 and without the seconds that compiling `global_matrices` takes."""
    rest = skeleton.rest
    matrices = np.tile(np.eye(4), (len(skeleton.parents), 1, 1))
    rotation = Rotation.from_quat(np.asarray(rest.rotation, dtype=np.float64)).as_matrix()
    matrices[:, :3, :3] = rotation * np.asarray(rest.scale, dtype=np.float64)[:, None, :]
    matrices[:, :3, 3] = np.asarray(rest.translation, dtype=np.float64)
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            matrices[joint] = matrices[parent] @ matrices[joint]
    return matrices


def joint_hops(positions: Float[np.ndarray, "j 3"], parents: Sequence[int]) -> Int[np.ndarray, "j j"]:
    """Bones between every two joints, one without length not counted; joints of two trees are far apart."""
    num_joints = len(parents)
    hops = np.zeros((num_joints, num_joints), dtype=np.int64)
    for joint, parent in enumerate(parents):
        step = num_joints if parent < 0 else int(np.linalg.norm(positions[joint] - positions[parent]) > 1e-9)
        hops[joint, :joint] = hops[:joint, joint] = hops[max(parent, 0), :joint] + step
    return hops


def spread_limbs(
    rest: Float[np.ndarray, "j 4 4"],
    parents: Sequence[int],
    body: Landmarks | None,
    *,
    step: float = 0.0,
) -> Float[np.ndarray, "j 4 4"]:
    """World from joint with arms and legs of a human at an angle, or the bones of any other tree apart.

    Args:
      step: spacing of the grid the body is meshed on. Bones of a tree take a radius of one step at least, and
        keep a gap of 1.3 steps, which a grid can show.
    """
    hanging = _hanging(parents)
    if body is None:
        return _push_apart(rest, parents, hanging, step)
    matrices = rest.copy()
    positions = rest[:, :3, 3]
    hips, shoulders = middle(positions, body.thigh), middle(positions, body.upper_arm)
    for starts, ends, center, degrees in (
        (body.upper_arm, body.hand, shoulders, _ARM_DEGREES),
        (body.thigh, body.foot, hips, _LEG_DEGREES),
    ):
        for side in ("left", "right"):
            start, limb = starts[side], positions[ends[side]] - positions[starts[side]]
            turn = _spread_turn(limb, hips - shoulders, positions[start] - center, degrees)
            _turn_joint(matrices, hanging[start], start, turn)
    return matrices


def _spread_turn(limb: np.ndarray, down: np.ndarray, outward: np.ndarray, degrees: tuple[float, float]) -> np.ndarray:
    """Rotation vector that brings the angle between a limb and straight down within limits."""
    if min(np.linalg.norm(limb), np.linalg.norm(down)) == 0:
        return np.zeros(3)
    limb, down = unit(limb), unit(down)
    away = limb - (limb @ down) * down
    out = outward - (outward @ down) * down
    # A limb that leans inward is brought through straight down; one as good as straight goes outward.
    if away @ out < 0:
        away, angle = -away, -np.arctan2(np.linalg.norm(away), limb @ down)
    else:
        angle = np.arctan2(np.linalg.norm(away), limb @ down)
    axis = np.cross(down, away if np.linalg.norm(away) > 0.02 else out)
    if np.linalg.norm(axis) == 0:
        return np.zeros(3)
    return unit(axis) * (np.clip(angle, *np.radians(degrees)) - angle)


def _hanging(parents: Sequence[int]) -> Bool[np.ndarray, "j j"]:
    """Row a: the joints that move when joint a turns, itself included."""
    above = np.eye(len(parents), dtype=bool)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            above[joint] |= above[parent]
    return above.T


def _turn_joint(matrices: np.ndarray, hanging: np.ndarray, joint: int, turn: np.ndarray) -> None:
    """Turns a joint, and what hangs on it, by a rotation vector about where it is. In place."""
    pivot = matrices[joint, :3, 3].copy()
    rotation = Rotation.from_rotvec(turn).as_matrix()
    moved = matrices[hanging]
    moved[:, :3, 3] -= pivot
    moved[:, :3] = rotation @ moved[:, :3]
    moved[:, :3, 3] += pivot
    matrices[hanging] = moved


def _push_apart(
    rest: np.ndarray, parents: Sequence[int], hanging: np.ndarray, step: float, num_rounds: int = 60
) -> Float[np.ndarray, "j 4 4"]:
    """Bones that lie closer than their thickness allows, although far apart along the tree, are turned away.

    Each contact turns the joints between the two bones, the more the less hangs on them and the longer their
    lever, as far as it is deep; contacts are averaged, and it goes on until none is left or `num_rounds` are
    over. A tree that cannot be freed keeps some contacts.
    """
    positions = rest[:, :3, 3]
    lengths = np.array([np.linalg.norm(positions[j] - positions[p]) if p >= 0 else 0.0 for j, p in enumerate(parents)])
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    ends = np.flatnonzero(lengths > 1e-9 * extent)
    if extent == 0 or not 2 <= len(ends) <= _MAX_BONES:
        return rest
    starts = np.asarray(parents)[ends]
    parts = tree_parts(positions, parents)
    radius = np.array([max(part.radius_a, part.radius_b, step) for part in parts])

    # Points on the bones; which bones they must keep away from, and by how much.
    share = np.tile([0.0, 0.5, 1.0], len(ends))
    of_bone = np.repeat(np.arange(len(ends)), 3)
    way = _ways(positions, parents)
    to_ends = np.minimum(way[:, starts], way[:, ends])
    along = np.minimum(
        share[:, None] * lengths[ends][of_bone, None] + to_ends[starts[of_bone]],
        (1.0 - share[:, None]) * lengths[ends][of_bone, None] + to_ends[ends[of_bone]],
    )
    needed = radius[of_bone, None] + radius
    needed = needed + np.maximum(0.15 * needed + 0.01 * extent, 1.3 * step)
    watched = along > 2.0 * needed

    # Inertia of a joint: what hangs on it.
    ease = 1.0 / (hanging @ lengths + 0.05 * extent)
    matrices = rest.copy()
    for _ in range(num_rounds):
        positions = matrices[:, :3, 3]
        a, b = positions[starts], positions[ends]
        points = a[of_bone] + share[:, None] * (b - a)[of_bone]
        away = points[:, None] - a
        t = np.clip(np.einsum("spi,pi->sp", away, b - a) / lengths[ends] ** 2, 0.0, 1.0)
        away -= t[..., None] * (b - a)
        distance = np.linalg.norm(away, axis=-1)
        deep = np.where(watched, needed - distance, 0.0)
        point, bone = np.nonzero(deep > 1e-3 * extent)
        if len(point) == 0:
            break
        normal = away[point, bone] / np.maximum(distance[point, bone], 1e-9)[:, None]
        # +1 where the joint carries the point only, -1 where it carries the other bone only.
        side = hanging[:, starts[of_bone[point]]].T.astype(np.float64) - hanging[:, starts[bone]].T
        lever = np.cross(points[point][:, None] - positions, normal[:, None]) * side[..., None]
        gain = ease[:, None] * lever
        total = np.sum(gain * lever, axis=(1, 2)) + ease.mean() * (0.05 * extent) ** 2
        turns = gain * (deep[point, bone] / total)[:, None, None]
        shared = np.maximum(np.count_nonzero(np.abs(turns).max(axis=2) > 1e-6, axis=0), 1)
        for joint, turn in enumerate(turns.sum(axis=0) / shared[:, None]):
            if np.abs(turn).max() > 1e-6:
                _turn_joint(matrices, hanging[joint], joint, turn)
    return matrices


def _ways(positions: np.ndarray, parents: Sequence[int]) -> Float[np.ndarray, "j j"]:
    """Length of the way along the bones between every two joints."""
    way = np.zeros((len(parents), len(parents)))
    for joint, parent in enumerate(parents):
        step = np.linalg.norm(positions[joint] - positions[parent]) if parent >= 0 else np.inf
        way[joint, :joint] = way[:joint, joint] = way[max(parent, 0), :joint] + step
    return way
