"""A scene made ready for paths: surfaces by triangle, lights, and rays."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from jaxrender.deferred.pipeline import default_lights
from jaxrender.pathtrace.backends import RayBackend, chosen_backend
from jaxrender.pathtrace.embree_rays import EmbreeRays
from jaxrender.pathtrace.emitters import ALL_GROUPS, Emitters, make_emitters
from jaxrender.pathtrace.hit_points import SurfaceTable, surface_table
from jaxrender.pathtrace.ray_scene import RayScene
from jaxrender.pathtrace.tree_rays import tree_rays
from jaxrender.scene import Lights, Scene, scene_bounds
from jaxrender.sh_basis import basis_columns


@dataclass(frozen=True)
class World:
    """A scene made ready for paths. Worth keeping between pictures."""

    table: SurfaceTable
    emitters: Emitters
    rays: RayScene
    extent: float
    notes: tuple[str, ...] = ()


def prepare(
    scene: Scene,
    *,
    lights: Lights | None = None,
    environment: Float[np.ndarray, "h w 3"] | None = None,
    rays: RayBackend = "auto",
) -> World:
    """Builds what rays and paths need of a scene.

    A scene without any light gets a sun and a sky, with a note that says so.

    Args:
      rays: who traces them: "embree" on the CPU, "jax" on the device that JAX uses, or "auto" (`chosen_backend`).
    Raises:
      ValueError: naming the field, if positions are not finite; for another name of `rays`.
    """
    open_rays: Callable[..., RayScene] = EmbreeRays if chosen_backend(rays) == "embree" else tree_rays
    _check_finite(scene)
    table = surface_table(scene)
    emitters = make_emitters(scene, table, lights=lights, environment=environment)
    notes: tuple[str, ...] = ()
    if not emitters.groups:
        sun, ambient = default_lights()
        emitters = make_emitters(scene, table, lights=sun, environment=sky_image(ambient))
        notes = ("no lights, a sun and a sky were added",)
    low, high = (np.asarray(corner, np.float64) for corner in scene_bounds(scene))
    return World(table, emitters, open_rays(scene, table), float(np.linalg.norm(high - low)) or 1.0, notes)


def sky_image(ambient: Float[Array, "3 k"], *, height: int = 32) -> Float[np.ndarray, "h w 3"]:
    """SH radiance as a latitude-longitude image, twice as wide as high; what is below 0 is 0."""
    order = round(ambient.shape[1] ** 0.5)
    theta = (np.arange(height) + 0.5) * (np.pi / height)
    phi = (np.arange(2 * height) + 0.5) * (np.pi / height) - np.pi
    s, c = np.sin(theta)[:, None], np.cos(theta)[:, None]
    x, y, z = np.broadcast_arrays(s * np.sin(phi), c, -s * np.cos(phi))
    basis = np.stack([np.asarray(b) for b in basis_columns(x, y, z, order=order)], axis=-1)
    return np.maximum(basis @ np.asarray(ambient, np.float64).T, 0.0).astype(np.float32)


def move(
    world: World, scene: Scene, *, lights: Lights | None = None, environment: Float[np.ndarray, "h w 3"] | None = None
) -> World:
    """The world of the same scene in another pose: with the same faces, materials and images.

    Textures stay, and so does who traces the rays; `extent` too, so that guides mean the same in all frames.

    Args:
      lights, environment: instead of those so far, which stay if none are given.
    Raises:
      ValueError: if the number of triangles differs, or positions are not finite.
    """
    count = len(world.table.material_id)
    if len(scene.faces) != count:
        raise ValueError(f"scene.faces: expected {count}, as before, got {len(scene.faces)}")
    _check_finite(scene)
    table = surface_table(scene, textures=world.table.textures)
    lights = world.emitters.lights if lights is None else lights
    emitters = make_emitters(scene, table, lights=lights, environment=environment)
    if environment is None and world.emitters.environment is not None:
        groups = tuple(group for group in ALL_GROUPS if group in (*emitters.groups, "environment"))
        emitters = dataclasses.replace(emitters, environment=world.emitters.environment, groups=groups)
    return World(table, emitters, world.rays.moved(scene, table), world.extent, world.notes)


def _check_finite(scene: Scene) -> None:
    if not np.isfinite(np.asarray(scene.positions)[np.asarray(scene.faces)]).all():
        raise ValueError("scene.positions: expected finite numbers, got NaN or Inf")
