"""`jaxrender render`: loads a scene, picks a camera, runs the deferred pipeline, writes the files."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrender import console
from jaxrender.camera import Camera
from jaxrender.checks import bad_input
from jaxrender.deferred.adaptive import Uniform, scene_view, shade_adaptive, supersample
from jaxrender.deferred.clusters import Clusters
from jaxrender.deferred.dial import fit_budget, fit_psnr
from jaxrender.deferred.exchange import gbuffer_layers
from jaxrender.deferred.metrics import SampleMetrics
from jaxrender.deferred.pipeline import Rendering, render_scene
from jaxrender.deferred.preview import environment_background, gradient_background, lay_over
from jaxrender.deferred.samples import standard_pattern
from jaxrender.harmonics.light import project_environment
from jaxrender.io import load_scene, read_environment, write_exr, write_png
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.io.picture import tone_map
from jaxrender.machine import is_writable_folder
from jaxrender.metrics import heatmap
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
    draw = _draw if options.adaptive is None else _draw_adaptive
    picture = draw(options, scene, camera, light)
    seconds = time.perf_counter() - started
    if not picture.alpha.any():
        console.announce(f"{scene.name}: nothing of it is seen")
    paths = [out]
    if environment is None:
        behind = gradient_background(height, width, top=BACKDROP_TOP, bottom=BACKDROP_BOTTOM)
    else:
        behind = environment_background(environment, camera, height=height, width=width)
    image = lay_over(picture.image * picture.alpha[..., None], picture.alpha, behind)
    write_png(out, tone_map(image, exposure_stops=options.exposure_stops))
    if options.exr:
        paths.append(out.with_suffix(".exr"))
        write_exr(paths[-1], picture.layers())
    if picture.count is not None:
        paths.append(out.with_suffix(".counts.png"))
        write_png(paths[-1], np.asarray(heatmap(jnp.asarray(picture.count, jnp.float32), high=picture.most)))
    record = {
        "triangles": len(scene.faces), "covered": float(np.mean(picture.alpha)), "seconds": seconds, **picture.numbers
    }  # fmt: skip
    console.finish(paths=paths, record=record, as_json=options.json)


@dataclass(frozen=True)
class _Picture:
    """What a way of drawing gives: `layers` makes those of the EXR file; `count`, of samples a pixel, if it varies."""

    image: np.ndarray
    alpha: np.ndarray
    layers: Callable[[], dict[str, np.ndarray]]
    count: np.ndarray | None = None
    most: int = 1
    numbers: dict[str, float] = field(default_factory=dict)


def _draw(options: "Render", scene: Scene, camera: Camera, light: dict[str, Any]) -> _Picture:
    """Every sample of a pattern is shaded."""
    width, height = options.size
    rendering = render_scene(
        scene, camera, height=height, width=width, samples=standard_pattern(options.samples),
        transparency=options.transparency, model=options.model, **light,
    )  # fmt: skip
    return _Picture(rendering.image, rendering.alpha, lambda: picture_layers(rendering))


def _draw_adaptive(options: "Render", scene: Scene, camera: Camera, light: dict[str, Any]) -> _Picture:
    """Some of the samples of an ordered grid are shaded."""
    width, height = options.size
    assert options.adaptive is not None
    samples, lighting = scene_view(
        scene, camera, height=height, width=width, size=options.adaptive, transparency=options.transparency,
        model=options.model, **light,
    )  # fmt: skip
    method: Clusters | SampleMetrics = SampleMetrics() if options.method == "printed" else Clusters()
    if options.method == "full":
        found = supersample(samples, lighting)
    elif options.method == "uniform":
        found = shade_adaptive(samples, lighting, method=Uniform(options.count))
    elif options.budget is not None:
        method, found = fit_budget(samples, lighting, method, budget=options.budget)
    elif options.psnr is not None:
        method, found = fit_psnr(samples, lighting, method, psnr_db=options.psnr)
    else:
        found = shade_adaptive(samples, lighting, method=method)
    numbers, said = {"sample_share": found.sample_share}, ""
    if options.method in ("clusters", "printed"):
        numbers["scale"], said = method.scale, f", scale {method.scale:g}"
    console.announce(f"{100.0 * found.sample_share:.1f} % of {found.num_covered} samples shaded{said}")
    layers = {
        "": np.concatenate([found.image, found.alpha[..., None]], axis=-1),
        "samplecount": found.count[..., None].astype(np.uint32),
    }
    return _Picture(found.image, found.alpha, lambda: layers, found.count, options.adaptive**2, numbers)


def open_view(options: "SceneView") -> tuple[Scene, Camera]:
    """The scene of the options, or the built-in one, and its camera; says what was odd in the file."""
    scene = builtin_scene() if options.scene is None else load_scene(options.scene)
    for note in scene.notes:
        console.announce(f"{scene.name}: {note}")
    return scene, choose_camera(scene, options)


def choose_camera(scene: Scene, options: "SceneView", *, bounds: tuple[Array, Array] | None = None) -> Camera:
    """The camera of the options, else of the file, else one that sees the whole scene, or `bounds`, from outside."""
    if options.eye is not None:
        eye, target = (jnp.asarray(v, jnp.float32) for v in (options.eye, options.target))
        up = [0.0, 0.0, -1.0] if np.allclose(options.eye[::2], options.target[::2]) else [0.0, 1.0, 0.0]
        return Camera(eye, target, jnp.asarray(up, jnp.float32), jnp.float32(math.radians(options.fov_degrees)))
    if options.inside:
        return inside_camera(scene, fov_y_radians=math.radians(options.fov_degrees))
    if not scene.cameras and options.camera == 0:
        return whole_scene_camera(scene, aspect=options.size[0] / options.size[1], bounds=bounds)
    if options.camera >= len(scene.cameras):
        bad_input("--camera", scene.name, expected=f"one of {len(scene.cameras)} cameras", got=options.camera)
    return scene.cameras[options.camera]


def picture_layers(rendering: Rendering) -> dict[str, np.ndarray]:
    """Picture, albedo and G-buffer by the usual names of layers: means over covered samples."""
    covered = np.asarray(rendering.gbuffer.coverage)[..., None]
    albedo = np.sum(np.asarray(rendering.surface.base_color) * covered, axis=2) / np.maximum(covered.sum(axis=2), 1)
    image = np.concatenate([rendering.image, rendering.alpha[..., None]], axis=-1)
    return {"": image, "albedo": albedo, **gbuffer_layers(rendering.gbuffer)}
