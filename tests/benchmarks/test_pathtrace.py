"""The suite `pathtrace` on small inputs: its rows are there, with finite numbers that fit together."""

import math

import pytest

from benchmarks import pathtrace
from benchmarks.suites import Options


@pytest.mark.data
def test_rows_are_complete_and_finite(shared_data, tmp_path, monkeypatch):
    monkeypatch.setattr(pathtrace, "FOLDER", tmp_path)
    rows = list(pathtrace.run(Options(cases=("table1", "rays", "quality", "final"), quick=True)))
    names = [(row.case, row.variant) for row in rows]
    assert names == [
        ("table1", "traced"), ("table1", "whole"), *[("rays", "embree"), ("rays", "jax")] * 3,
        *(("quality", name) for name in ("unfiltered", "guided", "bilateral", "atrous")), ("final", "plain"),
        ("final", "ratio"),
    ]  # fmt: skip
    assert all(math.isfinite(value) for row in rows for value in row.metrics.values())
    errors = {row.variant: row.metrics["mse_255"] for row in rows if row.case == "quality"}
    assert errors["guided"] < 0.3 * errors["unfiltered"]
    final = {row.variant: row.metrics["mse_255_direct"] for row in rows if row.case == "final"}
    assert final["ratio"] < final["plain"]
    # A second call takes the reference from the folder.
    assert [file.name for file in tmp_path.iterdir()] == ["cornell_64x48_16.npz"]
