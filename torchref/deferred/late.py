"""Late depth tests: fragments whose shader had a say are put into a picture one after another."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref.deferred.raster import Fragments


@dataclass(frozen=True)
class FragmentList:
    """n samples of triangles; `place` counts through an image (h, w, s). Unused entries have triangle -1.

    `screen_id` means nothing here: pieces of a cut triangle never share a sample, and go by their triangle.
    """

    place: Int[Tensor, " n"]
    triangle_id: Int[Tensor, " n"]
    screen_id: Int[Tensor, " n"]
    barycentrics: Float[Tensor, "n 2"]
    depth: Float[Tensor, " n"]
    w: Float[Tensor, " n"]


def resolve(fragments: Fragments, late: FragmentList) -> Fragments:
    """Each entry takes its sample if it is nearer than what is there, or as near and of an earlier triangle."""
    shape = fragments.triangle_id.shape
    names = ("triangle_id", "barycentrics", "depth", "w")
    seen = {name: getattr(fragments, name).flatten(0, 2).clone() for name in names}
    for entry, (place, triangle) in enumerate(zip(late.place.tolist(), late.triangle_id.tolist(), strict=True)):
        if triangle < 0:
            continue
        depth, there = float(seen["depth"][place]), int(seen["triangle_id"][place])
        earlier = there < 0 or triangle < there
        if late.depth[entry] < depth or (late.depth[entry] == depth and earlier):
            for name in names:
                seen[name][place] = getattr(late, name)[entry]
    return replace(fragments, **{name: values.unflatten(0, shape) for name, values in seen.items()})


def alpha_to_coverage(
    alpha: Float[Tensor, " n"], place: Int[Tensor, " n"], *, num_samples: int, width: int
) -> Bool[Tensor, " n"]:
    """Of each pixel's n samples the first ⌈alpha n - t⌉ in a fixed order, t the pixel's threshold in a 4 x 4 dither.

    The order jumps from sample to sample by a step near the golden section of n.
    """
    coprime = [k for k in range(1, num_samples + 1) if math.gcd(k, num_samples) == 1]
    step = min(coprime, key=lambda k: abs(k - 0.618 * num_samples))
    kept = []
    for a, at in zip(alpha.tolist(), place.tolist(), strict=True):
        pixel, sample = divmod(at, num_samples)
        row, column = divmod(pixel, width)
        count = math.ceil(a * num_samples - _threshold(row % 4, column % 4))
        kept.append(sample * step % num_samples < count)
    return torch.tensor(kept, dtype=torch.bool, device=alpha.device)


def _threshold(row: int, column: int) -> float:
    """Bayer's matrix of 4 x 4, from that of 2 x 2 for the place in its block, and then for the block: in (0, 1)."""
    square = [[0, 2], [3, 1]]
    rank = 4 * square[row % 2][column % 2] + square[row // 2][column // 2]
    return (rank + 0.5) / 16.0
