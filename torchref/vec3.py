"""Three-vectors as three tensors, as `jaxrender.vec3` keeps them; inside, a last axis of 3."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchref import vecmath
from torchref._precision import in_float64

Scalar = Float[Tensor, "*b"]


class Vec3(NamedTuple):
    """x, y, z, or red, green, blue."""

    x: Scalar
    y: Scalar
    z: Scalar


def from_array(values: Float[Tensor, "*b 3"]) -> Vec3:
    """The components along the last axis."""
    return Vec3(*values.unbind(dim=-1))


def to_array(v: Vec3) -> Float[Tensor, "*b 3"]:
    """A last axis of x, y, z."""
    return torch.stack(torch.broadcast_tensors(*v), dim=-1)


@in_float64
def dot(a: Vec3, b: Vec3) -> Scalar:
    """Inner product."""
    return vecmath.dot(to_array(a), to_array(b))[..., 0]


@in_float64
def cross(a: Vec3, b: Vec3) -> Vec3:
    """Vector product."""
    return from_array(torch.linalg.cross(to_array(a), to_array(b)))


@in_float64
def length(v: Vec3) -> Scalar:
    """|v|, with slope 0 at 0."""
    return vecmath.safe_sqrt((to_array(v) ** 2).sum(-1))


@in_float64
def normalize(v: Vec3) -> Vec3:
    """v / |v|, and 0 for 0."""
    return from_array(vecmath.normalize(to_array(v)))


@in_float64
def where(condition: Bool[Tensor, "*b"], a: Vec3, b: Vec3 | float) -> Vec3:
    """a where the condition holds, else b."""
    other = to_array(b) if isinstance(b, Vec3) else b
    return from_array(torch.where(condition[..., None], to_array(a), other))


@in_float64
def reflect(v: Vec3, n: Vec3) -> Vec3:
    """v turned by half a circle about the unit vector n: (2 n nᵀ - 1) v."""
    axis = to_array(n)
    turn = 2.0 * axis[..., :, None] * axis[..., None, :] - torch.eye(3, dtype=axis.dtype)
    return from_array(torch.einsum("...ij,...j->...i", turn, to_array(v)))


@in_float64
def largest(v: Vec3) -> Scalar:
    """The largest component."""
    return to_array(v).amax(dim=-1)


@in_float64
def mean(v: Vec3) -> Scalar:
    """The mean of the components."""
    return to_array(v).mean(dim=-1)


@in_float64
def tangents(n: Vec3) -> tuple[Vec3, Vec3]:
    """What the shortest rotation of the nearer pole into n makes of x, and the vector that completes the frame."""
    first = vecmath.orthonormal_tangent(to_array(n))
    return from_array(first), from_array(torch.linalg.cross(to_array(n), first))
