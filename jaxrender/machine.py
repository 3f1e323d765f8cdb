"""The machine a command runs on: processor, cores, and the folder where compiled programs are kept."""

import contextlib
import hashlib
import importlib.metadata
import os
import pathlib
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

# Limit and use of memory of a control group, version 2 and 1, as a container sees them.
_GROUP_FILES = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)

Item = TypeVar("Item")
Result = TypeVar("Result")


def num_cores() -> int:
    """The cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int | None:
    """Bytes that can still be had, within the limit of this process's control group; None where nobody tells."""
    found = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in pathlib.Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                found.append(1024 * int(line.split()[1]))
    for limit, used in _GROUP_FILES:
        # "max" where there is no limit.
        with contextlib.suppress(OSError, ValueError):
            most = int(pathlib.Path(limit).read_text())
            found.append(max(most - int(pathlib.Path(used).read_text()), 0))
    return min(found, default=None)


def check_memory(what: str, needed: int) -> None:
    """Raises MemoryError, with how much is there, unless so many bytes can be had for `what`."""
    free = available_memory()
    if free is not None and needed > free:
        raise MemoryError(f"{what}: about {needed / 1e9:.1f} GB needed, {free / 1e9:.1f} GB available")


def keep_xla_to_one_thread() -> None:
    """Lets XLA's CPU programs run on their calling thread; call it before JAX makes its first array.

    XLA's own pool of threads can lose a task and wait for ever on a batched program (seen with jaxlib 0.10.2 on two
    cores, within minutes of training; also reported by others in 2026). The commands and the training therefore
    switch the pool off and spread their blocks of work over threads of their own. A setting of the user's stays.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_cpu_multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()


def avoid_wrong_sums() -> None:
    """Switches off a fusion of XLA's CPU compiler that computes wrong numbers; to be called before the first array.

    jaxlib 0.10 compiles a sum over the last axis of a product with a broadcast factor, fused with other terms, to
    something else (seen with 0.10.2: `max(dot(a, b), 0) + dot(b, b)` for shapes (1, h, w, 3) and (9, h, w, 3)). A
    setting of the user's stays. Other versions may not know the option, and stop at options they do not know.
    """
    option = "xla_cpu_experimental_ynn_fusion_type"
    flags = os.environ.get("XLA_FLAGS", "")
    if importlib.metadata.version("jaxlib").startswith("0.10.") and option not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{option}=".strip()


def on_all_cores(
    function: Callable[[Item], Result], items: Sequence[Item], *, compiled: bool = False
) -> Iterator[Result]:
    """Gives function(item) of all items, in their order, as many at once as there are cores.

    The first one runs alone: what it compiles is there for the others, and no two threads compile at once. Not if all
    is `compiled` already.
    """
    alone = 0 if compiled else 1
    yield from map(function, items[:alone])
    with ThreadPoolExecutor(num_cores()) as threads:
        yield from threads.map(function, items[alone:])


def cpu_model() -> str:
    """The processor's name, as far as the system tells."""
    return _cpu_info("model name") or platform.processor() or platform.machine()


def cache_path() -> pathlib.Path:
    """Where compiled programs are kept: JAX_COMPILATION_CACHE_DIR, or a folder in the user's cache.

    One folder per kind of processor: home folders are shared between machines, and a program compiled for
    the instructions of one may not run on another.
    """
    chosen = getattr(jax.config, "jax_compilation_cache_dir", None)
    if chosen:
        return pathlib.Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    kind = f"{platform.machine()} {cpu_model()} {_cpu_info('flags')}"
    return pathlib.Path(base, "jaxrender", f"xla-{hashlib.sha256(kind.encode()).hexdigest()[:12]}")


def is_writable_folder(path: pathlib.Path) -> bool:
    """Whether files can be made in `path`, which is made first if it is missing."""
    probe = path / f".probe-{os.getpid()}"
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError:
        return False
    return True


def _cpu_info(key: str) -> str:
    """The first value of `key` in Linux's list of processors; empty elsewhere."""
    with contextlib.suppress(OSError):
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == key:
                return value.strip()
    return ""
