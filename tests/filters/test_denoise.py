"""jaxrender.filters.denoiser: sums and parts, what stays, counts, how much cleaner, the rule, cross-validation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters import choice
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.choice import AUTO_EPS, rule
from jaxrender.filters.denoiser import denoise
from jaxrender.filters.guides import make_guides
from jaxrender.filters.settings import DenoiseSettings, apply_filter

HEIGHT, WIDTH = 32, 48
PLAIN = DenoiseSettings(radius=4, eps=1.0, firefly_factor=None)
METHODS = ("guided", "bilateral", "atrous")


@pytest.fixture
def nan_is_a_value():
    """`apply_filter` leaves out what is NaN; `denoise` itself runs whatever the caller set."""
    with jax.debug_nans(False):
        yield


@pytest.fixture
def walls(rng):
    """Two walls that meet, each lit from its own side, and their texture; with the light that is true."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    left = (x < 20)[..., None]
    light = np.where(left, 0.4 + 0.01 * x[..., None], 1.2 - 0.01 * y[..., None]) * np.array([1.0, 0.9, 0.7])
    images = {
        "albedo": rng.uniform(0.2, 0.9, (HEIGHT, WIDTH, 3)),
        "normal": np.where(left, [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]),
        "depth": 5.0 + 0.02 * np.abs(x - 20)[..., None],
    }
    return {name: image.astype(np.float32) for name, image in images.items()}, light.astype(np.float32)


def noise(rng, samples=4.0):
    """Mean 1."""
    return rng.gamma(samples, 1.0 / samples, (HEIGHT, WIDTH, 3)).astype(np.float32)


# --- Sums


@pytest.mark.parametrize("emission", [False, True])
def test_parts_add_up_to_the_picture(rng, walls, emission):
    images, light = walls
    parts = {name: images["albedo"] * light * noise(rng) for name in ("direct", "indirect")}
    parts |= {"emission": (rng.uniform(size=(HEIGHT, WIDTH, 3)) < 0.01).astype(np.float32)} if emission else {}
    clean = denoise(Aovs(sum(parts.values()), **parts, **images), settings=PLAIN)
    assert clean.layers.keys() == parts.keys()
    np.testing.assert_allclose(sum(clean.layers.values()), clean.image, rtol=1e-6)
    for name in parts.keys() - {"indirect"}:
        np.testing.assert_array_equal(clean.layers[name], parts[name])
    # The same indirect light as a picture of its own, without a word about parts.
    alone = denoise(Aovs(parts["indirect"], **images), settings=PLAIN)
    assert alone.layers == {}
    np.testing.assert_array_equal(alone.image, clean.layers["indirect"])
    assert np.abs(clean.layers["indirect"] - parts["indirect"]).max() > 0.1


def test_a_part_that_is_not_finite_is_black(rng, walls):
    images, light = walls
    parts = {name: images["albedo"] * light * noise(rng) for name in ("direct", "indirect")}
    parts["direct"][3, 4, 1] = parts["indirect"][3, 5] = np.nan
    clean = denoise(Aovs(parts["direct"] + parts["indirect"], **parts, **images), settings=PLAIN)
    assert np.isfinite(clean.image).all() and (clean.layers["direct"][3, 4] == 0.0).all()
    # Of the two, one is guessed from around; the other has lost its direct light.
    assert (clean.counts["nan"], clean.counts["filled"], clean.counts["zeroed"]) == (2, 1, 1)
    assert (clean.image[3, 5] > parts["direct"][3, 5]).all()


@pytest.mark.parametrize("method", METHODS)
def test_it_is_linear(rng, walls, method):
    images, light = walls
    settings = dataclasses.replace(PLAIN, method=method)
    first, second = (images["albedo"] * light * rng.uniform(0.8, 1.2, (HEIGHT, WIDTH, 1)) for _ in range(2))
    clean = [
        denoise(Aovs(x.astype(np.float32), **images), settings=settings)
        for x in (first, second, 5 * first, first + second)
    ]
    assert [each.counts["raised"] for each in clean] == [0] * 4
    one, two, five, both = (each.image for each in clean)
    np.testing.assert_allclose(five, 5.0 * one, rtol=1e-5)
    np.testing.assert_allclose(both, one + two, rtol=1e-5)


# --- What stays, and counts


def test_sky_passes_and_pixels_are_counted(rng, walls):
    images, light = walls
    images = {name: image.copy() for name, image in images.items()}
    color = images["albedo"] * light
    sky = np.zeros((HEIGHT, WIDTH), bool)
    sky[:5, 30:] = True
    for image in images.values():
        image[sky] = 0.0
    color[sky] = rng.uniform(size=(sky.sum(), 3))
    color[0, 47, 0] = np.nan  # in the sky, where nothing fills it
    color[10, 10], color[20, 30, 2] = np.nan, np.inf
    color[12, 40] = -0.1
    color[25, 8] *= 100.0
    clean = denoise(Aovs(color, **images), settings=DenoiseSettings(radius=4, eps=1.0))
    # Nothing comes out below 0: the one pixel below it is in the middle of bright ones.
    assert clean.counts == {
        "nan": 3, "filled": 2, "zeroed": 1, "guide_nan": 0, "negative": 1, "too_large": 0, "clamped": 1, "lamps": 0,
        "raised": 0,
    }  # fmt: skip
    color[0, 47] = 0.0
    np.testing.assert_array_equal(clean.image[sky], color[sky])
    assert np.isfinite(clean.image).all()
    truth = images["albedo"] * light
    for y, x in ((10, 10), (20, 30)):
        np.testing.assert_allclose(clean.image[y, x], truth[y, x], rtol=0.1)
    # 16 times its neighbours, as it is clamped to, in windows of 81 pixels that cover it.
    assert (clean.image[25, 8] < 1.5 * truth[25, 8]).all()


def test_what_the_filter_puts_below_0_is_raised(walls):
    """A fit of a line to light that falls to 0 on a slope of depth goes on below it."""
    images, _ = walls
    x = np.linspace(0.0, 1.0, WIDTH, dtype=np.float32)
    depth = np.broadcast_to(1.0 + x[:, None], (HEIGHT, WIDTH, 1))
    color = np.broadcast_to(np.maximum(0.3 - x, 0.0)[:, None], (HEIGHT, WIDTH, 3)).astype(np.float32)
    settings = dataclasses.replace(PLAIN, eps=0.01)
    aovs = Aovs(color, normal=images["normal"] * 0.0 + np.float32([0.0, 0.0, 1.0]), depth=depth)
    clean = denoise(aovs, settings=settings)
    filtered = apply_filter(jnp.asarray(color), make_guides(aovs), settings)
    below = np.asarray(filtered < 0.0).any(-1)
    assert 0 < below.sum() == clean.counts["raised"] < HEIGHT * WIDTH
    np.testing.assert_allclose(clean.image, np.maximum(filtered, 0.0), atol=1e-6)


def test_gray_stays_gray(rng, walls):
    """A gray picture comes as three channels alike."""
    images, light = walls
    gray = np.repeat((light * noise(rng))[..., :1], 3, axis=-1)
    clean = denoise(Aovs(gray, normal=images["normal"]), settings=PLAIN).image
    np.testing.assert_array_equal(clean, np.repeat(clean[..., :1], 3, axis=-1))
    with pytest.raises(ValueError, match=r"color: expected shape .*, 3\)"):
        denoise(Aovs(gray[..., :1], normal=images["normal"]), settings=PLAIN)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("guide", "value"), [("normal", np.nan), ("depth", np.inf), ("depth", np.nan), ("depth", 1e10)]
)
def test_a_sky_without_finite_guides_passes(rng, walls, method, guide, value):
    images, light = walls
    sky = np.zeros((HEIGHT, WIDTH), bool)
    sky[:12] = True
    color = light * noise(rng)
    color[sky] = [0.2, 0.4, 2.0]
    image = images[guide].copy()
    image[sky] = value
    clean = denoise(Aovs(color, **{guide: image}), settings=dataclasses.replace(PLAIN, method=method))
    np.testing.assert_array_equal(clean.image[sky], color[sky])
    assert clean.counts["guide_nan"] == (sky.sum() if np.isnan(value) else 0)
    image[sky] = 0.0
    same = denoise(Aovs(color, **{guide: image}), settings=dataclasses.replace(PLAIN, method=method))
    np.testing.assert_array_equal(clean.image, same.image)


@pytest.mark.parametrize("broken", ["normal", "depth", "albedo", "ao"])
def test_gaps_in_guides_are_closed_and_counted(rng, walls, broken):
    """A hole of 9 x 9 pixels, wider than the windows: light there is filtered as around it."""
    images, light = walls
    images = {**images, "ao": np.ones((HEIGHT, WIDTH, 1), np.float32), "albedo": np.full_like(light, 0.5)}
    truth = images["albedo"] * light
    image = images[broken].copy()
    image[10:19, 30:39] = np.nan
    clean = denoise(
        Aovs(truth * noise(rng, 50.0), **{**images, broken: image}), settings=dataclasses.replace(PLAIN, radius=3)
    )
    assert clean.counts["guide_nan"] == 81 and clean.counts["filled"] == 0
    np.testing.assert_allclose(clean.image[10:19, 30:39], truth[10:19, 30:39], rtol=0.15)
    # An image without any number is left out.
    nothing = denoise(Aovs(truth, **{**images, broken: np.full_like(image, np.nan)}), settings=PLAIN)
    without = denoise(Aovs(truth, **{**images, broken: None}), settings=PLAIN)
    np.testing.assert_array_equal(nothing.image, without.image)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_guides_that_tell_nothing_are_refused(walls, value):
    images, light = walls
    with pytest.raises(ValueError, match=r"normal: expected finite numbers other than 0 in some pixel, got 0 of 1536"):
        denoise(Aovs(light, normal=np.full_like(images["normal"], value)))
    with pytest.raises(ValueError, match=r"color: expected a finite pixel where a surface is seen, got 0 of 1536"):
        denoise(Aovs(light * np.float32(np.nan), normal=images["normal"]))


@pytest.mark.parametrize("method", METHODS)
def test_light_near_the_largest_number_is_cut_and_counted(rng, walls, method):
    images, light = walls
    huge = (light * noise(rng) * np.float32(1e38)).astype(np.float32)
    for settings in (dataclasses.replace(PLAIN, method=method), DenoiseSettings(method=method, radius=4, auto=True)):
        clean = denoise(Aovs(huge, **images), settings=settings)
        assert np.isfinite(clean.image).all() and clean.counts["too_large"] == HEIGHT * WIDTH
    color = light * noise(rng)
    plain = denoise(Aovs(color, **images), settings=DenoiseSettings(method=method, radius=4))
    color[5, 5] = 3e38  # one spike, which the clamp brings down
    clean = denoise(Aovs(color, **images), settings=DenoiseSettings(method=method, radius=4))
    assert clean.counts["too_large"] == 1 and clean.image.max() < 20.0 * plain.image.max()


# --- How much cleaner


@pytest.mark.parametrize("method", METHODS)
def test_noise_goes_and_edges_stay(rng, walls, method):
    images, light = walls
    truth = images["albedo"] * light
    noisy = truth * noise(rng)
    settings = DenoiseSettings(method=method, samples_per_pixel=4.0)
    clean = denoise(Aovs(noisy, **images), settings=settings)
    assert clean.chosen["how"] == "rule" and clean.chosen["radius"] == 4
    before, after = (np.mean((image - truth) ** 2) for image in (noisy, clean.image))
    assert after < 0.15 * before
    # Without the albedo in the way; the texture is lost if it is not divided out.
    kept = denoise(Aovs(noisy, **images), settings=dataclasses.replace(settings, demodulate=False))
    assert np.mean((kept.image - truth) ** 2) > 2.0 * after
    edge = np.s_[:, 18:22]
    assert np.abs(clean.image - truth)[edge].mean() < 2.0 * np.abs(clean.image - truth).mean()


@pytest.mark.parametrize("method", METHODS)
def test_the_rule_falls_with_samples_and_has_bounds(method):
    radii = [rule(method, height=384, width=512, samples_per_pixel=s) for s in (1e-9, 1, 2, 4, 16, 64, 1e9)]
    assert radii == sorted(radii, reverse=True) and len(set(radii)) > 4
    assert radii[0] <= 384 // 8 and radii[-1] == 2
    assert rule(method, height=8, width=512, samples_per_pixel=1.0) == 2
    assert rule(method, height=48, width=64, samples_per_pixel=1e-3) == 6


@pytest.mark.usefixtures("nan_is_a_value")
def test_auto_goes_by_the_noise(rng, walls, monkeypatch):
    """It sees no more than the picture, and comes close to what the truth would choose."""
    monkeypatch.setattr(choice, "AUTO_RADII", (0.5, 1.0, 2.0))  # each is a program
    images, _ = walls
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    truth = 0.5 + 0.15 * np.sin(x / 4.0)[..., None] * np.cos(y / 5.0)[..., None] * np.ones(3)
    guides = {name: images[name] for name in ("normal", "depth")}
    chosen = {}
    for sigma in (0.01, 0.3):
        noisy = (truth + sigma * rng.normal(size=truth.shape)).astype(np.float32)
        asked = DenoiseSettings(auto=True, firefly_factor=None, samples_per_pixel=4.0)
        clean = denoise(Aovs(noisy, **guides), settings=asked)
        assert clean.chosen["how"] == "cross-validation"
        chosen[sigma] = clean.chosen["radius"]
        # A fourth channel, as the choice had it: the same programs.
        light = jnp.asarray(np.concatenate([noisy, noisy[..., :1]], axis=-1))
        errors = [
            np.mean((np.asarray(apply_filter(light, make_guides(Aovs(noisy, **guides)), each))[..., :3] - truth) ** 2)
            for radius in (2, 4, 8)
            for each in (dataclasses.replace(asked, radius=radius, eps=eps) for eps in AUTO_EPS)
        ]
        assert max(errors) > 1.3 * min(errors)
        assert np.mean((clean.image - truth) ** 2) < 1.1 * min(errors), (sigma, clean.chosen)
    assert chosen[0.01] < chosen[0.3]


def test_auto_leaves_what_is_given(rng, walls):
    images, light = walls
    aovs = Aovs(light * noise(rng), normal=images["normal"])
    given = denoise(aovs, settings=dataclasses.replace(PLAIN, auto=True, eps=None)).chosen
    assert given["radius"] == 4 and given["how"] == "radius given, eps by cross-validation"
    # Of the grid around the rule's, or from its border on in steps of 3.
    assert any(np.isclose(given["eps"], 0.15 * k * 3.0**n) for k in AUTO_EPS for n in (-3, -2, -1, 0, 1, 2, 3))
    given = denoise(aovs, settings=PLAIN).chosen
    assert (given["how"], given["radius"], given["eps"], given["samples_per_pixel"]) == ("given", 4, 1.0, "unknown")


# --- Bad input


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("method", "mean"), ("radius", 0), ("radius", 2.5), ("eps", 0.0), ("eps", np.nan), ("samples_per_pixel", -1.0),
        ("samples_per_pixel", np.inf), ("firefly_factor", 0.5), ("firefly_factor", np.nan),
    ],
)  # fmt: skip
def test_settings_out_of_range_are_named(walls, field, value):
    images, light = walls
    with pytest.raises(ValueError, match=f"^{field}: "):
        denoise(Aovs(light, **images), settings=DenoiseSettings(**{field: value}))


def test_settings_may_be_left_out(rng, walls):
    images, light = walls
    aovs = Aovs(light * noise(rng), **images)
    usual = denoise(aovs)
    np.testing.assert_array_equal(usual.image, denoise(aovs, settings=DenoiseSettings(samples_per_pixel=4.0)).image)
    assert usual.chosen["samples_per_pixel"] == "4 (assumed)" and usual.chosen["how"] == "rule"
    radius_given = denoise(aovs, settings=DenoiseSettings(radius=3)).chosen
    assert (radius_given["radius"], radius_given["how"]) == (3, "radius given, eps by rule")


def test_nothing_to_go_by(walls):
    images, light = walls
    with pytest.raises(ValueError, match="aovs: expected normal, depth or position, got none of them"):
        denoise(Aovs(light, albedo=images["albedo"]), settings=PLAIN)
