"""Pose -> feature vector: builds the basis that the model keeps (kernels: jaxrender.harmonics.pose_model)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from fitting.motion import Motion, articulating_joints, influencing_joints, skeleton_distances
from jaxrender.animation.skeleton import global_matrices
from jaxrender.animation.skinning import Character
from jaxrender.checks import bad_input
from jaxrender.harmonics.pose_model import FeatureBasis, FeatureKind, raw_features


def feature_groups(
    character: Character, points: Int[np.ndarray, " p"], kind: str
) -> tuple[Int[np.ndarray, " g"], Int[np.ndarray, " p"]]:
    """The bones that have points of their own, and the group of each point: the bone of its largest weight."""
    if kind != "surroundings":
        return np.zeros(1, np.int32), np.zeros(len(points), np.int32)
    skin = character.skin
    strongest = np.argmax(np.asarray(skin.weights)[points], axis=1)
    entry = np.take_along_axis(np.asarray(skin.joint_indices)[points], strongest[:, None], axis=1)[:, 0]
    bones, groups = np.unique(np.asarray(skin.palette_joints)[entry], return_inverse=True)
    return bones.astype(np.int32), groups.reshape(-1).astype(np.int32)


def unfitted_basis(
    character: Character, motion: Motion, kind: FeatureKind, bones: Int[np.ndarray, " g"]
) -> FeatureBasis:
    """The basis without its principal axes.

    Raises:
      InputError: if no joint articulates in the training frames.
    """
    joints = influencing_joints(character) if kind == "surroundings" else articulating_joints(character)
    moving = _moving_joints(motion)
    if not len(np.intersect1d(articulating_joints(character), moving)):
        got = f"0 of {len(character.skeleton.names)}"
        bad_input(character.name, "active joints", expected="at least one joint that bends the body", got=got)
    if kind != "surroundings":
        joints = np.intersect1d(joints, moving)
    size = float(np.ptp(np.asarray(character.skin.vertices), axis=0).max()) or 1.0
    train = np.flatnonzero(motion.where(0))
    distance = skeleton_distances(character.skeleton)[np.ix_(bones, joints)]
    # Mean rotation per joint, signs aligned with the first frame's; the middle of the motion is farthest from ±π.
    rotations = np.asarray(motion.pose.rotation)[train][:, joints]
    sign = np.sign(np.sum(rotations * rotations[:1], axis=-1, keepdims=True))
    mean = np.sum(np.where(sign == 0, 1.0, sign) * rotations, axis=0)
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-9)
    return FeatureBasis(
        kind=kind,
        size=size,
        joints=jnp.asarray(joints, jnp.int32),
        bones=jnp.asarray(bones, jnp.int32),
        falloff=jnp.asarray(np.exp(-3.5 * distance / size), jnp.float32),
        reference=jnp.asarray(mean, jnp.float32),
        translations=jnp.asarray(np.asarray(motion.pose.translation)[train][:, joints].mean(axis=0), jnp.float32),
        mean=jnp.zeros((len(bones), 0)),
        basis=jnp.zeros((len(bones), 0, 0)),
    )


def _moving_joints(motion: Motion) -> Int[np.ndarray, " j"]:
    """Joints whose local transform changes by more than rounding in the training frames."""
    train = np.flatnonzero(motion.where(0))
    spread = sum(np.ptp(np.asarray(values)[train], axis=0).max(axis=-1) for values in jax.tree.leaves(motion.pose))
    return np.flatnonzero(spread > 1e-5)


def all_raw_features(basis: FeatureBasis, character: Character, motion: Motion) -> Float[np.ndarray, "f g n"]:
    """Raw features of every frame."""
    parents = character.skeleton.parents
    one = jax.jit(lambda pose: raw_features(basis, pose, global_matrices(pose, parents=parents)))
    frames = range(len(motion))
    return np.stack([np.asarray(one(jax.tree.map(lambda values, i=i: values[i], motion.pose))) for i in frames])


def joint_angle_features(character: Character, motion: Motion) -> tuple[Float[np.ndarray, "f 1 n"], FeatureBasis]:
    """Exponential-map features of every frame, one group for all points, and their unfitted basis."""
    basis = unfitted_basis(character, motion, "exponential_map", np.zeros(1, np.int32))
    return all_raw_features(basis, character, motion), basis


def fit_basis(
    basis: FeatureBasis, raw: Float[np.ndarray, "f g n"], weights: Float[np.ndarray, " f"], num_components: int
) -> tuple[FeatureBasis, Float[np.ndarray, "g k"]]:
    """Principal axes of the weighted training poses, group by group.

    Args:
      weights: per frame; 0 keeps a frame out.
    Returns:
      the basis, and the weighted second moment of each component, Σ_f w_f a_f² (0 for components beyond the rank,
      whose axes are 0 as well).
    """
    used = weights > 0
    w, rows = weights[used], raw[used].astype(np.float64)
    _, num_groups, width = raw.shape
    k = min(num_components, width, max(len(rows) - 1, 1))
    mean = np.einsum("f,fgn->gn", w, rows) / w.sum()
    axes, moments = np.zeros((num_groups, width, k)), np.zeros((num_groups, k))
    for g in range(num_groups):
        scaled = np.sqrt(w)[:, None] * (rows[:, g] - mean[g])
        # The smaller Gram matrix instead of an SVD: ten times faster here, and in float64 exact far below the cut.
        wide = len(rows) < width
        values, vectors = np.linalg.eigh(scaled @ scaled.T if wide else scaled.T @ scaled)
        values, vectors = values[::-1][:k], vectors[:, ::-1][:, :k]
        rank = int((values > 1e-12 * max(values[0], 1e-30)).sum())
        directions = scaled.T @ vectors[:, :rank] / np.sqrt(values[:rank]) if wide else vectors[:, :rank]
        axes[g, :, :rank], moments[g, :rank] = directions, values[:rank]
    fitted = dataclasses.replace(basis, mean=jnp.asarray(mean, jnp.float32), basis=jnp.asarray(axes, jnp.float32))
    return fitted, moments
