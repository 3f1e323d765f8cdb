"""Sub-samples and what they stand for -> radiance, point by point in any order.

Textures are looked up over the footprint of what a point stands for, not of the point: with more taps if that is more
than a sub-sample's own cell, because a mip level alone is blurrier than the mean of many finer lookups.
"""

import dataclasses
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrender.deferred.gbuffer import GBuffer
from jaxrender.deferred.material_textures import MaterialTextures, look_up_material
from jaxrender.deferred.sampling import ShadingPoints
from jaxrender.deferred.shade import Surface, shade
from jaxrender.deferred.subsamples import SubSamples
from jaxrender.deferred.texture import Textures
from jaxrender.scene import Lights
from jaxrender.vecmath import normalize, safe_sqrt

#: Lookups each way for a point that stands for more than its own cell.
TAPS = 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lighting:
    """What shading wants to know besides the surface.

    Attributes:
      lights, ambient: as in `shade`. eye: of the camera. textures: of the materials; None for none.
      slots: the textures that any material has (`material_slots`). max_anisotropy, model: as in `render_scene`.
    """

    lights: Lights
    ambient: Float[Array, "3 k"] | None
    eye: Float[Array, "3"]
    textures: Textures | MaterialTextures | None = None
    slots: tuple[str, ...] = field(default=(), metadata={"static": True})
    max_anisotropy: int = field(default=8, metadata={"static": True})
    model: str = field(default="metallic_roughness", metadata={"static": True})


def shade_points(
    samples: SubSamples, lighting: Lighting, place: Int[Array, " b"], points: ShadingPoints, *, taps: int = 1
) -> tuple[Float[Array, "b 3"], Float[Array, " b"], Float[Array, " b"]]:
    """Radiance at sub-samples, how much the material varies over what they stand for (0 with one tap), and roughness.

    Args:
      place: of the sub-samples in the image (h, w, n), counted through.
      taps: lookups each way, spread evenly over the footprint.
    """
    gbuffer, tangent = samples.look(place, points.shift)
    gbuffer = _tapped(gbuffer, points.spread, taps)
    surface, normal = look_up_material(
        gbuffer, None if tangent is None else tangent[:, None], samples.material, lighting.textures,
        max_anisotropy=lighting.max_anisotropy, slots=lighting.slots,
    )  # fmt: skip
    detail = material_detail(surface, normal)
    mean = lambda values: jnp.mean(values, axis=1)  # noqa: E731
    smooth = jax.tree.map(lambda values: values[:, 0], gbuffer)
    smooth = dataclasses.replace(smooth, normal=normalize(mean(normal)) if taps > 1 else normal[:, 0])
    surface = jax.tree.map(mean, surface)
    radiance = shade(
        smooth, surface, lighting.lights, lighting.eye, ambient=lighting.ambient,
        model=lighting.model,
    )  # fmt: skip
    return radiance, detail, surface.roughness[:, 0]


def material_detail(surface: Surface, normal: Float[Array, "b t 3"]) -> Float[Array, " b"]:
    """How much of a material's effect on light is not linear in its texels: the spread of t lookups.

    √(var metallic + var roughness + 1/16 var normal). Base color is missing, since light is linear in it.
    """
    variance = lambda values: jnp.sum(jnp.var(values, axis=1), axis=-1)  # noqa: E731
    return safe_sqrt(variance(surface.metallic) + variance(surface.roughness) + variance(normal) / 16.0)


def _tapped(gbuffer: GBuffer, spread: Float[Array, "b 3"], taps: int) -> GBuffer:
    """Derivatives of uv over the footprint, cut into taps x taps parts along a new axis 1."""
    xx, xy, yy = spread[:, :1], spread[:, 1:2], spread[:, 2:]
    dx = xx * gbuffer.duv_dx + xy * gbuffer.duv_dy
    dy = xy * gbuffer.duv_dx + yy * gbuffer.duv_dy
    place = (np.arange(taps) + 0.5) / taps - 0.5
    x, y = (jnp.asarray(v.reshape(1, -1, 1), dx.dtype) for v in np.meshgrid(place, place))
    gbuffer = jax.tree.map(lambda v: jnp.repeat(v[:, None], taps * taps, axis=1), gbuffer)
    return dataclasses.replace(
        gbuffer,
        uv=gbuffer.uv + x * dx[:, None] + y * dy[:, None],
        duv_dx=jnp.broadcast_to(dx[:, None] / taps, gbuffer.uv.shape),
        duv_dy=jnp.broadcast_to(dy[:, None] / taps, gbuffer.uv.shape),
    )
