"""GBuffer, materials and lights -> outgoing radiance of each sample.

Lights are taken one after another, so that memory does not grow with their number. No shadows. Differentiable in
everything but ids.
"""

import math
from collections.abc import Mapping, Sequence
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

#: Fields of `Material` that name a texture, but for the normal map, which is part of the G-buffer.
TEXTURE_SLOTS = ("base_color_texture", "metallic_roughness_texture", "occlusion_texture", "emissive_texture")
MODELS = ("metallic_roughness", "phong", "lambert")

Vector = tuple[Array, ...]


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
    texels = {}
    for slot in TEXTURE_SLOTS:
        if textures is not None and slot in slots:
            layer = getattr(material, slot)[own]
            found = sample_texture_grad(
                textures, gbuffer.uv, gbuffer.duv_dx, gbuffer.duv_dy, layer=jnp.maximum(layer, 0),
                max_anisotropy=max_anisotropy,
            )  # fmt: skip
            texels[slot] = jnp.where((layer >= 0)[..., None], found, jnp.ones_like(found))
    return surface_of_texels(gbuffer, material, texels)


def surface_of_texels(gbuffer: GBuffer, material: Material, texels: Mapping[str, Float[Array, "*b 4"]]) -> Surface:
    """`look_up_surface` for textures that were looked up already, by slot; those that are missing are 1."""
    own, one = jnp.maximum(gbuffer.material_id, 0), jnp.ones_like(gbuffer.color)
    base = material.base_color[own] * texels.get("base_color_texture", one) * gbuffer.color
    rough = texels.get("metallic_roughness_texture", one)
    strength = material.occlusion_strength[own][..., None]
    return Surface(
        base_color=base[..., :3],
        alpha=base[..., 3],
        metallic=material.metallic[own][..., None] * rough[..., 2:3],
        roughness=material.roughness[own][..., None] * rough[..., 1:2],
        emissive=material.emissive[own] * texels.get("emissive_texture", one)[..., :3],
        occlusion=1.0 + strength * (texels.get("occlusion_texture", one)[..., :1] - 1.0),
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
    # From here on each component is an array of its own: a vector instruction then works on eight samples, not on x, y
    # and z of one.
    shape = gbuffer.position.shape
    part = lambda values: tuple(values.reshape(-1, 3)[:, i] for i in range(3))  # noqa: E731
    position, n, geometric = (part(v) for v in (gbuffer.position, gbuffer.normal, gbuffer.geometric_normal))
    wo = _unit(tuple(eye[i] - position[i] for i in range(3)))
    n_o, roughness = _dot(n, wo), surface.roughness.reshape(-1)
    diffuse, mirrored = (part(v) for v in _colors(surface, model))
    exponent = 2.0 / jnp.maximum(roughness * roughness, 1e-3) ** 2 - 2.0

    def add(radiance: Vector, light: Lights) -> tuple[Vector, None]:
        wi, irradiance = _incoming(light, position)
        n_i, i_o = _dot(n, wi), _dot(wi, wo)
        # Light from behind the triangle itself must not leak in through a bent normal.
        cosine = jnp.where(_dot(geometric, wi) > 0.0, jnp.maximum(n_i, 0.0), 0.0) * irradiance
        if model == "metallic_roughness":
            v = tuple(wi[i] + wo[i] for i in range(3))
            off_axis = tuple(v[i] - (n_i + n_o) * n[i] for i in range(3))
            sin2_h = _dot(off_axis, off_axis) / jnp.maximum(_dot(v, v), 1e-12)
            lobe, schlick = ggx(n_i, n_o, i_o, roughness, sin2_h=sin2_h)
            matt = jnp.where(n_o > 0.0, 0.96 * (1.0 - schlick) / math.pi, 0.0)
            f = [matt * d + (f0 + (1.0 - f0) * schlick) * lobe for f0, d in zip(mirrored, diffuse, strict=True)]
        elif model == "phong":
            lobe = phong_lobe(n_i, n_o, i_o, exponent)
            f = [d / math.pi + r * lobe for r, d in zip(mirrored, diffuse, strict=True)]
        else:
            f = [d / math.pi for d in diffuse]
        return tuple(radiance[i] + f[i] * cosine * light.intensity[i] for i in range(3)), None

    start = part(surface.emissive)
    if ambient is not None:
        around = _ambient(n, wo, diffuse, mirrored, roughness, exponent, ambient, glossy=model != "lambert")
        occlusion = surface.occlusion.reshape(-1)
        start = tuple(start[i] + around[i] * occlusion for i in range(3))
    radiance, _ = jax.lax.scan(add, start, lights)
    return jnp.where(gbuffer.coverage[..., None], jnp.stack(radiance, axis=-1).reshape(shape), 0.0)


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
    wi, falloff = _incoming(light, tuple(position[..., i] for i in range(3)))
    return jnp.stack(wi, axis=-1), falloff[..., None] * jnp.broadcast_to(light.intensity, position.shape)


def _incoming(light: Lights, position: Vector) -> tuple[Vector, Float[Array, " n"]]:
    """Direction to a light, and what part of its intensity arrives."""
    away = tuple(light.position[i] - position[i] for i in range(3))
    distance2 = _dot(away, away)
    parallel, inverse = light.kind == DIRECTIONAL, _inverse_root(distance2)
    wi = tuple(jnp.where(parallel, -light.direction[i], away[i] * inverse) for i in range(3))
    # range is inf for lights that do not end.
    window = jnp.clip(1.0 - (distance2 * (1.0 / light.range) ** 2) ** 2, 0.0, 1.0)
    falloff = jnp.where(parallel, 1.0, window * inverse * inverse)
    width = jnp.maximum(light.cos_inner - light.cos_outer, 1e-3)
    cosine = -(wi[0] * light.direction[0] + wi[1] * light.direction[1] + wi[2] * light.direction[2])
    cone = jnp.clip((cosine - light.cos_outer) / width, 0.0, 1.0) ** 2
    return wi, falloff * jnp.where(light.kind == SPOT, cone, 1.0)


def _ambient(
    n: Vector, wo: Vector, diffuse: Vector, mirrored: Vector, roughness: Float[Array, " n"],
    exponent: Float[Array, " n"], ambient: Float[Array, "3 k"], *, glossy: bool,
) -> Vector:  # fmt: skip
    """Light from all around: its irradiance on the normal, and its blurred mirror image.

    References:
      Ramamoorthi, Hanrahan, "An Efficient Representation for Irradiance Environment Maps", 2001 (clamped cosine);
      "Frequency Space Environment Map Rendering", 2002, eq. 20 (band l of a Phong lobe falls off as exp(-l²/2s)).
      Fresnel of rough mirrors: Lagarde, "Adopting a physically based shading model", 2011.
    """
    order = math.isqrt(ambient.shape[1])
    check_order(order, ambient.shape[1])
    clamped = _clamped_cosine(order)
    irradiance = _band_sum(n, ambient, [float(factor) for factor in clamped])
    matt = tuple(diffuse[i] * irradiance[i] / math.pi for i in range(3))
    if not glossy:
        return matt
    n_o = _dot(n, wo)
    mirror = tuple(2.0 * n_o * n[i] - wo[i] for i in range(3))
    image = _band_sum(
        mirror, ambient, [jnp.exp(-float(l * l) / (2.0 * jnp.maximum(exponent, 1.0))) for l in range(order)]
    )
    grazing = (1.0 - jnp.clip(n_o, 0.0, 1.0)) ** 5
    fresnel = [f0 + (jnp.maximum(1.0 - roughness, f0) - f0) * grazing for f0 in mirrored]
    return tuple(matt[i] + fresnel[i] * image[i] for i in range(3))


def _band_sum(direction: Vector, light: Float[Array, "3 k"], factors: Sequence[float | Float[Array, " n"]]) -> Vector:
    """Σ_l factor_l Σ_m L_lm y_lm(direction) by channel, not below 0."""
    basis = basis_columns(*direction, order=len(factors))
    channels = []
    for channel in light:
        bands = [sum(channel[l * l + m] * basis[l * l + m] for m in range(2 * l + 1)) for l in range(len(factors))]
        total = sum(factor * band for factor, band in zip(factors, bands, strict=True))
        channels.append(jnp.maximum(total, 0.0))
    return tuple(channels)


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


# --- Vectors as three arrays


def _dot(a: Vector, b: Vector) -> Float[Array, "*b"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _unit(v: Vector) -> Vector:
    inverse = _inverse_root(_dot(v, v))
    return tuple(component * inverse for component in v)


def _inverse_root(x: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """1/√x, and 0 with slope 0 where x is not positive."""
    some = x > 0.0
    return jnp.where(some, 1.0 / jnp.sqrt(jnp.where(some, x, 1.0)), 0.0)
