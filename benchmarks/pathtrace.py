"""The path tracer: the paper's render times, rays beside Mitsuba, filters of its own indirect light, soft shadows.

As the command runs: Embree and one thread per block of pixels, or the tree in JAX where JAX has a GPU. Scenes are those
of `path_scenes`, matt. Cases:

- `table1`: bounces and samples of table 1 of Bauszat et al. 2011 at 1024 x 768: `traced` are the guide rays with their
  light, `whole` is the picture with filter and all eye rays. `rays_per_second` counts rays that were traced.
- `backends`: the guide rays of the first row of that table by Embree and by the tree in JAX, in turns; at 256 x 192 on
  a CPU. `differing_share` is that of pixels whose light is another.
- `mitsuba`: direct light and two bounces for one sample a pixel, traced by both libraries in turns; one light of each
  kind for ours, one light of all for Mitsuba. `time_ratio` is Mitsuba's time over ours.
- `rays`: 131,072 rays through Sponza on one thread of a CPU, 1,048,576 on a GPU: Embree, and the tree in pure JAX.
- `quality`, `final`, `figures`: see `path_quality`.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.path_quality import figures, final, quality
from benchmarks.path_renders import open_stage
from benchmarks.path_scenes import DATA
from benchmarks.suites import Measurement, Options
from benchmarks.timing import measure_alternating
from jaxrender import console
from jaxrender.camera import camera_rays
from jaxrender.pathtrace import Bvh, EmbreeScene, TraceSettings, World, build_bvh, prepare, render, trace_rays
from jaxrender.pathtrace.backends import chosen_backend
from jaxrender.pathtrace.guide_rays import trace_guides
from jaxrender.pathtrace.ray_scene import RayScene

BACKENDS: tuple[Literal["embree", "jax"], ...] = ("embree", "jax")

Params = dict[str, str | int | float | bool]


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: tuple[str, ...] = ("cornell", "statue", "atrium", "sponza")
    table: tuple[int, int] = (768, 1024)
    table_rows: tuple[tuple[int, int], ...] = ((1, 1), (1, 4), (2, 4))
    table_of_tree: tuple[int, int] = (192, 256)
    num_rays: int = 1 << 17
    num_rays_gpu: int = 1 << 20
    min_runs: int = 3


FULL = Sizes()
QUICK = Sizes(
    scenes=("cornell",), table=(48, 64), table_rows=((1, 1),), table_of_tree=(48, 64), num_rays=1 << 12,
    num_rays_gpu=1 << 12, min_runs=1,
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
    for name, judge in QUALITY.items():
        if options.wants(name):
            yield from judge(options)


class _Counted(RayScene):
    """Rays of a world that count how many were traced."""

    def __init__(self, rays: RayScene):
        self._rays, self.count = rays, 0

    def closest(self, rays, wanted, *, reach=math.inf):
        self.count += int(np.sum(np.asarray(wanted)))
        return self._rays.closest(rays, wanted, reach=reach)

    def blocked(self, shadow):
        self.count += int(np.any(np.asarray(shadow.light), axis=0).sum())
        return self._rays.blocked(shadow)

    def moved(self, scene, table):
        return _Counted(self._rays.moved(scene, table))


def _table1(sizes: Sizes, options: Options) -> Iterator[Measurement]:
    height, width = sizes.table
    for name in sizes.scenes:
        stage, world = open_stage(name)
        for bounces, spp in sizes.table_rows:
            settings = TraceSettings(bounces=bounces, samples_per_pixel=spp, model="lambert", seed=options.seed)

            def traced(world: World = world, camera=stage.camera, settings=settings) -> None:
                trace_guides(world, camera, height=height, width=width, settings=settings)

            def whole(world: World = world, camera=stage.camera, settings=settings) -> None:
                render(world, camera, height=height, width=width, settings=settings)

            calls = {"traced": traced, "whole": whole}
            params: Params = {
                "scene": name, "triangles": len(stage.scene.faces), "bounces": bounces, "spp": spp, "height": height,
                "width": width, "rays": chosen_backend("auto"),
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


def _backends(sizes: Sizes, options: Options) -> Iterator[Measurement]:
    height, width = sizes.table_of_tree if jax.default_backend() == "cpu" else sizes.table
    bounces, spp = sizes.table_rows[0]
    settings = TraceSettings(bounces=bounces, samples_per_pixel=spp, model="lambert", seed=options.seed)
    for name in sizes.scenes:
        stage, _ = open_stage(name)
        worlds = {rays: prepare(stage.scene, environment=stage.environment, rays=rays) for rays in BACKENDS}
        trace = functools.partial(trace_guides, camera=stage.camera, height=height, width=width, settings=settings)
        calls: dict[str, Callable[[], None]] = {
            rays: functools.partial(_discard, trace, world) for rays, world in worlds.items()
        }
        times = measure_alternating(calls, min_runs=sizes.min_runs, min_seconds=0.0)
        counted = _Counted(worlds["embree"].rays)
        truth = trace(dataclasses.replace(worlds["embree"], rays=counted)).color
        params: Params = {"scene": name, "bounces": bounces, "spp": spp, "height": height, "width": width}
        for rays, world in worlds.items():
            timing = times[rays]
            differ = np.abs(trace(world).color - truth) > 1e-4 + 1e-3 * truth
            metrics = {**timing.metrics(), "rays_per_second": counted.count / (1e-3 * timing.ms_median),
                       "differing_share": float(differ.any(axis=-1).mean())}  # fmt: skip
            yield Measurement("backends", rays, metrics, params)


def _discard(trace: Callable[[World], object], world: World) -> None:
    """Images are NumPy arrays: there is nothing left to wait for."""
    trace(world)


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
        stage, world = open_stage(name)
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
    stage, _ = open_stage("sponza" if "sponza" in sizes.scenes else sizes.scenes[0])
    side = int((sizes.num_rays if jax.default_backend() == "cpu" else sizes.num_rays_gpu) ** 0.5)
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
        # Rays of the tree lie on its device, as those of the renderer do.
        own = {"embree": rays, "jax": tuple(jnp.asarray(x) for x in rays)}
        calls = {name: functools.partial(_ask, backend, own[name], query) for name, backend in backends.items()}
        for name, timing in measure_alternating(calls, min_runs=sizes.min_runs, min_seconds=0.0).items():
            metrics = {"ms_median": timing.ms_median, "compile_ms": timing.compile_ms,
                       "rays_per_second": len(origins) / (1e-3 * timing.ms_median)}  # fmt: skip
            yield Measurement("rays", name, metrics, {"kind": kind, "rays": len(origins), "triangles": len(faces)})


def _ask(backend: EmbreeScene | Bvh, rays: tuple, query: Literal["closest", "any"]) -> None:
    jax.block_until_ready(trace_rays(backend, *rays, query=query))


CASES = {"table1": _table1, "backends": _backends, "mitsuba": _mitsuba, "rays": _rays}
QUALITY = {"quality": quality, "final": final, "figures": figures}
