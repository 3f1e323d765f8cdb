"""`jaxrender trace`: loads a scene, traces a picture or several, writes them as they get better."""

import dataclasses
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from jaxrender import console
from jaxrender.camera import Camera
from jaxrender.checks import bad_input
from jaxrender.io import read_environment, write_exr, write_png
from jaxrender.io.frames import frame_name, numbered_name
from jaxrender.io.picture import tone_map
from jaxrender.machine import is_writable_folder
from jaxrender.pathtrace.backends import chosen_backend, told_backend
from jaxrender.pathtrace.guide_rays import pooled, trace_guides
from jaxrender.pathtrace.render import Rendered, combine, filter_incident, render
from jaxrender.pathtrace.settings import TraceSettings
from jaxrender.pathtrace.world import World, prepare
from jaxrender.render_command import open_view

if TYPE_CHECKING:
    from jaxrender.cli import Trace


def run_trace(options: "Trace") -> None:
    """The command."""
    if options.out.suffix not in ("", ".png"):
        bad_input("-o", str(options.out), expected="a name ending in .png", got=options.out.suffix)
    out = options.out.with_suffix(".png")
    if not is_writable_folder(out.parent):
        bad_input("-o", str(out.parent), expected="a folder that can be written", got="one that cannot")
    scene, camera = open_view(options)
    environment = None if options.environment is None else read_environment(options.environment)
    console.announce_device(rays=told_backend(chosen_backend(options.rays)))
    started = time.perf_counter()
    world = prepare(scene, environment=environment, rays=options.rays)
    for note in world.notes:
        console.announce(f"{scene.name}: {note}")
    console.announce(f"{len(scene.faces)} triangles ready after {time.perf_counter() - started:.1f} s")
    if options.time is not None:
        paths, record = _progressive(options, world, camera, out)
    else:
        paths, record = _frames(options, world, camera, out)
    console.finish(paths=paths, record={"triangles": len(scene.faces), **record}, as_json=options.json)


def _settings(options: "Trace", *, spp: int, seed: int) -> TraceSettings:
    return TraceSettings(
        bounces=options.bounces, samples_per_pixel=spp, light_samples=options.light_samples, model=options.model,
        method=options.filter, radius=options.radius, eps=options.eps, seed=seed,
        direct=None if options.direct == "auto" else options.direct,
    )  # fmt: skip


def _frames(options: "Trace", world: World, camera: Camera, out: Path) -> tuple[list[Path], dict]:
    """All frames; those that are finished stay, whatever happens to the next."""
    width, height = options.size
    paths: list[Path] = []
    seconds = []
    numbers = console.track(range(options.frames), "frames", total=options.frames)
    for frame in numbers if options.frames > 1 else range(1):
        started = time.perf_counter()
        settings = _settings(options, spp=options.spp, seed=options.seed + frame * options.new_seeds)
        view = orbit(camera, math.radians(options.orbit_degrees) * frame / options.frames)
        picture = render(world, view, height=height, width=width, settings=settings)
        seconds.append(time.perf_counter() - started)
        name = out if options.frames == 1 else Path(frame_name(numbered_name(str(out)), frame + 1))
        paths += _write(picture, name, options)
    console.announce(_told(picture, options.spp))
    return paths, {"spp": options.spp, "seconds": seconds if options.frames > 1 else seconds[0], **picture.chosen}


def _progressive(options: "Trace", world: World, camera: Camera, out: Path) -> tuple[list[Path], dict]:
    """One picture, written whenever its samples have doubled, for so many seconds."""
    width, height = options.size
    assert options.time is not None
    started, spp, guides = time.perf_counter(), 0, None
    while True:
        begun, count = time.perf_counter(), max(spp, 1)
        # What is traced must serve either way of adding up direct light.
        settings = dataclasses.replace(_settings(options, spp=count, seed=options.seed), direct="ratio")
        more = trace_guides(world, camera, height=height, width=width, settings=settings, first_sample=spp)
        guides = more if guides is None else pooled(guides, more, counts=(spp, count))
        spp += count
        settings = _settings(options, spp=spp, seed=options.seed)
        incident, chosen = filter_incident(guides, settings)
        picture = combine(world, camera, guides, incident, settings=settings, chosen=chosen)
        paths = _write(picture, out, options)
        now = time.perf_counter()
        console.announce(f"{now - started:.1f} s: {_told(picture, spp)}")
        # The first turn compiles; later ones take about twice as long as the one before.
        latest = now - begun if spp > 1 else 0.0
        if now - started + 2.0 * latest > options.time:
            break
    return paths, {"spp": spp, "seconds": time.perf_counter() - started, **picture.chosen}


def orbit(camera: Camera, angle_radians: float) -> Camera:
    """The camera, gone round what it looks at, about the vertical, counter-clockwise seen from above."""
    cos, sin = math.cos(angle_radians), math.sin(angle_radians)
    x, y, z = np.asarray(camera.eye - camera.target, np.float64)
    away = np.array([cos * x + sin * z, y, cos * z - sin * x])
    up = np.asarray(camera.up, np.float64)
    up = np.array([cos * up[0] + sin * up[2], up[1], cos * up[2] - sin * up[0]])
    eye = camera.target + jnp.asarray(away, jnp.float32)
    return dataclasses.replace(camera, eye=eye, up=jnp.asarray(up, jnp.float32))


def _told(picture: Rendered, spp: int) -> str:
    chosen = picture.chosen
    if chosen.get("method", "none") == "none":
        return f"{spp} samples a pixel, unfiltered"
    return f"{spp} samples a pixel; {chosen['method']} filter, radius {chosen['radius']} ({chosen['how']})"


def _write(picture: Rendered, out: Path, options: "Trace") -> list[Path]:
    """The PNG, and the EXR files if they are asked for."""
    write_png(out, tone_map(picture.image, exposure_stops=options.exposure_stops))
    if not options.exr:
        return [out]
    guides = picture.guides
    shared = {"albedo": guides.albedo, "normal": guides.normal, "depth": guides.depth, "position": guides.position,
              "ao": guides.ao}  # fmt: skip
    clean = {"": picture.image, "direct": picture.direct, "indirect": picture.indirect, "emission": picture.emission}
    noisy = {
        "": guides.color, "direct": guides.direct, "indirect": guides.indirect, "emission": guides.emission,
        "variance": guides.variance, "half_a": guides.even, "half_b": guides.odd,
    }  # fmt: skip
    paths = [out.with_suffix(".exr"), out.with_suffix(".noisy.exr")]
    for path, layers in zip(paths, (clean, noisy), strict=True):
        write_exr(path, {**layers, **shared})
    return [out, *paths]
