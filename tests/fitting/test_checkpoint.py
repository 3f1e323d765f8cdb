"""Kept parts, the lock and the store: what is damaged, foreign or half-written is never trusted."""

import contextlib
import dataclasses
import errno
import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from fitting.checkpoint import Checkpoint, as_arrays, fingerprint, from_arrays
from fitting.config import BakeSettings, FitSettings
from fitting.dataset import VisibilityStore, bake, remove_store
from fitting.evaluate import evaluate
from fitting.fit import fit_model
from fitting.lock import LOCK_FILE, only_writer
from fitting.model import MODEL_FILE, save_pose_model
from fitting.stages import no_tracking
from jaxrender import console
from jaxrender.checks import InputError
from jaxrender.console import to_jsonable

FIT = FitSettings(num_components=4, refine_steps=0, mixed_weight=0.2)
RUN = {"character": "mannequin", "fit": {"num_lobes": 2}}
BAKE = BakeSettings(num_directions=64)


def square(number):
    return {"square": np.array(number**2), "rows": np.arange(number, dtype=np.float32)}


def computed(stage, items, *, fails_at=None):
    """Squares of the items, and which of them were computed."""
    calls = []

    def compute(number):
        calls.append(number)
        if number == fails_at:
            raise MemoryError
        return square(number)

    found = dict(stage.parts(items, compute, track=no_tracking, label="squares", one_by_one=True))
    return [int(found[i]["square"]) for i in range(len(items))], calls


# --- Parts


def test_only_what_is_missing_is_computed(tmp_path):
    with pytest.raises(MemoryError):
        computed(Checkpoint(tmp_path / "c").stage("s", 1.0), [2, 3, 4, 5], fails_at=4)
    assert computed(Checkpoint(tmp_path / "c").stage("s", 1.0), [2, 3, 4, 5]) == ([4, 9, 16, 25], [4, 5])
    assert computed(Checkpoint(None).stage("s", 1.0), [2, 3])[1] == [2, 3]


def test_no_cut_and_no_flipped_bit_is_trusted(tmp_path):
    stage = Checkpoint(tmp_path / "c").stage("s", 1.0)
    stage.write("0", square(9))
    path = tmp_path / "c" / "s" / "0.part"
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert stage.read("0") is None
    for position in range(len(whole)):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ (1 << position % 8)]) + whole[position + 1 :])
        assert stage.read("0") is None
    path.write_bytes(whole)
    np.testing.assert_array_equal(stage.read("0")["rows"], np.arange(9, dtype=np.float32))


def test_parts_of_something_else_are_computed_again_and_removed(tmp_path, capsys):
    first = Checkpoint(tmp_path / "c").stage("s", np.zeros(3))
    computed(first, [2, 3, 4])
    folder = tmp_path / "c" / "s"
    # A part under the name of another one.
    (folder / "00002.part").write_bytes((folder / "00000.part").read_bytes())
    assert computed(Checkpoint(tmp_path / "c").stage("s", np.zeros(3)), [2, 3, 4])[1] == [4]
    # Half-written by a process that was killed.
    (folder / ".00001.0123abcd.part").write_bytes((folder / "00001.part").read_bytes())
    changed = np.zeros(3)
    changed[1] = np.nextafter(0.0, 1.0)
    other = Checkpoint(tmp_path / "c").stage("s", changed)
    assert list(folder.iterdir()) == [] and "3 kept parts are of another version" in capsys.readouterr().err
    assert computed(other, [2, 3, 4])[1] == [2, 3, 4]


def test_another_run_is_refused_until_the_first_has_finished(tmp_path):
    first = Checkpoint(tmp_path / "c", run=RUN)
    assert not (tmp_path / "c").exists()
    first.stage("s").write("0", square(3))
    with pytest.raises(
        InputError, match=r"c: fit.num_lobes: expected 2, as the unfinished run there has it, got 3; fin"
    ):
        Checkpoint(tmp_path / "c", run={**RUN, "fit": {"num_lobes": 3}})
    assert Checkpoint(tmp_path / "c", run=RUN).stage("s").read("0") is not None
    first.finish()
    assert not (tmp_path / "c").exists() and first.size() == 0
    Checkpoint(tmp_path / "c", run={**RUN, "fit": {"num_lobes": 3}})


def test_finishing_leaves_what_others_put_there(tmp_path):
    parts = Checkpoint(tmp_path / "c", run=RUN)
    parts.stage("s").write("0", square(3))
    (tmp_path / "c" / "thesis.txt").write_text("mine")
    parts.finish()
    assert [p.name for p in (tmp_path / "c").iterdir()] == ["thesis.txt"]


@dataclasses.dataclass
class Pair:
    a: object
    b: object


def test_fingerprints_tell_all_apart():
    values = [
        (1,), (1.0,), (True,), (None,), ("1",), ("",), (), ([],), ({},), ([1, 2],), ([1], 2), ({"a": 1},), ({"b": 1},),
        (np.zeros(2),), (np.zeros(2, np.float32),), (np.zeros((1, 2)),), (np.array([0.0, -0.0]),), (Pair(1, 2),),
        (Pair(2, 1),), ("a", "bc"), ("ab", "c"),
    ]  # fmt: skip
    assert len({fingerprint(*value) for value in values}) == len(values)
    assert fingerprint(jnp.arange(3)) == fingerprint(np.arange(3, dtype=np.int32))
    with pytest.raises(TypeError, match="set"):
        fingerprint({1})


def test_records_come_back_bit_by_bit():
    value = {"rows": [{"x": 0.1 + 0.2, "none": None, "text": "λ"}], "n": 3}
    assert from_arrays(as_arrays(value)) == value


# --- The lock

HOLD = """
import sys, pathlib, time
from fitting.lock import only_writer
with only_writer(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_and_a_killed_one_does_not_block(tmp_path):
    folder = tmp_path / "run"
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match=f"run: lock: expected no other run .*, got process {process.pid} on "):
        with only_writer(folder):
            pass
    process.kill()
    process.wait()
    process.stdout.close()
    assert (folder / LOCK_FILE).exists()
    with only_writer(folder), only_writer(folder):  # again, further down
        assert (folder / LOCK_FILE).exists()
    assert list(folder.iterdir()) == []


def test_a_second_thread_is_refused(tmp_path):
    refused = []

    def other():
        try:
            with only_writer(tmp_path):
                pass
        except InputError as error:
            refused.append(str(error))

    with only_writer(tmp_path):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(refused) == 1 and "another thread" in refused[0]
    other()
    assert len(refused) == 1


# --- The store


def tiny_store(path, **changes):
    shape = {"num_frames": 4, "num_points": 12, "bake": BAKE, "source": "a", "run": {"bake": {"seed": 0}}} | changes
    return VisibilityStore(path, **shape)


def tiny_bake(store):
    """A pair of balls that come apart; returns the frames that were traced."""
    ball = trimesh.creation.icosphere(1)
    corners = np.concatenate([ball.vertices, ball.vertices])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    traced = []

    def frame(index):
        traced.append(index)
        moved = corners + np.repeat([[0.0, 0.0, 0.0], [2.0 + 0.1 * index, 0.0, 0.0]], len(ball.vertices), axis=0)
        return moved, np.broadcast_to(np.eye(3), (len(moved), 3, 3))

    bake(store, frame, faces, np.arange(12), BAKE)
    return traced


@pytest.mark.parametrize("array", ["visibility", "checksum"])
def test_torn_chunks_are_baked_again(tmp_path, array):
    assert tiny_bake(tiny_store(tmp_path / "s")) == [0, 1, 2, 3]
    whole = tiny_store(tmp_path / "s").read()
    (chunk,) = [p for p in (tmp_path / "s" / array / "c" / "2").rglob("*") if p.is_file()] or [
        tmp_path / "s" / array / "c" / "2"
    ]
    data = chunk.read_bytes()
    flipped = [data[:i] + bytes([data[i] ^ 0x10]) + data[i + 1 :] for i in range(0, len(data), 3)]
    for torn in [*(data[:size] for size in range(0, len(data), 5)), *flipped]:
        chunk.write_bytes(torn)
        store = tiny_store(tmp_path / "s")
        # zstd has spare bits: what decodes to the same bytes is as good.
        assert list(store.missing()) in ([2], []) or array == "checksum"
        if list(store.missing()) == [2]:
            with pytest.raises(InputError, match="frame 2"):
                store.read()
            assert tiny_bake(store) == [2]
        np.testing.assert_array_equal(store.read(), whole)


def test_a_store_is_made_whole_and_leftovers_go(tmp_path):
    (tmp_path / ".s.0123abcd").mkdir()
    store = tiny_store(tmp_path / "s")
    assert [p.name for p in tmp_path.iterdir()] == ["s"]
    (tmp_path / "s" / "visibility" / "c.0123.partial").write_bytes(b"half")
    tiny_bake(store)
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"source": "b", "run": {"bake": {"seed": 1}}},
            "bake.seed: expected 0, as it was baked, got 1; take another -o",
        ),
        ({"source": "b"}, "source: expected a, as it was baked, got b; take another -o, or delete this folder, or add"),
        ({"num_points": 13}, "num_points: expected 12, as it was baked, got 13"),
    ],
)
def test_a_store_of_something_else_is_refused_and_stays(tmp_path, changes, words):
    tiny_bake(tiny_store(tmp_path / "s"))
    with pytest.raises(InputError, match=f"s: {words}"):
        tiny_store(tmp_path / "s", **changes)
    assert list(tiny_store(tmp_path / "s").missing()) == []
    # Settings that change nothing of what is stored may differ.
    assert list(tiny_store(tmp_path / "s", run={"bake": {"seed": 1}}).missing()) == []
    remove_store(tmp_path / "s")
    assert list(tiny_store(tmp_path / "s", **changes).missing()) == [0, 1, 2, 3]


@pytest.mark.parametrize("file", ["zarr.json", "visibility/zarr.json", "checksum/zarr.json"])
@pytest.mark.parametrize("size", [0, 40])
def test_a_store_with_a_damaged_description_is_refused(tmp_path, file, size):
    tiny_bake(tiny_store(tmp_path / "s"))
    path = tmp_path / "s" / file
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(InputError, match=r"s: (header|store): expected .* --restart"):
        tiny_store(tmp_path / "s")


def test_only_one_process_bakes(tmp_path):
    store = tiny_store(tmp_path / "s")
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match=f"lock: .*process {process.pid}"):
        tiny_bake(store)
    process.kill()
    process.wait()
    process.stdout.close()
    assert tiny_bake(store) == [0, 1, 2, 3]


def test_a_whole_store_is_read_while_another_process_writes_beside_it(tmp_path):
    tiny_bake(tiny_store(tmp_path / "s"))
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    assert tiny_bake(tiny_store(tmp_path / "s")) == []
    process.kill()
    process.wait()
    process.stdout.close()


# --- All of it, with writes and memory that fail


@contextlib.contextmanager
def full_after(count, monkeypatch):
    """A disk on which `count` more files fit."""
    replace, left = os.replace, iter(range(count))

    def fails(*places, **options):
        if next(left, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(*places, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fails)
        yield


def small_run(data, folder):
    """Bake, fit and evaluation on made-up data; the bytes of the model and the numbers."""
    with console.keeping(f"kept in {folder}"), only_writer(folder):
        tiny_bake(tiny_store(folder / "bake.zarr"))
        parts = Checkpoint(folder / "unfinished", run=RUN)
        model = fit_model(data, FIT, ridge=0.01, checkpoint=parts)
        found = evaluate(data, model, FIT, ridge=0.01, study=False, checkpoint=parts)
        save_pose_model(folder / MODEL_FILE, model, {"errors": found.summary()})
    return (folder / MODEL_FILE).read_bytes(), to_jsonable(found.as_dict())


def test_a_disk_that_is_full_at_any_file_costs_no_more_than_that_file(data, tmp_path, monkeypatch, capsys):
    # About twenty files, hence twenty runs that fail and twenty that continue: some seconds.
    expected = small_run(data, tmp_path / "whole")
    for count in range(100):
        folder = tmp_path / str(count)
        with full_after(count, monkeypatch):
            status = console.run_command(lambda folder=folder: small_run(data, folder))
        if status == 0:
            break
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert status == 2 and line.startswith(f"jaxrender: error: {folder}/")
        assert line.endswith(f": No space left on device; kept in {folder}")
        assert not [p for p in folder.rglob("*") if p.name.startswith(".") or p.suffix == ".partial"]
        assert small_run(data, folder) == expected
    assert 15 < count < 40


@pytest.mark.parametrize("fails", [lambda: np.zeros(1 << 60, np.uint8), lambda: jnp.zeros(1 << 50, jnp.uint8)])
def test_too_little_memory_ends_with_one_line_and_keeps_what_is_done(data, tmp_path, monkeypatch, capsys, fails):
    from fitting import fit

    solve, calls = fit.fit_block, []

    def solve_one(*arguments):
        calls.append(1)
        return solve(*arguments) if len(calls) == 1 else jax.block_until_ready(fails())

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(fit, "fit_block", solve_one)
        assert console.run_command(lambda: small_run(data, folder)) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("jaxrender: error: not enough memory: ") and line.endswith(f"; kept in {folder}")
    assert len(list((folder / "unfinished" / "fit").glob("0*.part"))) == 1
    assert small_run(data, folder) == small_run(data, tmp_path / "whole")
