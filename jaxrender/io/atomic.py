"""Files that are there whole or not at all."""

import contextlib
import errno
import glob
import os
import pathlib
import secrets
from collections.abc import Iterator


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Gives the block a temporary path beside `path`, and puts that file in its place when the block ends.

    The folder is made if it is missing. The file reaches the disk before it takes its name; if the block
    fails or is interrupted, the temporary file goes and whatever stood at `path` stays as it was. A `path`
    that is a device or a pipe (/dev/stdout) cannot be replaced and is given to the block as it is.

    Raises:
      OSError: if the folder cannot be written, the disk is full, or `path` is a folder.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        yield path
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path.parent)) from error
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        # Made here with the mode of an ordinary new file: mkstemp would leave it readable by its owner only.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)  # a full disk is reported without a name, or with one nobody asked for
        raise
    # The rename itself is an entry of the folder. Some systems cannot open a folder for this.
    with contextlib.suppress(OSError):
        _sync(path.parent)


def remove_leftovers(path: str | os.PathLike) -> None:
    """Removes the temporary files of `path` that killed processes left; only while nobody else writes it."""
    path = pathlib.Path(path)
    for left in path.parent.glob(f".{glob.escape(path.stem)}.{'[0-9a-f]' * 8}{glob.escape(path.suffix)}"):
        left.unlink(missing_ok=True)


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Writes `data` to `path` by `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _sync(path: pathlib.Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
