"""How a long job reports itself: a hook around its loops, and the seconds of each stage."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxrender.io.atomic import write_bytes

#: Beside the model, which holds nothing that depends on the clock.
TIMES_FILE = "times.json"

#: (items, how many there are in all, label, how many of them an earlier run has done) -> the items
Track = Callable[[Iterator, int, str, int], Iterator]


def no_tracking(items: Iterator, _count: int, _label: str, _done: int) -> Iterator:
    return items


@dataclass
class Timings:
    """Seconds per stage, in the order they ran, and the rays of the bake; of the last run, if it continued another."""

    seconds: dict[str, float] = field(default_factory=dict)
    rays: int = 0

    def stage(self, name: str) -> "_Stage":
        return _Stage(self, name)


class _Stage:
    def __init__(self, timings: Timings, name: str):
        self.timings, self.name = timings, name

    def __enter__(self) -> None:
        self.started = time.perf_counter()

    def __exit__(self, *_) -> None:
        self.timings.seconds[self.name] = time.perf_counter() - self.started


def write_times(folder: Path, timings: Timings) -> Path:
    """Writes the times into a folder; the file."""
    write_bytes(folder / TIMES_FILE, json.dumps(vars(timings), indent=1).encode())
    return folder / TIMES_FILE


def read_times(folder: Path) -> Timings:
    """The times of a folder; none at all if they are not there or cannot be read."""
    try:
        stored: Any = json.loads((folder / TIMES_FILE).read_bytes())
        return Timings({str(name): float(value) for name, value in stored["seconds"].items()}, int(stored["rays"]))
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return Timings()
