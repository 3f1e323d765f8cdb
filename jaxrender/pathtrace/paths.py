"""One vertex of a path at a time: light that arrives at it from lights, and the way on. Rays are traced in between.

A path is throughput (what part of the light found further on reaches the eye), f cos over density at each vertex. Two
ways find a light: it is drawn, or a scattered ray meets it. Both count, weighted by the balance heuristic:

    drawn      p_l / (S p_l + B p_b)   for each of S lights drawn with density p_l,
    met        p_b / (S p_l + B p_b)   for each of B rays scattered with density p_b,

all densities per solid angle around the vertex. A light without extent is drawn only, and counts 1/S. So do the others
at points that are not `shared`; rays scattered there count nothing.

References:
  Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997, section 9.2.2.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrender import vec3
from jaxrender.pathtrace.emitters import (
    Arriving,
    Emitters,
    area_density,
    draw_area,
    draw_environment,
    draw_light,
    emitted,
)
from jaxrender.pathtrace.environment import look_up
from jaxrender.pathtrace.hit_points import HitSurface, SurfaceTable
from jaxrender.pathtrace.low_discrepancy import Words, uniform_pair
from jaxrender.pathtrace.ray_offset import moved_coordinates
from jaxrender.pathtrace.scatter import Reflector, density, draw, evaluate
from jaxrender.vec3 import Scalar, Vec3, dot

#: Pairs of random numbers that a vertex may use.
_PAIRS = 5
_DIRECTION, _CHOICES, _AREA, _PICKS, _SKY = range(_PAIRS)

#: Paths end at random from this vertex on, if little light would come through.
ROULETTE_FROM = 3


class Vertex(NamedTuple):
    """What is done at a vertex; static, but for the number, and for how many are scattered where any are.

    Attributes:
      number: 0 is what the eye sees.
      drawn, scattered: S and B.
      model: of reflection, one of `scatter.MODELS`.
    """

    number: int | Int[Array, ""]
    drawn: int
    scattered: int | Float[Array, ""]
    model: str


class Path(NamedTuple):
    """Where paths stand.

    Attributes:
      throughput: see above. density: that of the direction in which the path goes on.
      alive: whether it goes on.
      shared: whether lights at the next vertex are found both ways.
    """

    throughput: Vec3
    density: Scalar
    alive: Bool[Array, " n"]
    shared: Bool[Array, " n"]


class Rays(NamedTuple):
    """Origins and unit directions."""

    origin: Vec3
    direction: Vec3


class ShadowRays(NamedTuple):
    """Rays to lights, and what arrives if nothing is nearer than `distance`.

    Attributes:
      light: radiance times throughput times f cos, weighted.
    """

    origin: Vec3
    direction: Vec3
    distance: Scalar
    light: Vec3


def begin(num_paths: int) -> Path:
    """Paths at the eye."""
    one, true = jnp.ones(num_paths), jnp.ones(num_paths, bool)
    return Path(Vec3(one, one, one), one, true, true)


def meet(
    emitters: Emitters, path: Path, direction: Vec3, distance: Scalar, surface: HitSurface, *, left: Vertex
) -> Vec3:
    """Light of an emitter that scattered rays meet, or of the surroundings where they meet nothing.

    Args:
      distance, surface: at the end of the rays.
      left: the vertex that the rays leave.
    """
    found, p_l = Vec3(*(jnp.zeros_like(distance),) * 3), jnp.zeros_like(distance)
    if "area" in emitters.groups:
        found = emitted(emitters, surface)
        p_l = area_density(emitters, surface.triangle, distance, dot(surface.geometric_normal, direction))
    if emitters.environment is not None:
        far, away = look_up(emitters.environment, direction), surface.triangle < 0
        found, p_l = vec3.where(away, far.radiance, found), jnp.where(away, far.density, p_l)
    weight = path.density / jnp.maximum(left.scattered * path.density + left.drawn * p_l, 1e-30)
    return vec3.where(path.alive & path.shared, path.throughput * found * weight, 0.0)


def draw_lights(
    emitters: Emitters, table: SurfaceTable, at: Reflector, path: Path, seeds: Words, index: Int[Array, ""], *,
    vertex: Vertex,
) -> tuple[ShadowRays, ...]:  # fmt: skip
    """As many lights of each group as are `drawn`, towards each vertex. `index` is that of the sample."""
    rays = []
    for s in range(vertex.drawn):
        dimension = vertex.number * _PAIRS
        numbers = [_pair(at, index * vertex.drawn + s, seeds, dimension + k) for k in range(_PAIRS)]
        # Between them, the picks of a vertex fall into each of as many parts once.
        pick, pick_light = ((p + s) / vertex.drawn for p in numbers[_PICKS])
        for group in emitters.groups:
            if group == "area":
                light = draw_area(emitters, table, at.position, pick, *numbers[_AREA])
            elif group == "lights":
                light = draw_light(emitters, at.position, pick_light)
            else:
                light = draw_environment(emitters, *numbers[_SKY])
            rays.append(_toward(at, path, light, vertex))
    return tuple(rays)


def _pair(at: Reflector, index: Int[Array, ""], seeds: Words, dimension: int | Array) -> tuple[Scalar, ...]:
    """`uniform_pair` in the precision of the vertices."""
    return tuple(x.astype(at.roughness.dtype) for x in uniform_pair(index, seeds, dimension=dimension))


def _toward(at: Reflector, path: Path, light: Arriving, vertex: Vertex) -> ShadowRays:
    f = evaluate(at, light.wi, model=vertex.model)
    both = vertex.drawn * light.density
    if isinstance(vertex.scattered, Array) or vertex.scattered:
        both = both + vertex.scattered * jnp.where(path.shared, density(at, light.wi, model=vertex.model), 0.0)
    weight = jnp.where(light.density > 0.0, light.density / jnp.maximum(both, 1e-30), 1.0 / vertex.drawn)
    arriving = vec3.where(path.alive, path.throughput * f * light.radiance * weight, 0.0)
    # To a point of a lamp, less what rounding may add.
    return ShadowRays(offset(at, light.wi), light.wi, light.distance * (1.0 - 1e-4), arriving)


def go_on(at: Reflector, path: Path, seeds: Words, index: Int[Array, ""], *, vertex: Vertex) -> tuple[Rays, Path]:
    """A scattered ray for each path; from `ROULETTE_FROM` on some end, and the others count for more."""
    (u, v), (choice, luck) = (_pair(at, index, seeds, vertex.number * _PAIRS + k) for k in (_DIRECTION, _CHOICES))
    scattered = draw(at, u, v, choice, model=vertex.model)
    throughput = path.throughput * scattered.weight
    alive = path.alive & (vec3.largest(throughput) > 0.0)
    fades = jnp.asarray(vertex.number) >= ROULETTE_FROM
    chance = jnp.where(fades, jnp.clip(vec3.largest(throughput), 0.05, 1.0), 1.0)
    alive, throughput = alive & (luck < chance), throughput / chance
    rays = Rays(offset(at, scattered.wi), scattered.wi)
    return rays, Path(vec3.where(alive, throughput, 0.0), scattered.density, alive, path.shared)


def offset(at: Reflector, direction: Vec3) -> Vec3:
    """Origins off the surface, on the side of a direction (`ray_offset.offset_origin`)."""
    n = vec3.where(dot(at.geometric_normal, direction) < 0.0, -at.geometric_normal, at.geometric_normal)
    return Vec3(*map(moved_coordinates, at.position, n))


def openness(distance: Scalar, triangle: Int[Array, " n"], radii: Float[Array, " k"]) -> tuple[Scalar, ...]:
    """min(d / R, 1) of the distances that rays of cosine density reach: their mean is ambient occlusion, 1 for open."""
    far = jnp.where(triangle >= 0, distance, jnp.inf)
    return tuple(jnp.minimum(far / radii[k], 1.0) for k in range(len(radii)))
