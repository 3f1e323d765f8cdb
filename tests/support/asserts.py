"""Comparison of nested results leaf by leaf; a failure names the leaf, the worst index and by how much."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from tests.support import tolerances


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The arrays in records, tuples, lists and dicts as (path, array), in order; None is no leaf."""
    if is_dataclass(value) and not isinstance(value, type):
        for f in fields(value):
            yield from flatten(getattr(value, f.name), f"{path}.{f.name}")
    elif hasattr(value, "_fields"):
        for name in value._fields:
            yield from flatten(getattr(value, name), f"{path}.{name}")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from flatten(item, f"{path}[{key!r}]")
    elif isinstance(value, (tuple, list)) and not all(np.isscalar(x) for x in value):
        for i, item in enumerate(value):
            yield from flatten(item, f"{path}[{i}]")
    elif value is not None:
        yield path or "result", value


def leaves(value: Any) -> list[tuple[str, np.ndarray]]:
    """The same as NumPy arrays, from JAX, torch or numbers."""
    return [(name, np.asarray(x.detach().cpu() if hasattr(x, "detach") else x)) for name, x in flatten(value)]


def assert_close(
    actual: Any,
    expected: Any,
    *,
    ulps: float,
    dtype: Any = np.float64,
    entrywise: bool = False,
    what: str = "",
) -> None:
    """Holds every leaf of `actual` to its partner in `expected` within `ulps` units of rounding of `dtype`.

    The rule for the scale is that of `tests.support.tolerances`. Leaves of integers must be equal.
    """
    got, wanted = leaves(actual), leaves(expected)
    names = [n for n, _ in got], [n for n, _ in wanted]
    assert names[0] == names[1], f"{what}: leaves {names[0]} against {names[1]}"
    for (name, a), (_, e) in zip(got, wanted, strict=True):
        problem = difference(a, e, ulps=ulps, dtype=dtype, entrywise=entrywise)
        assert problem is None, f"{what} {name}: {problem}"


def difference(
    a: np.ndarray, e: np.ndarray, *, ulps: float, dtype: Any = np.float64, entrywise: bool = False
) -> str | None:
    """What is wrong with `a`, or None: shape, NaN, or the index that exceeds its allowance most."""
    if a.shape != e.shape:
        return f"shape {a.shape}, expected {e.shape}"
    if a.size == 0:
        return None
    if not np.issubdtype(e.dtype, np.inexact):
        wrong = np.argwhere(a != e)
        return None if len(wrong) == 0 else f"{len(wrong)} of {a.size} differ, first at {_index(wrong[0])}"
    wide = np.complex128 if np.iscomplexobj(a) or np.iscomplexobj(e) else np.float64
    a, e = a.astype(wide), e.astype(wide)
    same_infinity = np.isinf(e) & (a == e)
    error = np.where(same_infinity, 0.0, np.abs(a - np.where(same_infinity, 0.0, e)))
    excess = error / tolerances.allowed(
        np.where(np.isfinite(e), e, 0.0), ulps=ulps, dtype=np.dtype(dtype), entrywise=entrywise
    )
    excess = np.where(np.isnan(excess), np.inf, excess)
    worst = np.unravel_index(np.argmax(excess), excess.shape)
    if excess[worst] <= 1.0:
        return None
    return (
        f"worst at {_index(worst)}: got {a[worst]:.17g}, expected {e[worst]:.17g}, off by {error[worst]:.3g}"
        f" = {excess[worst]:.3g} times the {ulps:g} ulps of {np.dtype(dtype).name} allowed; "
        f"{(excess > 1.0).sum()} of {a.size} entries exceed it"
    )


def _index(index) -> tuple[int, ...]:
    return tuple(int(i) for i in index)
