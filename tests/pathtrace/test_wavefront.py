"""Rays that count down: the loop alone, without any geometry."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace.wavefront import Plan, State, in_blocks, padded_count, plan_for_backend, run_wavefront


@functools.partial(jax.jit, static_argnums=1)
def count_down(numbers, plan):
    """Steps that each ray took until its number was 0, and the sum of what it met; the stack counts too."""

    def step(state):
        left, steps = state.each
        going = (left > 0).astype(jnp.int32)
        return State((left - going, steps + going), state.stack + going[None])

    zeros = jnp.zeros_like(numbers)
    state = State((numbers, zeros), jnp.stack([zeros, zeros]))
    return run_wavefront(step, lambda s: s.each[0] > 0, lambda s: (s.each[1], s.stack[1]), state, plan)


@pytest.mark.parametrize("plan", [Plan(64, 4, 4), Plan(64, 2, 1), Plan(64, 3, 100)])
@pytest.mark.parametrize("kind", ["few", "all", "none", "different", "one"])
def test_each_ray_takes_its_own_number_of_steps(rng, plan, kind):
    numbers = {
        "few": np.where(rng.uniform(size=64) < 0.1, 30, 0),
        "all": np.full(64, 5),
        "none": np.zeros(64),
        "different": rng.permutation(64),
        "one": np.arange(64) == 63,
    }[kind].astype(np.int32)
    steps, stack = count_down(numbers, plan)
    np.testing.assert_array_equal(steps, numbers)
    np.testing.assert_array_equal(stack, numbers)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 25])
def test_blocks_cover_all_rays(count):
    calls = []

    def trace(x, y):
        calls.append(x.shape)
        return {"sum": x[:, 0] + y}

    x, y = jnp.arange(2.0 * count).reshape(count, 2), jnp.ones(count)
    np.testing.assert_array_equal(in_blocks(trace, (x, y), Plan(8, 2, 2))["sum"], 2.0 * np.arange(count) + 1)
    assert all(shape[0] <= 8 for shape in calls)


def test_batches_come_in_few_sizes():
    block, _, smallest = plan_for_backend()
    counts = [*range(3000), *range(3000, 40 * block, 997)]
    sizes = [padded_count(n) for n in counts]
    assert len(set(sizes)) <= 12
    assert all(size >= n and size >= smallest for size, n in zip(sizes, counts, strict=True))
    assert all(size <= max(smallest, 4 * n) for size, n in zip(sizes, counts, strict=True))
