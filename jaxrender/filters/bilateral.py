"""Cross-bilateral filter, and the sums over pairs of pixels that the à-trous filter is made of, too.

One image `(h, w, c)`; batches by `vmap`. Two pixels weigh the same for one another, so each pair is weighed once.
Planes are one long row each: pixel row after pixel row, zeros between. So an offset is one number, and XLA's CPU code
is vectorised: 0.6 ns a weight at 1024 x 768, radius 16, four features, on one core; 3.2 ns with planes of rows and
columns, and 1.2 ns if every pixel weighs all around it.

Differentiable in reverse mode, by a rule written out: what it keeps are the inputs and the sums, no image per offset.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_whole
from jaxrender.filters.valid import check_images, valid_pixels

#: A smaller total weight counts as none: near the smallest float32, sums have no digits left.
LEAST_WEIGHT = 1e-30

# Offsets per turn of the loop. Sums are read and written once a turn; each offset keeps a plane meanwhile.
_AT_ONCE = 4


class Likeness(NamedTuple):
    """What makes pixels alike: weight exp(-Σ (scale · difference)²) of two of which it is known, and 1 of others."""

    planes: tuple[Float[Array, "n"], ...]
    scales: Float[Array, "f"]
    known: Bool[Array, "n"]


def cross_bilateral_filter(
    image: Float[Array, "h w c"],
    features: Float[Array, "h w f"],
    *,
    radius: int,
    sigma_spatial: float | Float[Array, ""],
    sigma_features: float | Float[Array, "..."],
) -> Float[Array, "h w c"]:
    """Mean of the pixels around, weighted by how near they are and how much alike in the features.

    The weight is exp(-|p - q|² / (2 sigma_spatial²)) · Π exp(-(F(p) - F(q))² / (2 sigma²)), a factor for each feature
    F. The window is the full square of (2 radius + 1)² pixels, cropped at the border.

    A pixel with a NaN or Inf in image or features gives nothing to others. It gets a value as they do, by distance
    alone if it is the features that are not finite. A total weight below 1e-30 counts as none and gives 0.

    Linear in the image. Differentiable, in reverse mode, in image, features and both sigmas. Time grows with the square
    of the radius, memory hardly.

    Args:
      image: any range. Half precision is summed in float32; the result has the type of the image.
      radius: in pixels, >= 0; may exceed the image.
      sigma_spatial: in pixels, > 0.
      sigma_features: in units of the features, > 0; one number, or one for each. With inf a feature does not count.
    Raises:
      ValueError: if image and features differ in height or width or are empty, a sigma has another shape or is a number
        <= 0, or radius < 0.
      TypeError: if image or features do not hold floating-point numbers.
    References:
      Petschnigg et al., "Digital Photography with Flash and No-Flash Image Pairs", SIGGRAPH 2004 (joint bilateral
      filter); Eisemann, Durand, "Flash Photography Enhancement via Intrinsic Relighting", SIGGRAPH 2004 (cross).
    """
    check_images(image=image, features=features)
    check_whole("radius", radius, 0)
    dtype = working_dtype(image, features)
    nearness = 0.5 / sigma_values("sigma_spatial", sigma_spatial, (), dtype) ** 2
    scales = math.sqrt(0.5) / sigma_values("sigma_features", sigma_features, features.shape[2:], dtype)

    height, width = image.shape[:2]
    y, x = half_window(min(radius, height - 1), min(radius, width - 1))
    gap = int(max(x, default=0))
    valid, known = valid_pixels(image, features), valid_pixels(features)
    values = to_planes(jnp.concatenate([finite(image, valid, dtype), valid[..., None].astype(dtype)], axis=-1), gap)
    likeness = Likeness(to_planes(finite(features, known, dtype), gap), scales, to_planes(known[..., None], gap)[0])
    around = pair_sums(values, (likeness,), y * (width + gap) + x, -nearness * jnp.asarray(y**2 + x**2, dtype))
    mean, _ = weighted_mean([v + a for v, a in zip(values, around, strict=True)])
    return from_planes(mean, height, width).astype(image.dtype)


def half_window(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The offsets (y, x) that come after the centre in a window of so many pixels to each side: one of each pair."""
    y, x = np.mgrid[0 : height + 1, -width : width + 1].reshape(2, -1)
    after = (y > 0) | (x > 0)
    return y[after], x[after]


def working_dtype(*images: Array) -> Any:
    """What to sum in: float64 if an image is, else float32."""
    return jnp.float64 if any(image.dtype == jnp.float64 for image in images) else jnp.float32


def sigma_values(name: str, sigma: float | Array, shape: tuple[int, ...], dtype: Any) -> Float[Array, "..."]:
    """A sigma as an array of a shape, for which one number is enough.

    Raises:
      ValueError: if it has another shape, or is a number <= 0. Values of arrays are not looked at.
    """
    if jnp.shape(sigma) not in ((), shape):
        raise ValueError(f"{name}: expected a number or an array of shape {shape}, got shape {jnp.shape(sigma)}")
    if isinstance(sigma, int | float) and not sigma > 0.0:
        raise ValueError(f"{name}: expected a value > 0, got {sigma}")
    return jnp.broadcast_to(jnp.asarray(sigma).astype(dtype), shape)


def finite(image: Float[Array, "h w c"], where: Bool[Array, "h w"], dtype: Any) -> Float[Array, "h w c"]:
    """The image in another precision, 0 elsewhere, and cut to where the difference of two is finite."""
    limit = jnp.finfo(dtype).max / 4
    return jnp.clip(jnp.where(where[..., None], image.astype(dtype), 0.0), -limit, limit)


def to_planes(image: Array, gap: int) -> tuple[Array, ...]:
    """Each channel as one row, with so many zeros after each row of pixels that offsets do not lead around."""
    padded = jnp.pad(image, ((0, 0), (0, gap), (0, 0)))
    return tuple(padded[..., k].reshape(-1) for k in range(image.shape[-1]))


def from_planes(planes: Sequence[Array], height: int, width: int) -> Array:
    """The image of such planes."""
    return jnp.stack([p.reshape(height, -1)[:, :width] for p in planes], axis=-1)


def weighted_mean(sums: Sequence[Float[Array, "n"]]) -> tuple[list[Float[Array, "n"]], Bool[Array, "n"]]:
    """Sums, of which the last is that of the weights, as means, 0 where there is no weight; and where there is."""
    *channels, total = sums
    found = total > LEAST_WEIGHT
    return [jnp.where(found, channel / jnp.where(found, total, 1.0), 0.0) for channel in channels], found


def pair_sums(
    values: Sequence[Float[Array, "n"]],
    likenesses: Sequence[Likeness],
    offsets: np.ndarray | Int[Array, "k"],
    log_weights: Float[Array, "k"],
    *,
    reach: int | None = None,
) -> list[Float[Array, "n"]]:
    """Sums over the neighbours at p ± offset, Σ w v, of planes of values v; p itself is not one of them.

    w is exp(log_weight) times the weights of all likenesses. Values must be 0 where a likeness is not known: such
    pixels take but do not give.

    Args:
      offsets: >= 0, in entries of the planes.
      log_weights: of each offset; -inf leaves it out.
      reach: the largest offset, if they are not known before the program runs.
    """
    reach = int(max(offsets, default=0)) if reach is None else reach
    missing = -len(offsets) % _AT_ONCE
    offsets = jnp.pad(jnp.asarray(offsets, jnp.int32), (0, missing)).reshape(-1, _AT_ONCE)
    log_weights = jnp.pad(log_weights, (0, missing), constant_values=-jnp.inf).reshape(offsets.shape)
    return _pair_sums(reach, list(values), list(likenesses), offsets, log_weights)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _pair_sums(reach, values, likenesses, offsets, log_weights):
    size, num_pairs = values[0].size, values[0].size + reach
    values, likenesses = _padded(values, likenesses, reach)

    def add(sums, some):
        weights = jax.lax.map(lambda pair: _weight(likenesses, *pair, num_pairs), some)
        return [_add_both_ways(s, weights, some[0], v, reach) for s, v in zip(sums, values, strict=True)], None

    return jax.lax.scan(add, [jnp.zeros(size, v.dtype) for v in values], (offsets, log_weights))[0]


def _pair_sums_forward(reach, values, likenesses, offsets, log_weights):
    return _pair_sums(reach, values, likenesses, offsets, log_weights), (values, likenesses, offsets, log_weights)


def _pair_sums_backward(reach, kept, slopes):
    """Derivatives of values are the same sums, of the slopes. That of w(p, q) is slope(p) v(q) + slope(q) v(p).

    With D = w times the latter, a pair adds D to its log weight; for each plane of a likeness, whose step over the pair
    is d, it adds 2 D scale² d to one end, takes it from the other, and adds -2 D scale d² to the scale.
    """
    values, likenesses, offsets, log_weights = kept
    zeros = jax.tree.map(jnp.zeros_like, (values, [list(x.planes) for x in likenesses]))
    num_pairs = values[0].size + reach
    values, likenesses = _padded(values, likenesses, reach)
    slopes, _ = _padded(slopes, [], reach)

    def weigh(pair):
        offset, _ = pair
        weight = _weight(likenesses, *pair, num_pairs)
        change = weight * sum(
            g[:num_pairs] * _part(v, offset, num_pairs) + v[:num_pairs] * _part(g, offset, num_pairs)
            for g, v in zip(slopes, values, strict=True)
        )
        changes = [jnp.where(_both(x.known, offset, num_pairs), change, 0.0) for x in likenesses]
        steps = [[_step(p, offset, num_pairs) for p in x.planes] for x in likenesses]
        spreads = [  # of a huge step the weight is 0, but its square infinite
            jnp.array([jnp.sum((d * step) * step) for step in group], change.dtype)
            for d, group in zip(changes, steps, strict=True)
        ]
        return weight, changes, jnp.sum(change), spreads

    def add(sums, some):
        of_values, of_planes = sums
        weights, changes, *scalars = jax.lax.map(weigh, some)  # fused into the sums, changes would cost eight times
        of_values = [_add_both_ways(s, weights, some[0], g, reach) for s, g in zip(of_values, slopes, strict=True)]
        of_planes = [
            [_add_both_ways(s, d, some[0], p, reach, steps=True) for s, p in zip(group, x.planes, strict=True)]
            for group, d, x in zip(of_planes, changes, likenesses, strict=True)
        ]
        return (of_values, of_planes), scalars

    (of_values, of_planes), (of_log_weights, spreads) = jax.lax.scan(add, zeros, (offsets, log_weights))
    of_likenesses = [
        Likeness(
            tuple(2.0 * scale**2 * s for scale, s in zip(x.scales, group, strict=True)),
            -2.0 * x.scales * jnp.sum(spread, axis=(0, 1)),
            np.zeros(x.known.size - 2 * reach, jax.dtypes.float0),
        )
        for x, group, spread in zip(likenesses, of_planes, spreads, strict=True)
    ]
    return of_values, of_likenesses, None, of_log_weights


_pair_sums.defvjp(_pair_sums_forward, _pair_sums_backward)


def _padded(values, likenesses, reach):
    """Planes with zeros at both ends: pairs begin at the first of these and end at the last."""
    return [jnp.pad(v, reach) for v in values], [
        Likeness(tuple(jnp.pad(p, reach) for p in x.planes), x.scales, jnp.pad(x.known, reach)) for x in likenesses
    ]


def _weight(likenesses, offset, log_weight, num_pairs):
    """w of the pairs (p, p + offset)."""
    exponent = jnp.full(num_pairs, log_weight)
    for x in likenesses:
        terms = [(scale * _step(p, offset, num_pairs)) ** 2 for scale, p in zip(x.scales, x.planes, strict=True)]
        exponent = exponent - jnp.where(_both(x.known, offset, num_pairs), sum(terms), 0.0)
    return jnp.exp(exponent)


def _add_both_ways(sums, weights, offsets, plane, reach, steps=False):
    """Adds what p + offset and p - offset give to p: weight times the plane there, or times the step to there."""
    here = plane[reach : reach + sums.size] if steps else 0.0
    for weight, offset in zip(weights, offsets, strict=True):
        ahead, behind = weight[reach:], _part(weight, reach - offset, sums.size)
        after, before = (_part(plane, reach + sign * offset, sums.size) - here for sign in (1, -1))
        sums = sums + (ahead * after + behind * before)
    return sums


def _step(plane, offset, num_pairs):
    return plane[:num_pairs] - _part(plane, offset, num_pairs)


def _both(known, offset, num_pairs):
    return known[:num_pairs] & _part(known, offset, num_pairs)


def _part(plane, start, size):
    return jax.lax.dynamic_slice(plane, (start,), (size,))
