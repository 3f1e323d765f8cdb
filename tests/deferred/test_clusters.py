"""Clusters against a greedy loop, windows whose surfaces are known, and laws of the greedy choice."""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.clusters import Clusters, cluster_samples, shading_slope
from jaxrender.deferred.sampling import index_matrix, sample_positions

FIELDS = ("normal", "position", "depth", "material_id", "covered", "slope")
FIRST = {size: int(np.argmin(index_matrix(size))) for size in range(1, 6)}


def _clusters(window: dict, normal_scale, plane_scale):
    def one(window):
        arrays = [window[name] for name in FIELDS]
        return cluster_samples(*arrays, normal_scale=normal_scale, plane_scale=plane_scale)

    return jax.vmap(one)(window)


# Compiling is nearly all of the time here.
_compiled = jax.jit(_clusters, compiler_options={"xla_backend_optimization_level": 0})


def run(windows: dict, *, normal_scale: float = 8.0, plane_scale: float = 300.0, kernel=_compiled) -> np.ndarray:
    """Each window by itself: batches are vmap's, but for the test of leading axes."""
    dtype = windows["depth"].dtype
    return np.asarray(kernel(windows, dtype.type(normal_scale), dtype.type(plane_scale)))


def flat(size: int, num: int = 1) -> dict:
    """A wall at depth 5 that fills the window, a millimetre to a sub-sample."""
    n = size**2
    place = np.concatenate([sample_positions(size) * size * 1e-3, np.full((n, 1), -5.0)], axis=1)
    return {
        "normal": np.tile(np.float32([0, 0, 1]), (num, n, 1)),
        "position": np.tile(place.astype(np.float32), (num, 1, 1)),
        "depth": np.full((num, n), 5.0, np.float32),
        "material_id": np.zeros((num, n), np.int32),
        "covered": np.ones((num, n), bool),
        "slope": np.zeros((num, 2), np.float32),
    }


def surfaces(rng, size: int, num: int, *, dtype=np.float32) -> dict:
    """Up to three bent surfaces and two materials to a window, some of which is empty; nothing lies near a tie."""
    shape = (num, size**2)
    patch = rng.integers(0, 3, shape)
    normal = np.take_along_axis(rng.normal(size=(num, 3, 3)), patch[..., None], axis=1)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True) + 0.1 * rng.normal(size=(*shape, 3))
    covered = rng.uniform(size=shape) < rng.choice([0.0, 0.5, 1.0, 1.0], size=(num, 1))
    return {
        "normal": (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(dtype),
        "position": (rng.normal(scale=0.1, size=(*shape, 3)) + patch[..., None]).astype(dtype),
        "depth": rng.uniform(4, 6, shape).astype(dtype),
        "material_id": (rng.uniform(size=shape) < 0.15).astype(np.int32),
        "covered": covered,
        "slope": rng.uniform(0, 2, (num, 2)).astype(dtype),
    }


def unlike(window: dict, i: int, taken: int, *, normal_scale: float, plane_scale: float) -> float:
    """Of a sub-sample and one that is taken, in float64; 1 makes a new cluster."""
    if window["material_id"][i] != window["material_id"][taken]:
        return math.inf
    normal, position = window["normal"].astype(float), window["position"].astype(float)
    apart = position[i] - position[taken]
    off = min(abs(apart @ normal[i]), abs(apart @ normal[taken])) / float(window["depth"][taken])
    place = sample_positions(math.isqrt(len(normal)))
    parts = [
        plane_scale * off,
        *(normal_scale * (normal[i] - normal[taken])),
        *(window["slope"].astype(float) * (place[i] - place[taken])),
    ]
    return math.hypot(*parts)


def greedy(window: dict, **scales) -> list[int]:
    """The first of the index matrix, then the most unlike, until none is more unlike than 1."""
    size = math.isqrt(len(window["depth"]))
    members = np.flatnonzero(window["covered"]).tolist()
    by_turn = np.argsort(index_matrix(size).ravel()).tolist()
    taken = [next(i for i in by_turn if i in members)] if members else []
    while taken:
        distance = [min(unlike(window, i, k, **scales) for k in taken) for i in members]
        if max(distance) <= 1.0:
            break
        taken.append(members[int(np.argmax(distance))])
    owner = [-1] * size**2
    for i in members:
        owner[i] = min(taken, key=lambda k: unlike(window, i, k, **scales))
    return owner


def each(windows: dict):
    """The windows of a batch."""
    return ({name: values[i] for name, values in windows.items()} for i in range(len(windows["depth"])))


# --- Against the loop, and its laws


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_it_is_the_greedy_loop(size, dtype, rng):
    windows = surfaces(rng, size, 30, dtype=dtype)
    for scales in ({"normal_scale": 3.0, "plane_scale": 20.0}, {"normal_scale": 1.0, "plane_scale": 2.0}):
        found = run(windows, **scales)
        assert found.dtype == np.int32
        for window, owner in zip(each(windows), found.tolist(), strict=True):
            assert owner == greedy(window, **scales)


@pytest.mark.parametrize("size", [2, 3, 4])
def test_clusters_cover_the_window_and_their_samples_lie_apart(size, rng):
    scales = {"normal_scale": 3.0, "plane_scale": 20.0}
    windows = surfaces(rng, size, 40)
    for window, owner in zip(each(windows), run(windows, **scales), strict=True):
        members = np.flatnonzero(window["covered"])
        taken = np.unique(owner[members])
        np.testing.assert_array_equal(owner == -1, ~window["covered"])
        np.testing.assert_array_equal(owner[taken], taken, err_msg="a taken one stands for itself")
        assert window["covered"][taken].all()
        assert all(unlike(window, i, owner[i], **scales) <= 1.0 + 1e-5 for i in members)
        # The distance of a pair has a direction: it is measured from the one that was taken before.
        for a, b in itertools.combinations(taken, 2):
            assert max(unlike(window, a, b, **scales), unlike(window, b, a, **scales)) > 1.0


def test_all_samples_of_one_material_and_no_tolerance_are_alike(rng):
    """All scales 0: one cluster for each material."""
    windows = surfaces(rng, 4, 40)
    windows["slope"][:] = 0.0
    for window, owner in zip(each(windows), run(windows, normal_scale=0.0, plane_scale=0.0), strict=True):
        there = window["covered"]
        assert len(np.unique(owner[there])) == len(np.unique(window["material_id"][there]))


# --- Known windows


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_one_surface_is_one_cluster(size):
    """A wall, one that is seen at a grazing angle and reaches far back, and one that is bent by less than allowed."""
    windows = flat(size, 3)
    x, y = sample_positions(size).T
    tilted = np.stack([x, y, -100.0 * x], axis=-1) * 0.1
    windows["position"][1] += tilted.astype(np.float32)
    windows["depth"][1] -= 10.0 * x.astype(np.float32)
    windows["normal"][1] = np.array([100.0, 0.0, 1.0]) / math.hypot(100.0, 1.0)
    bend = np.stack([0.1 * x, 0.1 * y, np.ones_like(x)], axis=-1)
    windows["normal"][2] = bend / np.linalg.norm(bend, axis=-1, keepdims=True)
    np.testing.assert_array_equal(run(windows), FIRST[size])


def _halves(size: int, by: str, amount: float, across: str) -> tuple[dict, np.ndarray]:
    """A wall one half of which differs in one thing; and which half."""
    windows = flat(size)
    x, y = sample_positions(size).T
    other = (x if across == "x" else y) > 0.01
    if by == "normal":
        windows["normal"][0, other] = [math.sin(amount), 0.0, math.cos(amount)]
    elif by == "material":
        windows["material_id"][0, other] = int(amount)
    else:
        windows["position"][0, other, 2] -= amount
        windows["depth"][0, other] += amount
    return windows, other


@pytest.mark.parametrize("across", ["x", "y"])
@pytest.mark.parametrize("size", [2, 3, 4, 5])
@pytest.mark.parametrize(("by", "more", "less"), [("normal", 0.16, 0.1), ("material", 1, 0), ("depth", 0.02, 0.015)])
def test_two_halves_are_two_clusters(by, more, less, size, across):
    """At 8 for normals they may be 1/8 apart, at 300 for planes 1/300 of the depth, which is 5."""
    windows, other = _halves(size, by, more, across)
    owner = run(windows)[0]
    assert len(np.unique(owner)) == 2 and len(np.unique(owner[other])) == len(np.unique(owner[~other])) == 1
    assert FIRST[size] in owner
    windows, _ = _halves(size, by, less, across)
    np.testing.assert_array_equal(run(windows)[0], FIRST[size])


def test_a_tangent_plane_is_crossed_only_by_both():
    """Two planes that meet in an edge: each point of one may be far from the other's plane, but not the other way."""
    windows = flat(4)
    far = sample_positions(4)[:, 0] > 0.01
    windows["position"][0, far] = np.float32([1.0, 0.0, -5.0])
    windows["normal"][0, far] = np.float32([1.0, 0.0, 0.0])
    assert len(np.unique(run(windows, normal_scale=0.0))) == 1, "on the wall itself"
    windows["position"][0, far] = np.float32([1.0, 0.0, -6.0])
    assert len(np.unique(run(windows, normal_scale=0.0))) == 2


@pytest.mark.parametrize("size", [2, 3, 4])
def test_a_feature_of_one_sub_sample_has_a_sample_of_its_own(size):
    n = size**2
    windows = flat(size, n)
    windows["material_id"][np.arange(n), np.arange(n)] = 7
    for cell, owner in enumerate(run(windows)):
        assert owner[cell] == cell and len(np.unique(owner)) == 2


@pytest.mark.parametrize("size", [2, 3, 4, 5])
def test_a_slope_splits_along_its_axis_only(size):
    """Into columns, or rows, each of which is as a whole in one cluster; one sample for any number of them."""
    windows = flat(size, 4)
    windows["slope"] = np.array([[3.5, 0], [9, 0], [0, 3.5], [0, 9]], np.float32)
    owners = run(windows).reshape(4, size, size)
    for owner, axis in zip(owners, (1, 1, 0, 0), strict=True):
        lines = [set(line.tolist()) for line in np.moveaxis(owner, axis, 0)]
        assert all(len(line) == 1 for line in lines)
        taken = np.unique(owner)
        assert 1 < len(taken) == len(np.unique(np.unravel_index(taken, (size, size))[axis]))
    assert len(np.unique(owners[1])) == len(np.unique(owners[3])) == size, "a step of more than 1 to the next"


def test_a_slope_splits_where_it_exceeds_the_tolerance():
    """4 x 4: from the first sample, at +1/8 px, it is 1/2 px to the other side."""
    windows = flat(4, 4)
    windows["slope"] = np.array([[1.99, 0.0], [2.01, 0.0], [0.0, 1.99], [0.0, 2.01]], np.float32)
    assert [len(np.unique(owner)) for owner in run(windows)] == [1, 2, 1, 2]


def test_the_slope_of_the_shading(dtype, rng):
    """Steps between pixels have a direction, what a material varies within one has none; both add as squares."""
    steps, detail, luma = (rng.uniform(size=shape).astype(dtype) for shape in ((4, 5, 2), (4, 5), (4, 5)))
    kernel = jax.jit(lambda *a: shading_slope(*a, contrast_scale=18.0, detail_scale=72.0))
    found = kernel(steps, detail, luma)
    assert found.dtype == dtype
    for i in np.ndindex(4, 5):
        textured = 72.0 * detail[i] * luma[i]
        expected = [math.hypot(18.0 * steps[i][axis], textured) for axis in range(2)]
        np.testing.assert_allclose(found[i], expected, rtol=4 * np.finfo(dtype).eps)
    np.testing.assert_allclose(kernel(steps, np.zeros_like(detail), luma), 18.0 * steps, rtol=1e-6)
    uniform = np.asarray(kernel(np.zeros_like(steps), detail, luma))
    np.testing.assert_array_equal(uniform[..., 0], uniform[..., 1])


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_a_large_slope_leaves_every_sub_sample_by_itself(size):
    windows = flat(size, 2)
    windows["slope"] = np.array([[size + 0.1, size + 0.1], [1e4, 3e4]], np.float32)
    np.testing.assert_array_equal(run(windows), np.tile(np.arange(size**2), (2, 1)))


# --- What does not matter


@pytest.mark.parametrize("size", [2, 3, 4])
def test_what_lies_in_empty_sub_samples_does_not_matter(size, rng):
    windows = surfaces(rng, size, 60)
    empty = ~windows["covered"]
    before = run(windows, normal_scale=3.0, plane_scale=20.0)
    np.testing.assert_array_equal(before[empty], -1)
    assert (before[windows["covered"]] >= 0).all() and empty.all(axis=1).any()
    for junk in (np.nan, np.inf, 1e30, 0.0):
        for name in ("normal", "position", "depth"):
            windows[name][empty] = junk
        windows["material_id"][empty] = -1
        np.testing.assert_array_equal(run(windows, normal_scale=3.0, plane_scale=20.0), before)


def test_the_world_may_be_moved_turned_and_scaled(rng, x64):
    windows = surfaces(rng, 4, 40, dtype=np.float64)
    windows["material_id"] = windows["material_id"].astype(np.int64)
    scales = {"normal_scale": 3.0, "plane_scale": 20.0}
    before = run(windows, **scales)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned = {**windows, "normal": windows["normal"] @ rotation.T, "position": windows["position"] @ rotation.T}
    np.testing.assert_array_equal(run(turned, **scales), before)
    moved = {**windows, "position": windows["position"] + [30.0, -20.0, 500.0]}
    np.testing.assert_array_equal(run(moved, **scales), before)
    scaled = {**windows, "position": 7.0 * windows["position"], "depth": 7.0 * windows["depth"]}
    np.testing.assert_array_equal(run(scaled, **scales), before)
    assert len(np.unique(before)) > 10


def test_the_first_sample_is_the_first_covered_one_of_the_matrix():
    windows = flat(4, 16)
    by_turn = np.argsort(index_matrix(4).ravel())
    for taken in range(16):
        windows["covered"][taken, by_turn[:taken]] = False
    for taken, owner in enumerate(run(windows)):
        assert set(owner[windows["covered"][taken]]) == {by_turn[taken]}


# --- Batches, bad input


@pytest.mark.parametrize("lead", [(), (12,), (3, 4)])
def test_leading_axes(lead, rng):
    """A batch goes on until its last window is done: the others stay as they are."""
    windows = surfaces(rng, 3, 12)
    expected = run(windows, normal_scale=3.0, plane_scale=20.0)
    expected = expected.reshape(*lead, 9) if lead else expected[0]
    shaped = {k: jnp.asarray(v.reshape(*lead, *v.shape[1:]) if lead else v[0]) for k, v in windows.items()}
    arrays = [shaped[name] for name in FIELDS]
    kernel = jax.jit(lambda *a: cluster_samples(*a, normal_scale=3.0, plane_scale=20.0))
    np.testing.assert_array_equal(kernel(*arrays), expected)


def test_jit_is_eager(rng):
    windows = next(window for window in each(surfaces(rng, 3, 20)) if window["covered"].all())
    arrays = [jnp.asarray(windows[name]) for name in FIELDS]
    owner = cluster_samples(*arrays, normal_scale=3.0, plane_scale=20.0)
    assert owner.tolist() == greedy(windows, normal_scale=3.0, plane_scale=20.0)


def test_a_large_image_has_the_clusters_of_its_windows(rng):
    """As optimised, whatever the compiler does at this size."""
    few = surfaces(rng, 4, 300)
    many = {name: np.tile(values, (100, *[1] * (values.ndim - 1))) for name, values in few.items()}
    scales = {"normal_scale": 3.0, "plane_scale": 20.0}
    found = run(many, **scales, kernel=jax.jit(_clusters)).reshape(100, 300, 16)
    np.testing.assert_array_equal(found, np.tile(run(few, **scales), (100, 1, 1)))


def test_the_settings_are_frozen():
    settings = Clusters()
    assert settings.scale == 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.scale = 2.0


@pytest.mark.parametrize(
    ("shape", "wrong", "message"),
    [
        ((2, 4), {"position": (2, 3, 3)}, "normal and position: expected one shape"),
        ((2, 5), {}, "sub-samples: expected m x m, got 5"),
    ],
)
def test_bad_input_is_refused(shape, wrong, message):
    windows = {
        "normal": (*shape, 3), "position": (*shape, 3), "depth": shape, "material_id": shape, "covered": shape,
        "slope": (shape[0], 2),
    }  # fmt: skip
    kinds = {"material_id": jnp.int32, "covered": bool}
    one = {name: jnp.zeros(size[1:], kinds.get(name, jnp.float32)) for name, size in {**windows, **wrong}.items()}
    with pytest.raises(ValueError, match=message):
        cluster_samples(*(one[name] for name in FIELDS), normal_scale=1.0, plane_scale=1.0)
