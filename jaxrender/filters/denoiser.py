"""A noisy picture and its images -> a clean one: the filters of this room in order, with settings that fit.

    firefly clamp <- light without albedo <- color, or indirect light alone where it is separate
    guides        <- normal, depth or position, ambient occlusion
    filter: one of three; radius and sigmas by a rule in samples per pixel and size, or by cross-validation
    light times albedo, at least 0, plus what was not filtered

Runs on the host and compiles one program for each radius and size. The filter is linear, so parts that add up before do
so afterwards.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float

from jaxrender import checks
from jaxrender.filters.albedo import demodulate, remodulate
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.atrous import atrous_filter
from jaxrender.filters.bilateral import cross_bilateral_filter
from jaxrender.filters.cross_validation import leave_one_out_error, own_share
from jaxrender.filters.fireflies import clamp_fireflies
from jaxrender.filters.guided import guided_filter
from jaxrender.filters.guides import Guides, make_guides, seen_surface

Method = Literal["guided", "bilateral", "atrous"]
Image = Float[Array, "h w c"]

#: What is taken if nobody says how many samples a pixel has.
USUAL_SAMPLES = 4.0
#: `auto` tries radii around that of the rule, and regularisers around the usual ones, by these factors.
AUTO_RADII, AUTO_EPS = (0.5, 0.7, 1.0, 1.4, 2.0), (0.1, 0.3, 1.0, 3.0)

# Slope of the sRGB curve, about: a difference of light counts as much as it shows.
_DISPLAY_SLOPE = 1.0 / 2.4 - 1.0
# Times the median light: brighter patches are lamps.
_LAMP = 16.0


@dataclass(frozen=True)
class DenoiseSettings:
    """How to denoise; None leaves it to the rule.

    Attributes:
      method: guided filter, cross-bilateral filter or à-trous filter.
      radius: in pixels, >= 1. The bilateral filter's sigma is half of it; à-trous levels are as many as reach so far.
      eps: > 0, factor to the usual regularisers, and its root to the sigmas of the other methods: larger is smoother.
      samples_per_pixel: > 0, of the picture.
      auto: choose radius and eps, as far as they are None, by cross-validation (see `cross_validation`).
      firefly_factor: >= 1, see `clamp_fireflies`; None for no clamp. At one sample a pixel honest light exceeds
        its median tenfold: with 6, sparse light loses more than fireflies cost.
      demodulate: filter light without albedo, where there is one.
    """

    method: Method = "guided"
    radius: int | None = None
    eps: float | None = None
    samples_per_pixel: float | None = None
    auto: bool = False
    firefly_factor: float | None = 16.0
    demodulate: bool = True

    def check(self) -> None:
        """Raises ValueError, naming the field, if a value is out of its range."""
        checks.check_one_of("method", self.method, ("guided", "bilateral", "atrous"))
        if self.radius is not None:
            checks.check_at_least("radius", self.radius, 1)
        for name in ("eps", "samples_per_pixel"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise ValueError(f"{name}: expected a number above 0, got {value}")
        if self.firefly_factor is not None:
            checks.check_at_least("firefly_factor", self.firefly_factor, 1.0)


@dataclass(frozen=True)
class Denoised:
    """The result.

    Attributes:
      image: the clean picture, >= 0 where it was filtered.
      layers: direct, indirect and emission where light came in parts; they add up to `image`.
      counts: pixels by what was done to them: nan (not finite on the way in; 0 in the end if not filled), filled (of
        those, guessed from around), negative (below 0 on the way in), clamped (fireflies), raised (below 0 after the
        filter, set to 0).
      chosen: method, radius, eps, samples_per_pixel, and how they were chosen.
    """

    image: Float[np.ndarray, "h w 3"]
    layers: dict[str, Float[np.ndarray, "h w 3"]]
    counts: dict[str, int]
    chosen: dict[str, float | int | str] = field(default_factory=dict)


@jax.debug_nans(False)  # here NaN marks pixels without a value
def denoise(aovs: Aovs, settings: DenoiseSettings) -> Denoised:
    """Filters the indirect light if it is separate, else the picture without lamps; what shows no surface stays too.

    Raises:
      ValueError: if images differ in size, there is nothing to guide the filter, or a setting is out of its range.
    """
    settings.check()
    aovs.check()
    split = aovs.indirect is not None
    noisy = jnp.asarray(aovs.indirect if split else aovs.color, jnp.float32)
    albedo = _albedo(aovs) if settings.demodulate and aovs.albedo is not None else jnp.ones_like(noisy)
    guides = make_guides(aovs)
    surface = jnp.asarray(seen_surface(aovs))

    valid = jnp.all(jnp.isfinite(noisy), axis=-1)
    light = jnp.where((valid & surface)[..., None], demodulate(noisy, albedo), jnp.nan)
    if not split:
        surface = surface & ~jnp.asarray(seen_lamps(np.asarray(light)))
        light = jnp.where(surface[..., None], light, jnp.nan)
    clamped = jnp.zeros_like(surface)
    if settings.firefly_factor is not None:
        light, clamped = _clamp(light, settings.firefly_factor)
    fixed = _parts(aovs) if split else {}
    chosen = choose(light, guides, settings, seen=partial(_picture, albedo=albedo, fixed=fixed))
    filtered = remodulate(apply_filter(light, guides, chosen), albedo)
    clean = jnp.where(surface[..., None], jnp.maximum(filtered, 0.0), jnp.where(valid[..., None], noisy, 0.0))
    raised = surface & jnp.any(filtered < 0.0, axis=-1)

    layers = {**fixed, "indirect": np.asarray(clean)} if split else {}
    image = sum(layers.values(), np.zeros_like(clean)) if split else np.asarray(clean)
    finite = np.isfinite(np.asarray(aovs.color)).all(axis=-1) & np.asarray(valid)
    counts = {
        "nan": ~finite, "filled": ~finite & np.asarray(surface), "raised": raised, "clamped": clamped,
        "negative": np.any(np.asarray(aovs.color) < 0.0, axis=-1),
    }  # fmt: skip
    return Denoised(image, layers, {name: int(np.sum(mask)) for name, mask in counts.items()}, _told(chosen, settings))


def rule(method: Method, *, height: int, width: int, samples_per_pixel: float, lit_share: float = 1.0) -> int:
    """The radius for so many samples a pixel, in pixels whatever the picture's size: less noise asks for less blur.

    Found on indirect light of four scenes at 512 x 384; at 1024 x 768 the same number of pixels is best again, as noise
    and the features that guides leave to blur are both counted in pixels. At most an eighth of the shorter side.

    Args:
      lit_share: of the pixels, those with any light. Where few paths find light, each tells less.
    """
    if method == "bilateral":
        radius = 24.0 * samples_per_pixel**-0.4
    elif method == "atrous":
        radius = 30.0 * samples_per_pixel**-0.33
    else:
        radius = 16.0 * samples_per_pixel ** (-1.0 / 3.0)
    radius *= max(lit_share, 0.01) ** -0.25
    return int(np.clip(round(radius), 2, max(2, min(height, width) // 8)))


def seen_lamps(light: Float[np.ndarray, "h w c"]) -> Bool[np.ndarray, "h w"]:
    """Where a lamp is seen itself, as guides do not tell it from the wall around it: it must not be spread over that.

    A patch (the median of 5 x 5 pixels) many times as bright as the picture's median, with the pixels next to it.
    """
    luminance = np.nan_to_num(light, nan=0.0).mean(axis=-1)
    lit = luminance[luminance > 0.0]
    if not lit.size:
        return np.zeros(light.shape[:2], bool)
    patches = scipy.ndimage.median_filter(luminance, size=5, mode="nearest") > _LAMP * np.median(lit)
    return scipy.ndimage.binary_dilation(patches, iterations=2) & (luminance > _LAMP * np.median(lit))


def choose(
    light: Image, guides: Guides, settings: DenoiseSettings, *, seen: Callable[[Array], Array]
) -> DenoiseSettings:
    """Settings with a radius and an eps: those given, else by the rule, else the best of a few by cross-validation.

    Args:
      seen: filtered light -> the picture it gives, which says how much an error shows.
    """
    height, width = light.shape[:2]
    samples = settings.samples_per_pixel or USUAL_SAMPLES
    finite = np.asarray(light)[np.isfinite(np.asarray(light)).all(axis=-1)]
    lit = float(finite.any(axis=-1).mean()) if finite.size else 1.0
    by_rule = rule(settings.method, height=height, width=width, samples_per_pixel=samples, lit_share=lit)
    start = replace(settings, radius=settings.radius or by_rule, eps=settings.eps or 1.0)
    if not settings.auto:
        return start
    radii = sorted({max(1, round(by_rule * factor)) for factor in AUTO_RADII})
    tried = [
        replace(start, radius=radius, eps=eps)
        for radius in (radii if settings.radius is None else [settings.radius])
        for eps in (AUTO_EPS if settings.eps is None else [settings.eps])
    ]
    weight = _shown(apply_filter(light, guides, start), seen)
    signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], size=(height, width, 1)), jnp.float32)
    signs = jnp.where(jnp.all(jnp.isfinite(light), axis=-1, keepdims=True), signs, jnp.nan)
    both = jnp.concatenate([light, signs], axis=-1)
    errors = [float(_left_out(both, apply_filter(both, guides, each), weight)) for each in tried]
    return tried[int(np.argmin(errors))]


def apply_filter(light: Image, guides: Guides, settings: DenoiseSettings) -> Image:
    """The filter of `settings`, whose radius and eps are numbers; linear in `light`. NaN pixels are filled in."""
    assert settings.radius is not None and settings.eps is not None
    radius, eps = int(settings.radius), float(settings.eps)
    if settings.method == "guided":
        return _guided(guides.channels, light, jnp.asarray(guides.eps * eps), radius)
    sigma = jnp.asarray(guides.sigma * np.sqrt(eps), jnp.float32)
    if settings.method == "bilateral":
        return _bilateral(light, guides.channels, sigma, radius)
    return _atrous(light, guides.channels, np.sqrt(2.0) * sigma, max(1, round(np.log2(radius / 2 + 1))))


def _albedo(aovs: Aovs) -> Image:
    return jnp.asarray(aovs.albedo, jnp.float32)


def _parts(aovs: Aovs) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """The light that is not filtered, without what is not finite."""
    parts = {"direct": aovs.direct, "emission": aovs.emission}
    given = {name: np.asarray(image, np.float32) for name, image in parts.items() if image is not None}
    return {name: np.where(np.isfinite(image).all(axis=-1, keepdims=True), image, 0.0) for name, image in given.items()}


def _picture(light: Image, *, albedo: Image, fixed: dict) -> Image:
    return remodulate(light, albedo) + sum(map(jnp.asarray, fixed.values()), jnp.zeros_like(light))


def _shown(pilot: Image, seen: Callable[[Image], Image]) -> Image:
    """How much a unit of light in each pixel and channel shows on a display, squared; the largest are cut."""
    pilot = jnp.maximum(jnp.nan_to_num(pilot), 0.0)
    picture = seen(pilot)
    albedo = seen(pilot + 1.0) - picture
    slope = jnp.where(picture < 1.0, albedo * jnp.maximum(picture, 3e-3) ** _DISPLAY_SLOPE, 0.0)
    return jnp.minimum(slope * slope, jnp.quantile(slope * slope, 0.99))


def _told(chosen: DenoiseSettings, asked: DenoiseSettings) -> dict[str, float | int | str]:
    known = asked.samples_per_pixel is not None
    how = "cross-validation" if asked.auto else "given" if asked.radius and asked.eps else "rule"
    return {
        "method": chosen.method, "radius": chosen.radius or 0, "eps": float(chosen.eps or 0.0), "how": how,
        "samples_per_pixel": asked.samples_per_pixel if known and asked.samples_per_pixel else "unknown",
    }  # fmt: skip


@partial(jax.jit, static_argnames="factor")
def _clamp(light: Image, factor: float) -> tuple[Image, Bool[Array, "h w"]]:
    return clamp_fireflies(light, factor=factor)


@partial(jax.jit, static_argnames="radius")
def _guided(channels: Image, light: Image, eps: Float[Array, " g"], radius: int) -> Image:
    return guided_filter(channels, light, radius=radius, eps=eps)


@partial(jax.jit, static_argnames="radius")
def _bilateral(light: Image, channels: Image, sigma: Float[Array, " g"], radius: int) -> Image:
    return cross_bilateral_filter(light, channels, radius=radius, sigma_spatial=radius / 2, sigma_features=sigma)


@partial(jax.jit, static_argnames="num_levels")
def _atrous(light: Image, channels: Image, sigma: Float[Array, " g"], num_levels: int) -> Image:
    return atrous_filter(light, channels, num_levels=num_levels, sigma_features=sigma)


@jax.jit
def _left_out(both: Image, filtered: Image, weight: Image) -> Float[Array, ""]:
    share = own_share(both[..., -1], filtered[..., -1])
    return leave_one_out_error(both[..., :-1], filtered[..., :-1], share, weight=weight)
