"""Where a ray meets the plane of a triangle; pointwise, on any leading axes, differentiable."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender.vecmath import dot, safe_div


def hit_parameters(
    corners: Float[Array, "*b 3 3"], origins: Float[Array, "*b 3"], directions: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b 2"]]:
    """t and (u, v) with o + t d = (1 - u - v) a + u b + v c for the corners (a, b, c) of a triangle that is known.

    With n = (b - a) × (c - a) and q = o + t d - a: t = n·(a - o) / n·d, u = (q × (c - a))·n / n·n,
    v = ((b - a) × q)·n / n·n. Smooth in all arguments, also past the triangle's edges: these are the derivatives of a
    hit whose triangle stays the same. Which triangle it is has no derivative.

    t is 0 where the ray is parallel to the plane, and u and v are 0 for a triangle without area; so are the gradients.
    """
    a = corners[..., 0, :]
    ab, ac = corners[..., 1, :] - a, corners[..., 2, :] - a
    n = jnp.cross(ab, ac)
    t = safe_div(dot(n, a - origins), dot(n, directions))
    q = (origins - a) + t * directions
    area = dot(n, n)
    u, v = safe_div(dot(jnp.cross(q, ac), n), area), safe_div(dot(jnp.cross(ab, q), n), area)
    return t[..., 0], jnp.concatenate([u, v], axis=-1)
