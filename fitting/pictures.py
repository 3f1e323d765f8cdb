"""Pictures of a trained character: stills beside traced truth, clips under changing light, exponent and material."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.evaluate import Evaluation
from fitting.motion import SEGMENT, Motion
from fitting.shading import make_shader, posed_mesh, traced_colors
from jaxrender.animation.skeleton import Pose, sample_clip
from jaxrender.animation.skinning import Character, SkinnedMesh
from jaxrender.camera import Camera, frame_bounds
from jaxrender.checks import bad_input
from jaxrender.harmonics.light import environment_directions, project_environment, rotate_environment, sh_window
from jaxrender.harmonics.pose_model import PoseModel
from jaxrender.harmonics.sh import sh_rotate
from jaxrender.io.exr import write_exr
from jaxrender.io.hdr import read_environment
from jaxrender.io.picture import side_by_side, to_bytes, tone_map, write_animation, write_png
from jaxrender.metrics import heatmap
from jaxrender.pathtrace.preview import VisibleSurface, color_surface, environment_background, visible_surface

# Light of a low sun rings at four bands; the window trades a little sharpness for it.
WINDOW_BANDS = 6.0
MEMBRANE_TRANSMISSION = (0.75, 0.4, 0.22)


def builtin_environment(height: int = 128) -> Float[np.ndarray, "h w 3"]:
    """A procedural sky: blue above, warm at the horizon, grey ground, and a sun of 6 degrees, high on the right."""
    directions, _ = environment_directions(height, 2 * height)
    up = directions[..., 1:2]
    height_above = np.maximum(up, 0)
    sky = np.array([0.1, 0.2, 0.45]) * height_above + np.array([0.4, 0.36, 0.32]) * np.exp(-6 * height_above)
    ground = np.array([0.07, 0.06, 0.05]) * np.ones_like(up)
    image = np.where(up > 0, sky, ground)
    sun = np.array([0.75, 0.6, 0.28]) / np.linalg.norm([0.75, 0.6, 0.28])
    image = image + np.array([150.0, 125.0, 95.0]) * (directions @ sun > math.cos(math.radians(6.0)))[..., None]
    return image.astype(np.float32)


def light_of(environment: Float[np.ndarray, "h w 3"]) -> Float[jax.Array, "3 16"]:
    """The order-4 light of a map, windowed against ringing."""
    return sh_window(project_environment(jnp.asarray(environment), order=4), width=WINDOW_BANDS)


def turn_light(light: Float[jax.Array, "3 16"], angle_radians: float) -> Float[jax.Array, "3 16"]:
    """The light turned about +Y, as `rotate_environment` turns its map."""
    c, s = math.cos(angle_radians), math.sin(angle_radians)
    rotation = jnp.asarray([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], light.dtype)
    return sh_rotate(light, jnp.broadcast_to(rotation, (3, 3, 3)))


def clip_camera(
    character: Character, poses: Pose, *, azimuth_degrees: float, elevation_degrees: float, aspect: float
) -> Camera:
    """A still camera that sees the whole of a clip."""
    count = len(poses.rotation)
    some = sorted({round(i) for i in np.linspace(0, count - 1, min(count, 12))})
    meshes = [posed_mesh(character, pose_at(poses, i)).positions for i in some]
    low, high = np.min([m.min(axis=0) for m in meshes], axis=0), np.max([m.max(axis=0) for m in meshes], axis=0)
    return frame_bounds(
        jnp.asarray(low), jnp.asarray(high), azimuth_radians=math.radians(azimuth_degrees),
        elevation_radians=math.radians(elevation_degrees), aspect=aspect,
    )  # fmt: skip


def pose_at(poses: Pose, index: int) -> Pose:
    """One pose of many."""
    return jax.tree.map(lambda values: values[index], poses)


def exposure_of(colors: Float[np.ndarray, "v 3"]) -> float:
    """Stops that bring the brighter parts of a character near white."""
    bright = np.percentile(np.maximum(colors, 0.0).max(axis=-1), 96)
    return float(np.log2(0.8 / max(bright, 1e-6)))


def draw_pictures(
    character: Character, motion: Motion, model: PoseModel, evaluation: Evaluation, out: Path, *, size: int = 420
) -> list[tuple[Path, str]]:
    """The report's pictures, written into `out`; files and captions."""
    index = _telling_frame(motion, evaluation)
    pose = pose_at(motion.pose, index)
    mesh = posed_mesh(character, pose)
    camera = frame_bounds(
        jnp.asarray(mesh.positions.min(axis=0)), jnp.asarray(mesh.positions.max(axis=0)),
        azimuth_radians=math.radians(25.0), elevation_radians=math.radians(10.0),
    )  # fmt: skip
    still = Still(character, model, pose, mesh, camera, size)
    light = light_of(builtin_environment())
    where = f"{motion.clip_names[motion.clip[index]]}, {motion.time[index]:.2f} s"
    held = "held out of training" if motion.part[index] != 0 else "a training frame"
    pictures = [
        (still.comparison(out / "diffuse.png", "diffuse", light, 1.0),
         f"Diffuse under the built-in sky ({where}, {held}): without shadows, the model, traced truth, and the "
         "difference (white: a quarter of the bright tone)."),
        (still.comparison(out / "phong.png", "phong", light, 12.0), "Phong, exponent 12, local viewer."),
        (still.comparison(out / "membrane.png", "membrane", turn_light(light, 2.6), 1.0),
         "Thin membrane, lit from behind: front light is shadowed, back light is not, as in the paper."),
        (still.painted(out / "error_on_mesh.png", evaluation.point_errors),
         f"RMS relative SH error of each point over {evaluation.painted_on}; white is 0.5 and more, dark 0."),
    ]  # fmt: skip
    film = out / "film.webp"
    poses = pose_at_frames(character, 0, fps=12.0, max_frames=36)
    settings = Film(size=(320, 320), exponents=(1.0, 40.0))
    frames = [to_bytes(image) for image in film_frames(character, model, poses, builtin_environment(), settings)]
    write_animation(film, frames, fps=12.0)
    caption = f"{character.clips[0].name}: the sky turns once, the exponent goes from 1 to 40 and back."
    return [*pictures, (film, caption)]


def _telling_frame(motion: Motion, evaluation: Evaluation) -> int:
    """The held-out frame of median error; a training frame where nothing is held out."""
    frames = evaluation.frames
    own = np.flatnonzero(frames.part == SEGMENT) if (frames.part == SEGMENT).any() else np.arange(len(frames.part))
    order = own[np.argsort(frames.curve["global"][own])]
    return int(frames.index[order[len(order) // 2]])


@dataclass(frozen=True)
class Still:
    """One pose, drawn in several ways with the same rays."""

    character: Character
    model: PoseModel
    pose: Pose
    mesh: SkinnedMesh
    camera: Camera
    size: int

    def comparison(self, path: Path, material: str, light, exponent: float) -> Path:
        """Unshadowed, model, truth and their difference side by side."""
        options = {"eye": self.camera.eye, "light": light, "exponent": exponent, "transmission": MEMBRANE_TRANSMISSION}
        traced = {"material": material, **options}
        _, modelled = make_shader(self.character, self.model, material=material)(self.pose, **options)
        truth = traced_colors(self.character, self.model, self.mesh, **traced)
        open_sky = traced_colors(self.character, self.model, self.mesh, **traced, shadows=False)
        stops = exposure_of(truth)
        surface, faces = self._surface(), np.asarray(self.character.faces)
        images = [
            tone_map(color_surface(surface, faces, np.asarray(colors), (0.02, 0.022, 0.026)), exposure_stops=stops)
            for colors in (open_sky, modelled, truth)
        ]
        scale = 4.0 * 2.0**stops / 0.8
        error = np.abs(np.asarray(modelled) - truth).mean(axis=-1) * scale
        shown = color_surface(surface, faces, np.repeat(error[:, None], 3, axis=1), (0.0, 0.0, 0.0))
        images.append(np.asarray(heatmap(jnp.asarray(shown[..., 0], jnp.float32), high=1.0)))
        write_png(path, side_by_side(images, ["no shadows", "model", "traced", "difference"]))
        return path

    def painted(self, path: Path, point_errors: Float[np.ndarray, " p"]) -> Path:
        """Error per point painted on the mesh, from two sides."""
        errors = np.nan_to_num(point_errors)[np.asarray(self.model.points)]
        values = np.repeat(errors[:, None], 3, axis=1)
        shown = color_surface(self._surface(), np.asarray(self.character.faces), values, (0.0, 0.0, 0.0))
        write_png(path, np.asarray(heatmap(jnp.asarray(shown[..., 0], jnp.float32), high=0.5)))
        return path

    def _surface(self) -> VisibleSurface:
        faces = np.asarray(self.character.faces)
        return visible_surface(np.asarray(self.mesh.positions), faces, self.camera, height=self.size, width=self.size)


@dataclass(frozen=True)
class Film:
    """How a clip is shown: picture size (width, height), view, light and material over time."""

    size: tuple[int, int] = (512, 512)
    exponents: tuple[float, ...] = (1.0, 60.0)
    turns: float = 1.0
    membrane: bool = False
    truth: bool = False
    azimuth_degrees: float = 25.0
    elevation_degrees: float = 10.0


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

    Args:
      each: called with the frame number and the linear image, for EXR files.
    """
    material = "membrane" if film.membrane else "phong"
    shade = make_shader(character, model, material=material)
    width, height = film.size
    camera = clip_camera(
        character, poses, azimuth_degrees=film.azimuth_degrees, elevation_degrees=film.elevation_degrees,
        aspect=width / height,
    )  # fmt: skip
    light, count, stops = light_of(environment), len(poses.rotation), None
    faces = np.asarray(character.faces)
    for index in range(count):
        phase = index / max(count, 1)
        angle = 2 * math.pi * film.turns * phase
        low, high = film.exponents[0], film.exponents[-1]
        exponent = (low + 1) * ((high + 1) / (low + 1)) ** (0.5 - 0.5 * math.cos(2 * math.pi * phase)) - 1
        options = {"eye": camera.eye, "light": turn_light(light, angle), "exponent": exponent}
        options["transmission"] = MEMBRANE_TRANSMISSION
        pose = pose_at(poses, index)
        positions, colors = shade(pose, **options)
        stops = exposure_of(np.asarray(colors)) if stops is None else stops
        surface = visible_surface(np.asarray(positions), faces, camera, height=height, width=width)
        sky = environment_background(surface, np.asarray(rotate_environment(jnp.asarray(environment), angle)))
        linear = color_surface(surface, faces, np.asarray(colors), sky)
        if each is not None:
            each(index, linear)
        image = tone_map(linear, exposure_stops=stops)
        if film.truth:
            mesh = posed_mesh(character, pose)
            traced = traced_colors(character, model, mesh, material=material, **options)
            other = tone_map(color_surface(surface, faces, traced, sky), exposure_stops=stops)
            image = side_by_side([image, other], ["model", "traced"])
        yield image


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
