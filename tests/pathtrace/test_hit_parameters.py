"""Hits recomputed in the plane of a triangle that is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace.hit_parameters import hit_parameters
from tests.support import oracles


def rays_at_triangles(rng, count, size=1.0, distance=5.0):
    """Corners, origins, directions, and the (u, v) that they meet at t = 1, in float64."""
    corners = rng.uniform(-1, 1, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    u, v = np.sort(rng.uniform(0, 1, (2, count)), axis=0)
    uv = np.stack([u, v - u], axis=-1)
    weights = np.concatenate([1 - v[:, None], uv], axis=-1)
    target = np.einsum("nk,nkj->nj", weights, corners)
    origins = target + distance * oracles.unit(rng.normal(size=(count, 3)))
    return corners, origins, target - origins, uv


def test_the_point_is_on_the_ray_and_on_the_face(rng, x64):
    corners, origins, directions, uv = rays_at_triangles(rng, 500)
    t, got = jax.jit(hit_parameters)(corners, origins, directions)
    np.testing.assert_allclose(t, 1, rtol=1e-9)
    np.testing.assert_allclose(got, uv, atol=1e-9)


def test_float32_keeps_six_digits(rng):
    """Triangles a hundredth of their distance; faces met at 6 degrees or steeper."""
    corners, origins, directions, _ = rays_at_triangles(rng, 2000, size=0.05)
    normal = oracles.unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    steep = np.abs(np.sum(normal * oracles.unit(directions), axis=-1)) > 0.1
    arrays = [x[steep].astype(np.float32) for x in (corners, origins, directions)]
    t, _ = hit_parameters(*arrays)
    with jax.enable_x64(True):
        exact, _ = hit_parameters(*(x.astype(np.float64) for x in arrays))
    assert steep.sum() > 1000
    np.testing.assert_allclose(t, exact, rtol=2e-5)


def test_gradients_are_those_of_differences(rng, x64):
    arguments = rays_at_triangles(rng, 20)[:3]
    weights = rng.normal(size=(20, 3))

    def loss(*x):
        t, uv = hit_parameters(*x)
        return jnp.sum(weights * jnp.concatenate([t[:, None], uv], axis=-1))

    slopes = jax.grad(loss, argnums=(0, 1, 2))(*arguments)
    for n, (x, slope) in enumerate(zip(arguments, slopes, strict=True)):
        step, h = rng.normal(size=x.shape), 1e-6
        up, down = (loss(*arguments[:n], x + s * h * step, *arguments[n + 1 :]) for s in (1, -1))
        np.testing.assert_allclose(jnp.sum(slope * step), (up - down) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize("kind", ["parallel", "no area"])
def test_nothing_to_hit_has_finite_values_and_gradients(kind):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    if kind == "no area":
        corners[2] = corners[1]
    arguments = corners, np.array([0.1, 0.2, 1], np.float32), np.array([1, 0, 0], np.float32)
    t, uv = hit_parameters(*arguments)
    assert t == 0 and np.isfinite(uv).all()
    slopes = jax.grad(lambda *x: jnp.sum(jnp.stack(jax.tree.leaves(hit_parameters(*x))[:1])), argnums=(0, 1, 2))
    assert all(np.isfinite(s).all() for s in slopes(*arguments))


def test_any_leading_axes(rng, x64):
    corners, origins, directions, _ = rays_at_triangles(rng, 6)
    flat = hit_parameters(corners, origins, directions)
    shaped = hit_parameters(*(x.reshape(2, 3, *x.shape[1:]) for x in (corners, origins, directions)))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b.reshape(a.shape)), flat, shaped)
