"""A scene made ready for paths: surfaces by triangle, lights, and rays."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from jaxrender.checks import bad_input, check_finite
from jaxrender.deferred.pipeline import default_lights
from jaxrender.latlong import environment_directions
from jaxrender.machine import check_memory
from jaxrender.pathtrace.backends import RayBackend, chosen_backend
from jaxrender.pathtrace.embree_rays import EmbreeRays
from jaxrender.pathtrace.emitters import ALL_GROUPS, Emitters, make_emitters
from jaxrender.pathtrace.hit_points import SurfaceTable, surface_table
from jaxrender.pathtrace.ray_scene import RayScene
from jaxrender.pathtrace.tree_rays import tree_rays
from jaxrender.scene import Lights, Scene, scene_bounds
from jaxrender.sh_basis import basis_columns

#: What is said of a scene that has none.
NO_LIGHTS = "no lights, a sun and a sky were added"

#: Bytes that `prepare` takes for a triangle (300 to 480 measured with 0.5 and 2 million, Embree's tree included), and
#: more for one that emits (2600), whose texture is looked at.
_TRIANGLE_BYTES, _EMITTER_BYTES = 500, 2700


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

    A scene without any light gets a sun and a sky, with a note that says so. Triangles without area are there for no
    ray, and no light is drawn from them.

    Args:
      rays: who traces them: "embree" on the CPU, "jax" on the device that JAX uses, or "auto" (`chosen_backend`).
    Raises:
      ValueError: naming the field, if there is no triangle, or anything is not finite; for another name of `rays`.
      MemoryError: if there are more triangles than memory; it says how much they need.
    """
    _check_scene(scene, scene.lights if lights is None else lights)
    open_rays: Callable[..., RayScene] = EmbreeRays if chosen_backend(rays) == "embree" else tree_rays
    table = surface_table(scene)
    emitters = make_emitters(scene, table, lights=lights, environment=environment)
    notes: tuple[str, ...] = ()
    if not emitters.groups:
        sun, ambient = default_lights()
        emitters = make_emitters(scene, table, lights=sun, environment=sky_image(ambient))
        notes = (NO_LIGHTS,)
    low, high = (np.asarray(corner, np.float64) for corner in scene_bounds(scene))
    return World(table, emitters, open_rays(scene, table), float(np.linalg.norm(high - low)) or 1.0, notes)


def sky_image(ambient: Float[Array, "3 k"], *, height: int = 32) -> Float[np.ndarray, "h w 3"]:
    """SH radiance as a latitude-longitude image, twice as wide as high; what is below 0 is 0."""
    order = round(ambient.shape[1] ** 0.5)
    x, y, z = np.moveaxis(environment_directions(height, 2 * height)[0], -1, 0)
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
      ValueError: if the number of triangles differs, or anything is not finite.
    """
    count = len(world.table.material_id)
    if len(scene.faces) != count:
        raise ValueError(f"scene.faces: expected {count}, as before, got {len(scene.faces)}")
    lights = world.emitters.lights if lights is None else lights
    _check_scene(scene, lights)
    table = surface_table(scene, textures=world.table.textures)
    emitters = make_emitters(scene, table, lights=lights, environment=environment)
    if environment is None and world.emitters.environment is not None:
        groups = tuple(group for group in ALL_GROUPS if group in (*emitters.groups, "environment"))
        emitters = dataclasses.replace(emitters, environment=world.emitters.environment, groups=groups)
    return World(table, emitters, world.rays.moved(scene, table), world.extent, world.notes)


def _check_scene(scene: Scene, lights: Lights) -> None:
    """Before anything is built: that there is something, that it fits, and that all numbers are finite."""
    count = len(scene.faces)
    if not count:
        raise ValueError("scene.faces: expected at least one triangle, got none")
    emissive = np.asarray(scene.material.emissive)[np.asarray(scene.material_id)]
    emitting = int(np.any(emissive > 0.0, axis=-1).sum())
    check_memory(f"{count} triangles", count * _TRIANGLE_BYTES + emitting * _EMITTER_BYTES)
    faces = np.asarray(scene.faces)
    for name in ("positions", "normals", "tangents", "uv", "colors"):
        values = np.asarray(getattr(scene, name))
        # Vertices without a triangle may be anything.
        if not np.isfinite(values).all() and not np.isfinite(values[faces]).all():
            raise ValueError(f"scene.{name}: expected finite numbers, got NaN or Inf")
    for name in ("base_color", "metallic", "roughness", "emissive", "normal_scale", "alpha_cutoff"):
        check_finite("scene.material", name, np.asarray(getattr(scene.material, name)))
    for name in ("position", "direction", "intensity", "cos_inner", "cos_outer"):
        check_finite("lights", name, np.asarray(getattr(lights, name)))
    intensity, reach = np.asarray(lights.intensity), np.asarray(lights.range)
    if (intensity < 0.0).any():
        bad_input("lights", "intensity", expected="numbers >= 0", got=float(intensity.min()))
    if not (reach > 0.0).all():
        bad_input("lights", "range", expected="numbers > 0, or Inf", got=reach.min())
