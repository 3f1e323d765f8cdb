"""Pairs of a tile and a triangle -> which samples of the tile lie in the triangle, and how deep it is there.

Edge functions are exact: they are set up around each tile, so that within it they fit in int32.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.deferred.binning import TileGrid
from jaxrender.deferred.samples import Samples
from jaxrender.deferred.triangles import SUBPIXELS, ScreenTriangles, corner_planes, edge, plane_steps


@dataclass(frozen=True)
class Lanes:
    """The samples of a tile, row by row, those of a pixel together.

    They lie at base + unit·(x, y) snapped units from the tile's corner.

    The unit is a whole pixel or a sixteenth, so that sums of edge functions stay within int32: at most 16 steps
    of the one and 128 of the other.
    """

    base: int
    unit: int
    x: Int[np.ndarray, "1 lanes"]
    y: Int[np.ndarray, "1 lanes"]

    @classmethod
    def of(cls, size: int, pattern: Samples) -> "Lanes":
        """The lanes of a tile of `size` x `size` pixels."""
        shape = size, size, len(pattern.offsets)
        row, column, sample = (index.reshape(1, -1).astype(np.int32) for index in np.indices(shape))
        if pattern.offsets == ((0, 0),):
            return cls(SUBPIXELS // 2, SUBPIXELS, column, row)
        dx, dy = np.moveaxis(np.array(pattern.offsets, np.int32)[sample], -1, 0)
        return cls(0, SUBPIXELS // 16, 16 * column + 8 + dx, 16 * row + 8 + dy)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TriangleRows:
    """What does not change from tile to tile; a row for each of n screen triangles, to be gathered at once.

    Attributes:
      edges: steps of the three edge functions to the right, then down.
      depth: steps of window depth to the right and down, and the least and greatest of the corners.
      planes: steps of 1/w, b_1/w and b_2/w to the right, then down.
    """

    edges: Int[Array, "n 6"]
    depth: Float[Array, "n 4"]
    planes: Float[Array, "n 6"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairRows:
    """What p pairs of a tile and a screen triangle need to know at lane (0, 0).

    Attributes:
      triangle: row of the screen triangles.
      edges: values of the three edge functions.
      planes: of window depth, 1/w, b_1/w and b_2/w.
    """

    triangle: Int[Array, " p"]
    edges: Int[Array, "p 3"]
    planes: Float[Array, "p 4"]


def set_up_triangles(triangles: ScreenTriangles, lanes: Lanes) -> TriangleRows:
    """Steps from lane to lane of everything that is linear on the screen."""
    start, end = triangles.xy, jnp.roll(triangles.xy, -1, axis=1)
    dx, dy = ((end - start)[..., axis] for axis in (0, 1))
    right, down = plane_steps(triangles, unit=lanes.unit)
    z = triangles.z
    return TriangleRows(
        edges=jnp.concatenate([-dy, dx], axis=1),
        depth=jnp.stack([right[0], down[0], z.min(axis=1), z.max(axis=1)], axis=1),
        planes=jnp.stack([*right[1:], *down[1:]], axis=1),
    )


def set_up_pairs(
    triangles: ScreenTriangles, tile: Int[Array, " p"], triangle: Int[Array, " p"], grid: TileGrid, lanes: Lanes
) -> PairRows:
    """Edge functions and planes of each pair's triangle at the first lane of its tile.

    Values come from exact edge functions, so that a plane is as good far from the corners as near to them; from there
    on it is 16 pixels at most.
    """
    x, y = (corner + lanes.base for corner in grid.corner(tile))
    own = triangles.xy.reshape(-1, 6)[triangle]
    corners = [(own[:, 2 * k], own[:, 2 * k + 1]) for k in range(3)]
    found = [edge(corners[k], corners[(k + 1) % 3], (x, y), unit=lanes.unit) for k in range(3)]
    planes = jnp.stack([v for plane in corner_planes(triangles) for v in plane] + [triangles.area], axis=1)[triangle]
    weights = [found[(k + 1) % 3][1] / planes[:, 12] for k in range(3)]
    values = [sum(weights[k] * planes[:, 3 * i + k] for k in range(3)) for i in range(4)]
    return PairRows(triangle, jnp.stack([c for c, _ in found], axis=1), jnp.stack(values, axis=1))


def cover(
    pairs: PairRows, triangles: TriangleRows, pair: Int[Array, " n"], lanes: Lanes
) -> tuple[Bool[Array, "n lanes"], Float[Array, "n lanes"]]:
    """Which lanes lie in each pair's triangle and between the near and far plane, and window depth there."""
    triangle = pairs.triangle[pair]
    inside = _inside(pairs.edges[pair], triangles.edges[triangle], lanes)
    x, y = (jnp.asarray(places, pairs.planes.dtype) for places in (lanes.x, lanes.y))
    z = depth_at(pairs.planes[pair, :1], triangles.depth[triangle][:, None], x, y)
    return inside & (z >= 0.0) & (z <= 1.0), z


def _inside(here: Int[Array, "n 3"], steps: Int[Array, "n 6"], lanes: Lanes) -> Bool[Array, "n lanes"]:
    """By the top-left rule."""
    values = (here[:, k, None] + steps[:, k, None] * lanes.x + steps[:, 3 + k, None] * lanes.y for k in range(3))
    # The sign bit of the three together is set as soon as one is negative.
    return functools.reduce(jnp.bitwise_or, values) >= 0


def depth_at(
    here: Float[Array, "*b"], steps: Float[Array, "*b 4"], x: Float[Array, "*#b"], y: Float[Array, "*#b"]
) -> Float[Array, "*b"]:
    """Window depth at lanes; the first column of `PairRows.planes` and rows of `TriangleRows.depth`."""
    right, down, low, high = (steps[..., k] for k in range(4))
    # On a sliver the plane may be steep beyond float32; no point of a triangle is deeper than its corners.
    return jnp.clip(here + right * x + down * y, low, high)


def barycentrics_at(
    here: Float[Array, "*b 4"], steps: Float[Array, "*b 6"], x: Float[Array, "*#b"], y: Float[Array, "*#b"]
) -> tuple[Float[Array, "*b 2"], Float[Array, "*b"]]:
    """Perspective-correct weights of corners 1 and 2, and clip w, at lanes inside; rows of `planes` of both kinds."""
    over_w, b1, b2 = (here[..., 1 + k] + steps[..., k] * x + steps[..., 3 + k] * y for k in range(3))
    return jnp.clip(jnp.stack([b1, b2], axis=-1) / over_w[..., None], 0.0, 1.0), 1.0 / over_w
