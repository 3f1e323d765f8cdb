"""One HTML page that tells a result: text, tables, pictures and plots, all inside a single file.

The page loads nothing and runs no script, so it opens offline and can be sent by mail. Everything given as
text is escaped. It follows the reader's light or dark setting, prints, and reads on a telephone.
"""

import base64
import html
import io
import math
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxrender.io import picture
from jaxrender.io.atomic import write_bytes

# Colors of plotted lines: told apart by most color-blind readers, and readable on white and on black
# (after Okabe and Ito, 2002, with the yellow darkened).
LINE_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#7f7f7f")

_MEDIA_TYPES = {
    b"\x89PNG": "image/png",
    b"GIF8": "image/gif",
    b"RIFF": "image/webp",
    b"\xff\xd8\xff": "image/jpeg",
}

# Plots are drawn in these colors, which are then replaced by the variables of the page's style.
_TEXT, _FAINT = "#010203", "#040506"

Cell = str | int | float | bool | np.generic | None


class Report:
    """A page that grows section by section; `write` puts it on disk.

    Every method returns the report, so calls can be chained. Parts added before the first `section` stand
    under the title.
    """

    def __init__(self, title: str, *, subtitle: str = ""):
        self._title = title
        self._subtitle = subtitle
        self._parts: list[str] = []
        self._sections: list[tuple[str, str]] = []
        self._num_plots = 0

    def section(self, title: str) -> "Report":
        """Starts a section."""
        anchor = f"s{len(self._sections) + 1}"
        self._sections.append((anchor, title))
        return self._add(f'<h2 id="{anchor}">{_escape(title)}</h2>')

    def subsection(self, title: str) -> "Report":
        """Starts a part of a section; it is not listed in the contents."""
        return self._add(f"<h3>{_escape(title)}</h3>")

    def text(self, text: str) -> "Report":
        """Adds prose; an empty line starts a new paragraph."""
        return self._add("".join(f"<p>{_escape(part.strip())}</p>" for part in text.split("\n\n") if part.strip()))

    def note(self, text: str) -> "Report":
        """Adds a remark that should not be overlooked."""
        return self._add(f'<p class="note">{_escape(text)}</p>')

    def facts(self, facts: Mapping[str, Cell], caption: str = "") -> "Report":
        """Adds names and values in two columns, for settings and sizes."""
        rows = "".join(
            f'<tr><th scope="row">{_escape(name)}</th><td>{_escape(format_cell(value))}</td></tr>'
            for name, value in facts.items()
        )
        return self._add(_table_html(caption, "", rows, kind="facts"))

    def table(
        self,
        rows: Iterable[Mapping[str, Cell] | Sequence[Cell]],
        columns: Sequence[str] | None = None,
        *,
        caption: str = "",
        best: Mapping[str, str] | None = None,
    ) -> "Report":
        """Adds a table. Rows are mappings by column name, or sequences in the order of `columns`.

        Args:
          columns: the heads; by default the keys of the first row, which must then be a mapping.
          best: column name -> "min" or "max"; the best number of that column is printed bold.
        Raises:
          ValueError: if a row is a sequence and does not have one value per column.
        """
        rows = list(rows)
        if columns is None:
            if not rows or not isinstance(rows[0], Mapping):
                raise ValueError("columns: expected names, since the rows have none")
            columns = list(rows[0])
        cells = [_row_cells(row, columns) for row in rows]
        winners = {name: _best(cells, columns.index(name), kind) for name, kind in (best or {}).items()}
        numeric = [all(_is_number(row[i]) or row[i] is None for row in cells) for i in range(len(columns))]
        head = "".join(f'<th scope="col"{_class(numeric[i])}>{_escape(name)}</th>' for i, name in enumerate(columns))
        body = []
        for row in cells:
            line = []
            for i, value in enumerate(row):
                text = _escape(format_cell(value))
                if _is_number(value) and winners.get(columns[i]) == value:
                    text = f"<strong>{text}</strong>"
                line.append(f"<td{_class(numeric[i])}>{text}</td>")
            body.append(f"<tr>{''.join(line)}</tr>")
        return self._add(_table_html(caption, f"<thead><tr>{head}</tr></thead>", "".join(body), kind="data"))

    def image(self, image: np.ndarray | str | os.PathLike, caption: str = "") -> "Report":
        """Adds a picture: an array (see `picture.to_bytes`), or a PNG, GIF, WebP or JPEG file."""
        return self._add(_figure_html(_image_html(image, caption), caption))

    def images(self, images: Sequence[tuple[np.ndarray | str | os.PathLike, str]], caption: str = "") -> "Report":
        """Adds pictures with their own captions beside each other, as many as the width allows."""
        inner = "".join(_figure_html(_image_html(image, label), label) for image, label in images)
        below = f'<p class="caption">{_escape(caption)}</p>' if caption else ""
        return self._add(f'<div class="gallery">{inner}</div>{below}')

    def plot(
        self,
        figure: Callable[[Any], None] | Any,
        caption: str = "",
        *,
        width_inches: float = 8.0,
        height_inches: float = 3.4,
    ) -> "Report":
        """Adds a plot: a matplotlib figure, or a function that draws on the figure it is given.

        The function gets a figure in the style of the page, of the given size; where matplotlib is missing
        it is not called, and a line says so.
        """
        try:
            import matplotlib
            import matplotlib.figure
        except ImportError:
            missing = 'No plot here: matplotlib is not installed (the extra "plots").'
            return self._add(_figure_html(f'<p class="missing">{_escape(missing)}</p>', caption))
        self._num_plots += 1
        with matplotlib.rc_context(_plot_style() | {"svg.hashsalt": f"plot{self._num_plots}"}):
            if callable(figure):
                draw, figure = (
                    figure,
                    matplotlib.figure.Figure((width_inches, height_inches), layout="constrained"),
                )
                draw(figure)
            file = io.StringIO()
            figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
        svg = file.getvalue()
        svg = svg[svg.index("<svg") :].replace(_TEXT, "var(--text)").replace(_FAINT, "var(--line)")
        # Sizes in points would not shrink with the page; the view box keeps the proportions.
        head, _, rest = svg.partition(">")
        head = f'<svg role="img" aria-label="{_escape(caption)}"' + _without_size(head.removeprefix("<svg"))
        return self._add(_figure_html(head + ">" + rest, caption, kind="plot"))

    def html(self) -> str:
        """The whole page."""
        contents = ""
        if len(self._sections) > 2:
            links = "".join(f'<li><a href="#{anchor}">{_escape(title)}</a></li>' for anchor, title in self._sections)
            contents = f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
        subtitle = f'<p class="subtitle">{_escape(self._subtitle)}</p>' if self._subtitle else ""
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            # Nothing but what is in the file: the browser itself holds the page to it.
            '<meta http-equiv="Content-Security-Policy" '
            "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
            f"<title>{_escape(self._title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n"
            f"<header><h1>{_escape(self._title)}</h1>{subtitle}{contents}</header>\n"
            + "\n".join(self._parts)
            + "\n</main>\n</body>\n</html>\n"
        )

    def write(self, path: str | os.PathLike) -> pathlib.Path:
        """Writes the page and returns its path."""
        write_bytes(path, self.html().encode())
        return pathlib.Path(path)

    def _add(self, part: str) -> "Report":
        self._parts.append(part)
        return self


def format_cell(value: Cell) -> str:
    """A value for people: four significant digits, thin spaces between thousands, – for nothing."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{value:,}".replace(",", "\u202f")
    if isinstance(value, float | np.floating):
        return _format_float(float(value))
    return str(value)


def _format_float(value: float) -> str:
    if not math.isfinite(value):
        return {"inf": "∞", "-inf": "−∞"}.get(str(value), "NaN")
    if value == 0:
        return "0"
    if not 1e-3 <= abs(value) < 1e5:
        return f"{value:.3g}".replace("-", "−")
    digits = min(4, max(0, 3 - math.floor(math.log10(abs(value)))))
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def _escape(text: object) -> str:
    return html.escape(str(text))


def _class(numeric: bool) -> str:
    return ' class="number"' if numeric else ""


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _row_cells(row: Mapping[str, Cell] | Sequence[Cell], columns: Sequence[str]) -> list[Cell]:
    if isinstance(row, Mapping):
        return [row.get(name) for name in columns]
    if len(row) != len(columns):
        raise ValueError(f"rows: expected {len(columns)} values in a row, got {len(row)}")
    return list(row)


def _best(cells: Sequence[Sequence[Cell]], column: int, kind: str) -> Cell:
    values: list[Any] = [row[column] for row in cells if _is_number(row[column])]
    return {"min": min, "max": max}[kind](values) if values else None


def _table_html(caption: str, head: str, body: str, *, kind: str) -> str:
    title = f"<caption>{_escape(caption)}</caption>" if caption else ""
    return f'<div class="scroll"><table class="{kind}">{title}{head}<tbody>{body}</tbody></table></div>'


def _figure_html(inner: str, caption: str, *, kind: str = "picture") -> str:
    below = f"<figcaption>{_escape(caption)}</figcaption>" if caption else ""
    return f'<figure class="{kind}">{inner}{below}</figure>'


def _image_html(image: np.ndarray | str | os.PathLike, caption: str) -> str:
    data = pathlib.Path(image).read_bytes() if isinstance(image, str | os.PathLike) else _png_bytes(image)
    media = next((name for magic, name in _MEDIA_TYPES.items() if data.startswith(magic)), None)
    if media is None:
        raise ValueError(f"image: expected a PNG, GIF, WebP or JPEG file, got {image}")
    encoded = base64.b64encode(data).decode("ascii")
    return f'<img alt="{_escape(caption)}" src="data:{media};base64,{encoded}">'


def _png_bytes(image: np.ndarray) -> bytes:
    file = io.BytesIO()
    picture.as_pillow(picture.to_bytes(image)).save(file, format="PNG", optimize=True)
    return file.getvalue()


def _without_size(attributes: str) -> str:
    return " ".join(part for part in attributes.split() if not part.startswith(("width=", "height=")))


def _plot_style() -> Any:  # matplotlib wants the literal names of its settings as keys
    from cycler import cycler  # comes with matplotlib

    return {
        "svg.fonttype": "none",
        "font.family": "sans-serif",
        "font.size": 10,
        "axes.titlesize": 11,
        "axes.prop_cycle": cycler(color=LINE_COLORS),
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.edgecolor": _FAINT,
        "grid.color": _FAINT,
        "grid.linewidth": 0.6,
        "lines.linewidth": 1.8,
        "legend.frameon": False,
        "xtick.color": _FAINT,
        "ytick.color": _FAINT,
        "xtick.labelcolor": _TEXT,
        "ytick.labelcolor": _TEXT,
        "text.color": _TEXT,
        "axes.labelcolor": _TEXT,
        "axes.titlecolor": _TEXT,
        "figure.facecolor": "none",
        "axes.facecolor": "none",
        "savefig.facecolor": "none",
    }


_STYLE = """
:root { color-scheme: light dark;
  --page: #ffffff; --text: #1c2024; --soft: #5b6470; --line: #d5dae0; --panel: #f5f7f9; --accent: #0b66b0; }
@media (prefers-color-scheme: dark) { :root {
  --page: #14171a; --text: #e4e7ea; --soft: #98a2ad; --line: #363d45; --panel: #1c2126; --accent: #6cb6f5; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--text);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 3rem 1.5rem 5rem; }
h1 { font-size: 2rem; line-height: 1.2; letter-spacing: -0.01em; margin: 0; }
h2 { font-size: 1.35rem; line-height: 1.3; margin: 3.2rem 0 0.8rem; padding-top: 1.1rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 2rem 0 0.4rem; }
p { max-width: 44rem; margin: 0.7rem 0; }
.subtitle { color: var(--soft); font-size: 1.1rem; margin: 0.5rem 0 0; }
.note { background: var(--panel); border-left: 3px solid var(--accent); padding: 0.6rem 1rem; }
.missing { color: var(--soft); font-style: italic; padding: 0.8rem 1rem; background: var(--panel); }
nav ul { list-style: none; display: flex; flex-wrap: wrap; gap: 0.3rem 1.3rem; padding: 0;
  margin: 1.4rem 0 0; }
a { color: var(--accent); text-decoration: none; }
a:hover { text-decoration: underline; }
.scroll { overflow-x: auto; margin: 1.2rem 0; }
table { border-collapse: collapse; font-size: 0.93rem; font-variant-numeric: tabular-nums; }
table.data { min-width: 60%; }
caption { caption-side: bottom; text-align: left; color: var(--soft); font-size: 0.9rem;
  padding-top: 0.5rem; }
th, td { text-align: left; vertical-align: baseline; padding: 0.36rem 1.6rem 0.36rem 0;
  border-bottom: 1px solid var(--line); }
th { font-weight: 600; }
td:first-child { white-space: nowrap; }
thead th { color: var(--soft); border-bottom-width: 2px; vertical-align: bottom; }
.facts th { color: var(--soft); font-weight: 400; white-space: nowrap; }
.number { text-align: right; padding: 0.36rem 0 0.36rem 1.6rem; white-space: nowrap; }
th.number:first-child, td.number:first-child { padding-left: 0; }
.number + :not(.number) { padding-left: 1.6rem; }
figure { margin: 1.4rem 0; }
figure img { display: block; max-width: 100%; height: auto; border-radius: 6px; }
figure svg { display: block; width: 100%; height: auto; overflow: visible; }
.plot { max-width: 48rem; }
figcaption, .caption { color: var(--soft); font-size: 0.9rem; margin-top: 0.5rem; max-width: 44rem; }
.gallery { display: grid; grid-template-columns: repeat(auto-fit, minmax(15rem, 1fr)); gap: 1.2rem;
  margin: 1.4rem 0 0; }
.gallery figure { margin: 0; }
.gallery img { width: 100%; }
@media print { body { font-size: 11px; } main { max-width: none; padding: 0; }
  nav { display: none; } figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; } }
"""
