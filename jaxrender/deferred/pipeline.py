"""The stages in order: scene and camera -> fragments -> G-buffer -> radiance -> pixels."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender.camera import Camera, clip_from_world, depth_range
from jaxrender.checks import check_at_least, check_one_of
from jaxrender.deferred.bands import band_starts, in_bands
from jaxrender.deferred.cutouts import bleed_colors
from jaxrender.deferred.gbuffer import (
    POINT_FIELDS,
    AttributeTable,
    GBuffer,
    attribute_table,
    gbuffer_rows,
    make_gbuffer,
    rows_per_band,
    smooth_points,
    surface_points,
    with_motion,
)
from jaxrender.deferred.late import FragmentList, alpha_to_coverage, draw_late
from jaxrender.deferred.material_textures import MaterialTextures, look_up_material, material_slots, pack_materials
from jaxrender.deferred.raster import Fragments, rasterize_triangles, screen_triangles
from jaxrender.deferred.samples import CENTER, Samples
from jaxrender.deferred.shade import Surface, look_up_surface, shade
from jaxrender.deferred.texture import Textures, build_textures
from jaxrender.scene import DIRECTIONAL, MASK, OPAQUE, Lights, Scene, scene_bounds
from jaxrender.vecmath import matmul, normalize

TRANSPARENCY = ("test", "coverage", "none")

#: Samples that are shaded at a time.
SAMPLES_PER_BLOCK = 1024


def scene_textures(scene: Scene) -> Textures | None:
    """Mip chains of the scene's images, colors of hidden texels filled in; None if it has none."""
    if not scene.images:
        return None
    return build_textures(
        [bleed_colors(i.texels) if i.srgb and i.texels.shape[-1] == 4 else i.texels for i in scene.images],
        wrap=[image.wrap for image in scene.images],
        srgb=[image.srgb for image in scene.images],
    )


def scene_material_textures(scene: Scene) -> Textures | MaterialTextures | None:
    """`scene_textures`, packed by material if they allow it: the fastest to look up. Worth keeping between pictures."""
    textures = scene_textures(scene)
    return None if textures is None else pack_materials(textures, scene.material) or textures


def default_lights() -> tuple[Lights, Float[Array, "3 9"]]:
    """A warm sun from above and a blue sky over brown ground, for scenes that bring no light."""
    dtype = jnp.float32
    sun = jnp.asarray([[-0.35, -1.0, -0.25]], dtype)
    one = jnp.ones(1, dtype)
    lights = Lights(
        kind=jnp.full(1, DIRECTIONAL, jnp.int32), position=jnp.zeros((1, 3), dtype), direction=normalize(sun),
        intensity=jnp.asarray([[3.2, 3.0, 2.7]], dtype), range=jnp.inf * one, cos_inner=-one, cos_outer=-one,
    )  # fmt: skip
    zero = jnp.zeros((3, 9), dtype)
    # Order 3: a constant, and band 1 along y (index 1, with the sign of the basis).
    constant, up = jnp.asarray([0.75, 0.8, 0.9], dtype), jnp.asarray([0.12, 0.18, 0.3], dtype)
    return lights, zero.at[:, 0].set(3.5449 * 0.6 * constant).at[:, 1].set(-2.0467 * up)


def scene_lights(
    scene: Scene, lights: Lights | None, ambient: Float[Array, "3 k"] | None
) -> tuple[Lights, Float[Array, "3 k"] | None]:
    """The lights that are given, else the scene's, else `default_lights`."""
    if lights is None and ambient is None and not len(scene.lights.kind):
        return default_lights()
    return scene.lights if lights is None else lights, ambient


def clip_positions(scene: Scene, camera: Camera, *, height: int, width: int) -> Float[Array, "v 4"]:
    """The scene's vertices in the camera's clip space, with the tightest depth range that holds them."""
    near, far = depth_range(camera, *scene_bounds(scene))
    matrix = clip_from_world(camera, height=max(height, 1), width=max(width, 1), near=near, far=far)
    return matmul(jnp.pad(scene.positions, ((0, 0), (0, 1)), constant_values=1.0), matrix.T)


def see(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    textures: Textures | MaterialTextures | None = None,
    transparency: str = "test",
) -> Fragments:
    """What each sample sees: back faces culled unless a material has two sides, masked texels looked through.

    Not for use inside `jit`.

    Args:
      textures: of `scene_textures` or `scene_material_textures`, made here if they are needed and not given.
      transparency: "test" discards masked texels below their cutoff, as glTF rules, and draws blended materials as
        opaque; "coverage" turns the alpha of both into a share of the samples (`late.alpha_to_coverage`), which wants
        several of them; "none" takes everything as opaque.
    """
    check_one_of("transparency", transparency, TRANSPARENCY)
    clip = clip_positions(scene, camera, height=height, width=width)
    two_sided = scene.material.double_sided[scene.material_id]
    triangles = screen_triangles(
        clip, scene.faces, height=height, width=width, samples=samples, cull="back", two_sided=two_sided
    )
    draw = functools.partial(rasterize_triangles, faces=scene.faces, height=height, width=width, samples=samples)
    mode = scene.material.alpha_mode[scene.material_id]
    clear = {"test": mode == MASK, "coverage": mode != OPAQUE, "none": jnp.zeros_like(mode, bool)}[transparency]
    if not bool(clear.any()):
        return draw(triangles)
    textures = scene_textures(scene) if textures is None else textures
    if isinstance(textures, MaterialTextures):
        textures = textures.single
    early, late = _split(triangles, clear)
    table = scene_table(scene, triangles, None, grid=samples.grid)
    keep = functools.partial(
        _keep, scene, table, textures, num_samples=samples.count, width=width, coverage=transparency == "coverage",
    )  # fmt: skip
    return dataclasses.replace(draw_late(draw(early), late, keep), triangles=triangles)


@jax.jit
def _split(triangles, clear: Bool[Array, " t"]):
    """The triangles that are drawn early, and those that are drawn late."""
    late = clear[triangles.source]
    return tuple(dataclasses.replace(triangles, valid=triangles.valid & own) for own in (~late, late))


scene_table = jax.jit(
    lambda scene, triangles, previous_clip, grid: attribute_table(
        scene, triangles, grid=grid, previous_clip=previous_clip
    ),
    static_argnames="grid",
)


@functools.partial(jax.jit, static_argnames=("num_samples", "width", "coverage"))
def _keep(
    scene: Scene, table: AttributeTable, textures: Textures | None, late: FragmentList, *, num_samples: int,
    width: int, coverage: bool,
) -> tuple[Bool[Array, " n"], Float[Array, " n"]]:  # fmt: skip
    """The shader of masked materials; textures are looked up trilinearly."""
    gbuffer, _ = surface_points(scene, table, late.triangle_id, late.screen_id, late.barycentrics, late.w)
    surface = look_up_surface(gbuffer, scene.material, textures, max_anisotropy=1, slots=("base_color_texture",))
    material = jnp.maximum(gbuffer.material_id, 0)
    masked, cutoff = scene.material.alpha_mode[material] == MASK, scene.material.alpha_cutoff[material]
    if coverage:
        # The edge of a mask stays where the cutoff puts it, twice as steep.
        alpha = jnp.where(masked, jnp.clip(2.0 * (surface.alpha - cutoff) + 0.5, 0.0, 1.0), surface.alpha)
        return alpha_to_coverage(alpha, late.place, num_samples=num_samples, width=width), late.depth
    return ~masked | (surface.alpha >= cutoff), late.depth


@dataclasses.dataclass(frozen=True)
class Rendering:
    """An image (linear RGB, not multiplied by alpha = share of covered samples), and what it was made of."""

    image: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    gbuffer: GBuffer
    surface: Surface


def render_scene(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    textures: Textures | MaterialTextures | None = None,
    lights: Lights | None = None,
    ambient: Float[Array, "3 k"] | None = None,
    max_anisotropy: int = 8,
    transparency: str = "test",
    model: str = "metallic_roughness",
    previous_clip: Float[Array, "v 4"] | None = None,
) -> Rendering:
    """Renders a scene with its own lights, or with a sun and a sky if it has none; samples are averaged.

    Not for use inside `jit`; from fragments on, everything it calls is.

    Args:
      textures: of `scene_material_textures` or `scene_textures`, made here if not given.
      lights, ambient: instead of the scene's.
      transparency: as in `see`; model: as in `shade`; previous_clip: as in `make_gbuffer`.
    """
    check_at_least("height", height, 1)
    check_at_least("width", width, 1)
    textures = scene_material_textures(scene) if textures is None else textures
    lights, ambient = scene_lights(scene, lights, ambient)
    fragments = see(
        scene, camera, height=height, width=width, samples=samples, textures=textures, transparency=transparency
    )
    table = scene_table(scene, fragments.triangles, previous_clip, grid=samples.grid)
    # At least as many rows as a square block of samples has.
    square = min(round((SAMPLES_PER_BLOCK / samples.count) ** 0.5), height)
    band = max(rows_per_band(height, width * samples.count), square)
    rows = functools.partial(
        _shaded_rows, scene, table, fragments, textures, lights, ambient, camera.eye, num_rows=band,
        max_anisotropy=max_anisotropy, slots=material_slots(scene.material), model=model,
    )  # fmt: skip
    gbuffer, surface, mean, share = in_bands(
        lambda start: rows(np.int32(start)), band_starts(height, band), height=height
    )
    return Rendering(np.asarray(mean), np.asarray(share), gbuffer, surface)


@functools.partial(jax.jit, static_argnames=("num_rows", "max_anisotropy", "slots", "model"))
def _shaded_rows(
    scene, table, fragments, textures, lights, ambient, eye, start, *, num_rows, max_anisotropy, slots, model
):
    """G-buffer, surface, mean radiance and coverage of some rows, block by block.

    A block is small and square, so that its footprints are alike: a lookup costs as much as its widest one.
    """
    rows = {name: jax.lax.dynamic_slice_in_dim(getattr(fragments, name), start, num_rows) for name in POINT_FIELDS}
    _, width, num_samples = rows["triangle_id"].shape
    columns = max(1, min(width, SAMPLES_PER_BLOCK // (num_rows * num_samples)))

    def block(own: dict[str, Array]) -> tuple:
        gbuffer, tangent, previous = smooth_points(table, **own)
        surface, normal = look_up_material(
            gbuffer, tangent, scene.material, textures, max_anisotropy=max_anisotropy, slots=slots
        )
        gbuffer = dataclasses.replace(gbuffer, normal=normal)
        radiance = shade(gbuffer, surface, lights, eye, ambient=ambient, model=model)
        share = jnp.mean(gbuffer.coverage.astype(jnp.float32), axis=-1)
        mean = jnp.sum(radiance, axis=-2) / jnp.maximum(share[..., None] * num_samples, 1.0)
        return gbuffer, previous, surface, mean, share

    def cut(values: Array) -> Array:
        empty = [(0, 0), (0, -width % columns), *((0, 0) for _ in values.shape[2:])]
        whole = jnp.pad(values, empty, constant_values=-1 if values.dtype == jnp.int32 else 0)
        return whole.reshape(num_rows, -1, columns, *values.shape[2:]).swapaxes(0, 1)

    def join(values: Array) -> Array:
        return values.swapaxes(0, 1).reshape(num_rows, -1, *values.shape[3:])[:, :width]

    shaded = jax.lax.map(block, jax.tree.map(cut, rows))
    gbuffer, previous, surface, mean, share = jax.tree.map(join, shaded)
    return with_motion(gbuffer, fragments, previous, start), surface, mean, share


def draw_gbuffer(
    scene: Scene,
    fragments: Fragments,
    *,
    textures: Textures | None = None,
    max_anisotropy: int = 8,
    previous_clip: Float[Array, "v 4"] | None = None,
) -> GBuffer:
    """`make_gbuffer` for large images: on all cores, in bounded memory. Not for use inside `jit`."""
    height, width, num_samples = fragments.triangle_id.shape
    if not fragments.triangle_id.size:
        return make_gbuffer(scene, fragments, previous_clip=previous_clip)
    table = scene_table(scene, fragments.triangles, previous_clip, grid=fragments.samples.grid)
    band = rows_per_band(height, width * num_samples, times=2)
    rows = functools.partial(
        _gbuffer_rows, scene, table, fragments, num_rows=band, textures=textures, max_anisotropy=max_anisotropy
    )
    return in_bands(lambda start: rows(np.int32(start)), band_starts(height, band), height=height)


_gbuffer_rows = jax.jit(gbuffer_rows, static_argnames=("num_rows", "max_anisotropy"))
