"""Reflectance against integrals over the hemisphere, reciprocity, and printed special cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender import brdf
from jaxrender.vecmath import normalize
from tests.support import oracles


def hemisphere(num_z=400, num_phi=64):
    """Directions about +z and their solid angles."""
    z, w = np.polynomial.legendre.leggauss(num_z)
    z, w = 0.5 * (z + 1), 0.5 * w
    phi = 2 * np.pi * (np.arange(num_phi) + 0.5) / num_phi
    ring = np.sqrt(1 - z**2)
    d = np.stack([ring[:, None] * np.cos(phi), ring[:, None] * np.sin(phi), np.tile(z[:, None], num_phi)], -1)
    return d.reshape(-1, 3).astype(np.float32), np.repeat(w * 2 * np.pi / num_phi, num_phi)


def reflected(f, wo):
    """∫ f cos over the hemisphere for one direction to the eye."""
    wi, weight = hemisphere()
    n = np.tile(np.float32([0, 0, 1]), (len(wi), 1))
    values = np.asarray(f(jnp.asarray(wi), jnp.asarray(np.tile(wo, (len(wi), 1))), jnp.asarray(n)))
    return (weight * wi[:, 2]) @ values


def constants(n, base, metallic, roughness):
    one = jnp.ones((n, 1), jnp.float32)
    return {"base_color": jnp.tile(jnp.asarray(base, jnp.float32)[None], (n, 1)), "metallic": metallic * one,
            "roughness": roughness * one}  # fmt: skip


EYES = [np.float32([0, 0, 1]), np.float32([0.6, 0, 0.8]), np.float32([0.96, 0, 0.28])]


@pytest.mark.parametrize("wo", EYES)
@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_a_white_surface_gives_back_about_what_it_gets(wo, metallic, roughness):
    """glTF's blend of layers gains up to 9 % at grazing angles; one bounce on a rough metal loses up to 69 %."""
    white = lambda wi, wo, n: brdf.metallic_roughness(wi, wo, n, **constants(len(wi), [1, 1, 1], metallic, roughness))  # noqa: E731
    back = reflected(white, wo)
    assert (back < (1.1 if metallic == 0.0 else 1.0 + 1e-4)).all()
    assert (back > 0.3).all()


def test_the_roughest_metal_has_a_closed_form():
    """With α = 1 the normals are uniform, D = 1/π, and straight down ∫ D V cos = 1 - ln 2."""
    metal = lambda wi, wo, n: brdf.metallic_roughness(wi, wo, n, **constants(len(wi), [1, 1, 1], 1.0, 1.0))  # noqa: E731
    np.testing.assert_allclose(reflected(metal, EYES[0]), 1 - np.log(2), rtol=1e-4)


def test_lambert_and_the_phong_lobe_about_the_normal():
    np.testing.assert_allclose(
        reflected(lambda wi, wo, n: brdf.lambert(jnp.ones_like(wi) * 0.7), EYES[0]), 0.7, rtol=1e-5
    )
    for alpha in (1.0, 20.0, 300.0):
        lobe = lambda wi, wo, n, a=alpha: brdf.phong(  # noqa: E731
            wi, wo, n, specular=jnp.ones_like(wi), exponent=jnp.full((len(wi), 1), a, jnp.float32)
        )
        # (α+2)/2π ∫ cos^(α+1) = 1 seen along the normal, less anywhere else.
        np.testing.assert_allclose(reflected(lobe, EYES[0]), 1.0, rtol=1e-4)
        assert (reflected(lobe, EYES[2]) <= 1.0 + 1e-4).all()


def test_reciprocity_and_the_horizon(rng):
    wi, wo = (normalize(jnp.asarray(rng.normal(size=(50, 3)) * [1, 1, 0.6], jnp.float32)) for _ in range(2))
    n = jnp.asarray(np.tile([0.0, 0.0, 1.0], (50, 1)), jnp.float32)
    material = constants(50, [0.8, 0.5, 0.2], 0.4, 0.5)
    forth, back = brdf.metallic_roughness(wi, wo, n, **material), brdf.metallic_roughness(wo, wi, n, **material)
    np.testing.assert_allclose(forth, back, rtol=2e-5, atol=1e-7)
    below = (np.asarray(wi)[:, 2] <= 0) | (np.asarray(wo)[:, 2] <= 0)
    assert below.any() and (np.asarray(forth)[below] == 0).all() and (np.asarray(forth)[~below] > 0).all()


def test_mirror_reflectance_of_a_dielectric_is_four_percent():
    """At normal incidence D V = 1/(4π α²): f = 0.04/(4π α²) + 0.96 base/π."""
    up = jnp.asarray([[0.0, 0.0, 1.0]], jnp.float32)
    got = brdf.metallic_roughness(up, up, up, **constants(1, [0.5, 0.5, 0.5], 0.0, 0.5))
    np.testing.assert_allclose(got, 0.04 / (4 * np.pi * 0.0625) + 0.96 * 0.5 / np.pi, rtol=1e-5)


def test_gradients_agree_with_finite_differences(rng):
    wi, wo = (
        normalize(jnp.asarray(rng.normal(size=(9, 3)) * [0.5, 0.5, 0.1] + [0, 0, 1], jnp.float32)) for _ in range(2)
    )
    n = normalize(jnp.asarray(rng.normal(size=(9, 3)) * 0.1 + [0, 0, 1], jnp.float32))
    material = constants(9, [0.8, 0.5, 0.2], 0.4, 0.5)
    for name in material:
        f = lambda x, name=name: jnp.sum(brdf.metallic_roughness(wi, wo, n, **(material | {name: x})) ** 2)  # noqa: E731
        towards = jnp.asarray(rng.normal(size=material[name].shape), jnp.float32)
        h = 1e-2
        slope = (f(material[name] + h * towards) - f(material[name] - h * towards)) / (2 * h)
        np.testing.assert_allclose(jnp.sum(jax.grad(f)(material[name]) * towards), slope, rtol=3e-2, atol=1e-3)


@pytest.mark.parametrize("roughness", [0.05, 0.1, 0.2])
def test_peaks_of_smooth_surfaces_keep_their_digits(roughness, rng):
    """Half vectors within a few α of the normal, in float32 against float64."""
    n = oracles.unit(rng.normal(size=(20_000, 3)))
    wo = oracles.unit(n + 0.8 * rng.normal(size=n.shape) / np.sqrt(3))
    h = oracles.unit(n + 2 * roughness**2 * rng.normal(size=n.shape))
    wi = 2 * np.sum(h * wo, axis=1, keepdims=True) * h - wo
    seen = (np.sum(n * wo, axis=1) > 0.2) & (np.sum(n * wi, axis=1) > 0.2)

    def values(dtype):
        own = {"base_color": np.ones((1, 3)), "metallic": np.ones((1, 1)), "roughness": np.full((1, 1), roughness)}
        own = {name: jnp.asarray(np.repeat(v, seen.sum(), axis=0), dtype) for name, v in own.items()}
        vectors = (jnp.asarray(np.float32(v[seen]), dtype) for v in (wi, wo, n))
        return np.asarray(brdf.metallic_roughness(*vectors, **own))[:, 0]

    single = values(jnp.float32)
    with jax.enable_x64(True):
        double = values(jnp.float64)
    # The vectors are rounded to float32 in both: what is left is the arithmetic, times the slope of D at its flank.
    off = np.abs(single / double - 1.0)
    assert seen.sum() > 5000 and np.quantile(off, 0.99) < 2e-4 * (0.1 / roughness) ** 2 + 2e-5
