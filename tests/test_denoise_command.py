"""`jaxrender denoise`: which images it takes, what it writes and says, frames, bad input. Not how well it filters.

Most of it runs with a mean over 3 x 3 pixels in place of the filters, so that what is expected is easy to say.
"""

import html.parser
import json
import re
import struct

import numpy as np
import OpenEXR
import pytest

from jaxrender import cli, console, denoise_command, denoise_inputs, denoise_page
from jaxrender.io import read_exr_layers, write_exr
from jaxrender.io.exr import read_exr_header
from jaxrender.io.picture import read_png

HEIGHT, WIDTH = 24, 32


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    monkeypatch.delenv(console.DEBUG_VARIABLE, raising=False)
    monkeypatch.setattr(console, "enable_compilation_cache", lambda: None)


@pytest.fixture
def calls(monkeypatch):
    """The mean in place of the filter; gives the list of what it was called with."""
    called = []

    def stand_in(aovs, settings):
        called.append((aovs, settings))
        parts = {name: mean3(getattr(aovs, name)) for name in ("direct", "indirect") if aovs.indirect is not None}
        if parts and aovs.emission is not None:
            parts["emission"] = np.asarray(aovs.emission)
        image = sum(parts.values()) if parts else mean3(aovs.color)
        broken = int((~np.isfinite(aovs.color)).any(axis=-1).sum())
        counts = {"nan": broken, "negative": 2, "clamped": 3, "filled": broken, "raised": 4}
        return denoise_command.Denoised(
            image, parts, counts, {"method": settings.method, "radius": settings.radius or 5, "eps": 0.5}
        )

    monkeypatch.setattr(denoise_command, "denoise", stand_in)
    return called


def mean3(image):
    image = np.nan_to_num(np.asarray(image), posinf=0.0)
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    return sum(padded[y : y + len(image), x : x + image.shape[1]] for y in range(3) for x in range(3)) / np.float32(9)


def image(rng, count=3, size=(HEIGHT, WIDTH)):
    return rng.uniform(0.1, 1.0, (*size, count)).astype(np.float32)


def picture_layers(rng):
    """A picture with alpha, and guides."""
    return {
        "": image(rng, 4), "albedo": image(rng), "N": image(rng), "Z": image(rng, 1), "Variance": image(rng),
        "id": rng.integers(0, 2**32, (HEIGHT, WIDTH, 1), dtype=np.uint32),
    }  # fmt: skip


def run(capsys, *arguments, status=0):
    """Runs the command; gives standard output and standard error."""
    assert cli.main(["denoise", *map(str, arguments)]) == status, capsys.readouterr().err
    return capsys.readouterr()


def fails(capsys, *arguments):
    """Runs the command, which must end with status 2 and one line; gives the line."""
    out, err = run(capsys, *arguments, status=2)
    errors = [line for line in err.splitlines() if line.startswith("jaxrender: error: ")]
    assert out == "" and len(errors) == 1 and "Traceback" not in err, err
    return errors[0].removeprefix("jaxrender: error: ")


# --- One picture


def test_picture_layers_and_files(tmp_path, capsys, rng, calls):
    layers = picture_layers(rng)
    layers["Z"][0, 0], layers["Z"][0, 1] = np.inf, 1e10
    write_exr(tmp_path / "noisy.exr", layers)
    record = json.loads(run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "a" / "clean.exr", "--json").out)
    assert record["paths"] == [str(tmp_path / "a" / f"clean.{kind}") for kind in ("exr", "png", "html")]
    assert record["counts"] == {"nan": 0, "negative": 2, "clamped": 3, "filled": 0, "raised": 4}
    assert record["chosen"]["radius"] == 5 and record["separate"] == []
    assert record["layers"] == {
        "color": "noisy.exr: RGB", "normal": "noisy.exr: N", "depth": "noisy.exr: Z", "albedo": "noisy.exr: albedo",
    }  # fmt: skip
    back = read_exr_layers(tmp_path / "a" / "clean.exr")
    np.testing.assert_allclose(back[""][..., :3], mean3(layers[""][..., :3]), rtol=1e-6)
    np.testing.assert_array_equal(back[""][..., 3], layers[""][..., 3])
    assert back.keys() == layers.keys()
    for name in ("albedo", "N", "Z", "Variance", "id"):
        np.testing.assert_array_equal(back[name], layers[name])
    assert read_png(tmp_path / "a" / "clean.png").shape == (HEIGHT, WIDTH, 3)
    ((aovs, settings),) = calls
    assert set(aovs.given()) == {"color", "normal", "depth", "albedo"}
    np.testing.assert_array_equal(aovs.depth, layers["Z"])
    assert settings == denoise_command.DenoiseSettings(samples_per_pixel=None)


def test_options_become_settings(tmp_path, capsys, rng, calls):
    write_exr(tmp_path / "noisy.exr", picture_layers(rng))
    arguments = ["--method", "atrous", "--radius", "3", "--eps", "2", "--spp", "8", "--firefly", "off", "--auto"]
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "c.exr", "--no-demodulate", *arguments)
    assert calls[0][1] == denoise_command.DenoiseSettings(
        method="atrous", radius=3, eps=2.0, samples_per_pixel=8.0, auto=True, firefly_factor=None, demodulate=False
    )


def test_all_light_and_lamps_by_option(tmp_path, capsys, rng, calls):
    write_exr(tmp_path / "noisy.exr", picture_layers(rng))
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "c.exr", "--whole", "--no-keep-lamps")
    assert calls[0][1] == denoise_command.DenoiseSettings(whole=True, keep_lamps=False)


def test_samples_come_from_the_file_unless_told(tmp_path, capsys, rng, calls):
    planes = {name: image(rng, 1)[..., 0] for name in ("R", "G", "B", "N.X", "N.Y", "N.Z")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "samplesPerPixel": 16}
    OpenEXR.File(header, planes).write(str(tmp_path / "noisy.exr"))
    for arguments in ([], ["--spp", "4"]):
        run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "c.exr", *arguments)
    assert [settings.samples_per_pixel for _, settings in calls] == [16.0, 4.0]


def test_images_of_other_files_by_option(tmp_path, capsys, rng, calls):
    files = {"color": image(rng, 4), "normals": {"x": image(rng), "y": image(rng)}, "depths": image(rng, 1)}
    for name, layers in files.items():
        write_exr(tmp_path / f"{name}.exr", layers)
    options = {"--color": "color.exr", "--normal": "normals.exr:y", "--depth": "depths.exr", "--ao": "normals.exr:x"}
    arguments = [part for name, file in options.items() for part in (name, tmp_path / file)]
    record = json.loads(run(capsys, *arguments, "-o", tmp_path / "clean.exr", "--json").out)
    aovs = calls[0][0]
    np.testing.assert_array_equal(aovs.normal, files["normals"]["y"])
    np.testing.assert_array_equal(aovs.depth, files["depths"])
    np.testing.assert_array_equal(aovs.ao, files["normals"]["x"])
    assert record["layers"]["normal"] == "normals.exr: y" and set(read_exr_layers(tmp_path / "clean.exr")) == {""}


def test_a_layer_of_blender_keeps_its_channels(tmp_path, capsys, rng, calls):
    """The picture becomes the nameless layer; what else is in the file keeps its channels' names."""
    names = ["Combined.R", "Combined.G", "Combined.B", "Combined.A", "Normal.X", "Normal.Y", "Normal.Z", "Depth.Z"]
    planes = {f"ViewLayer.{name}": image(rng, 1)[..., 0] for name in names}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, dict(planes)).write(
        str(tmp_path / "noisy.exr")
    )
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
    (part,) = read_exr_header(tmp_path / "clean.exr")
    assert set(part.channels) == {*"RGBA", *(f"ViewLayer.{name}" for name in names[4:])}
    np.testing.assert_array_equal(read_exr_layers(tmp_path / "clean.exr")[""][..., 3], planes["ViewLayer.Combined.A"])


def test_the_noisy_one_of_two_pictures_is_filtered(tmp_path, capsys, rng, calls):
    layers = {"": image(rng), "Noisy Image": image(rng, 4), "Normal": image(rng)}
    write_exr(tmp_path / "noisy.exr", layers)
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
    np.testing.assert_array_equal(calls[0][0].color, layers["Noisy Image"][..., :3])
    assert set(read_exr_layers(tmp_path / "clean.exr")) == {"", "Normal"}


def test_a_gray_picture_stays_gray(tmp_path, capsys, rng, calls):
    gray = image(rng, 1)
    write_exr(tmp_path / "noisy.exr", {"": gray, "N": image(rng)})
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
    assert calls[0][0].color.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(read_exr_layers(tmp_path / "clean.exr")[""], mean3(gray), rtol=1e-6)


@pytest.mark.parametrize("channel", ["Y", "R", "G"])
def test_a_lone_channel_keeps_its_name(tmp_path, capsys, rng, calls, channel):
    planes = {name: image(rng, 1)[..., 0] for name in (channel, "N.X", "N.Y", "N.Z")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict(planes)).write(str(tmp_path / "noisy.exr"))
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
    (part,) = read_exr_header(tmp_path / "clean.exr")
    assert set(part.channels) == set(planes)


def test_the_header_stays(tmp_path, capsys, rng, calls):
    """A crop of a larger picture stays where it was, pixels keep their shape, and notes of the renderer stay."""
    window = tuple(np.array(corner, np.int32) for corner in ((10, 12), (10 + WIDTH - 1, 12 + HEIGHT - 1)))
    display = tuple(np.array(corner, np.int32) for corner in ((0, 0), (63, 47)))
    header = {
        "compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage, "dataWindow": window,
        "displayWindow": display, "pixelAspectRatio": 2.0, "cryptomatte/abc/manifest": "{}", "owner": "somebody",
    }  # fmt: skip
    planes = {name: image(rng, 1)[..., 0] for name in ("R", "G", "B", "N.X", "N.Y", "N.Z")}
    OpenEXR.File(header, planes).write(str(tmp_path / "noisy.exr"))
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
    with OpenEXR.File(str(tmp_path / "clean.exr"), header_only=True) as file:
        back = dict(file.header(0))
    np.testing.assert_array_equal(back["dataWindow"], window)
    np.testing.assert_array_equal(back["displayWindow"], display)
    assert back["pixelAspectRatio"] == 2.0 and back["cryptomatte/abc/manifest"] == "{}"
    assert back["owner"] == "somebody" and back["compression"] == OpenEXR.ZIP_COMPRESSION


# --- Light in parts


def test_parts_add_up_and_take_their_places(tmp_path, capsys, rng, calls):
    direct, indirect, emission = image(rng), image(rng), image(rng)
    layers = {"": direct + indirect + emission, "direct": direct, "indirect": indirect, "emission": emission}
    write_exr(tmp_path / "noisy.exr", {**layers, "N": image(rng)})
    record = json.loads(run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr", "--json").out)
    back = read_exr_layers(tmp_path / "clean.exr")
    assert record["separate"] == ["direct", "emission", "indirect"] and set(back) == {*layers, "N"}
    np.testing.assert_allclose(back["direct"] + back["indirect"] + back["emission"], back[""], rtol=1e-6)
    np.testing.assert_allclose(back["indirect"], mean3(indirect), rtol=1e-6)
    np.testing.assert_array_equal(back["emission"], emission)


def test_lobes_become_parts(tmp_path, capsys, rng, calls):
    layers = {f"V.{lobe}{kind}": image(rng) for lobe in ("Diff", "Gloss") for kind in ("Dir", "Ind", "Col")}
    layers |= {"V.Emit": image(rng), "V.Env": image(rng), "V.Normal": image(rng)}
    light = {kind: sum(layers[f"V.{lobe}{kind}"] * layers[f"V.{lobe}Col"] for lobe in ("Diff", "Gloss"))
             for kind in ("Dir", "Ind")}  # fmt: skip
    layers["V.Combined"] = light["Dir"] + light["Ind"] + layers["V.Emit"] + layers["V.Env"]
    write_exr(tmp_path / "noisy.exr", layers)
    run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
    aovs, back = calls[0][0], read_exr_layers(tmp_path / "clean.exr")
    np.testing.assert_allclose(aovs.albedo, layers["V.DiffCol"] + layers["V.GlossCol"], rtol=1e-6)
    np.testing.assert_allclose(back["indirect"], mean3(light["Ind"]), rtol=1e-5)
    np.testing.assert_allclose(back["direct"] + back["indirect"] + back["emission"], back[""], rtol=1e-5)
    np.testing.assert_array_equal(back["V.DiffInd"], layers["V.DiffInd"])


def test_parts_that_do_not_add_up_are_left_alone(tmp_path, capsys, rng, calls):
    layers = {"": image(rng), "direct": image(rng), "indirect": image(rng), "N": image(rng)}
    write_exr(tmp_path / "noisy.exr", layers)
    err = run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr").err
    (line,) = [line for line in err.splitlines() if "do not add up" in line]
    assert line.startswith("noisy.exr: direct and indirect light do not add up to the picture (at 100 %")
    assert calls[0][0].indirect is None
    np.testing.assert_array_equal(read_exr_layers(tmp_path / "clean.exr")["indirect"], layers["indirect"])


def test_indirect_light_alone_leaves_a_direct_rest(tmp_path, capsys, rng, calls):
    picture, indirect = image(rng) + 1.0, image(rng)
    write_exr(tmp_path / "noisy.exr", {"": picture, "N": image(rng)})
    write_exr(tmp_path / "gi.exr", indirect)
    run(capsys, tmp_path / "noisy.exr", "--indirect", tmp_path / "gi.exr", "-o", tmp_path / "clean.exr")
    np.testing.assert_allclose(calls[0][0].direct, picture - indirect, rtol=1e-6)
    assert set(read_exr_layers(tmp_path / "clean.exr")) == {"", "N", "direct", "indirect"}


# --- What it says, and how it stores


def test_broken_pixels_are_counted_on_standard_error(tmp_path, capsys, rng, calls):
    layers = picture_layers(rng)
    layers[""][2, 3, 0], layers[""][4, 5] = np.nan, np.inf
    write_exr(tmp_path / "noisy.exr", layers)
    out, err = run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
    told = "2 NaN or Inf, 2 negative, 3 clamped as fireflies, 2 filled in, 4 below 0 after the filter and set to 0"
    assert f"noisy.exr: of the pixels {told}\n" in err
    assert "noisy.exr: method guided, radius 5, eps 0.5\n" in err
    assert out.splitlines() == [f"wrote {tmp_path / 'clean'}.{kind}" for kind in ("exr", "png", "html")]


def test_half_floats_are_clamped_and_counted(tmp_path, capsys, rng, calls):
    layers = picture_layers(rng)
    layers["Z"][0, 0], layers["Z"][0, 1], layers["Z"][0, 2] = 1e10, np.inf, -1e6
    layers[""][5:8, 5:8, :3] = 1e6
    write_exr(tmp_path / "noisy.exr", layers)
    err = run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr", "--half").err
    large = (mean3(layers[""][..., :3]) > 65504).any(axis=-1)
    assert f"warning: noisy.exr: {large.sum() + 2} pixels too large for half floats, clamped to 65504\n" in err
    back = read_exr_layers(tmp_path / "clean.exr")
    assert (back[""][large][..., :3] <= 65504).all() and back[""].max() == 65504
    assert back["Z"][0, :3, 0].tolist() == [65504, np.inf, -65504]
    with OpenEXR.File(str(tmp_path / "clean.exr"), separate_channels=True) as file:
        assert {c.pixels.dtype.name for c in file.channels().values()} == {"float16", "uint32"}


class Page(html.parser.HTMLParser):
    """Tags and text; complains about tags that do not close."""

    def __init__(self, source):
        super().__init__()
        self.tags, self.text, self.open = [], "", []
        self.feed(source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_the_page_shows_before_and_after_and_loads_nothing(tmp_path, capsys, rng, calls):
    write_exr(tmp_path / "<b>.exr", picture_layers(rng))
    run(capsys, tmp_path / "<b>.exr", "-o", tmp_path / "clean.exr")
    page = Page((tmp_path / "clean.html").read_text())
    images = [attributes for tag, attributes in page.tags if tag == "img"]
    assert [picture["alt"] for picture in images] == ["after", "before", "Before", "After"]
    assert all(picture["src"].startswith("data:image/") for picture in images)
    labels = {attributes["for"] for tag, attributes in page.tags if tag == "label"}
    assert {attributes["id"] for tag, attributes in page.tags if tag == "input"} == labels and len(labels) == 3
    assert not {tag for tag, _ in page.tags} & {"script", "link", "b"}
    for text in ("<b>.exr, 32 x 24 pixels", "radius", "clamped as fireflies", "<b>.exr: albedo"):
        assert text in page.text


def test_details_are_where_the_change_is():
    size = denoise_page.DETAIL_PX
    before = np.zeros((2 * size, 3 * size + 5, 3), np.uint8)
    after = before.copy()
    after[size + 3, 2 * size + 9], after[1, 1] = 200, 100
    assert denoise_page.find_details(before, after)[:2] == [(size, 2 * size), (0, 0)]
    assert denoise_page.find_details(before[:9, :1], after[:9, :1]) == [(0, 0)]


def test_large_pictures_are_shown_smaller(rng, monkeypatch):
    monkeypatch.setattr(denoise_page, "MAX_SIDE", 16)
    page = denoise_page.BeforeAfterPage("x")
    denoise_page.add_comparison(page, image(rng), image(rng))
    assert "max-width:640px;aspect-ratio:16/12" in page.html()


@pytest.mark.slow
def test_the_built_in_picture(tmp_path, capsys, calls, monkeypatch):
    """Without a file, a noisy picture is traced, the same each time; the filter is told of how many samples."""
    monkeypatch.setattr(denoise_command, "BUILTIN_SIZE", (HEIGHT, WIDTH))
    for _ in range(2):
        err = run(capsys, "-o", tmp_path / "clean.exr").err
        assert "the built-in picture: of the pixels 0 NaN or Inf" in err
    (aovs, settings), (again, _) = calls
    assert set(aovs.given()) == {"color", "albedo", "normal", "depth", "position", "ao"}
    np.testing.assert_array_equal(aovs.color, again.color)
    assert settings.samples_per_pixel == denoise_inputs.BUILTIN_SAMPLES
    assert read_exr_layers(tmp_path / "clean.exr")[""].shape == (HEIGHT, WIDTH, 3)
    seen = aovs.depth[..., 0] > 0
    assert 0.1 < seen.mean() < 0.9
    np.testing.assert_allclose(np.linalg.norm(aovs.normal, axis=-1), seen, atol=1e-5)
    assert (aovs.albedo[seen] > 0.05).all() and (aovs.color[~seen].max(axis=-1) > 0.0).any()


# --- Frames


def write_frames(folder, rng, frames):
    for frame in frames:
        write_exr(folder / f"noisy.{frame:04d}.exr", {"": image(rng), "N": image(rng)})


@pytest.mark.parametrize("pattern", ["####", "%04d"])
def test_frames(tmp_path, capsys, rng, calls, pattern):
    write_frames(tmp_path, rng, [1, 3, 4])
    write_exr(tmp_path / "depth.exr", image(rng, 1))
    arguments = ["--frames", "1,3-4", "--depth", tmp_path / "depth.exr", "--json"]
    out, err = run(capsys, tmp_path / f"noisy.{pattern}.exr", "-o", tmp_path / "o" / f"clean.{pattern}.exr", *arguments)
    record = json.loads(out)
    assert [frame["frame"] for frame in record["frames"]] == [1, 3, 4] and record["counts"]["clamped"] == 9
    assert "denoise: 3/3 frames in" in err and "3 frames: of the pixels 0 NaN" in err
    for number, (aovs, _) in zip((1, 3, 4), calls, strict=True):
        back = read_exr_layers(tmp_path / "o" / f"clean.{number:04d}.exr")
        np.testing.assert_allclose(back[""], mean3(aovs.color), rtol=1e-6)
        assert (tmp_path / "o" / f"clean.{number:04d}.png").exists()
    assert record["paths"][-1] == str(tmp_path / "o" / "clean.html")
    assert "noisy.0001.exr, frame 1, 32 x 24 pixels" in Page((tmp_path / "o" / "clean.html").read_text()).text


def test_a_number_is_added_to_the_output(tmp_path, capsys, rng, calls):
    write_frames(tmp_path, rng, [7])
    out = run(capsys, tmp_path / "noisy.####.exr", "-o", tmp_path / "c.exr", "--frames", "7").out
    assert [line.rpartition("/")[2] for line in out.splitlines()] == ["c.0007.exr", "c.0007.png", "c.html"]


def test_what_auto_chose_stays_for_all_frames(tmp_path, capsys, rng, calls):
    write_frames(tmp_path, rng, [1, 2])
    run(capsys, tmp_path / "noisy.####.exr", "-o", tmp_path / "c.####.exr", "--frames", "1-2", "--auto")
    first, second = (settings for _, settings in calls)
    assert (first.auto, first.radius, first.eps) == (True, None, None)
    assert (second.auto, second.radius, second.eps) == (False, 5, 0.5)


def test_what_the_rule_gave_stays_for_all_frames(tmp_path, capsys, rng, calls):
    """The first frame has light in all pixels, the second in few, by which the rule would choose another radius."""
    write_frames(tmp_path, rng, [1, 2])
    arguments = [tmp_path / "noisy.####.exr", "-o", tmp_path / "c.####.exr", "--frames", "1-2"]
    out, err = run(capsys, *arguments, "--json")
    assert [(settings.radius, settings.eps) for _, settings in calls] == [(None, None), (5, 0.5)]
    assert "noisy.0001.exr: method guided, radius 5, eps 0.5; radius and eps for all 2 frames\n" in err
    assert json.loads(out)["frames"][1]["chosen"]["how"] == "as frame 1"


def test_an_interrupt_keeps_frames_and_resume_goes_on(tmp_path, capsys, rng, calls, monkeypatch):
    write_frames(tmp_path, rng, [1, 2, 3])
    arguments = [tmp_path / "noisy.####.exr", "-o", tmp_path / "c" / "c.####.exr", "--frames", "1-3"]
    known = denoise_command.denoise

    def interrupted(aovs, settings):
        if len(calls) == 2:
            raise KeyboardInterrupt
        return known(aovs, settings)

    with monkeypatch.context() as patch:
        patch.setattr(denoise_command, "denoise", interrupted)
        err = run(capsys, *arguments, status=130).err
    words = "interrupted; 2 frames were written to "
    assert err.splitlines()[-1] == f"{words}{tmp_path / 'c'}; with --resume the same command goes on from there"
    assert sorted(path.name for path in (tmp_path / "c").glob("c.*")) == [
        "c.0001.exr", "c.0001.png", "c.0002.exr", "c.0002.png",
    ]  # fmt: skip
    err = run(capsys, *arguments, "--resume").err
    assert len(calls) == 3 and "denoise: 1 frames (2 of 3 are there already)" in err
    out, err = run(capsys, *arguments, "--resume")
    assert len(calls) == 3 and out == ""


def test_missing_frames_are_named_before_anything_is_done(tmp_path, capsys, rng, calls):
    write_frames(tmp_path, rng, [1, 4])
    line = fails(capsys, tmp_path / "noisy.####.exr", "-o", tmp_path / "c.####.exr", "--frames", "1-4")
    assert line == f"{tmp_path}/noisy.0002.exr: frames: expected files of 4 frames, got 2 (missing: 2, 3)"
    assert calls == [] and not list(tmp_path.glob("c.*"))


# --- Bad input


@pytest.fixture
def files(tmp_path, rng):
    """A folder of files that cannot be used, or not for everything."""
    write_exr(tmp_path / "good.exr", {"": image(rng), "N": image(rng), "mask": image(rng, 1)})
    write_exr(tmp_path / "small.exr", image(rng, size=(HEIGHT, WIDTH - 1)))
    write_exr(tmp_path / "plain.exr", {"": image(rng), "mask": image(rng, 1)})
    write_exr(tmp_path / "whole.exr", {"": np.ones((HEIGHT, WIDTH, 3), np.uint32), "N": image(rng)})
    write_exr(tmp_path / "no_picture.exr", {"N": image(rng), "Z": image(rng, 1)})
    write_exr(tmp_path / "only_depth.exr", {"Z": image(rng, 1)})
    for name in ("folder.exr", "pictures.png", "page.html"):
        (tmp_path / name).mkdir()
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "text.exr").write_text("not an image")
    data = (tmp_path / "good.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(data[: len(data) // 2])
    window = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    for name, side in (("vast", 100_000), ("large", 60_000)):
        forged = data[: window + 8] + struct.pack("<2i", side - 1, side - 1) + data[window + 16 :]
        (tmp_path / f"{name}.exr").write_bytes(forged)
    corners = {name: np.array(xy, np.int32) for name, xy in (("low", (0, 0)), ("high", (31, 23)), ("near", (8, 8)))}
    display = {"displayWindow": (corners["low"], corners["high"])}
    small = {"name": "N", "dataWindow": (corners["low"], corners["near"]), **display}
    parts = [
        OpenEXR.Part({"name": "a", **display}, {c: image(rng, 1)[..., 0] for c in "RGB"}),
        OpenEXR.Part(small, {c: image(rng, 1, (9, 9))[..., 0] for c in "XYZ"}),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    (tmp_path / "file").touch()
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["good.exr", "--normal", "small.exr"],
         r"small\.exr: layer '': expected 32 x 24 pixels as the picture \(good\.exr\), got 31 x 24 pixels"),
        (["parts.exr"], r"parts\.exr: layer 'N': expected 32 x 24 pixels as the picture .*, got 9 x 9 pixels"),
        (["plain.exr"], r"plain\.exr: layers: expected normals, depth or positions to go by .*, got '', 'mask'"),
        (["plain.exr", "--auto", "--method", "atrous"], "expected normals, depth or positions"),
        (["whole.exr"], r"whole\.exr: layer '': expected floating point \(color\), got integers \(uint32\)"),
        (["good.exr", "--normal", "whole.exr:"], r"whole\.exr: layer '': expected floating point \(normal\)"),
        (["picture.png"], r"picture\.png: content: expected an OpenEXR image of linear floating point, got PNG, integ"),
        (["good.exr", "--albedo", "picture.png"], r"picture\.png: content: expected an OpenEXR image"),
        (["text.exr"], r"text\.exr: first bytes: expected an OpenEXR file, got 6e 6f 74 20"),
        (["none.exr"], r"none\.exr: No such file or directory"),
        (["good.exr:nothing"], r"good\.exr: layers: expected a layer 'nothing', got '', 'N', 'mask'"),
        (["good.exr", "--depth", "good.exr:x"], r"good\.exr: layers: expected a layer 'x', got '', 'N', 'mask'"),
        (["good.exr", "--depth", "good.exr:N"], r"layer 'N': expected 1 channel, or 3 that are equal \(depth\)"),
        (["no_picture.exr"], r"no_picture\.exr: layers: expected a picture .*, got 'N', 'Z'"),
        (["only_depth.exr"], r"only_depth\.exr: layers: expected a picture .*, got 'Z'"),
        (["good.exr", "-o", "folder.exr"], r"-o: .*folder\.exr: expected the name of a file, got a folder"),
        (["good.exr", "-o", "pictures.exr"], r"-o: .*pictures\.png: expected the name of a file, got a folder"),
        (["good.exr", "-o", "page.exr"], r"-o: .*page\.html: expected the name of a file, got a folder"),
        (["cut.exr"], r"cut\.exr: pixels: expected those of 1 images, as the header says, got a file that is cut off"),
        (["vast.exr"], r"vast\.exr: data window: expected sides of 1 to 65536 pixels, got 100000 x 100000"),
        (["large.exr"], r"large\.exr: data window: expected at most 536870912 values, got 25200000000"),
        (["good.exr", "-o", "good.exr"], "-o: .*good.exr: expected another file than those that are read, got one"),
        (["good.exr", "--depth", "good.exr:mask", "-o", "sub/../good"], "-o: .*good.exr: expected another file"),
        (["good.exr", "-o", "clean.tif"], r"-o: .*clean\.tif: expected a name ending in \.exr, got \.tif"),
        (["good.exr", "-o", "file/clean.exr"], "-o: .*file: expected a folder that can be written, got one that can"),
        (["n.####.exr"], r"n\.####\.exr: name: expected --frames with a numbered name, such as 1-24, got none"),
        (["good.exr", "--frames", "1-3"], r"--frames: 1-3: expected a numbered name such as noisy\.####\.exr, got .*"),
        (["n.##.exr", "--frames", "3-1"], r"--frames: '3-1': expected a range such as 1-24 or 1,3,5-7, got '3-1'"),
        (["good.exr", "--color", "good.exr"], "--color: expected it alone, got it beside a picture"),
        (["--normal", "good.exr"], "--normal: expected a noisy picture beside it, got none"),
        (["good.exr", "--radius", "0"], "--radius: expected a value >= 1, got 0"),
        (["good.exr", "--eps", "0"], "--eps: expected a finite number above 0, got 0.0"),
        (["good.exr", "--spp", "nan"], "--spp: expected a finite number above 0, got nan"),
        (["good.exr", "--firefly", "1"], "--firefly: expected a finite number above 1, got 1.0"),
        (["good.exr", "--exposure-stops", "inf"], "--exposure-stops: expected a number from -64 to 64, got inf"),
        (["good.exr", "--resume"], "--resume: expected --frames beside it, got none"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(files, capsys, calls, arguments, words):
    names = re.compile(r"(.*[./].*|file.*)")
    arguments = [str(files / a) if names.fullmatch(a) and a != "inf" else a for a in arguments]
    out = [] if "-o" in arguments else ["-o", files / "clean.exr"]
    line = fails(capsys, *arguments, *out)
    assert re.search(words, line), line
    assert calls == [] and not (files / "clean.exr").exists()


def test_deep_images_are_refused_by_name(tmp_path, capsys, rng, calls):
    """A header that says so, since the library cannot write one."""
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage, "version": 1}
    OpenEXR.File(header, {c: image(rng, 1)[..., 0] for c in "RGB"}).write(str(tmp_path / "x.exr"))
    data = (tmp_path / "x.exr").read_bytes()
    at = data.index(b"type\0string\0")
    old = struct.pack("<i", 13) + b"scanlineimage"
    assert data[at + 12 : at + 12 + len(old)] == old
    flags = struct.pack("<I", struct.unpack("<I", data[4:8])[0] | 0x800)
    forged = data[:4] + flags + data[8:at] + b"maxSamplesPerPixel\0int\0" + struct.pack("<2i", 4, 1)
    forged += data[at : at + 12] + struct.pack("<i", 12) + b"deepscanline" + data[at + 12 + len(old) :]
    (tmp_path / "deep.exr").write_bytes(forged)
    line = fails(capsys, tmp_path / "deep.exr", "-o", tmp_path / "clean.exr")
    assert "deep.exr: type: expected flat images (deep data is not supported), got " in line


# --- The filters themselves


def test_what_was_filtered_is_said(tmp_path, capsys, rng):
    """Direct light stays as it came, unless all light is asked for; the parts add up in any case."""
    direct, indirect = image(rng), image(rng)
    write_exr(tmp_path / "noisy.exr", {"": direct + indirect, "direct": direct, "indirect": indirect, "N": image(rng)})
    for options, words, same in (
        ([], "filtered indirect light, direct as it came", True),
        (["--whole"], "filtered direct and indirect light", False),
    ):
        err = run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr", "--spp", "4", *options).err
        assert f", {words}\n" in err
        assert words.removeprefix("filtered ") in Page((tmp_path / "clean.html").read_text()).text
        back = read_exr_layers(tmp_path / "clean.exr")
        assert np.array_equal(back["direct"], direct) == same
        np.testing.assert_allclose(back["direct"] + back["indirect"], back[""], rtol=1e-6)


def test_guides_without_a_use_are_refused_in_one_line(tmp_path, capsys, rng):
    for value in (0.0, np.nan):
        write_exr(tmp_path / "noisy.exr", {"": image(rng), "N": np.full((HEIGHT, WIDTH, 3), value, np.float32)})
        line = fails(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr")
        assert line == "normal: expected finite numbers other than 0 in some pixel, got 0 of 768"


def test_parts_filtered_by_the_real_filter_add_up(tmp_path, capsys, rng):
    direct, indirect, emission = image(rng), image(rng), image(rng)
    direct[3, 4], indirect[8, 9] = np.nan, 1e4
    layers = {"": direct + indirect + emission, "direct": direct, "indirect": indirect, "emission": emission}
    write_exr(tmp_path / "noisy.exr", {**layers, "N": image(rng), "albedo": image(rng), "Z": image(rng, 1)})
    record = json.loads(run(capsys, tmp_path / "noisy.exr", "-o", tmp_path / "clean.exr", "--json").out)
    back = read_exr_layers(tmp_path / "clean.exr")
    assert {"direct", "indirect"} <= set(record["separate"]) and np.isfinite(back[""]).all()
    np.testing.assert_allclose(back["direct"] + back["indirect"] + back["emission"], back[""], rtol=1e-5, atol=1e-6)
    assert np.abs(back["indirect"] - indirect).max() > 0.01
    assert record["counts"]["nan"] == 1
