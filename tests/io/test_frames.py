"""Numbered names and ranges of frames."""

import pytest

from jaxrender.checks import InputError
from jaxrender.io import frames


@pytest.mark.parametrize(
    ("name", "frame", "expected"),
    [
        ("a.####.exr", 7, "a.0007.exr"),
        ("a.#.exr", 12, "a.12.exr"),
        ("s_##/a_###.exr", 5, "s_05/a_005.exr"),
        ("a.%04d.exr", 7, "a.0007.exr"),
        ("a_%d.exr", 7, "a_7.exr"),
        ("a.exr:V.N", 7, "a.exr:V.N"),
    ],
)
def test_frame_names(name, frame, expected):
    assert frames.frame_name(name, frame) == expected
    assert frames.has_number(name) == (name != expected)


def test_names_with_and_without_a_number():
    assert frames.numbered_name("out/a.exr") == "out/a.####.exr"
    assert frames.numbered_name("out/a_##.exr") == "out/a_##.exr"
    assert [frames.unnumbered_name(name) for name in ("a.####.exr", "a_%04d.exr", "a.exr", "##.exr")] == [
        "a.exr", "a.exr", "a.exr", ".exr",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1-4", (1, 2, 3, 4)),
        ("7", (7,)),
        ("1,3, 5-7", (1, 3, 5, 6, 7)),
        ("10-20x5,15", (10, 15, 20)),
        ("0-1", (0, 1)),
    ],
)
def test_ranges(text, expected):
    assert frames.parse_frames(text) == expected


@pytest.mark.parametrize("text", ["", "a", "4-1", "1--3", "1-4x0", "-3", "1,,2", "1-999999999", "1" * 30])
def test_no_ranges(text):
    with pytest.raises(InputError, match=r"^--frames: .*: expected (a range such as 1-24|at most 100000 frames)"):
        frames.parse_frames(text)
