"""The one rule of precision of this package: work in float64, answer in the dtype of the inputs."""

import contextvars
import functools
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch

Kernel = TypeVar("Kernel", bound=Callable)

# How many kernels are at work around this one: a table made for another kernel must stay in float64.
_depth = contextvars.ContextVar("_depth", default=0)


def in_float64(kernel: Kernel) -> Kernel:
    """Lets a kernel see its floating tensors as float64, and rounds its result once, at the end."""

    @functools.wraps(kernel)
    def rounded(*args, **kwargs):
        given = [t for x in (*args, *kwargs.values()) for t in _tensors(x)]
        came = [t.real.dtype if t.is_complex() else t.dtype for t in given if t.is_floating_point() or t.is_complex()]
        if came:
            dtype = functools.reduce(torch.promote_types, came)
        else:
            dtype = torch.float64 if _depth.get() else torch.get_default_dtype()
        token = _depth.set(_depth.get() + 1)
        try:
            wide = {name: _cast(x, torch.float64) for name, x in kwargs.items()}
            return _cast(kernel(*(_cast(x, torch.float64) for x in args), **wide), dtype)
        finally:
            _depth.reset(token)

    return rounded  # type: ignore[return-value]


def _tensors(value: Any) -> list[torch.Tensor]:
    if is_dataclass(value) and not isinstance(value, type):
        return [t for f in fields(value) for t in _tensors(getattr(value, f.name))]
    if isinstance(value, (tuple, dict)):
        return [t for x in (value.values() if isinstance(value, dict) else value) for t in _tensors(x)]
    return [value] if isinstance(value, torch.Tensor) else []


def _cast(value: Any, dtype: torch.dtype) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: _cast(getattr(value, f.name), dtype) for f in fields(value)})
    if isinstance(value, tuple):
        items = (_cast(x, dtype) for x in value)
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    if isinstance(value, dict):
        return {name: _cast(x, dtype) for name, x in value.items()}
    if isinstance(value, torch.Tensor) and value.is_complex():
        return value.to(dtype.to_complex())
    if isinstance(value, torch.Tensor) and value.is_floating_point():
        return value.to(dtype)
    return value
