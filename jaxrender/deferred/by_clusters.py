"""A canvas, filled by clusters: first by the attributes alone, then again where shading or material turned out to vary.

In a film the second turn is nearly empty: what the frame before turned out is believed from the start.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.deferred.canvas import Canvas, leads
from jaxrender.deferred.clusters import Clusters, cluster_samples, is_uneven, shading_slope
from jaxrender.deferred.fxaa import luma
from jaxrender.deferred.metrics import average_over_frames, shading_steps
from jaxrender.deferred.point_lists import WINDOWS_PER_BLOCK, WINDOWS_PER_CALL, by_block, covered_pixels, in_calls
from jaxrender.deferred.sampling import first_sample
from jaxrender.deferred.subsamples import SubSamples
from jaxrender.srgb import encode_srgb


def shade_by_clusters(canvas: Canvas, method: Clusters, *, previous: Float[np.ndarray, "h w 2"] | None) -> None:
    """Shades one sample of each cluster.

    Args:
      previous: slopes (`shading_slope`) of the frame before.
    """
    samples, n = canvas.samples, canvas.covered.shape[-1]
    pixel = covered_pixels(canvas.covered)
    one_surface = np.asarray(_on_one_surface(samples)).reshape(-1)
    expected = np.zeros((len(one_surface), 2), np.float32)
    if previous is not None:
        faded, uneven = _faded(previous, n=n)
        expected, one_surface = np.asarray(faded).reshape(-1, 2), one_surface & ~np.asarray(uneven).reshape(-1)
    # A single sub-sample stands for itself, which is another footprint.
    whole = one_surface[pixel] & (np.count_nonzero(canvas.windows[pixel], axis=1) > 1)
    several, pixels = pixel[~whole], pixel[whole]
    canvas.shade_whole(pixels, in_calls(_first_sample, WINDOWS_PER_CALL, canvas.windows[pixels]))
    canvas.shade_clusters(several, _clusters(samples, several, expected[several], method))
    if method.contrast == 0.0 and method.detail == 0.0:
        return
    # Within a cluster a material varies less than within the pixel: about as much less as the cluster is narrower.
    detail = canvas.detail if previous is None else canvas.detail * np.sqrt(canvas.count, dtype=np.float32)
    slope, uneven = _slopes(
        canvas.as_map(canvas.image), canvas.covered.any(axis=-1), canvas.as_map(detail), previous,
        np.float32(method.contrast * method.scale), np.float32(method.detail * method.scale), n=n,
    )  # fmt: skip
    canvas.evidence = np.asarray(slope)
    uneven = pixel[np.asarray(uneven).reshape(-1)[pixel]]
    finer = _clusters(samples, uneven, canvas.evidence.reshape(-1, 2)[uneven], method)
    more = np.bincount(leads(finer)[0], minlength=len(uneven)) > canvas.count[uneven]
    canvas.shade_clusters(uneven[more], finer[more])


def _clusters(samples: SubSamples, pixel, slope, method: Clusters) -> Int[np.ndarray, "p n"]:
    scales = np.float32(method.normal * method.scale), np.float32(method.plane * method.scale)
    return in_calls(_cluster_windows, WINDOWS_PER_CALL, pixel.astype(np.int32), slope, fixed=(samples, *scales))


@jax.jit
def _cluster_windows(samples: SubSamples, normal_scale, plane_scale, pixel, slope) -> Int[Array, "p n"]:
    n = samples.depth.shape[-1]

    def group(block: tuple[Array, Array]) -> Int[Array, "b n"]:
        pixel, slope = block
        found, _ = samples.look(pixel[:, None] * n + jnp.arange(n, dtype=jnp.int32)[None])
        return cluster_samples(
            found.normal, found.position, found.depth, found.material_id, found.coverage, slope,
            normal_scale=normal_scale, plane_scale=plane_scale,
        ).astype(jnp.int8)  # fmt: skip

    return by_block(group, WINDOWS_PER_BLOCK, pixel, slope)


_on_one_surface = jax.jit(lambda samples: samples.one_surface)
_first_sample = jax.jit(first_sample)


@functools.partial(jax.jit, static_argnames="n")
def _faded(previous, *, n: int) -> tuple[Float[Array, "h w 2"], Bool[Array, "h w"]]:
    """What is left of the slopes of the frame before if this one shows none."""
    slope = average_over_frames(jnp.zeros_like(previous), jnp.asarray(previous))
    return slope, is_uneven(slope, n)


@functools.partial(jax.jit, static_argnames="n")
def _slopes(
    image, covered, detail, previous, contrast_scale, detail_scale, *, n: int
) -> tuple[Float[Array, "h w 2"], Bool[Array, "h w"]]:
    """What `shading_slope` expects of each pixel from what was shaded so far, and whether that is much."""
    light = luma(encode_srgb(image))
    steps = shading_steps(light, covered=covered)
    slope = shading_slope(steps, detail, light, contrast_scale=contrast_scale, detail_scale=detail_scale)
    slope = slope if previous is None else average_over_frames(slope, previous)
    return slope, is_uneven(slope, n)
