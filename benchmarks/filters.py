"""Guided, cross-bilateral and à-trous filters beside OpenCV, kornia and OIDN; the precision of window variances.

On one thread per core as XLA's own defaults have it, which is how users call the library. The picture is drawn from the
seed: a relief with blocks, seen from above, under a light whose noise is that of one sample per pixel. Cases:

- `table2`: the filters and settings of table 2 of Bauszat et al. 2011, at two sizes.
- `radius`: the guided filter with 3 guide channels over the radius. `ratio_to_24` is the time against radius 24.
- `precision`: variances over windows from float32 sums of four kinds.
- `gradient`: value and derivatives of the guided filter by its own rule, and by plain automatic differentiation.
- `fast`: the guided filter with coefficients from fewer pixels.

Variants: `jaxrender` is the jitted function; `jaxrender_bands` spreads it over all cores; a peer has its name. What a
peer does otherwise is in `differs`. All variants of a setting take turns. `max_error` is the largest error against
float64 sums over the upper left corner of the picture, `max_error_inside` that away from the border, where all guided
filters are one. `peak_bytes` is the growth of the process in a call after the first.
"""

import dataclasses
import functools
import importlib
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from benchmarks import denoising
from benchmarks.suites import Measurement, Options
from benchmarks.timing import measure_alternating, peak_memory
from jaxrender import console
from jaxrender.filters import (
    atrous_filter,
    box_sum_from_table,
    box_variance,
    cross_bilateral_filter,
    guided_filter,
    guided_filter_in_bands,
    summed_area_table,
)
from jaxrender.filters.guided import center_of, filter_planes
from jaxrender.metrics import mse, psnr

EPS = 1e-3
RADIUS = 24
SIGMA_FEATURES = 0.1
#: Pixels a side of the corner that is compared with float64.
CHECKED = 256
PEER_MODULES = {"opencv": "cv2", "kornia": "kornia", "oidn": "pyoidn"}

Image = Float[np.ndarray, "h w _"]
Params = dict[str, str | int | float | bool]
Call = Callable[[], Any]


@dataclass(frozen=True)
class Sizes:
    """How much is measured; heights before widths."""

    table: tuple[tuple[int, int], ...] = ((768, 1024), (2160, 3840))
    #: Larger pictures get fewer runs, the smallest bilateral radius only, and no peers that would take minutes a call.
    small_pixels: int = 2_000_000
    runs_of_large: int = 3
    bilateral_radii: tuple[int, ...] = (16, 24, 32)
    levels: tuple[int, ...] = (4, 5, 6)
    guide_channels: tuple[int, ...] = (1, 3, 4)
    radii: tuple[int, ...] = (2, 4, 8, 16, 24, 32, 48, 64, 128)
    kornia_radii: tuple[int, ...] = (2, 8, 24)
    precision: tuple[tuple[int, int], ...] = ((768, 1024), (4096, 4096))
    precision_radii: tuple[int, ...] = (1, 24, 512)
    subsamples: tuple[int, ...] = (1, 2, 4, 8)
    min_runs: int = 5
    min_seconds: float = 1.0


FULL = Sizes()
QUICK = Sizes(
    table=((128, 192),), radii=(2, 8, 24, 64), precision=((128, 192),), min_runs=2, min_seconds=0.0
)  # fmt: skip


class Picture(NamedTuple):
    """A noisy picture and what is known of it; all float32."""

    noisy: Image
    guide: Image  # normal and depth, in [0, 1]
    normal: Image  # in [-1, 1]
    albedo: Image


def run(options: Options) -> Iterator[Measurement]:
    """The asked cases, in the order of `CASES`."""
    sizes = QUICK if options.quick else FULL
    for name, case in CASES.items():
        if options.wants(name):
            yield from case(sizes, options.seed)
    if options.wants("quality"):
        yield from denoising.quality(options)


def draw_picture(height: int, width: int, seed: int) -> Picture:
    """A wavy relief with raised blocks from above, and its light as one sample per pixel sees it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / height
    blocks = (np.floor(6 * x) + np.floor(6 * y)) % 2
    relief = 0.3 * np.sin(9 * x) * np.cos(7 * y) + 0.3 * blocks + 0.3
    dy, dx = np.gradient(relief, 1 / height)
    normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = 0.2 + 0.6 * np.stack([blocks, 1 - blocks, np.full_like(x, 0.5)], axis=-1)
    light = (0.6 + 0.4 * np.sin(3 * x + 2 * y))[..., None] * np.maximum(normal[..., 2:], 0.2) * [1.0, 0.8, 0.6]
    noisy = albedo * light * rng.exponential(size=(height, width, 1))
    guide = np.concatenate([0.5 + 0.5 * normal, 1 - relief[..., None]], axis=-1)
    return Picture(*(array.astype(np.float32) for array in (noisy, guide, normal, albedo)))


@functools.cache
def peer(name: str) -> types.ModuleType | None:
    """A peer's library, or None, said once, where it cannot be loaded or does not work."""
    try:
        module = importlib.import_module(PEER_MODULES[name])
        if name == "opencv":
            module.ximgproc.guidedFilter  # noqa: B018  only in the builds with contrib
        if name == "oidn":  # loads its weights and its device with the first image
            module.denoise(np.ones((32, 32, 3), np.float32), hdr=True)
    except (ImportError, OSError, AttributeError, RuntimeError) as error:
        console.announce(f"filters: {name} is not to be had ({error}); its rows are left out")
        return None
    return module


# --- Table 2


def _table2(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    for height, width in sizes.table:
        picture = draw_picture(height, width, seed)
        small = height * width <= sizes.small_pixels
        runs = sizes if small else dataclasses.replace(sizes, min_runs=min(sizes.min_runs, sizes.runs_of_large))
        size: Params = {"height": height, "width": width, "seed": seed}
        for radius in sizes.bilateral_radii if small else sizes.bilateral_radii[:1]:
            yield from _bilateral(picture, radius, size, runs, with_peer=small)
        for levels in sizes.levels:
            yield from _atrous(picture, levels, size, runs)
        for channels in sizes.guide_channels:
            yield from _guided(picture, channels, size, runs, plain_kornia=small)
        yield from _oidn(picture, size, runs)


def _bilateral(picture: Picture, radius: int, size: Params, sizes: Sizes, *, with_peer: bool) -> Iterator[Measurement]:
    ours = partial(cross_bilateral_filter, radius=radius, sigma_spatial=radius / 2, sigma_features=SIGMA_FEATURES)
    images = picture.noisy, picture.guide
    variants: dict[str, Call] = {"jaxrender": _jitted(ours, images)}
    params: Params = {**size, "filter": "bilateral", "radius": radius, "features": 4, "sigma_features": SIGMA_FEATURES}
    differs: dict[str, Params] = {}
    if with_peer and (cv2 := peer("opencv")):
        joint = np.ascontiguousarray(picture.guide[..., :3])
        variants["opencv"] = partial(
            cv2.ximgproc.jointBilateralFilter, joint, picture.noisy, 2 * radius + 1, SIGMA_FEATURES, radius / 2
        )
        differs["opencv"] = {"features": 3, "differs": "distance |d1|+|d2|+|d3|, a disc, border mirrored"}
    judge = {"jaxrender": _judge(in_float64(ours), images, halo=radius)}
    yield from _rows("table2", variants, params, sizes, judge=judge, differs=differs)


def _atrous(picture: Picture, levels: int, size: Params, sizes: Sizes) -> Iterator[Measurement]:
    ours = partial(atrous_filter, num_levels=levels, sigma_features=SIGMA_FEATURES)
    images = picture.noisy, picture.guide
    params: Params = {**size, "filter": "atrous", "levels": levels, "features": 4, "sigma_features": SIGMA_FEATURES}
    judge = {"jaxrender": _judge(in_float64(ours), images, halo=2 * (2**levels - 1))}
    yield from _rows("table2", {"jaxrender": _jitted(ours, images)}, params, sizes, judge=judge)


def _guided(
    picture: Picture, channels: int, size: Params, sizes: Sizes, *, plain_kornia: bool
) -> Iterator[Measurement]:
    images = np.ascontiguousarray(picture.guide[..., :channels]), picture.noisy
    variants = guided_variants(*images, radius=RADIUS)
    if not plain_kornia:
        variants.pop("kornia", None)
    params: Params = {**size, "filter": "guided", "radius": RADIUS, "guide_channels": channels, "eps": EPS}
    judge = _judge(partial(guided_in_float64, radius=RADIUS, eps=EPS), images, halo=2 * RADIUS)
    judges = {name: judge for name in variants}
    yield from _rows("table2", variants, params, sizes, judge=judges, differs=DIFFERS)


def _oidn(picture: Picture, size: Params, sizes: Sizes) -> Iterator[Measurement]:
    """A network: no radius, and no other filter computes the same."""
    if (pyoidn := peer("oidn")) is None:
        return
    call = partial(pyoidn.denoise, picture.noisy, picture.albedo, picture.normal, hdr=True)
    params: Params = {**size, "filter": "oidn", "differs": "RT network, HDR, albedo and normal, quality high"}
    yield from _rows("table2", {"oidn": call}, params, sizes)


#: OpenCV takes a window of 3 guide channels for flat if the determinant of its matrix is below about 1e-6: with guides
#: in [0, 1] and this eps, wherever the guide varies little. Its result is then wrong by up to a third of the picture's
#: range. Scaled, it is right.
OPENCV_SCALE = 255.0

DIFFERS: Mapping[str, Params] = types.MappingProxyType(
    {
        "opencv": {"differs": "border mirrored, guide and root of eps times 255"},
        "kornia": {"differs": "border mirrored"},
        "kornia_separable": {"differs": "border mirrored"},
    }
)


def guided_variants(guide: Image, image: Image, *, radius: int) -> dict[str, Call]:
    """All ways to run the guided filter: name -> call. OpenCV's takes 1 or 3 guide channels."""
    ours = partial(guided_filter, radius=radius, eps=EPS)
    variants: dict[str, Call] = {
        "jaxrender": _jitted(ours, (guide, image)),
        "jaxrender_bands": lambda: np.concatenate(list(guided_filter_in_bands(guide, image, radius=radius, eps=EPS))),
    }
    if (cv2 := peer("opencv")) and guide.shape[-1] in (1, 3):
        scaled = OPENCV_SCALE * guide
        variants["opencv"] = partial(cv2.ximgproc.guidedFilter, scaled, image, radius, OPENCV_SCALE**2 * EPS)
    if kornia := peer("kornia"):
        planes = [_tensor(guide), _tensor(image)]
        for name, separable in (("kornia", False), ("kornia_separable", True)):
            variants[name] = partial(kornia.filters.guided_blur, *planes, 2 * radius + 1, EPS, separable=separable)
    return variants


# --- The other cases of the guided filter


def _radius(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    """All radii of our filter and of OpenCV's take turns; those of kornia's, which needs seconds, by themselves."""
    height, width = sizes.table[0]
    picture = draw_picture(height, width, seed)
    images = np.ascontiguousarray(picture.guide[..., :3]), picture.noisy
    fast, slow = ("jaxrender", "opencv"), ("kornia",)
    for names, radii in ((fast, sizes.radii), (slow, sizes.kornia_radii)):
        calls = {
            f"{name} {radius}": call
            for radius in radii
            for name, call in guided_variants(*images, radius=radius).items()
            if name in names
        }
        timings = measure_alternating(calls, min_runs=sizes.min_runs, min_seconds=sizes.min_seconds) if calls else {}
        for radius in radii:
            judge = _judge(partial(guided_in_float64, radius=radius, eps=EPS), images, halo=2 * radius)
            params: Params = {
                "height": height, "width": width, "seed": seed, "filter": "guided", "radius": radius,
                "guide_channels": 3, "eps": EPS,
            }  # fmt: skip
            for name in names:
                if (timing := timings.get(f"{name} {radius}")) is None:
                    continue
                metrics = timing.metrics() | judge(_as_image(calls[f"{name} {radius}"]()))
                metrics["ratio_to_24"] = timing.ms_median / timings[f"{name} {RADIUS}"].ms_median
                yield Measurement("radius", name, metrics, params | DIFFERS.get(name, {}))


def _gradient(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    """Derivatives with regard to guide, image and eps, of the sum of squares of the result."""
    height, width = sizes.table[0]
    picture = draw_picture(height, width, seed)
    arguments = jnp.asarray(picture.guide[..., :3]), jnp.asarray(picture.noisy), jnp.full(3, EPS, jnp.float32)
    losses = {"jaxrender": _loss(_by_rule), "autodiff": _loss(_by_planes)}
    functions = {"value": losses["jaxrender"]}
    functions |= {name: jax.value_and_grad(loss, argnums=(0, 1, 2)) for name, loss in losses.items()}
    programs = {name: jax.jit(function).lower(*arguments).compile() for name, function in functions.items()}
    calls = {name: partial(program, *arguments) for name, program in programs.items()}
    timings = measure_alternating(calls, min_runs=sizes.min_runs, min_seconds=sizes.min_seconds)
    params: Params = {"height": height, "width": width, "seed": seed, "radius": RADIUS, "guide_channels": 3}
    slopes = {name: calls[name]()[1] for name in losses}
    for name, timing in timings.items():
        metrics = {key: value for key, value in timing.metrics().items() if key != "compile_ms"}
        metrics["ratio_to_value"] = timing.ms_median / timings["value"].ms_median
        memory = programs[name].memory_analysis()
        metrics["temp_bytes"] = float(memory.temp_size_in_bytes) if memory else np.nan
        if name != "value":
            pairs = zip(slopes[name], slopes["autodiff"], strict=True)
            metrics["max_difference"] = max(float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b))) for a, b in pairs)
        yield Measurement("gradient", name, metrics, params)


def _loss(function: Callable) -> Callable:
    return lambda guide, image, eps: jnp.sum(function(guide, image, eps) ** 2)


def _by_rule(guide, image, eps):
    return guided_filter(guide, image, radius=RADIUS, eps=eps)


def _by_planes(guide, image, eps):
    """The same formula, each stage on the whole image, without a rule for its derivative."""
    centers = center_of(guide, image)
    planes = [jnp.moveaxis(x - center[None, None], -1, 0) for x, center in zip((guide, image), centers, strict=True)]
    valid = jnp.ones(guide.shape[:2], bool)
    result = filter_planes(*planes, valid, eps[:, None, None], radius=RADIUS)
    return jnp.moveaxis(result, 0, -1) + centers[1][None, None]


def _fast(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    height, width = sizes.table[0]
    picture = draw_picture(height, width, seed)
    images = np.ascontiguousarray(picture.guide[..., :3]), picture.noisy
    calls = {
        str(step): _jitted(partial(guided_filter, radius=RADIUS, eps=EPS, subsample=step), images)
        for step in sizes.subsamples
    }
    timings = measure_alternating(calls, min_runs=sizes.min_runs, min_seconds=sizes.min_seconds)
    whole = calls["1"]()
    for step in sizes.subsamples:
        timing, result = timings[str(step)], calls[str(step)]()
        metrics = timing.metrics() | {"speedup": timings["1"].ms_median / timing.ms_median}
        metrics |= {"mse": float(mse(result, whole)), "psnr_db": float(psnr(result, whole))}
        params: Params = {
            "height": height, "width": width, "seed": seed, "radius": RADIUS, "guide_channels": 3, "eps": EPS,
            "subsample": step,
        }  # fmt: skip
        yield Measurement("fast", "jaxrender", metrics, params)


# --- Precision


def _precision(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    """Errors of variances, and the most negative one, as shares of the squared range of the image."""
    for height, width in sizes.precision:
        for kind, image in precision_images(height, width, seed).items():
            squared_range = float(np.ptp(image.astype(np.float64)) ** 2)
            for radius in sizes.precision_radii:
                true = variance_in_float64(image, radius=radius)
                for variant, function in VARIANCES.items():
                    if variant == "opencv" and peer("opencv") is None:
                        continue
                    found = np.asarray(function(image, radius=radius), np.float64)
                    metrics = {
                        "max_error_of_variance": float(np.max(np.abs(found - true))) / squared_range,
                        "most_negative": min(0.0, float(np.min(found))) / squared_range,
                    }
                    params: Params = {"height": height, "width": width, "radius": radius, "image": kind, "seed": seed}
                    yield Measurement("precision", variant, metrics, params)


def precision_images(height: int, width: int, seed: int) -> dict[str, Float[np.ndarray, "h w"]]:
    """Images of one channel that are hard on sums of float32."""
    rng = np.random.default_rng(seed)
    uniform = rng.random((height, width), dtype=np.float32)
    spikes = np.where(rng.random((height, width), dtype=np.float32) < 1e-4, np.float32(1e4), np.float32(1.0)) * uniform
    return {"uniform": uniform, "hdr_spikes": spikes, "near_constant": 100 + 0.01 * uniform}


def variance_in_float64(image: Float[np.ndarray, "h w"], *, radius: int) -> Float[np.ndarray, "h w"]:
    """The truth, from sums of the image less its mean."""
    centered = image.astype(np.float64) - np.mean(image, dtype=np.float64)
    return _variance(centered[..., None], partial(_box_sums, radius=radius))[..., 0]


def _by_table(image, *, radius: int):
    """The textbook's: one table of the image, one of its squares."""
    sums = jax.jit(lambda x: box_sum_from_table(summed_area_table(x), radius=radius))
    return _variance(jnp.asarray(image)[..., None], sums)[..., 0]


def _by_prefix_sums(image, *, radius: int):
    """Differences of running sums along the columns, then of those along the rows."""
    return _variance(image[..., None], partial(_box_sums, radius=radius))[..., 0]


def _by_box_variance(image, *, radius: int):
    return jax.jit(partial(box_variance, radius=radius))(jnp.asarray(image)[..., None])[..., 0]


def _by_opencv(image, *, radius: int):
    """Sums of its box filter, which keeps them in float64 and returns float32."""
    cv2 = peer("opencv")
    assert cv2 is not None
    sides = [2 * min(radius, size - 1) + 1 for size in image.shape[::-1]]
    sums = partial(cv2.boxFilter, ddepth=cv2.CV_32F, ksize=sides, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return _variance(image[..., None], lambda x: sums(x[..., 0])[..., None])[..., 0]


VARIANCES: Mapping[str, Callable] = types.MappingProxyType(
    {
        "summed_area_table": _by_table,
        "prefix_sums": _by_prefix_sums,
        "box_variance": _by_box_variance,
        "opencv": _by_opencv,
    }
)


def _variance(image, sums: Callable):
    """E[x²] - E[x]² over windows, in the precision of the image; nothing is cut off at 0."""
    count = sums(np.ones_like(image))
    mean = sums(image) / count
    return sums(image * image) / count - mean * mean


# --- Truth


def in_float64(function: Callable) -> Callable[..., Image]:
    """One of our filters, without compiling its float32 program, in float64."""

    def compute(*images: Image) -> Image:
        with jax.enable_x64(True):
            return np.asarray(jax.jit(function)(*(jnp.asarray(image) for image in images)))

    return compute


def guided_in_float64(guide: Image, image: Image, *, radius: int, eps: float) -> Image:
    """The guided filter from running sums in float64, with NumPy's solver."""
    u = np.concatenate([np.ones_like(guide[..., :1]), guide], axis=-1)
    both = np.concatenate([u, image], axis=-1)
    size, n = guide.shape[:2], u.shape[-1]
    sums = _box_sums((u[..., None] * both[..., None, :]).reshape(*size, -1), radius=radius).reshape(*size, n, -1)
    ridge = np.diag(np.where(np.arange(n) > 0, eps, 0.0))
    x = np.linalg.solve(sums[..., :n] + sums[..., :1, :1] * ridge, sums[..., n:])
    x = _box_sums(x.reshape(*size, -1), radius=radius).reshape(x.shape)
    windows = _box_sums(np.ones((*size, 1)), radius=radius)
    return np.einsum("hwn,hwnc->hwc", u, x) / windows


def _box_sums(image, *, radius: int):
    """Sums over windows cropped at the border, by running sums along either axis, in the image's precision."""
    for axis in (0, 1):
        size = image.shape[axis]
        at = np.arange(size)
        zero = np.zeros_like(image.take([0], axis))
        sums = np.concatenate([zero, np.cumsum(image, axis=axis, dtype=image.dtype)], axis=axis)
        image = sums.take(np.minimum(at + radius + 1, size), axis) - sums.take(np.maximum(at - radius, 0), axis)
    return image


def _judge(reference: Callable[..., Image], images: tuple[Image, ...], *, halo: int) -> Callable[[Image], dict]:
    """What tells the errors of a result on the upper left corner; a pixel depends on nothing beyond `halo` from it."""
    height, width = images[0].shape[:2]
    corner = tuple(slice(min(CHECKED + halo, size)) for size in (height, width))
    true = reference(*(image[corner].astype(np.float64) for image in images))

    def judge(result: Image) -> dict[str, float]:
        known = tuple(slice(min(CHECKED, size)) for size in (height, width))
        error = np.abs(result.astype(np.float64)[known] - true[known])
        inside = error[halo : height - halo, halo : width - halo]
        found = {"max_error": float(error.max())}
        return found | ({"max_error_inside": float(inside.max())} if inside.size else {})

    return judge


# --- Rows


def _rows(
    case: str,
    variants: Mapping[str, Call],
    params: Params,
    sizes: Sizes,
    *,
    judge: Mapping[str, Callable[[Image], dict]] | None = None,
    differs: Mapping[str, Params] | None = None,
) -> Iterator[Measurement]:
    """A row for each variant: times, errors where it has a judge, memory; `differs` overrides its parameters."""
    timings = measure_alternating(variants, min_runs=sizes.min_runs, min_seconds=sizes.min_seconds)
    for name, timing in timings.items():
        with peak_memory() as peak:
            result = jax.block_until_ready(variants[name]())
        metrics = timing.metrics() | {"peak_bytes": float(peak.peak_bytes)}
        if judge and name in judge:
            metrics |= judge[name](_as_image(result))
        yield Measurement(case, name, metrics, params | (differs or {}).get(name, {}))


def _jitted(function: Callable, images: tuple[Image, ...]) -> Call:
    return partial(jax.jit(function), *(jnp.asarray(image) for image in images))


def _tensor(image: Image) -> Any:
    """As kornia wants it: (1, c, h, w)."""
    return importlib.import_module("torch").from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 0)[None]))


def _as_image(result: Any) -> Image:
    """A variant's result as (h, w, c)."""
    result = np.asarray(result)
    return np.moveaxis(result[0], 0, -1) if result.ndim == 4 else result


CASES: Mapping[str, Callable[[Sizes, int], Iterator[Measurement]]] = types.MappingProxyType(
    {"table2": _table2, "radius": _radius, "precision": _precision, "gradient": _gradient, "fast": _fast}
)
