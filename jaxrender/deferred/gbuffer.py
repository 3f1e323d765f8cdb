"""Fragments and a scene -> GBuffer: everything that shading wants to know of the surface each sample sees.

Differentiable in the scene's positions, normals, colors and uv for fixed fragments (see `interpolate`).
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrender.deferred.interpolate import attribute_gradients, blend, corner_weights
from jaxrender.deferred.raster import Fragments
from jaxrender.deferred.texture import Textures, sample_texture_grad
from jaxrender.scene import Scene
from jaxrender.vecmath import normalize

#: Rows of the image that are interpolated at a time.
ROWS_PER_BAND = 8


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GBuffer:
    """The surface at each sample; every field is 0 where the sample is empty, ids are -1.

    Attributes:
      position: in the world.
      normal: unit shading normal on the side of the eye, with the normal map applied.
      geometric_normal: unit normal of the triangle, on the side of the eye.
      uv: texture coordinates; duv_dx, duv_dy their exact derivatives, per pixel to the right and downwards.
      color: linear RGBA of the vertex colors.
      depth: linear view depth (clip w) of a perspective camera.
      material_id, triangle_id: -1 where empty.
    """

    position: Float[Array, "h w s 3"]
    normal: Float[Array, "h w s 3"]
    geometric_normal: Float[Array, "h w s 3"]
    uv: Float[Array, "h w s 2"]
    duv_dx: Float[Array, "h w s 2"]
    duv_dy: Float[Array, "h w s 2"]
    color: Float[Array, "h w s 4"]
    depth: Float[Array, "h w s"]
    material_id: Int[Array, "h w s"]
    triangle_id: Int[Array, "h w s"]

    @property
    def coverage(self) -> Bool[Array, "h w s"]:
        return self.triangle_id >= 0


def make_gbuffer(
    scene: Scene, fragments: Fragments, *, textures: Textures | None = None, max_anisotropy: int = 8
) -> GBuffer:
    """Interpolates the scene's attributes at all samples.

    Args:
      textures: of the scene's images; without them there are no normal maps.
      max_anisotropy: taps of a normal map's lookup.
    """
    h, band = fragments.triangle_id.shape[0], ROWS_PER_BAND

    attributes = jnp.concatenate([scene.positions, scene.normals, scene.tangents, scene.uv, scene.colors], axis=-1)
    corners = scene.positions[scene.faces]
    flat = normalize(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))

    def some_rows(fields: dict[str, Any]) -> GBuffer:
        own = dataclasses.replace(fragments, **fields)
        return _interpolated(scene, own, textures, attributes, flat, max_anisotropy=max_anisotropy)

    # Band by band: what a band gathers stays in a processor's cache.
    names = ("triangle_id", "screen_id", "barycentrics", "depth", "w")
    fields = {name: _in_bands(getattr(fragments, name), band, -1 if name.endswith("_id") else 0) for name in names}
    return jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:])[:h], jax.lax.map(some_rows, fields))


def _in_bands(image: Array, band: int, empty: int) -> Array:
    """Rows in groups of `band`, filled up with empty ones."""
    h, *rest = image.shape
    padding = [(0, -h % band), *((0, 0) for _ in rest)]
    return jnp.pad(image, padding, constant_values=empty).reshape(-1, band, *rest)


def _interpolated(
    scene: Scene, fragments: Fragments, textures: Textures | None, attributes: Float[Array, "v 16"],
    flat: Float[Array, "t 3"], *, max_anisotropy: int,
) -> GBuffer:  # fmt: skip
    """All fields for some rows of an image, from all vertex attributes side by side and the triangles' normals."""
    weights = corner_weights(fragments)
    values = blend(fragments, attributes, weights)
    position, normal, tangent, uv, color = jnp.split(values, [3, 6, 10, 12], axis=-1)
    duv_dx, duv_dy = attribute_gradients(fragments, scene.uv)
    covered = fragments.coverage
    triangle = jnp.maximum(fragments.triangle_id, 0)
    material_id = jnp.where(covered, scene.material_id[triangle], -1)
    # The back of a surface is seen only where it has two sides; there its normals are turned over.
    side = jnp.where(fragments.triangles.front[jnp.maximum(fragments.screen_id, 0)], 1.0, -1.0)[..., None]
    normal = normalize(normal)
    if textures is not None:
        lookup = uv, duv_dx, duv_dy, max_anisotropy
        normal = _with_normal_map(scene, textures, normal, tangent, jnp.maximum(material_id, 0), lookup)
    some = covered[..., None]
    return GBuffer(
        position=position,
        normal=jnp.where(some, normal * side, 0.0),
        geometric_normal=jnp.where(some, flat[triangle] * side, 0.0),
        uv=uv,
        duv_dx=duv_dx,
        duv_dy=duv_dy,
        color=color,
        depth=fragments.w,
        material_id=material_id,
        triangle_id=fragments.triangle_id,
    )


def _with_normal_map(
    scene: Scene, textures: Textures, normal: Float[Array, "h w s 3"], tangent: Float[Array, "h w s 4"],
    material: Int[Array, "h w s"], lookup: tuple,
) -> Float[Array, "h w s 3"]:  # fmt: skip
    """The shading normal turned by the material's normal map, where it has one."""
    uv, duv_dx, duv_dy, max_anisotropy = lookup
    layer = scene.material.normal_texture[material]
    texel = sample_texture_grad(
        textures, uv, duv_dx, duv_dy, layer=jnp.maximum(layer, 0), max_anisotropy=max_anisotropy
    )[..., :3]
    scale = scene.material.normal_scale[material][..., None]
    local = (2.0 * texel - 1.0) * jnp.concatenate([scale, scale, jnp.ones_like(scale)], axis=-1)
    t = normalize(tangent[..., :3])
    b = jnp.cross(normal, t) * tangent[..., 3:]
    turned = normalize(local[..., :1] * t + local[..., 1:2] * b + local[..., 2:] * normal)
    return jnp.where((layer >= 0)[..., None], turned, normal)
