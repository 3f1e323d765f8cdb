"""glTF materials -> one linear RGB albedo a vertex: factor × vertex colour × base colour texture.

A texture is looked up at the vertices only. One that is missing or damaged is left out with a note; nothing
here makes a character unreadable except a broken index or a path that leaves the folder.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from jaxrender.io.gltf_accessors import one_a_vertex, read_floats
from jaxrender.io.gltf_container import Container, printable
from jaxrender.io.gltf_textures import (
    CLAMP,
    MIRROR,
    MissingTexture,
    read_image,
    texcoord_name,
    transformed,
    uv_transform,
    wrap_codes,
)
from jaxrender.srgb import decode_srgb


def read_albedo(
    source: Container, attributes: dict[str, Any], material_index: Any, num_vertices: int, where: str
) -> Float32[np.ndarray, "v 3"]:
    """Albedo of the vertices of one primitive, in [0, 1]."""
    albedo = np.ones((num_vertices, 3))
    if "COLOR_0" in attributes:
        colors = read_floats(source, attributes["COLOR_0"], ("VEC3", "VEC4"), f"{where}.COLOR_0")
        colors = one_a_vertex(source, colors, num_vertices, f"{where}.COLOR_0")
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
    upper = (1.0 - fx) * decode_srgb(image[y0, x0] / 255.0) + fx * decode_srgb(image[y0, x1] / 255.0)
    lower = (1.0 - fx) * decode_srgb(image[y1, x0] / 255.0) + fx * decode_srgb(image[y1, x1] / 255.0)
    return (1.0 - fy) * upper + fy * lower


def _texture_at(source: Container, info: Any, attributes: dict[str, Any], num_vertices: int, where: str) -> np.ndarray:
    name, transform = texcoord_name(info), uv_transform(info)
    if name not in attributes:
        raise MissingTexture(f"no {printable(name)}")
    uv = read_floats(source, attributes[name], ("VEC2",), f"{where}.{name}")
    uv = one_a_vertex(source, uv, num_vertices, f"{where}.{name}")
    texture = source.item("textures", info.index, f"{where} -> baseColorTexture.index")
    image = read_image(source, texture)[..., :3]
    wrap_u, wrap_v = wrap_codes(source, texture)
    return sample_bilinear(image, transformed(uv, transform), wrap_u=wrap_u, wrap_v=wrap_v)


def _texels(u: np.ndarray, size: int, wrap: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two texels around each coordinate and the share of the second, (n, 1)."""
    # Into one or two periods first, so that huge coordinates stay exact integers.
    u = np.clip(u, 0.0, 1.0) if wrap == CLAMP else np.mod(u, 2.0 if wrap == MIRROR else 1.0)
    x = u * size - 0.5
    below = np.floor(x).astype(np.int64)
    pair = np.stack([below, below + 1])
    if wrap == CLAMP:
        pair = np.clip(pair, 0, size - 1)
    elif wrap == MIRROR:
        pair = np.mod(pair, 2 * size)
        pair = np.minimum(pair, 2 * size - 1 - pair)
    else:
        pair = np.mod(pair, size)
    return pair[0], pair[1], (x - below)[:, None]
