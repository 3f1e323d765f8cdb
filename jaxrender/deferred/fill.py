"""Lists of triangles by tile -> for every sample the nearest triangle, after the depth test.

Tiles are worked on in lockstep: a chunk of tiles, of about equally long lists, takes its first triangles, then its
second ones, and so on. All samples of a tile are lanes of one vector, and nothing is scattered.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxrender.deferred.binning import TileGrid, TileLists
from jaxrender.deferred.coverage import Lanes, PairRows, TriangleRows, cover
from jaxrender.deferred.samples import Samples

#: Depth of a sample that has seen no triangle yet: beyond the far plane.
EMPTY = 2.0


@dataclass(frozen=True)
class Plan:
    """How an image is cut: strips of rows of tiles, in which chunks of tiles are worked on in lockstep.

    A strip is small enough for a processor's cache, and holds enough tiles to sort them by the length of their lists.
    """

    grid: TileGrid
    pattern: Samples
    rows_per_strip: int
    tiles_per_chunk: int

    @property
    def num_strips(self) -> int:
        return -(-self.grid.rows // self.rows_per_strip)

    @property
    def tiles_per_strip(self) -> int:
        return self.rows_per_strip * self.grid.columns


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Work:
    """Everything the depth test needs: pairs sorted by tile, where each tile's begin, and the triangles they name."""

    triangles: TriangleRows
    pairs: PairRows
    lists: TileLists


def fill_strip(work: Work, strip: Int[Array, ""], plan: Plan) -> tuple[Int[Array, "r c s"], Float[Array, "r c s"]]:
    """Runs the depth test over one strip of the image.

    Its tiles in order of their work, chunk by chunk, and back in their places.

    Returns:
      By rows and columns of cells, and samples of the pattern: the pair that each sample sees (-1 for none), and its
      window depth (`EMPTY` for none).
    """
    n, chunk = plan.tiles_per_strip, plan.tiles_per_chunk
    tile = strip * n + jnp.arange(n, dtype=jnp.int32)
    tile = jnp.where(tile < plan.grid.count, tile, -1)
    order = jnp.argsort(-jnp.where(tile >= 0, work.lists.count[tile], 0), stable=True)
    chunks = jnp.concatenate([tile[order], jnp.full(-n % chunk, -1, jnp.int32)]).reshape(-1, chunk)
    lanes = Lanes.of(plan.grid.size, plan.pattern)
    filled = jax.lax.map(lambda own: _fill_chunk(work, own, lanes), chunks)
    place = jnp.zeros(n, jnp.int32).at[order].set(jnp.arange(n, dtype=jnp.int32))
    size, s = plan.grid.size, len(plan.pattern.offsets)

    def put(values: Array) -> Array:
        tiles = values.reshape(-1, values.shape[-1])[place]
        cells = tiles.reshape(plan.rows_per_strip, plan.grid.columns, size, size, s).swapaxes(1, 2)
        return cells.reshape(plan.rows_per_strip * size, plan.grid.columns * size, s)

    pair, depth = filled
    return put(pair), put(depth)


def _fill_chunk(work: Work, tile: Int[Array, " k"], lanes: Lanes) -> tuple[Int[Array, "k n"], Float[Array, "k n"]]:
    """The triangles of each tile's list, one after another, for k tiles of n lanes side by side."""
    start, count = work.lists.start[tile], jnp.where(tile >= 0, work.lists.count[tile], 0)
    shape = len(tile), lanes.x.shape[1]

    def step(state: Any) -> Any:
        # The depth of a turn is used in the next one: two results in one turn would each work it out again.
        turn, winner, depth, z = state
        nearer, last = z < depth, jnp.maximum(start + turn - 1, 0)
        active = turn < count
        seen, following = cover(work.pairs, work.triangles, jnp.where(active, start + turn, 0), lanes)
        following = jnp.where(seen & active[:, None], following, EMPTY)
        # Lists are in drawing order, so that the first one keeps a tie.
        return turn + 1, jnp.where(nearer, last[:, None], winner), jnp.minimum(z, depth), following

    empty = jnp.full(shape, EMPTY, jnp.float32)
    state = jnp.int32(0), jnp.full(shape, -1, jnp.int32), empty, empty
    return jax.lax.while_loop(lambda state: state[0] <= jnp.max(count), step, state)[1:3]
