"""Lists of samples -> pixels: shades what is listed, and sums it up."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.deferred.point_lists import POINTS_PER_BLOCK, POINTS_PER_CALL, WINDOWS_PER_CALL, by_block, in_calls
from jaxrender.deferred.point_shading import TAPS, Lighting, shade_points
from jaxrender.deferred.sampling import ShadingPoints, cluster_points, prefix_points, sample_rank, window_size
from jaxrender.deferred.subsamples import SubSamples

#: Sub-samples whose windows are listed at a time: each of them may be a row of a list as wide as the window.
SUBSAMPLES_AT_ONCE = 1 << 22


@dataclass(frozen=True)
class AdaptiveImage:
    """A picture and what it took.

    Attributes:
      image: linear RGB, the mean over covered sub-samples; alpha: share of covered ones.
      count: samples of each pixel that the picture is made of; 0 where it is empty.
      num_shaded: samples that were shaded, also those that were shaded again with another footprint.
      num_covered: sub-samples that full supersampling shades.
      evidence: what the choice went by, for the next frame of a film (`shade_adaptive`); None if by nothing.
    """

    image: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    count: Int[np.ndarray, "h w"]
    num_shaded: int
    num_covered: int
    evidence: Float[np.ndarray, "h w k"] | None = None

    @property
    def sample_share(self) -> float:
        """What part of the covered sub-samples was shaded; above 1 if more were shaded again than left out."""
        return self.num_shaded / max(self.num_covered, 1)


class Canvas:
    """Pixels on their way: sums of radiance and counts, filled list by list. Pixels are counted through.

    Attributes:
      image, count: as in `AdaptiveImage`, but flat.
      detail: of `material_detail`; roughness: of what was shaded first.
      evidence: as in `AdaptiveImage`.
    """

    def __init__(self, samples: SubSamples, lighting: Lighting):
        self.samples, self.lighting, self.covered = samples, lighting, np.asarray(samples.covered)
        height, width, _ = self.covered.shape
        self.image = np.zeros((height * width, 3), np.float32)
        self.detail, self.roughness = np.zeros((2, height * width), np.float32)
        self.count = np.zeros(height * width, np.int32)
        self.num_shaded = 0
        self.evidence: Float[np.ndarray, "h w k"] | None = None

    @property
    def windows(self) -> Bool[np.ndarray, "p n"]:
        """Which sub-samples of each pixel are covered."""
        return self.covered.reshape(-1, self.covered.shape[-1])

    def shade_clusters(self, pixel: Int[np.ndarray, " p"], owner: Int[np.ndarray, "p n"]) -> None:
        """Shades one sample of each cluster of some pixels, instead of what they had."""
        most = max(1, SUBSAMPLES_AT_ONCE // owner.shape[1])
        for start in range(0, len(pixel), most):
            self._shade_clusters(pixel[start : start + most], owner[start : start + most])

    def _shade_clusters(self, pixel: Int[np.ndarray, " p"], owner: Int[np.ndarray, "p n"]) -> None:
        row, sample = leads(owner)
        owners = owner[row]
        alone = np.count_nonzero(owners == sample[:, None].astype(owner.dtype), axis=1) == 1
        place = pixel[row] * owner.shape[1] + sample
        radiance, detail, _, weight = self.shade(_cluster_points, place, alone, owners, sample)
        self.put(pixel, row, radiance, weight, detail)

    def shade_whole(self, pixel: Int[np.ndarray, " p"], sample: Int[np.ndarray, " p"]) -> None:
        """Shades one sample of some pixels for all that is covered of them."""
        place = pixel * self.covered.shape[-1] + sample
        owner = np.where(self.windows[pixel], sample[:, None], -1).astype(np.int8)
        radiance, detail, _, _ = self.shade(_cluster_points, place, np.zeros(len(pixel), bool), owner, sample)
        self.image[pixel], self.detail[pixel], self.count[pixel] = radiance, detail, 1

    def shade_prefixes(
        self, pixel: Int[np.ndarray, " b"], slot: Int[np.ndarray, " b"], count: Int[np.ndarray, " b"]
    ) -> tuple[Int[np.ndarray, " b"], Float[np.ndarray, "b 3"], Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
        """Sample number `slot` of the first `count` ones of pixels: which it is, radiance, roughness and weight."""
        n, windows = self.covered.shape[-1], self.windows[pixel]
        sample = in_calls(_nth_sample, WINDOWS_PER_CALL, windows, slot)
        # A footprint of more than one cell has more taps; where all samples are taken it is one.
        every = count >= np.count_nonzero(windows, axis=1)
        area = np.where(every, n, count).astype(np.int32)
        place, whole = pixel * n + sample, windows.all(axis=1)
        radiance, _, roughness, weight = self.shade(_prefix_points, place, every, area, count, whole)
        return sample, radiance, roughness, weight

    def shade(
        self, points: Callable[..., ShadingPoints], place: Int[np.ndarray, " b"], alone: Bool[np.ndarray, " b"],
        *arguments: np.ndarray,
    ) -> list[np.ndarray]:  # fmt: skip
        """Radiance, detail, roughness and weight of points(n, *arguments); those `alone` need one lookup of textures.

        Args:
          points: gives the points of a block; n is the number of sub-samples of a window.
        """
        self.num_shaded += len(place)
        found = [np.zeros((len(place), 3), np.float32), *np.zeros((3, len(place)), np.float32)]
        for taps, kind in ((1, np.flatnonzero(alone)), (TAPS, np.flatnonzero(~alone))):
            if not len(kind):
                continue
            own = (values[kind] for values in (place.astype(np.int32), *arguments))
            fixed = self.samples, self.lighting
            parts = in_calls(_shade_points, POINTS_PER_CALL, *own, fixed=fixed, points=points, taps=taps)
            for whole, part in zip(found, parts, strict=True):
                whole[kind] = part
        return found

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

    def as_map(self, values: np.ndarray) -> np.ndarray:
        """Values of all pixels, by row and column."""
        return values.reshape(*self.covered.shape[:2], *values.shape[1:])

    def result(self) -> AdaptiveImage:
        """What is drawn."""
        alpha = np.asarray(np.mean(self.covered, axis=-1, dtype=np.float32))
        return AdaptiveImage(
            self.as_map(self.image), alpha, self.as_map(self.count), self.num_shaded, int(self.covered.sum()),
            self.evidence,
        )  # fmt: skip


def leads(owner: Int[np.ndarray, "p n"]) -> tuple[Int[np.ndarray, " b"], Int[np.ndarray, " b"]]:
    """Row and number of the sub-samples that stand for themselves, and for others too."""
    row, sample = np.nonzero(owner == np.arange(owner.shape[1], dtype=owner.dtype))
    return row.astype(np.int32), sample.astype(np.int32)


@functools.partial(jax.jit, static_argnames=("points", "taps"))
def _shade_points(
    samples, lighting, place, *arguments, points: Callable[..., ShadingPoints], taps: int
) -> tuple[Array, Array, Array, Array]:
    def shaded(block: tuple[Array, ...]) -> tuple[Array, Array, Array, Array]:
        where = points(samples.depth.shape[-1], *block[1:])
        return *shade_points(samples, lighting, block[0], where, taps=taps), where.weight

    return by_block(shaded, POINTS_PER_BLOCK, place, *arguments)


def _cluster_points(_n: int, owner, sample) -> ShadingPoints:
    return cluster_points(owner.astype(jnp.int32), sample)


def _prefix_points(n: int, area, count, whole) -> ShadingPoints:
    # Of a window that is covered in part other samples are taken than the first ones of the matrix: they stay in place.
    points = prefix_points(area, size=window_size(n))
    shift = jnp.where(whole[:, None], points.shift, 0.0)
    return dataclasses.replace(points, shift=shift, weight=1.0 / count.astype(jnp.float32))


@jax.jit
def _nth_sample(covered, slot) -> Int[Array, " p"]:
    return jnp.argmax(sample_rank(covered) == slot[:, None], axis=-1).astype(jnp.int32)
