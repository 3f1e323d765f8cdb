"""What shines: triangles, lights without extent, and the surroundings; light drawn from each towards a point.

A drawn light comes as radiance over density, both per solid angle around the point, so that f cos times it is an
estimate of what the point gives back. Densities are 0 for lights without extent, which no ray can hit.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender import vec3
from jaxrender.deferred.shade import incoming
from jaxrender.pathtrace.environment import Environment, draw_direction, make_environment
from jaxrender.pathtrace.hit_points import HitSurface, SurfaceTable, hit_surface
from jaxrender.scene import DIRECTIONAL, Lights, Scene
from jaxrender.vec3 import Scalar, Vec3, dot

#: Kinds of lights, in the order in which they are drawn.
ALL_GROUPS = ("area", "lights", "environment")

#: In the square of the scene's unit.
_SMALLEST_AREA = 1e-30

#: Barycentric coordinates at which the emission of a triangle is read for the tables.
_PROBES = ((1 / 3, 1 / 3), (0.1, 0.1), (0.8, 0.1), (0.1, 0.8))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Emitters:
    """All lights of a scene.

    Attributes:
      area_triangle: those that emit; area_chance: cumulative probability of each, by power.
      area_corners: of each: corner, edges to the two others, and radiance without its texture.
      area_density: by triangle of the scene, probability over area; 0 of those that do not emit.
      two_sided: by triangle of the scene, whether its back emits too.
      lights: without extent; light_chance: cumulative probability of each.
      environment: None if nothing comes from far away.
      groups: which of "area", "lights" and "environment" there are.
    """

    area_triangle: Int[Array, " m"]
    area_chance: Float[Array, " m"]
    area_corners: Float[Array, "m 12"]
    area_density: Float[Array, " t"]
    two_sided: Bool[Array, " t"]
    lights: Lights
    light_chance: Float[Array, " n"]
    environment: Environment | None
    groups: tuple[str, ...] = field(metadata={"static": True})


class Arriving(NamedTuple):
    """Light drawn towards a point.

    Attributes:
      wi: unit, to the light. distance: to it, inf for one far away.
      radiance: over the density with which it was drawn.
      density: of the same direction, per solid angle; 0 for a light without extent.
    """

    wi: Vec3
    distance: Scalar
    radiance: Vec3
    density: Scalar


def make_emitters(
    scene: Scene,
    table: SurfaceTable,
    *,
    lights: Lights | None = None,
    environment: Float[np.ndarray, "h w 3"] | None = None,
) -> Emitters:
    """Finds the emitting triangles of a scene (those without area are left out) and makes tables, on the host.

    Args:
      lights: instead of the scene's.
      environment: radiance from far away (`make_environment`).
    """
    lights = scene.lights if lights is None else lights
    triangle, area, corners, power = _shining(scene, table)
    chance, density = _cumulative(power), np.zeros(len(scene.faces), np.float32)
    density[triangle] = np.diff(chance, prepend=np.float32(0.0)) / area
    far = None if environment is None or not np.any(environment) else make_environment(environment)
    present = {"area": len(triangle), "lights": len(lights.kind), "environment": far is not None}
    return Emitters(
        area_triangle=jnp.asarray(triangle), area_chance=jnp.asarray(chance), area_density=jnp.asarray(density),
        area_corners=jnp.asarray(corners, jnp.float32),
        two_sided=scene.material.double_sided[scene.material_id], lights=lights,
        light_chance=jnp.asarray(_cumulative(_light_power(lights))), environment=far,
        groups=tuple(name for name, some in present.items() if some),
    )  # fmt: skip


def _shining(scene: Scene, table: SurfaceTable) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The triangles that emit: numbers, areas, `Emitters.area_corners`, and powers."""
    faces, material = np.asarray(scene.faces), np.asarray(scene.material_id)
    emissive = np.asarray(scene.material.emissive)
    p = np.asarray(scene.positions, np.float64)[faces]
    area = 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    # Below this, 1 / area leaves the range of float32; no ray would find such a triangle either.
    glows = (emissive[material] > 0.0).any(axis=1) & (area > _SMALLEST_AREA)
    triangle = np.flatnonzero(glows).astype(np.int32)
    power = area[triangle] * _mean_emission(table, triangle)
    triangle, power = triangle[power > 0.0], power[power > 0.0]
    a, b, c = (p[triangle, k] for k in range(3))
    corners = np.concatenate([a, b - a, c - a, emissive[material[triangle]]], axis=1)
    return triangle, area[triangle], corners, power


def draw_area(emitters: Emitters, table: SurfaceTable, position: Vec3, pick: Scalar, u: Scalar, v: Scalar) -> Arriving:
    """A point of an emitting triangle, uniform over the area of one chosen by power.

    References:
      Square to triangle: Osada et al., "Shape Distributions", TOG 21(4), 2002, section 4.2.
    """
    index = _picked(emitters.area_chance, pick)
    triangle = emitters.area_triangle[index]
    root = jnp.sqrt(u)
    b1, b2 = root * (1.0 - v), root * v
    rows = emitters.area_corners[index]
    a, e1, e2, radiance = (vec3.from_array(rows[:, 3 * k : 3 * k + 3]) for k in range(4))
    away = a + e1 * b1 + e2 * b2 - position
    distance2 = jnp.maximum(dot(away, away), 1e-20)
    distance = jnp.sqrt(distance2)
    wi = away / distance
    n = vec3.normalize(vec3.cross(e1, e2))
    toward = -dot(n, wi)
    shown = jnp.where(emitters.two_sided[triangle], jnp.abs(toward), jnp.maximum(toward, 0.0))
    density = area_density(emitters, triangle, distance, shown)
    if "emissive_texture" in table.slots:
        radiance = hit_surface(table, triangle, jnp.stack([b1, b2], axis=-1), wi).emissive
    return Arriving(wi, distance, vec3.where(shown > 1e-6, radiance / density, 0.0), density)


def draw_light(emitters: Emitters, position: Vec3, pick: Scalar) -> Arriving:
    """One of the lights without extent."""
    index = _picked(emitters.light_chance, pick)
    chance = emitters.light_chance[index] - jnp.where(index > 0, emitters.light_chance[jnp.maximum(index - 1, 0)], 0.0)
    one = jax.tree.map(lambda values: values[index], emitters.lights)
    wi, radiance = jax.vmap(incoming)(one, vec3.to_array(position))
    away = vec3.from_array(one.position) - position
    distance = jnp.where(one.kind == DIRECTIONAL, jnp.inf, vec3.length(away))
    return Arriving(
        vec3.from_array(wi), distance, vec3.from_array(radiance) / jnp.maximum(chance, 1e-12), jnp.zeros_like(distance)
    )


def draw_environment(emitters: Emitters, u: Scalar, v: Scalar) -> Arriving:
    """A direction of the surroundings, by brightness."""
    assert emitters.environment is not None
    found = draw_direction(emitters.environment, u, v)
    radiance = vec3.where(found.density > 0.0, found.radiance / jnp.maximum(found.density, 1e-12), 0.0)
    return Arriving(found.direction, jnp.full_like(u, jnp.inf), radiance, found.density)


def area_density(emitters: Emitters, triangle: Int[Array, " n"], distance: Scalar, cosine: Scalar) -> Scalar:
    """Density per solid angle with which `draw_area` finds the point that a ray hits at some distance."""
    own = emitters.area_density[jnp.maximum(triangle, 0)]
    return jnp.where(triangle >= 0, own * distance * distance / jnp.maximum(jnp.abs(cosine), 1e-6), 0.0)


def _picked(chance: Float[Array, " m"], pick: Scalar) -> Int[Array, " n"]:
    """The first index at which a cumulative probability is above a uniform number."""
    return jnp.clip(jnp.searchsorted(chance, pick, side="right"), 0, len(chance) - 1)


def _mean_emission(table: SurfaceTable, triangle: Int[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Over channels and over some points of each triangle."""
    if not len(triangle):
        return np.zeros(0)
    count = len(triangle)
    barycentrics = jnp.asarray(np.tile(_PROBES, (count, 1)), jnp.float32)
    down = Vec3(*(jnp.full(len(barycentrics), x, jnp.float32) for x in (0.0, -1.0, 0.0)))
    surface = _hit_surface(table, jnp.asarray(np.repeat(triangle, len(_PROBES))), barycentrics, down)
    return np.asarray(vec3.mean(surface.emissive), np.float64).reshape(count, len(_PROBES)).mean(axis=1)


def _light_power(lights: Lights) -> Float[np.ndarray, " n"]:
    """By intensity where there are many; all alike if they are few, so that as many samples draw each once."""
    mean = np.asarray(lights.intensity, np.float64).mean(axis=-1)
    return np.ones(len(mean)) if len(mean) <= 4 or not mean.any() else mean + 1e-3 * mean.max()


def _cumulative(power: Float[np.ndarray, " n"]) -> np.ndarray:
    total = np.cumsum(power)
    return (total / total[-1]).astype(np.float32) if len(total) else np.zeros(0, np.float32)


def emitted(emitters: Emitters, surface: HitSurface) -> Vec3:
    """Radiance towards rays that hit a surface; its back emits if it has two sides."""
    shines = surface.front | emitters.two_sided[jnp.maximum(surface.triangle, 0)]
    return vec3.where((surface.triangle >= 0) & shines, surface.emissive, 0.0)


def only(emitters: Emitters, groups: tuple[str, ...]) -> Emitters:
    """The same with some of its groups; rays still meet the others."""
    return replace(emitters, groups=tuple(group for group in emitters.groups if group in groups))


_hit_surface = jax.jit(hit_surface)
