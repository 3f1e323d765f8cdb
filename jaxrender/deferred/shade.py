"""GBuffer, materials and lights -> outgoing radiance of each sample.

Lights are taken one after another, so that memory does not grow with their number. No shadows. Differentiable in
everything but ids.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender.brdf import metallic_roughness
from jaxrender.deferred.gbuffer import GBuffer
from jaxrender.deferred.texture import Textures, sample_texture_grad
from jaxrender.scene import DIRECTIONAL, SPOT, Lights, Material
from jaxrender.vecmath import dot, normalize, safe_div, safe_sqrt


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Surface:
    """The material at each sample, textures looked up.

    Attributes:
      base_color: linear RGB. alpha: opacity, for masks.
      roughness: perceptual, as in glTF. emissive: radiance.
    """

    base_color: Float[Array, "*b 3"]
    alpha: Float[Array, "*b"]
    metallic: Float[Array, "*b 1"]
    roughness: Float[Array, "*b 1"]
    emissive: Float[Array, "*b 3"]


def look_up_surface(
    gbuffer: GBuffer, material: Material, textures: Textures | None, *, max_anisotropy: int = 8
) -> Surface:
    """Factors times textures times vertex colors.

    References:
      glTF 2.0 specification, 3.9: green of the metallic-roughness texture is roughness, blue is metallic.
    """
    own = jnp.maximum(gbuffer.material_id, 0)

    def texel(slot: Float[Array, " m"]) -> Float[Array, "h w s 4"]:
        layer = slot[own]
        if textures is None:
            return jnp.ones_like(gbuffer.color)
        found = sample_texture_grad(
            textures, gbuffer.uv, gbuffer.duv_dx, gbuffer.duv_dy, layer=jnp.maximum(layer, 0),
            max_anisotropy=max_anisotropy,
        )  # fmt: skip
        return jnp.where((layer >= 0)[..., None], found, jnp.ones_like(found))

    base = material.base_color[own] * texel(material.base_color_texture) * gbuffer.color
    rough = texel(material.metallic_roughness_texture)
    return Surface(
        base_color=base[..., :3],
        alpha=base[..., 3],
        metallic=material.metallic[own][..., None] * rough[..., 2:3],
        roughness=material.roughness[own][..., None] * rough[..., 1:2],
        emissive=material.emissive[own] * texel(material.emissive_texture)[..., :3],
    )


def shade(
    gbuffer: GBuffer,
    surface: Surface,
    lights: Lights,
    eye: Float[Array, "3"],
    *,
    ambient: Float[Array, "3 9"] | None = None,
) -> Float[Array, "h w s 3"]:
    """Radiance towards the eye; 0 where a sample is empty.

    Args:
      ambient: SH radiance of the surroundings, order 3, lighting the diffuse part (and a little of the mirrored one).
    """
    wo = normalize(jnp.broadcast_to(eye, gbuffer.position.shape) - gbuffer.position)
    n = gbuffer.normal

    def add(radiance, light):
        wi, irradiance = incoming(light, gbuffer.position)
        f = metallic_roughness(
            wi, wo, n, base_color=surface.base_color, metallic=surface.metallic, roughness=surface.roughness
        )
        # Light from behind the triangle itself must not leak in through a bent normal.
        seen = dot(gbuffer.geometric_normal, wi) > 0.0
        lit = f * irradiance * jnp.maximum(dot(n, wi), 0.0)
        return radiance + jnp.where(seen, lit, jnp.zeros_like(lit)), None

    start = surface.emissive if ambient is None else surface.emissive + _ambient(gbuffer, surface, ambient)
    radiance, _ = jax.lax.scan(add, start, lights)
    return jnp.where(gbuffer.coverage[..., None], radiance, jnp.zeros_like(radiance))


def incoming(light: Lights, position: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Direction to one light (a `Lights` without its leading axis) and the irradiance on a surface that faces it.

    References:
      KHR_lights_punctual: inverse square, the recommended range window, the smooth cone of a spot.
    """
    away = jnp.broadcast_to(light.position, position.shape) - position
    distance2 = dot(away, away)
    parallel = light.kind == DIRECTIONAL
    wi = jnp.where(parallel, -jnp.broadcast_to(light.direction, away.shape), normalize(away))
    # range is inf for lights that do not end.
    window = jnp.clip(1.0 - (distance2 / light.range**2) ** 2, 0.0, 1.0)
    falloff = jnp.where(parallel, jnp.ones_like(distance2), safe_div(window, distance2))
    cosine = -dot(wi, jnp.broadcast_to(light.direction, wi.shape))
    width = jnp.maximum(light.cos_inner - light.cos_outer, 1e-4)
    cone = jnp.clip((cosine - light.cos_outer) / width, 0.0, 1.0) ** 2
    cone = jnp.where(light.kind == SPOT, cone, jnp.ones_like(cone))
    return wi, falloff * cone * jnp.broadcast_to(light.intensity, away.shape)


def _ambient(gbuffer: GBuffer, surface: Surface, ambient: Float[Array, "3 9"]) -> Float[Array, "h w s 3"]:
    """Light from all around: irradiance of order-3 SH on the normal, for Lambert and as a stand-in for rough mirrors.

    References:
      Ramamoorthi, Hanrahan, "An Efficient Representation for Irradiance Environment Maps", 2001.
    """
    x, y, z = (gbuffer.normal[..., i] for i in range(3))
    one = jnp.ones_like(x)
    basis = [
        0.282095 * one, -0.488603 * y, 0.488603 * z, -0.488603 * x, 1.092548 * x * y, -1.092548 * y * z,
        0.315392 * (3.0 * z * z - 1.0), -1.092548 * x * z, 0.546274 * (x * x - y * y),
    ]  # fmt: skip
    bands = [math.pi] + 3 * [2.0 * math.pi / 3.0] + 5 * [math.pi / 4.0]
    convolved = jnp.stack([b * a for b, a in zip(basis, bands, strict=True)], axis=-1)
    irradiance = jnp.maximum(jnp.einsum("...k,ck->...c", convolved, ambient, precision="highest"), 0.0)
    f0 = 0.04 * (1.0 - surface.metallic) + surface.base_color * surface.metallic
    diffuse = surface.base_color * (1.0 - surface.metallic)
    return (diffuse + f0 * (1.0 - 0.5 * safe_sqrt(surface.roughness))) * irradiance / math.pi
