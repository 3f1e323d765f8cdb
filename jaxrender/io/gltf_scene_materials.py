"""glTF materials -> `Material` by id, with the images their textures refer to.

A texture that cannot be used is left out with a note that names its file; the material keeps its factors.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pygltflib

from jaxrender.io.gltf_container import Container, printable
from jaxrender.io.gltf_textures import (
    CLAMP,
    MIRROR,
    MissingTexture,
    image_index,
    read_image,
    texcoord_name,
    uv_transform,
    wrap_codes,
)
from jaxrender.io.surfaces import on_device
from jaxrender.scene import BLEND, MASK, OPAQUE, Material, SceneImage

_ALPHA_MODES = {"OPAQUE": OPAQUE, "MASK": MASK, "BLEND": BLEND, None: OPAQUE}
#: Slot of a texture, and whether its RGB is sRGB. The first one that a material has decides its coordinates.
_SLOTS = {"base_color": True, "metallic_roughness": False, "normal": False, "occlusion": False, "emissive": True}


@dataclass(frozen=True)
class Coordinates:
    """What a material's textures are looked up at: an attribute, and its KHR_texture_transform."""

    attribute: str | None
    transform: dict = field(default_factory=dict)


@dataclass(frozen=True)
class MaterialTable:
    """All materials of a file by id, then one without a texture for primitives that name none, if they need it."""

    material: Material
    names: tuple[str, ...]
    images: tuple[SceneImage, ...]
    coordinates: tuple[Coordinates, ...]


def read_materials(source: Container, *, with_default: bool) -> MaterialTable:
    """Every material, whether used or not, so that ids are indices of the file.

    Raises:
      InputError: for numbers that are none, unknown alpha modes and broken indices.
    """
    records = list(source.gltf.materials) + ([pygltflib.Material(name="default")] if with_default else [])
    layers: dict[tuple, int] = {}
    images: list[SceneImage] = []
    rows: list[dict[str, Any]] = []
    coordinates: list[Coordinates] = []
    for i, record in enumerate(records):
        where = f"materials[{i}]"
        infos = _texture_infos(record)
        coordinates.append(_coordinates(infos))
        row = _factors(source, record, where)
        for slot, srgb in _SLOTS.items():
            row[f"{slot}_texture"] = _layer(source, infos[slot], coordinates[-1], slot, srgb, where, layers, images)
        rows.append(row)
        for name in record.extensions:
            if str(name).startswith("KHR_materials_") and name != "KHR_materials_emissive_strength":
                source.note(f"material extension {printable(name)} ignored")
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    names = tuple(printable(record.name or f"material_{i}") for i, record in enumerate(records))
    return MaterialTable(
        Material(**{name: on_device(c) for name, c in columns.items()}),
        names,
        tuple(images),
        tuple(coordinates),
    )


def plain_materials(base_color: np.ndarray, emissive: np.ndarray) -> Material:
    """Rough, non-metallic, double-sided materials without textures, for formats that know only colors.

    Args:
      base_color: linear RGB by id, (m, 3). emissive: radiance, (m, 3).
    """
    m = len(base_color)
    none, one = on_device(np.full(m, -1)), on_device(np.ones(m))
    return Material(
        base_color=on_device(np.concatenate([base_color, np.ones((m, 1))], axis=1)),
        metallic=on_device(np.zeros(m)),
        roughness=one,
        emissive=on_device(emissive),
        normal_scale=one,
        occlusion_strength=one,
        alpha_mode=on_device(np.full(m, OPAQUE)),
        alpha_cutoff=on_device(np.full(m, 0.5)),
        double_sided=on_device(np.ones(m, bool)),
        base_color_texture=none,
        metallic_roughness_texture=none,
        normal_texture=none,
        occlusion_texture=none,
        emissive_texture=none,
    )


def _texture_infos(record: Any) -> dict[str, Any]:
    pbr = record.pbrMetallicRoughness
    return {
        "base_color": pbr and pbr.baseColorTexture,
        "metallic_roughness": pbr and pbr.metallicRoughnessTexture,
        "normal": record.normalTexture,
        "occlusion": record.occlusionTexture,
        "emissive": record.emissiveTexture,
    }


def _coordinates(infos: dict[str, Any]) -> Coordinates:
    for info in infos.values():
        if info is not None:
            return Coordinates(texcoord_name(info), uv_transform(info))
    return Coordinates(None)


def _factors(source: Container, record: Any, where: str) -> dict[str, Any]:
    """The numbers of a material under the names of `Material`; missing ones are the defaults of glTF."""
    pbr = record.pbrMetallicRoughness or pygltflib.PbrMetallicRoughness()
    if not isinstance(record.alphaMode, str | None) or record.alphaMode not in _ALPHA_MODES:
        source.bad(f"{where}.alphaMode", expected="OPAQUE, MASK or BLEND", got=record.alphaMode)
    strength = record.extensions.get("KHR_materials_emissive_strength", {})
    strength = strength.get("emissiveStrength") if isinstance(strength, dict) else None
    emissive = _numbers(source, record.emissiveFactor, [0.0] * 3, f"{where}.emissiveFactor", 1.0)
    normal, occlusion = record.normalTexture, record.occlusionTexture
    field = f"{where}.pbrMetallicRoughness"
    return {
        "base_color": _numbers(source, pbr.baseColorFactor, [1.0] * 4, f"{field}.baseColorFactor", 1.0),
        "metallic": _numbers(source, pbr.metallicFactor, 1.0, f"{field}.metallicFactor", 1.0),
        "roughness": _numbers(source, pbr.roughnessFactor, 1.0, f"{field}.roughnessFactor", 1.0),
        "emissive": emissive * _numbers(source, strength, 1.0, f"{where}.emissiveStrength", 1e9),
        "normal_scale": _numbers(source, normal and normal.scale, 1.0, f"{where}.normalTexture.scale", 1e3, -1e3),
        "occlusion_strength": _numbers(
            source, occlusion and occlusion.strength, 1.0, f"{where}.occlusionTexture.strength", 1.0
        ),
        "alpha_mode": _ALPHA_MODES[record.alphaMode],
        "alpha_cutoff": _numbers(source, record.alphaCutoff, 0.5, f"{where}.alphaCutoff", 1e3),
        "double_sided": bool(record.doubleSided),
    }


def _numbers(source: Container, value: Any, default: Any, where: str, high: float, low: float = 0.0) -> np.ndarray:
    """Finite numbers in the shape of the default, clipped to [low, high]."""
    value = default if value is None or value == [] else value
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.shape != np.shape(default) or not np.isfinite(array).all():
        count = np.size(default)
        source.bad(where, expected=f"{count} finite number{'s' if count > 1 else ''}", got=value)
    return np.clip(array, low, high)


def _layer(
    source: Container,
    info: Any,
    coordinates: Coordinates,
    slot: str,
    srgb: bool,
    where: str,
    layers: dict[tuple, int],
    images: list[SceneImage],
) -> int:
    """The layer of a texture: one for each image, wrap mode and transfer function; -1 without a texture."""
    if info is None:
        return -1
    texture = source.item("textures", info.index, f"{where} -> {slot} texture.index")
    name = _image_name(source, texture)
    try:
        if Coordinates(texcoord_name(info), uv_transform(info)) != coordinates:
            raise MissingTexture("it uses other texture coordinates than the material's first texture")
        texels = read_image(source, texture)
    except MissingTexture as reason:
        source.note(f"{slot.replace('_', ' ')} texture {name} left out ({reason})")
        return -1
    wrap_u, wrap_v = (_wrap(code) for code in wrap_codes(source, texture))
    key = image_index(texture), wrap_u, wrap_v, srgb
    if key not in layers:
        layers[key] = len(images)
        images.append(SceneImage(name, texels, (wrap_u, wrap_v), srgb))
    return layers[key]


def _wrap(code: Any) -> str:
    return "clamp" if code == CLAMP else "mirror" if code == MIRROR else "repeat"


def _image_name(source: Container, texture: Any) -> str:
    """The file of an image, or what stands for it inside the glTF."""
    index = image_index(texture)
    if index is None:
        return "without an image"
    record = source.item("images", index, "textures.source")
    outside = record.uri and not str(record.uri).startswith("data:")
    return printable(record.uri if outside else record.name or f"images[{index}]")
