"""The stages in order: scene and camera -> fragments -> G-buffer -> radiance -> pixels."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.camera import Camera, clip_from_world, depth_range
from jaxrender.deferred.gbuffer import GBuffer, make_gbuffer
from jaxrender.deferred.raster import Fragments, rasterize
from jaxrender.deferred.samples import CENTER, Samples
from jaxrender.deferred.shade import Surface, look_up_surface, shade
from jaxrender.deferred.texture import Textures, build_textures
from jaxrender.scene import DIRECTIONAL, MASK, Lights, Scene, scene_bounds
from jaxrender.vecmath import normalize

#: Layers of masked surfaces behind each other that are looked through before the rest counts as opaque.
MAX_LAYERS = 64


def scene_textures(scene: Scene) -> Textures | None:
    """Mip chains of the scene's images; None if it has none."""
    if not scene.images:
        return None
    return build_textures(
        [image.texels for image in scene.images],
        wrap=[image.wrap for image in scene.images],
        srgb=[image.srgb for image in scene.images],
    )


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


def see(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    textures: Textures | None = None,
    max_layers: int = MAX_LAYERS,
) -> tuple[Fragments, int]:
    """What each sample sees: back faces culled unless a material has two sides, masked texels looked through.

    Returns:
      fragments, and the number of samples still on a discarded texel after `max_layers` layers (they keep what is
      behind all of them).
    """
    near, far = depth_range(camera, *scene_bounds(scene))
    matrix = clip_from_world(camera, height=height, width=width, near=near, far=far)
    points = jnp.concatenate([scene.positions, jnp.ones_like(scene.positions[:, :1])], axis=1)
    clip = jnp.einsum("vi,ji->vj", points, matrix, precision="highest")
    masked = scene.material.alpha_mode[scene.material_id] == MASK
    two_sided = scene.material.double_sided[scene.material_id]
    draw = functools.partial(
        rasterize, clip, scene.faces, height=height, width=width, samples=samples, cull="back", two_sided=two_sided
    )
    if not bool(masked.any()):
        return draw(), 0
    found = draw(drawn=~masked)
    beyond, left = jnp.zeros_like(found.depth) - 1.0, 0
    for _ in range(max_layers):
        layer = draw(drawn=masked, beyond=beyond)
        found, beyond, left = _look_through(scene, textures, found, layer)
        if int(left) == 0:
            break
    return found, int(left)


@jax.jit
def _look_through(scene: Scene, textures: Textures | None, found: Fragments, layer: Fragments):
    """Puts the opaque texels of a layer of masked triangles in front of what was found; says where to look on."""
    gbuffer = make_gbuffer(scene, layer)
    alpha = look_up_surface(gbuffer, scene.material, textures, max_anisotropy=1).alpha
    cutoff = scene.material.alpha_cutoff[jnp.maximum(gbuffer.material_id, 0)]
    nearer = layer.coverage & (layer.depth < found.depth)
    kept, discarded = nearer & (alpha >= cutoff), nearer & (alpha < cutoff)
    names = ("triangle_id", "screen_id", "barycentrics", "depth", "w")
    merged: dict[str, Any] = {
        name: jnp.where(kept.reshape(*kept.shape, *(1,) * (getattr(found, name).ndim - 3)), getattr(layer, name),
                        getattr(found, name))
        for name in names
    }  # fmt: skip
    # The triangles of both differ only in which of them were drawn.
    return dataclasses.replace(found, **merged), jnp.where(discarded, layer.depth, 2.0), jnp.sum(discarded)


@dataclasses.dataclass(frozen=True)
class Rendering:
    """An image (linear RGB, straight alpha = share of covered samples), and what it was made of."""

    image: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    gbuffer: GBuffer
    surface: Surface
    num_unresolved: int


def render_scene(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    samples: Samples = CENTER,
    textures: Textures | None = None,
    lights: Lights | None = None,
    ambient: Float[Array, "3 9"] | None = None,
    max_anisotropy: int = 8,
) -> Rendering:
    """Renders a scene with its own lights, or with a sun and a sky if it has none; samples are averaged.

    Args:
      textures: of `scene_textures`, made here if not given.
      lights, ambient: instead of the scene's.
    """
    textures = scene_textures(scene) if textures is None else textures
    if lights is None and ambient is None and not len(scene.lights.kind):
        lights, ambient = default_lights()
    lights = scene.lights if lights is None else lights
    fragments, left = see(scene, camera, height=height, width=width, samples=samples, textures=textures)
    gbuffer, surface, mean, share = _shaded(scene, fragments, textures, lights, ambient, camera.eye, max_anisotropy)
    return Rendering(np.asarray(mean), np.asarray(share), gbuffer, surface, left)


@functools.partial(jax.jit, static_argnames="max_anisotropy")
def _shaded(scene, fragments, textures, lights, ambient, eye, max_anisotropy):
    gbuffer = make_gbuffer(scene, fragments, textures=textures, max_anisotropy=max_anisotropy)
    surface = look_up_surface(gbuffer, scene.material, textures, max_anisotropy=max_anisotropy)
    radiance = shade(gbuffer, surface, lights, eye, ambient=ambient)
    share = jnp.mean(gbuffer.coverage.astype(jnp.float32), axis=-1)
    mean = jnp.sum(radiance, axis=-2) / jnp.maximum(share[..., None] * radiance.shape[-2], 1.0)
    return gbuffer, surface, mean, share
