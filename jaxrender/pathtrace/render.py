"""Scene and camera -> light of guide rays, filtered, looked up for all eye rays: the picture.

The steps are those of Bauszat, Eisemann, Magnor, "Guided Image Filtering for Interactive High-quality Global
Illumination", 2011, section 3, with an answer to soft shadows added (`shadow_ratio`). They run block by block of
pixels, as many at once as a CPU has cores. The same seed gives the same picture.
"""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender import vec3
from jaxrender.camera import Camera
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.denoiser import denoise
from jaxrender.filters.fireflies import clamp_fireflies
from jaxrender.filters.settings import DenoiseSettings
from jaxrender.pathtrace import programs
from jaxrender.pathtrace.emitters import only
from jaxrender.pathtrace.guide_rays import SHARP, Traced, soft_groups, trace_guides
from jaxrender.pathtrace.paths import Vertex
from jaxrender.pathtrace.programs import light_up, make_view, unshadowed_light
from jaxrender.pathtrace.settings import TraceSettings
from jaxrender.pathtrace.shadow_ratio import UNSHADOWED, filtered_ratio, ratio_radius
from jaxrender.pathtrace.sharpness import blend_windows, window_radii
from jaxrender.pathtrace.world import World, prepare
from jaxrender.scene import Scene
from jaxrender.vec3 import Scalar, Vec3

#: Of a picture; they add up to it.
PARTS = ("direct", "indirect", "emission")

# Radii that are wanted this near below one are not worth another.
_NEAR = 0.5


@dataclass(frozen=True)
class Rendered:
    """A picture and its parts.

    Attributes:
      image: direct + indirect + emission, the mean over all eye rays.
      incident: filtered indirect light of guide rays, over the reflectance.
      guides: what it was made of. chosen: the filter's settings.
    """

    image: Float[np.ndarray, "h w 3"]
    direct: Float[np.ndarray, "h w 3"]
    indirect: Float[np.ndarray, "h w 3"]
    emission: Float[np.ndarray, "h w 3"]
    incident: Float[np.ndarray, "h w 3"]
    guides: Traced
    chosen: dict[str, float | int | str] = field(default_factory=dict)


def render(
    scene: Scene | World, camera: Camera, *, height: int, width: int, settings: TraceSettings | None = None
) -> Rendered:
    """Traces, filters, and puts together. Not for use inside `jit`.

    Args:
      scene: of `prepare` to use it for several pictures, or with lights that are not the scene's.
    Raises:
      ValueError: if a size or a setting is out of its range.
    """
    settings = settings or TraceSettings()
    world = _opened(scene)
    guides = trace_guides(world, camera, height=height, width=width, settings=settings)
    incident, chosen = filter_incident(guides, settings)
    return combine(world, camera, guides, incident, settings=settings, chosen=chosen)


def render_direct(
    scene: Scene | World, camera: Camera, *, height: int, width: int, settings: TraceSettings | None = None
) -> Float[np.ndarray, "h w 3"]:
    """The direct light of guide rays, unfiltered, with the reflectance in it: that of no bounces, by drawn lights."""
    alone = dataclasses.replace(settings or TraceSettings(), bounces=0, ao_rays=0)
    return trace_guides(_opened(scene), camera, height=height, width=width, settings=alone).direct


def render_indirect(
    scene: Scene | World, camera: Camera, *, height: int, width: int, settings: TraceSettings | None = None
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]:
    """The indirect light that arrives where guide rays end, unfiltered, over the reflectance; and the reflectance."""
    guides = trace_guides(_opened(scene), camera, height=height, width=width, settings=settings or TraceSettings())
    return guides.incident, guides.albedo


def _opened(scene: Scene | World) -> World:
    return scene if isinstance(scene, World) else prepare(scene)


def filter_incident(guides: Traced, settings: TraceSettings) -> tuple[np.ndarray, dict[str, float | int | str]]:
    """The indirect light of guide rays, filtered by normals, depths and ambient occlusion; and the settings.

    Where surfaces mirror, windows are narrower, unless a radius is set (`sharpness`).
    """
    if settings.method == "none" or settings.bounces == 0 or not guides.normal.any():
        return guides.incident, {"method": "none"}
    aovs = Aovs(
        guides.incident, direct=np.zeros_like(guides.incident), indirect=guides.incident, normal=guides.normal,
        depth=guides.depth, ao=guides.ao,
    )  # fmt: skip
    chosen = DenoiseSettings(
        method=settings.method, radius=settings.radius, eps=settings.eps,  # type: ignore[arg-type]
        samples_per_pixel=settings.samples_per_pixel, auto=settings.cross_validated,
    )  # fmt: skip
    found = denoise(aovs, settings=chosen)
    light, largest = found.layers["indirect"], int(found.chosen["radius"])
    wanted = largest * (1.0 - guides.sharpness)
    radii = window_radii(largest, float(wanted.min()) + _NEAR)
    if settings.radius is None and len(radii) > 1:
        chosen = dataclasses.replace(chosen, eps=float(found.chosen["eps"]))
        narrower = [
            denoise(aovs, settings=dataclasses.replace(chosen, radius=radius)).layers["indirect"]
            if radius else np.asarray(_clamped(guides.incident, chosen.firefly_factor)) for radius in radii[1:]
        ]  # fmt: skip
        light = np.asarray(_blend(np.stack([light, *narrower]), np.asarray(radii, np.float32), wanted))
    return light, {name: value for name, value in found.chosen.items() if name != "filtered"}


def combine(
    world: World, camera: Camera, guides: Traced, incident: Float[np.ndarray, "h w 3"], *, settings: TraceSettings,
    chosen: dict[str, float | int | str] | None = None,
) -> Rendered:  # fmt: skip
    """All eye rays: each has its own surface and direct light, and the filtered light of the guide ray most like it."""
    height, width = guides.incident.shape[:2]
    # All is known of guide rays already, but for soft light that goes by ratio.
    known = not (settings.by_ratio and soft_groups(world.emitters))
    own = {"direct": guides.direct, "indirect": guides.albedo * incident, "emission": guides.emission}
    sums = own if known else dict.fromkeys(PARTS, np.zeros_like(incident))
    samples = range(1 if known else 0, settings.samples_per_pixel)
    if samples:
        images = _looked_up(world, guides, incident, settings)
        trace = functools.partial(_block, world, camera, images, samples, height=height, width=width, settings=settings)
        traced = programs.trace_blocks(trace, height=height, width=width)
        sums = {name: sums[name] + traced[name] for name in PARTS}
    parts = {name: image / settings.samples_per_pixel for name, image in sums.items()}
    image = sum(parts.values(), np.zeros_like(incident))
    return Rendered(image, **parts, incident=incident, guides=guides, chosen=chosen or {})


def _looked_up(
    world: World, guides: Traced, incident: Float[np.ndarray, "h w 3"], settings: TraceSettings
) -> tuple[Array, Array, Array]:
    """What eye rays take from guide rays, side by side, and what they find them by."""
    values = [incident, guides.met / np.maximum(guides.albedo, 1e-3)]
    if settings.by_ratio:
        values += _ratios(world, guides, settings)
    return jnp.asarray(np.concatenate(values, axis=-1)), jnp.asarray(guides.normal), jnp.asarray(guides.depth)


def _ratios(world: World, guides: Traced, settings: TraceSettings) -> list[np.ndarray]:
    """The share of light that arrives, for each group of soft lights."""
    over = np.maximum(guides.albedo, 1e-3)
    ratios = []
    for k, emitters in enumerate(soft_groups(world.emitters)):
        arrived, unshadowed = (x[..., 3 * k : 3 * k + 3] / over for x in (guides.arrived, guides.unshadowed))
        radius = ratio_radius(settings.shadow_rays, group=emitters.groups[0])
        ratios.append(
            filtered_ratio(arrived, unshadowed, normal=guides.normal, depth=guides.depth, ao=guides.ao, radius=radius)
        )
    return ratios


def _block(
    world: World, camera: Camera, images: tuple[Array, Array, Array], samples: range, start: int, *, block: int,
    height: int, width: int, settings: TraceSettings,
) -> dict[str, Vec3]:  # fmt: skip
    """Sums over eye rays, for `block` pixels."""
    view, spp, model = make_view(camera, height=height), settings.samples_per_pixel, settings.model
    vertex = Vertex(0, settings.light_samples, spp if settings.bounces else 0, model)
    many = vertex._replace(drawn=max(1, UNSHADOWED // spp))
    by_ratio = soft_groups(world.emitters) if settings.by_ratio else []
    drawn = only(world.emitters, SHARP) if settings.by_ratio else world.emitters
    sums: dict[str, Vec3] = {}
    for sample in samples:
        rays, seeds = programs.eye_rays(view, start, settings.seed, sample, block=block, height=height, width=width)
        at, path, seen = programs.see(world, view, rays, model=model, by_ratio=True)
        found = programs.look_up_guides(*images, camera, seen, height=height, width=width)
        light, _ = light_up(world, drawn, at, path, seeds, sample, vertex=vertex)
        whole = [unshadowed_light(emitters, world.table, at, path, seeds, sample, vertex=many) for emitters in by_ratio]
        parts = _parts(seen, found, path.shared, light, whole)
        sums = programs.added(sums, parts) if sums else parts
    return sums


_blend = jax.jit(blend_windows)


@functools.partial(jax.jit, static_argnames="factor")
def _clamped(light: Float[Array, "h w 3"], factor: float | None) -> Float[Array, "h w 3"]:
    return light if factor is None else clamp_fireflies(light, factor=factor)[0]


@jax.jit
def _parts(
    seen: dict[str, Sequence[Scalar]], found: Float[Array, "n c"], mirrors: Bool[Array, " n"], light: Vec3,
    whole: Sequence[Vec3],
) -> dict[str, Vec3]:  # fmt: skip
    """The light of eye rays.

    Args:
      found: what `_looked_up` gives, of the guide ray that is most alike.
      mirrors: where lamps that smooth surfaces mirror are met, which the guides' paths do alone.
      whole: light of each soft group that nothing is in front of.
    """
    incident, met, *ratios = (vec3.from_array(found[:, 3 * k : 3 * k + 3]) for k in range(found.shape[1] // 3))
    albedo = Vec3(*seen["albedo"])
    direct = light + vec3.where(mirrors, albedo * met, 0.0)
    for value, ratio in zip(whole, ratios, strict=True):
        direct = direct + value * ratio
    return {"direct": direct, "indirect": albedo * incident, "emission": Vec3(*seen["emission"])}
