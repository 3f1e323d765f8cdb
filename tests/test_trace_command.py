"""`jaxrender trace`: its files, what `denoise` reads of them, progress, frames, and its manners."""

import json

import numpy as np
import pytest

from jaxrender import cli
from jaxrender.io import read_exr_layers
from jaxrender.io.aovs import read_layered_file
from jaxrender.io.picture import read_png

SMALL = ["--size", "40", "30", "--spp", "1", "--bounces", "1"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_picture_parts_and_noisy_layers(folder, capsys):
    """Parts add up; the noisy file has what the denoiser looks for, and the denoiser takes it."""
    assert cli.main(["trace", "-o", "a.png", "--exr", "--json", *SMALL]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["paths"] == ["a.png", "a.exr", "a.noisy.exr"] and record["method"] == "guided" and record["spp"] == 1
    assert "rays: Embree" in err and "mannequin: no lights, a sun and a sky were added" in err
    picture = read_png(folder / "a.png")
    assert picture.shape == (30, 40, 3) and 0.05 < picture.mean() < 0.95
    clean = read_exr_layers(folder / "a.exr")
    total = clean["direct"] + clean["indirect"] + clean["emission"]
    np.testing.assert_allclose(clean[""], total, rtol=1e-5, atol=1e-6)
    noisy = read_layered_file(folder / "a.noisy.exr").layers
    np.testing.assert_allclose(noisy[""], noisy["direct"] + noisy["indirect"] + noisy["emission"], rtol=1e-5, atol=1e-6)
    assert noisy["ao"].shape == noisy["normal"].shape == (30, 40, 3) and noisy["depth"].shape == (30, 40, 1)
    assert cli.main(["denoise", "a.noisy.exr", "-o", "b.exr", "--spp", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["chosen"]["method"] == "guided"
    again = read_exr_layers(folder / "b.exr")
    # Direct light is left as it is; the indirect light is filtered by the same rule.
    np.testing.assert_allclose(again["direct"], noisy["direct"], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(again["indirect"].mean(), clean["indirect"].mean(), rtol=0.1)


def test_frames_go_round_and_time_is_kept(folder, capsys):
    view = ["--eye", "1.5", "1.2", "2.5", "--target", "0", "0.9", "0"]
    assert cli.main(["trace", "-o", "f.png", "--frames", "2", "--orbit-degrees", "180", *view, *SMALL]) == 0
    assert capsys.readouterr().out.splitlines() == ["wrote f.0001.png", "wrote f.0002.png"]
    first, second = (read_png(folder / f"f.000{k}.png") for k in (1, 2))
    assert np.abs(first - second).mean() > 0.01
    assert cli.main(["trace", "-o", "t.png", "--time", "0.01", *view, *SMALL]) == 0
    err = capsys.readouterr().err
    assert "1 samples a pixel" in err and (folder / "t.png").is_file()


def test_rays_by_the_tree(folder, capsys):
    """The same picture, and the command says who traces; no bounces and no filter, so that little is compiled."""
    plain = ["--size", "16", "12", "--spp", "1", "--bounces", "0", "--direct", "plain"]
    pictures = []
    for rays, told in (("embree", "rays: Embree, "), ("jax", "rays: tree in JAX, cpu")):
        assert cli.main(["trace", "-o", f"{rays}.png", "--rays", rays, *plain]) == 0
        assert told in capsys.readouterr().err
        pictures.append(read_png(folder / f"{rays}.png"))
    assert (np.abs(pictures[0] - pictures[1]) < 0.01).all(axis=-1).mean() > 0.98


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--spp", "0"], "--spp: expected a value >= 1, got 0"),
        (["--bounces", "99"], "--bounces: expected at most 64, got 99"),
        (["--time", "0"], "--time: expected a finite number above 0, got 0.0"),
        (["--frames", "3"], "--orbit-degrees: expected a number that is not 0 with --frames, got 0.0"),
        (["--time", "5", "--frames", "2", "--orbit-degrees", "9"], "--time: expected it without --frames"),
        (["-o", "a.jpg"], "-o: a.jpg: expected a name ending in .png, got .jpg"),
        (["no.gltf"], "no.gltf"),
        (["--environment", "no.hdr"], "no.hdr"),
        (["--camera", "3"], "--camera"),
    ],
)
def test_bad_input_is_one_line(folder, capsys, options, line):
    assert cli.main(["trace", "--size", "8", "6", *options]) == 2
    err = capsys.readouterr().err.splitlines()
    (found,) = [text for text in err if text.startswith("jaxrender: error:")]
    assert line in found and "Traceback" not in "".join(err)
