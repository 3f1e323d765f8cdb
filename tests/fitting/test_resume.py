"""`python -m fitting train`, killed in every stage: it continues, and the model is the uninterrupted one's, bit by bit.

The processes are real and are killed from outside, when a file of a certain kind has appeared. `python -m benchmarks
run resume` does the same at random moments, many times. About a dozen processes: a minute and a half on two cores.
"""

import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from fitting.checkpoint import UNFINISHED, remove_parts
from fitting.cli import main
from fitting.model import MODEL_FILE, find_model
from fitting.train import STORE

ROOT = pathlib.Path(__file__).resolve().parents[2]
COMMAND = [
    "train", "--num-vertices", "800", "--bake.max-points", "60", "--bake.max-frames", "12", "--bake.num-mixed", "4",
    "--bake.num-directions", "64", "--fit.num-components", "4", "--fit.num-lobes", "1", "--fit.refine-steps", "3",
    "--no-study",
]  # fmt: skip
FRAMES = "bake.zarr/checksum/c/*"
BLOCKS = f"{UNFINISHED}/fit/0*.part"


@pytest.fixture(scope="module")
def train(tmp_path_factory):
    """A function that starts a training; all of them share compiled programs, as a user's do."""
    programs = str(tmp_path_factory.mktemp("programs"))

    def start(folder, *options):
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": programs, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-m", "fitting", *COMMAND, "-o", str(folder), *options]
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    return start


def end_when(process, folder, pattern, count, number=signal.SIGKILL):
    """Ends a process when `count` files are there; its status and its last line."""
    deadline = time.monotonic() + 300
    while len(list(folder.glob(pattern))) < count:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    return process.returncode, err.strip().splitlines()[-1]


@pytest.fixture(scope="module")
def uninterrupted(train, tmp_path_factory):
    """The model of a run that nothing disturbs; the pictures, which come after it, are left out."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    end_when(train(folder), folder, MODEL_FILE, 1)
    return (folder / MODEL_FILE).read_bytes()


def modified(folder, pattern):
    return {path: path.stat().st_mtime_ns for path in folder.glob(pattern)}


def test_a_training_survives_being_killed_in_every_stage(train, uninterrupted, tmp_path, capsys):
    folder = tmp_path / "run"
    assert end_when(train(folder), folder, FRAMES, 3)[0] == -signal.SIGKILL
    frames = modified(folder, FRAMES)
    status, line = end_when(train(folder), folder, FRAMES, 8, signal.SIGTERM)
    assert status == 143 and line == f"terminated; what was finished is kept in {folder}; the same command continues"
    for ending in (f"{UNFINISHED}/ridge/ridge.part", BLOCKS):
        assert end_when(train(folder), folder, ending, 1)[0] == -signal.SIGKILL
    blocks = modified(folder, BLOCKS)
    # Settings of another run are refused while this one is not finished, and change nothing.
    assert main([*COMMAND, "-o", str(folder), "--fit.refine-steps", "4"]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"{folder / UNFINISHED}: fit.refine_steps: expected 3, as the unfinished run there has it, got 4" in line
    status, line = end_when(train(folder), folder, BLOCKS, len(blocks) + 4, signal.SIGINT)
    assert status == 130 and line == f"interrupted; what was finished is kept in {folder}; the same command continues"
    assert end_when(train(folder), folder, f"{UNFINISHED}/measure/*.part", 1)[0] == -signal.SIGKILL
    assert end_when(train(folder), folder, MODEL_FILE, 1)[0] == -signal.SIGKILL
    assert (folder / MODEL_FILE).read_bytes() == uninterrupted
    # Nothing that was there has been done twice.
    assert frames.items() <= modified(folder, FRAMES).items()
    assert blocks.items() <= modified(folder, BLOCKS).items()
    _, header, _ = find_model(folder)
    assert header["rays"] == len(modified(folder, FRAMES)) * 60 * 64
    assert not list(folder.glob(".*.safetensors"))


def test_a_second_training_in_the_folder_is_refused_and_another_bake_too(train, tmp_path, capsys):
    folder = tmp_path / "run"
    first = train(folder)
    while not list(folder.glob(FRAMES)):
        assert first.poll() is None
        time.sleep(0.01)
    assert main([*COMMAND, "-o", str(folder)]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert f"{folder}: lock: expected no other run that writes to this folder, got process {first.pid} on " in line
    first.kill()
    first.communicate()
    # What there may be of its fit would be told first.
    remove_parts(folder / UNFINISHED)
    assert main([*COMMAND, "-o", str(folder), "--bake.num-mixed", "5"]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert f"{folder / STORE}: bake.num_mixed: expected 4, as it was baked, got 5; take another -o, or delete" in line
    before = modified(folder, FRAMES)
    again = train(folder, "--bake.num-mixed", "5", "--restart")
    while len(modified(folder, FRAMES).items() - before.items()) < 1:
        assert again.poll() is None, again.stderr.read()
        time.sleep(0.01)
    again.send_signal(signal.SIGINT)
    _, err = again.communicate(timeout=60)
    assert err.strip().endswith("the same command without --restart continues")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of one megabyte; skips where none can be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)], capture_output=True).returncode:
        pytest.skip("no small file system can be mounted here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_ends_the_training_with_one_line_and_with_more_room_it_continues(train, uninterrupted, small_disk):
    folder = small_disk / "run"
    filler = small_disk / "filler"
    # Room for a part of the fit.
    filler.write_bytes(b"x" * ((1 << 20) - (300 << 10)))
    process = train(folder)
    _, err = process.communicate(timeout=300)
    line = err.strip().splitlines()[-1]
    assert process.returncode == 2 and line.startswith(f"jaxrender: error: {folder}/")
    kept = f"what was finished is kept in {folder}; the same command continues"
    assert line.endswith(f": No space left on device; {kept}")
    filler.unlink()
    assert list(folder.glob(BLOCKS))
    end_when(train(folder), folder, MODEL_FILE, 1)
    assert (folder / MODEL_FILE).read_bytes() == uninterrupted
