"""OpenEXR in and out, and files that were not made to be read."""

import struct

import numpy as np
import OpenEXR
import pytest

from jaxrender.checks import InputError
from jaxrender.io import exr


def make_layers(rng):
    return {
        "": rng.normal(size=(5, 7, 4)).astype(np.float32),
        "albedo": rng.random((5, 7, 3)).astype(np.float32),
        "Z": np.where(rng.random((5, 7, 1)) < 0.2, np.inf, 3.0).astype(np.float32),
        "motion": rng.normal(size=(5, 7, 2)).astype(np.float32),
        "a.deep.name": rng.random((5, 7, 1)).astype(np.float32),
        "sh": rng.normal(size=(5, 7, 16)).astype(np.float32),
        "id": rng.integers(0, 2**32, size=(5, 7, 1), dtype=np.uint32),
    }


def test_layers_come_back_bit_for_bit(tmp_path, rng):
    layers = make_layers(rng)
    exr.write_exr(tmp_path / "x.exr", layers)
    back = exr.read_exr_layers(tmp_path / "x.exr")
    assert back.keys() == layers.keys()
    for name, values in layers.items():
        assert back[name].dtype == values.dtype
        np.testing.assert_array_equal(back[name], values, err_msg=name)


def test_image_and_single_layer(tmp_path, rng):
    image = rng.random((3, 4, 3)).astype(np.float32)
    exr.write_exr(tmp_path / "x.exr", image)
    np.testing.assert_array_equal(exr.read_exr(tmp_path / "x.exr"), image)
    exr.write_exr(tmp_path / "gray.exr", image[..., :1])
    np.testing.assert_array_equal(exr.read_exr(tmp_path / "gray.exr"), image[..., :1])
    with pytest.raises(InputError, match=r"gray.exr: layers: expected a layer 'albedo', got ''"):
        exr.read_exr(tmp_path / "gray.exr", layer="albedo")


def test_half_rounds_to_the_nearest(tmp_path, rng):
    image = rng.random((3, 4, 3)).astype(np.float32)
    exr.write_exr(tmp_path / "x.exr", image, half=True)
    np.testing.assert_array_equal(exr.read_exr(tmp_path / "x.exr"), image.astype(np.float16).astype(np.float32))


def test_channel_names_are_those_other_programs_expect(tmp_path, rng):
    layers = make_layers(rng)
    exr.write_exr(tmp_path / "x.exr", {"": layers[""], "albedo": layers["albedo"], "Z": layers["Z"]})
    (part,) = exr.read_exr_header(tmp_path / "x.exr")
    assert set(part.channels) == {"R", "G", "B", "A", "albedo.R", "albedo.G", "albedo.B", "Z"}
    assert (part.height, part.width) == (5, 7)


def write_raw(path, channels, **header):
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}, channels).write(
        str(path)
    )


def test_families_are_ordered_by_meaning_not_by_letter(tmp_path):
    planes = {f"N.{c}": np.full((2, 3), v, np.float32) for c, v in zip("XYZ", (1, 2, 3), strict=True)}
    planes |= {f"left.{c}": np.full((2, 3), v, np.float16) for c, v in zip("rgb", (4, 5, 6), strict=True)}
    planes |= {"uv.u": np.full((2, 3), 7, np.float32), "uv.v": np.full((2, 3), 8, np.float32)}
    planes |= {"left.Z": np.full((2, 3), 9, np.float32)}
    write_raw(tmp_path / "x.exr", planes)
    layers = exr.read_exr_layers(tmp_path / "x.exr")
    assert {name: layer[0, 0].tolist() for name, layer in layers.items()} == {
        "N": [1, 2, 3],
        "left": [4, 5, 6],
        "uv": [7, 8],
        "left.Z": [9],
    }


def test_a_data_window_away_from_the_origin(tmp_path, rng):
    plane = rng.random((4, 6)).astype(np.float32)
    write_raw(
        tmp_path / "x.exr",
        {"Y": plane},
        dataWindow=(np.array([-10, 20], np.int32), np.array([-5, 23], np.int32)),
        displayWindow=(np.array([0, 0], np.int32), np.array([99, 99], np.int32)),
    )
    np.testing.assert_array_equal(exr.read_exr(tmp_path / "x.exr")[..., 0], plane)


def test_several_parts(tmp_path, rng):
    a, b = rng.random((2, 4, 6)).astype(np.float32)
    parts = [
        OpenEXR.Part({"name": "beauty"}, {"R": a, "G": a, "B": b}),
        OpenEXR.Part({"name": "depth"}, {"Z": b}),
        OpenEXR.Part({"name": "second"}, {"R": b, "G": b, "B": a}),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "x.exr"))
    layers = exr.read_exr_layers(tmp_path / "x.exr")
    assert {name: layer.shape for name, layer in layers.items()} == {
        "": (4, 6, 3),
        "depth.Z": (4, 6, 1),
        "second": (4, 6, 3),
    }
    np.testing.assert_array_equal(layers["second"][..., 2], a)


@pytest.mark.parametrize("cut", [0, 3, 4, 60, 200, 350, -1])
def test_truncated_files(tmp_path, rng, cut, capfd):
    exr.write_exr(tmp_path / "x.exr", rng.random((9, 8, 3)).astype(np.float32))
    data = (tmp_path / "x.exr").read_bytes()
    assert len(data) > 500
    (tmp_path / "cut.exr").write_bytes(data[:cut])
    with pytest.raises(InputError, match=r"cut\.exr: .*: expected .*, got [^\n]+$"):
        exr.read_exr(tmp_path / "cut.exr")
    assert capfd.readouterr() == ("", "")  # the library's own chatter is in the message, not on the terminal


def test_every_damaged_byte_is_an_image_or_one_clear_error(tmp_path, rng):
    exr.write_exr(tmp_path / "x.exr", rng.random((4, 4, 3)).astype(np.float32))
    data = bytearray((tmp_path / "x.exr").read_bytes())
    for position in rng.choice(len(data), size=60, replace=False):
        damaged = data.copy()
        damaged[position] ^= int(rng.integers(1, 256))
        (tmp_path / "d.exr").write_bytes(damaged)
        try:
            assert exr.read_exr(tmp_path / "d.exr").ndim == 3
        except InputError as error:
            assert "d.exr: " in str(error)


def test_a_giant_data_window_is_refused_before_decoding(tmp_path, rng):
    exr.write_exr(tmp_path / "x.exr", rng.random((4, 4, 3)).astype(np.float32))
    data = (tmp_path / "x.exr").read_bytes()
    for corner, message in [
        ((2**30, 2**30), "header: expected"),
        ((65535, 65535), "at most 536870912 values"),
    ]:
        window = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        (tmp_path / "big.exr").write_bytes(data[: window + 8] + struct.pack("<2i", *corner) + data[window + 16 :])
        with pytest.raises(InputError, match=message):
            exr.read_exr(tmp_path / "big.exr")


def test_giant_tiles_are_refused_before_decoding(tmp_path, rng):
    tiles = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.tiledimage,
        "tiles": OpenEXR.TileDescription(),
    }
    plane = rng.random((8, 9)).astype(np.float32)
    OpenEXR.File(tiles, {"Y": plane}).write(str(tmp_path / "x.exr"))
    np.testing.assert_array_equal(exr.read_exr(tmp_path / "x.exr")[..., 0], plane)
    data = (tmp_path / "x.exr").read_bytes()
    size = data.index(b"tiledesc\0") + len(b"tiledesc\0") + 4
    (tmp_path / "big.exr").write_bytes(data[:size] + struct.pack("<2I", 32, 2**28) + data[size + 8 :])
    with pytest.raises(InputError, match="tiles: expected tiles of at most 67108864 values, got 32 x 268435456"):
        exr.read_exr(tmp_path / "big.exr")


def test_names_that_are_no_text(tmp_path, rng):
    write_raw(tmp_path / "x.exr", {"layername.R": rng.random((2, 3)).astype(np.float32)})
    data = (tmp_path / "x.exr").read_bytes().replace(b"layername", b"\xff\xfeyername")
    (tmp_path / "x.exr").write_bytes(data)
    with pytest.raises(InputError, match="header: expected an intact OpenEXR file, got an invalid header"):
        exr.read_exr(tmp_path / "x.exr")


def test_other_files_and_missing_ones(tmp_path):
    (tmp_path / "text.exr").write_text("not an image")
    with pytest.raises(InputError, match=r"text\.exr: first bytes: expected an OpenEXR file, got 6e 6f 74 20"):
        exr.read_exr(tmp_path / "text.exr")
    with pytest.raises(FileNotFoundError):
        exr.read_exr(tmp_path / "none.exr")


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((3, 4)), "expected shape"),
        (np.zeros((0, 4, 3)), "none of them 0"),
        (np.zeros((3, 4, 5)), "expected 1, 3 or 4 channels"),
        (np.zeros((3, 4, 3), complex), "real numbers"),
        (np.full((3, 4, 1), -1), "32 bits without a sign"),
        ({}, "at least one layer"),
        (
            {"a": np.zeros((3, 4, 1)), "b": np.zeros((4, 3, 1))},
            "layer 'b': expected .* pixels as in the first",
        ),
        ({"a": np.zeros((3, 4, 3)), "a.R": np.zeros((3, 4, 1))}, "a new channel name, got 'a.R'"),
    ],
)
def test_arrays_that_cannot_be_written(tmp_path, image, message):
    with pytest.raises(ValueError, match=message):
        exr.write_exr(tmp_path / "x.exr", image)
    assert not (tmp_path / "x.exr").exists()


@pytest.mark.data
def test_a_layered_file_of_a_studio(shared_data):
    layers = exr.read_exr_layers(shared_data / "openexr_multichannel" / "beachball_singlepart.0001.exr")
    assert layers[""].shape == layers["left"].shape == (876, 911, 4)
    assert layers["disparityL"].shape == (876, 911, 2)
    assert layers["whitebarmask.left.mask"].shape == (876, 911, 1)
