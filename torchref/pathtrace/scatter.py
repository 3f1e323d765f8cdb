"""Reflection at a point: values, drawn directions and their densities, from vectors with a last axis of 3."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.brdf import lambert, metallic_roughness, phong
from torchref.pathtrace.hit_points import HitSurface
from torchref.vec3 import Scalar, Vec3, from_array, to_array
from torchref.vecmath import dot, normalize, orthonormal_tangent

MODELS = ("metallic_roughness", "phong", "lambert")


class Reflector(NamedTuple):
    """A point of a surface: frame, reflectances of the matt part and of the mirror, and how they are chosen."""

    position: Vec3
    normal: Vec3
    geometric_normal: Vec3
    wo: Vec3
    diffuse: Vec3
    mirror: Vec3
    roughness: Scalar
    matt_share: Scalar


class Scattered(NamedTuple):
    """A drawn direction, f cos / density, and the density."""

    wi: Vec3
    weight: Vec3
    density: Scalar


@in_float64
def make_reflector(surface: HitSurface, direction: Vec3, *, model: str) -> Reflector:
    """Colors of glTF 2.0, appendix B.3; the matt part's chance is its share of what both give back, in [0.1, 0.9]."""
    base, metallic = to_array(surface.base_color), surface.metallic[..., None]
    wo = -to_array(direction)
    diffuse, mirror = (1.0 - metallic) * base, (1.0 - metallic) * 0.04 + metallic * base
    normal = to_array(surface.normal)
    if model == "lambert":
        diffuse, mirror = base, torch.zeros_like(base)
    else:
        # The part along wo becomes 0.01 where it was less; the part across it stays.
        along = dot(normal, wo)
        bent = torch.where(along < 0.01, normal - along * wo + 0.01 * wo, normal)
        bent = bent / torch.linalg.vector_norm(bent, dim=-1, keepdim=True)
        normal = torch.where(surface.triangle[..., None] >= 0, bent, normal)
    schlick = (1.0 - dot(normal, wo)).clamp(0.0, 1.0) ** 5
    given_back = mirror + (1.0 - mirror) * schlick if model == "metallic_roughness" else mirror
    matt, glossy = diffuse.mean(-1), given_back.mean(-1)
    share = (matt / torch.where(matt + glossy > 0.0, matt + glossy, 1.0)).clamp(0.1, 0.9)
    share = torch.where(matt > 0.0, share, 0.0)
    share = torch.where(glossy > 0.0, share, 1.0)
    return Reflector(
        surface.position, from_array(normal), surface.geometric_normal, from_array(wo), from_array(diffuse),
        from_array(mirror), surface.roughness, share,
    )  # fmt: skip


@in_float64
def reflectance(at: Reflector) -> Vec3:
    """Matt and glossy reflectance together, in [10⁻³, 1]."""
    return from_array((to_array(at.diffuse) + to_array(at.mirror)).clamp(1e-3, 1.0))


@in_float64
def evaluate(at: Reflector, wi: Vec3, *, model: str) -> Vec3:
    """f cos, where wi leaves the front of the triangle.

    With F = F0 + (1 - F0) (1 - o·h)⁵, glTF's surface is a metal of color `mirror` and what a dielectric of color
    `diffuse` has over a black one.
    """
    n, wo, wi = to_array(at.normal), to_array(at.wo), to_array(wi)
    diffuse, mirror, roughness = to_array(at.diffuse), to_array(at.mirror), at.roughness[..., None]
    if model == "lambert":
        f = lambert(diffuse)
    elif model == "phong":
        f = lambert(diffuse) + phong(wi, wo, n, specular=mirror, exponent=_exponent(roughness))
    else:
        rest = {"roughness": roughness}
        one, black = torch.ones_like(roughness), torch.zeros_like(diffuse)
        metal = metallic_roughness(wi, wo, n, base_color=mirror, metallic=one, **rest)
        over, under = (
            metallic_roughness(wi, wo, n, base_color=base, metallic=0.0 * one, **rest) for base in (diffuse, black)
        )
        f = metal + (over - under)
    crosses = (dot(to_array(at.geometric_normal), wi) > 0.0) & (dot(n, wi) > 0.0)
    return from_array(torch.where(crosses, f * dot(n, wi), 0.0))


@in_float64
def density(at: Reflector, wi: Vec3, *, model: str) -> Scalar:
    """The densities of both parts, mixed by their chances."""
    n, wo, wi = to_array(at.normal), to_array(at.wo), to_array(wi)
    matt = dot(n, wi).clamp(min=0.0) / math.pi
    if model == "lambert":
        return matt[..., 0]
    part = _phong_density if model == "phong" else _facet_density
    share = at.matt_share[..., None]
    return (share * matt + (1.0 - share) * part(n, wo, wi, at.roughness[..., None]))[..., 0]


@in_float64
def draw(at: Reflector, u: Scalar, v: Scalar, choice: Scalar, *, model: str) -> Scattered:
    """One of the two parts by `choice`, a direction of it by u and v."""
    n, wo, roughness = to_array(at.normal), to_array(at.wo), at.roughness[..., None]
    u, v, choice = u[..., None], v[..., None], choice[..., None]
    # A disk, seen from the side: the cosine-weighted hemisphere.
    wi = _in_frame(n, _ring(torch.sqrt(u), v, torch.sqrt(1.0 - u)))
    if model == "phong":
        # The lobe's cumulative distribution is 1 - cos^(exponent + 1).
        cosine = (1.0 - u).clamp(min=1e-7) ** (1.0 / (_exponent(roughness) + 1.0))
        glossy = _in_frame(_mirrored(wo, n), _ring(torch.sqrt((1.0 - cosine**2).clamp(min=0.0)), v, cosine))
    elif model == "metallic_roughness":
        glossy = _mirrored(wo, _visible_facet(n, wo, roughness, u, v))
    if model != "lambert":
        wi = torch.where(choice < at.matt_share[..., None], wi, glossy)
    wi = from_array(normalize(wi))
    p = density(at, wi, model=model)
    weight = to_array(evaluate(at, wi, model=model)) / p.clamp(min=1e-9)[..., None]
    return Scattered(wi, from_array(torch.where((p > 1e-9)[..., None], weight, 0.0)), p)


def _alpha(roughness: Tensor) -> Tensor:
    return (roughness**2).clamp(min=1e-3)


def _exponent(roughness: Tensor) -> Tensor:
    return 2.0 / _alpha(roughness) ** 2 - 2.0


def _mirrored(v: Float[Tensor, "*b 3"], n: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    return normalize(2.0 * dot(n, v) * n - v)


def _ring(radius: Tensor, turn: Tensor, height: Tensor) -> Float[Tensor, "*b 3"]:
    azimuth = 2.0 * math.pi * turn
    return torch.cat(torch.broadcast_tensors(radius * torch.cos(azimuth), radius * torch.sin(azimuth), height), dim=-1)


def _frame(n: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """World from local, z along n."""
    t = orthonormal_tangent(n)
    return torch.stack([t, torch.linalg.cross(n, t), n], dim=-1)


def _in_frame(n: Float[Tensor, "*b 3"], local: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    return torch.einsum("...ij,...j->...i", _frame(n), local)


def _phong_density(n: Tensor, wo: Tensor, wi: Tensor, roughness: Tensor) -> Tensor:
    """(s + 1)/2π cos^s of the angle to the mirror image."""
    s, cosine = _exponent(roughness), dot(_mirrored(wo, n), wi)
    return torch.where(cosine > 0.0, torch.where(cosine > 0.0, cosine, 1.0) ** s * (s + 1.0) / (2.0 * math.pi), 0.0)


def _facet_density(n: Tensor, wo: Tensor, wi: Tensor, roughness: Tensor) -> Tensor:
    """Of facets D_wo(h) = G1 (o·h) D / (n·o), over dwi/dh = 4 o·h; n·o is at least 10⁻⁴.

    References:
      Heitz, "Sampling the GGX Distribution of Visible Normals", JCGT 7(4), 2018, eqs. 1-3 and 17.
    """
    a2 = _alpha(roughness) ** 2
    h = normalize(wi + wo)
    n_h, o_h, n_o = dot(n, h), dot(wo, h), dot(n, wo).clamp(min=1e-4)
    off_axis = torch.linalg.cross(n, h)
    d = a2 / (math.pi * (n_h**2 * a2 + dot(off_axis, off_axis)) ** 2)
    smith = 2.0 / (1.0 + torch.sqrt(1.0 + a2 * (1.0 / n_o**2 - 1.0)))
    return torch.where((n_h > 0.0) & (o_h > 0.0), smith * d / (4.0 * n_o), 0.0)


def _visible_facet(n: Tensor, wo: Tensor, roughness: Tensor, u: Tensor, v: Tensor) -> Float[Tensor, "*b 3"]:
    """Normals of a stretched hemisphere: those of points of the unit sphere that the stretched wo sees.

    References:
      Dupuy, Benyoub, "Sampling Visible GGX Normals with Spherical Caps", HPG 2023, listing 3.
    """
    alpha, frame = _alpha(roughness), _frame(n)
    o = torch.einsum("...ij,...i->...j", frame, wo)
    stretch = torch.cat([alpha, alpha, torch.ones_like(alpha)], dim=-1)
    o = normalize(stretch * torch.cat([o[..., :2], o[..., 2:].clamp(min=1e-4)], dim=-1))
    z = 1.0 - u * (1.0 + o[..., 2:])
    h = normalize(stretch * (_ring(torch.sqrt((1.0 - z**2).clamp(0.0, 1.0)), v, z) + o))
    return torch.einsum("...ij,...j->...i", frame, h)
