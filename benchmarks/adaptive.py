"""Adaptive supersampling beside full supersampling and other anti-aliasing: time, error and share of the samples.

The scene is Sponza where `../shared/data` has it, else the built-in one, from three cameras (no setting was chosen by
what C shows), under point lights without shadows that the seed places. Errors are of display-encoded values in [0, 1]
over black, against full supersampling of the same m; `psnr_255_db` is the paper's convention, 48.13 dB more than
`psnr_db`. Shares are of the covered sub-samples. Cases:

- `table1`: the paper's table. Whole frames, from triangles to display-encoded values, alternating with each other;
  `compile_ms` is only what no row before has compiled. Then errors without times: other views, normal maps off. `flip`
  is in the rows with the fewest lights and normal maps on.
- `lights256`: its times under more lights; runs only where a pattern other than `*` asks for it.
- `uniform`: the same count in every pixel, for all counts.
- `metrics`: the terms of the printed metrics alone and together, balanced counts, trilinear lookups (against the
  anisotropic reference); at the default scale, and at a larger one for what is too few samples only.
- `strategies`: the ways to evaluate the samples of the printed metrics. `predicted_ratio` is lanes paid over samples
  shaded by "compacted" in warps of 32, `measured_ratio` the time over that of "compacted"; `predicted_gain` is what
  shading gains over full supersampling if lanes are all that counts.
- `dial`: error over share as all tolerances change together; the share at which it crosses the paper's error. Normal
  maps that a pixel is too coarse for cost most of the samples, so both with and without them.
- `flicker`: a camera that moves slowly. `flicker_255` is the mean absolute second difference in time less that of the
  reference, `error_flicker_255` that of the error, both in levels of 255. "..._averaged" goes by the frame before too.
- `pictures`: figures and a flight, in `out/adaptive`.
"""

import dataclasses
import functools
import importlib.util
import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from benchmarks.raster import SPONZA, point_lights
from benchmarks.suites import Measurement, Options
from benchmarks.timing import measure_alternating
from jaxrender import console
from jaxrender.camera import Camera
from jaxrender.deferred.adaptive import Method, Uniform, scene_view, shade_adaptive, supersample
from jaxrender.deferred.bands import band_starts, in_bands
from jaxrender.deferred.by_quads import QuadBudget
from jaxrender.deferred.canvas import AdaptiveImage
from jaxrender.deferred.clusters import Clusters
from jaxrender.deferred.fxaa import fxaa
from jaxrender.deferred.gbuffer import rows_per_band
from jaxrender.deferred.metrics import SampleMetrics, balanced_counts
from jaxrender.deferred.mlaa import mlaa
from jaxrender.deferred.pipeline import scene_material_textures
from jaxrender.deferred.point_lists import screen_order
from jaxrender.deferred.point_shading import Lighting
from jaxrender.deferred.sampling import first_sample, window_size
from jaxrender.deferred.sraa import sraa
from jaxrender.deferred.strategies import STRATEGIES, work_order
from jaxrender.deferred.subsamples import SubSamples
from jaxrender.deferred.warps import warp_cost
from jaxrender.io import load_scene
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.machine import keep_xla_to_one_thread
from jaxrender.metrics import flip, mse, psnr
from jaxrender.scene import Lights, Scene, scene_bounds, whole_scene_camera
from jaxrender.srgb import encode_srgb

Params = dict[str, str | int | float | bool]
Vector = tuple[float, float, float]

#: Where `pictures` go.
OUT = Path("out/adaptive")
#: Eye and target of the cameras inside Sponza, and the box its lights are in.
SPONZA_VIEWS: dict[str, tuple[Vector, Vector]] = {
    "A": ((10.0, 2.0, 0.0), (-5.0, 3.0, 0.0)),
    "B": ((-11.0, 1.6, -3.0), (6.0, 4.0, 2.5)),
    "C": ((2.0, 6.5, 4.2), (-7.0, 2.5, -3.0)),
}
SPONZA_BOX = ((-15.0, 0.5, -6.0), (14.0, 9.0, 6.0))
#: Angles of the cameras around the built-in scene.
BUILTIN_VIEWS = {"A": (0.6, 0.35), "B": (-0.8, 0.15), "C": (2.4, 0.6)}
#: Radiant intensity of all lights together, of at least so many; and of the camera of `flicker`, metres a frame. Both
#: are for Sponza, and follow the size of other scenes.
TOTAL_INTENSITY, FEWEST_LIGHTS, SLOWLY = 525.0, 8, (-0.012, 0.002, 0.008)
#: dB (peak 1) of the paper's table, by m.
PAPER_DB = {2: 43.0, 3: 45.1, 4: 44.2}
SRAA = {"sigma_depth": 0.01, "sigma_normal": 0.1, "sigma_space": 0.5}

PRINTED, ADAPTIVE = SampleMetrics(), Clusters()


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
      grids: values of m, from 2 on. lights: how many, fewest first. larger_scale: besides 1 in `metrics`.
      dial: scales, ascending. flicker, flight, picture: (height, width) of their images.
    """

    height: int = 768
    width: int = 1024
    grids: tuple[int, ...] = (2, 3, 4)
    lights: tuple[int, ...] = (8, 64)
    views: tuple[str, ...] = ("A", "B", "C")
    min_runs: int = 3
    metric_grids: tuple[int, ...] = (3, 4)
    larger_scale: float = 4.0
    strategies_grid: int = 4
    dial: tuple[float, ...] = (0.3, 0.55, 1.0, 1.7, 3.0)
    flicker: tuple[int, int] = (288, 384)
    flicker_frames: int = 12
    flicker_grid: int = 3
    picture: tuple[int, int] = (480, 640)
    flight: tuple[int, int] = (288, 384)
    flight_frames: int = 36


FULL = Sizes()
QUICK = Sizes(
    height=192, width=256, grids=(2,), lights=(8,), views=("A", "C"), min_runs=1, metric_grids=(2,), strategies_grid=2,
    dial=(0.3, 1.0, 3.0), flicker=(192, 256), flicker_frames=4, flicker_grid=2, picture=(192, 256), flight=(192, 256),
    flight_frames=3,
)  # fmt: skip


def run(options: Options) -> Iterator[Measurement]:
    """The cases; see the suite's description."""
    keep_xla_to_one_thread()
    sizes = QUICK if options.quick else FULL
    wanted = [case for case in CASES if (options.names if case in ON_REQUEST else options.wants)(case)]
    if wanted:
        place = open_place(builtin=options.quick, seed=options.seed)
    for case in wanted:
        yield from CASES[case](place, sizes)


# --- What is drawn


@dataclass(frozen=True)
class Place:
    """A scene to look at, with what does not change from picture to picture.

    Attributes:
      box: lowest and highest corner of where its lights are.
      flight: the camera of a film, at a share of its time.
    """

    name: str
    scene: Scene
    textures: Any
    cameras: Mapping[str, Camera]
    flight: Callable[[float], Camera]
    box: tuple[np.ndarray, np.ndarray]
    seed: int

    @property
    def scale(self) -> float:
        """Its diagonal, 1 for Sponza."""
        diagonal = lambda low, high: float(np.linalg.norm(np.subtract(high, low)))  # noqa: E731
        return diagonal(*self.box) / diagonal(*SPONZA_BOX)

    def lights(self, number: int) -> Lights:
        """Point lights spread over the box."""
        rng = np.random.default_rng(self.seed)
        position, color = rng.uniform(*self.box, (number, 3)), rng.uniform(0.6, 1.0, (number, 3))
        intensity = color * TOTAL_INTENSITY * self.scale**2 / max(number, FEWEST_LIGHTS)
        return point_lights(position, intensity)


def open_place(*, builtin: bool, seed: int) -> Place:
    """Sponza if it is there and wanted, else the built-in scene."""
    if builtin or not SPONZA.is_file():
        scene = builtin_scene(num_vertices=40_000)
        around = functools.partial(whole_scene_camera, scene, aspect=4 / 3)
        cameras = {
            name: around(azimuth_radians=azimuth, elevation_radians=elevation)
            for name, (azimuth, elevation) in BUILTIN_VIEWS.items()
        }
        flight = lambda share: around(azimuth_radians=0.6 + 2.0 * math.pi * share)  # noqa: E731
        low, high = (np.asarray(bound, np.float64) for bound in scene_bounds(scene))
        return Place("built-in", scene, scene_material_textures(scene), cameras, flight, (low, high), seed)
    scene = load_scene(SPONZA)
    cameras = {name: _camera(*ends) for name, ends in SPONZA_VIEWS.items()}
    box = np.array(SPONZA_BOX[0]), np.array(SPONZA_BOX[1])
    return Place("Sponza", scene, scene_material_textures(scene), cameras, _down_the_nave, box, seed)


def _camera(eye: Iterable[float], target: Iterable[float]) -> Camera:
    eye, target, up = (jnp.asarray(list(v), jnp.float32) for v in (eye, target, (0.0, 1.0, 0.0)))
    return Camera(eye, target, up, jnp.float32(np.radians(60.0)))


def _down_the_nave(share: float) -> Camera:
    """From view A to the far end of the court, slow at both ends."""
    t = share * share * (3.0 - 2.0 * share)
    between = lambda start, end: (1.0 - t) * np.array(start) + t * np.array(end)  # noqa: E731
    return _camera(between((10.0, 2.0, 0.0), (-6.0, 3.4, 1.0)), between((-5.0, 3.0, 0.0), (-16.0, 3.0, -1.5)))


@dataclass(frozen=True)
class View:
    """What all ways to draw a picture have in common."""

    place: Place
    camera: Camera
    height: int
    width: int
    size: int
    lights: int
    name: str = "A"
    normal_maps: bool = True
    max_anisotropy: int = 8

    def rasterise(self, size: int) -> tuple[SubSamples, Lighting]:
        """size x size sub-samples a pixel, and what shading them needs; all there when it returns."""
        samples, lighting = scene_view(
            self.place.scene, self.camera, height=self.height, width=self.width, size=size,
            textures=self.place.textures, lights=self.place.lights(self.lights), max_anisotropy=self.max_anisotropy,
        )  # fmt: skip
        slots = tuple(slot for slot in lighting.slots if self.normal_maps or slot != "normal_texture")
        return jax.block_until_ready(samples), dataclasses.replace(lighting, slots=slots)

    def params(self, **more: str | int | float | bool) -> Params:
        """Of a record."""
        return {
            "m": self.size, "lights": self.lights, "view": self.name, "scene": self.place.name, "height": self.height,
            "width": self.width, "normal_maps": self.normal_maps, "seed": self.place.seed, **more,
        }  # fmt: skip


def view_of(place: Place, sizes: Sizes, *, size: int, name: str = "A", lights: int | None = None, **more: Any) -> View:
    """A view at the suite's size, under the fewest lights if nothing else is said."""
    number = sizes.lights[0] if lights is None else lights
    return View(place, place.cameras[name], sizes.height, sizes.width, size, number, name, **more)


# --- Ways to draw it


@dataclass(frozen=True)
class Shot:
    """A picture and what it took.

    Attributes:
      image: display-encoded, over black.
      num_pixels: those where anything is.
    """

    image: Float[np.ndarray, "h w 3"]
    num_shaded: int
    num_covered: int
    num_pixels: int
    count: Int[np.ndarray, "h w"]

    @property
    def sample_share(self) -> float:
        """As of `AdaptiveImage`."""
        return self.num_shaded / max(self.num_covered, 1)


Shots = dict[str, Shot]


def show(drawn: AdaptiveImage) -> Shot:
    """A picture as a screen shows it."""
    image = np.asarray(_encoded(drawn.image, drawn.alpha))
    return Shot(image, drawn.num_shaded, drawn.num_covered, int(np.count_nonzero(drawn.alpha)), drawn.count)


def _filtered(encoded_filter: Callable[[Array], Array]) -> Callable[..., Shot]:
    """Supersampling as it is, then a filter of the finished image."""

    def draw(samples: SubSamples, lighting: Lighting, shots: Shots) -> Shot:
        shot = show(supersample(samples, lighting))
        return dataclasses.replace(shot, image=np.asarray(encoded_filter(jnp.asarray(shot.image))))

    return draw


def _uniformly(samples: SubSamples, lighting: Lighting, shots: Shots) -> Shot:
    """With the balanced count that is nearest to what the printed metrics shaded."""
    n = samples.depth.shape[-1]
    wanted = n * shots["printed"].sample_share
    count = min(balanced_counts(window_size(n))[:-1], key=lambda k: abs(k - wanted))
    return show(shade_adaptive(samples, lighting, method=Uniform(count)))


def _by_quads(samples: SubSamples, lighting: Lighting, shots: Shots) -> Shot:
    """With as many samples as the printed metrics shaded, the same in each quad."""
    n = samples.depth.shape[-1]
    count = min(max(4, round(4 * n * shots["printed"].sample_share)), 4 * n - 1)
    return show(shade_adaptive(samples, lighting, method=QuadBudget(count)))


def _reconstructed(samples: SubSamples, lighting: Lighting, shots: Shots) -> Shot:
    """One sample of each pixel is shaded, and spread by SRAA."""
    height, width, n = samples.depth.shape
    drawn = shade_adaptive(samples, lighting, method=Uniform(1))
    band = rows_per_band(height, width * n, times=4)
    rows = functools.partial(_sraa_rows, samples, drawn.image, num_rows=band, size=window_size(n))
    image = in_bands(lambda start: rows(np.int32(start)), band_starts(height, band), height=height)
    return show(dataclasses.replace(drawn, image=image))


@functools.partial(jax.jit, static_argnames=("num_rows", "size"))
def _sraa_rows(samples: SubSamples, shading: Array, start: Array, *, num_rows: int, size: int) -> Array:
    """Rows from `start` on; one more on either side is read."""
    height, width, n = samples.depth.shape
    row = start - 1 + jnp.arange(num_rows + 2, dtype=jnp.int32)
    inside, row = (row >= 0) & (row < height), jnp.clip(row, 0, height - 1)
    column, sample = (jnp.arange(count, dtype=jnp.int32) for count in (width, n))
    pixel = row[:, None] * width + column[None]
    found, _ = samples.look(pixel[..., None] * n + sample[None, None])
    covered = found.coverage & inside[:, None, None]
    first = first_sample(found.coverage)
    image = sraa(shading[row], found.depth, found.normal, covered, first, size=size, **SRAA)
    return image[1:-1]


#: Variant -> how samples are shaded; it may look at what was drawn before it. In the order of drawing.
WAYS: dict[str, Callable[[SubSamples, Lighting, Shots], Shot]] = {
    "supersampled": lambda samples, lighting, shots: show(supersample(samples, lighting)),
    "printed": lambda samples, lighting, shots: show(shade_adaptive(samples, lighting, method=PRINTED)),
    "adaptive": lambda samples, lighting, shots: show(shade_adaptive(samples, lighting, method=ADAPTIVE)),
    "uniform": _uniformly,
    "quads": _by_quads,
    "sraa": _reconstructed,
    "single": lambda samples, lighting, shots: show(supersample(samples, lighting)),
    "fxaa": _filtered(jax.jit(fxaa)),
    "mlaa": _filtered(jax.jit(mlaa)),
}
#: Those that rasterise one sample a pixel.
ONE_SAMPLE = ("single", "fxaa", "mlaa")

_encoded = jax.jit(lambda image, alpha: encode_srgb(image * alpha[..., None]))


class Frames:
    """One view drawn in several ways: the last picture of each, and the seconds of its stages each time."""

    def __init__(self, view: View, *, keep: bool = False):
        """With `keep`, what is rasterised is kept for the next."""
        self.view, self.keep = view, keep
        self.shots: Shots = {}
        self.seconds: dict[str, list[tuple[float, float]]] = {}
        self._kept: dict[int, tuple[SubSamples, Lighting]] = {}

    def draw(self, variant: str) -> np.ndarray:
        """A whole frame, to display-encoded values."""
        start = time.perf_counter()
        samples, lighting = self.rasterised(1 if variant in ONE_SAMPLE else self.view.size)
        middle = time.perf_counter()
        self.shots[variant] = WAYS[variant](samples, lighting, self.shots)
        self.seconds.setdefault(variant, []).append((middle - start, time.perf_counter() - middle))
        return self.shots[variant].image

    def rasterised(self, size: int) -> tuple[SubSamples, Lighting]:
        """The sub-samples, anew or as kept."""
        if not self.keep:
            return self.view.rasterise(size)
        if size not in self._kept:
            self._kept[size] = self.view.rasterise(size)
        return self._kept[size]

    def by(self, method: Method) -> Shot:
        """The picture by another method or setting."""
        return show(shade_adaptive(*self.rasterised(self.view.size), method=method))

    def reference(self) -> Shot:
        """Full supersampling, drawn once."""
        if "supersampled" not in self.shots:
            self.draw("supersampled")
        return self.shots["supersampled"]

    def stages(self, variant: str) -> dict[str, float]:
        """Median times of the stages but for the first frame."""
        raster, shading = np.median(self.seconds[variant][1:], axis=0)
        return {"ms_raster": 1e3 * float(raster), "ms_shade": 1e3 * float(shading)}


def judge(shot: Shot, reference: Shot, *, with_flip: bool = False) -> dict[str, float]:
    """Error against the reference, and how much of its work was done."""
    error = float(mse(jnp.asarray(shot.image), jnp.asarray(reference.image)))
    decibel = float(psnr(jnp.asarray(shot.image), jnp.asarray(reference.image)))
    found = {"mse": error, "psnr_db": decibel, "psnr_255_db": decibel + 20.0 * math.log10(255.0)}
    if with_flip and _has_flip():
        found["flip"] = flip(shot.image, reference.image)
    return {**found, **amount(shot, reference)}


def amount(shot: Shot, reference: Shot) -> dict[str, float]:
    """Samples shaded, as a share of those that full supersampling shades, and per pixel."""
    return {
        "sample_share": shot.num_shaded / max(reference.num_covered, 1),
        "samples_per_pixel": shot.num_shaded / max(reference.num_pixels, 1),
    }


@functools.cache
def _has_flip() -> bool:
    if importlib.util.find_spec("flip_evaluator") is not None:
        return True
    console.announce("adaptive: flip-evaluator is not installed; flip is left out")
    return False


# --- Cases


def _table(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    for number in sizes.lights:
        one = view_of(place, sizes, size=1, lights=number)
        yield from _one_sample(one, sizes)
        for size in sizes.grids:
            yield from _timed("table1", view_of(place, sizes, size=size, lights=number), sizes)
    for name in sizes.views[1:]:
        for number in sizes.lights:
            for size in sizes.grids:
                yield from _judged(view_of(place, sizes, size=size, name=name, lights=number), sizes)
    for name in sizes.views:
        for size in sizes.grids:
            yield from _judged(view_of(place, sizes, size=size, name=name, normal_maps=False), sizes)


def _many_lights(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    for size in sizes.grids:
        yield from _timed("lights256", view_of(place, sizes, size=size, lights=256), sizes)


def _one_sample(view: View, sizes: Sizes) -> Iterator[Measurement]:
    """The paper's first rows: times alone."""
    frames = Frames(view)
    variants = {variant: functools.partial(frames.draw, variant) for variant in ONE_SAMPLE}
    for variant, timing in measure_alternating(variants, min_runs=sizes.min_runs, min_seconds=0.0, max_runs=1).items():
        metrics = {**timing.metrics(), **frames.stages(variant), **amount(frames.shots[variant], frames.shots[variant])}
        yield Measurement("table1", variant, metrics, view.params())


def _timed(case: str, view: View, sizes: Sizes) -> Iterator[Measurement]:
    """All ways to draw a view, in turn."""
    jax.clear_caches()  # a process has room for some thousands of programs, and every view brings its own
    frames = Frames(view)
    variants = {variant: functools.partial(frames.draw, variant) for variant in WAYS}
    timings = measure_alternating(variants, min_runs=sizes.min_runs, min_seconds=0.0, max_runs=1)
    with_flip = view.lights == sizes.lights[0]
    for variant, timing in timings.items():
        speedup = timings["supersampled"].ms_median / timing.ms_median
        metrics = {**timing.metrics(), **frames.stages(variant), "speedup": speedup}
        yield Measurement(case, variant, {**metrics, **_errors(frames, variant, with_flip)}, view.params())


def _judged(view: View, sizes: Sizes) -> Iterator[Measurement]:
    """All ways to draw a view, once, without times."""
    jax.clear_caches()
    frames = Frames(view, keep=True)
    for variant in WAYS:
        frames.draw(variant)
        with_flip = view.lights == sizes.lights[0] and view.normal_maps
        yield Measurement("table1", variant, _errors(frames, variant, with_flip), view.params())


def _errors(frames: Frames, variant: str, with_flip: bool) -> dict[str, float]:
    shot, reference = frames.shots[variant], frames.reference()
    if shot is reference:
        return amount(shot, reference)
    return judge(shot, reference, with_flip=with_flip)


def _uniform(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    for size in sizes.grids:
        frames = Frames(view_of(place, sizes, size=size), keep=True)
        for count in range(1, size * size):
            found = judge(frames.by(Uniform(count)), frames.reference())
            balanced = count in balanced_counts(size)
            yield Measurement("uniform", "uniform", found, frames.view.params(count=count, balanced=balanced))


#: Variant of the case `metrics` -> settings.
TERMS: dict[str, SampleMetrics] = {
    "depth": SampleMetrics(normal=None, shading=None),
    "depth_plane_corrected": SampleMetrics(normal=None, shading=None, plane_corrected=True),
    "normal": SampleMetrics(depth=None, shading=None),
    "shading": SampleMetrics(depth=None, normal=None),
    "normal_shading": SampleMetrics(depth=None),
    "all": PRINTED,
    "all_plane_corrected": SampleMetrics(plane_corrected=True),
    "all_balanced": SampleMetrics(balanced=True),
    "all_mapped_normals": SampleMetrics(mapped_normals=True),
    "highlight": SampleMetrics(depth=None, normal=None, shading=None, highlight=48.0),
    "highlight_shading": SampleMetrics(depth=None, normal=None, highlight=48.0),
    "all_highlight": SampleMetrics(highlight=48.0),
}


def _metrics(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    for size in sizes.metric_grids:
        view = view_of(place, sizes, size=size)
        frames = Frames(view, keep=True)
        trilinear = Frames(dataclasses.replace(view, max_anisotropy=1), keep=True)
        drawn = [(name, frames, terms) for name, terms in TERMS.items()] + [("all_trilinear", trilinear, PRINTED)]
        for name, own, terms in drawn:
            for scale in (1.0, sizes.larger_scale):
                found = judge(own.by(dataclasses.replace(terms, scale=scale)), frames.reference())
                yield Measurement("metrics", name, found, view.params(scale=scale))


def _strategies(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    view = view_of(place, sizes, size=sizes.strategies_grid, lights=sizes.lights[-1])
    samples, lighting = view.rasterise(view.size)
    drawn: dict[str, AdaptiveImage] = {}

    def draw(strategy: str) -> np.ndarray:
        drawn[strategy] = shade_adaptive(samples, lighting, method=PRINTED, strategy=strategy)
        return drawn[strategy].image

    variants = {strategy: functools.partial(draw, strategy) for strategy in STRATEGIES}
    timings = measure_alternating(variants, min_runs=sizes.min_runs, min_seconds=0.0, max_runs=1)
    plain = drawn["compacted"]
    for strategy, timing in timings.items():
        equal = np.array_equal(drawn[strategy].image, plain.image)
        paid = _lanes_paid(drawn[strategy].count, strategy)
        numbers = {
            "sample_share": drawn[strategy].sample_share,
            "predicted_ratio": paid / max(int(plain.count.sum()), 1),
            "predicted_gain": plain.num_covered / max(paid, 1),
            "measured_ratio": timing.ms_median / timings["compacted"].ms_median,
            "mse_to_compacted": judge(show(drawn[strategy]), show(plain))["mse"],
        }
        yield Measurement("strategies", strategy, {**timing.metrics(), **numbers}, view.params(bit_equal=equal))


def _lanes_paid(count: Int[np.ndarray, "h w"], strategy: str) -> int:
    """What warps of 32 lanes pay for these counts."""
    if strategy in ("masked", "low_resolution"):
        return int(jnp.sum(warp_cost(jnp.asarray(count), order="blocks").paid))
    return len(work_order(count.reshape(-1)[screen_order(*count.shape)], strategy=strategy)[0])


def _dial(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    for name, normal_maps, size in itertools.product(sizes.views, (True, False), sizes.grids):
        frames = Frames(view_of(place, sizes, size=size, name=name, normal_maps=normal_maps), keep=True)
        for variant, method in (("adaptive", ADAPTIVE), ("printed", PRINTED)):
            curve = []
            for scale in sizes.dial:
                found = judge(frames.by(dataclasses.replace(method, scale=scale)), frames.reference())
                curve.append((found["sample_share"], found["psnr_db"]))
                yield Measurement("dial", variant, found, frames.view.params(scale=scale))
            goal = PAPER_DB[size]
            found = {"share_at_goal": share_at(goal, curve)}
            yield Measurement("dial", variant, found, frames.view.params(goal_db=goal))


def share_at(goal: float, curve: list[tuple[float, float]]) -> float:
    """The share at which a curve of (share, dB) first reaches a goal.

    Between points dB is linear in the share. NaN if the curve begins above the goal, so that less would do too, or
    never gets there.
    """
    for (share, low), (more, high) in itertools.pairwise(curve):
        if low < goal <= high:
            return share + (more - share) * (goal - low) / (high - low)
    return math.nan


#: Variants of the case `flicker`, and those of them that go by the frame before too.
FLICKERING = ("supersampled", "single", "fxaa", "printed", "adaptive")
AVERAGED: dict[str, Method] = {"printed_averaged": PRINTED, "adaptive_averaged": ADAPTIVE}


def _flicker(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    height, width = sizes.flicker
    start = view_of(place, sizes, size=sizes.flicker_grid)
    start = dataclasses.replace(start, height=height, width=width)
    shots: dict[str, list[Shot]] = {variant: [] for variant in (*FLICKERING, *AVERAGED)}
    before: dict[str, AdaptiveImage | None] = dict.fromkeys(AVERAGED)
    for frame in range(sizes.flicker_frames):
        frames = Frames(dataclasses.replace(start, camera=_moved(place, start.camera, frame)), keep=True)
        for variant in FLICKERING:
            frames.draw(variant)
            shots[variant].append(frames.shots[variant])
        for variant, method in AVERAGED.items():
            drawn = shade_adaptive(*frames.rasterised(start.size), method=method, previous=before[variant])
            before[variant] = drawn
            shots[variant].append(show(drawn))
    references = shots["supersampled"]
    reference = np.stack([shot.image for shot in references])
    for variant, own in shots.items():
        film = np.stack([shot.image for shot in own])
        numbers = {
            "flicker_255": _restlessness(film) - _restlessness(reference),
            "error_flicker_255": _restlessness(film - reference),
            "sample_share": float(
                np.mean([amount(*pair)["sample_share"] for pair in zip(own, references, strict=True)])
            ),
        }
        if variant not in ("supersampled", "single", "fxaa"):
            decibel = [judge(*pair)["psnr_db"] for pair in zip(own, references, strict=True)]
            numbers["psnr_db"] = float(np.mean(decibel))
        yield Measurement("flicker", variant, numbers, start.params(frames=sizes.flicker_frames))


def _moved(place: Place, camera: Camera, frame: int) -> Camera:
    way = jnp.asarray(np.array(SLOWLY) * (place.scale * frame), jnp.float32)
    return dataclasses.replace(camera, eye=camera.eye + way, target=camera.target + way)


def _restlessness(film: Float[np.ndarray, "f h w 3"]) -> float:
    """How much a film changes its mind: the mean absolute second difference in time, in levels of 255."""
    return 255.0 * float(np.mean(np.abs(np.diff(film, n=2, axis=0)), dtype=np.float64))


def _pictures(place: Place, sizes: Sizes) -> Iterator[Measurement]:
    from benchmarks.adaptive_figures import FIGURES  # which uses all of the above

    for name, figure in FIGURES.items():
        path, view, numbers = figure(place, sizes, OUT / name)
        yield Measurement("pictures", Path(name).stem, numbers, view.params(path=str(path)))


CASES: dict[str, Callable[[Place, Sizes], Iterator[Measurement]]] = {
    "table1": _table,
    "lights256": _many_lights,
    "uniform": _uniform,
    "metrics": _metrics,
    "strategies": _strategies,
    "dial": _dial,
    "flicker": _flicker,
    "pictures": _pictures,
}
#: Cases that take too long to run with all the others.
ON_REQUEST = ("lights256",)
