"""The guided filter: ridge regression in each window, other libraries, laws, rounding, edges."""

import functools
import re

import cv2
import jax
import jax.numpy as jnp
import kornia
import numpy as np
import pytest
import torch

from jaxrender.filters import edge_aware_eps, guided_filter
from jaxrender.filters.guided import filter_planes
from jaxrender.filters.guided_rows import filter_rows, restart_rows
from tests.filters import oracle

# Compiling is nearly all of the time here: most images have one size and one radius, and share their programs.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
_compiled = quick(guided_filter, static_argnames=("radius", "subsample", "edge_aware"))
HEIGHT, WIDTH = SIZE = 13, 16
EPS = {"number": (), "per channel": (3,), "per window": (*SIZE, 1), "per window and channel": (*SIZE, 3)}


def run(guide, image, *, eps, radius: int = 2, **options) -> np.ndarray:
    """The filtered image, finite everywhere, whatever the input."""
    dtype = jnp.float64 if jax.config.jax_enable_x64 else jnp.float32
    with jax.debug_nans(False):
        arrays = [jnp.asarray(x, dtype) for x in (guide, image, eps)]
        result = np.asarray(_compiled(arrays[0], arrays[1], eps=arrays[2], radius=radius, **options))
    assert np.isfinite(result).all()
    return result


def images(seed: int = 1, size=SIZE, g: int = 3, c: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Guide and image, in numbers that float32 holds."""
    rng = np.random.default_rng(seed)
    return tuple(rng.uniform(size=(*size, k)).astype(np.float32).astype(np.float64) for k in (g, c))


def mask(guide, image) -> tuple[np.ndarray, np.ndarray]:
    """Some pixels of either are not finite, and one window has none that is valid."""
    guide, image = guide.copy(), image.copy()
    guide[0, -1, 0], guide[6, 7, 2], image[3, 3, 1], image[12, 0, 0], image[6, 7, 0] = (
        np.nan,
        np.inf,
        -np.inf,
        np.nan,
        9.0,
    )
    image[-3:, -3:, 1] = np.nan
    guide[-1, -1] = np.nan
    return guide, image


PER_CHANNEL = np.array([0.01, 0.03, 0.1])
constant = functools.partial(np.full, (*SIZE, 2))


def by_itself(image, **options):
    """The filter with one array as guide and image."""
    return guided_filter(image, image, **options)


_by_itself = quick(by_itself, static_argnames=("radius", "subsample", "edge_aware"))


# --- An image that guides itself


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("options", [{}, {"radius": 40}, {"subsample": 2}, {"edge_aware": True}])
def test_an_image_may_be_its_own_guide(masked, options, x64):
    image, _ = images()
    image = mask(image, image)[0] if masked else image
    options = {"radius": 2, "eps": 0.01} | options
    with jax.debug_nans(False):
        found = _by_itself(jnp.asarray(image), **options)
    np.testing.assert_allclose(found, run(image, image.copy(), **options), rtol=1e-10, atol=1e-12)


def test_an_image_that_guides_itself_sums_each_product_once():
    """Fewer numbers go through the loop, on CPUs and elsewhere, than with a second image that happens to be equal."""
    image = jnp.asarray(images()[0], jnp.float32)

    def summed(function, *arguments, platform):
        lowered = jax.jit(function).trace(*arguments).lower(lowering_platforms=(platform,))
        text = lowered.as_text()
        return sum(np.prod([int(n) for n in re.findall(r"\d+(?=x)", shape)])
                   for shape in re.findall(r"stablehlo.add .*tensor<((?:\d+x)+)f32>", text))  # fmt: skip

    one, two = functools.partial(by_itself, radius=2, eps=0.1), functools.partial(guided_filter, radius=2, eps=0.1)
    for platform in ("cpu", "cuda"):
        assert summed(one, image, platform=platform) < 0.9 * summed(two, image, image, platform=platform)


# --- Against definitions and other libraries


@pytest.mark.parametrize("name", EPS)
def test_it_is_ridge_regression_in_each_window(name, rng, x64):
    eps = rng.uniform(0.01, 0.1, size=EPS[name])
    for guide, image in (images(), mask(*images())):
        expected = oracle.guided_filter(guide, image, radius=2, eps=eps)
        np.testing.assert_allclose(run(guide, image, eps=eps), expected, rtol=0, atol=1e-12)


def test_it_is_that_in_float32():
    for guide, image in (images(), mask(*images())):
        expected = oracle.guided_filter(guide, image, radius=2, eps=PER_CHANNEL)
        found = run(guide, image, eps=PER_CHANNEL)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("size", "g", "c", "radius"),
    [
        ((1, 1), 2, 3, 4),
        ((1, 9), 1, 1, 3),
        ((9, 1), 1, 2, 0),
        ((5, 4), 4, 1, 50),
        ((100, 7), 3, 2, 2),  # running sums start afresh every 32 rows
        ((140, 5), 1, 1, 17),  # and every 64
    ],
)
def test_both_ways_through_the_image_are_one(size, g, c, radius, rng, x64):
    """Row by row, as on a CPU, and stage by stage, as elsewhere; masked pixels, and eps for each window."""
    guide, image = (np.moveaxis(x, -1, 0) for x in images(2, size, g, c))
    valid, eps = rng.uniform(size=size) < 0.8, rng.uniform(0.01, 0.1, size=(g, *size))
    both = quick(lambda *a: [function(*a, radius=radius) for function in (filter_rows, filter_planes)])
    rows, planes = both(guide, image, valid, eps)
    np.testing.assert_allclose(rows, planes, rtol=0, atol=1e-12)
    rows, planes = both(guide, image, np.ones(size, bool), eps)
    np.testing.assert_allclose(rows, planes, rtol=0, atol=1e-12)
    expected = oracle.guided_filter(
        *(np.moveaxis(x, 0, -1) for x in (guide, image)), radius=radius, eps=eps.T.swapaxes(0, 1)
    )
    np.testing.assert_allclose(planes, np.moveaxis(expected, -1, 0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("g", [1, 3])
def test_other_libraries_agree_away_from_the_border(g):
    """cv2.ximgproc.guidedFilter(guide, src, radius, eps) and kornia.filters.guided_blur(guide, src, kernel_size, eps).

    OpenCV takes the radius, kornia the window's width; both mirror at the border, where this filter crops, so all
    agree 2 radius from it. In all of them eps is inside the sum: Σ/n + eps.
    """
    (guide, image), radius, eps = images(3, (34, 41), g, 3), 4, 0.02
    guide, image = guide.astype(np.float32), image.astype(np.float32)
    found = run(guide, image, eps=eps, radius=radius)
    inside = np.s_[2 * radius : -2 * radius, 2 * radius : -2 * radius]
    np.testing.assert_allclose(
        found[inside], cv2.ximgproc.guidedFilter(guide, image, radius, eps)[inside], rtol=0, atol=5e-6
    )
    planes = [torch.tensor(x).movedim(-1, 0)[None] for x in (guide, image)]
    theirs = kornia.filters.guided_blur(*planes, 2 * radius + 1, eps)[0].movedim(0, -1).numpy()
    np.testing.assert_allclose(found[inside], theirs[inside], rtol=0, atol=5e-6)


# --- Laws


def test_constants_pass():
    guide, _ = images()
    for value in (0.0, 0.7, -3e4):
        np.testing.assert_allclose(run(guide, constant(value), eps=PER_CHANNEL), value, rtol=1e-6)
        found = run(*mask(guide, constant(value)), eps=PER_CHANNEL)
        np.testing.assert_allclose(found[..., 1], value, rtol=2.0**-8)  # a window without pixels gives 8 bits
        np.testing.assert_allclose(found[:8, :8, 1], value, rtol=1e-6)


def test_it_is_linear_in_the_image():
    guide, a = images()
    b = images(2)[1]
    found = run(guide, 2.0 * a - 3.0 * b, eps=PER_CHANNEL)
    expected = 2.0 * run(guide, a, eps=PER_CHANNEL) - 3.0 * run(guide, b, eps=PER_CHANNEL)
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-6)


def test_offsets_commute():
    guide, image = images()
    plain = run(guide, image, eps=PER_CHANNEL)
    np.testing.assert_allclose(run(guide, image + 64.0, eps=PER_CHANNEL) - 64.0, plain, rtol=0, atol=64.0 * 2.0**-21)
    np.testing.assert_allclose(run(guide + [4.0, -64.0, 16.0], image, eps=PER_CHANNEL), plain, rtol=0, atol=5e-5)


def test_a_scaled_guide_needs_scaled_eps():
    """Per channel: eps for each is the same as channels of other size with one eps. Powers of two, so bit for bit."""
    guide, image = images()
    plain = run(guide, image, eps=PER_CHANNEL)
    for scale in (np.full(3, 2.0**13), np.array([2.0, 0.25, 1024.0])):
        np.testing.assert_array_equal(run(guide * scale, image, eps=PER_CHANNEL * scale**2), plain)
    one = run(guide / np.sqrt(PER_CHANNEL), image, eps=np.ones(3))
    np.testing.assert_allclose(one, plain, rtol=0, atol=2e-6)


def test_channels_of_the_image_do_not_meet():
    guide, image = images()
    plain, other = run(guide, image, eps=PER_CHANNEL), image.copy()
    other[..., 1] = 5.0 - 100.0 * other[..., 1] ** 2
    np.testing.assert_array_equal(run(guide, other, eps=PER_CHANNEL)[..., 0], plain[..., 0])
    np.testing.assert_array_equal(run(guide, image[..., ::-1], eps=PER_CHANNEL), plain[..., ::-1])


def test_channels_of_the_guide_have_no_order():
    guide, image = images()
    found = run(guide[..., [2, 0, 1]], image, eps=PER_CHANNEL[[2, 0, 1]])
    np.testing.assert_allclose(found, run(guide, image, eps=PER_CHANNEL), rtol=0, atol=2e-6)
    # One that is constant tells nothing.
    levels = [run(np.where(np.arange(3) == 1, level, guide), image, eps=PER_CHANNEL) for level in (0.0, 0.5, 40.0)]
    np.testing.assert_allclose(levels[1:], [levels[0]] * 2, rtol=0, atol=2e-6)


def test_mirrored_images_give_mirrored_results():
    guide, image = images()
    plain = run(guide, image, eps=PER_CHANNEL)
    for turn in (np.flipud, np.fliplr):
        np.testing.assert_allclose(run(turn(guide), turn(image), eps=PER_CHANNEL), turn(plain), rtol=0, atol=2e-6)


def test_limits_of_eps():
    """Small: what is linear in the guide passes. Large: the box mean of the box mean."""
    guide, image = images()
    linear = guide @ [[1.0, -2.0], [0.5, 3.0], [-1.0, 0.25]] + 2.0
    np.testing.assert_allclose(run(guide, linear, eps=np.full(3, 1e-6)), linear, rtol=0, atol=1e-4)
    tent = oracle.of_windows(oracle.of_windows(image, 2, oracle.mean), 2, oracle.mean)
    np.testing.assert_allclose(run(guide, image, eps=np.full(3, 1e12)), tent, rtol=0, atol=1e-6)


def test_its_own_guide_keeps_steps_and_smooths_noise(rng):
    step = np.where(np.arange(WIDTH)[:, None] < 8, 0.2, 0.8) * np.ones((*SIZE, 1))
    noisy = step + rng.normal(scale=0.02, size=(*SIZE, 1))
    found = run(noisy, noisy, eps=np.array(0.01))
    away = np.s_[:, [0, 1, 2, 3, 12, 13, 14, 15]]
    assert np.std((found - step)[away]) < 0.4 * np.std((noisy - step)[away])
    assert (found[:, 8] - found[:, 7]).min() > 0.5


# --- Rounding


def test_windows_that_are_singular_but_for_eps():
    """A flat guide, channels that are equal, and nearly flat ones, with eps far below the rounding of a variance."""
    guide, image = images()
    tent = oracle.of_windows(oracle.of_windows(image, 2, oracle.mean), 2, oracle.mean)
    tiny = np.full(3, 1e-12)
    for level, eps in ((0.0, tiny), (0.3, tiny), (0.7, tiny), (1.0, tiny), (100.3, 1e6 * tiny), (1e4, 1e6 * tiny)):
        np.testing.assert_allclose(run(np.full_like(guide, level), image, eps=eps), tent, rtol=0, atol=1e-6)
    same = np.repeat(guide[..., :1], 3, axis=-1)
    expected = oracle.guided_filter(same, image, radius=2, eps=1e-6)
    np.testing.assert_allclose(run(same, image, eps=np.full(3, 1e-6)), expected, rtol=0, atol=2e-5)
    assert np.abs(run(same, image, eps=tiny)).max() < 3.0
    half_flat = np.where(np.arange(WIDTH)[:, None] < 8, 0.3, guide)
    assert np.abs(run(half_flat, image, eps=tiny)).max() < 30.0


def test_a_large_offset_of_the_guide():
    """At 1e4 above a contrast of 1, float32 holds the guide itself to 10⁻³ only; eps is 0.01 to 0.1."""
    guide, image = images()
    guide = np.float32(guide + 1e4).astype(np.float64)
    expected = oracle.guided_filter(guide - 1e4, image, radius=2, eps=PER_CHANNEL)
    np.testing.assert_allclose(run(guide, image, eps=PER_CHANNEL), expected, rtol=0, atol=1e-3)


def test_what_a_spike_leaves_behind():
    """Nothing in windows far from it, but what the shift of the mean rounds off; on a CPU only as soon as running sums
    have started afresh: until then the rows below keep a rounding of the spike's size, shared by a window's pixels."""
    radius, height, row = 2, 120, 40
    guide, image = images(4, (height, 9), 1, 1)
    spiked = image.copy()
    spiked[row, 4] = 1e6
    planes = quick(functools.partial(filter_planes, radius=radius))
    in_planes = [np.moveaxis(x, -1, 0).astype(np.float32) for x in (guide, image)]
    valid, eps = np.ones((height, 9), bool), np.full((1, 1, 1), 0.01, np.float32)
    above, below = np.s_[: row - 2 * radius], np.s_[row + 2 * radius + 1 :]
    with_spike = [in_planes[0], np.moveaxis(spiked, -1, 0).astype(np.float32)]
    results = [np.asarray(planes(*pair, valid, eps))[0] for pair in (in_planes, with_spike)]
    for far in (above, below):
        np.testing.assert_array_equal(results[1][far], results[0][far])
    exact = oracle.guided_filter(guide, spiked, radius=radius, eps=0.01)
    error = np.abs(run(guide, spiked, radius=radius, eps=0.01) - exact)
    mean, unit = 1e6 / (height * 9), 2.0**-24
    afresh = -(-(row + 2 * radius + 4) // restart_rows(radius)) * restart_rows(radius) + 2 * radius
    assert error[above].max() < 16.0 * unit * mean
    assert error[afresh:].max() < 16.0 * unit * mean
    assert error[below].max() < 4.0 * unit * 1e6 / radius
    assert np.abs(exact[row, 4]) > 1e4


@pytest.mark.parametrize("half", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_computed_in_float32(half):
    guide, image = (jnp.asarray(x, half) for x in images())
    found = _compiled(guide, image, eps=jnp.asarray(PER_CHANNEL, half), radius=2)
    assert found.dtype == half
    wide = run(
        guide.astype(jnp.float32), image.astype(jnp.float32), eps=jnp.asarray(PER_CHANNEL, half).astype(jnp.float32)
    )
    np.testing.assert_allclose(found.astype(jnp.float32), wide, rtol=jnp.finfo(half).eps, atol=1e-6)


def test_edge_aware_eps_of_a_half_precision_guide_does_not_vanish():
    """In float16 eps / Γ is below the smallest number here, and flat windows would be singular."""
    guide = np.where(np.arange(WIDTH) < 8, 0.25, 0.75) * np.ones(SIZE)
    aware = quick(functools.partial(edge_aware_eps, eps=1e-4))
    eps = aware(jnp.asarray(guide[..., None], jnp.float16))
    assert eps.dtype == jnp.float32 and eps.min() > 0.0
    np.testing.assert_allclose(eps, aware(jnp.asarray(guide[..., None], jnp.float32)), rtol=1e-3)


# --- Its options


def test_edge_aware_eps_is_that_of_the_paper(rng, x64):
    """Γ(p) = mean over q of (v(p) + λ) / (v(q) + λ), v the variance in 3 x 3 pixels."""
    guide, eps = images()[0] * 7.0, rng.uniform(0.01, 0.1, size=3)
    v = oracle.of_windows(guide, 1, oracle.variance).sum(-1) + (0.001 * (guide.max() - guide.min())) ** 2
    gamma = np.array([[np.mean(here / v) for here in row] for row in v])
    found = quick(edge_aware_eps)(guide, eps=eps)
    np.testing.assert_allclose(found, eps / gamma[..., None], rtol=1e-10)
    image = images()[1]
    aware = run(guide, image, eps=np.array(0.5), edge_aware=True)
    ridge = quick(edge_aware_eps)(guide, eps=0.5)
    np.testing.assert_allclose(aware, run(guide, image, eps=ridge), rtol=0, atol=1e-12)


def test_edge_aware_eps_is_small_at_edges():
    guide = np.where(np.arange(WIDTH)[:, None] < 8, 0.2, 0.8) * np.ones((*SIZE, 1))
    eps = np.asarray(quick(edge_aware_eps)(jnp.asarray(guide, jnp.float32), eps=0.01))[..., 0]
    assert (eps[:, 7:9] < 1e-3 * eps[:, :1]).all()
    np.testing.assert_allclose(eps[:, :6], eps[0, 0], rtol=0.05)  # λ is not far above the rounding of a variance


@pytest.mark.parametrize("step", [2, 3])
def test_coefficients_of_block_means(step, x64):
    """A guide and an image of blocks: away from their seams a subsampled filter is the filter of the small images."""
    small_guide, small_image = images(5, (5, 6), 2, 1)
    crop = np.s_[: 5 * step - 1, : 6 * step - 1]  # the last blocks are one pixel short
    guide, image = (np.kron(x, np.ones((step, step, 1)))[crop] for x in (small_guide, small_image))
    found = run(guide, image, eps=0.02, radius=2 * step, subsample=step)
    coefficients = [
        oracle.of_windows(np.array(x), 2, oracle.mean)
        for x in regression_coefficients(small_guide, small_image, 2, 0.02)
    ]
    a, b = (bilinear(x, step)[crop] for x in coefficients)
    np.testing.assert_allclose(found, np.sum(a * guide, -1, keepdims=True) + b, rtol=0, atol=1e-12)


def regression_coefficients(guide, image, radius, eps):
    """a (h, w, g) and b (h, w, 1) of the windows, for an image of one channel."""
    a, b = np.zeros(guide.shape), np.zeros(image.shape)
    for y, x, window in oracle.windows(*guide.shape[:2], radius):
        inside, wanted = guide[window].reshape(-1, guide.shape[2]), image[window].reshape(-1)
        covariance = np.cov(inside.T, bias=True) + eps * np.eye(guide.shape[2])
        a[y, x] = np.linalg.solve(covariance, (inside - inside.mean(0)).T @ wanted / len(wanted))
        b[y, x] = wanted.mean() - a[y, x] @ inside.mean(0)
    return a, b


def bilinear(x, step: int) -> np.ndarray:
    """As cv2.resize enlarges: pixel centres aligned, the outermost values beyond."""
    size = (x.shape[1] * step, x.shape[0] * step)
    return np.stack([cv2.resize(x[..., k], size, interpolation=cv2.INTER_LINEAR) for k in range(x.shape[2])], axis=-1)


# --- Masked pixels, batches, bad input


def test_a_masked_pixel_is_not_there():
    """What it holds beside its NaN changes nothing; with a finite guide it is filled in."""
    guide, image = images()
    image[5, 5] = np.nan, 0.3
    first = run(guide, image, eps=PER_CHANNEL)
    image[5, 5] = 1e30, np.inf
    np.testing.assert_array_equal(run(guide, image, eps=PER_CHANNEL), first)
    linear = guide @ [[1.0, -2.0], [0.5, 3.0], [-1.0, 0.25]]
    holes = linear.copy()
    holes[[2, 5, 9], [3, 5, 0]] = np.nan
    np.testing.assert_allclose(run(guide, holes, eps=np.full(3, 1e-6)), linear, rtol=0, atol=1e-3)


def test_images_without_valid_pixels():
    guide, image = images()
    for pair in ((np.full_like(guide, np.nan), image), (guide, np.full_like(image, np.inf))):
        assert not run(*pair, eps=PER_CHANNEL).any()


def test_a_batch_is_its_images_and_jit_changes_nothing():
    with jax.debug_nans(False):
        pairs = [[jnp.asarray(x, jnp.float32) for x in pair] for pair in (images(), mask(*images(2)), images(3))]
        one = functools.partial(guided_filter, radius=2, eps=jnp.asarray(PER_CHANNEL, jnp.float32))
        together = quick(jax.vmap(one))(*(jnp.stack(x) for x in zip(*pairs, strict=True)))
        for found, pair in zip(together, pairs, strict=True):
            np.testing.assert_allclose(found, run(*pair, eps=PER_CHANNEL), rtol=0, atol=1e-6)
    np.testing.assert_allclose(one(*pairs[0]), together[0], rtol=0, atol=1e-6)


def test_a_pixel_depends_on_its_surroundings_alone():
    """On 2 radius pixels around it: no sum leaks over rows or columns."""
    guide, image = images(6, (34, 41), 3, 3)
    whole = run(guide, image, eps=0.02, radius=4)
    y, x = 12, 20
    direct = oracle.guided_filter(
        guide[y - 8 : y + 9, x - 8 : x + 9], image[y - 8 : y + 9, x - 8 : x + 9], radius=4, eps=0.02
    )
    np.testing.assert_allclose(whole[y, x], direct[8, 8], rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("guide", "image", "options", "error", "message"),
    [
        (
            (4, 5, 1),
            (5, 4, 1),
            {},
            ValueError,
            r"guide and image: expected \(h, w, g\) and \(h, w, c\), got \(4, 5, 1\)",
        ),
        ((4, 5), (4, 5, 1), {}, ValueError, "guide and image: expected"),
        ((4, 5, 1), (4, 5, 1), {"radius": -1}, ValueError, "radius: expected a value >= 0, got -1"),
        ((4, 5, 1), (4, 5, 1), {"subsample": 0}, ValueError, "subsample: expected a value >= 1, got 0"),
        (
            (4, 5, 3),
            (4, 5, 1),
            {"eps": np.ones(2)},
            ValueError,
            r"eps: expected shape \(\), \(3,\), or \(4, 5, 1 or 3\)",
        ),
        ((4, 5, 3), (4, 5, 1), {"eps": np.ones((4, 5, 2))}, ValueError, r"eps: .*got \(4, 5, 2\)"),
        ((4, 5, 3), (4, 5, 1), {"eps": np.ones((5, 4, 1))}, ValueError, "eps: expected"),
        ((4, 5, 3), (4, 5, 1), {"eps": np.ones(2), "edge_aware": True}, ValueError, "eps: expected"),
        ((0, 5, 3), (0, 5, 1), {}, ValueError, "not empty"),
        ((4, 5, 3), (4, 5, 1), {"eps": 0.0}, ValueError, "eps: expected finite numbers above 0, got 0.0"),
        ((4, 5, 3), (4, 5, 1), {"eps": -1.0, "edge_aware": True}, ValueError, "eps: .*above 0, got -1.0"),
        ((4, 5, 3), (4, 5, 1), {"eps": np.array([0.1, np.nan, 0.1])}, ValueError, "eps: .*above 0, got nan"),
        ((4, 5, 3), (4, 5, 1), {"radius": 2.5}, ValueError, "radius: expected a whole number >= 0, got 2.5"),
        ((4, 5, 3), (4, 5, 1), {"subsample": 1.5}, ValueError, "subsample: expected a whole number >= 1, got 1.5"),
    ],
)
def test_bad_input_is_refused(guide, image, options, error, message):
    with pytest.raises(error, match=message):
        jax.eval_shape(
            functools.partial(guided_filter, **{"radius": 1, "eps": 0.1} | options), jnp.zeros(guide), jnp.zeros(image)
        )


def test_whole_numbers_are_refused():
    with pytest.raises(TypeError, match="floating-point"):
        guided_filter(jnp.zeros((3, 4, 1), jnp.int32), jnp.zeros((3, 4, 1)), radius=1, eps=0.1)
