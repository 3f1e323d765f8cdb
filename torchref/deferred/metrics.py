"""Windows of a G-buffer and a first shading -> how many samples each pixel needs: window by window, pixel by pixel.

Empty sub-samples and pixels are left out. A window that keeps fewer than two, or one that is not finite, has count 0.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref._precision import in_float64

# Prefixes of the printed matrices whose middle is close to the pixel's; measured.
_BALANCED = {1: (1,), 2: (1, 2, 4), 3: (1, 5, 9), 4: (1, 2, 6, 8, 10, 14, 16)}


@in_float64
def depth_sample_count(
    depth: Float[Tensor, "*b n"],
    *,
    scale: float | Float[Tensor, ""],
    covered: Bool[Tensor, "*b n"] | None = None,
    plane_corrected: bool = False,
) -> Float[Tensor, "*b"]:
    """c times the mean squared residual of the best constant, or of the best plane over the cells of the window."""

    def count(own: Tensor, there: Tensor) -> Tensor:
        basis = torch.ones(len(own), 1, dtype=own.dtype)
        if plane_corrected:
            size = math.isqrt(len(there))
            cells = torch.cartesian_prod(torch.arange(size), torch.arange(size)).reshape(-1, 2)
            basis = torch.cat([basis, cells[there].to(own.dtype)], dim=1)
        # A pseudo-inverse, since all cells may lie on one line.
        left = own[:, 0] - basis @ (torch.linalg.pinv(basis) @ own[:, 0])
        return scale * (left**2).mean()

    return _by_window(count, depth[..., None], covered)


@in_float64
def normal_sample_count(
    normal: Float[Tensor, "*b n 3"], *, scale: float | Float[Tensor, ""], covered: Bool[Tensor, "*b n"] | None = None
) -> Float[Tensor, "*b"]:
    """c √(1 - cos t) = c √2 sin(t/2), t the largest angle between the line of a normal and the mean normal."""
    return scale * math.sqrt(2.0) * torch.sin(_by_window(_cone, normal, covered) / 2)


@in_float64
def normal_cone(
    normal: Float[Tensor, "*b n 3"], *, covered: Bool[Tensor, "*b n"] | None = None
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b"]]:
    """The direction of the sum of the normals, and 1 - cos t."""
    there = torch.ones(normal.shape[:-1], dtype=torch.bool) if covered is None else covered
    total = torch.where(there[..., None], normal, 0.0).sum(-2)
    length = torch.linalg.norm(total, dim=-1, keepdim=True)
    # Of normals that cancel out nothing is left to point anywhere: the sum stays as it is.
    long_enough = length >= 1e-6 * there.sum(-1, keepdim=True).clamp(min=1)
    axis = torch.where(long_enough, total / torch.where(long_enough, length, 1.0), total)
    return axis, 2.0 * torch.sin(_by_window(_cone, normal, covered) / 2) ** 2


def _cone(own: Float[Tensor, "k 3"], there: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
    """t, a right angle where normals cancel out."""
    mean = own.mean(0)
    if torch.linalg.norm(mean) < 1e-6:
        return torch.full((), math.pi / 2, dtype=own.dtype)
    across = torch.linalg.norm(torch.linalg.cross(own, mean.expand_as(own)), dim=-1)
    return torch.atan2(across, torch.abs(own @ mean)).amax()


def _by_window(
    count: Callable[[Tensor, Tensor], Tensor], values: Float[Tensor, "*b n c"], covered: Bool[Tensor, "*b n"] | None
) -> Float[Tensor, "*b"]:
    """count(values of the covered sub-samples, which these are) of each window."""
    if covered is None:
        covered = torch.ones(values.shape[:-1], dtype=torch.bool)
    found = []
    n, size = values.shape[-2:]
    for own, there in zip(values.reshape(-1, n, size), covered.reshape(-1, n), strict=True):
        own = own[there]
        enough = len(own) > 1 and bool(torch.isfinite(own).all())
        found.append(count(own, there) if enough else own.new_zeros(()))
    return torch.stack(found).reshape(covered.shape[:-1])


@in_float64
def shading_sample_count(
    luminance: Float[Tensor, "h w"],
    *,
    scale: float | Float[Tensor, ""],
    edge_threshold: float = 1 / 8,
    min_threshold: float = 1 / 16,
    covered: Bool[Tensor, "h w"] | None = None,
) -> Float[Tensor, "h w"]:
    """c times the range over a pixel and the four beside it, if that is no less than either threshold."""

    def count(here: Tensor, beside: dict[tuple[int, int], Tensor]) -> Tensor:
        values = torch.stack([here, *beside.values()])
        contrast = values.amax() - values.amin()
        enough = contrast >= min_threshold and contrast >= edge_threshold * values.amax()
        return scale * contrast if enough else torch.zeros_like(here)

    return _by_pixel(count, luminance, covered)


@in_float64
def shading_steps(
    luminance: Float[Tensor, "h w"], *, covered: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, "h w 2"]:
    """The largest difference to the left and right, and to above and below."""

    def steps(here: Tensor, beside: dict[tuple[int, int], Tensor]) -> Tensor:
        none = torch.zeros_like(here)
        x = [torch.abs(value - here) for (_, dx), value in beside.items() if dx]
        y = [torch.abs(value - here) for (dy, _), value in beside.items() if dy]
        return torch.stack([torch.stack([none, *x]).amax(), torch.stack([none, *y]).amax()])

    return _by_pixel(steps, luminance, covered)


def _by_pixel(
    function: Callable[[Tensor, dict[tuple[int, int], Tensor]], Tensor],
    values: Float[Tensor, "h w"],
    covered: Bool[Tensor, "h w"] | None,
) -> Float[Tensor, "h w ..."]:
    """function(value, those of the four values beside it that are there, by (dy, dx)); 0 where a pixel is not there."""
    height, width = values.shape
    there = torch.isfinite(values)
    if covered is not None:
        there = there & covered
    nowhere = torch.zeros_like(function(values.new_zeros(()), {}))
    found = []
    for y in range(height):
        for x in range(width):
            beside = {
                (dy, dx): values[y + dy, x + dx]
                for dy, dx in ((0, -1), (0, 1), (-1, 0), (1, 0))
                if 0 <= y + dy < height and 0 <= x + dx < width and there[y + dy, x + dx]
            }
            found.append(function(values[y, x], beside) if there[y, x] else nowhere)
    return torch.stack(found).reshape(height, width, *nowhere.shape)


def sample_count(*metrics: Float[Tensor, "*b"], size: int, allowed: tuple[int, ...] | None = None) -> Int[Tensor, "*b"]:
    """The least allowed whole number from 1 to m² that no metric exceeds; m² if all are too small."""
    counts = []
    for wanted in zip(*(metric.flatten().tolist() for metric in metrics), strict=True):
        fitting = [k for k in allowed or range(1, size * size + 1) if k >= max(wanted)]
        counts.append(fitting[0] if fitting else size * size)
    return torch.tensor(counts, dtype=torch.int32).reshape(metrics[0].shape)


def balanced_counts(size: int) -> tuple[int, ...]:
    """Those measured for m up to 4; else the powers of two, and m²."""
    if size in _BALANCED:
        return _BALANCED[size]
    powers = [k for k in range(1, size * size) if k.bit_count() == 1]
    return (*powers, size * size)


def tile_maximum(count: Int[Tensor, "h w"], *, tile: int) -> Int[Tensor, "h w"]:
    """The largest count among the pixels with the same (row // tile, column // tile)."""
    result = torch.empty_like(count)
    for top in range(0, count.shape[0], tile):
        for left in range(0, count.shape[1], tile):
            block = slice(top, top + tile), slice(left, left + tile)
            result[block] = count[block].amax()
    return result


@in_float64
def average_over_frames(
    metric: Float[Tensor, "h w"], previous: Float[Tensor, "h w"], *, share: float = 0.8
) -> Float[Tensor, "h w"]:
    """What rises is taken at once; what falls loses 1 - share of the way in a frame."""
    return torch.where(metric >= previous, metric, metric + share * (previous - metric))
