"""`python -m benchmarks`: lists suites, runs them, sets out what they found."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks import metadata, report, suites
from jaxrender import console


@dataclass(frozen=True)
class List:
    """Lists the suites and what each measures."""

    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        found = {name: suites.describe_suite(name) for name in suites.SUITES}
        if self.json:
            console.print_json({"suites": found})
            return
        for name, line in found.items():
            print(f"{name}: {line}")


@dataclass(frozen=True)
class Run:
    """Runs suites and writes their records as a JSON list, anew after each measurement."""

    # JAX's compilation cache stays off here: it would turn compile_ms into the time to read a file.

    suite: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of suites; all of them by default."""
    json: Path = Path("out/benchmarks.json")
    """The file to write."""
    cases: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PATTERN ...")] = ("*",)
    """Only cases whose name matches one of these patterns."""
    quick: bool = False
    """Small inputs and few repetitions: to see that a suite works, not how fast."""
    seed: int = 0
    """Seed of the inputs."""

    def run(self) -> None:
        names = self.suite or tuple(suites.SUITES)
        modules = {name: suites.load_suite(name) for name in names}
        options = suites.Options(cases=self.cases, quick=self.quick, seed=self.seed)
        environment = {**metadata.environment(), "quick": self.quick, "seed": self.seed}
        console.announce_device()
        records: list[report.Record] = []
        report.write_records(self.json, records)  # a path that cannot be written fails now, not in an hour
        with console.keeping(f"what was measured so far is in {self.json}"):
            for name, module in modules.items():
                for measurement in module.run(options):
                    records.append(report.make_record(name, measurement, environment))
                    report.write_records(self.json, records)
                    time = measurement.metrics.get("ms_median")
                    said = "" if time is None else f": {report.format_cell(float(time))} ms"
                    console.announce(f"{name} {measurement.case} {measurement.variant}{said}")
        if not records:
            raise ValueError(f"--cases: expected a pattern that matches a case, got {' '.join(self.cases)}")
        print(report.format_markdown(records))
        console.finish(paths=[self.json], record={}, as_json=False)


@dataclass(frozen=True)
class Show:
    """Sets out files of records as tables."""

    files: tyro.conf.Positional[tuple[Path, ...]] = (Path("out/benchmarks.json"),)
    """Files that `run` wrote."""
    html: Path | None = None
    """Also write the tables as an HTML page."""

    def run(self) -> None:
        records = [record for file in self.files for record in report.read_records(file)]
        print(report.format_markdown(records))
        if self.html is not None:
            console.finish(paths=[report.write_page(self.html, records)], record={}, as_json=False)


def main(argv: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    commands = (
        Annotated[List, tyro.conf.subcommand("list")]
        | Annotated[Run, tyro.conf.subcommand("run")]
        | Annotated[Show, tyro.conf.subcommand("report")]
    )
    return console.run_command(lambda: console.parse(commands, prog="python -m benchmarks", argv=argv).run())
