"""The commands from end to end on a small skinned GLB, and the example of the README as it is printed."""

import json
import pathlib
import re
import shutil

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import load_file, save_file

import jaxrender.io
from fitting.cli import main
from fitting.model import MODEL_FILE, find_model
from jaxrender.io import read_exr
from jaxrender.io.builtin_scene import builtin_scene

README = pathlib.Path(__file__).resolve().parents[2] / "README.md"
SMALL = [
    "--bake.max-points", "80", "--bake.max-frames", "24", "--bake.num-mixed", "4", "--bake.num-directions", "64",
    "--fit.num-components", "6", "--fit.refine-steps", "6", "--no-study",
]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory, shared_data):
    """A folder with a character and a trained model, as a user has it."""
    folder = tmp_path_factory.mktemp("user")
    shutil.copy(shared_data / "characters" / "CesiumMan.glb", folder / "character.glb")
    shutil.copy(shared_data / "hdri" / "venice_sunset_1k.hdr", folder / "sky.hdr")
    assert main(["train", str(folder / "character.glb"), "-o", str(folder / "out" / "run"), *SMALL]) == 0
    return folder


def printed(capsys):
    return json.loads(capsys.readouterr().out)


def test_train_writes_what_it_says(run):
    out = run / "out" / "run"
    assert {MODEL_FILE, "report.html", "evaluation.json", "diffuse.png", "film.webp"} <= {p.name for p in out.iterdir()}
    page = (out / "report.html").read_text()
    assert not re.search(r'(src|href)="(https?:|//)', page)
    # Six components, as asked for, in the page's table of facts.
    assert re.search(r"pose components\D*>6<", page)
    _, header, _ = find_model(out)
    assert header["source"]["input"] == str((run / "character.glb").resolve())
    assert header["errors"]["train"] < 0.3 and "seconds" not in header
    assert {"bake", "evaluate", "pictures"} <= set(json.loads((out / "times.json").read_bytes())["seconds"])
    assert not (out / "unfinished").exists() and not list(out.glob(".*"))


def test_evaluate_measures_the_model_in_the_file(run, tmp_path, capsys):
    """A model spoiled on purpose is found out, and left as it is."""
    shutil.copytree(run / "out" / "run", tmp_path / "run")
    file = tmp_path / "run" / MODEL_FILE
    _, header, _ = find_model(file)
    before = {path: path.stat().st_mtime_ns for path in file.parent.rglob("*")}
    assert main(["evaluate", str(tmp_path / "run"), "-o", str(tmp_path / "again"), "--no-study", "--json"]) == 0
    assert printed(capsys)["errors"]["train"] == pytest.approx(header["errors"]["train"], rel=1e-4)
    assert (tmp_path / "again" / "report.html").is_file()
    assert before == {path: path.stat().st_mtime_ns for path in file.parent.rglob("*")}
    arrays = load_file(file)
    arrays["weights"][:] = 0.0
    arrays["offset"][:] = 0.0
    save_file(arrays, file, metadata={"header": json.dumps(header)})
    before = file.read_bytes()
    assert main(["evaluate", str(tmp_path / "run"), "--no-study", "--json"]) == 0
    assert printed(capsys)["errors"]["train"] == pytest.approx(1.0, abs=1e-3)
    assert file.read_bytes() == before


def test_relight_draws_frames_a_film_and_exr(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["relight", str(run / "out" / "run"), "--environment", str(run / "sky.hdr"), "-o", str(tmp_path / "film")]
    assert main([*command, "--size", "48", "64", "--fps", "4", "--exr", "--json"]) == 0
    paths = sorted((tmp_path / "film").iterdir())
    assert {pathlib.Path(p) for p in printed(capsys)["paths"]} <= set(paths)
    frames = [p for p in paths if p.suffix == ".png"]
    assert len(frames) > 4
    for path in frames:
        with Image.open(path) as image:
            assert image.size == (48, 64)
            assert np.ptp(np.asarray(image).astype(int)) > 60
    (first, *_) = [p for p in paths if p.suffix == ".exr"]
    assert np.isfinite(read_exr(first)).all()


def test_relight_finds_the_character_beside_the_model(run, tmp_path, capsys):
    shutil.copytree(run / "out" / "run", tmp_path / "run")
    file = tmp_path / "run" / MODEL_FILE
    _, header, _ = find_model(file)
    header["source"]["input"] = "/nowhere/character.glb"
    save_file(load_file(file), file, metadata={"header": json.dumps(header)})
    command = ["relight", str(tmp_path / "run"), "-o", str(tmp_path / "film"), "--size", "32", "32", "--fps", "1"]
    assert main(command) == 2
    assert "source.input: expected /nowhere/character.glb" in capsys.readouterr().err
    shutil.copy(run / "character.glb", tmp_path / "run")
    assert main(command) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h, a: h.pop("source"), "source.name: expected str, got nothing"),
        (lambda h, a: h.update(source="x"), "source.name: expected str, got nothing"),
        (lambda h, a: h["source"].update(num_vertices="many"), "source.num_vertices: expected int, got 'many'"),
        (lambda h, a: h.pop("ridge"), "ridge: expected int or float, got nothing"),
        (lambda h, a: a.update({"features.joints": a["features.joints"] + 500}), "features.joints: expected indices"),
        (lambda h, a: a.update({"points": a["points"][:-1]}), "points: expected 3273 entries, one a vertex, got 3272"),
        (lambda h, a: h["source"].update(content_hash="0" * 64), "character: expected the character of hash 0000"),
    ],
)
def test_a_model_that_does_not_fit_is_refused_in_one_line(run, tmp_path, capsys, change, words):
    file = tmp_path / MODEL_FILE
    shutil.copy(run / "out" / "run" / MODEL_FILE, file)
    _, header, _ = find_model(file)
    arrays = load_file(file)
    change(header, arrays)
    save_file(arrays, file, metadata={"header": json.dumps(header)})
    assert main(["relight", str(file), "-o", str(tmp_path / "film")]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "expected" in line]
    assert words in line
    assert not (tmp_path / "film").exists() or not list((tmp_path / "film").iterdir())


def test_the_readme_examples_run_as_printed(run, monkeypatch):
    relit, raster, whole, adaptive, filters, traced = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.S)
    monkeypatch.chdir(run)
    names: dict = {}
    exec(raster, names)
    assert names["values"].shape == names["duv_dx"].shape == (64, 64, 4, 2)
    # The scene is the built-in one, and the picture small.
    monkeypatch.setattr(jaxrender.io, "load_scene", lambda _: builtin_scene(num_vertices=1500))
    exec(whole.replace('{"height": 768, "width": 1024}', '{"height": 36, "width": 48}'), names)
    assert names["picture"].shape == (36, 48, 3) and names["picture"].max() > 0.05
    assert read_exr(run / "gbuffer.exr", layer="normal").shape == (36, 48, 3)
    exec(adaptive, names)
    assert names["picture"].image.shape == names["next_frame"].image.shape == (36, 48, 3)
    assert names["first"].sample_share <= 0.2
    exec(filters, names)
    assert names["clean"].shape == names["result"].image.shape == (36, 48, 3)
    exec(traced.replace("height=768, width=1024", "height=36, width=48"), names)
    assert names["traced"].image.shape == (36, 48, 3) and names["traced"].image.max() > 0.05
    exec(relit, names)
    positions, colors = np.asarray(names["positions"]), np.asarray(names["colors"])
    assert positions.shape == colors.shape == (3273, 3)
    assert np.isfinite(colors).all() and colors.max() > 0.05
