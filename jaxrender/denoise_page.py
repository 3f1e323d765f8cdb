"""The page that shows what `jaxrender denoise` did: before and after laid over each other, details, numbers."""

import base64
import html
import io

import numpy as np
import PIL.Image
from jaxtyping import Float, UInt8

from jaxrender.io.picture import as_pillow, to_bytes
from jaxrender.io.report import Report

#: Longest side of the large pictures in pixels; details are shown as they are.
MAX_SIDE = 1600
#: Pictures of half this width and less are enlarged.
SHOWN_WIDTH = 640
#: Side of a detail in pixels, how many there are, and how much they are enlarged.
DETAIL_PX, NUM_DETAILS, DETAIL_SCALE = 128, 3, 2


class BeforeAfterPage(Report):
    """A report that can lay two pictures over each other, without a script."""

    def comparison(self, before: np.ndarray, after: np.ndarray, caption: str) -> "BeforeAfterPage":
        """Adds two pictures of one size with buttons for either, and both with a border that can be moved."""
        height, width = before.shape[:2]
        name = f"c{len(self._parts)}"
        buttons = "".join(
            f'<input type="radio" name="{name}" id="{name}-{kind}"{" checked" if kind == "both" else ""}>'
            f'<label for="{name}-{kind}">{label}</label>'
            for kind, label in (("before", "Before"), ("both", "Both"), ("after", "After"))
        )
        pictures = f"{_picture(after, 'after')}<div>{_picture(before, 'before')}</div>"
        # A small picture is shown in whole multiples of its size.
        wide = width * max(1, SHOWN_WIDTH // width)
        frame = f'<div class="over" style="max-width:{wide}px;aspect-ratio:{width}/{height}">{pictures}</div>'
        below = f"<figcaption>{html.escape(caption)}</figcaption>"
        self._add(f'<figure class="compare">{buttons}{frame}{below}</figure>')
        return self

    def html(self) -> str:
        """The whole page, with the style of comparisons."""
        return super().html().replace("</style>", f"{_STYLE}</style>", 1)


def find_details(before: UInt8[np.ndarray, "h w c"], after: UInt8[np.ndarray, "h w c"]) -> list[tuple[int, int]]:
    """Top left corners of the squares of `DETAIL_PX` in which the two differ most, the most first; (row, column)."""
    change = np.abs(before.astype(np.float32) - after.astype(np.float32)).mean(axis=-1)
    rows, columns = (range(0, max(side - DETAIL_PX // 2, 1), DETAIL_PX) for side in change.shape)
    sums = {(y, x): change[y : y + DETAIL_PX, x : x + DETAIL_PX].sum() for y in rows for x in columns}
    return sorted(sums, key=lambda corner: -sums[corner])[:NUM_DETAILS]


def add_comparison(
    page: BeforeAfterPage, before: Float[np.ndarray, "h w 3"], after: Float[np.ndarray, "h w 3"]
) -> None:
    """Adds two pictures (in [0, 1], linear) over each other, and the places where they differ most, enlarged."""
    old, new = to_bytes(before), to_bytes(after)
    caption = "Left of the border before, right of it after; its handle is in the corner below, on the left picture."
    page.comparison(_shrunk(old), _shrunk(new), caption)
    page.section("Where it changed most")
    for y, x in find_details(old, new):
        details = (image[y : y + DETAIL_PX, x : x + DETAIL_PX] for image in (old, new))
        enlarged = [detail.repeat(DETAIL_SCALE, axis=0).repeat(DETAIL_SCALE, axis=1) for detail in details]
        caption = f"From row {y} and column {x} on, {DETAIL_SCALE} times enlarged."
        page.images([(enlarged[0], "Before"), (enlarged[1], "After")], caption)


def _shrunk(pixels: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    picture = as_pillow(pixels)
    picture.thumbnail((MAX_SIDE, MAX_SIDE), PIL.Image.Resampling.BOX)
    return np.asarray(picture)


def _picture(pixels: UInt8[np.ndarray, "h w c"], text: str) -> str:
    file = io.BytesIO()
    as_pillow(pixels).save(file, format="WEBP", quality=92, method=2)
    encoded = base64.b64encode(file.getvalue()).decode("ascii")
    return f'<img alt="{text}" src="data:image/webp;base64,{encoded}">'


# Pictures are as wide as the frame they are in ("cqw"), so that both lie on each other however wide the upper is cut.
_STYLE = """
.compare input { margin: 0 0.3rem 0.6rem 0; }
.compare label { margin-right: 1.2rem; }
.over { position: relative; width: 100%; overflow: hidden; container-type: inline-size; border-radius: 6px; }
.compare .over img { position: absolute; top: 0; left: 0; width: 100cqw; max-width: none; border-radius: 0; }
.over div { position: absolute; top: 0; left: 0; width: 50%; height: 100%; min-width: 12px; max-width: 100%;
  overflow: hidden; resize: horizontal; border-right: 2px solid var(--accent); }
.compare input[id$="-before"]:checked ~ .over div { width: 100% !important; border: 0; }
.compare input[id$="-after"]:checked ~ .over div { display: none; }
.gallery { grid-template-columns: repeat(auto-fit, minmax(12rem, max-content)); }
.gallery img { width: auto; }
.gallery img, .over img { image-rendering: pixelated; }
"""
