"""Guides with gaps: where nothing is seen, and where a renderer wrote what is not a number."""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from jaxrender.filters.aovs import FAR_AWAY, Aovs

#: Images of which one says where a surface is.
_SURFACE = ("normal", "depth", "position")
_LENGTHS = ("depth", "position")
_BESIDE = ("ao", "albedo")


def seen_surface(aovs: Aovs) -> Bool[np.ndarray, "h w"]:
    """Where any of normal, depth and position is finite and not 0, and lengths are not those of the background.

    Raises:
      ValueError: if that is nowhere, or none of the three is given.
    """
    given = [name for name in _SURFACE if getattr(aovs, name) is not None]
    if not given:
        raise ValueError("aovs: expected normal, depth or position, got none of them")
    surface = np.any([_seen(_read(aovs, name)) for name in given], axis=0)
    if not surface.any():
        names = ", ".join(given)
        raise ValueError(f"{names}: expected finite numbers other than 0 in some pixel, got 0 of {surface.size}")
    return surface


def close_gaps(aovs: Aovs, surface: Bool[np.ndarray, "h w"]) -> tuple[Aovs, Bool[np.ndarray, "h w"]]:
    """Guides and albedo with finite numbers everywhere, and where they had others.

    Those are taken from the nearest pixel of the surface, and 0 where none is seen, as are depths and positions of the
    background, infinite or huge. An image without a finite pixel on the surface is left out.
    """
    closed: dict[str, Any] = {}
    broken = np.zeros(np.shape(aovs.color)[:2], bool)
    for name in (*_SURFACE, *_BESIDE):
        if getattr(aovs, name) is None:
            continue
        image = _read(aovs, name)
        gaps = ~np.isfinite(image).all(axis=-1)
        broken |= gaps
        closed[name] = _filled(image, gaps, surface) if (surface & ~gaps).any() else None
    return replace(aovs, **closed), broken


def _read(aovs: Aovs, name: str) -> Float[np.ndarray, "h w c"]:
    image = np.asarray(getattr(aovs, name), np.float32)
    if name not in _LENGTHS:
        return image
    with np.errstate(invalid="ignore"):
        return np.where((np.abs(image) >= FAR_AWAY).any(axis=-1, keepdims=True), np.float32(0.0), image)


def _seen(image: Float[np.ndarray, "h w c"]) -> Bool[np.ndarray, "h w"]:
    return np.isfinite(image).all(axis=-1) & (image != 0.0).any(axis=-1)


def _filled(
    image: Float[np.ndarray, "h w c"], gaps: Bool[np.ndarray, "h w"], surface: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w c"]:
    if not gaps.any():
        return image
    far = gaps | ~surface
    y, x = scipy.ndimage.distance_transform_edt(far, return_distances=False, return_indices=True)
    near = np.where((gaps & surface)[..., None], image[y, x], image)
    return np.where((gaps & ~surface)[..., None], np.float32(0.0), near)
