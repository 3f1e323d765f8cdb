"""The outer shell of a glTF: bytes -> parsed JSON, buffers, and the files it may refer to.

The JSON and the GLB chunks are read by pygltflib, from bytes we have read ourselves: it is never handed a
path, so it opens no file of its own accord. Whatever goes wrong here is an `InputError`.
"""

import base64
import binascii
import collections
import dataclasses
import hashlib
import pathlib
import re
import struct
import urllib.parse
import warnings
from typing import Any, NoReturn

import numpy as np
import pygltflib

from jaxrender.checks import InputError, bad_input

MAX_FILE_BYTES = 2**31
MAX_NUMBERS = 2**27
# The parser spends about 0.2 ms and 1 kB on each JSON object, so that a small file of empty ones would
# hold it for hours. The largest shared character has 9 thousand.
MAX_JSON_OBJECTS = 300_000

# Extensions that change nothing we read, or that we understand.
_SUPPORTED = {"KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "EXT_texture_webp"}
_ABOUT_MATERIALS = "KHR_materials_"


class OutsideFolderError(InputError):
    """A URI that is absolute, has a scheme, or leads out of the folder of the glTF."""


class Container:
    """A parsed glTF and access to its bytes. `path` stands in messages."""

    def __init__(self, path: pathlib.Path):
        self.path = path
        self._repairs: collections.Counter[str] = collections.Counter()
        self._numbers_read = 0
        self._data = read_file(path, path, "file")
        self.gltf = _parse(path, self._data)
        self._buffers: dict[int, bytes] = {}
        self.images: dict[int, np.ndarray] = {}  # decoded ones
        _check_extensions(path, self.gltf)

    def note(self, what: str, count: int = 1) -> None:
        """Remembers that something was repaired or left out, `count` times."""
        self._repairs[what] += count

    @property
    def notes(self) -> tuple[str, ...]:
        return tuple(f"{what}: {count}" for what, count in self._repairs.items() if count)

    def spend(self, numbers: int, where: str) -> None:
        """Counts numbers that are about to be read: a few bytes of file can ask for the same data often."""
        self._numbers_read += numbers
        if self._numbers_read > MAX_NUMBERS:
            self.bad(where, expected=f"at most {MAX_NUMBERS} numbers in all that is read", got="more")

    def bad(self, field: str, *, expected: object, got: object) -> NoReturn:
        """Raises InputError about a field of this file."""
        bad_input(self.path, field, expected=expected, got=printable(got))

    def item(self, kind: str, index: Any, where: str) -> Any:
        """`gltf.<kind>[index]`, or InputError if there is no such thing."""
        items = getattr(self.gltf, kind)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            self.bad(where, expected=f"an index into {len(items)} {kind}", got=index)
        return items[index]

    def buffer(self, index: Any, where: str) -> bytes:
        """The bytes of one buffer, at least as long as it promises."""
        declared = self.item("buffers", index, where)
        if index not in self._buffers:
            field = f"buffers[{index}]"
            if declared.uri is None and any("meshopt" in name for name in declared.extensions):
                self.bad(field, expected="uncompressed data", got="a placeholder (meshopt is not supported)")
            if declared.uri is not None:
                data = self.resource(declared.uri, field)
            else:
                data = (self.gltf.binary_blob() if index == 0 else None) or b""
            length = self.whole(declared.byteLength, f"{field}.byteLength", at_least=1)
            if len(data) < length:
                self.bad(field, expected=f"{length} bytes", got=f"{len(data)}")
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def view(self, index: Any, where: str) -> memoryview:
        """The bytes of one buffer view."""
        view = self.item("bufferViews", index, where)
        field = f"bufferViews[{index}]"
        buffer = self.buffer(view.buffer, f"{field}.buffer")
        offset = self.whole(view.byteOffset, f"{field}.byteOffset")
        length = self.whole(view.byteLength, f"{field}.byteLength", at_least=1)
        if offset + length > len(buffer):
            self.bad(field, expected=f"bytes within its buffer of {len(buffer)}", got=f"{offset} + {length}")
        return memoryview(buffer)[offset : offset + length]

    def resource(self, uri: str, where: str) -> bytes:
        """The bytes behind a URI: embedded in it, or a file in this file's folder."""
        if uri.startswith("data:"):
            return self._embedded(uri, where)
        return read_file(self._inside_folder(uri, where), self.path, where)

    def whole(self, value: Any, where: str, *, at_least: int = 0) -> int:
        """A whole number that is not missing and not below `at_least`; missing is 0 where 0 is allowed."""
        if value is None and at_least == 0:
            return 0
        if not isinstance(value, int) or isinstance(value, bool) or value < at_least:
            self.bad(where, expected=f"a whole number >= {at_least}", got=value)
        return value

    def content_hash(self) -> str:
        """SHA-256 (hex) of the file, followed by the external buffers that were read."""
        digest = hashlib.sha256(self._data)
        for index in sorted(self._buffers):
            if self.gltf.buffers[index].uri is not None:
                digest.update(self._buffers[index])
        return digest.hexdigest()

    def _embedded(self, uri: str, where: str) -> bytes:
        header, comma, body = uri.partition(",")
        raw = urllib.parse.unquote_to_bytes(body)
        if comma and not header.endswith(";base64"):
            return raw
        try:
            if not comma:
                raise ValueError
            return base64.b64decode(raw, validate=True)
        except (ValueError, binascii.Error):
            self.bad(f"{where}.uri", expected="a data URI with valid base64", got=uri)

    def _inside_folder(self, uri: str, where: str) -> pathlib.Path:
        """The file a relative URI names. The folder of the glTF is the border, for symbolic links too."""
        name = urllib.parse.unquote(uri)
        parts = re.split(r"[/\\]", name)
        # An empty first part is an absolute path; a colon makes a scheme (http:) or a drive (C:).
        inside = parts[0] and ".." not in parts and not re.match(r"[A-Za-z][A-Za-z0-9+.\-]*:", name)
        try:
            folder = self.path.parent.resolve()
            target = (folder / name).resolve()
        except (OSError, ValueError, RuntimeError):  # a loop of links, a name the file system cannot hold
            inside = False
        if not inside or not target.is_relative_to(folder):
            field, got = f"{self.path}: {where}.uri", printable(uri)
            raise OutsideFolderError(f"{field}: expected a file inside the folder of the glTF, got {got}")
        return target


def printable(text: object) -> str:
    """At most 80 characters on one line, whatever a file put into a name."""
    line = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(text)[:81])
    return line if len(line) <= 80 else line[:79] + "…"


def read_file(path: pathlib.Path, about: pathlib.Path, field: str) -> bytes:
    """The bytes of an ordinary file; a pipe or a device would keep us waiting for ever."""
    try:
        if not path.is_file():
            bad_input(
                about,
                field,
                expected="a readable file",
                got="a folder" if path.is_dir() else f"no file {path.name}",
            )
        size = path.stat().st_size
        if not 0 < size <= MAX_FILE_BYTES:
            bad_input(about, field, expected=f"1 to {MAX_FILE_BYTES} bytes", got=size)
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        bad_input(about, field, expected="a readable file", got=printable(error))


def _parse(path: pathlib.Path, data: bytes) -> pygltflib.GLTF2:
    binary = data[:4] == b"glTF"
    if binary:
        text = _json_chunk(path, data)
    else:
        text = data.removeprefix(b"\xef\xbb\xbf")
        if not text.lstrip()[:1] == b"{":
            bad_input(path, "file", expected="glTF 2.0 (JSON or GLB)", got="something else")
    if b'"asset"' not in text:
        bad_input(path, "asset", expected="a glTF 2.0 asset", got="none")
    if text.count(b"{") > MAX_JSON_OBJECTS:
        bad_input(path, "JSON", expected=f"at most {MAX_JSON_OBJECTS} objects", got=text.count(b"{"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if binary:
                gltf = pygltflib.GLTF2.load_from_bytes(data)
            else:
                gltf = pygltflib.GLTF2.gltf_from_json(text.decode())
    # The parser checks little: a wrong type shows as whatever error it leads to, a RecursionError included.
    except Exception as error:
        reason = printable(f"{type(error).__name__}: {error}")
        bad_input(path, "JSON", expected="a valid glTF 2.0 document", got=reason)
    _complete(path, gltf, "")
    if not str(gltf.asset.version).startswith("2."):
        bad_input(path, "asset.version", expected="2.x", got=printable(gltf.asset.version))
    return gltf


def _json_chunk(path: pathlib.Path, data: bytes) -> bytes:
    """The first chunk of a GLB, after a check of the header and of all chunk lengths."""
    if len(data) < 20:
        bad_input(path, "header", expected="at least 20 bytes of GLB", got=len(data))
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        bad_input(path, "header", expected="GLB version 2", got=version)
    if length > len(data):
        bad_input(path, "header", expected=f"{length} bytes", got=f"{len(data)} (truncated)")
    offset = 12
    while offset < length:
        size, kind = struct.unpack_from("<I4s", data, offset) if offset + 8 <= length else (length, b"")
        if offset == 12 and kind != b"JSON":
            bad_input(path, "chunk 0", expected="JSON", got=printable(kind))
        offset += 8 + size
    if offset != length:
        bad_input(path, "chunks", expected=f"an end at byte {length}", got=offset)
    return data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]


def _complete(path: pathlib.Path, record: Any, where: str) -> None:
    """Puts the default for every list or dictionary that is null, and refuses null in a list of records."""
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        inside = f"{where}.{field.name}".lstrip(".")
        if value is None and field.default_factory is not dataclasses.MISSING:
            setattr(record, field.name, field.default_factory())
        elif isinstance(value, list):
            for i, member in enumerate(value):
                if member is None:
                    bad_input(path, f"{inside}[{i}]", expected="an entry", got="null")
                if dataclasses.is_dataclass(member):
                    _complete(path, member, f"{inside}[{i}]")
        elif dataclasses.is_dataclass(value):
            _complete(path, value, inside)


def _check_extensions(path: pathlib.Path, gltf: pygltflib.GLTF2) -> None:
    for name in gltf.extensionsRequired:
        if name not in _SUPPORTED and not str(name).startswith(_ABOUT_MATERIALS):
            supported = ", ".join(sorted(_SUPPORTED))
            bad_input(
                path,
                "extensionsRequired",
                expected=f"none but {supported}, KHR_materials_*",
                got=printable(name),
            )
