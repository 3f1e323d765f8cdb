"""The frame of the benchmarks: records, tables, timing, memory, the command. No times are judged."""

import json
import types

import numpy as np
import pytest

from benchmarks import cli, metadata, report, suites, timing
from jaxrender.checks import InputError

ENVIRONMENT = {
    "device": "cpu",
    "cpu": "C",
    "cores": 2,
    "jax": "0",
    "python": "3",
    "commit": None,
    "date": "d",
}


def fake_suite(options):
    for case in ("small", "large"):
        if options.wants(case):
            yield suites.Measurement(case, "ours", {"ms_median": 1.5, "psnr_db": np.inf}, {"n": 3})
            yield suites.Measurement(case, "peer", {"ms_median": np.float32(2.0)}, {"n": 3, "threads": 2})


@pytest.fixture
def fake(monkeypatch):
    """Replaces the table of suites by one suite that measures nothing."""
    module = types.SimpleNamespace(__doc__="What it measures.\n\nMore.", run=fake_suite)
    monkeypatch.setattr(suites, "SUITES", {"fake": "-"})
    monkeypatch.setattr(suites.importlib, "import_module", lambda name: module)
    return module


def test_list(fake, capsys):
    assert cli.main(["list"]) == 0
    assert capsys.readouterr().out == "fake: What it measures.\n"
    assert cli.main(["list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"suites": {"fake": "What it measures."}}


def test_run_writes_strict_records_and_report_reads_them(fake, tmp_path, capsys):
    path = tmp_path / "deep" / "r.json"
    assert cli.main(["run", "fake", "--json", str(path), "--seed", "7"]) == 0
    records = json.loads(path.read_text(), parse_constant=lambda text: pytest.fail(text))
    assert [(r["case"], r["variant"]) for r in records] == [
        ("small", "ours"), ("small", "peer"), ("large", "ours"), ("large", "peer"),
    ]  # fmt: skip
    assert set(records[0]) == {"suite", "case", "variant", "params", "metrics", "environment"}
    assert records[0]["metrics"] == {"ms_median": 1.5, "psnr_db": None}
    assert records[0]["environment"]["seed"] == 7 and records[0]["environment"]["cores"] >= 1
    out = capsys.readouterr().out
    assert "| small | peer" in out and out.endswith(f"wrote {path}\n")

    assert cli.main(["report", str(path), "--html", str(tmp_path / "r.html")]) == 0
    assert "## fake" in capsys.readouterr().out
    assert "peer" in (tmp_path / "r.html").read_text()


def test_cases_are_chosen_by_pattern(fake, tmp_path, capsys):
    assert cli.main(["run", "--json", str(tmp_path / "r.json"), "--cases", "sm*"]) == 0
    assert {r["case"] for r in report.read_records(tmp_path / "r.json")} == {"small"}
    assert cli.main(["run", "--json", str(tmp_path / "r.json"), "--cases", "none"]) == 2
    assert "--cases: expected a pattern that matches" in capsys.readouterr().err


def test_an_interrupt_keeps_what_was_measured(fake, tmp_path, capsys):
    def run(options):
        yield suites.Measurement("a", "ours", {"ms_median": 1.0})
        raise KeyboardInterrupt

    fake.run = run
    assert cli.main(["run", "--json", str(tmp_path / "r.json")]) == 130
    assert [r["case"] for r in report.read_records(tmp_path / "r.json")] == ["a"]
    assert "what was measured so far is in" in capsys.readouterr().err


def test_unknown_suite_and_unwritable_file(tmp_path, capsys):
    assert cli.main(["run", "nosuch", "--json", str(tmp_path / "r.json")]) == 2
    assert "jaxrender: error: suite: expected one of" in capsys.readouterr().err
    assert not (tmp_path / "r.json").exists()


def test_the_file_is_tried_before_anything_is_measured(fake, tmp_path, capsys):
    fake.run = lambda options: pytest.fail("must not be measured")
    (tmp_path / "file").touch()
    assert cli.main(["run", "fake", "--json", str(tmp_path / "file" / "r.json")]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"jaxrender: error: {tmp_path / 'file'}: Not a directory"


def test_listed_suites_can_be_loaded():
    for name in suites.SUITES:
        assert suites.describe_suite(name).endswith(".")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "content: expected JSON"),
        ("{}", "content: expected a list of records, got dict"),
        ("[1]", "record 0: suite: expected str"),
        ('[{"suite": "a", "case": "b", "variant": "c", "params": [], "metrics": {}, "environment": {}}]',
         "record 0: params: expected dict, got list"),
    ],
)  # fmt: skip
def test_bad_files(tmp_path, content, message):
    (tmp_path / "r.json").write_text(content)
    with pytest.raises(InputError, match=message):
        report.read_records(tmp_path / "r.json")


def test_tables_hold_every_column():
    rows = [
        suites.Measurement("a", "ours", {"ms_median": 1.0}, {"n": 1}),
        suites.Measurement("a", "peer", {"mse": 0.5}, {"m": 2}),
    ]
    records = [report.make_record("s", row, ENVIRONMENT) for row in rows]
    columns, cells = report.tabulate(records)
    assert columns == ["case", "variant", "n", "m", "ms_median", "mse"]
    assert cells == [["a", "ours", 1, None, 1.0, None], ["a", "peer", None, 2, None, 0.5]]
    lines = report.format_markdown(records).splitlines()
    assert len({len(line) for line in lines if line.startswith("|")}) == 1


def test_timing_separates_the_first_call_and_gives_quartiles(monkeypatch):
    seconds = iter([0.5, 0.003, 0.001, 0.002, 0.005, 0.004])
    monkeypatch.setattr(timing, "_seconds", lambda function: function() or next(seconds))
    calls = []
    found = timing.measure(calls.append, 7, min_runs=5, min_seconds=0.0)
    assert calls == [7] * 6 and found.num_runs == 5
    assert found.metrics() == pytest.approx({"compile_ms": 497, "ms_median": 3, "ms_q1": 2, "ms_q3": 4})


def test_runs_go_on_until_enough_time_has_passed(monkeypatch):
    monkeypatch.setattr(timing, "_seconds", lambda function: 0.25)
    assert timing.measure(lambda: None, min_runs=2, min_seconds=2.0).num_runs == 8
    assert timing.measure(lambda: None, min_runs=2, min_seconds=2.0, max_runs=5).num_runs == 5


def test_the_result_is_waited_for(monkeypatch):
    waited = []
    monkeypatch.setattr(timing.jax, "block_until_ready", waited.append)
    timing.measure(lambda: "result", min_runs=2, min_seconds=0.0)
    assert waited == ["result"] * 3


def test_variants_alternate():
    order = []
    timing.measure_alternating(
        {"a": lambda: order.append("a"), "b": lambda: order.append("b")},
        min_runs=3,
        min_seconds=0.0,
        max_runs=3,
    )
    assert "".join(order) == "ab" * 4
    with pytest.raises(ValueError, match="at least one"):
        timing.measure_alternating({})


def test_one_run_is_enough_for_a_summary():
    found = timing.measure(lambda: None, min_runs=1, min_seconds=0.0, max_runs=1)
    assert found.ms_q1 == found.ms_median == found.ms_q3


def test_peak_memory_sees_what_is_gone_again():
    with timing.peak_memory() as peak:
        block = np.ones(64 * 2**20, np.uint8)
        del block
    assert 60 * 2**20 <= peak.peak_bytes < 200 * 2**20


def test_environment_is_flat_and_complete():
    found = metadata.environment()
    assert {"commit", "jax", "numpy", "python", "device", "cpu", "cores", "date"} <= set(found)
    assert all(value is None or isinstance(value, str | int | bool) for value in found.values())
