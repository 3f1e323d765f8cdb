"""brdf, G-buffer, shading and the late depth test against the twins: kernel by kernel, then the whole.

The G-buffer is made of fragments that both sides share, so that it can be compared in float64: those of the twin's
rasteriser, with jaxrender's screen triangles.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from jaxrender.deferred import gbuffer as ours
from jaxrender.deferred import late as ours_late
from jaxrender.deferred import raster
from jaxrender.deferred import samples as layouts
from jaxrender.deferred.shade import look_up_surface, shade
from tests.support import scenes
from tests.support.asserts import assert_close, leaves
from tests.support.cases import Record
from tests.support.tolerances import ROUNDING, TIGHT
from tests.twins import both
from tests.twins.agreement import cases_of, check
from torchref.deferred import gbuffer as theirs
from torchref.deferred import late as theirs_late
from torchref.deferred import raster as twin
from torchref.deferred import samples as twin_layouts
from torchref.deferred import shade as twin_shade

LAYOUTS = {"center": ("ordered_grid", 1), "grid2": ("ordered_grid", 2), "msaa4": ("standard_pattern", 4)}
NO_OPTIMIZATION = {"xla_backend_optimization_level": 0}


@pytest.mark.parametrize(("case", "dtype"), cases_of("brdf.", "deferred.shade.", "deferred.late."))
def test_twin(case, dtype):
    check(case, dtype)


# --- Fragments that both sides share


@functools.cache
def data() -> dict[str, Any]:
    """The scene and its textures as records, and clip positions of this picture and of one before."""
    rng = np.random.default_rng(5)
    arrays = scenes.scene(rng)
    parts = {"material": scenes.material(rng), "lights": scenes.lights()}
    records = {name: Record(f"scene.{name.capitalize()}", fields) for name, fields in parts.items()}
    return {
        "scene": Record("scene.Scene", {**arrays, **records, "cameras": (), "name": "small"}),
        "textures": Record("deferred.texture.Textures", scenes.textures(rng)),
        "clip": scenes.clip(arrays["positions"]),
        "previous_clip": scenes.clip(arrays["positions"], eye=np.array([0.2, 1.2, 3.4])),
        "faces": arrays["faces"],
    }


@functools.cache
def twin_fragments(layout: str) -> twin.Fragments:
    name, count = LAYOUTS[layout]
    clip, faces = torch.tensor(data()["clip"], dtype=torch.float64), torch.tensor(data()["faces"]).long()
    return twin.rasterize(clip, faces, **scenes.SIZE, samples=getattr(twin_layouts, name)(count))


@functools.cache
def screen_triangles(layout: str) -> dict[str, np.ndarray]:
    """Fields of jaxrender's screen triangles, with the whole numbers' area."""
    name, count = LAYOUTS[layout]
    samples = getattr(layouts, name)(count)
    with jax.enable_x64(False):
        clip, faces = (jnp.asarray(data()[name]) for name in ("clip", "faces"))
        found = raster.screen_triangles(clip, faces, **scenes.SIZE, samples=samples)
    fields = {f.name: np.asarray(getattr(found, f.name)) for f in dataclasses.fields(found)}
    a, b = (fields["xy"][:, k].astype(float) - fields["xy"][:, 0] for k in (1, 2))
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return fields | {"area": np.where(area > 0, area, 1.0)}


def fragments(layout: str, dtype: Any) -> tuple[raster.Fragments, twin.Fragments]:
    """The same in both packages. Of a cut triangle, the largest piece stands for all: they lie in one plane."""
    other, fields = twin_fragments(layout), screen_triangles(layout)
    ids = other.triangle_id.numpy()
    own = (fields["source"][:, None] == np.arange(len(data()["faces"]))) & fields["valid"][:, None]
    largest = np.argmax(np.where(own, fields["area"][:, None], 0.0), axis=0)
    as_dtype = lambda x: x.astype(dtype) if x.dtype.kind == "f" else x  # noqa: E731
    triangles = raster.ScreenTriangles(**{name: jnp.asarray(as_dtype(values)) for name, values in fields.items()})
    name, count = LAYOUTS[layout]
    mine = raster.Fragments(
        triangle_id=jnp.asarray(ids, jnp.int32),
        screen_id=jnp.asarray(np.where(ids >= 0, largest[ids], -1), jnp.int32),
        **{name: jnp.asarray(as_dtype(getattr(other, name).numpy())) for name in ("barycentrics", "depth", "w")},
        faces=jnp.asarray(data()["faces"]), triangles=triangles, samples=getattr(layouts, name)(count),
    )  # fmt: skip
    narrow = torch.float64 if dtype == np.float64 else torch.float32
    names = ("barycentrics", "depth", "w", "clip")
    return mine, dataclasses.replace(other, **{name: getattr(other, name).to(narrow) for name in names})


@pytest.fixture
def dtype(request):
    """The test runs in either precision; jaxrender's slopes of planes start from float32 in both."""
    promotion = "standard" if request.param == np.float64 else "strict"
    with jax.enable_x64(request.param == np.float64), jax.numpy_dtype_promotion(promotion):
        yield request.param


def slope_scale(mine: raster.Fragments) -> tuple[np.ndarray, np.ndarray]:
    """The size of the terms that a derivative of uv is summed up from, and what snapping may change of their sum.

    The terms cancel where w hardly changes. A corner that moves by a snapped unit turns its triangle's planes by that
    unit over the triangle's height.
    """
    row = np.maximum(np.asarray(mine.screen_id), 0)
    t = {f.name: np.asarray(getattr(mine.triangles, f.name))[row] for f in dataclasses.fields(mine.triangles)}
    xy = t["xy"].astype(float)
    edges = np.abs(np.roll(xy, -1, axis=-2) - np.roll(xy, -2, axis=-2)).max(-1)
    over_height = edges / t["area"][..., None]
    uv = data()["scene"].fields["uv"][data()["faces"][np.maximum(np.asarray(mine.triangle_id), 0)]]
    slopes = (over_height / t["w"]).sum(-1) * 256.0 * mine.samples.grid
    scale = np.asarray(mine.w) * slopes * np.abs(uv - uv[..., :1, :]).max((-1, -2))
    return scale[..., None], (scale * over_height.max(-1))[..., None]


# --- The G-buffer

FREE = ("positions", "normals", "tangents", "uv", "colors")


def gbuffer_of(
    package: str, module: Any, fragments: Any, dtype: Any, *, textures: bool, weight: np.ndarray | None = None
) -> tuple[Any, dict]:
    """The result, and with `weight` the slopes of a fixed mix of what the samples get, times that."""
    make = jnp.asarray if package == "jaxrender" else torch.tensor
    scene = both.record(data()["scene"], package, dtype)
    images = both.record(data()["textures"], package, dtype) if textures else None
    free = {name: getattr(scene, name) for name in FREE} | {"previous": make(data()["previous_clip"].astype(dtype))}

    def objective(free, fragments):
        result = module.make_gbuffer(
            dataclasses.replace(scene, **{name: free[name] for name in FREE}), fragments, textures=images,
            max_anisotropy=2, previous_clip=free["previous"],
        )  # fmt: skip
        rng, total = np.random.default_rng(17), 0.0
        vectors = [values for f in dataclasses.fields(result) if (values := getattr(result, f.name)).ndim == 4]
        for values in vectors if weight is not None else ():
            total += (values * make((rng.normal(size=values.shape) * weight).astype(dtype))).sum()
        return total, result

    if package == "jaxrender":
        whole = (lambda *x: ({}, objective(*x)[1])) if weight is None else jax.grad(objective, has_aux=True)
        slopes, result = jax.jit(whole, compiler_options=NO_OPTIMIZATION)(free, fragments)
        return result, slopes
    if weight is None:
        return objective(free, fragments)[1], {}
    total, result = objective({name: x.requires_grad_() for name, x in free.items()}, fragments)
    slopes = torch.autograd.grad(total, list(free.values()), materialize_grads=True)
    return result, dict(sorted(zip(free, slopes, strict=True)))


@pytest.mark.parametrize(
    ("layout", "textures", "dtype"),
    [("center", True, np.float64), ("center", True, np.float32), ("grid2", False, np.float64),
     ("msaa4", False, np.float32)],
    indirect=["dtype"],
)  # fmt: skip
def test_gbuffer(layout, textures, dtype):
    mine, other = fragments(layout, dtype)
    cut = (np.asarray(mine.screen_id) != np.asarray(mine.triangle_id))[..., None]
    # Slopes once; with a normal map they are those of tests/deferred/test_shading_gradients.py.
    weight = (~cut).astype(float) if layout == "grid2" else None
    got, slopes = gbuffer_of("jaxrender", ours, mine, dtype, textures=textures, weight=weight)
    expected, their_slopes = gbuffer_of("torchref", theirs, other, dtype, textures=textures, weight=weight)
    assert_close(slopes, their_slopes, ulps=TIGHT, what="slopes")
    got, expected = dict(leaves(got)), dict(leaves(expected))
    scale, snapped = slope_scale(mine)
    limit = 16.0 * np.finfo(dtype).eps * scale + np.where(cut, 4.0 * snapped, 0.0)
    for name in (".duv_dx", ".duv_dy"):
        error = np.abs(got.pop(name) - expected.pop(name))
        assert (error <= limit).all(), (name, (error / np.where(limit > 0, limit, 1.0)).max())
    # A normal map is looked up by them.
    normals = got.pop(".normal"), expected.pop(".normal")
    np.testing.assert_allclose(*normals, atol=1e-4 if textures else 1e-6)
    assert_close(*(np.where(cut, 0.0, n) for n in normals), ulps=ROUNDING, dtype=dtype, what="normal")
    assert_close(got, expected, ulps=ROUNDING, dtype=dtype)


def test_gbuffer_in_bands(monkeypatch):
    """Seven rows at a time, of ten: the last band begins higher up."""
    mine, _ = fragments("center", np.float32)
    whole, _ = gbuffer_of("jaxrender", ours, mine, np.float32, textures=False)
    monkeypatch.setattr(ours, "SAMPLES_PER_BAND", 7 * 12)
    bands, _ = gbuffer_of("jaxrender", ours, mine, np.float32, textures=False)
    assert_close(bands, whole, ulps=4, dtype=np.float32)


# --- The late depth test


def test_resolve():
    """Lists with many fragments a sample, some as deep as each other or as what is there, and unused entries."""
    rng = np.random.default_rng(8)
    mine, other = fragments("msaa4", np.float32)
    number, faces, size = 1500, len(data()["faces"]), mine.triangle_id.size
    screen = screen_triangles("msaa4")
    # No triangle twice at a sample, nor one that is there already.
    place, triangle = np.divmod(rng.choice(size * faces, number, replace=False), faces)
    new = np.asarray(mine.triangle_id).reshape(-1)[place] != triangle
    place, triangle, number = place[new], triangle[new], int(new.sum())
    early = np.asarray(mine.depth).reshape(-1)[place]
    depth = np.where(rng.random(number) < 0.5, early, rng.integers(0, 4, number) / 4.0).astype(np.float32)
    late = {
        "place": place, "triangle_id": np.where(rng.random(number) < 0.1, -1, triangle),
        "screen_id": np.array([np.flatnonzero(screen["source"] == t)[-1] for t in triangle]),
        "barycentrics": rng.random((number, 2)).astype(np.float32), "depth": depth,
        "w": rng.random(number).astype(np.float32),
    }  # fmt: skip
    late = {name: x.astype(np.int32) if x.dtype.kind == "i" else x for name, x in late.items()}
    listed = ours_late.FragmentList(**{name: jnp.asarray(x) for name, x in late.items()})
    got = jax.jit(ours_late.resolve)(mine, listed)
    listed = theirs_late.FragmentList(**{name: torch.tensor(x) for name, x in late.items()})
    expected = theirs_late.resolve(other, listed)
    ids = np.asarray(got.triangle_id)
    changed = ids != np.asarray(mine.triangle_id)
    assert 0.2 < changed.mean() < 0.9
    for name in ("triangle_id", "barycentrics", "depth", "w"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name).numpy())
    assert (screen["source"][np.asarray(got.screen_id)] == ids)[changed].all()


# --- The whole


def test_a_picture():
    """From clip positions to radiance, each side on its own, in float32 and in float64."""
    rng = np.random.default_rng(9)
    ambient = 0.2 * rng.normal(size=(3, 9)).astype(np.float32) + np.eye(1, 9, dtype=np.float32)
    kept, slots = {"max_anisotropy": 2}, ("base_color_texture",)

    @functools.partial(jax.jit, compiler_options=NO_OPTIMIZATION)
    def draw(scene, textures, fragments, eye, ambient):
        gbuffer = ours.make_gbuffer(scene, fragments, textures=textures, **kept)
        surface = look_up_surface(gbuffer, scene.material, textures, slots=slots, **kept)
        return shade(gbuffer, surface, scene.lights, eye, ambient=ambient)

    mine = raster.rasterize(jnp.asarray(data()["clip"]), jnp.asarray(data()["faces"]), **scenes.SIZE)
    scene, textures = (both.record(data()[name], "jaxrender", np.float32) for name in ("scene", "textures"))
    got = draw(scene, textures, mine, jnp.asarray(scenes.EYE, jnp.float32), jnp.asarray(ambient))

    other = twin_fragments("center")
    scene, textures = (both.record(data()[name], "torchref", np.float64) for name in ("scene", "textures"))
    gbuffer = theirs.make_gbuffer(scene, other, textures=textures, **kept)
    surface = twin_shade.look_up_surface(gbuffer, scene.material, textures, slots=slots, **kept)
    expected = twin_shade.shade(gbuffer, surface, scene.lights, torch.tensor(scenes.EYE), ambient=torch.tensor(ambient))

    same = np.asarray(mine.triangle_id) == other.triangle_id.numpy()
    assert same.mean() > 0.99 and expected.max() > 0.5
    error = np.abs(np.asarray(got) - expected.numpy())[same]
    # Weights in float32 are off by up to 10⁻⁵ at a floor's far end, texels from one to the next by one.
    assert error.max() < 1e-4 and np.median(error) < 1e-6, error.max()
