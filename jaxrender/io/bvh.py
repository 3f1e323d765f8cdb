"""BVH motion capture: hierarchy and motion of a file -> a skeleton, a clip, and a body grown around them.

A BVH has no unit, no body and no up axis of its own: it is read as +Y up, and scaled to metres by the rule of
`read_bvh`. Files are taken as hostile: sizes are checked before anything is held in memory, nothing recurses,
and whatever is wrong is one `InputError` with the number of its line.
"""

import hashlib
import io
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxrender.animation.anatomy import recognize, stature
from jaxrender.animation.mannequin import mannequin_character
from jaxrender.animation.skeleton import Channel, Clip, Pose, Skeleton
from jaxrender.animation.skinning import Character
from jaxrender.checks import InputError, bad_input

STATURE = 1.7
"""Metres: what a skeleton of unknown unit is scaled to."""

MAX_BYTES = 1 << 28
"""256 MB are about a quarter of an hour of 100 joints at 120 frames a second."""

MAX_JOINTS = 2000

_LARGEST = 1e9  # in units of the file or degrees; what is larger is damage
_FARTHEST = 1e6  # metres
_CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class BvhMotion:
    """What one BVH file holds, in metres. `notes` say, one line each, what was repaired or left out."""

    skeleton: Skeleton
    clip: Clip
    unit_scale: float
    content_hash: str
    notes: tuple[str, ...]


def read_bvh(
    path: str | Path, *, metres_per_unit: float | None = None, skip_calibration: bool | None = None
) -> tuple[Skeleton, Clip]:
    """The skeleton and the motion of a BVH file; `parse_bvh` also tells the scale that was used.

    Every End Site is a joint of its own without channels, named after its parent. At rest all rotations are
    none. The rotation of a joint is the product of its rotation channels in the order of the file, column
    vectors: "Zrotation Xrotation" is M = T Rz Rx. A position channel replaces that component of the OFFSET.

    Args:
      metres_per_unit: None makes the legs of a recognised upright human those of a person of 1.7 m, and for
        any other skeleton the height of the rest pose, or its largest extent if that is more, 1.7 m. (The
        CMU data has about 0.056 m per unit.)
      skip_calibration: whether frame 0 is left out. None finds out: it is a calibration pose if from frame 0
        to 1 some joint turns by more than 15 degrees, and five times as far as any joint in each of the next
        five steps and in the median step.
    Raises:
      InputError: if the file is not a whole and finite BVH; the message names the line.
    """
    motion = parse_bvh(path, metres_per_unit=metres_per_unit, skip_calibration=skip_calibration)
    return motion.skeleton, motion.clip


def read_bvh_character(
    path: str | Path,
    *,
    num_vertices: int = 5000,
    metres_per_unit: float | None = None,
    skip_calibration: bool | None = None,
) -> Character:
    """The motion of a BVH file on a mannequin grown around its skeleton; options as in `read_bvh`."""
    motion = parse_bvh(path, metres_per_unit=metres_per_unit, skip_calibration=skip_calibration)
    return mannequin_character(
        Path(path).stem,
        motion.skeleton,
        (motion.clip,),
        num_vertices=num_vertices,
        content_hash=motion.content_hash,
        unit_scale=motion.unit_scale,
        notes=motion.notes,
    )


def parse_bvh(
    path: str | Path, *, metres_per_unit: float | None = None, skip_calibration: bool | None = None
) -> BvhMotion:
    """Reads a BVH file; arguments and errors as in `read_bvh`."""
    path = Path(path)
    if metres_per_unit is not None and not 0 < metres_per_unit < float("inf"):
        raise ValueError(f"metres_per_unit: expected a positive number, got {metres_per_unit}")
    content = _read_bytes(path)
    lines = _Lines(path, content)
    joints = _hierarchy(lines)
    frame_time, values = _motion(lines, sum(len(joint.channels) for joint in joints))
    rotations, positions = _tracks(joints, values)

    notes: list[str] = []
    if skip_calibration is None:
        skip_calibration = _starts_with_calibration(rotations)
    if skip_calibration and len(values) > 1:
        notes.append("frame 0, a calibration pose, was skipped")
        rotations = {joint: track[1:] for joint, track in rotations.items()}
        positions = {joint: track[1:] for joint, track in positions.items()}
        values = values[1:]
    names = _unique([joint.name for joint in joints], notes)
    parents = tuple(joint.parent for joint in joints)
    offsets = np.stack([joint.offset for joint in joints])
    scale = metres_per_unit
    if scale is None:
        scale, reason = _guess_scale(names, parents, offsets)
        notes.append(f"unit taken as {scale:.4g} m: {reason}")
    farthest = scale * max(float(np.abs(track).max()) for track in (offsets, *positions.values()))
    if not farthest < _FARTHEST:
        bad_input(path, "positions", expected=f"coordinates below {_FARTHEST:g} m", got=f"{farthest:.3g} m")

    times = _float32(np.arange(len(values)) * frame_time)
    turning = [
        Channel(joint, "rotation", "LINEAR", times, _float32(_sign_continuous(track)))
        for joint, track in rotations.items()
    ]
    moving = [
        Channel(joint, "translation", "LINEAR", times, _float32(scale * track)) for joint, track in positions.items()
    ]
    rest = Pose(
        translation=jnp.asarray(scale * offsets, dtype=jnp.float32),
        rotation=jnp.tile(jnp.asarray([0, 0, 0, 1], dtype=jnp.float32), (len(joints), 1)),
        scale=jnp.ones((len(joints), 3), dtype=jnp.float32),
    )
    return BvhMotion(
        skeleton=Skeleton(names, parents, rest),
        clip=Clip(path.stem, (*turning, *moving), 0.0, float(times[-1])),
        unit_scale=float(scale),
        content_hash=hashlib.sha256(content).hexdigest(),
        notes=tuple(notes),
    )


# The file as lines.


def _read_bytes(path: Path) -> bytes:
    """The bytes of a regular file of reasonable size: a pipe or a device could be endless."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            bad_input(path, "file", expected="a regular file", got="a folder, pipe or device")
        if status.st_size > MAX_BYTES:
            bad_input(path, "file", expected=f"at most {MAX_BYTES} bytes", got=status.st_size)
        with path.open("rb") as file:
            return file.read(MAX_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


class _Lines:
    """The lines of a file that are not blank, as words, and the number of the one last handed out."""

    def __init__(self, path: Path, content: bytes):
        try:
            content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = content.count(b"\n", 0, error.start) + 1
            bad_input(f"{path}:{line}", "text", expected="UTF-8", got=f"byte 0x{content[error.start]:02x}")
        self.path = path
        self.num_bytes = len(content)
        self.number = 0
        self._text = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig")

    def __iter__(self) -> Iterator[list[str]]:
        for line in self._text:
            self.number += 1
            if words := line.split():
                yield words

    def next(self, expected: str) -> list[str]:
        """The words of the next line that is not blank."""
        for words in self:
            return words
        self.fail("end of file", expected=expected, got="no more lines")

    def fail(self, what: str, *, expected: object, got: object) -> NoReturn:
        bad_input(f"{self.path}:{self.number}", what, expected=expected, got=got)

    def numbers(self, words: list[str], what: str, count: int) -> Float[np.ndarray, " n"]:
        """`count` numbers, finite and below 1e9 in size."""
        if len(words) != count:
            self.fail(what, expected=f"{count} numbers", got=len(words))
        values = np.empty(count)
        for i, word in enumerate(words):
            try:
                values[i] = float(word)
            except ValueError:
                self.fail(what, expected="a number", got=_short(word))
        sound = np.abs(values) < _LARGEST
        if not sound.all():
            self.fail(what, expected=f"numbers below {_LARGEST:g}", got=_short(words[int(np.argmin(sound))]))
        return values


def _short(*words: str) -> str:
    """Words of a file for a message: quoted, and not endless."""
    text = " ".join(words)
    return repr(text if len(text) <= 60 else text[:57] + "...")


# The hierarchy.


@dataclass
class _Joint:
    name: str
    parent: int
    end_site: bool
    has_offset: bool = False
    has_channels: bool = False
    offset: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    channels: list[tuple[str, int]] = field(default_factory=list)


def _hierarchy(lines: _Lines) -> list[_Joint]:
    """Every joint, parents first, up to the line MOTION. An explicit stack stands for the nesting."""
    if (words := lines.next("HIERARCHY"))[0].upper() != "HIERARCHY":
        lines.fail("first line", expected="HIERARCHY", got=_short(*words))
    joints: list[_Joint] = []
    nesting: list[int] = []
    opening = False  # a joint waits for its {
    for words in _statements(lines):
        key = words[0].upper()
        if opening != (key == "{"):
            expected = f"{{ of {joints[-1].name}" if opening else "a joint before {"
            lines.fail("hierarchy", expected=expected, got=_short(*words))
        if key == "{":
            nesting.append(len(joints) - 1)
            opening = False
        elif key == "MOTION" and not nesting:
            break
        elif key == "ROOT" and not joints:
            joints.append(_Joint(" ".join(words[1:]) or "root", -1, end_site=False))
            opening = True
        elif key in ("ROOT", "JOINT", "END", "OFFSET", "CHANNELS", "}") and nesting:
            inside = joints[nesting[-1]]
            if key == "OFFSET" and not inside.has_offset:
                inside.offset, inside.has_offset = (
                    lines.numbers(words[1:], f"OFFSET of {inside.name}", 3),
                    True,
                )
            elif key == "CHANNELS" and not (inside.has_channels or inside.end_site):
                inside.channels, inside.has_channels = _channels(lines, words, inside.name), True
            elif key == "}" and inside.has_offset:
                nesting.pop()
            elif key in ("JOINT", "END") and inside.has_offset and not inside.end_site:
                if len(joints) == MAX_JOINTS:
                    lines.fail("hierarchy", expected=f"at most {MAX_JOINTS} joints", got="more")
                name = f"{inside.name} End Site" if key == "END" else " ".join(words[1:])
                joints.append(_Joint(name or f"joint {len(joints)}", nesting[-1], end_site=key == "END"))
                opening = True
            else:
                rule = "one OFFSET, then at most one CHANNELS and joints, and neither of these in an End Site"
                lines.fail(f"joint {inside.name}", expected=rule, got=_short(*words))
        else:
            rule = "one ROOT, with joints, OFFSET and CHANNELS inside, closed by as many } as {"
            lines.fail("hierarchy", expected=rule, got=_short(*words))
    else:
        lines.fail("end of file", expected="MOTION after a closed hierarchy", got="no more lines")
    if not joints:
        lines.fail("hierarchy", expected="a ROOT", got="none")
    return joints


def _statements(lines: _Lines) -> Iterator[list[str]]:
    """Lines as words, with each brace on its own: some files put it behind the name."""
    for words in lines:
        statement: list[str] = []
        for word in words:
            if word in ("{", "}"):
                if statement:
                    yield statement
                yield [word]
                statement = []
            else:
                statement.append(word)
        if statement:
            yield statement


def _channels(lines: _Lines, words: list[str], name: str) -> list[tuple[str, int]]:
    """("position" or "rotation", axis) in the order of the file."""
    if len(words) < 2 or words[1] != str(len(words) - 2):
        lines.fail(f"CHANNELS of {name}", expected="their number and as many names", got=_short(*words[1:]))
    channels = []
    for word in words[2:]:
        if not (match := _CHANNEL.fullmatch(word)):
            lines.fail(f"CHANNELS of {name}", expected="Xposition ... Zrotation", got=_short(word))
        channels.append((match[2].lower(), "xyz".index(match[1].lower())))
    moved = [axis for kind, axis in channels if kind == "position"]
    if len(set(moved)) < len(moved):
        lines.fail(f"CHANNELS of {name}", expected="each position once", got=_short(*words[2:]))
    return channels


def _unique(names: list[str], notes: list[str]) -> tuple[str, ...]:
    """Names with a number behind each one that came before."""
    taken = set(names)
    result: list[str] = []
    seen: set[str] = set()
    repeats: dict[str, int] = {}
    for name in names:
        new = name
        while new in seen or (new != name and new in taken):
            repeats[name] = repeats.get(name, 1) + 1
            new = f"{name} {repeats[name]}"
        seen.add(new)
        result.append(new)
    if repeats:
        notes.append(f"joints of one name got numbers: {', '.join(sorted(repeats)[:5])}")
    return tuple(result)


# The motion.


def _motion(lines: _Lines, num_channels: int) -> tuple[float, np.ndarray]:
    """Frame time in seconds, and the values (frames, channels) as they stand in the file."""
    num_frames = _after_colon(lines, "FRAMES")
    if not num_frames.isdecimal() or not 1 <= len(num_frames) <= 12 or int(num_frames) < 1:
        lines.fail("Frames", expected="a whole number >= 1", got=repr(num_frames[:40]))
    declared = int(num_frames)
    # A number takes a digit and a blank at least, so the file itself bounds what is held in memory.
    if declared * max(num_channels, 1) > lines.num_bytes // 2 + 1:
        lines.fail("Frames", expected=f"no more frames than {lines.num_bytes} bytes can hold", got=declared)
    frame_time = float(lines.numbers([_after_colon(lines, "FRAME TIME")], "Frame Time", 1)[0])
    if not 0 < frame_time < 1e4:
        lines.fail("Frame Time", expected="seconds above 0", got=frame_time)
    values = np.zeros((declared, num_channels))
    if num_channels == 0:
        return frame_time, values
    frame = 0
    for words in lines:
        if frame == declared:
            lines.fail("motion", expected=f"{declared} frames as declared", got="more lines")
        values[frame] = lines.numbers(words, f"frame {frame}", num_channels)
        frame += 1
    if frame < declared:
        lines.fail("end of file", expected=f"{declared} frames as declared", got=frame)
    return frame_time, values


def _after_colon(lines: _Lines, key: str) -> str:
    """The text behind "key:", whatever the case and the blanks."""
    line = " ".join(lines.next(f"{key.capitalize()}:"))
    head, _, tail = line.partition(":")
    if head.strip().upper() != key:
        lines.fail("motion", expected=f'"{key.capitalize()}:"', got=repr(line[:40]))
    return tail.strip()


def _tracks(joints: list[_Joint], values: np.ndarray) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Joint -> unit quaternions (f, 4), and joint -> positions (f, 3) in units of the file."""
    rotations: dict[int, np.ndarray] = {}
    positions: dict[int, np.ndarray] = {}
    column = 0
    for index, joint in enumerate(joints):
        for kind, axis in joint.channels:
            if kind == "rotation":
                turn = _axis_quaternion(axis, np.radians(values[:, column]))
                rotations[index] = _multiply(rotations[index], turn) if index in rotations else turn
            else:
                track = positions.setdefault(index, np.tile(joint.offset, (len(values), 1)))
                track[:, axis] = values[:, column]
            column += 1
    return rotations, positions


def _axis_quaternion(axis: int, angle: Float[np.ndarray, " f"]) -> Float[np.ndarray, "f 4"]:
    q = np.zeros((len(angle), 4))
    q[:, axis] = np.sin(0.5 * angle)
    q[:, 3] = np.cos(0.5 * angle)
    return q


def _multiply(a: Float[np.ndarray, "f 4"], b: Float[np.ndarray, "f 4"]) -> Float[np.ndarray, "f 4"]:
    """Hamilton product in float64, which the kernels of `skeleton` would round to float32."""
    av, aw, bv, bw = a[:, :3], a[:, 3:], b[:, :3], b[:, 3:]
    vector = aw * bv + bw * av + np.cross(av, bv)
    return np.concatenate([vector, aw * bw - np.sum(av * bv, axis=-1, keepdims=True)], axis=-1)


def _sign_continuous(q: Float[np.ndarray, "f 4"]) -> Float[np.ndarray, "f 4"]:
    """The same rotations, with each quaternion on the side of the one before; the first has w >= 0."""
    flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0, -1.0, 1.0)
    first = -1.0 if q[0, 3] < 0 else 1.0
    return q * np.cumprod(np.concatenate([[first], flips]))[:, None]


def _starts_with_calibration(rotations: dict[int, np.ndarray]) -> bool:
    """Whether frame 0 stands apart: see `read_bvh`."""
    if not rotations or len(next(iter(rotations.values()))) < 4:
        return False
    q = np.stack(list(rotations.values()))
    cosine = np.abs(np.sum(q[:, 1:] * q[:, :-1], axis=-1))
    turn = 2.0 * np.arccos(np.minimum(cosine, 1.0)).max(axis=0)
    usual = max(turn[1:6].max(), float(np.median(turn[1:])))
    return bool(turn[0] > max(np.radians(15.0), 5.0 * usual))


def _guess_scale(names: tuple[str, ...], parents: tuple[int, ...], offsets: np.ndarray) -> tuple[float, str]:
    """Metres per unit for a skeleton of unknown unit, and why."""
    positions = offsets.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            positions[joint] += positions[parent]
    height = stature(positions, parents, recognize(names, parents))
    if height is not None:
        return STATURE / height, f"the legs are those of a person of {STATURE} m"
    extent = np.ptp(positions, axis=0)
    largest = float(extent.max())
    if largest > 0:
        return STATURE / largest, f"the rest pose then measures {STATURE} m"
    return 1.0, "the skeleton has no extent"


def _float32(x: np.ndarray) -> np.ndarray:
    return np.asarray(x, dtype=np.float32)
