"""The programs that run between rays, each compiled once, and rays between programs: for blocks of pixels.

A host program, NumPy between the steps. Each step is one of the pure kernels of `hit_points`, `scatter`, `emitters` and
`paths`; apart, they compute nothing twice (see `hit_points`).
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender import vec3
from jaxrender.camera import Camera, look_at, project_px
from jaxrender.machine import num_cores
from jaxrender.pathtrace import paths
from jaxrender.pathtrace.emitters import Emitters
from jaxrender.pathtrace.guide_lookup import guide_lookup
from jaxrender.pathtrace.hit_points import (
    HitSurface,
    SurfaceTable,
    apply_material,
    gather_corners,
    interpolate,
    look_up_texels,
)
from jaxrender.pathtrace.hits import Hits
from jaxrender.pathtrace.low_discrepancy import pixel_seeds, uniform_pair
from jaxrender.pathtrace.paths import Path, Rays, Vertex
from jaxrender.pathtrace.scatter import Reflector, draw, make_reflector, reflectance
from jaxrender.pathtrace.sharpness import sharpness
from jaxrender.pathtrace.world import World
from jaxrender.vec3 import Vec3

#: Most pixels of a block: large enough that programs outweigh what calls them.
BLOCK = 1 << 16

#: Glossy surfaces below this roughness mirror lamps: scattered rays must look for them, too.
SMOOTH = 0.3

# Pairs of random numbers by which eye rays leave the centre of their pixel, and those of occlusion rays.
_LENS, _OCCLUSION = 1000, 1001


def blocks(num_pixels: int) -> tuple[range, int]:
    """Where the blocks of a picture start, and their size, so that each core gets some.

    The last one may reach beyond the last pixel.
    """
    size = BLOCK
    while size > 256 and num_pixels < 2 * num_cores() * size:
        size //= 2
    return range(0, num_pixels, size), size


class View(NamedTuple):
    """A camera as numbers: where it is, its axes, and how wide a pixel is on the plane one unit before it."""

    eye: Vec3
    right: Vec3
    up: Vec3
    backward: Vec3
    step: float | np.float32


def make_view(camera: Camera, *, height: int) -> View:
    """What eye rays need of a camera."""
    axes = np.asarray(look_at(camera.eye, camera.target, camera.up))
    eye, right, up, backward = (Vec3(*column) for column in (np.asarray(camera.eye), *axes.T))
    step = np.float32(2.0 * np.tan(0.5 * np.float64(camera.fov_y_radians)) / height)
    return View(eye, right, up, backward, step)


def rows(v: Sequence[Array | np.ndarray]) -> np.ndarray:
    """Components side by side, (n, 3), as Embree and images want them."""
    return np.stack([np.asarray(c) for c in v], axis=-1)


def see(
    world: World, view: View, rays: Rays, *, model: str, by_ratio: bool
) -> tuple[Reflector, Path, dict[str, np.ndarray]]:
    """The surface that eye rays see: reflection, path, and images of it.

    Args:
      by_ratio: lights are only drawn, but where the surface is so smooth that it mirrors them.
    """
    hits, surface = hit(world, rays, view.step)
    path = paths.begin(len(hits.triangle))
    emission = meet(world.emitters, path, rays.direction, hits.t, surface, left=Vertex(-1, 0, 1, model))
    at, path = arrive(path, rays.direction, surface, model=model)
    smooth = np.asarray(at.roughness < SMOOTH) & (rows(at.mirror).any(axis=-1))
    path = path._replace(shared=smooth | (not by_ratio))
    seen = (hits.triangle >= 0)[:, None]
    position = rows(at.position)
    depth = ((np.asarray(view.eye) - position) @ np.asarray(view.backward))[:, None]
    images = {"albedo": rows(reflected_share(at)), "normal": rows(at.normal), "position": position, "depth": depth,
              "sharpness": np.asarray(_sharpness(at))[:, None]}  # fmt: skip
    images = {name: np.where(seen, image, np.float32(0.0)) for name, image in images.items()}
    return at, path, images | {"emission": rows(emission)}


def hit(world: World, rays: Rays, width: float | np.float32 | None) -> tuple[Hits, HitSurface]:
    """The closest hits, and the surface there.

    Args:
      width: of the rays at distance 1, for textures; None is the finest.
    """
    hits = world.rays.closest(rows(rays.origin), rows(rays.direction))
    corners = _gather(world.table, hits.triangle)
    wide = None if width is None else np.where(hits.triangle >= 0, hits.t, np.float32(0.0)) * width
    points = _interpolate(world.table, corners, hits.triangle, hits.barycentrics, rays.direction, wide)
    return hits, _material(world.table, points, _texels(world.table, points, fine=width is None))


def light_up(
    world: World, emitters: Emitters, at: Reflector, path: Path, seeds: Array, index: int, *, vertex: Vertex
) -> tuple[np.ndarray, np.ndarray]:
    """Light of drawn lights: what arrives, and what would arrive if nothing were in between.

    Only rays that would bring light are traced.
    """
    arrived, unshadowed = np.zeros((2, len(seeds), 3), np.float32)
    number, vertex = np.int32(vertex.number), vertex._replace(number=0)
    for shadow in _draw_lights(emitters, world.table, at, path, seeds, np.int32(index), number, vertex=vertex):
        light = rows(shadow.light)
        unshadowed += light
        tried = np.flatnonzero(light.any(axis=-1))
        origins, directions = (rows([np.asarray(c)[tried] for c in v]) for v in shadow[:2])
        blocked = world.rays.blocked(origins, directions, np.asarray(shadow.distance)[tried])
        light[tried[blocked]] = 0.0
        arrived += light
    return arrived, unshadowed


@functools.partial(jax.jit, static_argnames=("block", "height", "width"))
def eye_rays(view: View, start, seed, sample, *, block: int, height: int, width: int) -> tuple[Rays, Array]:
    """Rays of one sample of `block` pixels from `start` on, and the seeds of the pixels; those past the last repeat it.

    Sample 0 passes through the centres, the others where a sequence of low discrepancy puts them.
    """
    pixel = jnp.minimum(jnp.asarray(start, jnp.int32) + jnp.arange(block, dtype=jnp.int32), height * width - 1)
    seeds = pixel_seeds(pixel, jnp.asarray(seed, jnp.int32))
    sample = jnp.broadcast_to(jnp.asarray(sample, jnp.int32), pixel.shape)
    x, y = (jnp.where(sample == 0, 0.5, offset) for offset in uniform_pair(sample, seeds, dimension=_LENS))
    row, column = ((pixel // width).astype(x.dtype), (pixel % width).astype(x.dtype))
    x, y = (column + x - 0.5 * width) * view.step, (0.5 * height - row - y) * view.step
    eye = Vec3(*(jnp.broadcast_to(c, pixel.shape) for c in view.eye))
    return Rays(eye, vec3.normalize(view.right * x + view.up * y - view.backward)), seeds


@functools.partial(jax.jit, static_argnames=("height", "width"))
def look_up_guides(
    image: Float[Array, "h w c"], normal: Float[Array, "h w 3"], depth: Float[Array, "h w 1"], camera: Camera,
    own: dict[str, Float[Array, "n _"]], *, height: int, width: int,
) -> Float[Array, "n c"]:  # fmt: skip
    """`guide_lookup` for surfaces that eye rays see."""
    places, _ = project_px(camera, own["position"], height=height, width=width)
    found, _ = guide_lookup(
        image, normal, depth, places_px=places, sample_normal=own["normal"], sample_depth=own["depth"]
    )
    return found


@jax.jit
def occlusion_rays(at: Reflector, seeds: Array, index: Array) -> Rays:
    """Rays of cosine density."""
    u, v = uniform_pair(index, seeds, dimension=_OCCLUSION)
    wi = draw(at, u, v, jnp.zeros_like(u), model="lambert").wi
    return Rays(paths.offset(at, wi), wi)


@functools.partial(jax.jit, static_argnames="model")
def arrive(path: Path, direction: Vec3, surface: HitSurface, *, model: str) -> tuple[Reflector, Path]:
    """The reflection at hits; paths that hit nothing end."""
    alive = path.alive & (surface.triangle >= 0)
    path = path._replace(alive=alive, shared=jnp.ones_like(alive))
    return make_reflector(surface, direction, model=model), path


@functools.partial(jax.jit, static_argnames="vertex")
def unshadowed_light(
    emitters: Emitters, table: SurfaceTable, at: Reflector, path: Path, seeds: Array, index: Array, *, vertex: Vertex
) -> Vec3:
    """The second result of `light_up` alone: no rays, and a program whose size does not grow with the number drawn."""
    one = vertex._replace(drawn=1)

    def add(s: Array, total: Vec3) -> Vec3:
        for ray in paths.draw_lights(emitters, table, at, path, seeds, index * vertex.drawn + s, vertex=one):
            total = total + ray.light * (1.0 / vertex.drawn)
        return total

    zero = jnp.zeros_like(at.roughness)
    return jax.lax.fori_loop(0, vertex.drawn, add, Vec3(zero, zero, zero))


def scatter(at: Reflector, path: Path, seeds: Array, index: int, *, vertex: Vertex) -> tuple[Rays, Path]:
    """`paths.go_on`: one program for all vertices."""
    number, vertex = np.int32(vertex.number), vertex._replace(number=0)
    return _go_on(at, path, seeds, np.int32(index), number, vertex=vertex)


@functools.partial(jax.jit, static_argnames="vertex")
def _draw_lights(emitters, table, at, path, seeds, index, number, *, vertex: Vertex):
    return paths.draw_lights(emitters, table, at, path, seeds, index, vertex=vertex._replace(number=number))


@functools.partial(jax.jit, static_argnames="vertex")
def _go_on(at, path, seeds, index, number, *, vertex: Vertex):
    return paths.go_on(at, path, seeds, index, vertex=vertex._replace(number=number))


def meet(
    emitters: Emitters, path: Path, direction: Vec3, distance: Array | np.ndarray, surface: HitSurface, *, left: Vertex
) -> Vec3:
    """`paths.meet`."""
    return _meet(emitters, path, direction, distance, surface, left=left._replace(number=0))


_meet = jax.jit(paths.meet, static_argnames="left")
reflected_share = jax.jit(reflectance)
openness = jax.jit(paths.openness)
_sharpness = jax.jit(sharpness)
_gather = jax.jit(gather_corners)
_interpolate = jax.jit(interpolate)
_texels = jax.jit(look_up_texels, static_argnames="fine")
_material = jax.jit(apply_material)
