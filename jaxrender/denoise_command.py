"""`jaxrender denoise`: finds the images of a picture, filters it, writes it with its layers, and shows the change."""

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Num

from jaxrender import console
from jaxrender.checks import bad_input
from jaxrender.denoise_inputs import LIGHT, DenoiseInputs, builtin_inputs, read_inputs
from jaxrender.denoise_page import BeforeAfterPage, add_comparison
from jaxrender.filters.denoiser import Denoised, DenoiseSettings, denoise
from jaxrender.io import write_exr, write_png
from jaxrender.io.aovs import split_reference
from jaxrender.io.frames import frame_name, has_number, numbered_name, parse_frames, unnumbered_name
from jaxrender.io.picture import tone_map
from jaxrender.machine import is_writable_folder

if TYPE_CHECKING:
    from jaxrender.cli import Denoise as Options

#: Height and width of the built-in picture.
BUILTIN_SIZE = (384, 512)
#: The largest number of half precision.
HALF_MAX = 65504.0

#: Options that name an image, as it is called in `Aovs`.
IMAGE_OPTIONS = ("normal", "depth", "position", "albedo", "ao", "direct", "indirect", "emission")

#: Counts of pixels, in words.
COUNTS = {
    "nan": "NaN or Inf", "negative": "negative", "clamped": "clamped as fireflies", "filled": "filled in",
    "raised": "below 0 after the filter and set to 0", "zeroed": "NaN or Inf and set to 0",
    "guide_nan": "NaN or Inf in a guide", "too_large": "too large and cut", "lamps": "kept as lamps",
    "half_overflow": "too large for half floats",
}  # fmt: skip
#: Those that are told only where there are some.
RARE = ("zeroed", "guide_nan", "too_large", "lamps", "half_overflow")


@dataclass(frozen=True)
class Job:
    """One picture: its file and those by option, the EXR file to write, and its number in a sequence."""

    noisy: str | None
    others: Mapping[str, str]
    out: Path
    frame: int | None = None

    def files(self) -> list[Path]:
        """All files it reads."""
        return [split_reference(reference)[0] for reference in (self.noisy, *self.others.values()) if reference]


@dataclass(frozen=True)
class Done:
    """What became of a job: counts of pixels, chosen settings, and for people the pictures before and after."""

    job: Job
    inputs: DenoiseInputs
    denoised: Denoised
    counts: dict[str, int]
    seconds: float

    def record(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "frame": self.job.frame, "input": self.job.noisy, "output": self.job.out, "counts": self.counts,
            "chosen": self.denoised.chosen, "layers": self.inputs.sources, "separate": sorted(self.denoised.layers),
            "notes": self.inputs.notes, "seconds": self.seconds,
        }  # fmt: skip


def run_denoise(options: "Options") -> None:
    """The command."""
    jobs = list_jobs(options)
    check_jobs(jobs)
    left = [job for job in jobs if not (options.resume and job.out.exists())]
    console.announce_device()
    settings, page, first, told = make_settings(options), None, None, set[str]()
    records: list[dict[str, Any]] = []
    with _progress(jobs, left) as advance:
        for job in left:
            with console.keeping(_kept(len(records), job)):
                done = run_job(job, settings, options)
            for note in done.inputs.notes:
                if note not in told:
                    console.announce(f"{done.inputs.name}: {note}")
                told.add(note)
            if page is None:
                console.announce(f"{done.inputs.name}: {words_of(done.denoised.chosen)}{_for_all(jobs)}")
                page, first = start_page(done, stops=options.exposure_stops), job.frame
                settings = settled(settings, done.denoised.chosen)
            else:
                done = replace(done, denoised=_as_frame(done.denoised, first))
            records.append(done.record())
            advance(1)
    counts = {name: sum(record["counts"].get(name, 0) for record in records) for name in COUNTS}
    paths = [path for job in left for path in (job.out, job.out.with_suffix(".png"))]
    if page is not None:
        tell_counts(done.inputs.name if len(records) == 1 else f"{len(records)} frames", counts)
        add_numbers(page, records)
        name = str(jobs[0].out) if options.frames is None else unnumbered_name(options.out.name)
        paths.append(page.write(jobs[0].out.parent / Path(name).with_suffix(".html").name))
    record = records[0] if options.frames is None else {"counts": counts, "frames": records}
    console.finish(paths=paths, record=record, as_json=options.json)


# --- What is to be done


def list_jobs(options: "Options") -> list[Job]:
    """One job, or one for each frame.

    Raises:
      InputError: if names and --frames do not fit together, or the output is not to be an EXR file.
    """
    if options.out.suffix.lower() not in ("", ".exr"):
        bad_input("-o", str(options.out), expected="a name ending in .exr", got=options.out.suffix)
    out = options.out.with_suffix(".exr")
    noisy = options.noisy if options.color is None else options.color
    others = {aov: getattr(options, aov) for aov in IMAGE_OPTIONS}
    others = {aov: reference for aov, reference in others.items() if reference is not None}
    if options.frames is None:
        for reference in (noisy, *others.values()):
            if reference and has_number(reference) and not split_reference(reference)[0].exists():
                bad_input(reference, "name", expected="--frames with a numbered name, such as 1-24", got="none")
        return [Job(noisy, others, out)]
    if noisy is None or not has_number(noisy):
        bad_input("--frames", options.frames, expected="a numbered name such as noisy.####.exr", got=noisy or "none")
    out_name = numbered_name(str(out))
    return [
        Job(
            frame_name(noisy, frame), {aov: frame_name(reference, frame) for aov, reference in others.items()},
            Path(frame_name(out_name, frame)), frame,
        )
        for frame in parse_frames(options.frames)
    ]  # fmt: skip


def check_jobs(jobs: Sequence[Job]) -> None:
    """Raises InputError if a file of a sequence is missing, an output is an input, or a folder cannot be written."""
    inputs = {path.resolve(): path for job in jobs for path in job.files()}
    missing = [job.frame for job in jobs if not all(path.exists() for path in job.files())]
    if missing and jobs[0].frame is not None:
        gone = next(path for job in jobs for path in job.files() if not path.exists())
        numbers = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        expected = f"files of {len(jobs)} frames"
        bad_input(gone, "frames", expected=expected, got=f"{len(jobs) - len(missing)} (missing: {numbers})")
    for job in jobs:
        if job.out.resolve() in inputs:
            bad_input("-o", str(job.out), expected="another file than those that are read", got="one of them")
        for path in (job.out, job.out.with_suffix(".png"), job.out.with_suffix(".html")):
            if path.is_dir():
                bad_input("-o", str(path), expected="the name of a file", got="a folder of that name")
    for folder in {job.out.parent for job in jobs}:
        if not is_writable_folder(folder):
            bad_input("-o", str(folder), expected="a folder that can be written", got="one that cannot")


def make_settings(options: "Options") -> DenoiseSettings:
    """The settings that the options say."""
    return DenoiseSettings(
        method=options.method, radius=options.radius, eps=options.eps, samples_per_pixel=options.spp,
        auto=options.auto, firefly_factor=None if options.firefly == "off" else options.firefly,
        demodulate=options.demodulate, whole=options.whole, keep_lamps=options.keep_lamps,
    )  # fmt: skip


def settled(settings: DenoiseSettings, chosen: Mapping[str, Any]) -> DenoiseSettings:
    """Settings for the frames after the first: what it was filtered with stays, so that frames do not flicker."""
    radius, eps = chosen.get("radius"), chosen.get("eps")
    return replace(
        settings, auto=False, radius=radius if isinstance(radius, int) else settings.radius,
        eps=eps if isinstance(eps, float) else settings.eps,
    )  # fmt: skip


# --- One picture


def run_job(job: Job, settings: DenoiseSettings, options: "Options") -> Done:
    """Reads, filters, and writes a picture; the EXR file comes last, so that it tells that all is there."""
    height, width = BUILTIN_SIZE
    inputs = builtin_inputs(height=height, width=width) if job.noisy is None else read_inputs(job.noisy, job.others)
    if settings.samples_per_pixel is None:
        settings = replace(settings, samples_per_pixel=inputs.samples_per_pixel)
    started = time.perf_counter()
    denoised = denoise(inputs.aovs, settings=settings)
    image = np.asarray(denoised.image, np.float32)
    seconds = time.perf_counter() - started
    layers = output_layers(inputs, denoised)
    counts = {name: int(count) for name, count in denoised.counts.items()}
    if options.half:
        layers, counts["half_overflow"] = within_half(layers)
    write_png(job.out.with_suffix(".png"), tone_map(image, exposure_stops=options.exposure_stops))
    write_exr(job.out, layers, half=options.half, attributes=inputs.attributes)
    return Done(job, inputs, denoised, counts, seconds)


def output_layers(inputs: DenoiseInputs, denoised: Denoised) -> dict[str, Num[np.ndarray, "h w c"]]:
    """The picture as layer "", its filtered parts, which add up to it, and all other channels as they came.

    A picture of one channel keeps its name. A part that is a layer of the file takes its place; others are layers
    "direct", "indirect" and "emission".
    """
    picture = np.asarray(denoised.image, np.float32)[..., : 1 if inputs.gray else 3]
    if inputs.alpha is not None:
        picture = np.concatenate([picture, inputs.alpha], axis=-1)
    layers = {name: pixels for name, pixels in inputs.channels.items() if name not in ("R", "G", "B", "A", "Y")}
    for part in LIGHT if denoised.layers else ():
        values = denoised.layers.get(part, getattr(inputs.aovs, part))
        if values is not None:
            names = inputs.replaced.get(part, (f"{part}.R", f"{part}.G", f"{part}.B"))
            layers |= {names[index]: np.asarray(values, np.float32)[..., index : index + 1] for index in range(3)}
    return {inputs.gray if inputs.gray not in ("", "Y") else "": picture, **layers}


def within_half(layers: Mapping[str, Num[np.ndarray, "h w c"]]) -> tuple[dict[str, np.ndarray], int]:
    """Layers with all finite numbers brought into the range of half floats, and the number of pixels that were not."""
    clamped: dict[str, np.ndarray] = {}
    over = np.zeros(next(iter(layers.values())).shape[:2], bool)
    for name, pixels in layers.items():
        clamped[name] = pixels
        if np.issubdtype(pixels.dtype, np.floating):
            large = np.isfinite(pixels) & (np.abs(pixels) > HALF_MAX)
            clamped[name] = np.where(large, np.copysign(np.float32(HALF_MAX), pixels), pixels)
            over |= large.any(axis=-1)
    return clamped, int(over.sum())


# --- What is told


def words_of(chosen: Any) -> str:
    """Chosen settings as a line, whatever they are: names and values, lists, numbers in three digits."""
    if isinstance(chosen, Mapping):
        return ", ".join(f"{name.replace('_', ' ')} {words_of(value)}" for name, value in chosen.items())
    if isinstance(chosen, list | tuple | np.ndarray):
        return " ".join(words_of(value) for value in chosen)
    return f"{chosen:.3g}" if isinstance(chosen, float | np.floating) else str(chosen)


def tell_counts(name: str, counts: Mapping[str, int]) -> None:
    """Says how many pixels were not as they should be; a warning if some had to be changed to be written."""
    shown = {key: words for key, words in COUNTS.items() if key not in RARE or counts[key] > 0}
    told = ", ".join(f"{counts[key]} {words}" for key, words in shown.items() if key != "half_overflow")
    console.announce(f"{name}: of the pixels {told}")
    if counts["half_overflow"]:
        console.warn(f"{name}: {counts['half_overflow']} pixels {COUNTS['half_overflow']}, clamped to {HALF_MAX:g}")


def _for_all(jobs: Sequence[Job]) -> str:
    return f"; radius and eps for all {len(jobs)} frames" if len(jobs) > 1 else ""


def _as_frame(denoised: Denoised, frame: int | None) -> Denoised:
    """Says of a later frame where its settings come from."""
    return replace(denoised, chosen={**denoised.chosen, "how": f"as frame {frame}"})


def _kept(count: int, job: Job) -> str:
    if job.frame is None:
        return "nothing was written"
    return f"{count} frames were written to {job.out.parent}; with --resume the same command goes on from there"


@contextlib.contextmanager
def _progress(jobs: Sequence[Job], left: Sequence[Job]):
    """Progress over frames; nothing for a single picture."""
    if jobs[0].frame is None:
        yield lambda n: None
        return
    with console.progress("denoise", total=len(jobs), unit="frames", done=len(jobs) - len(left)) as advance:
        yield advance


# --- The page


def start_page(done: Done, *, stops: float) -> BeforeAfterPage:
    """The page with the pictures of one frame."""
    frame = "" if done.job.frame is None else f"frame {done.job.frame}, "
    height, width = done.inputs.aovs.color.shape[:2]
    page = BeforeAfterPage("Denoised", subtitle=f"{done.inputs.name}, {frame}{width} x {height} pixels")
    add_comparison(page, *(_shown(image, stops) for image in (done.inputs.aovs.color, done.denoised.image)))
    chosen = {name.replace("_", " "): words_of(value) for name, value in done.denoised.chosen.items()}
    page.section("Settings").facts(chosen)
    page.section("Images that were used").facts(done.inputs.sources)
    for note in done.inputs.notes:
        page.note(note)
    return page


def add_numbers(page: BeforeAfterPage, records: Sequence[Mapping[str, Any]]) -> None:
    """Adds the counts of each frame."""
    page.section("Pixels")
    some = {name for name in COUNTS if any(record["counts"].get(name, 0) for record in records)}
    rows = [
        {
            **({} if record["frame"] is None else {"frame": str(record["frame"])}),
            **{
                words: record["counts"].get(name, 0)
                for name, words in COUNTS.items()
                if name in some or name not in RARE
            },
            "seconds": record["seconds"],
        }
        for record in records
    ]
    page.table(rows, caption="Pixels that were not as they should be, and the time of the filter, with compilation.")


def _shown(image: Any, stops: float) -> Float[np.ndarray, "h w 3"]:
    return tone_map(np.asarray(image, np.float32), exposure_stops=stops)
