"""The suite `resume` with two kills: that its rows say what happened. Some five processes, hence half a minute."""

from benchmarks import resume as suite
from benchmarks.suites import Options


def test_killed_trainings_end_with_the_same_model():
    *rows, total = suite.run(Options(quick=True))
    assert total.variant == "all" and total.metrics["kills"] == sum(row.metrics["kills"] for row in rows) == 2
    assert total.metrics["folders_equal"] == total.metrics["folders"] == len(rows)
    assert total.metrics["parts_twice"] == 0
