"""Files appear whole or not at all."""

import errno
import os
import stat

import pytest

from jaxrender.io.atomic import atomic_path, remove_leftovers, write_bytes


def test_writes_and_makes_folders(tmp_path):
    write_bytes(tmp_path / "a" / "b.bin", b"data")
    assert (tmp_path / "a" / "b.bin").read_bytes() == b"data"
    assert os.listdir(tmp_path / "a") == ["b.bin"]


def test_mode_is_that_of_an_ordinary_file(tmp_path):
    write_bytes(tmp_path / "atomic", b"")
    (tmp_path / "plain").touch()
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_keeps_the_old_file_and_leaves_nothing(tmp_path, error):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(error), atomic_path(path) as temporary:
        temporary.write_text("half")
        assert path.read_text() == "old"
        raise error
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["file.txt"]


def test_the_temporary_file_keeps_the_ending(tmp_path):
    with atomic_path(tmp_path / "picture.png") as temporary:
        assert temporary.suffix == ".png" and temporary.parent == tmp_path


def test_leftovers_of_killed_processes_are_removed_and_nothing_else(tmp_path):
    kept = ["model.bin", ".model.bin", ".model.0123abcd.txt", ".model.0123abc.bin", ".other.0123abcd.bin"]
    for name in [*kept, ".model.0123abcd.bin", ".model.ffffffff.bin"]:
        (tmp_path / name).touch()
    remove_leftovers(tmp_path / "model.bin")
    assert sorted(os.listdir(tmp_path)) == sorted(kept)


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(IsADirectoryError):
        write_bytes(tmp_path, b"")


def test_a_device_is_written_not_replaced():
    write_bytes("/dev/null", b"data")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_a_full_disk_is_told_with_the_name_that_was_asked_for(tmp_path):
    with pytest.raises(OSError) as caught, atomic_path(tmp_path / "out.bin"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(tmp_path / "out.bin")
    assert os.listdir(tmp_path) == []


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        write_bytes(tmp_path / "file" / "x", b"")
