"""One writer per folder: a lock that the system takes back from a process that is killed."""

import contextlib
import errno
import os
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from jaxrender.checks import bad_input
from jaxrender.console import warn

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCK_FILE = ".lock"

# Folder -> the thread of this process that holds it. Who holds a folder may ask for it again further down.
_held: dict[Path, int] = {}
_registry = threading.Lock()


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Holds `folder`, which is made if it is missing, against all other processes and threads during the block.

    The lock is on a file that goes when the block ends. A process that is killed leaves the file behind, but not the
    lock. A file system without locks is written to all the same, with a warning.

    Raises:
      InputError: if another run holds the folder; names it and its process.
      OSError: if the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    folder = folder.resolve()
    with _registry:
        owner = _held.get(folder)
        if owner is None:
            file = _lock(folder / LOCK_FILE)
            _held[folder] = threading.get_ident()
    if owner is not None:
        if owner != threading.get_ident():
            _refuse(folder, f"another thread of process {os.getpid()}")
        yield
        return
    try:
        yield
    finally:
        with _registry:
            del _held[folder]
            _unlock(file, folder / LOCK_FILE)


def _refuse(folder: Path, holder: str) -> None:
    bad_input(folder, "lock", expected="no other run that writes to this folder", got=holder)


def _lock(path: Path) -> int:
    """Opens and locks the file; its handle."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _try_lock(file):
                _refuse(path.parent, _holder(file))
            # The last holder may have removed the file between our two steps: then this one is no longer in the folder.
            if _is_file_at(file, path):
                os.ftruncate(file, 0)
                os.lseek(file, 0, os.SEEK_SET)
                os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
                return file
        except BaseException:
            os.close(file)
            raise
        os.close(file)


def _unlock(file: int, path: Path) -> None:
    # Removed while it is still locked: nobody else can hold it, and who waits for it notices.
    with contextlib.suppress(OSError):
        if _is_file_at(file, path):
            path.unlink()
    os.close(file)
    if sys.platform == "win32":  # where an open file cannot be removed
        with contextlib.suppress(OSError):
            path.unlink()


def _try_lock(file: int) -> bool:
    """Whether the lock was free; True as well where the file system knows none."""
    try:
        if sys.platform == "win32":
            # One byte far behind the text, which others may then still read.
            os.lseek(file, 1 << 20, os.SEEK_SET)
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK):
            return False
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP):
            raise
        warn("this file system has no locks: do not start a second run in the same folder")
    return True


def _is_file_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


def _holder(file: int) -> str:
    os.lseek(file, 0, os.SEEK_SET)
    return os.read(file, 200).decode(errors="replace").strip() or "another process"
