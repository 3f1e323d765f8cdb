"""The indirect light of an eye ray from the most similar of four guide rays, one eye ray after another."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchref._precision import in_float64

NORMAL_FLOOR, DEPTH_FLOOR = 1e-3, 1e-3
TIE = 1e-3


@in_float64
def guide_lookup(
    image: Float[Tensor, "h w c"],
    normal: Float[Tensor, "h w 3"],
    depth: Float[Tensor, "h w 1"],
    *,
    places_px: Float[Tensor, "n 2"],
    sample_normal: Float[Tensor, "n 3"],
    sample_depth: Float[Tensor, "n 1"],
) -> tuple[Float[Tensor, "n c"], Int[Tensor, "n 2"]]:
    """The value at the neighbour with the largest s_N s_D, else the larger s_N, else the smaller distance.

    References:
      Bauszat, Eisemann, Magnor 2011, eqs. 3-5.
    """
    height, width = image.shape[:2]
    taken = []
    for (x, y), n, d in zip(places_px.tolist(), sample_normal, sample_depth, strict=True):
        left, top = math.floor(x - 0.5), math.floor(y - 0.5)
        around = [
            (min(max(row, 0), height - 1), min(max(column, 0), width - 1))
            for row in (top, top + 1)
            for column in (left, left + 1)
        ]
        by_normal = _similarity([float((n - normal[at]).norm()) for at in around], NORMAL_FLOOR)
        by_depth = _similarity([abs(float(d - depth[at])) for at in around], DEPTH_FLOOR * abs(float(d)))
        ranks = [
            (
                s_n * s_d if normal[row, column].any() else -1.0,
                s_n,
                -((column + 0.5 - x) ** 2) - (row + 0.5 - y) ** 2,
            )
            for (row, column), s_n, s_d in zip(around, by_normal, by_depth, strict=True)
        ]
        best = list(range(4))
        for score in range(3):
            most = max(ranks[i][score] for i in best)
            best = [i for i in best if ranks[i][score] >= most - TIE]
        taken.append(around[best[0]])
    at = torch.tensor(taken, dtype=torch.int32).reshape(-1, 2)
    return image[at[:, 0].long(), at[:, 1].long()], at


def _similarity(distances: list[float], floor: float) -> list[float]:
    largest = max(*distances, floor)
    return [1.0 - distance / largest if largest > 0.0 else 1.0 for distance in distances]
