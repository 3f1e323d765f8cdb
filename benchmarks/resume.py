"""Training killed at random moments: what is done twice, and whether the model is the uninterrupted one, bit by bit.

A small training runs as a process and is killed (SIGKILL) up to 0.3 seconds after it has written some file, both
drawn evenly from what is left to do, again and again until it comes through; then the next folder begins. So kills
fall as often into the work on a busy machine as on a free one. A frame of the bake or a part that was whole on disk and
is written again counts as done twice.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from benchmarks.suites import Measurement, Options
from fitting.cli import NUMBERS_FILE
from fitting.model import MODEL_FILE

ROOT = pathlib.Path(__file__).resolve().parents[1]
FRAMES, PARTS = "bake.zarr/visibility/c/**/0", "unfinished/*/*.part"
TRAIN = (
    "train", "--num-vertices", "800", "--bake.max-points", "60", "--bake.num-directions", "256",
    "--fit.num-components", "6",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A training, how often it is killed, and whether it runs to its end or to the model, before the pictures."""

    options: tuple[str, ...]
    kills: int = 50
    to_model: bool = False

    @property
    def last_file(self) -> str:
        return MODEL_FILE if self.to_model else NUMBERS_FILE


FEW_FRAMES = ("--bake.max-frames", "24", "--bake.num-mixed", "8", "--fit.refine-steps", "6")
CASES: Mapping[str, Case] = MappingProxyType(
    {
        "fit": Case((*FEW_FRAMES, "--no-study"), to_model=True),
        "whole": Case(FEW_FRAMES),
    }
)


def run(options: Options) -> Iterator[Measurement]:
    """One row for each folder, and one for all."""
    for name, case in CASES.items():
        if not options.wants(name) or (options.quick and not case.to_model):
            continue
        kills = 2 if options.quick else case.kills
        with tempfile.TemporaryDirectory() as place:
            yield from _measure(name, case, kills, pathlib.Path(place), options.seed)


def _measure(name: str, case: Case, kills: int, place: pathlib.Path, seed: int) -> Iterator[Measurement]:
    rng, params = np.random.default_rng(seed), {"seed": seed}
    _train(place / "whole", case, None)
    num_files = len(_files(place / "whole"))
    expected = (place / "whole" / MODEL_FILE).read_bytes()
    rows: list[dict[str, float]] = []
    while sum(row["kills"] for row in rows) < kills:
        folder, left = place / str(len(rows)), kills - sum(row["kills"] for row in rows)
        row = _one_folder(folder, case, num_files, left, rng)
        rows.append({**row, "bytes_equal": float((folder / MODEL_FILE).read_bytes() == expected)})
        yield Measurement(name, f"folder {len(rows)}", rows[-1], params)
    total = {key: sum(row[key] for row in rows) for key in rows[0]}
    total |= {"folders": len(rows), "folders_equal": total.pop("bytes_equal"), "files": num_files}
    yield Measurement(name, "all", total, params)


def _one_folder(
    folder: pathlib.Path, case: Case, num_files: int, max_kills: float, rng: np.random.Generator
) -> dict[str, float]:
    """Runs until the training has come through; what happened on the way."""
    kills, twice = 0, {FRAMES: 0, PARTS: 0}
    before: dict[str, dict[pathlib.Path, int]] = {FRAMES: {}, PARTS: {}}
    started = time.perf_counter()
    while True:
        after = int(rng.integers(len(_files(folder)), num_files + 1)), rng.uniform(0.0, 0.3)
        done = _train(folder, case, after if kills < max_kills else None)
        for pattern, written in before.items():
            now = _written(folder, pattern)
            twice[pattern] += sum(path in now and now[path] != when for path, when in written.items())
            before[pattern] = now
        if done:
            break
        kills += 1
    return {
        "kills": kills,
        "frames_twice": twice[FRAMES],
        "parts_twice": twice[PARTS],
        "seconds": time.perf_counter() - started,
    }


def _train(folder: pathlib.Path, case: Case, after: tuple[int, float] | None) -> bool:
    """Whether the training came as far as it should; if not, it was killed `after` some files and seconds."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder.parent / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "fitting", *TRAIN, *case.options, "-o", str(folder)]
    num_files, seconds = after or (0, 0.0)
    deadline = float("inf")
    with tempfile.TemporaryFile("w+") as err:
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=err)
        try:
            while process.poll() is None and time.perf_counter() < deadline and not (folder / case.last_file).is_file():
                if after and deadline == float("inf") and len(_files(folder)) >= num_files:
                    deadline = time.perf_counter() + seconds
                time.sleep(0.002)
            status = process.poll()
        finally:
            process.kill()
            process.wait()
        if status not in (None, 0):
            err.seek(0)
            raise RuntimeError(f"the training failed: {err.read().strip().splitlines()[-1]}")
    return (folder / case.last_file).is_file()


def _files(folder: pathlib.Path) -> list[pathlib.Path]:
    return [path for pattern in (FRAMES, PARTS) for path in folder.glob(pattern)]


def _written(folder: pathlib.Path, pattern: str) -> dict[pathlib.Path, int]:
    """Whole files and when they were written."""
    return {path: path.stat().st_mtime_ns for path in folder.glob(pattern) if not path.name.startswith(".")}
