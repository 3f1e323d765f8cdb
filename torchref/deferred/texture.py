"""Textures as mip chains in one buffer, and their filters, one lookup after another.

uv (0, 0) is the upper left corner of an image, the centre of texel i lies at (i + 0.5) / size. Light is linear, alpha
straight. Layers clamp. uv that is not finite is 0; a derivative that is NaN is 0, an infinite one very large.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchref._precision import in_float64
from torchref._srgb import decode_srgb

_REPEAT, _CLAMP, _MIRROR = range(3)
_MODES = {"repeat": _REPEAT, "clamp": _CLAMP, "mirror": _MIRROR}
_LARGE = 2.0**24


@dataclass(frozen=True)
class Textures:
    """Texel (x, y) of level l of layer k is `texels[offset[k, l] + y * width[k, l] + x]`; linear RGBA.

    Tables end by repeating the last level of a layer. `wrap`: 0 repeat, 1 clamp, 2 mirror, for u and v.
    """

    texels: Float[Tensor, "n c"]
    offset: Int[Tensor, "k l"]
    width: Int[Tensor, "k l"]
    height: Int[Tensor, "k l"]
    num_levels: Int[Tensor, " k"]
    wrap: Int[Tensor, "k 2"]


@in_float64
def build_textures(
    images: Sequence[Shaped[Tensor | np.ndarray, "_ _ _"]],
    *,
    wrap: str | Sequence[str | tuple[str, str]] = "repeat",
    srgb: bool | Sequence[bool] = True,
) -> Textures:
    """One layer for each image. `srgb` is about the colour of byte images; floating point is linear already."""
    chains, rows, start = [], [], 0
    for k, image in enumerate(images):
        image = torch.as_tensor(image)
        encoded = srgb if isinstance(srgb, bool) else srgb[k]
        color, alpha = image[..., :3].double(), image[..., 3:].double()
        if image.dtype == torch.uint8:
            color, alpha = color / 255, alpha / 255
            if encoded:
                color = decode_srgb(color)
        if alpha.shape[-1] == 0:
            alpha = torch.ones_like(color[..., :1])
        chains.append(mip_chain(torch.cat([color, alpha], dim=-1)))
        rows.append([])
        for height, width in mip_sizes(*image.shape[:2]):
            rows[k].append((start, width, height))
            start += height * width
    counts = [len(row) for row in rows]
    table = torch.tensor([row + [row[-1]] * (max(counts) - len(row)) for row in rows], dtype=torch.int32)
    names = [wrap if isinstance(wrap, str) else wrap[k] for k in range(len(images))]
    modes = [[_MODES[name] for name in ((n, n) if isinstance(n, str) else n)] for n in names]
    return Textures(
        texels=torch.cat(chains),
        offset=table[..., 0],
        width=table[..., 1],
        height=table[..., 2],
        num_levels=torch.tensor(counts, dtype=torch.int32),
        wrap=torch.tensor(modes, dtype=torch.int32),
    )


def mip_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """(height, width) of the levels, down to 1 x 1."""
    sizes = [(height, width)]
    while sizes[-1] != (1, 1):
        sizes.append((max(1, sizes[-1][0] // 2), max(1, sizes[-1][1] // 2)))
    return sizes


@in_float64
def mip_chain(image: Float[Tensor, "h w 4"]) -> Float[Tensor, "n 4"]:
    """All levels, each the exact area average of the one before."""
    levels = [image]
    for height, width in mip_sizes(*image.shape[:2])[1:]:
        down, across = _area_average(levels[-1].shape[0], height), _area_average(levels[-1].shape[1], width)
        levels.append(torch.einsum("ai,bj,ijc->abc", down, across, levels[-1]))
    return torch.cat([level.reshape(-1, 4) for level in levels])


def _area_average(source: int, target: int) -> Float[Tensor, "target source"]:
    """What share of each target interval every source interval fills, both dividing [0, 1]."""
    shares = torch.zeros(target, source, dtype=torch.float64)
    for i in range(target):
        for j in range(source):
            overlap = min((i + 1) / target, (j + 1) / source) - max(i / target, j / source)
            shares[i, j] = max(0.0, overlap) * target
    return shares


@in_float64
def sample_bilinear(
    textures: Textures,
    layer: Int[Tensor, "*#b"] | int,
    uv: Float[Tensor, "*b 2"],
    *,
    level: Int[Tensor, "*#b"] | int,
) -> Float[Tensor, "*b 4"]:
    """Each texel weighs by the tent function of its distance, in u times in v."""
    return _each(lambda p, k, l: _bilinear(textures, k, l, p), uv, _layers(textures, layer), level)


@in_float64
def sample_trilinear(
    textures: Textures,
    layer: Int[Tensor, "*#b"] | int,
    uv: Float[Tensor, "*b 2"],
    *,
    lod: Float[Tensor, "*#b"] | float,
) -> Float[Tensor, "*b 4"]:
    """Each level weighs by the tent function of its distance from the clamped lod."""
    return _each(lambda p, k, d: _trilinear(textures, k, p, d), uv, _layers(textures, layer), lod)


@in_float64
def texture_lod(
    textures: Textures,
    duv_dx: Float[Tensor, "*b 2"],
    duv_dy: Float[Tensor, "*b 2"],
    *,
    layer: Int[Tensor, "*#b"] | int | None = None,
) -> Float[Tensor, "*b"]:
    """log2 of the longer of the two derivatives, in texels of level 0; no less than -24."""

    def one(dx: Tensor, dy: Tensor, k: int) -> Tensor:
        size = _size(textures, k, 0)
        longest = max((_texels(d, size) ** 2).sum() for d in (dx, dy))
        return torch.log2(torch.clamp(longest, min=1.0 / _LARGE**2)) / 2

    return _each(one, duv_dx, duv_dy, _layers(textures, layer), vectors=2)


@in_float64
def footprint_axes(
    dx: Float[Tensor, "*b 2"], dy: Float[Tensor, "*b 2"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b 2"]]:
    """Singular values of the matrix with columns dx and dy, and the left singular vector of the larger one."""
    u, s, _ = torch.linalg.svd(torch.stack([dx, dy], dim=-1))
    circle = s[..., :1] ** 2 - s[..., 1:] ** 2 <= 1e-5 * 0.5 * (s**2).sum(-1, keepdim=True)
    direction = torch.where(circle, torch.tensor([1.0, 0.0], dtype=u.dtype), u[..., 0])
    return s[..., 0], s[..., 1], direction


@in_float64
def sample_texture_grad(
    textures: Textures,
    uv: Float[Tensor, "*b 2"],
    duv_dx: Float[Tensor, "*b 2"],
    duv_dy: Float[Tensor, "*b 2"],
    *,
    layer: Int[Tensor, "*#b"] | int | None = None,
    max_anisotropy: int = 16,
) -> Float[Tensor, "*b 4"]:
    """Mean of trilinear taps along the major axis of the footprint."""

    def one(p: Tensor, dx: Tensor, dy: Tensor, k: int) -> Tensor:
        size = _size(textures, k, 0)
        major, minor, direction = footprint_axes(_texels(dx, size), _texels(dy, size))
        if minor * max_anisotropy < major:
            minor = major / max_anisotropy
        if minor < 1.0 / _LARGE:
            minor = minor.new_tensor(1.0 / _LARGE)
        ratio = major / minor
        if minor < 1.0:
            ratio = ratio * minor
        count = max(1, math.ceil(float(ratio.detach()) - 1.0 / 256.0))
        if count == 1:
            return _trilinear(textures, k, p, torch.log2(minor))
        # From the first tap to the last, such that with half a tap at either end the whole axis is covered.
        reach = (ratio - 1.0) * torch.clamp(minor, min=1.0) * direction / size
        places = [j / (count - 1.0) - 0.5 for j in range(count)]
        return sum(_trilinear(textures, k, p + s * reach, torch.log2(minor)) for s in places) / count

    return _each(one, uv, duv_dx, duv_dy, _layers(textures, layer), vectors=3)


@in_float64
def sample_ewa(
    textures: Textures,
    uv: Float[Tensor, "*b 2"],
    duv_dx: Float[Tensor, "*b 2"],
    duv_dy: Float[Tensor, "*b 2"],
    *,
    layer: Int[Tensor, "*#b"] | int | None = None,
    max_radius: int = 64,
) -> Float[Tensor, "*b 4"]:
    """Gaussian exp(-2 xᵀ M⁻¹ x) over the texels with xᵀ M⁻¹ x < 1, M = J Jᵀ + 1, J the derivatives in texels."""

    def one(p: Tensor, dx: Tensor, dy: Tensor, k: int) -> Tensor:
        for level in range(int(textures.num_levels[k])):
            size = _size(textures, k, level)
            jacobian = torch.stack([_texels(dx, size), _texels(dy, size)], dim=-1)
            lengths = torch.linalg.svdvals(jacobian.detach())
            if lengths[1] <= 4.0 and lengths[0] <= max_radius:
                break
        jacobian = torch.clamp(jacobian, -max_radius, max_radius)
        matrix = jacobian @ jacobian.T + torch.eye(2, dtype=p.dtype)
        inverse, center = torch.linalg.inv(matrix), _place(textures, k, p, size)
        (left, top), (right, bottom) = (
            (center + sign * torch.sqrt(torch.diagonal(matrix))).detach().tolist() for sign in (-1, 1)
        )
        total, weights = torch.zeros(4, dtype=p.dtype), torch.zeros((), dtype=p.dtype)
        for y in range(math.ceil(top), math.floor(bottom) + 1):
            for x in range(math.ceil(left), math.floor(right) + 1):
                offset = torch.tensor([x, y], dtype=p.dtype) - center
                q = offset @ inverse @ offset
                if q < 1.0:
                    weight = torch.exp(-2.0 * q)
                    total = total + weight * _texel(textures, k, level, x, y)
                    weights = weights + weight
        return total / weights

    return _each(one, uv, duv_dx, duv_dy, _layers(textures, layer), vectors=3)


@in_float64
def texture_derivatives(
    uv: Float[Tensor, "h w 2"], layer: Int[Tensor, "h w"], *, tolerance: float = 3.0
) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w 2"]]:
    """Mean of the differences to the neighbours that no seam lies in between; 0 without one."""
    uv = torch.where(torch.isfinite(uv), uv, torch.zeros_like(uv))
    dx, dy = torch.zeros_like(uv), torch.zeros_like(uv)
    for y in range(uv.shape[0]):
        for x, value in enumerate(_line_derivatives(uv[y], layer[y].tolist(), tolerance)):
            dx[y, x] = value
    for x in range(uv.shape[1]):
        for y, value in enumerate(_line_derivatives(uv[:, x], layer[:, x].tolist(), tolerance)):
            dy[y, x] = value
    return dx, dy


def _line_derivatives(uv: Tensor, layer: list[int], tolerance: float) -> list[Tensor | float]:
    # The steps of the line that stay in one layer, by the index of their left end.
    steps = {i: uv[i + 1] - uv[i] for i in range(len(layer) - 1) if layer[i] == layer[i + 1] and layer[i] >= 0}

    def jumps_from(i: int, other: int) -> bool:
        size, change = (float(torch.linalg.vector_norm(v.detach())) for v in (steps[other], steps[i] - steps[other]))
        return change > tolerance * size and float(torch.linalg.vector_norm(steps[i].detach())) > size

    neighbours = {i: [o for o in (i - 1, i + 1) if o in steps] for i in steps}
    seams = {i for i in steps if neighbours[i] and all(jumps_from(i, o) for o in neighbours[i])}
    values: list[Tensor | float] = []
    for i in range(len(layer)):
        own = [steps[o] for o in (i - 1, i) if o in steps and o not in seams]
        values.append(sum(own) / len(own) if own else 0.0)
    return values


def _each(function: Callable, *arguments, vectors: int = 1) -> Tensor:
    """Calls it for every lookup: the first arguments are vectors, the others numbers or tensors of them."""
    shape = torch.broadcast_shapes(*(x.shape[:-1] for x in arguments[:vectors]))
    columns = [x.expand(*shape, x.shape[-1]).reshape(-1, x.shape[-1]) for x in arguments[:vectors]]
    columns += [torch.as_tensor(x).expand(shape).reshape(-1) for x in arguments[vectors:]]
    results = [function(*row) for row in zip(*columns, strict=True)]
    return torch.stack(results).reshape(*shape, *results[0].shape)


def _layers(textures: Textures, layer: Tensor | int | None) -> Tensor:
    return torch.as_tensor(0 if layer is None else layer).clamp(0, len(textures.num_levels) - 1)


def _size(textures: Textures, k: int, level: int) -> Tensor:
    return torch.stack([textures.width[k, level], textures.height[k, level]]).double()


def _texels(derivative: Tensor, size: Tensor) -> Tensor:
    return torch.clamp(torch.nan_to_num(derivative, nan=0.0).clamp(-_LARGE, _LARGE) * size, -_LARGE, _LARGE)


def _texel(textures: Textures, k: int, level: int, x: int, y: int) -> Tensor:
    """The texel at whole numbers inside the image or not."""
    width, height = int(textures.width[k, level]), int(textures.height[k, level])
    x, y = _inside(x, width, int(textures.wrap[k, 0])), _inside(y, height, int(textures.wrap[k, 1]))
    return textures.texels[int(textures.offset[k, level]) + y * width + x]


def _inside(i: int, size: int, mode: int) -> int:
    if mode == _CLAMP:
        return min(max(i, 0), size - 1)
    if mode == _MIRROR and (i // size) % 2:
        return size - 1 - i % size
    return i % size


def _place(textures: Textures, k: int, uv: Tensor, size: Tensor) -> Tensor:
    """uv in texels, texel centres at whole numbers. Far outside a clamped image, everywhere is the same."""
    uv = torch.where(torch.isfinite(uv), uv, torch.zeros_like(uv))
    return torch.where(textures.wrap[k] == _CLAMP, uv.clamp(-128.0, 128.0), torch.fmod(uv, 2.0)) * size - 0.5


def _bilinear(textures: Textures, k: int, level: int, uv: Tensor) -> Tensor:
    level = min(max(int(level), 0), int(textures.num_levels[k]) - 1)
    place = _place(textures, k, uv, _size(textures, k, level))
    left, top = (math.floor(x) for x in place.detach().tolist())
    total = torch.zeros(4, dtype=uv.dtype)
    for y in (top, top + 1):
        for x in (left, left + 1):
            tent = (1.0 - torch.abs(place[0] - x)) * (1.0 - torch.abs(place[1] - y))
            total = total + tent * _texel(textures, k, level, x, y)
    return total


def _trilinear(textures: Textures, k: int, uv: Tensor, lod: Tensor) -> Tensor:
    lod = torch.clamp(torch.nan_to_num(lod.double(), nan=0.0), 0, int(textures.num_levels[k]) - 1)
    base = math.floor(float(lod.detach()))
    tents = {l: 1.0 - torch.abs(lod - l) for l in (base, base + 1)}
    return sum(tent * _bilinear(textures, k, l, uv) for l, tent in tents.items())
