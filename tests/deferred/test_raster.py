"""The rasteriser against a brute-force one, closed meshes against single coverage, and its edges."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.raster import Budget, rasterize, rasterize_within
from jaxrender.deferred.samples import CENTER, ordered_grid, standard_pattern
from tests.deferred import oracle

LAYOUTS = {
    "center": CENTER, "grid2": ordered_grid(2), "grid3": ordered_grid(3), "grid4": ordered_grid(4),
    "msaa2": standard_pattern(2), "msaa4": standard_pattern(4), "msaa8": standard_pattern(8),
    "msaa16": standard_pattern(16),
}  # fmt: skip


def soup(rng, count, *, spread=1.6, size=0.5):
    """Triangles of all sizes, in part off the screen, at different depths and w."""
    center = rng.uniform(-spread, spread, (count, 1, 2))
    xy = center + rng.normal(size=(count, 3, 2)) * size * rng.uniform(0.01, 1.0, (count, 1, 1))
    z, w = rng.uniform(0.05, 0.95, (count, 3)), rng.uniform(0.5, 4.0, (count, 3))
    clip = np.concatenate([xy * w[..., None], (z * w)[..., None], w[..., None]], axis=-1)
    return clip.reshape(-1, 4).astype(np.float32), np.arange(3 * count).reshape(-1, 3).astype(np.int32)


def ndc(points, depth=0.5):
    """Clip positions of points given in NDC."""
    points = np.asarray(points, np.float32)
    return np.concatenate([points, np.full((len(points), 1), depth, np.float32), np.ones((len(points), 1))], 1).astype(
        np.float32
    )


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("cull", ["none", "back", "front"])
def test_soups_agree_with_brute_force(rng, name, cull):
    clip, faces = soup(rng, 150)
    samples, m = LAYOUTS[name], LAYOUTS[name].grid
    # Cells of a grid are the pixels of a larger image, one for all grids: they share programs. It ends within a tile.
    size = {"height": 37, "width": 53} if m == 1 else {"height": 84 // m, "width": 156 // m}
    got = rasterize(jnp.asarray(clip), jnp.asarray(faces), **size, samples=samples, cull=cull)
    large = {"height": size["height"] * m, "width": size["width"] * m}
    center = np.array([[0.5, 0.5]])
    positions = center if m > 1 else samples.positions_px
    ids, depth, _ = oracle.rasterize(clip, faces, **large, positions_px=positions, cull=cull)
    if m > 1:
        cells = lambda a: a.reshape(size["height"], m, size["width"], m).swapaxes(1, 2).reshape(*size.values(), -1)  # noqa: E731
        ids, depth = cells(ids), cells(depth)
    # Depth is a plane over up to a screen: some tens of roundings of a number near 1.
    np.testing.assert_allclose(got.depth, depth, atol=5e-6)
    differ = np.asarray(got.triangle_id) != ids
    assert differ.sum() <= 1, "only a tie of depths within rounding may differ"


def test_shared_edges_are_covered_once(rng):
    """A closed fan and a jittered grid cover each sample inside exactly once, whatever the winding."""
    n = 10
    x, y = np.meshgrid(np.linspace(-1.3, 1.3, n), np.linspace(-1.3, 1.3, n))
    points = np.stack([x, y], -1)
    points[1:-1, 1:-1] += rng.uniform(-0.05, 0.05, (n - 2, n - 2, 2))
    a = np.arange(n * n).reshape(n, n)
    quads = np.stack([a[:-1, :-1], a[:-1, 1:], a[1:, 1:], a[1:, :-1]], -1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    flip = rng.random(len(faces)) < 0.5
    faces[flip] = faces[flip][:, ::-1]
    clip = ndc(points.reshape(-1, 2))
    for samples in (CENTER, standard_pattern(16)):
        budget = Budget(max_clipped=1, max_spans=16, max_pairs=64)
        draw = functools.partial(
            rasterize_within, budget=budget, height=32, width=32, samples=samples, tiles_per_chunk=16
        )
        alone = jax.jit(
            jax.vmap(lambda face, draw=draw: draw(jnp.asarray(clip), face[None])),
        )
        got, demand = alone(jnp.asarray(faces))
        assert not np.asarray(demand.exceeds(budget)).any()
        assert (np.asarray(got.coverage).sum(axis=0) == 1).all()


def test_corners_on_samples_follow_the_top_left_rule():
    """The square from (1, 1) to (3, 3) px, snapped onto sample positions, holds 4 pixels whichever way it is cut."""
    corner = lambda x, y: ((x + 0.5) / 4 - 1, 1 - (y + 0.5) / 4)  # noqa: E731
    clip = ndc([corner(1, 1), corner(3, 1), corner(3, 3), corner(1, 3)])
    expected = np.zeros((8, 8), bool)
    expected[1:3, 1:3] = True
    for faces in ([[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]], [[2, 1, 0], [3, 2, 0]]):
        got = rasterize(jnp.asarray(clip), jnp.asarray(faces), height=8, width=8)
        assert (np.asarray(got.coverage)[..., 0] == expected).all()
        assert len(np.unique(np.asarray(got.triangle_id))) == 3


def perspective(points, *, near=0.1, far=50.0):
    """Clip positions of view-space points (looking down -z), 90° both ways."""
    x, y, z = np.asarray(points, np.float64).T
    return np.stack([x, y, far / (near - far) * z + near * far / (near - far), -z], -1).astype(np.float32)


def test_a_floor_under_the_camera_is_cut_at_the_near_plane():
    """One triangle that reaches far behind the eye: all of the lower half is floor, with w = view depth."""
    points = np.array([[-4000.0, -1.0, 3000.0], [4000.0, -1.0, 3000.0], [0.0, -1.0, -9000.0]])
    got = rasterize(jnp.asarray(perspective(points, far=20000.0)), jnp.asarray([[0, 1, 2]]), height=40, width=40)
    assert np.asarray(got.coverage)[21:].all()
    assert not np.asarray(got.coverage)[:20].any()
    y = (np.arange(21, 40) + 0.5) / 20 - 1
    # Where a ray with slope -y meets the floor one below the eye.
    np.testing.assert_allclose(np.asarray(got.w)[21:, 20, 0], 1 / y, rtol=1e-3)
    weights = np.asarray(got.barycentrics, np.float64)[21:, :, 0]
    there = (
        points[0] * (1 - weights.sum(-1, keepdims=True)) + points[1] * weights[..., :1] + points[2] * weights[..., 1:]
    )
    np.testing.assert_allclose(there[..., 2], -np.asarray(got.w)[21:, :, 0], rtol=5e-3, atol=1e-2)


def test_triangles_through_the_eye_plane_are_watertight(rng):
    """A closed box around the eye, cut into many triangles that cross all clip planes: no sample is empty."""
    n = 5
    g = np.linspace(-1, 1, n)
    faces, points = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            u, v = np.meshgrid(g, g)
            p = np.stack([np.full_like(u, side), u, v], -1)
            p = np.roll(p, axis, axis=-1).reshape(-1, 3)
            a = np.arange(n * n).reshape(n, n) + sum(map(len, points))
            q = np.stack([a[:-1, :-1], a[:-1, 1:], a[1:, 1:], a[1:, :-1]], -1).reshape(-1, 4)
            faces += [q[:, [0, 1, 2]], q[:, [0, 2, 3]]]
            points.append(p)
    points, faces = np.concatenate(points), np.concatenate(faces).astype(np.int32)
    for turn in range(6):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        moved = (points * [3.0, 0.4, 2.0] + rng.uniform(-0.25, 0.25, 3)) @ rotation
        got = rasterize(jnp.asarray(perspective(moved, near=0.01)), jnp.asarray(faces), height=96, width=96)
        assert np.asarray(got.coverage).all(), turn


def test_each_cut_triangle_keeps_its_id_and_its_place(rng):
    """Triangles that cross the near plane, interpolated, give the ray's hit point; float64 rays are the judge."""
    corners = rng.uniform(-2, 2, (60, 3, 3)) + [0, 0, -0.6]
    near, far = 0.1, 50.0
    clip = perspective(corners.reshape(-1, 3), near=near, far=far)
    got = rasterize(jnp.asarray(clip), jnp.asarray(np.arange(180).reshape(-1, 3)), height=48, width=48)
    x = (np.arange(48) + 0.5) / 24 - 1
    rays = np.stack(
        [np.broadcast_to(x[None], (48, 48)), np.broadcast_to(-x[:, None], (48, 48)), -np.ones((48, 48))], -1
    )
    best, ids = np.full((48, 48), np.inf), np.full((48, 48), -1)
    for t, (a, b, c) in enumerate(corners):
        m = np.stack([rays, *np.broadcast_arrays(a - b, a - c, rays)[:2]], -1)
        with np.errstate(all="ignore"):
            s = np.linalg.solve(m, np.broadcast_to(a, rays.shape)[..., None])[..., 0]
        hit = (
            (s[..., 1] >= 0)
            & (s[..., 2] >= 0)
            & (s[..., 1] + s[..., 2] <= 1)
            & (s[..., 0] >= near)
            & (s[..., 0] < best)
        )
        best[hit], ids[hit] = s[hit][:, 0], t
    same = np.asarray(got.triangle_id)[..., 0] == ids
    # Corners snapped by up to 1/512 px move edges: a fiftieth of the samples lies that near to one here.
    assert same.mean() > 0.97
    np.testing.assert_allclose(np.asarray(got.w)[..., 0][same & (ids >= 0)], best[same & (ids >= 0)], rtol=0.03)


def test_the_first_of_equal_triangles_wins_even_if_it_was_cut():
    points = np.array([[-40.0, -1.0, 3.0], [40.0, -1.0, 3.0], [0.0, -1.0, -90.0]])
    clip = perspective(np.concatenate([points, points]))
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 4, 5], [0, 1, 2]]):
        got = rasterize(jnp.asarray(clip), jnp.asarray(faces), height=32, width=32)
        assert set(np.unique(got.triangle_id)) == {-1, 0}


def test_empty_and_degenerate_input():
    clip = ndc([(-0.5, -0.5), (0.5, -0.5), (0.0, 0.5)])
    nothing = rasterize(jnp.asarray(clip), jnp.zeros((0, 3), jnp.int32), height=8, width=9)
    assert nothing.triangle_id.shape == (8, 9, 1)
    assert not np.asarray(nothing.coverage).any()
    assert (np.asarray(nothing.depth) == 1).all()
    line = rasterize(jnp.asarray(clip), jnp.asarray([[0, 0, 1], [1, 1, 1]]), height=8, width=9)
    assert not np.asarray(line.coverage).any()
    for bad in (np.nan, np.inf):
        broken = clip.copy()
        broken[1, 0] = bad
        with jax.debug_nans(False):
            both = jnp.asarray(np.concatenate([broken, clip]))
            got = rasterize(both, jnp.asarray([[0, 1, 2], [3, 4, 5]]), height=8, width=8)
        assert set(np.unique(got.triangle_id)) == {-1, 1}
    assert rasterize(jnp.asarray(clip), jnp.asarray([[0, 1, 2]]), height=0, width=5).depth.shape == (0, 5, 1)


def test_bad_arguments():
    clip, face = jnp.asarray(ndc([(0, 0), (1, 0), (0, 1)])), jnp.asarray([[0, 1, 2]])
    with pytest.raises(ValueError, match="faces: expected indices from 0 to 2, got 0 to 3"):
        rasterize(clip, jnp.asarray([[0, 1, 3]]), height=4, width=4)
    with pytest.raises(ValueError, match="expected at most 16382 samples a side"):
        rasterize(clip, face, height=9000, width=4, samples=ordered_grid(2))
    with pytest.raises(ValueError, match="cull"):
        rasterize(clip, face, height=4, width=4, cull="sideways")


def test_the_pure_form_is_the_same_and_reports_what_it_had_no_room_for(rng):
    clip, faces = (jnp.asarray(a) for a in soup(rng, 60))
    whole = rasterize(clip, faces, height=33, width=40)
    run = jax.jit(
        lambda clip, budget: rasterize_within(clip, faces, budget, height=33, width=40), static_argnames="budget"
    )
    enough = Budget(max_clipped=8, max_spans=400, max_pairs=900)
    got, demand = run(clip, enough)
    assert not bool(demand.exceeds(enough))
    for name in ("triangle_id", "depth", "w"):
        assert (np.asarray(getattr(got, name)) == np.asarray(getattr(whole, name))).all()
    small = dataclasses.replace(enough, max_pairs=int(demand.pairs) - 1)
    assert bool(run(clip, small)[1].exceeds(small))
    # A batch of poses.
    batch = jnp.stack([clip, clip * jnp.asarray([0.5, 0.5, 1.0, 1.0])[None]])
    many, _ = jax.jit(jax.vmap(lambda c: rasterize_within(c, faces, enough, height=33, width=40)))(batch)
    assert (np.asarray(many.triangle_id[0]) == np.asarray(whole.triangle_id)).all()
    shrunk = rasterize(batch[1], faces, height=33, width=40)
    assert (np.asarray(many.triangle_id[1]) == np.asarray(shrunk.triangle_id)).all()
