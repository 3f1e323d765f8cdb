"""Interpolation modes, the pull model and gradients, against float64 planes and finite differences."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.raster import rasterize
from jaxrender.deferred.samples import CENTER, ordered_grid, standard_pattern
from tests.deferred.oracle import snap

# The package has a function of that name.
ip = importlib.import_module("jaxrender.deferred.interpolate")

SIZE = {"height": 20, "width": 24}
NDC = np.array([(-0.8, -0.7), (0.9, -0.4), (-0.1, 0.85), (0.95, 0.9)])
W = np.array([0.7, 3.0, 1.3, 2.0])
FACES = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
VALUES = np.array([[1.0, -2.0], [4.0, 0.5], [-1.0, 3.0], [2.0, 2.0]], np.float32)
LAYOUTS = {"center": CENTER, "grid": ordered_grid(2), "msaa8": standard_pattern(8)}


def clip_of(ndc=NDC, w=W):
    z = np.array([0.2, 0.8, 0.5, 0.6])
    return np.concatenate([ndc * w[:, None], (z * w)[:, None], w[:, None]], axis=1).astype(np.float32)


def scene(samples=CENTER):
    return rasterize(jnp.asarray(clip_of()), jnp.asarray(FACES), **SIZE, samples=samples)


def expected_at(triangle, x, y, *, mode, grid=1):
    """float64 value of a triangle's plane at a place given in snapped units."""
    xy = snap(clip_of(), height=SIZE["height"] * grid, width=SIZE["width"] * grid).astype(np.float64)
    face = FACES[triangle]
    matrix = np.concatenate([xy[face], np.ones((3, 1))], axis=1).T
    screen = np.linalg.solve(matrix, [x, y, 1.0])
    w, values = W[face], VALUES[face].astype(np.float64)
    if mode == "flat_first":
        return values[0]
    if mode == "flat_last":
        return values[2]
    weights = screen / w if mode == "perspective" else screen
    return weights @ values / weights.sum()


def check(got, fragments, x, y, *, mode, tolerance=3e-5):
    ids = np.asarray(fragments.triangle_id)
    x, y, got = (np.asarray(a) for a in (x, y, got))
    assert (ids >= 0).sum() > 150
    for at in np.argwhere(ids >= 0)[::7]:
        at = tuple(at)
        expected = expected_at(ids[at], x[at], y[at], mode=mode, grid=fragments.samples.grid)
        np.testing.assert_allclose(got[at], expected, atol=tolerance)
    assert (got[ids < 0] == 0).all()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("mode", ip.MODES)
def test_modes_at_samples(layout, mode):
    fragments = scene(LAYOUTS[layout])
    check(ip.interpolate(fragments, jnp.asarray(VALUES), mode=mode), fragments, *ip.sample_places(fragments), mode=mode)


def test_sample_places_are_those_of_the_layout():
    fragments = scene(LAYOUTS["msaa8"])
    x, y = ip.sample_places(fragments)
    offsets = np.array(standard_pattern(8).offsets)
    np.testing.assert_array_equal(x[3, 5], (5 - 12) * 256 + 128 + 16 * offsets[:, 0])
    np.testing.assert_array_equal(y[3, 5], (3 - 10) * 256 + 128 + 16 * offsets[:, 1])
    grid = scene(LAYOUTS["grid"])
    x, y = ip.sample_places(grid)
    np.testing.assert_array_equal(x[3, 5], (5 - 12) * 512 + np.array([128, 384, 128, 384]))
    np.testing.assert_array_equal(y[3, 5], (3 - 10) * 512 + np.array([128, 128, 384, 384]))


def test_noperspective_behind_the_eye_is_the_plane_of_the_projected_corners():
    """One corner behind the eye: the value is linear on the screen still, with the corner's mirrored projection."""
    w = np.array([0.7, 3.0, -0.5])
    ndc = np.array([(-0.8, -0.7), (0.9, -0.4), (0.3, -2.0)])
    clip = np.concatenate([ndc * w[:, None], np.array([0.2, 2.0, -0.3])[:, None], w[:, None]], 1).astype(np.float32)
    fragments = rasterize(jnp.asarray(clip), jnp.asarray([[0, 1, 2]]), **SIZE)
    got = np.asarray(ip.interpolate(fragments, jnp.asarray(VALUES[:3]), mode="noperspective"))[..., 0, :]
    covered = np.asarray(fragments.coverage)[..., 0]
    assert covered.sum() > 60
    y, x = np.argwhere(covered).T
    at = np.stack([(x + 0.5) / 12 - 1, 1 - (y + 0.5) / 10, np.ones(len(x))])
    screen = np.linalg.solve(np.concatenate([ndc, np.ones((3, 1))], 1).T, at)
    np.testing.assert_allclose(got[covered], screen.T @ VALUES[:3], atol=2e-2)


@pytest.mark.parametrize("offset", [(0, 0), (-8, 7), (3, -5), (8, 0), (19, -24)])
def test_pull_model_at_an_offset(offset):
    fragments = scene(LAYOUTS["msaa8"])
    got = ip.interpolate_at_offset(fragments, jnp.asarray(VALUES), jnp.asarray(offset))
    wrapped = [(o + 8) % 16 - 8 for o in offset]
    y, x, _ = np.indices(fragments.triangle_id.shape)
    x, y = (x - 12) * 256 + 128 + 16 * wrapped[0], (y - 10) * 256 + 128 + 16 * wrapped[1]
    check(got, fragments, x, y, mode="perspective", tolerance=2e-4)


def test_pull_model_at_a_sample():
    fragments = scene(LAYOUTS["msaa8"])
    x, y = ip.sample_places(fragments)
    for index in (0, 5):
        got = ip.interpolate_at_sample(fragments, jnp.asarray(VALUES), index, mode="noperspective")
        places = (np.broadcast_to(np.asarray(a)[..., index, None], a.shape) for a in (x, y))
        check(got, fragments, *places, mode="noperspective", tolerance=2e-4)


@pytest.mark.parametrize("mask", [None, [1, 1, 0, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0, 1, 1]])
def test_centroid_is_direct3ds(mask):
    fragments = scene(LAYOUTS["msaa8"])
    mask_array = None if mask is None else np.array(mask, bool)
    x, y = (np.asarray(a) for a in ip.centroids(fragments, sample_mask=mask_array))
    places = [np.asarray(a) for a in ip.sample_places(fragments)]
    ids = np.asarray(fragments.triangle_id)
    used = np.ones(8, bool) if mask_array is None else mask_array
    partly = 0
    for r, c in np.ndindex(ids.shape[:2]):
        for s in range(8):
            own = ids[r, c] == ids[r, c, s]
            counted = own & used
            if own.all() or (not counted.any() and used.all()):
                expected = (c - 12) * 256 + 128, (r - 10) * 256 + 128
            else:
                first = np.argmax(counted) if counted.any() else np.argmax(used)
                expected = places[0][r, c, first], places[1][r, c, first]
                partly += 1
            assert (x[r, c, s], y[r, c, s]) == expected
    assert partly > 50
    got = ip.interpolate_at_centroid(fragments, jnp.asarray(VALUES), sample_mask=mask_array)
    check(got, fragments, x, y, mode="perspective", tolerance=2e-4)


@pytest.mark.parametrize("layout", ["center", "grid"])
def test_attribute_gradients_are_those_of_the_plane(layout):
    fragments = scene(LAYOUTS[layout])
    dx, dy = (np.asarray(a) for a in ip.attribute_gradients(fragments, jnp.asarray(VALUES)))
    ids, m = np.asarray(fragments.triangle_id), fragments.samples.grid
    x, y = (np.asarray(a) for a in ip.sample_places(fragments))
    for at in np.argwhere(ids >= 0)[::11]:
        at = tuple(at)
        value = lambda u, v, at=at: expected_at(ids[at], x[at] + u, y[at] + v, mode="perspective", grid=m)  # noqa: E731
        h = 1.0
        scale = 256.0 * m / (2 * h)
        np.testing.assert_allclose(dx[at], (value(h, 0) - value(-h, 0)) * scale, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(dy[at], (value(0, h) - value(0, -h)) * scale, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("mode", ["perspective", "noperspective"])
def test_gradients_to_clip_positions(mode):
    """A loss over interpolated values, moved by each clip coordinate; coverage is held fixed."""
    fragments = scene()
    clip = clip_of()

    def loss(clip):
        weights = ip.differentiable_barycentrics(fragments, clip, mode=mode)
        return jnp.sum(jnp.sin(ip.blend(fragments, jnp.asarray(VALUES), weights)))

    def exact(clip):
        """The same with float64 planes of the unsnapped corners."""
        ids = np.asarray(fragments.triangle_id)[..., 0]
        total, ndc, w = 0.0, clip[:, :2] / clip[:, 3:], clip[:, 3]
        for t, face in enumerate(FACES):
            y, x = np.argwhere(ids == t).T
            at = np.stack([(x + 0.5) / 12 - 1, 1 - (y + 0.5) / 10, np.ones(len(x))])
            screen = np.linalg.solve(np.concatenate([ndc[face], np.ones((3, 1))], 1).T, at)
            weights = screen / w[face, None] if mode == "perspective" else screen
            total += np.sin((weights / weights.sum(0)).T @ VALUES[face].astype(np.float64)).sum()
        return total

    np.testing.assert_allclose(loss(jnp.asarray(clip)), exact(clip.astype(np.float64)), rtol=0.02)
    slope = np.asarray(jax.grad(loss)(jnp.asarray(clip)))
    for v, i in np.ndindex(4, 4):
        h = np.zeros((4, 4))
        h[v, i] = 1e-4
        expected = (exact(clip + h) - exact(clip - h)) / 2e-4
        np.testing.assert_allclose(slope[v, i], expected, rtol=0.02, atol=0.3)


def test_gradients_to_attributes():
    fragments = scene()
    slope = jax.grad(lambda a: jnp.sum(ip.interpolate(fragments, a) ** 2))(jnp.asarray(VALUES))
    towards = np.random.default_rng(0).normal(size=VALUES.shape).astype(np.float32)
    f = lambda t: float(jnp.sum(ip.interpolate(fragments, jnp.asarray(VALUES + t * towards)) ** 2))  # noqa: E731
    np.testing.assert_allclose(np.sum(np.asarray(slope) * towards), (f(0.01) - f(-0.01)) / 0.02, rtol=2e-3)
