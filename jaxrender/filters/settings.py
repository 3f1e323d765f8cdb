"""How to denoise: the settings of a person, and the filter that settings with numbers stand for."""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender import checks
from jaxrender.filters.atrous import atrous_filter
from jaxrender.filters.bilateral import cross_bilateral_filter
from jaxrender.filters.guided import guided_filter
from jaxrender.filters.guides import Guides

Method = Literal["guided", "bilateral", "atrous"]
Image = Float[Array, "h w c"]


@dataclass(frozen=True)
class DenoiseSettings:
    """How to denoise; None leaves it to the rule.

    Attributes:
      method: guided filter, cross-bilateral filter or à-trous filter.
      radius: in whole pixels, >= 1. The bilateral filter's sigma is half of it; à-trous levels are as many as reach so
        far.
      eps: > 0, factor to the usual regularisers, and its root to the sigmas of the other methods: larger is smoother.
      samples_per_pixel: > 0, of the picture.
      auto: choose radius and eps, as far as they are None, by cross-validation (see `cross_validation`).
      firefly_factor: >= 1, see `clamp_fireflies`; None for no clamp. At one sample a pixel honest light exceeds
        its median tenfold: with 6, sparse light loses more than fireflies cost.
      demodulate: filter light without albedo, where there is one.
      whole: filter direct light as well where it is separate; else only indirect light is filtered there.
      keep_lamps: leave pixels as they are that seem to show a lamp itself (see `seen_lamps`), where the light that is
        filtered may hold some.
    """

    method: Method = "guided"
    radius: int | None = None
    eps: float | None = None
    samples_per_pixel: float | None = None
    auto: bool = False
    firefly_factor: float | None = 16.0
    demodulate: bool = True
    whole: bool = False
    keep_lamps: bool = True

    def check(self) -> None:
        """Raises ValueError, naming the field, if a value is out of its range."""
        checks.check_one_of("method", self.method, ("guided", "bilateral", "atrous"))
        if self.radius is not None:
            checks.check_whole("radius", self.radius, 1)
        for name in ("eps", "samples_per_pixel"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise ValueError(f"{name}: expected a number above 0, got {value}")
        if self.firefly_factor is not None:
            checks.check_at_least("firefly_factor", self.firefly_factor, 1.0)


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


@partial(jax.jit, static_argnames="radius")
def _guided(channels: Image, light: Image, eps: Float[Array, " g"], radius: int) -> Image:
    return guided_filter(channels, light, radius=radius, eps=eps)


@partial(jax.jit, static_argnames="radius")
def _bilateral(light: Image, channels: Image, sigma: Float[Array, " g"], radius: int) -> Image:
    return cross_bilateral_filter(light, channels, radius=radius, sigma_spatial=radius / 2, sigma_features=sigma)


@partial(jax.jit, static_argnames="num_levels")
def _atrous(light: Image, channels: Image, sigma: Float[Array, " g"], num_levels: int) -> Image:
    return atrous_filter(light, channels, num_levels=num_levels, sigma_features=sigma)
