"""Textures against torch's grid_sample, brute force in NumPy, supersampling, and the reference's numbers."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from jaxrender.deferred.texture import (
    build_textures,
    footprint_axes,
    mip_chain,
    mip_sizes,
    sample_bilinear,
    sample_ewa,
    sample_texture_grad,
    sample_trilinear,
    texture_derivatives,
    texture_lod,
)

FILTERS = (sample_texture_grad, sample_ewa)


def light(*shape: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float32)


def float32(x) -> jax.Array:
    return jnp.asarray(np.asarray(x, np.float32))


def run(function, *arguments, **options):
    """Compiled as one program, and with little optimisation: compiling is nearly all of the time here."""
    compiled = jax.jit(functools.partial(function, **options), compiler_options={"xla_backend_optimization_level": 0})
    return compiled(*arguments)


def level_of(textures, layer: int, level: int) -> np.ndarray:
    start, w, h = (int(t[layer, level]) for t in (textures.offset, textures.width, textures.height))
    return np.asarray(textures.texels[start : start + w * h]).reshape(h, w, 4)


# --- Building


def test_bytes_are_decoded_once_and_alpha_is_linear():
    image = np.array([[[0, 128, 255, 128], [10, 11, 188, 0]]], np.uint8)
    # IEC 61966-2-1: 10 / 255 / 12.92; ((c + 0.055) / 1.055)^2.4 above 0.04045 * 255 = 10.3.
    expected = [[0.0, 0.21586050, 1.0, 128 / 255], [0.0030352698, 0.0033465358, 0.50288646, 0.0]]
    np.testing.assert_allclose(level_of(build_textures([image]), 0, 0)[0], expected, rtol=1e-6)
    np.testing.assert_allclose(level_of(build_textures([image], srgb=False), 0, 0), image / 255.0, rtol=1e-6)
    np.testing.assert_array_equal(level_of(build_textures([light(2, 3, 3)]), 0, 0)[..., 3], 1.0)


def test_tables_waste_nothing():
    shapes = [(5, 7), (1, 1), (16, 2), (3, 64)]
    textures = build_textures(
        [light(h, w, 3) for h, w in shapes], wrap=["repeat", "clamp", "mirror", ("clamp", "repeat")]
    )
    assert textures.num_levels.tolist() == [3, 1, 5, 7]
    assert textures.wrap.tolist() == [[0, 0], [1, 1], [2, 2], [1, 0]]
    assert len(textures.texels) == sum(h * w for shape in shapes for h, w in mip_sizes(*shape))
    assert (textures.width[3].tolist(), textures.height[3].tolist()) == (
        [64, 32, 16, 8, 4, 2, 1],
        [3, 1, 1, 1, 1, 1, 1],
    )
    levels = np.stack([textures.offset, textures.width * textures.height], -1).reshape(-1, 2)
    levels = np.unique(levels, axis=0)  # in order of offset; the padding of the tables repeats the last one
    np.testing.assert_array_equal(levels[:, 0], np.cumsum(levels[:, 1]) - levels[:, 1])


@pytest.mark.parametrize("shape", [(8, 8), (5, 7), (13, 6), (1, 9)])
def test_levels_keep_the_mean_and_constants(shape):
    chain = np.asarray(run(mip_chain, jnp.asarray(light(*shape, 4))))
    sizes = [h * w for h, w in mip_sizes(*shape)]
    levels = np.split(chain, np.cumsum(sizes)[:-1])
    for level in levels:
        np.testing.assert_allclose(level.mean(0), levels[0].mean(0), rtol=1e-6)
    np.testing.assert_allclose(run(mip_chain, jnp.full((*shape, 4), 0.7)), 0.7, rtol=2e-7)


def test_an_even_level_is_the_2x2_box():
    image = light(4, 6, 4)
    second = np.asarray(run(mip_chain, jnp.asarray(image)))[24:30].reshape(2, 3, 4)
    np.testing.assert_allclose(second, image.reshape(2, 2, 3, 2, 4).mean((1, 3)), rtol=1e-6)


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        ([], {}, "number of images"),
        ([light(2, 2, 2)], {}, r"image 0: shape: expected \(h, w, 3\)"),
        ([light(2, 2, 3), light(0, 2, 3)], {}, "image 1: shape"),
        ([np.zeros((2, 2, 3), np.int32)], {}, "image 0: dtype: expected uint8"),
        ([np.full((1, 1, 3), np.nan, np.float32)], {}, "image 0: texels: expected finite"),
        ([light(2, 2, 3)], {"wrap": "border"}, "wrap: expected one of repeat"),
        ([light(2, 2, 3)], {"wrap": ["clamp", "clamp"]}, "wrap: expected one for each of 1"),
        ([light(2, 2, 3)], {"srgb": [True, False]}, "srgb: expected one for each of 1"),
    ],
)
def test_bad_images_are_refused(images, options, message):
    with pytest.raises(ValueError, match=message):
        build_textures(images, **options)


# --- Bilinear and trilinear


@pytest.mark.parametrize(("wrap", "mode"), [("clamp", "border"), ("mirror", "reflection")])
def test_bilinear_is_that_of_grid_sample(rng, wrap, mode):
    image, uv = light(5, 8, 4), rng.uniform(-2, 3, (400, 2)).astype(np.float32)
    found = run(sample_bilinear, build_textures([image], wrap=wrap), 0, jnp.asarray(uv), level=0)
    grid = torch.tensor(uv * 2.0 - 1.0, dtype=torch.float64)[None, None]
    source = torch.tensor(image, dtype=torch.float64).permute(2, 0, 1)[None]
    expected = torch.nn.functional.grid_sample(source, grid, padding_mode=mode, align_corners=False)[0, :, 0].T
    # Positions of up to 24 texels, rounded to 24 bits.
    np.testing.assert_allclose(found, expected, atol=4e-6)


@pytest.mark.parametrize("wrap", ["repeat", "mirror"])
def test_bilinear_of_a_wrapped_image_is_that_of_its_tiles(rng, wrap):
    image, uv = light(3, 4, 4), rng.uniform(-1.5, 1.5, (200, 2)).astype(np.float32)
    index = np.r_[0:4, 0:4, 0:4, 0:4] if wrap == "repeat" else np.r_[0:4, 3:-1:-1, 0:4, 3:-1:-1]
    rows = np.r_[0:3, 0:3, 0:3, 0:3] if wrap == "repeat" else np.r_[0:3, 2:-1:-1, 0:3, 2:-1:-1]
    tiles = image[rows][:, index].astype(np.float64)
    place = (uv.astype(np.float64) + 2.0) * [4, 3] - 0.5
    corner = np.floor(place).astype(int)
    expected = np.zeros((200, 4))
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = corner[:, 0] + dx, corner[:, 1] + dy
            expected += ((1 - np.abs(place[:, 0] - x)) * (1 - np.abs(place[:, 1] - y)))[:, None] * tiles[y, x]
    found = run(sample_bilinear, build_textures([image], wrap=wrap), 0, jnp.asarray(uv), level=0)
    np.testing.assert_allclose(found, expected, atol=4e-6)


def test_the_origin_is_the_upper_left_corner():
    image = light(2, 3, 4)
    textures = build_textures([image], wrap="clamp")
    uv = float32([[0, 0], [1, 0], [0, 1], [1 / 6, 0.25], [0.5, 0.75], [np.inf, -np.inf]])
    found = run(sample_bilinear, textures, 0, uv, level=0)
    np.testing.assert_allclose(found, image[[0, 0, 1, 0, 1, 0], [0, 2, 0, 0, 1, 0]], rtol=1e-5)


def test_layers_and_levels_clamp_and_stay_apart(rng):
    images = [np.full((4, 4, 4), k, np.float32) for k in range(3)]
    uv = jnp.asarray(rng.uniform(-2, 2, (6, 2)), jnp.float32)
    layer = jnp.asarray([-5, 0, 1, 2, 3, 99])
    textures = build_textures(images)
    wanted = np.repeat([0, 0, 1, 2, 2, 2], 4).reshape(6, 4)
    np.testing.assert_allclose(run(sample_bilinear, textures, layer, uv, level=7), wanted, atol=1e-6)
    np.testing.assert_allclose(run(sample_trilinear, textures, layer, uv, lod=1.3), wanted, atol=1e-6)
    for sample in FILTERS:
        np.testing.assert_allclose(run(sample, textures, uv, uv, uv, layer=layer), wanted, atol=2e-6)


def test_trilinear_mixes_neighbouring_levels():
    textures, uv = build_textures([light(8, 8, 4)]), jnp.asarray(light(5, 2))
    one, two, last = (run(sample_bilinear, textures, 0, uv, level=l) for l in (1, 2, 3))
    mixed = run(sample_trilinear, textures, 0, uv, lod=1.25)
    np.testing.assert_allclose(mixed, 0.75 * one + 0.25 * two, rtol=1e-5)
    np.testing.assert_allclose(run(sample_trilinear, textures, 0, uv, lod=1e9), last, rtol=1e-6)
    np.testing.assert_allclose(last, np.broadcast_to(np.mean(level_of(textures, 0, 0), (0, 1)), (5, 4)), rtol=1e-6)


# --- Footprints


def test_the_footprint_of_nearly_parallel_derivatives():
    """Reference sheet, section 6: axes 11.3 x 0.007, where the formula of the EXT extension sees 8 x 8."""
    major, minor, direction = run(footprint_axes, float32([8, 0.01]), float32([8, 0.02]))
    np.testing.assert_allclose([major, minor], [11.31373, 0.00707105], rtol=1e-5)
    np.testing.assert_allclose(np.abs(direction), [1.0, 0.001875], atol=1e-5)
    textures = build_textures([light(64, 64, 4)])
    dx, dy = float32([[8 / 64, 0.01 / 64]]), float32([[8 / 64, 0.02 / 64]])
    np.testing.assert_allclose(run(texture_lod, textures, dx, dy), 3.0, atol=1e-5)
    # Level log2(11.3 / 16) < 0, hence taps one texel apart in effect: ceil(11.3) = 12 of them on the base level.
    uv = np.array([0.3, 0.6])
    along = (np.arange(12) / 11 - 0.5)[:, None] * (11.31373 - 1.0) * np.array([1.0, 0.001875])
    taps = run(sample_bilinear, textures, 0, float32(uv + along / 64), level=0)
    found = run(sample_texture_grad, textures, float32(uv[None]), dx, dy)
    np.testing.assert_allclose(found[0], np.mean(taps, axis=0), atol=1e-5)


def test_axes_are_singular_values(rng):
    matrices = rng.normal(size=(200, 2, 2)) * np.exp(rng.uniform(-12, 12, (200, 1, 1)))
    matrices[:3] = np.diag([3.0, 1.0]), np.diag([1.0, 3.0]), [[1, -2], [2, 1]]
    u, s, _ = np.linalg.svd(matrices.astype(np.float32).astype(np.float64))
    major, minor, direction = run(footprint_axes, float32(matrices[..., 0]), float32(matrices[..., 1]))
    np.testing.assert_allclose(major, s[:, 0], rtol=1e-6)
    np.testing.assert_allclose(minor / s[:, 0], s[:, 1] / s[:, 0], atol=1e-6)
    apart = s[:, 0] > 1.05 * s[:, 1]
    cosine = np.abs(np.sum(np.asarray(direction) * u[..., 0], axis=-1))
    np.testing.assert_allclose(cosine[apart], 1.0, atol=1e-6)
    np.testing.assert_array_equal(direction[2], [1.0, 0.0])


def test_a_round_footprint_is_trilinear_and_one_tap_is_the_longer_axis():
    textures, uv = build_textures([light(16, 16, 4)]), jnp.asarray(light(6, 2))
    turn = np.array([[0.8, -0.6], [0.6, 0.8]]) * 3.0 / 16
    dx, dy = (float32(np.tile(d, (6, 1))) for d in turn.T)
    expected = run(sample_trilinear, textures, 0, uv, lod=float(np.log2(3.0)))
    np.testing.assert_allclose(run(sample_texture_grad, textures, uv, dx, dy), expected, atol=1e-5)
    np.testing.assert_allclose(
        run(sample_texture_grad, textures, uv, dx, 0.25 * dy, max_anisotropy=1), expected, atol=1e-5
    )


def test_taps_cover_an_aligned_footprint():
    """4 x 2 texels: on level 1, two taps two texels apart, that is next to each other."""
    textures, uv = build_textures([light(16, 32, 4)]), light(6, 2)
    dx, dy = (float32(np.tile(d, (6, 1))) for d in ([4 / 32, 0], [0, 2 / 16]))
    pair = [run(sample_bilinear, textures, 0, float32(uv + [[s / 32, 0]]), level=1) for s in (-1, 1)]
    np.testing.assert_allclose(
        run(sample_texture_grad, textures, jnp.asarray(uv), dx, dy), np.mean(pair, axis=0), atol=1e-5
    )


def brute_force_ewa(image, uv, dx, dy) -> np.ndarray:
    """Heckbert's sum with his A, B, C, F over a repeated image, base level."""
    h, w = image.shape[:2]
    (ux, vx), (uy, vy) = dx * [w, h], dy * [w, h]
    a, b, c = vx * vx + vy * vy + 1, -2 * (ux * vx + uy * vy), ux * ux + uy * uy + 1
    f = a * c - b * b / 4
    y, x = np.mgrid[-3 * h : 4 * h, -3 * w : 4 * w]
    u, v = x - (uv[0] * w - 0.5), y - (uv[1] * h - 0.5)
    q = a * u * u + b * u * v + c * v * v
    weight = np.where(q < f, np.exp(-2 * q / f), 0.0)
    return np.einsum("yx,yxc->c", weight, image[y % h, x % w].astype(np.float64)) / weight.sum()


def test_ewa_is_heckberts_sum(rng):
    image = light(9, 12, 4)
    uv = rng.uniform(0, 1, (12, 2))
    # Rows and columns, slanted both ways, up to 20 x 3.9 texels; one that magnifies.
    shapes = np.array([[1, 0], [0, 1], [3.9, 0.5], [20, 3.0], [12, 3.5], [0.1, 0.01]])[np.arange(12) % 6]
    angle = rng.uniform(0, np.pi, 12)
    angle[:2] = 0.0, np.pi / 2
    axis = np.stack([np.cos(angle), np.sin(angle)], -1)
    dx, dy = shapes[:, :1] * axis / [12, 9], shapes[:, 1:] * axis[:, ::-1] * [-1, 1] / [12, 9]
    found = run(sample_ewa, build_textures([image]), float32(uv), float32(dx), float32(dy), max_radius=24)
    expected = [brute_force_ewa(image, *row) for row in zip(uv, dx, dy, strict=True)]
    np.testing.assert_allclose(found, expected, atol=2e-5)


def tilted_plane(size: int):
    """uv of a floor that runs to the horizon, at pixel centres, as a function of pixel coordinates."""

    def uv_at(x, y):
        depth = size / (y + 0.06 * size)
        return np.stack([(x / size - 0.5) * depth + 0.3 * depth, depth], axis=-1)

    return uv_at


def patterns(n: int) -> list[np.ndarray]:
    y, x = np.mgrid[0:n, 0:n]
    checkers = ((x // 4 + y // 4) % 2).astype(np.float32)
    zone = 0.5 + 0.5 * np.cos(0.5 * np.pi * ((x - n / 2) ** 2 + (y - n / 2) ** 2) / n)
    return [np.repeat(p[..., None], 3, -1).astype(np.float32) for p in (checkers, zone)]


def test_better_filters_come_closer_to_supersampling():
    """A floor of checkers, and one of zone plates, against 8 x 8 samples per pixel of the base level."""
    size, m = 32, 8
    uv_at, textures = tilted_plane(size), build_textures(patterns(64))
    y, x = np.mgrid[0:size, 0:size] + 0.5
    dx, dy = uv_at(x + 0.5, y) - uv_at(x - 0.5, y), uv_at(x, y + 0.5) - uv_at(x, y - 0.5)
    sub = (np.mgrid[0 : (size + 2) * m, 0 : (size + 2) * m] + 0.5) / m - 1.0
    fine, coarse, dx, dy = (float32(v) for v in (uv_at(sub[1], sub[0]), uv_at(x, y), dx, dy))
    offset = (np.arange(3 * m) + 0.5) / m - 1.5
    r2 = offset[:, None] ** 2 + offset**2
    box = (np.maximum(abs(offset)[:, None], abs(offset)) < 0.5).astype(float)
    gaussian = np.where(r2 < 1.0, np.exp(-2.0 * r2), 0.0)
    for layer in range(2):
        dense = np.asarray(run(sample_bilinear, textures, layer, fine, level=0))
        windows = np.lib.stride_tricks.sliding_window_view(dense, (3 * m, 3 * m), axis=(0, 1))[::m, ::m]
        blurred = run(sample_trilinear, textures, layer, coarse, lod=run(texture_lod, textures, dx, dy, layer=layer))
        # A mip chain and its taps stand for a box over the pixel, EWA for a Gaussian over two pixels.
        for sample, kernel in zip(FILTERS, (box, gaussian), strict=True):
            truth = np.einsum("hwcyx,yx->hwc", windows, kernel / kernel.sum())
            image = run(sample, textures, coarse, dx, dy, layer=layer)
            errors = [float(np.sqrt(np.mean((np.asarray(i) - truth) ** 2))) for i in (image, blurred)]
            assert errors[0] < 0.6 * errors[1], (sample.__name__, layer, errors)


# --- Gradients, and the ends of the range


@pytest.mark.parametrize("sample", FILTERS)
def test_gradients_are_finite_differences(sample, rng):
    """A smooth texture in float64. Where a texel, level or tap changes within the step, the slope is another."""
    with jax.enable_x64(True):
        y, x = np.mgrid[0:16, 0:16] * (2 * np.pi / 16)
        waves = np.stack([np.sin(x), np.cos(y), np.sin(x + y), np.cos(x - y)], axis=-1)
        textures = build_textures([waves])
        point = rng.uniform(0, 1, (20, 2)), rng.uniform(-0.2, 0.2, (20, 2)), rng.uniform(-0.05, 0.05, (20, 2))
        weights = jnp.asarray([1.0, 2.0, -1.0, 0.5])

        def mix(*p):
            return jnp.einsum("...c,c->...", sample(textures, *p), weights)

        slopes = run(jax.grad(lambda *p: mix(*p).sum(), argnums=(0, 1, 2)), *point)
        along = [rng.normal(size=(20, 2)) for _ in point]
        predicted = sum(np.sum(s * a, axis=-1) for s, a in zip(slopes, along, strict=True))
        steps = np.array([-1e-6, 1e-6])[:, None, None]
        ends = np.asarray(run(mix, *(p + steps * a for p, a in zip(point, along, strict=True))))
        found = (ends[1] - ends[0]) / 2e-6
        close = np.isclose(found, predicted, rtol=1e-5, atol=1e-5)
        assert close.sum() >= 19, (found, predicted)


def test_gradients_of_texels_are_the_weights():
    textures, uv, d = build_textures([light(8, 8, 4)]), jnp.asarray(light(5, 2)), 0.2 * jnp.asarray(light(2, 5, 2))
    for sample in FILTERS:
        value = lambda t: sample(dataclasses.replace(textures, texels=t), uv, d[0], d[1]).sum()  # noqa: B023, E731
        result, weights = run(jax.value_and_grad(value), textures.texels)
        np.testing.assert_allclose(weights.sum(), 20.0, rtol=1e-5)
        np.testing.assert_allclose(
            jnp.sum(weights * textures.texels), result, rtol=1e-5
        )  # lookups are linear in texels


def test_an_image_can_be_found_through_its_levels():
    uv = jnp.asarray(light(9, 2))
    total = lambda image: sample_trilinear(build_textures([image]), 0, uv, lod=1.5)[:, :3].sum()  # noqa: E731
    slope = run(jax.grad(total), jnp.asarray(light(4, 4, 3)))
    np.testing.assert_allclose(slope.sum(), 27.0, rtol=1e-5)


@pytest.mark.parametrize("sample", FILTERS)
def test_any_derivative_has_a_finite_answer(sample):
    """Nothing, subnormal, huge, infinite, NaN: the finest or the coarsest level, and finite slopes."""
    image = light(8, 4, 3)
    textures = build_textures([image])
    values = np.array([0.0, 1e-30, 1e-20, 1e-7, 1e5, 1e30, 3e38, np.inf, -np.inf, np.nan], np.float32)
    pairs = np.stack(np.meshgrid(values, values), -1).reshape(-1, 2)
    dx, dy = np.repeat(pairs, 4, 0), np.tile(pairs[[0, 12, 57, 99]], (100, 1))
    with jax.debug_nans(False):
        uv = jnp.asarray(light(400, 2))
        arguments = uv, jnp.asarray(dx), jnp.asarray(dy)
        options = {"max_radius": 4} if sample is sample_ewa else {}

        def total(texels, *rest):  # of texels as well: an entry of 0 · inf would show there
            result = sample(dataclasses.replace(textures, texels=texels), *rest, **options)
            return result.sum(), result

        every = jax.grad(total, argnums=(0, 1, 2, 3), has_aux=True)
        slopes, result = jax.tree.map(np.asarray, run(every, textures.texels, *arguments))
        assert np.isfinite(result).all() and all(np.isfinite(s).all() for s in slopes)
        largest = np.nan_to_num(np.abs(np.concatenate([dx, dy], -1)), nan=0.0).max(-1)
        mean = np.append(image.mean((0, 1)), 1.0)
        # With 16 taps along a line, and on the coarsest level, nothing but the mean can come out.
        np.testing.assert_allclose(result[largest >= 1e5], np.tile(mean, ((largest >= 1e5).sum(), 1)), atol=1e-6)
        finest = run(sample, textures, uv, 0.0 * uv, 0.0 * uv, **options)
        np.testing.assert_allclose(result[largest <= 1e-7], finest[largest <= 1e-7], atol=1e-5)


def test_jit_vmap_and_leading_axes_change_nothing(rng):
    textures = build_textures([light(8, 4, 3), light(6, 6, 4)])
    uv, dx, dy = (jnp.asarray(rng.normal(size=(2, 3, 2)) * s, jnp.float32) for s in (1.0, 0.3, 0.1))
    layer = jnp.asarray([[0, 1, 1], [1, 0, 0]])
    whole = run(sample_texture_grad, textures, uv, dx, dy, layer=layer)
    assert whole.shape == (2, 3, 4) and whole.dtype == jnp.float32
    call = lambda u, x, y, k: sample_texture_grad(textures, u, x, y, layer=k)  # noqa: E731
    np.testing.assert_allclose(run(jax.vmap(call), uv, dx, dy, layer), whole, atol=1e-6)
    np.testing.assert_allclose(run(call, uv[1, 2], dx[1, 2], dy[1, 2], 0), whole[1, 2], atol=1e-6)
    eager, lod = sample_trilinear(textures, layer, uv, lod=0.6), jnp.full((2, 3), 0.6)
    np.testing.assert_allclose(run(lambda d: sample_trilinear(textures, layer, uv, lod=d), lod), eager, atol=1e-6)
    assert run(sample_ewa, textures, uv[:0], dx[:0], dy[:0]).shape == (0, 3, 4)
    assert run(sample_texture_grad, textures, uv[:0], dx[:0], dy[:0]).shape == (0, 3, 4)


def test_bad_options_are_refused():
    textures, uv = build_textures([light(2, 2, 3)]), jnp.zeros((1, 2))
    with pytest.raises(ValueError, match="max_anisotropy: expected a value >= 1"):
        sample_texture_grad(textures, uv, uv, uv, max_anisotropy=0)
    with pytest.raises(ValueError, match="max_radius"):
        sample_ewa(textures, uv, uv, uv, max_radius=2)
    with pytest.raises(ValueError, match="duv_dx and duv_dy"):
        sample_texture_grad(textures, uv, uv, uv[0])
    with pytest.raises(ValueError, match=r"uv: expected shape \(..., 2\)"):
        sample_bilinear(textures, 0, jnp.zeros((1, 3)), level=0)


# --- Derivatives of an image of uv


def test_derivatives_of_a_linear_map_are_exact_up_to_the_border():
    y, x = np.mgrid[0:5, 0:6]
    uv = float32(np.stack([0.25 * x - 0.5 * y, 2.0 * y + x], -1))
    dx, dy = run(texture_derivatives, uv, jnp.zeros((5, 6), jnp.int32))
    np.testing.assert_array_equal(dx, np.broadcast_to([0.25, 1.0], (5, 6, 2)))
    np.testing.assert_array_equal(dy, np.broadcast_to([-0.5, 2.0], (5, 6, 2)))


def test_derivatives_do_not_cross_seams():
    """Another layer, a jump of uv (a repeated chart), no texture, and a pixel alone."""
    u = np.array([[0.0, 0.1, 0.2, 9.0, 9.5, 10.0, 0.3, 0.4, 0.5, 0.9, 0.0, 0.0]])
    layer = np.array([[0, 0, 0, 1, 1, 1, 1, 1, 1, 2, -1, -1]])
    dx, dy = run(texture_derivatives, float32(np.stack([u, 0 * u], -1)), jnp.asarray(layer))
    wanted = [0.1, 0.1, 0.1, 0.5, 0.5, 0.5, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(dx[0, :, 0], wanted, atol=1e-6)
    np.testing.assert_array_equal(dy, np.zeros((1, 12, 2)))


def test_derivatives_of_a_floor_agree_with_its_formula():
    """Perspective is not taken for a seam, and central differences are of second order."""
    size = 64
    uv_at = tilted_plane(size)
    y, x = np.mgrid[0:size, 0:size] + 0.5
    dx, dy = run(texture_derivatives, float32(uv_at(x, y)), jnp.zeros((size, size), jnp.int32))
    exact_dx, exact_dy = ((uv_at(x + a, y + b) - uv_at(x - a, y - b)) / 1e-4 for a, b in ((5e-5, 0), (0, 5e-5)))
    np.testing.assert_allclose(dx, exact_dx, atol=1e-4)
    error = np.linalg.norm(dy - exact_dy, axis=-1) / np.linalg.norm(exact_dy, axis=-1)
    assert error[1:-1].max() < 0.06 and error[20:-1].max() < 2e-3


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (0, 3), (1, 2)])
def test_derivatives_of_small_images(shape):
    dx, dy = run(texture_derivatives, jnp.ones((*shape, 2)), jnp.zeros(shape, jnp.int32))
    np.testing.assert_array_equal(dx, np.zeros((*shape, 2)))
    np.testing.assert_array_equal(dy, np.zeros((*shape, 2)))
