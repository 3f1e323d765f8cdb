"""A character's clips as frames: resampled poses, the split into training and held-out motion, mixed poses."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.config import BakeSettings, SplitSettings
from jaxrender.animation.skeleton import Pose, Skeleton, global_matrices, sample_clip
from jaxrender.animation.skinning import Character
from jaxrender.checks import bad_input

TRAIN, SEGMENT, CLIP, MIXED = 0, 1, 2, 3
PART_NAMES = ("training", "held-out segments", "held-out clips", "mixed poses")


@dataclass(frozen=True)
class Motion:
    """f poses, where they come from and what they are for.

    `clip` indexes `clip_names` (-1 for mixed poses), `time` is in seconds, `part` is TRAIN, SEGMENT, CLIP or MIXED.
    `source` tells for each joint which frame its rotation was taken from: the frame itself unless the pose is mixed.
    """

    pose: Pose
    clip: Int[np.ndarray, " f"]
    time: Float[np.ndarray, " f"]
    part: Int[np.ndarray, " f"]
    clip_names: tuple[str, ...]
    source: Int[np.ndarray, "f j"]

    def __len__(self) -> int:
        return len(self.clip)

    def where(self, *parts: int) -> Bool[np.ndarray, " f"]:
        return np.isin(self.part, parts)


def sample_motion(character: Character, bake: BakeSettings, split: SplitSettings) -> Motion:
    """Resamples every clip and labels its frames; then adds the mixed poses.

    Raises:
      InputError: if the character has no clip, or too few frames to train on.
    """
    if not character.clips:
        bad_input(character.name, "animations", expected="at least one clip", got="none")
    durations = np.array([max(clip.duration, 0.0) for clip in character.clips])
    rate = min(bake.frames_per_second, max(bake.max_frames - len(durations), 1) / max(durations.sum(), 1e-9))
    counts = np.floor(durations * rate + 1e-6).astype(int) + 1
    names = tuple(clip.name for clip in character.clips)
    held_out = held_out_clips(names, split)
    poses, clips, times, parts = [], [], [], []
    for index, (clip, count) in enumerate(zip(character.clips, counts, strict=True)):
        t = (clip.start + np.minimum(np.arange(count) / rate, clip.duration)).astype(np.float32)
        poses.append(sample_clip(clip, character.skeleton, t))
        clips.append(np.full(count, index))
        times.append(t)
        part = np.full(count, CLIP if index in held_out else TRAIN)
        first_held = int(np.ceil(count * (1.0 - split.segment_share)))
        if index not in held_out and count >= 5:
            part[first_held:] = SEGMENT
        parts.append(part)
    own = np.repeat(np.arange(counts.sum())[:, None], len(character.skeleton.parents), axis=1)
    of_clip, at, use = (np.concatenate(values) for values in (clips, times, parts))
    motion = Motion(_concatenate(poses), of_clip, at, use, names, own)
    if motion.where(TRAIN).sum() < 2:
        got = f"{motion.where(TRAIN).sum()} of {len(motion)} (clips of one frame hold no motion)"
        bad_input(character.name, "training frames", expected="at least 2", got=got)
    return add_mixed_poses(motion, character, bake.num_mixed, seed=bake.seed)


def held_out_clips(names: tuple[str, ...], split: SplitSettings) -> set[int]:
    """Indices of the clips kept from training."""
    if split.clips == ("none",) or not split.clips:
        return set()
    if split.clips == ("auto",):
        return set(range(2, len(names), 4)) if len(names) >= 4 else set()
    unknown = sorted(set(split.clips) - set(names))
    if unknown:
        bad_input("split.clips", unknown[0], expected=f"one of {', '.join(names)}", got="no such clip")
    chosen = {i for i, name in enumerate(names) if name in split.clips}
    if len(chosen) == len(names):
        bad_input("split.clips", "all", expected="at least one clip left to train on", got="every clip held out")
    return chosen


def add_mixed_poses(motion: Motion, character: Character, count: int, *, seed: int) -> Motion:
    """Appends poses whose limbs come from different training frames.

    Walking down the skeleton, a joint follows its parent's source frame, except that behind a joint with several
    limbs each limb takes, with probability 0.7, a frame of its own. Chains such as an arm stay whole.
    """
    source = np.flatnonzero(motion.where(TRAIN))
    if count == 0 or len(source) < 2:
        return motion
    parents = character.skeleton.parents
    limbs = limb_starts(character)
    rng = np.random.default_rng(seed)
    chosen = np.empty((count, len(parents)), int)
    for joint, parent in enumerate(parents):
        fresh = rng.choice(source, count)
        redraw = rng.random(count) < 0.7
        inherited = chosen[:, parent] if parent >= 0 else fresh
        chosen[:, joint] = np.where(redraw, fresh, inherited) if joint in limbs else inherited
    joints = np.arange(len(parents))
    mixed = jax.tree.map(lambda values: np.asarray(values)[chosen, joints], motion.pose)
    return Motion(
        _concatenate([motion.pose, mixed]),
        np.concatenate([motion.clip, np.full(count, -1)]),
        np.concatenate([motion.time, np.zeros(count, np.float32)]),
        np.concatenate([motion.part, np.full(count, MIXED)]),
        motion.clip_names,
        np.concatenate([motion.source, chosen]),
    )


def limb_starts(character: Character) -> set[int]:
    """Joints that begin a limb: children of a joint below which the skin divides."""
    parents = character.skeleton.parents
    carries = np.zeros(len(parents), int)
    carries[influencing_joints(character)] = 1
    for joint in reversed(range(len(parents))):
        if parents[joint] >= 0:
            carries[parents[joint]] += carries[joint]
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(parents):
        if carries[joint]:
            children.setdefault(parent, []).append(joint)
    return {joint for limbs in children.values() if len(limbs) > 1 for joint in limbs}


def influencing_joints(character: Character) -> Int[np.ndarray, " i"]:
    """Joints that move at least one vertex, ascending."""
    skin = character.skin
    used = np.asarray(skin.joint_indices)[np.asarray(skin.weights) > 0]
    return np.unique(np.asarray(skin.palette_joints)[used])


def articulating_joints(character: Character) -> Int[np.ndarray, " i"]:
    """Joints whose local motion changes the shape, ascending.

    Those that carry the whole skin, from the root down to the last common ancestor of all influencing joints, only
    move the body as a piece: self-visibility does not see them. Those that carry no skin do nothing.
    """
    parents = character.skeleton.parents
    lines = [set(ancestors(parents, joint)) for joint in influencing_joints(character)]
    some, every = set[int]().union(*lines), set(lines[0]).intersection(*lines)
    return np.array(sorted(some - every), int)


def ancestors(parents: tuple[int, ...], joint: int) -> list[int]:
    """The joint, its parent, and so on up to a root."""
    line = []
    while joint >= 0:
        line.append(joint)
        joint = parents[joint]
    return line


def skeleton_distances(skeleton: Skeleton) -> Float[np.ndarray, "j j"]:
    """Length of the way along the bones between any two joints at rest; infinite between separate skeletons."""
    at = np.asarray(global_matrices(skeleton.rest, parents=skeleton.parents))[:, :3, 3].astype(np.float64)
    count = len(skeleton.parents)
    distance = np.full((count, count), np.inf)
    for joint, parent in enumerate(skeleton.parents):
        distance[joint, joint] = 0.0
        if parent >= 0:
            bone = np.linalg.norm(at[joint] - at[parent])
            distance[joint, :joint] = distance[parent, :joint] + bone
            distance[:joint, joint] = distance[joint, :joint]
    return distance


def _concatenate(poses: list[Pose]) -> Pose:
    return jax.tree.map(lambda *parts: jnp.concatenate([jnp.asarray(part) for part in parts]), *poses)
