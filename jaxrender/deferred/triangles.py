"""Clipped triangles -> screen triangles: projected, snapped to 1/256 px, wound one way, culled."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_one_of
from jaxrender.deferred.clipping import ClippedTriangles
from jaxrender.deferred.exact import cross_product, divide_by, to_float
from jaxrender.vecmath import safe_div

#: Snapped units in a pixel: 8 fractional bits.
SUBPIXELS = 256
CULLING = ("none", "back", "front")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScreenTriangles:
    """n triangles on the screen, corners ordered so that edge functions are positive inside (y down).

    Attributes:
      xy: snapped corners in 1/256 px from the middle of the image, x right and y down.
      z: window depth z/w of the corners, 0 at the near plane and 1 at the far plane.
      w: clip w of the corners; for a perspective camera their linear view depth.
      weights: barycentrics of the corners in the source triangle.
      area: twice the area in snapped units squared; 1 if there is none.
      source: the triangle of the mesh.
      order: the order to draw in.
      front: whether the source is seen from its counter-clockwise side.
      valid: False where there is nothing to draw.
    """

    xy: Int[Array, "n 3 2"]
    z: Float[Array, "n 3"]
    w: Float[Array, "n 3"]
    weights: Float[Array, "n 3 3"]
    area: Float[Array, " n"]
    source: Int[Array, " n"]
    order: Int[Array, " n"]
    front: Bool[Array, " n"]
    valid: Bool[Array, " n"]


def project_triangles(
    clipped: ClippedTriangles,
    *,
    height: int,
    width: int,
    cull: str = "none",
    drawn: Bool[Array, " t"] | None = None,
    two_sided: Bool[Array, " t"] | None = None,
) -> ScreenTriangles:
    """Viewport transform, snapping (round to nearest), winding and culling.

    Args:
      cull: "back" drops triangles that appear clockwise, "front" those that appear counter-clockwise.
      drawn: by triangle of the mesh, whether it is drawn at all; every one by default.
      two_sided: by triangle of the mesh, whether it is never culled.
    """
    check_one_of("cull", cull, CULLING)
    valid = clipped.valid
    corners = jnp.where(valid[:, None, None], clipped.clip, jnp.ones_like(clipped.clip))
    w = corners[..., 3]
    half = jnp.asarray([0.5 * width * SUBPIXELS, -0.5 * height * SUBPIXELS], corners.dtype)
    xy = jnp.round(safe_div(corners[..., :2], jnp.broadcast_to(w[..., None], (*w.shape, 2))) * half[None, None])
    xy = xy.astype(jnp.int32)
    z = safe_div(corners[..., 2], w)
    a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    high, low = cross_product(a[:, 0], a[:, 1], b[:, 0], b[:, 1], bias=jnp.zeros_like(a[:, 0]))
    # Counter-clockwise in a world with y up is clockwise with y down: a positive cross product is a back face.
    front = high < 0
    area = jnp.abs(to_float(high, low))
    valid = valid & (area > 0)
    area = jnp.where(area > 0, area, jnp.ones_like(area))
    if cull != "none":
        right_way = front if cull == "back" else ~front
        valid &= right_way if two_sided is None else right_way | two_sided[clipped.source]
    if drawn is not None:
        valid &= drawn[clipped.source]

    def swap(values: Array) -> Array:
        turned = front.reshape(-1, *(1,) * (values.ndim - 2))
        first, second, third = (values[:, k] for k in range(3))
        return jnp.stack([first, jnp.where(turned, third, second), jnp.where(turned, second, third)], axis=1)

    return ScreenTriangles(
        xy=swap(xy), z=swap(z), w=swap(clipped.clip[..., 3]), weights=swap(clipped.weights), area=area,
        source=clipped.source, order=clipped.order, front=front, valid=valid,
    )  # fmt: skip


def edge(
    start: tuple[Int[Array, "*b"], Int[Array, "*b"]],
    end: tuple[Int[Array, "*b"], Int[Array, "*b"]],
    point: tuple[Int[Array, "*b"], Int[Array, "*b"]],
    *,
    unit: int,
) -> tuple[Int[Array, "*b"], Float[Array, "*b"]]:
    """The edge function at a point, ready to be compared with 0 at all sample positions nearby.

    With (dx, dy) = end - start, and steps i to the right and j down, each of `unit` snapped units, a sample is inside
    the edge, by the top-left rule, if and only if  c + dx·j - dy·i >= 0  in int32: c is the edge function at the
    point, less 1 for edges that do not own their samples, divided by `unit` and rounded down.

    Args:
      unit: a power of two.
    Returns:
      c, and the edge function itself in float32.
    References:
      Direct3D 11 functional specification, 3.4.2 (top-left rule).
    """
    dx, dy = end[0] - start[0], end[1] - start[1]
    owns = (dy == 0) & (dx > 0) | (dy < 0)
    bias = 1 - owns.astype(jnp.int32)
    high, low = cross_product(dx, dy, point[0] - start[0], point[1] - start[1], bias=bias)
    value = to_float(high, low) + bias.astype(jnp.float32)
    return divide_by(high, low, bits=unit.bit_length() - 1), value


def weight_steps(
    xy: Int[Array, "*b 3 2"], area: Float[Array, "*b"], *, unit: int
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Steps of the corners' weights, which are linear on the screen, per `unit` snapped units to the right and down."""
    start, end = jnp.roll(xy, -1, axis=-2), jnp.roll(xy, -2, axis=-2)
    dx, dy = ((end - start)[..., axis].astype(area.dtype) for axis in (0, 1))
    step = unit / area[..., None]
    return -dy * step, dx * step


def corner_planes(triangles: ScreenTriangles) -> list[list[Float[Array, " n"]]]:
    """What is linear on the screen, at the three corners: window depth, 1/w, and b_1/w and b_2/w of the source."""
    over_w = safe_div(jnp.ones_like(triangles.w), triangles.w)
    b1, b2 = (triangles.weights[..., i] * over_w for i in (1, 2))
    return [[values[:, k] for k in range(3)] for values in (triangles.z, over_w, b1, b2)]


def plane_steps(triangles: ScreenTriangles, *, unit: int) -> tuple[list[Float[Array, " n"]], list[Float[Array, " n"]]]:
    """Steps of `corner_planes` per `unit` snapped units to the right, and down."""
    planes = corner_planes(triangles)
    right, down = (
        [d[:, 0] * plane[0] + d[:, 1] * plane[1] + d[:, 2] * plane[2] for plane in planes]
        for d in weight_steps(triangles.xy, triangles.area, unit=unit)
    )
    return right, down


def screen_barycentrics(
    xy: Int[Array, "*b 3 2"], area: Float[Array, "*b"], px: Int[Array, "*b"], py: Int[Array, "*b"]
) -> Float[Array, "*b 3"]:
    """Weights of the corners at a point, linear in screen space; from exact products, outside the triangle as well."""
    start, end = jnp.roll(xy, -1, axis=-2), jnp.roll(xy, -2, axis=-2)
    dx, dy = end[..., 0] - start[..., 0], end[..., 1] - start[..., 1]
    high, low = cross_product(
        dx, dy, px[..., None] - start[..., 0], py[..., None] - start[..., 1], bias=jnp.zeros_like(dx)
    )
    return to_float(high, low) / area[..., None]


def perspective_weights(
    screen: Float[Array, "*b 3"], w: Float[Array, "*b 3"], weights: Float[Array, "*b 3 3"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """Perspective-correct barycentrics in the source triangle, and clip w, from weights on the screen.

    References:
      b_k = (l_k / w_k) / Σ (l_i / w_i); w = 1 / Σ (l_i / w_i).
    """
    over_w = screen / w
    total = jnp.sum(over_w, axis=-1, keepdims=True)
    own = safe_div(over_w, jnp.broadcast_to(total, over_w.shape))
    return jnp.sum(own[..., :, None] * weights, axis=-2), safe_div(jnp.ones_like(total), total)[..., 0]
