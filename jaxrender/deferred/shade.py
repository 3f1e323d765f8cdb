"""GBuffer, materials and lights -> outgoing radiance of each sample.

Lights are taken one after another, so that memory does not grow with their number. No shadows. Differentiable in
everything but ids.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.brdf import ggx, phong_lobe
from jaxrender.checks import check_one_of, check_order
from jaxrender.deferred.gbuffer import GBuffer
from jaxrender.deferred.texture import Textures, sample_texture_grad
from jaxrender.scene import DIRECTIONAL, SPOT, Lights, Material
from jaxrender.sh_basis import basis_columns
from jaxrender.vecmath import einsum, safe_div, safe_sqrt

#: Fields of `Material` that name a texture, but for the normal map, which is part of the G-buffer.
TEXTURE_SLOTS = ("base_color_texture", "metallic_roughness_texture", "occlusion_texture", "emissive_texture")
MODELS = ("metallic_roughness", "phong", "lambert")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Surface:
    """The material at each sample, textures looked up.

    Attributes:
      base_color: linear RGB. alpha: opacity, for masks.
      roughness: perceptual, as in glTF. emissive: radiance.
      occlusion: part of the light from all around that gets there.
    """

    base_color: Float[Array, "*b 3"]
    alpha: Float[Array, "*b"]
    metallic: Float[Array, "*b 1"]
    roughness: Float[Array, "*b 1"]
    emissive: Float[Array, "*b 3"]
    occlusion: Float[Array, "*b 1"]


def look_up_surface(
    gbuffer: GBuffer,
    material: Material,
    textures: Textures | None,
    *,
    max_anisotropy: int = 8,
    slots: tuple[str, ...] = TEXTURE_SLOTS,
) -> Surface:
    """Factors times textures times vertex colors.

    Args:
      slots: the textures that any material has; the others cost nothing.
    References:
      glTF 2.0 specification, 3.9: green of the metallic-roughness texture is roughness, blue is metallic, red of the
      occlusion texture is what is left of the light.
    """
    own = jnp.maximum(gbuffer.material_id, 0)

    def texel(slot: str) -> Float[Array, "*b 4"]:
        if textures is None or slot not in slots:
            return jnp.ones_like(gbuffer.color)
        layer = getattr(material, slot)[own]
        found = sample_texture_grad(
            textures, gbuffer.uv, gbuffer.duv_dx, gbuffer.duv_dy, layer=jnp.maximum(layer, 0),
            max_anisotropy=max_anisotropy,
        )  # fmt: skip
        return jnp.where((layer >= 0)[..., None], found, jnp.ones_like(found))

    base = material.base_color[own] * texel("base_color_texture") * gbuffer.color
    rough = texel("metallic_roughness_texture")
    strength = material.occlusion_strength[own][..., None]
    return Surface(
        base_color=base[..., :3],
        alpha=base[..., 3],
        metallic=material.metallic[own][..., None] * rough[..., 2:3],
        roughness=material.roughness[own][..., None] * rough[..., 1:2],
        emissive=material.emissive[own] * texel("emissive_texture")[..., :3],
        occlusion=1.0 + strength * (texel("occlusion_texture")[..., :1] - 1.0),
    )


def shade(
    gbuffer: GBuffer,
    surface: Surface,
    lights: Lights,
    eye: Float[Array, "3"],
    *,
    ambient: Float[Array, "3 k"] | None = None,
    model: str = "metallic_roughness",
) -> Float[Array, "*b 3"]:
    """Radiance towards the eye; 0 where a sample is empty.

    Args:
      ambient: SH radiance of the surroundings, any order.
      model: "metallic_roughness" as in glTF; "phong", with the same colors, the exponent 2/α² - 2 and no Fresnel term;
        or "lambert" of the base color alone.
    References:
      Exponent of Phong for the roughness of facets: Walter et al., "Microfacet Models for Refraction", 2007, 5.2.
    """
    check_one_of("model", model, MODELS)
    # Components come first from here on: a vector instruction then works on samples, not on x, y and z.
    front = lambda values: jnp.moveaxis(values, -1, 0)  # noqa: E731
    position, n, geometric = (front(v) for v in (gbuffer.position, gbuffer.normal, gbuffer.geometric_normal))
    wo = _unit(_along(eye, position) - position)
    n_o, roughness = _dot(n, wo), surface.roughness[..., 0]
    diffuse, mirrored = (front(v) for v in _colors(surface, model))
    exponent = 2.0 / jnp.maximum(roughness * roughness, 1e-3) ** 2 - 2.0

    def add(radiance: Array, light: Lights) -> tuple[Array, None]:
        wi, irradiance = _incoming(light, position)
        n_i = _dot(n, wi)
        # Light from behind the triangle itself must not leak in through a bent normal.
        cosine = jnp.where(_dot(geometric, wi) > 0.0, jnp.maximum(n_i, 0.0), 0.0) * irradiance
        if model == "metallic_roughness":
            lobe, schlick = ggx(n_i, n_o, _dot(wi, wo), roughness)
            fresnel = mirrored + (1.0 - mirrored) * schlick[None]
            f = (1.0 - fresnel) * jnp.where(n_o > 0.0, 1.0 / math.pi, 0.0)[None] * diffuse + fresnel * lobe[None]
        elif model == "phong":
            f = diffuse / math.pi + mirrored * phong_lobe(n_i, n_o, _dot(wi, wo), exponent)[None]
        else:
            f = diffuse / math.pi
        return radiance + f * cosine[None] * _along(light.intensity, position), None

    start = front(surface.emissive)
    if ambient is not None:
        around = _ambient(n, wo, diffuse, mirrored, roughness, exponent, ambient, glossy=model != "lambert")
        start += around * surface.occlusion[..., 0][None]
    radiance, _ = jax.lax.scan(add, start, lights)
    return jnp.moveaxis(jnp.where(gbuffer.coverage[None], radiance, 0.0), 0, -1)


def _colors(surface: Surface, model: str) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Diffuse albedo and reflectance of the mirror."""
    if model == "lambert":
        return surface.base_color, jnp.zeros_like(surface.base_color)
    mirrored = 0.04 * (1.0 - surface.metallic) + surface.base_color * surface.metallic
    return surface.base_color * (1.0 - surface.metallic), mirrored


def incoming(light: Lights, position: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Direction to one light (a `Lights` without its leading axis) and the irradiance on a surface that faces it.

    References:
      KHR_lights_punctual: inverse square, the recommended range window, the smooth cone of a spot.
    """
    wi, falloff = _incoming(light, jnp.moveaxis(position, -1, 0))
    return jnp.moveaxis(wi, 0, -1), falloff[..., None] * jnp.broadcast_to(light.intensity, position.shape)


def _incoming(light: Lights, position: Float[Array, "3 *b"]) -> tuple[Float[Array, "3 *b"], Float[Array, "*b"]]:
    """Direction to a light, and what part of its intensity arrives; components first."""
    away = _along(light.position, position) - position
    distance2 = _dot(away, away)
    parallel = light.kind == DIRECTIONAL
    axis = _along(light.direction, position)
    wi = jnp.where(parallel, -axis, _unit(away))
    # range is inf for lights that do not end.
    window = jnp.clip(1.0 - (distance2 / light.range**2) ** 2, 0.0, 1.0)
    falloff = jnp.where(parallel, 1.0, safe_div(window, distance2))
    width = jnp.maximum(light.cos_inner - light.cos_outer, 1e-4)
    cone = jnp.clip((-_dot(wi, axis) - light.cos_outer) / width, 0.0, 1.0) ** 2
    return wi, falloff * jnp.where(light.kind == SPOT, cone, 1.0)


def _ambient(
    n: Float[Array, "3 *b"], wo: Float[Array, "3 *b"], diffuse: Float[Array, "3 *b"], mirrored: Float[Array, "3 *b"],
    roughness: Float[Array, "*b"], exponent: Float[Array, "*b"], ambient: Float[Array, "3 k"], *, glossy: bool,
) -> Float[Array, "3 *b"]:  # fmt: skip
    """Light from all around: its irradiance on the normal, and its blurred mirror image.

    References:
      Ramamoorthi, Hanrahan, "An Efficient Representation for Irradiance Environment Maps", 2001 (clamped cosine);
      "Frequency Space Environment Map Rendering", 2002, eq. 20 (band l of a Phong lobe falls off as exp(-l²/2s)).
      Fresnel of rough mirrors: Lagarde, "Adopting a physically based shading model", 2011.
    """
    order = math.isqrt(ambient.shape[1])
    check_order(order, ambient.shape[1])
    bands = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    at = lambda direction: jnp.stack(basis_columns(*direction, order=order))  # noqa: E731
    clamped = ambient * jnp.asarray(_clamped_cosine(order)[bands], ambient.dtype)[None]
    irradiance = jnp.maximum(einsum("ck,k...->c...", clamped, at(n)), 0.0)
    if not glossy:
        return diffuse * irradiance / math.pi
    n_o = jnp.clip(_dot(n, wo), 0.0, 1.0)
    mirror = 2.0 * _dot(n, wo)[None] * n - wo
    falloff = jnp.exp(jnp.stack([-float(l * l) / (2.0 * jnp.maximum(exponent, 1.0)) for l in range(order)]))[bands]
    image = jnp.maximum(einsum("ck,k...->c...", ambient, at(mirror) * falloff), 0.0)
    grazing = jnp.maximum(1.0 - roughness[None], mirrored)
    fresnel = mirrored + (grazing - mirrored) * ((1.0 - n_o) ** 5)[None]
    return diffuse * irradiance / math.pi + fresnel * image


def _clamped_cosine(order: int) -> np.ndarray:
    """∫ max(cos θ, 0) y over the sphere by band, over √(4π/(2l+1)): π, 2π/3, π/4, 0, -π/24, ...

    References:
      Ramamoorthi, Hanrahan, 2001, eq. 8.
    """
    factors = np.zeros(max(order, 2))
    factors[:2] = math.pi, 2.0 * math.pi / 3.0
    for l in range(2, order, 2):
        binomial = math.comb(l, l // 2) / 2.0**l
        factors[l] = 2.0 * math.pi * (-1.0) ** (l // 2 - 1) / ((l + 2) * (l - 1)) * binomial
    return factors[:order]


# --- Vectors whose components come first


def _along(vector: Float[Array, "3"], like: Float[Array, "3 *b"]) -> Float[Array, "3 *#b"]:
    return vector.astype(like.dtype).reshape(3, *(1,) * (like.ndim - 1))


def _dot(a: Float[Array, "3 *#b"], b: Float[Array, "3 *#b"]) -> Float[Array, "*b"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _unit(v: Float[Array, "3 *b"]) -> Float[Array, "3 *b"]:
    length = safe_sqrt(_dot(v, v))
    return v * safe_div(jnp.ones_like(length), length)[None]
