"""jaxrender.filters.choice: what light it is, whether noise is shared by neighbours, beyond the grid."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from jaxrender.filters import choice
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.denoiser import denoise
from jaxrender.filters.settings import DenoiseSettings

HEIGHT, WIDTH = 64, 96
METHODS = ("guided", "bilateral", "atrous")


def scene(rng, *, blur=0.0, samples=2.0):
    """A wall with slow light, the noise of a few samples, both seen through a pixel filter."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    truth = (1.0 + 0.3 * np.sin(x / 15.0) * np.cos(y / 12.0))[..., None] * np.ones(3)
    noisy = truth * rng.gamma(samples, 1.0 / samples, truth.shape)
    if blur:
        noisy = scipy.ndimage.gaussian_filter(noisy, (blur, blur, 0.0))
    normal = np.zeros_like(truth)
    normal[..., 2] = 1.0
    return Aovs(noisy.astype(np.float32), normal=normal.astype(np.float32)), truth


@pytest.mark.parametrize("method", METHODS)
def test_direct_light_asks_for_narrower_windows_and_closer_fits(method):
    size = {"height": 768, "width": 1024}
    for samples in (1.0, 4.0, 16.0, 64.0):
        indirect = choice.rule(method, **size, samples_per_pixel=samples)
        whole = choice.rule(method, **size, samples_per_pixel=samples, divided=False)
        assert 1 <= whole < indirect
        eps = choice.rule_eps(method, samples_per_pixel=samples, divided=False)
        assert eps <= choice.rule_eps(method, samples_per_pixel=samples) == 1.0
        assert eps < choice.rule_eps(method, samples_per_pixel=0.5 * samples, divided=False) or samples == 1.0
    assert choice.rule_eps(method, samples_per_pixel=1e9, divided=False) == 0.01


def test_the_rule_goes_by_what_is_filtered(rng):
    aovs, _ = scene(rng)
    settings = DenoiseSettings(samples_per_pixel=4.0)
    whole = denoise(aovs, settings=settings).chosen
    parts = dataclasses.replace(aovs, color=2.0 * aovs.color, direct=aovs.color, indirect=aovs.color)
    apart = denoise(parts, settings=settings).chosen
    together = denoise(parts, settings=dataclasses.replace(settings, whole=True)).chosen
    assert (apart["radius"], apart["eps"]) == (8, 1.0)  # an eighth of the side
    assert (whole["radius"], whole["eps"]) == (together["radius"], together["eps"]) == (5, 0.15)


def test_all_light_together_adds_up_and_is_as_the_picture(rng):
    """Direct and indirect light, each filtered with what both ask for, are what the picture of both gives."""
    first, _ = scene(rng)
    second, _ = scene(rng)
    parts = {"direct": first.color.copy(), "indirect": second.color}
    parts["direct"][10, 12] *= 300.0
    settings = DenoiseSettings(radius=3, eps=0.3, whole=True)
    clean = denoise(dataclasses.replace(first, color=sum(parts.values()), **parts), settings=settings)
    assert clean.layers.keys() == {"direct", "indirect"} and clean.counts["clamped"] == 1
    np.testing.assert_allclose(clean.layers["direct"] + clean.layers["indirect"], clean.image, rtol=1e-6)
    alone = denoise(dataclasses.replace(first, color=sum(parts.values())), settings=settings)
    assert (clean.counts["raised"], alone.counts["raised"]) == (0, 0)
    np.testing.assert_allclose(clean.image, alone.image, rtol=1e-4)
    assert np.abs(clean.layers["direct"] - parts["direct"]).max() > 0.1


@pytest.mark.parametrize("samples", [0.3, 2.0, 30.0])
def test_grain_tells_a_pixel_filter(rng, samples):
    found = {}
    for blur in (0.0, 0.4, 0.5, 0.7):
        aovs, truth = scene(rng, blur=blur, samples=samples)
        found[blur] = choice.grain(aovs.color, truth)
    assert abs(found[0.0] - 1.0) < 0.08
    assert found[0.7] < 0.35 and 0.45 < found[0.5] < 0.66 and found[0.4] < 0.9


def test_grain_of_nothing():
    flat = np.ones((5, 5, 3), np.float32)
    assert choice.grain(flat, flat) == choice.grain(flat[:1, :1], flat[:1, :1]) == 1.0
    assert choice.grain(flat * np.float32(np.nan), flat) == 1.0


@pytest.mark.parametrize("blur", [0.0, 0.5])
def test_auto_goes_by_the_rule_where_neighbours_share_noise(rng, blur):
    """Cross-validation would take the noise that neighbours share for light, and hardly filter."""
    aovs, truth = scene(rng, blur=blur)
    settings = DenoiseSettings(samples_per_pixel=2.0, auto=True)
    clean = denoise(aovs, settings=settings)
    by_rule = denoise(aovs, settings=dataclasses.replace(settings, auto=False))
    if not blur:
        assert clean.chosen["how"] == "cross-validation"
        assert np.mean((clean.image - truth) ** 2) <= np.mean((by_rule.image - truth) ** 2)
        return
    assert clean.chosen["how"].startswith("rule and not cross-validation (neighbouring pixels share noise, 0.5")
    np.testing.assert_array_equal(clean.image, by_rule.image)


def test_auto_goes_on_where_the_grid_ends(rng, monkeypatch):
    """With an error that falls in one direction, until the steps or the picture end."""
    light, tried = jnp.ones((64, 80, 3)), []

    def stand_in(both, guides, settings):
        tried.append((settings.radius, settings.eps))
        return both

    errors = lambda settings: 10.0 / settings[0] + settings[1]  # noqa: E731
    monkeypatch.setattr(choice, "apply_filter", stand_in)
    monkeypatch.setattr(choice, "_left_out", lambda *_: errors(tried[-1]))
    start = DenoiseSettings(radius=6, eps=1.0)
    with jax.debug_nans(False):
        best = choice._cross_validated(light, None, start, ["radius", "eps"], weight=light)
        # Three steps beyond 12 and 0.1: one of the radius, to a quarter of 64 rows at most, then two of eps.
        assert (best.radius, best.eps) == (16, pytest.approx(0.1 / 9.0)) and len(tried) <= 20 + 6
        only = choice._cross_validated(light, None, start, ["eps"], weight=light)
        assert (only.radius, only.eps) == (6, pytest.approx(0.1 / 27.0))
