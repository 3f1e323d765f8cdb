"""How a long job reports itself: a hook around its loops, and the seconds of each stage."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

Track = Callable[[Iterator, int, str], Iterator]


def no_tracking(items: Iterator, _count: int, _label: str) -> Iterator:
    return items


@dataclass
class Timings:
    """Seconds per stage, in the order they ran."""

    seconds: dict[str, float] = field(default_factory=dict)

    def stage(self, name: str) -> "_Stage":
        return _Stage(self, name)


class _Stage:
    def __init__(self, timings: Timings, name: str):
        self.timings, self.name = timings, name

    def __enter__(self) -> None:
        self.started = time.perf_counter()

    def __exit__(self, *_) -> None:
        self.timings.seconds[self.name] = time.perf_counter() - self.started
