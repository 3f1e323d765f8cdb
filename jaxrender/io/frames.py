"""Names of numbered files: "noisy.####.exr" or "noisy.%04d.exr", and ranges such as "1-24" or "1,3,5-7,10-20x2"."""

import pathlib
import re

from jaxrender.checks import bad_input

#: More frames than this at a time are taken for a slip of the hand.
MAX_FRAMES = 100_000

_NUMBER = re.compile(r"#+|%0?(\d*)d")
_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9})(?:x(\d{1,9}))?)?")


def has_number(name: str) -> bool:
    """Whether `name` has a place for a frame's number."""
    return _NUMBER.search(name) is not None


def frame_name(name: str, frame: int) -> str:
    """`name` with the number of the frame, padded with zeros to as many digits as there are # (or as %04d says)."""
    return _NUMBER.sub(lambda found: f"{frame:0{found[1] or 1 if found[0][0] == '%' else len(found[0])}d}", name)


def numbered_name(name: str) -> str:
    """`name` with a place for a number: put before the ending unless there is one."""
    path = pathlib.Path(name)
    return name if has_number(name) else str(path.with_name(f"{path.stem}.####{path.suffix}"))


def unnumbered_name(name: str) -> str:
    """`name` without its places for a number, and without the dot, dash or underscore before each."""
    return re.sub(rf"[._-]?(?:{_NUMBER.pattern})", "", name)


def parse_frames(text: str) -> tuple[int, ...]:
    """The frames of a range, in order, each once; "a-bxn" is every n-th.

    Raises:
      InputError: if it is no range, is empty, or has more than `MAX_FRAMES`.
    """
    frames: dict[int, None] = {}
    for part in text.split(","):
        found = _RANGE.fullmatch(part.strip())
        first, last, step = (int(n) if n else None for n in found.groups()) if found else (None, None, None)
        if first is None or (last is not None and last < first) or step == 0:
            bad_input("--frames", repr(part), expected="a range such as 1-24 or 1,3,5-7", got=repr(text))
        numbers = range(first, (first if last is None else last) + 1, step or 1)
        if len(frames) + len(numbers) > MAX_FRAMES:
            bad_input("--frames", repr(part), expected=f"at most {MAX_FRAMES} frames", got=repr(text))
        frames.update(dict.fromkeys(numbers))
    return tuple(frames)
