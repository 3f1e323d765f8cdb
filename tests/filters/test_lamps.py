"""jaxrender.filters.lamps: bright patches with and without noise, and what the denoiser makes of them."""

import dataclasses

import numpy as np
import pytest

from jaxrender.filters.aovs import Aovs
from jaxrender.filters.denoiser import denoise
from jaxrender.filters.lamps import bright_patches, seen_lamps
from jaxrender.filters.settings import DenoiseSettings

HEIGHT, WIDTH = 48, 64
PATCH = np.s_[10:34, 20:50]
SETTINGS = DenoiseSettings(radius=4, eps=0.3, samples_per_pixel=4.0)


@pytest.fixture
def room(rng):
    """Noisy light of about 1, and its mask of a patch."""
    light = rng.gamma(4.0, 0.25, (HEIGHT, WIDTH, 3)).astype(np.float32)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[PATCH] = True
    return light, mask


def test_a_lamp_has_no_noise(rng, room):
    light, mask = room
    lamp = light + 40.0 * mask[..., None].astype(np.float32)
    lamp[mask] = 40.0
    np.testing.assert_array_equal(seen_lamps(lamp), mask)
    sun = np.where(mask[..., None], 30.0 * light, light)
    assert not seen_lamps(sun).any()
    inside = bright_patches(sun)
    assert (inside != mask).sum() < 20
    # A bulb of 4 x 4 pixels, a tube of 3 pixels; nothing where all is dark.
    for place in (np.s_[5:9, 5:9], np.s_[20:23, 4:40]):
        small = light.copy()
        small[place] = 60.0
        assert seen_lamps(small)[place].mean() > 0.7 and seen_lamps(small).sum() <= small[place][..., 0].size
    assert not seen_lamps(np.zeros_like(light)).any() and not bright_patches(light * np.float32(np.nan)).any()


@pytest.mark.parametrize("method", ["guided", "bilateral", "atrous"])
def test_sun_on_the_floor_is_filtered_by_itself(room, method):
    light, mask = room
    normal = np.zeros_like(light)
    normal[..., 2] = 1.0
    color = np.where(mask[..., None], 30.0 * light, light)
    clean = denoise(Aovs(color, normal=normal), settings=dataclasses.replace(SETTINGS, method=method))
    assert clean.counts["lamps"] == 0
    inner, outer = np.s_[14:30, 24:46], np.s_[38:46, 4:60]
    assert clean.image[inner].std() < 0.5 * color[inner].std()
    assert clean.image[outer].std() < 0.5 * color[outer].std()
    # The edge of the patch is in no guide, and is kept but for corners.
    beside = clean.image[10:34, 52:55]
    assert np.median(beside) < 2.0


def test_lamps_are_counted_and_may_be_filtered(room):
    light, mask = room
    normal = np.zeros_like(light)
    normal[..., 2] = 1.0
    color = np.where(mask[..., None], np.float32(40.0), light)
    kept = denoise(Aovs(color, normal=normal), settings=SETTINGS)
    assert kept.counts["lamps"] == mask.sum()
    np.testing.assert_array_equal(kept.image[mask], color[mask])
    none = denoise(Aovs(color, normal=normal), settings=dataclasses.replace(SETTINGS, keep_lamps=False))
    assert none.counts["lamps"] == 0 and (none.image[mask] != color[mask]).any()
    # Where emission is apart nothing else is a lamp.
    parts = {"direct": color, "indirect": light}
    assert denoise(Aovs(color + light, normal=normal, **parts), settings=SETTINGS).counts["lamps"] == 0
