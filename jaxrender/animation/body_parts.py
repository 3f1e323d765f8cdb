"""The flesh around bones: elliptic round cones, each of which moves with one joint.

NumPy float64, metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class Part:
    """Two spheres and what they sweep between them, from `a` to `b`, stretched along the unit vector `wide`.

    The radius runs from `radius_a` to `radius_b`, the stretch from `stretch_a` to `stretch_b`, both at least
    1. Parts of one group are joined as they are; groups melt into each other over about the width `blend`.
    """

    joint: int
    a: Vector
    b: Vector
    radius_a: float
    radius_b: float
    group: int
    blend: float
    wide: Vector
    stretch_a: float = 1.0
    stretch_b: float = 1.0


_BALL = 0.1
"""Radius of the body of a skeleton without extent."""

# Shares of the extent of the skeleton.
_THICKEST, _THINNEST = 0.055, 0.014


def tree_parts(positions: Float[np.ndarray, "j 3"], parents: Sequence[int]) -> list[Part]:
    """A tapered cone along every bone, thicker the more of the skeleton hangs on it, as in a tree.

    The radius grows with the root of the length of bones from there on, within limits that follow the extent
    of the whole, and is at most half the length of the bone. A skeleton without extent is a ball.
    """
    bones = [joint for joint, parent in enumerate(parents) if parent >= 0]
    lengths = np.zeros(len(parents))
    for joint in bones:
        lengths[joint] = np.linalg.norm(positions[joint] - positions[parents[joint]])
    hanging = np.zeros(len(parents))
    for joint in reversed(bones):
        hanging[parents[joint]] += hanging[joint] + lengths[joint]
    extent, total = float(np.linalg.norm(np.ptp(positions, axis=0))), float(lengths.sum())
    sideways = np.array([1.0, 0.0, 0.0])
    bones = [joint for joint in bones if lengths[joint] > 1e-9 * extent]
    if not bones:
        return [Part(0, positions[0], positions[0], _BALL, _BALL, 0, 0.2 * _BALL, sideways)]
    parts: dict[int, Part] = {}
    for joint in bones:
        parent = parents[joint]
        from_here = np.array([hanging[joint] + lengths[joint], hanging[joint]])
        radii = extent * np.clip(_THICKEST * np.sqrt(from_here / total), _THINNEST, _THICKEST)
        start, end = np.minimum(radii, max(0.5 * lengths[joint], _THINNEST * extent)).tolist()
        # A bone that goes on nearly straight continues the group of the one before it, without a knob.
        before = parts.get(parent)
        heading = (positions[joint] - positions[parent]) / lengths[joint]
        straight = before is not None and heading @ unit(before.b - before.a) > 0.9
        group = before.group if before is not None and straight else joint
        parts[joint] = Part(parent, positions[parent], positions[joint], start, end, group, 0.3 * end, sideways)
    return list(parts.values())


def unit(v: Vector) -> Vector:
    """v / |v|, for a v that is known not to be 0."""
    return v / np.linalg.norm(v)


def unit_across(axis: Vector, *candidates: Vector) -> Vector:
    """The first of the candidates that is not parallel to the unit vector `axis`, made square to it, unit."""
    for candidate in (*candidates, *np.eye(3)):
        side = candidate - (candidate @ axis) * axis
        if np.linalg.norm(side) > 1e-3 * np.linalg.norm(candidate):
            return unit(side)
    raise AssertionError("three axes cannot all be parallel to one")
