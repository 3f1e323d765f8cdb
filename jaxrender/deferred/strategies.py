"""Counts of pixels -> the order in which their samples are evaluated: the ways of section 4.2 of the paper.

All of them evaluate the same samples. They differ in which samples sit in one warp of 32 lanes, and so in how many
lanes idle: a loop ends when the last of its lanes does.

References:
  Holländer et al., 2013, section 4.2; Hoberock et al., "Stream Compaction for Deferred Shading", 2009 (sorting);
  Lauritzen, "Deferred Rendering for Current and Future Rendering Pipelines", 2010 (tiles).
"""

import numpy as np
from jaxtyping import Int

from jaxrender.checks import check_one_of

#: The first one is the default.
STRATEGIES = ("compacted", "tiled", "masked", "per_count", "sorted", "low_resolution")

WARP_SIZE, TILE_PIXELS = 32, 256


def work_order(
    count: Int[np.ndarray, " p"], *, strategy: str = "compacted"
) -> tuple[Int[np.ndarray, " b"], Int[np.ndarray, " b"]]:
    """Pixel and turn (0 to its count - 1) of every lane, in the order of evaluation; pixel -1 for an idle lane.

    Args:
      count: >= 0, of pixels in an order in which each 32 lie together on the screen.
      strategy: "compacted" lists all samples without a gap. "tiled" does so tile by tile of 256 pixels, each of which
        begins with a warp of its own, as a group of threads with shared memory would. "masked" loops over the pixels of
        a warp until the largest count is done. "sorted" does so after sorting the pixels by count. "per_count" makes
        one pass over the pixels of each count, as a stencil test would, from buckets. "low_resolution" is "masked"; its
        counts have to be made with `tile_maximum`.
    """
    check_one_of("strategy", strategy, STRATEGIES)
    pixels = np.arange(len(count), dtype=np.int32)
    if strategy == "compacted":
        return np.repeat(pixels, count), _turns(count)
    if strategy == "tiled":
        return _tiled(count)
    if strategy == "per_count":
        # Histogram bucketing: a histogram tells where each count's bucket ends, one stable sort fills them all.
        buckets = np.split(np.argsort(count, kind="stable").astype(np.int32), np.cumsum(np.bincount(count)))
        passes = [_loops(bucket, count) for bucket in buckets]
        return np.concatenate([pixel for pixel, _ in passes]), np.concatenate([turn for _, turn in passes])
    if strategy == "sorted":
        pixels = np.argsort(-count, kind="stable").astype(np.int32)
    return _loops(pixels, count)


def _tiled(count: Int[np.ndarray, " p"]) -> tuple[Int[np.ndarray, " b"], Int[np.ndarray, " b"]]:
    """The samples of each tile without a gap, and idle lanes up to the next whole warp."""
    pixels = np.repeat(np.arange(len(count), dtype=np.int32), count)
    tile = pixels // TILE_PIXELS
    own = np.bincount(tile)
    room = -(-own // WARP_SIZE) * WARP_SIZE
    lane = np.arange(len(pixels)) + (np.cumsum(room - own) - (room - own))[tile]
    found = np.full((2, int(room.sum())), [[-1], [0]], np.int32)
    found[:, lane] = pixels, _turns(count)
    return found[0], found[1]


def _turns(count: Int[np.ndarray, " p"]) -> Int[np.ndarray, " b"]:
    """0 to count - 1 for every pixel, one after another."""
    ends = np.cumsum(count)
    return (np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - count, count)).astype(np.int32)


def _loops(pixels: Int[np.ndarray, " p"], count: Int[np.ndarray, " p"]) -> tuple[np.ndarray, np.ndarray]:
    """Warps of pixels, each going round as often as its largest count."""
    lanes = np.pad(pixels, (0, -len(pixels) % WARP_SIZE), constant_values=-1).reshape(-1, WARP_SIZE)
    own = np.where(lanes >= 0, count[lanes] if len(count) else 0, 0)
    rounds = own.max(axis=1) if len(own) else np.zeros(0, int)
    warp, turn = np.repeat(np.arange(len(lanes)), rounds), _turns(rounds)
    busy = turn[:, None] < own[warp]
    return (
        np.where(busy, lanes[warp], -1).reshape(-1),
        np.broadcast_to(turn[:, None], busy.shape).reshape(-1).astype(np.int32),
    )
