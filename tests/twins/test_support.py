"""The comparison behind these tests fails when it should, and says where."""

from dataclasses import dataclass

import numpy as np
import pytest

from tests.support.asserts import assert_close


@dataclass
class Pair:
    first: np.ndarray
    second: tuple


def pair(change: float = 0.0) -> Pair:
    second = np.arange(6.0).reshape(2, 3)
    second[1, 2] += change
    return Pair(np.zeros(2), (second, np.array([1, 2])))


def test_equal_results_pass():
    assert_close(pair(), pair(), ulps=0)


def test_a_difference_is_named_with_leaf_and_worst_index():
    with pytest.raises(AssertionError, match=r"kernel \.second\[0\]: worst at \(1, 2\): got 5\.25.* expected 5,"):
        assert_close(pair(0.25), pair(), ulps=64, what="kernel")


def test_the_scale_is_the_leaf_or_the_entry():
    expected = np.array([1.0, 1e-8])
    actual = expected + np.array([0.0, 1e-12])
    assert_close(actual, expected, ulps=8192)
    with pytest.raises(AssertionError, match=r"worst at \(1,\)"):
        assert_close(actual, expected, ulps=8192, entrywise=True)


@pytest.mark.parametrize(
    ("actual", "expected", "message"),
    [
        (np.zeros(3), np.zeros((3, 1)), r"shape \(3,\), expected \(3, 1\)"),
        (np.array([1.0, np.nan]), np.ones(2), r"worst at \(1,\)"),
        (np.array([np.inf]), np.ones(1), r"worst at \(0,\)"),
        (np.ones(1), np.array([np.inf]), r"worst at \(0,\)"),
        (np.array([1, 3]), np.array([1, 2]), r"1 of 2 differ, first at \(1,\)"),
        ({"a": np.ones(1)}, {"b": np.ones(1)}, r"leaves"),
    ],
)
def test_what_must_not_pass(actual, expected, message):
    with pytest.raises(AssertionError, match=message):
        assert_close(actual, expected, ulps=1e6)
