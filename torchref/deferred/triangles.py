"""Triangles on the screen."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class ScreenTriangles:
    """Snapped triangles (1/256 px from the middle of the image, y down), wound so that edge functions are positive."""

    xy: Int[Tensor, "n 3 2"]
    z: Float[Tensor, "n 3"]
    w: Float[Tensor, "n 3"]
    weights: Float[Tensor, "n 3 3"]
    area: Float[Tensor, " n"]
    source: Int[Tensor, " n"]
    order: Int[Tensor, " n"]
    front: Bool[Tensor, " n"]
    valid: Bool[Tensor, " n"]
