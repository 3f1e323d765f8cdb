"""The figures of the paper drawn anew, and a flight through the scene.

Each figure is a function of place, sizes and file name; it writes a picture, and tells the view it shows and the
numbers behind it. Numbers in captions are rounded; differences are of display-encoded values.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import PIL.Image
import PIL.ImageDraw
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import uniform_filter

from benchmarks.adaptive import ADAPTIVE, PRINTED, Frames, Place, Shot, Sizes, View, judge, view_of
from jaxrender.deferred.adaptive import Method
from jaxrender.deferred.metrics import tile_maximum
from jaxrender.io import write_png
from jaxrender.io.picture import contact_sheet, to_bytes, with_color_bar, write_animation
from jaxrender.metrics import heatmap

Bytes = UInt8[np.ndarray, "h w 3"]
Found = tuple[Path, View, dict[str, float]]

#: A difference is shown so many times as large; the colors end at 1.
GAIN = 10.0
GAP_PX, BACKGROUND = 8, (24, 26, 30)
#: Outlines of the places that are shown enlarged.
OUTLINES = ((255, 80, 80), (90, 220, 110), (90, 160, 255))
FILM_FPS = 15


def draw_comparison(place: Place, sizes: Sizes, path: Path) -> Found:
    """Full supersampling and its adaptive equal, and what is enlarged of them (the paper's figure 1)."""
    frames = Frames(view_of(place, sizes, size=sizes.grids[-1]), keep=True)
    reference, ours = frames.reference(), frames.by(ADAPTIVE)
    numbers = judge(ours, reference)
    frames.draw("single")
    zoom, (height, width) = _crop(frames.view)
    corners = worst_places(_difference(frames.shots["single"], reference), height, width, number=len(OUTLINES))
    size = frames.view.size
    labels = [f"{size} x {size} supersampling", f"adaptive, {_said(numbers)}"]
    panels = [_outlined(shot.image, corners, height, width) for shot in (reference, ours)]
    crops = [
        _enlarged(shot.image, corner, height, width, zoom, outline)
        for corner, outline in zip(corners, OUTLINES, strict=True)
        for shot in (reference, ours)
    ]
    sheets = [contact_sheet(panels, labels=labels), contact_sheet(crops, labels=["supersampling", "adaptive"] * 3)]
    write_png(path, _stacked(sheets))
    return path, frames.view, numbers


def draw_anisotropy(place: Place, sizes: Sizes, path: Path) -> Found:
    """What anisotropic lookups are worth: reference, adaptive with them, adaptive without (figure 5)."""
    frames = _frames(place, sizes, _middle(sizes))
    plain = Frames(dataclasses.replace(frames.view, max_anisotropy=1), keep=True)
    reference, ours, blurred = frames.reference(), frames.by(PRINTED), plain.by(PRINTED)
    _, (height, width) = _crop(frames.view)
    height, width = 2 * height, 2 * width
    corners = worst_places(_difference(blurred, ours), height, width, number=len(OUTLINES))
    crops = [
        _enlarged(shot.image, corner, height, width, 3, outline)
        for corner, outline in zip(corners, OUTLINES, strict=True)
        for shot in (reference, ours, blurred)
    ]
    size = frames.view.size
    numbers, without = judge(ours, reference), judge(blurred, reference)
    labels = [f"{size} x {size} supersampling", f"printed, {_said(numbers)}", f"trilinear, {_said(without)}"]
    write_png(path, contact_sheet(crops, labels=labels + [""] * (len(crops) - 3), columns=3))
    return path, frames.view, {**numbers, "psnr_db_trilinear": without["psnr_db"]}


def draw_counts(place: Place, sizes: Sizes, path: Path) -> Found:
    """Counts of the printed metrics: where they are, sorted, and the largest of 6 x 6 pixels (figure 6)."""
    frames = _frames(place, sizes, sizes.grids[-1])
    shot = frames.by(PRINTED)
    n = frames.view.size**2
    spread = np.asarray(tile_maximum(jnp.asarray(shot.count), tile=6))
    sorted_counts = np.sort(shot.count, axis=None)[::-1].reshape(shot.count.shape)
    maps = [_count_map(counts, n) for counts in (shot.count, sorted_counts, spread)]
    labels = ["samples a pixel", "sorted", "largest of 6 x 6 pixels"]
    write_png(path, _with_counts_bar(contact_sheet(maps, labels=labels), n))
    numbers = judge(shot, frames.reference())
    covered = shot.count[shot.count > 0]
    numbers["share_of_pixels_with_1"] = float(np.mean(covered == 1))
    numbers["share_of_pixels_with_all"] = float(np.mean(covered == n))
    return path, frames.view, {**numbers, "low_resolution_ratio": float(spread.sum()) / max(1, int(covered.sum()))}


def draw_rates(place: Place, sizes: Sizes, path: Path) -> Found:
    """Adaptive, reference, their difference, and the difference to one sample, by m (figure 7)."""
    panels: list[np.ndarray] = []
    labels: list[str] = []
    for size in sizes.grids:
        frames = _frames(place, sizes, size)
        reference, ours = frames.reference(), frames.by(ADAPTIVE)
        frames.draw("single")
        single, numbers = frames.shots["single"], judge(ours, reference)
        panels += [_bytes(ours.image), _bytes(reference.image)]
        panels += [_difference_map(ours, reference), _difference_map(ours, single)]
        labels += [f"m = {size}: adaptive, {_said(numbers)}", f"{size} x {size} supersampling"]
        labels += [f"|adaptive - reference| x {GAIN:g}", f"|adaptive - one sample| x {GAIN:g}"]
    write_png(path, _with_difference_bar(contact_sheet(panels, labels=labels, columns=4)))
    return path, frames.view, numbers


def draw_terms_of(method: Method, terms: Mapping[str, Method], name: str) -> Callable[[Place, Sizes, Path], Found]:
    """What geometry and shading find alone (figure 8).

    Args:
      terms: by what they are called; name: of the whole.
    """

    def draw(place: Place, sizes: Sizes, path: Path) -> Found:
        frames = _frames(place, sizes, _middle(sizes))
        for variant in ("single", "fxaa"):
            frames.draw(variant)
        reference, size, n = frames.reference(), frames.view.size, frames.view.size**2
        panels = [_bytes(shot.image) for shot in (reference, frames.shots["single"], frames.shots["fxaa"])]
        labels = [f"{size} x {size} supersampling"]
        labels += [f"{variant}, {judge(frames.shots[variant], reference)['psnr_db']:.1f} dB" for variant in frames.shots
                   if variant != "supersampled"]  # fmt: skip
        numbers: dict[str, float] = {}
        for own, settings in {name: method, **terms}.items():
            shot = frames.by(settings)
            found = judge(shot, reference)
            panels += [_bytes(shot.image), _count_map(shot.count, n), _difference_map(shot, reference)]
            labels += [f"{own}, {_said(found)}", "samples a pixel", f"|{own} - reference| x {GAIN:g}"]
            numbers = numbers or found
        sheet = _with_counts_bar(contact_sheet(panels, labels=labels, columns=3), n)
        write_png(path, _with_difference_bar(sheet))
        return path, frames.view, numbers

    return draw


def draw_flight(place: Place, sizes: Sizes, path: Path) -> Found:
    """A flight: the adaptive picture, and beside it the samples of each pixel."""
    height, width = sizes.flight
    view = dataclasses.replace(view_of(place, sizes, size=_middle(sizes)), height=height, width=width)
    film, shares = [], []
    for frame in range(sizes.flight_frames):
        camera = place.flight(frame / sizes.flight_frames)
        shot = Frames(dataclasses.replace(view, camera=camera), keep=True).by(ADAPTIVE)
        shares.append(shot.sample_share)
        labels = [f"adaptive, m = {view.size}", f"samples a pixel: {100 * shares[-1]:.0f} % shaded"]
        sheet = contact_sheet([_bytes(shot.image), _count_map(shot.count, view.size**2)], labels=labels)
        film.append(_with_counts_bar(sheet, view.size**2))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_animation(path, film, fps=FILM_FPS)
    return path, view, {"sample_share": float(np.mean(shares)), "frames": float(len(film))}


#: File name -> what draws it.
FIGURES: dict[str, Callable[[Place, Sizes, Path], Found]] = {
    "figure1.png": draw_comparison,
    "figure5.png": draw_anisotropy,
    "figure6.png": draw_counts,
    "figure7.png": draw_rates,
    "figure8.png": draw_terms_of(
        PRINTED,
        {
            "geometry": dataclasses.replace(PRINTED, shading=None),
            "shading": dataclasses.replace(PRINTED, depth=None, normal=None),
        },
        "printed",
    ),
    "figure8_clusters.png": draw_terms_of(
        ADAPTIVE,
        {
            "geometry": dataclasses.replace(ADAPTIVE, contrast=0.0, detail=0.0),
            "shading": dataclasses.replace(ADAPTIVE, normal=0.0, plane=0.0),
        },
        "clusters",
    ),
    "flight.webp": draw_flight,
}


# --- Parts of figures


def _frames(place: Place, sizes: Sizes, size: int) -> Frames:
    height, width = sizes.picture
    return Frames(dataclasses.replace(view_of(place, sizes, size=size), height=height, width=width), keep=True)


def _middle(sizes: Sizes) -> int:
    """m = 3 of the figures that the paper draws so."""
    return sizes.grids[len(sizes.grids) // 2]


def _said(numbers: Mapping[str, float]) -> str:
    return f"{100 * numbers['sample_share']:.0f} % of the samples, {numbers['psnr_db']:.1f} dB"


def _bytes(image: Float[np.ndarray, "h w 3"]) -> Bytes:
    """Display-encoded values as bytes."""
    return np.round(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def _difference(shot: Shot, other: Shot) -> Float[np.ndarray, "h w"]:
    """The largest of the three channels' differences."""
    return np.abs(shot.image - other.image).max(axis=-1)


def _difference_map(shot: Shot, other: Shot) -> Bytes:
    return to_bytes(np.asarray(heatmap(jnp.asarray(GAIN * _difference(shot, other)), high=1.0)))


def _count_map(count: Int[np.ndarray, "h w"], most: int) -> Bytes:
    return to_bytes(np.asarray(heatmap(jnp.asarray(count, jnp.float32), high=float(most))))


def _with_counts_bar(sheet: Bytes, most: int) -> Bytes:
    return with_color_bar(sheet, _scale(), title="Counts: samples shaded in a pixel", low="0", high=str(most))


def _with_difference_bar(sheet: Bytes) -> Bytes:
    title = f"Differences: largest of the three channels, display-encoded, x {GAIN:g}"
    return with_color_bar(sheet, _scale(), title=title, low="0", high=f"{255 / GAIN:g} / 255")


def _scale() -> Float[np.ndarray, "n 3"]:
    return np.asarray(heatmap(jnp.linspace(0.0, 1.0, 64)))


def _crop(view: View) -> tuple[int, tuple[int, int]]:
    """Enlargement, and height and width of what is enlarged, so that a row of six is as wide as two pictures."""
    zoom = 4
    width = ((2 * view.width - 4 * GAP_PX) // 6) // zoom
    return zoom, (3 * width // 4, width)


def worst_places(error: Float[np.ndarray, "h w"], height: int, width: int, *, number: int) -> list[tuple[int, int]]:
    """Upper left corners of windows at least as far apart as they are large, with the largest mean error first."""
    mean = uniform_filter(np.asarray(error, np.float64), (height, width), mode="constant")
    top, left = height // 2, width // 2
    mean = mean[top : top + error.shape[0] - height + 1, left : left + error.shape[1] - width + 1]
    found: list[tuple[int, int]] = []
    for _ in range(number):
        y, x = (int(i) for i in np.unravel_index(np.argmax(mean), mean.shape))
        found.append((y, x))
        mean[max(0, y - 2 * height + 1) : y + 2 * height, max(0, x - 2 * width + 1) : x + 2 * width] = -1.0
    return found


def _outlined(image: Float[np.ndarray, "h w 3"], corners: Sequence[tuple[int, int]], height: int, width: int) -> Bytes:
    picture = PIL.Image.fromarray(_bytes(image))
    draw = PIL.ImageDraw.Draw(picture)
    for (y, x), outline in zip(corners, OUTLINES, strict=True):
        draw.rectangle((x - 2, y - 2, x + width + 1, y + height + 1), outline=outline, width=2)
    return np.asarray(picture)


def _enlarged(
    image: Float[np.ndarray, "h w 3"], corner: tuple[int, int], height: int, width: int, zoom: int,
    outline: tuple[int, int, int],
) -> Bytes:  # fmt: skip
    """A window with every pixel as a square, framed in the color of its outline."""
    y, x = corner
    window = _bytes(image[y : y + height, x : x + width])
    large = np.repeat(np.repeat(window, zoom, axis=0), zoom, axis=1)
    for edge in (large[:2], large[-2:], large[:, :2], large[:, -2:]):
        edge[...] = outline
    return large


def _stacked(sheets: Sequence[Bytes]) -> Bytes:
    """Sheets one below the other, narrower ones in the middle."""
    width = max(sheet.shape[1] for sheet in sheets)
    rows = []
    for sheet in sheets:
        row = np.full((sheet.shape[0], width, 3), BACKGROUND, np.uint8)
        left = (width - sheet.shape[1]) // 2
        row[:, left : left + sheet.shape[1]] = sheet
        rows.append(row)
    return np.concatenate(rows)
