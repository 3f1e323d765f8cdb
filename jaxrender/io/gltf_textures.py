"""glTF textures: decoded images, how they wrap, and the coordinates they are looked up at.

What is wrong with a texture alone is a `MissingTexture`, which readers turn into a note; a broken index or a path
that leaves the folder is an `InputError`.
"""

import io
import warnings
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from jaxrender.checks import InputError
from jaxrender.io.gltf_container import Container, OutsideFolderError

MAX_TEXELS = 2**26
REPEAT, CLAMP, MIRROR = 10497, 33071, 33648


class MissingTexture(Exception):
    """A texture that cannot be used; the message says why."""


def uv_transform(info: Any) -> dict:
    """The KHR_texture_transform of a reference to a texture, empty if it has none."""
    transform = info.extensions.get("KHR_texture_transform", {})
    return transform if isinstance(transform, dict) else {}


def texcoord_name(info: Any) -> str:
    """The attribute that a reference to a texture is looked up at."""
    return f"TEXCOORD_{uv_transform(info).get('texCoord', info.texCoord or 0)}"


def wrap_codes(source: Container, texture: Any) -> tuple[int | None, int | None]:
    """How a texture wraps in u and v: REPEAT, CLAMP, MIRROR; anything else repeats."""
    if texture.sampler is None:
        return REPEAT, REPEAT
    sampler = source.item("samplers", texture.sampler, "textures.sampler")
    return sampler.wrapS, sampler.wrapT


def image_index(texture: Any) -> Any:
    """The image of a texture, WebP where the file offers it; None if it is in no supported format."""
    webp = texture.extensions.get("EXT_texture_webp", {})
    return webp.get("source", texture.source) if isinstance(webp, dict) else texture.source


def transformed(uv: np.ndarray, transform: dict) -> np.ndarray:
    """KHR_texture_transform: scale, then rotate, then shift.

    The rotation is counter-clockwise to someone who looks at the image, v pointing down, as every importer
    has it; the matrix printed in the extension turns the other way (KhronosGroup/glTF issue 1563).

    Raises:
      MissingTexture: if the transform makes no sense.
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


def read_image(source: Container, texture: Any) -> UInt8[np.ndarray, "h w c"]:
    """A texture's image as bytes, RGBA if it has an alpha channel, else RGB; decoded once.

    The file decides the format, so only harmless ones are tried.

    Raises:
      MissingTexture: if it is missing, damaged or larger than `MAX_TEXELS`. InputError: if its path leaves the folder.
    """
    index = image_index(texture)
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
            return np.asarray(picture.convert("RGBA" if picture.has_transparency_data else "RGB"), dtype=np.uint8)
    except (OutsideFolderError, MissingTexture):
        raise
    except InputError as error:
        raise MissingTexture("its bytes are missing") from error
    # A damaged image makes the decoders raise almost anything, SyntaxError included.
    except Exception as error:
        raise MissingTexture("not a readable PNG, JPEG or WebP") from error
