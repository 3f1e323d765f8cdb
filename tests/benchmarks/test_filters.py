"""The suite `filters` at tiny sizes: that every case runs and its numbers mean what they say. No times are judged."""

import types

import numpy as np
import pytest

from benchmarks import filters as suite
from benchmarks.suites import Options

TINY = suite.Sizes(
    table=((40, 56),),
    bilateral_radii=(2,),
    levels=(2,),
    guide_channels=(1,),
    radii=(3, 4),
    kornia_radii=(4,),
    precision=((60, 80),),
    precision_radii=(1, 24),
    subsamples=(1, 2),
    min_runs=1,
    min_seconds=0.0,
)


@pytest.fixture
def rows(monkeypatch):
    """Runs one case at tiny sizes."""
    monkeypatch.setattr(suite, "QUICK", TINY)
    monkeypatch.setattr(suite, "RADIUS", 4)
    return lambda case: list(suite.run(Options(cases=(case,), quick=True, seed=3)))


@pytest.fixture
def without_peers(monkeypatch):
    monkeypatch.setattr(suite, "PEER_MODULES", dict.fromkeys(suite.PEER_MODULES, "no_such_library"))
    suite.peer.cache_clear()
    yield
    suite.peer.cache_clear()


def check_numbers(rows, case):
    assert rows and {row.case for row in rows} == {case}
    for row in rows:
        assert all(isinstance(value, float) and np.isfinite(value) for value in row.metrics.values()), row
        assert all(isinstance(value, str | int | float | bool) for value in row.params.values()), row


def test_only_the_asked_cases_run(monkeypatch):
    ran = []
    cases = {name: lambda sizes, seed, name=name: ran.append((name, sizes, seed)) or [] for name in suite.CASES}
    monkeypatch.setattr(suite, "CASES", cases)
    assert list(suite.run(Options(cases=("radius", "f*"), seed=5))) == []
    assert ran == [("radius", suite.FULL, 5), ("fast", suite.FULL, 5)]


def test_sizes_are_those_of_the_papers_table():
    assert suite.FULL.table == ((768, 1024), (2160, 3840))
    assert (suite.FULL.bilateral_radii, suite.FULL.levels) == ((16, 24, 32), (4, 5, 6))
    assert suite.FULL.guide_channels == (1, 3, 4) and suite.RADIUS in suite.FULL.radii
    assert suite.RADIUS in suite.QUICK.radii and suite.RADIUS in suite.FULL.kornia_radii


# --- Cases


def test_table_beside_peers(rows):
    found = rows("table2")
    check_numbers(found, "table2")
    ours = {row.params["filter"]: row for row in found if row.variant == "jaxrender"}
    assert set(ours) == {"bilateral", "atrous", "guided"}
    for row in found:
        assert {"compile_ms", "ms_median", "ms_q1", "ms_q3", "peak_bytes"} <= set(row.metrics)
        if row.variant.startswith("jaxrender"):
            assert "differs" not in row.params
            assert row.metrics["max_error"] < 1e-5  # values up to about 5, weights of float32
        elif row.params["filter"] == "guided":
            assert row.params["differs"].startswith("border mirrored")
            assert row.metrics["max_error_inside"] < 1e-4 < row.metrics["max_error"]
    guided = [(row.params["guide_channels"], row.variant) for row in found if row.params["filter"] == "guided"]
    assert {(1, "jaxrender"), (1, "jaxrender_bands")} <= set(guided)


def test_peers_compute_the_same_away_from_the_border(monkeypatch):
    """Also where the guide is flat, which OpenCV takes amiss unless it is scaled."""
    monkeypatch.setattr(suite, "guided_filter", lambda guide, image, **_: image)  # ours need not be compiled
    picture = suite.draw_picture(40, 56, 3)
    flat = 0.5 + 0.01 * picture.guide[..., :3]
    true = suite.guided_in_float64(flat.astype(float), picture.noisy.astype(float), radius=4, eps=suite.EPS)
    calls = suite.guided_variants(flat, picture.noisy, radius=4)
    peers = {name: call for name, call in calls.items() if not name.startswith("jaxrender")}
    if not peers:
        pytest.skip("no other library is here")
    for name, call in peers.items():
        error = np.abs(suite._as_image(call()) - true)[8:-8, 8:-8]
        assert error.max() < 1e-4, name


def test_only_opencv_lacks_four_guide_channels(monkeypatch):
    monkeypatch.setattr(suite, "guided_filter", lambda guide, image, **_: image)
    image = np.zeros((8, 9, 3), np.float32)
    some = {g: set(suite.guided_variants(np.zeros((8, 9, g), np.float32), image, radius=1)) for g in (3, 4)}
    assert some[3] - some[4] == ({"opencv"} if suite.peer("opencv") else set())


def test_missing_peers_are_named_once_and_have_no_rows(without_peers, capsys, monkeypatch):
    monkeypatch.setattr(suite, "_jitted", lambda function, images: lambda: np.zeros_like(images[0]))
    tiny = suite.Sizes(min_runs=1, min_seconds=0.0)
    picture = suite.draw_picture(20, 24, 0)
    for radius in (1, 2):
        rows = list(suite._bilateral(picture, radius, {}, tiny, with_peer=True))
        assert [row.variant for row in rows] == ["jaxrender"]
    assert list(suite._oidn(picture, {}, tiny)) == []
    said = capsys.readouterr().err.replace("\n", " ")
    assert said.count("filters: opencv is not to be had") == said.count("filters: oidn is not to be had") == 1


def test_oidn_gets_color_albedo_and_normal(monkeypatch):
    asked = []
    fake = types.SimpleNamespace(denoise=lambda *images, **options: asked.append((images, options)) or images[0])
    monkeypatch.setattr(suite, "peer", lambda name: fake)
    picture = suite.draw_picture(20, 24, 0)
    (row,) = suite._oidn(picture, {"height": 20}, TINY)
    (noisy, albedo, normal), options = asked[0]
    assert noisy is picture.noisy and albedo is picture.albedo and normal is picture.normal
    assert options == {"hdr": True} and row.variant == "oidn" and row.params["height"] == 20


def test_time_over_the_radius(rows):
    found = rows("radius")
    check_numbers(found, "radius")
    for variant in {row.variant for row in found}:
        of = {row.params["radius"]: row.metrics for row in found if row.variant == variant}
        for metrics in of.values():
            assert metrics["ratio_to_24"] == pytest.approx(metrics["ms_median"] / of[4]["ms_median"])
        assert set(of) == ({4} if variant == "kornia" else {3, 4})
    assert all(row.metrics["max_error"] < 1e-5 for row in found if row.variant == "jaxrender")


def test_precision_of_variances(rows):
    found = rows("precision")
    check_numbers(found, "precision")
    for row in found:
        assert row.metrics["most_negative"] <= 0.0
        if row.variant == "box_variance":
            assert row.metrics["max_error_of_variance"] < 1e-6 and row.metrics["most_negative"] == 0.0
    error = {
        (row.variant, row.params["image"], row.params["radius"]): row.metrics["max_error_of_variance"] for row in found
    }
    for radius in TINY.precision_radii:
        # 100 + 0.01 x: squares of 1e4 in float32 are known to 1e-3, ten times the squared range.
        assert (
            error["summed_area_table", "near_constant", radius] > 1.0 > error["box_variance", "near_constant", radius]
        )
        assert 0.0 < error["prefix_sums", "uniform", radius] < 1e-5


def test_gradient_against_automatic_differentiation(rows):
    found = rows("gradient")
    check_numbers(found, "gradient")
    assert [row.variant for row in found] == ["value", "jaxrender", "autodiff"]
    value, ours, automatic = (row.metrics for row in found)
    assert value["ratio_to_value"] == 1.0 and "max_difference" not in value
    assert ours["max_difference"] < 1e-3 and automatic["max_difference"] == 0.0
    assert 0 < ours["temp_bytes"] < automatic["temp_bytes"]


def test_fewer_pixels_are_near_the_whole(rows):
    found = rows("fast")
    assert [row.params["subsample"] for row in found] == [1, 2]
    whole, half = (row.metrics for row in found)
    assert whole["speedup"] == 1.0 and whole["mse"] == 0.0 and whole["psnr_db"] == np.inf
    assert 20.0 < half["psnr_db"] < 60.0
    assert half["psnr_db"] == pytest.approx(-10 * np.log10(half["mse"]), abs=1e-3)


# --- Parts


def test_picture_is_in_range_and_drawn_from_the_seed():
    first, again, other = (suite.draw_picture(30, 40, seed) for seed in (1, 1, 2))
    for name, array in first._asdict().items():
        assert array.dtype == np.float32 and array.shape[:2] == (30, 40)
        np.testing.assert_array_equal(array, getattr(again, name))
    assert (first.noisy != other.noisy).any() and (first.guide == other.guide).all()
    for array in (first.guide, first.albedo):
        assert 0.0 <= array.min() < array.max() <= 1.0
    assert first.noisy.min() >= 0.0
    np.testing.assert_allclose(np.linalg.norm(first.normal, axis=-1), 1.0, rtol=1e-6)


def windows(height, width, radius):
    for y in range(height):
        for x in range(width):
            yield y, x, slice(max(0, y - radius), y + radius + 1), slice(max(0, x - radius), x + radius + 1)


def test_truth_of_the_guided_filter_is_ridge_regression(rng):
    guide, image, eps = rng.random((6, 7, 2)), rng.random((6, 7, 3)), 0.03
    total, count = np.zeros_like(image), np.zeros((6, 7, 1))
    for _, _, *window in windows(6, 7, 2):
        g, p = guide[*window].reshape(-1, 2), image[*window].reshape(-1, 3)
        spread = g - g.mean(axis=0)
        a = np.linalg.solve(spread.T @ spread + eps * len(g) * np.eye(2), spread.T @ p)
        total[*window] += p.mean(axis=0) + (guide[*window] - g.mean(axis=0)) @ a
        count[*window] += 1
    np.testing.assert_allclose(suite.guided_in_float64(guide, image, radius=2, eps=eps), total / count, rtol=1e-12)


def test_truth_of_the_variance(rng):
    image = rng.random((6, 7)).astype(np.float32) + np.float32(100.0)
    true = suite.variance_in_float64(image, radius=2)
    for y, x, *window in windows(6, 7, 2):
        assert true[y, x] == pytest.approx(np.var(image[*window].astype(float)), rel=1e-9)


def test_judge_sees_errors_at_the_border_and_inside(monkeypatch):
    monkeypatch.setattr(suite, "CHECKED", 20)
    image = np.zeros((30, 40, 1), np.float32)
    seen = []
    judge = suite._judge(lambda corner: seen.append(corner) or corner, (image,), halo=5)
    assert seen[0].shape == (25, 25, 1) and seen[0].dtype == np.float64
    result = image.copy()
    result[0, 3], result[10, 12], result[22, 22] = 0.5, 0.25, 9.0  # the last is outside the corner
    assert judge(result) == {"max_error": 0.5, "max_error_inside": 0.25}
    small = suite._judge(lambda corner: corner, (image[:8],), halo=5)
    assert small(result[:8]) == {"max_error": 0.5}
