"""The case `quality` of the suite `filters`: renders with a known reference, filtered, each way at its best setting.

Only indirect light is noisy: it is filtered without albedo, and direct light of the reference and emission are added.
Scenes, samples per pixel and seeds are those of `renders`; numbers are means over two seeds. Variants:

- `unfiltered`; `paper`: guided by normal and depth, with the paper's radius and regularisers.
- `normal_depth`, `jaxrender`, `jaxrender_auto`: `denoise` without and with the ambient occlusion of eight rays, at the
  rule, and with radius and regulariser by cross-validation. None of them sees the reference.
- `bilateral_best` (normal, depth), `atrous_best` (normal, position), `atrous_ao_best` (also given 64 rays of ambient
  occlusion, without noise, which ours does not have): at the settings with the least `mse_255` against the reference,
  by coordinate search from the best of an earlier search; clamping of fireflies, as ours does it, is searched too. The
  bilateral window reaches two sigmas, and at most 32 pixels.
- `oidn`: light without albedo, clean normals, an albedo of 1. Left out where pyoidn does not run.

Metrics: `mse_255` of display-encoded values in [0, 255], clamped; `relative_mse` is the mean of
(x - reference)² / (reference² + 0.01) of linear values. From both the part that is noise of the reference is taken
away, to first order, so they may fall below 0. `contact_mse_255`: `mse_255` where ambient occlusion of the shortest
rays is below 0.5. `flip` and `ssim` are of the first seed. `flicker_255`: variance over the seeds of what mse_255 sees.

The rows of the scene `all` sum up: `cells_won` of `cells` (scenes by samples) in which mse_255 is below those of both
`bilateral_best` and `atrous_best`; `cells_won_relative`, the same of relative_mse; `mse_ratio`, the geometric mean of
mse_255 over that of the better of the two; `contact_ratio`, that of contact_mse_255 over that of `normal_depth`.
Quick runs do not search. Pictures are in `out/filters`.
"""

import functools
import importlib
import importlib.util
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import uniform_filter

from benchmarks.renders import REFERENCE_SPP, SCENES, SEEDS, SPP, NoRenders, Renders, load_renders
from benchmarks.suites import Measurement, Options
from jaxrender import console
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.atrous import atrous_filter
from jaxrender.filters.bilateral import cross_bilateral_filter
from jaxrender.filters.denoiser import denoise
from jaxrender.filters.fireflies import clamp_fireflies
from jaxrender.filters.guided import guided_filter
from jaxrender.filters.guides import make_guides
from jaxrender.filters.settings import DenoiseSettings
from jaxrender.io import write_png
from jaxrender.io.picture import contact_sheet
from jaxrender.metrics import flip, ssim
from jaxrender.srgb import encode_srgb

Image = Float[np.ndarray, "h w c"]
Color = Float[np.ndarray, "h w 3"]
Settings = Mapping[str, float]

OUT = Path("out/filters")
#: Where ambient occlusion of the shortest rays is below this, a pixel is in contact with something.
CONTACT_AO = 0.5
#: The paper's radius, and its regularisers of normals and of depth.
PAPER_RADIUS, PAPER_EPS = 12, (0.01, 0.01, 0.01, 0.02)
#: Steps of the search; a setting that is not named is doubled and halved.
STEPS: Mapping[str, tuple[Callable[[float], float], ...]] = {
    "clamp": (lambda on: 1 - on,),
    "levels": (lambda n: n + 1, lambda n: max(1, n - 1)),
    "sigma": (lambda s: 1.5 * s, lambda s: max(0.5, s / 1.5)),
}
_USUAL_STEPS = (lambda s: 2.0 * s, lambda s: 0.5 * s)
_FIREFLY_FACTOR = DenoiseSettings().firefly_factor or 16.0

#: Where the search starts, by filter, then by scene for 1, 4, 16 and 64 samples: the best of an earlier search.
NAMES = {
    "bilateral_best": ("sigma", "normal", "depth"),
    "atrous_best": ("levels", "normal", "position"),
    "atrous_ao_best": ("levels", "normal", "position", "ao"),
}
STARTS: Mapping[str, Mapping[str, Sequence[tuple[float, ...]]]] = {
    "bilateral_best": {
        "cornell": ((12.0, 0.2, 0.01), (5.3, 0.2, 0.01), (3.6, 0.1, 0.01), (2.4, 0.1, 0.005)),
        "statue": ((18.0, 0.1, 0.01), (12.0, 0.1, 0.005), (5.3, 0.1, 0.005), (3.6, 0.1, 0.0025)),
        "atrium": ((27.0, 0.2, 0.04), (12.0, 0.2, 0.04), (8.0, 0.2, 0.04), (3.6, 0.1, 0.04)),
        "sponza": ((12.0, 0.2, 0.08), (5.3, 0.2, 0.01), (3.6, 0.2, 0.0025), (2.4, 0.1, 0.0025)),
    },
    "atrous_best": {
        "cornell": ((5, 0.2, 0.025), (3, 0.2, 0.025), (3, 0.2, 0.0125), (4, 0.1, 0.00625)),
        "statue": ((7, 0.2, 0.025), (7, 0.2, 0.0125), (7, 0.2, 0.00625), (7, 0.1, 0.00625)),
        "atrium": ((5, 0.4, 0.1), (4, 0.4, 0.05), (3, 0.4, 0.05), (3, 0.2, 0.05)),
        "sponza": ((4, 0.4, 0.1), (3, 0.4, 0.0125), (3, 0.4, 0.00625), (2, 0.2, 0.00625)),
    },
    "atrous_ao_best": {
        "cornell": ((4, 0.4, 0.1, 0.2), (3, 0.4, 0.05, 0.2), (3, 0.2, 0.025, 0.2), (5, 0.1, 0.0125, 0.2)),
        "statue": ((7, 0.8, 0.05, 0.1), (4, 0.2, 0.05, 0.2), (5, 0.1, 0.0125, 0.2), (4, 0.1, 0.00625, 0.2)),
        "atrium": ((4, 0.8, 0.1, 0.4), (4, 0.4, 0.1, 0.4), (4, 0.4, 0.05, 0.2), (3, 0.2, 0.05, 0.2)),
        "sponza": ((4, 0.4, 0.2, 0.4), (3, 0.4, 0.1, 0.4), (3, 0.2, 0.1, 0.4), (2, 0.4, 0.025, 0.2)),
    },
}
RIVALS = ("bilateral_best", "atrous_best")
OURS = "jaxrender"


@dataclass(frozen=True)
class Sizes:
    """How much is done; `rounds` of the search, 0 to stay where it starts; pictures at so many samples."""

    height: int = 384
    width: int = 512
    scenes: tuple[str, ...] = SCENES
    spp: tuple[int, ...] = SPP
    reference_spp: int = REFERENCE_SPP
    rounds: int = 2
    pictures: tuple[int, ...] = (1, 4)


FULL = Sizes()
QUICK = Sizes(height=96, width=128, scenes=("cornell", "statue"), spp=(1, 4), reference_spp=64, rounds=0, pictures=(1,))


def quality(
    options: Options, sizes: Sizes | None = None, *, load: Callable[..., Renders] | None = None, out: Path = OUT
) -> Iterator[Measurement]:
    """All ways in all cells, and a sum of them; nothing, and a word why, if there are no renders.

    Args:
      load: as `load_renders`, for renders of another origin. out: the folder of pictures.
    """
    sizes, load = sizes or (QUICK if options.quick else FULL), load or load_renders
    ways = {name: way for name, way in WAYS.items() if name != "oidn" or has_oidn()}
    rows: list[Measurement] = []
    try:
        for scene in sizes.scenes:
            for spp in sizes.spp:
                for row in _cell_rows(load_cell(scene, spp, sizes, load), ways, sizes, out):
                    rows.append(row)
                    yield row
    except NoRenders as error:
        console.announce(f"filters: quality is left out or incomplete: {error}")
    yield from summaries(rows)


class Cell:
    """A scene at one number of samples: noisy renders of some seeds, and what they are judged by."""

    def __init__(self, renders: Sequence[Renders]):
        """Renders that differ in the seed alone."""
        self.renders = renders
        first = self.first = renders[0]
        self.seen = first.depth[..., 0] > 0.0
        self.contact = self.seen & (first.ao64[..., 0] < CONTACT_AO)
        self.reference = self.picture(first.reference_indirect)
        self.shown = shown(self.reference)
        self.variance = first.albedo**2 * first.reference_indirect_variance
        step = 1e-3 * self.reference + 1e-6
        slope = (shown(self.reference + step) - shown(self.reference)) / step
        self.shown_variance = slope * slope * self.variance

    def picture(self, indirect: Color) -> Color:
        """Linear: all light, this indirect light instead of the noisy one."""
        return self.first.albedo * (self.first.reference_direct + indirect) + self.first.emission

    def aovs(self, render: Renders, ao: Image | None) -> Aovs:
        """What `denoise` is given."""
        indirect, direct = render.albedo * render.indirect, render.albedo * render.reference_direct
        return Aovs(
            color=direct + indirect + render.emission, direct=direct, indirect=indirect, emission=render.emission,
            albedo=render.albedo, normal=render.normal, depth=render.depth, position=render.position, ao=ao,
        )  # fmt: skip

    def features(self, *, position: bool) -> Array:
        """Normals and depth, or normals and positions, scaled as `denoise` does it."""
        first = self.first
        depth = None if position else first.depth
        aovs = Aovs(color=first.indirect, normal=first.normal, depth=depth, position=first.position)
        return make_guides(aovs).channels

    @functools.cached_property
    def lights(self) -> tuple[Image, Image]:
        """Indirect light of all seeds in one image, without and with clamped fireflies; NaN where there is nothing."""
        masked = [np.where(self.seen[..., None], render.indirect, np.float32(np.nan)) for render in self.renders]
        clamped = [np.asarray(_clamped(light)) for light in masked]
        return np.concatenate(masked, axis=-1), np.concatenate(clamped, axis=-1)

    def pictures(self, light: Image | Array) -> list[Color]:
        """Filtered light of all seeds -> their pictures."""
        filtered = np.where(self.seen[..., None], np.maximum(np.asarray(light), 0.0), 0.0)
        return [self.picture(part) for part in np.split(filtered, len(self.renders), axis=-1)]

    def error(self, images: Sequence[Color]) -> float:
        """mse_255."""
        return self._mean_error([(shown(image) - self.shown) ** 2 for image in images], self.shown_variance)

    def judge(self, images: Sequence[Color]) -> dict[str, float]:
        """All metrics but those of the suite's sum."""
        squares = [(shown(image) - self.shown) ** 2 for image in images]
        scale = self.reference**2 + 0.01
        relative = [(image - self.reference) ** 2 / scale for image in images]
        found = {
            "mse_255": self._mean_error(squares, self.shown_variance),
            "relative_mse": self._mean_error(relative, self.variance / scale),
            "ssim": ssim(shown(images[0]) / 255.0, self.shown / 255.0),
            "flicker_255": float(np.mean(np.var([shown(image) for image in images], axis=0, ddof=1))),
        }
        if self.contact.any():
            within = [square[self.contact] for square in squares]
            found["contact_mse_255"] = self._mean_error(within, self.shown_variance[self.contact])
        if importlib.util.find_spec("flip_evaluator") is not None:
            found["flip"] = flip(shown(images[0]) / 255.0, self.shown / 255.0)
        return found

    def _mean_error(self, squares: Sequence[np.ndarray], variance: np.ndarray) -> float:
        return float(np.mean(squares, dtype=np.float64) - np.mean(variance, dtype=np.float64))


def load_cell(scene: str, spp: int, sizes: Sizes, load: Callable[..., Renders]) -> Cell:
    """The renders of all seeds."""
    options = {"height": sizes.height, "width": sizes.width, "spp": spp, "reference_spp": sizes.reference_spp}
    return Cell([load(scene, seed=seed, **options) for seed in SEEDS])


def shown(image: Color) -> Color:
    """Linear -> what a display is given, in [0, 255], not rounded; in float64, for differences of it are divided."""
    return 255.0 * encode_srgb(np.asarray(image, np.float64))


def search(error: Callable[[Settings], float], start: Settings, *, rounds: int) -> tuple[dict[str, float], float]:
    """Coordinate search: each setting is stepped in either direction as long as the error falls.

    Args:
      rounds: over all settings, at most; fewer if one changes nothing. With 0 only the start is tried.
    Returns:
      the best settings and their error.
    """
    known: dict[tuple[float, ...], float] = {}

    def tried(settings: Settings) -> float:
        key = tuple(settings.values())
        if key not in known:
            known[key] = error(settings)
        return known[key]

    best = dict(start)
    for _ in range(rounds):
        before = dict(best)
        for name in start:
            for step in STEPS.get(name, _USUAL_STEPS):
                # A step that gains less than this is not worth the next one. Errors may be below 0.
                while tried(moved := {**best, name: step(best[name])}) < tried(best) - 1e-3 * abs(tried(best)):
                    best = moved
        if best == before:
            break
    return best, tried(best)


def summaries(rows: Sequence[Measurement]) -> Iterator[Measurement]:
    """One row for each variant, from those of the cells."""
    cells: dict[tuple, dict[str, Mapping[str, float]]] = {}
    for row in rows:
        cells.setdefault((row.params["scene"], row.params["spp"]), {})[row.variant] = row.metrics
    for name in dict.fromkeys(row.variant for row in rows):
        own = [cell for cell in cells.values() if {name, *RIVALS, "normal_depth"} <= cell.keys()]
        if not own:
            continue
        found = {"cells": float(len(own))}
        for metric, key in (("mse_255", "cells_won"), ("relative_mse", "cells_won_relative")):
            found[key] = float(sum(all(cell[name][metric] < cell[r][metric] for r in RIVALS) for cell in own))
        found["mse_ratio"] = _geometric_mean(
            [(cell[name]["mse_255"], min(cell[r]["mse_255"] for r in RIVALS)) for cell in own]
        )
        pairs = [(cell[name], cell["normal_depth"]) for cell in own if "contact_mse_255" in cell[name]]
        if pairs:
            found["contact_ratio"] = _geometric_mean([(a["contact_mse_255"], b["contact_mse_255"]) for a, b in pairs])
        yield Measurement("quality", name, found, {"scene": "all"})


@functools.cache
def has_oidn() -> bool:
    """Whether Open Image Denoise runs here; says so if it does not."""
    try:
        _oidn_of(np.zeros((16, 16, 3), np.float32), np.zeros((16, 16, 3), np.float32))
    except (ImportError, OSError, RuntimeError) as error:
        console.announce(f"filters: oidn is left out: {error}")
        return False
    return True


def draw_strip(cell: Cell, images: Mapping[str, Color], path: Path, *, zoom: int = 2) -> None:
    """Writes one part of the picture as each way shows it, where filtered pictures err most on average.

    Args:
      images: by label, linear; the first is the reference.
      zoom: a pixel becomes a square of so many.
    """
    height, width = (3 * size // 8 for size in cell.seen.shape)
    filtered = [image for label, image in images.items() if not label.startswith(("reference", "unfiltered"))]
    errors = np.mean([np.abs(shown(image) - cell.shown).mean(axis=-1) for image in filtered], axis=0)
    y, x = worst_place(errors, height, width)
    crops = []
    for image in images.values():
        window = np.round(shown(image[y : y + height, x : x + width])).astype(np.uint8)
        crops.append(np.repeat(np.repeat(window, zoom, axis=0), zoom, axis=1))
    write_png(path, contact_sheet(crops, labels=list(images), columns=3))


def worst_place(error: Float[np.ndarray, "h w"], height: int, width: int) -> tuple[int, int]:
    """The upper left corner of the window with the largest mean error."""
    mean = uniform_filter(np.asarray(error, np.float64), (height, width), mode="constant")
    top, left = height // 2, width // 2
    inside = mean[top : top + error.shape[0] - height + 1, left : left + error.shape[1] - width + 1]
    y, x = np.unravel_index(np.argmax(inside), inside.shape)
    return int(y), int(x)


# --- The ways: cell, rounds of search -> linear pictures of all seeds, and the settings


Result = tuple[list[Color], dict[str, Any]]


def _unfiltered(cell: Cell, rounds: int) -> Result:
    return [cell.picture(render.indirect) for render in cell.renders], {}


def _paper(cell: Cell, rounds: int) -> Result:
    eps = jnp.asarray(PAPER_EPS, jnp.float32)
    light = _guided(cell.features(position=False), cell.lights[0], eps, PAPER_RADIUS)
    return cell.pictures(light), {"radius": PAPER_RADIUS}


def _denoised(*, ao: bool, auto: bool = False) -> Callable[[Cell, int], Result]:
    def way(cell: Cell, rounds: int) -> Result:
        settings = DenoiseSettings(samples_per_pixel=cell.first.spp, auto=auto)
        found = [denoise(cell.aovs(render, render.ao8 if ao else None), settings=settings) for render in cell.renders]
        return [one.image for one in found], {key: found[0].chosen[key] for key in ("radius", "eps")}

    return way


def _best(name: str) -> Callable[[Cell, int], Result]:
    def way(cell: Cell, rounds: int) -> Result:
        features = cell.features(position=name != "bilateral_best")
        if name == "atrous_ao_best":
            features = jnp.concatenate([features, jnp.asarray(cell.first.ao64)], axis=-1)

        def filtered(settings: Settings) -> list[Color]:
            light = cell.lights[int(settings["clamp"])]
            return cell.pictures(_rival(name, light, features, settings))

        best, _ = search(lambda settings: cell.error(filtered(settings)), start_of(name, cell), rounds=rounds)
        return filtered(best), best

    return way


def _oidn(cell: Cell, rounds: int) -> Result:
    lights = [_oidn_of(render.indirect, render.normal) for render in cell.renders]
    return cell.pictures(np.concatenate(lights, axis=-1)), {}


WAYS: dict[str, Callable[[Cell, int], Result]] = {
    "unfiltered": _unfiltered,
    "paper": _paper,
    "normal_depth": _denoised(ao=False),
    OURS: _denoised(ao=True),
    "jaxrender_auto": _denoised(ao=True, auto=True),
    **{name: _best(name) for name in NAMES},
    "oidn": _oidn,
}
#: Which ways a picture shows, and as what.
PANELS = {
    "unfiltered": "unfiltered", "bilateral_best": "bilateral", "atrous_best": "a-trous", OURS: "guided, default",
    "oidn": "OIDN",
}  # fmt: skip


def start_of(name: str, cell: Cell) -> dict[str, float]:
    """Where the search of a filter starts: for other numbers of samples, that of the next in the table."""
    nearest = int(np.argmin([abs(math.log(spp / cell.first.spp)) for spp in SPP]))
    return {"clamp": 0, **dict(zip(NAMES[name], STARTS[name][cell.first.scene][nearest], strict=True))}


def _rival(name: str, light: Image, features: Array, settings: Settings) -> Array:
    sigmas = [settings["normal"]] * 3
    if name == "bilateral_best":
        # Few radii, since each is a program of its own.
        radius = int(np.clip(8 * math.ceil(settings["sigma"] / 4.0 - 0.1), 8, 32))
        sigma = jnp.asarray([*sigmas, settings["depth"]], jnp.float32)
        return _bilateral(light, features, jnp.float32(settings["sigma"]), sigma, radius)
    for feature in ("position", "ao"):
        sigmas += [settings[feature]] * 3 if feature in settings else []
    return _atrous(light, features, jnp.asarray(sigmas, jnp.float32), int(settings["levels"]))


def _cell_rows(
    cell: Cell, ways: Mapping[str, Callable[[Cell, int], Result]], sizes: Sizes, out: Path
) -> Iterator[Measurement]:
    first = cell.first
    height, width = cell.seen.shape
    common = {"scene": first.scene, "spp": first.spp, "height": height, "width": width}
    common |= {"reference_spp": first.reference_spp, "seeds": len(cell.renders)}
    panels: dict[str, tuple[str, Color]] = {}
    for name, way in ways.items():
        images, settings = way(cell, sizes.rounds)
        metrics = cell.judge(images)
        if name in PANELS:
            panels[name] = f"{PANELS[name]}, MSE {metrics['mse_255']:.3g}", images[0]
        yield Measurement("quality", name, metrics, {**common, "settings": _told(settings)})
    if first.spp in sizes.pictures:
        strip = {"reference": cell.reference, **dict(panels[name] for name in PANELS if name in panels)}
        draw_strip(cell, strip, out / f"{first.scene}_{width}x{height}_{first.spp}.png")


def _told(settings: Mapping[str, Any]) -> str:
    return " ".join(f"{name}={value:.4g}" for name, value in settings.items())


def _geometric_mean(pairs: Sequence[tuple[float, float]]) -> float:
    """Of first over second; NaN if one is not above 0."""
    if min(min(pair) for pair in pairs) <= 0.0:
        return math.nan
    return math.exp(float(np.mean([math.log(a / b) for a, b in pairs])))


def _oidn_of(light: Color, normal: Color) -> Color:
    pyoidn = importlib.import_module("pyoidn")
    light, normal = (np.ascontiguousarray(image, np.float32) for image in (light, normal))
    return pyoidn.denoise(light, np.ones_like(light), normal, hdr=True, clean_aux=True)


@jax.jit
def _clamped(light):
    return clamp_fireflies(light, factor=_FIREFLY_FACTOR)[0]


@functools.partial(jax.jit, static_argnames="radius")
def _guided(channels, light, eps, radius):
    return guided_filter(channels, light, radius=radius, eps=eps)


@functools.partial(jax.jit, static_argnames="radius")
def _bilateral(light, features, sigma, sigma_features, radius):
    return cross_bilateral_filter(light, features, radius=radius, sigma_spatial=sigma, sigma_features=sigma_features)


@functools.partial(jax.jit, static_argnames="num_levels")
def _atrous(light, features, sigma, num_levels):
    return atrous_filter(light, features, num_levels=num_levels, sigma_features=sigma)
