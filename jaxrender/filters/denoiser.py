"""A noisy picture and its images -> a clean one: the filters of this room in order, with settings that fit.

    light without albedo <- color without lamps, or indirect light alone where it is separate; fireflies clamped
    guides               <- normal, depth or position, ambient occlusion; patches of bright light
    filter: one of three; radius and sigmas by a rule in samples per pixel, or by cross-validation
    light times albedo, at least 0, plus what was not filtered

Runs on the host and compiles one program for each radius and size. The filter itself is linear in the light; the clamps
before and after it are not.
"""

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender.filters.albedo import demodulate, remodulate
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.choice import USUAL_SAMPLES, Chosen, choose
from jaxrender.filters.fireflies import clamp_fireflies
from jaxrender.filters.gaps import close_gaps, seen_surface
from jaxrender.filters.guides import Guides, make_guides, with_patches
from jaxrender.filters.lamps import bright_patches, seen_lamps
from jaxrender.filters.light import Light, parts_of
from jaxrender.filters.settings import DenoiseSettings, apply_filter

Image = Float[Array, "h w c"]
Color = Float[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]

_USUAL = DenoiseSettings()


@dataclass(frozen=True)
class Denoised:
    """The result.

    Attributes:
      image: the clean picture, >= 0 where it was filtered.
      layers: direct, indirect and emission where light came in parts; they add up to `image`.
      counts: pixels by what was done to them. On the way in: nan (light not finite; of those, filled were guessed from
        around, zeroed are 0 in some part), guide_nan (a guide or the albedo not finite: that of the nearest surface is
        taken), negative, too_large (cut to `light.LARGEST`). Then: clamped (fireflies), lamps (seen themselves, left as
        they were), raised (below 0 after the filter, set to 0).
      chosen: method, radius, eps, how they were chosen, samples_per_pixel, and which light was filtered.
    """

    image: Color
    layers: dict[str, Color]
    counts: dict[str, int]
    chosen: dict[str, float | int | str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Bare:
    """Light without albedo: the parts as they came; their sum, without fireflies, NaN where it is not to be used.

    `gain` is what the clamp made of the sum, `clamped` and `lamps` are masks.
    """

    parts: dict[str, Image]
    total: Image
    gain: Float[Array, "h w 1"]
    albedo: Image
    clamped: Mask
    lamps: Mask


@jax.debug_nans(False)  # here NaN marks pixels without a value
def denoise(aovs: Aovs, *, settings: DenoiseSettings = _USUAL) -> Denoised:
    """Filters the indirect light if it is separate, else the picture without lamps; what shows no surface stays too.

    Raises:
      ValueError: if images differ in size, there is nothing to guide the filter or to be filtered, or a setting is out
        of its range.
    """
    settings.check()
    aovs.check()
    surface = seen_surface(aovs)
    guiding, guide_gaps = close_gaps(aovs, surface)
    light = parts_of(aovs, whole=settings.whole)
    _check_some(light, surface)
    bare = _strip(light, guiding, surface, settings)
    guides = make_guides(guiding)
    if not light.divided:
        guides = with_patches(guides, bright_patches(np.asarray(bare.total)))
    seen = partial(_picture, albedo=bare.albedo, fixed=light.fixed)
    chosen = choose(bare.total, guides, settings, divided=light.divided, seen=seen)
    stays = ~surface | bare.lamps
    clean, raised = _filter(light, bare, guides, chosen.settings, stays)
    layers = {**light.fixed, **clean} if light.separate else {}
    masks = {
        "nan": light.nan, "filled": ~light.valid & surface, "zeroed": light.lost | (~light.valid & ~surface),
        "guide_nan": guide_gaps, "negative": light.negative, "too_large": light.too_large, "clamped": bare.clamped,
        "lamps": bare.lamps, "raised": raised,
    }  # fmt: skip
    image = sum(layers.values(), np.zeros_like(clean[next(iter(clean))])) if light.separate else clean["color"]
    counts = {name: int(np.sum(mask)) for name, mask in masks.items()}
    return Denoised(image, layers, counts, _told(chosen, settings, light))


def _check_some(light: Light, surface: Mask) -> None:
    if not (light.valid & surface).any():
        names = ", ".join(light.filtered)
        raise ValueError(f"{names}: expected a finite pixel where a surface is seen, got 0 of {int(surface.sum())}")


def _strip(light: Light, guiding: Aovs, surface: Mask, settings: DenoiseSettings) -> _Bare:
    """Takes off albedo, lamps and fireflies."""
    first = next(iter(light.filtered.values()))
    given = guiding.albedo if settings.demodulate and guiding.albedo is not None else np.ones_like(first)
    albedo = jnp.asarray(given, jnp.float32)
    parts = {name: demodulate(jnp.asarray(image), albedo) for name, image in light.filtered.items()}
    total = np.where((light.valid & surface)[..., None], np.asarray(sum(parts.values())), np.float32(np.nan))
    lamps = np.zeros_like(surface)
    if settings.keep_lamps and not light.divided:
        lamps = seen_lamps(total)
        total = np.where(lamps[..., None], np.float32(np.nan), total)
    bare, clamped = jnp.asarray(total), np.zeros_like(surface)
    if settings.firefly_factor is not None:
        bare, mask = _clamp(bare, settings.firefly_factor)
        clamped = np.asarray(mask)
    gain = jnp.sum(bare, axis=-1, keepdims=True) / jnp.sum(jnp.asarray(total), axis=-1, keepdims=True)
    gain = jnp.where(jnp.asarray(clamped)[..., None], gain, jnp.ones_like(gain))
    return _Bare(parts, bare, gain, albedo, clamped, lamps)


def _filter(
    light: Light, bare: _Bare, guides: Guides, settings: DenoiseSettings, stays: Mask
) -> tuple[dict[str, Color], Mask]:
    """The filtered parts, and where one of them was below 0. Parts go through the filter together."""
    usable = jnp.isfinite(bare.total).all(axis=-1, keepdims=True)
    several = [jnp.where(usable, part * bare.gain, jnp.nan) for part in bare.parts.values()]
    # One part is its own sum, in which fireflies are clamped exactly.
    inputs = jnp.concatenate(several, axis=-1) if len(several) > 1 else bare.total
    filtered = jnp.split(apply_filter(inputs, guides, settings), len(several), axis=-1)
    clean, raised = {}, np.zeros_like(stays)
    for (name, came), part in zip(light.filtered.items(), filtered, strict=True):
        shaded = np.asarray(remodulate(part, bare.albedo))
        kept = np.where(light.valid[..., None], came, np.float32(0.0))
        clean[name] = np.where(stays[..., None], kept, np.maximum(shaded, np.float32(0.0)))
        raised |= ~stays & (shaded < 0.0).any(axis=-1)
    return clean, raised


def _picture(light: Image, *, albedo: Image, fixed: dict) -> Image:
    return remodulate(light, albedo) + sum(map(jnp.asarray, fixed.values()), jnp.zeros_like(light))


def _told(chosen: Chosen, asked: DenoiseSettings, light: Light) -> dict[str, float | int | str]:
    samples: float | str = "unknown" if chosen.how == "given" else f"{USUAL_SAMPLES:g} (assumed)"
    return {
        "method": asked.method, "radius": chosen.settings.radius or 0, "eps": float(chosen.settings.eps or 0.0),
        "how": chosen.how, "samples_per_pixel": asked.samples_per_pixel or samples, "filtered": light.words(),
    }  # fmt: skip


@partial(jax.jit, static_argnames="factor")
def _clamp(light: Image, factor: float) -> tuple[Image, Bool[Array, "h w"]]:
    return clamp_fireflies(light, factor=factor)
