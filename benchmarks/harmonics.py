"""Shadowed relighting of a character: baking, lobe fit, linear solve, training, run-time steps, and SH kernels.

All on the built-in character. Inputs that do not come from it are drawn from the seed. Cases:

- `bake`: `fitting.dataset.bake` beside bare Embree calls on the same rays. `overhead_share` is against building
  Embree's scene and casting, `overhead_share_casting` against casting alone.
- `bake_memory`: peak memory of a bake of few and of many frames, each in a process of its own.
- `lobe_fit`: anchored fits of 1 to 3 lobes.
- `linear_solve`: one factorisation for the right-hand sides of a whole character.
- `training`: `train_character` from start to end, compilation included, each time in a process of its own.
- `runtime`: a pose to vertex colors, step by step and together.
- `sh`: basis, rotation and Phong operator.
- `twin`: `torchref`'s relighting beside ours.

Importing `fitting` lets XLA's CPU programs run on one thread each (`jaxrender.machine`). The run time is measured
so, on one thread and on one thread per core with a share of the points each, and once more with XLA's own pool in
another process, which is stopped if it locks up. `xla_threads` says which: `one` or `pool`, or the device's name.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import itertools
import multiprocessing
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.suites import Measurement, Options
from benchmarks.timing import Timing, measure, measure_alternating, peak_memory
from fitting.config import BakeSettings, FitSettings, SplitSettings, TrainSettings
from fitting.dataset import PosedMesh, VisibilityStore, bake, character_frames, choose_points
from fitting.features import all_raw_features, feature_groups, fit_basis, unfitted_basis
from fitting.fit import predict_sh
from fitting.model import to_half
from fitting.motion import SEGMENT, TRAIN, sample_motion
from fitting.solve import block_sh
from fitting.train import train_character
from jaxrender import console, harmonics
from jaxrender.animation.mannequin import builtin_character
from jaxrender.animation.skeleton import global_matrices
from jaxrender.animation.skinning import Character, skin_mesh
from jaxrender.harmonics.pose_model import PoseModel, model_arrays
from jaxrender.harmonics.visibility import RELATIVE_OFFSET
from jaxrender.machine import num_cores
from jaxrender.pathtrace.embree import RAYS_PER_TASK, EmbreeScene, pool
from jaxrender.vecmath import normalize, reflection_frame

ORDER = 4
NUM_LOBES = 2
#: What `Measurement.params` may hold.
Params = dict[str, str | int | float | bool]
POOL_SWITCH = "--xla_cpu_multi_thread_eigen="
#: Steps 1 to 5 that are under way at once in the row that measures throughput rather than latency.
IN_FLIGHT = 16


@dataclass(frozen=True)
class Sizes:
    """How much is measured; the defaults are the sizes of the goals."""

    vertices: int = 10_000
    directions: int = 256
    bake_frames: int = 3
    bake_runs: int = 7
    memory_frames: tuple[int, int] = (20, 100)
    lobe_vertices: int = 64
    lobe_frames: int = 16
    solve_frames: int = 240
    solve_features: int = 126
    solve_columns: tuple[int, ...] = (12, 16)
    train_frames: int = 300
    num_mixed: int = 300
    refine_steps: int = 30
    num_components: int = 48
    sh_vectors: int = 10_000
    sh_orders: tuple[int, ...] = (4, 10)
    twin_points: int = 1000
    min_runs: int = 7
    min_seconds: float = 1.0
    pool_seconds: float = 300.0


FULL = Sizes()
QUICK = Sizes(
    vertices=2000,
    directions=64,
    bake_frames=2,
    bake_runs=2,
    memory_frames=(4, 16),
    lobe_vertices=16,
    lobe_frames=4,
    train_frames=40,
    num_mixed=40,
    refine_steps=6,
    num_components=12,
    sh_vectors=1000,
    twin_points=200,
    min_runs=3,
    min_seconds=0.05,
    pool_seconds=120.0,
)


def run(options: Options) -> Iterator[Measurement]:
    """The cases in the order of a user's work; see the suite's description."""
    sizes = QUICK if options.quick else FULL
    for name, case in CASES.items():
        if options.wants(name):
            yield from case(sizes, options.seed)


# --- Baking


def _bake(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    body = _body(sizes.vertices)
    points, faces = choose_points(body, 0).vertices, np.asarray(body.faces)
    settings = BakeSettings(num_directions=sizes.directions, num_mixed=0, seed=seed)
    frame = _spread_frames(body, settings, sizes.bake_frames)
    directions = harmonics.hemisphere_directions(sizes.directions)
    frames = range(sizes.bake_frames)
    rays = [_rays(*frame(i), points, directions) for i in frames]
    scenes = [EmbreeScene(centred, faces) for centred, _, _ in rays]
    bits = [harmonics.trace_visibility(*frame(i), faces, directions, points=points) for i in frames]
    cast = np.packbits(_cast(scenes[0], *rays[0][1:]).reshape(len(points), -1), axis=1)
    mismatched = int(np.bitwise_count(cast ^ bits[0]).sum())

    with tempfile.TemporaryDirectory() as folder:
        # A store is made for each repetition beforehand: that is done once a bake, not once a frame.
        make = functools.partial(
            VisibilityStore, num_frames=len(frames), num_points=len(points), bake=settings, source=""
        )
        stores = iter([make(Path(folder, str(i))) for i in range(sizes.bake_runs + 1)])
        scratch = make(Path(folder, "scratch"))
        timings = measure_alternating(
            {
                "jaxrender": lambda: bake(next(stores), frame, faces, points, settings),
                "embree": lambda: [_cast(EmbreeScene(r[0], faces), *r[1:]) for r in rays],
                "embree, casting only": lambda: [_cast(scene, *r[1:]) for scene, r in zip(scenes, rays, strict=True)],
                "stage: skinning": lambda: [frame(i) for i in frames],
                "stage: store": lambda: list(map(scratch.write, frames, bits)),
            },
            min_runs=sizes.bake_runs,
            max_runs=sizes.bake_runs,
        )
    num_rays = len(frames) * len(points) * sizes.directions
    params = {"num_points": len(points), "num_frames": len(frames), "num_directions": sizes.directions}
    ours = timings["jaxrender"].ms_median
    for variant, timing in timings.items():
        metrics = timing.metrics()
        if not variant.startswith("stage"):
            metrics["rays_per_second"] = num_rays / (1e-3 * timing.ms_median)
        if variant == "jaxrender":
            metrics["overhead_share"] = ours / timings["embree"].ms_median - 1.0
            metrics["overhead_share_casting"] = ours / timings["embree, casting only"].ms_median - 1.0
            metrics["mismatched_rays"] = mismatched
        yield Measurement("bake", variant, metrics, params)


def _rays(positions, frames, points, directions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, origins and directions of the rays that `trace_visibility` casts, ready for Embree."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    centred = (positions - 0.5 * (low + high)).astype(np.float32)
    offset = np.float32(RELATIVE_OFFSET * np.linalg.norm(high - low))
    origins = centred[points] + offset * frames[points, :, 2]
    local = np.ascontiguousarray(directions, np.float32)
    rays = np.matmul(local, np.ascontiguousarray(frames[points]).transpose(0, 2, 1))
    return centred, np.repeat(origins, len(local), axis=0), rays.reshape(-1, 3)


def _cast(scene: EmbreeScene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Embree's bare any-hit query on all cores; True where a ray is free."""
    spans = [slice(start, start + RAYS_PER_TASK) for start in range(0, len(origins), RAYS_PER_TASK)]
    found = pool().map(lambda span: scene.run(origins[span], directions[span], "OCCLUDED"), spans)
    return np.concatenate(list(found)) < 0


def _bake_memory(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    for num_frames in sizes.memory_frames:
        peak, num_points = _in_fresh_process(_bake_peak, sizes, num_frames, seed)
        params: Params = {"num_points": num_points, "num_frames": num_frames, "num_directions": sizes.directions}
        metrics = {"peak_bytes": peak, "rays": num_frames * num_points * sizes.directions}
        yield Measurement("bake_memory", "jaxrender", metrics, params)


def _bake_peak(sizes: Sizes, num_frames: int, seed: int) -> tuple[int, int]:
    """Peak memory of a bake into a store on disk, and its number of points."""
    body = _body(sizes.vertices)
    points = choose_points(body, 0).vertices
    settings = BakeSettings(num_directions=sizes.directions, num_mixed=0, seed=seed)
    frame = _spread_frames(body, settings, num_frames)
    frame(0)  # compiles: its memory is not the bake's
    with tempfile.TemporaryDirectory() as folder:
        store = VisibilityStore(
            Path(folder, "bake"), num_frames=num_frames, num_points=len(points), bake=settings, source=""
        )
        with peak_memory() as peak:
            bake(store, frame, np.asarray(body.faces), points, settings)
    return peak.peak_bytes, len(points)


# --- Fitting


def _lobe_fit(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    body = _body(sizes.vertices)
    frame = _spread_frames(body, BakeSettings(num_mixed=0, seed=seed), sizes.lobe_frames)
    directions = harmonics.hemisphere_directions(sizes.directions)
    table = harmonics.projection_table(directions, order=ORDER)
    rng = np.random.default_rng(seed)
    points = np.sort(rng.choice(len(body.skin.vertices), sizes.lobe_vertices, replace=False))
    faces = np.asarray(body.faces)
    bits = [harmonics.trace_visibility(*frame(i), faces, directions, points=points) for i in range(sizes.lobe_frames)]
    sh = jnp.swapaxes(jnp.asarray(block_sh(np.stack(bits), table)), 0, 1)
    fits: dict[str, Callable[[], Any]] = {}
    for c in (1, 2, 3):
        shared = jax.jit(functools.partial(harmonics.fit_shared_axes, num_lobes=c, order=ORDER))
        anchored = jax.jit(functools.partial(harmonics.fit_zh_lobes, num_lobes=c, order=ORDER))
        # Waited for: with the next program compiled meanwhile, the process was seen to die (jaxlib 0.10.2).
        axes = jax.block_until_ready(shared(sh))
        fits[str(c)] = functools.partial(anchored, sh, anchor_axes=axes[:, None])
    timings = _alternate(fits, sizes)
    num = sh.shape[0] * sh.shape[1]
    for name, timing in timings.items():
        lost = float(jnp.sum(fits[name]().residual) / jnp.sum(sh * sh))
        metrics = {**timing.metrics(), "us_per_vertex_frame": 1e3 * timing.ms_median / num}
        params: Params = {"num_lobes": int(name), "num_vertices": sh.shape[0], "num_frames": sh.shape[1]}
        yield Measurement("lobe_fit", "jaxrender", metrics | {"relative_l2": lost**0.5}, params | _xla_params())


def _linear_solve(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    rng = np.random.default_rng(seed)
    frames, columns = sizes.solve_frames, sizes.solve_features
    # Joint angles: singular values over four decades.
    left, _, right = np.linalg.svd(rng.normal(size=(frames, columns)), full_matrices=False)
    features = (left * np.logspace(0, -4, left.shape[1])) @ right
    solve = jax.jit(functools.partial(harmonics.fit_linear, ridge=1e-4))
    for per_vertex in sizes.solve_columns:
        targets = rng.standard_normal((frames, sizes.vertices * per_vertex), np.float32)
        timing = measure(
            solve,
            jnp.asarray(features, jnp.float32),
            jnp.asarray(targets),
            min_runs=sizes.min_runs,
            min_seconds=sizes.min_seconds,
        )
        fit = solve(jnp.asarray(features, jnp.float32), jnp.asarray(targets))
        exact = _ridge_in_float64(features, targets[:, :256], 1e-4)
        metrics = {
            **timing.metrics(),
            "relative_l2": _relative_l2(fit.weights[:, :256], exact),
            "rank": float(fit.rank),
            "residual": float(fit.residual),
        }
        params: Params = {"num_frames": frames, "num_features": columns, "num_columns": targets.shape[1]}
        yield Measurement("linear_solve", "jaxrender", metrics, params | _xla_params())


def _ridge_in_float64(features: np.ndarray, targets: np.ndarray, ridge: float) -> np.ndarray:
    """`fit_linear`'s weights by SVD."""
    scale = features.std(axis=0)
    a = (features - features.mean(axis=0)) / scale
    u, s, vt = np.linalg.svd(a, full_matrices=False)
    lam = ridge * np.sum(a * a) / a.shape[1]
    scaled = (vt.T * (s / (s * s + lam))) @ (u.T @ (targets.astype(np.float64) - targets.mean(axis=0)))
    return scaled / scale[:, None]


def _training(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    for num_mixed in (0, sizes.num_mixed):
        for refine_steps in (0, sizes.refine_steps):
            metrics, params = _in_fresh_process(_train, sizes, refine_steps, num_mixed, seed)
            variant = ("refined" if refine_steps else "linear") + (", mixed poses" if num_mixed else "")
            yield Measurement("training", variant, metrics, params)


def _train(sizes: Sizes, refine_steps: int, num_mixed: int, seed: int) -> tuple[dict, dict]:
    """Metrics and params of one training run."""
    body = _body(sizes.vertices)
    settings = TrainSettings(
        # A high rate: the limit on frames decides.
        bake=BakeSettings(
            frames_per_second=1000.0,
            max_frames=sizes.train_frames,
            num_directions=sizes.directions,
            num_mixed=num_mixed,
            seed=seed,
        ),
        fit=FitSettings(num_lobes=NUM_LOBES, num_components=sizes.num_components, refine_steps=refine_steps),
    )
    with tempfile.TemporaryDirectory() as folder, peak_memory() as peak:
        result = train_character(body, settings, Path(folder))
    seconds = result.timings.seconds
    held_out, trained = (np.flatnonzero(result.data.part == part) for part in (SEGMENT, TRAIN))
    half = to_half(result.model)
    metrics = {
        "seconds_total": sum(seconds.values()),
        **{f"seconds_{name.replace(' ', '_')}": value for name, value in seconds.items()},
        "rays_per_second": result.bake.rays_per_second,
        "relative_l2": _model_error(result.model, result.data, held_out),
        "relative_l2_training": _model_error(result.model, result.data, trained),
        "relative_l2_float16": _model_error(half, result.data, held_out),
        "peak_bytes": peak.peak_bytes,
        "model_bytes_float32": sum(array.nbytes for array in model_arrays(result.model).values()),
        "model_bytes_float16": sum(array.nbytes for array in model_arrays(half).values()),
    }
    params: Params = {
        "num_points": len(result.data.points.vertices),
        "num_frames": len(held_out) + len(trained),
        "num_mixed": num_mixed,
        "num_directions": sizes.directions,
        "num_lobes": NUM_LOBES,
        "num_components": len(result.model.weights) - 1,
        "refine_steps": refine_steps,
    }
    return metrics, params | _xla_params()


def _model_error(model: PoseModel, data, frames: np.ndarray) -> float:
    """Relative SH error over the visible points in some frames."""
    visible = np.flatnonzero(data.visible)
    components = np.asarray(harmonics.project_features(model.features, jnp.asarray(data.raw[frames], jnp.float32)))
    predicted = predict_sh(model, components, visible)
    wrong = total = 0.0
    # In pieces: unpacked, a ray is a float.
    for start in range(0, len(visible), 256):
        piece = slice(start, start + 256)
        truth = np.asarray(block_sh(data.bits[np.ix_(frames, visible[piece])], data.table))
        wrong += float(np.sum((predicted[:, piece] - truth) ** 2, dtype=np.float64))
        total += float(np.sum(truth**2, dtype=np.float64))
    return (wrong / total) ** 0.5


# --- Run time


def _runtime(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    yield from _runtime_rows(sizes, seed)
    if _xla_threads() == "one":
        try:
            yield from _in_fresh_process(
                _runtime_rows, sizes, seed, pool_of_threads=True, timeout_seconds=sizes.pool_seconds
            )
        except TimeoutError as error:
            console.announce(f"harmonics runtime with XLA's own threads: {error}; left out")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Shading:
    """What steps 1 to 5 work on besides the pose's components; all but `eye` and `light` per point."""

    model: PoseModel
    frames: jax.Array
    positions: jax.Array
    albedo: jax.Array
    exponent: jax.Array
    light: jax.Array
    eye: jax.Array

    def part(self, span: slice) -> "_Shading":
        """The same for some of the points."""
        own = {name: getattr(self.model, name)[span] for name in ("axes", "offset", "groups")}
        own["weights"] = self.model.weights[..., span]
        rest = {name: getattr(self, name)[span] for name in ("frames", "positions", "albedo", "exponent")}
        return dataclasses.replace(self, model=dataclasses.replace(self.model, **own), **rest)


def _synthetic_model(body: Character, sizes: Sizes, seed: int):
    """A model with the character's own pose features and random weights, and the first pose of its motion."""
    bake_settings = BakeSettings(frames_per_second=1000.0, max_frames=sizes.num_components + 12, num_mixed=0, seed=seed)
    motion = sample_motion(body, bake_settings, SplitSettings())
    points = choose_points(body, 0)
    bones, groups = feature_groups(body, points.vertices, "surroundings")
    basis = unfitted_basis(body, motion, "surroundings", bones)
    raw = all_raw_features(basis, body, motion)
    basis, _ = fit_basis(basis, raw, np.ones(len(motion)), sizes.num_components)
    rng, p = np.random.default_rng(seed), len(points.vertices)
    weights = 0.05 * rng.standard_normal((basis.basis.shape[-1] + 1, 6 * NUM_LOBES, p), np.float32)
    weights[0, 2 * NUM_LOBES :: 4] += 0.8
    weights[0, 2 * NUM_LOBES + 1 :: 4] += 0.7
    axes = rng.standard_normal((p, NUM_LOBES, 3), np.float32) + np.array([0, 0, 2], np.float32)
    model = PoseModel(
        features=basis,
        weights=jnp.asarray(weights),
        axes=normalize(jnp.asarray(axes)),
        offset=jnp.asarray(0.05 * rng.standard_normal((p, ORDER**2), np.float32)),
        groups=jnp.asarray(groups, jnp.int32),
        points=jnp.asarray(points.of_vertex, jnp.int32),
        visible=jnp.ones(p, bool),
    )
    return model, jax.tree.map(lambda values: jnp.asarray(values)[0], motion.pose), points.vertices


def _runtime_rows(sizes: Sizes, seed: int) -> list[Measurement]:
    body = _body(sizes.vertices)
    model, pose, points = _synthetic_model(body, sizes, seed)
    rng, p = np.random.default_rng(seed), len(points)
    parents = body.skeleton.parents

    @jax.jit
    def features(basis, pose):
        return harmonics.project_features(
            basis, harmonics.raw_features(basis, pose, global_matrices(pose, parents=parents))
        )

    skinned = jax.jit(lambda skin, pose: skin_mesh(skin, global_matrices(pose, parents=parents)))
    components, mesh = features(model.features, pose), skinned(body.skin, pose)
    scene = _Shading(
        model=model,
        frames=mesh.frames[points],
        positions=mesh.positions[points],
        albedo=jnp.asarray(rng.uniform(0.2, 0.8, (p, 3)), jnp.float32),
        exponent=jnp.asarray(rng.uniform(1.0, 100.0, p), jnp.float32),
        light=jnp.asarray(rng.standard_normal((3, ORDER**2), np.float32)),
        eye=jnp.asarray([0.5, 1.5, 4.0], jnp.float32),
    )
    uniform = dataclasses.replace(scene, exponent=jnp.asarray(20.0, jnp.float32))
    whole = {offset: jax.jit(functools.partial(_steps_1_to_5, offset=offset)) for offset in (False, True)}

    axes, coefficients = jax.jit(harmonics.predict_lobes)(model, components)
    mirror, turn, turned = (step_2 := jax.jit(_rotate))(axes, scene.frames, scene.positions, scene.eye)
    visibility = (step_3 := jax.jit(harmonics.lobes_to_sh))(coefficients, turned)
    step_3_offset = jax.jit(lambda c, a, o, r: harmonics.lobes_to_sh(c, a) + harmonics.sh_rotate(o, r))
    shadowed = step_3_offset(coefficients, turned, model.offset, turn)
    step_4, step_5 = jax.jit(harmonics.phong_transfer), jax.jit(harmonics.shade_transfer)
    transfer = step_4(visibility, uniform.exponent)

    scalar: Params = {"exponent": "scalar"}
    each: Params = {"exponent": "per point"}
    without: Params = {"offset": False}
    with_offset: Params = {"offset": True}
    rows: list[tuple[str, Params, Callable[[], Any]]] = [
        ("pose features", {}, lambda: features(model.features, pose)),
        ("skinning", {}, lambda: skinned(body.skin, pose)),
        ("step 1: synthesize", {}, functools.partial(jax.jit(harmonics.predict_lobes), model, components)),
        ("step 2: rotate lobes", {}, lambda: step_2(axes, scene.frames, scene.positions, scene.eye)),
        ("step 3: to SH", without, lambda: step_3(coefficients, turned)),
        ("step 3: to SH", with_offset, lambda: step_3_offset(coefficients, turned, model.offset, turn)),
        ("step 4: operator", scalar, lambda: step_4(visibility, uniform.exponent)),
        ("step 4: operator", each, lambda: step_4(visibility, scene.exponent)),
        ("step 5: shade", {}, lambda: step_5(transfer, mirror, scene.light, scene.albedo)),
    ]
    for offset, steps in whole.items():
        for kind, lit in ((scalar, uniform), (each, scene)):
            params: Params = {"offset": offset, **kind}
            rows.append(("steps 1-5", params, functools.partial(steps, components, lit)))
            if _xla_threads() == "one" and num_cores() > 1:
                parts = _divide(lit, p, num_cores())
                rows.append(("steps 1-5, all cores", params, functools.partial(_spread, steps, components, parts)))
    rows.append(
        (
            f"steps 1-5, {IN_FLIGHT} in flight",
            {**with_offset, **scalar},
            lambda: [whole[True](components, uniform) for _ in range(IN_FLIGHT)],
        )
    )

    # The same colors from the separate steps: what the steps together must not change.
    apart = {
        (offset, lit.exponent.ndim): step_5(
            step_4(shadowed if offset else visibility, lit.exponent), mirror, scene.light, scene.albedo
        )
        for offset in whole
        for lit in (uniform, scene)
    }
    timings = _alternate({str(i): row[2] for i, row in enumerate(rows)}, sizes)
    common: Params = {"num_points": p, "num_lobes": NUM_LOBES, "num_components": components.shape[-1]}
    found = []
    for i, (variant, params, function) in enumerate(rows):
        calls = IN_FLIGHT if "in flight" in variant else 1
        timing = timings[str(i)]
        metrics = {**timing.metrics(), "hz": calls * 1e3 / timing.ms_median}
        if variant in ("steps 1-5", "steps 1-5, all cores"):
            colors = function()
            colors = jnp.concatenate(colors) if isinstance(colors, list) else colors
            exact = apart[bool(params["offset"]), int(params["exponent"] == "per point")]
            metrics["relative_l2"] = _relative_l2(colors, exact)
        found.append(Measurement("runtime", variant, metrics, {**common, **params, **_xla_params()}))
    return found


def _rotate(axes, frames, positions, eye):
    """Step 2: world and vertex to reflection frame, and the lobes there."""
    wo = normalize(jnp.broadcast_to(eye, positions.shape) - positions)
    mirror = reflection_frame(wo, frames[..., 2])
    turn = jnp.einsum("...ji,...jk->...ik", mirror, frames)
    return mirror, turn, harmonics.rotate_lobes(axes, turn)


def _steps_1_to_5(components, scene: _Shading, *, offset: bool):
    lobes = harmonics.predict_lobes(scene.model, components)
    extra = {"offset": scene.model.offset} if offset else {}
    return harmonics.relight(
        *lobes, scene.frames, scene.positions, scene.light, scene.exponent, scene.albedo, scene.eye, **extra
    )


def _divide(scene: _Shading, num_points: int, count: int) -> list[_Shading]:
    """The scene cut by points, for one thread each."""
    edges = np.linspace(0, num_points, count + 1).astype(int)
    parts = []
    for first, last in itertools.pairwise(edges):
        if scene.exponent.ndim == 0:
            padded = dataclasses.replace(scene, exponent=jnp.zeros(num_points)).part(slice(first, last))
            parts.append(dataclasses.replace(padded, exponent=scene.exponent))
        else:
            parts.append(scene.part(slice(first, last)))
    return parts


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_cores())


def _spread(steps, components, parts: list[_Shading]) -> list:
    """Runs each part on a thread of its own and waits for all."""
    return list(_threads().map(lambda part: jax.block_until_ready(steps(components, part)), parts))


# --- Kernels


def _sh(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    for order in sizes.sh_orders:
        # An operator of order 10 is 40 kB.
        num = sizes.sh_vectors if order <= 4 else max(1, sizes.sh_vectors // 10)
        rows = _sh_rows(order, num, np.random.default_rng(seed))
        timings = _alternate({" ".join(key): row[0] for key, row in rows.items()}, sizes)
        for (kernel, variant), (_, error) in rows.items():
            timing = timings[f"{kernel} {variant}"]
            metrics = {**timing.metrics(), "ns_per_item": 1e6 * timing.ms_median / num, "relative_l2": error}
            params: Params = {"kernel": kernel, "order": order, "num_items": num}
            yield Measurement("sh", variant, metrics, params | _xla_params())


def _sh_rows(order: int, num: int, rng: np.random.Generator) -> dict[tuple[str, str], tuple[Callable[[], Any], float]]:
    """Kernel and variant -> what to time, and its error."""
    directions = normalize(jnp.asarray(rng.standard_normal((num, 3), np.float32)))
    turns = jnp.asarray(_random_rotations(rng, num), jnp.float32)
    turned = jnp.einsum("...ij,...j->...i", turns, directions)
    sh = jnp.asarray(rng.standard_normal((num, order**2), np.float32))
    exponents = jnp.asarray(rng.uniform(0.0, 100.0, num), jnp.float32)
    operator = jax.jit(functools.partial(harmonics.phong_operator, order=order))
    kernels: dict[str, tuple[Callable, Callable]] = {
        "jaxrender": (
            jax.jit(functools.partial(harmonics.sh_basis, order=order)),
            jax.jit(harmonics.sh_rotate),
        )
    }
    if _installed("e3nn_jax", "sh", "e3nn"):
        kernels["e3nn"] = _e3nn(order)
    rows: dict[tuple[str, str], tuple[Callable[[], Any], float]] = {}
    for variant, (basis, rotate) in kernels.items():
        # Laws that hold in every layout: Σ y² = order² / 4π, and y(Rd) = R y(d).
        y = basis(directions)
        basis_error = _relative_l2(jnp.sum(y**2, axis=-1), np.full(num, order**2 / (4 * np.pi)))
        rotate_error = _relative_l2(rotate(y, turns), basis(turned))
        rows["sh_basis", variant] = functools.partial(basis, directions), basis_error
        rows["sh_rotate", variant] = functools.partial(rotate, sh, turns), rotate_error
    rows["phong_operator", "jaxrender"] = (
        functools.partial(operator, exponents),
        _operator_error(operator, order),
    )
    return rows


def _e3nn(order: int) -> tuple[Callable, Callable]:
    """e3nn's basis and rotation, in its own layout."""
    import e3nn_jax

    irreps = e3nn_jax.s2_irreps(order - 1)

    def basis(directions):
        found = e3nn_jax.spherical_harmonics(irreps, directions, normalize=False, normalization="integral")
        return found.array

    def rotate(vector, rotation):
        return e3nn_jax.IrrepsArray(irreps, vector).transform_by_matrix(rotation).array

    def relaxed(function):
        """e3nn mixes types, leans on rank promotion and calls what JAX has deprecated; while it is traced, it may."""

        @jax.jit
        def traced(*args):
            with (
                warnings.catch_warnings(action="ignore", category=DeprecationWarning),
                jax.numpy_dtype_promotion("standard"),
                jax.numpy_rank_promotion("allow"),
            ):
                return function(*args)

        return traced

    return relaxed(basis), relaxed(jax.vmap(rotate))


def _operator_error(operator, order: int) -> float:
    """Against quadrature, at exponents where that is exact."""
    exponents = (0, 1, 5, 20)
    exact = [
        harmonics.brdf_operator(functools.partial(jax.lax.integer_pow, y=a), order=order, num_nodes=2 * order + 20)
        for a in exponents
    ]
    return _relative_l2(operator(jnp.asarray(exponents, jnp.float32)), np.stack(exact))


def _random_rotations(rng: np.random.Generator, num: int) -> np.ndarray:
    """Rotation matrices of random unit quaternions."""
    w, x, y, z = (q := rng.standard_normal((4, num))) / np.linalg.norm(q, axis=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _twin(sizes: Sizes, seed: int) -> Iterator[Measurement]:
    if not _installed("torch", "twin", "torchref"):
        return
    import torch

    import torchref.harmonics.relight

    rng, p = np.random.default_rng(seed), sizes.twin_points
    axes = rng.standard_normal((p, NUM_LOBES, 3))
    arrays = [
        axes / np.linalg.norm(axes, axis=-1, keepdims=True),
        rng.standard_normal((p, NUM_LOBES, ORDER)),
        _random_rotations(rng, p),
        rng.standard_normal((p, 3)),
        rng.standard_normal((3, ORDER**2)),
        np.float32(20.0),
        rng.uniform(0.2, 0.8, (p, 3)),
        np.array([0.5, 1.5, 9.0]),
    ]
    ours = [jnp.asarray(array, jnp.float32) for array in arrays]
    theirs = [torch.as_tensor(np.asarray(array, np.float32)) for array in arrays]
    relight = jax.jit(harmonics.relight)
    variants = {
        "jaxrender": lambda: relight(*ours),
        "torchref": lambda: torchref.harmonics.relight.relight(*theirs),
    }
    timings = _alternate(variants, sizes)
    difference = _relative_l2(variants["jaxrender"](), variants["torchref"]().numpy())
    for variant, timing in timings.items():
        metrics = {**timing.metrics(), "hz": 1e3 / timing.ms_median, "relative_l2": difference}
        params: Params = {"num_points": p, "num_lobes": NUM_LOBES, "offset": False, "exponent": "scalar"}
        yield Measurement("twin", variant, metrics, params | _xla_params())


# --- Shared


@functools.cache
def _body(num_vertices: int) -> Character:
    return builtin_character(num_vertices=num_vertices)


def _spread_frames(body: Character, settings: BakeSettings, count: int) -> Callable[[int], PosedMesh]:
    """Frame number below `count` -> posed mesh, evenly over all of the body's motion."""
    motion = sample_motion(body, settings, SplitSettings())
    chosen = np.linspace(0, len(motion) - 1, count).astype(int)
    posed = character_frames(body, motion)
    return lambda index: posed(int(chosen[index]))


def _alternate(variants: Mapping[str, Callable[[], object]], sizes: Sizes) -> dict[str, Timing]:
    jax.clear_caches()  # What was run to prepare the inputs shall be compiled once more, for compile_ms.
    return measure_alternating(variants, min_runs=sizes.min_runs, min_seconds=sizes.min_seconds)


def _relative_l2(found, exact) -> float:
    found, exact = np.asarray(found, np.float64), np.asarray(exact, np.float64)
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def _installed(module: str, case: str, variant: str) -> bool:
    """Whether a peer can be imported; says so if not."""
    if importlib.util.find_spec(module) is not None:
        return True
    console.announce(f"harmonics {case} {variant}: {module} is not installed; left out")
    return False


def _xla_threads() -> str:
    """`one` or `pool` on the CPU, the platform's name elsewhere."""
    if jax.default_backend() != "cpu":
        return jax.default_backend()
    return "one" if f"{POOL_SWITCH}false" in os.environ.get("XLA_FLAGS", "") else "pool"


def _xla_params() -> Params:
    return {"xla_threads": _xla_threads()}


def _in_fresh_process(
    function: Callable[..., Any],
    *args: Any,
    pool_of_threads: bool = False,
    timeout_seconds: float = 7200.0,
) -> Any:
    """The result of a function of this module from a process of its own: nothing compiled, no memory in use.

    On an accelerator, which two processes had better not share, the function runs here, with nothing compiled.

    Args:
      pool_of_threads: switches XLA's own thread pool on.
    Raises:
      TimeoutError: if there is no answer in time; the process is stopped. RuntimeError: if it died.
    """
    if jax.default_backend() != "cpu":
        jax.clear_caches()
        return function(*args)
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, function, args), daemon=True)
    with _pool_switched_on() if pool_of_threads else contextlib.nullcontext():
        process.start()
    sender.close()
    try:
        if not receiver.poll(timeout_seconds):
            raise TimeoutError(f"no answer within {timeout_seconds:g} s")
        return receiver.recv()
    except EOFError:
        raise RuntimeError(f"the process that ran {function.__name__} died") from None
    finally:
        process.kill()
        process.join()


def _answer(sender, function: Callable[..., Any], args: tuple) -> None:
    sender.send(function(*args))


@contextlib.contextmanager
def _pool_switched_on() -> Iterator[None]:
    """XLA_FLAGS, for a child process, with the thread pool on."""
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = flags.replace(f"{POOL_SWITCH}false", f"{POOL_SWITCH}true")
    try:
        yield
    finally:
        os.environ["XLA_FLAGS"] = flags


CASES: Mapping[str, Callable[[Sizes, int], Iterator[Measurement]]] = {
    "bake": _bake,
    "bake_memory": _bake_memory,
    "lobe_fit": _lobe_fit,
    "linear_solve": _linear_solve,
    "training": _training,
    "runtime": _runtime,
    "sh": _sh,
    "twin": _twin,
}
