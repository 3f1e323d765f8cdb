"""The camera against NumPy, against its own inverse, and at the poles."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.camera import (
    Camera,
    camera_rays,
    clip_from_world,
    depth_range,
    frame_bounds,
    look_at,
    project_px,
    view_from_world,
)


def make_camera(eye=(0.0, 0.0, 5.0), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), fov_degrees=60.0):
    return Camera(
        *(jnp.asarray(v, jnp.float32) for v in (eye, target, up)),
        jnp.asarray(math.radians(fov_degrees), jnp.float32),
    )


def test_default_view_looks_down_minus_z():
    np.testing.assert_array_equal(
        look_at(*(jnp.asarray(v, jnp.float32) for v in ([0, 0, 5], [0, 0, 0], [0, 1, 0]))), np.eye(3)
    )


def test_look_at_against_cross_products(rng):
    for _ in range(10):
        eye, target, up = rng.normal(size=(3, 3)).astype(np.float32)
        rotation = np.asarray(look_at(*map(jnp.asarray, (eye, target, up))))
        backward = (eye - target) / np.linalg.norm(eye - target)
        right = np.cross(up, backward)
        right /= np.linalg.norm(right)
        expected = np.stack([right, np.cross(backward, right), backward], axis=1)
        # Normalizing amplifies rounding by at most 1 / sin(up, backward), about 10 for these seeds.
        np.testing.assert_allclose(rotation, expected, atol=20 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, -3.0, 0.0)])
def test_look_at_along_up_is_still_a_rotation(up):
    rotation = np.asarray(look_at(*(jnp.asarray(v, jnp.float32) for v in ((0.0, 2.0, 0.0), (0.0, 0.0, 0.0), up))))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) > 0.99
    np.testing.assert_allclose(rotation[:, 2], [0, 1, 0], atol=1e-6)


def test_eye_at_target_is_finite_with_finite_gradient():
    def total(eye):
        return jnp.sum(look_at(eye, jnp.zeros(3), jnp.asarray([0.0, 1.0, 0.0])))

    value, gradient = jax.value_and_grad(total)(jnp.zeros(3))
    assert np.isfinite(value) and np.isfinite(gradient).all()


def test_view_from_world_sends_eye_to_origin_and_target_ahead():
    camera = make_camera(eye=(1.0, 2.0, 3.0), target=(-1.0, 0.5, 0.0))
    transform = np.asarray(view_from_world(camera))
    distance = np.linalg.norm([2.0, 1.5, 3.0])
    np.testing.assert_allclose(transform @ [1, 2, 3, 1], [0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(transform @ [-1, 0.5, 0, 1], [0, 0, -distance, 1], atol=2e-6)


def test_rays_pass_through_pixel_centres():
    origins, directions = camera_rays(make_camera(fov_degrees=90.0), height=2, width=4)
    assert origins.shape == directions.shape == (2, 4, 3)
    np.testing.assert_array_equal(origins[1, 2], [0, 0, 5])
    # Half the height is tan 45° = 1, so a pixel is 1 wide; the top left centre is at (-1.5, 0.5).
    np.testing.assert_allclose(
        directions[0, 0], np.array([-1.5, 0.5, -1.0]) / math.sqrt(1.5**2 + 0.5**2 + 1), atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-6)


def test_corner_offset_is_the_corner_of_the_field_of_view():
    _, directions = camera_rays(make_camera(), height=3, width=3, offsets=jnp.zeros(2, jnp.float32))
    x, y, z = np.asarray(directions[0, 0])
    assert math.degrees(math.atan2(y, -z)) == pytest.approx(30.0, abs=1e-4)
    assert math.degrees(math.atan2(-x, -z)) == pytest.approx(30.0, abs=1e-4)


def test_offsets_per_pixel_match_offsets_by_pixel(rng):
    camera, offsets = make_camera(eye=(1.0, 2.0, 3.0)), jnp.asarray(rng.random((4, 5, 2)), jnp.float32)
    _, directions = camera_rays(camera, height=4, width=5, offsets=offsets)
    _, alone = camera_rays(camera, height=4, width=5, offsets=offsets[3, 1])
    np.testing.assert_array_equal(directions[3, 1], alone[3, 1])


def test_project_is_the_inverse_of_rays(rng):
    camera = make_camera(eye=(1.0, 2.0, 3.0), target=(0.2, 0.1, 0.0))
    origins, directions = camera_rays(camera, height=6, width=9)
    t = jnp.asarray(rng.uniform(0.5, 4.0, size=(6, 9, 1)), jnp.float32)
    px, depth = project_px(camera, origins + jnp.broadcast_to(t, directions.shape) * directions, height=6, width=9)
    columns, rows = np.meshgrid(np.arange(9) + 0.5, np.arange(6) + 0.5)
    # Points a few units away, rounded to 1e-7 relative, seen at a pixel step of 0.2: well below 1e-4 px.
    np.testing.assert_allclose(px, np.stack([columns, rows], axis=-1), atol=1e-4)
    assert (np.asarray(depth) > 0).all()


def test_point_in_the_plane_of_the_eye_is_finite():
    px, depth = project_px(make_camera(), jnp.asarray([[1.0, 2.0, 5.0]], jnp.float32), height=4, width=4)
    assert depth[0] == 0 and np.isfinite(px).all()


def test_clip_space_is_that_of_the_pixels_and_depths(rng):
    camera = make_camera(eye=(1.0, 2.0, 3.0), target=(0.2, 0.1, 0.0), fov_degrees=50.0)
    points = jnp.asarray(rng.normal(size=(20, 3)), jnp.float32)
    matrix = jax.jit(clip_from_world, static_argnames=("height", "width"))(
        camera, height=60, width=90, near=0.5, far=8.0
    )
    clip = np.pad(np.asarray(points, np.float64), ((0, 0), (0, 1)), constant_values=1.0) @ np.asarray(matrix).T
    px, depth = project_px(camera, points, height=60, width=90)
    # Row 0 of an image is on top, y of clip space is up.
    at = np.stack([90 * (0.5 + 0.5 * clip[:, 0] / clip[:, 3]), 60 * (0.5 - 0.5 * clip[:, 1] / clip[:, 3])], axis=1)
    np.testing.assert_allclose(at, px, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(clip[:, 3], depth, rtol=1e-5, atol=1e-6)
    # Linear in 1/w, 0 at near and 1 at far.
    np.testing.assert_allclose(clip[:, 2] / clip[:, 3], (1 / 0.5 - 1 / clip[:, 3]) / (1 / 0.5 - 1 / 8.0), atol=1e-4)


def test_clip_space_against_the_matrix_of_the_direct3d_manual():
    """XMMatrixPerspectiveFovRH, transposed for column vectors, at the origin."""
    camera = make_camera(eye=(0.0, 0.0, 0.0), target=(0.0, 0.0, -1.0), fov_degrees=90.0)
    matrix = clip_from_world(camera, height=1, width=2, near=1, far=3)
    expected = [[0.5, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1.5, -1.5], [0, 0, -1, 0]]
    np.testing.assert_allclose(matrix, expected, atol=1e-6)


def test_depth_range_holds_the_box_in_front():
    low, high = jnp.asarray([-1.0, -1.0, -1.0]), jnp.asarray([1.0, 1.0, 1.0])
    ranges = jax.jit(lambda z: depth_range(make_camera(eye=(0.0, 0.0, 5.0), target=(0.0, 0.0, z)), low, high))
    near, far = ranges(0.0)
    np.testing.assert_allclose([near, far], [0.99 * 4, 1.01 * 6], rtol=1e-6)
    behind = ranges(9.0)
    assert 0 < behind[0] < behind[1] < np.inf
    inside = depth_range(make_camera(eye=(0.0, 0.0, 0.5), target=(0.0, 0.0, 0.0)), low, high, smallest_ratio=0.01)
    np.testing.assert_allclose(inside, [0.01 * 1.515, 1.515], rtol=1e-6)


@pytest.mark.parametrize(("near", "far"), [(0.0, 1.0), (2.0, 1.0), (1, math.inf), (math.nan, 1.0)])
def test_bad_depths(near, far):
    with pytest.raises(ValueError, match="near, far: expected 0 < near < far"):
        clip_from_world(make_camera(), height=2, width=2, near=near, far=far)


@pytest.mark.parametrize("aspect", [0.5, 1.9])
def test_framing_holds_every_corner_and_touches_the_edge(aspect):
    low, high = jnp.asarray([-0.4, 0.0, -1.5]), jnp.asarray([0.6, 1.8, 0.3])
    corners = jnp.asarray([[x, y, z] for x in (-0.4, 0.6) for y in (0.0, 1.8) for z in (-1.5, 0.3)])
    height, width = 1000, round(1000 * aspect)

    @jax.jit
    @jax.vmap
    def corners_px(azimuth, elevation):
        camera = frame_bounds(
            low, high, azimuth_radians=azimuth, elevation_radians=elevation, aspect=aspect, margin=0.0
        )
        return project_px(camera, corners, height=height, width=width)

    azimuth, elevation = np.meshgrid([0.0, 0.7, math.pi, -2.0], [-1.2, 0.0, 0.4, math.pi / 2])
    px, depth = corners_px(*(jnp.asarray(v.ravel(), jnp.float32) for v in (azimuth, elevation)))
    assert (np.asarray(depth) > 0).all()
    inside = np.concatenate([px, [width, height] - np.asarray(px)], axis=-1)
    # The nearest corner lies on the frame: zero up to float32 rounding of a distance of about 5 units.
    np.testing.assert_allclose(inside.min(axis=(1, 2)), 0.0, atol=0.01)


def test_azimuth_grows_towards_plus_x_and_elevation_up():
    box = jnp.asarray([-1.0, -1.0, -1.0]), jnp.asarray([1.0, 1.0, 1.0])
    eye = np.asarray(frame_bounds(*box, azimuth_radians=math.pi / 2).eye)
    assert eye[0] > 1 and abs(eye[1]) < 1e-5 and abs(eye[2]) < 1e-5
    assert frame_bounds(*box, elevation_radians=0.3).eye[1] > 0.5


def test_framing_a_point_stays_finite():
    camera = frame_bounds(jnp.ones(3), jnp.ones(3))
    np.testing.assert_allclose(camera.eye, [1, 1, 2])


def test_camera_is_a_pytree_and_rays_jit_and_differentiate():
    camera = make_camera(eye=(1.0, 2.0, 3.0))

    def total(camera):
        return jnp.sum(camera_rays(camera, height=3, width=4)[1] ** 2 @ jnp.arange(3, dtype=jnp.float32))

    np.testing.assert_allclose(jax.jit(total)(camera), total(camera), rtol=1e-6)
    # Central differences in float32 of a value near 10: truncation 1e-6, rounding 1e-6 / 1e-2.
    step = 1e-2
    moved = [make_camera(eye=(1.0 + sign * step, 2.0, 3.0)) for sign in (1, -1)]
    difference = (total(moved[0]) - total(moved[1])) / (2 * step)
    assert jax.grad(total)(camera).eye[0] == pytest.approx(float(difference), abs=2e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"aspect": 0.0}, "aspect: expected a value > 0"),
        ({"fov_y_radians": 4.0}, "fov_y_radians: expected"),
        ({"margin": -0.1}, "margin: expected a value >= 0"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        frame_bounds(jnp.zeros(3), jnp.ones(3), **options)


def test_bad_size():
    with pytest.raises(ValueError, match="height: expected a value >= 1, got 0"):
        camera_rays(make_camera(), height=0, width=4)
