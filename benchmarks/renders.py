"""Noisy renders with a known reference, made with Mitsuba where they are missing and kept in `out/renders`.

A folder <scene>_<width>x<height> holds layers in linear float32. Light is demodulated: divided by the albedo of the
first hit, so a picture is albedo * (direct + indirect) + emission. Paths and scenes are those of `mitsuba_scenes`.

- guides.exr, without noise: normal (world, on the side of the face that the eye sees), depth (linear view depth),
  position (world) and albedo, all 0 where nothing is hit; emission (lamps and sky seen directly); ao8 and ao64, as
  "ao", but of so many stratified rays of their own.
- noisy_<spp>_<seed>.exr: direct, indirect, ao. From 2 samples on also the means of the first and of the second half
  of the samples (direct_a, direct_b, indirect_a, indirect_b) and indirect_variance.
- reference.exr: direct, indirect, direct_variance, indirect_variance.
- settings.json: by file, what it was made with. Files made with other settings are made anew.

A variance is that of the mean of all samples. Ambient occlusion (ao) is the mean of min(d / R, 1), d the distance that
a ray of cosine density goes; its channels are those of three R, shares of the diagonal of the box around all that the
camera sees. "ao" is that of the first bounces of the paths, so it costs nothing, and shares their noise.
"""

import functools
import importlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxrender import checks, console
from jaxrender.io import read_exr_layers, write_exr
from jaxrender.io.atomic import write_bytes

FOLDER = Path("out/renders")
SCENES = ("cornell", "statue", "atrium", "sponza")
#: (height, width).
SIZES = ((384, 512), (768, 1024))
SPP, SEEDS, REFERENCE_SPP = (1, 4, 16, 64), (0, 1), 1024
#: The R of ambient occlusion, as shares of the extent.
AO_SHARES = (0.05, 0.15, 0.4)
#: To be raised when scenes or estimators change: everything is then made anew.
VERSION = 1

# Of the primary rays that measure the extent, which must be the same for all sizes of picture.
_EXTENT_SIZE = (96, 128)
# Sums of a chunk are float32; those of all chunks float64.
_CHUNK = 64
# First word of the seeds, so that no two files share random numbers.
_AO8, _AO64, _NOISY, _REFERENCE = range(4)

Image = Float[np.ndarray, "h w 3"]
Layers = Mapping[str, Float[np.ndarray, "h w _"]]


class NoRenders(Exception):
    """They are not here and cannot be made; the message says why."""


@dataclass(frozen=True, eq=False)
class Renders:
    """One noisy render, its guides and its reference; the fields are the layers described above.

    Attributes:
      spp, reference_spp: samples per pixel. seed: of the noisy render.
      ao_radii: R of the channels of ambient occlusion, in units of the scene.
      reference_direct ...: the layers of reference.exr. What takes two samples is None at one.
    """

    scene: str
    spp: int
    seed: int
    reference_spp: int
    ao_radii: tuple[float, ...]
    normal: Image
    depth: Float[np.ndarray, "h w 1"]
    position: Image
    albedo: Image
    emission: Image
    ao8: Image
    ao64: Image
    direct: Image
    indirect: Image
    ao: Image
    reference_direct: Image
    reference_indirect: Image
    reference_direct_variance: Image
    reference_indirect_variance: Image
    direct_a: Image | None = None
    direct_b: Image | None = None
    indirect_a: Image | None = None
    indirect_b: Image | None = None
    indirect_variance: Image | None = None


def load_renders(
    scene: str,
    *,
    height: int,
    width: int,
    spp: int,
    seed: int,
    reference_spp: int = REFERENCE_SPP,
    folder: str | Path = FOLDER,
) -> Renders:
    """Reads a noisy render with guides and reference, and makes first what is missing.

    Args:
      reference_spp: at least so many samples in the reference; one with more is taken as it is.
      folder: where the folders of all scenes are.
    Raises:
      ValueError: if there is no such scene, or a number is out of range.
      NoRenders: if something is missing, and Mitsuba, an LLVM library for it or the shared data are not here.
    """
    made = _Shelf(scene, height, width, Path(folder))
    guides = made.guides()
    noisy = made.noisy(spp=spp, seed=seed)
    reference = made.reference(spp=reference_spp)
    settings = made.settings()
    layers = {**guides, **noisy, **{f"reference_{name}": pixels for name, pixels in reference.items()}}
    return Renders(
        scene=scene,
        spp=spp,
        seed=seed,
        reference_spp=settings["reference.exr"]["spp"],
        ao_radii=tuple(settings["guides.exr"]["ao_radii"]),
        **{field.name: layers[field.name] for field in fields(Renders) if field.name in layers},
    )


def make_all(
    sizes: Iterable[tuple[int, int]] = SIZES,
    scenes: Iterable[str] = SCENES,
    *,
    reference_spp: int = REFERENCE_SPP,
    folder: str | Path = FOLDER,
) -> None:
    """Makes what is missing of the sizes (height, width) and scenes: the noisy renders of all, then the references.

    Raises:
      as `load_renders`.
    """
    for height, width in sizes:
        shelves = [_Shelf(scene, height, width, Path(folder)) for scene in scenes]
        for shelf in shelves:
            shelf.guides()
            for spp in SPP:
                for seed in SEEDS:
                    shelf.noisy(spp=spp, seed=seed)
        for shelf in shelves:
            shelf.reference(spp=reference_spp)


class _Shelf:
    """The files of one scene at one size, and what makes them. Mitsuba is loaded when the first is missing."""

    def __init__(self, scene: str, height: int, width: int, folder: Path):
        checks.check_one_of("scene", scene, SCENES)
        checks.check_at_least("height", height, 1)
        checks.check_at_least("width", width, 1)
        self.scene, self.height, self.width = scene, height, width
        self.folder = folder / f"{scene}_{width}x{height}"

    def settings(self) -> dict[str, Any]:
        """What settings.json says, by file; nothing if it is missing or damaged."""
        try:
            found = json.loads((self.folder / "settings.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        entries = found.items() if isinstance(found, dict) else ()
        return {name: entry for name, entry in entries if isinstance(entry, dict)}

    def guides(self) -> Layers:
        """The layers of guides.exr."""
        if not self._has("guides.exr"):
            layers = self._tracer.guides(self._first, self._view.camera)
            for name, strata, stream in (("ao8", (4, 2), _AO8), ("ao64", (8, 8), _AO64)):
                options = {"strata": strata, "seed": _seed(stream), "radii": self._radii}
                layers[name] = self._tracer.ambient_occlusion(self._view, self._first, **options)
            self._keep("guides.exr", layers)
        return read_exr_layers(self.folder / "guides.exr")

    def noisy(self, *, spp: int, seed: int) -> Layers:
        """The layers of a noisy render."""
        checks.check_at_least("spp", spp, 1)
        checks.check_at_least("seed", seed, 0)
        file = f"noisy_{spp}_{seed}.exr"
        if not self._has(file, seed=seed, spp=spp):
            counts = {"a": spp - spp // 2, "b": spp // 2} if spp > 1 else {"a": spp}
            halves = {half: self._sums(n, _NOISY, spp, seed, i) for i, (half, n) in enumerate(counts.items())}
            total = {name: np.sum([half[name] for half in halves.values()], axis=0) for name in halves["a"]}
            layers = {name: total[name] / spp for name in ("direct", "indirect", "ao")}
            if spp > 1:
                layers |= {
                    f"{n}_{half}": halves[half][n] / counts[half] for n in ("direct", "indirect") for half in "ab"
                }
                layers["indirect_variance"] = _variance_of_mean(total, "indirect", spp)
            self._keep(file, layers, seed=seed, spp=spp)
        return read_exr_layers(self.folder / file)

    def reference(self, *, spp: int) -> Layers:
        """The layers of the reference, of at least `spp` samples."""
        checks.check_at_least("reference_spp", spp, 2)
        there = self.settings().get("reference.exr", {}).get("spp", 0)
        if not self._has("reference.exr", spp=max(spp, there)):
            total: dict[str, np.ndarray] = {}
            label = f"renders: {self.folder.name}, reference of {spp} samples per pixel"
            with console.progress(label, total=spp, unit="samples") as advance:
                for chunk, start in enumerate(range(0, spp, _CHUNK)):
                    count = min(_CHUNK, spp - start)
                    sums = self._sums(count, _REFERENCE, chunk)
                    total = {name: total[name] + values if total else values for name, values in sums.items()}
                    advance(count)
            layers = {name: total[name] / spp for name in ("direct", "indirect")}
            layers |= {f"{name}_variance": _variance_of_mean(total, name, spp) for name in ("direct", "indirect")}
            self._keep("reference.exr", layers, spp=spp)
        return read_exr_layers(self.folder / "reference.exr")

    def _has(self, file: str, **settings: int) -> bool:
        """Whether a file is there and was made with these settings."""
        found = self.settings().get(file, {})
        same = all(found.get(key) == value for key, value in (settings | {"version": VERSION}).items())
        if same and (self.folder / file).is_file():
            return True
        console.announce(f"renders: making {self.folder.name}/{file}")
        return False

    def _keep(self, file: str, layers: Mapping[str, np.ndarray], **settings: int) -> None:
        self._note(file, None)
        write_exr(self.folder / file, {name: values.astype(np.float32) for name, values in layers.items()})
        made = {"version": VERSION, **settings, "ao_radii": self._radii, "mitsuba": version("mitsuba")}
        self._note(file, made)

    def _note(self, file: str, made: Mapping[str, Any] | None) -> None:
        """Puts what a file was made with in settings.json, or takes it out while the file changes."""
        entries = {name: entry for name, entry in self.settings().items() if name != file}
        entries |= {file: made} if made else {}
        write_bytes(self.folder / "settings.json", json.dumps(entries, indent=1, sort_keys=True).encode())

    def _sums(self, count: int, *stream: int) -> dict[str, np.ndarray]:
        """Float64 sums of `light_sums` over so many samples, of random numbers that belong to this stream alone."""
        sums = self._tracer.light_sums(
            self._view, self._first, num_samples=count, seed=_seed(*stream), radii=self._radii
        )
        return {name: values.astype(np.float64) for name, values in sums.items()}

    @functools.cached_property
    def _tracer(self) -> Any:
        try:
            return importlib.import_module("benchmarks.mitsuba_scenes")
        except ImportError as error:
            raise NoRenders(f"renders are made with Mitsuba (extra `peers`), which is not here: {error}") from error

    @functools.cached_property
    def _view(self) -> Any:
        try:
            return self._tracer.build(self.scene)
        except self._tracer.NoMitsuba as error:
            raise NoRenders(f"renders cannot be made here: {error}") from error

    @functools.cached_property
    def _first(self) -> Any:
        return self._tracer.first_hits(self._view, height=self.height, width=self.width)

    @functools.cached_property
    def _radii(self) -> tuple[float, ...]:
        first = self._tracer.first_hits(self._view, height=_EXTENT_SIZE[0], width=_EXTENT_SIZE[1])
        seen = np.asarray(first.surface.p, np.float64)[:, np.asarray(first.hit)]
        return tuple(float(share * np.linalg.norm(np.ptp(seen, axis=1))) for share in AO_SHARES)


def _variance_of_mean(total: Mapping[str, np.ndarray], name: str, count: int) -> np.ndarray:
    """From sums and sums of squares; rounding of float32 leaves an error of about 1e-6 of the mean squared."""
    mean = total[name] / count
    return np.maximum(total[f"{name}_squared"] / count - mean * mean, 0.0) / (count - 1)


def _seed(*stream: int) -> int:
    return int(np.random.SeedSequence(stream).generate_state(1)[0])
