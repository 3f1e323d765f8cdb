"""jaxrender.deferred.metrics, sampling and clusters against the twins: counts, their derivatives, and choices."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from jaxrender.deferred import metrics as jax_metrics
from tests.support import scenes
from tests.support.asserts import assert_close
from tests.support.cases import Case, Record
from tests.support.tolerances import LONG_SUM, ROUNDING, TIGHT
from tests.twins import both
from tests.twins.agreement import DTYPES, check
from torchref.deferred import metrics as torch_metrics

_rng = np.random.default_rng(2013)

# Shares and footprints are float32 in either precision.
FLOAT32_ALWAYS = ROUNDING * float(np.finfo(np.float32).eps / np.finfo(np.float64).eps)


def _covered(*shape: int) -> np.ndarray:
    """From full windows to empty ones, and both at once."""
    share = _rng.choice([0.0, 0.3, 0.7, 1.0], size=(*shape[:-1], 1))
    return _rng.uniform(size=shape) < share


def _normals(*shape: int, bend: float) -> np.ndarray:
    """Around an axis of each window."""
    normal = _unit(*shape[:-1], 1) + bend * _rng.normal(size=(*shape, 3))
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _unit(*shape: int) -> np.ndarray:
    normal = _rng.normal(size=(*shape, 3))
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _one_behind(normal: np.ndarray) -> np.ndarray:
    """The first normal of each window points the other way."""
    return normal * np.where(np.arange(normal.shape[-2]) == 0, -1.0, 1.0)[:, None]


def _nothing_known(values: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Values that nobody may look at, where nothing is."""
    junk = _rng.choice([np.nan, np.inf, -np.inf, 1e30], size=covered.shape)
    return np.where(covered.reshape(*covered.shape, *[1] * (values.ndim - covered.ndim)), values, junk[..., None])


def _metrics() -> list[Case]:
    room = "deferred.metrics"
    cases = []
    for size in (1, 2, 3, 4, 5):
        shape = (3, 4, size * size)
        depth, covered = _rng.uniform(0.2, 1.0, shape), _covered(*shape)
        nearly_full = (np.arange(size * size) != 1) | (_rng.uniform(size=(3, 4, 1)) < 0.5)
        scale, label = np.array(20.0), f"{size} x {size}"
        both_slopes = ("depth", "scale") if size > 1 else ()
        cases += [
            Case(
                f"{room}.depth_sample_count",
                {"depth": depth, "scale": scale, "covered": covered},
                label,
                gradients=both_slopes,
            ),
            # A ridge of 1e-6, for cells on a line, leaves some 1e-6 of a slope, 1e-11 of its variance. Windows with
            # few cells: tests/deferred/test_metrics.py.
            Case(
                f"{room}.depth_sample_count",
                {"depth": depth, "scale": scale, "covered": nearly_full, "plane_corrected": True},
                f"{label}, without plane",
                gradients=both_slopes,
                ulps64=256 * TIGHT,
                gradient_ulps=256 * TIGHT,
            ),
            Case(
                f"{room}.normal_sample_count",
                {"normal": _normals(*shape, bend=0.4), "scale": scale, "covered": covered},
                label,
                gradients=("normal", "scale") if size > 1 else (),
                on={"normal": "sphere"},
            ),
            Case(
                f"{room}.normal_sample_count",
                {"normal": _one_behind(_normals(*shape, bend=0.05)), "scale": 16.0},
                f"{label}, both sides",
                gradients=("normal",) if size > 2 else (),
                on={"normal": "sphere"},
            ),
        ]
    covered = _covered(5, 9)
    cases += [
        Case(
            f"{room}.depth_sample_count",
            {"depth": _nothing_known(_rng.uniform(0, 1, (5, 9, 1)), covered)[..., 0], "covered": covered, "scale": 2.0},
            "junk in empty ones",
            gradients=("depth",),
        ),
        Case(
            f"{room}.normal_sample_count",
            {"normal": _nothing_known(_normals(5, 9, bend=0.5), covered), "covered": covered, "scale": 2.0},
            "junk in empty ones",
        ),
        Case(
            f"{room}.depth_sample_count",
            {"depth": np.where(_rng.uniform(size=(30, 4)) < 0.9, _rng.uniform(0, 1, (30, 4)), np.nan), "scale": 2.0},
            "not finite",
        ),
        Case(
            f"{room}.normal_sample_count",
            {"normal": np.where(_rng.uniform(size=(30, 4, 3)) < 0.9, _unit(30, 4), np.inf), "scale": 2.0},
            "not finite",
        ),
        Case(f"{room}.depth_sample_count", {"depth": _rng.uniform(0, 1, 4), "scale": 2.0}, "one window"),
        Case(f"{room}.normal_sample_count", {"normal": _normals(4, bend=0.5), "scale": 2.0}, "one window"),
        *(Case(f"{room}.balanced_counts", {"size": size}, f"{size}", host=True) for size in range(1, 10)),
        *(
            Case(f"{room}.tile_maximum", {"count": _rng.integers(0, 17, shape), "tile": tile}, f"{shape}, {tile}")
            for shape, tile in (((7, 13), 6), ((12, 6), 6), ((3, 4), 1), ((2, 3), 5))
        ),
        Case(
            f"{room}.average_over_frames",
            {"metric": _rng.uniform(0, 4, (5, 6)), "previous": _rng.uniform(0, 4, (5, 6)), "share": 0.7},
            gradients=("metric", "previous"),
        ),
    ]
    for shape in ((6, 7), (1, 5), (4, 1), (1, 1)):
        luminance, there = _rng.uniform(0, 1, shape), _rng.uniform(size=shape) < 0.7
        for label, image, mask in (
            (f"{shape}, all", {"luminance": 0.4 + 0.5 * luminance}, {}),
            (f"{shape}, some", {"luminance": _nothing_known(luminance[..., None], there)[..., 0]}, {"covered": there}),
        ):
            gradients = ("luminance",) if len(there) > 1 else ()
            cases += [
                Case(
                    f"{room}.shading_sample_count",
                    {**image, **mask, "scale": 16.0, "edge_threshold": 0.2},
                    label,
                    gradients=gradients,
                ),
                Case(f"{room}.shading_steps", {**image, **mask}, label, gradients=gradients),
            ]
    return cases


def _sampling() -> list[Case]:
    room = "deferred.sampling"
    cases = [
        *(Case(f"{room}.index_matrix", {"size": size}, f"{size}", host=True) for size in (*range(1, 10), 16)),
        *(Case(f"{room}.sample_positions", {"size": size}, f"{size}", host=True) for size in (1, 2, 3, 4, 8)),
        Case(f"{room}.prefix_points", {"count": np.array(3), "size": 2}, "one window", ulps64=FLOAT32_ALWAYS),
    ]
    for size in (1, 2, 3, 4, 5):
        covered = _covered(4, 6, size * size)
        owner, sample = _clustering(size, 12)
        cases += [
            Case(f"{room}.sample_rank", {"covered": covered}, f"{size} x {size}"),
            Case(f"{room}.first_sample", {"covered": covered}, f"{size} x {size}"),
            Case(
                f"{room}.prefix_points",
                {"count": _rng.integers(1, size * size + 1, (3, 5)), "size": size},
                f"{size} x {size}",
                ulps64=FLOAT32_ALWAYS,
            ),
            Case(
                f"{room}.cluster_points",
                {"owner": owner, "sample": sample},
                f"{size} x {size}",
                ulps64=FLOAT32_ALWAYS,
            ),
        ]
    owner, sample = (values[0] for values in _clustering(3, 1))
    return [
        *cases,
        Case(f"{room}.first_sample", {"covered": np.array([False, False, True, True])}, "one window"),
        Case(f"{room}.cluster_points", {"owner": owner, "sample": sample}, "one window", ulps64=FLOAT32_ALWAYS),
    ]


def _clustering(size: int, num_windows: int) -> tuple[np.ndarray, np.ndarray]:
    """Owners of windows, and one of the owners of each."""
    n = size * size
    owner, sample = np.full((num_windows, n), -1, np.int32), np.zeros(num_windows, np.int32)
    for row in range(num_windows):
        members = _rng.permutation(n)[: _rng.integers(1, n + 1)]
        owners = members[: _rng.integers(1, len(members) + 1)]
        owner[row, members] = _rng.choice(owners, len(members))
        owner[row, owners] = owners
        sample[row] = owners[0]
    return owner, sample


def _window_of_surfaces(size: int, *lead: int, scales: tuple[float, float] = (3.0, 20.0)) -> dict:
    """Bent patches of some materials, up to three to a window, at distances around 5."""
    shape = (*lead, size * size)
    patch = _rng.integers(0, 3, shape)
    normal = np.take_along_axis(_unit(*lead, 3), patch[..., None], axis=-2) + 0.1 * _rng.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    covered = _covered(*shape)
    return {
        "normal": _nothing_known(normal, covered),
        "position": _nothing_known(_rng.normal(scale=0.1, size=(*shape, 3)) + patch[..., None], covered),
        "depth": np.where(covered, _rng.uniform(4, 6, shape), 0.0),
        "material_id": np.where(covered, np.where(_rng.uniform(size=shape) < 0.1, 1, 0), -1).astype(np.int32),
        "covered": covered,
        "slope": _rng.uniform(0, 2, (*lead, 2)),
        "normal_scale": scales[0],
        "plane_scale": np.array(scales[1]),
    }


def _clusters() -> list[Case]:
    # Decisions: a tie closer than the roundings would differ, but the steps of random surfaces lie apart.
    return [
        *(
            Case("deferred.clusters.cluster_samples", _window_of_surfaces(size, 4, 5), f"{size} x {size}")
            for size in (1, 2, 3, 4, 5)
        ),
        Case("deferred.clusters.cluster_samples", _window_of_surfaces(4, 9, scales=(8.0, 300.0)), "the defaults"),
        Case("deferred.clusters.cluster_samples", _window_of_surfaces(3), "one window"),
        Case(
            "deferred.clusters.shading_slope",
            {
                "steps": _rng.uniform(0, 1, (4, 5, 2)),
                "detail": _rng.uniform(0, 0.1, (4, 5)),
                "luma": _rng.uniform(0, 1, (4, 5)),
                "contrast_scale": 18.0,
                "detail_scale": np.array(72.0),
            },
        ),
    ]


def _cones() -> list[Case]:
    windows = {"normal": _normals(5, 9, bend=0.5), "covered": _covered(5, 9)}
    listed = {
        "values": _rng.uniform(0, 2, (30, 3)),
        "weight": _rng.uniform(0, 1, 30),
        "pixel": _rng.integers(0, 9, 30).astype(np.int32),  # 7 and 8 are nobody's
        "num_pixels": 7,
    }
    return [
        Case("deferred.metrics.normal_cone", windows, gradients=("normal",), on={"normal": "sphere"}),
        Case("deferred.sampling.resolve_samples", listed, gradients=("values", "weight")),
    ]


def _quads() -> list[Case]:
    cases = []
    for size, count in ((1, 4), (2, 4), (2, 7), (3, 12)):
        window = _window_of_surfaces(2 * size, 5)
        del window["slope"]
        quarter = np.arange(4).reshape(2, 2).repeat(size, 0).repeat(size, 1).reshape(-1)
        seeds = np.full((5, 4), -1, np.int32)
        for row, k in np.ndindex(5, 4):
            members = np.flatnonzero(window["covered"][row] & (quarter == k))
            seeds[row, k] = _rng.choice(members) if len(members) else -1
        window |= {"seeds": seeds, "count": count, "apart_scale": 1.5}
        cases.append(Case("deferred.clusters.cluster_quads", window, f"{size} x {size}, {count}"))
    return cases


def _highlights() -> list[Case]:
    """Lights in front of the normals, beside and behind them; windows that are flat, bent, empty in part, or all."""
    lights = scenes.lights()
    lights["range"] = np.minimum(lights["range"], 50.0)
    return [
        Case(
            "deferred.highlights.highlight_sample_count",
            {
                "normal": _normals(6, 9, bend=bend),
                "position": _rng.uniform(-1.0, 1.0, (6, 3)),
                "roughness": _rng.uniform(0.3, 1.0, 6),
                "light": _rng.uniform(0.05, 0.4, 6),
                "lights": Record("scene.Lights", lights),
                "eye": scenes.EYE,
                "scale": np.array(48.0),
                "covered": _covered(6, 9),
            },
            f"bend {bend}",
            gradients=("roughness", "light", "scale"),
            ulps32=LONG_SUM,  # the difference of two values that are nearly the same, 48 times
        )
        for bend in (0.01, 0.1, 0.5)
    ]


CASES = [*_metrics(), *_sampling(), *_clusters(), *_cones(), *_quads(), *_highlights()]
CHAINS = [
    (
        Case("deferred.clusters.cluster_samples", _window_of_surfaces(size, 8), f"{size} x {size}"),
        _rng.uniform(size=(8, size * size, 3)),
    )
    for size in (2, 3, 4)
]


@pytest.mark.parametrize(
    ("case", "dtype"),
    [
        pytest.param(case, dtype, id=f"{case.id}-{np.dtype(dtype).name}")
        for case in CASES
        for dtype in (DTYPES[:1] if case.host else DTYPES)
    ],
)
def test_twin(case, dtype):
    with jax.debug_nans(False):  # which are in the empty sub-samples of some cases
        check(case, dtype)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_whole_counts(size, rng):
    """The one kernel with any number of arguments, on whole numbers, on others, and beyond either end."""
    values = np.concatenate([np.arange(-1, size * size + 2), [1e9, np.inf], rng.uniform(-1, size * size + 2, 60)])
    metrics = [rng.permutation(values[:60]).astype(np.float32).reshape(3, 20) for _ in range(3)]
    for used in (metrics[:1], metrics):
        for allowed in (None, jax_metrics.balanced_counts(size)):
            ours = jax_metrics.sample_count(*map(jnp.asarray, used), size=size, allowed=allowed)
            theirs = torch_metrics.sample_count(*map(torch.tensor, used), size=size, allowed=allowed)
            assert_close(ours, theirs, ulps=0.0, what=f"{len(used)} metrics, {allowed}")


@pytest.mark.parametrize(("case", "radiance"), CHAINS, ids=lambda value: getattr(value, "id", ""))
def test_the_chain_from_windows_to_pixels(case, radiance):
    """Clusters, what their samples stand for, and the sum of share times radiance over the samples of a pixel."""
    with jax.debug_nans(False):
        ours, theirs = (_pixels(run, case, radiance) for run in (both.run_jax, both.run_torch))
    assert_close(ours, theirs, ulps=ROUNDING, dtype=np.float32)


def _pixels(run: Callable, case: Case, radiance: np.ndarray) -> np.ndarray:
    owner = np.asarray(run(case, np.float64)[0])
    row, sample = np.nonzero(owner == np.arange(owner.shape[1]))
    arguments = {"owner": owner[row], "sample": sample.astype(np.int32)}
    points, _ = run(Case("deferred.sampling.cluster_points", arguments), np.float64)
    pixels = np.zeros((len(owner), 3))
    for i, own, weight in zip(row, sample, np.asarray(points.weight), strict=True):
        pixels[i] += weight * radiance[i, own]
    return pixels
