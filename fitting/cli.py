"""python -m fitting train | evaluate | relight | inspect: parses, calls the stages, prints the paths."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from fitting.checkpoint import NOTHING_KEPT, Checkpoint
from fitting.config import BakeSettings, FitSettings, SplitSettings, TrainSettings
from fitting.lock import only_writer
from fitting.model import (
    MODEL_FILE,
    character_source,
    check_same_character,
    find_model,
    model_header,
    save_pose_model,
    source_file,
)
from fitting.stages import TIMES_FILE, read_times, write_times
from jaxrender import cli as jaxrender_cli
from jaxrender import console
from jaxrender.animation.mannequin import builtin_character
from jaxrender.animation.skinning import Character
from jaxrender.checks import InputError, bad_input
from jaxrender.harmonics.pose_model import PoseModel
from jaxrender.io.atomic import remove_leftovers, write_bytes
from jaxrender.io.character import load_character
from jaxrender.machine import is_writable_folder
from jaxrender.pathtrace.backends import chosen_backend, told_backend

if TYPE_CHECKING:
    from fitting.evaluate import Evaluation
    from fitting.train import TrainResult

NUMBERS_FILE = "evaluation.json"

Out = Annotated[Path, tyro.conf.arg(aliases=("-o",))]


@dataclass(frozen=True)
class Train:
    """Trains a pose-to-visibility model on an animated character, evaluates it, and writes model and report."""

    input: tyro.conf.Positional[Path | None] = None
    """A glTF, GLB or BVH file. Without one, the built-in character."""
    out: Out = Path("out/train")
    """Folder for the model, the report, the pictures and the bake. After an interruption the same command continues."""
    num_vertices: int = 5000
    """Vertices of the mannequin that is grown around a skeleton without a body."""
    bake: BakeSettings = field(default_factory=BakeSettings)
    split: SplitSettings = field(default_factory=SplitSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    study: bool = True
    """Compare with the paper's methods and the baselines on a sample of points: a minute or two."""
    restart: bool = False
    """Begin anew: throw away the bake and the unfinished work of an earlier run in the folder."""
    json: bool = False
    """Print one JSON object instead of the list of files."""

    def run(self) -> None:
        console.enable_compilation_cache()
        settings = TrainSettings(self.bake, self.split, self.fit)
        character = open_character(self.input, self.num_vertices)
        train_and_report(
            character, settings, self.out, source=self.input, num_vertices=self.num_vertices, study=self.study,
            restart=self.restart, as_json=self.json,
        )  # fmt: skip


@dataclass(frozen=True)
class Evaluate:
    """Evaluates a trained model again: errors on held-out motion, comparisons, and the report."""

    model: tyro.conf.Positional[Path]
    """The folder of a training run."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None
    """Folder for numbers, pictures and report. By default that of the model, unless a training holds it."""
    study: bool = True
    """Compare with the paper's methods and the baselines on a sample of points."""
    json: bool = False
    """Print one JSON object instead of the list of files."""

    def run(self) -> None:
        console.enable_compilation_cache()
        model, header, file, character = open_model(self.model)
        evaluate_and_report(
            character, model, header, settings_from_header(header, file), file, self.out or file.parent,
            study=self.study, as_json=self.json,
        )  # fmt: skip


@dataclass(frozen=True)
class Inspect:
    """Prints what a model file holds: character, settings, errors, arrays and sizes."""

    model: tyro.conf.Positional[Path]
    """A model file, or the folder of a training run."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        model, header, file = find_model(self.model)
        arrays = {name: f"{value.dtype} {tuple(value.shape)}" for name, value in _arrays(model).items()}
        size = file.stat().st_size
        if self.json:
            console.print_json({"file": file, "bytes": size, "header": header, "arrays": arrays})
            return
        print(f"{file}  {console.format_bytes(size)}")
        print(json.dumps(header, indent=2))
        for name, text in arrays.items():
            print(f"{name:24} {text}")


def _arrays(model) -> dict[str, np.ndarray]:
    from jaxrender.harmonics.pose_model import model_arrays

    return model_arrays(model)


def main(argv: list[str] | None = None) -> int:
    """The command; returns the exit status."""
    commands = Train | Evaluate | jaxrender_cli.Relight | Inspect

    def command() -> None:
        console.parse(commands, prog="python -m fitting", description=__doc__, argv=argv).run()

    return console.run_command(command)


def open_character(path: Path | None, num_vertices: int) -> Character:
    """The character of a file, or the built-in one; says what was repaired."""
    if path is not None and path.is_dir():
        bad_input(path, "input", expected="a glTF, GLB or BVH file", got="a folder")
    character = builtin_character(num_vertices=num_vertices) if path is None else load_character(
        path, num_vertices=num_vertices
    )  # fmt: skip
    for note in character.notes:
        console.announce(f"{character.name}: {note}")
    return character


def settings_from_header(header: dict, file: Path) -> TrainSettings:
    """The settings a model was trained with."""
    stored = header.get("settings", {})
    try:
        split = {**stored["split"], "clips": tuple(stored["split"]["clips"])}
        return TrainSettings(BakeSettings(**stored["bake"]), SplitSettings(**split), FitSettings(**stored["fit"]))
    except (KeyError, TypeError, AttributeError) as error:
        bad_input(file, "settings", expected="the settings of a training run", got=str(error))


def open_model(path: Path) -> tuple[PoseModel, dict, Path, Character]:
    """A trained model, its header and file, and the character it was trained on."""
    model, header, file = find_model(path)
    character = open_character(source_file(header, file), header["source"]["num_vertices"])
    check_same_character(character, model, header, file)
    return model, header, file, character


def train_and_report(
    character: Character, settings: TrainSettings, out: Path, *, source: Path | None, num_vertices: int, study: bool,
    restart: bool, as_json: bool,
) -> None:  # fmt: skip
    """The main job: bake, fit, evaluate, pictures, report. Everything heavy is imported here, after the cache is on.

    Interrupted at any point, it continues when it is called again, and ends with the same model, bit by bit.
    """
    _check_writable(out)
    from fitting.pictures import PICTURES
    from fitting.report import REPORT_FILE
    from fitting.train import character_run, train_character

    console.announce_device(rays=told_backend(chosen_backend(settings.bake.rays)))
    again = "the same command without --restart continues" if restart else "the same command continues"
    with (
        _named_by_file(character, source, out),
        console.keeping(f"what was finished is kept in {out}; {again}"),
        only_writer(out),
    ):
        for name in (MODEL_FILE, NUMBERS_FILE, TIMES_FILE, REPORT_FILE, *PICTURES):
            remove_leftovers(out / name)
        parts = character_run(character, settings, out, restart=restart)
        result = train_character(character, settings, out, track=_track, checkpoint=parts)
        if not as_json:
            console.announce(
                f"ridge {result.ridge:g}; {result.bake.rays_per_second / 1e6:.1f} M rays/s; "
                f"{int((~np.asarray(result.model.visible)).sum())} of {len(result.model.visible)} points see nothing"
            )
        evaluation = _evaluate(character, result, settings, study=study, checkpoint=parts)
        found = character_source(character, source, num_vertices)
        header = model_header(result, settings, source=found, errors=evaluation.summary())
        model_path = out / MODEL_FILE
        # A report that is there is of the model that is there, and the last thing a run writes.
        (out / REPORT_FILE).unlink(missing_ok=True)
        save_pose_model(model_path, result.model, header)
        paths = _report(character, result, settings, evaluation, model_path, out)
        parts.finish()
    record = {"errors": header["errors"], "ridge": result.ridge, "seconds": result.timings.seconds}
    console.finish(paths=[model_path, *paths], record=record, as_json=as_json)


def evaluate_and_report(
    character: Character, model: PoseModel, header: dict, settings: TrainSettings, file: Path, out: Path,
    *, study: bool, as_json: bool,
) -> None:  # fmt: skip
    """Measures the model in `file`, which stays as it is, on its own bake; what is missing of that is baked again."""
    _check_writable(out)
    from fitting.dataset import BakeStatistics
    from fitting.train import STORE, TrainResult
    from fitting.training_data import bake_character

    console.announce_device(rays=told_backend(chosen_backend(settings.bake.rays)))
    with only_writer(out):
        data, _, motion = bake_character(character, settings, file.parent / STORE, track=_track)
        if len(model.axes) != len(data.visible):
            bad_input(file, "axes", expected=f"{len(data.visible)} points, as its settings make", got=len(model.axes))
        times = read_times(file.parent)
        traced = BakeStatistics(header["rays"], times.rays, times.seconds.get("bake", 0.0), 0)
        result = TrainResult(model, data, float(header["ridge"]), traced, times, motion)
        evaluation = _evaluate(character, result, settings, study=study)
        paths = _report(character, result, settings, evaluation, file, out)
    console.finish(paths=paths, record={"errors": evaluation.summary()}, as_json=as_json)


@contextlib.contextmanager
def _named_by_file(character: Character, source: Path | None, out: Path) -> Iterator[None]:
    """Bad input is reported with the file's name instead of the character's, and leaves no empty folder behind."""
    try:
        yield
    except InputError as error:
        with contextlib.suppress(OSError):
            out.rmdir()
        place, _, rest = str(error).partition(": ")
        if source is None or place != character.name:
            raise
        raise InputError(f"{source}: {rest}") from error


def _check_writable(out: Path) -> None:
    if not is_writable_folder(out):
        bad_input("-o", str(out), expected="a folder that can be written", got="one that cannot")


def _track(items, count, label, done):
    return console.track(items, label, total=count, done=done)


def _evaluate(
    character: Character, result: "TrainResult", settings: TrainSettings, *, study: bool,
    checkpoint: Checkpoint = NOTHING_KEPT,
) -> "Evaluation":  # fmt: skip
    from fitting.evaluate import evaluate
    from fitting.features import joint_angle_features

    assert result.motion is not None  # a character always has one
    console.announce("evaluating ...")
    with result.timings.stage("evaluate"):
        return evaluate(
            result.data, result.model, settings.fit, ridge=result.ridge, study=study, track=_track,
            angles=joint_angle_features(character, result.motion) if study else None,
            clip_names=result.motion.clip_names, checkpoint=checkpoint,
        )  # fmt: skip


def _report(
    character: Character, result: "TrainResult", settings: TrainSettings, evaluation: "Evaluation", model_path: Path,
    out: Path,
) -> list[Path]:  # fmt: skip
    """Numbers, pictures, times and the page; their paths."""
    from fitting.pictures import draw_pictures
    from fitting.report import write_report

    assert result.motion is not None
    numbers = out / NUMBERS_FILE
    write_bytes(numbers, json.dumps(console.to_jsonable(evaluation.as_dict())).encode())
    console.announce("drawing ...")
    with result.timings.stage("pictures"):
        pictures = draw_pictures(character, result.motion, result.model, evaluation, out)
    times = write_times(out, result.timings)
    report = write_report(out, result, settings, evaluation, model_path, pictures)
    return [numbers, *(path for path, _ in pictures), times, report]


def run_demo(options) -> None:
    """`jaxrender demo`: the built-in character, small enough for two cores and five minutes."""
    settings = TrainSettings(
        BakeSettings(max_frames=150, num_mixed=100, seed=options.seed),
        SplitSettings(),
        FitSettings(num_components=32, refine_steps=18),
    )
    train_and_report(
        open_character(None, 3000), settings, options.out, source=None, num_vertices=3000, study=False,
        restart=options.restart, as_json=options.json,
    )  # fmt: skip


def run_relight(options) -> None:
    """`jaxrender relight` and `python -m fitting relight`: a clip under turning light."""
    from fitting.pictures import render_clip

    if options.model is None:
        demo = Path("out/demo")
        if not (demo / MODEL_FILE).is_file():
            console.announce(f"no model given: training the built-in character into {demo} first")
            run_demo(jaxrender_cli.Demo(out=demo, seed=options.seed))
        options = dataclasses.replace(options, model=demo)
    model, _, file, character = open_model(options.model)
    _check_writable(options.out)
    paths = render_clip(character, model, options)
    console.finish(paths=paths, record={"model": str(file)}, as_json=options.json)
