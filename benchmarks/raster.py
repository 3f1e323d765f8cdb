"""The rasteriser: ids and depth, all attributes of a G-buffer, and a shaded picture, beside Mesa's llvmpipe.

The scene is Sponza where `../shared/data` has it, else the built-in one with many vertices. Cases:

- `ids`: triangle, depth and barycentrics of every sample; llvmpipe writes ids and depth.
- `gbuffer`: all of `GBuffer` (20 floats, depth, 2 ids); llvmpipe writes ids, depth and five vec4, two of them
  derivatives.
- `shaded`: textures, normal maps, masks, a light and a sky; no peer.
- `lights`: the shading of a G-buffer alone, under 8, 64 and 256 lights.
- `million`: ids of a landscape of a million triangles.
- `triangle_size`: a grid of equal triangles over the image, from 2 to 512 pixels each.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import llvmpipe
from benchmarks.suites import Measurement, Options
from benchmarks.timing import measure, measure_alternating
from jaxrender import console
from jaxrender.camera import Camera, clip_from_world
from jaxrender.deferred import (
    clip_positions,
    draw_gbuffer,
    look_up_surface,
    make_gbuffer,
    rasterize,
    render_scene,
    scene_textures,
    see,
    shade,
)
from jaxrender.io import load_scene
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.machine import keep_xla_to_one_thread
from jaxrender.scene import POINT, Lights, Scene, scene_bounds, whole_scene_camera
from jaxrender.vecmath import matmul

SPONZA = Path(__file__).resolve().parents[2] / "shared" / "data" / "sponza" / "Sponza.gltf"
SIZES, QUICK_SIZES = ((768, 1024), (3072, 4096)), ((192, 256),)
LIGHTS = (8, 64, 256)
FIVE_TARGETS = (
    "first = smooth_value; second = linear_value; third = flat_value; fourth = dFdxFine(smooth_value);"
    "fifth = dFdyFine(smooth_value);"
)
TRIANGLE_SIZES_PX = (2, 8, 32, 128, 512)
Params = dict[str, str | int | float | bool]


def run(options: Options) -> Iterator[Measurement]:
    """The cases in the order of the stages."""
    keep_xla_to_one_thread()
    sizes = QUICK_SIZES if options.quick else SIZES
    if any(options.wants(case) for case in ("ids", "gbuffer", "shaded", "lights")):
        scene, camera, name = _scene()
        for height, width in sizes:
            yield from _of_scene(scene, camera, name, height, width, options)
    if options.wants("million"):
        yield from _million(*sizes[0], options)
    if options.wants("triangle_size"):
        yield from _triangle_sizes(*sizes[0], options)


def _scene() -> tuple[Scene, Camera, str]:
    if not SPONZA.is_file():
        scene = builtin_scene(num_vertices=40_000)
        return scene, whole_scene_camera(scene, aspect=4 / 3), "built-in"
    eye, target, up = (jnp.asarray(v) for v in ([10.0, 2.0, 0.0], [-5.0, 3.0, 0.0], [0.0, 1.0, 0.0]))
    return load_scene(SPONZA), Camera(eye, target, up, jnp.float32(np.radians(60.0))), "Sponza"


def _of_scene(scene, camera, name: str, height: int, width: int, options: Options) -> Iterator[Measurement]:
    clip = clip_positions(scene, camera, height=height, width=width)
    params: Params = {"scene": name, "height": height, "width": width, "triangles": len(scene.faces), "cull": "back"}
    ids = lambda: rasterize(clip, scene.faces, height=height, width=width, cull="back")  # noqa: E731
    if options.wants("ids"):
        peer = _peer(clip, scene.faces, height, width, body="", num_targets=0)
        yield from _beside("ids", ids, peer, params)
    if options.wants("gbuffer"):
        whole = lambda: draw_gbuffer(scene, ids())  # noqa: E731
        values = np.ones((len(clip), 4), np.float32)
        peer = _peer(clip, scene.faces, height, width, values=values, body=FIVE_TARGETS, num_targets=5)
        yield from _beside("gbuffer", whole, peer, params)
    if options.wants("shaded"):
        textures = scene_textures(scene)
        draw = lambda: render_scene(scene, camera, height=height, width=width, textures=textures).image  # noqa: E731
        yield Measurement("shaded", "jaxrender", measure(draw, min_runs=3).metrics(), params)
    if options.wants("lights") and height * width <= 1024 * 1024:
        yield from _lights(scene, camera, params, seed=options.seed)


def point_lights(position: np.ndarray, intensity: np.ndarray) -> Lights:
    """Point lights without end; (n, 3) each."""
    one = jnp.ones(len(position), jnp.float32)
    return Lights(
        kind=jnp.full(len(position), POINT, jnp.int32), intensity=jnp.asarray(intensity, jnp.float32),
        position=jnp.asarray(position, jnp.float32),
        direction=jnp.tile(jnp.asarray([[0.0, 0.0, -1.0]], jnp.float32), (len(position), 1)),
        range=one * jnp.inf, cos_inner=-one, cos_outer=-one,
    )  # fmt: skip


def _lights(scene: Scene, camera: Camera, params: Params, *, seed: int) -> Iterator[Measurement]:
    """Point lights spread over the scene; shading only, on one core."""
    height, width = int(params["height"]), int(params["width"])
    gbuffer = make_gbuffer(scene, see(scene, camera, height=height, width=width, transparency="none"))
    surface = look_up_surface(gbuffer, scene.material, None)
    rng = np.random.default_rng(seed)
    low, high = (np.asarray(bound) for bound in scene_bounds(scene))
    shaded = jax.jit(shade)
    for number in LIGHTS:
        lights = point_lights(rng.uniform(low, high, (number, 3)), np.ones((number, 3)))
        draw = lambda lights=lights: shaded(gbuffer, surface, lights, camera.eye)  # noqa: E731
        yield Measurement("lights", "jaxrender", measure(draw, min_runs=3).metrics(), {**params, "lights": number})


def _peer(clip, faces, height: int, width: int, **options) -> llvmpipe.Drawing | None:
    try:
        return llvmpipe.Drawing(np.asarray(clip), np.asarray(faces), height=height, width=width, **options)
    except llvmpipe.NoOpenGL as error:
        console.announce(f"raster: {error}; its rows are left out")
        return None


def _beside(
    case: str, ours: Callable[[], object], peer: llvmpipe.Drawing | None, params: Params, *, cull: str = "back"
) -> Iterator[Measurement]:
    variants: dict[str, Callable[[], object]] = {"jaxrender": ours}
    if peer is not None:
        variants["llvmpipe"] = lambda: peer.draw(cull=cull)
    for variant, timing in measure_alternating(variants, min_runs=5).items():
        yield Measurement(case, variant, timing.metrics(), params)
    if peer is not None:
        peer.release()


def _million(height: int, width: int, options: Options) -> Iterator[Measurement]:
    """Hills to the horizon, seen from above one of them: most triangles are far away and smaller than a pixel."""
    side = 40 if options.quick else 708
    x, z = np.meshgrid(np.linspace(-50, 50, side + 1), np.linspace(-100, 0, side + 1))
    y = 3.0 * np.sin(0.35 * x) * np.cos(0.3 * z) + 0.4 * np.sin(2.1 * x + 1.3 * z)
    points = jnp.asarray(np.stack([x, y, z], axis=-1).reshape(-1, 3), jnp.float32)
    faces = jnp.asarray(grid_faces(side, side), jnp.int32)
    eye, target, up = (jnp.asarray(v, jnp.float32) for v in ([0.0, 9.0, 6.0], [0.0, 0.0, -40.0], [0.0, 1.0, 0.0]))
    camera = Camera(eye, target, up, jnp.float32(np.radians(50.0)))
    matrix = clip_from_world(camera, height=height, width=width, near=jnp.float32(1.0), far=jnp.float32(200.0))
    clip = matmul(jnp.pad(points, ((0, 0), (0, 1)), constant_values=1.0), matrix.T)
    params: Params = {"height": height, "width": width, "triangles": len(faces), "cull": "back"}
    ids = lambda: rasterize(clip, faces, height=height, width=width, cull="back")  # noqa: E731
    yield from _beside("million", ids, _peer(clip, faces, height, width, body="", num_targets=0), params)


def _triangle_sizes(height: int, width: int, options: Options) -> Iterator[Measurement]:
    for pixels in TRIANGLE_SIZES_PX:
        clip, faces = _grid(height, width, pixels)
        params: Params = {"height": height, "width": width, "triangles": len(faces), "pixels_per_triangle": pixels}
        draw = lambda clip=clip, faces=faces: rasterize(clip, faces, height=height, width=width)  # noqa: E731
        peer = _peer(clip, faces, height, width, body="", num_targets=0)
        for found in _beside("triangle_size", draw, peer, params, cull="none"):
            rate = 1e3 * len(faces) / found.metrics["ms_median"]
            yield dataclasses.replace(found, metrics={**found.metrics, "triangles_per_second": rate})


def _grid(height: int, width: int, pixels: int):
    """Right triangles of about so many pixels, two a cell, at one depth."""
    side = np.sqrt(2.0 * pixels)
    rows, columns = max(1, round(height / side)), max(1, round(width / side))
    x, y = np.meshgrid(np.linspace(-1, 1, columns + 1), np.linspace(-1, 1, rows + 1))
    clip = np.stack([x, y, np.full_like(x, 0.5), np.ones_like(x)], axis=-1).reshape(-1, 4)
    return jnp.asarray(clip, jnp.float32), jnp.asarray(grid_faces(rows, columns), jnp.int32)


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles to each cell of a grid of (rows + 1) x (columns + 1) vertices, seen as counter-clockwise."""
    a = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    quads = np.stack([a[:-1, :-1], a[1:, :-1], a[1:, 1:], a[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
