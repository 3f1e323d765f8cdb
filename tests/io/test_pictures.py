"""Display encoding, PNG, animations and labelled sheets."""

import numpy as np
import PIL.Image
import pytest

from jaxrender import srgb
from jaxrender.checks import InputError
from jaxrender.io import picture


def test_srgb_known_values_and_inverse():
    # IEC 61966-2-1: the linear piece ends at 0.0031308 (0.04045 encoded); mid gray 0.5 is 0.21404 linear.
    np.testing.assert_allclose(srgb.decode_srgb(np.array([0.04045, 0.5, 1.0])), [0.0031308, 0.21404, 1.0], rtol=1e-4)
    x = np.linspace(0.0, 1.0, 1001)
    # The two pieces of the standard meet only to 6 digits, so the inverse is off by that at the joint.
    np.testing.assert_allclose(srgb.decode_srgb(srgb.encode_srgb(x)), x, atol=1e-6)


def test_bytes_survive_a_round_trip():
    values = np.arange(256, dtype=np.uint8).reshape(16, 16, 1)
    np.testing.assert_array_equal(picture.to_bytes(srgb.decode_srgb(values / 255.0)), values)
    assert picture.to_bytes(values) is values


def test_to_bytes_clamps_and_marks_nan():
    pixels = picture.to_bytes(np.array([[[-1.0, 2.0, np.inf], [np.nan, 0.0, 0.0]]], np.float32))
    np.testing.assert_array_equal(pixels, [[[0, 255, 255], [255, 0, 255]]])
    assert picture.to_bytes(np.array([[np.nan, 1.0]])).tolist() == [[[255, 0, 255], [255, 255, 255]]]


def test_alpha_is_not_encoded():
    assert picture.to_bytes(np.full((1, 1, 4), 0.5))[0, 0].tolist() == [188, 188, 188, 128]


@pytest.mark.parametrize("shape", [(3,), (2, 2, 2), (0, 2, 3), (1, 2, 2, 3)])
def test_to_bytes_shapes(shape):
    with pytest.raises(ValueError, match="image: expected shape"):
        picture.to_bytes(np.zeros(shape))


def test_to_bytes_types():
    with pytest.raises(ValueError, match="expected uint8 or floating point, got int64"):
        picture.to_bytes(np.zeros((2, 2, 3), np.int64))


def test_tone_map_keeps_dark_colors_orders_bright_ones_and_stays_below_one(rng):
    gray = np.repeat(np.concatenate([np.linspace(0, 4, 400), [1e3, 1e6, np.inf]])[None, :, None], 3, axis=-1)
    mapped = picture.tone_map(gray)[0, :, 0]
    assert (np.diff(mapped) >= 0).all() and mapped[0] == 0 and mapped[-1] <= 1
    colors = rng.uniform(0.1, 0.75, size=(8, 8, 3)).astype(np.float32)
    # Below the shoulder only the pedestal of 0.04 is taken off.
    np.testing.assert_allclose(picture.tone_map(colors), colors - 0.04, atol=1e-6)
    np.testing.assert_allclose(picture.tone_map(colors / 4, exposure_stops=2.0), colors - 0.04, atol=1e-6)
    saturated = picture.tone_map(np.array([[[50.0, 1.0, 1.0]]]))[0, 0]
    assert saturated[1] > 0.5  # a very bright red goes to white
    assert picture.tone_map(rng.exponential(100.0, (16, 16, 3))).max() <= 1.0


def test_png_round_trip(tmp_path, rng):
    image = rng.random((5, 7, 3)).astype(np.float32)
    picture.write_png(tmp_path / "x.png", image)
    back = picture.read_png(tmp_path / "x.png")
    assert back.dtype == np.float32
    # Half a byte in sRGB, whose decoding is steepest at white: d linear / d srgb = 2.4 / 1.055.
    np.testing.assert_allclose(back, image, atol=0.5 / 255 * 2.4 / 1.055 + 1e-6)


def test_png_modes(tmp_path, rng):
    gray = rng.integers(0, 2**16, size=(4, 6), dtype=np.uint16)
    PIL.Image.fromarray(gray).save(tmp_path / "deep.png")
    np.testing.assert_allclose(
        picture.read_png(tmp_path / "deep.png")[..., 1], srgb.decode_srgb(gray / 65535.0), atol=1e-6
    )
    rgba = rng.integers(0, 256, size=(4, 6, 4), dtype=np.uint8)
    picture.write_png(tmp_path / "rgba.png", rgba)
    np.testing.assert_array_equal(picture.to_bytes(picture.read_png(tmp_path / "rgba.png")), rgba[..., :3])


def test_damaged_and_other_files(tmp_path, rng):
    picture.write_png(tmp_path / "x.png", rng.random((32, 32, 3)))
    data = (tmp_path / "x.png").read_bytes()
    for name, content in [
        ("cut", data[:200]),
        ("text", b"hello"),
        ("empty", b""),
        ("gif", b"GIF89a" + bytes(20)),
    ]:
        (tmp_path / f"{name}.png").write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}\.png: content: expected an intact PNG image, got "):
            picture.read_png(tmp_path / f"{name}.png")
    with pytest.raises(FileNotFoundError):
        picture.read_png(tmp_path / "none.png")


def test_a_png_that_claims_to_be_giant(tmp_path):
    picture.write_png(tmp_path / "x.png", np.zeros((1, 1, 3), np.uint8))
    data = bytearray((tmp_path / "x.png").read_bytes())
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    import zlib

    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    (tmp_path / "x.png").write_bytes(data)
    with pytest.raises(InputError, match=r"x\.png: "):
        picture.read_png(tmp_path / "x.png")


@pytest.mark.parametrize("ending", [".webp", ".gif", ".png"])
def test_animations(tmp_path, ending):
    ramp = np.linspace(0.0, 1.0, 32, dtype=np.float32)
    frames = [np.stack([np.tile(np.roll(ramp, 4 * i), (16, 1))] * 3, axis=-1) for i in range(7)]
    path = tmp_path / f"x{ending}"
    picture.write_animation(path, frames, fps=30.0)
    with PIL.Image.open(path) as image:
        assert image.n_frames == 7 and image.size == (32, 16)
        assert image.info.get("loop", 0) == 0
        durations = []
        for index in range(7):
            image.seek(index)
            image.load()
            durations.append(image.info["duration"])
            shown = np.asarray(image.convert("RGB"), np.float64)
            # Lossy or with few colors; a mean within 4 of 255 still tells each frame from its neighbours.
            assert np.abs(shown - picture.to_bytes(frames[index])).mean() < 4
    # 7 frames at 30 per second are 233 ms; GIF counts in steps of 10.
    assert sum(durations) == pytest.approx(233, abs=1 if ending != ".gif" else 5)


def test_animation_arguments(tmp_path):
    frame = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(ValueError, match="animation ending: expected one of"):
        picture.write_animation(tmp_path / "x.mp4", [frame])
    with pytest.raises(ValueError, match="frames: expected at least one"):
        picture.write_animation(tmp_path / "x.gif", [])
    with pytest.raises(ValueError, match="frames: expected one size"):
        picture.write_animation(tmp_path / "x.gif", [frame, frame[:2]])
    with pytest.raises(ValueError, match="fps"):
        picture.write_animation(tmp_path / "x.gif", [frame], fps=0)
    assert list(tmp_path.iterdir()) == []


def test_contact_sheet_layout():
    red, green = np.zeros((10, 30, 3), np.uint8), np.zeros((6, 20, 3), np.uint8)
    red[..., 0], green[..., 1] = 255, 255
    sheet = picture.contact_sheet([red, green, red], columns=2, gap_px=4)
    assert sheet.shape == (2 * (10 + 4) + 4, 2 * (30 + 4) + 4, 3)
    assert sheet[4, 4].tolist() == [255, 0, 0]
    assert sheet[4 + 2, 38 + 5].tolist() == [0, 255, 0]  # in the middle of its cell
    assert sheet[0, 0].tolist() == [24, 26, 30]


def test_labels_are_drawn_above_and_fit():
    image = np.zeros((20, 120, 3), np.uint8)
    plain, labelled = (
        picture.side_by_side([image, image]),
        picture.side_by_side([image, image], ["a", "b" * 200]),
    )
    bar = labelled.shape[0] - plain.shape[0]
    assert bar > 8 and labelled.shape[1] == plain.shape[1]
    text = (labelled[: 8 + bar].max(axis=-1) > 100).any(axis=0)
    assert text[8:128].any() and text[136:256].any()
    assert not text[128:136].any() and not text[256:].any()


def test_a_color_bar_stands_below_the_picture(rng):
    image = rng.random((30, 200, 3)).astype(np.float32)
    colors = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 16)
    sheet = picture.with_color_bar(image, colors, title="a title much too long for it", low="0", high="7")
    assert sheet.dtype == np.uint8 and sheet.shape[1:] == (200, 3) and sheet.shape[0] > 40
    np.testing.assert_array_equal(sheet[:30], picture.to_bytes(image))
    middle = sheet[30 + (sheet.shape[0] - 30) // 2].astype(int)
    (red,) = np.nonzero((middle[:, 0] > 60) & (middle[:, 1:].max(axis=-1) < 5))
    assert len(red) > 30 and (np.diff(middle[red, 0]) >= 0).all() and middle[red[-1], 0] > 250
    assert picture.with_color_bar(image[:1, :1, :1], colors, title="t", low="0", high="1").shape[1:] == (1, 3)


def test_sheet_arguments():
    with pytest.raises(ValueError, match="images: expected at least one"):
        picture.contact_sheet([])
    with pytest.raises(ValueError, match="labels: expected one per image"):
        picture.side_by_side([np.zeros((2, 2, 3))], ["a", "b"])
