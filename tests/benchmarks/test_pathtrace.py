"""The suite `pathtrace` on small inputs: its rows are there, with finite numbers that fit together."""

import math

import jax
import PIL.Image
import pytest

from benchmarks import denoising, path_quality, path_renders, pathtrace
from benchmarks.suites import Options

# The others compile much, and are tested in test_denoising.
WAYS = ("unfiltered", "normal_depth", denoising.OURS, *denoising.RIVALS)


@pytest.fixture(scope="module")
def made(shared_data, tmp_path_factory):
    """Rows of all cases but that of Mitsuba, and the folder of pictures and renders."""
    folder = tmp_path_factory.mktemp("pathtrace")
    with pytest.MonkeyPatch.context() as patch, jax.debug_nans(False):  # NaN marks what is not to be filtered
        patch.setattr(path_renders, "FOLDER", folder)
        patch.setattr(path_quality, "FOLDER", folder)
        ways = {name: denoising.WAYS[name] for name in WAYS}
        patch.setattr(denoising, "WAYS", ways)
        patch.setattr(path_quality, "WAYS", ways)
        cases = ("table1", "backends", "rays", "quality", "final", "figures")
        return list(pathtrace.run(Options(cases=cases, quick=True))), folder


@pytest.mark.data
def test_rows_are_complete_and_finite(made):
    rows, _ = made
    names = [(row.case, row.variant) for row in rows]
    assert names == [
        ("table1", "traced"), ("table1", "whole"), ("backends", "embree"), ("backends", "jax"),
        *[("rays", "embree"), ("rays", "jax")] * 3,
        *[("quality", name) for name in WAYS] * 2, ("final", "plain"), ("final", "ratio"),
        *(("figures", f"figure{number}") for number in (2, 5, 6, 7, 8)),
    ]  # fmt: skip
    assert all(math.isfinite(value) for row in rows for value in row.metrics.values())
    assert all(row.metrics["differing_share"] < 0.02 for row in rows if row.case == "backends")


@pytest.mark.data
def test_filters_and_ratios_lower_the_error(made):
    rows, _ = made
    errors = {row.variant: row.metrics["mse_255"] for row in rows if row.case == "quality" and "spp" in row.params}
    assert errors[denoising.OURS] < 0.3 * errors["unfiltered"]
    final = {row.variant: row.metrics for row in rows if row.case == "final"}
    assert final["ratio"]["mse_255_direct"] < final["plain"]["mse_255_direct"]
    for metrics in final.values():
        assert 0.0 < metrics["mse_255_indirect"] < metrics["mse_255"]


@pytest.mark.data
def test_pictures_are_there(made):
    rows, folder = made
    for row in rows:
        if row.case == "figures":
            with PIL.Image.open(folder / f"{row.variant}.png") as picture:
                assert picture.width > row.params["width"]


@pytest.mark.data
def test_renders_are_kept(made, monkeypatch):
    _, folder = made
    assert {"cornell_64x48_noisy_1_0.npz", "cornell_64x48_reference_16_977.npz", "cornell_64x48_smooth_16_978.npz"} <= {
        file.name for file in folder.iterdir()
    }
    monkeypatch.setattr(path_renders, "FOLDER", folder)
    monkeypatch.setattr(path_renders, "trace_guides", None)
    assert path_renders.load_guides("cornell", height=48, width=64, spp=1, seed=0).incident.any()
