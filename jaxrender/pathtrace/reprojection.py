"""Where the surfaces of a picture were in the frame before it: by triangle and barycentrics, so that skin is followed.

Host programs, NumPy in and out.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxrender.camera import Camera, project_px
from jaxrender.pathtrace import programs
from jaxrender.pathtrace.guide_rays import Traced
from jaxrender.pathtrace.world import World
from jaxrender.scene import Scene

#: Points of one surface in neighbouring pixels are not farther apart than this, and not farther from the plane of one
#: of them, in widths of a pixel at their distance.
_ALONG, _ACROSS = 30.0, 1.5

#: Cosine of the largest angle between normals of one surface in neighbouring pixels.
_ALIKE = 0.8


def previous_places(
    world: World, camera: Camera, before: Scene, camera_before: Camera, seen_before: Traced
) -> tuple[Float[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Where in the frame before the surface of each pixel's centre was, and whether it is seen there.

    It is where the four pixels around the place show points close by with like normals. Surroundings match nothing.

    Args:
      world: as it is now. before: the scene in the frame before, with the same faces.
      seen_before: what was traced then, of the picture's size.
    """
    height, width = seen_before.depth.shape[:2]
    triangle, barycentrics = _centres(world, camera, height=height, width=width)
    corners = np.maximum(triangle, 0)
    faces = np.asarray(before.faces)[corners]
    weights = np.concatenate([1.0 - barycentrics.sum(axis=1, keepdims=True), barycentrics], axis=1)
    points, normals = (
        np.einsum("nk,nkc->nc", weights, np.asarray(x)[faces]).astype(np.float32).reshape(height, width, 3)
        for x in (before.positions, before.normals)
    )
    places, depth = (np.asarray(x) for x in _project(camera_before, points, height=height, width=width))
    pixel = 2.0 * np.tan(0.5 * float(camera_before.fov_y_radians)) / height * np.maximum(depth, 0.0)
    lengths = np.linalg.norm(normals, axis=-1)
    found = (triangle >= 0).reshape(height, width) & (depth > 0.0)
    places = np.where(found[..., None], places, np.float32(0.5))
    whole = np.floor(places - 0.5)
    inside = (places >= 0.5) & (places <= np.array([width - 0.5, height - 0.5]))
    matches = found & inside.all(axis=-1)
    for offset in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = (np.clip(whole[..., k] + offset[k], 0, size - 1).astype(int)
                       for k, size in ((0, width), (1, height)))  # fmt: skip
        apart = points - seen_before.position[row, column]
        there = seen_before.normal[row, column]
        near = np.linalg.norm(apart, axis=-1) < _ALONG * pixel
        flat = np.abs(np.sum(apart * there, axis=-1)) < _ACROSS * pixel
        alike = np.abs(np.sum(normals * there, axis=-1)) > _ALIKE * lengths
        matches &= near & flat & alike & (seen_before.depth[row, column, 0] > 0.0)
    return places.astype(np.float32), matches


def _centres(world: World, camera: Camera, *, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangle and barycentrics at the centres of all pixels, row by row."""
    view = programs.make_view(camera, height=height)

    def trace(start: int, *, block: int) -> programs.Images:
        rays, _ = programs.eye_rays(view, start, 0, 0, block=block, height=height, width=width)
        hits = world.rays.closest(rays, jnp.ones(block, bool))
        return {"triangle": (jnp.asarray(hits.triangle),), "barycentrics": list(jnp.asarray(hits.barycentrics).T)}

    found = programs.trace_blocks(trace, height=height, width=width)
    return found["triangle"].reshape(-1), found["barycentrics"].reshape(-1, 2)


_project = jax.jit(project_px, static_argnames=("height", "width"))
