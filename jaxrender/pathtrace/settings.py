"""How a picture is traced."""

from dataclasses import dataclass

from jaxrender import checks
from jaxrender.pathtrace.scatter import MODELS

METHODS = ("guided", "bilateral", "atrous", "none")

#: From so many shadow rays a pixel on, their mean is better than a filtered ratio.
PLAIN_FROM = 32

#: From so many samples on, radius and eps of the filter are found by cross-validation. The rule is made for independent
#: samples; ours are stratified, so that from here on their noise is less than it takes for granted.
AUTO_FROM = 16

#: Most bounces that may be asked for.
MOST_BOUNCES = 64


@dataclass(frozen=True)
class TraceSettings:
    """How a picture is traced.

    Attributes:
      bounces: of indirect light, 0 to `MOST_BOUNCES`; 0 leaves direct light alone.
      samples_per_pixel: eye rays (the first through the pixel's centre), and paths of indirect light, which all leave
        from where that first ray ends.
      light_samples: of area lights and surroundings each, for each eye ray.
      model: reflection, one of `scatter.MODELS`.
      method: the filter of the indirect light, "guided", "bilateral", "atrous" or "none".
      radius, eps: of the filter, as in `DenoiseSettings`; None goes by its rule, or by cross-validation.
      auto: whether by cross-validation; None is from `AUTO_FROM` samples on.
      ao_rays: rays of ambient occlusion per pixel, a guide of the filter; None is 8 below 4 samples and without
        bounces, else 0, where the paths' own first hits are enough.
      direct: how noise of soft shadows is met. "plain" averages samples; "ratio" multiplies unshadowed light by a
        filtered share of it that arrives (`shadow_ratio`); None takes the latter below `PLAIN_FROM` samples.
      seed: of all random numbers.
    """

    bounces: int = 2
    samples_per_pixel: int = 1
    light_samples: int = 1
    model: str = "metallic_roughness"
    method: str = "guided"
    radius: int | None = None
    eps: float | None = None
    auto: bool | None = None
    ao_rays: int | None = None
    direct: str | None = None
    seed: int = 0

    def check(self) -> None:
        """Raises ValueError, naming the field, if a value is out of its range."""
        checks.check_at_least("bounces", self.bounces, 0)
        if self.bounces > MOST_BOUNCES:
            raise ValueError(f"bounces: expected at most {MOST_BOUNCES}, got {self.bounces}")
        checks.check_at_least("samples_per_pixel", self.samples_per_pixel, 1)
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed: expected a number from 0 to {2**31 - 1}, got {self.seed}")
        checks.check_at_least("light_samples", self.light_samples, 1)
        checks.check_one_of("model", self.model, MODELS)
        checks.check_one_of("method", self.method, METHODS)
        if self.direct is not None:
            checks.check_one_of("direct", self.direct, ("plain", "ratio"))
        if self.ao_rays is not None:
            checks.check_at_least("ao_rays", self.ao_rays, 0)

    @property
    def cross_validated(self) -> bool:
        """Whether the filter's radius and eps, as far as they are None, are found by cross-validation."""
        return self.samples_per_pixel >= AUTO_FROM if self.auto is None else self.auto

    @property
    def by_ratio(self) -> bool:
        """Whether soft shadows are filtered."""
        return self.direct == "ratio" or (self.direct is None and self.shadow_rays < PLAIN_FROM)

    @property
    def shadow_rays(self) -> int:
        """To each kind of soft light from a pixel."""
        return self.samples_per_pixel * self.light_samples

    @property
    def num_ao_rays(self) -> int:
        if self.ao_rays is not None:
            return self.ao_rays
        return 8 if self.samples_per_pixel < 4 or self.bounces == 0 else 0
