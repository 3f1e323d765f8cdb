"""The HTML report of a training run: pictures, plots, tables, settings, timings. Opens offline."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from fitting.config import TrainSettings
from fitting.evaluate import Evaluation
from fitting.motion import PART_NAMES
from fitting.study import Study
from fitting.study.lobes import count_lobes
from fitting.train import TrainResult
from jaxrender import console
from jaxrender.io.report import Report
from jaxrender.machine import cpu_model, num_cores

REPORT_FILE = "report.html"
SETS = {"train": "training", "segments": "held-out segments", "clips": "held-out clips"}


def write_report(
    out: Path,
    result: TrainResult,
    settings: TrainSettings,
    evaluation: Evaluation,
    model_path: Path,
    pictures: list[tuple[Path, str]],
) -> Path:
    """Writes `report.html` into `out`.

    Args:
      pictures: files and captions, shown in this order.
    """
    report = Report(f"{evaluation.name}: visibility from the pose", subtitle=_subtitle(result, evaluation))
    _summary(report, result, evaluation, model_path)
    report.section("Pictures")
    for path, caption in pictures:
        report.image(path, caption)
    _errors(report, result, evaluation)
    if evaluation.study is not None:
        _study(report, evaluation.study)
    _run(report, result, settings)
    return Path(report.write(out / REPORT_FILE))


def _subtitle(result: TrainResult, evaluation: Evaluation) -> str:
    counts = [(PART_NAMES[part], int((result.data.part == part).sum())) for part in range(4)]
    frames = ", ".join(f"{count} of {name}" for name, count in counts if count)
    return f"{evaluation.num_points} shading points, {count_lobes(result.model.num_lobes)}; frames: {frames}"


def _summary(report: Report, result: TrainResult, evaluation: Evaluation, model_path: Path) -> None:
    report.section("In short")
    weights = np.asarray(result.model.weights)
    facts: dict[str, Any] = {
        f"SH error, {SETS[name]}": row and row["global"] for name, row in evaluation.errors.items()
    }
    facts |= {f"mean visibility alone, {SETS[n]}": r and r["global"] for n, r in evaluation.baseline.items()}
    facts |= {
        "points that see nothing (masked)": f"{evaluation.invisible_share:.1%}",
        "ridge": result.ridge,
        "model file": console.format_bytes(model_path.stat().st_size),
        "pose matrices": f"{console.format_bytes(weights.nbytes)} as {weights.dtype}",
        "pose components": len(weights) - 1,
        "traced": f"{result.bake.num_rays / 1e6:.0f} M rays at {result.bake.rays_per_second / 1e6:.1f} M per second",
    }
    report.facts({name: "-" if value is None else value for name, value in facts.items()})
    report.note(
        "SH error is the global relative L2 error against the SH projection of the traced visibility: the root of "
        "the squared error summed over points and frames, over the same sum of the truth. Held-out segments are the "
        "last part of every training clip, held-out clips were never seen. Points that see nothing are left out."
    )


def _errors(report: Report, result: TrainResult, evaluation: Evaluation) -> None:
    report.section("Errors of the model")
    rows = []
    for name, row in evaluation.errors.items():
        if row is not None:
            bands = {f"band {l}": value for l, value in enumerate(row["bands"])}
            rows.append({"frames": SETS[name], "global": row["global"], "mean per point": row["mean_relative"]} | bands)
    report.table(rows, caption="Relative L2 in SH; a band is measured against its own norm.")
    frames = evaluation.frames

    def draw(figure):
        axes = figure.subplots()
        for part in (0, 1, 2):
            own = np.flatnonzero(frames.part == part)
            if len(own):
                axes.errorbar(
                    own, frames.curve["mean"][own], frames.curve["std"][own], fmt=".", markersize=3, elinewidth=0.4,
                    label=PART_NAMES[part],
                )  # fmt: skip
        axes.set(xlabel="frame", ylabel="relative error, mean ± std over points", ylim=(0, None))
        axes.legend()

    report.plot(draw, "Error per frame over the points.")
    clips = [{key: value for key, value in row.items() if not isinstance(value, list)} for row in evaluation.clips]
    if clips:
        report.table(clips, caption="By clip.")


def _study(report: Report, study: Study) -> None:
    report.section("Against other methods")
    best = {f"{column}, {SETS[s]}": "min" for column in ("SH", "sun", "sky") for s in SETS}
    report.table(
        _method_table(study.rows),
        caption=f"{len(study.points)} points, the same frames and ridge. SH: relative L2. sun, sky: relative RMS of "
        "diffuse shading under order-4 lamps and an order-4 sky, against the traced bits under the same lights.",
        best={name: kind for name, kind in best.items() if name in _method_table(study.rows)[0]},
    )
    if study.subset_rows:
        report.table(
            _method_table(study.subset_rows),
            caption="Methods that fit lobes to every frame on its own, with others for comparison, on fewer points.",
        )
    report.table([dataclasses.asdict(goal) for goal in study.goals], caption="Goals.")
    report.section("The paper's figures")
    for title, series in (("Figure 3", study.figure3), ("Figure 5", study.figure5)):
        _figure(report, title, series)
    report.section("Ridge and generalisation")
    _ridge_plot(report, study.ridge_curve)
    if study.gains:
        report.table(_flat(study.gains), caption="Linear model on 16 SH coefficients: what helps on unseen motion.")


def _method_table(rows) -> list[dict]:
    table = []
    for row in rows:
        line = {"method": row.method, "numbers": row.numbers}
        for label, values in (("SH", row.sh), ("sun", row.directional), ("sky", row.environment)):
            line |= {f"{label}, {SETS[s]}": values.get(s) for s in SETS if any(r.sh.get(s) is not None for r in rows)}
        table.append(line | {"note": row.note})
    return table


def _figure(report: Report, title: str, series: list[dict]) -> None:
    def draw(figure):
        axes = figure.subplots()
        for one in series:
            curve = one["curve"]
            line = axes.plot(curve["mean"], linewidth=1.0, label=one["name"])[0]
            low, high = curve["mean"] - curve["std"], curve["mean"] + curve["std"]
            axes.fill_between(np.arange(len(low)), low, high, color=line.get_color(), alpha=0.12, linewidth=0)
        axes.set(xlabel="frame", ylabel="relative error, mean and std", ylim=(0, None))
        axes.legend()

    report.plot(draw, f"{title}: error per frame, mean and standard deviation over points.")
    report.table(_flat([{k: v for k, v in one.items() if k != "curve"} for one in series]), caption=title)


def _ridge_plot(report: Report, rows: list[dict]) -> None:
    def draw(figure):
        axes = figure.subplots()
        for name, label in SETS.items():
            values = [row.get(name) for row in rows]
            if values and all(value is not None for value in values):
                axes.semilogx([row["ridge"] for row in rows], values, marker=".", label=label)
        axes.set(xlabel="ridge, relative to the mean eigenvalue", ylabel="SH error", ylim=(0, None))
        axes.legend()

    report.plot(draw, "Linear model on 16 SH coefficients against the penalty.")


def _flat(rows: list[dict]) -> list[dict]:
    """Rows of nested dicts as flat ones, sets named in words."""
    flat = []
    for row in rows:
        line: dict[str, Any] = {}
        for key, value in row.items():
            if isinstance(value, dict):
                line |= {f"{key}, {SETS.get(k, k)}": v for k, v in value.items() if not isinstance(v, dict | list)}
            else:
                line[SETS.get(key, key)] = value
        flat.append(line)
    keys = list(dict.fromkeys(key for line in flat for key in line))
    return [{key: line.get(key) for key in keys} for line in flat]


def _run(report: Report, result: TrainResult, settings: TrainSettings) -> None:
    report.section("The run")
    seconds = {name: console.format_seconds(value) for name, value in result.timings.seconds.items()}
    report.facts(seconds | {"machine": f"{cpu_model()}, {num_cores()} cores"}, caption="Time per stage.")
    groups = settings.as_dict().items()
    flat = {f"{group}.{key}": str(value) for group, values in groups for key, value in values.items()}
    report.facts(flat, caption="Settings.")
