"""Light from far away: densities, drawn directions, and estimates with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.checks import InputError
from jaxrender.harmonics import environment_directions
from jaxrender.latlong import look_up_smoothly
from jaxrender.pathtrace.environment import draw_direction, look_up, make_environment, texel_of
from tests.pathtrace.made_up import rows, vec
from tests.support import oracles


def numbers(rng, n):
    return (jnp.asarray(x, jnp.float32) for x in rng.uniform(size=(2, n)).astype(np.float32))


@pytest.fixture
def image(rng):
    """With a black row, a black texel and a sun."""
    values = rng.uniform(0.0, 1.0, (6, 9, 3))
    values[3], values[1, 4], values[2, 7] = 0.0, 0.0, [50.0, 40.0, 20.0]
    return values.astype(np.float32)


def solid_angles(height, width):
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return np.repeat(-np.diff(edges)[:, None] * 2.0 * np.pi / width, width, axis=1)


def test_the_density_is_that_of_brightness_and_integrates_to_1(image):
    environment = make_environment(image)
    power = image.mean(-1) * solid_angles(6, 9)
    density = np.asarray(environment.density, np.float64)
    # The tables are float32: chances are right to its rounding of 1, over the solid angle.
    np.testing.assert_allclose(density * solid_angles(6, 9), power / power.sum(), atol=2e-7)
    np.testing.assert_allclose((density * solid_angles(6, 9)).sum(), 1.0, atol=1e-6)
    assert (density[3] == 0.0).all() and density[1, 4] == 0.0


def test_drawn_directions_follow_the_density(image, rng):
    """Chi-square over texels, each halved in height: 2 x (54 - 10) - 1 degrees of freedom."""
    environment, n = make_environment(image), 200_000
    d = rows(draw_direction(environment, *numbers(rng, n)).direction)
    assert np.abs(np.linalg.norm(d, axis=1) - 1.0).max() < 1e-6
    # Halves of equal solid angle: by the height y.
    edges = np.cos(np.linspace(0.0, np.pi, 7))
    heights = np.sort(np.concatenate([edges, 0.5 * (edges[1:] + edges[:-1])]))
    azimuth = np.arctan2(d[:, 0], -d[:, 2])
    counts, _, _ = np.histogram2d(-d[:, 1], azimuth, bins=[heights, np.linspace(-np.pi, np.pi, 10)])
    expected = np.repeat(np.asarray(environment.density, np.float64) * solid_angles(6, 9), 2, axis=0) * n / 2
    some = expected > 0.0
    # Rounding of the azimuth may take a point on the edge of a black texel over it.
    assert counts[~some].sum() < 5
    chi2 = ((counts - expected)[some] ** 2 / expected[some]).sum()
    degrees = some.sum() - 1
    assert abs(chi2 - degrees) < 4.0 * np.sqrt(2 * degrees)


def test_what_is_drawn_is_what_is_looked_up(image, rng):
    environment = make_environment(image)
    drawn = draw_direction(environment, *numbers(rng, 5000))
    found = look_up(environment, drawn.direction)
    same = np.asarray(drawn.density) == np.asarray(found.density)
    # All but those that rounding puts over the edge of a texel.
    assert same.mean() > 0.999
    np.testing.assert_array_equal(rows(drawn.radiance)[same], rows(found.radiance)[same])
    assert (np.asarray(drawn.density) > 0.0).all()


def test_texels_lie_where_the_directions_of_pixels_are():
    directions, _ = environment_directions(5, 8)
    environment = make_environment(np.ones((5, 8, 3)))
    row, column = texel_of(environment, vec(directions))
    np.testing.assert_array_equal(row, np.repeat(np.arange(5)[:, None], 8, axis=1))
    np.testing.assert_array_equal(column, np.repeat(np.arange(8)[None], 5, axis=0))


@pytest.mark.parametrize("direction", [[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [-1e-8, 0, 1], [1e-8, 0, 1]])
def test_poles_and_the_seam_are_on_the_image(direction):
    row, column = texel_of(make_environment(np.ones((5, 8, 3))), vec([direction]))
    assert 0 <= row[0] <= 4 and 0 <= column[0] <= 7
    expected = {1: 0, -1: 4}.get(direction[1], 2)
    assert row[0] == expected


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 2), (8, 16)])
def test_a_constant_image_is_drawn_evenly(shape, rng):
    environment = make_environment(np.full((*shape, 3), 0.3))
    np.testing.assert_allclose(environment.density, 1.0 / (4.0 * np.pi), rtol=1e-5)
    n = 20_000
    d = rows(draw_direction(environment, *numbers(rng, n)).direction)
    # Means of x, y, z are 0, of their products 1/3 and 0; deviations of a mean are below 1/√n of these.
    assert np.abs(d.mean(axis=0)).max() < 4.0 / np.sqrt(3 * n)
    assert np.abs(d.T @ d / n - np.eye(3) / 3).max() < 4.0 * 0.3 / np.sqrt(n)


def test_one_bright_texel_gets_all_directions(rng):
    image = np.zeros((16, 32, 3))
    image[5, 20] = [0.0, 7.0, 0.0]
    environment = make_environment(image)
    drawn = draw_direction(environment, *numbers(rng, 2000))
    assert (rows(drawn.radiance) == [0.0, 7.0, 0.0]).all()
    np.testing.assert_allclose(drawn.density, 1.0 / solid_angles(16, 32)[5, 20], rtol=1e-5)
    row, column = texel_of(environment, drawn.direction)
    assert (np.abs(row - 5) <= 0).mean() > 0.99 and (np.abs(column - 20) <= 0).mean() > 0.99


def test_a_black_image_brings_nothing_and_no_nan(rng):
    environment = make_environment(np.zeros((4, 6, 3)))
    drawn = draw_direction(environment, *numbers(rng, 100))
    assert (rows(drawn.radiance) == 0.0).all()
    np.testing.assert_allclose(drawn.density, 1.0 / (4.0 * np.pi), rtol=1e-5)


def test_the_ends_of_the_numbers_are_in_texels_with_light(image):
    largest = np.float32(1.0) - np.finfo(np.float32).epsneg
    ends = (
        jnp.asarray([0.0, 0.0, largest, largest], jnp.float32),
        jnp.asarray([0.0, largest, 0.0, largest], jnp.float32),
    )
    image[0], image[-1], image[:, 0], image[:, -1] = 0.0, 0.0, 0.0, 0.0
    drawn = draw_direction(make_environment(image), *ends)
    assert (np.asarray(drawn.density) > 0.0).all() and np.isfinite(rows(drawn.direction)).all()


@pytest.mark.parametrize("power", [1, 3])
def test_irradiance_of_a_closed_form(power, rng):
    """L = max(y, 0)^k on a fine image: E = 2π / (k + 2) on a floor, and less on one that is turned (by quadrature)."""
    directions, solid = environment_directions(128, 256)
    image = np.repeat(np.maximum(directions[..., 1:2], 0.0) ** power, 3, axis=-1)
    environment = make_environment(image)
    n = 40_000
    drawn = draw_direction(environment, *numbers(rng, n))
    for normal in ([0.0, 1.0, 0.0], oracles.unit(np.array([0.6, 0.7, -0.3]))):
        estimates = np.asarray(drawn.radiance.x / drawn.density, np.float64) * np.maximum(
            rows(drawn.direction) @ normal, 0.0
        )
        expected = (image[..., 0] * np.maximum(directions @ normal, 0.0) * solid).sum()
        if normal[1] == 1.0:
            # Texels are flat: the sum over them is the integral to the square of their size.
            np.testing.assert_allclose(expected, 2.0 * np.pi / (power + 2), rtol=1e-3)
        assert abs(estimates.mean() - expected) < 4.0 * estimates.std() / np.sqrt(n) + 1e-3 * expected


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.ones((3, 4)), r"environment: shape: expected \(h, w, 3\), got \(3, 4\)"),
        (np.ones((3, 4, 4)), r"expected \(h, w, 3\), got \(3, 4, 4\)"),
        (np.ones((0, 4, 3)), r"expected \(h, w, 3\), got \(0, 4, 3\)"),
        (np.full((2, 2, 3), np.nan), r"environment: radiance: expected finite numbers >= 0"),
        (np.full((2, 2, 3), np.inf), r"expected finite numbers >= 0"),
        (np.full((2, 2, 3), -0.1), r"expected finite numbers >= 0"),
    ],
)
def test_bad_images_are_refused(image, message):
    with pytest.raises(InputError, match=message):
        make_environment(image)


def test_compiled_is_the_same(image, rng):
    environment = make_environment(image)
    u, v = numbers(rng, 50)
    plain, compiled = draw_direction(environment, u, v), jax.jit(draw_direction)(environment, u, v)
    np.testing.assert_allclose(rows(plain.direction), rows(compiled.direction), atol=1e-6)
    np.testing.assert_array_equal(plain.density, compiled.density)


def test_the_background_is_smooth_and_meets_itself(image):
    """The texel's own radiance in its middle, the mean of two between them, also across the seam; constant at poles."""
    image = jnp.asarray(image)
    middles = environment_directions(6, 9)[0]
    seen = np.asarray(look_up_smoothly(image, vec(middles.reshape(-1, 3)))).reshape(6, 9, 3)
    np.testing.assert_allclose(seen, image, rtol=2e-5, atol=2e-5)
    theta = (np.arange(6) + 0.5) * np.pi / 6
    # Azimuth π, between the last column and the first.
    seam = np.stack([0.0 * theta, np.cos(theta), np.sin(theta)], axis=1)
    between = np.asarray(look_up_smoothly(image, vec(seam)))
    np.testing.assert_allclose(between, 0.5 * (image[:, 0] + image[:, -1]), rtol=1e-4, atol=1e-4)
    poles = np.asarray(look_up_smoothly(image, vec(np.array([[1e-3, 1.0, 0.0], [1e-3, -1.0, 0.0]]))))
    assert (poles <= np.asarray(image)[[0, -1]].max(axis=1) + 1e-6).all() and np.isfinite(poles).all()
