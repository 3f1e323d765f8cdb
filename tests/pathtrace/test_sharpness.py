"""Windows that follow lobes: their size at the ends, in between, and what is blended from which radii."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace.hit_points import HitSurface
from jaxrender.pathtrace.scatter import make_reflector
from jaxrender.pathtrace.sharpness import blend_windows, sharpness, window_radii
from tests.pathtrace.made_up import vec

BLEND = jax.jit(blend_windows)


def sharp(model="metallic_roughness", *, metallic=1.0, roughness=0.3, base=0.5, cosine=1.0):
    number = lambda x: jnp.full(1, x, jnp.float32)  # noqa: E731
    up = vec(np.array([[0.0, 0.0, 1.0]]))
    surface = HitSurface(
        triangle=jnp.zeros(1, jnp.int32), position=up, normal=up, geometric_normal=up, front=jnp.ones(1, bool),
        base_color=vec(np.full((1, 3), base)), alpha=number(1.0), metallic=number(metallic),
        roughness=number(roughness), emissive=vec(np.zeros((1, 3))),
    )  # fmt: skip
    direction = vec(-np.array([[np.sqrt(1.0 - cosine**2), 0.0, cosine]]))
    return float(sharpness(make_reflector(surface, direction, model=model))[0])


def test_matt_surfaces_have_the_whole_window_and_mirrors_none():
    assert sharp("lambert") == sharp(roughness=1.0) == 0.0
    assert sharp(roughness=0.0) == 1.0
    assert sharp(base=0.0, metallic=1.0) == 0.0  # nothing is reflected at all


def test_it_is_the_mirrored_share_times_what_alpha_leaves():
    np.testing.assert_allclose(sharp(roughness=0.6), 1.0 - 0.36, rtol=1e-6)
    np.testing.assert_allclose(sharp(metallic=0.0, roughness=0.1), 0.99 * 0.04 / 0.54, rtol=1e-5)


def test_a_dielectric_mirrors_at_grazing_angles():
    flat, grazing = sharp(metallic=0.0, cosine=1.0), sharp(metallic=0.0, cosine=0.05)
    assert flat < 0.1 and grazing > 0.5


def test_radii_fall_by_quarters_down_to_what_is_wanted():
    assert window_radii(16, 0.0) == (16, 4, 1, 0)
    assert window_radii(10, 0.3) == (10, 2, 1, 0)
    assert window_radii(10, 1.0) == (10, 2, 1)
    assert window_radii(3, 0.0) == (3, 1, 0)
    assert window_radii(16, 16.0) == (16,)


@pytest.mark.parametrize(
    ("wanted", "expected"), [(99.0, 1.0), (16.0, 1.0), (4.0, 10.0), (1.0, 100.0), (0.0, 1000.0), (2.1622777, 55.0)]
)
def test_each_pixel_has_its_own_radius(wanted, expected):
    levels = jnp.asarray([1.0, 10.0, 100.0, 1000.0])[:, None, None, None] * jnp.ones((4, 2, 3, 3))
    image = BLEND(levels, jnp.asarray([16.0, 4.0, 1.0, 0.0]), jnp.full((2, 3, 1), wanted))
    np.testing.assert_allclose(image, np.full((2, 3, 3), expected), rtol=1e-5)


def test_one_radius_is_that_image():
    levels = jnp.arange(18.0).reshape(1, 2, 3, 3)
    np.testing.assert_array_equal(BLEND(levels, jnp.asarray([5.0]), jnp.zeros((2, 3, 1))), levels[0])
