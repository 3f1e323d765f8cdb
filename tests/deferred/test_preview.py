"""Pictures of meshes: interpolation, coverage, seams, handedness, backgrounds."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxrender.camera import Camera, camera_rays, frame_bounds, project_px
from jaxrender.deferred import preview
from jaxrender.deferred.preview import (
    blur_environment,
    color_surface,
    coverage,
    environment_background,
    gradient_background,
    lay_over,
    render_vertex_colors,
    visible_surface,
)
from jaxrender.latlong import environment_directions

EPS = np.finfo(np.float32).eps


def camera_at(eye, target=(0.0, 0.0, 0.0), fov_degrees=40.0):
    up = jnp.asarray([0.0, 1.0, 0.0])
    fov = jnp.asarray(math.radians(fov_degrees), jnp.float32)
    return Camera(jnp.asarray(eye, jnp.float32), jnp.asarray(target, jnp.float32), up, fov)


@pytest.fixture
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


@pytest.fixture
def floor():
    """A square of side 20 in the plane y = 0."""
    vertices = np.array([[-10, 0, -10], [10, 0, -10], [10, 0, 10], [-10, 0, 10]], np.float32)
    return vertices, np.array([[0, 2, 1], [0, 3, 2]], np.int32)


def test_colors_are_linear_on_a_plane_in_perspective(floor):
    """A color that is linear in space comes out as that function of the point each ray meets."""
    vertices, faces = floor
    camera = camera_at((1.0, 3.0, 8.0))
    image, alpha = render_vertex_colors(
        vertices, faces, vertices / 20 + 0.5, camera, height=24, width=32, samples_per_axis=1
    )
    origins, directions = (np.asarray(x, np.float64) for x in camera_rays(camera, height=24, width=32))
    point = origins - origins[..., 1:2] / directions[..., 1:2] * directions
    inside = np.all(np.abs(point) < 9.9, axis=-1) & (directions[..., 1] < 0)
    assert inside.sum() > 200
    np.testing.assert_array_equal(alpha[inside], 1.0)
    # Corners are snapped to 1/256 px, so that the floor lies up to 1/360 px beside its place on the screen.
    per_pixel = sum(np.abs(np.gradient(point, axis=axis)).max(axis=-1) for axis in (0, 1))
    off = np.abs(image - (point / 20 + 0.5)).max(axis=-1)
    assert (off[inside] <= (per_pixel / 20 / 360 + 13 * 10 * EPS)[inside]).all()


def test_samples_of_a_pixel_are_averaged(floor):
    vertices, faces = floor
    camera = camera_at((1.0, 3.0, 8.0))
    size = {"height": 12, "width": 16}
    image, alpha = render_vertex_colors(vertices, faces, vertices / 20 + 0.5, camera, **size, samples_per_axis=3)
    fine, fine_alpha = render_vertex_colors(
        vertices, faces, vertices / 20 + 0.5, camera, height=36, width=48, samples_per_axis=1
    )
    np.testing.assert_allclose(image, fine.reshape(12, 3, 16, 3, 3).mean(axis=(1, 3)), atol=8 * EPS)
    np.testing.assert_allclose(alpha, fine_alpha.reshape(12, 3, 16, 3).mean(axis=(1, 3)), atol=8 * EPS)
    assert ((alpha > 0) & (alpha < 1)).any()  # the far edge of the floor


def test_no_holes_at_seams(sphere):
    """Every pixel that lies inside the outline is covered whole, from several sides."""
    vertices, faces = sphere
    for azimuth in (0.0, 0.7, 2.0):
        low, high = jnp.full(3, -1.0), jnp.full(3, 1.0)
        camera = frame_bounds(low, high, azimuth_radians=azimuth, elevation_radians=0.4)
        surface = visible_surface(vertices, faces, camera, height=96, width=96)
        _, directions = camera_rays(camera, height=96, width=96)
        distance = float(jnp.linalg.norm(camera.eye))
        # Angle from the middle against that of the outline; the mesh sags 1 % inside the sphere, a pixel is 0.6 %.
        angle = np.arccos(np.clip(np.asarray(directions) @ -np.asarray(camera.eye) / distance, -1, 1))
        inside = angle < 0.97 * math.asin(1 / distance)
        assert inside.sum() > 1000
        np.testing.assert_array_equal(coverage(surface)[inside], 1.0)


def test_right_is_right_and_up_is_up(sphere):
    """Seen from +z, +x is on the right and +y on top."""
    vertices, faces = sphere
    image, _ = render_vertex_colors(
        vertices, faces, np.maximum(vertices, 0), camera_at((0.0, 0.0, 5.0)), height=32, width=32
    )
    assert image[:, 16:, 0].sum() > 0 and image[:, :14, 0].sum() == 0
    assert image[:16, :, 1].sum() > 0 and image[18:, :, 1].sum() == 0


def test_vertices_are_where_the_camera_projects_them(sphere):
    vertices, faces = sphere
    camera = camera_at((2.0, 1.5, 4.0))
    px, _ = project_px(camera, jnp.asarray(vertices), height=200, width=200)
    nearest = int(np.argmin(np.linalg.norm(vertices - np.asarray(camera.eye), axis=-1)))
    colors = np.zeros_like(vertices)
    colors[nearest] = 1.0
    image, _ = render_vertex_colors(vertices, faces, colors, camera, height=200, width=200)
    row, column = np.unravel_index(np.argmax(image[..., 0]), image.shape[:2])
    np.testing.assert_allclose([column + 0.5, row + 0.5], np.asarray(px[nearest]), atol=1.0)


def test_new_colors_cost_no_rasterisation(sphere, monkeypatch):
    vertices, faces = sphere
    camera = camera_at((0.0, 0.0, 4.0))
    surface = visible_surface(vertices, faces, camera, height=16, width=16)
    expected, _ = render_vertex_colors(vertices, faces, np.abs(vertices), camera, height=16, width=16)
    monkeypatch.setattr(preview, "rasterize", None)
    image, alpha = color_surface(surface, np.abs(vertices))
    np.testing.assert_array_equal(image, expected)
    np.testing.assert_array_equal(alpha, coverage(surface))


def test_negative_colors_are_black(sphere):
    vertices, faces = sphere
    image, alpha = render_vertex_colors(
        vertices, faces, -np.ones_like(vertices), camera_at((0.0, 0.0, 4.0)), height=16, width=16
    )
    assert (image == 0).all() and alpha.max() == 1


def test_far_from_the_origin_the_picture_is_the_same(sphere):
    vertices, faces = sphere
    away = np.array([4096.0, 0.0, -2048.0], np.float32)
    near = visible_surface(vertices, faces, camera_at((0.0, 0.5, 4.0)), height=32, width=32)
    eye, target = away + np.float32([0.0, 0.5, 4.0]), away
    far = visible_surface(vertices + away, faces, camera_at(eye, target), height=32, width=32)
    # Positions are rounded to 2^-12 there, so that some samples near an edge fall on the other face.
    assert np.asarray(near.triangle_id == far.triangle_id).mean() > 0.97
    np.testing.assert_allclose(coverage(near), coverage(far), atol=0.25)


def test_a_background_stands_behind(sphere):
    vertices, faces = sphere
    camera = camera_at((0.0, 0.0, 4.0))
    size = {"height": 24, "width": 24}
    image, alpha = render_vertex_colors(
        vertices, faces, np.ones_like(vertices), camera, **size, background=(0.25, 0.5, 1.0)
    )
    expected = alpha[..., None] + (1 - alpha[..., None]) * np.float32([0.25, 0.5, 1.0])
    np.testing.assert_allclose(image, expected, atol=4 * EPS)
    behind = gradient_background(24, 24, top=(1.0, 0.0, 0.0), bottom=(0.0, 0.0, 1.0))
    image, _ = render_vertex_colors(vertices, faces, np.zeros_like(vertices), camera, **size, background=behind)
    np.testing.assert_allclose(image, (1 - alpha[..., None]) * behind, atol=4 * EPS)


def test_gradient_runs_from_top_to_bottom():
    image = gradient_background(5, 3, top=(1.0, 0.5, 0.0), bottom=(0.0, 0.5, 2.0))
    np.testing.assert_array_equal(image[0, 1], [1.0, 0.5, 0.0])
    np.testing.assert_array_equal(image[2, 0], [0.5, 0.5, 1.0])
    np.testing.assert_array_equal(image[4, 2], [0.0, 0.5, 2.0])
    np.testing.assert_array_equal(gradient_background(1, 1, top=(1, 2, 3), bottom=(0, 0, 0))[0, 0], [1, 2, 3])


@pytest.mark.parametrize("target", [(0, 0, -1), (0, 0, 1), (1, 0, 0), (0.3, 0.5, 0.8), (-0.6, -0.4, 0.7)])
def test_environment_is_seen_in_its_direction(target):
    """A map that holds the direction of each pixel shows the direction of each ray, across the seam as well."""
    directions, _ = environment_directions(64, 128)
    environment = (directions + 2.0).astype(np.float32)
    camera = camera_at((0.0, 0.0, 0.0), target)
    shown = environment_background(environment, camera, height=20, width=30)
    rays = np.asarray(camera_rays(camera, height=20, width=30)[1])
    # Bilinear error of sines and cosines: a quarter of the squared step (two axes of an eighth each), and rounding.
    step = math.pi / 64
    np.testing.assert_allclose(shown - 2.0, rays, atol=step**2 / 4 + 8 * EPS)


def test_environment_is_seen_at_the_poles():
    directions, _ = environment_directions(32, 64)
    environment = (directions[..., 1:2] * np.ones(3) + 2.0).astype(np.float32)
    camera = camera_at((0.0, 0.0, 0.0), (0.0, 1.0, 1e-3), fov_degrees=10.0)
    shown = environment_background(environment, camera, height=8, width=8)
    up = np.asarray(camera_rays(camera, height=8, width=8)[1])[..., 1:2]
    # The middle of the first row is half a step off the pole, 1 - cos(π/64); the bilinear error is as large.
    np.testing.assert_allclose(shown - 2.0, np.broadcast_to(up, shown.shape), atol=(math.pi / 32) ** 2 / 4)


def test_blur_keeps_constants_and_closes_around(rng):
    np.testing.assert_allclose(blur_environment(np.full((16, 32, 3), 2.5), degrees=20.0), 2.5, rtol=1e-12)
    noise = rng.uniform(0, 1, (16, 32, 3))
    turned = blur_environment(np.roll(noise, 11, axis=1), degrees=15.0)
    np.testing.assert_allclose(turned, np.roll(blur_environment(noise, degrees=15.0), 11, axis=1), rtol=1e-12)
    assert blur_environment(noise, degrees=15.0).std() < 0.5 * noise.std()


def test_lay_over_is_the_over_operator():
    image, alpha = np.full((2, 2, 3), 0.3), np.array([[0.0, 0.5], [1.0, 0.25]])
    over = lay_over(image, alpha, np.full((2, 2, 3), 2.0))
    np.testing.assert_allclose(over[..., 0], [[2.3, 1.3], [0.3, 1.8]], rtol=1e-15)


def test_samples_per_axis_is_checked(sphere):
    vertices, faces = sphere
    with pytest.raises(ValueError, match="size: expected a value >= 1, got 0"):
        visible_surface(vertices, faces, camera_at((0.0, 0.0, 4.0)), height=4, width=4, samples_per_axis=0)
