"""What `jaxrender denoise` works on: files of any renderer, or a noisy picture of the built-in scene, as `Aovs`."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from jaxrender.checks import bad_input
from jaxrender.filters.aovs import Aovs
from jaxrender.io.aovs import (
    LayeredFile,
    aov_image,
    lobe_albedo,
    pick_layers,
    read_layered_file,
    split_light,
    split_reference,
)
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.io.exr import exr_attributes, read_exr_header
from jaxrender.io.layer_names import AovNames
from jaxrender.pathtrace.guide_rays import Traced, trace_guides
from jaxrender.pathtrace.settings import TraceSettings
from jaxrender.pathtrace.world import prepare
from jaxrender.scene import whole_scene_camera

#: Images that tell where edges are; one of them there must be.
GUIDES = ("normal", "depth", "position")
#: Parts of the picture that add up to it.
LIGHT = ("direct", "indirect", "emission")

_BESIDE = (*GUIDES, "albedo", "ao")

#: Samples a pixel of the built-in picture.
BUILTIN_SAMPLES = 4


@dataclass(frozen=True)
class DenoiseInputs:
    """Images to filter, and what is to be written beside the result.

    Attributes:
      name: of the picture, for messages.
      alpha: (h, w, 1) of the picture, None without. gray: the picture had one channel, and its name.
      sources: which layer each image is, for people.
      channels: all of the file but the picture, by full name, to be handed on.
      replaced: filtered part of the light -> the channels it has in the file, if it is a layer there.
      notes: what people should be told.
      samples_per_pixel: as the file says, None where it does not.
      attributes: of the file's header, to be handed on.
    """

    name: str
    aovs: Aovs
    alpha: Float[np.ndarray, "h w 1"] | None = None
    gray: str = ""
    sources: Mapping[str, str] = field(default_factory=dict)
    channels: Mapping[str, Num[np.ndarray, "h w 1"]] = field(default_factory=dict)
    replaced: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    samples_per_pixel: float | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)


def read_inputs(noisy: str, others: Mapping[str, str]) -> DenoiseInputs:
    """Reads "FILE[:LAYER]" with the noisy picture, finds what is beside it, and reads `others` in place of that.

    Args:
      others: name of an image of `Aovs` -> "FILE[:LAYER]".
    Raises:
      InputError: if a file or layer is not usable, sizes differ, or nothing tells where edges are.
      OSError: if a file cannot be read.
    """
    path, layer = split_reference(noisy)
    file = read_layered_file(path)
    color = _picture_layer(file, layer)
    images, sources = _find_images(file, color, others)
    if not any(guide in images for guide in GUIDES):
        expected = "normals, depth or positions to go by (there, or by --normal, --depth, --position)"
        bad_input(path, "layers", expected=expected, got=file.listing())
    file, cut_note = _of_one_size(file, color)
    names = AovNames(file.layers, color=color)
    if "albedo" not in others and sources.get("albedo", "").lower().endswith("diffcol"):
        images["albedo"] = lobe_albedo(file, names)
    given = {name: images.pop(name) for name in LIGHT if name in images}
    light, light_note = split_light(file, names, images["color"], given)
    if light is not None:
        images |= {name: getattr(light, name) for name in LIGHT if getattr(light, name) is not None}
    picture = file.layers[color]
    aovs = Aovs(**images)
    aovs.check()
    return DenoiseInputs(
        path.name,
        aovs,
        alpha=picture[..., 3:4] if picture.shape[-1] == 4 else None,
        gray=(file.channels[color][0] if color == "" else "Y") if picture.shape[-1] == 1 else "",
        sources=sources,
        channels=_channels(file, without=color),
        replaced={} if light is None else {part: file.channels[layer] for part, layer in light.layers.items()},
        notes=tuple(note for note in (cut_note, light_note) if note),
        samples_per_pixel=file.samples_per_pixel,
        attributes=_attributes(file, picture),
    )


def _attributes(file: LayeredFile, picture: np.ndarray) -> dict[str, Any]:
    """Of the header, where it is that of the picture: one of another part may have another size."""
    first = read_exr_header(file.path)[0]
    return exr_attributes(file.path) if (first.height, first.width) == picture.shape[:2] else {}


def _picture_layer(file: LayeredFile, layer: str | None) -> str:
    """The layer that is the noisy picture: the one named, else the one of the view with the most layers known."""
    if layer is not None:
        return pick_layers(file, "color", layer)[0]
    names = AovNames(file.layers)
    if names.color is not None:
        return names.color
    only = next(iter(file.layers))
    if len(file.layers) == 1 and not any(only in names.find(aov) for aov in _BESIDE):
        return only
    expected = "a picture (R, G, B, or Combined, RGBA, beauty; or --color FILE:LAYER)"
    bad_input(file.path, "layers", expected=expected, got=file.listing())


def _find_images(
    file: LayeredFile, color: str, others: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The picture, `others`, and what is known by name; with the layers they are."""
    images = {"color": aov_image(file, "color", (color,))}
    found: dict[str, tuple[LayeredFile, tuple[str, ...]]] = {"color": (file, (color,))}
    for aov, reference in others.items():
        path, layer = split_reference(reference)
        other = file if path == file.path else read_layered_file(path)
        found[aov] = other, pick_layers(other, aov, layer)
    names = AovNames(file.layers, color=color)
    beside = {aov: (file, names.find(aov)) for aov in _BESIDE if aov not in others}
    found |= {aov: (own, layers) for aov, (own, layers) in beside.items() if layers}
    for aov, (own, layers) in found.items():
        images[aov] = aov_image(own, aov, layers)
        if images[aov].shape[:2] != images["color"].shape[:2]:
            expected = f"{_size(images['color'])} as the picture ({file.path.name})"
            bad_input(own.path, f"layer {layers[0]!r}", expected=expected, got=_size(images[aov]))
    return images, {aov: f"{own.path.name}: {' '.join(layers) or 'RGB'}" for aov, (own, layers) in found.items()}


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]} pixels"


def _of_one_size(file: LayeredFile, color: str) -> tuple[LayeredFile, str]:
    """The file without layers of another size than the picture, and a remark if there are any."""
    size = file.layers[color].shape[:2]
    layers = {name: pixels for name, pixels in file.layers.items() if pixels.shape[:2] == size}
    left = ", ".join(repr(name) for name in file.layers if name not in layers)
    return replace(file, layers=layers), f"layers of another size are left out: {left}" if left else ""


def _channels(file: LayeredFile, *, without: str) -> dict[str, Num[np.ndarray, "h w 1"]]:
    """All channels but those of one layer, each as a layer of its own name, so that they keep their names."""
    return {
        channel: pixels[..., index : index + 1]
        for name, pixels in file.layers.items()
        if name != without
        for index, channel in enumerate(file.channels[name])
    }


# --- The built-in picture


def builtin_inputs(*, height: int, width: int) -> DenoiseInputs:
    """A picture of the built-in scene of `BUILTIN_SAMPLES` paths a pixel, all light in one, with its guides."""
    found = trace_builtin(height=height, width=width)
    aovs = Aovs(
        color=found.color, albedo=found.albedo, normal=found.normal, depth=found.depth, position=found.position,
        ao=found.ao,
    )  # fmt: skip
    aovs.check()
    return DenoiseInputs(
        "the built-in picture", aovs, sources={name: "traced here" for name in aovs.given()},
        samples_per_pixel=float(BUILTIN_SAMPLES),
    )  # fmt: skip


def trace_builtin(*, height: int, width: int) -> Traced:
    """The built-in scene from nearby, under a sun and a sky; direct light is of as many samples as indirect."""
    scene = builtin_scene()
    camera = whole_scene_camera(scene, aspect=width / height)
    camera = replace(camera, fov_y_radians=0.65 * camera.fov_y_radians)
    settings = TraceSettings(samples_per_pixel=BUILTIN_SAMPLES, direct="ratio")
    return trace_guides(prepare(scene), camera, height=height, width=width, settings=settings)
