"""`jaxrender quads`: its numbers against plain loops over the same quads, its pictures, its manners."""

import dataclasses
import json
import math
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender import cli, quads_command
from jaxrender.deferred.pipeline import see
from jaxrender.deferred.quads import Quads, quad_coverage, visible_quads
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.io.picture import read_png
from jaxrender.quad_costs import pixel_layers, quad_costs
from jaxrender.scene import MASK, OPAQUE, whole_scene_camera

HEIGHT, WIDTH, TRIANGLES = 37, 53, 90
MAPS = ("overdraw", "overdraw_visible", "helpers", "wasted_lanes")


def random_quads(rng, count: int) -> Quads:
    """Quads of random places and lanes in an image of odd size; lanes outside are helpers."""
    rows, columns = -(-HEIGHT // 2), -(-WIDTH // 2)
    row, column = rng.integers(0, rows, count), rng.integers(0, columns, count)
    inside = np.where(2 * row + 1 < HEIGHT, 15, 3) & np.where(2 * column + 1 < WIDTH, 15, 5)
    mask = rng.integers(1, 16, count) & inside
    # Cubed, so that some triangles have hundreds of quads and some have one.
    ids = np.sort((TRIANGLES * rng.random(count) ** 3).astype(int))
    fields = (jnp.asarray(v[mask > 0], jnp.int32) for v in (ids, ids, row, column, mask))
    return Quads(*fields, rows=rows, columns=columns)


@pytest.fixture
def quads(rng) -> Quads:
    return random_quads(rng, 1500)


@pytest.fixture
def masked(rng):
    return jnp.asarray(rng.random((HEIGHT, WIDTH)) < 0.02)


def as_lists(quads: Quads) -> list[list[int]]:
    """Triangle, row, column and mask of each."""
    fields = (quads.triangle_id, quads.row, quads.column, quads.mask)
    return np.stack([np.asarray(values) for values in fields], axis=1).tolist()


def bits(mask: int) -> int:
    return mask.bit_count()


def check_work(work, quads: Quads):
    """Every number of a QuadWork again, by loops."""
    pixels, touched, places = {}, {}, {}
    for t, i, j, mask in as_lists(quads):
        pixels[t] = pixels.get(t, 0) + bits(mask)
        touched[t] = touched.get(t, 0) + 1
        places[i, j] = places.get((i, j), 0) + 1
    assert (work.triangles, work.pixels, work.quads) == (len(pixels), sum(pixels.values()), len(quads.mask))
    assert work.helper_share == pytest.approx(1 - work.pixels / (4 * work.quads), rel=1e-6)
    assert work.overdraw_max == max(places.values())
    assert work.overdraw_mean == pytest.approx(work.quads / len(places))
    assert sum(group.triangles for group in work.by_size) == work.triangles
    for group in work.by_size:
        mine = [t for t, count in pixels.items() if group.first <= count <= (group.last or math.inf)]
        assert group.triangles == len(mine)
        lanes = 4 * sum(touched[t] for t in mine)
        share = 1 - sum(pixels[t] for t in mine) / lanes if lanes else 0.0
        assert group.helper_share == pytest.approx(share, abs=1e-6)
    for fill in work.warps:
        size = fill.lanes // 4
        warps = [as_lists(quads)[k : k + size] for k in range(0, len(quads.mask), size)]
        assert fill.warps == len(warps)
        used = [sum(bits(quad[3]) for quad in warp) / fill.lanes for warp in warps]
        assert fill.utilisation == pytest.approx(np.mean(used), rel=1e-6)
        assert fill.triangles == pytest.approx(np.mean([len({quad[0] for quad in warp}) for warp in warps]))


def warp_of(y: int, x: int, lanes: int, order: str):
    """Which warp of a full-screen pass shades a pixel."""
    if order == "blocks":
        return y // (lanes // 8), x // 8
    return (y // 2 * -(-WIDTH // 2) + x // 2) // (lanes // 4)


def lockstep(step, turns) -> tuple[int, int]:
    """Useful and paid turns of a full-screen pass, one warp after the other."""
    longest, useful = {}, 0
    for (y, x), own in np.ndenumerate(turns):
        warp = warp_of(y, x, step.lanes, step.order)
        longest[warp] = max(longest.get(warp, 0), int(own))
        useful += int(own)
    return useful, step.lanes * sum(longest.values())


def test_all_numbers_agree_with_loops(rng, quads, masked):
    keep = np.flatnonzero(rng.random(len(quads.mask)) < 0.4)
    fields = (v[keep] for v in (quads.triangle_id, quads.screen_id, quads.row, quads.column, quads.mask))
    visible = Quads(*fields, rows=quads.rows, columns=quads.columns)
    costs = quad_costs(quads, visible, masked, num_triangles=TRIANGLES)
    check_work(costs.all, quads)
    check_work(costs.visible, visible)
    layers, overdraw = np.zeros((HEIGHT, WIDTH), int), np.zeros((quads.rows, quads.columns))
    for _, i, j, mask in as_lists(quads):
        overdraw[i, j] += 1
        for lane in range(4):
            if mask >> lane & 1:
                layers[2 * i + lane // 2, 2 * j + lane % 2] += 1
    np.testing.assert_array_equal(pixel_layers(quads, height=HEIGHT, width=WIDTH), layers)
    assert [(s.lanes, s.order) for s in costs.loop] == [(32, "rows"), (32, "blocks"), (64, "rows"), (64, "blocks")]
    for loop, branch in zip(costs.loop, costs.branch, strict=True):
        assert (loop.useful, loop.paid) == lockstep(loop, layers)
        sides = [lockstep(branch, np.asarray(side)) for side in (masked, ~masked)]
        assert (branch.useful, branch.paid) == tuple(map(sum, zip(*sides, strict=True)))
        for step in (loop, branch):
            assert step.efficiency == step.useful / step.paid < 1
    assert costs.masked_share == pytest.approx(np.mean(masked))
    for number, imbalance in costs.raster_imbalance.items():
        each = np.zeros(number)
        for (i, j), work in np.ndenumerate(overdraw):
            each[(j // 8 + i // 8 % 2 * (number // 2)) % number] += work
        assert imbalance == pytest.approx(each.max() / each.mean(), rel=1e-5)


def test_tables_hold_the_numbers_and_are_not_cut(capsys, quads, masked):
    costs = quad_costs(quads, quads, masked, num_triangles=TRIANGLES)
    quads_command.print_costs(costs)
    out = capsys.readouterr().out
    lines = [line.split() for line in out.splitlines()]
    share = f"{100 * costs.all.helper_share:.1f}"
    assert ["helper", "lanes", share, "%", share, "%"] in lines
    assert ["of", "64,", "filled", "by", "blocks"] in [line[:5] for line in lines]
    assert "…" not in out and "\x1b" not in out


def test_helper_shares_of_pixels_agree_with_loops(quads):
    lanes, helpers = np.zeros((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH))
    for _, i, j, mask in as_lists(quads):
        for lane in range(4):
            y, x = 2 * i + lane // 2, 2 * j + lane % 2
            if y < HEIGHT and x < WIDTH:
                lanes[y, x] += 1
                helpers[y, x] += not mask >> lane & 1
    found = quads_command.helper_shares(quads, height=HEIGHT, width=WIDTH)
    np.testing.assert_allclose(found, helpers / np.maximum(lanes, 1), atol=1e-6)
    assert (lanes == 0).any() and (helpers > 0).any()


def test_wasted_lanes_are_those_of_the_last_warp_on_the_pixel(quads):
    every = as_lists(quads)
    expected = np.zeros((HEIGHT, WIDTH))
    for k, (_, i, j, mask) in enumerate(every):
        used = sum(bits(quad[3]) for quad in every[k // 8 * 8 : k // 8 * 8 + 8])
        for lane in range(4):
            if mask >> lane & 1:
                expected[2 * i + lane // 2, 2 * j + lane % 2] = 1 - used / 32
    np.testing.assert_allclose(quads_command.wasted_shares(quads, height=HEIGHT, width=WIDTH), expected, atol=1e-6)


def test_without_matplotlib_the_chart_is_left_out(tmp_path, monkeypatch, capsys, quads, masked):
    costs = quad_costs(quads, quads, masked, num_triangles=TRIANGLES)
    for name in ("matplotlib", "matplotlib.figure"):
        monkeypatch.setitem(sys.modules, name, None)
    assert quads_command.draw_chart(tmp_path / "chart.png", costs) == []
    assert capsys.readouterr().err == 'no chart: matplotlib is not installed (the extra "plots")\n'


# --- The command


@pytest.mark.slow
def test_the_built_in_scene(tmp_path, capsys):
    """Numbers and pictures of the command against its own quads, listed again."""
    pytest.importorskip("matplotlib")
    height, width, out = 120, 161, tmp_path / "a" / "quads"
    assert cli.main(["quads", "-o", str(out), "--size", str(width), str(height), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    scene = builtin_scene()
    fragments = see(scene, whole_scene_camera(scene, aspect=width / height), height=height, width=width)
    quads = quad_coverage(fragments)
    visible = visible_quads(fragments, quads)
    for name, some in (("all", quads), ("visible", visible)):
        work, masks = record[name], np.asarray(some.mask)
        pixels = sum(bits(int(mask)) for mask in masks)
        assert (work["quads"], work["pixels"]) == (len(masks), pixels)
        assert work["helper_share"] == pytest.approx(1 - pixels / (4 * len(masks)), abs=1e-6)
        assert work["triangles"] == len(np.unique(some.triangle_id)) == sum(g["triangles"] for g in work["by_size"])
        assert [warps["warps"] for warps in work["warps"]] == [-(-len(masks) // 8), -(-len(masks) // 16)]
    assert record["visible"]["pixels"] == int(fragments.coverage.sum()) < record["all"]["pixels"]
    assert record["loop"][0]["useful"] == record["all"]["pixels"]
    # Nothing is tested for alpha: the branch costs what the lanes beyond the border cost.
    blocks = {step["lanes"]: step for step in record["branch"] if step["order"] == "blocks"}[64]
    assert record["masked_share"] == 0.0 and (blocks["useful"], blocks["paid"]) == (120 * 161, 120 * 168)
    assert record["raster_imbalance"]["1"] == 1.0 <= record["raster_imbalance"]["4"]
    assert record["paths"] == [str(out / f"{name}.png") for name in (*MAPS, "helpers_by_size")]
    covered = np.asarray(fragments.coverage)[..., 0]
    for name in MAPS:
        picture = read_png(out / f"{name}.png")
        assert picture.shape[1] == width and height < picture.shape[0] < height + 40
        dark = np.all(picture[:height] < 0.01, axis=-1)
        # No triangle comes within a quad of a pixel with no covered pixel around it.
        near = sum(np.roll(covered, (y, x), axis=(0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)) > 0
        assert dark[~near].all() and not dark.all()
    shaded = read_png(out / "overdraw_visible.png")[:height]
    assert (shaded[covered].sum(axis=-1) > 0.01).all()
    check_masked(scene, fragments)


def check_masked(scene, fragments):
    """With an alpha-tested floor, the pixels that see it."""
    modes = jnp.asarray([OPAQUE, MASK], jnp.int32)
    tested = dataclasses.replace(scene, material=dataclasses.replace(scene.material, alpha_mode=modes))
    ids = np.asarray(fragments.triangle_id)[..., 0]
    floor = (ids >= 0) & (np.asarray(scene.material_id)[ids] == 1)
    np.testing.assert_array_equal(quads_command.sees_masked(tested, fragments), floor)
    assert 0 < floor.sum() < (ids >= 0).sum()


@pytest.mark.slow
def test_a_camera_that_sees_nothing(tmp_path, capsys):
    view = ["--eye", "0", "1", "5", "--target", "0", "1", "10", "--size", "161", "120"]
    assert cli.main(["quads", "-o", str(tmp_path), *view]) == 0
    out = capsys.readouterr().out
    assert [*"00"] in [line.split()[-2:] for line in out.splitlines()]
    assert out.splitlines()[-1].startswith("wrote ") and "nan" not in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.gltf"], "nowhere.gltf"),
        (["--size", "0", "4"], "--size: expected two numbers of 1 or more, got 0 4"),
        (["--samples", "3"], "--samples: expected one of 1, 2, 4, 8, 16, got 3"),
        (["-o", "FILE/below"], "-o: "),
        (["-o", "FILE"], "-o: "),
    ],
)
def test_bad_input_to_quads(tmp_path, capsys, arguments, words):
    (tmp_path / "FILE").write_text("x")
    arguments = [a.replace("FILE", str(tmp_path / "FILE")) for a in arguments]
    out = [] if "-o" in arguments else ["-o", str(tmp_path / "out")]
    assert cli.main(["quads", *arguments, *out]) == 2
    stdout, error = capsys.readouterr()
    assert stdout == "" and words in error and "Traceback" not in error
