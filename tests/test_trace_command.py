"""`jaxrender trace`: its files, what `denoise` reads of them, progress, frames, and its manners."""

import json

import numpy as np
import pytest

from jaxrender import cli, trace_command
from jaxrender.io import read_exr_layers, write_exr
from jaxrender.io.aovs import read_layered_file
from jaxrender.io.picture import read_png
from tests.io.test_animated_scene import stage

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
    assert "mannequin: no lights, a sun and a sky were added (--environment takes a map instead)" in err
    assert "rays: Embree" in err
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


def test_numbers_go_into_the_name_of_the_file_alone(folder, capsys):
    """Not into that of its folder; and a seed is checked before anything is built."""
    frames = ["--frames", "1", *SMALL]
    assert cli.main(["trace", "-o", "take#1/t.png", *frames]) == 0
    assert [str(path.relative_to(folder)) for path in folder.glob("take*/*")] == ["take#1/t.png"]
    assert cli.main(["trace", "-o", "take#1/u.png", "--frames", "2", "--new-seeds", *SMALL]) == 0
    assert {path.name for path in folder.glob("take#1/u*")} == {"u.0001.png", "u.0002.png"}
    capsys.readouterr()
    assert cli.main(["trace", "--seed", "99999999999", *SMALL]) == 2
    assert "--seed: expected a number from 0 to 2147483647" in capsys.readouterr().err


def test_rays_by_the_tree(folder, capsys):
    """The same picture, and the command says who traces; no bounces and no filter, so that little is compiled."""
    plain = ["--size", "16", "12", "--spp", "1", "--bounces", "0", "--direct", "plain"]
    pictures = []
    for rays, told in (("embree", "rays: Embree, "), ("jax", "rays: tree in JAX, cpu")):
        assert cli.main(["trace", "-o", f"{rays}.png", "--rays", rays, *plain]) == 0
        assert told in capsys.readouterr().err
        pictures.append(read_png(folder / f"{rays}.png"))
    assert (np.abs(pictures[0] - pictures[1]) < 0.01).all(axis=-1).mean() > 0.98


def test_a_clip_is_played_and_its_flicker_told(folder, capsys):
    """The second frame of the animation is the picture of its time; materials are kept, and the ground is under it."""
    (folder / "stage.glb").write_bytes(stage().glb())
    play = ["trace", "stage.glb", "--clip", "turn", "--ground", "--eye", "4", "5", "7", "--json", *SMALL]
    assert cli.main([*play, "-o", "a.png", "--frames", "2", "--fps", "2"]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["paths"] == ["a.0001.png", "a.0002.png"] and record["clip"] == "turn" and record["triangles"] == 8
    assert "stage: clip turn, 1.00 s; 2 frames" in err
    (flicker,), (share,), seconds = (record[name] for name in ("flicker_rms_255", "seen_in_both", "seconds"))
    assert 0.0 < flicker < 100.0 and 0.1 < share < 1.0 and len(seconds) == 2
    assert f"flicker {flicker:.2f} of 255" in err
    first, second = (read_png(folder / f"a.000{k}.png") for k in (1, 2))
    # Seeds are the same: what differs has moved.
    assert np.abs(first - second).mean() > 2e-4


def test_light_turns_and_new_seeds_flicker(folder, capsys):
    """Shadows wander with the sun; a still scene flickers by its seeds only."""
    view = ["--eye", "1.5", "1.2", "2.5", "--target", "0", "0.9", "0", "--json", *SMALL]
    assert cli.main(["trace", "-o", "s.png", "--frames", "2", "--turn-light-degrees", "180", *view]) == 0
    turned = json.loads(capsys.readouterr().out)
    assert cli.main(["trace", "-o", "n.png", "--frames", "2", "--new-seeds", *view]) == 0
    still = json.loads(capsys.readouterr().out)
    assert turned["flicker_rms_255"][0] > 2.0 * still["flicker_rms_255"][0] > 0.0
    assert "clip" not in still


def test_frames_that_are_finished_stay(folder, capsys, monkeypatch):
    """Ctrl-C in the second frame: exit status 130, and what there is."""
    whole = trace_command.render

    def interrupted(*args, **options):
        if (folder / "k.0001.png").exists():
            raise KeyboardInterrupt
        return whole(*args, **options)

    monkeypatch.setattr(trace_command, "render", interrupted)
    assert cli.main(["trace", "-o", "k.png", "--frames", "3", "--orbit-degrees", "90", *SMALL]) == 130
    assert "interrupted; 1 of 3 frames are finished and stay" in capsys.readouterr().err
    assert sorted(path.name for path in folder.glob("k*")) == ["k.0001.png"]


def test_what_is_too_large_or_not_light_is_one_line(folder, capsys, monkeypatch):
    """More triangles than memory, and a map with NaN: exit status 2; a scene without light is offered a map."""
    image = np.ones((4, 8, 3), np.float32)
    image[0, 0, 0], image[1, 1, 1] = np.nan, -1.0
    write_exr(folder / "sky.exr", {"": image})
    assert cli.main(["trace", "--environment", "sky.exr", *SMALL]) == 2
    got = "expected finite values of at least 0, got 1 NaN or Inf and 1 negative ones"
    assert f"sky.exr: radiance: {got}" in capsys.readouterr().err
    monkeypatch.setattr("jaxrender.machine.available_memory", lambda: 10**6)
    assert cli.main(["trace", *SMALL]) == 2
    (line,) = [text for text in capsys.readouterr().err.splitlines() if text.startswith("jaxrender: error")]
    assert "not enough memory: 11794 triangles: about" in line and line.endswith("GB available")


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--spp", "0"], "--spp: expected a value >= 1, got 0"),
        (["--bounces", "99"], "--bounces: expected at most 64, got 99"),
        (["--time", "0"], "--time: expected a finite number above 0, got 0.0"),
        (
            ["--frames", "3"],
            "--frames: expected --clip, --orbit-degrees, --turn-light-degrees or --new-seeds beside it",
        ),
        (["--orbit-degrees", "nan"], "--orbit-degrees: expected a finite number, got nan"),
        (["--clip", "0", "--fps", "0"], "--fps: expected a finite number above 0, got 0.0"),
        (["--clip", "0", "--start-seconds", "-1"], "--start-seconds: expected a finite number >= 0, got -1.0"),
        (["--clip", "fly"], "mannequin: clip: expected one of walk"),
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
