"""A canvas, filled the printed way: first one sample of each pixel, then as many more as the metrics say."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrender.deferred.bands import band_starts, in_bands
from jaxrender.deferred.canvas import Canvas
from jaxrender.deferred.fxaa import luma
from jaxrender.deferred.gbuffer import rows_per_band
from jaxrender.deferred.highlights import highlight_sample_count
from jaxrender.deferred.material_textures import NORMAL, look_up_material
from jaxrender.deferred.metrics import (
    SampleMetrics,
    average_over_frames,
    balanced_counts,
    depth_sample_count,
    normal_sample_count,
    sample_count,
    shading_sample_count,
    tile_maximum,
)
from jaxrender.deferred.point_lists import covered_pixels
from jaxrender.deferred.point_shading import Lighting
from jaxrender.deferred.sampling import first_sample, window_size
from jaxrender.deferred.strategies import work_order
from jaxrender.deferred.subsamples import SubSamples
from jaxrender.srgb import encode_srgb

#: Side of the tiles of "low_resolution", as in the paper.
TILE = 6


def shade_by_counts(
    canvas: Canvas, method: SampleMetrics, *, strategy: str, previous: Float[np.ndarray, "h w 1"] | None
) -> None:
    """Shades the first K samples of each pixel.

    Args:
      strategy: of `work_order`.
      previous: the largest metric of each pixel in the frame before.
    """
    n = canvas.covered.shape[-1]
    size, pixel = window_size(n), covered_pixels(canvas.covered)
    num_covered = np.count_nonzero(canvas.windows[pixel], axis=1)
    allowed = balanced_counts(size) if method.balanced else None

    def counted(metric: Float[Array, "h w"]) -> np.ndarray:
        count = sample_count(metric, size=size, allowed=allowed)
        if strategy == "low_resolution":
            count = tile_maximum(count, tile=TILE)
        return np.minimum(np.asarray(count).reshape(-1)[pixel], num_covered)

    settled = (lambda m: m) if previous is None else lambda m: average_over_frames(m, jnp.asarray(previous[..., 0]))
    metric = _geometric_metric(canvas.samples, canvas.lighting, method)
    count = counted(settled(metric))
    first, radiance, canvas.roughness[pixel], weight = canvas.shade_prefixes(pixel, np.zeros_like(pixel), count)
    canvas.image[pixel] = radiance
    metric = settled(_with_shading(canvas, method, metric))
    canvas.evidence = np.asarray(metric)[..., None]
    wanted = counted(metric)
    # The first sample is shaded again where its footprint has shrunk.
    kept = wanted == count
    entry, slot = work_order(wanted - kept, strategy=strategy)
    idle = entry < 0
    entry = np.maximum(entry, 0)
    slot = np.minimum(slot + kept[entry], wanted[entry] - 1)
    sample, again, _, share = canvas.shade_prefixes(pixel[entry], slot, wanted[entry])
    canvas.num_shaded -= int(idle.sum())
    row = np.concatenate([np.flatnonzero(kept), entry[~idle]])
    sample, radiance, weight = (
        np.concatenate([a[kept], b[~idle]]) for a, b in ((first, sample), (radiance, again), (weight, share))
    )
    # One order of summation, whatever the order of evaluation.
    order = np.lexsort([sample, row])
    canvas.put(pixel, row[order], radiance[order], weight[order])


def _geometric_metric(samples: SubSamples, lighting: Lighting, method: SampleMetrics) -> Float[Array, "h w"]:
    """max(k_d, k_n) before it becomes a count."""
    height, width, n = samples.depth.shape
    band = rows_per_band(height, width * n)
    known = samples.covered & jnp.isfinite(samples.depth)
    far = jnp.max(jnp.where(known, samples.depth, 0.0), initial=1e-30)
    scales = [None if c is None else np.float32(c * method.scale) for c in (method.depth, method.normal)]
    rows = functools.partial(
        _metric_rows, samples, lighting, far, *scales, np.float32(method.least), num_rows=band,
        plane_corrected=method.plane_corrected, mapped_normals=method.mapped_normals,
    )  # fmt: skip
    return in_bands(lambda start: rows(np.int32(start)), band_starts(height, band), height=height)


@functools.partial(jax.jit, static_argnames=("num_rows", "plane_corrected", "mapped_normals"))
def _metric_rows(
    samples, lighting, far, depth_scale, normal_scale, least, start, *, num_rows: int, plane_corrected: bool,
    mapped_normals: bool,
) -> Float[Array, "r w"]:  # fmt: skip
    cut = lambda values: jax.lax.dynamic_slice_in_dim(values, start, num_rows)  # noqa: E731
    covered = cut(samples.covered)
    metric = jnp.full(covered.shape[:2], least)
    if depth_scale is not None:
        by_depth = depth_sample_count(
            cut(samples.depth) / far, scale=depth_scale, covered=covered, plane_corrected=plane_corrected
        )
        metric = jnp.maximum(metric, by_depth)
    if normal_scale is not None:
        normal = _normals(samples, lighting if mapped_normals else None, _places(start, covered.shape))
        metric = jnp.maximum(metric, normal_sample_count(normal, scale=normal_scale, covered=covered))
    return metric


def _places(start: Array, shape: tuple[int, ...]) -> Int[Array, "r w n"]:
    """Where the sub-samples of rows are in the image, counted through."""
    rows, width, n = shape
    return start * (width * n) + jnp.arange(rows * width * n, dtype=jnp.int32).reshape(shape)


def _normals(samples: SubSamples, lighting: Lighting | None, place: Array) -> Float[Array, "*b 3"]:
    """Normals of sub-samples; those of normal maps, looked up over each one's cell, if there is lighting."""
    found, tangent = samples.look(place)
    if lighting is None or tangent is None or NORMAL not in lighting.slots:
        return found.normal
    size = window_size(samples.depth.shape[-1])
    cell = dataclasses.replace(found, duv_dx=found.duv_dx / size, duv_dy=found.duv_dy / size)
    return look_up_material(
        cell, tangent, samples.material, lighting.textures, max_anisotropy=lighting.max_anisotropy, slots=(NORMAL,)
    )[1]


def _with_shading(canvas: Canvas, method: SampleMetrics, metric: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """The metric, or those that look at the first shading where they are larger."""
    if method.shading is not None:
        by_shading = shading_sample_count(
            _encoded_luma(canvas.as_map(canvas.image)), scale=method.shading * method.scale,
            edge_threshold=method.edge_threshold, min_threshold=method.min_threshold,
            covered=jnp.asarray(canvas.covered.any(axis=-1)),
        )  # fmt: skip
        metric = jnp.maximum(metric, by_shading)
    if method.highlight is not None and canvas.lighting.model != "lambert":
        metric = jnp.maximum(metric, _highlight_metric(canvas, method))
    return metric


def _highlight_metric(canvas: Canvas, method: SampleMetrics) -> Float[Array, "h w"]:
    assert method.highlight is not None
    height, width, n = canvas.covered.shape
    band = rows_per_band(height, width * n)
    light, roughness = _linear_luma(canvas.as_map(canvas.image)), canvas.as_map(canvas.roughness)
    rows = functools.partial(
        _highlight_rows, canvas.samples, canvas.lighting, light, roughness, np.float32(method.highlight * method.scale),
        num_rows=band, mapped_normals=method.mapped_normals,
    )  # fmt: skip
    return in_bands(lambda start: rows(np.int32(start)), band_starts(height, band), height=height)


@functools.partial(jax.jit, static_argnames=("num_rows", "mapped_normals"))
def _highlight_rows(
    samples, lighting, light, roughness, scale, start, *, num_rows: int, mapped_normals: bool
) -> Float[Array, "r w"]:
    cut = lambda values: jax.lax.dynamic_slice_in_dim(values, start, num_rows)  # noqa: E731
    covered = cut(samples.covered)
    place = _places(start, covered.shape)
    first, _ = samples.look(jnp.take_along_axis(place, first_sample(covered)[..., None], axis=-1)[..., 0])
    normal = _normals(samples, lighting if mapped_normals else None, place)
    return highlight_sample_count(
        normal, first.position, cut(roughness), cut(light), lighting.lights, lighting.eye, scale=scale, covered=covered
    )


_encoded_luma = jax.jit(lambda image: luma(encode_srgb(jnp.asarray(image))))
_linear_luma = jax.jit(lambda image: luma(jnp.asarray(image)))
