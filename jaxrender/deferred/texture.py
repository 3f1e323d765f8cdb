"""Images -> mip chains in one buffer; bilinear, trilinear, anisotropic and elliptical (EWA) lookups.

Pointwise, but for `texture_derivatives` which takes one image: uv has any leading axes. (0, 0) is the upper left corner
of an image and (1, 1) the lower right one (glTF); the centre of texel i lies at (i + 0.5) / size. Light is linear and
alpha is straight (not premultiplied). A layer is an integer and clamps to those there are; filters never cross layers.
Where uv is not finite it counts as 0. A derivative of uv that is NaN counts as 0 (the finest level), an infinite one as
very large (the coarsest).

Lookups are differentiable in texels, uv and the derivatives of uv, piecewise: at borders between texels, levels and
numbers of taps the slope jumps. Which layer, level or texel is read has no gradient.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxrender.checks import bad_input, check_at_least, check_finite, check_last_axis, check_one_of, check_same_shape
from jaxrender.srgb import decode_srgb
from jaxrender.vecmath import normalize, safe_div, safe_sqrt

WRAP_MODES = ("repeat", "clamp", "mirror")

#: Derivatives of uv, and their size in texels, are cut here: far beyond the coarsest level, far from overflow.
_HUGE = 2.0**24

#: EWA reads the finest level at which the short half-axis of the footprint is no longer than this, in texels.
_EWA_MINOR = 4.0

#: Texels on a chord across the longer extent: it is no longer than 2 √2 times the short half-axis, which is √(4² + 1).
_EWA_SLOTS = int(2.0 * np.sqrt(2.0 * (_EWA_MINOR**2 + 1.0))) + 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Textures:
    """All levels of all layers. Texel (x, y) of level l of layer k is `texels[offset[k, l] + y * width[k, l] + x]`.

    A layer with fewer levels than the deepest one repeats its last in the tables. `wrap` holds indices into
    `WRAP_MODES`, for u and v. Texels are linear RGBA; lookups work with any number of channels.
    """

    texels: Float[Array, "n c"]
    offset: Int[Array, "k l"]
    width: Int[Array, "k l"]
    height: Int[Array, "k l"]
    num_levels: Int[Array, " k"]
    wrap: Int[Array, "k 2"]


# --- Building


def build_textures(
    images: Sequence[Shaped[Array | np.ndarray, "_ _ _"]],
    *,
    wrap: str | Sequence[str | tuple[str, str]] = "repeat",
    srgb: bool | Sequence[bool] = True,
) -> Textures:
    """Mip chains of images of any sizes, one layer each.

    Args:
      images: RGB or RGBA; without alpha it is 1. Bytes are 0..1, floating point is linear light as it is.
      wrap: for all layers, or one per layer: "repeat", "clamp", "mirror", or a pair of them for u and v.
      srgb: whether the colour of byte images is sRGB-encoded (alpha never is), for all layers or one per layer. False
        for normals and other data.
    Returns:
      texels in the default floating dtype; differentiable in floating images that are JAX arrays.
    Raises:
      ValueError: if there is no image, or one is empty, of other shape or dtype, or (NumPy) not finite.
    """
    check_at_least("number of images", len(images), 1)
    wraps = [wrap] * len(images) if isinstance(wrap, str) else list(wrap)
    encoded = [srgb] * len(images) if isinstance(srgb, bool) else list(srgb)
    for name, given in (("wrap", wraps), ("srgb", encoded)):
        if len(given) != len(images):
            raise ValueError(f"{name}: expected one for each of {len(images)} images, got {len(given)}")
    table = _level_table([(s[0], s[1]) for s in (_checked(image, k).shape for k, image in enumerate(images))])
    chains = [_mip_chain(_linear_rgba(image, e)) for image, e in zip(images, encoded, strict=True)]
    integers = lambda x: jnp.asarray(x, jnp.int32)  # noqa: E731
    return Textures(
        texels=jnp.concatenate(chains),
        offset=integers(table[..., 0]),
        width=integers(table[..., 1]),
        height=integers(table[..., 2]),
        num_levels=integers([len(mip_sizes(*image.shape[:2])) for image in images]),
        wrap=integers([_wrap_pair(w) for w in wraps]),
    )


def _level_table(shapes: Sequence[tuple[int, int]]) -> np.ndarray:
    """(offset, width, height) of every level of every layer."""
    layers, start = [], 0
    for shape in shapes:
        levels = []
        for h, w in mip_sizes(*shape):
            levels.append((start, w, h))
            start += h * w
        layers.append(levels)
    if start >= 2**31:
        raise ValueError(f"images: expected fewer than 2^31 texels with all levels, got {start}")
    deepest = max(map(len, layers))
    return np.array([levels + levels[-1:] * (deepest - len(levels)) for levels in layers])


def mip_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """(height, width) of every level: each is half the one before, rounded down, at least 1; the last is 1 x 1."""
    levels = range(max(height, width).bit_length())
    return [(max(1, height >> l), max(1, width >> l)) for l in levels]


def mip_chain(image: Float[Array, "h w 4"]) -> Float[Array, "n 4"]:
    """Texels of all levels, the finest first, row by row.

    A level is the box filter of the one before it: 2 x 2 texels become one. Along an odd size, 2n + 1 texels become n:
    each takes its exact share of three, so that the mean of the image stays the same on all levels.

    References:
      Guthe, Heckbert, "Non-Power-of-Two Mipmapping", NVIDIA 2005 (the polyphase box filter).
    """
    levels = [image]
    for _ in mip_sizes(*image.shape[:2])[1:]:
        levels.append(_halve(_halve(levels[-1]).swapaxes(0, 1)).swapaxes(0, 1))
    return jnp.concatenate([level.reshape(-1, 4) for level in levels])


def _halve(image: Float[Array, "h w 4"]) -> Float[Array, "h2 w 4"]:
    n = image.shape[0] // 2
    if n == 0:
        return image
    first, second = image[0 : 2 * n : 2], image[1 : 2 * n : 2]
    if image.shape[0] == 2 * n:
        return 0.5 * (first + second)
    i = jnp.arange(n, dtype=image.dtype)[:, None, None]
    return ((n - i) * first + n * second + (i + 1.0) * image[2::2]) * (1.0 / (2 * n + 1))


_mip_chain = jax.jit(mip_chain)


def _checked(image: Shaped[Array | np.ndarray, "_ _ _"], k: int) -> Shaped[Array | np.ndarray, "_ _ _"]:
    if image.ndim != 3 or image.shape[-1] not in (3, 4) or 0 in image.shape:
        bad_input(f"image {k}", "shape", expected="(h, w, 3) or (h, w, 4)", got=tuple(image.shape))
    if image.dtype != np.uint8 and not jnp.issubdtype(image.dtype, jnp.floating):
        bad_input(f"image {k}", "dtype", expected="uint8 or floating point", got=image.dtype)
    if isinstance(image, np.ndarray) and image.dtype != np.uint8:
        check_finite(f"image {k}", "texels", image)
    return image


def _linear_rgba(image: Shaped[Array | np.ndarray, "h w c"], srgb: bool) -> Float[Array, "h w 4"]:
    if image.dtype == np.uint8:
        level = np.arange(256) / 255.0
        light = decode_srgb(level) if srgb else level
        pixels = np.asarray(image)
        image = np.concatenate([light[pixels[..., :3]], level[pixels[..., 3:]]], axis=-1)
    linear = jnp.asarray(image, dtype=float)
    opaque = jnp.ones((*linear.shape[:2], 4 - linear.shape[-1]), linear.dtype)
    return jnp.concatenate([linear, opaque], axis=-1)


def _wrap_pair(wrap: str | tuple[str, str]) -> list[int]:
    pair = (wrap, wrap) if isinstance(wrap, str) else tuple(wrap)
    for mode in pair:
        check_one_of("wrap", mode, WRAP_MODES)
    if len(pair) != 2:
        raise ValueError(f"wrap: expected a mode or a pair of modes, got {wrap}")
    return [WRAP_MODES.index(mode) for mode in pair]


# --- Isotropic lookups


def sample_bilinear(
    textures: Textures,
    layer: Int[Array, "*#b"] | int,
    uv: Float[Array, "*b 2"],
    *,
    level: Int[Array, "*#b"] | int,
) -> Float[Array, "*b 4"]:
    """Linear RGBA between the four nearest texels of a level; levels clamp to those of the layer."""
    check_last_axis("uv", uv, 2)
    layer = _layers(textures, layer, uv)
    level = jnp.clip(_integers(level, uv), 0, textures.num_levels[layer] - 1)
    size = _size(textures, layer, level, uv.dtype)
    at = _texel_position(_finite(uv), size, textures.wrap[layer])
    corner = jnp.floor(at)
    far = at - corner
    near = 1.0 - far
    start, width = textures.offset[layer, level], textures.width[layer, level]
    low = _wrapped(corner, size, textures.wrap[layer])
    high = _wrapped(corner + 1.0, size, textures.wrap[layer])
    rows = [start + y * width for y in (low[..., 1], high[..., 1])]
    top, bottom = (
        near[..., :1] * textures.texels[row + low[..., 0]] + far[..., :1] * textures.texels[row + high[..., 0]]
        for row in rows
    )
    return near[..., 1:] * top + far[..., 1:] * bottom


def sample_trilinear(
    textures: Textures,
    layer: Int[Array, "*#b"] | int,
    uv: Float[Array, "*b 2"],
    *,
    lod: Float[Array, "*#b"] | float,
) -> Float[Array, "*b 4"]:
    """Linear RGBA between the levels floor(lod) and floor(lod) + 1, bilinear on each.

    Args:
      lod: level of detail, clamped to [0, levels of the layer - 1]; NaN counts as 0.
    """
    check_last_axis("uv", uv, 2)
    layer = _layers(textures, layer, uv)
    lod = jnp.broadcast_to(jnp.asarray(lod, uv.dtype), uv.shape[:-1])
    coarsest = (textures.num_levels[layer] - 1).astype(uv.dtype)
    lod = jnp.clip(jnp.where(jnp.isnan(lod), 0.0, lod), 0.0, coarsest)
    fine = jnp.floor(lod)
    level, rest = fine.astype(jnp.int32), (lod - fine)[..., None]
    # Level + 1 clamps, where it has no weight.
    finer, coarser = (sample_bilinear(textures, layer, uv, level=level + i) for i in (0, 1))
    return (1.0 - rest) * finer + rest * coarser


def texture_lod(
    textures: Textures,
    duv_dx: Float[Array, "*b 2"],
    duv_dy: Float[Array, "*b 2"],
    *,
    layer: Int[Array, "*#b"] | int | None = None,
) -> Float[Array, "*b"]:
    """Isotropic level of detail log2(max(|dX|, |dY|)), dX and dY in texels of the base level; at least -24.

    Not clamped to the levels that there are; `sample_trilinear` does that.

    References:
      Direct3D 11 functional specification, 7.18.11.
    """
    dx, dy = _in_texels(textures, _layers(textures, layer, duv_dx), duv_dx, duv_dy)
    length2 = jnp.maximum(jnp.sum(dx * dx, axis=-1), jnp.sum(dy * dy, axis=-1))
    return 0.5 * jnp.log2(jnp.maximum(length2, 1.0 / _HUGE**2))


# --- Footprints and anisotropic lookups


def footprint_axes(
    dx: Float[Array, "*b 2"], dy: Float[Array, "*b 2"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b 2"]]:
    """Half-axes (major, minor) of the ellipse that the map (dx dy) makes of the unit circle, and the major's direction.

    They are the singular values of the 2 x 2 matrix with columns dx and dy, so it does not matter how dx and dy lie to
    each other. The direction is a unit vector up to its sign; of a circle it is (1, 0).

    Args:
      dx, dy: at most 1e9 in size, else squares overflow in float32.
    """
    u2, v2 = dx[..., 0] ** 2 + dy[..., 0] ** 2, dx[..., 1] ** 2 + dy[..., 1] ** 2
    mean = 0.5 * (u2 + v2)
    # On the scale of the mean, the matrix times its transpose is 1 + [[h, k], [k, -h]].
    scale = jnp.where(mean > 1e-12, mean, jnp.ones_like(mean))
    h = 0.5 * (u2 - v2) / scale
    k = (dx[..., 0] * dx[..., 1] + dy[..., 0] * dy[..., 1]) / scale
    spread2 = h * h + k * k
    major = safe_sqrt(mean + scale * safe_sqrt(spread2))
    minor = safe_div(jnp.abs(dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0]), major)
    circle = spread2 <= 1e-10
    h, k = jnp.where(circle, 1.0, h), jnp.where(circle, 0.0, k)
    spread = jnp.sqrt(h * h + k * k)
    flat = h >= 0
    direction = jnp.stack([jnp.where(flat, spread + h, k), jnp.where(flat, k, spread - h)], axis=-1)
    return major, minor, normalize(direction)


def sample_texture_grad(
    textures: Textures,
    uv: Float[Array, "*b 2"],
    duv_dx: Float[Array, "*b 2"],
    duv_dy: Float[Array, "*b 2"],
    *,
    layer: Int[Array, "*#b"] | int | None = None,
    max_anisotropy: int = 16,
) -> Float[Array, "*b 4"]:
    """Linear RGBA over the footprint of a pixel (`textureGrad`): trilinear taps along the ellipse's major axis.

    With half-axes major and minor in texels, and minor raised to major / max_anisotropy, the level is log2(minor), and
    ceil(major / minor) taps are spread so that they reach from end to end: each covers minor of it. Below one texel,
    minor counts as 1. Every lookup has the cost of the widest footprint among those of the call.

    Args:
      duv_dx, duv_dy: change of uv from pixel to pixel.
      layer: 0 if not given.
      max_anisotropy: most taps, >= 1; 1 is trilinear by the major axis.
    References:
      Direct3D 11 functional specification, 7.18.11, with the ellipse always made orthogonal.
    """
    check_same_shape("duv_dx and duv_dy", duv_dx, duv_dy)
    check_at_least("max_anisotropy", max_anisotropy, 1)
    layer = _layers(textures, layer, uv)
    lod, ratio, axis = _anisotropy(*_in_texels(textures, layer, duv_dx, duv_dy), max_anisotropy)
    uv, axis = _finite(uv), axis / _size(textures, layer, jnp.zeros_like(layer), uv.dtype)
    # A hair above a whole number is not worth one more tap.
    taps = jax.lax.stop_gradient(jnp.maximum(jnp.ceil(ratio - 1.0 / 256.0), 1.0))

    def add_tap(i: Array, total: Array) -> Array:
        place = jnp.where(taps > 1.0, i.astype(uv.dtype) / jnp.maximum(taps - 1.0, 1.0) - 0.5, 0.0)
        value = sample_trilinear(textures, layer, uv + place[..., None] * axis, lod=lod)
        return total + jnp.where((i.astype(uv.dtype) < taps)[..., None], value, 0.0)

    def step(i: Array, total: Array) -> Array:
        return jax.lax.cond(jnp.any(i.astype(uv.dtype) < taps), add_tap, lambda _, total: total, i, total)

    zero = jnp.zeros((*uv.shape[:-1], textures.texels.shape[-1]), jnp.result_type(textures.texels, uv))
    # Checkpoint: going back, a tap is looked up again instead of kept.
    return jax.lax.fori_loop(0, max_anisotropy, jax.checkpoint(step), zero) / taps[..., None]


def _anisotropy(
    dx: Float[Array, "*b 2"], dy: Float[Array, "*b 2"], max_anisotropy: int
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b 2"]]:
    """Level of detail, ratio of the axes, and the vector in texels from the first tap to the last."""
    major, minor, direction = footprint_axes(dx, dy)
    minor = jnp.maximum(jnp.maximum(minor, major / max_anisotropy), 1.0 / _HUGE)
    tap = jnp.maximum(minor, 1.0)
    ratio = jnp.maximum(major / tap, 1.0)
    return jnp.log2(minor), ratio, ((ratio - 1.0) * tap)[..., None] * direction


def sample_ewa(
    textures: Textures,
    uv: Float[Array, "*b 2"],
    duv_dx: Float[Array, "*b 2"],
    duv_dy: Float[Array, "*b 2"],
    *,
    layer: Int[Array, "*#b"] | int | None = None,
    max_radius: int = 64,
) -> Float[Array, "*b 4"]:
    """Elliptical weighted average: the slow reference of filter quality.

    The mean of all texels at offsets (u, v) with Q = A u² + B u v + C v² < F, weighted by exp(-2 Q / F): a Gaussian
    over the footprint, cut at two standard deviations, with A and C raised by 1 for the reconstruction filter. It reads
    the finest level at which the half-axes are no longer than 4 and `max_radius` texels; so an ellipse that is longer
    than 16 : 1 or so is blurred across by the level's own texels. At the rim the weight drops from e^-2 to 0: results
    jump slightly as uv or the footprint moves, and gradients leave that out.

    Args:
      layer: 0 if not given.
      max_radius: in texels, >= 4; the cost of a lookup grows with it.
    References:
      Heckbert, "Fundamentals of Texture Mapping and Image Warping", 1989, section 3.5.
    """
    check_same_shape("duv_dx and duv_dy", duv_dx, duv_dy)
    check_at_least("max_radius", max_radius, _EWA_MINOR)
    layer = _layers(textures, layer, uv)
    level = _ewa_level(textures, layer, duv_dx, duv_dy, max_radius)
    size, wrap = _size(textures, layer, level, uv.dtype), textures.wrap[layer]
    center = _texel_position(_finite(uv), size, wrap)
    dx, dy = (jnp.clip(_scaled(d, size), -max_radius, max_radius) for d in (duv_dx, duv_dy))
    # Rows run across the longer extent, so that the chord of a row is short: rows of texels, or columns.
    squares = dx * dx + dy * dy
    columns = squares[..., 0] > squares[..., 1]
    along, across = _swapped_where(columns, center)
    a = jnp.max(squares, axis=-1) + 1.0
    b = -2.0 * (dx[..., 0] * dx[..., 1] + dy[..., 0] * dy[..., 1])
    # F = A C - B² / 4 = det² + trace + 1: nothing cancels.
    f = (dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0]) ** 2 + jnp.sum(squares, axis=-1) + 1.0
    start, width = textures.offset[layer, level], textures.width[layer, level]
    slots = jnp.arange(_EWA_SLOTS, dtype=uv.dtype).reshape((1,) * a.ndim + (-1,))

    def add_row(row: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        j = jnp.floor(across) + (row - (max_radius + 1)).astype(uv.dtype)
        v = j - across
        # Q = A (u + B v / 2A)² + (F / A) v²: the chord is where that is below F.
        middle = along - 0.5 * b * v / a
        i = jnp.ceil(middle - safe_sqrt(f * (a - v * v)) / a)[..., None] + slots
        q_over_f = (a / f)[..., None] * (i - middle[..., None]) ** 2 + (v * v / a)[..., None]
        weight = jnp.where(q_over_f < 1.0, jnp.exp(-2.0 * jnp.minimum(q_over_f, 1.0)), 0.0)
        place = jnp.stack(jnp.broadcast_arrays(i, j[..., None]), axis=-1)
        place = jnp.where(columns[..., None, None], place[..., ::-1], place)
        at = _wrapped(place, size[..., None, :], wrap[..., None, :])
        texels = textures.texels[start[..., None] + at[..., 1] * width[..., None] + at[..., 0]]
        return sums[0] + jnp.sum(weight[..., None] * texels, axis=-2), sums[1] + jnp.sum(weight, axis=-1)

    def step(row: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        distance = jnp.abs(row - (max_radius + 1)).astype(uv.dtype) - 1.0
        needed = distance < jnp.sqrt(jnp.max(a, initial=1.0))
        return jax.lax.cond(needed, add_row, lambda _, sums: sums, row, sums)

    zero = (
        jnp.zeros((*uv.shape[:-1], textures.texels.shape[-1]), jnp.result_type(textures.texels, uv)),
        jnp.zeros_like(a),
    )
    total, weights = jax.lax.fori_loop(0, 2 * max_radius + 4, jax.checkpoint(step), zero)
    return total / weights[..., None]


def _ewa_level(
    textures: Textures, layer: Int[Array, "*b"], duv_dx: Float[Array, "*b 2"], duv_dy: Float[Array, "*b 2"], radius: int
) -> Int[Array, "*b"]:
    sizes = jnp.stack([textures.width[layer], textures.height[layer]], axis=-1).astype(duv_dx.dtype)
    major, minor, _ = footprint_axes(_scaled(duv_dx[..., None, :], sizes), _scaled(duv_dy[..., None, :], sizes))
    fits = (minor <= _EWA_MINOR) & (major <= radius)
    return jnp.where(
        jnp.any(fits, axis=-1), jnp.argmax(fits, axis=-1).astype(jnp.int32), textures.num_levels[layer] - 1
    )


# --- Derivatives of uv from an image of it


def texture_derivatives(
    uv: Float[Array, "h w 2"], layer: Int[Array, "h w"], *, tolerance: float = 3.0
) -> tuple[Float[Array, "h w 2"], Float[Array, "h w 2"]]:
    """d(uv)/dx and d(uv)/dy per pixel, x to the right and y down, from the neighbours of each pixel.

    The mean of the differences to both neighbours; one of them where the other crosses a seam; 0 where both do. A seam
    lies at the image's border, where the layer changes, and where uv jumps: where the difference is larger than each of
    its neighbours in the same layer, by more than `tolerance` times the neighbour.

    Args:
      layer: negative where there is no texture; derivatives are 0 there.
      tolerance: >= 0; 3 keeps the perspective of a plane down to the last pixels before its horizon.
    """
    check_last_axis("uv", uv, 2)
    check_at_least("tolerance", tolerance, 0)
    if 0 in uv.shape:
        return jnp.zeros_like(uv), jnp.zeros_like(uv)
    uv = _finite(uv)
    across = lambda x: jnp.swapaxes(x, 0, 1)  # noqa: E731
    return _row_derivatives(uv, layer, tolerance), across(_row_derivatives(across(uv), across(layer), tolerance))


def _row_derivatives(uv: Float[Array, "h w 2"], layer: Int[Array, "h w"], tolerance: float) -> Float[Array, "h w 2"]:
    # steps[:, i] leads from pixel i - 1 to pixel i; the first and the last lead out of the image.
    steps = jnp.pad(uv[:, 1:] - uv[:, :-1], ((0, 0), (1, 1), (0, 0)))
    smooth = jnp.pad((layer[:, 1:] == layer[:, :-1]) & (layer[:, 1:] >= 0), ((0, 0), (1, 1)))
    # A step is held against the one before it and the one after it, where they stay in the layer.
    size, change = safe_sqrt(jnp.sum(steps**2, axis=-1)), safe_sqrt(jnp.sum(jnp.diff(steps, axis=1) ** 2, axis=-1))
    comparable = smooth[:, 1:] & smooth[:, :-1]
    over_before = (change > tolerance * size[:, :-1]) & (size[:, 1:] > size[:, :-1])
    over_after = (change > tolerance * size[:, 1:]) & (size[:, :-1] > size[:, 1:])
    before, after = (((0, 0), (1, 0)), ((0, 0), (0, 1)))
    fits = jnp.pad(comparable & ~over_before, before) | jnp.pad(comparable & ~over_after, after)
    alone = ~(jnp.pad(comparable, before) | jnp.pad(comparable, after))
    good = (smooth & (fits | alone))[..., None]
    steps = jnp.where(good, steps, jnp.zeros_like(steps))
    count = good[:, 1:].astype(uv.dtype) + good[:, :-1].astype(uv.dtype)
    return (steps[:, 1:] + steps[:, :-1]) / jnp.maximum(count, 1.0)


# --- Addresses


def _layers(textures: Textures, layer: Int[Array, "*#b"] | int | None, uv: Float[Array, "*b 2"]) -> Int[Array, "*b"]:
    return jnp.clip(_integers(0 if layer is None else layer, uv), 0, textures.num_levels.shape[0] - 1)


def _integers(value: Int[Array, "*#b"] | int, uv: Float[Array, "*b 2"]) -> Int[Array, "*b"]:
    return jnp.broadcast_to(jnp.asarray(value).astype(jnp.int32), uv.shape[:-1])


def _size(textures: Textures, layer: Int[Array, "*b"], level: Int[Array, "*b"], dtype) -> Float[Array, "*b 2"]:
    return jnp.stack([textures.width[layer, level], textures.height[layer, level]], axis=-1).astype(dtype)


def _finite(uv: Float[Array, "*b 2"]) -> Float[Array, "*b 2"]:
    return jnp.where(jnp.isfinite(uv), uv, jnp.zeros_like(uv))


def _scaled(duv: Float[Array, "*#b 2"], size: Float[Array, "*#b 2"]) -> Float[Array, "*b 2"]:
    """A derivative of uv in texels, never NaN and never beyond ±2^24."""
    duv = jnp.clip(jnp.where(jnp.isnan(duv), jnp.zeros_like(duv), duv), -_HUGE, _HUGE)
    return jnp.clip(duv * size, -_HUGE, _HUGE)


def _in_texels(
    textures: Textures, layer: Int[Array, "*b"], duv_dx: Float[Array, "*b 2"], duv_dy: Float[Array, "*b 2"]
) -> tuple[Float[Array, "*b 2"], Float[Array, "*b 2"]]:
    size = _size(textures, layer, jnp.zeros_like(layer), duv_dx.dtype)
    return _scaled(duv_dx, size), _scaled(duv_dy, size)


def _texel_position(uv: Float[Array, "*b 2"], size: Float[Array, "*b 2"], wrap: Int[Array, "*b 2"]):
    """Position in texels, centres at whole numbers; whole periods are taken off uv first, to keep its digits."""
    period = jnp.where(wrap == WRAP_MODES.index("mirror"), 2.0, 1.0).astype(uv.dtype)
    reduced = uv - period * jnp.floor(uv / period)
    return jnp.where(wrap == WRAP_MODES.index("clamp"), jnp.clip(uv, -128.0, 128.0), reduced) * size - 0.5


def _wrapped(index: Float[Array, "*b 2"], size: Float[Array, "*b 2"], wrap: Int[Array, "*b 2"]) -> Int[Array, "*b 2"]:
    """The texel that a whole number stands for. In floating point, which is exact here: integers divide slowly."""
    period = jnp.where(wrap == WRAP_MODES.index("mirror"), 2.0 * size, size)
    place = index - period * jnp.floor(index / period)
    place = jnp.minimum(place, 2.0 * size - 1.0 - place)
    held = jnp.clip(index, 0.0, size - 1.0)
    return jnp.where(wrap == WRAP_MODES.index("clamp"), held, place).astype(jnp.int32)


def _swapped_where(
    swap: Bool[Array, "*b"], center: Float[Array, "*b 2"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    u, v = center[..., 0], center[..., 1]
    return jnp.where(swap, v, u), jnp.where(swap, u, v)
