"""Small glTF files for tests, right or wrong on purpose: their JSON is a dictionary to be bent at will."""

import base64
import json
import pathlib
import struct
from typing import Any

import numpy as np

COMPONENT_TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class GltfBuilder:
    """Collects binary data in one buffer and describes it in `json`."""

    def __init__(self) -> None:
        self.blob = bytearray()
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def view(self, data: bytes, **fields: Any) -> int:
        """A buffer view of these bytes, padded to 4."""
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **fields}
        self.blob += data + b"\0" * (-len(data) % 4)
        return self.add("bufferViews", view)

    def accessor(self, array: Any, dtype: str = "f4", **fields: Any) -> int:
        """An accessor of rows (n, c), or of scalars (n,), in a view of its own."""
        rows = np.asarray(array).reshape(len(array), -1)
        view = self.view(rows.astype("<" + dtype).tobytes())
        return self.add("accessors", {"bufferView": view, **describe(rows, dtype), **fields})

    def interleaved(self, *arrays: Any) -> list[int]:
        """Accessors of float rows that alternate in one buffer view, with a gap of four bytes after each."""
        rows = [np.asarray(array, dtype="<f4") for array in arrays]
        packed = np.concatenate([np.pad(r, ((0, 0), (0, 1)), constant_values=np.nan) for r in rows], axis=1)
        view = self.view(packed.tobytes(), byteStride=packed.shape[1] * 4)
        offsets = np.cumsum([0] + [4 * (r.shape[1] + 1) for r in rows[:-1]])
        return [
            self.add("accessors", {"bufferView": view, "byteOffset": int(o), **describe(r, "f4")})
            for r, o in zip(rows, offsets, strict=True)
        ]

    def add(self, kind: str, record: dict[str, Any]) -> int:
        """Appends to a list of the JSON and returns the index."""
        self.json.setdefault(kind, []).append(record)
        return len(self.json[kind]) - 1

    def glb(self) -> bytes:
        text = json.dumps(self._with_buffer({})).encode()
        text += b" " * (-len(text) % 4)
        blob = bytes(self.blob)
        body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    def gltf(self, uri: str | None = None) -> bytes:
        """The JSON form, with its buffer behind `uri` or, by default, embedded."""
        embedded = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        return json.dumps(self._with_buffer({"uri": uri or embedded})).encode()

    def write(self, folder: pathlib.Path) -> pathlib.Path:
        path = folder / "character.glb"
        path.write_bytes(self.glb())
        return path

    def _with_buffer(self, fields: dict[str, Any]) -> dict[str, Any]:
        return {"buffers": [{"byteLength": len(self.blob), **fields}], **self.json}


def describe(rows: np.ndarray, dtype: str) -> dict[str, Any]:
    return {"componentType": COMPONENT_TYPES[dtype], "count": len(rows), "type": TYPES[rows.shape[1]]}


# A tetrahedron with outward faces, its right angle at the origin.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
NORMALS = np.array([[-1, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) / np.array([[np.sqrt(3)], [1], [1], [1]])
JOINTS = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0]])
WEIGHTS = np.array([[0.75, 0.25, 0, 0], [0.5, 0.5, 0, 0], [1, 0, 0, 0], [0.25, 0.75, 0, 0]])
BINDS = np.tile(np.eye(4), (2, 1, 1))
BINDS[1, :3, 3] = [0, -2, 0]
QUARTER_TURN = [0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5))]


def tetrahedron() -> GltfBuilder:
    """A tetrahedron on two joints, with one clip that turns the second joint by 90 degrees about z.

    Nodes: 0 root joint, 1 joint two metres above it, 2 the mesh. Accessors: 0 POSITION, 1 NORMAL, 2 JOINTS_0,
    3 WEIGHTS_0, 4 indices, 5 inverse binds (column-major), 6 key times, 7 key values.
    """
    b = GltfBuilder()
    attributes = {
        "POSITION": b.accessor(CORNERS),
        "NORMAL": b.accessor(NORMALS),
        "JOINTS_0": b.accessor(JOINTS, "u1"),
        "WEIGHTS_0": b.accessor(WEIGHTS),
    }
    indices = b.accessor(FACES.ravel(), "u2")
    binds = b.accessor(BINDS.swapaxes(1, 2).reshape(-1, 16))
    times = b.accessor([0.5, 1.5])
    values = b.accessor([[0, 0, 0, 1], QUARTER_TURN])
    b.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"name": "root", "children": [1]},
            {"name": "tip", "translation": [0, 2, 0]},
            {"name": "body", "mesh": 0, "skin": 0},
        ],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices}]}],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": binds}],
        "animations": [
            {
                "name": "turn",
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}],
                "samplers": [{"input": times, "output": values}],
            }
        ],
    }
    return b


def primitive(builder: GltfBuilder) -> dict[str, Any]:
    """The first primitive of the first mesh."""
    return builder.json["meshes"][0]["primitives"][0]


def rigid() -> GltfBuilder:
    """The tetrahedron without skin: node 0 carries the mesh, accessors as in `tetrahedron`."""
    b = tetrahedron()
    for name in ("JOINTS_0", "WEIGHTS_0"):
        del primitive(b)["attributes"][name]
    b.json |= {
        "nodes": [{"name": "body", "mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "skins": [],
        "animations": [],
    }
    return b
