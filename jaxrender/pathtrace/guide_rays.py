"""The rays through pixel centres: their surface, the direct light on it, and the indirect light that arrives there."""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender import checks, vec3
from jaxrender.camera import Camera
from jaxrender.pathtrace import programs
from jaxrender.pathtrace.emitters import Emitters, only
from jaxrender.pathtrace.paths import Path, Vertex
from jaxrender.pathtrace.programs import Images, View, light_up, make_view
from jaxrender.pathtrace.scatter import Reflector, reflectance
from jaxrender.pathtrace.settings import TraceSettings
from jaxrender.pathtrace.world import World
from jaxrender.vec3 import Scalar, Vec3

#: Lengths of the rays of ambient occlusion, over the diagonal of the scene's box.
AO_RADII = (0.02, 0.05, 0.15)

#: Lights with and without extent.
SOFT, SHARP = ("area", "environment"), ("lights",)


@dataclass(frozen=True)
class Traced:
    """Images of guide rays, before any filter. All are 0 where nothing is seen, but `emission`.

    Attributes:
      arrived: light of lamps with extent, then of the surroundings, as far as there are any, side by side.
      unshadowed: what would arrive without anything in between, of the same samples.
      sharp: light of lights without extent. met: of what scattered rays met by themselves. These four have the
        reflectance in them; the sum of all but `unshadowed` is the direct light.
      incident: indirect light over the reflectance.
      emission: of what is seen itself.
      variance: of `incident`, of the mean over paths; 0 for one path a pixel.
      even, odd: `incident` of the paths of even and of odd number; the same for one path.
      albedo: reflectance (`scatter.reflectance`).
      normal, position, depth: of the surface; depth is linear view depth.
      ao: ambient occlusion for each of `AO_RADII`, 1 for open.
      sharpness: of reflections (`sharpness.sharpness`).
    """

    arrived: Float[np.ndarray, "h w 3k"]
    unshadowed: Float[np.ndarray, "h w 3k"]
    sharp: Float[np.ndarray, "h w 3"]
    met: Float[np.ndarray, "h w 3"]
    incident: Float[np.ndarray, "h w 3"]
    emission: Float[np.ndarray, "h w 3"]
    variance: Float[np.ndarray, "h w 3"]
    even: Float[np.ndarray, "h w 3"]
    odd: Float[np.ndarray, "h w 3"]
    albedo: Float[np.ndarray, "h w 3"]
    normal: Float[np.ndarray, "h w 3"]
    position: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w 1"]
    ao: Float[np.ndarray, "h w k"]
    sharpness: Float[np.ndarray, "h w 1"]

    @property
    def direct(self) -> Float[np.ndarray, "h w 3"]:
        return sum_of_groups(self.arrived) + self.sharp + self.met

    @property
    def indirect(self) -> Float[np.ndarray, "h w 3"]:
        return self.incident * self.albedo

    @property
    def color(self) -> Float[np.ndarray, "h w 3"]:
        return self.direct + self.indirect + self.emission


def trace_guides(
    world: World, camera: Camera, *, height: int, width: int, settings: TraceSettings, first_sample: int = 0
) -> Traced:
    """Direct and indirect light of the rays through pixel centres, unfiltered.

    Args:
      first_sample: number of the first of `samples_per_pixel` paths; others have other random numbers.
    Raises:
      ValueError: if a size or a setting is out of its range.
    """
    settings.check()
    checks.check_at_least("height", height, 1)
    checks.check_at_least("width", width, 1)
    view = make_view(camera, height=height)
    trace = functools.partial(
        _block, world, view, height=height, width=width, settings=settings, first_sample=first_sample
    )
    return Traced(**programs.trace_blocks(trace, height=height, width=width))


def pooled(first: Traced, second: Traced, *, counts: tuple[int, int]) -> Traced:
    """The means over the paths of two traces of one view, which had so many each."""
    n, m = counts
    total = n + m
    names = [field.name for field in dataclasses.fields(Traced)]
    means = {name: (n * getattr(first, name) + m * getattr(second, name)) / total for name in names}
    # Sums of squared deviations add up, with how far the two means are apart.
    apart = first.incident - second.incident
    squares = n * (n - 1) * first.variance + m * (m - 1) * second.variance + n * m / total * apart * apart
    means["variance"] = squares / (total * (total - 1))
    if n == m == 1:
        means["even"], means["odd"] = first.incident, second.incident
    same = ("emission", "albedo", "normal", "position", "depth", "sharpness")
    return Traced(**means | {name: getattr(first, name) for name in same})


def soft_groups(emitters: Emitters) -> list[Emitters]:
    """The groups of light with extent, apart."""
    return [only(emitters, (group,)) for group in SOFT if group in emitters.groups]


def sum_of_groups(image: Float[np.ndarray, "*b 3k"]) -> Float[np.ndarray, "*b 3"]:
    """The light of all groups that stand side by side."""
    return image.reshape(*image.shape[:-1], -1, 3).sum(axis=-2)


def _block(
    world: World, view: View, start: int, *, block: int, height: int, width: int, settings: TraceSettings,
    first_sample: int,
) -> Images:  # fmt: skip
    """All images of `block` pixels, row by row, from pixel `start` on."""
    rays, seeds = programs.eye_rays(view, start, settings.seed, 0, block=block, height=height, width=width)
    at, path, seen = programs.see(world, view, rays, model=settings.model, by_ratio=settings.by_ratio)
    direct = _direct(world, at, path, seeds, first_sample, settings)
    return {**seen, **direct, **_indirect(world, at, path, seeds, first_sample, settings)}


def _direct(
    world: World, at: Reflector, path: Path, seeds: Array, first_sample: int, settings: TraceSettings
) -> dict[str, Sequence[Scalar]]:
    """Light of drawn lights on guide rays' hits."""
    spp = settings.samples_per_pixel
    vertex = Vertex(0, settings.light_samples, spp if settings.bounces else 0, settings.model)
    # Plain, each eye ray finds soft light for itself; by ratio, the guide ray finds it for all.
    shares = spp if settings.by_ratio else 1
    arrived: list[Scalar] = []
    unshadowed: list[Scalar] = []
    for emitters in soft_groups(world.emitters):
        light = {"seen": programs.black(at), "whole": programs.black(at)}
        for sample in range(first_sample, first_sample + shares):
            seen, whole = light_up(world, emitters, at, path, seeds, sample, vertex=vertex)
            light = programs.added(light, {"seen": seen, "whole": whole})
        light = _scaled(light, np.float32(1.0 / shares))
        arrived, unshadowed = [*arrived, *light["seen"]], [*unshadowed, *light["whole"]]
    hard = only(world.emitters, SHARP)
    sharp, _ = light_up(world, hard, at, path, seeds, first_sample, vertex=vertex)
    return {"arrived": arrived, "unshadowed": unshadowed, "sharp": sharp}


def _indirect(
    world: World, at: Reflector, path: Path, seeds: Array, first_sample: int, settings: TraceSettings
) -> dict[str, Vec3]:
    """Light of paths from guide rays' hits, and ambient occlusion."""
    scattered = settings.samples_per_pixel if settings.bounces else 0
    sums = dict.fromkeys(("even", "odd", "squares", "met", "ao"), programs.black(at))
    radii = world.extent * np.asarray(AO_RADII, np.float32)
    for sample in range(scattered):
        terms = _follow(world, at, path, seeds, first_sample + sample, radii, settings)
        terms["odd" if sample % 2 else "even"] = terms.pop("incident")
        sums = programs.added(sums, terms)
    for ray in range(settings.num_ao_rays):
        number = first_sample * settings.num_ao_rays + ray
        rays = programs.occlusion_rays(at, seeds, np.int32(number))
        hits = world.rays.closest(rays, path.alive, reach=float(radii.max()))
        sums = programs.added(sums, {"ao": Vec3(*programs.openness(hits.t, hits.triangle, radii))})
    counts = settings.samples_per_pixel, scattered + settings.num_ao_rays
    return {"met": sums.pop("met"), **_means(sums, *map(np.float32, counts))}


@jax.jit
def _means(sums: dict[str, Vec3], spp: Float[Array, ""], num_ao: Float[Array, ""]) -> dict[str, Vec3]:
    """Means, halves and variance of incident light from sums over `spp` paths; openness from one over `num_ao` rays."""
    num_odd = jnp.floor(0.5 * spp)
    mean = (sums["even"] + sums["odd"]) / spp
    spread = sums["squares"] / spp - mean * mean
    variance = Vec3(*(jnp.maximum(c, 0.0) for c in spread)) / jnp.maximum(spp - 1.0, 1.0)
    odd = vec3.where(num_odd > 0.0, sums["odd"] / jnp.maximum(num_odd, 1.0), mean)
    ao = vec3.where(num_ao > 0.0, sums["ao"] / jnp.maximum(num_ao, 1.0), 1.0)
    return {"incident": mean, "variance": variance, "even": sums["even"] / (spp - num_odd), "odd": odd, "ao": ao}


def _follow(
    world: World, at: Reflector, path: Path, seeds: Array, sample: int, radii: np.ndarray, settings: TraceSettings
) -> dict[str, Vec3]:
    """One path of indirect light from the guides' hits.

    Returns:
      met: direct light that the first scattered ray meets. incident: indirect light over the reflectance, and its
      squares. ao: openness.
    """
    model, guide, light = settings.model, at, {"light": programs.black(at)}
    vertex = Vertex(0, settings.light_samples, settings.samples_per_pixel, model)
    for number in range(1, settings.bounces + 1):
        seen = path.alive
        rays, path = programs.scatter(at, path, seeds, sample, vertex=vertex)
        # First rays tell how open a place is, though they may bring no light.
        hits, surface = programs.hit(world, rays, seen if number == 1 else path.alive, None)
        met = programs.meet(world.emitters, path, rays.direction, hits.t, surface, left=vertex)
        if number == 1:
            direct, ao = met, Vec3(*programs.openness(hits.t, hits.triangle, radii))
        else:
            light = programs.added(light, {"light": met})
        at, path = programs.arrive(path, rays.direction, surface, model=model)
        vertex = Vertex(number, 1, 1 if number < settings.bounces else 0, model)
        drawn, _ = light_up(world, world.emitters, at, path, seeds, sample, vertex=vertex)
        light = programs.added(light, {"light": drawn})
    return {"met": direct, "ao": ao, **_over_reflectance(guide, light["light"])}


@jax.jit
def _over_reflectance(at: Reflector, light: Vec3) -> dict[str, Vec3]:
    incident = light / reflectance(at)
    return {"incident": incident, "squares": incident * incident}


@jax.jit
def _scaled(light: dict[str, Vec3], factor: Float[Array, ""]) -> dict[str, Vec3]:
    return {name: value * factor for name, value in light.items()}
