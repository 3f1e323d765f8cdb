"""The share of light that arrives, filtered: its exact cases, steps, colors, bias, and the rule for the radius."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace.shadow_ratio import filtered_ratio, ratio_radius, shadow_ratio

RATIO = jax.jit(shadow_ratio, static_argnames="radius")
EPS = jnp.asarray([1e-3, 1e-3], jnp.float32)


def ratio(arrived, unshadowed, *, radius, channels=None):
    channels = np.zeros((*np.shape(arrived)[:2], 2)) if channels is None else channels
    arrays = (jnp.asarray(x, jnp.float32) for x in (arrived, unshadowed, channels))
    return np.asarray(RATIO(*arrays, EPS, radius=radius))


@pytest.fixture
def light(rng):
    """What would arrive: noisy, with color and a bright corner."""
    values = rng.uniform(0.2, 1.0, (20, 24, 1)) * rng.uniform(0.5, 2.0, 3)
    values[:4, :4] *= 20.0
    return values


@pytest.mark.parametrize("radius", [0, 1, 3])
def test_without_an_occluder_it_is_1_and_in_full_shadow_0(light, radius, rng):
    channels = rng.uniform(size=(20, 24, 2))
    np.testing.assert_array_equal(ratio(light, light, radius=radius, channels=channels), 1.0)
    np.testing.assert_array_equal(ratio(0.0 * light, light, radius=radius, channels=channels), 0.0)


@pytest.mark.parametrize("radius", [0, 1, 3])
def test_where_no_light_would_arrive_it_is_1(radius):
    np.testing.assert_array_equal(ratio(np.zeros((6, 7, 3)), np.zeros((6, 7, 3)), radius=radius), 1.0)


def test_a_step_stays_a_step_without_a_filter(light):
    seen = np.ones_like(light)
    seen[:, 12:] = 0.0
    np.testing.assert_array_equal(ratio(seen * light, light, radius=0), seen)


@pytest.mark.parametrize("radius", [1, 3])
def test_a_filter_blurs_a_step_by_its_window_and_no_more(light, radius):
    """Two box means: beyond 2 r of the step nothing changes; a guide that shows the step keeps it."""
    seen = np.ones_like(light)
    seen[:, 12:] = 0.0
    blurred = ratio(seen * light, light, radius=radius)
    assert (blurred[:, : 12 - 2 * radius] > 1.0 - 1e-5).all() and (blurred[:, 12 + 2 * radius :] < 1e-5).all()
    assert (blurred[:, 11] < 0.95).all() and (blurred[:, 12] > 0.05).all()
    guide = np.repeat(seen[..., :1], 2, axis=-1)
    kept = ratio(seen * 0.5, np.full_like(light, 0.5), radius=radius, channels=guide)
    assert np.abs(kept - seen).max() < 0.02


@pytest.mark.parametrize("radius", [0, 2])
def test_gray_stays_gray_and_colors_are_apart(light, radius, rng):
    shade = rng.uniform(size=(20, 24, 1))
    gray = np.repeat(light[..., :1], 3, axis=-1)
    found = ratio(shade * gray, gray, radius=radius)
    np.testing.assert_allclose(found - found[..., :1], 0.0, atol=1e-6)
    colored = ratio(shade * gray * [1.0, 0.5, 0.0], gray, radius=radius)
    np.testing.assert_allclose(colored[..., 1], 0.5 * found[..., 0], atol=1e-5)
    assert (colored[..., 2] == 0.0).all()


def test_it_lies_within_0_and_1_for_any_images(rng):
    found = ratio(rng.normal(size=(9, 9, 3)), rng.normal(size=(9, 9, 3)), radius=2, channels=rng.normal(size=(9, 9, 2)))
    assert (found >= 0.0).all() and (found <= 1.0).all() and np.isfinite(found).all()


def test_random_shadows_of_a_constant_share_are_found_without_bias(rng):
    """A quarter of the lamp is hidden; noise of the light itself cancels between the two images."""
    light = rng.uniform(0.5, 1.5, (64, 64, 1)) * np.ones(3)
    seen = rng.uniform(size=(64, 64, 1)) < 0.75
    found = ratio(seen * light, light, radius=3)
    # 4096 / 49 windows' worth of independent means of 49 draws; the ratio's own bias is of 1/49 of its variance.
    deviation = np.sqrt(0.75 * 0.25 / 4096 * (1.0 + 1.0 / 12.0))
    assert abs(found.mean() - 0.75) < 4.0 * deviation + 0.002
    assert found.std() < 0.5 * np.sqrt(0.75 * 0.25 / 9)


def test_the_noise_of_light_that_is_not_hidden_cancels(rng):
    """What the division is for: behind half a veil the ratio is exact, though the light varies twentyfold."""
    light = np.exp(rng.normal(size=(16, 16, 3)))
    np.testing.assert_allclose(ratio(0.5 * light, light, radius=2), 0.5, atol=1e-5)


@pytest.mark.parametrize(
    ("group", "rays", "radius"),
    [("area", 1, 3), ("area", 2, 2), ("area", 4, 1), ("area", 16, 1), ("area", 1000, 1), ("environment", 1, 12),
     ("environment", 4, 6), ("environment", 16, 3), ("environment", 10_000, 1)],
)  # fmt: skip
def test_the_rule_for_the_radius(group, rays, radius):
    assert ratio_radius(rays, group=group) == radius


def test_the_ratio_of_a_picture_has_its_guides_and_its_radius(rng):
    """With flat guides it is `shadow_ratio` without any."""
    light = rng.uniform(0.5, 1.0, (12, 14, 3)).astype(np.float32)
    arrived = (light * (rng.uniform(size=(12, 14, 1)) < 0.5)).astype(np.float32)
    flat = {"normal": np.tile(np.float32([0, 0, 1]), (12, 14, 1)), "depth": np.ones((12, 14, 1), np.float32),
            "ao": np.ones((12, 14, 1), np.float32)}  # fmt: skip
    found = filtered_ratio(arrived, light, **flat, radius=2)
    np.testing.assert_allclose(found, ratio(arrived, light, radius=2), atol=1e-5)


def test_gradients_are_those_of_finite_differences(rng, x64):
    arrived, more = rng.uniform(0.2, 0.5, (2, 5, 6, 3))
    channels, mix = jnp.asarray(rng.uniform(size=(5, 6, 2))), rng.normal(size=(5, 6, 3))
    value = jax.jit(
        lambda a, u: jnp.sum(shadow_ratio(a, u, channels, jnp.asarray([0.02, 0.03]), radius=1) * jnp.asarray(mix))
    )
    a, u = jnp.asarray(arrived), jnp.asarray(arrived + more)
    slopes = jax.grad(value, argnums=(0, 1))(a, u)
    step, h = rng.normal(size=(2, 5, 6, 3)), 1e-6
    there, back = (value(a + s * h * step[0], u + s * h * step[1]) for s in (1.0, -1.0))
    along = sum(float(jnp.sum(g * s)) for g, s in zip(slopes, step, strict=True))
    np.testing.assert_allclose(along, (there - back) / (2.0 * h), rtol=1e-6)
