"""glTF materials -> one linear RGB albedo a vertex: factor × vertex colour × base colour texture.

A texture is looked up at the vertices only. One that is missing or damaged is left out with a note; nothing
here makes a character unreadable except a broken index or a path that leaves the folder.
"""

import io
import warnings
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from PIL import Image

from jaxrender.checks import InputError
from jaxrender.io.gltf_accessors import read_floats
from jaxrender.io.gltf_container import Container, OutsideFolderError, printable

MAX_TEXELS = 2**26
_REPEAT, _CLAMP, _MIRROR = 10497, 33071, 33648


class MissingTexture(Exception):
    """A base color texture that cannot be read; the message says why."""


def read_albedo(
    source: Container, attributes: dict[str, Any], material_index: Any, num_vertices: int, where: str
) -> Float32[np.ndarray, "v 3"]:
    """Albedo of the vertices of one primitive, in [0, 1]."""
    albedo = np.ones((num_vertices, 3))
    if "COLOR_0" in attributes:
        colors = read_floats(source, attributes["COLOR_0"], ("VEC3", "VEC4"), f"{where}.COLOR_0")
        colors = _one_a_vertex(source, colors, num_vertices, f"{where}.COLOR_0")
        albedo = albedo * np.clip(colors[:, :3], 0.0, 1.0)
    if material_index is not None:
        pbr = source.item("materials", material_index, f"{where}.material").pbrMetallicRoughness
        if pbr is not None:
            factor = np.asarray(pbr.baseColorFactor, dtype=np.float64)
            if factor.shape != (4,) or not np.isfinite(factor).all():
                field = f"materials[{material_index}].baseColorFactor"
                source.bad(field, expected="4 finite numbers", got=pbr.baseColorFactor)
            albedo = albedo * np.clip(factor[:3], 0.0, 1.0)
            if pbr.baseColorTexture is not None:
                try:
                    albedo = albedo * _texture_at(source, pbr.baseColorTexture, attributes, num_vertices, where)
                except MissingTexture as reason:
                    source.note(f"base color texture left out ({reason})")
    return albedo.astype(np.float32)


def sample_bilinear(
    image: UInt8[np.ndarray, "h w 3"], uv: Float[np.ndarray, "v 2"], *, wrap_u: int | None, wrap_v: int | None
) -> Float64[np.ndarray, "v 3"]:
    """Linear RGB of an sRGB image at uv, (0, 0) being its upper left corner.

    Args:
      wrap_u, wrap_v: glTF (OpenGL) codes: 33071 clamps, 33648 mirrors, anything else repeats.
    """
    height, width = image.shape[:2]
    x0, x1, fx = _texels(uv[:, 0].astype(np.float64), width, wrap_u)
    y0, y1, fy = _texels(uv[:, 1].astype(np.float64), height, wrap_v)
    upper = (1.0 - fx) * _linear_from_srgb(image[y0, x0]) + fx * _linear_from_srgb(image[y0, x1])
    lower = (1.0 - fx) * _linear_from_srgb(image[y1, x0]) + fx * _linear_from_srgb(image[y1, x1])
    return (1.0 - fy) * upper + fy * lower


def _texture_at(source: Container, info: Any, attributes: dict[str, Any], num_vertices: int, where: str) -> np.ndarray:
    transform = info.extensions.get("KHR_texture_transform", {})
    transform = transform if isinstance(transform, dict) else {}
    name = f"TEXCOORD_{transform.get('texCoord', info.texCoord or 0)}"
    if name not in attributes:
        raise MissingTexture(f"no {printable(name)}")
    uv = read_floats(source, attributes[name], ("VEC2",), f"{where}.{name}")
    uv = _one_a_vertex(source, uv, num_vertices, f"{where}.{name}")
    texture = source.item("textures", info.index, f"{where} -> baseColorTexture.index")
    image = _read_image(source, texture)
    wrap_u = wrap_v = _REPEAT
    if texture.sampler is not None:
        sampler = source.item("samplers", texture.sampler, "textures.sampler")
        wrap_u, wrap_v = sampler.wrapS, sampler.wrapT
    return sample_bilinear(image, _transformed(uv, transform), wrap_u=wrap_u, wrap_v=wrap_v)


def _transformed(uv: np.ndarray, transform: dict) -> np.ndarray:
    """KHR_texture_transform: scale, then rotate, then shift.

    The rotation is counter-clockwise to someone who looks at the image, v pointing down, as every importer
    has it; the matrix printed in the extension turns the other way (KhronosGroup/glTF issue 1563).
    """
    try:
        with np.errstate(all="ignore"):
            offset = np.array(transform.get("offset", 0.0), dtype=np.float64).reshape(-1)
            scale = np.array(transform.get("scale", 1.0), dtype=np.float64).reshape(-1)
            angle = float(transform.get("rotation", 0.0))
            c, s = np.cos(angle), np.sin(angle)
            moved = (uv * scale) @ np.array([[c, -s], [s, c]]) + offset
    except (TypeError, ValueError, OverflowError) as error:
        raise MissingTexture("bad KHR_texture_transform") from error
    if not np.isfinite(moved).all():
        raise MissingTexture("bad KHR_texture_transform")
    return moved


def _read_image(source: Container, texture: Any) -> np.ndarray:
    """A texture's image as sRGB bytes. The file decides the format, so only harmless ones are tried."""
    webp = texture.extensions.get("EXT_texture_webp", {})
    index = webp.get("source", texture.source) if isinstance(webp, dict) else texture.source
    if index is None:
        raise MissingTexture("no image in a supported format")
    record = source.item("images", index, "textures.source")
    if index not in source.images:
        source.images[index] = _decoded(source, record, f"images[{index}]")
        source.spend(source.images[index].size // 12, f"images[{index}]")
    return source.images[index]


def _decoded(source: Container, record: Any, where: str) -> np.ndarray:
    try:
        data = source.resource(record.uri, where) if record.uri else source.view(record.bufferView, where)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture = Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "WEBP"))
            if picture.width * picture.height > MAX_TEXELS:
                raise MissingTexture(f"more than {MAX_TEXELS} texels")
            return np.asarray(picture.convert("RGB"), dtype=np.uint8)
    except (OutsideFolderError, MissingTexture):
        raise
    except InputError as error:
        raise MissingTexture("its bytes are missing") from error
    # A damaged image makes the decoders raise almost anything, SyntaxError included.
    except Exception as error:
        raise MissingTexture("not a readable PNG, JPEG or WebP") from error


def _texels(u: np.ndarray, size: int, wrap: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two texels around each coordinate and the share of the second, (n, 1)."""
    # Into one or two periods first, so that huge coordinates stay exact integers.
    u = np.clip(u, 0.0, 1.0) if wrap == _CLAMP else np.mod(u, 2.0 if wrap == _MIRROR else 1.0)
    x = u * size - 0.5
    below = np.floor(x).astype(np.int64)
    pair = np.stack([below, below + 1])
    if wrap == _CLAMP:
        pair = np.clip(pair, 0, size - 1)
    elif wrap == _MIRROR:
        pair = np.mod(pair, 2 * size)
        pair = np.minimum(pair, 2 * size - 1 - pair)
    else:
        pair = np.mod(pair, size)
    return pair[0], pair[1], (x - below)[:, None]


def _linear_from_srgb(texels: np.ndarray) -> np.ndarray:
    """The transfer function of IEC 61966-2-1, from 8 bits to [0, 1]."""
    c = texels.astype(np.float64) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _one_a_vertex(source: Container, values: np.ndarray, num_vertices: int, where: str) -> np.ndarray:
    if len(values) != num_vertices:
        source.bad(where, expected=f"{num_vertices} elements, as POSITION has", got=len(values))
    return values
