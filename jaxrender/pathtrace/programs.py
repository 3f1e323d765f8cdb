"""The programs that run between rays, each compiled once, and rays between programs: for blocks of pixels.

A host program. Each step is one of the pure kernels of `hit_points`, `scatter`, `emitters` and `paths`; apart, they
compute nothing twice (see `hit_points`). What is in between stays where JAX has it: only rays on the host are fetched,
by the world's `RayScene`, and the images of a block when it is done.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender import vec3
from jaxrender.camera import Camera, look_at, project_px
from jaxrender.latlong import look_up_smoothly
from jaxrender.machine import num_cores
from jaxrender.pathtrace import paths
from jaxrender.pathtrace.backends import on_the_device
from jaxrender.pathtrace.emitters import Emitters
from jaxrender.pathtrace.guide_lookup import guide_lookup
from jaxrender.pathtrace.hit_points import (
    HitPoints,
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
from jaxrender.vec3 import Scalar, Vec3

#: Most pixels of a block: on a CPU, large enough that programs outweigh what calls them; elsewhere, what fills a GPU.
BLOCK, GPU_BLOCK = 1 << 16, 1 << 20

#: Glossy surfaces below this roughness mirror lamps: scattered rays must look for them, too.
SMOOTH = 0.3

# Pairs of random numbers by which eye rays leave the centre of their pixel, and those of occlusion rays.
_LENS, _OCCLUSION = 1000, 1001


Images = Mapping[str, Sequence[Scalar]]


def blocks(num_pixels: int) -> tuple[range, int]:
    """Where the blocks of a picture start, and their size: so that each core of a CPU gets some, and few on a GPU.

    The last one may reach beyond the last pixel.
    """
    if jax.default_backend() != "cpu":
        size = -(-num_pixels // -(-num_pixels // GPU_BLOCK))
        return range(0, num_pixels, size), size
    size = BLOCK
    while size > 256 and num_pixels < 2 * num_cores() * size:
        size //= 2
    return range(0, num_pixels, size), size


def trace_blocks(trace: Callable[..., Images], *, height: int, width: int) -> dict[str, Float[np.ndarray, "h w c"]]:
    """Images from `trace(start, block=size)`, which gives their channels apart, by name; fetched block by block."""
    starts, size = blocks(height * width)

    def fetched(start: int) -> dict[str, np.ndarray]:
        return jax.device_get(_side_by_side(trace(start, block=size)))

    found = list(on_the_device(fetched, starts))
    return {
        name: np.concatenate([block[name] for block in found])[: height * width].reshape(height, width, -1)
        for name in found[0]
    }


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


def see(
    world: World, view: View, rays: Rays, *, model: str, by_ratio: bool
) -> tuple[Reflector, Path, dict[str, Sequence[Scalar]]]:
    """The surface that eye rays see: reflection, path, and images of it.

    Args:
      by_ratio: lights are only drawn, but where the surface is so smooth that it mirrors them.
    """
    path = paths.begin(len(rays.direction.x))
    hits, surface = hit(world, rays, path.alive, view.step)
    emission = meet(world.emitters, path, rays.direction, hits.t, surface, left=Vertex(-1, 0, 1, model))
    if world.emitters.environment is not None:
        emission = _before_the_sky(world.emitters.environment.radiance, rays.direction, surface.triangle, emission)
    at, path = arrive(path, rays.direction, surface, model=model)
    path, images = _look(view, at, path, by_ratio=by_ratio)
    return at, path, images | {"emission": emission}


def hit(
    world: World, rays: Rays, wanted: Bool[Array, " n"], width: float | np.float32 | None
) -> tuple[Hits, HitSurface]:
    """The closest hits of the rays that are wanted, and the surface there.

    Args:
      width: of the rays at distance 1, for textures; None is the finest.
    """
    hits = world.rays.closest(rays, wanted)
    corners = _gather(world.table, hits.triangle)
    points = _interpolate(world.table, corners, hits, rays.direction, width)
    return hits, _material(world.table, points, _texels(world.table, points, fine=width is None))


def light_up(
    world: World, emitters: Emitters, at: Reflector, path: Path, seeds: Array, index: int, *, vertex: Vertex
) -> tuple[Vec3, Vec3]:
    """Light of drawn lights: what arrives, and what would arrive if nothing were in between."""
    arrived = unshadowed = black(at)
    if not emitters.groups:
        return arrived, unshadowed
    numbers, vertex = _apart(vertex)
    for shadow in _draw_lights(emitters, world.table, at, path, seeds, np.int32(index), numbers, vertex=vertex):
        arrived, unshadowed = _add_light(arrived, unshadowed, shadow.light, world.rays.blocked(shadow))
    return arrived, unshadowed


def black(at: Reflector) -> Vec3:
    """No light, at each of these points."""
    return Vec3(*(jnp.zeros_like(at.roughness),) * 3)


@jax.jit
def added(sums: dict[str, Vec3], terms: dict[str, Vec3]) -> dict[str, Vec3]:
    """The sums with terms added to those of their name."""
    return sums | {name: sums[name] + term for name, term in terms.items()}


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
    seen: dict[str, Sequence[Scalar]], *, height: int, width: int,
) -> Float[Array, "n c"]:  # fmt: skip
    """`guide_lookup` for surfaces that eye rays see."""
    own = {name: jnp.stack(seen[name], axis=-1) for name in ("position", "normal", "depth")}
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


def unshadowed_light(
    emitters: Emitters, table: SurfaceTable, at: Reflector, path: Path, seeds: Array, index: int, *, vertex: Vertex
) -> Vec3:
    """The second result of `light_up` alone: no rays, and a program whose size does not grow with the number drawn."""
    numbers, vertex = _apart(vertex)
    return _unshadowed_light(emitters, table, at, path, seeds, np.int32(index), numbers, vertex=vertex)


@functools.partial(jax.jit, static_argnames="vertex")
def _unshadowed_light(emitters, table, at, path, seeds, index, numbers, *, vertex: Vertex) -> Vec3:
    one = _whole(numbers, vertex)._replace(drawn=1)

    def add(s: Array, total: Vec3) -> Vec3:
        for ray in paths.draw_lights(emitters, table, at, path, seeds, index * vertex.drawn + s, vertex=one):
            total = total + ray.light * (1.0 / vertex.drawn)
        return total

    zero = jnp.zeros_like(at.roughness)
    return jax.lax.fori_loop(0, vertex.drawn, add, Vec3(zero, zero, zero))


def scatter(at: Reflector, path: Path, seeds: Array, index: int, *, vertex: Vertex) -> tuple[Rays, Path]:
    """`paths.go_on`: one program for all vertices."""
    numbers, vertex = _apart(vertex)
    return _go_on(at, path, seeds, np.int32(index), numbers, vertex=vertex)


@functools.partial(jax.jit, static_argnames="vertex")
def _draw_lights(emitters, table, at, path, seeds, index, numbers, *, vertex: Vertex):
    return paths.draw_lights(emitters, table, at, path, seeds, index, vertex=_whole(numbers, vertex))


@functools.partial(jax.jit, static_argnames="vertex")
def _go_on(at, path, seeds, index, numbers, *, vertex: Vertex):
    return paths.go_on(at, path, seeds, index, vertex=_whole(numbers, vertex))


def meet(
    emitters: Emitters, path: Path, direction: Vec3, distance: Array | np.ndarray, surface: HitSurface, *, left: Vertex
) -> Vec3:
    """`paths.meet`."""
    numbers, left = _apart(left)
    return _meet(emitters, path, direction, distance, surface, numbers, left=left)


@functools.partial(jax.jit, static_argnames="left")
def _meet(emitters, path, direction, distance, surface, numbers, *, left: Vertex) -> Vec3:
    return paths.meet(emitters, path, direction, distance, surface, left=_whole(numbers, left))


def _apart(vertex: Vertex) -> tuple[tuple[np.int32, np.float32], Vertex]:
    """What of a vertex may change without another program, and the rest."""
    numbers = np.int32(vertex.number), np.float32(vertex.scattered)
    return numbers, vertex._replace(number=0, scattered=1 if vertex.scattered else 0)


def _whole(numbers: tuple[Array, Array], vertex: Vertex) -> Vertex:
    number, scattered = numbers
    return vertex._replace(number=number, scattered=scattered if vertex.scattered else 0)


@functools.partial(jax.jit, static_argnames="by_ratio")
def _look(view: View, at: Reflector, path: Path, *, by_ratio: bool) -> tuple[Path, Images]:
    """Images of what eye rays see, 0 where that is nothing; and which paths find lights both ways."""
    seen = path.alive
    smooth = (at.roughness < SMOOTH) & (vec3.largest(at.mirror) > 0.0)
    depth = vec3.dot(view.eye - at.position, view.backward)
    images = {"albedo": reflectance(at), "normal": at.normal, "position": at.position}
    channels: dict[str, Sequence[Scalar]] = {**images, "depth": (depth,), "sharpness": (sharpness(at),)}
    masked = {name: [jnp.where(seen, c, 0.0) for c in image] for name, image in channels.items()}
    return path._replace(shared=smooth | (not by_ratio)), masked


@jax.jit
def _before_the_sky(
    sky: Float[Array, "h w 3"], direction: Vec3, triangle: Int[Array, " n"], emission: Vec3
) -> Vec3:  # fmt: skip
    """The emission of what is seen, and a smooth background: light is drawn and met texel by texel."""
    return vec3.where(triangle < 0, vec3.from_array(look_up_smoothly(sky, direction)), emission)


@jax.jit
def _interpolate(
    table: SurfaceTable, corners: Float[Array, "c n"], hits: Hits, direction: Vec3, width: Float[Array, ""] | None
) -> HitPoints:
    wide = None if width is None else jnp.where(hits.triangle >= 0, hits.t, 0.0) * width
    triangle, barycentrics = (jnp.asarray(x) for x in (hits.triangle, hits.barycentrics))
    return interpolate(table, corners, triangle, barycentrics, direction, wide)


@jax.jit
def _add_light(arrived: Vec3, unshadowed: Vec3, light: Vec3, blocked: Bool[Array, " n"]) -> tuple[Vec3, Vec3]:
    return arrived + vec3.where(~blocked, light, 0.0), unshadowed + light


@jax.jit
def _side_by_side(images: Images) -> dict[str, Float[Array, "n c"]]:
    none = jnp.zeros((next(len(channels[0]) for channels in images.values() if len(channels)), 0))
    return {name: jnp.stack(channels, axis=-1) if len(channels) else none for name, channels in images.items()}


openness = jax.jit(paths.openness)
_gather = jax.jit(gather_corners)
_texels = jax.jit(look_up_texels, static_argnames="fine")
_material = jax.jit(apply_material)
