"""Training data made up: one round occluder that moves with the pose before each point."""

import jax.numpy as jnp
import numpy as np

from fitting.dataset import ShadingPoints
from fitting.motion import MIXED, SEGMENT, TRAIN
from fitting.training_data import TrainingData
from jaxrender.harmonics.pose_model import FeatureBasis
from jaxrender.harmonics.visibility import hemisphere_directions

NUM_DIRECTIONS, NUM_POINTS, NUM_JOINTS = 64, 9, 4
PART = np.array([TRAIN] * 28 + [SEGMENT] * 7 + [MIXED] * 5)


def made_up_features(turns, num_groups, scale):
    """Nine numbers per joint from two pose angles, each group seeing them with factors of its own."""
    rng = np.random.default_rng(3)
    mix = rng.normal(size=(num_groups, turns.shape[1] * 2, 9 * NUM_JOINTS)) * scale
    latent = np.concatenate([turns, np.cos(turns)], axis=1)
    return np.einsum("fi,gin->fgn", latent, mix).astype(np.float32)


def made_up_basis(kind, num_groups):
    joints = jnp.arange(NUM_JOINTS, dtype=jnp.int32)
    distance = np.linspace(0.0, 1.0, num_groups * NUM_JOINTS).reshape(num_groups, NUM_JOINTS)
    return FeatureBasis(
        kind=kind,
        size=2.0,
        joints=joints,
        bones=jnp.arange(num_groups, dtype=jnp.int32),
        falloff=jnp.asarray(np.exp(-3.5 * distance), jnp.float32),
        reference=jnp.zeros((NUM_JOINTS, 4)),
        translations=jnp.zeros((NUM_JOINTS, 3)),
        mean=jnp.zeros((num_groups, 0)),
        basis=jnp.zeros((num_groups, 0, 0)),
    )


def made_up_data():
    rng = np.random.default_rng(7)
    t = np.linspace(0.0, 3.0, len(PART))
    turns = np.stack([0.9 * np.sin(t), 0.7 * np.cos(1.3 * t)], axis=1)
    tilt = np.linspace(-0.6, 0.6, NUM_POINTS)
    at = np.stack([np.sin(turns[:, :1] + tilt), np.sin(turns[:, 1:] - tilt), np.full((len(t), NUM_POINTS), 0.8)], -1)
    at /= np.linalg.norm(at, axis=-1, keepdims=True)
    free = at @ hemisphere_directions(NUM_DIRECTIONS).T < np.cos(rng.uniform(0.4, 0.8, NUM_POINTS))[:, None]
    visible = np.arange(NUM_POINTS) != 4
    free[:, 4] = False
    return TrainingData(
        name="made up",
        points=ShadingPoints(np.arange(NUM_POINTS), np.arange(NUM_POINTS)),
        groups=np.repeat([0, 1], [5, 4]).astype(np.int32),
        bits=np.packbits(free, axis=-1),
        raw=made_up_features(turns, 2, 1.0),
        basis=made_up_basis("surroundings", 2),
        part=PART,
        clip=np.where(PART == MIXED, -1, np.arange(len(PART)) % 2),
        num_directions=NUM_DIRECTIONS,
        visible=visible,
    )
