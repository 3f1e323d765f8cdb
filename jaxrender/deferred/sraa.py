"""Subpixel reconstruction anti-aliasing (SRAA): one shaded sample per pixel, geometry at all of them.

Image kernel; light is linear. The n = size² sub-samples of a pixel form a grid, row by row.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxrender.checks import bad_input, check_at_least


def sraa(
    shading: Float[Array, "h w 3"],
    depth: Float[Array, "h w n"],
    normal: Float[Array, "h w n 3"],
    covered: Bool[Array, "h w n"],
    first: Int[Array, "h w"],
    *,
    size: int,
    sigma_depth: float,
    sigma_normal: float,
    sigma_space: float = math.inf,
) -> Float[Array, "h w 3"]:
    """Gives every covered sub-sample the radiance of shaded samples of the same surface, then takes their mean.

    Sub-sample i gets the mean over the shaded samples j of the 3 x 3 pixels around, cropped at the border, weighted by

        exp(-max(|z_i - z_j| / (sigma_depth z_i), (1 - n_i·n_j) / sigma_normal) - |x_i - x_j|² / (2 sigma_space²)),

    the form of the authors' published kernel, with relative depth and a term of space. Empty samples have no weight.
    Weights are taken relative to the largest, so they never vanish: where no shaded sample is of the same surface, the
    one most like it counts. Without any shaded sample around, a sub-sample gets its pixel's entry of `shading`, and so
    does a pixel without covered sub-samples.

    Differentiable in shading (linearly), depth and normal.

    Args:
      shading: radiance of the sub-sample `first` of each pixel; the background where that one is empty.
      depth: view depth, > 0, in any unit; read at covered sub-samples only, like normal.
      normal: unit.
      first: index of the shaded sub-sample, clamped to [0, n - 1].
      size: sub-samples along a side of the pixel.
      sigma_depth: relative difference of depth at which the weight falls to 1/e, > 0.
      sigma_normal: 1 - cos of the angle between normals at which it does, > 0.
      sigma_space: in pixels, > 0. Infinite, the default, smooths shading by 3 x 3 on flat ground; 1/2 keeps detail.
    Raises:
      ValueError: if shapes do not fit each other, or an option is out of its range.
    References:
      Chajdas, McGuire, Luebke, "Subpixel Reconstruction Antialiasing for Deferred Shading", I3D 2011, sec. 3.
    """
    _check(shading, depth, normal, covered, first, size)
    for name, sigma in (("depth", sigma_depth), ("normal", sigma_normal), ("space", sigma_space)):
        if not sigma > 0.0:
            raise ValueError(f"sigma_{name}: expected a value > 0, got {sigma}")
    # Planes (..., h, w). With coordinates as the last axis this takes five times as long, and jaxlib 0.10.2 compiles
    # sums over it, of broadcast factors and fused with other terms, to wrong ones on CPUs.
    covered, depth, normal = (
        jnp.moveaxis(covered, 2, 0),
        jnp.moveaxis(depth, 2, 0),
        jnp.moveaxis(normal, (2, 3), (0, 1)),
    )
    light = jnp.moveaxis(shading, 2, 0)
    # What lies in empty samples must not reach the arithmetic, nor its derivatives.
    depth, normal = jnp.where(covered, depth, 1.0), jnp.where(covered[:, None], normal, 0.0)
    place = jnp.asarray((np.argwhere(np.ones((size, size)))[:, ::-1] + 0.5) / size, depth.dtype)

    index = jnp.clip(first, 0, size * size - 1)
    shaded = jnp.take_along_axis(covered, index[None], axis=0)[0]
    neighbours = list(
        zip(
            _windows(shaded),
            _windows(jnp.take_along_axis(depth, index[None], axis=0)[0]),
            _windows(jnp.take_along_axis(normal, index[None, None], axis=0)[0]),
            _windows(jnp.moveaxis(place[index], 2, 0)),
            _windows(jnp.where(shaded[None], light, 0.0)),
            [(dx, dy) for dy in (-1.0, 0.0, 1.0) for dx in (-1.0, 0.0, 1.0)],
            strict=True,
        )
    )

    def add_sample(total: Array, sample: tuple[Array, Array, Array, Array]) -> tuple[Array, None]:
        """Adds one sub-sample of every pixel."""
        here, z, n, x = sample
        unlike = []
        for found, z_j, n_j, x_j, _, pixel in neighbours:
            by_depth = jnp.abs(z - z_j) / (sigma_depth * z)
            cosine = n[0] * n_j[0] + n[1] * n_j[1] + n[2] * n_j[2]
            distance2 = (x_j[0] + pixel[0] - x[0]) ** 2 + (x_j[1] + pixel[1] - x[1]) ** 2
            far = jnp.maximum(by_depth, (1.0 - cosine) / sigma_normal) + distance2 / (2.0 * sigma_space**2)
            unlike.append(jnp.where(found, far, jnp.inf))

        least = jax.lax.stop_gradient(functools.reduce(jnp.minimum, unlike))
        alone = jnp.isinf(least)
        least = jnp.where(alone, 0.0, least)
        weights = [jnp.exp(least - u) for u in unlike]
        norm = jnp.where(alone, 1.0, sum(weights))
        mean = sum(weight[None] * of[4] for weight, of in zip(weights, neighbours, strict=True)) / norm[None]
        return total + jnp.where(here[None], jnp.where(alone[None], light, mean), 0.0), None

    # Sub-samples one after another, and going back computed again: the weights of all would be 9 size² images.
    total, _ = jax.lax.scan(jax.checkpoint(add_sample), jnp.zeros_like(light), (covered, depth, normal, place))
    count = jnp.sum(covered, axis=0)[None].astype(light.dtype)
    return jnp.moveaxis(jnp.where(count > 0.0, total / jnp.maximum(count, 1.0), light), 0, 2)


def _windows(planes: Shaped[Array, "*c h w"]) -> list[Shaped[Array, "*c h w"]]:
    """What the 3 x 3 pixels around each pixel hold, row by row; 0 or False beyond the border."""
    h, w = planes.shape[-2:]
    padded = jnp.pad(planes, ((0, 0),) * (planes.ndim - 2) + ((1, 1), (1, 1)))
    return [padded[..., y : y + h, x : x + w] for y in range(3) for x in range(3)]


def _check(shading: Array, depth: Array, normal: Array, covered: Array, first: Array, size: int) -> None:
    check_at_least("size", size, 1)
    if shading.ndim != 3 or shading.shape[2] != 3:
        bad_input("shading", "shape", expected="(h, w, 3)", got=tuple(shading.shape))
    pixels = tuple(shading.shape[:2])
    samples = (*pixels, size * size)
    for name, array, shape in (
        ("depth", depth, samples),
        ("normal", normal, (*samples, 3)),
        ("covered", covered, samples),
        ("first", first, pixels),
    ):
        if tuple(array.shape) != shape:
            bad_input(name, "shape", expected=shape, got=tuple(array.shape))
