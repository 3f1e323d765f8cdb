"""Adaptive supersampling, the stages in order: sub-samples -> first shading -> counts or clusters -> more -> pixels.

Not for use inside `jit`: lists are as long as there are samples to shade. All that works on arrays is.

References:
  Holländer, Boubekeur, Eisemann, "Adaptive Supersampling for Deferred Anti-Aliasing", JCGT 2(1), 2013.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxrender.camera import Camera
from jaxrender.checks import check_at_least, check_one_of
from jaxrender.deferred.by_clusters import shade_by_clusters
from jaxrender.deferred.by_counts import shade_by_counts
from jaxrender.deferred.by_quads import QuadBudget, shade_by_quads
from jaxrender.deferred.canvas import AdaptiveImage, Canvas
from jaxrender.deferred.clusters import Clusters
from jaxrender.deferred.gbuffer import GBuffer
from jaxrender.deferred.material_textures import MaterialTextures, material_slots
from jaxrender.deferred.metrics import SampleMetrics
from jaxrender.deferred.pipeline import scene_lights, scene_material_textures, scene_table, see
from jaxrender.deferred.point_lists import covered_pixels
from jaxrender.deferred.point_shading import Lighting
from jaxrender.deferred.samples import ordered_grid
from jaxrender.deferred.strategies import STRATEGIES
from jaxrender.deferred.subsamples import GBufferSamples, SubSamples, group_samples, scene_samples
from jaxrender.deferred.texture import Textures
from jaxrender.scene import Lights, Material, Scene


@dataclass(frozen=True)
class Uniform:
    """The same count in every pixel: the baseline of all metrics."""

    count: int


Method = Clusters | SampleMetrics | Uniform | QuadBudget

#: Sub-samples of a window are numbered in bytes.
_LARGEST_SIZE = 11

CLUSTERS = Clusters()


def render_supersampled(
    scene: Scene, camera: Camera, *, height: int, width: int, size: int = 4, **options: Any
) -> AdaptiveImage:
    """Full ordered-grid supersampling: every sub-sample is shaded, with the footprint of its own cell.

    The reference of `render_adaptive`; the same arguments, but for those of the choice.
    """
    samples, lighting = scene_view(scene, camera, height=height, width=width, size=size, **options)
    return supersample(samples, lighting)


def render_adaptive(
    scene: Scene, camera: Camera, *, height: int, width: int, size: int = 4, method: Method = CLUSTERS,
    strategy: str = "compacted", previous: AdaptiveImage | None = None, **options: Any,
) -> AdaptiveImage:  # fmt: skip
    """Renders a scene at m x m samples a pixel, of which only some are shaded.

    Args:
      size: m, up to 11.
      method: which ones. `Clusters` (the default), the printed `SampleMetrics`, `Uniform`, or a `QuadBudget`.
      strategy, previous: of `shade_adaptive`.
      options: textures, lights, ambient, max_anisotropy, transparency and model, as in `render_scene`.
    """
    samples, lighting = scene_view(scene, camera, height=height, width=width, size=size, **options)
    return shade_adaptive(samples, lighting, method=method, strategy=strategy, previous=previous)


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
    _check_room(height, width, size)
    grid = ordered_grid(size)
    textures = scene_material_textures(scene) if textures is None else textures
    fragments = see(
        scene, camera, height=height, width=width, samples=grid, textures=textures, transparency=transparency
    )
    table = scene_table(scene, fragments.triangles, None, grid=size)
    lights, ambient = scene_lights(scene, lights, ambient)
    lighting = Lighting(
        lights=lights, ambient=ambient, eye=camera.eye, textures=textures, slots=material_slots(scene.material),
        max_anisotropy=max_anisotropy, model=model,
    )  # fmt: skip
    return scene_samples(scene.material, table, fragments), lighting


def gbuffer_view(gbuffer: GBuffer, material: Material, *, size: int) -> GBufferSamples:
    """The sub-samples of a G-buffer: one with m x m samples a pixel, or one of m times the picture's size."""
    _check_size(size)
    if gbuffer.depth.shape[-1] != size * size:
        gbuffer = group_samples(gbuffer, size=size)
    height, width, _ = gbuffer.depth.shape
    _check_room(height, width, size)
    return GBufferSamples(material=material, gbuffer=gbuffer)


def _check_size(size: int) -> None:
    if not isinstance(size, int) or not 1 <= size <= _LARGEST_SIZE:
        raise ValueError(f"size: expected a whole number from 1 to {_LARGEST_SIZE}, got {size}")


def _check_room(height: int, width: int, size: int) -> None:
    """Places of sub-samples are counted through in int32."""
    if height * width * size * size >= 2**31:
        raise ValueError(
            f"size: expected fewer than 2^31 sub-samples, got {height} x {width} pixels of {size} x {size}"
        )


def _check_settings(method: Method) -> None:
    """All numbers of a method are finite, and none is negative."""
    for field in dataclasses.fields(method):
        value = getattr(method, field.name)
        if value is not None and not 0.0 <= value < math.inf:
            raise ValueError(f"{type(method).__name__}.{field.name}: expected a number >= 0, got {value}")


def supersample(samples: SubSamples, lighting: Lighting) -> AdaptiveImage:
    """Shades every covered sub-sample."""
    canvas = Canvas(samples, lighting)
    pixel, n = covered_pixels(canvas.covered), canvas.covered.shape[-1]
    canvas.shade_clusters(pixel, np.where(canvas.windows[pixel], np.arange(n, dtype=np.int8), np.int8(-1)))
    return canvas.result()


def shade_adaptive(
    samples: SubSamples, lighting: Lighting, *, method: Method = CLUSTERS, strategy: str = "compacted",
    previous: AdaptiveImage | None = None,
) -> AdaptiveImage:  # fmt: skip
    """Shades some of the sub-samples of each pixel.

    Args:
      samples, lighting: of `scene_view`, or of `gbuffer_view` and made by hand.
      strategy: how the samples of a count are put together for evaluation (`work_order`); the image is the same, but
        for "low_resolution". Other methods than counts are always compacted.
      previous: the picture of the frame before in a film, by the same method and of the same size; `QuadBudget` does
        not look at it. What it went by fades slowly (`average_over_frames`): counts jump less, and fewer samples have
        to be shaded again.
    """
    check_one_of("strategy", strategy, STRATEGIES)
    _check_settings(method)
    counted = isinstance(method, SampleMetrics | Uniform)
    if strategy != "compacted" and not counted:
        raise ValueError(f'strategy: expected "compacted" for {type(method).__name__}, got {strategy}')
    canvas = Canvas(samples, lighting)
    evidence = None if previous is None else previous.evidence
    if evidence is not None and evidence.shape != (*canvas.covered.shape[:2], 1 if counted else 2):
        raise ValueError(
            f"previous: expected a picture of {canvas.covered.shape[:2]} pixels by the same method, "
            f"got one with evidence {evidence.shape}"
        )
    if isinstance(method, Clusters):
        shade_by_clusters(canvas, method, previous=evidence)
    elif isinstance(method, QuadBudget):
        shade_by_quads(canvas, method)
    else:
        shade_by_counts(canvas, _as_metrics(method, canvas), strategy=strategy, previous=evidence)
    return canvas.result()


def _as_metrics(method: SampleMetrics | Uniform, canvas: Canvas) -> SampleMetrics:
    """A uniform count is what is left when all metrics are off."""
    if isinstance(method, SampleMetrics):
        return method
    n = canvas.covered.shape[-1]
    if not 1 <= method.count <= n:
        raise ValueError(f"count: expected a number from 1 to {n}, got {method.count}")
    return SampleMetrics(depth=None, normal=None, shading=None, least=method.count)
