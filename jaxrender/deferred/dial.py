"""One number instead of many constants: a share of the samples, or a quality, turned into the scale of a method.

Found by bisection on one picture; the constants then serve the film.
"""

import dataclasses
from collections.abc import Callable
from typing import NoReturn, TypeVar

import jax.numpy as jnp

from jaxrender.checks import bad_input
from jaxrender.deferred.adaptive import shade_adaptive, supersample
from jaxrender.deferred.canvas import AdaptiveImage
from jaxrender.deferred.clusters import Clusters
from jaxrender.deferred.metrics import SampleMetrics
from jaxrender.deferred.point_shading import Lighting
from jaxrender.deferred.subsamples import SubSamples
from jaxrender.metrics import psnr
from jaxrender.srgb import encode_srgb

Scalable = TypeVar("Scalable", bound=Clusters | SampleMetrics)

#: Scales between which is searched, as powers of two.
_RANGE = (-6.0, 8.0)


def fit_budget(
    samples: SubSamples, lighting: Lighting, method: Scalable, *, budget: float, steps: int = 10
) -> tuple[Scalable, AdaptiveImage]:
    """The method with the largest scale that shades no more than a share of the covered sub-samples, and its picture.

    Args:
      samples, lighting: as in `shade_adaptive`.
      budget: the share, in (0, 1].
      steps: pictures that are made on the way; the scale is known to 2^(14/2^steps) then.
    Raises:
      InputError: if the budget is not in (0, 1], or less than the smallest scale takes.
    """
    if not 0.0 < budget <= 1.0:
        bad_input("budget", "share", expected="a number in (0, 1]", got=budget)
    return _search(
        samples, lighting, method, fits=lambda picture: picture.sample_share <= budget, upwards=True, steps=steps,
        refuse=lambda picture: bad_input(
            "budget", "share", expected=f"at least {picture.sample_share:.4f} for this view", got=budget
        ),
    )  # fmt: skip


def fit_psnr(
    samples: SubSamples, lighting: Lighting, method: Scalable, *, psnr_db: float, steps: int = 10
) -> tuple[Scalable, AdaptiveImage]:
    """The method with the smallest scale that comes as near to full supersampling, and its picture.

    Args:
      psnr_db: with peak 1, of display-encoded colors over black (`picture_psnr`), in (0, 200].
      samples, lighting, steps: as in `fit_budget`.
    Raises:
      InputError: if `psnr_db` is out of range, or more than the largest scale reaches.
    """
    if not 0.0 < psnr_db <= 200.0:
        bad_input("psnr", "quality", expected="decibels in (0, 200]", got=psnr_db)
    reference = supersample(samples, lighting)
    return _search(
        samples, lighting, method, fits=lambda picture: picture_psnr(picture, reference) >= psnr_db, upwards=False,
        steps=steps,
        refuse=lambda picture: bad_input(
            "psnr", "quality", expected=f"at most {picture_psnr(picture, reference):.1f} dB for this view", got=psnr_db
        ),
    )  # fmt: skip


def _search(
    samples: SubSamples, lighting: Lighting, method: Scalable, *, fits: Callable[[AdaptiveImage], bool],
    upwards: bool, steps: int, refuse: Callable[[AdaptiveImage], NoReturn],
) -> tuple[Scalable, AdaptiveImage]:  # fmt: skip
    """Bisects between the end of the range that fits and the other one; goes as far from the first as it can."""

    if not isinstance(method, Clusters | SampleMetrics):
        raise ValueError(f"method: expected Clusters or SampleMetrics, got {type(method).__name__}")

    def draw(exponent: float) -> tuple[Scalable, AdaptiveImage]:
        scaled = dataclasses.replace(method, scale=2.0**exponent)
        return scaled, shade_adaptive(samples, lighting, method=scaled)

    good, bad = _RANGE if upwards else _RANGE[::-1]
    best = None
    for _ in range(steps):
        middle = 0.5 * (good + bad)
        drawn = draw(middle)
        if fits(drawn[1]):
            good, best = middle, drawn
        else:
            bad = middle
    if best is None:
        best = draw(good)
        if not fits(best[1]):
            refuse(best[1])
    return best


def picture_psnr(picture: AdaptiveImage, reference: AdaptiveImage) -> float:
    """Peak signal-to-noise ratio in dB, peak 1, of display-encoded colors over black; infinite for equal pictures."""
    shown = [encode_srgb(p.image * p.alpha[..., None]) for p in (picture, reference)]
    return float(psnr(*(jnp.asarray(image, jnp.float32) for image in shown)))
