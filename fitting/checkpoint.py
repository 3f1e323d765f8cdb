"""Finished parts of a long job, kept on disk until the job is done, so that an interrupted one goes on from them.

A part is a file of named arrays with a fingerprint of all it was computed from and a checksum of its bytes. It is
written to a temporary file, brought to the disk, and then renamed. What is missing, cut short, damaged, or was
computed from anything else (other data, settings, code, or version of a library) is computed again, never trusted.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from safetensors.numpy import load, save

import fitting
import jaxrender
from fitting.stages import Track
from jaxrender.checks import bad_input
from jaxrender.console import announce, format_bytes, to_jsonable
from jaxrender.io.atomic import write_bytes
from jaxrender.machine import on_all_cores

Arrays = dict[str, np.ndarray]
Item = TypeVar("Item")

#: Folder of the parts in the folder of a run; it is there only while the run is not finished.
UNFINISHED = "unfinished"

_RUN_FILE = "run.json"
_MAGIC = b"jaxrender part 1\n"
_HASH_BYTES = 32


class Checkpoint:
    """The parts of one run, by stage. One writer at a time (fitting.lock)."""

    def __init__(self, folder: Path | None, *, run: Mapping[str, Any] | None = None):
        """Opens the parts in `folder`, which need not be there; without a folder nothing is kept.

        Args:
          run: what tells this run from others, as JSON data: character and settings.
        Raises:
          InputError: if parts of another run are there; names the first difference.
        """
        self.folder, self.run = folder, to_jsonable(run or {})
        if folder is not None and self.size():
            _refuse_another_run(folder, self.run)
            announce(f"an interrupted run left {format_bytes(self.size())} in {folder}; continuing with them")

    def stage(self, name: str, *depends: Any) -> "Stage":
        """The parts of one stage.

        Args:
          name: of its folder; no other stage of the run may have it.
          depends: all that the parts are computed from: arrays, records, settings, numbers.
        """
        if self.folder is None:
            return Stage(self, name, "")
        stage = Stage(self, name, fingerprint(name, code_fingerprint(), *depends))
        stage.remove_foreign()
        return stage

    def begin(self) -> None:
        """Writes down whose parts these are; before the first part, so that no run without any leaves a folder."""
        if self.folder is not None and not (self.folder / _RUN_FILE).is_file():
            write_bytes(self.folder / _RUN_FILE, json.dumps(self.run, indent=1).encode())

    def size(self) -> int:
        """Bytes on disk."""
        return 0 if self.folder is None else sum(file.stat().st_size for file in _files(self.folder))

    def finish(self) -> None:
        """Removes all parts: what they were for is done."""
        if self.folder is not None:
            remove_parts(self.folder)


NOTHING_KEPT = Checkpoint(None)


def remove_parts(folder: Path) -> None:
    """Removes the parts of whatever run from their folder, and the folder unless something else is in it."""
    # First the file that would have another run refused.
    for file in ((folder / _RUN_FILE), *_files(folder)):
        file.unlink(missing_ok=True)
    for empty in (*folder.glob("*/"), folder):
        with contextlib.suppress(OSError):
            empty.rmdir()


def _files(folder: Path) -> list[Path]:
    # Temporary files of a killed process have the endings too.
    return [*folder.glob("*/*.part"), *folder.glob("*.json")]


@dataclasses.dataclass(frozen=True)
class Stage:
    """Parts that depend on the same things, by name."""

    checkpoint: Checkpoint
    name: str
    fingerprint: str

    def read(self, part: str) -> Arrays | None:
        """A kept part; None if it is not there, not whole, or of something else."""
        if self.checkpoint.folder is None:
            return None
        try:
            data = self._path(part).read_bytes()
        except OSError:
            return None
        head = self._head(part)
        checksum, body = data[len(head) : len(head) + _HASH_BYTES], data[len(head) + _HASH_BYTES :]
        return load(body) if data.startswith(head) and hashlib.sha256(body).digest() == checksum else None

    def write(self, part: str, arrays: Arrays) -> None:
        """Keeps a part.

        Raises:
          OSError: if the disk is full or cannot be written.
        """
        if self.checkpoint.folder is None:
            return
        self.checkpoint.begin()
        body = save({key: np.array(value, order="C") for key, value in arrays.items()})
        write_bytes(self._path(part), self._head(part) + hashlib.sha256(body).digest() + body)

    def part(self, part: str, compute: Callable[[], Arrays]) -> Arrays:
        """The kept part, else what `compute` gives, which is kept."""
        kept = self.read(part)
        if kept is None:
            kept = compute()
            self.write(part, kept)
        return kept

    def parts(
        self,
        items: Sequence[Item],
        compute: Callable[[Item], Arrays],
        *,
        track: Track,
        label: str,
        one_by_one: bool = False,
    ) -> Iterator[tuple[int, Arrays]]:
        """Number and part of every item: first what is kept, then the others, computed and kept.

        A part is on disk as soon as it is computed, also if nobody has asked for it yet.

        Args:
          one_by_one: `compute` uses all cores itself, or compiles something else for every item.
        """
        missing = []
        for number in range(len(items)):
            kept = self.read(_name(number))
            if kept is None:
                missing.append(number)
            else:
                yield number, kept

        def one(number: int) -> Arrays:
            arrays = compute(items[number])
            self.write(_name(number), arrays)
            return arrays

        # XLA runs each item on its calling thread (jaxrender.machine); several at a time keep the cores busy.
        computed = map(one, missing) if one_by_one else on_all_cores(one, missing)
        for number in track(iter(missing), len(items), label, len(items) - len(missing)):
            yield number, next(computed)

    def remove_foreign(self) -> None:
        """Removes parts of something else: disk use stays that of one run."""
        foreign = 0
        if self.checkpoint.folder is None:
            return
        for path in self.checkpoint.folder.glob(f"{self.name}/*.part"):
            head = self._head(path.stem)
            with path.open("rb") as file:
                if file.read(len(head)) == head:
                    continue
            path.unlink()
            foreign += not path.name.startswith(".")
        if foreign:
            announce(f"{self.name}: {foreign} kept parts are of another version or of other data; computed again")

    def _path(self, part: str) -> Path:
        assert self.checkpoint.folder is not None
        return self.checkpoint.folder / self.name / f"{part}.part"

    def _head(self, part: str) -> bytes:
        return _MAGIC + bytes.fromhex(fingerprint(self.fingerprint, part))


def _name(number: int) -> str:
    return f"{number:05d}"


def as_arrays(value: Any) -> Arrays:
    """Records, lists, numbers and texts as a part; floats come back bit by bit, records as dictionaries."""
    return {"json": np.frombuffer(json.dumps(to_jsonable(value)).encode(), np.uint8)}


def from_arrays(arrays: Arrays) -> Any:
    """What `as_arrays` was given."""
    return json.loads(arrays["json"].tobytes())


def fingerprint(*values: Any) -> str:
    """SHA-256 of arrays, records, containers, numbers and texts: their types, shapes and all their bytes."""
    digest = hashlib.sha256()
    for value in values:
        _feed(digest.update, value)
    return digest.hexdigest()


def _feed(update: Callable[[Any], None], value: Any) -> None:
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        update(f"array {array.dtype} {array.shape};".encode())
        update(np.ascontiguousarray(array).data)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        _feed(update, [type(value).__name__, {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}])
    elif isinstance(value, Mapping):
        update(b"mapping;")
        _feed(update, list(value.items()))
    elif isinstance(value, list | tuple):
        update(f"list {len(value)};".encode())
        for item in value:
            _feed(update, item)
    elif value is None or isinstance(value, bool | int | float | str):
        text = repr(value)
        update(f"{type(value).__name__} {len(text)} {text};".encode())
    else:
        raise TypeError(f"no fingerprint of a {type(value).__name__}")


@functools.cache
def code_fingerprint() -> str:
    """Of the programs that compute: the source of our packages, and the versions of the libraries under them."""
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy", "scipy")]
    folders = [Path(str(package.__file__)).parent for package in (jaxrender, fitting)]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    return fingerprint(versions, [hashlib.sha256(file.read_bytes()).hexdigest() for file in files])


def _refuse_another_run(folder: Path, run: dict) -> None:
    try:
        there = json.loads((folder / _RUN_FILE).read_bytes())
    except (OSError, ValueError):
        return  # cut short or gone; the parts tell themselves what they are of
    difference = first_difference(there, run)
    if difference is None:
        return
    field, theirs, ours = difference
    bad_input(
        folder, field, expected=f"{theirs}, as the unfinished run there has it",
        got=f"{ours}; finish that run, take another -o, or delete this folder (the bake beside it stays)",
    )  # fmt: skip


def first_difference(there: Any, here: Any, *, name: str = "run") -> tuple[str, Any, Any] | None:
    """Name, one value and the other of the first leaf that two nested dictionaries do not share."""
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return None if there == here else (name, there, here)
    for key in dict.fromkeys([*there, *here]):
        inner = key if name == "run" else f"{name}.{key}"
        found = first_difference(there.get(key), here.get(key), name=inner)
        if found is not None:
            return found
    return None
