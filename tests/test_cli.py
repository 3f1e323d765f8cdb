"""The manners of the commands: exit status, one line of error, progress, JSON, the cache, the doctor."""

import dataclasses
import errno
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from jaxrender import checks, cli, console, doctor, machine


@pytest.fixture(autouse=True)
def no_debug(monkeypatch):
    monkeypatch.delenv(console.DEBUG_VARIABLE, raising=False)


@pytest.fixture
def jax_cache():
    """Puts JAX's cache settings back."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def fails_with(error):
    def main():
        raise error

    return main


# --- Exit status and errors


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (checks.InputError("a.glb: joints: expected 4,\n  got 5"), 2, "a.glb: joints: expected 4, got 5"),
        (ValueError("order: expected a value >= 1, got 0"), 2, "order: expected a value >= 1, got 0"),
        (FileNotFoundError(errno.ENOENT, "No such file", "x.glb"), 2, "x.glb: No such file"),
        (OSError(errno.ENOSPC, "No space left on device", "out/m"), 2, "out/m: No space left on device"),
        (PermissionError(errno.EACCES, "Permission denied", "/out"), 2, "/out: Permission denied"),
        (OSError("odd"), 2, "odd"),
        (MemoryError(), 2, "not enough memory"),
        (KeyError("x"), 1, "internal error: KeyError: 'x' (set JAXRENDER_DEBUG=1 for the traceback)"),
    ],
)
def test_errors_are_one_line(error, status, line, capsys):
    assert console.run_command(fails_with(error)) == status
    assert capsys.readouterr() == ("", f"jaxrender: error: {line}\n")


def test_long_lines_are_not_broken(capsys):
    console.run_command(fails_with(checks.InputError("x" * 500 + " " + "y" * 500)))
    assert capsys.readouterr().err.count("\n") == 1


def test_markup_in_names_is_left_alone(capsys):
    console.run_command(fails_with(checks.InputError("[bold]file[/red].glb :smile:")))
    assert "[bold]file[/red].glb :smile:" in capsys.readouterr().err


def test_debug_lets_the_traceback_through(monkeypatch):
    monkeypatch.setenv(console.DEBUG_VARIABLE, "1")
    with pytest.raises(KeyError):
        console.run_command(fails_with(KeyError("x")))


def test_success_and_system_exit():
    assert console.run_command(lambda: None) == 0
    assert console.run_command(fails_with(SystemExit(2))) == 2
    assert console.run_command(fails_with(SystemExit())) == 0


def test_interrupt_says_what_was_kept(capsys):
    def main():
        with console.keeping("12 frames are in out/bake; the same command goes on from there"):
            raise KeyboardInterrupt

    assert console.run_command(main) == 130
    assert capsys.readouterr().err == "interrupted; 12 frames are in out/bake; the same command goes on from there\n"


@pytest.mark.parametrize(
    ("number", "status", "said"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)
def test_interrupt_of_a_real_process(number, status, said):
    code = """
import signal, time
from jaxrender import console
signal.signal(signal.SIGINT, signal.default_int_handler)  # which is off in a job that runs in the background
def main():
    with console.keeping("kept"):
        print("ready", flush=True)
        time.sleep(60)
raise SystemExit(console.run_command(main))
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == status and err == f"{said}; kept\n"


def test_a_reader_that_goes_away():
    code = """
from jaxrender import console
def main():
    for i in range(100_000): print(i)
raise SystemExit(console.run_command(main))
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.readline()
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=30) == 141 and err == b""


# --- Parsing


@pytest.mark.parametrize(
    "argv",
    [
        [], ["unknown"], ["demo", "--no-such-option"], ["demo", "--seed", "x"], ["relight", "--fps", "0"],
        ["relight", "--size", "0", "4"], ["relight", "--exponents", "1", "2", "3"], ["doctor", "extra"],
    ],
)  # fmt: skip
def test_usage_errors_end_with_2_and_no_traceback(argv, capsys):
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == "" and err and "Traceback" not in err


@pytest.mark.parametrize("argv", [["--help"], ["demo", "--help"], ["relight", "-h"], ["doctor", "-h"]])
def test_help(argv, capsys):
    assert cli.main(argv) == 0
    assert "usage: jaxrender" in capsys.readouterr().out


def test_the_package_is_a_command():
    done = subprocess.run([sys.executable, "-m", "jaxrender", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("jaxrender ")


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("jaxrender 0.")


@dataclasses.dataclass(frozen=True)
class Probe:
    """A command."""

    path: pathlib.Path = pathlib.Path("x")
    """A path."""
    fast: bool = False
    """A flag."""


def test_parse_gives_the_record():
    assert console.parse(Probe, prog="probe", argv=["--path", "y", "--fast"]) == Probe(pathlib.Path("y"), True)


# --- Progress


def test_plain_progress_is_a_few_lines(capsys):
    with console.progress("bake", total=1000, unit="frames", done=200) as advance:
        for _ in range(800):
            advance(1)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "bake: 800 frames (200 of 1000 are there already)"
    assert [line.split()[1] for line in lines[1:]] == [f"{n}/1000" for n in range(300, 1001, 100)]
    assert lines[-1].startswith("bake: 1000/1000 frames in ")


def test_progress_that_fails_does_not_claim_to_be_done(capsys):
    with pytest.raises(KeyError), console.progress("bake", total=4):
        raise KeyError
    assert capsys.readouterr().err == "bake: 4\n"


def test_track_passes_items_on(capsys):
    assert list(console.track("abc", "letters", total=3)) == ["a", "b", "c"]
    assert "letters: 3/3 in" in capsys.readouterr().err


def test_progress_bar_on_a_terminal(monkeypatch, capsys):
    import rich.console

    monkeypatch.setattr(console, "_stderr", rich.console.Console(stderr=True, force_terminal=True, width=90))
    with console.progress("bake", total=2, unit="frames") as advance:
        advance(2)
    err = capsys.readouterr().err
    assert "bake" in err and "2/2" in err and "frames" in err


def test_compiling_says_what_and_how_long(capsys):
    with console.compiling("the relighting step"):
        pass
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "compiling the relighting step ..."
    assert lines[1].startswith("compiled the relighting step in 0.")


def test_device_line(capsys):
    console.announce_device(rays="Embree, 2 threads")
    assert capsys.readouterr().err.endswith("; rays: Embree, 2 threads\n")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.94, "9.9 s"),
        (9.96, "10 s"),
        (59.4, "59 s"),
        (59.6, "1 min 0 s"),
        (3700, "1 h 1 min"),
    ],
)
def test_format_seconds(seconds, text):
    assert console.format_seconds(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (1000, "1.0 kB"),
        (1.25e6, "1.2 MB"),
        (11.2e9, "11.2 GB"),
        (2e15, "2000.0 TB"),
    ],
)
def test_format_bytes(count, text):
    assert console.format_bytes(count) == text


# --- JSON


def test_json_is_strict_and_takes_what_we_have(capsys):
    console.print_json(
        {
            "record": Probe(),
            "array": np.arange(3, dtype=np.float32),
            "jax": jax.numpy.ones(2),
            "nan": float("nan"),
            "number": np.float64(0.5),
            "path": pathlib.Path("a/b"),
            "tuple": (1, None, True, "ä"),
        }
    )
    assert json.loads(capsys.readouterr().out) == {
        "record": {"path": "x", "fast": False},
        "array": [0, 1, 2],
        "jax": [1, 1],
        "nan": None,
        "number": 0.5,
        "path": "a/b",
        "tuple": [1, None, True, "ä"],
    }
    with pytest.raises(TypeError, match="cannot be written as JSON: object"):
        console.to_jsonable(object())


def test_finish(capsys):
    console.finish(paths=["a", pathlib.Path("b")], record={"error": 0.5}, as_json=False)
    assert capsys.readouterr().out == "wrote a\nwrote b\n"
    console.finish(paths=["a", pathlib.Path("b")], record={"error": 0.5}, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"error": 0.5, "paths": ["a", "b"]}


# --- The compilation cache


def test_cache_follows_the_environment(tmp_path, monkeypatch, jax_cache):
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = console.enable_compilation_cache()
    assert path.parent == tmp_path / "jaxrender" and path.is_dir() and not list(path.iterdir())
    assert jax.config.jax_compilation_cache_dir == str(path)


def test_a_chosen_cache_is_kept(tmp_path, jax_cache):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    assert console.enable_compilation_cache() == tmp_path / "mine"


def test_a_cache_that_cannot_be_written_only_warns(tmp_path, jax_cache, capsys):
    (tmp_path / "file").touch()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "file" / "cache"))
    assert console.enable_compilation_cache() is None
    assert capsys.readouterr().err.startswith("jaxrender: warning: compiled programs are not kept")
    assert jax.config.jax_compilation_cache_dir is None


def test_the_cache_holds_programs_and_is_used_again(tmp_path):
    code = """
import jax, jax.numpy as jnp
from jaxrender import console
console.enable_compilation_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((8, 8))).block_until_ready()
"""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    counts = []
    for _ in range(2):
        subprocess.run([sys.executable, "-c", code], check=True, env=environment)
        counts.append(len(list(tmp_path.glob("*-cache"))))
    assert counts[0] > 0 and counts[1] == counts[0]


# --- The doctor


def test_doctor_as_json_is_complete(capsys, tmp_path, monkeypatch, jax_cache):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    assert cli.main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["packages"]["jax"] == jax.__version__
    assert found["machine"]["cores"] == machine.num_cores() >= 1
    assert found["devices"]["devices"][0]["platform"] == jax.devices()[0].platform
    assert found["rays"]["works"] and found["rays"]["version"]
    assert found["compilation_cache"] == {"path": str(tmp_path), "writable": True, "bytes": 0, "programs": 0}
    assert {extra["name"] for extra in found["extras"]} == set(doctor.EXTRAS)
    assert found["problems"] == []


def test_doctor_for_people(capsys):
    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out
    for text in ("Machine", "Versions", "Extras", "Embree", jax.__version__, "All is well."):
        assert text in out


def test_doctor_names_what_is_missing(monkeypatch, capsys, tmp_path, jax_cache):
    (tmp_path / "file").touch()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "file" / "cache"))
    known = doctor.package_version
    monkeypatch.setattr(doctor, "package_version", lambda name: None if name in ("matplotlib", "zarr") else known(name))
    monkeypatch.setitem(sys.modules, "embreex", None)
    assert cli.main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert 'missing: matplotlib; pip install ".[plots]"' in out
    assert "Problem: the package zarr is missing" in out
    assert "Problem: no ray backend" in out
    assert "cannot be written" in out


def test_every_extra_is_described_and_read_from_the_metadata():
    extras = {extra["name"]: extra for extra in doctor.examine()["extras"]}
    assert all(extra["adds"] for extra in extras.values())


def test_progress_time_left(monkeypatch, capsys):
    clock = iter([0.0, 0.0, 40.0, 41.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    with console.progress("bake", total=100) as advance:
        advance(4)
    lines = capsys.readouterr().err.splitlines()
    assert lines[1] == "bake: 4/100, 16 min 0 s left"
