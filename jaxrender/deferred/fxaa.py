"""Fast approximate anti-aliasing (FXAA) of one finished image, the baseline that costs least.

Image kernels, on display-encoded (sRGB) colour: what counts as an edge is a matter of the eye. Beyond the border, the
nearest pixel inside is read.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrender.checks import bad_input, check_at_least, check_last_axis, check_one_of
from jaxrender.vecmath import safe_div

#: How far the presets walk along an edge between one look at it and the next, in pixels. There is no look at the end.
_STEPS_PX: dict[int, tuple[float, ...]] = {
    10: (1.5, 3.0, 12.0),
    11: (1.0, 1.5, 3.0, 12.0),
    **{12 + n: (1.0, 1.5, 2.0, *n * (2.0,), 4.0, 12.0) for n in range(4)},
    20: (1.5, 2.0, 8.0),
    **{21 + n: (1.0, 1.5, 2.0, *n * (2.0,), 8.0) for n in range(3)},
    24: (1.0, 1.5, 2.0, 2.0, 2.0, 3.0, 8.0),
    **{25 + n: (1.0, 1.5, 2.0, 2.0, 2.0, 2.0, *n * (2.0,), 4.0, 8.0) for n in range(5)},
    39: (1.0, 1.0, 1.0, 1.0, 1.0, 1.5, 2.0, 2.0, 2.0, 2.0, 4.0, 8.0),
}

#: Lumas closer than this are equal. Between flat colours most comparisons are ties (a look halfway into a step sees
#: just a quarter of its height), and rounding must not break them: 60 float32 roundings, a 250th of an 8-bit level.
_TIE = 2.0**-16


def luma(image: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Brightness of display-encoded colour, 0.299 R + 0.587 G + 0.114 B (Rec. 601), in [0, 1]. Pointwise."""
    check_last_axis("image", image, 3)
    return 0.299 * image[..., 0] + 0.587 * image[..., 1] + 0.114 * image[..., 2]


def luma_range(luma: Float[Array, "h w"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """How far a pixel and its four direct neighbours lie apart, max - min, and their max.

    Raises:
      ValueError: if `luma` is not an image, or empty.
    """
    if luma.ndim != 2 or 0 in luma.shape:
        bad_input("luma", "shape", expected="(h, w), not empty", got=tuple(luma.shape))
    at = _neighbours(luma)
    cross = jnp.stack([luma, at(-1, 0), at(1, 0), at(0, -1), at(0, 1)])
    brightest = jnp.max(cross, axis=0)
    return brightest - jnp.min(cross, axis=0), brightest


def fxaa(
    image: Float[Array, "h w 3"],
    *,
    preset: int = 12,
    subpix: float = 0.75,
    edge_threshold: float = 0.166,
    edge_threshold_min: float = 0.0833,
) -> Float[Array, "h w 3"]:
    """Smooths the stairs of edges: "FXAA 3.11 quality", all presets of the PC version.

    A pixel whose luma range reaches both thresholds lies at an edge, horizontal or vertical by its second differences.
    From the boundary to the neighbour that differs more, both ends of the edge are sought: where the mean luma of the
    two sides has changed by a quarter of the step between them. If at the nearer end, at distance d of the length l, it
    is this pixel's side that ends, a slanted line cuts 1/2 - d / l off the pixel, and it is read that far towards the
    neighbour. Where it differs from the blurred 3 x 3 around it (thin lines, single pixels) it is read at least as far
    as that difference, made smooth, times `subpix`.

    Equal to the shader in exact arithmetic, but that lumas count as equal within 2⁻¹⁶ and bilinear weights are exact.
    Ties go to horizontal edges, and to the neighbour above or to the left: so mirrored images give mirrored results
    but for pixels with equal steps to both sides (lines one pixel wide), and transposed ones but for pixels with equal
    second differences (single pixels, many peaks of noise). Every output lies between the pixel and one of its four
    neighbours.

    Differentiable in the image, piecewise: directions, distances and thresholds have no gradient.

    Args:
      image: display-encoded, in [0, 1].
      preset: 10 to 15 (coarser ends), 20 to 29, 39; in each series a higher number walks farther along edges.
      subpix: in [0, 1]; 0 leaves thin lines alone, 1 blurs them most.
      edge_threshold: least range to act on, as a share of the brightest of the five lumas, >= 0.
      edge_threshold_min: least range to act on in the dark, >= 0.
    Raises:
      ValueError: if the image has another shape or is empty, or an option is out of its range.
    References:
      Lottes, "FXAA", NVIDIA white paper 2009/2011, and Fxaa3_11.h (2011), FxaaPixelShader with FXAA_PC.
    """
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        bad_input("image", "shape", expected="(h, w, 3), not empty", got=tuple(image.shape))
    check_one_of("preset", preset, sorted(_STEPS_PX))
    check_at_least("edge_threshold", edge_threshold, 0.0)
    check_at_least("edge_threshold_min", edge_threshold_min, 0.0)
    if not 0.0 <= subpix <= 1.0:
        raise ValueError(f"subpix: expected a value in [0, 1], got {subpix}")
    light = luma(image)
    contrast, brightest = luma_range(light)
    at_edge = contrast >= jnp.maximum(edge_threshold * brightest, edge_threshold_min)

    frozen = jax.lax.stop_gradient(light)
    horizontal = _edge_strength(frozen) >= _edge_strength(frozen.T).T - _TIE
    toward_first, other = _pair(frozen, horizontal)
    by_edge = _shift_by_edge(frozen, other, horizontal, toward_first, _STEPS_PX[preset])
    shift = jnp.maximum(by_edge, subpix * _isolation(light, contrast))

    # A shift is one to the neighbour, so that the bilinear look at the new place is a mix of the two.
    beside = _beside(image, horizontal[..., None], toward_first[..., None])
    moved = image + shift[..., None] * (beside - image)
    return jnp.where(at_edge[..., None], moved, image)


def _neighbours(values: Float[Array, "h w *c"]) -> Callable[[int, int], Float[Array, "h w *c"]]:
    """The image as seen dy rows below and dx columns to the right of each pixel, by one at most."""
    h, w = values.shape[:2]
    padded = jnp.pad(values, ((1, 1), (1, 1)) + ((0, 0),) * (values.ndim - 2), mode="edge")
    return lambda dy, dx: padded[1 + dy : 1 + dy + h, 1 + dx : 1 + dx + w]


def _edge_strength(light: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """How much of a horizontal edge there is: second differences down three columns, the middle one twice."""
    padded = jnp.pad(light, 1, mode="edge")
    bend = jnp.abs(padded[:-2] - 2.0 * padded[1:-1] + padded[2:])
    return 2.0 * bend[:, 1:-1] + (bend[:, :-2] + bend[:, 2:])


def _beside(
    values: Float[Array, "h w *c"], horizontal: Bool[Array, "h w *#c"], toward_first: Bool[Array, "h w *#c"]
) -> Float[Array, "h w *c"]:
    """The neighbour across the edge: above or below, left or right."""
    at = _neighbours(values)
    first = jnp.where(horizontal, at(-1, 0), at(0, -1))
    return jnp.where(toward_first, first, jnp.where(horizontal, at(1, 0), at(0, 1)))


def _pair(light: Float[Array, "h w"], horizontal: Bool[Array, "h w"]) -> tuple[Bool[Array, "h w"], Float[Array, "h w"]]:
    """Whether the neighbour that differs more lies above or to the left, and its luma."""
    first, second = (_beside(light, horizontal, jnp.full_like(horizontal, side)) for side in (True, False))
    toward_first = jnp.abs(first - light) >= jnp.abs(second - light) - _TIE
    return toward_first, jnp.where(toward_first, first, second)


def _shift_by_edge(
    light: Float[Array, "h w"],
    other: Float[Array, "h w"],
    horizontal: Bool[Array, "h w"],
    toward_first: Bool[Array, "h w"],
    steps_px: tuple[float, ...],
) -> Float[Array, "h w"]:
    """The share of a pixel that the slanted line through the ends of its edge cuts off, in [0, 1/2]."""
    middle, quarter = 0.5 * (light + other), 0.25 * jnp.abs(light - other)
    half = jnp.where(toward_first, -0.5, 0.5).astype(light.dtype)
    y, x = (jnp.arange(n, dtype=light.dtype) for n in light.shape)
    y = y[:, None] + jnp.where(horizontal, half, 0.0)
    x = x[None, :] + jnp.where(horizontal, 0.0, half)

    def walk(sign: float) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
        """Distance of the end on one side, and by how much the mean of the two sides has changed there."""

        def look(distance: Float[Array, "h w"]) -> Float[Array, "h w"]:
            along = sign * distance
            return (
                _bilinear(light, y + jnp.where(horizontal, 0.0, along), x + jnp.where(horizontal, along, 0.0)) - middle
            )

        def go_on(distance: Array, change: Array, step: Array | float) -> Array:
            return jnp.where(jnp.abs(change) >= quarter - _TIE, distance, distance + step)

        def step_and_look(state: tuple[Array, Array], step: Array) -> tuple[tuple[Array, Array], None]:
            distance = go_on(*state, step)
            return (distance, look(distance)), None

        start = jnp.full_like(light, steps_px[0])
        between = jnp.asarray(steps_px[1:-1], light.dtype)
        (distance, change), _ = jax.lax.scan(step_and_look, (start, look(start)), between)
        return go_on(distance, change, steps_px[-1]), change

    (back, change_back), (ahead, change_ahead) = walk(-1.0), walk(1.0)
    change = jnp.where(back < ahead, change_back, change_ahead)
    turns_here = (change < 0.0) != (light < middle)
    return jnp.where(turns_here, 0.5 - jnp.minimum(back, ahead) / (back + ahead), 0.0)


def _bilinear(values: Float[Array, "h w"], y: Float[Array, "h w"], x: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Values between pixels, whose centres lie at whole numbers here."""
    top, left = jnp.floor(y), jnp.floor(x)
    down, right = y - top, x - left
    rows, columns = (
        [jnp.clip(low.astype(jnp.int32) + i, 0, n - 1) for i in (0, 1)]
        for low, n in zip((top, left), values.shape, strict=True)
    )
    upper, lower = ((1.0 - right) * values[row, columns[0]] + right * values[row, columns[1]] for row in rows)
    return (1.0 - down) * upper + down * lower


def _isolation(light: Float[Array, "h w"], contrast: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """How little a pixel has in common with the 3 x 3 around it, in [0, 1]: smoothstep, squared."""
    at = _neighbours(light)
    direct = (at(-1, 0) + at(1, 0)) + (at(0, -1) + at(0, 1))
    corners = (at(-1, -1) + at(1, 1)) + (at(-1, 1) + at(1, -1))
    away = jnp.abs((2.0 * direct + corners) / 12.0 - light)
    c = jnp.clip(safe_div(away, contrast), 0.0, 1.0)
    return ((3.0 - 2.0 * c) * c * c) ** 2
