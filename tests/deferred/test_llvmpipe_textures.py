"""Texture lookups beside Mesa's llvmpipe, on the very mip levels that jaxrender built.

What llvmpipe 22.3 does: bilinear weights are float32, not fixed point. Its level of detail is that of OpenGL, by pixel,
but for the logarithm: log2 of the squared length is taken to be linear in the mantissa (`their_log2`), exact at powers
of two and up to 0.0861 too small between them, hence lod up to 0.0431 too fine. With an anisotropy of 16 it filters by
EWA, and `textureGrad` ignores the gradients it is given; so our anisotropic lookup is judged by our EWA, and that by
their implicit lookup.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.llvmpipe import mip_texture
from jaxrender.deferred.interpolate import interpolate
from jaxrender.deferred.quads import quad_derivatives
from jaxrender.deferred.raster import rasterize
from jaxrender.deferred.texture import (
    build_textures,
    sample_bilinear,
    sample_ewa,
    sample_texture_grad,
    sample_trilinear,
    texture_lod,
)
from tests.deferred.test_texture import float32, level_of, light, patterns
from tests.support import llvmpipe

SIZE = 48, 64
# The greatest of (log2(1 + m) - m) / 2, at m = 1 / ln 2 - 1.
LOD_ERROR = 0.5 * (np.log2(1 / np.log(2)) - 1 / np.log(2) + 1)
# By layer: (height, width) and wrap modes of u and v.
LAYERS = {
    "square": ((64, 64), ("repeat", "repeat")),
    "odd": ((13, 24), ("mirror", "mirror")),
    "row": ((1, 9), ("clamp", "clamp")),
    "tall": ((50, 12), ("clamp", "repeat")),
    "small": ((5, 7), ("repeat", "mirror")),
    "clamped": ((32, 20), ("clamp", "mirror")),
}


@pytest.fixture(scope="module", autouse=True)
def gl():
    return llvmpipe.context()


@functools.cache
def pictures():
    """Noise of all sizes and wrap modes."""
    images = [light(*shape, 4, seed=k) for k, (shape, _) in enumerate(LAYERS.values())]
    return build_textures(images, wrap=[wrap for _, wrap in LAYERS.values()])


def levels_of(textures, layer):
    return [level_of(textures, layer, level) for level in range(int(textures.num_levels[layer]))]


def layer_of(name):
    """Number, (width, height), and levels of a layer of the pictures."""
    layer = list(LAYERS).index(name)
    return layer, np.array(LAYERS[name][0])[::-1], levels_of(pictures(), layer)


def gradients(rng, size_px, *, orthogonal):
    """Footprints from a sixteenth of a texel to the whole image and beyond, in units of uv."""
    length = 2.0 ** rng.uniform(-4, np.log2(size_px.max()) + 1, SIZE)
    angle, ratio = rng.uniform(0, 2 * np.pi, SIZE), rng.uniform(0, 1, SIZE)
    other = angle + (np.pi / 2 if orthogonal else rng.uniform(0, 2 * np.pi, SIZE))
    at = lambda angle, length: length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1) / size_px  # noqa: E731
    return at(angle, length).astype(np.float32), at(other, length * ratio).astype(np.float32)


def their_log2(x):
    """Linear between powers of two."""
    mantissa, exponent = np.frexp(np.asarray(x, np.float64))
    return exponent + 2.0 * (mantissa - 1.0)


def their_lod(lod):
    return 0.5 * their_log2(4.0 ** np.asarray(lod, np.float64))


def rounding(uv, size_px):
    """What a lookup may lose on noise in [0, 1], where a texel's neighbour may differ by 1.

    Two sides with two roundings each of a position in texels, on both axes; and eight of the weighted sum.
    """
    return 4 * 2.0**-24 * np.abs(uv * size_px).max() * 2 + 8 * 2.0**-24


@jax.jit
def bilinear(textures, layer, uv, level):
    return sample_bilinear(textures, layer, uv, level=level)


@jax.jit
def trilinear(textures, layer, uv, lod):
    return sample_trilinear(textures, layer, uv, lod=lod)


@jax.jit
def lod_of(textures, layer, duv_dx, duv_dy):
    return texture_lod(textures, duv_dx, duv_dy, layer=layer)


@jax.jit
def by_gradients(textures, layer, uv, duv_dx, duv_dy):
    return sample_texture_grad(textures, uv, duv_dx, duv_dy, layer=layer, max_anisotropy=1)


# --- Isotropic lookups


@pytest.mark.parametrize("name", LAYERS)
def test_bilinear(name, rng):
    """The base level, magnified."""
    layer, size_px, levels = layer_of(name)
    uv = rng.uniform(-2, 3, (*SIZE, 2)).astype(np.float32)
    theirs = llvmpipe.look_up(levels, uv, "textureGrad(image, uv, dx, dy)", wrap=LAYERS[name][1])
    ours = bilinear(pictures(), layer, uv, 0)
    np.testing.assert_allclose(ours, theirs, atol=rounding(uv, size_px))
    # A lookup shifted by 1/256 of a texel would not pass.
    assert rounding(uv, size_px) < 0.1 * np.median(np.abs(np.diff(levels[0], axis=1))) / 256


@pytest.mark.parametrize("name", LAYERS)
def test_trilinear_at_a_given_level_of_detail(name, rng):
    layer, size_px, levels = layer_of(name)
    uv = rng.uniform(-2, 3, (*SIZE, 2)).astype(np.float32)
    lod = rng.uniform(-1, len(levels), SIZE).astype(np.float32)
    theirs = llvmpipe.look_up(levels, uv, "textureLod(image, uv, lod)", wrap=LAYERS[name][1], lod=lod)
    ours = trilinear(pictures(), layer, uv, lod)
    np.testing.assert_allclose(ours, theirs, atol=rounding(uv, size_px))


@pytest.mark.parametrize("shape", [(64, 64), (48, 96), (37, 5)])
def test_level_of_detail(shape, rng):
    """Read off a texture whose levels hold their own number."""
    textures = build_textures([light(*shape, 4)])
    levels = [np.full_like(level, number) for number, level in enumerate(levels_of(textures, 0))]
    dx, dy = gradients(rng, np.array(shape[::-1]), orthogonal=False)
    uv = np.full((*SIZE, 2), 0.3, np.float32)
    theirs = llvmpipe.look_up(levels, uv, "textureGrad(image, uv, dx, dy)", duv_dx=dx, duv_dy=dy)[..., 0]
    ours = np.asarray(lod_of(textures, 0, dx, dy), np.float64)
    between = (ours > 0) & (ours < len(levels) - 1)
    assert between.sum() > 1000
    clamp = lambda lod: np.clip(lod, 0, len(levels) - 1)  # noqa: E731
    # A level of up to 6 and its fraction, rounded a few times.
    np.testing.assert_allclose(clamp(their_lod(ours)), theirs, atol=16 * 2.0**-24 * len(levels))
    assert ((clamp(ours) - theirs) > -1e-6 * len(levels)).all()
    assert ((clamp(ours) - theirs) < LOD_ERROR + 1e-6 * len(levels)).all()


@pytest.mark.parametrize("name", LAYERS)
def test_trilinear_by_gradients(name, rng):
    """`sample_trilinear` with `texture_lod`, their logarithm put in: any gradients, nothing but rounding."""
    layer, size_px, levels = layer_of(name)
    uv = rng.uniform(-2, 3, (*SIZE, 2)).astype(np.float32)
    dx, dy = gradients(rng, size_px, orthogonal=False)
    theirs = llvmpipe.look_up(
        levels, uv, "textureGrad(image, uv, dx, dy)", wrap=LAYERS[name][1], duv_dx=dx, duv_dy=dy
    )  # fmt: skip
    lod = lod_of(pictures(), layer, dx, dy)
    ours = trilinear(pictures(), layer, uv, float32(their_lod(lod)))
    # The rounding of lod moves weight between two levels.
    np.testing.assert_allclose(ours, theirs, atol=rounding(uv, size_px) + 16 * 2.0**-24 * len(levels))


@pytest.mark.parametrize("name", LAYERS)
def test_lookups_by_gradients_without_anisotropy(name, rng):
    """`sample_texture_grad` as it is: their coarse logarithm may move 0.043 of the weight between two levels.

    Gradients are orthogonal: else ours goes by the long axis of the ellipse, which is longer than both of them.
    """
    layer, size_px, levels = layer_of(name)
    uv = rng.uniform(-2, 3, (*SIZE, 2)).astype(np.float32)
    dx, dy = gradients(rng, size_px, orthogonal=True)
    theirs = llvmpipe.look_up(
        levels, uv, "textureGrad(image, uv, dx, dy)", wrap=LAYERS[name][1], duv_dx=dx, duv_dy=dy
    )  # fmt: skip
    ours = by_gradients(pictures(), layer, uv, dx, dy)
    lod = lod_of(pictures(), layer, dx, dy)
    level = jnp.floor(jnp.clip(lod, 0, len(levels) - 1)).astype(jnp.int32)
    finer, coarser = (bilinear(pictures(), layer, uv, level + i) for i in (0, 1))
    allowed = LOD_ERROR * np.abs(finer - coarser) + rounding(uv, size_px) + 16 * 2.0**-24 * len(levels)
    assert (np.abs(ours - theirs) <= allowed).all()


# --- Anisotropy

# Mean of x² over a pixel's box, 1/12; over EWA's exp(-2 r²), cut at r = 1, (1/2 - 1 / (e² - 1)) / 2. Gradients times
# this give EWA the width of the box.
SAME_WIDTH = np.sqrt(1 / 12 / (0.25 - 0.5 / (np.e**2 - 1)))

compiled = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


@compiled
def anisotropic(textures, layer, uv, duv_dx, duv_dy):
    return sample_texture_grad(textures, uv, duv_dx, duv_dy, layer=layer)


@compiled
def ewa(textures, layer, uv, duv_dx, duv_dy):
    return sample_ewa(textures, uv, duv_dx, duv_dy, layer=layer)


@functools.cache
def slanted():
    """A plane in perspective, and how to draw it; footprints from 1.8 : 1 to 20 : 1."""
    ndc, w = 0.9 * np.array([(-1.1, -1.1), (1.1, -1.1), (1.1, 1.1), (-1.1, 1.1)]), np.array([1.0, 1.3, 9.0, 8.0])
    clip = np.concatenate([ndc * w[:, None], 0.5 * w[:, None], w[:, None]], axis=1).astype(np.float32)
    faces, values = np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros((4, 4), np.float32)
    # Linear in the clip position, so that both triangles lie in one plane.
    values[:, :2] = clip[:, [0, 1, 3]] @ [[0.5, 0.1], [0.0, 0.5], [0.1, 1.0]]
    size = dict(zip(("height", "width"), SIZE, strict=True))
    fragments = rasterize(jnp.asarray(clip), jnp.asarray(faces), **size)
    return fragments, {"clip": clip, "faces": faces, "values": values, **size}


def footprints(*, fine):
    """uv and its derivatives over the slanted plane, and where it is seen."""
    fragments, drawing = slanted()
    uv = jnp.asarray(drawing["values"][:, :2])
    found = interpolate(fragments, uv), *quad_derivatives(fragments, uv, fine=fine)
    return *(a[..., 0, :] for a in found), np.asarray(fragments.coverage)[..., 0]


@pytest.mark.parametrize("layer", [0, 1])
def test_anisotropic_lookups_come_closer_to_ewa_than_trilinear_ones(layer):
    """Root mean square, measured: 0.031 against 0.056 on checkers, 0.024 against 0.096 on zone plates.

    At its own width EWA is a blur 1.44 times as wide as a pixel's box, which is what taps stand for, and trilinear's
    excess of blur may come closer to that (on checkers: 0.078 against 0.040). So the widths are made equal.
    """
    uv, dx, dy, seen = footprints(fine=True)
    textures = build_textures(patterns(64))
    exact = ewa(textures, layer, uv, *(float32(SAME_WIDTH * np.asarray(d)) for d in (dx, dy)))
    tight, loose = (
        np.sqrt(np.mean(np.asarray(f(textures, layer, uv, dx, dy) - exact)[seen] ** 2))
        for f in (anisotropic, by_gradients)
    )
    assert tight < 0.6 * loose, (tight, loose)


@pytest.mark.parametrize("layer", [0, 1])
def test_ewa_is_llvmpipes(layer):
    """Their footprint is that of the quad's upper left pixel, their level floor(log2 min(|dX|, |dY|)).

    Levels are handed to ours as layers, so that it reads the same. Theirs has weights from a table of 1024 steps of
    Q / F, so each is off by up to 2/1023; and a texel that lies at the rim to within such a step counts on one side
    only. With tens of texels to an ellipse, that happens in a few of a hundred, and moves the mean by e^-2 over the sum
    of weights. The smallest ellipse here has half-axes √(1.77² + 1) and √(0.97² + 1) and weights of (1 - e^-2) / 2 on
    average: their sum is 3.8 at the least. The weights' errors are spread evenly over their 2/1023; the mean of four
    texels in [0, 1] keeps half of half their standard deviation, and most are means of more.
    """
    uv, dx, dy, seen = footprints(fine=False)
    levels = levels_of(build_textures(patterns(64)), layer)
    image = mip_texture(levels, max_anisotropy=16)
    _, _, (theirs,) = llvmpipe.draw(
        **slanted()[1], body="first = texture(image, smooth_value.xy);", num_targets=1, textures={"image": image}
    )
    shorter = np.min([np.linalg.norm(np.asarray(d), axis=-1) * 64 for d in (dx, dy)], axis=0)
    level = np.clip(np.floor(np.log2(np.maximum(shorter, 1.0))), 0, len(levels) - 1).astype(np.int32)
    assert len(np.unique(level[seen])) >= 4
    difference = np.abs(np.asarray(ewa(build_textures(levels), level, uv, dx, dy)) - theirs)[seen][:, 0]
    assert np.median(difference) < 2 / 1023 / np.sqrt(12) / 4
    assert (difference < 2 / 1023).mean() > 0.95
    assert difference.max() < np.exp(-2) / 3.8
