"""Run-time steps 2 to 5 against brute-force integrals over the sphere and against the steps taken one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.harmonics.relight import (
    membrane,
    phong_transfer,
    relight,
    relight_diffuse,
    rotate_lobes,
    shade_transfer,
)
from jaxrender.harmonics.sh import sh_basis, sh_rotate
from jaxrender.harmonics.zh import lobes_to_sh
from jaxrender.vecmath import normalize, reflection_frame
from tests.support.asserts import assert_close

NUM_VERTICES, NUM_LOBES = 7, 2
#: Sums of a few hundred float64 products, of either sign.
ULPS = 2000


pytestmark = pytest.mark.usefixtures("x64")


@pytest.fixture
def scene(x64):
    """Vertices with lobes, offsets and frames, a colored order-4 light and an eye; float64."""
    rng = np.random.default_rng(5)
    unit = lambda *shape: normalize(jnp.asarray(rng.normal(size=(*shape, 3))))  # noqa: E731
    frames = np.linalg.qr(rng.normal(size=(NUM_VERTICES, 3, 3)))[0]
    frames[np.linalg.det(frames) < 0, :, 0] *= -1
    return {
        "axes": unit(NUM_VERTICES, NUM_LOBES),
        "coefficients": jnp.asarray(rng.normal(size=(NUM_VERTICES, NUM_LOBES, 4))),
        "frames": jnp.asarray(frames),
        "light": jnp.asarray(rng.normal(size=(3, 16))),
        "albedo": jnp.asarray(rng.uniform(size=(NUM_VERTICES, 3))),
        "offset": jnp.asarray(rng.normal(size=(NUM_VERTICES, 16))),
    }


@pytest.fixture
def view(x64):
    rng = np.random.default_rng(6)
    return {"positions": jnp.asarray(rng.normal(size=(NUM_VERTICES, 3))), "eye": jnp.asarray([0.4, 2.0, 5.0])}


def lobe_integrals(scene, axis, alpha):
    """albedo · (α+1)/2π ∫ V(s) L(s) max(0, s·axis)^α ds, over the half where the lobe is smooth."""
    z, w = np.polynomial.legendre.leggauss(64)
    z, w = 0.5 * (z + 1), 0.5 * w  # the upper half only
    phi = 2 * np.pi * (np.arange(32) + 0.5) / 32
    ring = np.sqrt(1 - z**2)
    local = np.stack([ring[:, None] * np.cos(phi), ring[:, None] * np.sin(phi), np.tile(z[:, None], 32)], -1)
    weights = np.repeat(w * 2 * np.pi / 32, 32) * np.repeat(z**alpha, 32) * (alpha + 1) / (2 * np.pi)
    result = []
    for v in range(NUM_VERTICES):
        n = np.asarray(axis[v])
        t = np.cross(n, [0.3, 0.5, 0.8])
        t /= np.linalg.norm(t)
        s = local.reshape(-1, 3) @ np.stack([t, np.cross(n, t), n])
        own = jnp.asarray(s @ np.asarray(scene["frames"][v]))  # world to vertex frame
        visibility = lobes_to_sh(scene["coefficients"][v], scene["axes"][v]) + scene["offset"][v]
        seen = np.asarray(sh_basis(own, order=4)) @ np.asarray(visibility)
        radiance = np.asarray(sh_basis(jnp.asarray(s), order=4)) @ np.asarray(scene["light"]).T
        result.append(np.asarray(scene["albedo"][v]) * ((weights * seen) @ radiance))
    return np.array(result)


def mirrored(scene, view):
    wo = np.asarray(normalize(view["eye"][None] - view["positions"]))
    n = np.asarray(scene["frames"][..., 2])
    return 2 * np.sum(n * wo, axis=-1, keepdims=True) * n - wo


@pytest.mark.parametrize("alpha", [0.0, 1.0, 7.5, 60.0])
def test_relight_is_the_integral_over_the_mirrored_lobe(scene, view, alpha):
    got = relight(**scene, **view, exponent=jnp.asarray(alpha))
    np.testing.assert_allclose(got, lobe_integrals(scene, mirrored(scene, view), alpha), atol=1e-10)


def test_diffuse_is_the_cosine_integral(scene):
    got = relight_diffuse(**scene)
    np.testing.assert_allclose(got, lobe_integrals(scene, scene["frames"][..., 2], 1.0), atol=1e-10)


@pytest.mark.parametrize("alpha", [1.0, 12.25])
def test_relight_is_the_steps_of_the_paper(scene, view, alpha):
    """Lobes turned into the reflection frame (2), to SH (3), M^α (4), dotted with the light turned there (5)."""
    wo = normalize(view["eye"][None] - view["positions"])
    world_from_reflection = reflection_frame(wo, scene["frames"][..., 2])
    reflection_from_vertex = jnp.swapaxes(world_from_reflection, -1, -2) @ scene["frames"]
    visibility = lobes_to_sh(scene["coefficients"], rotate_lobes(scene["axes"], reflection_from_vertex))
    visibility = visibility + sh_rotate(scene["offset"], reflection_from_vertex)
    transfer = phong_transfer(visibility, jnp.asarray(alpha))
    steps = shade_transfer(transfer, world_from_reflection, scene["light"], scene["albedo"])
    assert_close(relight(**scene, **view, exponent=jnp.asarray(alpha)), steps, ulps=ULPS)


def test_one_exponent_each_is_each_on_its_own(scene, view):
    alphas = jnp.linspace(0.5, 200.0, NUM_VERTICES)
    together = relight(**scene, **view, exponent=alphas)
    for v in range(NUM_VERTICES):
        assert_close(together[v], relight(**scene, **view, exponent=alphas[v])[v], ulps=ULPS)


def test_the_viewer_is_local(scene, view):
    """Each vertex mirrors its own direction to the eye; moving the eye along that line changes nothing there."""
    colors = relight(**scene, **view, exponent=jnp.asarray(20.0))
    nearer = view | {"eye": view["positions"][0] + 0.25 * (view["eye"] - view["positions"][0])}
    moved = relight(**scene, **nearer, exponent=jnp.asarray(20.0))
    assert_close(moved[0], colors[0], ulps=ULPS)
    assert np.abs(np.asarray(moved - colors)[1:]).max() > 1e-3


def test_turning_everything_changes_nothing(scene, view):
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0])
    turn = turn * jnp.sign(jnp.linalg.det(turn))
    turned = scene | {
        "frames": jnp.einsum("ij,vjk->vik", turn, scene["frames"]),
        "light": sh_rotate(scene["light"], jnp.broadcast_to(turn, (3, 3, 3))),
    }
    moved = {"positions": view["positions"] @ turn.T, "eye": turn @ view["eye"]}
    exponent = jnp.asarray(9.0)
    expected = relight(**scene, **view, exponent=exponent)
    np.testing.assert_allclose(relight(**turned, **moved, exponent=exponent), expected, atol=1e-12)


def test_the_membrane_is_a_diffuse_front_and_an_unshadowed_back(scene):
    opaque = membrane(**scene, transmission=jnp.zeros(3))
    assert_close(opaque, relight_diffuse(**scene), ulps=ULPS)
    dark = membrane(**scene, transmission=jnp.ones(3)) - opaque
    occluded = scene | {"coefficients": jnp.zeros_like(scene["coefficients"]), "offset": None}
    assert_close(dark, membrane(**occluded, transmission=jnp.ones(3)), ulps=ULPS)


@pytest.mark.parametrize("name", ["light", "exponent", "eye", "axes", "albedo"])
def test_gradients_agree_with_finite_differences(scene, view, name):
    arguments = scene | view | {"exponent": jnp.asarray(6.0)}

    def brightness(value):
        return jnp.sum(relight(**(arguments | {name: value})) ** 2)

    rng = np.random.default_rng(1)
    at, towards = arguments[name], jnp.asarray(rng.normal(size=arguments[name].shape))
    h = 1e-5
    slope = (brightness(at + h * towards) - brightness(at - h * towards)) / (2 * h)
    np.testing.assert_allclose(jnp.sum(jax.grad(brightness)(at) * towards), slope, rtol=1e-6)


@pytest.mark.parametrize("alpha", [0.0, 1.0, 30.0, 1000.0])
def test_the_lobe_keeps_its_energy(scene, view, alpha):
    """A point that sees the whole sphere under light of one value everywhere reflects all of it, for each α."""
    sphere = jnp.zeros((NUM_VERTICES, 16)).at[:, 0].set(jnp.sqrt(4 * jnp.pi))
    open_scene = scene | {"coefficients": jnp.zeros_like(scene["coefficients"]), "offset": sphere}
    white = open_scene | {"light": jnp.zeros((3, 16)).at[:, 0].set(jnp.sqrt(4 * jnp.pi))}
    assert_close(relight(**white, **view, exponent=jnp.asarray(alpha)), scene["albedo"], ulps=ULPS)
