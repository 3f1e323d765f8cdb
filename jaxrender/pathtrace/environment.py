"""Light from infinitely far away: a latitude-longitude image, drawn from by brightness.

Rows and columns are those of `latlong`. As a light, a texel has one radiance all over, so that densities are exact.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrender.checks import bad_input
from jaxrender.latlong import solid_angles, to_angles, to_direction
from jaxrender.vec3 import Scalar, Vec3, from_array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Environment:
    """Radiance from all around, and tables to draw directions from it.

    Attributes:
      radiance: linear RGB, row by row; density: per solid angle, 0 where it is black.
      rows: cumulative probability of the rows; columns: of the columns within each row.
    """

    radiance: Float[Array, "h w 3"]
    density: Float[Array, "h w"]
    rows: Float[Array, " h"]
    columns: Float[Array, "h w"]


class FarLight(NamedTuple):
    """Light from a direction: radiance, and the density per solid angle with which `draw_direction` finds it."""

    direction: Vec3
    radiance: Vec3
    density: Scalar


def make_environment(image: Float[np.ndarray, "h w 3"]) -> Environment:
    """Tables of an image, on the host. Texels are drawn by mean radiance times solid angle.

    Raises:
      InputError: if the image has another shape, or holds what is not finite or below 0.
    """
    image = np.asarray(image, np.float32)
    if image.ndim != 3 or image.shape[-1] != 3 or 0 in image.shape:
        bad_input("environment", "shape", expected="(h, w, 3)", got=image.shape)
    lost, negative = ~np.isfinite(image), image < 0.0
    if lost.any() or negative.any():
        got = f"{lost.sum()} NaN or Inf and {(negative & ~lost).sum()} negative ones"
        bad_input("environment", "radiance", expected="finite numbers >= 0", got=got)
    height, width = image.shape[:2]
    solid = solid_angles(height, width)[:, None]
    power = image.astype(np.float64).mean(axis=-1) * solid
    black = power.sum() == 0.0
    power = np.broadcast_to(solid, power.shape) if black else power
    of_row = power.sum(axis=1)
    rows = (np.cumsum(of_row) / of_row.sum()).astype(np.float32)
    columns = np.cumsum(np.where(of_row[:, None] > 0.0, power, 1.0), axis=1)
    columns = (columns / columns[:, -1:]).astype(np.float32)
    # The probabilities that the rounded tables give, not those that were meant.
    share = np.diff(rows, prepend=np.float32(0.0))[:, None] * np.diff(columns, axis=1, prepend=np.float32(0.0))
    return Environment(*(jnp.asarray(x, jnp.float32) for x in (image, share / solid, rows, columns)))


def texel_of(environment: Environment, direction: Vec3) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
    """Row and column of a unit direction."""
    height, width = environment.density.shape
    theta, phi = to_angles(direction)
    row = jnp.clip((theta * (height / math.pi)).astype(jnp.int32), 0, height - 1)
    column = jnp.clip(((phi + math.pi) * (width / (2.0 * math.pi))).astype(jnp.int32), 0, width - 1)
    return row, column


def look_up(environment: Environment, direction: Vec3) -> FarLight:
    """Radiance from a unit direction."""
    return _at(environment, direction, *texel_of(environment, direction))


def draw_direction(environment: Environment, u: Scalar, v: Scalar) -> FarLight:
    """A direction by brightness, from two uniform numbers in [0, 1)."""
    height, width = environment.density.shape
    row = _found(lambda i: environment.rows[i], u, height)
    column = _found(lambda i: environment.columns[row, i], v, width)
    # What is left of the numbers, within the texel.
    below = jnp.where(row > 0, environment.rows[jnp.maximum(row - 1, 0)], 0.0)
    left = jnp.where(column > 0, environment.columns[row, jnp.maximum(column - 1, 0)], 0.0)
    du = jnp.clip((u - below) / jnp.maximum(environment.rows[row] - below, 1e-12), 0.0, 1.0)
    dv = jnp.clip((v - left) / jnp.maximum(environment.columns[row, column] - left, 1e-12), 0.0, 1.0)
    top, bottom = (jnp.cos((row + i).astype(u.dtype) * (math.pi / height)) for i in (0, 1))
    y = top + (bottom - top) * du
    phi = (column.astype(v.dtype) + dv) * (2.0 * math.pi / width) - math.pi
    return _at(environment, to_direction(y, phi), row, column)


def _at(environment: Environment, direction: Vec3, row: Int[Array, "*b"], column: Int[Array, "*b"]) -> FarLight:
    texel = environment.radiance[row, column]
    return FarLight(direction, from_array(texel), environment.density[row, column])


def _found(table, u: Scalar, size: int) -> Int[Array, "*b"]:
    """The first index at which the table is above u, by halving."""
    low, high = jnp.zeros(u.shape, jnp.int32), jnp.full(u.shape, size - 1, jnp.int32)
    for _ in range(max(1, (size - 1).bit_length())):
        middle = (low + high) // 2
        above = table(middle) > u
        low, high = jnp.where(above, low, jnp.minimum(middle + 1, high)), jnp.where(above, middle, high)
    return high
