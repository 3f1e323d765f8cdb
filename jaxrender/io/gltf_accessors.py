"""glTF accessors -> NumPy arrays. Every size, offset and stride is checked before a byte is touched.

Sizes are Python integers until they are known to be small, so none can overflow.
"""

from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from jaxrender.io.gltf_container import Container

# Beyond this size squares of squares (areas, cofactors) leave the range of float32.
LARGEST_NUMBER = 1e9
# For accessors without data of their own, whose size no file size bounds.
MAX_ZEROS = 2**22

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def read_floats(source: Container, index: Any, types: tuple[str, ...], where: str) -> Float32[np.ndarray, "n c"]:
    """An accessor as finite floats; integers marked as normalised become [0, 1] or [-1, 1].

    Matrices are (n, 16), in the column-major order of the file.

    Raises:
      InputError: if the accessor is not one of `types`, does not fit its buffer, or holds NaN, Inf or
        numbers beyond `LARGEST_NUMBER`.
    """
    raw = _read(source, index, types, where)
    values = raw.astype(np.float32)
    if source.gltf.accessors[index].normalized and raw.dtype.kind in "iu":
        values = np.maximum(values / np.float32(np.iinfo(raw.dtype).max), np.float32(-1.0))
    bad = ~(np.abs(values) <= LARGEST_NUMBER)
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        found = f"{int(bad.sum())} NaN, Inf or larger, first {values[at]} in row {at[0]}"
        source.bad(where, expected=f"finite numbers up to {LARGEST_NUMBER:g}", got=found)
    return values


def read_integers(source: Container, index: Any, types: tuple[str, ...], where: str) -> Int64[np.ndarray, "n c"]:
    """An accessor of unsigned integers."""
    raw = _read(source, index, types, where)
    if raw.dtype.kind != "u":
        source.bad(where, expected="unsigned integers", got=raw.dtype.name)
    return raw.astype(np.int64)


def one_a_vertex(source: Container, values: np.ndarray, num_vertices: int, where: str) -> np.ndarray:
    """The rows of an attribute, if there is one for each vertex.

    Raises:
      InputError: otherwise.
    """
    if len(values) != num_vertices:
        source.bad(where, expected=f"{num_vertices} elements, as POSITION has", got=len(values))
    return values


def _read(source: Container, index: Any, types: tuple[str, ...], where: str) -> np.ndarray:
    accessor = source.item("accessors", index, where)
    field = f"accessors[{index}]"
    if accessor.type not in types:
        source.bad(f"{where} -> {field}.type", expected=" or ".join(types), got=accessor.type)
    dtype = _dtype(source, accessor.componentType, f"{field}.componentType")
    count = source.whole(accessor.count, f"{field}.count", at_least=1)
    shape = (count, _COMPONENTS[accessor.type])
    source.spend(shape[0] * shape[1], f"{field}.count")
    if accessor.bufferView is None:
        if count > MAX_ZEROS:
            source.bad(f"{field}.count", expected=f"at most {MAX_ZEROS} without a bufferView", got=count)
        values = np.zeros(shape, dtype)
    else:
        values = _strided(source, accessor.bufferView, accessor.byteOffset, shape, dtype, field)
    return values if accessor.sparse is None else _substituted(source, values, accessor.sparse, f"{field}.sparse")


def _strided(source: Container, view_index, offset, shape: tuple[int, int], dtype, field: str) -> np.ndarray:
    """A copy of `shape` elements of a buffer view, which may lie between others (byteStride)."""
    view = source.view(view_index, f"{field}.bufferView")
    offset = source.whole(offset, f"{field}.byteOffset")
    element = shape[1] * dtype.itemsize
    stride = source.gltf.bufferViews[view_index].byteStride
    if stride is None:
        stride = element
    source.whole(stride, f"bufferViews[{view_index}].byteStride", at_least=element)
    end = offset + (shape[0] - 1) * stride + element
    if end > len(view):
        source.bad(field, expected=f"data within its bufferView of {len(view)} bytes", got=f"{end} bytes")
    return np.ndarray(shape, dtype, buffer=view, offset=offset, strides=(stride, dtype.itemsize)).copy()


def _substituted(source: Container, values: np.ndarray, sparse, field: str) -> np.ndarray:
    """`values` with the rows of a sparse accessor put in."""
    count = source.whole(sparse.count, f"{field}.count", at_least=1)
    if sparse.indices is None or sparse.values is None or count > len(values):
        source.bad(field, expected=f"indices and values for at most {len(values)} elements", got=count)
    index_dtype = _dtype(source, sparse.indices.componentType, f"{field}.indices.componentType")
    rows = _strided(
        source,
        sparse.indices.bufferView,
        sparse.indices.byteOffset,
        (count, 1),
        index_dtype,
        f"{field}.indices",
    )[:, 0]
    if rows.dtype.kind != "u" or not (np.diff(rows.astype(np.int64)) > 0).all() or rows[-1] >= len(values):
        source.bad(f"{field}.indices", expected=f"increasing unsigned integers below {len(values)}", got=rows)
    values[rows] = _strided(
        source,
        sparse.values.bufferView,
        sparse.values.byteOffset,
        (count, values.shape[1]),
        values.dtype,
        f"{field}.values",
    )
    return values


def _dtype(source: Container, component_type, field: str) -> np.dtype:
    if component_type not in _DTYPES:
        source.bad(field, expected="one of " + ", ".join(map(str, _DTYPES)), got=component_type)
    return np.dtype(_DTYPES[component_type])
