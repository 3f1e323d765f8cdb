"""The path tracer: the paper's render times, rays beside Mitsuba, filters of its own indirect light, soft shadows.

On one thread per block of pixels, as the command runs. Scenes are those of `path_scenes`, matt. Cases:

- `table1`: bounces and samples of table 1 of Bauszat et al. 2011 at 1024 x 768: `traced` are the guide rays with their
  light, `whole` is the picture with filter and all eye rays. `rays_per_second` counts rays that were traced.
- `mitsuba`: direct light and two bounces for one sample a pixel, traced by both libraries in turns; one light of each
  kind for ours, one light of all for Mitsuba. `time_ratio` is Mitsuba's time over ours.
- `rays`: 131,072 rays through Sponza, one thread: Embree, and the tree in pure JAX.
- `quality`: indirect light of 1, 4 and 16 paths at 512 x 384, filtered in four ways, MSE on 0..255 display-encoded with
  converged direct light added, against 1024 paths of another seed. `bilateral` and `atrous` have the best of some
  radii for each cell, found with the reference; `guided` goes by its rule.
- `final`: the whole picture with direct light plain and by ratio, against 1024 samples: direct, indirect and total.
"""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from benchmarks.path_scenes import DATA, STAGES, Stage
from benchmarks.suites import Measurement, Options
from benchmarks.timing import measure_alternating
from jaxrender import console
from jaxrender.camera import camera_rays
from jaxrender.pathtrace import Bvh, EmbreeScene, TraceSettings, World, build_bvh, prepare, render, trace_rays
from jaxrender.pathtrace.guide_rays import trace_guides
from jaxrender.pathtrace.ray_scene import RayScene
from jaxrender.pathtrace.render import Rendered, filter_incident
from jaxrender.srgb import encode_srgb

FOLDER = Path("out") / "pathtrace"
RADII = {"bilateral": (4, 8, 16, 24), "atrous": (4, 8, 16, 32)}

Image = Float[np.ndarray, "h w 3"]
Params = dict[str, str | int | float | bool]


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: tuple[str, ...] = ("cornell", "statue", "atrium", "sponza")
    table: tuple[int, int] = (768, 1024)
    table_rows: tuple[tuple[int, int], ...] = ((1, 1), (1, 4), (2, 4))
    quality: tuple[int, int] = (384, 512)
    reference_spp: int = 1024
    spp: tuple[int, ...] = (1, 4, 16)
    num_rays: int = 1 << 17
    min_runs: int = 3


FULL = Sizes()
QUICK = Sizes(
    scenes=("cornell",), table=(48, 64), table_rows=((1, 1),), quality=(48, 64), reference_spp=16, spp=(1,),
    num_rays=1 << 12, min_runs=1,
)  # fmt: skip


def run(options: Options) -> Iterator[Measurement]:
    """The asked cases."""
    if not DATA.is_dir():
        console.announce("pathtrace: the scenes are in ../shared/data, which is not here; nothing is measured")
        return
    sizes = QUICK if options.quick else FULL
    for name, case in CASES.items():
        if options.wants(name):
            yield from case(sizes, options)


@functools.lru_cache(maxsize=1)
def _open(name: str) -> tuple[Stage, World]:
    stage = STAGES[name]()
    return stage, prepare(stage.scene, environment=stage.environment)


class _Counted(RayScene):
    """Rays of a world that count how many were asked for."""

    def __init__(self, rays: RayScene):
        self._rays, self.count = rays, 0

    def closest(self, origins, directions):
        self.count += len(origins)
        return self._rays.closest(origins, directions)

    def blocked(self, origins, directions, distance):
        self.count += len(origins)
        return self._rays.blocked(origins, directions, distance)


def _table1(sizes: Sizes, options: Options) -> Iterator[Measurement]:
    height, width = sizes.table
    for name in sizes.scenes:
        stage, world = _open(name)
        for bounces, spp in sizes.table_rows:
            settings = TraceSettings(bounces=bounces, samples_per_pixel=spp, model="lambert", seed=options.seed)

            def traced(world: World = world, camera=stage.camera, settings=settings) -> None:
                trace_guides(world, camera, height=height, width=width, settings=settings)

            def whole(world: World = world, camera=stage.camera, settings=settings) -> None:
                render(world, camera, height=height, width=width, settings=settings)

            calls = {"traced": traced, "whole": whole}
            params: Params = {
                "scene": name, "triangles": len(stage.scene.faces), "bounces": bounces, "spp": spp, "height": height,
                "width": width,
            }  # fmt: skip
            for key, timing in measure_alternating(calls, min_runs=sizes.min_runs, min_seconds=0.0).items():
                counted = _Counted(world.rays)
                calls[key](dataclasses.replace(world, rays=counted))
                metrics = {
                    "ms_median": timing.ms_median, "ms_q1": timing.ms_q1, "ms_q3": timing.ms_q3,
                    "compile_ms": timing.compile_ms, "rays": counted.count,
                    "rays_per_second": counted.count / (1e-3 * timing.ms_median),
                }  # fmt: skip
                yield Measurement("table1", key, metrics, params)


def _mitsuba(sizes: Sizes, options: Options) -> Iterator[Measurement]:
    try:
        from benchmarks import mitsuba_scenes as theirs

        theirs.prepare()
    except (ImportError, OSError, RuntimeError) as error:
        console.announce(f"pathtrace: Mitsuba is not to be had ({error}); its rows are left out")
        return
    except Exception as error:
        if type(error).__name__ != "NoMitsuba":
            raise
        console.announce(f"pathtrace: {error}")
        return
    height, width = sizes.table
    for name in sizes.scenes:
        stage, world = _open(name)
        view = theirs.build(name)
        settings = TraceSettings(
            bounces=2, model="lambert", ao_rays=0, direct="plain", method="none", seed=options.seed
        )

        def ours(world=world, camera=stage.camera, settings=settings):
            trace_guides(world, camera, height=height, width=width, settings=settings)

        def mitsuba(view=view):
            first = theirs.first_hits(view, height=height, width=width)
            theirs.light_sums(view, first, num_samples=1, seed=options.seed, radii=(1.0, 1.0, 1.0))

        times = measure_alternating({"jaxrender": ours, "mitsuba": mitsuba}, min_runs=max(sizes.min_runs, 3),
                                    min_seconds=0.0)  # fmt: skip
        params: Params = {"scene": name, "bounces": 2, "spp": 1, "height": height, "width": width}
        for key, timing in times.items():
            ratio = times["mitsuba"].ms_median / timing.ms_median
            yield Measurement("mitsuba", key, {"ms_median": timing.ms_median, "ms_q1": timing.ms_q1,
                                               "ms_q3": timing.ms_q3, "time_ratio": ratio}, params)  # fmt: skip


def _rays(sizes: Sizes, options: Options) -> Iterator[Measurement]:
    """Primary rays, cosine-free random ones from where those end, and the same as shadow rays."""
    stage, _ = _open("sponza" if "sponza" in sizes.scenes else sizes.scenes[0])
    side = int(sizes.num_rays**0.5)
    origins, directions = (
        np.ascontiguousarray(np.asarray(x).reshape(-1, 3)) for x in camera_rays(stage.camera, height=side, width=side)
    )
    vertices, faces = np.asarray(stage.scene.positions), np.asarray(stage.scene.faces)
    embree = EmbreeScene(vertices, faces)
    backends: dict[str, EmbreeScene | Bvh] = {"embree": embree, "jax": build_bvh(vertices, faces)}
    hits = embree.closest_hit(origins, directions)
    reach = np.where(hits.triangle >= 0, 0.999 * hits.t, 1.0).astype(np.float32)
    rng = np.random.default_rng(options.seed)
    loose = rng.normal(size=directions.shape).astype(np.float32)
    loose /= np.linalg.norm(loose, axis=1, keepdims=True)
    bounced = origins + reach[:, None] * directions
    kinds: tuple[tuple[str, tuple[np.ndarray, np.ndarray], Literal["closest", "any"]], ...] = (
        ("primary", (origins, directions), "closest"),
        ("bounce", (bounced, loose), "closest"),
        ("shadow", (bounced, loose), "any"),
    )
    for kind, rays, query in kinds:
        calls = {name: functools.partial(_ask, backend, rays, query) for name, backend in backends.items()}
        for name, timing in measure_alternating(calls, min_runs=sizes.min_runs, min_seconds=0.0).items():
            metrics = {"ms_median": timing.ms_median, "compile_ms": timing.compile_ms,
                       "rays_per_second": len(origins) / (1e-3 * timing.ms_median)}  # fmt: skip
            yield Measurement("rays", name, metrics, {"kind": kind, "rays": len(origins), "triangles": len(faces)})


def _ask(backend: EmbreeScene | Bvh, rays: tuple[np.ndarray, np.ndarray], query: Literal["closest", "any"]) -> None:
    jax.block_until_ready(trace_rays(backend, *rays, query=query))


def _reference(name: str, sizes: Sizes) -> Rendered:
    """`reference_spp` samples of the whole picture, kept in `FOLDER`."""
    stage, world = _open(name)
    height, width = sizes.quality
    file = FOLDER / f"{name}_{width}x{height}_{sizes.reference_spp}.npz"
    names = ("image", "direct", "indirect", "emission", "incident")
    if not file.is_file():
        console.announce(f"pathtrace: {name}, reference of {sizes.reference_spp} samples")
        settings = TraceSettings(samples_per_pixel=sizes.reference_spp, method="none", model="lambert", seed=977)
        found = render(world, stage.camera, height=height, width=width, settings=settings)
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, **{name: getattr(found, name) for name in names})
    with np.load(file) as stored:
        return Rendered(**{name: stored[name] for name in names}, guides=None)  # type: ignore[arg-type]


def _mse(image: Image, reference: Image) -> float:
    """On 0..255, clamped and display-encoded."""
    a, b = (255.0 * np.asarray(encode_srgb(jnp.clip(jnp.asarray(x), 0.0, 1.0))) for x in (image, reference))
    return float(np.mean((a - b) ** 2))


def _quality(sizes: Sizes, options: Options) -> Iterator[Measurement]:
    height, width = sizes.quality
    for name in sizes.scenes:
        stage, world = _open(name)
        truth = _reference(name, sizes)
        for spp in sizes.spp:
            settings = TraceSettings(samples_per_pixel=spp, model="lambert", seed=options.seed)
            guides = trace_guides(world, stage.camera, height=height, width=width, settings=settings)

            def judged(incident, guides=guides, truth=truth):
                over = guides.albedo
                rest = truth.direct + truth.emission
                return _mse(incident * over + rest, truth.incident * over + rest)

            params: Params = {
                "scene": name,
                "spp": spp,
                "height": height,
                "width": width,
                "reference_spp": sizes.reference_spp,
            }
            yield Measurement("quality", "unfiltered", {"mse_255": judged(guides.incident)}, params)
            incident, chosen = filter_incident(guides, settings)
            yield Measurement(
                "quality", "guided", {"mse_255": judged(incident)}, {**params, "radius": chosen["radius"]}
            )
            for method, radii in RADII.items():
                tried = {
                    radius: judged(
                        filter_incident(guides, dataclasses.replace(settings, method=method, radius=radius))[0]
                    )
                    for radius in radii
                }
                best = min(tried, key=tried.__getitem__)
                yield Measurement("quality", method, {"mse_255": tried[best]}, {**params, "radius": best})


def _final(sizes: Sizes, options: Options) -> Iterator[Measurement]:
    height, width = sizes.quality
    for name in sizes.scenes:
        stage, world = _open(name)
        truth = _reference(name, sizes)
        for spp in sizes.spp:
            for direct in ("plain", "ratio"):
                settings = TraceSettings(samples_per_pixel=spp, model="lambert", seed=options.seed, direct=direct)
                found = render(world, stage.camera, height=height, width=width, settings=settings)
                metrics = {f"mse_255_{part}": _mse(getattr(found, part), getattr(truth, part))
                           for part in ("direct", "indirect")}  # fmt: skip
                params: Params = {"scene": name, "spp": spp, "height": height, "width": width}
                yield Measurement("final", direct, {**metrics, "mse_255": _mse(found.image, truth.image)}, params)


CASES = {"table1": _table1, "mitsuba": _mitsuba, "rays": _rays, "quality": _quality, "final": _final}
