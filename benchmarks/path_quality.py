"""What the path tracer's own pictures are worth: three cases of the suite `pathtrace`, at 512 x 384.

- `quality`: indirect light of 1, 4, 16 and 64 paths, filtered in all the ways of `denoising`, judged as there, against
  2048 paths. The ambient occlusion that guides is the renderer's own: of the paths' first hits, with eight short rays
  below 4 samples. `contact_mse_255` is of pixels where half the rays to a fiftieth of the scene's extent are blocked.
- `final`: the whole picture of 1, 4 and 16 samples with direct light plain and by ratio, against 2048 anti-aliased
  samples: `mse_255_direct`, `mse_255_indirect` and `mse_255` of all, on 0..255 display-encoded, without the noise of
  the reference; means over two seeds.
- `figures`: the paper's figures 2, 5, 6, 7 and 8 from these images, in `out/pathtrace`.
"""

from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from benchmarks import denoising
from benchmarks.denoising import OURS, WAYS, Cell, load_cell, shown, worst_place
from benchmarks.path_renders import FOLDER, PARTS, load_path_renders, load_smooth_halves, open_stage
from benchmarks.renders import SEEDS
from benchmarks.suites import Measurement, Options
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.denoiser import denoise
from jaxrender.filters.settings import DenoiseSettings
from jaxrender.io import write_png
from jaxrender.io.picture import contact_sheet, with_color_bar
from jaxrender.metrics import heatmap
from jaxrender.pathtrace import Rendered, TraceSettings, render

Color = Float[np.ndarray, "h w 3"]

FULL = denoising.Sizes(reference_spp=2048, pictures=())
QUICK = denoising.Sizes(height=48, width=64, scenes=("cornell",), spp=(1,), reference_spp=32, rounds=0, pictures=())
#: Differences of 1 / GAIN of full scale have the brightest color.
GAIN = 10.0
#: Rows of figure 8: scene and samples a pixel.
ROWS = (("statue", 1), ("statue", 4), ("cornell", 1), ("cornell", 4), ("sponza", 1))
#: Columns of figures 6 and 8, and what they are called there.
COLUMNS = {"unfiltered": "unfiltered", "bilateral_best": "cross-bilateral", "atrous_best": "a-trous", OURS: "guided"}


def quality(options: Options) -> Iterator[Measurement]:
    """All ways in all cells, and their sum."""
    yield from denoising.quality(options, _sizes(options), load=load_path_renders, out=FOLDER)


def final(options: Options) -> Iterator[Measurement]:
    """Whole pictures, with direct light in two ways."""
    sizes = _sizes(options)
    for scene in sizes.scenes:
        stage, world = open_stage(scene)
        truth = _Truth(scene, sizes)
        for spp in (1, 4, 16) if not options.quick else (1,):
            for direct in ("plain", "ratio"):
                errors = []
                for seed in SEEDS:
                    settings = TraceSettings(samples_per_pixel=spp, model="lambert", seed=seed, direct=direct)
                    found = render(world, stage.camera, height=sizes.height, width=sizes.width, settings=settings)
                    errors.append(truth.errors(found))
                metrics = {name: float(np.mean([error[name] for error in errors])) for name in errors[0]}
                params: dict[str, str | int | float | bool] = {
                    "scene": scene, "spp": spp, "height": sizes.height, "width": sizes.width,
                    "reference_spp": sizes.reference_spp, "seeds": len(SEEDS),
                }  # fmt: skip
                yield Measurement("final", direct, metrics, params)


class _Truth:
    """An anti-aliased reference, and how far pictures are from it."""

    def __init__(self, scene: str, sizes: denoising.Sizes):
        self._halves = load_smooth_halves(scene, height=sizes.height, width=sizes.width, spp=sizes.reference_spp)
        for half in self._halves:
            half["image"] = sum((half[name] for name in PARTS), np.zeros_like(half["direct"]))

    def errors(self, found: Rendered) -> dict[str, float]:
        """Mean squared errors without the reference's noise, a quarter of the squared difference of its halves."""
        metrics = {}
        for name, key in (("direct", "mse_255_direct"), ("indirect", "mse_255_indirect"), ("image", "mse_255")):
            a, b = (half[name] for half in self._halves)
            noise = 0.25 * np.mean((shown(a) - shown(b)) ** 2)
            metrics[key] = float(np.mean((shown(getattr(found, name)) - shown(0.5 * (a + b))) ** 2) - noise)
        return metrics


def figures(options: Options) -> Iterator[Measurement]:
    """Each figure is a file; its row has the numbers of its captions."""
    sizes = _sizes(options)
    for name, draw in FIGURES.items():
        path = FOLDER / f"{name}.png"
        metrics = draw(sizes, path)
        yield Measurement("figures", name, metrics, {"file": str(path), "height": sizes.height, "width": sizes.width})


def draw_parts(sizes: denoising.Sizes, path: Path) -> dict[str, float]:
    """Direct light, filtered indirect light, and both, of 4 samples (figure 2)."""
    stage, world = open_stage(sizes.scenes[0])
    settings = TraceSettings(samples_per_pixel=4, model="lambert")
    found = render(world, stage.camera, height=sizes.height, width=sizes.width, settings=settings)
    images = (found.direct + found.emission, found.indirect, found.image)
    write_png(path, contact_sheet([_bytes(image) for image in images], labels=("direct", "indirect", "final")))
    return {"indirect_share": float(found.indirect.mean() / found.image.mean())}


def draw_guides(sizes: denoising.Sizes, path: Path) -> dict[str, float]:
    """One path a pixel filtered by ever more guides (figure 5, and ambient occlusion beyond it)."""
    cell = _cell("statue" if "statue" in sizes.scenes else sizes.scenes[0], 1, sizes)
    first = cell.first
    gray = np.repeat(first.normal.mean(axis=-1, keepdims=True), 3, axis=-1)
    guides = {
        "gray normal": {"normal": gray}, "normal": {"normal": first.normal},
        "normal, depth": {"normal": first.normal, "depth": first.depth},
        "normal, depth, occlusion": {"normal": first.normal, "depth": first.depth, "ao": first.ao},
    }  # fmt: skip
    images, errors = {}, {}
    zero = np.zeros_like(first.indirect)
    for label, channels in guides.items():
        aovs = Aovs(first.indirect, direct=zero, indirect=first.indirect, **channels)
        light = denoise(aovs, settings=DenoiseSettings(samples_per_pixel=1)).layers["indirect"]
        errors[label] = cell.error([cell.picture(light)])
        images[f"{label}, MSE {errors[label]:.3g}"] = first.albedo * light
    write_png(path, contact_sheet([_bytes(image) for image in images.values()], labels=list(images), columns=2))
    return {f"mse_255 {label}": error for label, error in errors.items()}


def draw_close_up(sizes: denoising.Sizes, path: Path) -> dict[str, float]:
    """Where the rivals err most, enlarged (figure 6)."""
    cell = _cell(sizes.scenes[0], 1, sizes)
    images, errors = _columns(cell, sizes)
    height, width = (size // 4 for size in cell.seen.shape)
    rivals = [np.abs(shown(images[name]) - cell.shown).mean(axis=-1) for name in denoising.RIVALS]
    y, x = worst_place(np.mean(rivals, axis=0), height, width)
    panels = {"reference": cell.reference, **{COLUMNS[name]: image for name, image in images.items()}}
    crops = [np.repeat(np.repeat(_bytes(image[y : y + height, x : x + width]), 4, axis=0), 4, axis=1)
             for image in panels.values()]  # fmt: skip
    write_png(path, contact_sheet(crops, labels=list(panels), columns=3))
    return errors


def draw_errors(sizes: denoising.Sizes, path: Path) -> dict[str, float]:
    """Guided filter, reference, and their difference, `GAIN` times as large (figure 7)."""
    cell = _cell("statue" if "statue" in sizes.scenes else sizes.scenes[0], 1, sizes)
    image = WAYS[OURS](cell, 0)[0][0]
    difference = np.abs(shown(image) - cell.shown).mean(axis=-1) / 255.0
    scale = heatmap(jnp.linspace(0.0, 1.0, 256))
    colors = with_color_bar(
        _bytes(np.asarray(heatmap(jnp.asarray(difference), high=1.0 / GAIN))), np.asarray(scale),
        title="of full scale", low="0", high=f"{1.0 / GAIN:g}",
    )  # fmt: skip
    panels = [_bytes(image), _bytes(cell.reference), colors]
    write_png(path, contact_sheet(panels, labels=("guided, 1 sample", "reference", "difference")))
    return {"mean_difference_255": float(255.0 * difference.mean())}


def draw_table(sizes: denoising.Sizes, path: Path) -> dict[str, float]:
    """Scenes and samples by filters, each with its error (figure 8)."""
    panels, labels = [], []
    metrics: dict[str, float] = {}
    for scene, spp in ROWS:
        if scene not in sizes.scenes or spp not in sizes.spp:
            continue
        images, errors = _columns(_cell(scene, spp, sizes), sizes)
        for name, image in images.items():
            panels.append(_bytes(image))
            labels.append(f"{scene}, {spp} spp, {COLUMNS[name]}: {errors[name]:.3g}")
        metrics |= {f"mse_255 {scene} {spp} {name}": error for name, error in errors.items()}
    write_png(path, contact_sheet(panels, labels=labels, columns=len(COLUMNS)))
    return metrics


FIGURES = {
    "figure2": draw_parts, "figure5": draw_guides, "figure6": draw_close_up, "figure7": draw_errors,
    "figure8": draw_table,
}  # fmt: skip


def _sizes(options: Options) -> denoising.Sizes:
    return QUICK if options.quick else FULL


def _cell(scene: str, spp: int, sizes: denoising.Sizes) -> Cell:
    return load_cell(scene, spp, sizes, load_path_renders)


def _columns(cell: Cell, sizes: denoising.Sizes) -> tuple[dict[str, Color], dict[str, float]]:
    """The picture of the first seed by each column of figure 8, and the error."""
    images, errors = {}, {}
    for name in COLUMNS:
        found = WAYS[name](cell, sizes.rounds)[0]
        images[name], errors[name] = found[0], cell.error(found)
    return images, errors


def _bytes(image: Color) -> UInt8[np.ndarray, "h w 3"]:
    return np.round(shown(np.asarray(image))).astype(np.uint8)
