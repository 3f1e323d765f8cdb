"""The suite `adaptive` at tiny sizes: that every case runs and its numbers mean what they say. No times are judged."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from benchmarks import adaptive as suite
from benchmarks import adaptive_figures as figures
from benchmarks import report
from benchmarks.suites import Options
from jaxrender.deferred.strategies import STRATEGIES

TINY = dataclasses.replace(
    suite.QUICK, height=48, width=64, flicker=(48, 64), flicker_frames=3, picture=(48, 64), flight=(48, 64),
    flight_frames=2, dial=(0.3, 1.0, 3.0),
)  # fmt: skip

ERRORS = {"mse", "psnr_db", "psnr_255_db", "sample_share", "samples_per_pixel"}
TIMES = {"compile_ms", "ms_median", "ms_q1", "ms_q3", "ms_raster", "ms_shade"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("adaptive")


@pytest.fixture(scope="module")
def rows(folder):
    """All rows of a quick run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(suite, "QUICK", TINY)
        # At these sizes all views have room in one process, and share their programs.
        patch.setattr(suite.jax, "clear_caches", lambda: None)
        return list(suite.run(Options(quick=True, seed=3)))


def of(rows, case):
    return [row for row in rows if row.case == case]


def shot(image, *, num_shaded=1, num_covered=1, num_pixels=1):
    image = np.asarray(image, np.float32)
    return suite.Shot(image, num_shaded, num_covered, num_pixels, np.ones(image.shape[:2], np.int32))


# --- All cases, once


@pytest.mark.slow
def test_rows_are_complete_and_finite(rows):
    assert {row.case for row in rows} == set(suite.CASES) - set(suite.ON_REQUEST)
    for row in rows:
        assert {"m", "lights", "view", "scene", "height", "width", "normal_maps", "seed"} <= set(row.params)
        assert all(isinstance(value, str | int | float | bool) for value in row.params.values()), row
        for name, value in row.metrics.items():
            exact = name.startswith("psnr") and row.metrics.get("mse") == 0.0
            unreached = name == "share_at_goal"
            assert isinstance(value, float) and (math.isfinite(value) or exact or unreached), (row, name)
    report.write_records("/dev/null", [report.make_record("adaptive", row, {}) for row in rows])


@pytest.mark.slow
def test_table_has_every_variant_with_times_and_errors(rows):
    table = of(rows, "table1")
    assert [row.variant for row in table if row.params["m"] == 1] == list(suite.ONE_SAMPLE)
    timed = [row for row in table if row.params["m"] == 2 and "ms_median" in row.metrics]
    assert [row.variant for row in timed] == list(suite.WAYS)
    for row in timed:
        assert set(row.metrics) >= TIMES | {"speedup", "sample_share"}
        if row.variant != "supersampled":
            assert set(row.metrics) >= ERRORS and row.metrics["mse"] > 0.0
    judged = [row for row in table if row.params["m"] == 2 and "ms_median" not in row.metrics]
    assert {(row.params["view"], row.params["normal_maps"]) for row in judged} == {
        ("C", True), ("A", False), ("C", False),
    }  # fmt: skip
    assert {row.params["view"] for row in timed} == {"A"}


@pytest.mark.slow
def test_errors_and_shares_are_ordered_as_they_must_be(rows):
    timed = {row.variant: row.metrics for row in of(rows, "table1") if "speedup" in row.metrics}
    assert timed["supersampled"]["sample_share"] == 1.0 == timed["supersampled"]["speedup"]
    assert 0.2 < timed["single"]["sample_share"] < 0.3  # one of four
    assert timed["single"]["sample_share"] == timed["fxaa"]["sample_share"] == timed["mlaa"]["sample_share"]
    for variant in ("printed", "adaptive"):
        assert timed[variant]["psnr_db"] > timed["single"]["psnr_db"] + 6.0
        assert timed[variant]["psnr_255_db"] == pytest.approx(timed[variant]["psnr_db"] + 48.1308, abs=1e-3)


@pytest.mark.slow
def test_uniform_counts_and_terms(rows):
    found = of(rows, "uniform")
    assert [row.params["count"] for row in found] == [1, 2, 3]
    assert [row.params["balanced"] for row in found] == [True, True, False]
    shares = [row.metrics["sample_share"] for row in found]
    assert shares == sorted(shares)
    terms = of(rows, "metrics")
    assert {row.variant for row in terms} == {*suite.TERMS, "all_trilinear"}
    share = {(row.variant, row.params["scale"]): row.metrics["sample_share"] for row in terms}
    for scale in (1.0, TINY.larger_scale):
        assert share["depth_plane_corrected", scale] <= share["depth", scale] <= share["all", scale]


@pytest.mark.slow
def test_strategies_shade_the_same_picture(rows):
    found = {row.variant: row for row in of(rows, "strategies")}
    assert tuple(found) == STRATEGIES
    assert [name for name, row in found.items() if not row.params["bit_equal"]] == ["low_resolution"]
    predicted = {name: row.metrics["predicted_ratio"] for name, row in found.items()}
    assert predicted["compacted"] == 1.0 <= predicted["sorted"] <= predicted["masked"] <= predicted["low_resolution"]
    assert found["compacted"].metrics["measured_ratio"] == 1.0


@pytest.mark.slow
def test_dial_and_flicker(rows):
    first = {"view": "A", "normal_maps": True}
    dial = [row for row in of(rows, "dial") if row.variant == "adaptive" and first.items() <= row.params.items()]
    assert [row.params.get("scale") for row in dial] == [*TINY.dial, None]
    shares = [row.metrics["sample_share"] for row in dial[:-1]]
    assert shares == sorted(shares) and dial[-1].params["goal_db"] == suite.PAPER_DB[2]
    flicker = {row.variant: row.metrics for row in of(rows, "flicker")}
    assert tuple(flicker) == (*suite.FLICKERING, *suite.AVERAGED)
    assert flicker["supersampled"]["flicker_255"] == flicker["supersampled"]["error_flicker_255"] == 0.0
    assert flicker["adaptive"]["error_flicker_255"] < flicker["single"]["error_flicker_255"]


@pytest.mark.slow
def test_pictures_are_written(rows, folder):
    found = of(rows, "pictures")
    assert [row.params["path"] for row in found] == [str(suite.OUT / name) for name in figures.FIGURES]
    for row in found:
        with PIL.Image.open(folder / row.params["path"]) as image:
            assert min(image.size) > 48 and image.convert("L").getextrema()[1] > 100
            assert getattr(image, "n_frames", 1) == (TINY.flight_frames if row.variant == "flight" else 1)


# --- Parts


def test_a_long_case_wants_to_be_named(monkeypatch):
    assert not Options().names("lights256") and Options().wants("lights256")
    assert Options(cases=("*", "lights*")).names("lights256")
    ran = []
    cases = {name: lambda place, sizes, name=name: ran.append(name) or [] for name in suite.CASES}
    monkeypatch.setattr(suite, "CASES", cases)
    monkeypatch.setattr(suite, "open_place", lambda **options: None)
    list(suite.run(Options()))
    assert "lights256" not in ran and len(ran) == len(cases) - 1
    ran.clear()
    list(suite.run(Options(cases=("lights256", "dial"))))
    assert ran == ["lights256", "dial"]


def test_errors_of_known_pictures():
    reference = shot(np.full((12, 16, 3), 0.5), num_shaded=40, num_covered=40, num_pixels=10)
    found = suite.judge(shot(np.full((12, 16, 3), 0.6), num_shaded=15), reference)
    assert found["mse"] == pytest.approx(0.01, rel=1e-5)
    assert found["psnr_db"] == pytest.approx(20.0, abs=1e-4)
    assert found["psnr_255_db"] == pytest.approx(68.1308, abs=1e-3)
    assert found["sample_share"] == 0.375 and found["samples_per_pixel"] == 1.5
    assert "flip" not in found
    pytest.importorskip("flip_evaluator")
    assert 0.0 < suite.judge(shot(np.full((12, 16, 3), 0.6)), reference, with_flip=True)["flip"] < 1.0


def test_where_a_curve_reaches_its_goal():
    curve = [(0.1, 30.0), (0.2, 40.0), (0.6, 50.0)]
    assert suite.share_at(35.0, curve) == pytest.approx(0.15)
    assert suite.share_at(50.0, curve) == pytest.approx(0.6)
    assert math.isnan(suite.share_at(29.0, curve)) and math.isnan(suite.share_at(51.0, curve))


def test_lanes_paid():
    count = np.ones((8, 16), np.int32)
    assert {suite._lanes_paid(count, strategy) for strategy in STRATEGIES} == {128}
    count[2, 9] = 5  # its block of 8 x 4 pixels waits for it
    assert suite._lanes_paid(count, "masked") == 128 + 4 * 32
    assert suite._lanes_paid(count, "compacted") == 132
    assert suite._lanes_paid(count, "sorted") == 128 + 4 * 32
    assert suite._lanes_paid(count, "per_count") == 128 + 5 * 32


def test_restlessness_is_of_second_differences():
    steady = np.arange(5.0)[:, None, None, None] * np.ones((1, 2, 2, 3)) / 255.0
    assert suite._restlessness(steady) == pytest.approx(0.0, abs=1e-12)
    blinking = np.array([0.0, 1.0, 0.0, 1.0])[:, None, None, None] * np.ones((1, 2, 2, 3)) / 255.0
    assert suite._restlessness(blinking) == pytest.approx(2.0)


def test_worst_places_lie_apart():
    error = np.zeros((20, 30))
    error[3:6, 4:8], error[12:15, 20:24] = 1.0, 2.0
    first, second, third = figures.worst_places(error, 5, 6, number=3)
    for (y, x), (top, left) in ((first, (12, 20)), (second, (3, 4))):
        assert y <= top and top + 3 <= y + 5 and x <= left and left + 4 <= x + 6
    for a, b in ((first, second), (first, third), (second, third)):
        assert abs(a[0] - b[0]) >= 10 or abs(a[1] - b[1]) >= 12
    for y, x in (first, second, third):
        assert 0 <= y <= 15 and 0 <= x <= 24


def test_figures_go_where_the_suite_says():
    assert suite.OUT == Path("out/adaptive")
    assert {Path(name).suffix for name in figures.FIGURES} == {".png", ".webp"}
