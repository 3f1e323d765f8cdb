"""Light from infinitely far away, texel by texel of a latitude-longitude image."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.latlong import solid_angles, to_angles, to_direction
from torchref.vec3 import Scalar, Vec3, from_array


@dataclass(frozen=True)
class Environment:
    """Radiance, probability over solid angle, and cumulative probabilities of rows and of columns within rows."""

    radiance: Float[Tensor, "h w 3"]
    density: Float[Tensor, "h w"]
    rows: Float[Tensor, " h"]
    columns: Float[Tensor, "h w"]


class FarLight(NamedTuple):
    """Radiance from a direction, and the density per solid angle of drawing it."""

    direction: Vec3
    radiance: Vec3
    density: Scalar


@in_float64
def make_environment(image: Float[np.ndarray, "h w 3"]) -> Environment:
    """The chance of a texel is its share of Σ mean radiance · solid angle; of a black image, that of the sphere."""
    image = torch.as_tensor(image)
    height, width = image.shape[:2]
    solid = solid_angles(height, width)[:, None].expand(height, width)
    weight = image.mean(dim=-1) * solid
    if not weight.any():
        weight = solid
    chance = weight / weight.sum()
    # Where a row is black, any table will do.
    inside = torch.where(weight.sum(dim=1, keepdim=True) > 0.0, weight, solid)
    columns = inside.cumsum(dim=1) / inside.sum(dim=1, keepdim=True)
    return Environment(image, chance / solid, chance.sum(dim=1).cumsum(dim=0), columns)


def texel_of(environment: Environment, direction: Vec3) -> tuple[Int[Tensor, "*b"], Int[Tensor, "*b"]]:
    """The texel in whose ranges of polar angle and azimuth a direction lies."""
    height, width = environment.density.shape
    polar, azimuth = to_angles(Vec3(*(c.double() for c in direction)))
    row = torch.floor(polar / math.pi * height).clamp(0, height - 1)
    column = torch.floor((azimuth / (2.0 * math.pi) + 0.5) * width).clamp(0, width - 1)
    return row.int(), column.int()


@in_float64
def look_up(environment: Environment, direction: Vec3) -> FarLight:
    """Radiance and density of the texel."""
    return _far_light(environment, direction, *texel_of(environment, direction))


@in_float64
def draw_direction(environment: Environment, u: Scalar, v: Scalar) -> FarLight:
    """Inverts the distribution of rows, then that of the columns of the row; uniform in solid angle within a texel."""
    height, width = environment.density.shape
    rows, columns, places = [], [], []
    for a, b in zip(u.flatten(), v.flatten(), strict=True):
        row, down = _inverted(environment.rows, a)
        column, across = _inverted(environment.columns[row], b)
        top, bottom = (math.cos((row + i) * math.pi / height) for i in (0, 1))
        azimuth = ((column + across) / width - 0.5) * 2.0 * math.pi
        places.append(torch.stack(to_direction((1.0 - down) * top + down * bottom, azimuth)))
        rows.append(row)
        columns.append(column)
    direction = from_array(torch.stack(places).reshape(*u.shape, 3))
    row, column = (torch.tensor(x).reshape(u.shape) for x in (rows, columns))
    return _far_light(environment, direction, row, column)


def _far_light(environment: Environment, direction: Vec3, row: Tensor, column: Tensor) -> FarLight:
    row, column = row.long(), column.long()
    return FarLight(direction, from_array(environment.radiance[row, column]), environment.density[row, column])


def _inverted(cumulative: Float[Tensor, " k"], u: Tensor) -> tuple[int, Tensor]:
    """The first step of a distribution that ends above u, and what part of it lies below u."""
    index = int((cumulative > u).double().argmax())
    begin = cumulative[index - 1] if index else torch.zeros_like(u)
    return index, (u - begin) / (cumulative[index] - begin)
