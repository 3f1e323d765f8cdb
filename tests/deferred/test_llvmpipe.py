"""The rasteriser and the interpolation modes beside Mesa's llvmpipe, on soups, slivers and Sponza."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.interpolate import interpolate
from jaxrender.deferred.raster import rasterize
from tests.deferred.oracle import rasterize as brute_force
from tests.deferred.test_raster import perspective, soup
from tests.support import llvmpipe

CENTER = np.array([[0.5, 0.5]])


@pytest.fixture(scope="module", autouse=True)
def gl():
    return llvmpipe.context()


def both(clip, faces, *, height, width, cull="none", **options):
    theirs = llvmpipe.draw(clip, faces, height=height, width=width, cull=cull, **options)
    ours = rasterize(jnp.asarray(clip), jnp.asarray(faces), height=height, width=width, cull=cull)
    return ours, theirs


@pytest.mark.parametrize("cull", ["none", "back", "front"])
def test_soups(rng, cull):
    clip, faces = soup(rng, 400)
    ours, (ids, _, _) = both(clip, faces, height=128, width=160, cull=cull)
    mine = np.asarray(ours.triangle_id)[..., 0]
    # Where they differ, float64 depth is the judge: llvmpipe's plane is off by up to 1e-3 on steep triangles.
    exact, _, _ = brute_force(clip, faces, height=128, width=160, positions_px=CENTER, cull=cull)
    differ = mine != ids
    assert differ.mean() < 5e-4
    assert (mine[differ] == exact[..., 0][differ]).all()


def test_slivers(rng):
    """Needles a few sub-pixels wide, all at one depth: the same samples, and the same triangle where there is one."""
    # Inside the picture: what leaves it they cut at its border, and snap again.
    a = rng.uniform(-0.9, 0.9, (300, 1, 2))
    along = rng.uniform(-0.95, 0.95, (300, 1, 2)) - a
    points = np.concatenate([a, a + along, a + along * 0.5 + rng.normal(size=(300, 1, 2)) * 0.004], axis=1)
    clip = np.concatenate([points.reshape(-1, 2), np.full((900, 1), 0.5), np.ones((900, 1))], 1).astype(np.float32)
    ours, (ids, _, _) = both(clip, np.arange(900).reshape(-1, 3), height=96, width=96)
    assert (ids >= 0).mean() > 0.05
    mine = np.asarray(ours.triangle_id)[..., 0]
    exact, _, layers = brute_force(clip, np.arange(900).reshape(-1, 3), height=96, width=96, positions_px=CENTER)
    assert ((mine >= 0) == (ids >= 0)).all()
    assert (mine == ids)[layers[..., 0] == 1].all()
    assert (mine == exact[..., 0]).all()


def test_triangles_cut_by_the_near_plane(rng):
    corners = rng.uniform(-2, 2, (80, 3, 3)) + [0, 0, -0.6]
    clip = perspective(corners.reshape(-1, 3))
    ours, (ids, depth, _) = both(clip, np.arange(240).reshape(-1, 3), height=96, width=96)
    mine = np.asarray(ours.triangle_id)[..., 0]
    # They snap a cut corner where their own clipper puts it.
    assert (mine != ids).mean() < 2e-3
    np.testing.assert_allclose(np.asarray(ours.depth)[..., 0][mine == ids], depth[mine == ids], atol=2e-4)


def test_interpolation_modes(rng):
    """Smooth, noperspective and flat (OpenGL's last vertex) on overlapping triangles with uneven w."""
    clip, faces = soup(rng, 60, spread=0.5, size=0.3)
    # Inside the picture: noperspective values of what they cut at its border are not numbers.
    clip[:, :2] = np.clip(clip[:, :2], -0.98 * clip[:, 3:], 0.98 * clip[:, 3:])
    values = rng.normal(size=(len(clip), 4)).astype(np.float32)
    ours, (ids, _, pictures) = both(clip, faces, height=96, width=96, values=values)
    same = np.asarray(ours.triangle_id)[..., 0] == ids
    area = np.asarray(ours.triangles.area)[np.maximum(ids, 0)]
    # On triangles under a pixel their planes are steep beyond float32.
    large = same & (ids >= 0) & (area > 256 * 256)
    assert large.sum() > 2000
    for mode, picture in zip(("perspective", "noperspective", "flat_last"), pictures, strict=True):
        mine = np.asarray(interpolate(ours, jnp.asarray(values), mode=mode))[..., 0, :]
        error = np.abs(mine[large] - picture[large])
        # Their plane is a float32 one from the corner of the image; ours is judged in test_interpolate.
        assert np.median(error) < 1e-4
        assert np.quantile(error, 0.999) < 5e-3
        assert error.max() < 0.05


def test_sponza(shared_data):
    folder = shared_data / "sponza"
    positions, faces = sponza_geometry(folder)
    right, up, back = np.array([[0.0658, 0.0, -0.9978], [0.0, 1.0, 0.0], [0.9978, 0.0, 0.0658]])
    view = (positions - [10.0, 2.0, 0.3]) @ np.stack([right, up, back], axis=1)
    clip = perspective(view.astype(np.float64), far=100.0)
    clip[:, 0] *= 0.75
    ours, (ids, depth, _) = both(clip, faces, height=384, width=512)
    mine, my_depth = np.asarray(ours.triangle_id)[..., 0], np.asarray(ours.depth)[..., 0]
    differ = mine != ids
    assert (mine >= 0).mean() > 0.9
    # Sponza has coplanar decals: ties of depth, which each side decides within the rounding of its plane near 1.
    ties = differ & (np.abs(my_depth - depth) < 1e-5)
    assert differ.mean() < 1e-3
    assert (differ & ~ties).sum() <= 10


def sponza_geometry(folder):
    gltf, data = json.loads((folder / "Sponza.gltf").read_text()), (folder / "Sponza.bin").read_bytes()
    kinds = {5126: np.float32, 5125: np.uint32, 5123: np.uint16}

    def read(index, width):
        accessor = gltf["accessors"][index]
        view = gltf["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        found = np.frombuffer(data, kinds[accessor["componentType"]], accessor["count"] * width, start)
        return found.reshape(-1, width)

    positions, faces, base = [], [], 0
    for primitive in gltf["meshes"][0]["primitives"]:
        positions.append(read(primitive["attributes"]["POSITION"], 3))
        faces.append(read(primitive["indices"], 1).reshape(-1, 3).astype(np.int64) + base)
        base += len(positions[-1])
    return np.concatenate(positions), np.concatenate(faces).astype(np.int32)
