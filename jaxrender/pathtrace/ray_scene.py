"""What paths ask of a scene's rays, whichever backend answers, and where masked materials have holes."""

from typing import Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.pathtrace.hit_points import SurfaceTable, hit_surface
from jaxrender.pathtrace.hits import Hits
from jaxrender.pathtrace.paths import Rays, ShadowRays
from jaxrender.scene import MASK, Scene
from jaxrender.vec3 import Vec3


class RayScene(Protocol):
    """Closest hits and shadow tests in a `Scene`. Where the alpha of a masked material is below its cutoff, rays pass.

    Arrays come from the programs of paths and go to them: a backend on the host fetches them, one on the device does
    not.
    """

    def closest(self, rays: Rays, wanted: Bool[Array, " n"], *, reach: float = float("inf")) -> Hits:
        """The first solid point along each ray.

        Args:
          wanted: the other rays miss, and cost next to nothing.
          reach: what is further away may be missed.
        """
        ...

    def blocked(self, shadow: ShadowRays) -> Bool[Array | np.ndarray, " n"]:
        """Whether anything solid is nearer than the light; rays that would bring none are not traced."""
        ...

    def moved(self, scene: Scene, table: SurfaceTable) -> "RayScene":
        """That of the same scene in another pose, by the same backend."""
        ...


def masked_triangles(scene: Scene) -> Bool[np.ndarray, " t"]:
    """Which triangles may have holes."""
    return np.asarray(scene.material.alpha_mode)[np.asarray(scene.material_id)] == MASK


def is_hole(table: SurfaceTable, triangle: Int[Array, " n"], barycentrics: Float[Array, "n 2"]) -> Bool[Array, " n"]:
    """Whether points of triangles are in holes of masked materials; not where the triangle is -1."""
    down = Vec3(*(jnp.full(triangle.shape, x, jnp.float32) for x in (0.0, -1.0, 0.0)))
    surface = hit_surface(table, triangle, barycentrics, down)
    own = table.material_id[jnp.maximum(triangle, 0)]
    masked = table.material.alpha_mode[own] == MASK
    return (triangle >= 0) & masked & (surface.alpha < table.material.alpha_cutoff[own])
