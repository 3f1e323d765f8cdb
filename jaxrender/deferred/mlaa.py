"""Morphological anti-aliasing (MLAA) of one finished image, in the manner of SMAA 1x without diagonals and corners.

Image kernel, on display-encoded (sRGB) colour. Three stages: edges part pixels that differ; a run of edges that turns
off at its ends stands for a slanted line, whose areas are computed here rather than looked up; pixels are mixed with
their neighbours by these areas.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrender.checks import bad_input, check_at_least
from jaxrender.deferred.fxaa import luma
from jaxrender.srgb import decode_srgb, encode_srgb

#: Steps of luma closer than this are equal: rounding must not break ties between flat colours.
_TIE = 2.0**-16


def mlaa(
    image: Float[Array, "h w 3"], *, threshold: float = 0.1, max_search_steps: int = 16, linear_light: bool = False
) -> Float[Array, "h w 3"]:
    """Redraws the stairs of edges as the lines that they stand for.

    There is an edge where luma steps by `threshold`, and by half of the largest step nearby: those around the pixel
    right of it or below, and those before its left and upper neighbours. A run of edges ends where it stops or another
    one crosses it. If that one lies above, the line begins half a pixel above the run and meets it in its middle; below
    likewise; without one, or with both, it stays on the run (with both at one end and one at the other, the two ends
    turn to opposite sides). A pixel c is mixed with its neighbours p and q by the areas a that such lines cut off, up
    and down or left and right, whichever holds the larger area: it becomes the mean of (1 - a_p) c + a_p p and
    (1 - a_q) c + a_q q, weighted by a_p and a_q.

    Transposed images give transposed results but for pixels with equal areas both ways (those mix with the pixels above
    and below), mirrored ones mirrored results but for edges that are dropped beside stronger ones. Every output is a
    mix of the pixel and of two of its neighbours, with at least half of the pixel itself. Differentiable in the image,
    piecewise: areas and thresholds have no gradient.

    Args:
      image: display-encoded, in [0, 1].
      threshold: smallest step of luma, > 0.
      max_search_steps: how far ends are sought on either side, in pairs of pixels, >= 1. Beyond, a run is cut.
      linear_light: mixes light, as coverage does, instead of encoded values.
    Raises:
      ValueError: if the image has another shape or is empty, or an option is out of its range.
    References:
      Reshetov, "Morphological Antialiasing", HPG 2009. Jimenez, Echevarria, Sousa, Gutierrez, "SMAA: Enhanced Subpixel
      Morphological Antialiasing", Eurographics 2012, sec. 3 and 4.1 (its luma is Rec. 709, here it is Rec. 601).
    """
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        bad_input("image", "shape", expected="(h, w, 3), not empty", got=tuple(image.shape))
    check_at_least("max_search_steps", max_search_steps, 1)
    if not threshold > 0.0:
        raise ValueError(f"threshold: expected a value > 0, got {threshold}")
    left_edges, top_edges = _edges(jax.lax.stop_gradient(luma(image)), threshold)
    reach = 2 * max_search_steps
    # At a pixel's own edge: the areas in the pixel before the edge, and in the pixel itself.
    of_above, to_above = (x.astype(image.dtype) for x in _areas(top_edges, left_edges, reach))
    of_left, to_left = (x.T.astype(image.dtype) for x in _areas(left_edges.T, top_edges.T, reach))
    to_below, to_right = _next(of_above, 0), _next(of_left, 1)

    color = jnp.asarray(decode_srgb(image)) if linear_light else image
    vertical = jnp.maximum(to_above, to_below) >= jnp.maximum(to_left, to_right)
    first, second = jnp.where(vertical, to_above, to_left), jnp.where(vertical, to_below, to_right)
    down, right = _mix(color, to_above, to_below, 0), _mix(color, to_left, to_right, 1)
    mixed = jnp.where(vertical[..., None], down, right)
    touched = (first + second > 0.0)[..., None]
    return jnp.where(touched, encode_srgb(mixed) if linear_light else mixed, image)


def _edges(light: Float[Array, "h w"], threshold: float) -> tuple[Bool[Array, "h w"], Bool[Array, "h w"]]:
    """Whether an edge parts a pixel from the one to its left, and from the one above."""
    columns = jnp.pad(jnp.abs(jnp.diff(light, axis=1)), ((0, 0), (2, 1)))
    rows = jnp.pad(jnp.abs(jnp.diff(light, axis=0)), ((2, 1), (0, 0)))
    left, top = columns[:, 1:-1], rows[1:-1]
    # Steps beside this one, and the ones before it: a fainter edge next to a strong one is not seen.
    around = (left, top, columns[:, 2:], rows[2:], columns[:, :-2], rows[:-2])
    largest = around[0]
    for step in around[1:]:
        largest = jnp.maximum(largest, step)
    left, top = ((step >= threshold - _TIE) & (2.0 * step >= largest - _TIE) for step in (left, top))
    return left, top


def _areas(
    edges: Bool[Array, "h w"], crossing: Bool[Array, "h w"], reach: int
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Shares, in [0, 1/2], that the line along a pixel's upper edge cuts off the pixel above it, and off itself.

    Args:
      edges: between a pixel and the one above.
      crossing: between a pixel and the one to its left.
      reach: the longest way to an end, in pixels.
    """
    boundary = jnp.arange(edges.shape[1] + 1)[None]
    beside = jnp.pad(crossing, ((1, 0), (0, 1)))
    above, below = beside[:-1], beside[1:]
    run = jnp.pad(edges, ((0, 0), (1, 1)))
    ends = above | below | ~(run[:, :-1] & run[:, 1:])
    start = jax.lax.cummax(jnp.where(ends, boundary, 0), axis=1)[:, :-1]
    stop = jax.lax.cummin(jnp.where(ends, boundary, edges.shape[1]), axis=1, reverse=True)[:, 1:]
    pixel = boundary[:, :-1]
    before, after = jnp.minimum(pixel - start, reach), jnp.minimum(stop - 1 - pixel, reach)

    # 1: turns up, -1: turns down; an end that is crossed both ways turns away from the other one.
    places = (pixel - before, pixel + 1 + after)
    side = above.astype(jnp.int32) - below.astype(jnp.int32)
    sides = [jnp.take_along_axis(side, place, axis=1) for place in places]
    both = [jnp.take_along_axis(above & below, place, axis=1) for place in places]
    turns = [jnp.where(b, -s, own) for b, s, own in zip(both, sides[::-1], sides, strict=True)]
    length = (before + after + 1).astype(float)
    areas = [_triangle(distance.astype(float), length) for distance in (before, after)]
    first, second = (
        [jnp.where(edges & (t == way), a, 0.0) for way in (1, -1)] for t, a in zip(turns, areas, strict=True)
    )
    return first[0] + second[0], first[1] + second[1]


def _triangle(distance: Float[Array, "h w"], length: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Area from t = distance to distance + 1 under the line that falls from 1/2 at t = 0 to 0 at length / 2."""
    a, b = jnp.minimum(distance, 0.5 * length), jnp.minimum(distance + 1.0, 0.5 * length)
    return 0.5 * (b - a) * (1.0 - (a + b) / length)


def _next(values: Float[Array, "h w"], axis: int) -> Float[Array, "h w"]:
    """The values of the pixel below (axis 0) or to the right (1); 0 beyond the border."""
    return jnp.pad(values[1:], ((0, 1), (0, 0))) if axis == 0 else jnp.pad(values[:, 1:], ((0, 0), (0, 1)))


def _mix(
    color: Float[Array, "h w 3"], to_first: Float[Array, "h w"], to_second: Float[Array, "h w"], axis: int
) -> Float[Array, "h w 3"]:
    """Mixes with the neighbours before and behind along an axis. At the border, where they wrap, areas are 0."""
    norm = to_first + to_second
    norm = jnp.where(norm > 0.0, norm, 1.0)
    first, second = (jnp.roll(color, shift, axis) - color for shift in (1, -1))
    return color + (to_first**2 / norm)[..., None] * first + (to_second**2 / norm)[..., None] * second
