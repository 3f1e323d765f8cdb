"""Who traces rays: Embree on the CPU, or the tree in JAX on whatever device JAX uses."""

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, TypeVar

import jax

from jaxrender.checks import check_one_of
from jaxrender.machine import num_cores, on_all_cores

#: What may be asked for.
RayBackend = Literal["auto", "embree", "jax"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def chosen_backend(rays: RayBackend) -> Literal["embree", "jax"]:
    """ "auto" is Embree where JAX runs on the CPU, and the tree elsewhere: data then stay on the device.

    Raises:
      ValueError: for another name.
    """
    check_one_of("rays", rays, ("auto", "embree", "jax"))
    if rays != "auto":
        return rays
    return "embree" if jax.default_backend() == "cpu" else "jax"


def told_backend(backend: Literal["embree", "jax"]) -> str:
    """For people."""
    return f"Embree, {num_cores()} threads" if backend == "embree" else f"tree in JAX, {jax.default_backend()}"


def on_the_device(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Gives function(item) in order: of as many items at once as a CPU has cores; a GPU is filled by one."""
    return on_all_cores(function, items) if jax.default_backend() == "cpu" else map(function, items)
