"""Vertex colors to an image by first-hit rays: what `fitting` draws its pictures with.

Works on one image; NumPy in, NumPy out. The rays of a pose are cast once (`visible_surface`); coloring it again
costs no ray.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates

from jaxrender.camera import Camera, camera_rays
from jaxrender.checks import check_at_least
from jaxrender.pathtrace.embree import EmbreeScene


@dataclass(frozen=True)
class VisibleSurface:
    """What each sample of an image sees: a face (-1: nothing), where on it, and the direction of the ray.

    Samples are ordered row by row; a pixel has samples_per_axis² of them in a regular grid.
    """

    triangle: Int[np.ndarray, "hs ws"]
    barycentrics: Float[np.ndarray, "hs ws 2"]
    directions: Float[np.ndarray, "hs ws 3"]
    samples_per_axis: int


def visible_surface(
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "t 3"],
    camera: Camera,
    *,
    height: int,
    width: int,
    samples_per_axis: int = 2,
) -> VisibleSurface:
    """Casts one ray per sample."""
    check_at_least("samples_per_axis", samples_per_axis, 1)
    size = height * samples_per_axis, width * samples_per_axis
    origins, directions = (np.asarray(x) for x in camera_rays(camera, height=size[0], width=size[1]))
    rays = (np.ascontiguousarray(x.reshape(-1, 3), np.float32) for x in (origins, directions))
    hits = EmbreeScene(positions, faces).closest_hit(*rays)
    return VisibleSurface(
        hits.triangle.reshape(size), hits.barycentrics.reshape(*size, 2), directions, samples_per_axis
    )


def color_surface(
    surface: VisibleSurface,
    faces: Int[np.ndarray, "t 3"],
    colors: Float[np.ndarray, "v 3"],
    background: Float[np.ndarray, "hs ws 3"] | tuple[float, float, float],
) -> Float[np.ndarray, "h w 3"]:
    """Linear image: vertex colors interpolated over the faces, negative ones set to 0, samples averaged."""
    hit = surface.triangle >= 0
    corners = np.maximum(colors, 0.0)[np.asarray(faces)[surface.triangle[hit]]]
    u, v = surface.barycentrics[hit].T
    share = np.stack([1.0 - u - v, u, v], axis=-1)
    image = np.broadcast_to(np.asarray(background, np.float32), (*hit.shape, 3)).copy()
    image[hit] = np.einsum("nk,nkc->nc", share, corners)
    n = surface.samples_per_axis
    return image.reshape(hit.shape[0] // n, n, hit.shape[1] // n, n, 3).mean(axis=(1, 3))


def environment_background(
    surface: VisibleSurface, environment: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "hs ws 3"]:
    """Radiance of a latitude-longitude map along the ray of each sample (bilinear, wrapping around)."""
    x, y, z = np.moveaxis(surface.directions, -1, 0)
    h, w = environment.shape[:2]
    row = np.arccos(np.clip(y, -1.0, 1.0)) / np.pi * h - 0.5
    column = (np.arctan2(x, -z) / (2 * np.pi) + 0.5) * w - 0.5
    where = np.stack([np.clip(row, 0, h - 1), column])
    channels = [map_coordinates(environment[..., c], where, order=1, mode="grid-wrap") for c in range(3)]
    return np.stack(channels, axis=-1)


def render_vertex_colors(
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "t 3"],
    colors: Float[np.ndarray, "v 3"],
    camera: Camera,
    *,
    height: int,
    width: int,
    samples_per_axis: int = 2,
    background: tuple[float, float, float] | Float[np.ndarray, "eh ew 3"] = (0.0, 0.0, 0.0),
) -> Float[np.ndarray, "h w 3"]:
    """Draws a mesh with a color per vertex.

    Args:
      colors: linear radiance.
      background: one color, or a latitude-longitude map.
    """
    surface = visible_surface(positions, faces, camera, height=height, width=width, samples_per_axis=samples_per_axis)
    if isinstance(background, np.ndarray) and background.ndim == 3:
        background = environment_background(surface, background)
    return color_surface(surface, faces, colors, background)
