"""The guided filter as one walk down the rows: what a CPU runs.

Sums over windows are running sums down the columns, then doubled along the row (`windows.py`). Nothing of the size of
the image is made but the output: rows of coefficients wait in a ring until the last window that needs them is done.

What a stage of a step makes is put in a place that all steps share. XLA would otherwise fuse the stages and compute
the first ones many times over, or, where one step makes what the next one reads, copy it twice a step: a third more
time in all. Running sums start afresh every `restart_rows` rows. That keeps their rounding small, and makes the result
of a piece of an image that starts at such a row equal to that of the whole, bit for bit.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrender.filters.windows import neighbour_sums, window_counts


def restart_rows(radius: int) -> int:
    """How many rows apart running sums start afresh: a power of two, at least the window's height - 1.

    A row of the result depends, by rounding, on twice so many rows above it.
    """
    return max(32, 1 << (2 * radius - 1).bit_length())


class _Walk(NamedTuple):
    """What a step hands to the next one, which is about to do row t."""

    rows: tuple[Float[Array, "kr wp"], ...]  # places for two rows: 1, guide and image, with zeros at both ends
    sums: Float[Array, "n kr wp"]  # of products down the columns, rows t - 1 - r to t - 1 + r
    stages: tuple[Float[Array, "n+1 _ w"], ...]  # places for the normal equations, from the pivot's column on
    ring: Float[Array, "l+2 n c wp"]  # coefficients: row y at y modulo l + 1; zeros at l + 1
    coefficients: Float[Array, "n c wp"]  # sums of the last l rows of them
    totals: Float[Array, "n+1 c w"]  # place for sums over windows of them
    result: Float[Array, "h c w"]


def filter_rows(
    guide: Float[Array, "g h w"],
    image: Float[Array, "c h w"] | None,
    valid: Bool[Array, "h w"],
    eps: Float[Array, "g #h #w"],
    *,
    radius: int,
) -> Float[Array, "c h w"]:
    """The same as `guided.filter_planes`, up to rounding. With None for the image, the guide is filtered by itself."""
    g, height, width = guide.shape
    images = [] if image is None else [image]
    reach_y, reach_x = min(radius, height - 1), min(radius, width - 1)
    length, n, c = 2 * reach_y + 1, g + 1, g if image is None else image.shape[0]
    counts_y, counts_x = (1.0 / x.astype(guide.dtype) for x in window_counts(height, width, radius=radius))

    def inside(y):
        return (y >= 0) & (y < height)

    def fetch(place, y):
        at = jnp.clip(y, 0, height - 1)
        weight = (_row(valid, at) & inside(y)).astype(guide.dtype)[None]
        rows = [weight, *(_row(planes, at) * weight for planes in (guide, *images))]
        for start, row in zip((0, 1, n), rows, strict=False):
            place = lax.dynamic_update_slice(place, row, (start, reach_x))
        return place

    def products(row):
        return row[:n, None] * row[None]

    def in_ring(ring, y):
        slot = jnp.where(inside(y), lax.rem(y, length + 1), length + 1)
        return lax.dynamic_index_in_dim(ring, slot, keepdims=False)

    def window_sums(values):
        return neighbour_sums(values, length=2 * reach_x + 1)

    def equations(m):
        """Of the guide by itself, the right-hand sides are among the products of its channels."""
        return m if images else jnp.concatenate([m, m[:, 1:]], axis=1)

    def pivot(j: int, m, pixels, y):
        divisor = pixels
        if j > 0:
            ridge = _row(eps[j - 1], jnp.clip(y, 0, eps.shape[1] - 1))
            divisor = jnp.maximum(m[j, 0], jnp.zeros_like(divisor)) + ridge * pixels
        line = m[j, 1:] / divisor[None]
        others = m[:, 1:] - m[:, :1] * line[None]
        return jnp.where((jnp.arange(n) == j)[:, None, None], line[None], others)

    def step(t, walk: _Walk, first) -> _Walk:
        """Does row t, in a block that began at row `first`; sums that start afresh have no row to let go of."""
        leaving, gone = (jnp.where(t == first, -1, t - 1 - rows) for rows in (reach_y, 2 * reach_y))
        rows = fetch(walk.rows[0], t + reach_y), fetch(walk.rows[1], leaving)
        sums = walk.sums + (products(rows[0]) - products(rows[1]))
        stages = [_put(walk.stages[0], equations(window_sums(sums)), t)]
        pixels = jnp.maximum(stages[0][0, 0], jnp.ones_like(counts_x))
        for j in range(n - 1):
            stages.append(_put(walk.stages[j + 1], pivot(j, stages[j][:n], pixels, t), t))
        solved = pivot(n - 1, stages[-1][:n], pixels, t)
        ring = lax.dynamic_update_slice(walk.ring, solved[None], (lax.rem(t, length + 1), 0, 0, reach_x))
        coefficients = walk.coefficients + (in_ring(ring, t) - in_ring(ring, gone))
        totals = _put(walk.totals, window_sums(coefficients), t)
        done = jnp.maximum(t - reach_y, 0)
        here = _row(guide, done)
        filtered = totals[0] + sum(here[i][None] * totals[i + 1] for i in range(g))
        filtered = filtered * (counts_y[done] * counts_x)[None]
        result = lax.dynamic_update_slice(walk.result, filtered[None], (done, 0, 0))
        return _Walk(rows, sums, tuple(stages), ring, coefficients, totals, result)

    num_steps = height + reach_y
    every = restart_rows(reach_y)

    def block(k, walk: _Walk) -> _Walk:
        """The steps up to the next restart."""
        start = k * every

        def add(i, state):
            rows, sums, coefficients = state
            y = 2 * i
            rows = tuple(fetch(place, start - reach_y + y + j) for j, place in enumerate(rows))
            sums = sums + (products(rows[0]) + products(rows[1]))
            old = start - 2 * reach_y + y
            coefficients = coefficients + (in_ring(walk.ring, old) + in_ring(walk.ring, old + 1))
            return rows, sums, coefficients

        state = walk.rows, jnp.zeros_like(walk.sums), jnp.zeros_like(walk.coefficients)
        rows, sums, coefficients = lax.fori_loop(0, reach_y, add, state)
        walk = walk._replace(rows=rows, sums=sums, coefficients=coefficients)
        return lax.fori_loop(start, jnp.minimum(start + every, num_steps), lambda t, w: step(t, w, start), walk)

    zeros = lambda *shape: jnp.zeros(shape, guide.dtype)  # noqa: E731
    k, k_rows, padded = n + c, n + c * len(images), width + 2 * reach_x
    start = _Walk(
        rows=(zeros(k_rows, padded), zeros(k_rows, padded)),
        sums=zeros(n, k_rows, padded),
        stages=tuple(zeros(n + 1, k - j, width) for j in range(n)),
        ring=zeros(length + 2, n, c, padded),
        coefficients=zeros(n, c, padded),
        totals=zeros(n + 1, c, width),
        result=zeros(height, c, width),
    )
    result = lax.fori_loop(0, -(-num_steps // every), block, start).result
    return jnp.swapaxes(result, 0, 1)


def _row(planes: Array, y) -> Array:
    return lax.dynamic_index_in_dim(planes, y, axis=-2, keepdims=False)


def _put(place: Float[Array, "m k w"], value: Float[Array, "n k w"], t) -> Float[Array, "m k w"]:
    """`value` in all but the last entry of `place`: at 0, which the compiler cannot know, so it has to store it."""
    return lax.dynamic_update_slice(place, value, (jnp.minimum(t, 0), 0, 0))
