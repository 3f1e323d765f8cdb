"""Three-vectors as three arrays (structure of arrays), for kernels that run over many points.

A vector instruction then works on eight points at a time. With the components in a last axis of 3 it would work on x, y
and z of one, and sums over that axis would not be vectorised at all. Colors are kept the same way.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Scalar = Float[Array, "*b"]


class Vec3(NamedTuple):
    """x, y, z (or red, green, blue) of any shape; arithmetic is by component, with a `Vec3` or a scalar field."""

    x: Scalar
    y: Scalar
    z: Scalar

    def __add__(self, other: "Vec3 | Scalar | float") -> "Vec3":  # type: ignore[override]
        o = _of(other)
        return Vec3(self.x + o.x, self.y + o.y, self.z + o.z)

    def __sub__(self, other: "Vec3 | Scalar | float") -> "Vec3":
        o = _of(other)
        return Vec3(self.x - o.x, self.y - o.y, self.z - o.z)

    def __mul__(self, other: "Vec3 | Scalar | float") -> "Vec3":  # type: ignore[override]
        o = _of(other)
        return Vec3(self.x * o.x, self.y * o.y, self.z * o.z)

    def __truediv__(self, other: "Vec3 | Scalar | float") -> "Vec3":
        o = _of(other)
        return Vec3(self.x / o.x, self.y / o.y, self.z / o.z)

    def __neg__(self) -> "Vec3":
        return Vec3(-self.x, -self.y, -self.z)

    def __radd__(self, other: Scalar | float) -> "Vec3":
        return self + other

    def __rmul__(self, other: Scalar | float) -> "Vec3":  # type: ignore[override]
        return self * other

    def __rsub__(self, other: Scalar | float) -> "Vec3":
        return -self + other


def _of(value: Vec3 | Scalar | float) -> Vec3:
    return value if isinstance(value, Vec3) else Vec3(value, value, value)  # type: ignore[arg-type]


def from_array(values: Float[Array, "*b 3"]) -> Vec3:
    """The components along the last axis, apart."""
    return Vec3(values[..., 0], values[..., 1], values[..., 2])


def to_array(v: Vec3) -> Float[Array, "*b 3"]:
    """The components side by side in a last axis."""
    return jnp.stack(v, axis=-1)


def dot(a: Vec3, b: Vec3) -> Scalar:
    """Inner product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Vector product."""
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def length(v: Vec3) -> Scalar:
    """|v|; its gradient at 0 is 0."""
    squared = dot(v, v)
    some = squared > 0.0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)


def normalize(v: Vec3) -> Vec3:
    """v / |v|; the zero vector, and its gradient, stay 0."""
    squared = dot(v, v)
    some = squared > 0.0
    return v * jnp.where(some, 1.0 / jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)


def where(condition: Bool[Array, "*b"], a: Vec3, b: Vec3 | float) -> Vec3:
    """a where the condition holds, b elsewhere."""
    o = _of(b)
    return Vec3(*(jnp.where(condition, p, q) for p, q in zip(a, o, strict=True)))


def reflect(v: Vec3, n: Vec3) -> Vec3:
    """The mirror image of v about the unit vector n: 2 (n·v) n - v."""
    return n * (2.0 * dot(n, v)) - v


def largest(v: Vec3) -> Scalar:
    """The largest component."""
    return jnp.maximum(jnp.maximum(v.x, v.y), v.z)


def mean(v: Vec3) -> Scalar:
    """The mean of the components."""
    return (v.x + v.y + v.z) / 3.0


def tangents(n: Vec3) -> tuple[Vec3, Vec3]:
    """Two unit vectors that form a right-handed frame with the unit vector n as its third.

    References:
      Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017, listing 3.
    """
    sign = jnp.where(n.z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n.z)
    b = n.x * n.y * a
    return Vec3(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), Vec3(b, sign + n.y * n.y * a, -n.y)
