"""Adaptive supersampling, the stages in order: sub-samples -> first shading -> counts or clusters -> more -> pixels.

Not for use inside `jit`: lists are as long as there are samples to shade. All that works on arrays is.

References:
  Holländer, Boubekeur, Eisemann, "Adaptive Supersampling for Deferred Anti-Aliasing", JCGT 2(1), 2013.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.camera import Camera
from jaxrender.checks import check_at_least, check_one_of
from jaxrender.deferred.bands import band_starts, in_bands
from jaxrender.deferred.clusters import Clusters, cluster_samples, is_uneven, shading_slope
from jaxrender.deferred.fxaa import luma
from jaxrender.deferred.gbuffer import SAMPLES_PER_BAND, GBuffer
from jaxrender.deferred.material_textures import MaterialTextures, material_slots
from jaxrender.deferred.metrics import (
    SampleMetrics,
    balanced_counts,
    depth_sample_count,
    normal_sample_count,
    sample_count,
    shading_sample_count,
    shading_steps,
    tile_maximum,
)
from jaxrender.deferred.pipeline import default_lights, scene_material_textures, scene_table, see
from jaxrender.deferred.point_shading import TAPS, Lighting, shade_points
from jaxrender.deferred.raster import room_for
from jaxrender.deferred.samples import ordered_grid
from jaxrender.deferred.sampling import ShadingPoints, cluster_points, first_sample, prefix_points, sample_rank
from jaxrender.deferred.strategies import STRATEGIES, work_order
from jaxrender.deferred.subsamples import GBufferSamples, SubSamples, group_samples, scene_samples
from jaxrender.deferred.texture import Textures
from jaxrender.machine import on_all_cores
from jaxrender.scene import Lights, Material, Scene
from jaxrender.srgb import encode_srgb

#: Points that are shaded by one call, and at a time; windows that are clustered by one call, and at a time.
_POINTS_PER_CALL, _POINTS_PER_BLOCK, _WINDOWS_PER_CALL, _WINDOWS_PER_BLOCK = 1 << 16, 1024, 1 << 14, 256


@dataclass(frozen=True)
class Uniform:
    """The same count in every pixel: the baseline of all metrics."""

    count: int


Method = Clusters | SampleMetrics | Uniform

#: Sub-samples of a window are numbered in bytes.
_LARGEST_SIZE = 11

CLUSTERS = Clusters()


@dataclass(frozen=True)
class AdaptiveImage:
    """A picture and what it took.

    Attributes:
      image: linear RGB, the mean over covered sub-samples; alpha: share of covered ones.
      count: samples of each pixel that the picture is made of; 0 where it is empty.
      num_shaded: samples that were shaded, also those that were shaded again with another footprint.
      num_covered: sub-samples that full supersampling shades.
    """

    image: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    count: Int[np.ndarray, "h w"]
    num_shaded: int
    num_covered: int

    @property
    def sample_share(self) -> float:
        """What part of the covered sub-samples was shaded."""
        return self.num_shaded / max(self.num_covered, 1)


def render_supersampled(
    scene: Scene, camera: Camera, *, height: int, width: int, size: int = 4, **options: Any
) -> AdaptiveImage:
    """Full ordered-grid supersampling: every sub-sample is shaded, with the footprint of its own cell.

    The reference of `render_adaptive`; the same arguments.
    """
    samples, lighting = scene_view(scene, camera, height=height, width=width, size=size, **options)
    return supersample(samples, lighting)


def render_adaptive(
    scene: Scene, camera: Camera, *, height: int, width: int, size: int = 4, method: Method = CLUSTERS,
    strategy: str = "compacted", **options: Any,
) -> AdaptiveImage:  # fmt: skip
    """Renders a scene at m x m samples a pixel, of which only some are shaded.

    Args:
      size: m, up to 11.
      method: which ones. `Clusters` (the default), the printed `SampleMetrics`, or `Uniform`.
      strategy: of `shade_adaptive`.
      options: textures, lights, ambient, max_anisotropy, transparency and model, as in `render_scene`.
    """
    samples, lighting = scene_view(scene, camera, height=height, width=width, size=size, **options)
    return shade_adaptive(samples, lighting, method=method, strategy=strategy)


def scene_view(
    scene: Scene, camera: Camera, *, height: int, width: int, size: int,
    textures: Textures | MaterialTextures | None = None,
    lights: Lights | None = None, ambient: Float[Array, "3 k"] | None = None, max_anisotropy: int = 8,
    transparency: str = "test", model: str = "metallic_roughness",
) -> tuple[SubSamples, Lighting]:  # fmt: skip
    """Rasterises a scene: its sub-samples, and what shading them needs. Arguments as in `render_scene`."""
    check_at_least("height", height, 1)
    check_at_least("width", width, 1)
    _check_size(size)
    grid = ordered_grid(size)
    textures = scene_material_textures(scene) if textures is None else textures
    if lights is None and ambient is None and not len(scene.lights.kind):
        lights, ambient = default_lights()
    fragments = see(
        scene, camera, height=height, width=width, samples=grid, textures=textures, transparency=transparency
    )
    table = scene_table(scene, fragments.triangles, None, grid=size)
    lighting = Lighting(
        lights=scene.lights if lights is None else lights, ambient=ambient, eye=camera.eye, textures=textures,
        slots=material_slots(scene.material), max_anisotropy=max_anisotropy, model=model,
    )  # fmt: skip
    return scene_samples(scene.material, table, fragments), lighting


def gbuffer_view(gbuffer: GBuffer, material: Material, *, size: int) -> GBufferSamples:
    """The sub-samples of a G-buffer: one with m x m samples a pixel, or one of m times the picture's size."""
    _check_size(size)
    if gbuffer.depth.shape[-1] != size * size:
        gbuffer = group_samples(gbuffer, size=size)
    return GBufferSamples(material=material, gbuffer=gbuffer)


def _check_size(size: int) -> None:
    if not 1 <= size <= _LARGEST_SIZE:
        raise ValueError(f"size: expected a number from 1 to {_LARGEST_SIZE}, got {size}")


def supersample(samples: SubSamples, lighting: Lighting) -> AdaptiveImage:
    """Shades every covered sub-sample."""
    covered = np.asarray(samples.covered)
    pixel = _pixels(covered)
    windows = covered.reshape(-1, covered.shape[-1])[pixel]
    owner = np.where(windows, np.arange(covered.shape[-1], dtype=np.int8), np.int8(-1))
    picture = _Picture(samples, lighting, covered)
    picture.shade_clusters(pixel, owner)
    return picture.result()


def shade_adaptive(
    samples: SubSamples, lighting: Lighting, *, method: Method = CLUSTERS, strategy: str = "compacted"
) -> AdaptiveImage:
    """Shades some of the sub-samples of each pixel.

    Args:
      samples, lighting: of `scene_view`, or of `gbuffer_view` and made by hand.
      strategy: how the samples of a count are put together for evaluation (`work_order`); the image is the same, but
        for "low_resolution". Clusters are always compacted.
    """
    check_one_of("strategy", strategy, STRATEGIES)
    covered = np.asarray(samples.covered)
    picture = _Picture(samples, lighting, covered)
    pixel = _pixels(covered)
    if isinstance(method, Clusters):
        if strategy != "compacted":
            raise ValueError(f'strategy: expected "compacted" for Clusters, got {strategy}')
        _shade_clusters(picture, pixel, method)
    else:
        _shade_counts(picture, pixel, method, strategy)
    return picture.result()


class _Picture:
    """Pixels on their way: sums of radiance and counts, filled list by list."""

    def __init__(self, samples: SubSamples, lighting: Lighting, covered: Bool[np.ndarray, "h w n"]):
        self.samples, self.lighting, self.covered = samples, lighting, covered
        height, width, _ = covered.shape
        self.image = np.zeros((height * width, 3), np.float32)
        self.detail = np.zeros(height * width, np.float32)
        self.count = np.zeros(height * width, np.int32)
        self.num_shaded = 0

    def shade_clusters(self, pixel: Int[np.ndarray, " p"], owner: Int[np.ndarray, "p n"]) -> None:
        """Shades one sample of each cluster of some pixels, instead of what they had."""
        n = owner.shape[1]
        row, sample = np.nonzero(owner == np.arange(n, dtype=owner.dtype))
        row, sample = row.astype(np.int32), sample.astype(np.int32)
        owners = owner[row]
        alone = np.count_nonzero(owners == sample[:, None].astype(owner.dtype), axis=1) == 1
        radiance, weight = np.zeros((len(row), 3), np.float32), np.zeros(len(row), np.float32)
        detail = np.zeros(len(row), np.float32)
        for kind, taps in ((np.flatnonzero(alone), 1), (np.flatnonzero(~alone), TAPS)):
            place = pixel[row[kind]] * n + sample[kind]
            found = self._shade(_cluster_points, place, owners[kind], sample[kind], taps=taps)
            radiance[kind], detail[kind], weight[kind] = found
        self.put(pixel, row, radiance, weight, detail)

    def shade_whole(self, pixel: Int[np.ndarray, " p"], first: Int[np.ndarray, " hw"]) -> None:
        """Shades one sample of some pixels for all that is covered of them."""
        n = self.covered.shape[-1]
        windows = self.covered.reshape(-1, n)[pixel]
        sample = first[pixel].astype(np.int32)
        self.image[pixel], self.detail[pixel], _ = self._shade(
            _whole_points, pixel * n + sample, windows, sample, taps=TAPS
        )
        self.count[pixel] = 1

    def shade_prefixes(
        self, pixel: Int[np.ndarray, " b"], slot: Int[np.ndarray, " b"], count: Int[np.ndarray, " b"]
    ) -> tuple[Int[np.ndarray, " b"], Float[np.ndarray, "b 3"], Float[np.ndarray, " b"]]:
        """Sample number `slot` of the first `count` samples of some pixels: which it is, its radiance and weight."""
        n = self.covered.shape[-1]
        windows = self.covered.reshape(-1, n)
        sample = _in_calls(_nth_sample, _WINDOWS_PER_CALL, windows[pixel], slot)
        place = pixel * n + sample
        points = functools.partial(_prefix_points, size=round(n**0.5))
        # A footprint of more than one cell has more taps; where all samples are taken it is one.
        whole, every = windows[pixel].all(axis=1), count >= np.count_nonzero(windows[pixel], axis=1)
        radiance, weight = np.zeros((len(place), 3), np.float32), np.zeros(len(place), np.float32)
        for kind, taps in ((np.flatnonzero(every), 1), (np.flatnonzero(~every), TAPS)):
            area = np.where(every[kind], n, count[kind]).astype(np.int32)
            found = self._shade(points, place[kind], area, count[kind], whole[kind], taps=taps)
            radiance[kind], _, weight[kind] = found
        return sample, radiance, weight

    def _shade(self, points: Callable[..., ShadingPoints], place, *arguments, taps: int) -> list[np.ndarray]:
        self.num_shaded += len(place)

        def shaded(place, *arguments):
            where = points(*arguments)
            return *_shade_points(self.samples, self.lighting, place, where, taps=taps), where.weight

        return _in_calls(shaded, _POINTS_PER_CALL, place.astype(np.int32), *arguments)

    def put(self, pixel: Int[np.ndarray, " p"], row, radiance, weight, detail=None) -> None:
        """Weighted sums over the samples of each pixel, instead of what it had. Row r is of pixel[r]; rows ascend."""
        if not len(row):
            return
        start = np.flatnonzero(np.diff(row, prepend=-1))
        own = pixel[row[start]]
        self.image[own] = np.add.reduceat(radiance * weight[:, None], start, axis=0)
        self.count[own] = np.diff(start, append=len(row))
        if detail is not None:
            self.detail[own] = np.add.reduceat(detail * weight, start)

    def slopes(self, method: Clusters) -> Float[np.ndarray, "p 2"]:
        """What `shading_slope` expects of each pixel from what was shaded so far."""
        scales = np.float32(method.contrast * method.scale), np.float32(method.detail * method.scale)
        image, detail = self._pixels(self.image), self._pixels(self.detail)
        return np.asarray(_slopes(image, self.covered.any(axis=-1), detail, *scales)).reshape(-1, 2)

    def _pixels(self, values: np.ndarray) -> np.ndarray:
        return values.reshape(*self.covered.shape[:2], *values.shape[1:])

    def result(self) -> AdaptiveImage:
        alpha = np.asarray(np.mean(self.covered, axis=-1, dtype=np.float32))
        return AdaptiveImage(
            self._pixels(self.image), alpha, self._pixels(self.count), self.num_shaded, int(self.covered.sum())
        )


# --- Clusters


def _shade_clusters(picture: _Picture, pixel: Int[np.ndarray, " p"], method: Clusters) -> None:
    """First by the attributes alone; then again where the shading, or the material, turned out to vary."""
    samples, n = picture.samples, picture.covered.shape[-1]
    one_surface, first = (np.asarray(v).reshape(-1) for v in _first_look(samples))
    # A single sub-sample stands for itself, which is another footprint.
    one_surface = one_surface & (np.count_nonzero(picture.covered.reshape(-1, n), axis=1) > 1)
    picture.shade_whole(pixel[one_surface[pixel]], first)
    several = pixel[~one_surface[pixel]]
    owner = _clusters(samples, several, np.zeros((len(several), 2), np.float32), method)
    picture.shade_clusters(several, owner)
    if method.contrast == 0.0 and method.detail == 0.0:
        return
    slope = picture.slopes(method)[pixel]
    uneven = np.asarray(is_uneven(slope, n))
    slope, uneven = slope[uneven], pixel[uneven]
    finer = _clusters(samples, uneven, slope, method)
    more = np.count_nonzero(finer == np.arange(n), axis=1) > picture.count[uneven]
    picture.shade_clusters(uneven[more], finer[more])


def _clusters(samples: SubSamples, pixel, slope, method: Clusters) -> Int[np.ndarray, "p n"]:
    scales = np.float32(method.normal * method.scale), np.float32(method.plane * method.scale)
    group = lambda pixel, slope: _cluster_windows(samples, pixel, slope, *scales)  # noqa: E731
    return _in_calls(group, _WINDOWS_PER_CALL, pixel.astype(np.int32), slope)


@jax.jit
def _cluster_windows(samples: SubSamples, pixel, slope, normal_scale, plane_scale) -> Int[Array, "p n"]:
    n = samples.depth.shape[-1]

    def group(block: tuple[Array, Array]) -> Int[Array, "b n"]:
        pixel, slope = block
        found, _ = samples.look(pixel[:, None] * n + jnp.arange(n, dtype=jnp.int32)[None])
        return cluster_samples(
            found.normal, found.position, found.depth, found.material_id, found.coverage, slope,
            normal_scale=normal_scale, plane_scale=plane_scale,
        ).astype(jnp.int8)  # fmt: skip

    return _by_block(group, _WINDOWS_PER_BLOCK, pixel, slope)


@jax.jit
def _first_look(samples: SubSamples) -> tuple[Bool[Array, "h w"], Int[Array, "h w"]]:
    return samples.one_surface, first_sample(samples.covered).astype(jnp.int8)


# --- Counts


def _shade_counts(
    picture: _Picture, pixel: Int[np.ndarray, " p"], method: SampleMetrics | Uniform, strategy: str
) -> None:
    """The printed way: first one sample of each pixel, then as many more as the metrics say."""
    n = picture.covered.shape[-1]
    size = round(n**0.5)
    num_covered = np.count_nonzero(picture.covered.reshape(-1, n)[pixel], axis=1)
    if isinstance(method, Uniform):
        if not 1 <= method.count <= n:
            raise ValueError(f"count: expected a number from 1 to {n}, got {method.count}")
        before = after = np.full(picture.covered.shape[:2], method.count, np.int32)
    else:
        metric = _geometric_metric(picture.samples, method)
        allowed = balanced_counts(size) if method.balanced else None
        before = np.asarray(sample_count(metric, size=size, allowed=allowed))
    count = np.minimum(before.reshape(-1)[pixel], num_covered)
    first, radiance, weight = picture.shade_prefixes(pixel, np.zeros_like(pixel), count)
    picture.image[pixel] = radiance
    if not isinstance(method, Uniform) and method.shading is not None:
        shaded = _shading_metric(picture, method)
        after = np.asarray(sample_count(metric, shaded, size=size, allowed=allowed))
    elif not isinstance(method, Uniform):
        after = before
    if strategy == "low_resolution":
        after = np.asarray(tile_maximum(jnp.asarray(after), tile=6))
    wanted = np.minimum(after.reshape(-1)[pixel], num_covered)
    # The first sample is shaded again where its footprint has shrunk.
    kept = wanted == count
    entry, slot = work_order(wanted - kept, strategy=strategy)
    idle = entry < 0
    entry = np.maximum(entry, 0)
    slot = np.minimum(slot + kept[entry], wanted[entry] - 1)
    more = picture.shade_prefixes(pixel[entry], slot, wanted[entry])
    picture.num_shaded -= int(idle.sum())
    row = np.concatenate([np.flatnonzero(kept), entry[~idle]])
    sample, radiance, weight = (
        np.concatenate([a[kept], b[~idle]]) for a, b in zip((first, radiance, weight), more, strict=True)
    )
    # One order of summation, whatever the order of evaluation.
    order = np.lexsort([sample, row])
    picture.put(pixel, row[order], radiance[order], weight[order])


def _geometric_metric(samples: SubSamples, method: SampleMetrics) -> Float[Array, "h w"]:
    """max(k_d, k_n) before it becomes a count."""
    height, width, n = samples.depth.shape
    band = min(max(1, SAMPLES_PER_BAND // (width * n)), height)
    far = jnp.maximum(jnp.max(jnp.where(samples.covered, samples.depth, 0.0)), 1e-30)
    scales = [None if c is None else np.float32(c * method.scale) for c in (method.depth, method.normal)]
    rows = functools.partial(_metric_rows, samples, far, *scales, num_rows=band, plane_corrected=method.plane_corrected)
    return in_bands(lambda start: rows(np.int32(start)), band_starts(height, band), height=height)


@functools.partial(jax.jit, static_argnames=("num_rows", "plane_corrected"))
def _metric_rows(samples, far, depth_scale, normal_scale, start, *, num_rows: int, plane_corrected: bool):
    _, width, n = samples.depth.shape
    cut = lambda values: jax.lax.dynamic_slice_in_dim(values, start, num_rows)  # noqa: E731
    covered, metric = cut(samples.covered), jnp.zeros((num_rows, width), samples.depth.dtype)
    if depth_scale is not None:
        by_depth = depth_sample_count(
            cut(samples.depth) / far, scale=depth_scale, covered=covered, plane_corrected=plane_corrected
        )
        metric = jnp.maximum(metric, by_depth)
    if normal_scale is not None:
        place = start * (width * n) + jnp.arange(num_rows * width * n, dtype=jnp.int32).reshape(covered.shape)
        found, _ = samples.look(place)
        metric = jnp.maximum(metric, normal_sample_count(found.normal, scale=normal_scale, covered=covered))
    return metric


def _shading_metric(picture: _Picture, method: SampleMetrics) -> Float[Array, "h w"]:
    assert method.shading is not None
    return shading_sample_count(
        _luma(picture._pixels(picture.image)), scale=method.shading * method.scale,
        edge_threshold=method.edge_threshold, min_threshold=method.min_threshold,
        covered=jnp.asarray(picture.covered.any(axis=-1)),
    )  # fmt: skip


# --- Compiled parts, and how work is handed to them


@functools.partial(jax.jit, static_argnames="taps")
def _shade_points(samples, lighting, place, points, *, taps: int):
    shaded = lambda block: shade_points(samples, lighting, *block, taps=taps)  # noqa: E731
    return _by_block(shaded, _POINTS_PER_BLOCK, place, points)


@jax.jit
def _cluster_points(owner, sample) -> ShadingPoints:
    return cluster_points(owner.astype(jnp.int32), sample)


@jax.jit
def _whole_points(covered, sample) -> ShadingPoints:
    return cluster_points(jnp.where(covered, sample[:, None], -1), sample)


@functools.partial(jax.jit, static_argnames="size")
def _prefix_points(area, count, whole, *, size: int) -> ShadingPoints:
    # Of a window that is covered in part other samples are taken than the first ones of the matrix: they stay in place.
    points = prefix_points(area, size=size)
    shift = jnp.where(whole[:, None], points.shift, 0.0)
    return dataclasses.replace(points, shift=shift, weight=1.0 / count.astype(jnp.float32))


@jax.jit
def _nth_sample(covered, slot) -> Int[Array, " p"]:
    return jnp.argmax(sample_rank(covered) == slot[:, None], axis=-1).astype(jnp.int32)


_luma = jax.jit(lambda image: luma(jnp.asarray(encode_srgb(image))))


@jax.jit
def _slopes(image, covered, detail, contrast_scale, detail_scale) -> Float[Array, "h w 2"]:
    light = _luma(image)
    steps = shading_steps(light, covered=covered)
    return shading_slope(steps, detail, light, contrast_scale=contrast_scale, detail_scale=detail_scale)


def _by_block(function: Callable[[Any], Any], block: int, *arguments: Any) -> Any:
    """function(arguments) block by block on a processor, whose caches are small; at once elsewhere."""
    if jax.default_backend() != "cpu":
        return function(arguments)
    cut = jax.tree.map(lambda values: values.reshape(-1, block, *values.shape[1:]), arguments)
    found = jax.lax.map(function, cut)
    return jax.tree.map(lambda values: values.reshape(-1, *values.shape[2:]), found)


def _in_calls(function: Callable[..., Any], size: int, *arguments: np.ndarray) -> Any:
    """function(*arguments) by calls of one size, at most `size`, on all cores; the last one is filled up."""
    total = len(arguments[0])
    # Two blocks at least: XLA compiles a loop of one turn to other code, which rounds in other places.
    size = min(size, max(2, -(-room_for(total) // _POINTS_PER_BLOCK)) * _POINTS_PER_BLOCK)

    def call(start: int) -> Any:
        own = [values[start : start + size] for values in arguments]
        missing = size - len(own[0])
        filled = [np.concatenate([values, np.zeros((missing, *values.shape[1:]), values.dtype)]) for values in own]
        return jax.tree.map(lambda values: np.asarray(values)[: size - missing], function(*filled))

    calls = list(on_all_cores(call, range(0, max(total, 1), size)))
    return jax.tree.map(lambda *values: np.concatenate(values), *calls)


def _pixels(covered: Bool[np.ndarray, "h w n"]) -> Int[np.ndarray, " p"]:
    """The pixels where anything is, in the order of `_screen_order`."""
    order = _screen_order(*covered.shape[:2])
    return order[covered.any(axis=-1).reshape(-1)[order]]


@functools.lru_cache(maxsize=4)
def _screen_order(height: int, width: int) -> Int[np.ndarray, " p"]:
    """All pixels, tile by tile of 16 x 16, in blocks of 8 x 4: neighbours in a list look alike."""
    y, x = np.mgrid[:height, :width]
    keys = (x % 8, y % 4, x // 8 % 2, y // 4 % 4, x // 16, y // 16)
    order = np.lexsort([key.reshape(-1) for key in keys]).astype(np.int32)
    order.setflags(write=False)
    return order
