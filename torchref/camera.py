"""The pinhole camera: where a world point lies in the picture, and which ray a pixel looks along.

View space has x to the right, y up and the eye looking down -z. Pixel coordinates `_px` run right and down from the
top left corner of the picture, so the centre of the first pixel is (0.5, 0.5). One camera at a time.
"""

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.vecmath import dot, normalize, orthonormal_tangent, safe_div


@dataclass(frozen=True)
class Camera:
    """The eye, a point that it looks at, the upward direction, and the whole vertical field of view."""

    eye: Float[Tensor, "3"]
    target: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    fov_y_radians: Float[Tensor, ""]


@in_float64
def look_at(eye: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """World-from-view rotation with columns right, up, backward.

    backward is from the target to the eye (+z where they coincide), right = up × backward. Where that vanishes,
    right is `orthonormal_tangent` of backward.
    """
    backward = normalize(eye - target)
    if not backward.any():
        backward = torch.tensor([0.0, 0.0, 1.0], dtype=eye.dtype, device=eye.device)
    right = normalize(torch.linalg.cross(up, backward))
    if not right.any():
        right = orthonormal_tangent(backward)
    return torch.stack([right, torch.linalg.cross(backward, right), backward], dim=-1)


@in_float64
def view_from_world(camera: Camera) -> Float[Tensor, "4 4"]:
    """Inverse of the placement of the camera, [R eye; 0 1]."""
    placed = torch.cat([look_at(camera.eye, camera.target, camera.up), camera.eye[:, None]], dim=1)
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=placed.dtype, device=placed.device)
    return torch.linalg.inv(torch.cat([placed, last]))


@in_float64
def clip_from_world(
    camera: Camera,
    *,
    height: int,
    width: int,
    near: int | float | Float[Tensor, ""],
    far: int | float | Float[Tensor, ""],
) -> Float[Tensor, "4 4"]:
    """View transform, then the projection that maps depth `near` to z/w = 0 and `far` to 1, with w the view depth.

    z/w = (A·depth + B)/depth with A + B/near = 0 and A + B/far = 1 gives A = far/(far - near), B = -near·A.
    """
    tangent = torch.tan(0.5 * camera.fov_y_radians)
    near, far = (torch.as_tensor(v, dtype=tangent.dtype) for v in (near, far))
    a = far / (far - near)
    zero = torch.zeros_like(tangent)
    rows = [
        [height / (width * tangent), zero, zero, zero],
        [zero, 1.0 / tangent, zero, zero],
        [zero, zero, -a, -near * a],
        [zero, zero, zero - 1.0, zero],
    ]
    return torch.stack([torch.stack(row) for row in rows]) @ view_from_world(camera)


@in_float64
def depth_range(
    camera: Camera, minimum: Float[Tensor, "3"], maximum: Float[Tensor, "3"], *, smallest_ratio: float = 1e-3
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """`near` and `far` around the depths of a box's corners, with 1 % of room; near is a share of far at least."""
    corners = torch.stack([torch.stack(c) for c in itertools.product(*zip(minimum, maximum, strict=True))])
    depth = -(torch.cat([corners, torch.ones_like(corners[:, :1])], dim=1) @ view_from_world(camera).mT)[:, 2]
    far = depth.max() if depth.max() > 0 else depth.abs().max()
    far = 1.01 * (far if far > 0 else torch.ones_like(far))
    return torch.maximum(0.99 * depth.min(), smallest_ratio * far), far


@in_float64
def camera_rays(
    camera: Camera, *, height: int, width: int, offsets: Float[Tensor, "*#hw 2"] | None = None
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    """Origins and unit directions, pixel by pixel.

    At unit distance the picture reaches from -tan(fov/2) to tan(fov/2) upwards, and width / height times as far
    sideways. `offsets` are places within the pixel, (0.5, 0.5) if None.
    """
    right, up, backward = look_at(camera.eye, camera.target, camera.up).unbind(-1)
    if offsets is None:
        offsets = torch.tensor([0.5, 0.5], dtype=right.dtype, device=right.device)
    offsets = offsets.expand(height, width, 2)
    half_height = torch.tan(camera.fov_y_radians / 2.0)
    half_width = half_height * width / height
    rows = []
    for row in range(height):
        for column in range(width):
            x = 2.0 * (column + offsets[row, column, 0]) / width - 1.0
            y = 1.0 - 2.0 * (row + offsets[row, column, 1]) / height
            rows.append(normalize(x * half_width * right + y * half_height * up - backward))
    return camera.eye.expand(height, width, 3), torch.stack(rows).reshape(height, width, 3)


@in_float64
def project_px(
    camera: Camera, points: Float[Tensor, "*b 3"], *, height: int, width: int
) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
    """Pixel coordinates by similar triangles, and the depth along the view axis.

    A point as deep as the eye itself lands in the middle of the picture.
    """
    right, up, backward = look_at(camera.eye, camera.target, camera.up).unbind(-1)
    seen = points - camera.eye
    depth = -dot(seen, backward)
    focal_px = 0.5 * height / torch.tan(camera.fov_y_radians / 2.0)
    x = width / 2.0 + focal_px * safe_div(dot(seen, right), depth)
    y = height / 2.0 - focal_px * safe_div(dot(seen, up), depth)
    return torch.cat([x, y], dim=-1), depth[..., 0]


@in_float64
def frame_bounds(
    minimum: Float[Tensor, "3"],
    maximum: Float[Tensor, "3"],
    *,
    azimuth_radians: float | Float[Tensor, ""] = 0.0,
    elevation_radians: float | Float[Tensor, ""] = 0.0,
    fov_y_radians: float = math.radians(35.0),
    aspect: int | float = 1.0,
    margin: float = 0.05,
) -> Camera:
    """The nearest camera, looking at the middle of a box, whose picture holds all eight corners.

    A corner (x, y, z) in view axes about the middle is inside from a distance z + |x| / (aspect · tan(fov/2)) on, and
    likewise in y without the aspect; the largest of these sixteen counts. The box is first enlarged by the share
    `margin`. A box without extent is seen from one unit away. Azimuth 0 is the side of +z and grows towards +x.
    """
    azimuth, elevation, fov = (
        torch.as_tensor(angle, dtype=minimum.dtype, device=minimum.device)
        for angle in (azimuth_radians, elevation_radians, fov_y_radians)
    )
    side, ahead, zero = torch.sin(azimuth), torch.cos(azimuth), torch.zeros_like(azimuth)
    level, rise = torch.cos(elevation), torch.sin(elevation)
    # The columns of a turn about y by the azimuth after one about x by minus the elevation.
    right = torch.stack([ahead, zero, -side])
    up = torch.stack([-rise * side, level, -rise * ahead])
    backward = torch.stack([level * side, rise, level * ahead])
    center, half = (minimum + maximum) / 2.0, (1.0 + margin) * (maximum - minimum) / 2.0
    tangent = torch.tan(fov / 2.0)
    needed = []
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner = half * torch.tensor(signs, dtype=half.dtype, device=half.device)
        depth = corner @ backward
        needed += [depth + (corner @ right).abs() / (aspect * tangent), depth + (corner @ up).abs() / tangent]
    distance = torch.stack(needed).max()
    distance = torch.where(distance > 0, distance, 1.0)
    return Camera(center + distance * backward, center, up, fov)
