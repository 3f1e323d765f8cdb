"""BVH files: rotation order, places, units, and files that are not what they should be."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxrender.checks import InputError
from jaxrender.io import bvh
from jaxrender.io.bvh import parse_bvh, read_bvh, read_bvh_character

# Float32 keys of rotations computed in float64: a rounding each, twice that in a matrix entry.
QUATERNION = 2 * np.finfo(np.float32).eps

ORDERS = ["".join(order) for size in (1, 2, 3) for order in itertools.permutations("XYZ", size)] + [
    "ZXZ",
    "XYX",
]

SAMPLE = """HIERARCHY
ROOT Hips
{
	OFFSET 1.0 2.0 3.0
	CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
	JOINT Knee
	{
		OFFSET 0 -4 0
		CHANNELS 3 Xrotation Zrotation Yrotation
		End Site
		{
			OFFSET 0 -3 0
		}
	}
}
MOTION
Frames: 3
Frame Time: 0.05
0 0 0 0 0 0 0 0 0
1 2 3 10 20 30 40 50 60
2 4 6 -170 100 5 0 -90 0
"""


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "motion.bvh"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def one_joint(channels, frames):
    lines = "\n".join(" ".join(map(str, frame)) for frame in frames)
    return (
        f"HIERARCHY\nROOT a\n{{\nOFFSET 0 1 0\nCHANNELS {len(channels)} {' '.join(channels)}\n"
        f"End Site\n{{\nOFFSET 0 1 0\n}}\n}}\nMOTION\nFrames: {len(frames)}\nFrame Time: 0.1\n{lines}\n"
    )


def track(clip, joint, path):
    (channel,) = (c for c in clip.channels if c.joint == joint and c.path == path)
    return channel


@pytest.mark.parametrize("order", ORDERS)
def test_the_order_of_channels_is_the_order_of_rotations(write, rng, order):
    angles = rng.uniform(-170, 170, size=(5, len(order)))
    text = one_joint([f"{axis}rotation" for axis in order], angles)
    _, clip = read_bvh(write(text), skip_calibration=False)
    # SciPy: capital letters are turns about the joint's own axes, so the first one is the outermost matrix.
    expected = Rotation.from_euler(order, angles, degrees=True).as_matrix()
    actual = Rotation.from_quat(track(clip, 0, "rotation").values).as_matrix()
    np.testing.assert_allclose(actual, expected, atol=4 * QUATERNION)


def test_a_chain_is_where_the_matrices_put_it(write):
    skeleton, clip = read_bvh(write(SAMPLE), metres_per_unit=0.5, skip_calibration=False)
    assert skeleton.names == ("Hips", "Knee", "Knee End Site")
    assert skeleton.parents == (-1, 0, 1)
    np.testing.assert_array_equal(skeleton.rest.translation, [[0.5, 1.0, 1.5], [0, -2, 0], [0, -1.5, 0]])
    assert {(c.joint, c.path) for c in clip.channels} == {
        (0, "rotation"),
        (0, "translation"),
        (1, "rotation"),
    }
    np.testing.assert_allclose(clip.channels[0].times, [0, 0.05, 0.1], rtol=1e-6)
    assert clip.duration == pytest.approx(0.1) and clip.start == 0.0

    def turn(axis, degrees):
        return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()

    # By hand, frame 1: p = T Rz Ry Rx (offset + Rx Rz Ry end), with Hips at (1, 2, 3) / 2.
    hips = turn("z", 10) @ turn("y", 20) @ turn("x", 30)
    knee = turn("x", 40) @ turn("z", 50) @ turn("y", 60)
    expected = np.array([0.5, 1.0, 1.5]) + hips @ (np.array([0, -2.0, 0]) + knee @ np.array([0, -1.5, 0]))
    q = [Rotation.from_quat(track(clip, joint, "rotation").values[1]).as_matrix() for joint in (0, 1)]
    offsets = np.asarray(skeleton.rest.translation)
    actual = track(clip, 0, "translation").values[1] + q[0] @ (offsets[1] + q[1] @ offsets[2])
    np.testing.assert_allclose(actual, expected, atol=4e-6)  # coordinates of a few metres in float32


def test_a_position_channel_replaces_its_component_of_the_offset(write):
    _, clip = read_bvh(write(one_joint(["Zposition", "Xrotation"], [[7, 0], [8, 0]])), metres_per_unit=1.0)
    np.testing.assert_array_equal(track(clip, 0, "translation").values, [[0, 1, 7], [0, 1, 8]])


def test_quaternions_are_unit_and_do_not_jump_in_sign(write, rng):
    angles = np.cumsum(rng.uniform(5, 25, size=(80, 3)), axis=0)
    _, clip = read_bvh(write(one_joint(["Yrotation", "Zrotation", "Xrotation"], angles)), skip_calibration=False)
    q = track(clip, 0, "rotation").values.astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=QUATERNION)
    assert np.all(np.sum(q[1:] * q[:-1], axis=1) > 0)
    assert q[0, 3] >= 0


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.replace("\n", "\r\n"),
        lambda t: t.replace("\n", "\r"),
        lambda t: t.replace(" ", "\t \t"),
        lambda t: t.replace("\n", "\n\n  \n"),
        lambda t: t.lower().replace("hips", "Hips").replace("knee", "Knee"),
        lambda t: t.upper().replace("HIPS", "Hips").replace("KNEE", "Knee"),
        lambda t: t.replace("\n{", " {").replace("\n\t{", " {").replace("\n\t\t{", " {"),
        lambda t: t.replace("Frames: 3", "Frames : 3").replace("Frame Time: 0.05", "Frame  Time:5e-2"),
        lambda t: "\ufeff" + t.rstrip("\n"),
    ],
    ids=["crlf", "cr", "tabs", "blank lines", "lower", "upper", "brace", "colons", "byte order mark"],
)
def test_spelling_does_not_matter(write, change):
    expected = parse_bvh(write(SAMPLE))
    actual = parse_bvh(write(change(SAMPLE)))
    assert actual.skeleton.names == expected.skeleton.names
    assert actual.unit_scale == expected.unit_scale
    for a, b in zip(actual.clip.channels, expected.clip.channels, strict=True):
        np.testing.assert_array_equal(a.values, b.values)
        np.testing.assert_array_equal(a.times, b.times)


def test_one_frame_and_joints_without_channels_are_fine(write):
    text = SAMPLE.replace("CHANNELS 3 Xrotation Zrotation Yrotation", "").replace("Frames: 3", "Frames: 1")
    motion = parse_bvh(write("\n".join(text.splitlines()[:-3]) + "\n1 2 3 4 5 6\n"))
    assert motion.clip.duration == 0.0
    assert {c.joint for c in motion.clip.channels} == {0}
    still = parse_bvh(write(one_joint([], [[]] * 4).rstrip() + "\n"))
    assert still.clip.channels == () and still.clip.duration == pytest.approx(0.3)


# What the reader decides by itself.


def test_the_unit_follows_the_rest_pose_or_is_given(write):
    # The rest pose is 7 units high and 0 wide.
    motion = parse_bvh(write(SAMPLE))
    assert motion.unit_scale == pytest.approx(bvh.STATURE / 7)
    assert any("unit taken as 0.2429 m" in note for note in motion.notes)
    wide = parse_bvh(write(SAMPLE.replace("OFFSET 0 -4 0", "OFFSET 9 -4 0")))
    assert wide.unit_scale == pytest.approx(bvh.STATURE / 9)
    given_unit = parse_bvh(write(SAMPLE), metres_per_unit=0.01)
    assert given_unit.unit_scale == 0.01 and given_unit.notes == ()
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="metres_per_unit"):
            parse_bvh(write(SAMPLE), metres_per_unit=wrong)


def test_a_skeleton_without_extent_keeps_its_unit(write):
    def tall(height):
        return SAMPLE.replace("OFFSET 0 -4 0", f"OFFSET 0 {height} 0").replace("OFFSET 0 -3 0", "OFFSET 0 0 0")

    assert parse_bvh(write(tall(0))).unit_scale == 1.0
    with pytest.raises(InputError, match="positions: expected coordinates below"):
        parse_bvh(write(tall(-1e-12)))


def test_a_calibration_frame_is_found_by_its_jump(write):
    motion = [[90.0], *([0.5 * i] for i in range(20))]
    text = one_joint(["Xrotation"], motion)
    found = parse_bvh(write(text))
    assert len(found.clip.channels[0].times) == 20 and found.clip.channels[0].times[0] == 0.0
    assert any("calibration" in note for note in found.notes)
    assert len(parse_bvh(write(text), skip_calibration=False).clip.channels[0].times) == 21

    smooth = one_joint(["Xrotation"], motion[1:])
    assert len(parse_bvh(write(smooth)).clip.channels[0].times) == 20
    assert len(parse_bvh(write(smooth), skip_calibration=True).clip.channels[0].times) == 19
    # Fast throughout: the first step is not out of the ordinary.
    fast = one_joint(["Xrotation"], [[40.0 * i] for i in range(20)])
    assert len(parse_bvh(write(fast)).clip.channels[0].times) == 20


def test_names_that_repeat_are_numbered(write):
    text = SAMPLE.replace("JOINT Knee", "JOINT Hips").replace("ROOT Hips", "ROOT Hips 2", 1)
    end = "\t\tEnd Site\n\t\t{\n\t\t\tOFFSET 0 -3 0\n\t\t}\n"
    motion = parse_bvh(write(text.replace(end, end * 3)))
    assert motion.skeleton.names == ("Hips 2", "Hips", "Hips End Site", "Hips End Site 2", "Hips End Site 3")
    assert any("got numbers" in note for note in motion.notes)


# Hostile files: one line, with the place.

# What is replaced in the sample, by what, and what the message says.
BROKEN = {
    "second root": ("MOTION", "ROOT b\n{\nOFFSET 0 0 0\n}\nMOTION", r":16: hierarchy: expected one ROOT"),
    "brace missing": ("JOINT Knee\n\t{\n", "JOINT Knee\n", r":7: hierarchy: expected { of Knee"),
    "brace too many": ("MOTION", "}\nMOTION", r":16: hierarchy: expected one ROOT"),
    "brace not closed": ("}\nMOTION", "MOTION", r":15: hierarchy: .*as many } as {, got 'MOTION'"),
    "no offset": ("\t\tOFFSET 0 -4 0\n", "", r":9: joint Knee: expected one OFFSET"),
    "two offsets": ("OFFSET 0 -4 0", "OFFSET 0 -4 0\nOFFSET 0 0 0", r":9: joint Knee"),
    "short offset": ("OFFSET 0 -4 0", "OFFSET 0 -4", r":8: OFFSET of Knee: expected 3 numbers, got 2"),
    "NaN offset": ("OFFSET 0 -4 0", "OFFSET 0 nan 0", r":8: OFFSET of Knee: expected numbers below .*'nan'"),
    "huge offset": ("OFFSET 0 -4 0", "OFFSET 0 1e300 0", r":8: OFFSET of Knee: .*'1e300'"),
    "channel count": ("CHANNELS 3", "CHANNELS 4", r":9: CHANNELS of Knee"),
    "channel count of letters": ("CHANNELS 3", "CHANNELS many", r":9: CHANNELS of Knee"),
    "channel name": ("3 Xrotation", "3 Wrotation", r":9: CHANNELS of Knee: .*'Wrotation'"),
    "scale channel": ("3 Xrotation", "3 Xscale", r":9: CHANNELS of Knee: .*'Xscale'"),
    "position twice": ("Yposition", "Xposition", r":5: CHANNELS of Hips: expected each position once"),
    "channels in end site": ("OFFSET 0 -3 0", "OFFSET 0 -3 0\nCHANNELS 0", r":13: joint Knee End Site"),
    "joint in end site": ("OFFSET 0 -3 0", "OFFSET 0 -3 0\nJOINT x", r":13: joint Knee End Site"),
    "negative frames": ("Frames: 3", "Frames: -3", r":17: Frames: expected a whole number >= 1, got '-3'"),
    "no frames": ("Frames: 3", "Frames: 0", r":17: Frames"),
    "fractional frames": ("Frames: 3", "Frames: 3.5", r":17: Frames"),
    "endless frames": ("Frames: 3", "Frames: 999999999", r":17: Frames: .*got 999999999"),
    "digits without end": ("Frames: 3", "Frames: " + "9" * 10000, r":17: Frames"),
    "no time": ("Frame Time: 0.05", "Frame Time: 0", r":18: Frame Time"),
    "NaN time": ("Frame Time: 0.05", "Frame Time: nan", r":18: Frame Time"),
    "time missing": ("Frame Time: 0.05\n", "", r":18: motion: expected .Frame time:."),
    "too few frames": ("2 4 6 -170 100 5 0 -90 0\n", "", r":20: end of file: expected 3 frames as declared"),
    "too many frames": (
        "-90 0\n",
        "-90 0\n0 0 0 0 0 0 0 0 0\n",
        r":22: motion: expected 3 frames as declared",
    ),
    "short frame": ("10 20 30 40", "10 20 30", r":20: frame 1: expected 9 numbers, got 8"),
    "long frame": ("10 20 30 40", "10 20 30 40 7", r":20: frame 1: expected 9 numbers, got 10"),
    "NaN in a frame": ("10 20 30", "10 NaN 30", r":20: frame 1: expected numbers below 1e.09, got 'NaN'"),
    "Inf in a frame": ("10 20 30", "10 -inf 30", r":20: frame 1: expected numbers below 1e.09, got '-inf'"),
    "overflow in a frame": ("10 20 30", "10 1e999 30", r":20: frame 1: .*1e999"),
    "far away": ("1 2 3 10", "1 9e8 3 10", r"positions: expected coordinates below 1e.06 m"),
    "words in a frame": ("10 20 30", "10 twenty 30", r":20: frame 1: expected a number, got 'twenty'"),
    "decimal comma": ("10 20 30", "10 2,5 30", r":20: frame 1: expected a number, got '2,5'"),
    "nul byte": ("10 20 30", "10 \x00 30", r":20: frame 1: expected a number"),
    "latin-1 name": (b"Knee", b"Kn\xe9", r":6: text: expected UTF-8, got byte 0xe9"),
    "no motion": (SAMPLE[SAMPLE.index("MOTION") :], "", r":15: end of file: expected MOTION"),
    "no frame count": (SAMPLE[SAMPLE.index("Frames") :], "", r":16: end of file: expected Frames:"),
    "empty": (SAMPLE, "", "end of file: expected HIERARCHY"),
    "another text": (SAMPLE, "solid cube\n", r":1: first line: expected HIERARCHY, got 'solid cube'"),
    "binary": (SAMPLE.encode(), b"glTF\x02\x00\n\xff\xfe", r":2: text: expected UTF-8, got byte 0xff"),
    "no root": (SAMPLE[10 : SAMPLE.index("MOTION")], "", "expected a ROOT"),
    "nested without end": (
        SAMPLE,
        "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\n" + "JOINT b\n{\nOFFSET 0 1 0\n" * 50000,
        "expected at most 2000 joints",
    ),
}


def broken(case):
    old, new, message = BROKEN[case]
    sample = SAMPLE.encode() if isinstance(old, bytes) else SAMPLE
    assert old in sample
    return sample.replace(old, new, 1), message


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_clear_line(write, case):
    text, message = broken(case)
    with pytest.raises(InputError, match=message) as error:
        parse_bvh(write(text))
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_what_is_no_ordinary_file_is_refused_before_it_is_read(tmp_path, write, monkeypatch):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        parse_bvh(tmp_path / "nothing.bvh")
    with pytest.raises(InputError, match="expected a regular file"):
        parse_bvh(tmp_path)
    with pytest.raises(InputError, match="expected a regular file"):
        parse_bvh("/dev/zero")
    path = write(SAMPLE)
    monkeypatch.setattr(bvh, "MAX_BYTES", 100)
    with pytest.raises(InputError, match="expected at most 100 bytes"):
        parse_bvh(path)


def test_a_file_cut_anywhere_is_refused(write):
    # The last number may be cut short and still be a number; anything before it is missed.
    for end in range(0, len(SAMPLE) - 3):
        with pytest.raises(InputError):
            parse_bvh(write(SAMPLE[:end]))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    edits=st.lists(
        st.tuples(st.integers(0, len(SAMPLE) - 1), st.integers(0, 3), st.binary(max_size=4)),
        min_size=1,
        max_size=3,
    )
)
def test_a_damaged_file_is_read_or_refused(tmp_path_factory, edits):
    content = SAMPLE.encode()
    for place, removed, inserted in edits:
        content = content[:place] + inserted + content[place + removed :]
    path = tmp_path_factory.mktemp("bvh") / "damaged.bvh"
    path.write_bytes(content)
    try:
        motion = parse_bvh(path)
    except InputError:
        return
    assert all(np.isfinite(channel.values).all() for channel in motion.clip.channels)
    assert len(set(motion.skeleton.names)) == len(motion.skeleton.names)


# Real files.

CMU = {"02_01": 344, "09_01": 149, "02_05": 1855, "05_06": 886}


@pytest.mark.data
@pytest.mark.parametrize("name", CMU)
def test_shared_motion_capture(shared_data, name):
    motion = parse_bvh(shared_data / "bvh" / f"{name}.bvh")
    names = motion.skeleton.names
    ends = [n for n in names if n.endswith("End Site")]
    assert (len(names) - len(ends), len(ends)) == (31, 7)
    # 96 channels: three positions of the root, three angles of every joint.
    assert sorted(c.path for c in motion.clip.channels) == ["rotation"] * 31 + ["translation"]
    frames = CMU[name] - 1  # frame 0 is a calibration pose
    assert all(c.values.shape[0] == frames and c.interpolation == "LINEAR" for c in motion.clip.channels)
    assert any("calibration" in note for note in motion.notes)
    assert motion.clip.duration == pytest.approx((frames - 1) / 120, rel=1e-4)
    # The unit of the database is 2.54 / 0.45 cm; the guess rests on proportions of the body.
    assert motion.unit_scale == pytest.approx(0.0564, rel=0.04)
    hips = track(motion.clip, 0, "translation").values
    assert 0.1 < hips[:, 1].min() and hips[:, 1].max() < 1.3


@pytest.mark.data
def test_shared_motion_capture_gets_a_body(shared_data):
    path = shared_data / "bvh" / "02_01.bvh"
    character = read_bvh_character(path, num_vertices=1000)
    assert character.name == "02_01" and len(character.content_hash) == 64
    assert character.unit_scale == pytest.approx(0.0564, rel=0.04)
    assert abs(character.skin.vertices.shape[0] - 1000) <= 100
    assert character.albedo.shape == character.skin.vertices.shape
    assert [clip.name for clip in character.clips] == ["02_01"]
