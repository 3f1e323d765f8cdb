"""All textures of a material side by side in the channels of one: a lookup works out addresses and weights once."""

import dataclasses
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.deferred.gbuffer import GBuffer, mapped_normal, turned_normal
from jaxrender.deferred.shade import TEXTURE_SLOTS, Surface, look_up_surface, surface_of_texels
from jaxrender.deferred.texture import Textures, sample_texture_grad
from jaxrender.scene import Material

NORMAL = "normal_texture"

#: Which channels of a texture its slot reads (glTF 2.0, 3.9).
_CHANNELS = {
    "base_color_texture": (0, 1, 2, 3),
    "metallic_roughness_texture": (1, 2),
    "occlusion_texture": (0,),
    "emissive_texture": (0, 1, 2),
    NORMAL: (0, 1, 2),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MaterialTextures:
    """All textures of a scene.

    Attributes:
      single: one layer for each image.
      packed: one layer for each material; the channels of `slots` stand one after another.
    """

    single: Textures
    packed: Textures
    slots: tuple[str, ...] = field(metadata={"static": True})

    def apart(self, found: Float[Array, "*b c"]) -> dict[str, Float[Array, "*b 4"]]:
        """What was looked up in `packed`, by slot, channels at their places and 1 where a slot has none."""
        ends = np.cumsum([len(_CHANNELS[slot]) for slot in self.slots])
        parts = zip(self.slots, jnp.split(found, ends[:-1], axis=-1), strict=True)
        return {slot: _rgba(slot, part) for slot, part in parts}


def material_slots(material: Material) -> tuple[str, ...]:
    """The fields of a material that name a texture anywhere. Not for use inside `jit`."""
    return tuple(slot for slot in _CHANNELS if bool((np.asarray(getattr(material, slot)) >= 0).any()))


def pack_materials(textures: Textures, material: Material) -> MaterialTextures | None:
    """One layer for each material, with all levels.

    None if the textures of a material differ in size or wrap, which then have to be looked up one by one. Not for use
    inside `jit`.
    """
    slots = material_slots(material)
    table = jax.tree.map(np.asarray, textures)
    layers = [[int(np.asarray(getattr(material, slot))[k]) for slot in slots] for k in range(len(material.metallic))]
    shapes = [{_shape(table, k) for k in own if k >= 0} or {((1, 1), (0, 0))} for own in layers]
    if not slots or any(len(own) > 1 for own in shapes):
        return None
    chosen = [next((k for k in own if k >= 0), None) for own in layers]
    texels = [_packed(table, own, one, slots) for own, one in zip(layers, chosen, strict=True)]
    return MaterialTextures(textures, _stacked(table, chosen, texels), slots)


def look_up_material(
    gbuffer: GBuffer, tangent: Float[Array, "*#b 4"] | None, material: Material,
    textures: Textures | MaterialTextures | None, *, max_anisotropy: int = 8, slots: tuple[str, ...],
) -> tuple[Surface, Float[Array, "*b 3"]]:  # fmt: skip
    """The material at each sample (`look_up_surface`), and the normal (`mapped_normal`).

    Args:
      tangent: of `smooth_points`; None to leave the normal as it is.
      slots: as of `material_slots`; those that are not named are not looked up, or have no effect.
    """
    if not isinstance(textures, MaterialTextures):
        known = tuple(slot for slot in slots if slot in TEXTURE_SLOTS)
        surface = look_up_surface(gbuffer, material, textures, max_anisotropy=max_anisotropy, slots=known)
        if textures is None or tangent is None or NORMAL not in slots:
            return surface, gbuffer.normal
        return surface, mapped_normal(gbuffer, tangent, material, textures, max_anisotropy=max_anisotropy)
    own = jnp.maximum(gbuffer.material_id, 0)
    found = sample_texture_grad(
        textures.packed, gbuffer.uv, gbuffer.duv_dx, gbuffer.duv_dy, layer=own, max_anisotropy=max_anisotropy
    )
    parts = textures.apart(found)
    texels = {slot: parts[slot] for slot in parts if slot in slots and slot in TEXTURE_SLOTS}
    surface = surface_of_texels(gbuffer, material, texels)
    if tangent is None or NORMAL not in slots:
        return surface, gbuffer.normal
    return surface, turned_normal(gbuffer, tangent, material, parts[NORMAL][..., :3])


def _rgba(slot: str, values: Float[Array, "*b c"]) -> Float[Array, "*b 4"]:
    """Channels back at their places."""
    one = jnp.ones_like(values[..., :1])
    columns = {channel: values[..., i : i + 1] for i, channel in enumerate(_CHANNELS[slot])}
    return jnp.concatenate([columns.get(channel, one) for channel in range(4)], axis=-1)


def _shape(table: Textures, layer: int) -> tuple[tuple[int, int], tuple[int, int]]:
    size = int(table.height[layer, 0]), int(table.width[layer, 0])
    return size, (int(table.wrap[layer, 0]), int(table.wrap[layer, 1]))


def _packed(table: Textures, layers: list[int], one: int | None, slots: tuple[str, ...]) -> np.ndarray:
    """Texels of all levels of one material; a texture that is missing is 1."""
    count = 1 if one is None else _num_texels(table, one)
    columns = []
    for layer, slot in zip(layers, slots, strict=True):
        start = 0 if layer < 0 else int(table.offset[layer, 0])
        own = table.texels[start : start + count] if layer >= 0 else np.ones((count, 4), table.texels.dtype)
        columns.append(own[:, list(_CHANNELS[slot])])
    return np.concatenate(columns, axis=1)


def _num_texels(table: Textures, layer: int) -> int:
    last = int(table.num_levels[layer]) - 1
    end = int(table.offset[layer, last]) + int(table.width[layer, last]) * int(table.height[layer, last])
    return end - int(table.offset[layer, 0])


def _stacked(table: Textures, chosen: list[int | None], texels: list[np.ndarray]) -> Textures:
    """The tables of the layers that gave each material its size; materials without a texture have one texel."""
    starts = np.cumsum([0, *(len(own) for own in texels[:-1])])
    pick = np.array([0 if one is None else one for one in chosen])
    some = np.array([one is not None for one in chosen])[:, None]
    level = lambda values, empty: np.where(some, values[pick], empty)  # noqa: E731
    offset = level(table.offset - table.offset[:, :1], 0) + starts[:, None]
    tables = dataclasses.replace(
        table, texels=jnp.asarray(np.concatenate(texels)), offset=offset.astype(np.int32), width=level(table.width, 1),
        height=level(table.height, 1), num_levels=level(table.num_levels[:, None], 1)[:, 0], wrap=level(table.wrap, 0),
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, tables)
