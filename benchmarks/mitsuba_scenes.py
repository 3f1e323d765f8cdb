"""Four diffuse scenes in Mitsuba, and the light along their paths with direct and indirect apart.

Needs the extra `peers` and an LLVM library from version 16 on (`prepare` says so); import it where it is needed only.
All primary rays pass through pixel centres. Paths have two indirect bounces, without Russian roulette. At every hit one
emitter is sampled, and emission that a bounce ray meets counts nothing, so no light counts twice. What is called
demodulated is divided by the albedo of the first hit: light arriving, weighted by the cosine over π.
"""

import ctypes.util
import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import jax.numpy as jnp
import mitsuba as mi
import numpy as np
from jaxtyping import Float

from benchmarks.path_scenes import DATA, Vector, look, placed, sky, with_edges
from jaxrender.camera import Camera, camera_rays
from jaxrender.io import load_scene
from jaxrender.scene import MASK, Scene
from jaxrender.srgb import decode_srgb

VARIANT = "llvm_ad_rgb"
# Newest first. Versions 14 and 15 do not work, and many systems have them beside a newer one.
_LLVM_LIBRARIES = tuple(f"LLVM-{version}" for version in range(30, 15, -1)) + ("LLVM",)


class NoMitsuba(Exception):
    """No renders can be made here; the message says why."""


def prepare() -> None:
    """Chooses an LLVM library, unless DRJIT_LIBLLVM_PATH names one, and the variant of Mitsuba.

    Raises:
      NoMitsuba: if none works. (Variants without LLVM would draw the paths of this file one by one.)
    """
    if mi.variant() == VARIANT:
        return
    variable = "DRJIT_LIBLLVM_PATH"
    found = os.environ.get(variable) or next(filter(None, map(ctypes.util.find_library, _LLVM_LIBRARIES)), None)
    # Left to itself Dr.Jit might find version 15, with which LLVM ends the process.
    if found is None:
        raise NoMitsuba(f"Mitsuba's {VARIANT} needs an LLVM library from version 16 on; {variable} may name one")
    os.environ[variable] = found
    try:
        mi.set_variant(VARIANT)
        dr.eval(mi.Float([0.0, 1.0]) + 1.0)
    except Exception as error:
        raise NoMitsuba(f"Mitsuba's {VARIANT} does not run with {variable}={found}: {error}") from error


# --- Scenes


@dataclass(frozen=True)
class View:
    """A scene as Mitsuba has it, and the camera. `cutouts`: some materials have holes that rays must pass."""

    scene: Any
    camera: Camera
    cutouts: bool = False


def build(name: str) -> View:
    """A scene of `BUILDERS`.

    Raises:
      NoMitsuba: if Mitsuba does not run, or the shared data are not here.
    """
    prepare()
    if not DATA.is_dir():
        raise NoMitsuba("the scenes of the renders are in ../shared/data, which is not here")
    return BUILDERS[name]()


def _cornell() -> View:
    """The Cornell box with a dragon in the place of the two boxes."""
    box = load_scene(DATA / "cornell_box" / "scene.json")
    # Its lamp is dim for a picture shown without exposure.
    box = dataclasses.replace(box, material=dataclasses.replace(box.material, emissive=1.6 * box.material.emissive))
    shapes = _shapes(box, leave_out=("cbox_smallbox", "cbox_largebox"))
    dragon = load_scene(DATA / "meshes" / "dragon_100k.ply")
    dragon = placed(dragon, scale=150.0, turn_radians=0.55, foot=(278.0, 0.0, 340.0))
    shapes |= _shapes(dragon, color=(0.72, 0.7, 0.62))
    # The angle of the file is that of the shorter side; here the box fills the longer one.
    camera = box.cameras[0]
    narrow = 2.0 * np.arctan(0.75 * np.tan(0.5 * camera.fov_y_radians))
    return View(_load(shapes), dataclasses.replace(camera, fov_y_radians=jnp.float32(narrow)))


def _statue() -> View:
    """A bunny before a red wall, lit by a lamp that shines on both, under a dim sky."""
    bunny = placed(load_scene(DATA / "meshes" / "bunny.ply"), scale=8.0, turn_radians=-0.3, foot=(0.0, 0.0, 0.0))
    shapes = _shapes(bunny, color=(0.75, 0.75, 0.75))
    shapes["floor"] = _rectangle((0, 0, 0), (0, 1, 0), (4.0, 4.0), color=(0.6, 0.6, 0.6))
    shapes["wall"] = _rectangle((-1.5, 1.5, 0), (1, 0, 0), (4.0, 1.5), color=(0.7, 0.12, 0.06))
    shapes["screen"] = _rectangle((0, 1.5, -2.0), (0, 0, 1), (4.0, 1.5), color=(0.25, 0.35, 0.6))
    shapes["lamp"] = _rectangle((1.6, 2.6, 1.0), (-0.75, -0.85, -0.35), (0.4, 0.4), radiance=(34.0, 30.0, 25.0))
    shapes["sky"] = _sky((0.16, 0.20, 0.28))
    return View(_load(shapes), look((0.9, 1.15, 3.4), (-0.15, 0.62, 0.0), 38.0))


def _atrium() -> View:
    """The older Sponza, all grey, under sun and sky."""
    building = with_edges(load_scene(DATA / "dabrovic_sponza" / "sponza_dabrovic.ply"))
    shapes = _shapes(building, color=(0.6, 0.6, 0.6))
    shapes |= {"sky": _sky((2.2, 2.6, 3.2)), "sun": _sun((0.2, -1.0, 0.22), (5.2, 4.7, 3.9))}
    return View(_load(shapes), look((11.0, 1.2, -1.0), (-5.0, 3.2, 0.6), 60.0))


def _sponza() -> View:
    """Sponza with its textures, under sun and sky."""
    shapes = _shapes(load_scene(DATA / "sponza" / "Sponza.gltf"))
    shapes |= {"sky": _sky((4.5, 5.2, 6.5)), "sun": _sun((0.2, -1.0, 0.22), (18.0, 16.2, 13.5))}
    return View(_load(shapes), look((10.0, 2.0, 0.0), (-5.0, 3.0, 0.0), 60.0), cutouts=True)


#: What `build` knows.
BUILDERS = {"cornell": _cornell, "statue": _statue, "atrium": _atrium, "sponza": _sponza}


def _load(shapes: Mapping[str, Any]) -> Any:
    return mi.load_dict({"type": "scene", **shapes})


def _shapes(scene: Scene, *, color: Vector | None = None, leave_out: tuple[str, ...] = ()) -> dict[str, Any]:
    """A mesh for each material, diffuse in its base color or in `color`, seen from both sides."""
    names, ids = scene.material_names, np.asarray(scene.material_id)
    return {
        f"{scene.name}-{index}": _mesh(scene, index, np.asarray(scene.faces)[ids == index], color)
        for index, name in enumerate(names)
        if name not in leave_out and (ids == index).any()
    }


def _mesh(scene: Scene, index: int, faces: np.ndarray, color: Vector | None) -> Any:
    used, corners = np.unique(faces, return_inverse=True)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(_diffuse(color) if color else _material(scene, index))
    glow = np.asarray(scene.material.emissive)[index]
    if glow.any():
        props["emitter"] = mi.load_dict({"type": "area", "radiance": _rgb(glow)})
    # Texture coordinates that are all the same give tangents that are no numbers.
    mapped = bool(np.ptp(np.asarray(scene.uv), axis=0).all())
    mesh = mi.Mesh(
        f"{scene.name}-{index}", len(used), len(faces), props, has_vertex_normals=True, has_vertex_texcoords=mapped
    )
    params = mi.traverse(mesh)
    vertices = {"positions": scene.positions, "normals": scene.normals} | ({"texcoords": scene.uv} if mapped else {})
    for name, values in vertices.items():
        params[f"vertex_{name}"] = mi.Float(np.asarray(values)[used].ravel())
    params["faces"] = mi.UInt32(corners.ravel().astype(np.uint32))
    params.update()
    return mesh


def _material(scene: Scene, index: int) -> dict[str, Any]:
    """The base color of a material as a diffuse one, with holes where its alpha is cut out."""
    material = scene.material
    factor, layer = np.asarray(material.base_color)[index], int(material.base_color_texture[index])
    if layer < 0:
        return _diffuse(factor[:3])
    texels = scene.images[layer].texels / np.float32(255.0)
    front = _diffuse(factor[:3], decode_srgb(texels[..., :3]) * factor[:3])
    if int(material.alpha_mode[index]) != MASK or texels.shape[-1] < 4:
        return front
    solid = (texels[..., 3:] * factor[3] >= float(material.alpha_cutoff[index])).astype(np.float32)
    return {"type": "mask", "opacity": _bitmap(solid, filter_type="nearest"), "nested": front}


def _diffuse(color: Any, texels: np.ndarray | None = None) -> dict[str, Any]:
    reflectance = _rgb(color) if texels is None else _bitmap(texels, filter_type="bilinear")
    return {"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}}


def _bitmap(texels: np.ndarray, *, filter_type: str) -> dict[str, Any]:
    bitmap = mi.Bitmap(np.ascontiguousarray(texels, np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": filter_type, "wrap_mode": "repeat"}


def _rgb(color: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(c) for c in color]}


def _rectangle(
    middle: Vector,
    normal: Vector,
    half_size: tuple[float, float],
    *,
    color: Vector = (0.0, 0.0, 0.0),
    radiance: Vector | None = None,
) -> dict[str, Any]:
    """A rectangle of twice `half_size`: across, horizontally, and up (towards -z if it lies flat)."""
    up = (0.0, 0.0, -1.0) if abs(normal[1]) > 0.999 else (0.0, 1.0, 0.0)
    target = [m + n for m, n in zip(middle, normal, strict=True)]
    place = mi.ScalarTransform4f().look_at(origin=list(middle), target=target, up=list(up))
    size = mi.ScalarTransform4f().scale([*half_size, 1.0])
    shape = {"type": "rectangle", "to_world": place @ size, "bsdf": _diffuse(color)}
    return shape | ({"emitter": {"type": "area", "radiance": _rgb(radiance)}} if radiance else {})


def _sky(zenith: Vector) -> dict[str, Any]:
    """`sky` as an emitter."""
    return {"type": "envmap", "bitmap": mi.Bitmap(sky(zenith))}


def _sun(direction: Vector, irradiance: Vector) -> dict[str, Any]:
    """Parallel light that travels along `direction`; `irradiance` is on a surface that faces it."""
    return {"type": "directional", "direction": list(direction), "irradiance": _rgb(irradiance)}


# --- Rays


@dataclass(frozen=True)
class FirstHits:
    """What the primary rays meet, as Mitsuba's arrays with one entry per pixel, rows first.

    Attributes:
      surface: Mitsuba's record of the hits. hit: whether there is one.
      normal: the shading normal, on the side of the face that the eye sees.
      emission: radiance that comes straight from a lamp or the sky.
    """

    surface: Any
    hit: Any
    normal: Any
    albedo: Any
    emission: Any
    height: int
    width: int


def first_hits(view: View, *, height: int, width: int) -> FirstHits:
    """Traces the primary rays through the pixel centres."""
    ray = primary_rays(view, height=height, width=width)
    si, _ = _nearest(view, ray, mi.Bool(True))
    hit = si.is_valid()
    # By the side of the face, as in a rasteriser: the sign of the shading normal itself makes silhouettes black.
    normal = mi.Normal3f(dr.mulsign(si.sh_frame.n, -dr.dot(si.n, ray.d)))
    emission = si.emitter(view.scene).eval(si)
    albedo = si.bsdf().eval_diffuse_reflectance(si, hit)
    first = FirstHits(si, hit, normal & hit, albedo & hit, emission, height, width)
    dr.eval(si, hit, first.normal, first.albedo, first.emission)
    return first


def primary_rays(view: View, *, height: int, width: int) -> Any:
    """Mitsuba's rays through the pixel centres, row by row."""
    origins, directions = (np.asarray(x).reshape(-1, 3).T for x in camera_rays(view.camera, height=height, width=width))
    return mi.Ray3f(mi.Point3f(np.ascontiguousarray(origins)), mi.Vector3f(np.ascontiguousarray(directions)))


def _nearest(view: View, ray: Any, active: Any) -> tuple[Any, Any]:
    """The nearest hit along `ray`, through holes, and its distance from the origin (inf for none)."""
    si = view.scene.ray_intersect(ray, active)
    if view.cutouts:

        def onward(si, hole):
            rest = si.spawn_ray(ray.d)
            rest.maxt = ray.maxt - dr.norm(si.p - ray.o)
            si = view.scene.ray_intersect(rest, hole)
            return si, _in_hole(si, hole)

        si, _ = dr.while_loop((si, _in_hole(si, active)), cond=lambda si, hole: hole, body=onward)
    return si, dr.select(si.is_valid(), dr.norm(si.p - ray.o), dr.inf)


def _in_hole(si: Any, active: Any) -> Any:
    return active & si.is_valid() & (si.bsdf().eval_null_transmission(si, active).x > 0.5)


# --- Light


def guides(first: FirstHits, camera: Camera) -> dict[str, np.ndarray]:
    """Images of position, normal, depth (along the line of sight) and albedo, 0 where nothing is hit, and emission."""
    position = _image(first, first.surface.p & first.hit)
    forward = np.asarray(camera.target - camera.eye, np.float64)
    depth = (position - np.asarray(camera.eye)) @ (forward / np.linalg.norm(forward))
    hit = np.asarray(first.hit).reshape(first.height, first.width)
    return {
        "normal": _image(first, first.normal),
        "depth": np.where(hit, depth, 0.0)[..., None].astype(np.float32),
        "position": position,
        "albedo": _image(first, first.albedo),
        "emission": _image(first, first.emission),
    }


def light_sums(
    view: View, first: FirstHits, *, num_samples: int, seed: int, radii: Vector
) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """Sums over the samples of demodulated light: "direct", "indirect", their squares, and "ao".

    A sample of "ao" is min(distance / radius, 1), the distance that of the first indirect hit; a channel per radius.
    """

    def add(i, sampler, sums):
        direct, indirect, distance = _path(view, first, sampler)
        terms = (direct, indirect, direct * direct, indirect * indirect, dr.minimum(distance / mi.Color3f(*radii), 1.0))
        return i + 1, sampler, tuple(total + term for total, term in zip(sums, terms, strict=True))

    sums = _repeat(add, num_samples, _sampler(first, seed), _zeros(first, 5))
    names = ("direct", "indirect", "direct_squared", "indirect_squared", "ao")
    return {name: _image(first, value) for name, value in zip(names, sums, strict=True)}


def ambient_occlusion(
    view: View, first: FirstHits, *, strata: tuple[int, int], seed: int, radii: Vector
) -> Float[np.ndarray, "h w 3"]:
    """The mean of min(distance / radius, 1) over one ray of cosine density in each stratum; 1 where nothing is hit."""
    across, along = strata

    def add(i, sampler, sums):
        u = (mi.Point2f(i % across, i // across) + sampler.next_2d()) / mi.Point2f(across, along)
        _, distance = _nearest(view, _bounce(first, u, maxt=max(radii)), first.hit)
        return i + 1, sampler, (sums[0] + dr.minimum(distance / mi.Color3f(*radii), 1.0),)

    (total,) = _repeat(add, across * along, _sampler(first, seed), _zeros(first, 1))
    return _image(first, dr.select(first.hit, total / (across * along), 1.0))


def _repeat(add: Any, num_times: int, sampler: Any, sums: tuple) -> tuple:
    """The sums after `add` has been at them so many times, in one program for all pixels."""
    # The number is opaque, so that all of them share the program.
    end = dr.opaque(mi.UInt32, num_times)
    state = (mi.UInt32(0), sampler, sums)
    _, _, sums = dr.while_loop(state, cond=lambda i, sampler, sums: i < end, body=add)
    # All at once: one by one, the paths would be traced anew for each.
    dr.eval(sums)
    return sums


def _zeros(first: FirstHits, count: int) -> tuple:
    return tuple(dr.zeros(mi.Color3f, first.height * first.width) for _ in range(count))


def _path(view: View, first: FirstHits, sampler: Any) -> tuple[Any, Any, Any]:
    """One sample of direct and indirect light, both demodulated, and the distance of the first indirect hit."""
    lamp, light = view.scene.sample_emitter_direction(first.surface, sampler.next_2d(), False, first.hit)
    direct = light * dr.maximum(dr.dot(first.normal, lamp.d), 0.0) / dr.pi
    direct &= _visible(view, first.surface, lamp, first.hit & dr.any(direct > 0.0))

    # The cosine and π cancel against the density of the bounce, so the first hit leaves no factor.
    si, distance = _nearest(view, _bounce(first, sampler.next_2d()), first.hit)
    indirect, beta, active = mi.Color3f(0.0), mi.Color3f(1.0), first.hit & si.is_valid()
    context = mi.BSDFContext()
    for bounce in (1, 2):
        bsdf = si.bsdf()
        lamp, light = view.scene.sample_emitter_direction(si, sampler.next_2d(active), False, active)
        arriving = beta * light * bsdf.eval(context, si, si.to_local(lamp.d), active)
        indirect += arriving & _visible(view, si, lamp, active & dr.any(arriving > 0.0))
        if bounce == 1:
            scattered, weight = bsdf.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
            beta *= weight
            si, _ = _nearest(view, si.spawn_ray(si.to_world(scattered.wo)), active & dr.any(weight > 0.0))
            active &= si.is_valid()
    return direct, indirect, distance


def _visible(view: View, si: Any, lamp: Any, active: Any) -> Any:
    """Whether nothing solid is between a hit and a point on an emitter."""
    ray = si.spawn_ray_to(lamp.p)
    if not view.cutouts:
        return active & ~view.scene.ray_test(ray, active)
    blocker, _ = _nearest(view, ray, active)
    return active & ~blocker.is_valid()


def _bounce(first: FirstHits, u: Any, *, maxt: Any = None) -> Any:
    """Rays from the first hits, of cosine density about the normals."""
    d = mi.Frame3f(first.normal).to_world(mi.warp.square_to_cosine_hemisphere(u))
    ray = first.surface.spawn_ray(d)
    if maxt is not None:
        ray.maxt = maxt
    return ray


def _sampler(first: FirstHits, seed: int) -> Any:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, first.height * first.width)
    return sampler


def _image(first: FirstHits, value: Any) -> np.ndarray:
    """A three-component array of Mitsuba's as an image."""
    return np.ascontiguousarray(np.asarray(value, np.float32).T).reshape(first.height, first.width, 3)
