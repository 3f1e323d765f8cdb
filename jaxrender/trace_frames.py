"""What each frame of `jaxrender trace` shows: the pose of the scene, the camera and the lights at its time."""

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxrender import console
from jaxrender.animation.animated_scene import AnimatedScene
from jaxrender.animation.skeleton import Clip
from jaxrender.camera import Camera
from jaxrender.harmonics.light import rotate_environment
from jaxrender.io import load_animated_scene, read_environment
from jaxrender.io.builtin_scene import builtin_animated_scene
from jaxrender.pathtrace.world import World, move, prepare
from jaxrender.render_command import choose_camera, open_view
from jaxrender.scene import DIRECTIONAL, Lights, Scene, scene_bounds, with_ground

if TYPE_CHECKING:
    from jaxrender.cli import Trace


@dataclass(frozen=True)
class Film:
    """All frames of a command.

    Attributes:
      scene: of the first frame.
      moving, clip: what moves it, if anything does.
      camera: without orbit; None for the file's own, which may move.
      extent: of what is looked at, without the ground that was added; None is the scene's.
    """

    options: "Trace"
    scene: Scene
    moving: AnimatedScene | None
    clip: Clip | None
    camera: Camera | None
    environment: Float[np.ndarray, "h w 3"] | None
    extent: float | None

    def pose(self, frame: int) -> Scene:
        """The scene in a frame, counted from 0."""
        if self.moving is None or self.clip is None or frame == 0:
            return self.scene
        return self.moving.at(self.clip, _seconds(self.options, frame))

    def view(self, frame: int, scene: Scene) -> Camera:
        """The camera in a frame, which shows `scene`."""
        camera = scene.cameras[self.options.camera] if self.camera is None else self.camera
        return orbit(camera, self._turned(self.options.orbit_degrees, frame))

    def first_world(self) -> World:
        """The world of the first frame."""
        world = prepare(self.scene, environment=self.environment, rays=self.options.rays)
        return world if self.extent is None else dataclasses.replace(world, extent=self.extent)

    def world(self, first: World, frame: int, scene: Scene) -> World:
        """That of a later frame, with the lights as they are then."""
        angle = self._turned(self.options.turn_light_degrees, frame)
        if self.clip is None and angle == 0.0:
            return first
        lights = scene.lights if len(scene.lights.kind) else first.emitters.lights
        turned = (
            None
            if self.environment is None or angle == 0.0
            else rotate_environment(jnp.asarray(self.environment), angle)
        )
        return move(
            first, scene, lights=turned_lights(lights, angle),
            environment=None if turned is None else np.asarray(turned),
        )  # fmt: skip

    def _turned(self, degrees: float, frame: int) -> float:
        return math.radians(degrees) * frame / self.options.frames


def open_film(options: "Trace") -> Film:
    """Reads the scene and finds a camera that sees all of its motion; says what was odd in the file."""
    environment = None if options.environment is None else read_environment(options.environment)
    if options.clip is None:
        scene, camera = open_view(options)
        return _grounded(Film(options, scene, None, None, camera, environment, None), scene_bounds(scene))
    moving = builtin_animated_scene() if options.scene is None else load_animated_scene(options.scene)
    for note in moving.rest.notes:
        console.announce(f"{moving.rest.name}: {note}")
    clip = moving.clip(options.clip)
    bounds = moving.bounds(clip, [_seconds(options, frame) for frame in range(options.frames)])
    scene = moving.at(clip, options.start_seconds)
    chosen = choose_camera(scene, options, bounds=bounds)
    own = options.eye is None and not options.inside and bool(scene.cameras)
    console.announce(f"{scene.name}: clip {clip.name}, {clip.duration:.2f} s; {options.frames} frames")
    return _grounded(Film(options, scene, moving, clip, None if own else chosen, environment, None), bounds)


def orbit(camera: Camera, angle_radians: float) -> Camera:
    """The camera, gone round what it looks at, about the vertical, counter-clockwise seen from above."""
    away = turned(np.asarray(camera.eye - camera.target, np.float64), angle_radians)
    up = turned(np.asarray(camera.up, np.float64), angle_radians)
    eye = camera.target + jnp.asarray(away, jnp.float32)
    return dataclasses.replace(camera, eye=eye, up=jnp.asarray(up, jnp.float32))


def turned_lights(lights: Lights, angle_radians: float) -> Lights:
    """The lights with the directional ones turned about the vertical, as `rotate_environment` turns surroundings."""
    sun = np.asarray(lights.kind) == DIRECTIONAL
    direction = np.asarray(lights.direction, np.float64)
    direction = np.where(sun[:, None], turned(direction, angle_radians), direction)
    return dataclasses.replace(lights, direction=jnp.asarray(direction, jnp.float32))


def turned(vectors: Float[np.ndarray, "*b 3"], angle_radians: float) -> Float[np.ndarray, "*b 3"]:
    """Vectors turned about +Y, counter-clockwise seen from above."""
    cos, sin = math.cos(angle_radians), math.sin(angle_radians)
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=-1)


def _seconds(options: "Trace", frame: int) -> float:
    return options.start_seconds + frame / options.fps


def _grounded(film: Film, bounds: tuple) -> Film:
    """With the ground that was asked for, under all of the motion."""
    if not film.options.ground:
        return film
    extent = float(np.linalg.norm(np.asarray(bounds[1]) - np.asarray(bounds[0]))) or 1.0
    moving = film.moving
    if moving is not None:
        moving = dataclasses.replace(moving, rest=with_ground(moving.rest, *bounds))
    return dataclasses.replace(film, scene=with_ground(film.scene, *bounds), moving=moving, extent=extent)
