"""Subpixel reconstruction against a NumPy loop, and where the answer is known: flat ground, and two half planes."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.sraa import sraa

SIGMAS = {"sigma_depth": 0.1, "sigma_normal": 0.2}


# Compiling is nearly all of the time here.
_compiled = jax.jit(
    sraa,
    static_argnames=("size", "sigma_depth", "sigma_normal", "sigma_space"),
    compiler_options={"xla_backend_optimization_level": 0},
)


def run(scene, **options) -> np.ndarray:
    return np.asarray(_compiled(*map(jnp.asarray, scene), **options))


def random_scene(height: int, width: int, size: int, seed: int = 1, dtype=np.float32) -> list[np.ndarray]:
    """Shading, depth, normal, covered, first; one pixel in five is empty and one sample in five."""
    rng = np.random.default_rng(seed)
    samples = (height, width, size**2)
    normal = rng.normal(size=(*samples, 3)) + [0.0, 0.0, 1.5]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    covered = (rng.uniform(size=samples) < 0.8) & (rng.uniform(size=samples[:2]) < 0.8)[..., None]
    first = rng.integers(0, size**2, size=samples[:2]).astype(np.int32)
    light, depth = rng.uniform(0, 4, (*samples[:2], 3)), rng.uniform(5, 6, samples)
    return [light.astype(dtype), depth.astype(dtype), normal.astype(dtype), covered, first]


def flat_scene(light, size: int, first: int = 0) -> list[np.ndarray]:
    """One plane that faces the eye and covers all."""
    samples = (*light.shape[:2], size**2)
    normal = np.broadcast_to(np.array([0.0, 0.0, 1.0], light.dtype), (*samples, 3))
    return [light, np.full(samples, 3.0, light.dtype), normal, np.ones(samples, bool), np.full(samples[:2], first)]


def two_halves(size: int, height: int = 12, width: int = 14) -> tuple[np.ndarray, list[np.ndarray]]:
    """Which sub-samples lie beyond a slanted line, and a scene with another light there."""
    y, x = (np.mgrid[0 : height * size, 0 : width * size] + 0.5) / size
    beyond = (y > 2.2 + 0.43 * x).reshape(height, size, width, size).swapaxes(1, 2).reshape(height, width, -1)
    first = size**2 // 2
    light = np.where(beyond[..., first, None], [4.0, 1.0, 0.5], [0.25, 0.5, 2.0])
    return beyond, flat_scene(light.astype(np.float32), size, first)


def place(k: int, size: int) -> np.ndarray:
    return np.array([k % size + 0.5, k // size + 0.5]) / size


def brute_force(scene, *, size, sigma_depth, sigma_normal, sigma_space=math.inf) -> np.ndarray:
    """The definition, from pixel to pixel; weights as they are, which only float64 can hold."""
    light, depth, normal, covered, first = (
        np.asarray(x, np.float64 if x.dtype.kind == "f" else x.dtype) for x in scene
    )
    height, width = first.shape
    result = light.copy()
    for y, x in np.ndindex(height, width):
        values = []
        for k in np.flatnonzero(covered[y, x]):
            total, weights = np.zeros(3), 0.0
            for v, u in np.ndindex(height, width):
                j = first[v, u]
                if max(abs(v - y), abs(u - x)) <= 1 and covered[v, u, j]:
                    by_depth = abs(depth[y, x, k] - depth[v, u, j]) / (depth[y, x, k] * sigma_depth)
                    by_normal = (1.0 - normal[y, x, k] @ normal[v, u, j]) / sigma_normal
                    away = place(j, size) + [u, v] - place(k, size) - [x, y]
                    weight = math.exp(-max(by_depth, by_normal) - away @ away / (2.0 * sigma_space**2))
                    total, weights = total + weight * light[v, u], weights + weight
            values.append(total / weights if weights > 0.0 else light[y, x])
        if values:
            result[y, x] = np.mean(values, axis=0)
    return result


# --- Against the definition


@pytest.mark.parametrize(("size", "sigma_space"), [(1, 0.6), (2, math.inf), (3, 0.6)])
def test_it_is_the_definition(size, sigma_space, dtype):
    scene = random_scene(6, 7, size, dtype=dtype)
    options = {"size": size, "sigma_space": sigma_space, **SIGMAS}
    # -log weights reach 8 and a cosine is rounded in units of 1, over sigma_normal.
    atol = 3e-5 if dtype == np.float32 else 1e-12
    np.testing.assert_allclose(run(scene, **options), brute_force(scene, **options), atol=atol)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_small_images(shape):
    scene = random_scene(*shape, 2, seed=3)
    np.testing.assert_allclose(run(scene, size=2, **SIGMAS), brute_force(scene, size=2, **SIGMAS), atol=3e-5)


def test_a_large_image_is_its_parts():
    """Whatever the compiler does for large images: this failed while cosines were sums over a last axis."""
    scene = random_scene(200, 160, 3)
    whole = jax.jit(functools.partial(sraa, size=3, **SIGMAS))(*map(jnp.asarray, scene))
    part = run([x[99:111, 69:84] for x in scene], size=3, **SIGMAS)
    np.testing.assert_allclose(whole[100:110, 70:83], part[1:-1, 1:-1], atol=3e-5)


# --- Known results


@pytest.mark.parametrize("first", [0, 4])
def test_flat_ground_is_blurred_by_3_x_3(first, rng):
    light = rng.uniform(size=(7, 8, 3)).astype(np.float32)
    ones = np.pad(np.ones((7, 8, 1)), ((1, 1), (1, 1), (0, 0)))
    sums, counts = (
        np.lib.stride_tricks.sliding_window_view(v, (3, 3), axis=(0, 1)).sum((-1, -2))
        for v in (np.pad(light, ((1, 1), (1, 1), (0, 0))), ones)
    )
    np.testing.assert_allclose(run(flat_scene(light, 3, first), size=3, **SIGMAS), sums / counts, rtol=1e-5)


def test_a_narrow_term_of_space_keeps_flat_ground():
    """The middle sample of 3 x 3 is shaded: of all within half a pixel, the own one is nearest."""
    light = np.random.default_rng(5).uniform(size=(6, 6, 3)).astype(np.float32)
    found = run(flat_scene(light, 3, 4), size=3, sigma_space=0.02, **SIGMAS)
    np.testing.assert_allclose(found, light, rtol=1e-5)


@pytest.mark.parametrize("parted_by", ["normal", "depth"])
@pytest.mark.parametrize("size", [2, 4])
def test_the_edge_of_two_half_planes_is_exact(size, parted_by):
    beyond, (light, depth, normal, covered, first) = two_halves(size)
    if parted_by == "normal":
        normal = np.where(beyond[..., None], np.float32([1.0, 0.0, 0.0]), normal)
    else:
        depth = np.where(beyond, np.float32(9.0), depth)
    found = run([light, depth, normal, covered, first], size=size, sigma_depth=0.01, sigma_normal=0.01)
    share = beyond.mean(-1)[..., None]
    assert ((share > 0.0) & (share < 1.0)).sum() >= 10
    np.testing.assert_allclose(found, share * [4.0, 1.0, 0.5] + (1.0 - share) * [0.25, 0.5, 2.0], rtol=2e-6)


def test_the_unit_of_depth_does_not_matter():
    scene = random_scene(6, 7, 2)
    far = [scene[0], 1024.0 * scene[1], *scene[2:]]
    np.testing.assert_array_equal(run(far, size=2, **SIGMAS), run(scene, size=2, **SIGMAS))


def test_where_nothing_like_it_was_shaded_the_most_alike_counts():
    """A thin object between the shaded samples, much nearer to the eye than all; the weights e^-4999 to e^-9999."""
    light = np.arange(27, dtype=np.float32).reshape(3, 3, 3)
    light, depth, normal, covered, first = flat_scene(light, 2)
    depth = np.broadcast_to(np.arange(11.0, 20.0, dtype=np.float32).reshape(3, 3, 1), (3, 3, 4)).copy()
    depth[1, 1, 3] = 0.02
    covered = covered & (np.arange(4) == np.where(np.arange(9) == 4, 3, 0).reshape(3, 3, 1))
    found = run([light, depth, normal, covered, first], size=2, sigma_depth=0.1, sigma_normal=0.1)
    np.testing.assert_array_equal(found[1, 1], light[0, 0])


def test_empty_samples():
    """Unshaded pixels give nothing; alone, or without any sample, a pixel keeps its entry of the shading."""
    light, depth, normal, covered, first = flat_scene(np.ones((5, 5, 3), np.float32), 2)
    light, covered = light.copy(), covered.copy()
    light[0, 0] = 100.0
    covered[0, 0, 0] = False  # its own shaded sample is empty, the other three are not
    covered[4, 4] = False
    light[4, 4] = 7.0
    found = run([light, depth, normal, covered, first], size=2, **SIGMAS)
    expected = np.ones((5, 5, 3))
    expected[4, 4] = 7.0
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    covered[:] = False
    covered[0, 0, 1] = True
    np.testing.assert_array_equal(run([light, depth, normal, covered, first], size=2, **SIGMAS), light)


def test_what_lies_in_empty_samples_does_not_matter():
    light, depth, normal, covered, first = random_scene(6, 7, 2)
    wild = [np.where(covered, depth, np.inf), np.where(covered[..., None], normal, np.nan)]
    with jax.debug_nans(False):
        found = run([light, *wild, covered, first], size=2, **SIGMAS)
        total = lambda *a: sraa(*a, jnp.asarray(covered), jnp.asarray(first), size=2, **SIGMAS).sum()  # noqa: E731
        gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2)), compiler_options={"xla_backend_optimization_level": 0})
        slopes = gradient(*map(jnp.asarray, (light, *wild)))
    np.testing.assert_array_equal(found, run([light, depth, normal, covered, first], size=2, **SIGMAS))
    assert all(np.isfinite(s).all() for s in slopes)
    np.testing.assert_array_equal(np.asarray(slopes[1])[~covered], 0.0)


def test_an_index_outside_is_clamped():
    scene = random_scene(6, 7, 2)
    low, high = (np.where(scene[4] == end, beyond, scene[4]) for end, beyond in ((0, -9), (3, 99)))
    for first in (low, high):
        np.testing.assert_array_equal(run([*scene[:4], first], size=2, **SIGMAS), run(scene, size=2, **SIGMAS))


def test_edges_come_much_closer_to_supersampling(rng):
    """A shaded slope behind a slanted edge: of one sample's squared error, less than a hundredth is left."""
    size = 4
    beyond, (_, depth, normal, covered, first) = two_halves(size)
    at = np.stack([place(k, size) for k in range(size**2)])
    light = np.where(beyond, 2.0, 0.2 + 0.01 * (np.arange(14)[:, None] + at[:, 0]))[..., None] * [1.0, 0.8, 0.6]
    scene = [light[:, :, first[0, 0]].astype("f4"), np.where(beyond, depth, 9.0).astype("f4"), normal, covered, first]
    found = run(scene, size=size, sigma_depth=0.02, sigma_normal=0.05)
    before, after = (np.mean((i - light.mean(2)) ** 2) for i in (scene[0], found))
    assert after < 0.01 * before, (before, after)
    assert found.min() >= scene[0].min() - 1e-6 and found.max() <= scene[0].max() + 1e-6


# --- Batches, gradients, bad input


def test_a_batch_is_its_images():
    scenes = [list(map(jnp.asarray, random_scene(6, 7, 2, seed=s))) for s in range(2)]
    function = functools.partial(sraa, size=2, **SIGMAS)
    together = jax.jit(jax.vmap(function))(*(jnp.stack(x) for x in zip(*scenes, strict=True)))
    assert together.shape == (2, 6, 7, 3) and together.dtype == jnp.float32
    for one, scene in zip(together, scenes, strict=True):
        np.testing.assert_allclose(one, run(scene, size=2, **SIGMAS), atol=1e-5)


@pytest.mark.parametrize("argument", [0, 1, 2])
def test_gradients_are_finite_differences(argument, rng, x64):
    scene = random_scene(5, 6, 2, dtype=np.float64)
    options = {"size": 2, "sigma_space": 0.7, **SIGMAS}
    weights, along = rng.normal(size=(5, 6, 3)), rng.normal(size=scene[argument].shape)
    if argument == 2:  # normals stay unit: off the sphere, a sample's product with itself is at a switch
        along -= np.sum(along * scene[2], axis=-1, keepdims=True) * scene[2]
    objective = lambda x: jnp.sum(sraa(*scene[:argument], x, *scene[argument + 1 :], **options) * weights)  # noqa: E731
    slope = jax.jit(jax.grad(objective))(scene[argument])
    ends = [
        np.sum(
            run([*scene[:argument], scene[argument] + s * 1e-6 * along, *scene[argument + 1 :]], **options) * weights
        )
        for s in (-1, 1)
    ]
    np.testing.assert_allclose(np.sum(slope * along), (ends[1] - ends[0]) / 2e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({0: (4, 5)}, {}, r"shading: shape: expected \(h, w, 3\), got \(4, 5\)"),
        ({1: (4, 5, 9)}, {}, r"depth: shape: expected \(4, 5, 4\), got \(4, 5, 9\)"),
        ({2: (4, 5, 4)}, {}, r"normal: shape: expected \(4, 5, 4, 3\)"),
        ({3: (4, 5)}, {}, r"covered: shape: expected \(4, 5, 4\)"),
        ({4: (5, 4)}, {}, r"first: shape: expected \(4, 5\)"),
        ({}, {"size": 0}, "size: expected a value >= 1"),
        ({}, {"sigma_depth": 0.0}, "sigma_depth: expected a value > 0, got 0.0"),
        ({}, {"sigma_normal": -1.0}, "sigma_normal: expected a value > 0"),
        ({}, {"sigma_space": math.nan}, "sigma_space: expected a value > 0"),
    ],
)
def test_bad_input_is_refused(change, options, message):
    scene = [jnp.asarray(x) for x in random_scene(4, 5, 2)]
    for i, shape in change.items():
        scene[i] = jnp.zeros(shape, scene[i].dtype)
    with pytest.raises(ValueError, match=message):
        sraa(*scene, **{"size": 2, **SIGMAS, **options})
