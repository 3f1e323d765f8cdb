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

_NORMALS = (*KNOWN_LAYERS["normal"][1][:-1], "normals", "n", *KNOWN_LAYERS["geometric_normal"][1][:-1])

#: Name of an image a denoiser takes -> its least number of channels, and what renderers call it, the surest first: what
#: they write for a denoiser of their own comes before what they write for other ends.
AOV_LAYERS: dict[str, tuple[int, tuple[str, ...]]] = {
    "color": (1, ("noisy image", "", "combined", "beauty", "rgba", "rgb", "color", "c", "ci")),
    "direct": (3, ("direct",)),
    "indirect": (3, ("indirect",)),
    "emission": (3, ("emit", "emission")),
    "background": (3, ("env", "background")),
    "albedo": (3, ("denoising albedo", "denoise_albedo_noice", "denoise_albedo", "albedo", "alb",
                   "diffuse_albedo_noice", "diffuse_albedo", "basecolor", "base_color", "diffuse_color", "diffcol")),
    "normal": (3, ("denoising normal", "n_noice", *_NORMALS)),
    "depth": (1, ("denoising depth", "z_noice", *KNOWN_LAYERS["depth"][1], "depth.t", "dd.y.t", "dd.t")),
    "position": (3, KNOWN_LAYERS["position"][1]),
    "ao": (1, ("ao", "ambient_occlusion", "ambientocclusion")),
}  # fmt: skip

#: Ways in which renderers split light by what reflected it: rows of the names of direct light, indirect light, and the
#: color that multiplies both ("" if they contain it). Rows that are not in a file are black there.
LIGHT_LOBES: dict[str, tuple[tuple[str, str, str], ...]] = {
    "Blender": (
        ("diffdir", "diffind", "diffcol"), ("glossdir", "glossind", "glosscol"), ("transdir", "transind", "transcol"),
        ("subsurfacedir", "subsurfaceind", "subsurfacecol"), ("volumedir", "volumeind", ""),
    ),
    "Arnold": tuple(
        (f"{lobe}_direct", f"{lobe}_indirect", "")
        for lobe in ("diffuse", "specular", "coat", "sheen", "transmission", "sss", "volume")
    ),
}  # fmt: skip


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


class AovNames:
    """Finds the layers of a denoiser's images among those of a file.

    Several view layers, each with a picture of its own, are told apart by what comes before their names: the one with
    the most layers that are known is taken, and of the others nothing.
    """

    def __init__(self, layers: Mapping[str, Num[np.ndarray, "h w c"]], *, color: str | None = None):
        """With `color`, the full name of the picture, the view layer is the one it belongs to."""
        self._layers = layers
        self._places: dict[str, dict[str, str]] = {}
        for name in layers:
            for place, short in _endings(name):
                self._places.setdefault(short, {}).setdefault(place, name)
        known = {name for _, names in AOV_LAYERS.values() for name in names}
        known |= {name for rows in LIGHT_LOBES.values() for row in rows for name in row if name}
        counts: dict[str, int] = {}
        for short in sorted(known & self._places.keys()):
            for place in self._places[short]:
                counts[place] = counts.get(place, 0) + 1
        pictures = [short for short in AOV_LAYERS["color"][1] if short in self._places]
        self._views = {
            place: name
            for short in pictures[::-1]
            for place, name in self._places[short].items()
            if name == "" or layers[name].shape[-1] >= 3
        }
        if color is None:
            self._view = max(self._views, key=lambda place: counts[place], default="")
            self.color = self._views.get(self._view)
        else:
            self.color = color
            self._view = next((place for place, short in _endings(color) if short in pictures), "")

    def find(self, aov: str) -> tuple[str, ...]:
        """Full name of the layer of an image of `AOV_LAYERS`; three if its x, y and z are layers; () if not there."""
        count, names = AOV_LAYERS[aov]
        for short in names:
            found = self.find_name(short, count=count)
            if found is not None:
                return (found,)
            triple = [self.find_name(short + axis, count=1) for axis in "xyz"] if count == 3 and short else [None]
            if None not in triple:
                return tuple(name for name in triple if name is not None)
        return ()

    def find_name(self, short: str, *, count: int = 3) -> str | None:
        """Full name of a layer of the view with at least `count` channels of floating point, not 2 or more than 4."""
        fitting = {
            place: name
            for place, name in self._places.get(short, {}).items()
            if (place == self._view or not self._elsewhere(place))
            and self._layers[name].shape[-1] in (1, 3, 4)[count > 1 :]
            and np.issubdtype(self._layers[name].dtype, np.floating)
        }
        nearest = sorted(fitting, key=lambda place: (place != self._view, not place.startswith(self._view)))
        return fitting[nearest[0]] if nearest else None

    def _elsewhere(self, place: str) -> bool:
        """Whether what stands there belongs to another view: one with a picture, or a picture itself."""
        pictures = (name.lower() for name, pixels in self._layers.items() if name and pixels.shape[-1] > 1)
        return place in self._views or place in pictures


def _endings(name: str) -> list[tuple[str, str]]:
    """All ways to take a name as a place and a name there: "a.b" is "b" in "a", and "a.b" in ""."""
    parts = name.lower().split(".")
    return [(".".join(parts[:k]), ".".join(parts[k:])) for k in range(len(parts))]
