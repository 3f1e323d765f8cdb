"""Files of renderers -> the images a denoiser takes: a layer for each, light in parts as far as they add up."""

import contextlib
import os
import pathlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import OpenEXR
from jaxtyping import Float, Num

from jaxrender.checks import bad_input
from jaxrender.io.exr import group_channels, read_exr_header, read_exr_layers
from jaxrender.io.layer_names import LIGHT_LOBES, AovNames

#: Images with one channel; all others have three, but ambient occlusion any number.
SINGLE = ("depth",)
#: Light adds up where a sum differs by less than this share of its parts: four roundings to half floats.
SUM_TOLERANCE = 4 * 2.0**-11
#: Share of the pixels that may differ by more: a renderer clamps some.
MISFITS = 1e-3

# Other images people hand in by mistake: all of them hold integers that are encoded for a display.
_OTHER_IMAGES = {b"\x89PNG": "PNG", b"\xff\xd8\xff": "JPEG", b"GIF8": "GIF", b"RIFF": "WebP", b"BM": "BMP"}


@dataclass(frozen=True)
class LayeredFile:
    """An EXR file: `layers` as `read_exr_layers` has them, and for each the full names its channels are written under.

    samples_per_pixel is what the header says, None where it does not: Cycles and pbrt write it.
    """

    path: pathlib.Path
    layers: dict[str, Num[np.ndarray, "h w c"]]
    channels: dict[str, tuple[str, ...]]
    samples_per_pixel: float | None

    def listing(self) -> str:
        """The names of the layers, for messages."""
        return ", ".join(repr(name) for name in self.layers)


def read_layered_file(path: str | os.PathLike) -> LayeredFile:
    """Reads all layers of an EXR file.

    Raises:
      InputError: as `read_exr_layers`, and by its kind if it is an image of integers. OSError: if it cannot be read.
    """
    path = pathlib.Path(path)
    with path.open("rb") as file:
        magic = file.read(4)
    kind = next((name for start, name in _OTHER_IMAGES.items() if magic.startswith(start)), None)
    if kind is not None:
        bad_input(path, "content", expected="an OpenEXR image of linear floating point", got=f"{kind}, integers")
    parts = read_exr_header(path)
    layers = read_exr_layers(path)
    channels: dict[str, tuple[str, ...]] = {}
    for index, part in enumerate(parts):
        own = "" if index == 0 else part.name
        before = f"{own}." if own else ""
        groups = group_channels(part.channels)
        if sorted(name.upper() for name in part.channels) == ["X", "Y", "Z"]:
            # Nothing but a vector. Each reads as what it may be among others: the Y as a picture, the Z as depth.
            places = {name.upper(): before + name if name.upper() != "Y" else own for name in part.channels}
            layers[own] = np.concatenate([layers.pop(places[axis]) for axis in "XYZ"], axis=-1)
            groups = {"": sorted(part.channels)}
        for name, members in groups.items():
            full = f"{before}{name}" if name else own
            channels[full] = tuple(m if m.startswith(before) else before + m for m in members)
    return LayeredFile(path, layers, channels, _samples_per_pixel(path))


def split_reference(reference: str) -> tuple[pathlib.Path, str | None]:
    """Path and layer of "FILE.exr:LAYER"; None where no layer is named, "" for the picture itself ("FILE.exr:")."""
    found = re.fullmatch(r"(.+?\.exr):(.*)", reference, re.IGNORECASE | re.DOTALL)
    if found is None or pathlib.Path(reference).exists():
        return pathlib.Path(reference), None
    return pathlib.Path(found[1]), found[2]


def pick_layers(file: LayeredFile, aov: str, layer: str | None = None) -> tuple[str, ...]:
    """The layer of `file` that is the image `aov`: the one named, else the one known by name, else the only one.

    Three names are those of its x, y and z.

    Raises:
      InputError: if there is no such layer, or none to be sure of.
    """
    if layer is not None:
        if layer not in file.layers:
            bad_input(file.path, "layers", expected=f"a layer {layer!r}", got=file.listing())
        return (layer,)
    found = AovNames(file.layers).find(aov)
    if found:
        return found
    if "" in file.layers or len(file.layers) == 1:
        return ("",) if "" in file.layers else tuple(file.layers)
    bad_input(file.path, "layers", expected=f"a layer known as {aov}, or :LAYER after the name", got=file.listing())


def aov_image(file: LayeredFile, aov: str, layers: Sequence[str]) -> Float[np.ndarray, "h w c"]:
    """The image `aov` of one layer, or of three that are its x, y and z, with as many channels as `filters.Aovs` has.

    Gray is repeated where there should be colors, alpha is dropped, and of colors that are all equal one is taken where
    one is wanted. Of ambient occlusion all channels are taken that differ: they may be of rays of several lengths.

    Raises:
      InputError: if the layer has another number of channels, or holds integers.
    """
    pixels = np.concatenate([file.layers[name] for name in layers], axis=-1)
    field = f"layer {layers[0]!r}"
    if not np.issubdtype(pixels.dtype, np.floating):
        bad_input(file.path, field, expected=f"floating point ({aov})", got=f"integers ({pixels.dtype})")
    count = pixels.shape[-1]
    if aov == "ao":
        return _different(pixels[..., :3] if count == 4 else pixels)
    if count not in (1, 3, 4):
        bad_input(file.path, field, expected=f"1, 3 or 4 channels ({aov})", got=f"{count}")
    if aov not in SINGLE:
        if count == 1 and aov in ("normal", "position"):
            bad_input(file.path, field, expected=f"3 channels ({aov})", got="1")
        return np.repeat(pixels, 3, axis=-1) if count == 1 else np.ascontiguousarray(pixels[..., :3])
    if count == 1:
        return pixels
    if not np.array_equal(pixels[..., 1:3], pixels[..., [0, 0]], equal_nan=True):
        bad_input(file.path, field, expected=f"1 channel, or 3 that are equal ({aov})", got=f"{count} that differ")
    return np.ascontiguousarray(pixels[..., :1])


def _different(pixels: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w k"]:
    """The channels without those that equal an earlier one."""
    kept: list[int] = []
    for index in range(pixels.shape[-1]):
        if not any(np.array_equal(pixels[..., index], pixels[..., other], equal_nan=True) for other in kept):
            kept.append(index)
    return np.ascontiguousarray(pixels[..., kept])


def _samples_per_pixel(path: pathlib.Path) -> float | None:
    """What the renderer noted in the header."""
    with OpenEXR.File(str(path), header_only=True) as file:  # the header goes when the file is closed
        notes = [
            value
            for name, value in file.header(0).items()
            if name == "samplesPerPixel" or re.fullmatch(r"cycles\..*\.samples", name)
        ]
    for note in notes:
        with contextlib.suppress(ValueError, TypeError):
            if 0 < float(note) < 1e9:
                return float(note)
    return None


# --- Light in parts


@dataclass(frozen=True)
class Light:
    """A picture in parts that add up to it. `layers` has the layer of a part that is one of the file's, unchanged."""

    direct: Float[np.ndarray, "h w 3"]
    indirect: Float[np.ndarray, "h w 3"]
    emission: Float[np.ndarray, "h w 3"] | None
    layers: Mapping[str, str]


def split_light(
    file: LayeredFile, names: AovNames, color: Float[np.ndarray, "h w 3"], given: Mapping[str, np.ndarray]
) -> tuple[Light | None, str]:
    """The light of `color` in parts, and a remark if there are parts that do not add up to it, which are not used.

    Parts are, in this order, those of `given` (direct, indirect, emission), the layers direct and indirect, and the
    lobes that Blender and Arnold write. Where only indirect light is there, the rest of the picture is direct.
    """
    emissions, remark = _emissions(file, names, given), ""
    for what, direct, indirect, own in _splits(file, names, given):
        off = []
        for emission, source in emissions:
            lit, misfits = _fitted(color, direct, indirect, emission)
            if misfits <= MISFITS:
                return Light(lit, indirect, emission, {**own, **source}), ""
            off.append(misfits)
        off_percent = f"{100 * min(off):.3g} %"
        remark = f"{what} do not add up to the picture (at {off_percent} of the pixels): it is filtered as a whole"
    return None, remark


def _fitted(
    color: np.ndarray, direct: np.ndarray | None, indirect: np.ndarray, emission: np.ndarray | None
) -> tuple[Float[np.ndarray, "h w 3"], float]:
    """Direct light, which is the rest of the picture if it is None, and the share of pixels that do not add up."""
    known = [indirect] if emission is None else [indirect, emission]
    if direct is None:
        with np.errstate(invalid="ignore", over="ignore"):
            direct = np.maximum(color - sum(known), 0.0)
    return direct, misfit_share(color, [direct, *known])


def misfit_share(total: Float[np.ndarray, "h w c"], parts: Sequence[Float[np.ndarray, "h w c"]]) -> float:
    """Share of the finite pixels where `parts` do not add up to `total` within `SUM_TOLERANCE` of their sizes."""
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.abs(sum(parts) - total)
        size = sum(np.abs(part) for part in parts)
        wrong = (difference > SUM_TOLERANCE * size + 1e-6).any(axis=-1)
        finite = np.isfinite(difference).all(axis=-1)
    return float(wrong[finite].mean()) if finite.any() else 1.0


def _emissions(file: LayeredFile, names: AovNames, given: Mapping[str, np.ndarray]) -> list:
    """What may be in the picture beside reflected light, most likely first: each with the layer it is, if it is one."""
    if "emission" in given:
        return [(given["emission"], {})]
    found = {aov: names.find(aov) for aov in ("emission", "background")}
    images = {aov: aov_image(file, aov, layers) for aov, layers in found.items() if layers}
    single = [(image, {"emission": found[aov][0]}) for aov, image in images.items()]
    return ([(sum(images.values()), {})] if len(images) == 2 else []) + single + [(None, {})]


def _splits(file: LayeredFile, names: AovNames, given: Mapping[str, np.ndarray]):
    """Yields what to call a split in a remark, its direct and indirect light, and which of them are single layers."""
    found = {aov: names.find(aov) for aov in ("direct", "indirect") if aov not in given}
    own = {aov: layers[0] for aov, layers in found.items() if layers}
    parts = {aov: given[aov] if aov in given else aov_image(file, aov, (own[aov],)) for aov in {*given, *own}}
    if "direct" in parts and "indirect" in parts:
        yield "direct and indirect light", parts["direct"], parts["indirect"], own
    elif "indirect" in parts:
        yield "indirect light and a direct rest", None, parts["indirect"], own
    for renderer, lobes in LIGHT_LOBES.items():
        light = [_sum_of_lobes(file, names, [(lobe[k], lobe[2]) for lobe in lobes]) for k in (0, 1)]
        if light[0] is not None and light[1] is not None:
            yield f"the lobes of {renderer}", light[0], light[1], {}


def _sum_of_lobes(file: LayeredFile, names: AovNames, pairs: Sequence[tuple[str, str]]) -> np.ndarray | None:
    """Sum of light times color over the lobes of which the light is there; None if there is none."""
    total = None
    for light, color in pairs:
        layer, tint = names.find_name(light), names.find_name(color) if color else None
        if layer is None or (color and tint is None):
            continue
        part = file.layers[layer][..., :3]
        with np.errstate(invalid="ignore", over="ignore"):
            part = part * file.layers[tint][..., :3] if tint is not None else part
            total = part if total is None else total + part
    return total


def lobe_albedo(file: LayeredFile, names: AovNames) -> Float[np.ndarray, "h w 3"]:
    """Sum of the colors of Blender's lobes, of which there is one: the albedo of all ways a surface reflects."""
    colors = [names.find_name(color) for _, _, color in LIGHT_LOBES["Blender"] if color]
    layers = [file.layers[name][..., :3] for name in colors if name is not None]
    return sum(layers[1:], start=layers[0])
