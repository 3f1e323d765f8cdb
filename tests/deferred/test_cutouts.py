"""Colors of hidden texels: nothing visible changes, nothing invisible shows."""

import numpy as np
import pytest

from jaxrender.deferred.cutouts import bleed_colors
from jaxrender.deferred.texture import build_textures, sample_trilinear


@pytest.mark.parametrize("size", [(16, 16), (7, 13), (1, 9), (5, 1)])
def test_visible_texels_stay_and_hidden_ones_take_their_colors(size, rng):
    texels = rng.integers(0, 256, size=(*size, 4), dtype=np.uint8)
    texels[..., 3] = np.where(rng.uniform(size=size) < 0.6, 0, texels[..., 3])
    texels[0, 0, 3] = 255
    filled = bleed_colors(texels)
    visible = texels[..., 3] > 0
    np.testing.assert_array_equal(filled[visible], texels[visible])
    np.testing.assert_array_equal(filled[..., 3], texels[..., 3])
    low, high = texels[visible][:, :3].min(axis=0), texels[visible][:, :3].max(axis=0)
    assert (filled[..., :3] >= low).all() and (filled[..., :3] <= high).all()


def test_one_color_fills_everything():
    texels = np.zeros((12, 10, 4), np.uint8)
    texels[3:6, 2:5] = [10, 200, 30, 255]
    filled = bleed_colors(texels)
    assert (filled[..., :3] == [10, 200, 30]).all()
    # A leaf keeps its color on every level, and at its edge.
    textures = build_textures([filled], srgb=False)
    for lod in range(4):
        color = np.asarray(sample_trilinear(textures, 0, np.float32([[0.35, 0.3], [0.2, 0.24]]), lod=float(lod)))
        np.testing.assert_allclose(color[:, :3] * 255, [[10, 200, 30]] * 2, atol=0.01)


def test_nothing_to_do():
    opaque = np.full((4, 4, 4), 255, np.uint8)
    assert bleed_colors(opaque) is opaque
    empty = np.zeros((4, 4, 4), np.uint8)
    assert bleed_colors(empty) is empty
