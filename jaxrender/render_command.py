"""`jaxrender render`: loads a scene, picks a camera, runs the deferred pipeline, writes the files."""

import math
import time
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxrender import console
from jaxrender.camera import Camera
from jaxrender.checks import bad_input
from jaxrender.deferred.gbuffer import GBuffer
from jaxrender.deferred.pipeline import Rendering, render_scene, scene_textures
from jaxrender.deferred.samples import standard_pattern
from jaxrender.io import load_scene, write_exr, write_png
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.io.picture import tone_map
from jaxrender.machine import is_writable_folder
from jaxrender.scene import Scene, whole_scene_camera

if TYPE_CHECKING:
    from jaxrender.cli import Render


def run_render(options: "Render") -> None:
    """The command."""
    out = options.out.with_suffix(".png")
    if not is_writable_folder(out.parent):
        bad_input("-o", str(out.parent), expected="a folder that can be written", got="one that cannot")
    scene = builtin_scene() if options.scene is None else load_scene(options.scene)
    for note in scene.notes:
        console.announce(f"{scene.name}: {note}")
    width, height = options.size
    camera = choose_camera(scene, options)
    console.announce_device()
    started = time.perf_counter()
    rendering = render_scene(
        scene, camera, height=height, width=width, samples=standard_pattern(options.samples),
        textures=scene_textures(scene),
    )  # fmt: skip
    seconds = time.perf_counter() - started
    paths = [out]
    write_png(out, tone_map(rendering.image, exposure_stops=options.exposure_stops))
    if options.exr:
        paths.append(out.with_suffix(".exr"))
        write_exr(paths[-1], picture_layers(rendering))
    record = {"triangles": len(scene.faces), "covered": float(np.mean(rendering.alpha)), "seconds": seconds}
    console.finish(paths=paths, record=record, as_json=options.json)


def choose_camera(scene: Scene, options: "Render") -> Camera:
    """The camera of the options, else of the file, else one that sees the whole scene."""
    if options.eye is not None:
        eye, target = (jnp.asarray(v, jnp.float32) for v in (options.eye, options.target))
        up = [0.0, 0.0, -1.0] if np.allclose(options.eye[::2], options.target[::2]) else [0.0, 1.0, 0.0]
        return Camera(eye, target, jnp.asarray(up, jnp.float32), jnp.float32(math.radians(options.fov_degrees)))
    if not scene.cameras:
        return whole_scene_camera(scene, aspect=options.size[0] / options.size[1])
    if options.camera >= len(scene.cameras):
        bad_input("--camera", scene.name, expected=f"0 to {len(scene.cameras) - 1}", got=options.camera)
    return scene.cameras[options.camera]


def picture_layers(rendering: Rendering) -> dict[str, np.ndarray]:
    """Picture and G-buffer by the usual names of layers: means over covered samples, ids of the first sample."""
    gbuffer, covered = rendering.gbuffer, np.asarray(rendering.gbuffer.coverage)
    count = np.maximum(covered.sum(axis=-1, keepdims=True), 1)

    def mean(values: Any) -> np.ndarray:
        values = np.asarray(values).reshape(*covered.shape, -1)
        return np.sum(values * covered[..., None], axis=2) / count

    ids = _ids(gbuffer)
    return {
        "": np.concatenate([rendering.image, rendering.alpha[..., None]], axis=-1),
        "albedo": mean(rendering.surface.base_color),
        "normal": mean(gbuffer.normal),
        "position": mean(gbuffer.position),
        "depth": mean(gbuffer.depth),
        "uv": mean(gbuffer.uv),
        **ids,
    }


def _ids(gbuffer: GBuffer) -> dict[str, np.ndarray]:
    """Material and triangle of the first sample, plus 1: 0 is nothing."""
    first = {"materialid": gbuffer.material_id, "triangleid": gbuffer.triangle_id}
    return {name: (np.asarray(ids)[:, :, :1] + 1).astype(np.uint32) for name, ids in first.items()}
