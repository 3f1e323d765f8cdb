"""SH coefficients to their best few zonal lobes: many starts, every step a dense least squares.

Pointwise: any leading axes. Axis names: `c` lobes, `l` bands, `k` = order² coefficients.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.harmonics.sh import sh_basis
from torchref.harmonics.zh import lobes_to_sh
from torchref.vecmath import frame_from_normal_tangent, normalize, orthonormal_tangent

COEFFICIENT_DAMPING = 0.01
"""Share of |z|² in the penalty of an anchored fit."""


@dataclass(frozen=True)
class ZHLobes:
    """c zonal lobes and the squared SH error that they leave."""

    axes: Float[Tensor, "*b c 3"]
    coefficients: Float[Tensor, "*b c l"]
    residual: Float[Tensor, "*b"]


@in_float64
def axis_from_chart(chart: Float[Tensor, "*#b 2"], reference: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Unit axis from stereographic coordinates about the z column of a frame.

    The chart plane touches the sphere at the z axis and is seen from the opposite pole: a point q = chart/2
    of it meets the unit sphere in (2q, 1 - |q|²) / (1 + |q|²). Small coordinates are angles in radians.
    """
    q = chart / 2.0
    r2 = (q * q).sum(-1, keepdim=True)
    local = torch.cat([2.0 * q, 1.0 - r2], dim=-1) / (1.0 + r2)
    return torch.einsum("...ij,...j->...i", reference, local)


@in_float64
def chart_from_axis(axis: Float[Tensor, "*#b 3"], reference: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*b 2"]:
    """The inverse of `axis_from_chart`: 2 (x, y) / (1 + z) in the frame; the opposite pole is at infinity."""
    local = torch.einsum("...ji,...j->...i", reference, axis)
    return 2.0 * local[..., :2] / (1.0 + local[..., 2:])


@in_float64
def reference_frames(axes: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """A right-handed frame around each unit axis, which is its z column."""
    return frame_from_normal_tangent(axes, orthonormal_tangent(axes))


@in_float64
def optimal_linear_direction(sh: Float[Tensor, "*b k"]) -> Float[Tensor, "*b 3"]:
    """The unit gradient of band 1: Σ_m v_1m y_1m(s) = √(3/4π) (-v_3, -v_1, v_2)·s."""
    return normalize(torch.stack([-sh[..., 3], -sh[..., 1], sh[..., 2]], dim=-1))


@in_float64
def solve_lobe_coefficients(
    sh: Float[Tensor, "*#b k"], axes: Float[Tensor, "*#b c 3"], *, order: int
) -> tuple[Float[Tensor, "*b c l"], Float[Tensor, "*b"]]:
    """The least-squares coefficients for given axes, and the squared SH error left.

    Band by band v_lm = Σ_i √(4π/(2l+1)) y_lm(d_i) z_il is solved by a pseudo-inverse, so where lobes share a
    span (band 0 always) the coefficients are the shortest that fit.
    """
    columns = []
    for l, design in enumerate(_designs(axes, order)):
        v = sh[..., l * l : (l + 1) ** 2]
        columns.append(torch.einsum("...im,...m->...i", torch.linalg.pinv(design, rtol=1e-10), v))
    coefficients = torch.stack(columns, dim=-1)
    return coefficients, ((sh - lobes_to_sh(coefficients, axes)) ** 2).sum(-1)


@in_float64
def fit_shared_axes(
    sh: Float[Tensor, "*b n k"], *, num_lobes: int, order: int, num_starts: int = 4, num_steps: int = 20
) -> Float[Tensor, "*b c 3"]:
    """One set of axes that serves n coefficient vectors, each with its own lobe coefficients."""
    groups = sh.reshape(-1, *sh.shape[-2:])
    axes = _search(groups, num_lobes, order, num_starts, num_steps)
    return axes.reshape(*sh.shape[:-2], num_lobes, 3)


@in_float64
def fit_zh_lobes(
    sh: Float[Tensor, "*b k"],
    *,
    num_lobes: int,
    order: int,
    anchor_axes: Float[Tensor, "*#b c 3"] | None = None,
    anchor: float = 0.1,
    num_starts: int = 4,
    num_steps: int = 12,
) -> ZHLobes:
    """Axes and coefficients of c lobes with the least squared SH error.

    With `anchor_axes` it is the least of error + anchor · (|chart|² + 0.01 |z|²), the charts being laid
    around the anchors, and found from there.

    Args:
      num_starts: how many of the best axis sets of a coarse direction grid are refined.
      num_steps: Levenberg-Marquardt steps.
    """
    lead, flat = sh.shape[:-1], sh.reshape(-1, sh.shape[-1])
    if anchor_axes is None:
        axes = _search(flat[:, None], num_lobes, order, num_starts, num_steps)
        coefficients, _ = solve_lobe_coefficients(flat, axes, order=order)
    else:
        anchors = anchor_axes.expand(*lead, num_lobes, 3).reshape(-1, num_lobes, 3)
        axes, coefficients = _search_anchored(flat, anchors, order, anchor, num_steps)
    residual = ((flat - lobes_to_sh(coefficients, axes)) ** 2).sum(-1)
    return ZHLobes(
        axes.reshape(*lead, num_lobes, 3),
        coefficients.reshape(*lead, num_lobes, order),
        residual.reshape(lead),
    )


def _designs(axes: Float[Tensor, "*b c 3"], order: int) -> list[Tensor]:
    """For each band the matrix (2l+1, c) from lobe coefficients to SH coefficients."""
    y = sh_basis(axes, order=order)
    return [
        math.sqrt(4.0 * math.pi / (2 * l + 1)) * y[..., l * l : (l + 1) ** 2].transpose(-1, -2) for l in range(order)
    ]


def _search(
    groups: Float[Tensor, "g n k"], num_lobes: int, order: int, num_starts: int, num_steps: int
) -> Float[Tensor, "g c 3"]:
    """For each group of vectors the axes with the least summed error."""

    def errors(vectors: Tensor, axes: Tensor) -> Tensor:  # (..., n, k), (..., c, 3) -> (...,)
        return solve_lobe_coefficients(vectors, axes[..., None, :, :], order=order)[1].sum(-1)

    sets = _axis_sets(num_lobes).to(groups.device)
    ranked = torch.stack([torch.argsort(errors(vectors, sets)) for vectors in groups])
    starts = sets[ranked[:, :num_starts]].flatten(0, 1)
    frames, vectors = reference_frames(starts), groups.repeat_interleave(num_starts, dim=0)

    def misfit(chart: Tensor) -> Tensor:
        axes = axis_from_chart(chart, frames)[..., None, :, :]
        coefficients, _ = solve_lobe_coefficients(vectors, axes, order=order)
        return (vectors - lobes_to_sh(coefficients, axes)).flatten(-2)

    chart = _levenberg_marquardt(misfit, torch.zeros_like(starts[..., :2]), num_steps)
    axes = axis_from_chart(chart, frames)
    best = torch.argmin(errors(vectors, axes).reshape(-1, num_starts), dim=-1)
    return axes.unflatten(0, (-1, num_starts))[torch.arange(len(groups)), best]


def _search_anchored(
    flat: Float[Tensor, "g k"], anchors: Float[Tensor, "g c 3"], order: int, anchor: float, num_steps: int
) -> tuple[Float[Tensor, "g c 3"], Float[Tensor, "g c l"]]:
    """Axes and coefficients of the penalised fit of each vector."""
    frames, damping = reference_frames(anchors), anchor * COEFFICIENT_DAMPING
    identity = torch.eye(anchors.shape[-2], dtype=flat.dtype, device=flat.device)

    def coefficients_at(axes: Tensor) -> Tensor:
        columns = []
        for l, design in enumerate(_designs(axes, order)):
            normal = design.transpose(-1, -2) @ design + damping * identity
            right = torch.einsum("...mi,...m->...i", design, flat[:, l * l : (l + 1) ** 2])
            columns.append(torch.linalg.solve(normal, right))
        return torch.stack(columns, dim=-1)

    def misfit(chart: Tensor) -> Tensor:
        axes = axis_from_chart(chart, frames)
        z = coefficients_at(axes)
        penalties = [math.sqrt(anchor) * chart.flatten(-2), math.sqrt(damping) * z.flatten(-2)]
        return torch.cat([flat - lobes_to_sh(z, axes), *penalties], dim=-1)

    chart = _levenberg_marquardt(misfit, torch.zeros_like(anchors[..., :2]), num_steps)
    axes = axis_from_chart(chart, frames)
    return axes, coefficients_at(axes)


def _axis_sets(num_lobes: int) -> Float[Tensor, "s c 3"]:
    """Sets of c axes to start from: choices among directions spread over a half sphere (±d are one axis)."""
    num_directions = {1: 64, 2: 32, 3: 16}.get(num_lobes, max(12, num_lobes + 2))
    i = torch.arange(num_directions, dtype=torch.float64) + 0.5
    z, phi = i / num_directions, math.pi * (1.0 + math.sqrt(5.0)) * i
    s = torch.sqrt(1.0 - z * z)
    directions = torch.stack([s * torch.cos(phi), s * torch.sin(phi), z], dim=-1)
    choices = itertools.islice(itertools.combinations(range(num_directions), num_lobes), 1000)
    return directions[torch.tensor(list(choices))]


def _levenberg_marquardt(
    misfit: Callable[[Tensor], Tensor], start: Float[Tensor, "g c 2"], num_steps: int
) -> Float[Tensor, "g c 2"]:
    """Lowers |misfit(p)|² of each of g problems: damped Gauss-Newton steps, each kept only if it helps.

    The Jacobian is taken by central differences; at this step their error (1e-10) only slows the last digits.
    `misfit` takes more leading axes, so that all differences are one call.
    """
    p, h = start, 1e-5
    moves = h * torch.eye(p[0].numel(), dtype=p.dtype, device=p.device).reshape(-1, 1, *p.shape[1:])
    damping, r = torch.full_like(p[:, 0, 0], 1e-2), misfit(p)
    for _ in range(num_steps):
        ahead, behind = misfit(torch.cat([p + moves, p - moves])).chunk(2)
        jacobian = ((ahead - behind) / (2.0 * h)).movedim(0, -1)
        normal = torch.einsum("gmi,gmj->gij", jacobian, jacobian)
        scale = torch.diagonal(normal, dim1=-2, dim2=-1) + 1e-12
        damped = normal + torch.diag_embed(damping[:, None] * scale)
        step = torch.linalg.solve(damped, torch.einsum("gmi,gm->gi", jacobian, r))
        trial = p - step.reshape(p.shape)
        r_trial = misfit(trial)
        better = (r_trial**2).sum(-1) < (r**2).sum(-1)
        p = torch.where(better[:, None, None], trial, p)
        r = torch.where(better[:, None], r_trial, r)
        damping = torch.where(better, damping / 5.0, damping * 5.0)
    return p
