"""Interpolation in every mode, from the equations of a plane: solved in float64 for each triangle."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchref.deferred.raster import Fragments, sample_places

MODES = ("perspective", "noperspective", "flat_first", "flat_last")


def interpolate(
    fragments: Fragments, attributes: Float[Tensor, "v c"], *, mode: str = "perspective"
) -> Float[Tensor, "h w s c"]:
    """Vertex attributes at the samples; 0 where a sample is empty."""
    return blend(fragments, attributes, corner_weights(fragments, mode=mode))


def blend(
    fragments: Fragments, attributes: Float[Tensor, "v c"], weights: Float[Tensor, "h w s 3"]
) -> Float[Tensor, "h w s c"]:
    """Σ weights · attributes of the corners; 0 where a sample is empty."""
    corners = attributes[fragments.faces[fragments.triangle_id.clamp(min=0)]]
    return torch.einsum("hwsk,hwskc->hwsc", weights, corners) * fragments.coverage[..., None]


def corner_weights(fragments: Fragments, *, mode: str = "perspective") -> Float[Tensor, "h w s 3"]:
    """What each corner of its triangle counts at a sample."""
    b = fragments.barycentrics
    weights = torch.stack([1 - b[..., 0] - b[..., 1], b[..., 0], b[..., 1]], dim=-1)
    return _as_mode(fragments, weights, mode)


def _as_mode(fragments: Fragments, weights: Tensor, mode: str) -> Tensor:
    if mode == "perspective":
        return weights
    if mode in ("flat_first", "flat_last"):
        return torch.eye(3, dtype=weights.dtype)[0 if mode == "flat_first" else 2].expand(weights.shape)
    times_w = weights * source_w(fragments)
    total = times_w.sum(-1, keepdim=True)
    return times_w / torch.where(fragments.coverage[..., None], total, torch.ones_like(total))


def source_w(fragments: Fragments) -> Float[Tensor, "h w s 3"]:
    """Clip w of the corners of each sample's triangle."""
    return fragments.clip[fragments.faces[fragments.triangle_id.clamp(min=0)]][..., 3]


def weights_at(
    fragments: Fragments, x: Int[Tensor, "h w s"], y: Int[Tensor, "h w s"], *, mode: str = "perspective"
) -> Float[Tensor, "h w s 3"]:
    """Weights of each sample's triangle at another place, in 1/256 of a cell from the middle of the image.

    Homogeneous form: the weights b solve Σ b_k (x_k, y_k, w_k) ∝ (X, Y, 1) in clip space, X and Y in NDC; corners are
    snapped where they can be projected.
    """
    h, w, _ = fragments.triangle_id.shape
    m = fragments.samples.grid
    x, y = x.to(torch.float64), y.to(torch.float64)
    place = torch.stack([x / (w * m * 128), -y / (h * m * 128), torch.ones_like(x)], dim=-1)
    solved = torch.linalg.solve(corner_matrix(fragments), place[..., None])[..., 0]
    return _as_mode(fragments, (solved / solved.sum(-1, keepdim=True)).to(fragments.barycentrics.dtype), mode)


def corner_matrix(fragments: Fragments) -> Float[Tensor, "h w s 3 3"]:
    """The corners (x, y, w) of each sample's triangle in clip space as columns, in float64; 1 where it is empty.

    A triangle in front of the eye has its corners where they snap to on the screen.
    """
    h, w, _ = fragments.triangle_id.shape
    m = fragments.samples.grid
    half = torch.tensor([w * m * 128.0, -h * m * 128.0], dtype=torch.float64)
    corners = fragments.clip[fragments.faces[fragments.triangle_id.clamp(min=0)]].to(torch.float64)
    own_w = corners[..., 3:]
    snapped = torch.round((corners[..., :2].float() / own_w.float()) * half.float()).to(torch.float64) / half * own_w
    xy = torch.where((own_w > 0).all(dim=-2, keepdim=True), snapped, corners[..., :2])
    matrix = torch.cat([xy, own_w], dim=-1).transpose(-1, -2)
    return torch.where(fragments.coverage[..., None, None], matrix, torch.eye(3, dtype=torch.float64))


def interpolate_at_offset(
    fragments: Fragments, attributes: Float[Tensor, "v c"], offset: Int[Tensor, "2"], *, mode: str = "perspective"
) -> Float[Tensor, "h w s c"]:
    """Attributes at an offset in 1/16 px (-8 to 7, wrapped) from the centre of each sample's pixel."""
    m = fragments.samples.grid
    dx, dy = (int(o) % 16 if int(o) % 16 < 8 else int(o) % 16 - 16 for o in offset)
    x, y = _centers(fragments)
    return blend(fragments, attributes, weights_at(fragments, x + 16 * m * dx, y + 16 * m * dy, mode=mode))


def interpolate_at_sample(
    fragments: Fragments, attributes: Float[Tensor, "v c"], index: int, *, mode: str = "perspective"
) -> Float[Tensor, "h w s c"]:
    """Attributes at sample `index` of the pixel."""
    h, w, s = fragments.triangle_id.shape
    at = sample_places(h, w, fragments.samples)[:, :, index : index + 1].expand(h, w, s, 2)
    return blend(fragments, attributes, weights_at(fragments, at[..., 0], at[..., 1], mode=mode))


def interpolate_at_centroid(
    fragments: Fragments,
    attributes: Float[Tensor, "v c"],
    *,
    mode: str = "perspective",
    sample_mask: Bool[Tensor, " s"] | None = None,
) -> Float[Tensor, "h w s c"]:
    """Attributes at the centroid, as Direct3D 11 rules."""
    return blend(
        fragments, attributes, weights_at(fragments, *centroids(fragments, sample_mask=sample_mask), mode=mode)
    )


def centroids(
    fragments: Fragments, *, sample_mask: Bool[Tensor, " s"] | None = None
) -> tuple[Int[Tensor, "h w s"], Int[Tensor, "h w s"]]:
    """Where each sample's triangle is evaluated in centroid mode: pixel by pixel, by the three cases of the rule."""
    h, w, s = fragments.triangle_id.shape
    mask = [True] * s if sample_mask is None else [bool(b) for b in sample_mask]
    places, (cx, cy) = sample_places(h, w, fragments.samples), _centers(fragments)
    x, y = cx.clone(), cy.clone()
    for r in range(h):
        for c in range(w):
            ids = fragments.triangle_id[r, c].tolist()
            for k in range(s):
                covered = [i for i in range(s) if ids[i] == ids[k]]
                counted = [i for i in covered if mask[i]]
                if len(covered) == s or (not counted and all(mask)):
                    continue
                first = counted[0] if counted else mask.index(True)
                x[r, c, k], y[r, c, k] = places[r, c, first]
    return x, y


def _centers(fragments: Fragments) -> tuple[Tensor, Tensor]:
    h, w, s = fragments.triangle_id.shape
    cell = 256 * fragments.samples.grid
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    x, y = x * cell + cell // 2 - w * cell // 2, y * cell + cell // 2 - h * cell // 2
    return x[..., None].expand(h, w, s), y[..., None].expand(h, w, s)
