"""One vertex of a path at a time, by the balance heuristic.

References:
  Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997, section 9.2.2.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.pathtrace.emitters import (
    Emitters,
    area_density,
    draw_area,
    draw_environment,
    draw_light,
    emitted,
)
from torchref.pathtrace.environment import look_up
from torchref.pathtrace.hit_points import HitSurface, SurfaceTable
from torchref.pathtrace.low_discrepancy import Words, uniform_pair
from torchref.pathtrace.ray_offset import offset_origin
from torchref.pathtrace.scatter import Reflector, density, draw, evaluate
from torchref.vec3 import Scalar, Vec3, from_array, to_array
from torchref.vecmath import dot

_PAIRS = 5
ROULETTE_FROM = 3


class Vertex(NamedTuple):
    """Its number from the eye, how many lights are drawn and rays scattered there, and the model of reflection."""

    number: int | Int[Tensor, ""]
    drawn: int
    scattered: int | Float[Tensor, ""]
    model: str


class Path(NamedTuple):
    """Throughput, density of the last direction, whether it goes on, and whether lights are found both ways."""

    throughput: Vec3
    density: Scalar
    alive: Bool[Tensor, " n"]
    shared: Bool[Tensor, " n"]


class Rays(NamedTuple):
    """Origins and unit directions."""

    origin: Vec3
    direction: Vec3


class ShadowRays(NamedTuple):
    """Rays to lights, how far, and what arrives if nothing is in between."""

    origin: Vec3
    direction: Vec3
    distance: Scalar
    light: Vec3


def begin(num_paths: int) -> Path:
    """Paths at the eye."""
    one, true = torch.ones(num_paths), torch.ones(num_paths, dtype=torch.bool)
    return Path(Vec3(one, one, one), one, true, true)


@in_float64
def meet(
    emitters: Emitters, path: Path, direction: Vec3, distance: Scalar, surface: HitSurface, *, left: Vertex
) -> Vec3:
    """What scattered rays find, times their share of the heuristic."""
    missed = surface.triangle < 0
    found, chance = torch.zeros(len(missed), 3, dtype=torch.float64), torch.zeros(len(missed), dtype=torch.float64)
    if "area" in emitters.groups:
        found = to_array(emitted(emitters, surface))
        cosine = dot(to_array(surface.geometric_normal), to_array(direction))[:, 0]
        chance = area_density(emitters, surface.triangle, distance, cosine)
    if emitters.environment is not None:
        far = look_up(emitters.environment, direction)
        found = torch.where(missed[:, None], to_array(far.radiance), found)
        chance = torch.where(missed, far.density, chance)
    # p_b / (S p_l + B p_b)
    share = path.density / (left.drawn * chance + left.scattered * path.density).clamp(min=1e-30)
    counts = (path.alive & path.shared)[:, None]
    return from_array(torch.where(counts, to_array(path.throughput) * found * share[:, None], 0.0))


@in_float64
def draw_lights(
    emitters: Emitters, table: SurfaceTable, at: Reflector, path: Path, seeds: Words, index: Int[Tensor, ""], *,
    vertex: Vertex,
) -> tuple[ShadowRays, ...]:  # fmt: skip
    """S lights of each group; their picks fall one in each S-th of [0, 1)."""
    rays = []
    for s in range(vertex.drawn):
        pairs = [
            uniform_pair(index * vertex.drawn + s, seeds, dimension=vertex.number * _PAIRS + k) for k in range(_PAIRS)
        ]
        area, picks, sky = (tuple(x.double() for x in pairs[k]) for k in (2, 3, 4))
        picks = [(pick + s) / vertex.drawn for pick in picks]
        drawn = {
            "area": lambda picks=picks, area=area: draw_area(emitters, table, at.position, picks[0], *area),
            "lights": lambda picks=picks: draw_light(emitters, at.position, picks[1]),
            "environment": lambda sky=sky: draw_environment(emitters, *sky),
        }
        rays += [_shadow_ray(at, path, drawn[group](), vertex) for group in emitters.groups]
    return tuple(rays)


def _shadow_ray(at, path, light, vertex):
    f = to_array(evaluate(at, light.wi, model=vertex.model))
    by_ray = torch.where(path.shared, density(at, light.wi, model=vertex.model), 0.0)
    # p_l / (S p_l + B p_b); no ray meets a light without extent.
    both = vertex.drawn * light.density + vertex.scattered * by_ray
    share = torch.where(light.density > 0.0, light.density / both.clamp(min=1e-30), 1.0 / vertex.drawn)[:, None]
    light_in = to_array(path.throughput) * f * to_array(light.radiance) * share
    light_in = torch.where(path.alive[:, None], light_in, 0.0)
    return ShadowRays(offset(at, light.wi), light.wi, (1.0 - 1e-4) * light.distance, from_array(light_in))


@in_float64
def go_on(at: Reflector, path: Path, seeds: Words, index: Int[Tensor, ""], *, vertex: Vertex) -> tuple[Rays, Path]:
    """A scattered ray; where light fades, the path ends by chance 1 - q, and what goes on counts 1 / q."""
    (u, v), (choice, luck) = (
        (x.double() for x in uniform_pair(index, seeds, dimension=vertex.number * _PAIRS + k)) for k in (0, 1)
    )
    found = draw(at, u, v, choice, model=vertex.model)
    throughput = to_array(path.throughput) * to_array(found.weight)
    most = throughput.amax(dim=1)
    alive = path.alive & (most > 0.0)
    if vertex.number >= ROULETTE_FROM:
        chance = most.clamp(0.05, 1.0)
        alive, throughput = alive & (luck < chance), throughput / chance[:, None]
    throughput = from_array(torch.where(alive[:, None], throughput, 0.0))
    return Rays(offset(at, found.wi), found.wi), Path(throughput, found.density, alive, path.shared)


@in_float64
def offset(at: Reflector, direction: Vec3) -> Vec3:
    """`offset_origin` of the position."""
    return from_array(offset_origin(to_array(at.position), to_array(at.geometric_normal), to_array(direction)))


@in_float64
def openness(distance: Scalar, triangle: Int[Tensor, " n"], radii: Float[Tensor, " k"]) -> tuple[Scalar, ...]:
    """min(d / R, 1) for each radius; 1 for rays that hit nothing."""
    return tuple(torch.where(triangle >= 0, (distance / radius).clamp(max=1.0), 1.0) for radius in radii)
