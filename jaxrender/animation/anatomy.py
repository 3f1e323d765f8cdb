"""Which joint of a skeleton is what in a body, by its name and its place in the tree.

NumPy float64. Lengths are in the unit of the positions that are handed in.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

# Names.


# Tried in this order on a name without side, prefix, digits and separators. In the wild are the names of
# CMU and Mixamo (LeftUpLeg), Biovision (LeftHip, LeftKnee), Biped (L Thigh, L Calf), Blender (thigh.L), SMPL.
_PARTS = (
    ("thumb", r"thumb"),
    ("finger", r"finger|index|middle|ring|pinky|little|metacarp|carpal"),
    ("toe", r"toe|ball"),
    ("foot", r"foot|ankle"),
    ("thigh", r"upleg|upperleg|thigh|femur"),
    ("shin", r"leg|shin|calf|knee|tibia"),
    ("forearm", r"forearm|lowerarm|lowarm|elbow|radius|ulna"),
    ("upper arm", r"arm|humerus|shldr"),
    ("clavicle", r"collar|clavicle|scapula"),
    ("shoulder", r"shoulder"),
    ("hand", r"hand|wrist|palm"),
    ("head", r"head|skull"),
    ("neck", r"neck"),
    ("spine", r"spine|back|abdomen|waist|belly|lumbar|chest|thorax|torso"),
    ("pelvis", r"hipjoint|pelvis|hips"),
    ("hip", r"hip"),
)
_TIPS = {"end", "site", "effector", "nub", "tip"}
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


@dataclass(frozen=True)
class Role:
    """What a joint is in a body ("tip" for the mere end of one), and its side: "left", "right" or ""."""

    part: str
    side: str = ""


def recognize(names: Sequence[str], parents: Sequence[int]) -> tuple[Role | None, ...]:
    """The role of every joint by its name, None where the name says nothing.

    A name means what it means in its own family: "LeftShoulder" is the collar bone where an upper arm hangs
    on it and the upper arm elsewhere; "LeftHip" is the thigh and "Hip" the pelvis.
    """
    roles = [_role(name) for name in names]
    carries_arm = set()
    for joint, role in enumerate(roles):
        if role is not None and role.part == "upper arm":
            carries_arm.update(ancestors(joint, parents))
    for joint, role in enumerate(roles):
        if role is not None and role.part == "shoulder":
            roles[joint] = replace(role, part="clavicle" if joint in carries_arm else "upper arm")
        elif role is not None and role.part == "hip":
            roles[joint] = replace(role, part="thigh" if role.side else "pelvis")
    return tuple(roles)


def _role(name: str) -> Role | None:
    words = [word.lower() for word in _WORD.findall(name.rsplit(":", 1)[-1])]
    side = next((_SIDES[word] for word in words if word in _SIDES), "")
    if _TIPS.intersection(words):
        return Role("tip", side)
    plain = "".join(word for word in words if word not in _SIDES)
    if not side and plain[:1] in _SIDES:  # "lThumb" has two words, "lthumb" one: look behind its first letter
        sided = next((part for part, pattern in _PARTS if re.match(pattern, plain[1:])), None)
        if sided is not None and sided not in ("spine", "neck", "head"):
            return Role(sided, _SIDES[plain[0]])
    part = next((part for part, pattern in _PARTS if re.search(pattern, plain)), None)
    return None if part is None else Role(part, side)


def ancestors(joint: int, parents: Sequence[int]) -> list[int]:
    """The joint's parent, its parent, and so on to the root."""
    result = []
    while (joint := parents[joint]) >= 0:
        result.append(joint)
    return result


# Landmarks.


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Where the joints of a human body are: joint numbers, and "left" and "right" ones by side."""

    pelvis: int
    chest: int
    head: int | None
    neck: tuple[int, ...]
    thigh: dict[str, int]
    shin: dict[str, int]
    foot: dict[str, int]
    upper_arm: dict[str, int]
    forearm: dict[str, int]
    hand: dict[str, int]


def find_landmarks(parents: Sequence[int], roles: Sequence[Role | None]) -> Landmarks | None:
    """The joints of a human body, or None unless there are two legs with feet and two arms with hands."""
    limbs: dict[str, dict[str, int]] = {}
    for part in ("thigh", "shin", "foot", "upper arm", "forearm", "hand"):
        limbs[part] = {}
        for joint, role in enumerate(roles):
            if role is not None and role.part == part and role.side:
                limbs[part].setdefault(role.side, joint)
        if len(limbs[part]) < 2:
            return None
    for side in ("left", "right"):
        for upper, middle, lower in (("thigh", "shin", "foot"), ("upper arm", "forearm", "hand")):
            above = ancestors(limbs[lower][side], parents)
            if limbs[middle][side] not in above or limbs[upper][side] not in above:
                return None

    def common(part: str) -> int:
        right = ancestors(limbs[part]["right"], parents)
        return next((j for j in ancestors(limbs[part]["left"], parents) if j in right), -1)

    pelvis, chest = common("thigh"), common("upper arm")
    if pelvis < 0 or chest < 0:
        return None
    head = next((joint for joint, role in enumerate(roles) if role == Role("head")), None)
    neck: tuple[int, ...] = ()
    if head is not None:
        above = ancestors(head, parents)
        if chest not in above:
            return None
        neck = tuple(reversed([j for j in above[: above.index(chest)] if roles[j] == Role("neck")]))
    return Landmarks(
        pelvis,
        chest,
        head,
        neck,
        *(limbs[p] for p in ("thigh", "shin", "foot", "upper arm", "forearm", "hand")),
    )


def stature(positions: Float[np.ndarray, "j 3"], parents: Sequence[int], roles: Sequence[Role | None]) -> float | None:
    """Body height by the length of the legs, in the units of `positions`; None if this is no upright human.

    References:
      Drillis and Contini, "Body Segment Parameters", 1966: thigh and shank are 0.245 and 0.246 of it.
    """
    body = find_landmarks(parents, roles)
    if body is None:
        return None
    trunk = middle(positions, body.upper_arm) - middle(positions, body.thigh)
    if not trunk[1] > 0.7 * np.linalg.norm(trunk):
        return None
    legs = limb_length(positions, body.thigh, body.shin, body.foot)
    return legs / 0.491 if legs > 0 else None


def middle(positions: np.ndarray, joints: dict[str, int]) -> Float[np.ndarray, "3"]:
    """The place between a left and a right joint."""
    return 0.5 * (positions[joints["left"]] + positions[joints["right"]])


def limb_length(positions: np.ndarray, *joints: dict[str, int]) -> float:
    """Mean over both sides of the way from joint to joint."""
    steps = [
        np.linalg.norm(positions[b[side]] - positions[a[side]])
        for a, b in pairwise(joints)
        for side in ("left", "right")
    ]
    return 0.5 * float(np.sum(steps))
