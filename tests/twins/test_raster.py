"""The rasteriser and the interpolation modes against their twins: a loop over triangles, planes solved in float64."""

import importlib

import jax.numpy as jnp
import numpy as np
import pytest
import torch

from jaxrender.deferred import raster
from jaxrender.deferred import samples as layouts
from tests.deferred.test_raster import perspective, soup
from torchref.deferred import interpolate as theirs
from torchref.deferred import raster as twin
from torchref.deferred import samples as twin_layouts

# The package has a function of that name.
ours = importlib.import_module("jaxrender.deferred.interpolate")

LAYOUTS = {"center": ("ordered_grid", 1), "grid": ("ordered_grid", 3), "msaa4": ("standard_pattern", 4)}


def both(clip, faces, *, layout, height=18, width=20, **options):
    name, count = LAYOUTS[layout]
    mine = raster.rasterize(
        jnp.asarray(clip), jnp.asarray(faces), height=height, width=width, samples=getattr(layouts, name)(count),
        **options,
    )  # fmt: skip
    twins = twin.rasterize(
        torch.tensor(clip), torch.tensor(faces), height=height, width=width,
        samples=getattr(twin_layouts, name)(count), **options,
    )  # fmt: skip
    return mine, twins


@pytest.mark.parametrize("count", [1, 2, 4, 8, 16])
def test_patterns(count):
    assert layouts.standard_pattern(count).offsets == twin_layouts.standard_pattern(count).offsets
    for mine, other in ((layouts.standard_pattern(count), twin_layouts.standard_pattern(count)),
                        (layouts.ordered_grid(count), twin_layouts.ordered_grid(count))):  # fmt: skip
        assert mine.count == other.count
        np.testing.assert_allclose(mine.positions_px, other.positions_px)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("cull", ["none", "back"])
def test_soups(rng, layout, cull):
    clip, faces = soup(rng, 60)
    mine, twins = both(clip, faces, layout=layout, cull=cull)
    assert (np.asarray(mine.triangle_id) == twins.triangle_id.numpy()).all()
    np.testing.assert_allclose(mine.depth, twins.depth, atol=5e-6)
    large = np.asarray(mine.triangles.area)[np.maximum(np.asarray(mine.screen_id), 0)] > 1e5
    np.testing.assert_allclose(np.asarray(mine.barycentrics)[large], twins.barycentrics.numpy()[large], atol=2e-4)
    np.testing.assert_allclose(mine.w, twins.w, rtol=2e-4)


def test_cut_triangles(rng):
    corners = rng.uniform(-2, 2, (40, 3, 3)) + [0, 0, -0.6]
    clip = perspective(corners.reshape(-1, 3))
    mine, twins = both(clip, np.arange(120).reshape(-1, 3).astype(np.int32), layout="center", height=40, width=40)
    same = np.asarray(mine.triangle_id) == twins.triangle_id.numpy()
    # Float32 and float64 cut an edge within a snapping step of each other.
    assert same.mean() > 0.998
    np.testing.assert_allclose(np.asarray(mine.w)[same], twins.w.numpy()[same], rtol=2e-3)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("mode", ours.MODES)
def test_modes_and_the_pull_model(rng, layout, mode):
    clip, faces = soup(rng, 12, spread=0.5, size=1.0)
    mine, twins = both(clip, faces, layout=layout)
    area = np.asarray(mine.triangles.area)[np.maximum(np.asarray(mine.screen_id), 0)]
    large = (area > 4e6) & (np.asarray(mine.triangle_id) >= 0)
    assert large.sum() > 100
    values = rng.normal(size=(len(clip), 3)).astype(np.float32)
    arguments = [(), (np.array([5, -7]),), (), (0,)]
    names = ["interpolate", "interpolate_at_offset", "interpolate_at_centroid", "interpolate_at_sample"]
    for name, more in zip(names, arguments, strict=True):
        a = getattr(ours, name)(mine, jnp.asarray(values), *more, mode=mode)
        b = getattr(theirs, name)(twins, torch.tensor(values), *more, mode=mode)
        np.testing.assert_allclose(np.asarray(a)[large], b.numpy()[large], atol=2e-3, err_msg=name)
        assert np.median(np.abs(np.asarray(a)[large] - b.numpy()[large])) < 1e-5
