"""Radius and eps for a picture: by a rule in samples per pixel, or by cross-validation. Runs on the host."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.filters.cross_validation import leave_one_out_error, own_share
from jaxrender.filters.guides import Guides
from jaxrender.filters.settings import DenoiseSettings, Method, apply_filter

Image = Float[Array, "h w c"]

#: What is taken if nobody says how many samples a pixel has.
USUAL_SAMPLES = 4.0
#: `auto` tries radii and regularisers around those of the rule, by these factors.
AUTO_RADII, AUTO_EPS = (0.5, 0.7, 1.0, 1.4, 2.0), (0.1, 0.3, 1.0, 3.0)
#: If the best of them is an outermost one, so many steps further out, by these factors.
AUTO_STEPS, STEP_RADIUS, STEP_EPS = 3, 1.4, 3.0

# Radius of the rule at one sample, and the power of the number of samples.
_DIVIDED = {"guided": (16.0, -1.0 / 3.0), "bilateral": (24.0, -0.4), "atrous": (30.0, -0.33)}
_UNDIVIDED = {"guided": (8.0, -0.4), "bilateral": (16.0, -0.33), "atrous": (16.0, -0.33)}

# Slope of the sRGB curve, about: a difference of light counts as much as it shows.
_DISPLAY_SLOPE = 1.0 / 2.4 - 1.0
# Noise is shared by neighbours if `grain` is below this, less so many standard errors of it.
_SHARED, _ERRORS = 0.9, 4.0
# Residuals are cut at so many times the light, lest a few spikes decide.
_SPIKE = 3.0


@dataclass(frozen=True)
class Chosen:
    """Settings with a radius and an eps, and in words how they were found."""

    settings: DenoiseSettings
    how: str


def rule(
    method: Method,
    *,
    height: int,
    width: int,
    samples_per_pixel: float,
    lit_share: float = 1.0,
    divided: bool = True,
) -> int:
    """The radius for so many samples a pixel, in pixels whatever the picture's size: less noise asks for less blur.

    Found at 512 x 384 by searches over renders of four scenes with 1 to 64 samples; at 1024 x 768 the same number of
    pixels was best in the one scene that was tried (Cornell box): noise and the features that guides leave to blur are
    both counted in pixels. At most an eighth of the shorter side.

    Args:
      lit_share: of the pixels, those with any light. Where few paths find light, each tells less.
      divided: whether it is indirect light alone. Direct light has shadows, of which guides know nothing: windows are
        about half as wide then.
    """
    factor, power = (_DIVIDED if divided else _UNDIVIDED)[method]
    radius = factor * samples_per_pixel**power * max(lit_share, 0.01) ** -0.25
    least = 2 if divided else 1
    return int(np.clip(round(radius), least, max(least, min(height, width) // 8)))


def rule_eps(method: Method, *, samples_per_pixel: float, divided: bool = True) -> float:
    """The factor to the usual regularisers: 1 for indirect light alone, else less for more samples (see `rule`).

    With direct light, a guided filter by both rules has an MSE 11 % above the best of a search, on average.
    """
    if divided:
        return 1.0
    return float(np.clip((0.3 if method == "guided" else 1.0) * samples_per_pixel**-0.5, 0.01, 1.0))


def choose(
    light: Image,
    guides: Guides,
    settings: DenoiseSettings,
    *,
    divided: bool,
    seen: Callable[[Array], Array],
) -> Chosen:
    """Settings with a radius and an eps: those given, else by the rule, else the best of some by cross-validation.

    Args:
      divided: whether it is indirect light alone (see `rule`).
      seen: filtered light -> the picture it gives, which says how much an error shows.
    """
    start = _by_rule(light, settings, divided=divided)
    free = [name for name in ("radius", "eps") if getattr(settings, name) is None]
    given = [f"{name} given" for name in ("radius", "eps") if name not in free]
    if not free:
        return Chosen(start, "given")
    if not settings.auto:
        return Chosen(start, ", ".join([*given, f"{free[0]} by rule"]) if given else "rule")
    pilot = apply_filter(light, guides, start)
    ratio = grain(np.asarray(light), np.asarray(pilot))
    if ratio < _shared_below(light):
        reason = f"neighbouring pixels share noise, {ratio:.2f} where 1 is none"
        return Chosen(start, ", ".join([*given, f"rule and not cross-validation ({reason})"]))
    best = _cross_validated(light, guides, start, free, weight=_shown(pilot, seen))
    return Chosen(best, ", ".join([*given, f"{free[0]} by cross-validation"]) if given else "cross-validation")


def grain(light: Float[np.ndarray, "h w c"], filtered: Float[np.ndarray, "h w c"]) -> float:
    """How much the noise of neighbours differs, over how much that of pixels two apart does: 1 if it is independent.

    Second differences over squares of 2 and of 3 pixels, squared, of what the filter takes away as a share of the
    light. A renderer's pixel filter shares samples among neighbours: 0.84 and 0.57 for a Gaussian of 0.4 and 0.5
    pixels, 0.95 to 1.03 without one (four scenes, 1 to 64 samples, direct light filtered as well or not).
    """
    mean = np.maximum(np.nan_to_num(filtered.mean(axis=-1, dtype=np.float64)), 0.0)
    scale = mean + 0.1 * mean.mean() + np.finfo(np.float32).tiny
    rest = np.clip((light.mean(axis=-1, dtype=np.float64) - mean) / scale, -_SPIKE, _SPIKE)
    squares = []
    for k in (1, 2):
        mixed = rest[k:, k:] - rest[:-k, k:] - rest[k:, :-k] + rest[:-k, :-k]
        squares.append(np.mean(mixed**2, where=np.isfinite(mixed)) if np.isfinite(mixed).any() else 0.0)
    return float(squares[0] / squares[1]) if squares[1] > 0.0 else 1.0


def _by_rule(light: Image, settings: DenoiseSettings, *, divided: bool) -> DenoiseSettings:
    samples = settings.samples_per_pixel or USUAL_SAMPLES
    height, width, lit = *light.shape[:2], _lit_share(light)
    radius = settings.radius or rule(
        settings.method, height=height, width=width, samples_per_pixel=samples, lit_share=lit, divided=divided
    )
    eps = settings.eps or rule_eps(settings.method, samples_per_pixel=samples, divided=divided)
    return replace(settings, radius=radius, eps=eps)


def _shared_below(light: Image) -> float:
    count = int(np.isfinite(np.asarray(light)).all(axis=-1).sum())
    return _SHARED - _ERRORS / max(count, 1) ** 0.5


def _lit_share(light: Image) -> float:
    finite = np.asarray(light)[np.isfinite(np.asarray(light)).all(axis=-1)]
    return float(finite.any(axis=-1).mean()) if finite.size else 1.0


def _cross_validated(
    light: Image, guides: Guides, start: DenoiseSettings, free: list[str], *, weight: Image
) -> DenoiseSettings:
    """The best of a grid around `start`, and of steps beyond it as long as the best lies on its border."""
    height, width = light.shape[:2]
    signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], size=(height, width, 1)), jnp.float32)
    signs = jnp.where(jnp.all(jnp.isfinite(light), axis=-1, keepdims=True), signs, jnp.nan)
    both = jnp.concatenate([light, signs], axis=-1)
    errors: dict[tuple[int, float], float] = {}

    def error(radius: int, eps: float) -> float:
        tried = replace(start, radius=radius, eps=eps)
        if (radius, eps) not in errors:
            errors[radius, eps] = float(_left_out(both, apply_filter(both, guides, tried), weight))
        return errors[radius, eps]

    assert start.radius is not None and start.eps is not None
    radii = sorted({max(1, round(start.radius * k)) for k in AUTO_RADII}) if "radius" in free else [start.radius]
    all_eps = [start.eps * k for k in AUTO_EPS] if "eps" in free else [start.eps]
    best = min(((r, e) for r in radii for e in all_eps), key=lambda x: error(*x))
    for _ in range(AUTO_STEPS):
        outer = _further_out(best, radii, all_eps, free, largest=max(2, min(height, width) // 4))
        better = min([best, *outer], key=lambda x: error(*x))
        if better == best:
            break
        best = better
        radii, all_eps = sorted({*radii, best[0]}), sorted({*all_eps, best[1]})
    return replace(start, radius=best[0], eps=best[1])


def _further_out(best: tuple[int, float], radii, all_eps, free: list[str], *, largest: int) -> list[tuple[int, float]]:
    """A step beyond the grid in each direction in which the best is the outermost; radii stay in 1 to `largest`."""
    radius, eps = best
    outer = []
    if "radius" in free and radius == radii[-1] and radius < largest:
        outer.append((min(largest, round(radius * STEP_RADIUS) + (radius == 1)), eps))
    if "radius" in free and radius == radii[0] and radius > 1:
        outer.append((int(radius / STEP_RADIUS), eps))
    if "eps" in free and eps == all_eps[-1]:
        outer.append((radius, eps * STEP_EPS))
    if "eps" in free and eps == all_eps[0]:
        outer.append((radius, eps / STEP_EPS))
    return outer


def _shown(pilot: Image, seen: Callable[[Image], Image]) -> Image:
    """How much a unit of light in each pixel and channel shows on a display, squared; the largest are cut."""
    pilot = jnp.maximum(jnp.nan_to_num(pilot), 0.0)
    picture = seen(pilot)
    albedo = seen(pilot + 1.0) - picture
    slope = jnp.where(picture < 1.0, albedo * jnp.maximum(picture, 3e-3) ** _DISPLAY_SLOPE, 0.0)
    return jnp.minimum(slope * slope, jnp.quantile(slope * slope, 0.99))


@jax.jit
def _left_out(both: Image, filtered: Image, weight: Image) -> Float[Array, ""]:
    share = own_share(both[..., -1], filtered[..., -1])
    return leave_one_out_error(both[..., :-1], filtered[..., :-1], share, weight=weight)
