"""Quads against brute force over exact coverage, hand-counted triangles, and derivatives of planes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred import quads as q
from jaxrender.deferred.interpolate import attribute_gradients
from jaxrender.deferred.raster import rasterize
from jaxrender.deferred.samples import CENTER, ordered_grid, standard_pattern
from tests.deferred import oracle
from tests.deferred.test_raster import ndc, perspective, soup

LAYOUTS = {"center": CENTER, "grid3": ordered_grid(3), "msaa4": standard_pattern(4), "msaa8": standard_pattern(8)}


def at_px(points, *, height, width):
    """NDC of points in pixels from the upper left corner."""
    x, y = np.asarray(points, np.float64).T
    return np.stack([2 * x / width - 1, 1 - 2 * y / height], axis=1)


def brute_force(clip, faces, fragments):
    """{(triangle, row, column): mask} of all coverage, and of visible pixels."""
    samples = fragments.samples
    h, w, _ = fragments.triangle_id.shape
    m = samples.grid
    size = {"height": h * m, "width": w * m}
    positions = np.array([[0.5, 0.5]]) if m > 1 else samples.positions_px
    ids = np.asarray(fragments.triangle_id).reshape(h, w, m, m, -1).swapaxes(1, 2).reshape(h * m, w * m, -1)
    everything, visible = {}, {}
    for t, face in enumerate(faces):
        _, _, layers = oracle.rasterize(clip, [face], **size, positions_px=positions)
        for result, pixels in ((everything, layers.any(axis=-1)), (visible, (ids == t).any(axis=-1))):
            for i, j in np.argwhere(pixels):
                key = t, i // 2, j // 2
                result[key] = result.get(key, 0) | 1 << (i % 2 * 2 + j % 2)
    return everything, visible


def as_table(quads):
    fields = (quads.triangle_id, quads.row, quads.column, quads.mask)
    rows = np.stack([np.asarray(f) for f in fields], axis=1).tolist()
    table = {tuple(row[:3]): row[3] for row in rows}
    assert len(table) == len(rows), "a quad is listed twice"
    return table


@pytest.mark.parametrize("name", LAYOUTS)
def test_coverage_is_that_of_brute_force(rng, name):
    """150 triangles over each other, in part outside, on an odd image that no tile divides."""
    clip, faces = soup(rng, 150)
    fragments = rasterize(jnp.asarray(clip), jnp.asarray(faces), height=37, width=53, samples=LAYOUTS[name])
    quads = q.quad_coverage(fragments)
    everything, visible = brute_force(clip, faces, fragments)
    assert as_table(quads) == everything
    assert (np.diff(np.asarray(quads.triangle_id)) >= 0).all(), "not in API order"
    assert as_table(q.visible_quads(fragments, quads)) == visible
    m = fragments.samples.grid
    assert (quads.rows, quads.columns) == ((37 * m + 1) // 2, (53 * m + 1) // 2)
    overdraw = np.zeros((quads.rows, quads.columns), int)
    pixels, touched = np.zeros(150, int), np.zeros(150, int)
    for (t, i, j), mask in everything.items():
        overdraw[i, j] += 1
        pixels[t] += bin(mask).count("1")
        touched[t] += 1
    np.testing.assert_array_equal(
        q.quad_overdraw(quads.row, quads.column, rows=quads.rows, columns=quads.columns), overdraw
    )
    statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=150)
    np.testing.assert_array_equal(statistics.pixels, pixels)
    np.testing.assert_array_equal(statistics.quads, touched)


def test_more_pairs_than_a_chunk(rng, monkeypatch):
    monkeypatch.setattr(q, "_CHUNK", 64)
    clip, faces = soup(rng, 150)
    fragments = rasterize(jnp.asarray(clip), jnp.asarray(faces), height=37, width=53)
    assert as_table(q.quad_coverage(fragments)) == brute_force(clip, faces, fragments)[0]


def test_a_large_triangle_has_next_to_no_helpers():
    clip = ndc([(-3.0, -1.0), (1.0, -1.0), (1.0, 3.0)])
    fragments = rasterize(jnp.asarray(clip), jnp.asarray([[0, 1, 2]]), height=64, width=64)
    quads = q.quad_coverage(fragments)
    statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=1)
    assert int(statistics.pixels[0]) == 64 * 64 and int(statistics.quads[0]) == 32 * 32
    assert float(q.helper_share(statistics.pixels, statistics.quads)[0]) == 0.0


def test_triangles_of_a_pixel_waste_three_quarters(rng):
    """A grid of 8 x 8 triangles, each around one pixel centre of an own quad."""
    center = np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 1, 2) * 2 + 0.5
    corners = center + np.array([[-0.4, -0.3], [0.4, -0.3], [0.0, 0.4]])
    clip = ndc(at_px(corners.reshape(-1, 2), height=16, width=16))
    faces = np.arange(len(clip)).reshape(-1, 3)
    fragments = rasterize(jnp.asarray(clip), jnp.asarray(faces, jnp.int32), height=16, width=16)
    quads = q.quad_coverage(fragments)
    statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=64)
    assert (np.asarray(q.helper_share(statistics.pixels, statistics.quads)) == 0.75).all()
    share, number = q.helper_share_by_size(statistics.pixels, statistics.quads, num_sizes=3)
    assert share.tolist() == [0.75, 0.0, 0.0] and number.tolist() == [64, 0, 0]


def test_the_documents_small_triangle():
    """Pipeline part 8: it meets four quads, covers one pixel in each of three of them, and none of the fourth."""
    # Pixel centres (1.5, 1.5), (2.5, 1.5) and (1.5, 2.5) lie inside, (2.5, 2.5) does not.
    clip = ndc(at_px([(1.2, 1.2), (2.9, 1.4), (1.4, 2.9)], height=4, width=4))
    fragments = rasterize(jnp.asarray(clip), jnp.asarray([[0, 1, 2]]), height=4, width=4)
    quads = q.quad_coverage(fragments)
    assert as_table(quads) == {(0, 0, 0): 8, (0, 0, 1): 4, (0, 1, 0): 2}
    assert q.quad_overdraw(quads.row, quads.column, rows=2, columns=2).tolist() == [[1, 1], [1, 0]]


def test_helper_share_falls_with_size(rng):
    """Right-angled triangles of s px a side: perimeter over area, 3/4 at one pixel."""
    shares = []
    for side in (1, 4, 16, 64):
        place = rng.uniform(0, 8, (40, 1, 2))
        corners = place + np.array([[0, 0], [1, 0], [0, 1]]) * side
        clip = ndc(at_px(corners.reshape(-1, 2), height=80, width=80))
        faces = np.arange(len(clip), dtype=np.int32).reshape(-1, 3)
        fragments = rasterize(jnp.asarray(clip), jnp.asarray(faces), height=80, width=80)
        quads = q.quad_coverage(fragments)
        statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=40)
        shares.append(float(q.helper_share(statistics.pixels.sum(), statistics.quads.sum())))
    assert 0.65 < shares[0] <= 0.75 and shares[-1] < 0.08
    assert shares == sorted(shares, reverse=True)


def test_a_triangle_through_the_camera_plane_counts_for_its_source():
    """Cut at the near plane into several: each has quads of its own, all belong to triangle 0, none is lost."""
    points = np.array([[-40.0, -1.0, 30.0], [40.0, -1.0, 30.0], [0.0, -1.0, -90.0]])
    fragments = rasterize(jnp.asarray(perspective(points, far=200.0)), jnp.asarray([[0, 1, 2]]), height=20, width=20)
    quads = q.quad_coverage(fragments)
    assert len(np.unique(quads.screen_id)) > 1 and (np.asarray(quads.triangle_id) == 0).all()
    statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=1)
    assert int(statistics.pixels[0]) == int(fragments.coverage.sum()) > 100
    assert len(q.visible_quads(fragments, quads).mask) == len(quads.mask)


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (1, 1)])
def test_nothing_to_draw(size):
    none = jnp.zeros((0, 3), jnp.int32)
    fragments = rasterize(jnp.zeros((1, 4)), none, height=size[0], width=size[1])
    quads = q.quad_coverage(fragments)
    assert len(quads.mask) == 0 and (quads.rows, quads.columns) == ((size[0] + 1) // 2, (size[1] + 1) // 2)
    assert len(q.visible_quads(fragments, quads).mask) == 0
    statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=2)
    assert q.helper_share(statistics.pixels, statistics.quads).tolist() == [0.0, 0.0]


def test_overdraw_is_drawn_two_pixels_to_a_quad():
    picture = np.asarray(q.draw_overdraw(jnp.asarray([[0, 1, 4]]), high=4.0))
    assert picture.shape == (2, 6, 3)
    luminance = picture.sum(axis=-1)
    assert (luminance[:, ::2] == luminance[:, 1::2]).all()
    assert luminance[0, 0] < luminance[0, 2] < luminance[0, 4]
    np.testing.assert_array_equal(picture, q.draw_overdraw(jnp.asarray([[0, 1, 4]])))


# --- Derivatives


def test_differences_of_a_quad_by_hand():
    """Quads (1 2 / 5 9) and a last column (7 / 8) whose neighbour is itself."""
    values = jnp.asarray([[1.0, 2.0, 7.0], [5.0, 9.0, 8.0]])
    assert q.ddx(values).tolist() == [[1, 1, 0], [4, 4, 0]]
    assert q.ddx(values, fine=False).tolist() == [[1, 1, 0], [1, 1, 0]]
    assert q.ddy(values).tolist() == [[4, 7, 1], [4, 7, 1]]
    assert q.ddy(values, fine=False).tolist() == [[4, 4, 1], [4, 4, 1]]


@pytest.mark.parametrize("shape", [(1, 1), (5, 7, 2), (4, 6, 2, 3), (0, 3), (1, 8)])
@pytest.mark.parametrize("fine", [True, False])
def test_differences_of_a_plane(shape, fine):
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    plane = (3 * x - 2 * y).reshape(*shape[:2], *(1,) * (len(shape) - 2)) * np.ones(shape, np.float32)
    dx, dy = (np.asarray(jax.jit(f, static_argnames="fine")(jnp.asarray(plane), fine=fine)) for f in (q.ddx, q.ddy))
    assert dx.shape == dy.shape == shape
    even = shape[0] // 2 * 2, shape[1] // 2 * 2
    assert (dx[:, : even[1]] == 3).all() and (dx[:, even[1] :] == 0).all()
    assert (dy[: even[0]] == -2).all() and (dy[even[0] :] == 0).all()


VALUES = np.array([[1.0, -2.0], [4.0, 0.5], [-1.0, 3.0], [2.0, 2.0]], np.float32)


def two_triangles(samples=CENTER, w=(0.7, 3.0, 1.3, 2.0), **size):
    """An edge through the image, with attributes that jump there unless triangles are kept apart."""
    xy, w = np.array([(-0.8, -0.7), (0.9, -0.4), (-0.1, 0.85), (0.95, 0.9)]), np.array(w)
    clip = np.concatenate([xy * w[:, None], 0.5 * w[:, None], w[:, None]], axis=1).astype(np.float32)
    return rasterize(jnp.asarray(clip), jnp.asarray([[0, 1, 2], [2, 1, 3]]), **size, samples=samples)


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("fine", [True, False])
def test_linear_attributes_have_their_exact_derivative_up_to_the_silhouette(name, fine):
    """With one w the attribute is a plane: helper lanes carry it on, and differences equal derivatives everywhere."""
    fragments = two_triangles(LAYOUTS[name], w=(1.0, 1.0, 1.0, 1.0), height=19, width=23)
    assert (np.asarray(fragments.triangle_id) == 1).sum() > 50
    got = q.quad_derivatives(fragments, jnp.asarray(VALUES), fine=fine)
    for ours, exact in zip(got, attribute_gradients(fragments, jnp.asarray(VALUES)), strict=True):
        np.testing.assert_allclose(ours, exact, atol=2e-5)


def test_perspective_differences_approach_the_derivative():
    """A difference over a pixel is a derivative up to second order: four times the pixels, a quarter of the error."""
    errors = []
    for scale in (1, 4):
        fragments = two_triangles(height=20 * scale, width=24 * scale)
        got = q.quad_derivatives(fragments, jnp.asarray(VALUES))
        exact = attribute_gradients(fragments, jnp.asarray(VALUES))
        scaled = [scale * np.abs(np.asarray(a) - np.asarray(b)) for a, b in zip(got, exact, strict=True)]
        errors.append(np.mean([e[np.asarray(fragments.coverage)].mean() for e in scaled]))
    assert 3.0 < errors[0] / errors[1] < 5.0


@pytest.mark.parametrize("mode", ["perspective", "noperspective", "flat_first", "flat_last"])
@pytest.mark.parametrize("fine", [True, False])
def test_inside_a_triangle_they_are_the_plain_differences(mode, fine):
    """Where one triangle holds the whole quad, the helper-lane rule and `ddx` of the interpolated image agree."""
    from jaxrender.deferred.interpolate import interpolate

    fragments = two_triangles(height=20, width=24)
    ids = np.asarray(fragments.triangle_id)[..., 0].reshape(10, 2, 12, 2)
    same = (ids == ids[:, :1, :, :1]).all(axis=(1, 3)) & (ids[:, 0, :, 0] >= 0)
    whole = same.repeat(2, axis=0).repeat(2, axis=1)
    assert whole.sum() > 100
    image = interpolate(fragments, jnp.asarray(VALUES), mode=mode)
    got = q.quad_derivatives(fragments, jnp.asarray(VALUES), mode=mode, fine=fine)
    for ours, plain in zip(got, (q.ddx(image, fine=fine), q.ddy(image, fine=fine)), strict=True):
        np.testing.assert_allclose(np.asarray(ours)[whole], np.asarray(plain)[whole], atol=3e-6)
    assert (np.asarray(got[0])[~np.asarray(fragments.coverage)] == 0).all()


def test_derivatives_are_linear_in_the_attributes():
    """The gradient to the attributes, empty samples and a degenerate first triangle included, is finite and exact."""
    clip = ndc([(-0.9, -0.9), (0.9, -0.8), (0.0, 0.9), (-0.9, -0.9)])
    fragments = rasterize(jnp.asarray(clip), jnp.asarray([[0, 3, 0], [0, 1, 2]]), height=9, width=9)
    total = lambda a: sum(jnp.sum(d * (k + 1.5)) for k, d in enumerate(q.quad_derivatives(fragments, a)))  # noqa: E731
    at = jnp.asarray(VALUES)
    slope = np.asarray(jax.grad(total)(at))
    assert np.isfinite(slope).all()
    np.testing.assert_allclose((slope * VALUES).sum(), float(total(at)), rtol=1e-4)


def test_bad_options():
    fragments = two_triangles(height=4, width=4)
    with pytest.raises(ValueError, match="mode: expected one of"):
        q.quad_derivatives(fragments, jnp.asarray(VALUES), mode="linear")
    with pytest.raises(ValueError, match="num_sizes: expected a value >= 1"):
        q.helper_share_by_size(jnp.zeros(1, jnp.int32), jnp.zeros(1, jnp.int32), num_sizes=0)
