"""The rays through pixel centres: their surface, the direct light on it, and the indirect light that arrives there."""

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
from jax import Array
from jaxtyping import Float

from jaxrender import checks
from jaxrender.camera import Camera
from jaxrender.machine import on_all_cores
from jaxrender.pathtrace import programs
from jaxrender.pathtrace.emitters import Emitters, only
from jaxrender.pathtrace.paths import Path, Vertex
from jaxrender.pathtrace.programs import View, light_up, make_view, rows
from jaxrender.pathtrace.scatter import Reflector
from jaxrender.pathtrace.settings import TraceSettings
from jaxrender.pathtrace.world import World

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
    starts, size = programs.blocks(height * width)
    trace = functools.partial(
        _block, world, view, block=size, height=height, width=width, settings=settings, first_sample=first_sample
    )
    return Traced(**joined(list(on_all_cores(trace, starts)), height=height, width=width))


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


def joined(blocks: list[dict[str, np.ndarray]], *, height: int, width: int) -> dict[str, np.ndarray]:
    """Images from blocks of pixels, by name; pixels past the last are dropped."""
    count = height * width
    return {
        name: np.concatenate([block[name] for block in blocks])[:count].reshape(height, width, -1) for name in blocks[0]
    }


def _block(
    world: World, view: View, start: int, *, block: int, height: int, width: int, settings: TraceSettings,
    first_sample: int,
) -> dict[str, np.ndarray]:  # fmt: skip
    """All images of `block` pixels, row by row, from pixel `start` on."""
    spp, model, by_ratio = settings.samples_per_pixel, settings.model, settings.by_ratio
    rays, seeds = programs.eye_rays(view, start, settings.seed, 0, block=block, height=height, width=width)
    at, path, images = programs.see(world, view, rays, model=model, by_ratio=by_ratio)
    scattered = spp if settings.bounces else 0
    vertex = Vertex(0, settings.light_samples, scattered, model)
    sums = {name: np.zeros((block, 3), np.float32) for name in ("even", "odd", "squares", "met", "ao")}
    # Plain, each eye ray finds soft light for itself; by ratio, the guide ray finds it for all.
    shares = spp if by_ratio else 1
    soft, hard = soft_groups(world.emitters), only(world.emitters, SHARP)
    arrived, unshadowed = np.zeros((2, block, 3 * len(soft)), np.float32)
    for group, emitters in enumerate(soft):
        own = slice(3 * group, 3 * group + 3)
        for sample in range(first_sample, first_sample + shares):
            seen, whole = light_up(world, emitters, at, path, seeds, sample, vertex=vertex)
            arrived[:, own] += seen / shares
            unshadowed[:, own] += whole / shares
    sharp = np.zeros((block, 3), np.float32)
    if hard.groups:
        sharp = light_up(world, hard, at, path, seeds, first_sample, vertex=vertex)[0]
    radii = world.extent * np.asarray(AO_RADII, np.float32)
    for sample in range(scattered):
        met, incident, ao = _follow(world, at, path, seeds, first_sample + sample, radii, settings)
        half = "odd" if sample % 2 else "even"
        for name, term in ((half, incident), ("squares", incident * incident), ("met", met), ("ao", ao)):
            sums[name] += term
    for ray in range(settings.num_ao_rays):
        sums["ao"] += _occlusion(world, at, seeds, first_sample + ray, radii)
    return {**images, "arrived": arrived, "unshadowed": unshadowed, "sharp": sharp, "met": sums["met"],
            **_means(sums, spp, num_ao=scattered + settings.num_ao_rays)}  # fmt: skip


def _means(sums: dict[str, np.ndarray], spp: int, *, num_ao: int) -> dict[str, np.ndarray]:
    """Means, halves and variance of incident light from sums over `spp` paths."""
    mean = (sums["even"] + sums["odd"]) / spp
    variance = np.maximum(sums["squares"] / spp - mean * mean, 0.0) / max(spp - 1, 1)
    odd = sums["odd"] / (spp // 2) if spp > 1 else mean
    ao = sums["ao"] / num_ao if num_ao else np.ones_like(mean)
    return {"incident": mean, "variance": variance, "even": sums["even"] / ((spp + 1) // 2), "odd": odd, "ao": ao}


def _follow(
    world: World, at: Reflector, path: Path, seeds: Array, sample: int, radii: np.ndarray, settings: TraceSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One path of indirect light from the guides' hits.

    Returns:
      direct light that the first scattered ray meets, incident indirect light over the reflectance, and openness.
    """
    model, spp = settings.model, settings.samples_per_pixel
    share = rows(programs.reflected_share(at))
    light = np.zeros_like(share)
    vertex = Vertex(0, settings.light_samples, spp, model)
    for number in range(1, settings.bounces + 1):
        rays, path = programs.scatter(at, path, seeds, sample, vertex=vertex)
        hits, surface = programs.hit(world, rays, None)
        met = rows(programs.meet(world.emitters, path, rays.direction, hits.t, surface, left=vertex))
        if number == 1:
            direct, ao = met, rows(programs.openness(hits.t, hits.triangle, radii))
        else:
            light += met
        at, path = programs.arrive(path, rays.direction, surface, model=model)
        vertex = Vertex(number, 1, 1 if number < settings.bounces else 0, model)
        light += light_up(world, world.emitters, at, path, seeds, sample, vertex=vertex)[0]
    return direct, light / share, ao


def _occlusion(world: World, at: Reflector, seeds: Array, ray: int, radii: np.ndarray) -> np.ndarray:
    """Openness along one more ray."""
    rays = programs.occlusion_rays(at, seeds, np.int32(ray))
    hits = world.rays.closest(rows(rays.origin), rows(rays.direction))
    return rows(programs.openness(hits.t, hits.triangle, radii))
