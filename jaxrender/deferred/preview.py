"""A mesh with a color per vertex -> an image: what `fitting` draws its pictures with.

Works on one image; NumPy in, NumPy out, not differentiable. What is seen of a pose is found once (`visible_surface`);
coloring it anew, under a light that turns say, costs no rasterisation.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import gaussian_filter

from jaxrender.camera import Camera, camera_rays, clip_from_world, depth_range
from jaxrender.deferred.interpolate import interpolate
from jaxrender.deferred.raster import Fragments, rasterize
from jaxrender.deferred.samples import ordered_grid
from jaxrender.latlong import look_up_smoothly
from jaxrender.vec3 import from_array
from jaxrender.vecmath import matmul


def visible_surface(
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "t 3"],
    camera: Camera,
    *,
    height: int,
    width: int,
    samples_per_axis: int = 2,
) -> Fragments:
    """What an image shows of a mesh, in a regular grid of samples_per_axis² samples a pixel. Faces have two sides."""
    # About the eye, so that single precision does not suffer far from the origin.
    eye = np.asarray(camera.eye, np.float64)
    about = jnp.asarray(np.asarray(positions, np.float64) - eye, jnp.float32)
    ahead = jnp.asarray(np.asarray(camera.target, np.float64) - eye, jnp.float32)
    own = dataclasses.replace(camera, eye=jnp.zeros(3, jnp.float32), target=ahead)
    near, far = depth_range(own, about.min(axis=0), about.max(axis=0))
    matrix = clip_from_world(own, height=height, width=width, near=near, far=far)
    clip = matmul(jnp.pad(about, ((0, 0), (0, 1)), constant_values=1.0), matrix.T)
    return rasterize(clip, jnp.asarray(faces), height=height, width=width, samples=ordered_grid(samples_per_axis))


def color_surface(
    surface: Fragments, colors: Float[np.ndarray, "v c"]
) -> tuple[Float[np.ndarray, "h w c"], Float[np.ndarray, "h w"]]:
    """The surface with a color per vertex, linear over each face, and the share of each pixel that it covers.

    Colors below 0, which order-4 light can leave, are set to 0 first.

    Returns:
      the mean color over all samples of a pixel, with 0 where nothing is hit (premultiplied), and the coverage.
    """
    return np.asarray(_mean_color(surface, jnp.asarray(colors, jnp.float32))), coverage(surface)


@jax.jit
def _mean_color(surface: Fragments, colors: Float[Array, "v c"]) -> Float[Array, "h w c"]:
    return jnp.mean(interpolate(surface, jnp.maximum(colors, 0.0)), axis=2)


def coverage(surface: Fragments) -> Float[np.ndarray, "h w"]:
    """The share of each pixel that shows the mesh, 0 to 1."""
    return np.asarray(surface.coverage).mean(axis=-1, dtype=np.float32)


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
    return np.asarray(_look_up(jnp.asarray(environment, jnp.float32), from_array(directions)))


_look_up = jax.jit(look_up_smoothly)


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
    """Draws a mesh with a color per vertex, antialiased by samples_per_axis² samples a pixel.

    Args:
      colors: linear radiance; below 0 counts as 0.
      background: one color, or an image such as `environment_background` and `gradient_background` make.
    Returns:
      the linear image and the share of each pixel that the mesh covers.
    """
    surface = visible_surface(positions, faces, camera, height=height, width=width, samples_per_axis=samples_per_axis)
    image, alpha = color_surface(surface, colors)
    behind = np.broadcast_to(np.asarray(background, np.float32), image.shape)
    return lay_over(image, alpha, behind), alpha
