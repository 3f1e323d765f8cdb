"""What a fit starts from: baked visibility, the poses it belongs to, and what each frame is for."""

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fitting.config import TrainSettings
from fitting.dataset import (
    BakeStatistics,
    ShadingPoints,
    VisibilityStore,
    bake,
    character_frames,
    choose_points,
    mean_visibility,
    represent_by_visible,
    sequence_frames,
)
from fitting.features import all_raw_features, feature_groups, joint_angle_features, unfitted_basis
from fitting.motion import MIXED, SEGMENT, TRAIN, Motion, sample_motion
from fitting.solve import BLOCK, ORDER, block_sh, padded
from fitting.stages import Track, no_tracking
from jaxrender.animation.skinning import Character
from jaxrender.checks import bad_input
from jaxrender.harmonics.pose_model import FeatureBasis
from jaxrender.harmonics.visibility import hemisphere_directions, projection_table
from jaxrender.scene import MeshSequence

# Points that see less than this share of their hemisphere in the training frames, on average, are inner surfaces.
INVISIBLE_BELOW = 0.02


@dataclass(frozen=True)
class TrainingData:
    """Baked visibility and the poses it belongs to; f frames, p points, g groups.

    `part` says what each frame is for (fitting.motion), `clip` which clip it is from, `source` which frames the limbs
    of a mixed pose are from.
    """

    name: str
    points: ShadingPoints
    groups: Int[np.ndarray, " p"]
    bits: UInt8[np.ndarray, "f p bytes"]
    raw: Float[np.ndarray, "f g n"]
    basis: FeatureBasis
    part: Int[np.ndarray, " f"]
    clip: Int[np.ndarray, " f"]
    num_directions: int
    visible: Bool[np.ndarray, " p"]
    source: Int[np.ndarray, "f j"] | None = None

    def frame_weights(self, mixed_weight: float) -> Float[np.ndarray, " f"]:
        """1 for training frames, `mixed_weight` for mixed poses, 0 for what is held out."""
        return np.where(self.part == TRAIN, 1.0, np.where(self.part == MIXED, mixed_weight, 0.0))

    @property
    def table(self) -> Float[np.ndarray, "d 16"]:
        return projection_table(hemisphere_directions(self.num_directions), order=ORDER)

    def sh(self, points: Int[np.ndarray, " n"]) -> Float[np.ndarray, "f n 16"]:
        """Baked SH visibility of some points in all frames."""
        return project(self.bits, points, self.table)


def project(
    bits: np.ndarray, points: Int[np.ndarray, " n"], table: Float[np.ndarray, "d k"]
) -> Float[np.ndarray, "f n k"]:
    """Coefficients of some points; a block at a time, since unpacked bits take 32 times the memory."""
    result = np.empty((len(bits), len(points), table.shape[1]), np.float32)
    for start in range(0, len(points), BLOCK):
        own = points[start : start + BLOCK]
        result[:, start : start + len(own)] = np.asarray(block_sh(bits[:, padded(own, BLOCK)], table))[:, : len(own)]
    return result


def bake_character(
    character: Character, settings: TrainSettings, store: Path, *, track: Track = no_tracking
) -> tuple[TrainingData, BakeStatistics, Motion]:
    """Bakes every frame of a character's motion, or what is missing of it in the store."""
    motion = sample_motion(character, settings.bake, settings.split)
    points = choose_points(character, settings.bake.max_points, seed=settings.bake.seed)
    bones, groups = feature_groups(character, points.vertices, settings.fit.features)
    check_pose_rank(character, motion)
    basis = unfitted_basis(character, motion, settings.fit.features, bones)
    raw = all_raw_features(basis, character, motion)
    frames = character_frames(character, motion)
    arrays = [np.asarray(values) for values in jax.tree.leaves(motion.pose)]
    source = _source_hash(character.content_hash, [*arrays, points.vertices, np.asarray(character.faces)])
    data, statistics = _bake(
        character.name, frames, character.faces, points, groups, raw, basis, motion.part, motion.clip,
        source, {"character": character_identity(character)}, settings, store, track,
    )  # fmt: skip
    if settings.bake.max_points:
        points = represent_by_visible(character, points, data.visible)
    return dataclasses.replace(data, points=points, source=motion.source), statistics, motion


def check_pose_rank(character: Character, motion: Motion) -> None:
    """Raises InputError if the matrix of joint angles over the training frames has a rank below 2.

    A single motion of a single joint teaches nothing about any other pose.
    """
    angles, _ = joint_angle_features(character, motion)
    rows = angles[motion.part == TRAIN, 0].astype(np.float64)
    rank = int(np.linalg.matrix_rank(rows - rows.mean(axis=0), tol=1e-4 * np.sqrt(rows.size)))
    if rank < 2:
        bad_input(
            character.name, "poses", expected="joint angles of rank 2 or more over the frames", got=f"rank {rank}"
        )


def bake_sequence(
    sequence: MeshSequence, settings: TrainSettings, store: Path, *, name: str = "sequence", track: Track = no_tracking
) -> tuple[TrainingData, BakeStatistics]:
    """The same for a mesh sequence without a skeleton; its feature matrix drives the model as it is.

    Raises:
      InputError: if a feature or vertex is not finite, or no feature varies over the training frames.
    """
    frames = sequence_frames(sequence)
    num_frames, num_vertices = sequence.vertices.shape[:2]
    part = np.full(num_frames, TRAIN)
    part[int(np.ceil(num_frames * (1.0 - settings.split.segment_share))) :] = SEGMENT
    raw = np.asarray(sequence.features, np.float32)[:, None, :]
    if (part == TRAIN).sum() < 2:
        bad_input(name, "frames", expected="at least 2 to train on", got=int((part == TRAIN).sum()))
    if not np.ptp(raw[part == TRAIN], axis=0).max() > 0:
        bad_input(name, "features", expected="at least one column that varies", got="constant columns only")
    empty = jnp.zeros(0, jnp.int32)
    basis = FeatureBasis(
        kind="given", size=1.0, joints=empty, bones=jnp.zeros(1, jnp.int32), falloff=jnp.zeros((1, 0)),
        reference=jnp.zeros((0, 4)), translations=jnp.zeros((0, 3)), mean=jnp.zeros((1, 0)), basis=jnp.zeros((1, 0, 0)),
    )  # fmt: skip
    vertices = np.arange(num_vertices)
    arrays = (sequence.vertices, sequence.frames, sequence.faces)
    source = _source_hash(name, [np.asarray(array) for array in arrays])
    return _bake(
        name, frames, sequence.faces, ShadingPoints(vertices, vertices), np.zeros(num_vertices, np.int32), raw, basis,
        part, np.zeros(num_frames, int), source, {"mesh sequence": name}, settings, store, track,
    )  # fmt: skip


def character_identity(character: Character) -> str:
    """Name and hash, for messages."""
    return f"{character.name} {character.content_hash[:12]}"


def _bake(name, frames, faces, points, groups, raw, basis, part, clip, source, run, settings, store_path, track):
    # The fit does not matter to the bake.
    run = {**run, "bake": dataclasses.asdict(settings.bake), "split": dataclasses.asdict(settings.split)}
    store = VisibilityStore(
        store_path, num_frames=len(part), num_points=len(points.vertices), bake=settings.bake, source=source, run=run
    )
    statistics = bake(store, frames, faces, points.vertices, settings.bake, track=track)
    bits = store.read()
    visible = mean_visibility(bits[part == TRAIN], settings.bake.num_directions).mean(axis=0) >= INVISIBLE_BELOW
    if not visible.any():
        bad_input(name, "vertices", expected="some that see out of the mesh", got="every vertex inside")
    data = TrainingData(
        name,
        points,
        groups,
        bits,
        raw,
        basis,
        np.asarray(part),
        np.asarray(clip),
        settings.bake.num_directions,
        visible,
    )
    return data, statistics


def _source_hash(name: str, arrays: list[np.ndarray]) -> str:
    digest = hashlib.sha256(name.encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
