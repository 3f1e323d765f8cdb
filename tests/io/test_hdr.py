"""Environment maps: values, and what is refused."""

import numpy as np
import pytest

from jaxrender.checks import InputError
from jaxrender.io import exr
from jaxrender.io.hdr import read_environment

PIXEL = bytes([128, 64, 32, 129])  # mantissas / 256 x 2^(129 - 128): (1, 0.5, 0.25)


def write_hdr(path, *, width=4, height=2, head=b"FORMAT=32-bit_rle_rgbe\n", order=b"-Y %d +X %d", pixels=None):
    pixels = PIXEL * (width * height) if pixels is None else pixels
    path.write_bytes(b"#?RADIANCE\n" + head + b"\n" + order % (height, width) + b"\n" + pixels)
    return path


def test_known_radiance(tmp_path):
    image = read_environment(write_hdr(tmp_path / "x.hdr"))
    assert image.shape == (2, 4, 3) and image.dtype == np.float32
    np.testing.assert_array_equal(image, np.broadcast_to([1.0, 0.5, 0.25], (2, 4, 3)))


def test_run_length_code(tmp_path):
    # One scanline of 8: marker 2 2 0 8, then each component as a run (128 + 8) of one value.
    line = bytes([2, 2, 0, 8]) + b"".join(bytes([136, value]) for value in PIXEL)
    image = read_environment(write_hdr(tmp_path / "x.hdr", width=8, height=4, pixels=4 * line))
    np.testing.assert_array_equal(image, np.broadcast_to([1.0, 0.5, 0.25], (4, 8, 3)))


def test_exposure_is_divided_out(tmp_path):
    head = b"FORMAT=32-bit_rle_rgbe\nEXPOSURE=2.0\n"
    np.testing.assert_array_equal(read_environment(write_hdr(tmp_path / "x.hdr", head=head))[0, 0], [0.5, 0.25, 0.125])


def test_the_content_counts_not_the_ending(tmp_path, rng):
    image = rng.random((4, 8, 3)).astype(np.float32)
    exr.write_exr(tmp_path / "map.exr", image)
    (tmp_path / "map.exr").rename(tmp_path / "map.hdr")
    np.testing.assert_array_equal(read_environment(tmp_path / "map.hdr"), image)
    assert read_environment(write_hdr(tmp_path / "map.exr")).shape == (2, 4, 3)


def test_gray_and_alpha(tmp_path, rng):
    image = rng.random((4, 8, 4)).astype(np.float32)
    exr.write_exr(tmp_path / "rgba.exr", image)
    np.testing.assert_array_equal(read_environment(tmp_path / "rgba.exr"), image[..., :3])
    exr.write_exr(tmp_path / "gray.exr", image[..., :1])
    np.testing.assert_array_equal(read_environment(tmp_path / "gray.exr"), np.repeat(image[..., :1], 3, axis=-1))


def test_bad_values_are_counted_or_cleaned(tmp_path):
    image = np.ones((4, 8, 3), np.float32)
    image[0, 0, 0], image[1, 1, 1], image[2, 2] = np.nan, np.inf, -0.25
    exr.write_exr(tmp_path / "x.exr", image)
    with pytest.raises(InputError, match=r"x\.exr: radiance: .* got 2 NaN or Inf and 3 negative ones"):
        read_environment(tmp_path / "x.exr")
    clean = read_environment(tmp_path / "x.exr", clean=True)
    assert clean.sum() == image.size - 5 and clean.min() == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"width": 4, "height": 4},
            r"size: expected a latitude-longitude map, twice as wide as high, got 4 x 4",
        ),
        ({"width": 100_000, "height": 50_000, "pixels": b""}, "may not exceed"),
        ({"width": 40_000, "height": 20_000, "pixels": b""}, "header: expected an intact"),
        ({"pixels": PIXEL}, "pixels: expected an intact image"),
        ({"head": b"FORMAT=32-bit_rle_xyze\n"}, "header: expected"),
        ({"order": b"+Y %d +X %d"}, "orientation 4"),
        ({"head": b"FORMAT=32-bit_rle_rgbe\nEXPOSURE=0\n"}, "EXPOSURE: expected a positive number"),
    ],
)
def test_refused(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        read_environment(write_hdr(tmp_path / "x.hdr", **options))


def test_the_limit_on_pixels(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxrender.io.hdr.MAX_PIXELS", 7)
    with pytest.raises(InputError, match="size: expected at most 7 pixels, got 4 x 2"):
        read_environment(write_hdr(tmp_path / "x.hdr"))


def test_a_large_exr_is_refused_by_its_header(tmp_path):
    exr.write_exr(tmp_path / "x.exr", np.zeros((3, 3, 3), np.float32))
    with pytest.raises(InputError, match="twice as wide as high, got 3 x 3"):
        read_environment(tmp_path / "x.exr")


def test_other_files(tmp_path):
    (tmp_path / "x.hdr").write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match="first bytes: expected a Radiance"):
        read_environment(tmp_path / "x.hdr")
    (tmp_path / "x.hdr").write_bytes(b"")
    with pytest.raises(InputError, match="an empty file"):
        read_environment(tmp_path / "x.hdr")
    with pytest.raises(FileNotFoundError):
        read_environment(tmp_path / "none.hdr")


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "mean", "maximum"), [("venice_sunset_1k", 0.47, 6496), ("studio_small_03_1k", 1.88, 3568)]
)
def test_real_maps(shared_data, name, mean, maximum):
    image = read_environment(shared_data / "hdri" / f"{name}.hdr")
    assert image.shape == (512, 1024, 3)
    # The figures of the data's own list; it gives the mean to two digits, once rounded up.
    assert image.mean() == pytest.approx(mean, abs=0.01)
    assert image.max() == pytest.approx(maximum, abs=0.5)
