"""Vertex colors to an image by first-hit rays, the stand-in for a rasteriser: what `fitting` draws its pictures with.

Works on one image; NumPy in, NumPy out, not differentiable. The rays of a pose are cast once (`visible_surface`);
coloring it anew, under a light that turns say, costs no ray.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter, map_coordinates

from jaxrender.camera import Camera, camera_rays
from jaxrender.checks import check_at_least
from jaxrender.pathtrace.embree import EmbreeScene


@dataclass(frozen=True)
class VisibleSurface:
    """What an image shows of a mesh: for each sample the face (-1: nothing) and where on it.

    A pixel has samples_per_axis² samples in a regular grid; the samples of an image form one of that many rows and
    columns more, row 0 on top. `barycentrics` are (u, v): the point is (1 - u - v) a + u b + v c.
    """

    triangle: Int[np.ndarray, "hs ws"]
    barycentrics: Float[np.ndarray, "hs ws 2"]
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
    """Casts one ray per sample. Both sides of a face are seen."""
    check_at_least("samples_per_axis", samples_per_axis, 1)
    size = height * samples_per_axis, width * samples_per_axis
    # About the eye, so that Embree's single precision does not suffer far from the origin.
    _, directions = camera_rays(camera, height=size[0], width=size[1])
    eye = np.asarray(camera.eye, np.float64)
    scene = EmbreeScene(np.asarray(positions, np.float64) - eye, faces)
    rays = np.ascontiguousarray(np.asarray(directions, np.float32).reshape(-1, 3))
    hits = scene.closest_hit(np.zeros_like(rays), rays)
    return VisibleSurface(hits.triangle.reshape(size), hits.barycentrics.reshape(*size, 2), samples_per_axis)


def color_surface(
    surface: VisibleSurface, faces: Int[np.ndarray, "t 3"], colors: Float[np.ndarray, "v c"]
) -> tuple[Float[np.ndarray, "h w c"], Float[np.ndarray, "h w"]]:
    """The surface with a color per vertex, linear over each face, and the share of each pixel that it covers.

    Colors below 0, which order-4 light can leave, are set to 0 first.

    Returns:
      the mean color over all samples of a pixel, with 0 where nothing is hit (premultiplied), and the coverage.
    """
    hit = surface.triangle >= 0
    corners = np.maximum(np.asarray(colors, np.float32), 0.0)[np.asarray(faces)[surface.triangle[hit]]]
    u, v = surface.barycentrics[hit].T
    share = np.stack([1.0 - u - v, u, v], axis=-1)
    samples = np.zeros((*hit.shape, corners.shape[-1]), np.float32)
    samples[hit] = np.sum(share[:, :, None] * corners, axis=1)
    return _mean_of_samples(samples, surface.samples_per_axis), coverage(surface)


def coverage(surface: VisibleSurface) -> Float[np.ndarray, "h w"]:
    """The share of each pixel that shows the mesh, 0 to 1."""
    covered = (surface.triangle >= 0).astype(np.float32)[..., None]
    return _mean_of_samples(covered, surface.samples_per_axis)[..., 0]


def _mean_of_samples(samples: np.ndarray, n: int) -> np.ndarray:
    h, w, c = samples.shape
    return samples.reshape(h // n, n, w // n, n, c).mean(axis=(1, 3))


def lay_over(
    image: Float[np.ndarray, "h w c"], alpha: Float[np.ndarray, "h w"], background: Float[np.ndarray, "h w c"]
) -> Float[np.ndarray, "h w c"]:
    """A premultiplied image over a background."""
    return image + (1.0 - alpha[..., None]) * background


def gradient_background(
    height: int, width: int, *, top: tuple[float, float, float], bottom: tuple[float, float, float]
) -> Float[np.ndarray, "h w 3"]:
    """One color that goes over into another from the top row to the bottom row."""
    share = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    blend = (1.0 - share) * np.array(top, np.float32) + share * np.array(bottom, np.float32)
    return np.broadcast_to(blend, (height, width, 3)).copy()


def blur_environment(environment: Float[np.ndarray, "h w c"], *, degrees: float) -> Float[np.ndarray, "h w c"]:
    """A latitude-longitude map smoothed by a Gaussian of this standard deviation at its equator, closed around."""
    sigma = degrees / 180.0 * environment.shape[0]
    return gaussian_filter(environment, (sigma, sigma, 0.0), mode=("nearest", "wrap", "nearest"))


def environment_background(
    environment: Float[np.ndarray, "eh ew 3"], camera: Camera, *, height: int, width: int
) -> Float[np.ndarray, "h w 3"]:
    """What the camera sees of a latitude-longitude map: bilinear in the map, which closes around.

    Args:
      environment: row 0 is +Y, the middle looks down -Z, columns turn towards +X.
    """
    _, directions = camera_rays(camera, height=height, width=width)
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    eh, ew = environment.shape[:2]
    row = np.arccos(np.clip(y, -1.0, 1.0)) / np.pi * eh - 0.5
    column = (np.arctan2(x, -z) / (2 * np.pi) + 0.5) * ew - 0.5
    where = np.stack([np.clip(row, 0, eh - 1), column])
    channels = [map_coordinates(c, where, order=1, mode="grid-wrap") for c in np.moveaxis(environment, -1, 0)]
    return np.stack(channels, axis=-1).astype(np.float32)


def render_vertex_colors(
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "t 3"],
    colors: Float[np.ndarray, "v 3"],
    camera: Camera,
    *,
    height: int,
    width: int,
    samples_per_axis: int = 2,
    background: tuple[float, float, float] | Float[np.ndarray, "h w 3"] = (0.0, 0.0, 0.0),
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Draws a mesh with a color per vertex, antialiased by samples_per_axis² rays a pixel.

    Args:
      colors: linear radiance; below 0 counts as 0.
      background: one color, or an image such as `environment_background` and `gradient_background` make.
    Returns:
      the linear image and the share of each pixel that the mesh covers.
    """
    surface = visible_surface(positions, faces, camera, height=height, width=width, samples_per_axis=samples_per_axis)
    image, alpha = color_surface(surface, faces, colors)
    behind = np.broadcast_to(np.asarray(background, np.float32), image.shape)
    return lay_over(image, alpha, behind), alpha
