"""The suites by name, and what a suite is.

A suite is a module of this package whose docstring says in its first line what it measures, with one
function `run(options)` that yields a `Measurement` as soon as it has one. It uses the public API only,
names its inputs and their seed in `params`, and stores the error of a result beside its time. Losses are
published too.
"""

import fnmatch
import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol, cast

from jaxrender import checks

#: Suite name -> module. Imported when it is asked for, since suites import the libraries they compare with.
SUITES: Mapping[str, str] = MappingProxyType(
    {
        "adaptive": "benchmarks.adaptive",
        "filters": "benchmarks.filters",
        "harmonics": "benchmarks.harmonics",
        "pathtrace": "benchmarks.pathtrace",
        "raster": "benchmarks.raster",
        "resume": "benchmarks.resume",
    }
)


@dataclass(frozen=True)
class Options:
    """What the command line passes on to every suite."""

    cases: tuple[str, ...] = ("*",)
    quick: bool = False
    seed: int = 0

    def wants(self, case: str) -> bool:
        """Whether `case` matches one of the asked patterns; a suite asks before it prepares a case."""
        return any(fnmatch.fnmatchcase(case, pattern) for pattern in self.cases)

    def names(self, case: str) -> bool:
        """`wants` but for the pattern "*": asked for a case that takes too long to run with all the others."""
        return any(fnmatch.fnmatchcase(case, pattern) for pattern in self.cases if pattern != "*")


@dataclass(frozen=True)
class Measurement:
    """One row: what was done (`case`), by what (`variant`), with which settings, and the numbers.

    Metric names, wherever they fit: ms_median, ms_q1, ms_q3, compile_ms, peak_bytes, psnr_db (peak 1), mse,
    mse_255, flip, sample_share, relative_l2, rays_per_second.
    """

    case: str
    variant: str
    metrics: Mapping[str, float]
    params: Mapping[str, str | int | float | bool] = field(default_factory=dict)


class Suite(Protocol):
    """The part of a suite module that the command uses."""

    __doc__: str | None

    def run(self, options: Options) -> Iterator[Measurement]:
        """Yields measurements, one by one."""
        ...


def load_suite(name: str) -> Suite:
    """The module of a suite.

    Raises:
      ValueError: if there is no suite of that name.
    """
    checks.check_one_of("suite", name, tuple(SUITES))
    return cast(Suite, importlib.import_module(SUITES[name]))


def describe_suite(name: str) -> str:
    """The first line of a suite's docstring."""
    return (load_suite(name).__doc__ or "").strip().split("\n")[0]
