"""What paths ask of a scene: both backends on holes behind holes, rays that nobody wants, and scenes that move."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender import vec3
from jaxrender.pathtrace.backends import chosen_backend, told_backend
from jaxrender.pathtrace.embree_rays import EmbreeRays
from jaxrender.pathtrace.hit_points import surface_table
from jaxrender.pathtrace.paths import Rays, ShadowRays
from jaxrender.pathtrace.tree_rays import tree_rays
from jaxrender.scene import MASK, SceneImage
from tests.support.rooms import matt, room, sphere, square

HOLE = matt((0.2, 0.2, 0.2), alpha_mode=MASK, base_color_texture=0, double_sided=True)


@pytest.fixture(params=["embree", "jax"])
def open_rays(request):
    kind = {"embree": EmbreeRays, "jax": tree_rays}[request.param]
    return lambda scene: kind(scene, surface_table(scene))


def plates(heights, *, solid=(), up=0.0):
    """Plates with a square hole of half their width, one above the other, and solid ones."""
    texels = np.full((16, 16, 4), 255, np.uint8)
    texels[4:12, 4:12, 3] = 0
    parts = [square((0, y + up, 0), (1, 0, 0), (0, 0, -1), HOLE) for y in heights]
    parts += [square((0, y + up, 0), (3, 0, 0), (0, 0, -3), matt((0.5, 0.5, 0.5))) for y in solid]
    return room(*parts, images=[SceneImage("plate", texels, ("clamp", "clamp"), True)])


def down_from(x, z, y=10.0):
    origins = np.stack([x, np.full_like(x, y), z], axis=-1).astype(np.float32)
    directions = np.broadcast_to(np.float32([0.0, -1.0, 0.0]), origins.shape)
    return Rays(*(vec3.from_array(jnp.asarray(v)) for v in (origins, directions)))


def shadow(rays, distance, light):
    x = rays.origin.x
    return ShadowRays(*rays, jnp.broadcast_to(jnp.float32(distance), x.shape), vec3.Vec3(x * 0 + light, x * 0, x * 0))


#: 256 rays: as few as there are in the smallest bucket of a wavefront, which compiles soonest.
ACROSS = np.linspace(-1.4, 1.4, 16)
X, Z = (v.ravel() for v in np.meshgrid(ACROSS, ACROSS))
OUT = np.maximum(np.abs(X), np.abs(Z))
#: In the alpha's ramp from texel to texel, and at the rim, either may be.
CLEAR = (np.abs(OUT - 0.5) > 0.05) & (np.abs(OUT - 1.0) > 1e-3)
ON_PLATE = (OUT > 0.5) & (OUT < 1.0)


@pytest.mark.parametrize("solid", [(0.0,), ()])
def test_rays_pass_holes_behind_holes(open_rays, solid):
    """The highest plate stops rays off the holes; the rest goes on to the floor, if there is one."""
    rays, down = open_rays(plates((3.0, 2.0, 1.0), solid=solid)), down_from(X, Z)
    wanted = jnp.ones(len(X), bool)
    hits = rays.closest(down, wanted)
    t = np.where(ON_PLATE, 7.0, 10.0 if solid else np.inf)
    np.testing.assert_allclose(np.asarray(hits.t)[CLEAR], t[CLEAR], rtol=1e-5)
    names = np.asarray(hits.triangle)[CLEAR]
    assert set(names[ON_PLATE[CLEAR]]) == {0, 1} and set(names[~ON_PLATE[CLEAR]]) == ({6, 7} if solid else {-1})
    blocked = np.asarray(rays.blocked(shadow(down, 9.5, 1.0)))
    np.testing.assert_array_equal(blocked[CLEAR], ON_PLATE[CLEAR])
    assert not np.asarray(rays.blocked(shadow(down, 6.5, 1.0))).any()


def test_rays_that_nobody_wants_miss(open_rays):
    rays, down = open_rays(plates((3.0, 2.0, 1.0), solid=(0.0,))), down_from(X, Z)
    wanted = jnp.asarray(X > 0.0)
    hits = rays.closest(down, wanted)
    assert (np.asarray(hits.triangle)[~np.asarray(wanted)] == -1).all()
    assert (np.asarray(hits.triangle)[np.asarray(wanted)] >= 0).all()
    assert (np.asarray(rays.closest(down, wanted, reach=6.0).triangle) == -1).all()
    assert np.asarray(rays.blocked(shadow(down, 20.0, 1.0))).all()
    assert not np.asarray(rays.blocked(shadow(down, 20.0, 0.0))).any()


def test_a_scene_that_moved(open_rays):
    down, wanted = down_from(X, Z), jnp.ones(len(X), bool)
    first, lifted = (plates((3.0, 2.0, 1.0), solid=(0.0,), up=up) for up in (0.0, 0.5))
    rays = open_rays(first).moved(lifted, surface_table(lifted))
    t = np.where(ON_PLATE, 6.5, 9.5)
    np.testing.assert_allclose(np.asarray(rays.closest(down, wanted).t)[CLEAR], t[CLEAR], rtol=1e-5)
    np.testing.assert_array_equal(np.asarray(rays.blocked(shadow(down, 9.0, 1.0)))[CLEAR], ON_PLATE[CLEAR])


def test_the_backends_agree_on_random_rays(rng):
    """Through a ball of masked triangles around a solid one: the same hits but for a few at edges and rims of holes."""
    texels = rng.integers(0, 256, (8, 8, 4)).astype(np.uint8)
    outer, inner = sphere(HOLE, radius=2.0), sphere(matt((0.5, 0.5, 0.5)))
    uv = np.asarray(outer[0])[:, :2]
    scene = room((*outer, uv), inner, images=[SceneImage("noise", texels, ("repeat", "repeat"), True)])
    table = surface_table(scene)
    origins = 1.5 * rng.normal(size=(1024, 3)).astype(np.float32)
    directions = rng.normal(size=origins.shape).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = Rays(*(vec3.from_array(jnp.asarray(v)) for v in (origins, directions)))
    found, truth = (kind(scene, table) for kind in (tree_rays, EmbreeRays))
    ours, theirs = (backend.closest(rays, jnp.ones(1024, bool)) for backend in (found, truth))
    same = np.asarray(ours.triangle) == np.asarray(theirs.triangle)
    assert same.mean() > 0.995 and set(np.asarray(theirs.triangle) // 1280) == {-1, 0, 1}
    some = same & (np.asarray(theirs.triangle) >= 0)
    np.testing.assert_allclose(np.asarray(ours.t)[some], np.asarray(theirs.t)[some], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.asarray(ours.barycentrics)[some], np.asarray(theirs.barycentrics)[some], atol=1e-3)
    blocked = [np.asarray(backend.blocked(shadow(rays, 2.0, 1.0))) for backend in (found, truth)]
    assert (blocked[0] == blocked[1]).mean() > 0.995 and 0.1 < blocked[1].mean() < 0.9


def test_which_backend(monkeypatch):
    assert [chosen_backend(rays) for rays in ("auto", "embree", "jax")] == ["embree", "embree", "jax"]
    assert told_backend("embree").startswith("Embree, ") and told_backend("jax") == "tree in JAX, cpu"
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    assert [chosen_backend(rays) for rays in ("auto", "embree", "jax")] == ["jax", "embree", "jax"]
    with pytest.raises(ValueError, match="rays: expected one of auto, embree, jax, got optix"):
        chosen_backend("optix")
