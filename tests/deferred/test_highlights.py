"""The highlight metric against densities on a dense cone, and cases whose answer is known."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred import highlight_sample_count
from jaxrender.scene import DIRECTIONAL, Lights
from jaxrender.srgb import encode_srgb
from tests.support import oracles

EYE = jnp.asarray([0.0, 0.0, 3.0])


def sun(towards, irradiance: float = 1.0) -> Lights:
    one = jnp.ones(1, jnp.float32)
    direction = -np.asarray(towards, np.float32) / np.linalg.norm(towards)
    return Lights(
        kind=jnp.full(1, DIRECTIONAL, jnp.int32), position=jnp.zeros((1, 3)), direction=jnp.asarray(direction)[None],
        intensity=irradiance * jnp.ones((1, 3)), range=jnp.inf * one, cos_inner=-one, cos_outer=-one,
    )  # fmt: skip


def cone(half_angle: float, axis=(0.0, 0.0, 1.0), n: int = 9) -> np.ndarray:
    """The axis and normals on the rim, opposite each other."""
    axis = oracles.unit(np.asarray(axis, float))
    across = oracles.unit(np.cross(axis, [0.3, 1.0, 0.2]))
    turn = 2.0 * np.pi * np.arange(n - 1) / (n - 1)
    side = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * np.cross(axis, across)
    return np.concatenate([[axis], np.cos(half_angle) * axis + np.sin(half_angle) * side]).astype(np.float32)


def count(normals, light: Lights, *, roughness: float = 0.4, first: float = 0.1, **options) -> float:
    arrays = jnp.asarray(normals), jnp.zeros(3), jnp.float32(roughness), jnp.float32(first)
    return float(highlight_sample_count(*arrays, light, EYE, scale=jnp.float32(16.0), **options))


@pytest.mark.parametrize("towards", [(0.0, 0.0, 1.0), (1.0, 0.2, 1.0), (0.2, -0.3, 1.0)])
@pytest.mark.parametrize("half_angle", [0.02, 0.2])
def test_the_range_is_that_of_all_normals_in_the_cone(towards, half_angle):
    """Trowbridge-Reitz at a hundred thousand normals inside, in float64."""
    rng = np.random.default_rng(4)
    z = rng.uniform(np.cos(half_angle), 1.0, 100_000)
    turn = rng.uniform(0.0, 2.0 * np.pi, z.shape)
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=-1)
    half = oracles.unit(oracles.unit(np.asarray(towards, float)) + [0.0, 0.0, 1.0])
    alpha2 = 0.4**4
    density = alpha2 / (np.pi * (1.0 + (normals @ half) ** 2 * (alpha2 - 1.0)) ** 2)
    brighter = 0.1 + 0.04 * np.ptp(density) / 4.0
    expected = 16.0 * float(encode_srgb(np.asarray(brighter)) - encode_srgb(np.asarray(0.1)))
    assert abs(count(cone(half_angle), sun(towards)) - expected) < 0.02 * expected + 1e-3


def test_one_normal_has_no_range():
    assert count(np.tile(cone(0.0)[:1], (4, 1)), sun((0.3, 0.0, 1.0))) == 0.0
    covered = jnp.asarray([True] + [False] * 8)
    assert count(cone(0.3), sun((0.3, 0.0, 1.0)), covered=covered) == 0.0


def test_a_light_behind_has_no_highlight():
    assert count(cone(0.1), sun((0.2, 0.0, -1.0))) == 0.0
    assert count(cone(0.1), sun((0.2, 0.0, 1.0))) > 0.0


def test_rough_surfaces_and_bright_ones_need_fewer():
    """A wide lobe hardly changes, and the eye sees the same step less beside more light."""
    smooth, rough = (count(cone(0.05), sun((0.2, 0.0, 1.0)), roughness=r) for r in (0.3, 0.9))
    dim, bright = (count(cone(0.05), sun((0.2, 0.0, 1.0)), first=first) for first in (0.02, 0.5))
    assert smooth > 10.0 * rough and dim > bright
