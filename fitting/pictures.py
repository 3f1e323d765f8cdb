"""Pictures of a trained character: stills beside traced truth, clips under changing light, exponent and material."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.evaluate import Evaluation
from fitting.motion import SEGMENT, Motion
from fitting.shading import make_shader, open_sky, posed_mesh, traced_visibility, truth_colors
from jaxrender.animation.skeleton import Pose, sample_clip
from jaxrender.animation.skinning import Character, SkinnedMesh
from jaxrender.camera import Camera, frame_bounds, look_at
from jaxrender.checks import bad_input
from jaxrender.deferred.preview import (
    blur_environment,
    color_surface,
    environment_background,
    gradient_background,
    lay_over,
    visible_surface,
)
from jaxrender.deferred.raster import Fragments
from jaxrender.harmonics.light import (
    environment_directions,
    project_environment,
    rotate_environment,
    sh_directional_light,
    sh_window,
)
from jaxrender.harmonics.pose_model import PoseModel
from jaxrender.harmonics.sh import sh_basis, sh_rotate
from jaxrender.io.exr import write_exr
from jaxrender.io.hdr import read_environment
from jaxrender.io.picture import side_by_side, to_bytes, tone_map, write_animation, write_png
from jaxrender.metrics import heatmap

#: What `draw_pictures` writes: stills, and films.
STILLS = ("key_light.png", "diffuse.png", "phong.png", "membrane.png", "error_on_mesh.png")
FILMS = ("film.webp", "membrane.webp")
PICTURES = (*STILLS, *FILMS)

MEMBRANE_TRANSMISSION = (0.75, 0.4, 0.22)
# Stills show shape and shadow, not the character's paint.
CLAY = (0.6, 0.57, 0.53)
# A membrane is shown in wax: paint would hide what comes through.
WAX = (0.8, 0.76, 0.7)
# Display-linear: what a still stands before, and the level that the brighter parts of a character are brought to.
BACKDROP_TOP, BACKDROP_BOTTOM = (0.055, 0.06, 0.07), (0.018, 0.019, 0.022)
BRIGHT = 0.8


# --- Light


def builtin_environment(height: int = 256) -> Float[np.ndarray, "h w 3"]:
    """A procedural sky: blue above, pale at the horizon, an afternoon sun on the right, and warm ground.

    The sun gives about twice the light of the sky, so that shadows show and four bands can still follow it.
    """
    directions, _ = environment_directions(height, 2 * height)
    up = directions[..., 1:2]
    sun = np.array([0.84, 0.5, 0.2]) / np.linalg.norm([0.84, 0.5, 0.2])
    angle = np.degrees(np.arccos(np.clip(directions @ sun, -1.0, 1.0)))[..., None]
    haze = np.exp(-4.5 * np.maximum(up, 0.0))
    sky = (1.0 - haze) * np.array([0.10, 0.20, 0.46]) + haze * np.array([0.52, 0.55, 0.58])
    sky = sky + np.array([0.9, 0.62, 0.36]) * (0.5 * np.exp(-angle / 9.0) + 0.16 * np.exp(-angle / 35.0))
    disc = 1.0 / (1.0 + np.exp((angle - 3.5) / 0.25))
    sky = sky + np.array([190.0, 165.0, 132.0]) * disc
    # Nearer to the feet the ground is darker, towards the horizon it takes the color of the air.
    far = np.exp(6.0 * np.minimum(up, 0.0))
    ground = (1.0 - far) * np.array([0.115, 0.098, 0.082]) + far * np.array([0.36, 0.34, 0.32])
    above = 1.0 / (1.0 + np.exp(-up / 0.006))
    return (above * sky + (1.0 - above) * ground).astype(np.float32)


def light_of(environment: Float[np.ndarray, "h w 3"]) -> Float[Array, "3 16"]:
    """The order-4 light of a map, windowed against ringing (`without_ringing`)."""
    return without_ringing(project_environment(jnp.asarray(environment), order=4))


def key_light(
    direction: tuple[float, float, float],
    *,
    irradiance: tuple[float, float, float] = (3.0, 2.8, 2.5),
    ambient: tuple[float, float, float] = (0.05, 0.06, 0.08),
) -> Float[Array, "3 16"]:
    """One lamp far away in a `direction` and even light from all around, windowed like a map's light.

    Args:
      irradiance: of a plane that faces the lamp. ambient: radiance of the surroundings.
    """
    towards = jnp.asarray(direction, jnp.float32)
    towards = towards / jnp.linalg.norm(towards)
    light = sh_directional_light(towards, jnp.asarray(irradiance, jnp.float32), order=4)
    return without_ringing(light.at[:, 0].add(jnp.asarray(ambient, jnp.float32) * math.sqrt(4 * math.pi)))


def without_ringing(light: Float[Array, "3 16"]) -> Float[Array, "3 16"]:
    """The light behind the widest of some windows that leaves its luminance positive, nearly.

    Four bands overshoot around a sun and go below zero beside it, which a glossy surface shows as black patches. The
    window blurs the light by as much as it takes; soft light keeps its bands.
    """
    directions, _ = environment_directions(24, 48)
    basis = sh_basis(jnp.asarray(directions.reshape(-1, 3), jnp.float32), order=4)
    for width in (16.0, 8.0, 6.5, 5.5, 5.0, 4.6, 4.3):
        windowed = sh_window(light, width=width)
        luminance = np.asarray(basis @ windowed.T) @ np.array([0.2126, 0.7152, 0.0722], np.float32)
        if luminance.min() > -0.05 * luminance.mean():
            break
    return windowed


def turn_light(light: Float[Array, "3 16"], angle_radians: float) -> Float[Array, "3 16"]:
    """The light turned about +Y, as `rotate_environment` turns its map."""
    c, s = math.cos(angle_radians), math.sin(angle_radians)
    rotation = jnp.asarray([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], light.dtype)
    return sh_rotate(light, jnp.broadcast_to(rotation, (3, 3, 3)))


def exposure_of(colors: list[Float[np.ndarray, "v 3"]]) -> float:
    """Stops that bring the brighter parts of a character near white, one for all frames given.

    Black vertices, those that see nothing, do not count.
    """
    levels = []
    for frame in colors:
        peak = np.maximum(np.asarray(frame), 0.0).max(axis=-1)
        lit = peak[peak > 0]
        levels.append(np.percentile(lit, 95) if lit.size else 1.0)
    return float(np.log2(BRIGHT) - np.mean(np.log2(np.maximum(levels, 1e-6))))


# --- Camera


def pose_at(poses: Pose, index: int) -> Pose:
    """One pose of many."""
    return jax.tree.map(lambda values: values[index], poses)


def clip_vertices(character: Character, poses: Pose) -> Float[np.ndarray, "n 3"]:
    """The vertices of a character in up to 12 poses of a clip: all of its way, where it travels."""
    count = len(poses.rotation)
    some = sorted({round(i) for i in np.linspace(0, count - 1, min(count, 12))})
    return np.concatenate([np.asarray(posed_mesh(character, pose_at(poses, i)).positions) for i in some])


def frame_vertices(
    vertices: Float[np.ndarray, "n 3"],
    *,
    azimuth_degrees: float,
    elevation_degrees: float,
    aspect: float,
    margin: float = 0.12,
) -> Camera:
    """A still camera that sees all vertices, with a margin, and is centred on them.

    Closer than `frame_bounds`, which has to keep the corners of their box in view.
    """
    low, high = (jnp.asarray(x, jnp.float32) for x in (vertices.min(axis=0), vertices.max(axis=0)))
    angles = {"azimuth_radians": math.radians(azimuth_degrees), "elevation_radians": math.radians(elevation_degrees)}
    camera = frame_bounds(low, high, aspect=aspect, **angles)
    axes = np.asarray(look_at(camera.eye, camera.target, camera.up), np.float64)
    center = np.asarray(camera.target, np.float64)
    slope = math.tan(0.5 * float(camera.fov_y_radians)) / (1.0 + margin)
    distance = float(np.linalg.norm(np.asarray(camera.eye) - center))
    for _ in range(8):
        x, y, z = ((vertices - center) @ axes).T
        distance = max(float(np.max(z + np.maximum(np.abs(x) / aspect, np.abs(y)) / slope)), 1e-6)
        # On the picture plane through the center; what is off the middle on one side moves towards it.
        across, along = x / (distance - z) * distance, y / (distance - z) * distance
        center = center + axes[:, :2] @ [0.5 * (v.max() + v.min()) for v in (across, along)]
    x, y, z = ((vertices - center) @ axes).T
    distance = max(float(np.max(z + np.maximum(np.abs(x) / aspect, np.abs(y)) / slope)), 1e-6)
    eye, target = (jnp.asarray(v, jnp.float32) for v in (center + distance * axes[:, 2], center))
    return Camera(eye, target, camera.up, camera.fov_y_radians)


# --- Stills


def draw_pictures(
    character: Character, motion: Motion, model: PoseModel, evaluation: Evaluation, out: Path, *, size: int = 480
) -> list[tuple[Path, str]]:
    """The report's pictures, written into `out`; files and captions."""
    index = _telling_frame(motion, evaluation)
    still = make_still(character, model, pose_at(motion.pose, index), size=size)
    environment = builtin_environment()
    sky, lamp = light_of(environment), key_light((-0.55, 0.75, 0.2))
    where = f"{motion.clip_names[motion.clip[index]]}, {motion.time[index]:.2f} s"
    held = "held out of training" if motion.part[index] != 0 else "a training frame"
    scale = "(white: a quarter of the bright tone)"
    key, diffuse, phong, thin, painted = (out / name for name in STILLS)
    pictures = [
        (still.comparison(key, "diffuse", lamp),
         f"Diffuse under one lamp of order 4 from the upper left ({where}, {held}): without shadows, the model, traced "
         f"visibility under the same light, and the difference {scale}."),
        (still.comparison(diffuse, "diffuse", sky), "Diffuse under the built-in sky."),
        (still.comparison(phong, "phong", sky, exponent=12.0), "Phong, exponent 12, local viewer."),
        (still.comparison(thin, "membrane", turn_light(sky, 2.4)),
         "Thin membrane, lit from behind: front light is shadowed, back light is not, as in the paper."),
        (still.painted(painted, evaluation.point_errors),
         f"RMS relative SH error of each point over {evaluation.painted_on}, from the front and from behind; pale "
         "yellow is 0.5 and more, dark is 0, grey sees nothing and was not measured."),
    ]  # fmt: skip
    film, sweep = (out / name for name in FILMS)
    poses = pose_at_frames(character, 0, fps=12.0, max_frames=36)
    settings = Film(size=(320, 320), exponents=(1.0, 64.0))
    write_animation(film, film_frames(character, model, poses, environment, settings), fps=12.0)
    settings = Film(size=(320, 320), membrane=True)
    frames = sweep_frames(character, model, still.pose, environment, settings, num_frames=36)
    write_animation(sweep, frames, fps=12.0)
    caption = f"{character.clips[0].name}: the sky turns once, the exponent goes from 1 to 64 and back."
    return [*pictures, (film, caption), (sweep, "The membrane in one pose, the sky turns.")]


def _telling_frame(motion: Motion, evaluation: Evaluation) -> int:
    """The held-out frame of median error; a training frame where nothing is held out."""
    frames = evaluation.frames
    own = np.flatnonzero(frames.part == SEGMENT) if (frames.part == SEGMENT).any() else np.arange(len(frames.part))
    order = own[np.argsort(frames.curve["global"][own])]
    return int(frames.index[order[len(order) // 2]])


@dataclass(frozen=True)
class Still:
    """One pose, drawn in several ways with the same view and the same traced visibility."""

    character: Character
    model: PoseModel
    pose: Pose
    mesh: SkinnedMesh
    camera: Camera
    surface: Fragments
    num_directions: int
    traced: tuple

    def comparison(self, path: Path, material: str, light: Float[Array, "3 16"], *, exponent: float = 1.0) -> Path:
        """Unshadowed, model, truth and their difference side by side, all under one exposure."""
        clay = np.broadcast_to(np.array(CLAY, np.float32), self.character.albedo.shape)
        options: dict[str, Any] = {"eye": self.camera.eye, "light": light, "albedo": clay, "exponent": exponent}
        options["transmission"] = MEMBRANE_TRANSMISSION
        shade = make_shader(self.character, self.model, material=material)
        modelled = np.asarray(shade(self.pose, **options)[1])
        points, bits = self.traced
        sky = open_sky(points, num_directions=self.num_directions)
        unshadowed, truth = (
            truth_colors(self.mesh, points, own, material=material, num_directions=self.num_directions, **options)
            for own in (sky, bits)
        )
        stops = exposure_of([truth])
        images = [
            self._shown(colors, lambda x: tone_map(x, exposure_stops=stops)) for colors in (unshadowed, modelled, truth)
        ]
        error = np.abs(modelled - truth).mean(axis=-1, keepdims=True) * (4.0 * 2.0**stops / BRIGHT)
        images.append(self._shown(error, _heat))
        write_png(path, side_by_side(images, ["no shadows", "model", "traced", "difference"]))
        return path

    def painted(self, path: Path, point_errors: Float[np.ndarray, " p"], *, high: float = 0.5) -> Path:
        """A number per point painted on the mesh, from the front and from behind."""
        of_vertex = point_errors[np.asarray(self.model.points)]
        measured = np.isfinite(of_vertex)
        values = np.stack([np.where(measured, of_vertex / high, 0.0), measured], axis=-1)
        back = make_still(
            self.character, self.model, self.pose, size=len(self.surface.triangle_id),
            azimuth_degrees=205.0, num_directions=0,
        )  # fmt: skip
        images = [still._shown(values, _heat_where_measured) for still in (self, back)]
        write_png(path, side_by_side(images, ["front", "back"]))
        return path

    def _shown(self, values: Float[np.ndarray, "v c"], display: Callable) -> Float[np.ndarray, "h w 3"]:
        """Values on the mesh through a transfer to display-linear, before the backdrop."""
        image, alpha = color_surface(self.surface, values)
        shown = display(image / np.maximum(alpha, 1e-6)[..., None]) * alpha[..., None]
        height, width = alpha.shape
        return lay_over(shown, alpha, gradient_background(height, width, top=BACKDROP_TOP, bottom=BACKDROP_BOTTOM))


def make_still(
    character: Character,
    model: PoseModel,
    pose: Pose,
    *,
    size: int,
    azimuth_degrees: float = 25.0,
    elevation_degrees: float = 10.0,
    num_directions: int = 1024,
) -> Still:
    """Rasterises one pose and casts its visibility rays.

    Args:
      size: height of a picture in pixels; its width follows the character.
      num_directions: visibility rays a point, 0 for none.
    """
    mesh = posed_mesh(character, pose)
    vertices = np.asarray(mesh.positions)
    x, y, z = np.ptp(vertices, axis=0)
    turn = math.radians(azimuth_degrees)
    across = abs(x * math.cos(turn)) + abs(z * math.sin(turn))
    aspect = float(np.clip(across / max(y, 1e-9), 0.55, 1.6))
    camera = frame_vertices(
        vertices, azimuth_degrees=azimuth_degrees, elevation_degrees=elevation_degrees, aspect=aspect
    )  # fmt: skip
    surface = visible_surface(vertices, np.asarray(character.faces), camera, height=size, width=round(size * aspect))
    traced = traced_visibility(character, mesh, num_directions=num_directions) if num_directions else ()
    return Still(character, model, pose, mesh, camera, surface, num_directions, traced)


def _heat(image: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
    return np.asarray(heatmap(jnp.asarray(image[..., 0], jnp.float32), high=1.0))


def _heat_where_measured(image: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 3"]:
    """Channel 0 as heat where channel 1, the share of measured corners, is above a half; grey elsewhere."""
    value = image[..., :1] / np.maximum(image[..., 1:], 1e-6)
    return np.where(image[..., 1:] > 0.5, _heat(value), 0.2)


# --- Clips


@dataclass(frozen=True)
class Film:
    """How a clip is shown: picture size (width, height), view, light and material over time."""

    size: tuple[int, int] = (512, 512)
    exponents: tuple[float, ...] = (1.0, 64.0)
    turns: float = 1.0
    membrane: bool = False
    truth: bool = False
    azimuth_degrees: float = 25.0
    elevation_degrees: float = 10.0

    @property
    def material(self) -> str:
        return "membrane" if self.membrane else "phong"

    def exponent(self, phase: float) -> float:
        """From the first exponent to the last and back while `phase` goes from 0 to 1, evenly in log(α + 1)."""
        low, high = self.exponents[0] + 1.0, self.exponents[-1] + 1.0
        return low * (high / low) ** (0.5 - 0.5 * math.cos(2 * math.pi * phase)) - 1.0


def pose_at_frames(character: Character, clip: int, *, fps: float, max_frames: int | None = None) -> Pose:
    """Poses of a clip at a frame rate."""
    chosen = character.clips[clip]
    count = max(1, math.floor(chosen.duration * fps + 1e-6) + 1)
    count = min(count, max_frames) if max_frames else count
    times = np.minimum(np.arange(count) / fps, chosen.duration) + chosen.start
    return sample_clip(chosen, character.skeleton, jnp.asarray(times, jnp.float32))


def film_frames(
    character: Character, model: PoseModel, poses: Pose, environment: Float[np.ndarray, "h w 3"], film: Film,
    *, each: Callable[[int, np.ndarray], None] | None = None,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Display-ready frames: the clip plays, the map turns about +Y, the exponent sweeps to its other end and back.

    Camera and exposure are one for the whole clip.

    Args:
      each: called with the frame number and the linear image of the model, for EXR files.
    """
    camera = _film_camera(character, poses, film)
    shots = _Shots(character, model, environment, film, camera)
    count = len(poses.rotation)
    some = sorted({round(i) for i in np.linspace(0, count - 1, min(count, 8))})
    stops = exposure_of([shots.shade(pose_at(poses, i), i / count)[1] for i in some])
    for index in range(count):
        pose, phase = pose_at(poses, index), index / count
        positions, colors = shots.shade(pose, phase)
        surface = shots.see(positions)
        linear = shots.draw(surface, colors, phase)
        if each is not None:
            each(index, linear)
        images = [tone_map(linear, exposure_stops=stops)]
        if film.truth:
            traced = shots.truth(posed_mesh(character, pose), phase)
            images.append(tone_map(shots.draw(surface, traced, phase), exposure_stops=stops))
        yield side_by_side(images, ["model", "traced"]) if film.truth else images[0]


def sweep_frames(
    character: Character, model: PoseModel, pose: Pose, environment: Float[np.ndarray, "h w 3"], film: Film,
    *, num_frames: int,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Display-ready frames of one still pose while light (and exponent) go around; the camera's rays are cast once."""
    camera = _film_camera(character, jax.tree.map(lambda x: jnp.asarray(x)[None], pose), film)
    shots = _Shots(character, model, environment, film, camera)
    shaded = [shots.shade(pose, index / num_frames) for index in range(num_frames)]
    stops = exposure_of([colors for _, colors in shaded])
    surface = shots.see(shaded[0][0])
    for index, (_, colors) in enumerate(shaded):
        yield tone_map(shots.draw(surface, colors, index / num_frames), exposure_stops=stops)


def _film_camera(character: Character, poses: Pose, film: Film) -> Camera:
    aspect = film.size[0] / film.size[1]
    return frame_vertices(
        clip_vertices(character, poses), azimuth_degrees=film.azimuth_degrees,
        elevation_degrees=film.elevation_degrees, aspect=aspect,
    )  # fmt: skip


class _Shots:
    """What all frames of a film share, and the three steps of a frame: shade, see, draw."""

    def __init__(self, character: Character, model: PoseModel, environment, film: Film, camera: Camera):
        self.character, self.film, self.camera = character, film, camera
        self.light = light_of(environment)
        # Out of focus, as behind a portrait; it also hides the pixels of a small map.
        self.environment = jnp.asarray(blur_environment(environment, degrees=0.7))
        self.shader = make_shader(character, model, material=film.material)
        self.faces = np.asarray(character.faces)
        wax = np.broadcast_to(np.array(WAX, np.float32), character.albedo.shape)
        self.albedo = wax if film.membrane else np.asarray(character.albedo)

    def shade(self, pose: Pose, phase: float) -> tuple[np.ndarray, np.ndarray]:
        positions, colors = self.shader(pose, **self._options(phase))
        return np.asarray(positions), np.asarray(colors)

    def truth(self, mesh: SkinnedMesh, phase: float, *, num_directions: int = 512) -> np.ndarray:
        points, bits = traced_visibility(self.character, mesh, num_directions=num_directions)
        return truth_colors(
            mesh, points, bits, material=self.film.material, num_directions=num_directions, **self._options(phase)
        )  # fmt: skip

    def see(self, positions: np.ndarray) -> Fragments:
        width, height = self.film.size
        return visible_surface(positions, self.faces, self.camera, height=height, width=width)

    def draw(self, surface: Fragments, colors: np.ndarray, phase: float) -> np.ndarray:
        image, alpha = color_surface(surface, colors)
        height, width = alpha.shape
        turned = rotate_environment(self.environment, self._angle(phase))
        return lay_over(
            image, alpha, environment_background(np.asarray(turned), self.camera, height=height, width=width)
        )

    def _angle(self, phase: float) -> float:
        return 2 * math.pi * self.film.turns * phase

    def _options(self, phase: float) -> dict[str, Any]:
        return {
            "eye": self.camera.eye,
            "light": turn_light(self.light, self._angle(phase)),
            "exponent": self.film.exponent(phase),
            "albedo": self.albedo,
            "transmission": MEMBRANE_TRANSMISSION,
        }


def render_clip(character: Character, model: PoseModel, options) -> list[Path]:
    """`relight`: PNG frames, an animated picture and, on demand, EXR frames of one clip.

    Args:
      options: `jaxrender.cli.Relight`.
    """
    if not character.clips:
        bad_input(character.name, "animations", expected="at least one clip", got="none")
    names = [clip.name for clip in character.clips]
    if options.clip is not None and options.clip not in names:
        bad_input(character.name, "clip", expected=f"one of {', '.join(names)}", got=options.clip)
    index = names.index(options.clip) if options.clip else 0
    environment = builtin_environment() if options.environment is None else read_environment(options.environment)
    fields = {name: getattr(options, name) for name in Film.__dataclass_fields__}
    poses = pose_at_frames(character, index, fps=options.fps)
    options.out.mkdir(parents=True, exist_ok=True)

    def keep_linear(number: int, image: np.ndarray) -> None:
        if options.exr:
            write_exr(options.out / f"frame_{number:04d}.exr", image.astype(np.float32))

    frames = []
    for number, image in enumerate(film_frames(character, model, poses, environment, Film(**fields), each=keep_linear)):
        frames.append(to_bytes(image))
        write_png(options.out / f"frame_{number:04d}.png", image)
    write_animation(options.out / "film.webp", frames, fps=options.fps)
    return [options.out / "film.webp", options.out / "frame_0000.png"]
