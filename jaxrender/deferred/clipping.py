"""Clip-space triangles -> triangles that can be projected and snapped: in front of the eye, inside the guard band.

Clip space is that of Direct3D, Vulkan and WebGPU: visible where -w <= x, y <= w and 0 <= z <= w. Only triangles that
cross the near plane or leave the guard band are cut; what is left of them is a fan of up to six. The far plane is a
depth test a sample.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.vecmath import safe_div

# Pixels from the middle of the image that snapped coordinates can hold.
GUARD_PX = 8192
#: A triangle cut by five planes has at most eight corners, hence six triangles.
FAN = 6
_CORNERS = FAN + 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ClippedTriangles:
    """n clip-space triangles: t as they came, then `FAN` for each of those that had to be cut.

    Attributes:
      clip: corner positions.
      weights: barycentrics of the corners in the triangle they were cut from; rows of the identity for the first t.
      source: the triangle each one is, or was cut from.
      order: the order to draw them in, which is that of their sources.
      valid: False where there is nothing to draw.
    """

    clip: Float[Array, "n 3 4"]
    weights: Float[Array, "n 3 3"]
    source: Int[Array, " n"]
    order: Int[Array, " n"]
    valid: Bool[Array, " n"]


def _planes(*, height: int, width: int) -> Float[np.ndarray, "5 4"]:
    """The near plane and the four sides of the guard band; a point is inside where plane · point >= 0."""
    # A pixel inside, so that rounding in the projection stays inside too.
    gx, gy = (2.0 * (GUARD_PX - 1) / max(size, 1) for size in (width, height))
    return np.array([[0, 0, 1, 0], [-1, 0, 0, gx], [1, 0, 0, gx], [0, -1, 0, gy], [0, 1, 0, gy]], np.float32)


def sort_out(
    clip: Float[Array, "v 4"], faces: Int[Array, "t 3"], *, height: int, width: int
) -> tuple[Bool[Array, " t"], Bool[Array, " t"]]:
    """Which triangles can be drawn as they are, and which have to be cut first.

    Triangles with a corner that is not finite, and those wholly outside one plane of the picture, are neither.

    References:
      Outcodes: Newman, Sproull, "Principles of Interactive Computer Graphics", 1973 (Cohen, Sutherland).
    """
    planes = _planes(height=height, width=width)
    x, y, z, w = (clip[:, i] for i in range(4))
    sides = [w - x < 0.0, w + x < 0.0, w - y < 0.0, w + y < 0.0, z < 0.0, w - z < 0.0]
    guard = [~(x * p[0] + y * p[1] + z * p[2] + w * p[3] >= 0.0) for p in planes] + [~(w > 0.0)]
    bits = [*sides, *guard, ~jnp.isfinite(clip).all(axis=1)]
    codes = functools.reduce(jnp.bitwise_or, [jnp.asarray(bit, jnp.int32) << k for k, bit in enumerate(bits)])
    a, b, c = (codes[faces[:, k]] for k in range(3))
    of_sides, of_guard = (1 << len(sides)) - 1, ((1 << len(guard)) - 1) << len(sides)
    every, some = a & b & c, a | b | c
    seen = (every & of_sides == 0) & (some >> (len(sides) + len(guard)) == 0)
    whole = some & of_guard == 0
    return seen & whole, seen & ~whole


def clip_triangles(
    clip: Float[Array, "v 4"], faces: Int[Array, "t 3"], *, height: int, width: int, max_clipped: int
) -> tuple[ClippedTriangles, Int[Array, ""]]:
    """Cuts the triangles that need it.

    Args:
      max_clipped: room for so many triangles to be cut.
    Returns:
      the triangles, and how many there were to cut; those beyond `max_clipped` are left out.
    References:
      Sutherland, Hodgman, "Reentrant Polygon Clipping", 1974.
    """
    corners = clip[faces]
    whole, cut = sort_out(clip, faces, height=height, width=width)
    num_triangles = len(faces)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=clip.dtype), (num_triangles, 3, 3))
    every = jnp.arange(num_triangles, dtype=jnp.int32)
    (which,) = jnp.nonzero(cut, size=max_clipped, fill_value=num_triangles)
    some = corners.at[which].get(mode="fill", fill_value=0.0)
    fans, valid = jax.vmap(lambda c: _fan(c, height=height, width=width))(some)
    valid &= (which < num_triangles)[:, None]
    source = jnp.broadcast_to(which.astype(jnp.int32)[:, None], valid.shape)
    together = ClippedTriangles(
        clip=jnp.concatenate([corners, fans[..., :4].reshape(-1, 3, 4)]),
        weights=jnp.concatenate([identity, fans[..., 4:].reshape(-1, 3, 3)]),
        source=jnp.concatenate([every, source.reshape(-1)]),
        order=_draw_order(cut, which),
        valid=jnp.concatenate([whole, valid.reshape(-1)]),
    )
    return together, jnp.sum(cut)


def _draw_order(cut: Bool[Array, " t"], which: Int[Array, " k"]) -> Int[Array, " n"]:
    """Every triangle as it came, followed by its fan if it was cut; fans without a triangle come last."""
    (t,), (k,) = cut.shape, which.shape
    earlier = jnp.cumsum(cut) - cut.astype(jnp.int32)
    fans = which + (which < t).astype(jnp.int32) + FAN * jnp.arange(k)
    place = jnp.concatenate(
        [jnp.arange(t) + FAN * jnp.minimum(earlier, k), (fans[:, None] + jnp.arange(FAN)[None]).reshape(-1)]
    )
    return jnp.zeros(t + FAN * k, jnp.int32).at[place].set(jnp.arange(t + FAN * k, dtype=jnp.int32))


def _fan(corners: Float[Array, "3 4"], *, height: int, width: int):
    """Corners and barycentrics (7 numbers) of the triangles that one is cut into, and which of them there are."""
    start = jnp.concatenate([corners, jnp.eye(3, dtype=corners.dtype)], axis=1)
    polygon = jnp.zeros((_CORNERS, 7), corners.dtype).at[:3].set(start)
    planes = jnp.asarray(_planes(height=height, width=width), corners.dtype)
    step = lambda state, plane: (_cut(state[0], state[1], plane), None)  # noqa: E731
    (polygon, count), _ = jax.lax.scan(step, (polygon, jnp.int32(3)), planes)
    fan = np.stack([np.zeros(FAN, int), np.arange(1, FAN + 1), np.arange(2, FAN + 2)], axis=1)
    return polygon[fan], jnp.arange(FAN) < count - 2


def _cut(polygon: Float[Array, "c 7"], count: Int[Array, ""], plane: Float[Array, "4"]):
    """The part of a convex polygon of `count` corners that is inside one plane, and its number of corners."""
    corner = jnp.arange(_CORNERS)
    following = jnp.where(corner + 1 < count, corner + 1, 0)
    distance = jnp.sum(polygon[:, :4] * plane[None], axis=1)
    inside, real = distance >= 0.0, corner < count
    leaves_or_enters = real & (inside != inside[following])
    # From the inner end always, so that two triangles that share an edge cut it at the same point, to the bit.
    inner, outer = jnp.where(inside, corner, following), jnp.where(inside, following, corner)
    t = safe_div(distance[inner], distance[inner] - distance[outer])[:, None]
    crossing = polygon[inner] + t * (polygon[outer] - polygon[inner])
    kept = (real & inside).astype(jnp.int32)
    emitted = kept + leaves_or_enters.astype(jnp.int32)
    place = jnp.cumsum(emitted) - emitted
    result = jnp.zeros_like(polygon).at[jnp.where(kept > 0, place, _CORNERS)].set(polygon, mode="drop")
    result = result.at[jnp.where(leaves_or_enters, place + kept, _CORNERS)].set(crossing, mode="drop")
    return result, jnp.sum(emitted, dtype=jnp.int32)
