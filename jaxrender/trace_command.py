"""`jaxrender trace`: loads a scene, traces a picture or several, writes them as they get better."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxrender import console
from jaxrender.camera import Camera
from jaxrender.checks import bad_input
from jaxrender.io import write_exr, write_png
from jaxrender.io.frames import frame_name, numbered_name
from jaxrender.io.picture import tone_map
from jaxrender.machine import is_writable_folder
from jaxrender.metrics import warped_flicker
from jaxrender.pathtrace.backends import chosen_backend, told_backend
from jaxrender.pathtrace.guide_rays import pooled, trace_guides
from jaxrender.pathtrace.render import Rendered, combine, filter_incident, render
from jaxrender.pathtrace.reprojection import previous_places
from jaxrender.pathtrace.settings import TraceSettings
from jaxrender.pathtrace.world import NO_LIGHTS, World
from jaxrender.scene import Scene
from jaxrender.srgb import encode_srgb
from jaxrender.trace_frames import Film, open_film

if TYPE_CHECKING:
    from jaxrender.cli import Trace


def run_trace(options: "Trace") -> None:
    """The command."""
    if options.out.suffix not in ("", ".png"):
        bad_input("-o", str(options.out), expected="a name ending in .png", got=options.out.suffix)
    out = options.out.with_suffix(".png")
    if not is_writable_folder(out.parent):
        bad_input("-o", str(out.parent), expected="a folder that can be written", got="one that cannot")
    film = open_film(options)
    console.announce_device(rays=told_backend(chosen_backend(options.rays)))
    started = time.perf_counter()
    world = film.first_world()
    for note in world.notes:
        other = " (--environment takes a map instead)" if note == NO_LIGHTS else ""
        console.announce(f"{film.scene.name}: {note}{other}")
    console.announce(f"{len(film.scene.faces)} triangles ready after {time.perf_counter() - started:.1f} s")
    if options.time is not None:
        paths, record = _progressive(options, world, film.view(0, film.scene), out)
    elif options.frames == 1:
        paths, record = _still(options, world, film.view(0, film.scene), out)
    else:
        paths, record = _frames(options, world, film, out)
    console.finish(paths=paths, record={"triangles": len(film.scene.faces), **record}, as_json=options.json)


def _settings(options: "Trace", *, spp: int, seed: int) -> TraceSettings:
    return TraceSettings(
        bounces=options.bounces, samples_per_pixel=spp, light_samples=options.light_samples, model=options.model,
        method=options.filter, radius=options.radius, eps=options.eps, seed=seed,
        direct=None if options.direct == "auto" else options.direct,
        # From frame to frame the filter should not change.
        auto=False if options.auto is None and options.frames > 1 else options.auto,
    )  # fmt: skip


def _still(options: "Trace", world: World, camera: Camera, out: Path) -> tuple[list[Path], dict]:
    """One picture."""
    width, height = options.size
    started = time.perf_counter()
    settings = _settings(options, spp=options.spp, seed=options.seed)
    picture = render(world, camera, height=height, width=width, settings=settings)
    seconds = time.perf_counter() - started
    console.announce(_told(picture, options.spp))
    return _write(picture, out, options, spp=options.spp), {"spp": options.spp, "seconds": seconds, **picture.chosen}


@dataclass(frozen=True)
class _Shot:
    """A frame that is finished, and what it showed."""

    scene: Scene
    camera: Camera
    picture: Rendered


def _frames(options: "Trace", first: World, film: Film, out: Path) -> tuple[list[Path], dict]:
    """All frames, and how much they flicker; those that are finished stay, whatever happens to the next."""
    width, height = options.size
    paths: list[Path] = []
    seconds, flickers, shares = [], [], []
    before: _Shot | None = None
    name = numbered_name(out.name)
    for frame in console.track(range(options.frames), "frames", total=options.frames):
        with console.keeping(f"{frame} of {options.frames} frames are finished and stay"):
            started = time.perf_counter()
            scene = film.pose(frame)
            world = film.world(first, frame, scene) if frame else first
            settings = _settings(options, spp=options.spp, seed=options.seed + frame * options.new_seeds)
            camera = film.view(frame, scene)
            picture = render(world, camera, height=height, width=width, settings=settings)
            seconds.append(time.perf_counter() - started)
            paths += _write(picture, out.with_name(frame_name(name, frame + 1)), options, spp=options.spp)
            now = _Shot(scene, camera, picture)
            if before is not None:
                found, share = _flicker(world, before, now, stops=options.exposure_stops)
                flickers.append(found)
                shares.append(share)
            before = now
    console.announce(_told(picture, options.spp))
    # A pair of frames that share nothing tells nothing.
    share = float(np.mean(shares))
    mean = float(np.average(flickers, weights=shares)) if share else 0.0
    console.announce(f"flicker {mean:.2f} of 255 from frame to frame, on the {100.0 * share:.0f} % seen in both")
    record = {"spp": options.spp, "seconds": seconds, "flicker_rms_255": flickers, "seen_in_both": shares}
    return paths, {**record, **({"clip": film.clip.name} if film.clip else {}), **picture.chosen}


def _flicker(world: World, before: _Shot, now: _Shot, *, stops: float) -> tuple[float, float]:
    """`warped_flicker` of display-encoded values in 0 to 255, and the share of the pixels that count."""
    places, matches = previous_places(world, now.camera, before.scene, before.camera, before.picture.guides)
    image, previous = (
        jnp.asarray(255.0 * encode_srgb(np.clip(shot.picture.image * np.float32(2.0**stops), 0.0, 1.0)))
        for shot in (now, before)
    )
    found = _warped(image, previous, places_px=jnp.asarray(places), matches=jnp.asarray(matches))
    return float(found), float(matches.mean())


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
        paths = _write(picture, out, options, spp=spp)
        now = time.perf_counter()
        console.announce(f"{now - started:.1f} s: {_told(picture, spp)}")
        # The first turn compiles; later ones take about twice as long as the one before.
        latest = now - begun if spp > 1 else 0.0
        if now - started + 2.0 * latest > options.time:
            break
    return paths, {"spp": spp, "seconds": time.perf_counter() - started, **picture.chosen}


def _told(picture: Rendered, spp: int) -> str:
    chosen = picture.chosen
    if chosen.get("method", "none") == "none":
        return f"{spp} samples a pixel, unfiltered"
    return f"{spp} samples a pixel; {chosen['method']} filter, radius {chosen['radius']} ({chosen['how']})"


def _write(picture: Rendered, out: Path, options: "Trace", *, spp: int) -> list[Path]:
    """The PNG, and the EXR files if they are asked for; the noisy one says of how many samples it is."""
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
    write_exr(paths[0], {**clean, **shared})
    write_exr(paths[1], {**noisy, **shared}, attributes={"samplesPerPixel": spp})
    return [out, *paths]


_warped = jax.jit(warped_flicker)
