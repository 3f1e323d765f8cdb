"""The four scenes of the path tracer's measurements as `Scene`s, matt all over: those of `mitsuba_scenes`."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxrender.camera import Camera
from jaxrender.io import load_scene
from jaxrender.io.surfaces import SceneSurface, merged_scene, no_lights, on_device
from jaxrender.scene import DIRECTIONAL, OPAQUE, Lights, Material, Scene

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Stage:
    """A scene, its camera, and what comes from far away."""

    scene: Scene
    camera: Camera
    environment: Float[np.ndarray, "h w 3"] | None = None


def cornell() -> Stage:
    """The Cornell box with a dragon in the place of the two boxes."""
    box = load_scene(DATA / "cornell_box" / "scene.json")
    # Its lamp is dim for a picture shown without exposure.
    box = dataclasses.replace(box, material=dataclasses.replace(box.material, emissive=1.6 * box.material.emissive))
    dragon = placed(load_scene(DATA / "meshes" / "dragon_100k.ply"), scale=150.0, turn_radians=0.55,
                    foot=(278.0, 0.0, 340.0))  # fmt: skip
    names = np.array(box.material_names)
    left = ~np.isin(names[np.asarray(box.material_id)], ["cbox_smallbox", "cbox_largebox"])
    # The back of the lamp, just below the ceiling, is dark.
    box = dataclasses.replace(box, material=dataclasses.replace(box.material, double_sided=jnp.zeros(len(names), bool)))
    scene = joined([only(box, left), painted(dragon, (0.72, 0.7, 0.62))], name="cornell")
    camera = box.cameras[0]
    # The angle of the file is that of the shorter side; here the box fills the longer one.
    narrow = 2.0 * np.arctan(0.75 * np.tan(0.5 * float(camera.fov_y_radians)))
    return Stage(scene, dataclasses.replace(camera, fov_y_radians=jnp.float32(narrow)))


def statue() -> Stage:
    """A bunny before a red wall, lit by a lamp that shines on both, under a dim sky."""
    bunny = placed(load_scene(DATA / "meshes" / "bunny.ply"), scale=8.0, turn_radians=-0.3, foot=(0.0, 0.0, 0.0))
    parts = [
        painted(bunny, (0.75, 0.75, 0.75)),
        rectangle((0, 0, 0), (0, 1, 0), (4.0, 4.0), color=(0.6, 0.6, 0.6)),
        rectangle((-1.5, 1.5, 0), (1, 0, 0), (4.0, 1.5), color=(0.7, 0.12, 0.06)),
        rectangle((0, 1.5, -2.0), (0, 0, 1), (4.0, 1.5), color=(0.25, 0.35, 0.6)),
        rectangle((1.6, 2.6, 1.0), (-0.75, -0.85, -0.35), (0.4, 0.4), radiance=(34.0, 30.0, 25.0)),
    ]
    return Stage(joined(parts, name="statue"), look((0.9, 1.15, 3.4), (-0.15, 0.62, 0.0), 38.0), sky((0.16, 0.2, 0.28)))


def atrium() -> Stage:
    """The older Sponza, all grey, under sun and sky."""
    building = with_edges(painted(load_scene(DATA / "dabrovic_sponza" / "sponza_dabrovic.ply"), (0.6, 0.6, 0.6)))
    lit = dataclasses.replace(building, lights=sun((0.2, -1.0, 0.22), (5.2, 4.7, 3.9)))
    return Stage(lit, look((11.0, 1.2, -1.0), (-5.0, 3.2, 0.6), 60.0), sky((2.2, 2.6, 3.2)))


def sponza() -> Stage:
    """Sponza with its textures, under sun and sky."""
    building = load_scene(DATA / "sponza" / "Sponza.gltf")
    lit = dataclasses.replace(building, lights=sun((0.2, -1.0, 0.22), (18.0, 16.2, 13.5)))
    return Stage(lit, look((10.0, 2.0, 0.0), (-5.0, 3.0, 0.0), 60.0), sky((4.5, 5.2, 6.5)))


STAGES = {"cornell": cornell, "statue": statue, "atrium": atrium, "sponza": sponza}


def placed(scene: Scene, *, scale: float, turn_radians: float, foot: Vector) -> Scene:
    """A statue, turned about the vertical, with the middle of its lowest plane at `foot`."""
    cos, sin = np.cos(turn_radians), np.sin(turn_radians)
    rotation = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    positions = np.asarray(scene.positions) @ rotation.T * scale
    low, high = positions.min(axis=0), positions.max(axis=0)
    positions += foot - np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    normals = np.asarray(scene.normals) @ rotation.T
    return dataclasses.replace(scene, positions=on_device(positions), normals=on_device(normals))


def with_edges(scene: Scene, *, cos_crease: float = 0.7) -> Scene:
    """The scene with the face's normal at corners where the vertex normal is far from it, as at edges walls share."""
    faces = np.asarray(scene.faces)
    a, b, c = (np.asarray(scene.positions, np.float64)[faces[:, i]] for i in range(3))
    flat = np.cross(b - a, c - a)
    flat = np.repeat(flat / np.linalg.norm(flat, axis=1, keepdims=True), 3, axis=0)
    corners = faces.ravel()
    normals = np.asarray(scene.normals, np.float64)[corners]
    normals = np.where(np.sum(normals * flat, axis=1, keepdims=True) < cos_crease, flat, normals)
    apart = {name: getattr(scene, name)[corners] for name in ("positions", "tangents", "uv", "colors")}
    faces = np.arange(len(corners)).reshape(-1, 3)
    return dataclasses.replace(scene, normals=on_device(normals), faces=on_device(faces), **apart)


def painted(scene: Scene, color: Vector, *, radiance: Vector = (0.0, 0.0, 0.0)) -> Scene:
    """A scene in one matt color, without textures."""
    material_id = jnp.zeros_like(scene.material_id)
    return dataclasses.replace(
        scene, material=matt([color], [radiance]), material_id=material_id, images=(), material_names=("paint",),
        colors=jnp.ones_like(scene.colors),
    )  # fmt: skip


def matt(colors: list[Vector], radiances: list[Vector]) -> Material:
    """Materials of one color each, opaque."""
    count = len(colors)
    one, zero, none = np.ones(count), np.zeros(count), jnp.full(count, -1, jnp.int32)
    return Material(
        base_color=on_device(np.concatenate([np.array(colors), one[:, None]], axis=1)), metallic=on_device(zero),
        roughness=on_device(one), emissive=on_device(np.array(radiances)), normal_scale=on_device(one),
        occlusion_strength=on_device(one), alpha_mode=jnp.full(count, OPAQUE, jnp.int32),
        alpha_cutoff=on_device(0.5 * one), double_sided=jnp.zeros(count, bool), base_color_texture=none,
        metallic_roughness_texture=none, normal_texture=none, occlusion_texture=none, emissive_texture=none,
    )  # fmt: skip


def rectangle(
    middle: Vector, normal: Vector, half_size: tuple[float, float], *, color: Vector = (0.0, 0.0, 0.0),
    radiance: Vector = (0.0, 0.0, 0.0),
) -> Scene:  # fmt: skip
    """A rectangle of twice `half_size`: across, horizontally, and up (towards -z if it lies flat)."""
    n = np.array(normal) / np.linalg.norm(normal)
    up = np.array([0.0, 0.0, -1.0] if abs(n[1]) > 0.999 else [0.0, 1.0, 0.0])
    across = np.cross(up, n)
    across /= np.linalg.norm(across)
    x, y = across * half_size[0], np.cross(n, across) * half_size[1]
    corners = np.array(middle) + np.stack([-x - y, x - y, x + y, -x + y])
    surface = SceneSurface(
        corners, np.tile(n, (4, 1)), None, np.zeros((4, 2)), np.ones((4, 4)), np.array([[0, 1, 2], [0, 2, 3]]),
        np.zeros(2, int),
    )  # fmt: skip
    return merged_scene([surface], material=matt([color], [radiance]), lights=no_lights(), cameras=(), name="rectangle",
                        material_names=("paint",))  # fmt: skip


def only(scene: Scene, kept: np.ndarray) -> Scene:
    """The scene with some of its triangles."""
    return dataclasses.replace(scene, faces=scene.faces[kept], material_id=scene.material_id[kept])


def joined(scenes: list[Scene], *, name: str) -> Scene:
    """One scene of several without textures."""
    surfaces, start = [], 0
    for scene in scenes:
        positions, normals, tangents, uv, colors, faces = (
            np.asarray(getattr(scene, name))
            for name in ("positions", "normals", "tangents", "uv", "colors", "faces")
        )  # fmt: skip
        material_id = np.asarray(scene.material_id) + start
        surfaces.append(SceneSurface(positions, normals, tangents, uv, colors, faces, material_id))
        start += len(scene.material.metallic)
    material = jax.tree.map(lambda *parts: jnp.concatenate(parts), *(scene.material for scene in scenes))
    names = tuple(name for scene in scenes for name in scene.material_names)
    return merged_scene(surfaces, material=material, lights=no_lights(), cameras=(), name=name, material_names=names)


def look(eye: Vector, target: Vector, fov_y_degrees: float) -> Camera:
    """A camera that is level."""
    vectors = [on_device(np.array(vector)) for vector in (eye, target, (0.0, 1.0, 0.0))]
    return Camera(vectors[0], vectors[1], vectors[2], jnp.float32(np.radians(fov_y_degrees)))


def sky(zenith: Vector) -> Float[np.ndarray, "64 128 3"]:
    """The overcast sky of the CIE, three times as bright at the zenith as at the horizon, over black ground."""
    height = np.sin(np.linspace(0.5 * np.pi, -0.5 * np.pi, 64))
    rows = np.where(height > 0.0, (1.0 + 2.0 * height) / 3.0, 0.0)
    return np.ascontiguousarray(np.broadcast_to(rows[:, None, None] * np.asarray(zenith), (64, 128, 3)), np.float32)


def sun(direction: Vector, irradiance: Vector) -> Lights:
    """Parallel light that travels along `direction`; `irradiance` is on a surface that faces it."""
    unit = np.array(direction) / np.linalg.norm(direction)
    return Lights(
        kind=jnp.full(1, DIRECTIONAL, jnp.int32), position=on_device(np.zeros((1, 3))), direction=on_device(unit[None]),
        intensity=on_device(np.array([irradiance])), range=on_device(np.array([np.inf])),
        cos_inner=on_device(-np.ones(1)), cos_outer=on_device(-np.ones(1)),
    )  # fmt: skip
