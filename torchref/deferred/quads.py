"""2x2 quads: derivatives by differences, helper lanes, and what shading whole quads costs.

Quads start at even pixels; lanes are 0 upper left, 1 upper right, 2 lower left, 3 lower right. In an ordered grid of
m x m samples they are those of the image m times as large. Everything is a loop over pixels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.deferred.interpolate import blend, weights_at
from torchref.deferred.raster import Fragments, sample_places


@in_float64
def ddx(values: Float[Tensor, "h w *c"], *, fine: bool = True) -> Float[Tensor, "h w *c"]:
    """Right - left pixel of the quad, of the own row or (coarse) the upper one; 0 without a right pixel."""
    h, w = values.shape[:2]
    result = [[torch.zeros_like(values[0, 0]) for _ in range(w)] for _ in range(h)]
    for i in range(h):
        for j in range(w):
            left, row = j - j % 2, i if fine else i - i % 2
            if left + 1 < w:
                result[i][j] = values[row, left + 1] - values[row, left]
    return _image(result, values)


@in_float64
def ddy(values: Float[Tensor, "h w *c"], *, fine: bool = True) -> Float[Tensor, "h w *c"]:
    """Lower - upper pixel of the quad, of the own column or (coarse) the left one; 0 without a lower pixel."""
    h, w = values.shape[:2]
    result = [[torch.zeros_like(values[0, 0]) for _ in range(w)] for _ in range(h)]
    for i in range(h):
        for j in range(w):
            top, column = i - i % 2, j if fine else j - j % 2
            if top + 1 < h:
                result[i][j] = values[top + 1, column] - values[top, column]
    return _image(result, values)


def _image(rows: list, like: Tensor) -> Tensor:
    return torch.stack([torch.stack(row) for row in rows]) if like.numel() else torch.zeros_like(like)


@in_float64
def quad_derivatives(
    fragments: Fragments, attributes: Float[Tensor, "v c"], *, mode: str = "perspective", fine: bool = True
) -> tuple[Float[Tensor, "h w s c"], Float[Tensor, "h w s c"]]:
    """Differences over the quad of what each sample's own triangle has there, extrapolated; 0 where empty."""
    h, w, s = fragments.triangle_id.shape
    m, per_cell = fragments.samples.grid, len(fragments.samples.offsets)
    places = sample_places(h, w, fragments.samples)
    dx, dy = (attributes.new_zeros(h, w, s, attributes.shape[1]) for _ in range(2))

    def at(sample: int, right: Tensor, down: Tensor) -> Tensor:
        """The attribute of each pixel's own sample, so many cells to the right and down of it."""
        x, y = places[..., 0] + 256 * right[..., None], places[..., 1] + 256 * down[..., None]
        return blend(fragments, attributes, weights_at(fragments, x, y, mode=mode))[:, :, sample]

    for k in range(s):
        row = torch.arange(h)[:, None] * m + k // per_cell // m + torch.zeros(1, w, dtype=torch.int64)
        column = torch.arange(w)[None] * m + k // per_cell % m + torch.zeros(h, 1, dtype=torch.int64)
        to_top, to_left = -(row % 2), -(column % 2)
        base_row, base_column = (0 * row, 0 * column) if fine else (to_top, to_left)
        dx[:, :, k] = m * (at(k, to_left + 1, base_row) - at(k, to_left, base_row))
        dy[:, :, k] = m * (at(k, base_column, to_top + 1) - at(k, base_column, to_top))
    return dx, dy


@dataclass(frozen=True)
class QuadStatistics:
    """Covered pixels and touched quads of each triangle."""

    pixels: Int[Tensor, " t"]
    quads: Int[Tensor, " t"]


def num_pixels(mask: Int[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """Bits that are set."""
    return torch.tensor([bin(m).count("1") for m in mask.flatten().tolist()], dtype=torch.int64).reshape(mask.shape)


def quad_statistics(triangle_id: Int[Tensor, " q"], mask: Int[Tensor, " q"], *, num_triangles: int) -> QuadStatistics:
    """Pixels and quads, triangle by triangle."""
    own = [mask[triangle_id == t] for t in range(num_triangles)]
    return QuadStatistics(
        pixels=torch.tensor([int(num_pixels(masks).sum()) for masks in own]),
        quads=torch.tensor([int((masks > 0).sum()) for masks in own]),
    )


@in_float64
def helper_share(pixels: Int[Tensor, "*b"], quads: Int[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Helper lanes of all shaded lanes, (4·quads - pixels) / (4·quads)."""
    lanes = 4.0 * quads.double()
    return torch.where(quads > 0, (lanes - pixels) / lanes.clamp(min=1.0), 0.0)


@in_float64
def helper_share_by_size(
    pixels: Int[Tensor, " t"], quads: Int[Tensor, " t"], *, num_sizes: int = 12
) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
    """The share of all triangles with ⌊log₂ pixels⌋ = k (the last k: or more), and their number."""
    shares, counts = [], []
    for k in range(num_sizes):
        like = (pixels >= 2**k) & ((pixels < 2 ** (k + 1)) | (k == num_sizes - 1))
        shares.append(helper_share(pixels[like].sum(), quads[like].sum()))
        counts.append(int(like.sum()))
    return torch.stack(shares), torch.tensor(counts)


def quad_overdraw(
    row: Int[Tensor, " q"], column: Int[Tensor, " q"], *, rows: int, columns: int
) -> Int[Tensor, "rows columns"]:
    """Quads shaded at each place."""
    places = list(zip(row.tolist(), column.tolist(), strict=True))
    return torch.tensor([[places.count((i, j)) for j in range(columns)] for i in range(rows)])
