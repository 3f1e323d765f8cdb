"""`jaxrender quads`: loads a scene, lists its quads, counts what they cost, draws where."""

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender import console
from jaxrender.checks import bad_input
from jaxrender.deferred.pipeline import scene_textures, see
from jaxrender.deferred.quads import Quads, draw_overdraw, quad_coverage, visible_quads
from jaxrender.deferred.raster import Fragments
from jaxrender.deferred.samples import standard_pattern
from jaxrender.deferred.warps import pack_quads
from jaxrender.io import write_png
from jaxrender.io.atomic import atomic_path
from jaxrender.io.picture import with_color_bar
from jaxrender.machine import is_writable_folder
from jaxrender.metrics import heatmap
from jaxrender.quad_costs import (
    WARP_SIZES,
    QuadCosts,
    QuadWork,
    SizeGroup,
    overdraw_of,
    pixel_layers,
    quad_costs,
)
from jaxrender.render_command import open_view
from jaxrender.scene import MASK, Scene

if TYPE_CHECKING:
    from jaxrender.cli import Quads as Options

#: Part of the places that the colors of an overdraw map tell apart; the few with more quads are all of one color.
RESOLVED = 0.995


def run_quads(options: "Options") -> None:
    """The command."""
    if not is_writable_folder(options.out):
        bad_input("-o", str(options.out), expected="a folder that can be written", got="one that cannot")
    scene, camera = open_view(options)
    width, height = options.size
    console.announce_device()
    started = time.perf_counter()
    fragments = see(
        scene, camera, height=height, width=width, samples=standard_pattern(options.samples),
        textures=scene_textures(scene),
    )  # fmt: skip
    quads = quad_coverage(fragments)
    visible = visible_quads(fragments, quads)
    costs = quad_costs(quads, visible, sees_masked(scene, fragments), num_triangles=len(scene.faces))
    seconds = time.perf_counter() - started
    paths = draw_maps(options.out, quads, visible, height=height, width=width)
    paths += draw_chart(options.out / "helpers_by_size.png", costs)
    if not options.json:
        print_costs(costs)
    record = {"size": options.size, "samples": options.samples, "seconds": seconds, **console.to_jsonable(costs)}
    console.finish(paths=paths, record=record, as_json=options.json)


def sees_masked(scene: Scene, fragments: Fragments) -> Bool[Array, "h w"]:
    """Pixels whose first sample sees an alpha-tested material."""
    masked = scene.material.alpha_mode[scene.material_id] == MASK
    first = fragments.triangle_id[:, :, 0]
    return masked[jnp.maximum(first, 0)] & (first >= 0)


# --- Tables


def print_costs(costs: QuadCosts) -> None:
    """The numbers as tables on standard output."""
    works = (costs.all, costs.visible)
    columns = [_work_rows(work) for work in works]
    rows = [[name, *(column[name] for column in columns)] for name in columns[0]]
    console.print_table("Quads", ["", "no depth test", "early depth test"], rows)
    groups = zip(*(work.by_size for work in works), strict=True)
    console.print_table(
        "Helper lanes by size of triangle",
        ["pixels", "triangles", "helpers", "early depth test: triangles", "helpers"],
        [[_size(every), *_group(every), *_group(seen)] for every, seen in groups],
    )
    console.print_table(
        "Lanes with work in full-screen passes in lockstep",
        ["warps", "loop over fragments", f"branch on alpha test ({_percent(costs.masked_share)} of pixels)"],
        [
            [f"of {loop.lanes}, filled by {loop.order}", _percent(loop.efficiency), _percent(branch.efficiency)]
            for loop, branch in zip(costs.loop, costs.branch, strict=True)
        ],
    )
    console.print_table(
        "Rasterisers with tiles in turn",
        ["number", "quads of the busiest / mean"],
        [[str(number), f"{value:.3f}"] for number, value in costs.raster_imbalance.items()],
    )


def _work_rows(work: QuadWork) -> dict[str, str]:
    rows = {
        "triangles": _count(work.triangles),
        "pixels, by triangle": _count(work.pixels),
        "quads": _count(work.quads),
        "helper lanes": _percent(work.helper_share),
        "quads at a place, mean": f"{work.overdraw_mean:.2f}",
        "quads at a place, most": _count(work.overdraw_max),
    }
    for fill in work.warps:
        name = f"warps of {fill.lanes}"
        rows[name] = _count(fill.warps)
        rows[f"{name}: lanes in use"] = _percent(fill.utilisation)
        rows[f"{name}: triangles in each"] = f"{fill.triangles:.2f}"
    return rows


def _count(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _size(group: SizeGroup) -> str:
    if group.last is None:
        return f"{group.first}+"
    return str(group.first) if group.first == group.last else f"{group.first}-{group.last}"


def _group(group: SizeGroup) -> list[str]:
    return [_count(group.triangles), _percent(group.helper_share) if group.triangles else "-"]


# --- Pictures


def draw_maps(out: Path, quads: Quads, visible: Quads, *, height: int, width: int) -> list[Path]:
    """Maps as PNG: overdraw of all quads and of the visible ones, helper lanes, wasted lanes of warps; their paths."""
    size = {"height": height, "width": width}
    colors = np.asarray(heatmap(jnp.linspace(0.0, 1.0, 256)))
    every, every_high = _overdraw_map(quads, **size)
    seen, seen_high = _overdraw_map(visible, **size)
    helpers, wasted = helper_shares(quads, **size), wasted_shares(visible, **size)
    maps = {
        "overdraw": (every, "quads shaded, no depth test", every_high),
        "overdraw_visible": (seen, "quads shaded, perfect early depth test", seen_high),
        "helpers": (heatmap(helpers, high=1.0), "helpers among the lanes shaded, no depth test", "100 %"),
        "wasted_lanes": (
            heatmap(jnp.asarray(wasted), high=1.0),
            f"wasted lanes in warps of {WARP_SIZES[0]}, perfect early depth test", "100 %",
        ),
    }  # fmt: skip
    paths = []
    for name, (image, title, high) in maps.items():
        paths.append(out / f"{name}.png")
        write_png(paths[-1], with_color_bar(np.asarray(image), colors, title=title, low="0", high=high))
    return paths


def _overdraw_map(quads: Quads, *, height: int, width: int) -> tuple[Float[Array, "h w 3"], str]:
    """The map, and what its brightest color means."""
    overdraw = overdraw_of(quads)
    some = np.asarray(overdraw)[np.asarray(overdraw) > 0]
    high = math.ceil(np.quantile(some, RESOLVED)) if len(some) else 1
    more = " and more" if some.max(initial=0) > high else ""
    return draw_overdraw(overdraw, high=high)[:height, :width], f"{high}{more}"


def helper_shares(quads: Quads, *, height: int, width: int) -> Float[Array, "h w"]:
    """Of the lanes that run for each pixel, the part that are helpers, in [0, 1]; 0 where none runs."""
    lanes = jnp.repeat(jnp.repeat(overdraw_of(quads), 2, axis=0), 2, axis=1)[:height, :width].astype(float)
    useful = pixel_layers(quads, height=height, width=width).astype(float)
    return (lanes - useful) / jnp.maximum(lanes, 1.0)


def wasted_shares(quads: Quads, *, height: int, width: int) -> Float[np.ndarray, "h w"]:
    """Of the lanes of the warp in which each pixel is shaded, the part without a pixel; 0 where nothing is.

    Where a pixel is shaded several times, that of the last triangle.
    """
    warps = pack_quads(quads.triangle_id, quads.mask, warp_size=WARP_SIZES[0])
    wasted = np.repeat(1.0 - np.asarray(warps.utilisation), WARP_SIZES[0] // 4)[: len(quads.mask)]
    row, column, mask = (np.asarray(values) for values in (quads.row, quads.column, quads.mask))
    shares = np.zeros((height, width), np.float32)
    for lane in range(4):
        own = mask >> lane & 1 > 0
        shares[2 * row[own] + lane // 2, 2 * column[own] + lane % 2] = wasted[own]
    return shares


def draw_chart(path: Path, costs: QuadCosts) -> list[Path]:
    """Helper lanes by size of triangle as a bar chart in PNG; without matplotlib a remark, and no path."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        console.announce('no chart: matplotlib is not installed (the extra "plots")')
        return []
    figure = Figure((9.0, 4.2), layout="constrained", dpi=110)
    axes = figure.subplots()
    for work, shift, color, name in (
        (costs.all, -0.2, "#4c72b0", "no depth test"),
        (costs.visible, 0.2, "#dd8452", "perfect early depth test"),
    ):
        places = np.arange(len(work.by_size)) + shift
        bars = axes.bar(
            places, [100 * g.helper_share for g in work.by_size], width=0.38, color=color,
            label=f"{name}: {_percent(work.helper_share)} of all lanes",
        )  # fmt: skip
        counts = [_short(group.triangles) for group in work.by_size]
        axes.bar_label(bars, counts, fontsize=7, rotation=90, padding=3)
    axes.set_xticks(range(len(costs.all.by_size)), [_size(group) for group in costs.all.by_size], fontsize=8)
    axes.set(xlabel="covered pixels of a triangle", ylabel="helper lanes (%)", ylim=(0, 90))
    axes.set_title("Helper lanes by size of triangle; on the bars, how many triangles", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")
    return [path]


def _short(number: int) -> str:
    """A count of three digits or so; empty for none."""
    if number < 10_000:
        return str(number or "")
    return f"{number / 1e3:.0f}k" if number < 1e6 else f"{number / 1e6:.1f}M"
