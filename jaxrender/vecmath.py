"""Vectors and frames on any leading axes, with finite values and gradients at zero.

Pointwise: every function takes `(..., 3)`. A division or root that could meet zero is guarded before
the operation (the bad input is swapped, then the result selected), so reverse-mode gradients stay finite.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Contractions in full float32. By default XLA may round their factors to the 10 bits of TF32 on a GPU, or to
# bfloat16 on a TPU, which would cost these kernels four of their seven digits.
einsum = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
matmul = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


def dot(a: Float[Array, "*#b 3"], b: Float[Array, "*#b 3"]) -> Float[Array, "*#b 1"]:
    """Inner product along the last axis, which is kept with size 1."""
    return jnp.sum(a * b, axis=-1, keepdims=True)


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """√x for x > 0 and 0 elsewhere; the gradient at x <= 0 is 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x))


def safe_div(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """a / b, and 0 where b is 0; the gradient there is 0 in b."""
    zero = b == 0
    return jnp.where(zero, jnp.zeros_like(b), a / jnp.where(zero, jnp.ones_like(b), b))


def normalize(v: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """v / |v| along the last axis; the zero vector, and its gradient, stay 0."""
    return safe_div(v, safe_sqrt(jnp.sum(v * v, axis=-1, keepdims=True)))


def orthonormal_tangent(n: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """A unit vector orthogonal to the unit vector n, without a branch on nearly equal components.

    Continuous except at n.z = 0, where the sign switches.

    References:
      Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017, listing 3.
    """
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    sign = jnp.where(z >= 0, jnp.ones_like(z), -jnp.ones_like(z))
    a = -1.0 / (sign + z)
    return jnp.stack([1.0 + sign * x * x * a, sign * x * y * a, -sign * x], axis=-1)


def frame_from_normal_tangent(normal: Float[Array, "*b 3"], tangent: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """World-from-local rotation whose columns are tangent, bitangent and normal (local z = normal).

    `tangent` is made orthogonal to the unit `normal` first; one that is parallel to it is replaced by
    `orthonormal_tangent(normal)`.
    """
    t = tangent - dot(tangent, normal) * normal
    lost = dot(t, t) <= 1e-12 * jnp.maximum(dot(tangent, tangent), 1e-30)
    t = normalize(jnp.where(lost, orthonormal_tangent(normal), t))
    # Once more: what is left of a nearly parallel tangent carries its rounding error enlarged.
    t = normalize(t - dot(t, normal) * normal)
    return jnp.stack([t, jnp.cross(normal, t), normal], axis=-1)


def reflection_frame(wo: Float[Array, "*b 3"], n: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """World-from-reflection rotation: local z is `wo` mirrored about the normal, 2(n·wo)n - wo.

    The azimuth is free, since the Phong operator commutes with rotations about z; it is the one of
    `orthonormal_tangent`.
    """
    r = normalize(2.0 * dot(n, wo) * n - wo)
    t = orthonormal_tangent(r)
    return jnp.stack([t, jnp.cross(r, t), r], axis=-1)


def constant_like(table: np.ndarray | Array, x: Float[Array, "..."]) -> Float[Array, "..."]:
    """A table as a constant of x's dtype, with leading axes of size 1 up to x's rank.

    Broadcasts are written out in this package; this is how a table of trailing axes meets an array of any
    rank.
    """
    constant = jnp.asarray(table, dtype=x.dtype)
    return constant.reshape((1,) * (x.ndim - constant.ndim) + constant.shape)
