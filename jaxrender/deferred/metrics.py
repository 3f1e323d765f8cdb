"""Windows of a G-buffer and a first shading -> how many samples each pixel needs.

Pointwise over windows: the n = m x m sub-samples of a pixel are an axis, in any order, and every metric is the same for
all orders. `shading_sample_count` alone takes an image. Results are real numbers; `sample_count` makes whole ones.

Background. Empty sub-samples have no part in a metric: what is there is compared with itself, so that NaN or any other
value in them changes nothing. A window with fewer than two covered sub-samples, or with a covered value that is not
finite, has count 0 (the edge of a shape is in its coverage, which is known for all sub-samples without shading).

Differentiable almost everywhere; not `sample_count`.

References:
  Holländer, Boubekeur, Eisemann, "Adaptive Supersampling for Deferred Anti-Aliasing", JCGT 2(1), 2013, section 3.1.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_at_least, check_last_axis, check_same_shape
from jaxrender.deferred.sampling import window_size
from jaxrender.vecmath import safe_div, safe_sqrt

#: Counts whose samples lie balanced around the middle of the pixel, for the printed matrices (`index_matrix`).
BALANCED = {1: (1,), 2: (1, 2, 4), 3: (1, 5, 9), 4: (1, 2, 6, 8, 10, 14, 16)}


@dataclass(frozen=True)
class SampleMetrics:
    """Settings of the printed metrics, and of some others that are off. A scale of None switches a metric off.

    Attributes:
      depth: c of k_d, for depths in [0, 1] of the farthest one.
      normal: c of k_n. shading: c of k_s, for display-encoded luma in [0, 1].
      edge_threshold, min_threshold: of k_s.
      highlight: c of k_h (`highlight_sample_count`); off unless set.
      plane_corrected: of `depth_sample_count`.
      mapped_normals: k_n sees normal maps, which are looked up for all sub-samples then.
      balanced: counts are rounded up to `balanced_counts`.
      least: no pixel gets fewer samples.
      scale: multiplies all constants of metrics; the dial.
    """

    depth: float | None = 1000.0
    normal: float | None = 16.0
    shading: float | None = 48.0
    edge_threshold: float = 1 / 4
    min_threshold: float = 1 / 12
    highlight: float | None = None
    plane_corrected: bool = False
    mapped_normals: bool = False
    balanced: bool = False
    least: int = 1
    scale: float = 1.0


def depth_sample_count(
    depth: Float[Array, "*b n"],
    *,
    scale: float | Float[Array, ""],
    covered: Bool[Array, "*b n"] | None = None,
    plane_corrected: bool = False,
) -> Float[Array, "*b"]:
    """k_d = c (Σ d²/n - (Σ d/n)²), the variance of the window, in two passes; in [0, c/4] for depths in [0, 1].

    Args:
      depth: any linear depth. scale: c >= 0.
      covered: which sub-samples are there; all by default.
      plane_corrected: subtracts the plane d = a + g_x x + g_y y that fits best, so that flat but steep surfaces do not
        count. Sub-samples must then be m x m, row by row. Not in the paper.
    """
    covered = _mask(depth, covered)
    count = jnp.maximum(jnp.sum(covered, axis=-1, keepdims=True), 1).astype(depth.dtype)
    depth = jnp.where(covered, depth, jnp.zeros_like(depth))
    difference = jnp.where(covered, depth - jnp.sum(depth, axis=-1, keepdims=True) / count, 0.0)
    if plane_corrected:
        difference = _without_plane(difference, covered)
    return _finite(scale * jnp.sum(difference * difference, axis=-1) / count[..., 0])


def normal_sample_count(
    normal: Float[Array, "*b n 3"], *, scale: float | Float[Array, ""], covered: Bool[Array, "*b n"] | None = None
) -> Float[Array, "*b"]:
    """k_n = c √(1 - min |n̄ · n_ij|), the cone around the normalised mean normal; in [0, c].

    |.| folds normals of back faces over. Where normals cancel out (|n̄| < 1e-6 of their number) the count is c. The
    gradient is 0 where all normals are equal.

    Args:
      normal: unit. scale: c >= 0.
      covered: as in `depth_sample_count`.
    """
    _, chord = normal_cone(normal, covered=covered)
    return scale * safe_sqrt(chord)


def normal_cone(
    normal: Float[Array, "*b n 3"], *, covered: Bool[Array, "*b n"] | None = None
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """The normalised mean normal n̄, and 1 - min |n̄ · n_ij|, in [0, 1].

    Where normals cancel out the former is their sum and the latter 1; with fewer than two covered sub-samples, or
    normals that are not finite, it is 0.
    """
    check_last_axis("normal", normal, 3)
    covered = _mask(normal[..., 0], covered)
    count = jnp.maximum(jnp.sum(covered, axis=-1), 1).astype(normal.dtype)
    normal = jnp.where(covered[..., None], normal, jnp.zeros_like(normal))
    total = jnp.sum(normal, axis=-2)
    length = safe_sqrt(jnp.sum(total * total, axis=-1))
    cancelled = length < 1e-6 * count
    axis = total / jnp.where(cancelled, 1.0, length)[..., None]
    cosine = jnp.abs(jnp.sum(normal * axis[..., None, :], axis=-1))
    # 1 - cos as half of a squared distance keeps the digits that a float32 cosine near 1 has lost.
    apart = jnp.minimum(_distance2(normal, axis), _distance2(normal, -axis))
    chord = jnp.where(cosine > 0.5, 0.5 * apart, 1.0 - cosine)
    widest = jnp.max(jnp.where(covered, chord, 0.0), axis=-1)
    # Equal normals differ from their mean by rounding, which must not have a slope.
    widest = jnp.where(widest > 32.0 * jnp.finfo(normal.dtype).eps ** 2, widest, 0.0)
    widest = jnp.where(cancelled, 1.0, jnp.clip(widest, 0.0, 1.0))
    told = (jnp.sum(covered, axis=-1) > 1) & jnp.all(jnp.isfinite(normal), axis=(-2, -1))
    return axis, jnp.where(told, widest, 0.0)


def _distance2(a: Float[Array, "*b n 3"], axis: Float[Array, "*b 3"]) -> Float[Array, "*b n"]:
    difference = a - axis[..., None, :]
    return jnp.sum(difference * difference, axis=-1)


def shading_sample_count(
    luminance: Float[Array, "h w"],
    *,
    scale: float | Float[Array, ""],
    edge_threshold: float = 1 / 8,
    min_threshold: float = 1 / 16,
    covered: Bool[Array, "h w"] | None = None,
) -> Float[Array, "h w"]:
    """k_s = c r where the range r of a pixel and its four neighbours reaches both thresholds, else 0.

    Args:
      luminance: display-encoded luma in [0, 1] of the first shading (`luma`).
      scale: c >= 0.
      edge_threshold: share of the largest luma that r must reach; min_threshold: the least r.
      covered: pixels that were shaded; others have count 0 and are no neighbours. All by default.
    References:
      The test of FXAA: Lottes, 2009.
    """
    around = _with_neighbours(luminance, covered)
    largest = jnp.max(around, axis=0)
    r = largest - jnp.min(around, axis=0)
    return jnp.where(r < jnp.maximum(min_threshold, largest * edge_threshold), 0.0, scale * r)


def shading_steps(
    luminance: Float[Array, "h w"], *, covered: Bool[Array, "h w"] | None = None
) -> Float[Array, "h w 2"]:
    """The larger of the two steps of the first shading to the neighbours in x, and in y; as in `shading_sample_count`.

    Unlike the range it tells along which axis the shading changes.
    """
    here, left, right, up, down = _with_neighbours(luminance, covered)
    x, y = (jnp.maximum(jnp.abs(a - here), jnp.abs(b - here)) for a, b in ((left, right), (up, down)))
    return jnp.stack([x, y], axis=-1)


def _with_neighbours(luminance: Float[Array, "h w"], covered: Bool[Array, "h w"] | None) -> Float[Array, "5 h w"]:
    """A pixel and its neighbours left, right, above, below. One that is missing or not finite is the pixel itself."""
    if luminance.ndim != 2:
        raise ValueError(f"luminance: expected shape (h, w), got {tuple(luminance.shape)}")
    some = jnp.isfinite(luminance) & _mask(luminance, covered)
    here = jnp.where(some, luminance, 0.0)

    def beside(dy: int, dx: int) -> Float[Array, "h w"]:
        rows, columns = slice(1 + dy, 1 + dy + here.shape[0]), slice(1 + dx, 1 + dx + here.shape[1])
        values, there = (jnp.pad(v, 1)[rows, columns] for v in (here, some))
        return jnp.where(there & some, values, here)

    return jnp.stack([here, beside(0, -1), beside(0, 1), beside(-1, 0), beside(1, 0)])


def sample_count(*metrics: Float[Array, "*b"], size: int, allowed: tuple[int, ...] | None = None) -> Int[Array, "*b"]:
    """K = clamp(⌈max of the metrics⌉, 1, m²); 1 where that is not a number.

    Args:
      size: m.
      allowed: the counts that may be used, ascending and up to m²; K is rounded up to the next. All by default.
    """
    check_at_least("size", size, 1)
    check_at_least("number of metrics", len(metrics), 1)
    largest = metrics[0]
    for other in metrics[1:]:
        check_same_shape("metrics", largest, other)
        largest = jnp.maximum(largest, other)
    largest = jnp.where(jnp.isnan(largest), 0.0, largest)
    count = jnp.clip(jnp.ceil(largest), 1, size * size).astype(jnp.int32)
    if allowed is None:
        return count
    if not allowed or list(allowed) != sorted(set(allowed)) or allowed[0] < 1 or allowed[-1] != size * size:
        raise ValueError(f"allowed: expected ascending counts from 1 up to {size * size}, got {allowed}")
    return jnp.asarray(allowed, jnp.int32)[jnp.searchsorted(jnp.asarray(allowed, jnp.int32), count)]


def balanced_counts(size: int) -> tuple[int, ...]:
    """Counts to allow for m x m windows: prefixes of the matrix that lie around the pixel's middle.

    For m up to 4 those found by measurement; for others the powers of two and m².
    """
    check_at_least("size", size, 1)
    if size in BALANCED:
        return BALANCED[size]
    return tuple(sorted({*(1 << k for k in range((size * size).bit_length())), size * size}))


def tile_maximum(count: Int[Array, "h w"], *, tile: int) -> Int[Array, "h w"]:
    """Each pixel gets the largest count of its tile x tile block (at the borders, of what there is of it).

    References:
      Holländer et al., 2013, section 4.2 (low-resolution counts, 6 x 6) and section 6 (tiles).
    """
    check_at_least("tile", tile, 1)
    h, w = count.shape
    whole = jnp.pad(count, ((0, -h % tile), (0, -w % tile)))
    blocks = whole.reshape(whole.shape[0] // tile, tile, whole.shape[1] // tile, tile)
    largest = jnp.max(blocks, axis=(1, 3), keepdims=True)
    return jnp.broadcast_to(largest, blocks.shape).reshape(whole.shape)[:h, :w]


def average_over_frames(
    metric: Float[Array, "h w"], previous: Float[Array, "h w"], *, share: float = 0.8
) -> Float[Array, "h w"]:
    """Running average of a metric over frames, which never falls behind by more than it takes to decay.

    What rises is taken at once, what falls goes down slowly: a new edge is never missed.

    Args:
      previous: what this function gave for the frame before; what is not finite counts as 0.
      share: of the previous value, in [0, 1).
    References:
      Holländer et al., 2013, section 6; after Herzog et al., "Spatio-Temporal Upsampling on the GPU", 2010.
    """
    check_same_shape("metric and previous", metric, previous)
    if not 0.0 <= share < 1.0:
        raise ValueError(f"share: expected a number in [0, 1), got {share}")
    # What was not a number must not stay so for the rest of the film.
    previous = jnp.where(jnp.isfinite(previous), previous, 0.0)
    return jnp.maximum(metric, share * previous + (1.0 - share) * metric)


def _mask(values: Array, covered: Bool[Array, "*b n"] | None) -> Bool[Array, "*b n"]:
    if covered is None:
        return jnp.ones(values.shape, bool)
    check_same_shape("sub-samples and covered", values, covered)
    return covered


def _finite(count: Float[Array, "*b"]) -> Float[Array, "*b"]:
    return jnp.where(jnp.isfinite(count), count, 0.0)


def _without_plane(difference: Float[Array, "*b n"], covered: Bool[Array, "*b n"]) -> Float[Array, "*b n"]:
    """What is left of mean-free values when the plane that fits them best is taken off."""
    size = window_size(covered.shape[-1])
    place = np.arange(size) - 0.5 * (size - 1)
    x, y = (jnp.asarray(v.reshape(-1), difference.dtype) for v in np.meshgrid(place, place))
    count = jnp.maximum(jnp.sum(covered, axis=-1, keepdims=True), 1).astype(difference.dtype)
    mean_free = lambda v: jnp.where(covered, v - jnp.sum(jnp.where(covered, v, 0.0), -1, keepdims=True) / count, 0.0)  # noqa: E731
    u, v = (mean_free(jnp.broadcast_to(values, difference.shape)) for values in (x, y))
    product = lambda a, b: jnp.sum(a * b, axis=-1, keepdims=True)  # noqa: E731
    # v is made orthogonal to u. Where all lie on one line nothing is left of it but rounding; else a tenth of a cell.
    v = v - safe_div(product(u, v), product(u, u)) * u
    v = jnp.where(product(v, v) > 1e-4, v, 0.0)
    for axis in (u, v):
        difference = difference - safe_div(product(axis, difference), product(axis, axis)) * axis
    return difference
