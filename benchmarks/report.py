"""Benchmark records: built, written, read back, and set out as tables.

A file is a list of objects {suite, case, variant, params, metrics, environment}, in strict JSON.
"""

import json
import os
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import benchmarks.suites
from jaxrender import checks, console
from jaxrender.io.atomic import write_bytes
from jaxrender.io.report import Report, format_cell

Record = dict[str, Any]

_FIELDS = {"suite": str, "case": str, "variant": str, "params": dict, "metrics": dict, "environment": dict}


def make_record(suite: str, measurement: benchmarks.suites.Measurement, environment: Mapping[str, Any]) -> Record:
    """The record of one measurement; a metric that is infinite or NaN (psnr_db of equal images) is null."""
    return console.to_jsonable(
        {
            "suite": suite,
            "case": measurement.case,
            "variant": measurement.variant,
            "params": measurement.params,
            "metrics": measurement.metrics,
            "environment": environment,
        }
    )


def write_records(path: str | os.PathLike, records: Sequence[Record]) -> None:
    """Writes all records, replacing the file as a whole."""
    write_bytes(path, (json.dumps(list(records), indent=1, allow_nan=False) + "\n").encode())


def read_records(path: str | os.PathLike) -> list[Record]:
    """Reads a file of records.

    Raises:
      InputError: if it is not JSON or not a list of records. OSError: if it cannot be read.
    """
    try:
        records = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except ValueError as error:  # not UTF-8, or not JSON
        checks.bad_input(path, "content", expected="JSON", got=error)
    if not isinstance(records, list):
        checks.bad_input(path, "content", expected="a list of records", got=type(records).__name__)
    for index, record in enumerate(records):
        for name, kind in _FIELDS.items():
            value = record.get(name) if isinstance(record, dict) else None
            if not isinstance(value, kind):
                expected, got = kind.__name__, type(value).__name__
                checks.bad_input(path, f"record {index}: {name}", expected=expected, got=got)
    return records


def tabulate(records: Iterable[Record]) -> tuple[list[str], list[list[Any]]]:
    """Column heads and rows: case, variant, every parameter, every metric; None where a record has none."""
    records = list(records)
    params = list(dict.fromkeys(name for record in records for name in record["params"]))
    metrics = list(dict.fromkeys(name for record in records for name in record["metrics"]))
    rows = [
        [
            record["case"],
            record["variant"],
            *(record["params"].get(name) for name in params),
            *(record["metrics"].get(name) for name in metrics),
        ]
        for record in records
    ]
    return ["case", "variant", *params, *metrics], rows


def format_markdown(records: Sequence[Record]) -> str:
    """The records as Markdown tables, one per suite, to read in a terminal and to paste into a document."""
    parts = []
    for suite, members in _by_suite(records).items():
        columns, rows = tabulate(members)
        texts = [columns, *([format_cell(value) for value in row] for row in rows)]
        widths = [max(len(line[i]) for line in texts) for i in range(len(columns))]
        lines = ["| " + " | ".join(t.ljust(w) for t, w in zip(line, widths, strict=True)) + " |" for line in texts]
        lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
        parts.append(f"## {suite}\n\n{describe_environment(members[0]['environment'])}\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def write_page(path: str | os.PathLike, records: Sequence[Record]) -> pathlib.Path:
    """The records as one HTML page."""
    page = Report("Benchmarks", subtitle="Milliseconds are medians; q1 and q3 are the quartiles.")
    for suite, members in _by_suite(records).items():
        columns, rows = tabulate(members)
        page.section(suite).table(rows, columns)
        page.facts(members[0]["environment"])
    return page.write(path)


def describe_environment(environment: Mapping[str, Any]) -> str:
    """One sentence: the machine, the versions, the commit, the day."""
    commit = str(environment.get("commit") or "unknown")[:10]
    changed = " with changes" if environment.get("uncommitted_changes") else ""
    return (
        f"{environment.get('device')} on {environment.get('cpu')}, {environment.get('cores')} cores; "
        f"jax {environment.get('jax')}, Python {environment.get('python')}; "
        f"commit {commit}{changed}, {environment.get('date')}"
    )


def _by_suite(records: Iterable[Record]) -> dict[str, list[Record]]:
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record["suite"], []).append(record)
    return groups
