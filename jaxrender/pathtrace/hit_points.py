"""Hits of rays -> the surface there. Three steps, of which each wants to be a program of its own on a CPU.

XLA computes an expression again for each of its uses in one program; gathers are the last thing to do twice.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender import vec3
from jaxrender.deferred.material_textures import MaterialTextures, material_slots
from jaxrender.deferred.pipeline import scene_material_textures
from jaxrender.deferred.texture import Textures, sample_bilinear, sample_trilinear
from jaxrender.scene import Material, Scene
from jaxrender.vec3 import Scalar, Vec3, dot, normalize
from jaxrender.vecmath import normalize as normalize_rows
from jaxrender.vecmath import safe_div, safe_sqrt

#: Columns by attribute of one corner.
_WIDTH = {"position": 3, "normal": 3, "uv": 2, "color": 4, "tangent": 4}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SurfaceTable:
    """A scene's attributes by triangle, ready to be gathered at hits.

    Attributes:
      corners: attributes of corner 0, then what has to be added for corners 1 and 2, those of `attributes` only; then
        the unit geometric normal of the front, and the density of texture coordinates (length in uv over length in the
        world, the geometric mean over the triangle).
    """

    corners: Float[Array, "t c"]
    material_id: Int[Array, " t"]
    material: Material
    textures: Textures | MaterialTextures | None
    attributes: tuple[str, ...] = field(metadata={"static": True})
    slots: tuple[str, ...] = field(metadata={"static": True})


class HitPoints(NamedTuple):
    """Where rays end, seen from the side they come from; all numbers are 0 where they hit nothing.

    Attributes:
      triangle: -1 where nothing is hit. material_id: 0 there.
      normal: of the vertices; geometric_normal: of the triangle; unit, on the side of the ray.
      tangent: along growing u, and handedness: the bitangent is handedness cross(normal, tangent).
      front: the ray hits the side from which the triangle is counter-clockwise.
      uv_width: width of the ray in texture coordinates.
      color: of the vertices, linear RGB. alpha: of the vertices.
    """

    triangle: Int[Array, " n"]
    material_id: Int[Array, " n"]
    position: Vec3
    normal: Vec3
    geometric_normal: Vec3
    tangent: Vec3
    handedness: Scalar
    front: Bool[Array, " n"]
    u: Scalar
    v: Scalar
    uv_width: Scalar
    color: Vec3
    alpha: Scalar


class HitSurface(NamedTuple):
    """`HitPoints` with material and textures.

    Attributes:
      normal: with the normal map.
      base_color, metallic, roughness, emissive, alpha: as in `deferred.Surface`.
    """

    triangle: Int[Array, " n"]
    position: Vec3
    normal: Vec3
    geometric_normal: Vec3
    front: Bool[Array, " n"]
    base_color: Vec3
    alpha: Scalar
    metallic: Scalar
    roughness: Scalar
    emissive: Vec3


def surface_table(
    scene: Scene, *, textures: Textures | MaterialTextures | None = None, only: tuple[str, ...] | None = None
) -> SurfaceTable:
    """Gathers what hits may ask for; attributes that say nothing are left out. Not for use inside `jit`.

    Args:
      textures: of `scene_material_textures`, made here if not given.
      only: the attributes that will be asked for; all by default.
    """
    textures = scene_material_textures(scene) if textures is None else textures
    slots = material_slots(scene.material) if textures is not None else ()
    by_name = {"position": scene.positions, "normal": scene.normals}
    if slots:
        by_name["uv"] = scene.uv
    if bool((np.asarray(scene.colors) != 1.0).any()):
        by_name["color"] = scene.colors
    if "normal_texture" in slots:
        by_name["tangent"] = scene.tangents
    if only is not None:
        # One at least.
        by_name = {name: by_name[name] for name in by_name if name in only} or {"position": scene.positions}
    return SurfaceTable(
        corners=_corner_rows(tuple(by_name.values()), scene.faces, scene.positions, scene.uv),
        material_id=scene.material_id, material=scene.material, textures=textures, attributes=tuple(by_name),
        slots=slots,
    )  # fmt: skip


@jax.jit
def _corner_rows(
    attributes: tuple[Float[Array, "v _"], ...], faces: Int[Array, "t 3"], positions: Float[Array, "v 3"],
    uv: Float[Array, "v 2"],
) -> Float[Array, "t c"]:  # fmt: skip
    """`SurfaceTable.corners`; one program, where this many single steps would be compiled each for itself."""
    values = jnp.concatenate(attributes, axis=1)
    a, b, c = (values[faces[:, k]] for k in range(3))
    p, q = (x[faces] for x in (positions, uv))
    doubled = jnp.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    edge_1, edge_2 = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
    uv_area = jnp.abs(edge_1[:, 0] * edge_2[:, 1] - edge_1[:, 1] * edge_2[:, 0])
    density = safe_sqrt(safe_div(uv_area, safe_sqrt(jnp.sum(doubled * doubled, axis=1))))
    return jnp.concatenate([a, b - a, c - a, normalize_rows(doubled), density[:, None]], axis=1)


def hit_surface(
    table: SurfaceTable,
    triangle: Int[Array, " n"],
    barycentrics: Float[Array, "n 2"],
    direction: Vec3,
    *,
    width: Scalar | None = None,
) -> HitSurface:
    """The surface where rays end.

    Differentiable in the table's attributes, textures and material for fixed hits.

    Args:
      triangle: -1 where a ray hits nothing; all fields are 0 there.
      direction: of the ray, towards the surface, unit.
      width: of the ray at the hit, across it, in the world: decides the level of textures. None is the finest.
    """
    points = interpolate(table, gather_corners(table, triangle), triangle, barycentrics, direction, width)
    return apply_material(table, points, look_up_texels(table, points, fine=width is None))


def gather_corners(table: SurfaceTable, triangle: Int[Array, " n"]) -> Float[Array, "c n"]:
    """The rows of triangles, as columns: each attribute's numbers then lie side by side."""
    return table.corners[jnp.maximum(triangle, 0)].T


def interpolate(
    table: SurfaceTable, corners: Float[Array, "c n"], triangle: Int[Array, " n"], barycentrics: Float[Array, "n 2"],
    direction: Vec3, width: Scalar | None,
) -> HitPoints:  # fmt: skip
    """Attributes at points of triangles, from `gather_corners`.

    References:
      Width in uv: Akenine-Möller et al., "Texture Level of Detail Strategies for Real-Time Ray Tracing", Ray Tracing
      Gems, 2019, eqs. 3, 5 and 34.
    """
    some = triangle >= 0
    b1, b2 = barycentrics[:, 0], barycentrics[:, 1]
    c = (corners.shape[0] - 4) // 3
    column = lambda k: jnp.where(some, corners[k] + b1 * corners[c + k] + b2 * corners[2 * c + k], 0.0)  # noqa: E731
    starts = dict(zip(table.attributes, np.cumsum([0, *(_WIDTH[name] for name in table.attributes)]), strict=False))
    read = lambda name, count, default: tuple(  # noqa: E731
        column(starts[name] + k) if name in starts else jnp.where(some, default, 0.0) for k in range(count)
    )
    flat = vec3.where(some, Vec3(*(corners[3 * c + k] for k in range(3))), 0.0)
    facing = dot(flat, direction)
    side = jnp.where(facing > 0.0, -1.0, 1.0)
    normal = normalize(Vec3(*read("normal", 3, 0.0)))
    # The triangle's own, where that of the vertices points away from its front, as at edges that walls share.
    normal = vec3.where(dot(normal, flat) > 1e-3, normal, flat)
    *tangent, handedness = read("tangent", 4, 0.0)
    *color, alpha = read("color", 4, 1.0)
    stretched = 0.0 if width is None else jnp.where(some, width, 0.0) / jnp.sqrt(jnp.maximum(jnp.abs(facing), 0.05))
    u, v = read("uv", 2, 0.0)
    return HitPoints(
        triangle, jnp.where(some, table.material_id[jnp.maximum(triangle, 0)], 0), Vec3(*read("position", 3, 0.0)),
        normal * side, flat * side, normalize(Vec3(*tangent)) * side, handedness * side, facing < 0.0,
        u, v, stretched * corners[3 * c + 3], Vec3(*color), alpha,
    )  # fmt: skip


def look_up_texels(table: SurfaceTable, points: HitPoints, *, fine: bool) -> dict[str, Float[Array, "n 4"]]:
    """The texels of each slot that a material of the scene uses; 1 where the own material does not.

    Args:
      fine: bilinear on the finest level, instead of trilinear by the width of the ray.
    """
    if table.textures is None:
        return {}
    uv, own = jnp.stack([points.u, points.v], axis=-1), points.material_id

    def read(textures: Textures, layer: Int[Array, " n"]) -> Float[Array, "n c"]:
        if fine:
            return sample_bilinear(textures, layer, uv, level=0)
        size = jnp.maximum(textures.width[layer, 0], textures.height[layer, 0]).astype(points.uv_width.dtype)
        return sample_trilinear(textures, layer, uv, lod=jnp.log2(jnp.maximum(points.uv_width * size, 1e-6)))

    if isinstance(table.textures, MaterialTextures):
        return table.textures.apart(read(table.textures.packed, own))
    found = {}
    for slot in table.slots:
        layer = getattr(table.material, slot)[own]
        found[slot] = jnp.where((layer >= 0)[:, None], read(table.textures, jnp.maximum(layer, 0)), 1.0)
    return found


def apply_material(table: SurfaceTable, points: HitPoints, texels: dict[str, Float[Array, "n 4"]]) -> HitSurface:
    """Factors times textures times vertex colors, and the normal map.

    References:
      glTF 2.0 specification, 3.9.
    """
    own, material = points.material_id, table.material
    some = points.triangle >= 0
    texel = lambda slot, k: texels[slot][:, k] if slot in texels else jnp.ones_like(points.alpha)  # noqa: E731
    rgb = lambda slot: Vec3(*(texel(slot, k) for k in range(3)))  # noqa: E731
    kept = lambda values: jnp.where(some, values, 0.0)  # noqa: E731
    factor = material.base_color[own]
    normal = points.normal
    if "normal_texture" in texels:
        normal = vec3.where(material.normal_texture[own] >= 0, _mapped(points, material, rgb("normal_texture")), normal)
    return HitSurface(
        triangle=points.triangle, position=points.position, normal=normal, geometric_normal=points.geometric_normal,
        front=points.front,
        base_color=vec3.where(some, vec3.from_array(factor) * rgb("base_color_texture") * points.color, 0.0),
        alpha=kept(factor[:, 3] * texel("base_color_texture", 3) * points.alpha),
        metallic=kept(material.metallic[own] * texel("metallic_roughness_texture", 2)),
        roughness=kept(material.roughness[own] * texel("metallic_roughness_texture", 1)),
        emissive=vec3.where(some, vec3.from_array(material.emissive[own]) * rgb("emissive_texture"), 0.0),
    )  # fmt: skip


def _mapped(points: HitPoints, material: Material, texel: Vec3) -> Vec3:
    """The normal turned by a texel of the normal map."""
    scale = material.normal_scale[points.material_id]
    local = texel * 2.0 - 1.0
    bitangent = vec3.cross(points.normal, points.tangent) * points.handedness
    return normalize(points.tangent * (local.x * scale) + bitangent * (local.y * scale) + points.normal * local.z)
