"""Checks of arguments and of data from outside, with one form of message.

A message names the argument (or the file and the field), the rule, and what came.
"""

import math
from collections.abc import Sequence
from typing import NoReturn

import numpy as np


class InputError(ValueError):
    """Bad data from outside: a file, a command line, an array a user handed in.

    The commands print its text as their one line of error and end with status 2.
    """


def bad_input(where: object, field: str, *, expected: object, got: object) -> NoReturn:
    """Raises the one message of this project about bad data: place, field, rule, and what came."""
    raise InputError(f"{where}: {field}: expected {expected}, got {got}")


def check_last_axis(name: str, array, size: int) -> None:
    """Raises ValueError unless `array` has last axis `size`."""
    if array.ndim < 1 or array.shape[-1] != size:
        raise ValueError(f"{name}: expected shape (..., {size}), got {tuple(array.shape)}")


def check_same_shape(names: str, a, b) -> None:
    """Raises ValueError unless `a` and `b` have one shape; `names` names them both ("image and guide")."""
    if a.shape != b.shape:
        raise ValueError(f"{names}: expected one shape, got {tuple(a.shape)} and {tuple(b.shape)}")


def check_at_least(name: str, value: int | float, smallest: int | float) -> None:
    """Raises ValueError unless `value` is finite and >= `smallest`."""
    if not smallest <= value < math.inf:
        raise ValueError(f"{name}: expected a value >= {smallest}, got {value}")


def check_whole(name: str, value: object, smallest: int) -> None:
    """Raises ValueError unless `value` is an integer >= `smallest`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise ValueError(f"{name}: expected a whole number >= {smallest}, got {value}")
    check_at_least(name, int(value), smallest)


def check_above_0(name: str, value: object) -> None:
    """Raises ValueError unless `value` is finite and above 0, if it is a number or an array of NumPy's.

    An array of JAX may be one of a program that is being traced, or of one that is still running.
    """
    if not isinstance(value, int | float | list | tuple | np.ndarray | np.generic):
        return
    wrong = np.asarray(value)[~((np.asarray(value) > 0.0) & np.isfinite(value))]
    if wrong.size:
        raise ValueError(f"{name}: expected finite numbers above 0, got {wrong.flat[0]}")


def check_one_of(name: str, value: object, allowed: Sequence[object]) -> None:
    """Raises ValueError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise ValueError(f"{name}: expected one of {', '.join(map(str, allowed))}, got {value}")


def check_order(order: int, coefficients: int | None = None) -> None:
    """Raises ValueError unless `order` is a positive number of SH bands that fits the coefficient count."""
    check_at_least("order", order, 1)
    if coefficients is not None and coefficients != order**2:
        raise ValueError(f"sh: expected {order**2} coefficients for order {order}, got {coefficients}")


def check_finite(where: object, field: str, array) -> None:
    """Raises InputError if a NaN or an infinity is in `array`; says how many and where the first one is."""
    finite = np.isfinite(array)
    if not finite.all():
        first = tuple(int(i) for i in np.argwhere(~finite)[0])
        bad_input(where, field, expected="finite numbers", got=f"{(~finite).sum()} NaN or Inf, first at {first}")
