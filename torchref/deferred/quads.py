"""2x2 quads: derivatives by differences, helper lanes, and what shading whole quads costs.

Quads start at even pixels; lanes are 0 upper left, 1 upper right, 2 lower left, 3 lower right. In an ordered grid of
m x m samples they are those of the image m times as large. Everything is a loop over pixels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchref._precision import in_float64
from torchref.deferred.raster import Fragments
from torchref.deferred.triangles import ScreenTriangles


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
    m, offsets = fragments.samples.grid, fragments.samples.offsets
    dx, dy = (attributes.new_zeros(h, w, s, attributes.shape[1]) for _ in range(2))
    for i, j, k in torch.argwhere(fragments.triangle_id >= 0).tolist():
        cell, offset = divmod(k, len(offsets))
        row, column = i * m + cell // m, j * m + cell % m
        top, left = row - row % 2, column - column % 2
        base_row, base_column = (row, column) if fine else (top, left)

        def at(r: int, c: int, i=i, j=j, k=k, offset=offset) -> Tensor:
            x, y = (16 * n + 8 + o for n, o in zip((c, r), offsets[offset], strict=True))
            return _value_at(fragments, attributes, (i, j, k), (16 * x, 16 * y), mode)

        dx[i, j, k] = m * (at(base_row, left + 1) - at(base_row, left))
        dy[i, j, k] = m * (at(top + 1, base_column) - at(top, base_column))
    return dx, dy


def _value_at(fragments: Fragments, attributes: Tensor, sample: tuple, place: tuple, mode: str) -> Tensor:
    """An attribute of a sample's triangle at a place (x, y) in 1/256 px from the upper left corner of the image."""
    h, w, _ = fragments.triangle_id.shape
    m, triangles = fragments.samples.grid, fragments.triangles
    source, own = int(fragments.triangle_id[sample]), int(fragments.screen_id[sample])
    corners = attributes[fragments.faces[source].long()]
    if mode in ("flat_first", "flat_last"):
        return corners[0 if mode == "flat_first" else 2]
    xy = triangles.xy[own].double() + torch.tensor([w * m * 128, h * m * 128])
    # Screen weights from the three equations: they sum to 1 and blend the corners into the place.
    equations = torch.cat([xy.T, torch.ones(1, 3, dtype=torch.float64)])
    screen = torch.linalg.solve(equations, torch.tensor([*place, 1.0], dtype=torch.float64))
    over_w = screen / triangles.w[own]
    weights = (over_w / over_w.sum()) @ triangles.weights[own]
    if mode == "noperspective":
        # l_k is proportional to b_k w_k; the first rows are the triangles of the mesh, uncut.
        weights = weights * (triangles.weights[source].T @ triangles.w[source])
        weights = weights / weights.sum()
    return weights @ corners


@dataclass(frozen=True)
class Quads:
    """Quads of single triangles in the order of the API; `mask` holds the covered lanes as bits."""

    triangle_id: Int[Tensor, " q"]
    screen_id: Int[Tensor, " q"]
    row: Int[Tensor, " q"]
    column: Int[Tensor, " q"]
    mask: Int[Tensor, " q"]
    rows: int
    columns: int


def quad_coverage(fragments: Fragments) -> Quads:
    """Every quad of which a triangle covers a pixel, in front or not: each pixel is tested against each triangle.

    The quads of one triangle come row by row.
    """
    h, w, _ = fragments.triangle_id.shape
    m, offsets, triangles = fragments.samples.grid, fragments.samples.offsets, fragments.triangles
    h, w = h * m, w * m
    found = []
    for screen_id in triangles.order.tolist():
        if not triangles.valid[screen_id]:
            continue
        masks: dict[tuple[int, int], int] = {}
        for i in range(h):
            for j in range(w):
                places = [(256 * j + 128 + 16 * x - 128 * w, 256 * i + 128 + 16 * y - 128 * h) for x, y in offsets]
                if any(_covers(triangles, screen_id, *place) for place in places):
                    at = (i // 2, j // 2)
                    masks[at] = masks.get(at, 0) | 1 << (i % 2 * 2 + j % 2)
        source = int(triangles.source[screen_id])
        found += [(source, screen_id, *at, mask) for at, mask in sorted(masks.items())]
    columns = torch.tensor(found, dtype=torch.int32).reshape(-1, 5).T
    return Quads(*columns, rows=(h + 1) // 2, columns=(w + 1) // 2)


def _covers(triangles: ScreenTriangles, screen_id: int, x: int, y: int) -> bool:
    """Whether a place lies in a triangle, by the top-left rule in exact integers, between the near and far plane."""
    corners, inside, areas = triangles.xy[screen_id].tolist(), True, []
    for k in range(3):
        (px, py), (qx, qy) = corners[k], corners[(k + 1) % 3]
        e = (qx - px) * (y - py) - (qy - py) * (x - px)
        top_or_left = (py == qy and qx > px) or qy < py
        inside = inside and (e > 0 or (e == 0 and top_or_left))
        areas.append(e)
    # The edge from corner k to k+1 faces corner k+2.
    weights = [areas[(k + 1) % 3] / sum(areas) for k in range(3)]
    z = sum(l * float(triangles.z[screen_id, k]) for k, l in enumerate(weights))
    return inside and 0.0 <= z <= 1.0


def visible_masks(fragments: Fragments, quads: Quads) -> Int[Tensor, " q"]:
    """The masks without the lanes in which the triangle is nowhere visible."""
    m, per_cell = fragments.samples.grid, len(fragments.samples.offsets)
    h, w, _ = fragments.triangle_id.shape
    masks = []
    for screen_id, row, column, mask in zip(quads.screen_id, quads.row, quads.column, quads.mask, strict=True):
        left = 0
        for lane in range(4):
            i, j = 2 * int(row) + lane // 2, 2 * int(column) + lane % 2
            if i < h * m and j < w * m and int(mask) >> lane & 1:
                first = (i % m * m + j % m) * per_cell
                seen = fragments.screen_id[i // m, j // m, first : first + per_cell] == screen_id
                left |= int(seen.any()) << lane
        masks.append(left)
    return torch.tensor(masks, dtype=torch.int32)


def visible_quads(fragments: Fragments, quads: Quads) -> Quads:
    """The quads that keep a lane when only visible lanes count."""
    masks = visible_masks(fragments, quads)
    kept = masks > 0
    fields = (quads.triangle_id, quads.screen_id, quads.row, quads.column, masks)
    return Quads(*(values[kept] for values in fields), rows=quads.rows, columns=quads.columns)


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
