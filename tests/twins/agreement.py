"""The checks that every case goes through; the test files of this folder apply them room by room."""

import functools
from typing import Any

import numpy as np
import pytest

from tests.support.asserts import assert_close, leaves
from tests.support.cases import CASES, Case
from tests.twins import both

DTYPES = [np.float64, np.float32]


def cases_of(*rooms: str) -> list:
    """Parameters (case, dtype) for the kernels whose name starts with one of `rooms`."""
    return [
        pytest.param(case, dtype, id=f"{case.id}-{np.dtype(dtype).name}")
        for case in CASES
        if case.kernel.startswith(rooms)
        for dtype in (DTYPES[:1] if case.host else DTYPES)
    ]


def check(case: Case, dtype: Any) -> None:
    """jaxrender's results and derivatives against the twin's: leaves, shapes, dtypes, values."""
    if case.host:
        (ours, theirs), slopes = both.run_host(case), ({}, {})
    else:
        (ours, our_slopes), (theirs, their_slopes) = both.run_jax(case, dtype), both.run_torch(case, dtype)
        slopes = our_slopes, their_slopes
    for (name, a), (_, b) in zip(leaves(ours), leaves(theirs), strict=True):
        same = a.dtype == b.dtype or (a.dtype.kind == b.dtype.kind == "i")  # x64 widens counts in JAX alone
        assert same, f"{case.id} {name}: {a.dtype} against the twin's {b.dtype}"
    wide = dtype == np.float64
    assert_close(
        ours,
        theirs,
        ulps=case.ulps64 if wide else case.ulps32,
        dtype=dtype,
        entrywise=case.entrywise,
        what=case.id,
    )
    assert_close(*slopes, ulps=case.gradient_ulps, dtype=dtype, what=f"{case.id} gradient")


@functools.cache
def kernels_with_a_case() -> frozenset[str]:
    return frozenset(case.kernel for case in CASES)
