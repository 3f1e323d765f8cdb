"""The case `quality` of the suite `filters`, on a tiny made-up render: that its numbers mean what they say."""

import dataclasses
import math

import jax
import numpy as np
import PIL.Image
import pytest

from benchmarks import denoising
from benchmarks.renders import NoRenders, Renders
from benchmarks.suites import Measurement, Options
from jaxrender.srgb import decode_srgb

HEIGHT, WIDTH = 24, 32
TINY = denoising.Sizes(height=HEIGHT, width=WIDTH, scenes=("cornell",), spp=(4,), rounds=0, pictures=(4,))
METRICS = {"mse_255", "relative_mse", "ssim", "flicker_255", "contact_mse_255"}


def make_render(seed, *, noise=0.2, reference_noise=0.0, spp=4):
    """A floor before the sky, with a dark stripe that only ambient occlusion knows."""
    rng = np.random.default_rng(seed)
    color, one = (HEIGHT, WIDTH, 3), (HEIGHT, WIDTH, 1)
    sky = np.arange(HEIGHT)[:, None, None] < 4
    normal = np.where(sky, 0.0, np.broadcast_to([0.0, 1.0, 0.0], color))
    depth = np.where(sky, 0.0, np.broadcast_to(np.linspace(8.0, 2.0, HEIGHT)[:, None, None], one))
    x = np.linspace(-1.0, 1.0, WIDTH)[None, :, None] * np.ones(one)
    position = np.where(sky, 0.0, np.concatenate([x, 0.0 * x, depth], axis=-1))
    stripe = np.abs(np.arange(WIDTH) - 16)[None, :, None] < 3
    ao = np.where(stripe, 0.2, 1.0) * np.ones(color)
    albedo = np.where(sky, 0.0, 0.6 * np.ones(color))
    light = np.where(sky, 0.0, 0.4 * ao)
    layers = {
        "normal": normal, "depth": depth, "position": position, "albedo": albedo,
        "emission": np.where(sky, 0.5, 0.0) * np.ones(color), "ao8": ao, "ao64": ao, "ao": ao,
        "direct": 0.0 * light, "indirect": light * (1.0 + noise * rng.standard_normal(color)),
        "reference_direct": 0.1 * np.ones(color), "reference_direct_variance": np.zeros(color),
        "reference_indirect": light * (1.0 + reference_noise * np.random.default_rng(99).standard_normal(color)),
        "reference_indirect_variance": (reference_noise * light) ** 2,
    }  # fmt: skip
    layers = {name: np.asarray(values, np.float32) for name, values in layers.items()}
    return Renders(scene="cornell", spp=spp, seed=seed, reference_spp=1024, ao_radii=(1.0, 2.0, 3.0), **layers)


def make_cell(**options):
    return denoising.Cell([make_render(seed, **options) for seed in (0, 1)])


def row(scene, variant, mse, contact=1.0):
    metrics = {"mse_255": mse, "relative_mse": -mse, "contact_mse_255": contact}
    return Measurement("quality", variant, metrics, {"scene": scene, "spp": 1})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Rows and folder of a run on made-up renders, without the ways that compile much."""
    folder = tmp_path_factory.mktemp("quality")
    with pytest.MonkeyPatch.context() as patch, jax.debug_nans(False):  # NaN marks what is not to be filtered
        patch.chdir(folder)
        patch.setattr(denoising, "load_renders", lambda scene, *, seed, spp, **_: make_render(seed, spp=spp))
        ways = {name: way for name, way in denoising.WAYS.items() if name not in ("jaxrender_auto", "oidn")}
        patch.setattr(denoising, "WAYS", ways)
        return list(denoising.quality(Options(), TINY)), folder


def test_rows_are_complete_and_finite(made):
    rows, _ = made
    names = set(denoising.WAYS) - {"jaxrender_auto", "oidn"}
    cells, sums = ([r for r in rows if (r.params["scene"] == "all") == last] for last in (False, True))
    assert {r.variant for r in cells} == {r.variant for r in sums} == names
    for r in cells:
        assert set(r.metrics) - {"flip"} == METRICS
        assert all(math.isfinite(value) for value in r.metrics.values())
        assert r.params["spp"] == 4
        assert r.params["width"] == WIDTH


def test_filters_denoise_and_ambient_occlusion_keeps_the_stripe(made):
    rows, _ = made
    found = {r.variant: r.metrics for r in rows if r.params["scene"] != "all"}
    for name in ("jaxrender", "bilateral_best", "atrous_ao_best"):
        assert found[name]["flicker_255"] < 0.5 * found["unfiltered"]["flicker_255"]
    assert found["jaxrender"]["contact_mse_255"] < 0.3 * found["normal_depth"]["contact_mse_255"]
    assert found["jaxrender"]["mse_255"] < found["unfiltered"]["mse_255"]


def test_draws_a_strip(made):
    _, folder = made
    with PIL.Image.open(folder / f"out/filters/cornell_{WIDTH}x{HEIGHT}_4.png") as picture:
        assert picture.width > 3 * 2 * (3 * WIDTH // 8)


def test_pictures_put_all_light_together():
    cell = make_cell()
    light = np.concatenate([cell.first.reference_indirect, np.full((HEIGHT, WIDTH, 3), -1.0, np.float32)], axis=-1)
    same, dark = cell.pictures(light)
    np.testing.assert_array_equal(same, cell.reference)
    # below 0 becomes 0: direct light and emission are left
    np.testing.assert_allclose(dark, cell.first.albedo * 0.1 + cell.first.emission, rtol=1e-6)


def test_error_is_that_of_displayed_values():
    cell = make_cell()
    image = decode_srgb(np.minimum((cell.shown + 3.0) / 255.0, 1.0))
    found = cell.judge([image, image])
    assert found["mse_255"] == pytest.approx(9.0, rel=1e-4)
    assert found["contact_mse_255"] == pytest.approx(9.0, rel=1e-4)
    assert found["flicker_255"] == 0.0


def test_noise_of_the_reference_is_taken_away():
    noisy, clean = make_cell(reference_noise=0.05), make_cell()
    raw = np.mean((denoising.shown(clean.reference) - noisy.shown) ** 2)
    assert raw > 1.0
    for metric in ("mse_255", "relative_mse", "contact_mse_255"):
        assert abs(noisy.judge([clean.reference] * 2)[metric]) < 0.15 * raw
    assert abs(noisy.error([clean.reference] * 2)) < 0.15 * raw


def test_flicker_is_the_variance_over_seeds():
    cell = make_cell()
    images = [decode_srgb((np.full_like(cell.reference, 100.0) + sign) / 255.0) for sign in (-2.0, 2.0)]
    assert cell.judge(images)["flicker_255"] == pytest.approx(8.0, rel=1e-4)


def test_search_finds_the_bottom_and_follows_a_slope():
    calls = []

    def error(settings):
        calls.append(tuple(settings.values()))
        return 1.0 + (settings["levels"] - 5) ** 2 + math.log2(settings["normal"] / 0.8) ** 2 + settings["clamp"]

    best, least = denoising.search(error, {"clamp": 1, "levels": 1, "normal": 0.1}, rounds=2)
    assert best == {"clamp": 0, "levels": 5, "normal": 0.8}
    assert least == 1.0
    assert len(set(calls)) == len(calls)
    assert denoising.search(error, {"clamp": 1, "levels": 1, "normal": 0.8}, rounds=0)[1] == 18.0


def test_search_ends_at_bounds():
    best, _ = denoising.search(lambda settings: settings["levels"] + settings["sigma"], {"levels": 3, "sigma": 2.0},
                               rounds=2)  # fmt: skip
    assert best == {"levels": 1, "sigma": 0.5}


def test_search_ends_where_nothing_changes_below_0():
    """Where noise of the reference is taken away, errors may be negative: standing still is no gain."""
    best, least = denoising.search(lambda settings: -0.1, {"levels": 3, "normal": 0.2}, rounds=2)
    assert best == {"levels": 3, "normal": 0.2} and least == -0.1


def test_search_does_not_run_after_nan():
    start = {"sigma": 2.0}
    assert denoising.search(lambda settings: math.nan, start, rounds=3)[0] == start


@pytest.mark.parametrize("name", list(denoising.NAMES))
def test_every_cell_has_a_start(name):
    assert set(denoising.STARTS[name]) == set(denoising.SCENES)
    for scene in denoising.SCENES:
        assert len(denoising.STARTS[name][scene]) == len(denoising.SPP)
    cell = denoising.Cell([make_render(0, spp=20)])
    values = tuple(denoising.start_of(name, cell).values())
    assert values == (0, *denoising.STARTS[name]["cornell"][2])


def test_summary_counts_cells_below_both_rivals():
    cells = {"a": (1.0, 2.0, 3.0), "b": (2.5, 2.0, 3.0), "c": (4.0, 5.0, 6.0)}
    rows = [
        row(scene, variant, value, contact=0.25 if variant == "jaxrender" else 1.0)
        for scene, (ours, bilateral, atrous) in cells.items()
        for variant, value in (
            ("jaxrender", ours), ("bilateral_best", bilateral), ("atrous_best", atrous), ("normal_depth", 7.0),
        )
    ]  # fmt: skip
    found = {r.variant: r.metrics for r in denoising.summaries(rows)}
    assert found["jaxrender"]["cells"] == 3
    assert found["jaxrender"]["cells_won"] == 2
    assert found["jaxrender"]["cells_won_relative"] == 0
    assert found["jaxrender"]["mse_ratio"] == pytest.approx((0.5 * 1.25 * 0.8) ** (1 / 3))
    assert found["jaxrender"]["contact_ratio"] == pytest.approx(0.25)
    assert found["bilateral_best"]["cells_won"] == 0
    assert list(denoising.summaries([row("a", "unfiltered", 1.0)])) == []


def test_worst_place_is_inside_and_covers_the_error():
    error = np.zeros((HEIGHT, WIDTH))
    error[20:23, 29:32] = 1.0
    y, x = denoising.worst_place(error, 8, 12)
    assert 0 <= y <= HEIGHT - 8
    assert 0 <= x <= WIDTH - 12
    assert error[y : y + 8, x : x + 12].sum() == 9.0


def test_says_what_is_missing(monkeypatch, capsys):
    def missing(*_, **__):
        raise NoRenders("no Mitsuba")

    monkeypatch.setattr(denoising, "load_renders", missing)
    monkeypatch.setattr(denoising, "has_oidn", lambda: False)
    assert list(denoising.quality(Options(), dataclasses.replace(TINY))) == []
    assert "no Mitsuba" in capsys.readouterr().err
