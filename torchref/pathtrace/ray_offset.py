"""Origins that lie off the surface by a little more than rounding; pointwise."""

import torch
from jaxtyping import Float
from torch import Tensor

_AT_MOST = 256


def offset_origin(
    position: Float[Tensor, "*b 3"], geometric_normal: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 3"]:
    """The position, moved to the side of the direction by steps from one float32 number to the next.

    256 n of them, cut to a whole number, towards the sign of n; near 0 (< 1/32) by n / 65536 instead. Not by
    arithmetic on bits: the steps are made one after the other. A constant, as far as derivatives are concerned.

    References:
      Wächter, Binder, "A Fast and Robust Method for Avoiding Self-Intersection", Ray Tracing Gems, 2019, ch. 6.
    """
    p, n = position.detach().to(torch.float32), geometric_normal.detach().to(torch.float32)
    behind = (geometric_normal * direction).sum(-1, keepdim=True) < 0
    n = torch.where(behind, -n, n)
    steps = (_AT_MOST * n).trunc()
    goal, moved = torch.copysign(torch.full_like(p, torch.inf), n), p
    for step in range(_AT_MOST):
        moved = torch.where(step < steps.abs(), torch.nextafter(moved, goal), moved)
    moved = torch.where(p.abs() < 1.0 / 32.0, p + n / 65536.0, moved)
    return position + (moved - p).to(position.dtype)
