"""Slopes of the G-buffer, of materials and of shading against finite differences in float64, and at the hard points."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.gbuffer import GBuffer, make_gbuffer
from jaxrender.deferred.raster import Fragments
from jaxrender.deferred.samples import ordered_grid
from jaxrender.deferred.shade import TEXTURE_SLOTS, Surface, incoming, look_up_surface, shade
from jaxrender.deferred.texture import Textures
from jaxrender.deferred.triangles import ScreenTriangles
from jaxrender.scene import Lights, Material, Scene
from tests.support import scenes

compiled = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})

EYE = np.array([0.2, 1.5, 2.5])


def record(kind, fields):
    """A record of arrays, from NumPy."""
    return kind(**{name: jnp.asarray(x) if isinstance(x, np.ndarray) else x for name, x in fields.items()})


def check(function, free, *, step=2e-6):
    """Slopes of a random mix of all outputs in each of some arrays, along a random direction.

    Per unit of x, a mirror changes by some hundreds of its value and its third derivative by the third power of that:
    with this step a relative 10⁻⁷, and rounding is no more.
    """

    @compiled
    @jax.value_and_grad
    def mixed(free):
        rng = np.random.default_rng(3)
        return sum(jnp.sum(x * rng.normal(size=x.shape)) for x in jax.tree.leaves(function(free)))

    free = {name: np.asarray(x) for name, x in free.items()}
    _, slopes = mixed(free)
    rng = np.random.default_rng(4)
    for name, x in free.items():
        direction = rng.normal(size=x.shape)
        exact = np.sum(np.asarray(slopes[name]) * direction)
        (after, _), (before, _) = (mixed(free | {name: x + h * direction}) for h in (step, -step))
        np.testing.assert_allclose(exact, (after - before) / (2.0 * step), rtol=1e-6, atol=1e-6, err_msg=name)
        assert abs(exact) > 1e-3, f"{name} changes nothing"


def small_gbuffer(rng, *shape):
    """Samples on bent normals, of all materials, some empty."""
    ids = np.arange(np.prod(shape), dtype=np.int32).reshape(shape) % 5 - 1
    flat = scenes.unit(rng.normal(size=(*shape, 3)) * 0.5 + [0.0, 1.0, 0.3])
    return record(GBuffer, {
        "position": rng.uniform(-1.0, 1.0, (*shape, 3)),
        "normal": scenes.unit(flat + 0.3 * rng.normal(size=(*shape, 3))), "geometric_normal": flat,
        "uv": 1.5 * rng.normal(size=(*shape, 2)), "duv_dx": 0.3 * rng.normal(size=(*shape, 2)),
        "duv_dy": 0.1 * rng.normal(size=(*shape, 2)), "color": rng.uniform(0.2, 1.0, (*shape, 4)),
        "depth": np.full(shape, 2.0), "material_id": ids, "triangle_id": ids,
    })  # fmt: skip


def small_surface(rng, *shape):
    """Materials from rough plastics to half metals."""
    bounds = {"base_color": (0.1, 1.0, 3), "metallic": (0.1, 0.9, 1), "roughness": (0.4, 1.0, 1),
              "emissive": (0.0, 0.2, 3), "occlusion": (0.0, 1.0, 1)}  # fmt: skip
    fields = {name: rng.uniform(low, high, (*shape, n)) for name, (low, high, n) in bounds.items()}
    return record(Surface, {**fields, "alpha": np.ones(shape)})


def test_shade(rng, x64):
    """The other models are compared with a twin's slopes in tests/twins/test_shading.py."""
    gbuffer, surface, lights = small_gbuffer(rng, 5), small_surface(rng, 5), record(Lights, scenes.lights())
    free = {
        **{name: getattr(lights, name) for name in ("intensity", "position", "direction")},
        **{name: getattr(surface, name) for name in ("base_color", "metallic", "roughness", "emissive", "occlusion")},
        "normal": gbuffer.normal, "at": gbuffer.position, "eye": EYE, "ambient": rng.normal(size=(3, 9)) + np.eye(1, 9),
    }  # fmt: skip

    def radiance(free):
        own = lambda record: {f.name: free[f.name] for f in dataclasses.fields(record) if f.name in free}  # noqa: E731
        at = {"normal": free["normal"], "position": free["at"]}
        return shade(
            dataclasses.replace(gbuffer, **at), dataclasses.replace(surface, **own(surface)),
            dataclasses.replace(lights, **own(lights)), free["eye"], ambient=free["ambient"],
        )  # fmt: skip

    check(radiance, free)


def test_surface_in_texels_factors_and_uv(rng, x64):
    gbuffer, material = small_gbuffer(rng, 9), record(Material, scenes.material(rng))
    textures = record(Textures, scenes.textures(rng))
    factors, slots = ("base_color", "metallic", "roughness", "emissive", "occlusion_strength"), TEXTURE_SLOTS[:3]
    free = {name: getattr(material, name) for name in factors}
    free |= {"texels": textures.texels, "uv": gbuffer.uv, "color": gbuffer.color}

    def surface(free):
        return look_up_surface(
            dataclasses.replace(gbuffer, uv=free["uv"], color=free["color"]),
            dataclasses.replace(material, **{name: free[name] for name in factors}),
            dataclasses.replace(textures, texels=free["texels"]), max_anisotropy=2, slots=slots,
        )  # fmt: skip

    check(surface, free)


def made_up_fragments(rng, faces):
    """Any weights in any triangles, on any screen triangles: slopes do not ask whether they fit."""
    count, shape = len(faces), (2, 3, 4)
    xy = rng.integers(-4000, 4000, (count, 3, 2))
    a, b = (xy[:, k] - xy[:, 0] for k in (1, 2))
    area = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1e5).astype(float)
    own = np.arange(count, dtype=np.int32)
    triangles = ScreenTriangles(
        xy=xy.astype(np.int32), z=rng.uniform(size=(count, 3)), w=rng.uniform(1.0, 3.0, (count, 3)),
        weights=np.tile(np.eye(3), (count, 1, 1)), area=area, source=own, order=own, front=rng.random(count) < 0.7,
        valid=np.ones(count, bool),
    )  # fmt: skip
    ids = rng.integers(-1, count, shape).astype(np.int32)
    return Fragments(
        triangle_id=ids, screen_id=ids, barycentrics=rng.uniform(0.1, 0.4, (*shape, 2)),
        depth=rng.uniform(size=shape), w=rng.uniform(1.0, 3.0, shape), faces=faces, triangles=triangles,
        samples=ordered_grid(2),
    )  # fmt: skip


def test_gbuffer_in_what_the_scene_has_by_vertex(rng, x64):
    """With normal maps, which are looked up where uv says and turned by tangents."""
    arrays = scenes.scene(rng)
    material, lights = record(Material, scenes.material(rng)), record(Lights, scenes.lights())
    scene = record(Scene, {**arrays, "material": material, "lights": lights, "cameras": (), "name": "small"})
    textures = record(Textures, scenes.textures(rng))
    fragments = jax.tree.map(jnp.asarray, made_up_fragments(rng, arrays["faces"]))
    names = ("positions", "normals", "tangents", "uv", "colors")
    previous = np.concatenate(
        [rng.normal(size=(len(arrays["uv"]), 3)), rng.uniform(1.0, 2.0, (len(arrays["uv"]), 1))], 1
    )
    free = {name: arrays[name] for name in names} | {"previous": previous, "texels": textures.texels}

    def gbuffer(free):
        made = make_gbuffer(
            dataclasses.replace(scene, **{name: free[name] for name in names}), fragments, max_anisotropy=1,
            textures=dataclasses.replace(textures, texels=free["texels"]), previous_clip=free["previous"],
        )  # fmt: skip
        return {f.name: x for f in dataclasses.fields(made) if (x := getattr(made, f.name)).dtype == jnp.float64}

    # The slopes of planes are made of whole numbers in float32 there.
    with jax.numpy_dtype_promotion("standard"):
        check(gbuffer, free)


@pytest.mark.parametrize("model", ["metallic_roughness", "phong"])
def test_hard_points(rng, model):
    """Finite values and slopes: lamp, eye and surface in one place, no normal, light along the mirror or against it."""
    rows = {
        "plain": {}, "no normal": {"normal": [0.0, 0.0, 0.0], "geometric_normal": [0.0, 0.0, 0.0]},
        "at the lamp": {"position": [0.0, 2.0, 0.0]}, "at the eye": {"position": [0.0, 1.0, 0.0]},
        "a mirror": {"roughness": [0.0]}, "a black metal": {"base_color": [0.0, 0.0, 0.0], "metallic": [1.0]},
        "edge on": {"normal": [1.0, 0.0, 0.0], "geometric_normal": [1.0, 0.0, 0.0]},
    }  # fmt: skip
    base = {"position": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0], "geometric_normal": [0.0, 1.0, 0.0],
            "base_color": [0.5, 0.6, 0.7], "metallic": [0.5], "roughness": [0.5]}  # fmt: skip
    free = {name: jnp.asarray([row.get(name, base[name]) for row in rows.values()], jnp.float32) for name in base}
    # Straight above, where the eye is; from below; from the side; a lamp above, and a spot at the eye.
    directions = [[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, -1.0, 0.0]]
    position = np.array([[0.0, 0, 0]] * 3 + [[0.0, 2, 0], [0.0, 1, 0]])
    lights = {
        "kind": np.array([0, 0, 0, 1, 2], np.int32), "position": position, "direction": np.array(directions),
        "intensity": np.ones((5, 3)), "range": np.full(5, 9.0), "cos_inner": np.full(5, 0.9),
        "cos_outer": np.full(5, 0.5),
    }  # fmt: skip
    lights = record(Lights, {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in lights.items()})
    count = len(rows)
    zero, one = jnp.zeros((count, 1), jnp.float32), jnp.ones((count, 1), jnp.float32)
    own = jnp.zeros(count, jnp.int32)

    def radiance(free, lights, ambient):
        pair, triple = zero.repeat(2, 1), zero.repeat(3, 1)
        gbuffer = GBuffer(
            free["position"], free["normal"], free["geometric_normal"], pair, pair, pair, one.repeat(4, 1), one[:, 0],
            own, own,
        )  # fmt: skip
        surface = Surface(free["base_color"], one[:, 0], free["metallic"], free["roughness"], triple, one)
        return shade(gbuffer, surface, lights, jnp.asarray([0.0, 1.0, 0.0], jnp.float32), ambient=ambient, model=model)

    around = jnp.asarray(rng.normal(size=(3, 4)), jnp.float32)
    total = lambda *free: jnp.sum(radiance(*free))  # noqa: E731
    whole = compiled(jax.value_and_grad(total, argnums=(0, 1, 2), allow_int=True))
    for leaf in jax.tree.leaves(whole(free, lights, around)):
        assert leaf.dtype == jax.dtypes.float0 or np.isfinite(leaf).all()


def test_a_light_without_end_has_no_slope_in_its_range(x64):
    light = record(Lights, {name: np.array(values[1]) for name, values in scenes.lights().items()})
    at = jnp.asarray([[0.3, 0.2, 0.1]])
    total = lambda light: jnp.sum(incoming(light, at)[1])  # noqa: E731
    with jax.debug_nans(False):
        assert compiled(jax.grad(total, allow_int=True))(light).range == 0.0
