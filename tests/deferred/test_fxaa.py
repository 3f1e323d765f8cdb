"""FXAA against the shader's arithmetic in a NumPy loop, edges that are known exactly, and laws of symmetry."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.fxaa import _STEPS_PX, fxaa, luma, luma_range

# From Fxaa3_11.h, FXAA_QUALITY__P0 and so on of each FXAA_QUALITY__PRESET.
STEPS = {
    10: "1.5 3 12", 11: "1 1.5 3 12", 12: "1 1.5 2 4 12", 13: "1 1.5 2 2 4 12", 14: "1 1.5 2 2 2 4 12",
    15: "1 1.5 2 2 2 2 4 12", 20: "1.5 2 8", 21: "1 1.5 2 8", 22: "1 1.5 2 2 8", 23: "1 1.5 2 2 2 8",
    24: "1 1.5 2 2 2 3 8", 25: "1 1.5 2 2 2 2 4 8", 26: "1 1.5 2 2 2 2 2 4 8", 27: "1 1.5 2 2 2 2 2 2 4 8",
    28: "1 1.5 2 2 2 2 2 2 2 4 8", 29: "1 1.5 2 2 2 2 2 2 2 2 4 8", 39: "1 1 1 1 1 1.5 2 2 2 2 4 8",
}  # fmt: skip


# Compiling is nearly all of the time here.
_compiled = jax.jit(
    fxaa,
    static_argnames=("preset", "subpix", "edge_threshold", "edge_threshold_min"),
    compiler_options={"xla_backend_optimization_level": 0},
)


def run(image, **options) -> np.ndarray:
    return np.asarray(_compiled(jnp.asarray(image), **options))


def noise(*shape: int, seed: int = 1, dtype=np.float32) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (*shape, 3)).astype(dtype)


def flat_colours(inside, height: int, width: int, samples: int = 1, dtype=np.float64) -> np.ndarray:
    """Dark and light where `inside(x, y)` says so, as the mean of samples² samples a pixel."""
    y, x = (np.mgrid[0 : height * samples, 0 : width * samples] + 0.5) / samples
    share = inside(x, y).reshape(height, samples, width, samples).mean((1, 3))[..., None]
    return ((1.0 - share) * [0.15, 0.3, 0.2] + share * [0.9, 0.7, 0.8]).astype(dtype)


def slanted(slope: float):
    return lambda x, y: y > 6.3 + slope * x


def brute_force(image, preset=12, subpix=0.75, edge_threshold=0.166, edge_threshold_min=0.0833) -> np.ndarray:
    """The shader's steps in its order, in pixels, with a texture unit of its own. Lumas within 2⁻¹⁶ are equal."""
    image = np.asarray(image, np.float64)
    height, width = image.shape[:2]
    steps = [float(s) for s in STEPS[preset].split()]
    weights = np.array([0.299, 0.587, 0.114])

    def fetch(x, y):
        x0, y0 = math.floor(x), math.floor(y)
        texel = lambda i, j: image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]  # noqa: E731
        top = texel(x0, y0) + (x - x0) * (texel(x0 + 1, y0) - texel(x0, y0))
        bottom = texel(x0, y0 + 1) + (x - x0) * (texel(x0 + 1, y0 + 1) - texel(x0, y0 + 1))
        return top + (y - y0) * (bottom - top)

    def tap(x, y):
        return float(weights @ fetch(x, y))

    def reaches(a, b):
        return a >= b - 2.0**-16

    result = image.copy()
    for y in range(height):
        for x in range(width):
            m, n, s, w, e = tap(x, y), tap(x, y - 1), tap(x, y + 1), tap(x - 1, y), tap(x + 1, y)
            high, low = max(m, n, s, w, e), min(m, n, s, w, e)
            if high - low < max(edge_threshold_min, high * edge_threshold):
                continue
            nw, ne, sw, se = tap(x - 1, y - 1), tap(x + 1, y - 1), tap(x - 1, y + 1), tap(x + 1, y + 1)
            edge_h = abs(nw - 2 * w + sw) + 2 * abs(n - 2 * m + s) + abs(ne - 2 * e + se)
            edge_v = abs(nw - 2 * n + ne) + 2 * abs(w - 2 * m + e) + abs(sw - 2 * s + se)
            span_h = reaches(edge_h, edge_v)
            before, after = (n, s) if span_h else (w, e)
            pair_before = reaches(abs(before - m), abs(after - m))
            gradient = abs(before - m) if pair_before else abs(after - m)
            pair_mean = 0.5 * (m + (before if pair_before else after))
            sign = -1 if pair_before else 1
            bx, by = (x, y + 0.5 * sign) if span_h else (x + 0.5 * sign, y)
            ox, oy = (1, 0) if span_h else (0, 1)
            distance = [steps[0], steps[0]]
            change, done = [0.0, 0.0], [False, False]
            for step in [*steps[1:], None]:
                for k, direction in enumerate((-1, 1)):
                    if not done[k] and step is not None:
                        along = direction * distance[k]
                        change[k] = tap(bx + along * ox, by + along * oy) - pair_mean
                        done[k] = reaches(abs(change[k]), gradient / 4)
                        distance[k] += 0.0 if done[k] else step
            nearer = 0 if distance[0] < distance[1] else 1
            good = (change[nearer] < 0) != (m - pair_mean < 0)
            offset = 0.5 - distance[nearer] / sum(distance) if good else 0.0
            lowpass = (2 * (n + s + w + e) + nw + ne + sw + se) / 12
            c = min(abs(lowpass - m) / (high - low), 1.0) if high > low else 0.0
            offset = max(offset, (c * c * (3 - 2 * c)) ** 2 * subpix) * sign
            result[y, x] = fetch(x, y + offset) if span_h else fetch(x + offset, y)
    return result


# All of one size: so they share their compiled programs.
IMAGES = {
    "noise": noise(20, 20, dtype=np.float64),
    "low contrast": 0.5 + 0.25 * noise(20, 20, seed=2, dtype=np.float64),
    "nearly horizontal": flat_colours(slanted(0.11), 20, 20),
    "nearly vertical": flat_colours(slanted(0.13), 20, 20).swapaxes(0, 1),
    "steep": flat_colours(slanted(0.8), 20, 20),
    "thin line": flat_colours(lambda x, y: abs(y - 4 - 0.27 * x) < 0.5, 20, 20),
    "disc": flat_colours(lambda x, y: (x - 9) ** 2 + (y - 8) ** 2 < 41, 20, 20),
}


# --- Luma


def test_luma_is_rec_601(rng):
    image = rng.uniform(size=(2, 3, 4, 3))
    np.testing.assert_allclose(luma(jnp.asarray(image, jnp.float32)), image @ [0.299, 0.587, 0.114], rtol=1e-6)
    np.testing.assert_allclose(luma(jnp.ones((1, 3))), [1.0], rtol=1e-6)
    with pytest.raises(ValueError, match=r"image: expected shape \(..., 3\)"):
        luma(jnp.zeros((2, 4)))


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (7, 8)])
def test_the_range_is_that_of_the_cross(shape, rng):
    light = rng.uniform(size=shape).astype(np.float32)
    spread, top = luma_range(jnp.asarray(light))
    for y, x in np.ndindex(shape):
        column, row = light[max(y - 1, 0) : y + 2, x], light[y, max(x - 1, 0) : x + 2]
        values = [*column, *row]
        assert top[y, x] == max(values) and spread[y, x] == max(values) - min(values)


def test_an_isolated_bright_pixel_has_its_contrast():
    spread, top = luma_range(jnp.zeros((3, 3)).at[1, 1].set(0.6))
    np.testing.assert_allclose(spread, 0.6 * np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]]))
    np.testing.assert_allclose(top, spread)


# --- Against the shader


@pytest.mark.parametrize("name", IMAGES)
def test_it_is_the_shader(name, dtype):
    image = IMAGES[name].astype(dtype)
    # Weights of the last look-up carry the error of a quotient of lumas.
    np.testing.assert_allclose(run(image), brute_force(image), atol=1e-5 if dtype == np.float32 else 1e-13)


def test_the_steps_are_the_shaders():
    assert {preset: " ".join(f"{s:g}" for s in steps) for preset, steps in _STEPS_PX.items()} == STEPS


@pytest.mark.parametrize("preset", [10, 15, 24, 39])
def test_presets_are_the_shaders(preset):
    image = flat_colours(lambda x, y: (y > 5.3 + 0.06 * x) & (x > 0.05 * y + 2), 16, 60, dtype=np.float32)
    found = run(image, preset=preset, subpix=0.3)
    np.testing.assert_allclose(found, brute_force(image, preset, 0.3), atol=1e-5)


def test_options_are_the_shaders():
    image = IMAGES["low contrast"].astype(np.float32)
    for subpix, threshold, least in ((0.0, 0.333, 0.0), (1.0, 0.063, 0.0312), (0.5, 0.0, 0.0), (0.5, 0.0, 0.2)):
        options = {"subpix": subpix, "edge_threshold": threshold, "edge_threshold_min": least}
        np.testing.assert_allclose(run(image, **options), brute_force(image, **options), atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (3, 5)])
def test_small_images(shape):
    image = noise(*shape, seed=4)
    np.testing.assert_allclose(run(image), brute_force(image), atol=1e-5)


def test_a_large_image_is_its_parts():
    """Whatever the compiler does for large images. 24 pixels: the longest way of preset 12 is 20.5, and its looks."""
    image = np.where(noise(150, 220) < 0.5, noise(150, 220, seed=2), flat_colours(slanted(0.4), 150, 220)).astype("f4")
    whole, part = run(image), run(image[26:124, 86:204])
    np.testing.assert_allclose(whole[50:100, 110:180], part[24:-24, 24:-24], atol=1e-6)


# --- Known results


def test_a_constant_image_and_faint_contrast_stay():
    image = np.full((20, 20, 3), [0.2, 0.7, 0.4], np.float32)
    for options in ({}, {"edge_threshold": 0.0, "edge_threshold_min": 0.0, "subpix": 1.0}):
        np.testing.assert_array_equal(run(image, **options), image)
    faint = (0.5 + 0.08 * noise(20, 20)).astype(np.float32)
    np.testing.assert_array_equal(run(faint), faint)
    assert np.abs(run(faint, edge_threshold_min=0.0312, edge_threshold=0.063) - faint).max() > 0.001


def test_a_single_pixel_moves_by_subpix():
    """Its ends lie equally near, and it has nothing in common with the pixels around."""
    image = np.zeros((7, 7, 3), np.float32)
    image[3, 3] = 1.0
    for subpix in (0.0, 0.25, 1.0):
        np.testing.assert_allclose(run(image, subpix=subpix)[3, 3], 1.0 - subpix, atol=1e-6)


def test_a_step_in_a_long_edge_becomes_a_ramp():
    """Where a row ends, its pixels i + 1/2 before the end lose 1/2 - d / (d + 20.5), d the way to see the end.

    Preset 12 looks at 1, 2.5, 4.5, 8.5. The change is seen from the first of them that lies i + 1/2 or more ahead,
    since halfway between two pixels it is a quarter of the step. The other end is not seen: 20.5.
    """
    image = np.zeros((8, 80, 3), np.float32)
    image[4:, :40] = 1.0
    image[5:, 40:] = 1.0
    ways = np.array([1.0, 2.5, 2.5, 4.5, 4.5, 8.5, 8.5, 8.5, 8.5])
    shifts = 0.5 - ways / (ways + 20.5)
    row = run(image, subpix=0.0)[4, :, 0]
    np.testing.assert_allclose(row[39:30:-1], 1.0 - shifts, atol=1e-6)
    np.testing.assert_array_equal(row[22:30], 1.0)
    np.testing.assert_allclose(row[40:49], shifts, atol=1e-6)


@pytest.mark.parametrize("slope", [0.06, 0.15, 0.3])
def test_slanted_edges_come_closer_to_supersampling(slope):
    """To 16 x 16 samples a pixel, nearly along rows and along columns: of the mean squared error a quarter is left."""
    truth, single = (flat_colours(slanted(slope), 24, 48, samples) for samples in (16, 1))
    for image, reference in ((single, truth), (single.swapaxes(0, 1), truth.swapaxes(0, 1))):
        found = run(image.astype(np.float32), subpix=0.0, preset=39)
        before, after = (np.mean((i - reference) ** 2) for i in (image, found))
        assert after < before / 4, (before, after)


def test_results_lie_between_neighbours():
    for image in (noise(20, 21, seed=7), IMAGES["disc"].astype(np.float32)):
        padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
        cross = np.stack([padded[1:-1, 1:-1], padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
        found = run(image, subpix=1.0)
        assert (found >= cross.min(0) - 1e-6).all() and (found <= cross.max(0) + 1e-6).all()


# --- Symmetry


def equal_second_differences(image) -> np.ndarray:
    light = np.pad(image.astype(np.float64) @ [0.299, 0.587, 0.114], 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(light, (3, 3))
    strengths = [np.abs(windows @ [1, -2, 1]) @ [1, 2, 1], np.abs(windows.swapaxes(2, 3) @ [1, -2, 1]) @ [1, 2, 1]]
    return np.abs(strengths[0] - strengths[1]) < 1e-4


@pytest.mark.parametrize("turn", [lambda i: i[::-1], lambda i: i[:, ::-1], lambda i: i.swapaxes(0, 1)])
@pytest.mark.parametrize("name", ["noise", "low contrast"])
def test_mirrored_and_transposed_images(name, turn):
    image = IMAGES[name].astype(np.float32)
    tied = equal_second_differences(image)
    assert tied.mean() < 0.1
    found, expected = run(turn(image)), turn(np.where(tied[..., None], 0.0, run(image)))
    np.testing.assert_allclose(np.where(turn(tied)[..., None], 0.0, found), expected, atol=2e-6)


def test_ties_go_up_and_to_rows():
    """The documented exceptions, told apart by colours of equal luma: red and green of 0.1755, and their gray."""
    red, green, gray = [0.587, 0.0, 0.0], [0.0, 0.299, 0.0], [0.175513] * 3
    line, dot = np.full((2, 5, 9, 3), gray, np.float32)
    line[:2], line[2], line[3:] = red, 1.0, green
    found, mirrored = run(line)[2, 4], run(line[::-1])[2, 4]
    assert found[0] > found[1] + 0.05 and mirrored[1] > mirrored[0] + 0.05
    dot[2, 4], dot[1, 4], dot[2, 3] = 1.0, red, green
    found, transposed = run(dot)[2, 4], run(dot.swapaxes(0, 1))[4, 2]
    assert found[0] > found[1] + 0.05 and transposed[1] > transposed[0] + 0.05


# --- Batches, gradients, bad input


def test_a_batch_is_its_images():
    images = jnp.asarray(np.stack([noise(20, 20, seed=s) for s in range(3)]))
    together = jax.jit(jax.vmap(fxaa))(images)
    assert together.shape == images.shape and together.dtype == jnp.float32
    for one, image in zip(together, images, strict=True):
        np.testing.assert_allclose(one, run(image), atol=1e-6)


def test_gradients_are_finite_differences(rng, x64):
    """Away from switches, where the result jumps: at one pixel in a hundred at most within the step taken."""
    image, along = noise(12, 13, seed=3, dtype=np.float64), rng.normal(size=(12, 13, 3))
    _, slope = jax.jit(lambda i, a: jax.jvp(fxaa, (i,), (a,)))(image, along)
    ends = [run(image + s * 1e-6 * along) for s in (-1, 1)]
    close = np.isclose((ends[1] - ends[0]) / 2e-6, slope, rtol=1e-6, atol=1e-7).all(-1)
    assert close.mean() > 0.99
    back = jax.jit(jax.grad(lambda i: jnp.sum(fxaa(i) * along)))(image)
    np.testing.assert_allclose(np.sum(back * along), np.sum(slope * along), rtol=1e-12)


@pytest.mark.parametrize("image", [np.full((20, 20, 3), 0.5), IMAGES["disc"]])
def test_gradients_on_flat_colours_are_finite(image):
    options = {"edge_threshold": 0.0, "edge_threshold_min": 0.0}
    slope = jax.jit(jax.grad(lambda i: fxaa(i, **options).sum()))(jnp.asarray(image, jnp.float32))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (np.zeros((4, 4)), {}, r"image: shape: expected \(h, w, 3\), not empty, got \(4, 4\)"),
        (np.zeros((4, 4, 4)), {}, "image: shape"),
        (np.zeros((0, 4, 3)), {}, "image: shape"),
        (np.zeros((4, 4, 3)), {"preset": 16}, "preset: expected one of 10, 11"),
        (np.zeros((4, 4, 3)), {"subpix": 1.5}, r"subpix: expected a value in \[0, 1\], got 1.5"),
        (np.zeros((4, 4, 3)), {"edge_threshold": -0.1}, "edge_threshold: expected a value >= 0"),
        (np.zeros((4, 4, 3)), {"edge_threshold_min": math.nan}, "edge_threshold_min: expected a value >= 0"),
    ],
)
def test_bad_input_is_refused(image, options, message):
    with pytest.raises(ValueError, match=message):
        fxaa(jnp.asarray(image, jnp.float32), **options)


def test_the_range_of_no_image_is_refused():
    with pytest.raises(ValueError, match=r"luma: shape: expected \(h, w\), not empty, got \(0, 3\)"):
        luma_range(jnp.zeros((0, 3)))
