"""OpenEXR files as layers: a name and an (h, w, c) array.

A layer gathers the channels of one prefix: "albedo.R", "albedo.G", "albedo.B" are layer "albedo". The
picture itself, channels R, G, B and A without a prefix (or a lone Y), is layer "". A channel that belongs
to no such group is a layer of its own under its full name ("Z").
"""

import contextlib
import errno
import io
import os
import pathlib
import re
import tempfile
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenEXR
from jaxtyping import Num

from jaxrender import checks
from jaxrender.io.atomic import atomic_path

#: Files that would decode to more numbers than this (2 GiB of float32) are refused before decoding.
MAX_VALUES = 2**29
_MAX_SIDE = 2**16
# The library makes room for a whole tile before it looks at the data, even if the image is smaller.
_MAX_TILE_VALUES = 2**26

# Components that stand together, in the order they take in the array.
_FAMILIES = ("RGBA", "XYZW", "UV")

# What of a header belongs to the way a file is stored, not to the picture.
_STORAGE = {
    "channels", "chunkCount", "compression", "dwaCompressionLevel", "lineOrder", "maxSamplesPerPixel", "name", "tiles",
    "type", "version", "zipCompressionLevel",
}  # fmt: skip

_output_lock = threading.Lock()


@dataclass(frozen=True)
class ExrPart:
    """What the header says of one part, before any pixel is decoded."""

    name: str
    height: int
    width: int
    channels: tuple[str, ...]


def read_exr(path: str | os.PathLike, *, layer: str = "") -> Num[np.ndarray, "h w c"]:
    """One layer of an EXR file; by default the picture, linear, with 1 (Y), 3 or 4 channels.

    Raises:
      InputError: if the file is not a readable EXR image or has no such layer.
    """
    layers = read_exr_layers(path)
    if layer not in layers:
        named = ", ".join(repr(name) for name in layers)
        checks.bad_input(path, "layers", expected=f"a layer {layer!r}", got=named)
    return layers[layer]


def read_exr_layers(path: str | os.PathLike) -> dict[str, Num[np.ndarray, "h w c"]]:
    """All layers of an EXR file.

    Half and float channels become float32, unsigned channels (ids) stay uint32. Arrays cover the data window,
    wherever it lies in the display window. In a file of several parts the layers after the first part are
    named "part" and "part.layer". Values are given as they are: a depth of infinity is common.

    Raises:
      InputError: if the file is missing, damaged, too large, or holds deep or subsampled data.
    """
    parts = read_exr_header(path)
    layers: dict[str, np.ndarray] = {}
    with _open(path, header_only=False) as file:
        if len(file.parts) != len(parts):
            expected = f"those of {len(parts)} images, as the header says"
            checks.bad_input(path, "pixels", expected=expected, got="a file that is cut off or damaged")
        for index, part in enumerate(parts):
            channels = {name: channel.pixels for name, channel in file.channels(index).items()}
            for name, pixels in channels.items():
                if pixels is None or pixels.shape != (part.height, part.width):
                    expected = f"{part.height} x {part.width} pixels"
                    checks.bad_input(path, f"channel {name!r}", expected=expected, got=getattr(pixels, "shape", None))
            for name, members in group_channels(tuple(channels)).items():
                full = name if index == 0 else f"{part.name}.{name}" if name else part.name
                layers[full] = _stack([channels[member] for member in members])
    return layers


def read_exr_header(path: str | os.PathLike) -> tuple[ExrPart, ...]:
    """The parts of an EXR file, checked for what can be read at all; decodes no pixel.

    Raises:
      InputError: as `read_exr_layers`.
    """
    parts = []
    with _open(path, header_only=True) as file:
        for index in range(len(file.parts)):
            parts.append(_check_header(path, file.header(index), index))
    if not parts:
        checks.bad_input(path, "header", expected="at least one image", got="none")
    if len({part.name for part in parts}) < len(parts):
        checks.bad_input(path, "header", expected="parts of different names", got=[part.name for part in parts])
    total = sum(part.height * part.width * len(part.channels) for part in parts)
    if total > MAX_VALUES:
        checks.bad_input(path, "data window", expected=f"at most {MAX_VALUES} values", got=f"{total}")
    return tuple(parts)


def exr_attributes(path: str | os.PathLike) -> dict[str, Any]:
    """What the header of the first part says of the picture: windows, the shape of pixels, notes of the renderer.

    For `write_exr`, of pictures of the same size. Only windows, numbers and texts, and pairs of numbers.

    Raises:
      InputError: as `read_exr_header`.
    """
    with _open(path, header_only=True) as file:
        header = file.header(0)
        kept = {name: value for name, value in header.items() if name not in _STORAGE and _is_plain(value)}
        return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in kept.items()}


def _is_plain(value: object) -> bool:
    """Text, a number, a pair of numbers, or a box of two such pairs."""
    if isinstance(value, tuple):
        return len(value) == 2 and all(isinstance(x, np.ndarray) and x.shape == (2,) for x in value)
    return isinstance(value, str | int | float) or (isinstance(value, np.ndarray) and value.shape == (2,))


def write_exr(
    path: str | os.PathLike,
    image: Num[np.ndarray, "h w c"] | Mapping[str, Num[np.ndarray, "h w c"]],
    *,
    half: bool = False,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Writes an image, or layers by name, losslessly compressed (ZIP); `read_exr_layers` gives them back.

    Floating point is stored as float32, or as float16 with `half`; integers as uint32. A layer of one
    channel takes the layer's name; two are named X, Y, three and four R, G, B, A, more are numbered.

    Args:
      attributes: for the header, as `exr_attributes` gives them.
    Raises:
      ValueError: if an array is not (h, w, c), the sizes differ, or two layers need the same channel name.
      OSError: if the file cannot be written.
    """
    layers = image if isinstance(image, Mapping) else {"": image}
    if not layers:
        raise ValueError("image: expected at least one layer, got none")
    channels: dict[str, np.ndarray] = {}
    shape = None
    for layer, pixels in layers.items():
        pixels = _storable(layer, np.asarray(pixels), half=half)
        shape = shape or pixels.shape[:2]
        if pixels.shape[:2] != shape:
            raise ValueError(f"layer {layer!r}: expected {shape} pixels as in the first layer, got {pixels.shape[:2]}")
        for index, name in enumerate(_channel_names(layer, pixels.shape[-1])):
            if name in channels:
                raise ValueError(f"layer {layer!r}: expected a new channel name, got {name!r} again")
            channels[name] = np.ascontiguousarray(pixels[..., index])
    header = {**(attributes or {}), "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        with _quiet() as said:
            try:
                OpenEXR.File(header, channels).write(str(temporary))
            except RuntimeError as error:
                text = said() or str(error)
                full = os.strerror(errno.ENOSPC)
                code, reason = (errno.ENOSPC, full) if full in text else (errno.EIO, f"not written: {text}")
                raise OSError(code, reason, str(path)) from error


def group_channels(channels: tuple[str, ...]) -> dict[str, list[str]]:
    """Layer name -> its channels in order: what of a part's channel names is one image ("" for the picture)."""
    groups: dict[str, list[str]] = {}
    rest = sorted(channels)
    for prefix in sorted({name.rpartition(".")[0] for name in rest}):
        found = {name.rpartition(".")[2].upper(): name for name in rest if name.rpartition(".")[0] == prefix}
        # A bare Z is depth and a bare Y is luminance. Of U, V and A, as Blender writes them, U and V belong together.
        families = _FAMILIES if prefix else _FAMILIES[:1]
        members = max(([found[c] for c in family if c in found] for family in families), key=len)
        if members and prefix not in channels:
            groups[prefix] = members
            rest = [name for name in rest if name not in members]
    numbered: dict[str, list[tuple[int, str]]] = {}
    for name in rest:
        prefix, _, suffix = name.rpartition(".")
        if re.fullmatch(r"[0-9]{1,6}", suffix) and prefix and prefix not in groups and prefix not in channels:
            numbered.setdefault(prefix, []).append((int(suffix), name))
        elif name == "Y" and "" not in groups:
            groups[""] = [name]
        else:
            groups[name] = [name]
    groups.update({prefix: [name for _, name in sorted(members)] for prefix, members in numbered.items()})
    return groups


def _channel_names(layer: str, count: int) -> list[str]:
    if count == 1:
        return [layer or "Y"]
    letters = "XY" if count == 2 else "RGBA"[:count] if count <= 4 else [str(i) for i in range(count)]
    if layer == "" and not 3 <= count <= 4:
        raise ValueError(f"layer '': expected 1, 3 or 4 channels for a layer without a name, got {count}")
    return [f"{layer}.{letter}" if layer else letter for letter in letters]


def _stack(channels: list[np.ndarray]) -> np.ndarray:
    whole = all(channel.dtype == np.uint32 for channel in channels)
    return np.stack([channel.astype(np.uint32 if whole else np.float32) for channel in channels], axis=-1)


def _storable(layer: str, pixels: np.ndarray, *, half: bool) -> np.ndarray:
    if pixels.ndim != 3 or 0 in pixels.shape:
        raise ValueError(f"layer {layer!r}: expected shape (h, w, c), none of them 0, got {pixels.shape}")
    if np.issubdtype(pixels.dtype, np.floating):
        return pixels.astype(np.float16 if half else np.float32)
    if np.issubdtype(pixels.dtype, np.integer) or pixels.dtype == np.bool_:
        if pixels.min() < 0 or pixels.max() > 2**32 - 1:
            raise ValueError(f"layer {layer!r}: expected integers of 32 bits without a sign, got a value outside")
        return pixels.astype(np.uint32)
    raise ValueError(f"layer {layer!r}: expected real numbers, got {pixels.dtype}")


def _check_header(path: str | os.PathLike, header: dict, index: int) -> ExrPart:
    where = f"part {index}: " if index else ""
    kind = header.get("type", OpenEXR.scanlineimage)
    if kind in (OpenEXR.deepscanline, OpenEXR.deeptile):
        checks.bad_input(path, f"{where}type", expected="flat images (deep data is not supported)", got=kind)
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    width, height = (int(size) for size in high - low + 1)
    if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE):
        expected = f"sides of 1 to {_MAX_SIDE} pixels"
        checks.bad_input(path, f"{where}data window", expected=expected, got=f"{width} x {height}")
    channels = header["channels"]
    if not channels:
        checks.bad_input(path, f"{where}channels", expected="at least one", got="none")
    for channel in channels:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            expected, got = (
                "full resolution (subsampling is not supported)",
                (channel.xSampling, channel.ySampling),
            )
            checks.bad_input(path, f"{where}channel {channel.name!r}", expected=expected, got=got)
    tile = header.get("tiles")
    if tile is not None and tile.xSize * tile.ySize * len(channels) > _MAX_TILE_VALUES:
        expected = f"tiles of at most {_MAX_TILE_VALUES} values"
        checks.bad_input(path, f"{where}tiles", expected=expected, got=f"{tile.xSize} x {tile.ySize} pixels")
    name = header.get("name") or f"part{index}"
    return ExrPart(name, height, width, tuple(channel.name for channel in channels))


@contextlib.contextmanager
def _open(path: str | os.PathLike, *, header_only: bool) -> Iterator["OpenEXR.File"]:
    path = pathlib.Path(path)
    with path.open("rb") as file:  # a missing or unreadable file is told by the system's own error
        magic = file.read(4)
    if magic != b"\x76\x2f\x31\x01":
        checks.bad_input(path, "first bytes", expected="an OpenEXR file", got=magic.hex(" ") or "an empty file")
    with _quiet() as said:
        try:
            with OpenEXR.File(str(path), separate_channels=True, header_only=header_only) as file:
                yield file
        except checks.InputError:
            raise
        except (RuntimeError, ValueError, TypeError, MemoryError) as error:
            # Names in the header may be no text at all, which shows only when the block asks for them.
            text = said() or ("an invalid header" if header_only else str(error))
            field = "header" if header_only else "pixels"
            checks.bad_input(path, field, expected="an intact OpenEXR file", got=text)


@contextlib.contextmanager
def _quiet() -> Iterator:
    """Catches what the library prints while it raises, if it raises at all, without a word about the reason.

    Its core writes to the file descriptor of standard error, its Python layer to `sys.stdout`. The block
    gets a function that returns the first line of the core's diagnosis.
    """
    with (
        _output_lock,
        tempfile.TemporaryFile() as caught,
        contextlib.redirect_stdout(io.StringIO()),
    ):
        saved = os.dup(2)
        try:
            os.dup2(caught.fileno(), 2)

            def said() -> str:
                caught.seek(0)
                first = caught.read(10_000).decode("utf-8", "replace").partition("\n")[0]
                return first.rpartition(") ")[2].strip()

            yield said
        finally:
            os.dup2(saved, 2)
            os.close(saved)
