"""Packing, lockstep and shared tiles against small examples counted by hand, and plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred import warps


def ints(values):
    return jnp.asarray(values, jnp.int32)


def test_ten_quads_fill_a_warp_and_a_quarter():
    """Eight quads to a warp: six of triangle 0 in full, two of 1 with a pixel each; then a quad of 1 and one of 2."""
    packed = warps.pack_quads(ints([0] * 6 + [1] * 3 + [2]), ints([15] * 6 + [1, 8, 3, 7]))
    assert packed.quads.tolist() == [8, 2]
    assert packed.pixels.tolist() == [26, 5]
    assert packed.triangles.tolist() == [2, 2]
    np.testing.assert_allclose(packed.utilisation, [26 / 32, 5 / 32])
    wide = warps.pack_quads(ints([0] * 6 + [1] * 3 + [2]), ints([15] * 6 + [1, 8, 3, 7]), warp_size=64)
    assert (wide.quads.tolist(), wide.pixels.tolist(), wide.triangles.tolist()) == ([10], [31], [3])


def test_sixteen_triangles_at_most_in_a_wavefront():
    """Pipeline part 8: 64 lanes of quads reference up to 16 triangles; pixel-sized ones use a quarter of the lanes."""
    packed = warps.pack_quads(ints(np.arange(48)), ints(np.full(48, 4)), warp_size=64)
    assert packed.triangles.tolist() == [16, 16, 16]
    assert packed.utilisation.tolist() == [0.25, 0.25, 0.25]


def test_packing_agrees_with_a_loop(rng):
    ids, masks = np.sort(rng.integers(0, 40, 203)), rng.integers(1, 16, 203)
    packed = jax.jit(warps.pack_quads, static_argnames="warp_size")(ints(ids), ints(masks), warp_size=32)
    for n in range(26):
        own = slice(8 * n, 8 * n + 8)
        assert int(packed.quads[n]) == len(ids[own])
        assert int(packed.pixels[n]) == sum(bin(m).count("1") for m in masks[own])
        assert int(packed.triangles[n]) == len(set(ids[own]))


def test_no_quads_no_warps():
    packed = warps.pack_quads(ints([]), ints([]))
    assert packed.quads.shape == packed.pixels.shape == packed.triangles.shape == (0,)
    assert float(warps.warp_cost(jnp.zeros((0, 4))).efficiency) == 1.0


def test_a_warp_is_a_strip_or_a_block_of_the_screen():
    """Of 16 x 16 px, the first warp is 16 x 2 px by rows and 8 x 4 px by blocks."""
    y, x = np.mgrid[:16, :16]
    number = jnp.asarray(16 * y + x)
    first = {order: np.asarray(warps.screen_lanes(number, order=order))[0] for order in warps.ORDERS}
    assert set(first["rows"].tolist()) == set(number[:2].ravel().tolist())
    assert set(first["blocks"].tolist()) == set(number[:4, :8].ravel().tolist())
    assert first["rows"][:8].tolist() == [0, 1, 16, 17, 2, 3, 18, 19]
    for size in warps.WARP_SIZES:
        for order in warps.ORDERS:
            lanes = np.asarray(warps.screen_lanes(number, warp_size=size, order=order))
            assert sorted(lanes.ravel().tolist()) == list(range(256)), "each pixel in one lane"


@pytest.mark.parametrize("order", warps.ORDERS)
def test_odd_images_leave_lanes_idle(order):
    lanes = np.asarray(warps.screen_lanes(jnp.ones((5, 7)), order=order))
    assert lanes.sum() == 35


def test_one_long_lane_holds_up_its_warp():
    """Two warps of 16 x 2 px: a uniform one of 3 turns, and one with a single pixel of 10 among pixels of 1."""
    trips = np.ones((4, 16), np.int32)
    trips[:2], trips[3, 5] = 3, 10
    cost = warps.warp_cost(jnp.asarray(trips))
    assert cost.useful.tolist() == [96, 41] and cost.paid.tolist() == [96, 320]
    np.testing.assert_allclose(float(cost.efficiency), 137 / 416, rtol=1e-6)


def test_incoherent_loops_cost_the_expected_maximum(rng):
    """Random 0/1 turns: a warp of n pays unless all are 0, and half of its lanes are useful."""
    trips = jnp.asarray(rng.integers(0, 2, (256, 256)), jnp.int32)
    for size in (4, 32):
        cost = warps.warp_cost(trips, warp_size=size)
        paid = size * (1 - 0.5**size)
        # Per warp of 4 the relative spread is √(1/15) over √16384 warps.
        np.testing.assert_allclose(float(cost.paid.mean()), paid, rtol=4 * 0.26 / 128)
    assert float(warps.warp_cost(jnp.ones((256, 256), jnp.int32)).efficiency) == 1.0


def test_both_sides_of_a_branch_are_paid():
    """Three strips: all then, all else, and one pixel of else among then."""
    taken = np.zeros((6, 16), bool)
    taken[:2], taken[4:] = True, True
    taken[5, 3] = False
    cost = warps.branch_cost(jnp.asarray(taken), then_cost=2.0, else_cost=5.0)
    assert cost.paid.tolist() == [64.0, 160.0, 224.0]
    assert cost.useful.tolist() == [64.0, 160.0, 31 * 2.0 + 5.0]


def test_helpers_prolong_a_packed_warp_but_are_not_useful():
    """A quad at (0, 0) with its upper left pixel covered, one at (0, 1) in full; the longest lane is a helper."""
    trips = ints([[1, 9, 2, 2], [4, 4, 2, 2]])
    row, column, mask = ints([0, 0]), ints([0, 1]), ints([1, 15])
    lanes = warps.quad_lanes(trips, row, column, warp_size=8)
    assert lanes.tolist() == [[1, 9, 4, 4, 2, 2, 2, 2]]
    covered = warps.covered_lanes(mask, warp_size=8)
    assert covered.tolist() == [[True, False, False, False, True, True, True, True]]
    cost = warps.loop_cost(lanes, covered)
    assert cost.useful.tolist() == [9] and cost.paid.tolist() == [72]


def test_owners_of_tiles():
    one, two, four = (np.asarray(warps.raster_owners(4, 8, num_rasters=n, tile_size=2))[::2, ::2] for n in (1, 2, 4))
    assert (one == 0).all()
    assert two.tolist() == [[0, 1, 0, 1], [1, 0, 1, 0]]
    assert four.tolist() == [[0, 1, 2, 3], [2, 3, 0, 1]]


def test_balance_of_even_and_of_piled_up_work(rng):
    """An even image is shared evenly; a few hundred tiny triangles in one tile all go to one rasteriser."""
    even = warps.raster_balance(jnp.ones((64, 64)), num_rasters=4)
    assert even.work.tolist() == [1024.0] * 4 and float(even.imbalance) == 1.0
    pile = np.zeros((64, 64), np.float32)
    pile[18:30, 34:46] = 300.0
    for n in (1, 2, 4):
        piled = warps.raster_balance(jnp.asarray(pile), num_rasters=n)
        assert float(piled.imbalance) == n and float(piled.work.max()) == pile.sum()
    assert float(warps.raster_balance(jnp.zeros((8, 8))).imbalance) == 1.0
    work = rng.uniform(size=(37, 53)).astype(np.float32)
    balance = warps.raster_balance(jnp.asarray(work), num_rasters=2, tile_size=5)
    y, x = np.mgrid[:37, :53] // 5
    expected = [work[(x + y) % 2 == r].sum() for r in range(2)]
    np.testing.assert_allclose(balance.work, expected, rtol=1e-5)
    np.testing.assert_allclose(float(balance.imbalance), max(expected) / np.mean(expected), rtol=1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: warps.pack_quads(ints([0]), ints([1]), warp_size=24), "warp_size: expected one of"),
        (lambda: warps.screen_lanes(jnp.ones((2, 2)), order="zigzag"), "order: expected one of"),
        (lambda: warps.raster_balance(jnp.ones((2, 2)), num_rasters=0), "num_rasters: expected a value >= 1"),
        (lambda: warps.loop_cost(jnp.ones((2, 4)), jnp.ones((1, 4), bool)), "trip_counts and covered"),
    ],
)
def test_bad_options(call, message):
    with pytest.raises(ValueError, match=message):
        call()
