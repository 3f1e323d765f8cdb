"""Light as SH: sums over pixels by brute force, closed forms for discs, and the orientation of maps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxrender import harmonics
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import LONG_SUM, ROUNDING, TIGHT

project_environment = jax.jit(harmonics.project_environment, static_argnames="order")
sh_area_light = jax.jit(harmonics.sh_area_light, static_argnames="order")
sh_directional_light = jax.jit(harmonics.sh_directional_light, static_argnames="order")

WHITE = np.ones(1)


# --- Environment maps


def test_orientation_of_a_map():
    directions, solid = harmonics.environment_directions(3, 5)
    assert directions.shape == (3, 5, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-15)
    np.testing.assert_allclose(directions[1, 2], [0, 0, -1], atol=1e-15)  # the middle looks down -Z
    assert (directions[0, :, 1] > 0.8).all()  # row 0 is the sky
    assert (directions[:, 3:, 0] > 0).all()  # to the right it turns to +X
    assert (solid[1] > solid[0]).all()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (64, 128)])
def test_solid_angles_sum_to_the_sphere(height, width):
    assert harmonics.environment_directions(height, width)[1].sum() == pytest.approx(4 * np.pi, rel=1e-14)


@pytest.mark.parametrize(
    ("height", "width", "order"), [(1, 1, 3), (3, 5, 4), (2, 3, 6), (8, 16, 1), (8, 16, 4), (16, 32, 10)]
)
def test_projection_is_the_sum_over_pixels(height, width, order, rng, dtype):
    """Also where a row has fewer pixels than the harmonics have waves."""
    image = rng.uniform(0, 3, size=(height, width, 2))
    directions, solid = harmonics.environment_directions(height, width)
    expected = np.einsum("hwc,hw,hwk->ck", image, solid, oracles.real_harmonics(directions, order))
    got = project_environment(jnp.asarray(image, dtype), order=order)
    assert got.dtype == dtype
    # Pixels and waves cancel in the high bands: the scale is that of band 0.
    assert_close(got, expected, ulps=TIGHT if dtype == np.float64 else ROUNDING, dtype=dtype)


def test_projection_of_a_large_map_with_a_sun_in_float32(rng):
    image = rng.uniform(0, 1, size=(256, 512, 3)).astype(np.float32)
    image[60, 300] = 3e4
    got = project_environment(jnp.asarray(image), order=4)
    with jax.enable_x64(True):
        expected = project_environment(jnp.asarray(image, jnp.float64), order=4)
    # Sums over 512 columns and 256 rows.
    assert_close(got, expected, ulps=LONG_SUM / 4, dtype=np.float32)


def test_constant_map_is_a_constant(x64):
    """Sampling at pixel centres leaves an error in the even zonal bands about +Y, of second order in the pixel."""
    errors = []
    for height in (16, 32, 64):
        got = project_environment(np.full((height, 2 * height, 1), 2.5), order=6)[0]
        assert float(got[0]) == pytest.approx(2.5 * np.sqrt(4 * np.pi), rel=1e-13)
        errors.append(float(np.abs(got[1:]).max()))
    assert errors[-1] < 3e-3
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)


def test_one_bright_pixel_is_a_lamp_at_infinity(x64):
    image = np.zeros((8, 16, 3))
    image[2, 11] = [5.0, 0.0, 2.0]
    directions, solid = harmonics.environment_directions(8, 16)
    lamp = sh_directional_light(directions[2, 11], image[2, 11] * solid[2, 11], order=5)
    assert_close(project_environment(image, order=5), lamp, ulps=TIGHT)


def test_projection_under_vmap_and_its_gradient(rng):
    images = jnp.asarray(rng.uniform(size=(2, 4, 8, 3)), jnp.float32)
    got = jax.jit(jax.vmap(lambda x: harmonics.project_environment(x, order=3)))(images)
    looped = jnp.stack([harmonics.project_environment(x, order=3) for x in images])
    assert_close(got, looped, ulps=16, dtype=np.float32)
    # Linear: the gradient of Σ_k c_k is the weight of a pixel, solid angle times Σ_k y_k.
    slope = jax.grad(lambda x: jnp.sum(harmonics.project_environment(x, order=3)))(images[0])
    directions, solid = harmonics.environment_directions(4, 8)
    expected = solid * oracles.real_harmonics(directions, 3).sum(-1)
    expected = np.broadcast_to(expected[..., None], slope.shape)
    assert_close(slope, expected, ulps=ROUNDING, dtype=np.float32)


@pytest.mark.parametrize("columns", [0, 1, 5, -3, 16, 37])
def test_rotating_a_map_is_rotating_its_coefficients(columns, rng, x64):
    image, angle = rng.uniform(size=(6, 16, 2)), columns * 2 * np.pi / 16
    turned = project_environment(harmonics.rotate_environment(jnp.asarray(image), angle), order=4)
    about_y = Rotation.from_euler("y", angle).as_matrix()
    expected = harmonics.sh_rotate(project_environment(image, order=4), jnp.asarray(about_y)[None])
    assert_close(turned, expected, ulps=TIGHT)


def test_rotating_a_map_takes_whole_columns():
    image = jnp.arange(8.0).reshape(1, 8, 1)
    column = 2 * np.pi / 8
    assert (harmonics.rotate_environment(image, 0.4 * column) == image).all()
    # Counter-clockwise seen from above: what was in column 3 (ahead) moves to the left.
    assert harmonics.rotate_environment(image, 0.6 * column)[0, :, 0].tolist() == [1, 2, 3, 4, 5, 6, 7, 0]


# --- Lamps


def test_directional_light_is_a_point(rng, x64):
    """The coefficients of δ_d are y(d): ∫ δ_d f = f(d)."""
    d, f = oracles.unit(rng.normal(size=3)), rng.normal(size=25)
    light = sh_directional_light(d, np.array([2.0, 0.5]), order=5)
    values = oracles.real_harmonics(d, 5) @ f
    assert_close(np.asarray(light) @ f, np.array([2.0, 0.5]) * values, ulps=TIGHT)


@pytest.mark.parametrize("radius", [0.02, 0.5, 1.3, np.pi / 2, 2.5, 3.1])
@pytest.mark.parametrize("order", [1, 2, 10])
def test_disc_is_the_integral_over_its_cap(radius, order, x64):
    profile = oracles.zonal_coefficients(np.ones_like, order, np.cos(radius), 1.0)
    up = sh_area_light(np.array([0.0, 0.0, 1.0]), np.array(radius), WHITE, order=order)[0]
    centres = np.arange(order) * (np.arange(order) + 1)
    # The oracle integrates from cos r, which has lost digits at r = 0.02.
    assert_close(np.asarray(up)[centres], profile, ulps=64 * TIGHT)
    assert np.count_nonzero(up) <= order


def test_disc_closed_forms(x64):
    d = oracles.unit(np.array([1.0, -2.0, 0.5]))
    everywhere = sh_area_light(d, np.array(np.pi), WHITE, order=6)[0]
    assert_close(everywhere, np.sqrt(4 * np.pi) * np.eye(36)[0], ulps=TIGHT)
    half = sh_area_light(d, np.array(np.pi / 2), WHITE, order=6)[0]
    assert_close(half, harmonics.zh_to_sh(harmonics.hemisphere_zh(order=6), d), ulps=TIGHT)
    # A disc and the disc that it leaves on the other side make the sphere.
    rest = sh_area_light(-d, np.array(np.pi - 0.4), WHITE, order=6)[0]
    assert_close(sh_area_light(d, np.array(0.4), WHITE, order=6)[0] + rest, everywhere, ulps=TIGHT)
    assert not np.any(sh_area_light(d, np.array(0.0), WHITE, order=6))


@pytest.mark.parametrize("radius", [1e-2, 1e-3, 1e-5])
def test_small_disc_is_a_lamp_without_cancellation(radius):
    """In float32: solid angle 4π sin²(r/2) times a point, up to (l r)² / 8 in band l."""
    d = jnp.asarray(oracles.unit(np.array([0.3, 0.9, -0.2])), jnp.float32)
    disc = sh_area_light(d, jnp.asarray(radius, jnp.float32), jnp.ones(1), order=4)
    point = sh_directional_light(d, jnp.full(1, 4 * np.pi * np.sin(radius / 2) ** 2), order=4)
    np.testing.assert_allclose(disc, point, rtol=(4 * radius) ** 2 / 8 + 64 * np.finfo(np.float32).eps, atol=0)


def test_disc_gradients(x64):
    d = oracles.unit(np.array([1.0, -2.0, 0.5]))
    light = functools.partial(sh_area_light, order=5)
    check_grads(light, (d, np.array(0.8), np.array([2.0, 1.0])), order=1, modes=["rev"])
    for radius in (0.0, np.pi):
        slope = jax.jacfwd(lambda r: harmonics.sh_area_light(d, r, WHITE, order=5))(jnp.asarray(radius))
        # dz_l/dr = 2π √((2l+1)/4π) sin r P_l(cos r), and sin π is 1e-16.
        assert np.abs(slope).max() < 1e-14


def test_lamps_broadcast(rng):
    d = jnp.asarray(oracles.unit(rng.normal(size=(4, 1, 3))), jnp.float32)
    radiance = jnp.asarray(rng.uniform(size=(1, 2, 3)), jnp.float32)
    points = sh_directional_light(d, radiance, order=3)
    discs = sh_area_light(d, jnp.full((1, 2), 0.3), radiance, order=3)
    assert points.shape == discs.shape == (4, 2, 3, 9)
    assert points.dtype == discs.dtype == jnp.float32
    one = harmonics.sh_area_light(d[2, 0], jnp.asarray(0.3), radiance[0, 1], order=3)
    assert_close(one, discs[2, 1], ulps=8, dtype=np.float32)
    one = harmonics.sh_directional_light(d[2, 0], radiance[0, 1], order=3)
    assert_close(one, points[2, 1], ulps=8, dtype=np.float32)


# --- Window


def test_window_is_a_raised_cosine_over_bands(rng, x64):
    v = rng.normal(size=(2, 25))
    got = np.asarray(harmonics.sh_window(v, width=3.0))
    factors = [1.0, 0.75, 0.25, 0.0, 0.0]
    assert_close(got, v * np.repeat(factors, [1, 3, 5, 7, 9]), ulps=4)


def test_window_calms_the_ringing_of_a_lamp(x64):
    d = np.array([0.0, 0.0, 1.0])
    lamp = sh_directional_light(d, WHITE, order=4)[0]
    nodes = oracles.sphere_rule(40)[0]
    raw, calm = (oracles.real_harmonics(nodes, 4) @ np.asarray(v) for v in (lamp, harmonics.sh_window(lamp, width=5.0)))
    assert raw.min() < 0
    assert calm.min() > 0.25 * raw.min()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: harmonics.project_environment(jnp.zeros((4, 8)), order=3), r"image: expected shape \(h, w, c\)"),
        (lambda: harmonics.project_environment(jnp.zeros((4, 8, 3)), order=0), "order: expected a value >= 1"),
        (lambda: harmonics.sh_area_light(jnp.zeros(3), jnp.ones(()), jnp.ones(3), order=0), "order: expected"),
        (lambda: harmonics.sh_window(jnp.zeros(9), width=0.0), "width: expected a value >= 1e-06, got 0.0"),
        (lambda: harmonics.sh_window(jnp.zeros(10), width=3.0), "sh: expected 9 coefficients"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
