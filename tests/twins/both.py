"""Calls a case in both packages: the border between the twins."""

import contextlib
import functools
import importlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

from tests.support.asserts import flatten
from tests.support.cases import Case, Record


def public(package: str, name: str) -> Any:
    """The function or record `name` (module path included) of "jaxrender" or "torchref"."""
    module, _, attribute = f"{package}.{name}".rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def record(value: Record, package: str, dtype: Any) -> Any:
    """A record of a case in one package."""
    make = jnp.asarray if package == "jaxrender" else torch.tensor
    return _build(value, package, lambda x: make(_rounded(x, dtype)))


def run_jax(case: Case, dtype: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """The kernel's result under `jit`, and the derivatives of a fixed random mix of its outputs."""
    with jax.enable_x64(dtype == np.float64):
        arrays, rest = _arguments(case, "jaxrender", lambda x: jnp.asarray(_rounded(x, dtype)))
        function = public("jaxrender", case.kernel)

        def objective(free: dict[str, jax.Array], fixed: dict[str, jax.Array]) -> tuple[jax.Array, Any]:
            result = case.outcome(function(**free, **fixed, **rest))
            outputs = [x for x in _arrays(result) if jnp.issubdtype(x.dtype, jnp.floating)]
            parts = [jnp.sum(x * jnp.asarray(w, x.dtype)) for x, w in zip(outputs, _mix(outputs), strict=True)]
            return sum(parts), result

        free = {name: arrays.pop(name) for name in _differentiated(case, dtype)}
        whole = jax.grad(objective, has_aux=True, allow_int=True) if free else (lambda a, b: ({}, objective(a, b)[1]))
        # Compiling is nearly all of the time here, and twins are about formulas: no need to optimise.
        compiled = jax.jit(whole, compiler_options={"xla_backend_optimization_level": 0})
        slopes, result = jax.block_until_ready(compiled(free, arrays))
        pairs = [pair for name, slope in slopes.items() for pair in flatten(slope, name) if _is_floating(pair[1])]
        return result, {name: _tangential(case, name, np.asarray(g)) for name, g in pairs}


def run_torch(case: Case, dtype: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """The same of the twin."""
    with _default_dtype(dtype):
        arrays, rest = _arguments(case, "torchref", lambda x: torch.tensor(_rounded(x, dtype)))
        pairs = [pair for name in _differentiated(case, dtype) for pair in flatten(arrays[name], name)]
        named = [pair for pair in pairs if _is_floating(pair[1])]
        free = [x.requires_grad_() for _, x in named]
        result = case.outcome(public("torchref", case.kernel)(**arrays, **rest))
        outputs = [x for x in _arrays(result) if x.is_floating_point()]
        parts = [(x * torch.tensor(w, dtype=x.dtype)).sum() for x, w in zip(outputs, _mix(outputs), strict=True)]
        slopes = torch.autograd.grad(sum(parts), free, materialize_grads=True) if free else []
        return result, {name: _tangential(case, name, g.numpy()) for (name, _), g in zip(named, slopes, strict=True)}


def run_host(case: Case) -> tuple[Any, Any]:
    """Both results of a kernel that takes and gives NumPy arrays in jaxrender."""
    arrays, rest = _arguments(case, "torchref", torch.tensor)
    ours = public("jaxrender", case.kernel)(**case.arguments)
    return case.outcome(ours), case.outcome(public("torchref", case.kernel)(**arrays, **rest))


def _differentiated(case: Case, dtype: Any) -> tuple[str, ...]:
    """Names in the order in which JAX hands back a dictionary; none in float32."""
    return tuple(sorted(case.gradients)) if dtype == np.float64 else ()


def _is_floating(leaf: Any) -> bool:
    """Whether a leaf of a record has a derivative: ids, masks and names have none."""
    return str(getattr(leaf, "dtype", "")).removeprefix("torch.").startswith("float")


def _arrays(result: Any) -> list:
    return [x for _, x in flatten(result)]


def _arguments(case: Case, package: str, array: Callable[[np.ndarray], Any]) -> tuple[dict, dict]:
    """The case's arguments that JAX traces, arrays and records that are differentiated, and all its others."""
    built = {name: _build(x, package, array) for name, x in case.arguments.items()}
    traced = {
        name
        for name, x in case.arguments.items()
        if name in case.gradients or (isinstance(x, np.ndarray) and name not in case.known)
    }
    return {n: x for n, x in built.items() if n in traced}, {n: x for n, x in built.items() if n not in traced}


def _build(value: Any, package: str, array: Callable[[np.ndarray], Any]) -> Any:
    if isinstance(value, Record):
        convert = (lambda x: x) if value.host else array
        fields = {name: _build(x, package, convert) for name, x in value.fields.items()}
        return public(package, value.name)(**fields)
    if isinstance(value, tuple):
        return tuple(_build(x, package, array) for x in value)
    if isinstance(value, dict):
        return {name: _build(x, package, array) for name, x in value.items()}
    return array(value) if isinstance(value, np.ndarray) else value


def _rounded(value: np.ndarray, dtype: Any) -> np.ndarray:
    if np.iscomplexobj(value):
        return value.astype(np.result_type(dtype, np.complex64))
    return value.astype(dtype) if np.issubdtype(value.dtype, np.floating) else value


def _mix(outputs: list) -> list[np.ndarray]:
    rng = np.random.default_rng(17)
    return [rng.normal(size=tuple(x.shape)) for x in outputs]


def _tangential(case: Case, name: str, slope: np.ndarray) -> np.ndarray:
    """The part of a derivative along the manifold on which the argument lives."""
    if name not in case.on:
        return slope
    argument, *path = name.split(".")
    at = functools.reduce(lambda record, field: record.fields[field], path, case.arguments[argument])
    at = at.astype(slope.dtype)
    if case.on[name] == "sphere":
        return slope - (slope * at).sum(-1, keepdims=True) * at
    return (slope - at @ slope.swapaxes(-1, -2) @ at) / 2.0


@contextlib.contextmanager
def _default_dtype(dtype: Any) -> Iterator[None]:
    """What x64 is to JAX: the dtype of results that depend on options alone."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64 if dtype == np.float64 else torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
