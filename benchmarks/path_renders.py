"""Renders of the path tracer itself with references, as layers of `renders`: made where missing, kept in `FOLDER`.

A file <scene>_<width>x<height>_<what>.npz holds images in linear float32:

- noisy_<spp>_<seed>: guide rays as `trace_guides` gives them at its defaults, light over the reflectance. `ao` is the
  ambient occlusion that the renderer filters by: of the paths' own first hits, with eight short rays below 4 samples.
- ao_64: the same of 64 rays of their own, for rivals and for the mask of contacts.
- reference_<spp>_<seed>: through pixel centres. Two of them make a reference.
- smooth_<spp>_<seed>: what an anti-aliased picture converges to. 16 rays a pixel on a grid, each a guide ray of its
  own, share the paths; nothing is looked up or filtered. Two of them make a reference.

The noise of a reference is told by the difference of its halves: paths of a low-discrepancy sequence are less noisy
than their spread says.

Surfaces are matt, indirect light has two bounces. Another seed is taken for references.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from benchmarks.path_scenes import STAGES, Stage
from benchmarks.renders import Renders
from jaxrender import console
from jaxrender.pathtrace import TraceSettings, World, prepare
from jaxrender.pathtrace.guide_rays import AO_RADII, Traced, trace_guides

FOLDER = Path("out") / "pathtrace"
REFERENCE_SEEDS = (977, 978)

#: What a picture is the sum of.
PARTS = ("direct", "indirect", "emission")

# Rays a pixel of anti-aliased references, along either side.
_GRID = 4
_AO_RAYS = 64

Image = Float[np.ndarray, "h w 3"]
Layers = dict[str, np.ndarray]


@functools.lru_cache(maxsize=1)
def open_stage(name: str) -> tuple[Stage, World]:
    """A scene of `path_scenes`, ready for rays; the last one is kept."""
    stage = STAGES[name]()
    return stage, prepare(stage.scene, environment=stage.environment)


def load_path_renders(scene: str, *, height: int, width: int, spp: int, seed: int, reference_spp: int) -> Renders:
    """One noisy trace, its guides and its reference, made where they are missing."""
    guides = load_guides(scene, height=height, width=width, spp=spp, seed=seed)
    over = np.maximum(guides.albedo, 1e-3)

    def make_occlusion() -> Layers:
        found = _trace(scene, height, width, TraceSettings(bounces=0, ao_rays=_AO_RAYS, seed=REFERENCE_SEEDS[0]))
        return {"ao": found.ao}

    ao = _kept(f"{scene}_{width}x{height}_ao_{_AO_RAYS}", make_occlusion)["ao"]
    truth = load_reference(scene, height=height, width=width, spp=reference_spp)
    return Renders(
        scene=scene, spp=spp, seed=seed, reference_spp=reference_spp,
        ao_radii=tuple(radius * open_stage(scene)[1].extent for radius in AO_RADII),
        normal=guides.normal, depth=guides.depth, position=guides.position, albedo=guides.albedo,
        emission=guides.emission, ao=guides.ao, ao8=guides.ao, ao64=ao, direct=guides.direct / over,
        indirect=guides.incident, indirect_variance=guides.variance if spp > 1 else None,
        reference_direct=truth["direct"] / over, reference_indirect=truth["incident"],
        reference_direct_variance=np.zeros_like(over), reference_indirect_variance=truth["variance"],
    )  # fmt: skip


def load_guides(scene: str, *, height: int, width: int, spp: int, seed: int) -> Traced:
    """A noisy trace, with direct light by ratio."""

    def make() -> Layers:
        return vars(_trace(scene, height, width, TraceSettings(samples_per_pixel=spp, seed=seed, direct="ratio")))

    return Traced(**_kept(f"{scene}_{width}x{height}_noisy_{spp}_{seed}", make))


def load_reference(scene: str, *, height: int, width: int, spp: int) -> Layers:
    """`direct`, `incident` and its `variance`, through pixel centres, of so many samples in two halves."""
    halves = []
    for seed in REFERENCE_SEEDS:

        def make(seed: int = seed) -> Layers:
            console.announce(f"pathtrace: {scene}, {spp // 2} samples of the reference")
            found = _trace(scene, height, width, _converged(spp // 2, seed))
            return {name: getattr(found, name) for name in ("direct", "incident")}

        halves.append(_kept(f"{scene}_{width}x{height}_reference_{spp // 2}_{seed}", make))
    a, b = halves
    means = {name: 0.5 * (a[name] + b[name]) for name in ("direct", "incident")}
    return means | {"variance": 0.25 * (a["incident"] - b["incident"]) ** 2}


def load_smooth_halves(scene: str, *, height: int, width: int, spp: int) -> list[Layers]:
    """Two of `direct`, `indirect` and `emission`, means over whole pixels, together of so many samples."""
    paths = max(1, spp // (2 * _GRID**2))
    halves = []
    for seed in REFERENCE_SEEDS:

        def make(seed: int = seed) -> Layers:
            console.announce(f"pathtrace: {scene}, {spp // 2} samples of the anti-aliased reference")
            found = _trace(scene, _GRID * height, _GRID * width, _converged(paths, seed))
            return {name: _pixel_means(getattr(found, name)) for name in PARTS}

        halves.append(_kept(f"{scene}_{width}x{height}_smooth_{spp // 2}_{seed}", make))
    return halves


def _trace(scene: str, height: int, width: int, settings: TraceSettings) -> Traced:
    stage, world = open_stage(scene)
    settings = replace(settings, model="lambert")
    return trace_guides(world, stage.camera, height=height, width=width, settings=settings)


def _converged(spp: int, seed: int) -> TraceSettings:
    return TraceSettings(samples_per_pixel=spp, ao_rays=0, direct="ratio", seed=seed)


def _pixel_means(image: Image) -> Image:
    height, width = (size // _GRID for size in image.shape[:2])
    return image.reshape(height, _GRID, width, _GRID, -1).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def _kept(name: str, make: Callable[[], Layers]) -> Layers:
    """The images of a file, which is made first if it is missing."""
    file = FOLDER / f"{name}.npz"
    if not file.is_file():
        made = make()
        FOLDER.mkdir(parents=True, exist_ok=True)
        unfinished = file.with_suffix(".part.npz")
        np.savez(unfinished, allow_pickle=False, **{key: np.asarray(image, np.float32) for key, image in made.items()})
        unfinished.replace(file)
    with np.load(file) as stored:
        return {key: stored[key] for key in stored.files}
