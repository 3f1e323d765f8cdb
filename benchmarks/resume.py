"""Training killed at random moments: what is done twice, and whether the model is the uninterrupted one, bit by bit.

A small training with its study and pictures runs as a process and is killed (SIGKILL) after a time drawn evenly from
the time of an uninterrupted one, again and again until one comes through; then the next folder begins. A file that
was whole on disk and is written again counts as done twice.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.suites import Measurement, Options
from fitting.model import MODEL_FILE

ROOT = pathlib.Path(__file__).resolve().parents[1]
FRAMES, PARTS = "bake.zarr/visibility/c/**/0", "unfinished/*/*.part"
TRAIN = (
    "train", "--num-vertices", "800", "--bake.max-points", "60", "--bake.max-frames", "24", "--bake.num-mixed", "8",
    "--bake.num-directions", "256", "--fit.num-components", "6", "--fit.refine-steps", "6",
)  # fmt: skip


@dataclass(frozen=True)
class Size:
    """How much of it: kills in all, and further options of the training."""

    kills: int = 50
    options: Sequence[str] = ()


QUICK = Size(kills=2, options=("--no-study", "--fit.num-lobes", "1", "--fit.refine-steps", "2"))


def run(options: Options) -> Iterator[Measurement]:
    """The case "kill": one row for each folder, and one for all."""
    if not options.wants("kill"):
        return
    size, rng = QUICK if options.quick else Size(), np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(place)
        _train(folder / "programs", size, folder, None)  # compiles
        whole = folder / "whole"
        seconds = _train(whole, size, folder, None)
        expected = (whole / MODEL_FILE).read_bytes()
        rows: list[dict[str, float]] = []
        while sum(row["kills"] for row in rows) < size.kills:
            left = size.kills - sum(int(row["kills"]) for row in rows)
            own = folder / str(len(rows))
            rows.append(_one_folder(own, size, folder, seconds, left, rng))
            rows[-1]["equal"] = float((own / MODEL_FILE).read_bytes() == expected)
            yield Measurement("kill", f"folder {len(rows)}", rows[-1], {"seed": options.seed})
        total = {name: sum(row[name] for row in rows) for name in rows[0]}
        total |= {"folders": len(rows), "uninterrupted_seconds": seconds, "equal": min(row["equal"] for row in rows)}
        yield Measurement("kill", "all", total, {"seed": options.seed})


def _one_folder(
    folder: pathlib.Path, size: Size, place: pathlib.Path, seconds: float, max_kills: int, rng: np.random.Generator
) -> dict[str, float]:
    """Runs until the training has come through; what happened on the way."""
    kills, frames_twice, parts_twice, left_behind = 0, 0, 0, 0
    before: dict[str, dict[pathlib.Path, int]] = {FRAMES: {}, PARTS: {}}
    started = time.perf_counter()
    while True:
        limit = rng.uniform(0.0, seconds) if kills < max_kills else None
        killed = _train(folder, size, place, limit) is None
        after = {pattern: _written(folder, pattern) for pattern in before}
        frames_twice += _again(before[FRAMES], after[FRAMES])
        parts_twice += _again(before[PARTS], after[PARTS])
        before = after
        if not killed:
            break
        kills += 1
    left_behind = len([file for file in folder.rglob(".*") if file.is_file()]) + len(list(folder.rglob("*.partial")))
    return {
        "kills": kills,
        "frames_twice": frames_twice,
        "parts_twice": parts_twice,
        "files_left_behind": left_behind,
        "seconds": time.perf_counter() - started,
    }


def _train(folder: pathlib.Path, size: Size, place: pathlib.Path, limit: float | None) -> float | None:
    """Seconds of a training; None if it was killed because it took longer than `limit`."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(place / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "fitting", *TRAIN, *size.options, "-o", str(folder)]
    started = time.perf_counter()
    try:
        # On a timeout, `run` kills the process.
        subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit, check=True)
    except subprocess.TimeoutExpired:
        return None
    except subprocess.CalledProcessError as error:
        raise RuntimeError(f"the training failed: {error.stderr.strip().splitlines()[-1]}") from error
    return time.perf_counter() - started


def _written(folder: pathlib.Path, pattern: str) -> dict[pathlib.Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.glob(pattern) if not path.name.startswith(".")}


def _again(before: dict[pathlib.Path, int], after: dict[pathlib.Path, int]) -> int:
    return sum(path in after and after[path] != written for path, written in before.items())
