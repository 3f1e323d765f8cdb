"""The manners all commands share: parsing, progress, errors, exit status, the compilation cache.

Results go to standard output, everything said on the way to standard error, so `--json` can be piped.
Exit status: 0 done; 1 a fault of ours; 2 bad input or arguments, a full disk or too little memory, told in one line;
130 after Ctrl-C; 143 after a request to end (SIGTERM).
"""

import contextlib
import dataclasses
import enum
import json
import os
import pathlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import rich.console
import rich.progress
import rich.table
import tyro

import jaxrender.checks
import jaxrender.machine

#: Set to anything but the empty string, it lets the traceback of an error through.
DEBUG_VARIABLE = "JAXRENDER_DEBUG"

_stderr = rich.console.Console(stderr=True, markup=False, highlight=False, emoji=False, soft_wrap=True)


# --- Parsing and exit status


def parse(commands: Any, *, prog: str, description: str = "", argv: list[str] | None = None) -> Any:
    """Turns the command line into one of `commands`: a dataclass, or a union of dataclasses (subcommands).

    Field docstrings are the help texts. A usage error is told on standard error and exits with status 2.
    """
    markers = (tyro.conf.PositionalMetavarFromFieldName,)
    return tyro.cli(commands, prog=prog, description=description or None, args=argv, config=markers)


def run_command(main: Callable[[], object]) -> int:
    """Runs `main` and returns the exit status of the process; no exception but `SystemExit` leaves as itself.

    Bad data (`InputError`), bad arguments (`ValueError`), files that cannot be read or written (`OSError`)
    and too little memory become one line and status 2. Ctrl-C and SIGTERM, which are taken alike, end
    with status 130 and 143. The notes that `keeping` left are part of the line. Anything else is a fault
    of ours: one line, status 1, and how to see the traceback.
    """
    try:
        with _terminated_like_ctrl_c():
            main()
        sys.stdout.flush()
        return 0
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    except Terminated as stop:
        announce(f"terminated{_notes(stop)}")
        return 128 + signal.SIGTERM
    except KeyboardInterrupt as stop:
        announce(f"interrupted{_notes(stop)}")
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # The reader (`| head`) has gone. Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (jaxrender.checks.InputError, ValueError, OSError) as error:
        return _fail(error, _one_line(error) + _notes(error), status=2)
    except Exception as error:
        if _out_of_memory(error):
            return _fail(error, f"not enough memory: {_one_line(error)}".removesuffix(": ") + _notes(error), status=2)
        text = f"internal error: {type(error).__name__}: {_one_line(error)}"
        return _fail(error, f"{text} (set {DEBUG_VARIABLE}=1 for the traceback)", status=1)


@contextlib.contextmanager
def keeping(note: str) -> Iterator[None]:
    """Says `note` if the block ends before its time: what was kept, and how to go on from there.

    That is after Ctrl-C or SIGTERM, when a file cannot be written (a full disk), and when memory runs out.
    """
    try:
        yield
    except (KeyboardInterrupt, OSError) as stop:
        stop.add_note(_Kept(note))
        raise
    except Exception as error:
        if _out_of_memory(error):
            error.add_note(_Kept(note))
        raise


class _Kept(str):
    """A note of ours: JAX leaves some on its errors too."""


class Terminated(KeyboardInterrupt):
    """Somebody asked the process to end, by SIGTERM."""


@contextlib.contextmanager
def _terminated_like_ctrl_c() -> Iterator[None]:
    """SIGTERM raises `Terminated` during the block, so that what is open is closed and said."""
    # Signals are the main thread's, and a handler that is there already is somebody's purpose.
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return

    def stop(*_: object) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _out_of_memory(error: Exception) -> bool:
    """Of Python and NumPy, or of a device of JAX."""
    is_of_jax = isinstance(error, jax.errors.JaxRuntimeError) and str(error).startswith("RESOURCE_EXHAUSTED")
    return isinstance(error, MemoryError) or is_of_jax


def _notes(error: BaseException) -> str:
    return "".join(f"; {note}" for note in getattr(error, "__notes__", []) if isinstance(note, _Kept))


def _fail(error: BaseException, text: str, *, status: int) -> int:
    if os.environ.get(DEBUG_VARIABLE):
        raise error
    announce(f"jaxrender: error: {text}")
    return status


def _one_line(error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return " ".join(str(error).split())
    if isinstance(error, OSError) and error.strerror:
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        return ": ".join([*names, error.strerror])
    return " ".join(str(error).split()) or type(error).__name__


# --- What is said on the way


def announce(text: str) -> None:
    """Prints one line to standard error, above any progress bar."""
    _stderr.print(text)


def warn(text: str) -> None:
    """Prints one line about something that does not stop the command."""
    announce(f"jaxrender: warning: {text}")


def announce_device(*, rays: str | None = None) -> None:
    """Says where the arrays live and, if given, what shoots the rays ("Embree, 2 threads")."""
    device = jax.devices()[0]
    name = (
        f"{device.platform} ({device.device_kind})"
        if device.platform != "cpu"
        else f"cpu, {jaxrender.machine.num_cores()} cores"
    )
    announce(f"device: {name}" + (f"; rays: {rays}" if rays else ""))


@contextlib.contextmanager
def compiling(what: str) -> Iterator[None]:
    """Says that `what` compiles, and how long it took: the one pause a user cannot see a reason for."""
    announce(f"compiling {what} ...")
    start = time.perf_counter()
    yield
    announce(f"compiled {what} in {format_seconds(time.perf_counter() - start)}")


@contextlib.contextmanager
def progress(label: str, *, total: int, unit: str = "", done: int = 0) -> Iterator[Callable[[int], None]]:
    """Gives the block a function `advance(n)`; shows a bar on a terminal and plain lines elsewhere.

    `done` counts what an earlier run has finished. Library code takes `advance` as a callback and stays
    free of printing.
    """
    if not _stderr.is_terminal:
        with _plain_progress(label, total=total, unit=unit, done=done) as advance:
            yield advance
        return
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.MofNCompleteColumn(),
        rich.progress.TextColumn(unit),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("left"),
        rich.progress.TimeRemainingColumn(),
    )
    with rich.progress.Progress(*columns, console=_stderr) as bars:
        task = bars.add_task(label, total=total, completed=done)

        def advance(n: int = 1) -> None:
            bars.advance(task, n)

        yield advance


def track(items: Iterable, label: str, *, total: int, unit: str = "", done: int = 0) -> Iterator:
    """Goes through `items` under `progress`."""
    with progress(label, total=total, unit=unit, done=done) as advance:
        for item in items:
            yield item
            advance(1)


@contextlib.contextmanager
def _plain_progress(label: str, *, total: int, unit: str, done: int) -> Iterator[Callable[[int], None]]:
    """A line at the start, at each tenth, after 30 silent seconds, and at the end."""
    start, said, told = time.perf_counter(), time.perf_counter(), done
    count, unit = done, f" {unit}" if unit else ""

    def advance(n: int = 1) -> None:
        nonlocal count, said, told
        count += n
        now = time.perf_counter()
        if count < total and (10 * (count - told) >= total or now - said >= 30):
            left = (now - start) / (count - done) * (total - count)
            announce(f"{label}: {count}/{total}{unit}, {format_seconds(left)} left")
            said, told = now, count

    announce(f"{label}: {total - done}{unit}" + (f" ({done} of {total} are there already)" if done else ""))
    yield advance
    announce(f"{label}: {count}/{total}{unit} in {format_seconds(time.perf_counter() - start)}")


def format_seconds(seconds: int | float) -> str:
    """A time for people: "0.4 s", "12 s", "3 min 20 s", "1 h 5 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def format_bytes(count: int | float) -> str:
    """A size for people, in powers of 1000: "730 B", "1.4 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 99.5 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


# --- Results


def to_jsonable(value: Any) -> Any:
    """`value` as strict JSON data; NaN and Inf become null.

    Records, mappings, sequences, paths, enumerations, arrays and NumPy numbers are spelled out.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_jsonable(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_jsonable(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return to_jsonable(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, enum.Enum):
        return to_jsonable(value.value)
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"cannot be written as JSON: {type(value).__name__}")


def print_json(value: Any) -> None:
    """Prints `value` as one strict JSON object on standard output."""
    print(json.dumps(to_jsonable(value), indent=2, allow_nan=False, ensure_ascii=False))


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Prints a table on standard output: texts to the left in the first column, numbers to the right in the others."""
    table = rich.table.Table(box=None, pad_edge=False, header_style="")
    for index, name in enumerate(columns):
        table.add_column(name, justify="right" if index else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    # Wide enough for any table: rich would cut cells to fit a narrow terminal, and a file has no width at all.
    stdout = rich.console.Console(markup=False, highlight=False, emoji=False, width=1000)
    stdout.print(title, style="bold")
    stdout.print(table)
    stdout.print()


def finish(*, paths: Iterable[str | os.PathLike], record: Mapping[str, Any], as_json: bool) -> None:
    """Ends a command: prints the paths it wrote, or with `as_json` the record and the paths as one object."""
    if as_json:
        print_json({**record, "paths": list(paths)})
        return
    for path in paths:
        print(f"wrote {os.fspath(path)}")


def enable_compilation_cache() -> pathlib.Path | None:
    """Turns JAX's persistent compilation cache on; the second run of a command then starts at once.

    Returns the folder, or None with a warning if it cannot be written. A folder set in the environment or
    in JAX's configuration is kept.
    """
    path = jaxrender.machine.cache_path()
    if not jaxrender.machine.is_writable_folder(path):
        jax.config.update("jax_compilation_cache_dir", None)
        warn(f"compiled programs are not kept: the cache folder {path} cannot be written")
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    # JAX keeps only what took a second to compile. A command here has many smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    return path
