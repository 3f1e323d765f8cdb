"""`jaxrender render`: loads a scene, picks a camera, runs the deferred pipeline, writes the files."""

import math
import time
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxrender import console
from jaxrender.camera import Camera
from jaxrender.checks import bad_input
from jaxrender.deferred.exchange import gbuffer_layers
from jaxrender.deferred.pipeline import Rendering, render_scene, scene_textures
from jaxrender.deferred.preview import environment_background, gradient_background, lay_over
from jaxrender.deferred.samples import standard_pattern
from jaxrender.harmonics.light import project_environment
from jaxrender.io import load_scene, read_environment, write_exr, write_png
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.io.picture import tone_map
from jaxrender.machine import is_writable_folder
from jaxrender.scene import Scene, inside_camera, whole_scene_camera

if TYPE_CHECKING:
    from jaxrender.cli import Render, SceneView

#: Behind everything, in linear light.
BACKDROP_TOP, BACKDROP_BOTTOM = (0.32, 0.4, 0.5), (0.16, 0.17, 0.18)


def run_render(options: "Render") -> None:
    """The command."""
    if options.out.suffix not in ("", ".png"):
        bad_input("-o", str(options.out), expected="a name ending in .png", got=options.out.suffix)
    out = options.out.with_suffix(".png")
    if not is_writable_folder(out.parent):
        bad_input("-o", str(out.parent), expected="a folder that can be written", got="one that cannot")
    scene, camera = open_view(options)
    width, height = options.size
    console.announce_device()
    started = time.perf_counter()
    environment = None if options.environment is None else read_environment(options.environment)
    light: dict[str, Any] = {}
    if environment is not None:
        light = {"lights": scene.lights, "ambient": project_environment(jnp.asarray(environment), order=5)}
    rendering = render_scene(
        scene, camera, height=height, width=width, samples=standard_pattern(options.samples),
        textures=scene_textures(scene), transparency=options.transparency, model=options.model, **light,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    if not rendering.alpha.any():
        console.announce(f"{scene.name}: nothing of it is seen")
    paths = [out]
    if environment is None:
        behind = gradient_background(height, width, top=BACKDROP_TOP, bottom=BACKDROP_BOTTOM)
    else:
        behind = environment_background(environment, camera, height=height, width=width)
    image = lay_over(rendering.image * rendering.alpha[..., None], rendering.alpha, behind)
    write_png(out, tone_map(image, exposure_stops=options.exposure_stops))
    if options.exr:
        paths.append(out.with_suffix(".exr"))
        write_exr(paths[-1], picture_layers(rendering))
    record = {"triangles": len(scene.faces), "covered": float(np.mean(rendering.alpha)), "seconds": seconds}
    console.finish(paths=paths, record=record, as_json=options.json)


def open_view(options: "SceneView") -> tuple[Scene, Camera]:
    """The scene of the options, or the built-in one, and its camera; says what was odd in the file."""
    scene = builtin_scene() if options.scene is None else load_scene(options.scene)
    for note in scene.notes:
        console.announce(f"{scene.name}: {note}")
    return scene, choose_camera(scene, options)


def choose_camera(scene: Scene, options: "SceneView") -> Camera:
    """The camera of the options, else of the file, else one that sees the whole scene from outside."""
    if options.eye is not None:
        eye, target = (jnp.asarray(v, jnp.float32) for v in (options.eye, options.target))
        up = [0.0, 0.0, -1.0] if np.allclose(options.eye[::2], options.target[::2]) else [0.0, 1.0, 0.0]
        return Camera(eye, target, jnp.asarray(up, jnp.float32), jnp.float32(math.radians(options.fov_degrees)))
    if options.inside:
        return inside_camera(scene, fov_y_radians=math.radians(options.fov_degrees))
    if not scene.cameras and options.camera == 0:
        return whole_scene_camera(scene, aspect=options.size[0] / options.size[1])
    if options.camera >= len(scene.cameras):
        bad_input("--camera", scene.name, expected=f"one of {len(scene.cameras)} cameras", got=options.camera)
    return scene.cameras[options.camera]


def picture_layers(rendering: Rendering) -> dict[str, np.ndarray]:
    """Picture, albedo and G-buffer by the usual names of layers: means over covered samples."""
    covered = np.asarray(rendering.gbuffer.coverage)[..., None]
    albedo = np.sum(np.asarray(rendering.surface.base_color) * covered, axis=2) / np.maximum(covered.sum(axis=2), 1)
    image = np.concatenate([rendering.image, rendering.alpha[..., None]], axis=-1)
    return {"": image, "albedo": albedo, **gbuffer_layers(rendering.gbuffer)}
