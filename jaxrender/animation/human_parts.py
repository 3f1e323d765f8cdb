"""The flesh of a human: parts around a skeleton whose landmarks are known.

Numbers are lengths of an adult of 1.75 m, in metres; they are scaled by the lengths of the skeleton's own
limbs. An animal whose joints carry the names of a human's gets the same parts. NumPy float64.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator

from jaxrender.animation.anatomy import Landmarks, Role, ancestors, limb_length, middle
from jaxrender.animation.body_parts import Part, Vector, unit, unit_across

# Lengths of the adult between the centres of joints: hip to ankle, shoulder to wrist, hips to shoulders; and
# the distances of the two hip and the two shoulder joints.
_LEG, _ARM, _TRUNK = 0.86, 0.54, 0.49
_HIPS, _SHOULDERS = 0.184, 0.36

# Share of the way from the hip joints to the shoulder joints; half width, half depth, shift ahead.
_TRUNK_PROFILE = np.array(
    [
        [0.02, 0.120, 0.076, -0.004],
        [0.14, 0.148, 0.092, -0.008],
        [0.30, 0.140, 0.088, 0.000],
        [0.45, 0.124, 0.080, 0.006],
        [0.62, 0.134, 0.092, 0.008],
        [0.80, 0.148, 0.102, 0.004],
        [0.93, 0.132, 0.084, -0.010],
        [1.00, 0.105, 0.070, -0.015],
    ]
)
# Share of the way, 1 at the elbow or knee and 2 at the wrist or ankle; radius, shift ahead.
_ARM_PROFILE = np.array(
    [
        [0.00, 0.052, 0.0],
        [0.15, 0.056, 0.0],
        [0.40, 0.049, 0.0],
        [0.75, 0.043, 0.0],
        [1.00, 0.039, 0.0],
        [1.25, 0.042, 0.0],
        [1.60, 0.034, 0.0],
        [2.00, 0.026, 0.0],
    ]
)
_LEG_PROFILE = np.array(
    [
        [0.00, 0.080, 0.000],
        [0.20, 0.083, 0.008],
        [0.50, 0.074, 0.012],
        [0.80, 0.058, 0.006],
        [1.00, 0.052, 0.002],
        [1.12, 0.050, -0.004],
        [1.32, 0.055, -0.017],
        [1.60, 0.044, -0.008],
        [1.90, 0.034, 0.000],
        [2.00, 0.034, 0.000],
    ]
)


def human_parts(
    positions: np.ndarray, parents: Sequence[int], roles: Sequence[Role | None], body: Landmarks
) -> list[Part] | None:
    """Parts of a human whose joints are at `positions` (j, 3); None if hips and shoulders span no plane."""
    across = positions[body.thigh["left"]] - positions[body.thigh["right"]]
    up = middle(positions, body.upper_arm) - middle(positions, body.thigh)
    legs = limb_length(positions, body.thigh, body.shin, body.foot)
    arms = limb_length(positions, body.upper_arm, body.forearm, body.hand)
    if min(legs, arms) <= 0 or np.linalg.norm(np.cross(across, up)) < 1e-3 * legs**2:
        return None
    return _Human(positions, parents, roles, body).parts


class _Human:
    """Collects `parts`; one method for each region of the body."""

    def __init__(self, positions: np.ndarray, parents: Sequence[int], roles: Sequence[Role | None], body: Landmarks):
        self.positions, self.parents, self.roles, self.body = positions, parents, roles, body
        self.children: list[list[int]] = [[] for _ in parents]
        for joint, parent in enumerate(parents):
            if parent >= 0:
                self.children[parent].append(joint)
        self.parts: list[Part] = []

        self.hips, self.shoulders = middle(positions, body.thigh), middle(positions, body.upper_arm)
        self.up = unit(self.shoulders - self.hips)
        self.left = unit_across(self.up, positions[body.thigh["left"]] - positions[body.thigh["right"]])
        self.ahead = np.cross(self.left, self.up)

        # Scale of each region. Thickness follows the whole body more than the one limb: short arms are no
        # thin arms.
        leg = limb_length(positions, body.thigh, body.shin, body.foot) / _LEG
        arm = limb_length(positions, body.upper_arm, body.forearm, body.hand) / _ARM
        trunk = float(np.linalg.norm(self.shoulders - self.hips)) / _TRUNK
        self.size = (leg * leg * trunk) ** (1 / 3)
        self.leg_size = (leg * self.size) ** 0.5
        self.trunk_size = (trunk * self.size) ** 0.5
        self.arm_size = (arm * self.size**2) ** (1 / 3)

        self.trunk()
        self.head()
        for side in ("left", "right"):
            self.arm(side)
            self.hand(side)
            self.leg(side)
            self.foot(side)
        self.others()

    # Tools.

    def add(
        self,
        joint: int,
        a: Vector,
        b: Vector,
        radii: tuple[float, float],
        *,
        blend: float,
        wide: Vector | None = None,
        stretch: tuple[float, float] = (1.0, 1.0),
        group: int | None = None,
    ) -> None:
        """One part, in a group of its own unless one is named."""
        group = self.new_group() if group is None else group
        wide = self.left if wide is None else wide
        self.parts.append(Part(joint, a, b, *radii, group, blend, wide, *stretch))

    def loft(
        self,
        centers: np.ndarray,
        owners: Sequence[int],
        radii: np.ndarray,
        stretch: np.ndarray,
        *,
        blend: float,
    ) -> None:
        """One group of cones through `centers`, each with the joint it moves with."""
        group = self.new_group()
        for i, owner in enumerate(owners):
            self.add(
                owner,
                centers[i],
                centers[i + 1],
                (radii[i], radii[i + 1]),
                stretch=(stretch[i], stretch[i + 1]),
                group=group,
                blend=blend,
            )

    def new_group(self) -> int:
        return self.parts[-1].group + 1 if self.parts else 0

    def path(self, start: int, end: int) -> list[int]:
        """Joints from `start` down to `end`, both included."""
        chain = [end]
        while chain[-1] != start:
            chain.append(self.parents[chain[-1]])
        return chain[::-1]

    def is_tip(self, joint: int) -> bool:
        role = self.roles[joint]
        return role is not None and role.part == "tip"

    def tip_below(self, joint: int) -> Vector | None:
        """Where the tip right under a joint is."""
        return next((self.positions[child] for child in self.children[joint] if self.is_tip(child)), None)

    # Regions.

    def trunk(self) -> None:
        """A column from hips to shoulders, the seat, the collar bones, and the flanks up to the armpits."""
        u, up, body = self.trunk_size, self.up, self.body
        column = self.shoulders - self.hips
        share = np.linspace(_TRUNK_PROFILE[0, 0], _TRUNK_PROFILE[-1, 0], 13)
        half_width, half_depth, ahead = u * PchipInterpolator(_TRUNK_PROFILE[:, 0], _TRUNK_PROFILE[:, 1:])(share).T
        hips, shoulders = (
            float(np.linalg.norm(self.positions[pair["left"]] - self.positions[pair["right"]]))
            for pair in (body.thigh, body.upper_arm)
        )
        half_width *= (1 - share) * np.clip(hips / (_HIPS * u), 0.8, 1.25) + share * np.clip(
            shoulders / (_SHOULDERS * u), 0.8, 1.2
        )
        centers = self.hips + share[:, None] * column + ahead[:, None] * self.ahead
        # A piece belongs to the last joint of the spine that lies below it.
        upright = body.chest == body.pelvis or body.pelvis in ancestors(body.chest, self.parents)
        spine = self.path(body.pelvis, body.chest) if upright else [body.pelvis]
        reach = np.maximum.accumulate((self.positions[spine] - self.hips) @ column / (column @ column))
        below = np.searchsorted(reach, 0.5 * (share[1:] + share[:-1]), side="right") - 1
        owners = [spine[max(i, 0)] for i in below]
        self.loft(centers, owners, half_depth, half_width / half_depth, blend=0.022 * u)

        for side, outward in (("left", self.left), ("right", -self.left)):
            seat = self.positions[body.thigh[side]] + u * (-0.040 * self.ahead - 0.006 * outward - 0.01 * up)
            self.add(body.pelvis, seat, seat + 0.03 * u * up, (0.080 * u, 0.076 * u), blend=0.025 * u)
            shoulder = self.positions[body.upper_arm[side]]
            collar = self.shoulders + 0.25 * (shoulder - self.shoulders) + u * (0.025 * up - 0.012 * self.ahead)
            joint = self.parents[body.upper_arm[side]]
            self.add(joint, collar, shoulder, (0.046 * u, 0.050 * u), blend=0.03 * u)
            flank = self.hips + 0.70 * column + 0.085 * u * outward
            self.add(body.chest, flank, shoulder - 0.03 * u * up, (0.060 * u, 0.042 * u), blend=0.03 * u)

    def head(self) -> None:
        """Neck and a head like an egg, its blunt end up and behind."""
        body, u = self.body, self.size
        if body.head is None:
            return
        base = self.positions[body.head]
        root = self.shoulders + u * (0.015 * self.up - 0.012 * self.ahead)
        rise = base - root
        axis = unit(unit(rise) + self.up) if rise @ self.up > 1e-3 * u else self.up
        face = unit_across(axis, self.ahead)

        above = [joint for joint in body.neck if (self.positions[joint] - root) @ axis > 0]
        below = [joint for joint in body.neck if joint not in above]
        owners = [below[-1] if below else body.chest, *above]
        points = np.stack([root, *self.positions[above], base + 0.02 * u * axis])
        radii = u * np.linspace(0.064, 0.050, len(points))
        self.loft(points, owners, radii, np.ones(len(points)), blend=0.02 * u)

        def place(above: float, before: float) -> Vector:
            return base + u * (above * axis + before * face)

        blend = 0.015 * u
        self.add(body.head, place(0.110, -0.022), place(0.112, 0.020), (0.077 * u, 0.073 * u), blend=blend)
        jaw, chin = place(0.040, 0.004), place(0.020, 0.050)
        self.add(body.head, place(0.117, -0.002), jaw, (0.079 * u, 0.052 * u), stretch=(1.0, 1.1), blend=blend)
        self.add(body.head, place(0.105, 0.026), chin, (0.067 * u, 0.042 * u), stretch=(1.0, 1.25), blend=blend)

    def arm(self, side: str) -> None:
        body, u = self.body, self.arm_size
        self.limb((body.upper_arm[side], body.forearm[side], body.hand[side]), _ARM_PROFILE, u, blend=0.014 * u)

    def leg(self, side: str) -> None:
        body, u = self.body, self.leg_size
        self.limb((body.thigh[side], body.shin[side], body.foot[side]), _LEG_PROFILE, u, blend=0.018 * u)

    def limb(self, joints: tuple[int, int, int], profile: np.ndarray, u: float, *, blend: float) -> None:
        """A loft along the bones from the first joint over the second to the third.

        Twist joints on the way share the flesh by where they are. A limb that is bent at rest is two groups,
        so that its bend is rounded.
        """
        chain = self.path(joints[0], joints[1])[:-1] + self.path(joints[1], joints[2])
        points = self.positions[chain]
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
        half = way[chain.index(joints[1])]
        way = np.where(way <= half, way / max(half, 1e-9), 1 + (way - half) / max(way[-1] - half, 1e-9))
        upper, lower = (self.positions[b] - self.positions[a] for a, b in pairwise(joints))
        straight = upper @ lower > 0.9 * np.linalg.norm(upper) * np.linalg.norm(lower)
        curve = PchipInterpolator(profile[:, 0], profile[:, 1:])
        for low, high in ((0.0, 2.0),) if straight else ((0.0, 1.0), (1.0, 2.0)):
            stops = np.unique(np.concatenate([way, np.linspace(0, 2, 13)]).round(9))
            stops = stops[(stops >= low) & (stops <= high)]
            radii, ahead = u * curve(stops).T
            on_bone = np.stack([np.interp(stops, way, points[:, axis]) for axis in range(3)], axis=-1)
            owners = [chain[np.searchsorted(way, s, side="right") - 1] for s in 0.5 * (stops[1:] + stops[:-1])]
            centers = on_bone + ahead[:, None] * self.ahead
            self.loft(centers, owners, radii, np.ones(len(stops)), blend=blend)

    def hand(self, side: str) -> None:
        """A flat palm and a thumb; and each finger, or a flat block for one finger or none."""
        u, hand = self.arm_size, self.body.hand[side]
        wrist = self.positions[hand]
        fingers, thumbs = self.chains(hand, "finger"), self.chains(hand, "thumb")
        tips = [self.positions[chain[-1]] - wrist for chain in fingers]
        if not tips and (tip := self.tip_below(hand)) is not None:
            tips = [tip - wrist]
        along = np.mean(tips, axis=0) if tips else np.zeros(3)
        if np.linalg.norm(along) < 0.01 * u:
            along = wrist - self.positions[self.body.forearm[side]]
        along = unit(along)
        # The palm lies in the plane of the thumb; without one it faces the thigh when the arm hangs.
        palm = np.cross(self.ahead, along)
        for chain in thumbs:
            normal = np.cross(self.positions[chain[-1]] - wrist, along)
            if np.linalg.norm(normal) > 0.01 * u:
                palm = normal
        wide = np.cross(unit_across(along, palm, self.up), along)
        wide = -wide if wide @ self.ahead < 0 else wide

        length = max([0.17 * u, *(float(tip @ along) for tip in tips)])
        knuckles = wrist + 0.48 * length * along
        blend = 0.008 * u
        self.add(hand, wrist, knuckles, (0.020 * u, 0.0165 * u), wide=wide, stretch=(1.35, 2.4), blend=blend)
        if len(fingers) > 1:
            for chain in fingers:
                self.finger(hand, knuckles, chain, 0.0095 * u, reach=0.06 * u)
        else:
            owner = next((joint for chain in fingers for joint in reversed(chain) if not self.is_tip(joint)), hand)
            tip = wrist + (length - 0.012 * u) * along
            self.add(
                owner,
                knuckles,
                tip,
                (0.0165 * u, 0.0115 * u),
                wide=wide,
                stretch=(2.4, 2.2),
                group=self.parts[-1].group,
                blend=blend,
            )
        base = wrist + u * (0.022 * along + 0.014 * wide)
        for chain in thumbs:
            self.finger(hand, base, chain, 0.0130 * u, reach=0.06 * u)
        if not thumbs:
            end = base + u * (0.05 * along + 0.035 * wide)
            self.add(hand, base, end, (0.015 * u, 0.011 * u), blend=blend)

    def chains(self, joint: int, part: str) -> list[list[int]]:
        """The chains of joints below the hand that begin with a finger or thumb, down to their ends."""
        result = []
        for child in self.children[joint]:
            role = self.roles[child]
            if role is not None and role.part == part:
                chain = [child]
                while self.children[chain[-1]]:
                    chain.append(self.children[chain[-1]][0])
                result.append(chain)
            elif role is None:
                result.extend(self.chains(child, part))
        return result

    def finger(self, hand: int, base: Vector, chain: list[int], radius: float, *, reach: float) -> None:
        """Cones from `base` along a chain of joints, made longer where they end closer than `reach`."""
        owners, points = [hand, *chain], [base, *self.positions[chain]]
        if self.is_tip(chain[-1]):
            owners.pop()
        else:
            points.append(points[-1])
        heading = unit_across(self.up, self.ahead)
        for a, b in pairwise(points):
            heading = unit(b - a) if np.linalg.norm(b - a) > 0.1 * radius else heading
        short = reach - float(np.linalg.norm(points[-1] - base))
        points[-1] = points[-1] + max(short, 0.0) * heading
        for owner, a, b in zip(owners, points, points[1:], strict=False):
            if np.linalg.norm(b - a) > 0.1 * radius:
                self.add(owner, a, b, (radius, 0.9 * radius), blend=0.4 * radius)

    def foot(self, side: str) -> None:
        """Heel, ball and toes on a flat sole that lies square to the shin."""
        u, foot = self.leg_size, self.body.foot[side]
        ankle = self.positions[foot]
        shin = unit(ankle - self.positions[self.body.shin[side]])
        toe = next((c for c in self.children[foot] if (r := self.roles[c]) is not None and r.part == "toe"), None)
        ball_joint = self.positions[toe] if toe is not None else self.tip_below(foot)
        ahead = ball_joint - ankle if ball_joint is not None else self.ahead
        along = unit_across(shin, ahead, self.ahead)
        wide = np.cross(shin, along)
        ball_at = max(float(ahead @ along), 0.08 * u) if toe is not None else 0.125 * u
        tip_at = ball_at + 0.075 * u
        if toe is not None and (tip := self.tip_below(toe)) is not None:
            tip_at = max(tip_at, float((tip - ankle) @ along))

        def place(forward: float, below: float) -> Vector:
            return ankle + u * below * shin + forward * along

        sole, blend = 0.072, 0.012 * u
        heel, ball = place(-0.022 * u, sole - 0.032), place(ball_at, sole - 0.026)
        tip = place(tip_at - 0.018 * u, sole - 0.018)
        self.add(foot, ankle, heel, (0.035 * u, 0.032 * u), blend=blend)
        self.add(foot, heel, ball, (0.032 * u, 0.026 * u), wide=wide, stretch=(1.05, 1.75), blend=blend)
        owner, group = foot if toe is None else toe, self.parts[-1].group
        self.add(owner, ball, tip, (0.026 * u, 0.017 * u), wide=wide, stretch=(1.75, 2.1), group=group, blend=blend)
        instep = place(0.8 * ball_at, sole - 0.036)
        self.add(foot, place(0.005 * u, 0.0), instep, (0.034 * u, 0.024 * u), blend=blend)

    def others(self) -> None:
        """Bones that no name tells: tails, hair, props. What leads down to the pelvis has no flesh."""
        u = self.size
        for joint, parent in enumerate(self.parents):
            if self.roles[joint] is not None or self.body.pelvis not in ancestors(joint, self.parents):
                continue
            a, b = self.positions[parent], self.positions[joint]
            if np.linalg.norm(b - a) > 1e-3 * u:
                self.add(parent, a, b, (0.024 * u, 0.020 * u), blend=0.012 * u)
