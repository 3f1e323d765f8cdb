"""Which triangles a ray meets, without gaps between neighbours; pointwise, on any leading axes.

The triangle is sheared along the ray into a plane, where the ray is the origin; it is met if the origin is on one side
of all three edges. Rounding may move an edge a little, but moves it alike for the two triangles that share it, provided
that both see its ends in one order: corners have to come sorted by an order of the vertices that all triangles share.

References:
  Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender.vecmath import safe_div


def ray_plane_axes(directions: Float[Array, "*b 3"]) -> Float[Array, "*b 2 3"]:
    """Two vectors that are orthogonal to each direction: coordinates in a plane, by a shear along the ray.

    Each is an axis minus its multiple of the axis k of the largest component, e_i - (d_i / d_k) e_k. Zero directions
    have two axes.
    """
    largest = jnp.argmax(jnp.abs(directions), axis=-1)[..., None]
    along = jnp.arange(3).reshape((1,) * (directions.ndim - 1) + (3,))
    k, i, j = (((along - largest) % 3 == n).astype(directions.dtype) for n in range(3))
    slopes = safe_div(directions, jnp.sum(directions * k, axis=-1, keepdims=True) * jnp.ones_like(directions))
    across = [axis - jnp.sum(slopes * axis, axis=-1, keepdims=True) * k for axis in (i, j)]
    return jnp.stack(across, axis=-2)


def hit_distance(
    corners: Float[Array, "*b 3 3"],
    origins: Float[Array, "*b 3"],
    directions: Float[Array, "*b 3"],
    plane_axes: Float[Array, "*b 2 3"],
) -> Float[Array, "*b"]:
    """t of the hit point origin + t · direction, and inf where the line misses; t < 0 is behind the origin.

    Both sides of a triangle count. One without area is never met, nor is one seen exactly edge-on.

    Args:
      corners: sorted by an order that all triangles of the mesh share (see above).
      plane_axes: `ray_plane_axes(directions)`.
    """
    a, b, c = ([corners[..., n, axis] - origins[..., axis] for axis in range(3)] for n in range(3))
    d = [directions[..., axis] for axis in range(3)]
    sheared = [[_inner([plane_axes[..., row, axis] for axis in range(3)], p) for row in range(2)] for p in (a, b, c)]
    ab, ac, bc = (_side(sheared[i], sheared[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    met = ((ab >= 0) & (bc >= 0) & (ac <= 0)) | ((ab <= 0) & (bc <= 0) & (ac >= 0))
    met &= (ab != 0) | (bc != 0) | (ac != 0)
    # From the plane: a sum over corners, weighted by the sides, has a hundred times the error at grazing angles.
    normal = _cross([q - p for p, q in zip(a, b, strict=True)], [q - p for p, q in zip(a, c, strict=True)])
    across = _inner(normal, d)
    met &= across != 0
    return jnp.where(met, _inner(normal, a) / jnp.where(met, across, 1.0), jnp.inf)


def _side(p: list, q: list) -> Array:
    return p[0] * q[1] - p[1] * q[0]


def _inner(p: list, q: list) -> Array:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def _cross(p: list, q: list) -> list:
    return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]
