"""Every way to order the work evaluates the same samples, once each; idle lanes against the costs of warps."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxrender.deferred.metrics import tile_maximum
from jaxrender.deferred.strategies import STRATEGIES, TILE_PIXELS, WARP_SIZE, work_order
from jaxrender.deferred.warps import screen_lanes, warp_cost

counts = hnp.arrays(np.int32, st.integers(0, 100), elements=st.integers(0, 16))


def check_complete(count, strategy: str) -> tuple[np.ndarray, np.ndarray]:
    """Each turn of each pixel is there once, in ascending order; the rest is idle."""
    pixel, turn = work_order(count, strategy=strategy)
    assert pixel.shape == turn.shape and pixel.ndim == 1
    assert pixel.dtype == turn.dtype == np.int32
    busy = pixel >= 0
    assert (pixel[~busy] == -1).all()
    order = np.argsort(pixel[busy], kind="stable")
    expected = [(p, t) for p, k in enumerate(count.tolist()) for t in range(k)]
    assert list(zip(pixel[busy][order].tolist(), turn[busy][order].tolist(), strict=True)) == expected
    return pixel, turn


def idle(count, strategy: str) -> int:
    return int(np.count_nonzero(work_order(count, strategy=strategy)[0] < 0))


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize(
    "count",
    [[], [0], [3], [0] * 40, [16] * 32, [1] * 33, [*[0] * 32, 5], [*range(17), *range(17)], [0, 1, 0, 16]],
    ids=lambda count: f"{len(count)} pixels, {sum(count)} samples",
)
def test_every_sample_is_listed_once(strategy, count):
    pixel, _ = check_complete(np.array(count, np.int32), strategy)
    assert sum(count) or not len(pixel), "nothing to do takes no lane"


@pytest.mark.parametrize("strategy", STRATEGIES)
@settings(max_examples=100, deadline=None, derandomize=True)
@given(count=counts)
def test_every_sample_of_random_counts_is_listed_once(strategy, count):
    check_complete(count, strategy)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(count=counts)
def test_loops_run_in_warps(count):
    """The lanes of a warp take the same turn. One warp is done before the next one starts."""
    for strategy in STRATEGIES[2:]:
        pixel, turn = (v.reshape(-1, WARP_SIZE) for v in work_order(count, strategy=strategy))
        assert (turn == turn[:, :1]).all()
        assert (pixel >= 0).any(axis=1).all(), "no turn without work"
        first, again = turn[:, 0] == 0, turn[:, 0] > 0
        assert first[:1].all() and (turn[1:, 0][again[1:]] == turn[:-1, 0][again[1:]] + 1).all()
        # Who is busy in a turn was so in the one before, in the same lane.
        kept = pixel[1:][again[1:]]
        assert ((kept == pixel[:-1][again[1:]]) | (kept < 0)).all()


@settings(max_examples=100, deadline=None, derandomize=True)
@given(count=counts)
def test_what_idles(count):
    """Compaction idles nowhere. A loop of 32 lanes idles until the largest of its 32 counts is done."""
    total, whole = int(count.sum()), np.pad(count, (0, -len(count) % WARP_SIZE))
    rounds = lambda values: WARP_SIZE * int(values.reshape(-1, WARP_SIZE).max(axis=1, initial=0).sum())  # noqa: E731
    assert idle(count, "compacted") == 0
    assert idle(count, "masked") == idle(count, "low_resolution") == rounds(whole) - total
    assert idle(count, "sorted") == rounds(np.sort(whole)[::-1].copy()) - total <= idle(count, "masked")
    tiles = np.pad(count, (0, -len(count) % TILE_PIXELS)).reshape(-1, TILE_PIXELS).sum(axis=1)
    assert idle(count, "tiled") == (-tiles % WARP_SIZE).sum()
    passes = [(k, int((count == k).sum())) for k in range(1, 17)]
    assert idle(count, "per_count") == sum(k * (-pixels % WARP_SIZE) for k, pixels in passes)


def test_tiles_begin_with_a_warp_of_their_own(rng):
    count = rng.integers(0, 5, 3 * TILE_PIXELS + 7).astype(np.int32)
    pixel, _ = check_complete(count, "tiled")
    tile = pixel.reshape(-1, WARP_SIZE) // TILE_PIXELS
    busy = pixel.reshape(-1, WARP_SIZE) >= 0
    assert all(len(np.unique(own[some])) == 1 for own, some in zip(tile, busy, strict=True))


@pytest.mark.parametrize("order", ["rows", "blocks"])
@pytest.mark.parametrize("shape", [(4, 8), (8, 16), (12, 48)])
def test_masked_loops_idle_as_warps_do(shape, order, rng):
    """Pixels in the order of the lanes of a full-screen pass: paid but not useful turns are the idle lanes."""
    count = rng.integers(0, 17, shape).astype(np.int32)
    count[: shape[0] // 2] //= 8
    lanes = np.asarray(screen_lanes(count, order=order))
    cost = warp_cost(count, order=order)
    assert idle(lanes.reshape(-1), "masked") == int(cost.paid.sum()) - int(cost.useful.sum())
    assert int(cost.useful.sum()) == count.sum()


def test_counts_of_low_resolution_idle_less(rng):
    """One count to a tile as large as a warp's block: no lane waits, but more is shaded."""
    count = rng.integers(1, 17, (16, 16)).astype(np.int32)
    coarse = np.asarray(tile_maximum(count, tile=8))
    by_warp = lambda values: np.asarray(screen_lanes(values, order="blocks")).reshape(-1)  # noqa: E731
    assert idle(by_warp(coarse), "low_resolution") == 0 < idle(by_warp(count), "masked")
    assert coarse.sum() > count.sum()


def test_sorting_keeps_the_order_of_equal_counts():
    count = np.array([2, 0, 1, 2, 1, 2], np.int32)
    pixel, _ = work_order(count, strategy="sorted")
    assert pixel[:6].tolist() == [0, 3, 5, 2, 4, -1]
    pixel, turn = work_order(count, strategy="compacted")
    assert pixel.tolist() == [0, 0, 2, 3, 3, 4, 5, 5] and turn.tolist() == [0, 1, 0, 0, 1, 0, 0, 1]
    pixel, _ = work_order(count, strategy="per_count")
    assert pixel[pixel >= 0].tolist() == [2, 4, 0, 3, 5, 0, 3, 5]


def test_an_unknown_strategy_is_refused():
    with pytest.raises(
        ValueError, match="strategy: expected one of compacted, tiled, masked, per_count, sorted, low_res"
    ):
        work_order(np.ones(3, np.int32), strategy="random")
