"""Layers of an EXR file, whoever wrote it -> the same layers under one name each.

Blender, Mitsuba, Arnold and pbrt call the same thing differently, and put the name of a view layer or of a part before
it. Names are compared without case and after the last of such prefixes.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Num

#: Our name -> number of channels, and what others call it, the surest first.
KNOWN_LAYERS: dict[str, tuple[int, tuple[str, ...]]] = {
    "normal": (3, ("normal", "sh_normal", "shading_normal", "ns", "nn", "n")),
    "geometric_normal": (3, ("geometric_normal", "geo_normal", "ng", "n")),
    "position": (3, ("position", "pos", "p", "worldposition", "worldpointsposition")),
    "depth": (1, ("depth", "depth.z", "depth.y", "depth.v", "z", "dd", "dd.y", "zdepth")),
    "uv": (2, ("uv", "st", "texcoord", "tex_coord")),
    "albedo": (3, ("albedo", "diffcol", "diffuse_albedo", "basecolor", "base_color", "diffuse_color")),
    "motion": (2, ("motion", "motion_vector", "motionvector", "mv")),
    "material_id": (1, ("materialid", "material_id", "indexma.x", "indexma", "matid")),
    "triangle_id": (1, ("triangleid", "triangle_id", "prim_index", "primid")),
}


def known_layers(layers: Mapping[str, Num[np.ndarray, "h w c"]]) -> dict[str, Num[np.ndarray, "h w c"]]:
    """What is recognised of `read_exr_layers`, by the names of `KNOWN_LAYERS` and with as many channels as there.

    A layer serves one name only: "N" is the geometric normal where there is "Ns" as well. "u" and "v" of two channels
    of their own are one layer.
    """
    names = list(layers)[::-1]
    short = {name.lower(): name for name in names} | {_last(name): name for name in names}
    found: dict[str, np.ndarray] = {}
    taken: set[str] = set()
    for ours, (count, theirs) in KNOWN_LAYERS.items():
        for name in theirs:
            full = short.get(name)
            if full is not None and full not in taken and layers[full].shape[-1] >= count:
                found[ours] = layers[full][..., :count]
                taken.add(full)
                break
    if "uv" not in found and "u" in short and "v" in short:
        found["uv"] = np.concatenate([layers[short[name]][..., :1] for name in "uv"], axis=-1)
    return found


def _last(name: str) -> str:
    """The name without what comes before it: "ViewLayer.Depth.Z" -> "depth.z", "part.albedo" -> "albedo"."""
    parts = name.lower().split(".")
    return ".".join(parts[-2:]) if len(parts[-1]) == 1 and len(parts) > 1 else parts[-1]
