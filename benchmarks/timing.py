"""Times and memory: the first call apart, then the median and the spread; the device is waited for.

The spread is given as quartiles, since times on a shared machine have a long tail to one side.
"""

import contextlib
import pathlib
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import jax

from jaxrender import checks


@dataclass(frozen=True)
class Timing:
    """Milliseconds per call.

    `compile_ms` is what the first call took beyond the median: tracing and compilation, and for other
    libraries whatever they prepare.
    """

    compile_ms: float
    ms_median: float
    ms_q1: float
    ms_q3: float
    num_runs: int

    def metrics(self) -> dict[str, float]:
        """The numbers under the names of a benchmark record."""
        return {
            "compile_ms": self.compile_ms,
            "ms_median": self.ms_median,
            "ms_q1": self.ms_q1,
            "ms_q3": self.ms_q3,
        }


def measure(
    function: Callable[..., object], *args, min_runs: int = 5, min_seconds: float = 1.0, max_runs: int = 1000
) -> Timing:
    """Times `function(*args)`; see `measure_alternating`."""
    variants = {"": lambda: function(*args)}
    return measure_alternating(variants, min_runs=min_runs, min_seconds=min_seconds, max_runs=max_runs)[""]


def measure_alternating(
    variants: Mapping[str, Callable[[], object]],
    *,
    min_runs: int = 5,
    min_seconds: float = 1.0,
    max_runs: int = 1000,
) -> dict[str, Timing]:
    """Times several ways to do one thing, each once a round, so that a busy machine slows all alike.

    Rounds go on until `min_runs` rounds and `min_seconds` per variant have passed, or `max_runs` rounds.

    Raises:
      ValueError: if there is no variant or min_runs is below 1.
    """
    if not variants:
        raise ValueError("variants: expected at least one, got none")
    checks.check_at_least("min_runs", min_runs, 1)
    first = {name: _seconds(function) for name, function in variants.items()}
    times: dict[str, list[float]] = {name: [] for name in variants}
    for round_ in range(max(min_runs, max_runs)):
        if round_ >= min_runs and min(map(sum, times.values())) >= min_seconds:
            break
        for name, function in variants.items():
            times[name].append(_seconds(function))
    return {name: _summarize(first[name], values) for name, values in times.items()}


def _seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def _summarize(first: float, seconds: list[float]) -> Timing:
    median = statistics.median(seconds)
    q1, q3 = (
        (seconds[0], seconds[0]) if len(seconds) == 1 else statistics.quantiles(seconds, n=4, method="inclusive")[::2]
    )
    return Timing(
        compile_ms=1e3 * max(0.0, first - median),
        ms_median=1e3 * median,
        ms_q1=1e3 * q1,
        ms_q3=1e3 * q3,
        num_runs=len(seconds),
    )


@dataclass
class Peak:
    """The largest amount of memory that was in use during a block beyond what was in use at its start."""

    peak_bytes: int = 0


@contextlib.contextmanager
def peak_memory() -> Iterator[Peak]:
    """Measures the peak memory of a block: on the device if JAX can tell, otherwise of this process.

    Pages that the process had freed but not given back count as in use at the start, so measure a stage
    first thing, or in a fresh process, when its size matters. Where the system cannot restart its counter
    (anything but Linux), a block that stays below an earlier peak shows 0.
    """
    peak = Peak()
    device = jax.devices()[0]
    if device.memory_stats() is not None:
        start = device.memory_stats()["bytes_in_use"]
        yield peak
        # The device's counter is never restarted: this is an upper bound if an earlier block used more.
        peak.peak_bytes = max(0, device.memory_stats()["peak_bytes_in_use"] - start)
        return
    with contextlib.suppress(OSError):
        pathlib.Path("/proc/self/clear_refs").write_text("5")  # restarts the high-water mark
    start = _status_bytes("VmRSS") or _lifetime_peak_bytes()
    yield peak
    peak.peak_bytes = max(0, (_status_bytes("VmHWM") or _lifetime_peak_bytes()) - start)


def _status_bytes(key: str) -> int | None:
    with contextlib.suppress(OSError):
        for line in pathlib.Path("/proc/self/status").read_text().splitlines():
            if line.startswith(key + ":"):
                return 1024 * int(line.split()[1])
    return None


def _lifetime_peak_bytes() -> int:
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size if sys.platform == "darwin" else 1024 * size
