"""The pinhole camera: transforms between world, view, clip space and pixels, camera rays, and automatic framing.

View space has x to the right, y up and the eye looking down -z. Pixel (row, column) = (0, 0) is the top
left one, and its centre is at (0.5, 0.5) in `_px` coordinates (x to the right, y down). All of it is
differentiable in the camera. One camera at a time; batches are `vmap`.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender import checks, vecmath

#: The corners of a box, as signs of x, y and z from its middle.
_BOX_CORNERS = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(8, 3)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Camera:
    """Where the eye is, what it looks at, which way is up, and the full vertical field of view."""

    eye: Float[Array, "3"]
    target: Float[Array, "3"]
    up: Float[Array, "3"]
    fov_y_radians: Float[Array, ""]


def look_at(eye: Float[Array, "3"], target: Float[Array, "3"], up: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """World-from-view rotation: its columns are right, up and backward (from the target to the eye).

    An `up` along the line of sight leaves the roll open; it is then that of `vecmath.orthonormal_tangent`.
    An eye at its target looks down -z of the world.
    """
    backward = eye - target
    z = jnp.asarray([0.0, 0.0, 1.0], backward.dtype)
    backward = jnp.where(jnp.sum(backward * backward) > 0, vecmath.normalize(backward), z)
    return vecmath.frame_from_normal_tangent(backward, vecmath.normalize(jnp.cross(up, backward)))


def view_from_world(camera: Camera) -> Float[Array, "4 4"]:
    """The rigid transform of homogeneous points from world to view space."""
    rotation = look_at(camera.eye, camera.target, camera.up).T
    affine = jnp.concatenate([rotation, -vecmath.matmul(rotation, camera.eye)[:, None]], axis=1)
    return jnp.concatenate([affine, jnp.asarray([[0.0, 0.0, 0.0, 1.0]], affine.dtype)], axis=0)


def camera_rays(
    camera: Camera, *, height: int, width: int, offsets: Float[Array, "*#hw 2"] | None = None
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w 3"]]:
    """Origins and unit directions of one ray per pixel.

    Args:
      offsets: where in its pixel a ray passes, (x, y) in [0, 1); (2,) or (h, w, 2). None is the centre.
    Raises:
      ValueError: if height or width is below 1.
    """
    checks.check_at_least("height", height, 1)
    checks.check_at_least("width", width, 1)
    dtype = camera.eye.dtype
    offsets = jnp.full((2,), 0.5, dtype) if offsets is None else offsets
    corner = jnp.stack(
        jnp.meshgrid(jnp.arange(width, dtype=dtype), jnp.arange(height, dtype=dtype), indexing="xy"), axis=-1
    )
    px = corner + jnp.broadcast_to(offsets, corner.shape)
    # On the plane z = -1 of view space a pixel is `step` wide and high.
    step = 2.0 * jnp.tan(0.5 * camera.fov_y_radians) / height
    x, y = (px[..., 0] - 0.5 * width) * step, (0.5 * height - px[..., 1]) * step
    view = vecmath.normalize(jnp.stack([x, y, -jnp.ones_like(x)], axis=-1))
    directions = vecmath.matmul(view, look_at(camera.eye, camera.target, camera.up).T)
    return jnp.broadcast_to(camera.eye, directions.shape), directions


def clip_from_world(
    camera: Camera,
    *,
    height: int,
    width: int,
    near: int | float | Float[Array, ""],
    far: int | float | Float[Array, ""],
) -> Float[Array, "4 4"]:
    """The projection of homogeneous world points to clip space: visible where -w <= x, y <= w and 0 <= z <= w.

    y is up, w is the linear view depth, and z / w runs from 0 at `near` to 1 at `far`: the clip space of
    Direct3D, Vulkan and WebGPU. Differentiable in the camera, `near` and `far`.

    Args:
      near, far: linear view depths with 0 < near < far, both finite; see `depth_range`.
    Raises:
      ValueError: if height or width is below 1, or near and far are numbers out of order.
    """
    checks.check_at_least("height", height, 1)
    checks.check_at_least("width", width, 1)
    if isinstance(near, int | float) and isinstance(far, int | float) and not 0 < near < far < math.inf:
        raise ValueError(f"near, far: expected 0 < near < far, both finite, got {near} and {far}")
    dtype = camera.eye.dtype
    near, far = jnp.asarray(near, dtype), jnp.asarray(far, dtype)
    y = 1.0 / jnp.tan(0.5 * camera.fov_y_radians)
    x, z, one, zero = y * (height / width), far / (near - far), jnp.ones_like(y), jnp.zeros_like(y)
    rows = [[x, zero, zero, zero], [zero, y, zero, zero], [zero, zero, z, near * z], [zero, zero, -one, zero]]
    clip_from_view = jnp.stack([jnp.stack(row) for row in rows])
    return vecmath.matmul(clip_from_view, view_from_world(camera))


def depth_range(
    camera: Camera, minimum: Float[Array, "3"], maximum: Float[Array, "3"], *, smallest_ratio: float = 1e-3
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Depths `near` and `far` that hold the part of a box that is in front of the eye, for `clip_from_world`.

    Both leave 1 % of room. A box wholly behind the eye gives 1e-3 and 1, times its distance.

    Args:
      smallest_ratio: near is at least this share of far, as float32 depth needs, also for an eye inside the box.
    """
    dtype = camera.eye.dtype
    low = jnp.asarray(_BOX_CORNERS < 0)
    corners = jnp.where(low, jnp.broadcast_to(minimum, (8, 3)), jnp.broadcast_to(maximum, (8, 3)))
    backward = look_at(camera.eye, camera.target, camera.up)[:, 2]
    depth = vecmath.matmul(jnp.broadcast_to(camera.eye, (8, 3)) - corners, backward)
    deepest = jnp.max(depth)
    fallback = jnp.max(jnp.abs(depth))
    far = 1.01 * jnp.where(deepest > 0, deepest, jnp.where(fallback > 0, fallback, jnp.ones((), dtype)))
    return jnp.maximum(0.99 * jnp.min(depth), smallest_ratio * far), far


def project_px(
    camera: Camera, points: Float[Array, "*b 3"], *, height: int, width: int
) -> tuple[Float[Array, "*b 2"], Float[Array, "*b"]]:
    """Pixel coordinates of world points, and their linear view depth (positive in front of the eye).

    A point in the plane of the eye (depth 0) lands at (width / 2, height / 2).
    """
    world_from_view = look_at(camera.eye, camera.target, camera.up)
    view = vecmath.matmul(points - jnp.broadcast_to(camera.eye, points.shape), world_from_view)
    depth = -view[..., 2]
    step = 2.0 * jnp.tan(0.5 * camera.fov_y_radians) / height
    x = vecmath.safe_div(view[..., 0], depth * step) + 0.5 * width
    y = 0.5 * height - vecmath.safe_div(view[..., 1], depth * step)
    return jnp.stack([x, y], axis=-1), depth


def frame_bounds(
    minimum: Float[Array, "3"],
    maximum: Float[Array, "3"],
    *,
    azimuth_radians: float | Float[Array, ""] = 0.0,
    elevation_radians: float | Float[Array, ""] = 0.0,
    fov_y_radians: float = math.radians(35.0),
    aspect: int | float = 1.0,
    margin: float = 0.05,
) -> Camera:
    """The camera that sees a whole box and no more, for example the bounds of a character over a clip.

    The eye looks at the middle of the box. The distance is the smallest one at which all eight corners,
    with `margin` (a share of the box) around them, lie inside the picture.

    Args:
      azimuth_radians: 0 looks at the front of a glTF character from +z; it grows towards +x.
      elevation_radians: 0 is level, π/2 looks straight down.
      aspect: width / height of the picture.
    Raises:
      ValueError: if aspect, margin or the field of view is out of its range.
    """
    if not aspect > 0:
        raise ValueError(f"aspect: expected a value > 0, got {aspect}")
    if not 0 < fov_y_radians < math.pi:
        raise ValueError(f"fov_y_radians: expected a value between 0 and π, got {fov_y_radians}")
    checks.check_at_least("margin", margin, 0.0)
    dtype = minimum.dtype
    azimuth, elevation = jnp.asarray(azimuth_radians, dtype), jnp.asarray(elevation_radians, dtype)
    backward = jnp.stack(
        [
            jnp.cos(elevation) * jnp.sin(azimuth),
            jnp.sin(elevation),
            jnp.cos(elevation) * jnp.cos(azimuth),
        ]
    )
    # The limit of "up is +y" at the poles: the picture does not roll while the camera passes overhead.
    up = jnp.stack(
        [
            -jnp.sin(elevation) * jnp.sin(azimuth),
            jnp.cos(elevation),
            -jnp.sin(elevation) * jnp.cos(azimuth),
        ]
    )
    center, half = 0.5 * (minimum + maximum), 0.5 * (1.0 + margin) * (maximum - minimum)
    corners = jnp.asarray(_BOX_CORNERS, dtype) * jnp.broadcast_to(half, (8, 3))
    x, y, z = vecmath.matmul(corners, look_at(backward, jnp.zeros_like(backward), up)).T
    tangent = math.tan(0.5 * fov_y_radians)
    distance = jnp.max(z + jnp.maximum(jnp.abs(x) / (tangent * aspect), jnp.abs(y) / tangent))
    # A box without extent is seen from one unit away.
    distance = jnp.where(distance > 0, distance, jnp.ones_like(distance))
    return Camera(center + distance * backward, center, up, jnp.asarray(fov_y_radians, dtype))
