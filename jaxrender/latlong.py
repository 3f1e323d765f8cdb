"""Latitude-longitude images of all directions: row 0 is the zenith (+Y), the middle looks down -Z, columns turn to +X.

Tables are NumPy in float64; the rest is pointwise and differentiable but at the poles.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.vec3 import Scalar, Vec3


def environment_directions(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (h, w, 3) of the pixel centres of an image and their solid angles (h, w), exact and 4π in all."""
    theta, phi = (np.arange(height) + 0.5) * (math.pi / height), azimuths(width)
    solid = np.repeat(solid_angles(height, width)[:, None], width, axis=1)
    s, c = np.sin(theta)[:, None], np.cos(theta)[:, None]
    parts = np.broadcast_arrays(s * np.sin(phi), c, -s * np.cos(phi))
    return np.stack(parts, axis=-1), solid


def azimuths(width: int) -> np.ndarray:
    """Of the middles of columns (w), in radians from -Z towards +X, ascending from -π."""
    return (np.arange(width) + 0.5) * (2 * math.pi / width) - math.pi


def solid_angles(height: int, width: int) -> np.ndarray:
    """Of one pixel of each row (h), by differences of cosines."""
    edges = np.cos(np.arange(height + 1) * (math.pi / height))
    return (edges[:-1] - edges[1:]) * (2 * math.pi / width)


def to_angles(direction: Vec3) -> tuple[Scalar, Scalar]:
    """Polar angle from +Y in [0, π], and azimuth from -Z towards +X in [-π, π], of a unit direction."""
    return jnp.arccos(jnp.clip(direction.y, -1.0, 1.0)), jnp.arctan2(direction.x, -direction.z)


def to_direction(cosine: Scalar, azimuth: Scalar) -> Vec3:
    """The unit direction of a cosine of the polar angle, in [-1, 1], and of an azimuth."""
    radius = jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 0.0))
    return Vec3(radius * jnp.sin(azimuth), cosine, -radius * jnp.cos(azimuth))


def look_up_smoothly(image: Float[Array, "h w c"], direction: Vec3) -> Float[Array, "*b c"]:
    """What an image shows in unit directions: bilinear between the middles of pixels, closed around.

    Differentiable in the image.
    """
    height, width = image.shape[:2]
    theta, phi = to_angles(direction)
    down = jnp.clip(theta * (height / math.pi) - 0.5, 0.0, height - 1.0)
    across = (phi + math.pi) * (width / (2.0 * math.pi)) - 0.5
    row, column = jnp.floor(down), jnp.floor(across)
    shares = (down - row)[..., None], (across - column)[..., None]
    row, column = row.astype(jnp.int32), column.astype(jnp.int32)
    total = jnp.zeros((*theta.shape, image.shape[2]), image.dtype)
    for below in (0, 1):
        for right in (0, 1):
            pixel = image[jnp.minimum(row + below, height - 1), (column + right) % width]
            share = (shares[0] if below else 1.0 - shares[0]) * (shares[1] if right else 1.0 - shares[1])
            total = total + pixel * share
    return total
