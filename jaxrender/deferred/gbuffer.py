"""Fragments and a scene -> GBuffer: everything that shading wants to know of the surface each sample sees.

Differentiable in the scene's positions, normals, colors and uv for fixed fragments (see `interpolate`).
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_last_axis
from jaxrender.deferred.interpolate import sample_places
from jaxrender.deferred.raster import Fragments
from jaxrender.deferred.texture import Textures, sample_texture_grad
from jaxrender.deferred.triangles import SUBPIXELS, ScreenTriangles, plane_steps
from jaxrender.scene import Material, Scene
from jaxrender.vecmath import normalize

#: Samples that are interpolated at a time; what they gather stays in a processor's cache.
SAMPLES_PER_BAND = 1 << 15

#: What `surface_points` wants to know of a sample: fields of `Fragments`.
POINT_FIELDS = ("triangle_id", "screen_id", "barycentrics", "w")


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
      motion: where the surface is in this picture, less where it was in the previous one, in pixels, x right and y
        down. None without a previous pose; 0 where it was behind the eye.
    """

    position: Float[Array, "*b 3"]
    normal: Float[Array, "*b 3"]
    geometric_normal: Float[Array, "*b 3"]
    uv: Float[Array, "*b 2"]
    duv_dx: Float[Array, "*b 2"]
    duv_dy: Float[Array, "*b 2"]
    color: Float[Array, "*b 4"]
    depth: Float[Array, "*b"]
    material_id: Int[Array, "*b"]
    triangle_id: Int[Array, "*b"]
    motion: Float[Array, "*b 2"] | None = None

    @property
    def coverage(self) -> Bool[Array, "*b"]:
        return self.triangle_id >= 0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AttributeTable:
    """The attributes of a scene, ready to be gathered by sample: a row for each triangle of the mesh or the screen.

    Attributes:
      corner: attributes of corner 0 and what has to be added for corners 1 and 2, side by side: position, normal, uv,
        color, tangent, and previous clip position if there is one.
      flat: unit geometric normal of the front; material_id: by triangle of the mesh.
      slopes: by screen triangle, steps of 1/w, b_1/w and b_2/w per pixel to the right, then downwards.
      front: by screen triangle.
    """

    corner: Float[Array, "t c"]
    flat: Float[Array, "t 3"]
    material_id: Int[Array, " t"]
    slopes: Float[Array, "n 6"]
    front: Bool[Array, " n"]


def attribute_table(
    scene: Scene, triangles: ScreenTriangles, *, grid: int = 1, previous_clip: Float[Array, "v 4"] | None = None
) -> AttributeTable:
    """Gathers the attributes of all triangles.

    Args:
      triangles: of the fragments; grid: m of their m x m samples.
      previous_clip: clip positions of the vertices in the previous picture.
    """
    values = [scene.positions, scene.normals, scene.uv, scene.colors, scene.tangents]
    values += [] if previous_clip is None else [previous_clip]
    a, b, c = (jnp.concatenate(values, axis=1)[scene.faces[:, k]] for k in range(3))
    p = scene.positions[scene.faces]
    right, down = plane_steps(triangles, unit=SUBPIXELS * grid)
    return AttributeTable(
        corner=jnp.concatenate([a, b - a, c - a], axis=1),
        flat=normalize(jnp.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])),
        material_id=scene.material_id,
        slopes=jnp.stack([*right[1:], *down[1:]], axis=1),
        front=triangles.front,
    )


def rows_per_band(height: int, samples_per_row: int, *, times: int = 1) -> int:
    """Rows of an image that are interpolated at a time: `SAMPLES_PER_BAND` samples, or some times as many."""
    return min(max(1, times * SAMPLES_PER_BAND // max(1, samples_per_row)), height)


def make_gbuffer(
    scene: Scene,
    fragments: Fragments,
    *,
    textures: Textures | None = None,
    max_anisotropy: int = 8,
    previous_clip: Float[Array, "v 4"] | None = None,
) -> GBuffer:
    """Interpolates the scene's attributes at all samples.

    Args:
      textures: of the scene's images; without them there are no normal maps.
      max_anisotropy: taps of a normal map's lookup.
      previous_clip: clip positions of the vertices in the previous picture, for `GBuffer.motion`.
    """
    grid = fragments.samples.grid
    table = attribute_table(scene, fragments.triangles, grid=grid, previous_clip=previous_clip)
    h, w, s = fragments.triangle_id.shape
    if not fragments.triangle_id.size:
        return gbuffer_rows(scene, table, fragments, 0, num_rows=h)
    band = rows_per_band(h, w * s)
    starts = jnp.arange(-(-h // band), dtype=jnp.int32) * band
    interpolated = jax.lax.map(
        lambda start: gbuffer_rows(
            scene, table, fragments, jnp.minimum(start, h - band), num_rows=band, textures=textures,
            max_anisotropy=max_anisotropy,
        ),
        starts,
    )  # fmt: skip
    return jax.tree.map(lambda values: _joined(values, h), interpolated)


def _joined(bands: Array, height: int) -> Array:
    """Bands of rows one below the other; the last one begins higher up, if it would not fit."""
    n, band, *rest = bands.shape
    if n * band == height:
        return bands.reshape(height, *rest)
    return jnp.concatenate([bands[:-1].reshape(-1, *rest), bands[-1, n * band - height :]])


def gbuffer_rows(
    scene: Scene,
    table: AttributeTable,
    fragments: Fragments,
    start: Int[Array, ""] | int,
    *,
    num_rows: int,
    textures: Textures | None = None,
    max_anisotropy: int = 8,
) -> GBuffer:
    """All fields for some rows of an image, from row `start` on.

    Args:
      table: of `attribute_table`.
    """
    rows = {name: jax.lax.dynamic_slice_in_dim(getattr(fragments, name), start, num_rows) for name in POINT_FIELDS}
    gbuffer, previous = surface_points(scene, table, **rows, textures=textures, max_anisotropy=max_anisotropy)
    return with_motion(gbuffer, fragments, previous, start)


def surface_points(
    scene: Scene, table: AttributeTable, triangle_id: Int[Array, "*b"], screen_id: Int[Array, "*b"],
    barycentrics: Float[Array, "*b 2"], w: Float[Array, "*b"], *, textures: Textures | None = None,
    max_anisotropy: int = 8,
) -> tuple[GBuffer, Float[Array, "*b 4"] | None]:  # fmt: skip
    """Points on triangles, in any order: the fields of `Fragments` or of `late.FragmentList` -> those of `GBuffer`.

    Returns:
      the surface there, with any leading axes, and the previous clip position, if the table has them.
    """
    gbuffer, tangent, previous = smooth_points(table, triangle_id, screen_id, barycentrics, w)
    if textures is not None:
        normal = mapped_normal(gbuffer, tangent, scene.material, textures, max_anisotropy=max_anisotropy)
        gbuffer = dataclasses.replace(gbuffer, normal=normal)
    return gbuffer, previous


def smooth_points(
    table: AttributeTable, triangle_id: Int[Array, "*b"], screen_id: Int[Array, "*b"],
    barycentrics: Float[Array, "*b 2"], w: Float[Array, "*b"], *, shift: Float[Array, "*b 2"] | None = None,
) -> tuple[GBuffer, Float[Array, "*b 4"], Float[Array, "*b 4"] | None]:  # fmt: skip
    """`surface_points` before the normal map.

    Args:
      shift: (x, y) in pixels, y down: the surface is taken so far away from the point, in the plane of its triangle.
    Returns:
      the surface; the tangent of its side (see `mapped_normal`); the previous clip position, if the table has them.
    """
    some, own, screen = (triangle_id >= 0)[..., None], jnp.maximum(triangle_id, 0), jnp.maximum(screen_id, 0)
    slopes = table.slopes[screen]
    if shift is not None:
        barycentrics, w = _shifted(barycentrics, w, slopes, shift)
    b1, b2 = barycentrics[..., :1], barycentrics[..., 1:]
    corner = table.corner[own]
    c = corner.shape[-1] // 3
    step_1, step_2 = corner[..., c : 2 * c], corner[..., 2 * c :]
    values = jnp.where(some, corner[..., :c] + b1 * step_1 + b2 * step_2, 0.0)
    position, normal, uv, color, tangent, previous = jnp.split(values, [3, 6, 8, 12, 16], axis=-1)
    # A = a_0 + b_1 (a_1 - a_0) + b_2 (a_2 - a_0), and db_k = w (d(b_k/w) - b_k d(1/w)).
    duv_dx, duv_dy = (
        jnp.where(some, w[..., None] * ((d[..., 1:2] - b1 * d[..., :1]) * step_1[..., 6:8]
                                        + (d[..., 2:] - b2 * d[..., :1]) * step_2[..., 6:8]), 0.0)
        for d in (slopes[..., :3], slopes[..., 3:])
    )  # fmt: skip
    # The back of a surface is seen only where it has two sides; there its normals are turned over.
    side = jnp.where(some, jnp.where(table.front[screen], 1.0, -1.0)[..., None], 0.0)
    gbuffer = GBuffer(
        position=position, normal=normalize(normal) * side, geometric_normal=table.flat[own] * side, uv=uv,
        duv_dx=duv_dx, duv_dy=duv_dy, color=color, depth=w,
        material_id=jnp.where(some[..., 0], table.material_id[own], -1), triangle_id=triangle_id,
    )  # fmt: skip
    return gbuffer, tangent * side, previous if previous.shape[-1] else None


def _shifted(
    barycentrics: Float[Array, "*b 2"], w: Float[Array, "*b"], slopes: Float[Array, "*b 6"], shift: Float[Array, "*b 2"]
) -> tuple[Float[Array, "*b 2"], Float[Array, "*b"]]:
    """Barycentrics and w some way along the plane of the triangle: 1/w and b/w are linear on the screen."""
    step = slopes[..., :3] * shift[..., :1] + slopes[..., 3:] * shift[..., 1:]
    inverse = jnp.where(w > 0.0, 1.0 / jnp.where(w > 0.0, w, 1.0), 0.0)
    # Beyond four times the depth the plane is as good as edge-on.
    moved = 1.0 / jnp.where(w > 0.0, jnp.maximum(inverse + step[..., 0], 0.25 * inverse), 1.0)
    barycentrics = (barycentrics * inverse[..., None] + step[..., 1:]) * moved[..., None]
    return barycentrics, jnp.where(w > 0.0, moved, 0.0)


def with_motion(
    gbuffer: GBuffer, fragments: Fragments, previous: Float[Array, "r w s 4"] | None, start: Int[Array, ""] | int
) -> GBuffer:
    """Rows from `start` on with `GBuffer.motion`, if there are previous clip positions."""
    if previous is None:
        return gbuffer
    h, w, _ = fragments.triangle_id.shape
    check_last_axis("previous_clip", previous, 4)
    unit = SUBPIXELS * fragments.samples.grid
    x, y = (
        jax.lax.dynamic_slice_in_dim(at, start, len(previous)).astype(previous.dtype) / unit
        for at in sample_places(fragments)
    )
    seen = previous[..., 3] > 0.0
    over_w = 1.0 / jnp.where(seen, previous[..., 3], 1.0)
    moved = jnp.stack([x - 0.5 * w * previous[..., 0] * over_w, y + 0.5 * h * previous[..., 1] * over_w], axis=-1)
    return dataclasses.replace(gbuffer, motion=jnp.where(seen[..., None], moved, 0.0))


def mapped_normal(
    gbuffer: GBuffer, tangent: Float[Array, "*b 4"], material: Material, textures: Textures, *, max_anisotropy: int = 8
) -> Float[Array, "*b 3"]:
    """The shading normal turned by the material's normal map, where it has one.

    Args:
      tangent: direction of growing u, and 1 or -1 for the sense of the bitangent; both change sign with the side.
    """
    layer = material.normal_texture[jnp.maximum(gbuffer.material_id, 0)]
    texel = sample_texture_grad(
        textures, gbuffer.uv, gbuffer.duv_dx, gbuffer.duv_dy, layer=jnp.maximum(layer, 0), max_anisotropy=max_anisotropy
    )
    return turned_normal(gbuffer, tangent, material, texel[..., :3])


def turned_normal(
    gbuffer: GBuffer, tangent: Float[Array, "*b 4"], material: Material, texel: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """`mapped_normal` for texels of the normal map that were looked up already."""
    own, normal = jnp.maximum(gbuffer.material_id, 0), gbuffer.normal
    scale = material.normal_scale[own][..., None]
    local = (2.0 * texel - 1.0) * jnp.concatenate([scale, scale, jnp.ones_like(scale)], axis=-1)
    t = normalize(tangent[..., :3])
    b = jnp.cross(normal, t) * tangent[..., 3:]
    turned = normalize(local[..., :1] * t + local[..., 1:2] * b + local[..., 2:] * normal)
    return jnp.where((material.normal_texture[own] >= 0)[..., None], turned, normal)
