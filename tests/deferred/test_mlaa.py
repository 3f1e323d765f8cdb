"""Morphological anti-aliasing against a NumPy loop with a table of all patterns, and stairs whose areas are known."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.mlaa import mlaa
from jaxrender.srgb import decode_srgb, encode_srgb
from tests.deferred.test_fxaa import IMAGES, flat_colours, noise

# Heights of the line at the left and at the right end of a run, by what crosses it there. In the order and with the
# end points of the area texture of SMAA (AreaTex.py, patterns 0 to 15; bits: left below, right below, left above, right
# above). A line between two ends at different heights is straight; otherwise it meets the run in the middle.
PATTERNS = [
    (0, 0), (-1, 0), (0, -1), (-1, -1), (1, 0), (0, 0), (1, -1), (1, -1),
    (0, 1), (-1, 1), (0, 0), (-1, 1), (1, 1), (-1, 1), (1, -1), (0, 0),
]  # fmt: skip


# Compiling is nearly all of the time here.
_compiled = jax.jit(
    mlaa,
    static_argnames=("threshold", "max_search_steps", "linear_light"),
    compiler_options={"xla_backend_optimization_level": 0},
)


def run(image, **options) -> np.ndarray:
    return np.asarray(_compiled(jnp.asarray(image), **options))


def steps_between(light) -> tuple[np.ndarray, np.ndarray]:
    """Steps to the pixel on the left, and above; with two more columns or rows of zeros on either side."""
    left, top = np.zeros_like(light), np.zeros_like(light)
    left[:, 1:], top[1:] = abs(light[:, 1:] - light[:, :-1]), abs(light[1:] - light[:-1])
    return np.pad(left, 2), np.pad(top, 2)


def brute_force(image, threshold=0.1, max_search_steps=16, seen: set | None = None) -> np.ndarray:
    """Edge by edge, first the rows and then, transposed, the columns; `seen` collects (pattern, length) of the rows."""
    image = np.asarray(image, np.float64)
    height, width = image.shape[:2]
    light = image @ [0.299, 0.587, 0.114]
    left, top = steps_between(light)
    edges = np.zeros((2, height + 4, width + 4), bool)
    for y, x in np.ndindex(height, width):
        v, u = y + 2, x + 2
        near = max(left[v, u], top[v, u], left[v, u + 1], top[v + 1, u], left[v, u - 1], top[v - 1, u])
        for kind, step in enumerate((left[v, u], top[v, u])):
            edges[kind, v, u] = step >= threshold - 2.0**-16 and 2 * step >= near - 2.0**-16
    # Areas by direction: up, down, left, right.
    areas = np.zeros((4, height + 4, width + 4))
    add_areas(areas[0], areas[1], edges[1], edges[0], 2 * max_search_steps, seen)
    add_areas(areas[2].T, areas[3].T, edges[0].T, edges[1].T, 2 * max_search_steps, None)
    result = image.copy()
    for y, x in np.ndindex(height, width):
        up, down, to_left, to_right = areas[:, y + 2, x + 2]
        pairs = [(up, -1, 0), (down, 1, 0)], [(to_left, 0, -1), (to_right, 0, 1)]
        pair = pairs[0] if max(up, down) >= max(to_left, to_right) else pairs[1]
        total = pair[0][0] + pair[1][0]
        if total > 0:
            mixed = [a * ((1 - a) * image[y, x] + a * image[y + dy, x + dx]) for a, dy, dx in pair if a > 0]
            result[y, x] = sum(mixed) / total
    return result


def add_areas(up, down, edges, crossing, reach, seen) -> None:
    for y, x in np.argwhere(edges):
        crossed = lambda column: crossing[y - 1, column] or crossing[y, column]  # noqa: B023, E731
        before = after = 0
        while before < reach and not crossed(x - before) and edges[y, x - before - 1]:
            before += 1
        while after < reach and not crossed(x + after + 1) and edges[y, x + after + 1]:
            after += 1
        ends = (x - before, x + after + 1)
        bits = [crossing[y, end] for end in ends] + [crossing[y - 1, end] for end in ends]
        pattern, length = sum(2**i for i in range(4) if bits[i]), before + after + 1
        heights = PATTERNS[pattern]
        if seen is not None:
            seen.add((pattern, length))
        # From one half pixel to the next the line is straight, and on one side.
        at = np.arange(2 * before, 2 * before + 3) / 2
        if heights[0] * heights[1] < 0:
            line = heights[0] * (0.5 - at / length)
        else:
            line = np.where(at < length / 2, heights[0], heights[1]) * abs(0.5 - at / length)
        halves = (line[1:] + line[:-1]) / 4
        down[y - 1, x] += halves[halves > 0].sum()
        up[y, x] -= halves[halves < 0].sum()


def black_and_white(rows: list[str]) -> np.ndarray:
    """An image drawn with # for white."""
    return np.repeat(np.array([[c == "#" for c in row] for row in rows], np.float32)[..., None], 3, axis=2)


@pytest.mark.parametrize("name", IMAGES)
def test_it_is_the_loop(name, dtype):
    image = IMAGES[name].astype(dtype)
    np.testing.assert_allclose(run(image), brute_force(image), atol=3e-7 if dtype == np.float32 else 1e-14)


def test_every_pattern_at_every_length():
    """A run between 0.4 and 0.6 whose ends are crossed from above or below, or fade out in steps too small to count."""
    sides = {
        (False, False): (0.47, 0.53),
        (True, False): (0.6, 0.6),
        (False, True): (0.4, 0.4),
        (True, True): (0.6, 0.4),
    }
    seen: set = set()
    for length in (1, 2, 3, 6):
        for left, right in itertools.product(sides.values(), repeat=2):
            columns = np.array([left] * 3 + [(0.4, 0.6)] * length + [right] * 3)
            image = np.repeat(np.repeat(columns.T, 3, axis=0)[..., None], 3, axis=2).astype(np.float32)
            np.testing.assert_allclose(run(image), brute_force(image, seen=seen), atol=3e-7)
    assert seen >= set(itertools.product(range(16), (1, 2, 3, 6)))


def test_options_are_the_loops():
    image = noise(20, 20, seed=5)
    for threshold, steps in ((0.02, 1), (0.3, 2), (0.6, 16)):
        options = {"threshold": threshold, "max_search_steps": steps}
        np.testing.assert_allclose(run(image, **options), brute_force(image, **options), atol=3e-7)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (3, 5)])
def test_small_images(shape):
    image = noise(*shape, seed=4)
    np.testing.assert_allclose(run(image), brute_force(image), atol=3e-7)


def test_a_large_image_is_its_parts():
    """Whatever the compiler does for large images. Ends are sought 32 pixels away at most."""
    image = flat_colours(lambda x, y: np.sin(0.11 * x + 0.9 * y) > 0.3 * np.cos(0.05 * x), 150, 220, dtype=np.float32)
    whole, part = run(image), run(image[10:130, 60:200])
    np.testing.assert_array_equal(whole[50:90, 100:160], part[40:80, 40:100])


# --- Known results


def test_a_stair_becomes_a_line():
    """Runs of 6 between steps up: the line crosses each from half a pixel above to half a pixel below."""
    image = black_and_white(["." * 24, "." * 18 + "#" * 6, "." * 12 + "#" * 12, "." * 6 + "#" * 18, "#" * 24])
    found = run(image)
    # 1/2 - (i + 1/2) / 6 of the i-th pixel, in the middle of the picture.
    falling = (5 - 2 * np.arange(3)) / 12
    np.testing.assert_allclose(found[2, 12:15, 0], 1.0 - falling, atol=1e-6)
    np.testing.assert_allclose(found[2, 9:12, 0], falling[::-1], atol=1e-6)
    np.testing.assert_array_equal(found[2, [5, 18], 0], [0.0, 1.0])


def test_a_single_step_is_smoothed_to_the_middle_of_its_runs():
    image = black_and_white(["." * 20, "." * 10 + "#" * 10, "#" * 20])
    found = run(image)
    falling = np.maximum(0.5 * (1 - (2 * np.arange(10) + 1) / 10), 0.0)
    np.testing.assert_allclose(found[1, 10:, 0], 1.0 - falling, atol=1e-6)
    np.testing.assert_allclose(found[1, 9::-1, 0], falling, atol=1e-6)
    np.testing.assert_array_equal(found[::2], image[::2])


def test_long_runs_are_cut():
    """Two pixels to either side: only the pixels at the end see it, in a run of up to five."""
    image = black_and_white(["." * 20, "." * 10 + "#" * 10, "#" * 20])
    found = run(image, max_search_steps=1)
    np.testing.assert_allclose(found[1, 10:13, 0], 1.0 - np.array([1 / 3, 1 / 8, 1 / 40]), atol=1e-6)
    np.testing.assert_array_equal(found[1, 13:], image[1, 13:])


def test_a_faint_edge_beside_a_strong_one_is_dropped():
    """Stairs from 0 to 0.2, alone, and with stairs to 1 one pixel behind."""
    alone = np.zeros((12, 10, 3), np.float32)
    alone[:6, 4:] = alone[6:, 5:] = 0.2
    crowded = alone.copy()
    crowded[:6, 5:] = crowded[6:, 6:] = 1.0
    dark = alone == 0.0
    assert np.abs(run(alone) - alone)[dark].max() > 0.05
    np.testing.assert_array_equal(run(crowded)[dark], 0.0)


def test_flat_colours_and_straight_edges_stay():
    half = np.where(np.arange(20) < 7, 0.0, 1.0).reshape(20, 1, 1)
    for image in (np.full((20, 20, 3), [0.2, 0.7, 0.4], np.float32), np.tile(half, (1, 20, 3)).astype(np.float32)):
        for linear_light in (False, True):
            np.testing.assert_array_equal(run(image, linear_light=linear_light), image)
            np.testing.assert_array_equal(run(image.swapaxes(0, 1), linear_light=linear_light), image.swapaxes(0, 1))
    faint = (0.5 + 0.08 * noise(20, 20)).astype(np.float32)
    np.testing.assert_array_equal(run(faint), faint)


def test_light_is_mixed_if_asked_for():
    image = black_and_white(["." * 20, "." * 10 + "#" * 10, "#" * 20]) * np.float32([1.0, 0.5, 0.2])
    share = run(image)[..., :1]
    expected = encode_srgb(share * decode_srgb(np.array([1.0, 0.5, 0.2])))
    np.testing.assert_allclose(run(image, linear_light=True), expected, atol=1e-6)


@pytest.mark.parametrize("slope", [0.06, 0.15, 0.3, 0.6])
def test_slanted_edges_come_closer_to_supersampling(slope):
    """To 16 x 16 samples a pixel: of the mean squared error a sixth is left at most, away from the border."""
    truth, single = (flat_colours(lambda x, y: y > 24.7 + slope * (x - 40), 50, 80, samples) for samples in (16, 1))
    for image, reference in ((single, truth), (single.swapaxes(0, 1), truth.swapaxes(0, 1))):
        found = run(image.astype(np.float32))
        before, after = (np.mean((i - reference)[16:-16, 16:-16] ** 2) for i in (image, found))
        print(before / after)
        assert after < before / 6, (before, after)


def test_results_are_mixes_of_neighbours_with_half_of_the_pixel():
    image = noise(20, 20, seed=7)
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    cross = np.stack([padded[1:-1, 1:-1], padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    found = run(image, threshold=0.02)
    assert (found >= (image + cross.min(0)) / 2 - 1e-6).all() and (found <= (image + cross.max(0)) / 2 + 1e-6).all()


# --- Symmetry


@pytest.mark.parametrize("turn", [lambda i: i[::-1], lambda i: i[:, ::-1]])
@pytest.mark.parametrize("name", ["nearly horizontal", "steep", "thin line", "disc"])
def test_mirrored_images_of_two_colours(name, turn):
    image = IMAGES[name].astype(np.float32)
    np.testing.assert_allclose(run(turn(image)), turn(run(image)), atol=2e-6)


@pytest.mark.parametrize("name", ["nearly vertical", "thin line", "disc"])
def test_transposed_images(name):
    """But for pixels that change equally much both ways, at corners."""
    image = IMAGES[name].astype(np.float32)
    one, other = run(image), run(image.swapaxes(0, 1)).swapaxes(0, 1)
    assert np.isclose(one, other, atol=2e-6).all(-1).mean() > 0.9


# --- Batches, gradients, bad input


def test_a_batch_is_its_images():
    images = jnp.asarray(np.stack([noise(20, 20, seed=s) for s in range(3)]))
    together = jax.jit(jax.vmap(mlaa))(images)
    assert together.shape == images.shape and together.dtype == jnp.float32
    for one, image in zip(together, images, strict=True):
        np.testing.assert_allclose(one, run(image), atol=1e-6)


@pytest.mark.parametrize("linear_light", [False, True])
def test_gradients_are_finite_differences(linear_light, rng, x64):
    image, along = noise(12, 13, seed=3, dtype=np.float64), rng.normal(size=(12, 13, 3))
    function = functools.partial(mlaa, linear_light=linear_light)
    _, slope = jax.jit(lambda i, a: jax.jvp(function, (i,), (a,)))(image, along)
    ends = [run(image + s * 1e-7 * along, linear_light=linear_light) for s in (-1, 1)]
    np.testing.assert_allclose((ends[1] - ends[0]) / 2e-7, slope, rtol=1e-5, atol=1e-6)
    back = jax.jit(jax.grad(lambda i: jnp.sum(function(i) * along)))(image)
    np.testing.assert_allclose(np.sum(back * along), np.sum(slope * along), rtol=1e-12)


@pytest.mark.parametrize("linear_light", [False, True])
def test_gradients_on_flat_colours_are_finite(linear_light):
    gradient = jax.jit(jax.grad(lambda i: mlaa(i, linear_light=linear_light).sum()))
    for image in (np.zeros((3, 4, 3)), np.ones((3, 4, 3)), black_and_white(["..##", "...#", "####"])):
        assert np.isfinite(gradient(jnp.asarray(image, jnp.float32))).all()


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (np.zeros((4, 4)), {}, r"image: shape: expected \(h, w, 3\), not empty, got \(4, 4\)"),
        (np.zeros((4, 4, 1)), {}, "image: shape"),
        (np.zeros((4, 0, 3)), {}, "image: shape"),
        (np.zeros((4, 4, 3)), {"threshold": 0.0}, "threshold: expected a value > 0, got 0.0"),
        (np.zeros((4, 4, 3)), {"max_search_steps": 0}, "max_search_steps: expected a value >= 1"),
    ],
)
def test_bad_input_is_refused(image, options, message):
    with pytest.raises(ValueError, match=message):
        mlaa(jnp.asarray(image, jnp.float32), **options)
