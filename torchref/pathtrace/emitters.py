"""What shines, and light drawn from it towards points, one after another."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.deferred.shade import incoming
from torchref.pathtrace.environment import Environment, draw_direction
from torchref.pathtrace.hit_points import HitSurface, SurfaceTable, hit_surface
from torchref.scene import DIRECTIONAL, Lights
from torchref.vec3 import Scalar, Vec3, from_array, to_array
from torchref.vecmath import dot, normalize, safe_div


@dataclass(frozen=True)
class Emitters:
    """Tables of emitting triangles, of lights without extent, and of the surroundings."""

    area_triangle: Int[Tensor, " m"]
    area_chance: Float[Tensor, " m"]
    area_corners: Float[Tensor, "m 12"]
    area_density: Float[Tensor, " t"]
    two_sided: Bool[Tensor, " t"]
    lights: Lights
    light_chance: Float[Tensor, " n"]
    environment: Environment | None
    groups: tuple[str, ...]


class Arriving(NamedTuple):
    """Direction and distance to a light, radiance over density, and the density per solid angle."""

    wi: Vec3
    distance: Scalar
    radiance: Vec3
    density: Scalar


@in_float64
def draw_area(emitters: Emitters, table: SurfaceTable, position: Vec3, pick: Scalar, u: Scalar, v: Scalar) -> Arriving:
    """A triangle by its chance, then P = (1 - √u) A + √u (1 - v) B + √u v C (Osada et al. 2002, eq. 1).

    The density over area times r² / cos is one per solid angle.
    """
    index = _inverted(emitters.area_chance, pick)
    a, edge_1, edge_2, radiance = emitters.area_corners[index].split(3, dim=1)
    triangle, root = emitters.area_triangle[index], torch.sqrt(u)[:, None]
    b, c = root * (1.0 - v[:, None]), root * v[:, None]
    corners = (a, a + edge_1, a + edge_2)
    point = sum(weight * corner for weight, corner in zip((1.0 - b - c, b, c), corners, strict=True))
    away = point - to_array(position)
    distance, wi = away.norm(dim=1, keepdim=True), normalize(away)
    cosine = dot(normalize(torch.linalg.cross(edge_1, edge_2)), -wi)
    both = emitters.two_sided[triangle.long()][:, None]
    seen = torch.where(both, cosine.abs(), cosine.clamp(min=0.0))
    density = area_density(emitters, triangle, distance[:, 0], seen[:, 0])[:, None]
    if "emissive_texture" in table.slots:
        places = torch.cat([b, c], dim=1)
        radiance = to_array(hit_surface(table, triangle, places, from_array(wi)).emissive)
    arriving = torch.where(seen > 1e-6, radiance / density, 0.0)
    return Arriving(from_array(wi), distance[:, 0], from_array(arriving), density[:, 0])


@in_float64
def draw_light(emitters: Emitters, position: Vec3, pick: Scalar) -> Arriving:
    """A light without extent by its chance; its irradiance over that."""
    index, where = _inverted(emitters.light_chance, pick), to_array(position)
    chance = emitters.light_chance.diff(prepend=torch.zeros(1, dtype=torch.float64))[index]
    wi, radiance, distance = [], [], []
    for i, point in zip(index.tolist(), where, strict=True):
        light = Lights(**{name: values[i] for name, values in vars(emitters.lights).items()})
        towards, irradiance = incoming(light, point)
        far = light.kind == DIRECTIONAL
        wi.append(towards)
        radiance.append(irradiance)
        distance.append(torch.full_like(point[0], torch.inf) if far else (light.position - point).norm())
    found = from_array(torch.stack(radiance) / chance[:, None])
    return Arriving(from_array(torch.stack(wi)), torch.stack(distance), found, torch.zeros_like(pick))


@in_float64
def draw_environment(emitters: Emitters, u: Scalar, v: Scalar) -> Arriving:
    """Radiance of the surroundings over the density of its direction."""
    far = draw_direction(emitters.environment, u, v)
    radiance = safe_div(to_array(far.radiance), far.density[..., None].expand(*u.shape, 3))
    return Arriving(far.direction, torch.full_like(u, torch.inf), from_array(radiance), far.density)


@in_float64
def area_density(emitters: Emitters, triangle: Int[Tensor, " n"], distance: Scalar, cosine: Scalar) -> Scalar:
    """The chance per area of a point, times r² / cos; 0 where nothing is hit."""
    own = emitters.area_density[triangle.clamp(min=0).long()]
    return torch.where(triangle >= 0, own * distance**2 / cosine.abs().clamp(min=1e-6), 0.0)


@in_float64
def emitted(emitters: Emitters, surface: HitSurface) -> Vec3:
    """Radiance of the front, and of the back of what has two sides."""
    seen = surface.front | emitters.two_sided[surface.triangle.clamp(min=0).long()]
    return from_array(torch.where((seen & (surface.triangle >= 0))[:, None], to_array(surface.emissive), 0.0))


def only(emitters: Emitters, groups: tuple[str, ...]) -> Emitters:
    """The same with some of its groups."""
    return replace(emitters, groups=tuple(x for x in emitters.groups if x in groups))


def _inverted(cumulative: Float[Tensor, " m"], pick: Tensor) -> Tensor:
    """The first entry above a number, the last if none is."""
    above = cumulative[None] > pick[:, None]
    return torch.where(above.any(1), above.double().argmax(1), len(cumulative) - 1)
