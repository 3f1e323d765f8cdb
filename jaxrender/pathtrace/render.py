"""Scene and camera -> light of guide rays, filtered, looked up for all eye rays: the picture.

The steps are those of Bauszat, Eisemann, Magnor, "Guided Image Filtering for Interactive High-quality Global
Illumination", 2011, section 3, with an answer to soft shadows added (`shadow_ratio`). They run on the host, block by
block of pixels, as many at once as there are cores. The same seed gives the same picture.
"""

import dataclasses
import functools
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxrender.camera import Camera
from jaxrender.filters.aovs import Aovs
from jaxrender.filters.denoiser import denoise
from jaxrender.filters.settings import DenoiseSettings
from jaxrender.machine import on_all_cores
from jaxrender.pathtrace import programs
from jaxrender.pathtrace.emitters import only
from jaxrender.pathtrace.guide_rays import SHARP, Traced, joined, soft_groups, sum_of_groups, trace_guides
from jaxrender.pathtrace.paths import Vertex
from jaxrender.pathtrace.programs import light_up, make_view, rows, unshadowed_light
from jaxrender.pathtrace.settings import TraceSettings
from jaxrender.pathtrace.shadow_ratio import UNSHADOWED, filtered_ratio, ratio_radius
from jaxrender.pathtrace.sharpness import blend_windows, window_radii
from jaxrender.pathtrace.world import World, prepare
from jaxrender.scene import Scene

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
    """The direct light of guide rays, unfiltered, with the reflectance in it."""
    return trace_guides(_opened(scene), camera, height=height, width=width, settings=settings or TraceSettings()).direct


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
        samples_per_pixel=settings.samples_per_pixel,
    )  # fmt: skip
    found = denoise(aovs, settings=chosen)
    light, largest = found.layers["indirect"], int(found.chosen["radius"])
    wanted = largest * (1.0 - guides.sharpness)
    radii = window_radii(largest, float(wanted.min()) + _NEAR)
    if settings.radius is None and len(radii) > 1:
        chosen = dataclasses.replace(chosen, eps=float(found.chosen["eps"]))
        narrower = [
            denoise(aovs, settings=dataclasses.replace(chosen, radius=radius)).layers["indirect"]
            if radius else guides.incident for radius in radii[1:]
        ]  # fmt: skip
        light = np.asarray(_blend(np.stack([light, *narrower]), np.asarray(radii, np.float32), wanted))
    return light, found.chosen


def combine(
    world: World, camera: Camera, guides: Traced, incident: Float[np.ndarray, "h w 3"], *, settings: TraceSettings,
    chosen: dict[str, float | int | str] | None = None,
) -> Rendered:  # fmt: skip
    """All eye rays: each has its own surface and direct light, and the filtered light of the guide ray most like it."""
    height, width = guides.incident.shape[:2]
    spp = settings.samples_per_pixel
    looked_up = [incident, guides.met / np.maximum(guides.albedo, 1e-3)]
    if settings.by_ratio:
        looked_up += _ratios(world, guides, settings)
    images = jnp.asarray(np.concatenate(looked_up, axis=-1)), jnp.asarray(guides.normal), jnp.asarray(guides.depth)
    filtered = dataclasses.replace(guides, incident=incident)
    starts, size = programs.blocks(height * width)
    trace = functools.partial(_block, world, camera, filtered, images, block=size, settings=settings)
    sums = joined(list(on_all_cores(trace, starts)), height=height, width=width)
    parts = {name: image / spp for name, image in sums.items()}
    image = sum(parts.values(), np.zeros_like(incident))
    return Rendered(image, **parts, incident=incident, guides=guides, chosen=chosen or {})


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
    world: World, camera: Camera, guides: Traced, images: tuple[Array, Array, Array], start: int, *, block: int,
    settings: TraceSettings,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Sums over eye rays, for `block` pixels. `guides` have the filtered incident light."""
    height, width = guides.incident.shape[:2]
    view, spp, model = make_view(camera, height=height), settings.samples_per_pixel, settings.model
    soft, hard = soft_groups(world.emitters), only(world.emitters, SHARP)
    names = ("arrived", "sharp", "met", "emission", "albedo", "incident")
    own = {name: _cut(getattr(guides, name), start, block) for name in names}
    sums = {name: np.zeros((block, 3), np.float32) for name in ("direct", "indirect", "emission")}
    vertex = Vertex(0, settings.light_samples, spp if settings.bounces else 0, model)
    for sample in range(spp):
        if sample == 0 and not (settings.by_ratio and soft):
            # All is known of guide rays already.
            sums["direct"] += sum_of_groups(own["arrived"]) + own["sharp"] + own["met"]
            sums["emission"] += own["emission"]
            sums["indirect"] += own["albedo"] * own["incident"]
            continue
        rays, seeds = programs.eye_rays(view, start, settings.seed, sample, block=block, height=height, width=width)
        at, path, seen = programs.see(world, view, rays, model=model, by_ratio=True)
        found = np.asarray(programs.look_up_guides(*images, camera, seen, height=height, width=width))
        sums["emission"] += seen["emission"]
        sums["indirect"] += seen["albedo"] * found[:, :3]
        if hard.groups:
            sums["direct"] += light_up(world, hard, at, path, seeds, sample, vertex=vertex)[0]
        # Lamps that smooth surfaces mirror are met by the guides' paths only.
        sums["direct"] += np.where(np.asarray(path.shared)[:, None], seen["albedo"] * found[:, 3:6], np.float32(0.0))
        for group, emitters in enumerate(soft):
            if not settings.by_ratio:
                sums["direct"] += light_up(world, emitters, at, path, seeds, sample, vertex=vertex)[0]
                continue
            many = vertex._replace(drawn=max(1, UNSHADOWED // spp))
            whole = rows(unshadowed_light(emitters, world.table, at, path, seeds, np.int32(sample), vertex=many))
            sums["direct"] += whole * found[:, 6 + 3 * group : 9 + 3 * group]
    return sums


_blend = jax.jit(blend_windows)


def _cut(image: Float[np.ndarray, "h w c"], start: int, count: int) -> np.ndarray:
    """`count` pixels from pixel `start` on; past the last, zeros."""
    pixels = image.reshape(-1, image.shape[-1])[start : start + count]
    return np.pad(pixels, [(0, count - len(pixels)), (0, 0)])
