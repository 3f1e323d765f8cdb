"""Quads against brute force over exact coverage, hand-counted triangles, and derivatives of planes."""

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred import quads as q
from jaxrender.deferred.raster import rasterize
from jaxrender.deferred.samples import CENTER, ordered_grid, standard_pattern
from tests.deferred import oracle
from tests.deferred.test_raster import ndc, perspective, soup

# The package has a function of that name.
ip = importlib.import_module("jaxrender.deferred.interpolate")

LAYOUTS = {"center": CENTER, "grid3": ordered_grid(3), "msaa8": standard_pattern(8)}
# Compiling is nearly all of the time here.
_FAST = {"xla_backend_optimization_level": 0}
quad_derivatives = jax.jit(q.quad_derivatives, static_argnames=("mode", "fine"), compiler_options=_FAST)
attribute_gradients = jax.jit(ip.attribute_gradients, compiler_options=_FAST)
interpolate = jax.jit(ip.interpolate, static_argnames="mode", compiler_options=_FAST)


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
def test_coverage_is_that_of_brute_force(rng, name, monkeypatch):
    """150 triangles over each other, in part outside, on an odd image that no tile divides; more than one chunk."""
    monkeypatch.setattr(q, "_CHUNK", 512)
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


def test_helper_share_by_size(rng):
    """3/4 for triangles of a pixel, nothing for one over the whole image, and less with size in between.

    8 x 8 triangles around a pixel centre of an own quad, one over everything, and right-angled ones of 4, 16 and 32 px.
    """
    center = np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 1, 2) * 2 + 0.5
    tiny = center + np.array([[-0.4, -0.3], [0.4, -0.3], [0.0, 0.4]])
    whole = np.array([[[-1.0, -1.0], [140.0, -1.0], [-1.0, 140.0]]])
    corner = np.array([[0, 0], [1, 0], [0, 1]])
    sides = [rng.uniform(0, 64 - side, (20, 1, 2)) + corner * side for side in (4, 16, 32)]
    corners = np.concatenate([tiny, whole, *sides]).reshape(-1, 2)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    clip = ndc(at_px(corners, height=64, width=64))
    fragments = rasterize(jnp.asarray(clip), jnp.asarray(faces), height=64, width=64)
    quads = q.quad_coverage(fragments)
    statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=len(faces))
    share = np.asarray(q.helper_share(statistics.pixels, statistics.quads))
    assert (share[:64] == 0.75).all()
    assert int(statistics.pixels[64]) == 64 * 64 and int(statistics.quads[64]) == 32 * 32 and share[64] == 0.0
    means = [share[65 + 20 * k : 85 + 20 * k].mean() for k in range(3)]
    # The cut quads lie along 2 + √2 sides of length s, the area is s²/2: about 3.4/s of the lanes at large s.
    assert 0.6 > means[0] > 0.3 > means[1] > 0.15 > means[2] > 0.05
    by_size, number = q.helper_share_by_size(statistics.pixels, statistics.quads, num_sizes=14)
    assert int(number.sum()) == len(faces) and number[0] == 64 and number[12] == 1
    assert by_size[0] == 0.75 and by_size[12] == 0.0 and by_size[13] == 0.0


def test_the_documents_small_triangle():
    """Pipeline part 8: it meets four quads, covers one pixel in each of three of them, and none of the fourth."""
    # Pixel centres (1.5, 1.5), (2.5, 1.5) and (1.5, 2.5) lie inside, (2.5, 2.5) does not.
    clip = ndc(at_px([(1.2, 1.2), (2.9, 1.4), (1.4, 2.9)], height=4, width=4))
    fragments = rasterize(jnp.asarray(clip), jnp.asarray([[0, 1, 2]]), height=4, width=4)
    quads = q.quad_coverage(fragments)
    assert as_table(quads) == {(0, 0, 0): 8, (0, 0, 1): 4, (0, 1, 0): 2}
    assert q.quad_overdraw(quads.row, quads.column, rows=2, columns=2).tolist() == [[1, 1], [1, 0]]


def test_a_triangle_through_the_camera_plane_counts_for_its_source():
    """Cut at the near plane into several: each has quads of its own, all belong to triangle 0, none is lost."""
    points = np.array([[-40.0, -1.0, -90.0], [40.0, -1.0, -90.0], [0.0, -1.0, 30.0]])
    fragments = rasterize(jnp.asarray(perspective(points, far=200.0)), jnp.asarray([[0, 1, 2]]), height=20, width=20)
    quads = q.quad_coverage(fragments)
    assert len(np.unique(quads.screen_id)) > 1 and (np.asarray(quads.triangle_id) == 0).all()
    statistics = q.quad_statistics(quads.triangle_id, quads.mask, num_triangles=1)
    assert int(statistics.pixels[0]) == int(fragments.coverage.sum()) > 100
    assert len(q.visible_quads(fragments, quads).mask) == len(quads.mask)


def test_nothing_to_draw():
    fragments = rasterize(jnp.zeros((1, 4)), jnp.zeros((0, 3), jnp.int32), height=1, width=5)
    quads = q.quad_coverage(fragments)
    assert len(quads.mask) == 0 and (quads.rows, quads.columns) == (1, 3)
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


@pytest.mark.parametrize(
    ("shape", "fine"), [((1, 1), True), ((5, 7, 2), True), ((4, 6, 2, 3), False), ((0, 3), False), ((1, 8), False)]
)
def test_differences_of_a_plane(shape, fine):
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    plane = (3 * x - 2 * y).reshape(*shape[:2], *(1,) * (len(shape) - 2)) * np.ones(shape, np.float32)
    dx, dy = (np.asarray(jax.jit(f, static_argnames="fine")(jnp.asarray(plane), fine=fine)) for f in (q.ddx, q.ddy))
    assert dx.shape == dy.shape == shape
    even = shape[0] // 2 * 2, shape[1] // 2 * 2
    assert (dx[:, : even[1]] == 3).all() and (dx[:, even[1] :] == 0).all()
    assert (dy[: even[0]] == -2).all() and (dy[even[0] :] == 0).all()


VALUES = np.array([[1.0, -2.0], [4.0, 0.5], [-1.0, 3.0], [2.0, 2.0]], np.float32)


@functools.cache
def two_triangles(samples=CENTER, w=(0.7, 3.0, 1.3, 2.0), *, height, width):
    """An edge through the image, with attributes that jump there unless triangles are kept apart."""
    xy, w = np.array([(-0.8, -0.7), (0.9, -0.4), (-0.1, 0.85), (0.95, 0.9)]), np.array(w)
    clip = np.concatenate([xy * w[:, None], 0.5 * w[:, None], w[:, None]], axis=1).astype(np.float32)
    return rasterize(
        jnp.asarray(clip), jnp.asarray([[0, 1, 2], [2, 1, 3]]), height=height, width=width, samples=samples
    )


@pytest.mark.parametrize(("name", "fine"), [("center", True), ("grid3", False)])
def test_linear_attributes_have_their_exact_derivative_up_to_the_silhouette(name, fine):
    """With one w the attribute is a plane: helper lanes carry it on, and differences equal derivatives everywhere."""
    fragments = two_triangles(LAYOUTS[name], w=(1.0, 1.0, 1.0, 1.0), height=19, width=23)
    assert (np.asarray(fragments.triangle_id) == 1).sum() > 50
    got = quad_derivatives(fragments, jnp.asarray(VALUES), fine=fine)
    for ours, exact in zip(got, attribute_gradients(fragments, jnp.asarray(VALUES)), strict=True):
        np.testing.assert_allclose(ours, exact, atol=2e-5)


def test_perspective_differences_approach_the_derivative():
    """A difference over a pixel is a derivative up to second order: three times the pixels, a third of the error."""
    errors = []
    for scale in (1, 3):
        fragments = two_triangles(height=19 * scale, width=23 * scale)
        got = quad_derivatives(fragments, jnp.asarray(VALUES))
        exact = attribute_gradients(fragments, jnp.asarray(VALUES))
        scaled = [scale * np.abs(np.asarray(a) - np.asarray(b)) for a, b in zip(got, exact, strict=True)]
        errors.append(np.mean([e[np.asarray(fragments.coverage)].mean() for e in scaled]))
    assert 2.3 < errors[0] / errors[1] < 3.7


@pytest.mark.parametrize(("mode", "fine"), [("perspective", True), ("noperspective", False), ("flat_last", True)])
def test_inside_a_triangle_they_are_the_plain_differences(mode, fine):
    """Where one triangle holds the whole quad, the helper-lane rule and `ddx` of the interpolated image agree."""
    fragments = two_triangles(height=19, width=23)
    ids = np.asarray(fragments.triangle_id)[:18, :22, 0].reshape(9, 2, 11, 2)
    same = (ids == ids[:, :1, :, :1]).all(axis=(1, 3)) & (ids[:, 0, :, 0] >= 0)
    whole = same.repeat(2, axis=0).repeat(2, axis=1)
    assert whole.sum() > 80
    whole = np.pad(whole, ((0, 1), (0, 1)))
    image = interpolate(fragments, jnp.asarray(VALUES), mode=mode)
    got = quad_derivatives(fragments, jnp.asarray(VALUES), mode=mode, fine=fine)
    for ours, plain in zip(got, (q.ddx(image, fine=fine), q.ddy(image, fine=fine)), strict=True):
        np.testing.assert_allclose(np.asarray(ours)[whole], np.asarray(plain)[whole], atol=3e-6)
    assert (np.asarray(got[0])[~np.asarray(fragments.coverage)] == 0).all()


def test_derivatives_are_linear_in_the_attributes():
    """The gradient to the attributes, empty samples and a degenerate first triangle included, is finite and exact."""
    clip = ndc([(-0.9, -0.9), (0.9, -0.8), (0.0, 0.9), (-0.9, -0.9)])
    fragments = rasterize(jnp.asarray(clip), jnp.asarray([[0, 3, 0], [0, 1, 2]]), height=9, width=9)
    total = lambda a: sum(jnp.sum(d * (k + 1.5)) for k, d in enumerate(q.quad_derivatives(fragments, a)))  # noqa: E731
    at = jnp.asarray(VALUES)
    value, slope = (np.asarray(x) for x in jax.jit(jax.value_and_grad(total), compiler_options=_FAST)(at))
    assert np.isfinite(slope).all()
    np.testing.assert_allclose((slope * VALUES).sum(), value, rtol=1e-4)


def test_bad_options():
    fragments = two_triangles(height=19, width=23)
    with pytest.raises(ValueError, match="mode: expected one of"):
        q.quad_derivatives(fragments, jnp.asarray(VALUES), mode="linear")
    with pytest.raises(ValueError, match="num_sizes: expected a value >= 1"):
        q.helper_share_by_size(jnp.zeros(1, jnp.int32), jnp.zeros(1, jnp.int32), num_sizes=0)
