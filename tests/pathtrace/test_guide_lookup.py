"""The most similar guide ray against a plain loop, and the cases where the equations do not decide."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace import guide_lookup
from jaxrender.pathtrace.guide_lookup import DEPTH_FLOOR, NORMAL_FLOOR, TIE
from tests.support import oracles

LOOK_UP = jax.jit(guide_lookup)


def brute_force(normal, depth, places, sample_normal, sample_depth):
    """Eqs. 3-5 in order: (row, column) with the largest s, then the largest s_N, then the nearest centre."""
    height, width = depth.shape[:2]
    found = []
    for (x, y), n, (d,) in zip(places, sample_normal, sample_depth, strict=True):
        corners = [
            (int(np.clip(np.floor(y - 0.5) + j, 0, height - 1)), int(np.clip(np.floor(x - 0.5) + i, 0, width - 1)))
            for j in (0, 1)
            for i in (0, 1)
        ]
        apart = np.array([np.linalg.norm(n - normal[c]) for c in corners])
        behind = np.array([abs(d - depth[c][0]) for c in corners])
        s_n = 1.0 - apart / max(apart.max(), NORMAL_FLOOR)
        s_d = 1.0 - behind / max(behind.max(), DEPTH_FLOOR * abs(d))
        away = [np.hypot(c[1] + 0.5 - x, c[0] + 0.5 - y) for c in corners]
        seen = [normal[c].any() for c in corners]
        best = np.flatnonzero(seen) if any(seen) else np.arange(4)
        for score in (s_n * s_d if any(seen) else np.zeros(4), s_n, -np.square(away)):
            best = best[score[best] >= score[best].max() - TIE]
        found.append(corners[best[0]])
    return np.array(found)


def look_up(image, normal, depth, places, sample_normal, sample_depth):
    dtype = jnp.result_type(float)
    image, normal, depth, places, sample_normal, sample_depth = (
        jnp.asarray(x, dtype) for x in (image, normal, depth, places, sample_normal, sample_depth)
    )
    values, taken = LOOK_UP(
        image, normal, depth, places_px=places, sample_normal=sample_normal, sample_depth=sample_depth
    )
    return np.asarray(values), np.asarray(taken)


@pytest.mark.parametrize("size", [(9, 12), (2, 2), (1, 5), (5, 1), (1, 1)])
def test_it_is_that_of_a_loop(size, rng, x64):
    """Guides with and without a surface, places on the image and beyond its border."""
    height, width = size
    normal, depth = oracles.unit(rng.normal(size=(*size, 3))), rng.uniform(1.0, 4.0, (*size, 1))
    normal[rng.uniform(size=size) < 0.2] = 0.0
    n = 500
    places = rng.uniform([-1.0, -1.0], [width + 1.0, height + 1.0], (n, 2))
    sample_normal, sample_depth = oracles.unit(rng.normal(size=(n, 3))), rng.uniform(1.0, 4.0, (n, 1))
    # Half of them see nearly what some guide saw.
    row, column = rng.integers(0, height, n // 2), rng.integers(0, width, n // 2)
    sample_normal[: n // 2] = np.where(
        normal[row, column].any(-1, keepdims=True), normal[row, column], sample_normal[: n // 2]
    )
    sample_depth[: n // 2] = depth[row, column]
    places[: n // 2] = np.stack([column, row], axis=1) + rng.uniform(0.0, 1.0, (n // 2, 2))
    image = rng.normal(size=(*size, 4))
    values, taken = look_up(image, normal, depth, places, sample_normal, sample_depth)
    np.testing.assert_array_equal(taken, brute_force(normal, depth, places, sample_normal, sample_depth))
    np.testing.assert_array_equal(values, image[taken[:, 0], taken[:, 1]])


def four(normals, depths, sample_normal, sample_depth, place=(1.1, 1.2)):
    """(row, column) taken of 2 x 2 guides, in reading order."""
    image = np.arange(4.0).reshape(2, 2, 1)
    normal, depth = np.reshape(np.asarray(normals, float), (2, 2, 3)), np.reshape(np.asarray(depths, float), (2, 2, 1))
    values, _ = look_up(image, normal, depth, [place], [sample_normal], [[sample_depth]])
    return int(values[0, 0])


UP, SIDE, SLANT = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]


def test_each_similarity_decides_where_the_other_is_the_same():
    assert four([UP, SIDE, SIDE, SIDE], [2.0] * 4, UP, 2.0, place=(1.4, 1.4)) == 0
    assert four([UP] * 4, [5.0, 5.0, 2.0, 5.0], UP, 2.1) == 2


def test_equal_guides_go_by_the_nearest_centre():
    """max = 0 in both factors: they are 1 for all."""
    for place, expected in (((0.6, 0.7), 0), ((1.4, 0.7), 1), ((0.9, 1.4), 2), ((1.2, 1.3), 3)):
        assert four([UP] * 4, [2.0] * 4, UP, 2.0, place=place) == expected


def test_all_four_products_0_go_by_the_normal():
    """Each guide is farthest in normal or in depth: the one whose normal is nearer wins, though it is farther away."""
    assert four([UP, UP, SIDE, SIDE], [9.0, 9.0, 2.0, 2.0], UP, 2.0, place=(1.1, 1.4)) == 1
    assert four([SIDE, SIDE, UP, UP], [2.0, 2.0, 9.0, 9.0], UP, 2.0, place=(0.9, 0.6)) == 2


@pytest.mark.parametrize("seed", range(5))
def test_ties_hold_for_any_vectors_in_single_precision(seed):
    """1 - d / max d must count as 0 where d is the largest, whatever rounding makes of it."""
    rng = np.random.default_rng(seed)
    for _ in range(8):
        n, near, far = oracles.unit(rng.normal(size=(3, 3)))
        if np.linalg.norm(n - near) > np.linalg.norm(n - far):
            near, far = far, near
        a, b = rng.uniform(2.0, 3.0), rng.uniform(4.0, 9.0)
        assert four([near, near, far, far], [b, b, a, a], n, a + 0.2, place=(0.9, 1.4)) == 0


def test_rounding_of_depth_on_a_wall_does_not_decide():
    """A spread of 1e-6 is no difference: the centre that is nearest counts, not the one whose depth is equal."""
    depths = [2.0, 2.0 + 1e-6, 2.0 + 1e-6, 2.0 + 2e-6]
    assert four([UP] * 4, depths, UP, 2.0, place=(1.4, 1.4)) == 3
    # Nor does it beside a normal that differs by little more than its floor.
    tilted = oracles.unit(np.array([0.0, 2e-3, 1.0])).tolist()
    assert four([tilted, UP, tilted, tilted], depths, UP, 2.0, place=(0.6, 1.4)) == 1


def test_guides_without_a_surface_are_taken_only_if_all_are():
    nothing = [0.0, 0.0, 0.0]
    assert four([nothing, SIDE, nothing, nothing], [2.0, 9.0, 2.0, 2.0], UP, 2.0, place=(0.6, 1.4)) == 1
    assert four([nothing] * 4, [0.0] * 4, UP, 2.0, place=(0.6, 1.4)) == 2


@pytest.mark.parametrize(("place", "expected"), [((-3.0, 0.2), 0), ((9.0, 0.2), 1), ((0.2, 9.0), 2), ((9.0, 9.0), 3)])
def test_the_border_counts_beyond_it(place, expected):
    assert four([UP] * 4, [2.0] * 4, UP, 2.0, place=place) == expected


def test_at_a_centre_the_guide_itself_is_taken(rng):
    """The sample that is the guide ray: both its differences are 0."""
    normal, depth = oracles.unit(rng.normal(size=(6, 7, 3))), rng.uniform(1.0, 4.0, (6, 7, 1))
    row, column = (x.ravel() for x in np.mgrid[:6, :7])
    places = np.stack([column, row], axis=1) + 0.5
    _, taken = look_up(np.zeros((6, 7, 1)), normal, depth, places, normal[row, column], depth[row, column])
    np.testing.assert_array_equal(taken, np.stack([row, column], axis=1))


def test_the_gradient_goes_to_the_pixels_taken(rng):
    normal, depth = oracles.unit(rng.normal(size=(4, 5, 3))), rng.uniform(1.0, 4.0, (4, 5, 1))
    arrays = {
        "places_px": rng.uniform(0.0, 5.0, (30, 2)), "sample_normal": oracles.unit(rng.normal(size=(30, 3))),
        "sample_depth": rng.uniform(1.0, 4.0, (30, 1)),
    }  # fmt: skip
    arrays = {name: jnp.asarray(x, jnp.float32) for name, x in arrays.items()}
    mix = jnp.asarray(rng.normal(size=(30, 2)), jnp.float32)
    guides = jnp.asarray(normal, jnp.float32), jnp.asarray(depth, jnp.float32)
    objective = lambda image: jnp.sum(guide_lookup(image, *guides, **arrays)[0] * mix)  # noqa: E731
    slope = np.asarray(jax.grad(objective)(jnp.zeros((4, 5, 2))))
    _, taken = guide_lookup(jnp.zeros((4, 5, 2)), *guides, **arrays)
    expected = np.zeros((4, 5, 2))
    np.add.at(expected, tuple(np.asarray(taken).T), np.asarray(mix))
    np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-6)


def test_bad_shapes_are_refused():
    one = jnp.zeros((3, 3, 3))
    rest = {"sample_normal": jnp.zeros((4, 3)), "sample_depth": jnp.zeros((4, 1))}
    with pytest.raises(ValueError, match=r"places_px: expected shape \(..., 2\)"):
        guide_lookup(one, one, one[..., :1], places_px=jnp.zeros((4, 3)), **rest)
    with pytest.raises(ValueError, match="normal and image"):
        guide_lookup(one, one[:2], one[..., :1], places_px=jnp.zeros((4, 2)), **rest)
