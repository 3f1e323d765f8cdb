"""Where and how values are interpolated, and their derivatives, beside Mesa's llvmpipe.

Corners lie on the grid that they are snapped to, so that snapping is no difference: llvmpipe does it for coverage only,
jaxrender for interpolation as well. Each triangle has a depth of its own, so that both sides see the same triangles
everywhere. Then what remains is rounding: `Plane.rounding` says how much of it there is at a sample.

Nothing is flipped on the way (`benchmarks.llvmpipe`): OpenGL's upward y is our downward y in the same memory, hence the
same quads, at odd sizes too, the same sample positions, and derivatives of the same sign.

What llvmpipe 22.3 does: its 4 samples are the standard ones. Centroid is Direct3D's rule, over the samples that passed
the depth test when the triangle was drawn. At samples and centroids it divides perspective-correct values by the 1/w of
the pixel's centre; the fourth component is 1 at all corners here, and dividing by it takes that out. All its
derivatives are fine ones. Noperspective values are wrong or NaN where the near plane and the border cut a triangle.
"""

import functools
import importlib
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.deferred.quads import ddx, ddy, quad_derivatives
from jaxrender.deferred.raster import rasterize
from jaxrender.deferred.samples import CENTER, standard_pattern
from tests.deferred import oracle
from tests.deferred.test_raster import perspective, soup
from tests.support import llvmpipe

# The package has a function of that name.
ip = importlib.import_module("jaxrender.deferred.interpolate")

SIZE = {"height": 47, "width": 63}
# Triangles of every scene, so that the rasteriser is compiled for few shapes.
NUM = 80
FOUR = standard_pattern(4)
VARYINGS = {"perspective": "smooth_value", "noperspective": "linear_value", "flat_last": "flat_value"}
# What each side may lose in set-up and evaluation: four roundings of the largest term.
ROUNDINGS = 8 * 2.0**-24
# How far snapping moves a corner at most.
SNAP_PX = np.sqrt(2.0) / 512


@pytest.fixture(scope="module", autouse=True)
def gl():
    return llvmpipe.context()


# --- Triangles


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles with vec4 values; equal only to itself, so that what is seen of it is kept."""

    clip: np.ndarray
    faces: np.ndarray
    values: np.ndarray

    def seen(self, samples=CENTER):
        return seen(self, samples)

    def drawn(self, samples=1, **options):
        """Ids and the three images, (h, w, s) and (h, w, s, 4)."""
        ids, _, images = llvmpipe.draw(self.clip, self.faces, **SIZE, values=self.values, samples=samples, **options)
        shape = (*SIZE.values(), samples)
        return ids.reshape(shape), [image.reshape(*shape, 4) for image in images]


@functools.cache
def seen(scene, samples):
    return rasterize(jnp.asarray(scene.clip), jnp.asarray(scene.faces), **SIZE, samples=samples)


def on_grid(rng, corners_px, depths):
    """Triangles with corners on the snapping grid, inside the picture, at one depth each and uneven w."""
    size = np.array([SIZE["width"], SIZE["height"]])
    xy = np.round(np.clip(corners_px, 0.5, size - 0.5) * 256)
    a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    whole = a[:, 0] * b[:, 1] != a[:, 1] * b[:, 0]
    xy, depths = xy[whole], depths[whole]
    # Powers of two: no rounding in x w / w.
    w = 2.0 ** rng.integers(-1, 3, (len(xy), 3))
    ndc = (xy / 128 / size - 1) * [1, -1]
    clip = np.concatenate([ndc * w[..., None], (depths[:, None] * w)[..., None], w[..., None]], axis=-1)
    clip = clip.reshape(-1, 4).astype(np.float32)
    values = rng.normal(size=(len(clip), 4)).astype(np.float32)
    values[:, 3] = 1.0
    return Scene(clip, np.arange(len(clip)).reshape(-1, 3).astype(np.int32), values)


@functools.cache
def overlapping():
    """Sixty triangles of all sizes and twenty slivers a few tenths of a pixel wide."""
    rng = np.random.default_rng(20081)
    size = SIZE["width"], SIZE["height"]
    around = rng.normal(size=(60, 3, 2)) * 24 * rng.uniform(0.02, 1, (60, 1, 1))
    ends = rng.uniform(0, size, (20, 2, 2))
    middle = ends.mean(axis=1, keepdims=True) + rng.normal(size=(20, 1, 2)) * 0.15
    corners = np.concatenate([rng.uniform(0, size, (60, 1, 2)) + around, np.concatenate([ends, middle], axis=1)])
    # Slivers in front of half of the rest.
    depths = np.concatenate([rng.permutation(np.linspace(0.2, 0.9, 60)), rng.permutation(np.linspace(0.4, 0.5, 20))])
    return on_grid(rng, corners, depths)


@functools.cache
def side_by_side():
    """A jittered grid of triangles that share edges: no sample is covered twice."""
    rng = np.random.default_rng(20082)
    x, y = np.linspace(0.5, SIZE["width"] - 0.5, 9), np.linspace(0.5, SIZE["height"] - 0.5, 6)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    points[1:-1, 1:-1] += rng.uniform(-2, 2, (4, 7, 2))
    quads = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], axis=2).reshape(-1, 4, 2)
    corners = np.concatenate([quads[:, [0, 1, 2]], quads[:, [2, 3, 0]]])
    return on_grid(rng, corners, np.full(len(corners), 0.5))


def same_triangles(fragments, ids):
    """The covered samples; both sides see the same triangle at each."""
    np.testing.assert_array_equal(np.asarray(fragments.triangle_id), ids)
    assert (ids >= 0).mean() > 0.5
    return ids >= 0


def places_px(fragments, places=None):
    """Sample places, or those given in snapped units, in pixels from the upper left corner of the image."""
    middle = SIZE["width"] / 2, SIZE["height"] / 2
    return [np.asarray(at) / 256 + half for at, half in zip(places or ip.sample_places(fragments), middle, strict=True)]


# --- Their float64 planes


class Plane:
    """Values of the triangles `ids` at (x, y) px, from unsnapped corners in float64, and what may be lost of them.

    Perspective-correct values are the quotient of two planes, of A/w and of 1/w; others of A and of 1.

    Attributes:
      value: the exact ones.
      rounding: what float32 may lose, `ROUNDINGS` of the largest terms: a plane is a sum of slope times position.
      per_px: the most that values change in a pixel; times `SNAP_PX`, it is what snapped corners may change inside.
    """

    def __init__(self, scene, values, ids, x, y, mode):
        """At NDC (X, Y), Σ λ_k (x, y, w)_k = (X, Y, 1) gives λ_k, the weight of corner k over w there."""
        width, height = SIZE["width"], SIZE["height"]
        corners = scene.clip.astype(np.float64)[scene.faces][..., [0, 1, 3]]
        if mode == "noperspective":
            corners = corners / corners[..., 2:]
        wanted = np.concatenate([values.astype(np.float64)[scene.faces], np.ones((len(corners), 3, 1))], axis=-1)
        used = np.unique(np.maximum(ids, 0))
        planes = np.zeros_like(wanted)
        planes[used] = np.linalg.solve(corners[used], wanted[used])
        right, up, middle = np.moveaxis(planes[np.maximum(ids, 0)], -2, 0)
        at = middle + right * (2 * x / width - 1)[..., None] + up * (1 - 2 * y / height)[..., None]
        slope = np.hypot(right * 2 / width, up * 2 / height)
        self.value = at[..., :-1] / at[..., -1:]
        mixed = lambda terms: (terms[..., :-1] + np.abs(self.value) * terms[..., -1:]) / np.abs(at[..., -1:])  # noqa: E731
        self.per_px = mixed(slope)
        self.rounding = ROUNDINGS * mixed(np.abs(at) + slope * max(width, height))
        if mode == "noperspective":
            # jaxrender turns perspective-correct weights back, each times its w: their rounding grows with it.
            w = np.abs(scene.clip[:, 3][scene.faces])
            self.rounding = self.rounding * (w.max(axis=1) / w.min(axis=1))[np.maximum(ids, 0)][..., None]


def check(ours, theirs, plane, where, *, snap_px=0.0):
    """Two images agree at the samples `where`, within rounding and the snapping of corners."""
    difference, allowed = np.abs(np.asarray(ours) - theirs), plane.rounding + snap_px * plane.per_px
    assert np.isfinite(theirs[where]).all()
    assert where.sum() > 100
    worst = np.max((difference / allowed)[where])
    assert worst <= 1, f"{worst} times what is allowed"


def unbiased(image):
    """The image divided by its fourth component, which is 1 at all corners (see the top of the file)."""
    return image / np.where(image[..., 3:] == 0, 1, image[..., 3:])


# --- At samples


def test_sample_positions_are_the_standard_ones():
    ids, (found, _, _) = side_by_side().drawn(4, body="first = vec4(gl_SamplePosition, 0, 0);")
    covered = np.broadcast_to(FOUR.positions_px, (*ids.shape, 2))[ids >= 0]
    np.testing.assert_array_equal(found[..., :2][ids >= 0], covered)


def test_ids_and_depth_at_samples(rng):
    """Triangles of any corners that intersect in depth."""
    clip, faces = soup(rng, NUM)
    scene = Scene(clip, faces, np.zeros_like(clip))
    fragments = scene.seen(FOUR)
    ids, depth, _ = llvmpipe.draw(clip, faces, **SIZE, samples=4)
    mine = np.asarray(fragments.triangle_id)
    exact, _, _ = oracle.rasterize(clip, faces, **SIZE, positions_px=FOUR.positions_px)
    # Where they differ, float64 depth is the judge: llvmpipe's planes do not see the snapped corners.
    differ = mine != ids
    assert differ.mean() < 1e-3
    assert (mine[differ] == exact[differ]).all()
    plane = Plane(scene, clip[:, 2:3] / clip[:, 3:], ids, *places_px(fragments), "noperspective")
    check(fragments.depth[..., None], depth[..., None], plane, ~differ & (ids >= 0), snap_px=SNAP_PX)


@pytest.mark.parametrize("mode", VARYINGS)
def test_values_at_samples(mode):
    scene = overlapping()
    fragments = scene.seen(FOUR)
    ids, (theirs, _, _) = scene.drawn(4, place="sample", body=f"first = {VARYINGS[mode]};")
    where = same_triangles(fragments, ids)
    ours = np.asarray(ip.interpolate(fragments, jnp.asarray(scene.values), mode=mode))
    if mode == "flat_last":
        np.testing.assert_array_equal(ours[where], theirs[where])
    else:
        plane = Plane(scene, scene.values, ids, *places_px(fragments), mode)
        check(ours, unbiased(theirs), plane, where)


# --- At the centroid


def raster_coverage(scene, ids):
    """(h, w, s, s): which samples of the pixel lie in the triangle that each sample sees, hidden or not."""
    xy = oracle.snap(scene.clip, **SIZE)
    at = oracle.sample_positions(*SIZE.values(), FOUR.positions_px).astype(np.int64)
    each = np.stack([oracle.covers(xy[face], at)[0] for face in scene.faces])
    row, column = np.indices(ids.shape[:2])
    return each[np.maximum(ids, 0), row[..., None], column[..., None]]


def centroids_of_both(scene):
    """Ids, and where each side evaluates: ours, and theirs read off a value that is the place itself."""
    fragments = scene.seen(FOUR)
    ndc = scene.clip[:, :2] / scene.clip[:, 3:]
    places = np.zeros_like(scene.values)
    places[:, :2] = (ndc * [1, -1] + 1) / 2 * [SIZE["width"], SIZE["height"]]
    ids, (_, theirs, _) = Scene(scene.clip, scene.faces, places).drawn(4, place="centroid")
    same_triangles(fragments, ids)
    # Places are whole sixteenths of a pixel; those read are off by the rounding of a plane, less than 1e-2 px.
    read = np.round(theirs[..., :2] * 16) / 16
    assert np.abs(read - theirs[..., :2])[ids >= 0].max() < 1e-2
    return ids, np.stack(places_px(fragments, ip.centroids(fragments)), axis=-1), read


@pytest.mark.parametrize("mode", ["perspective", "noperspective"])
@pytest.mark.parametrize("name", ["side_by_side", "overlapping"])
def test_centroids(name, mode):
    """The same place and value wherever nothing hides a part of what the triangle covers of the pixel."""
    scene = {"side_by_side": side_by_side, "overlapping": overlapping}[name]()
    fragments = scene.seen(FOUR)
    ids, ours, theirs = centroids_of_both(scene)
    whole = raster_coverage(scene, ids)
    visible = ids[..., None] == ids[..., None, :]
    same_rule = (ids >= 0) & (whole == visible).all(axis=-1)
    assert (same_rule & ~whole.all(axis=-1)).sum() > 1000
    # Direct3D's rule is to the letter what both do: the centre, or the first covered sample.
    np.testing.assert_array_equal(ours[same_rule], theirs[same_rule])
    _, images = scene.drawn(4, place="centroid")
    image = unbiased(images[0]) if mode == "perspective" else images[1]
    values = ip.interpolate_at_centroid(fragments, jnp.asarray(scene.values), mode=mode)
    plane = Plane(scene, scene.values, ids, ours[..., 0], ours[..., 1], mode)
    check(values, image, plane, same_rule)
    if name == "side_by_side":
        assert same_rule[ids >= 0].all()


def test_centroids_of_half_hidden_triangles_lie_in_what_they_cover():
    """Here rules differ: jaxrender's triangle covers what is visible of it, theirs what was when it was drawn.

    OpenGL only asks for a place in the pixel and the triangle. So: either a covered sample, or the centre of a pixel
    all samples of which are covered.
    """
    scene = overlapping()
    ids, ours, theirs = centroids_of_both(scene)
    whole = raster_coverage(scene, ids)
    visible = ids[..., None] == ids[..., None, :]
    hidden = (ids >= 0) & (whole != visible).any(axis=-1)
    assert hidden.sum() > 500
    row, column = np.indices(ids.shape[:2])
    corner = np.stack([column, row], axis=-1)[:, :, None]
    samples = (corner + FOUR.positions_px)[:, :, None]
    for places, covered in ((ours, visible), (theirs, whole)):
        at_sample = (covered & (places[..., None, :] == samples).all(axis=-1)).any(axis=-1)
        at_center = covered.all(axis=-1) & (places == corner + 0.5).all(axis=-1)
        assert (at_sample | at_center)[hidden].all()


# --- Triangles that the near plane cuts


@pytest.mark.parametrize("samples", [1, 4])
def test_values_of_triangles_cut_by_the_near_plane(rng, samples):
    """Perspective-correct and flat, most triangles with corners behind the eye; they are cut at the border too."""
    corners = rng.uniform(-2, 2, (NUM, 3, 3)) + [0, 0, -0.6]
    # Else two large ones hide all others.
    corners[:50] -= [0, 0, 2]
    clip = perspective(corners.reshape(-1, 3))
    values = rng.normal(size=(len(clip), 4)).astype(np.float32)
    values[:, 3] = 1.0
    scene = Scene(clip, np.arange(3 * NUM).reshape(-1, 3).astype(np.int32), values)
    fragments = scene.seen(FOUR if samples == 4 else CENTER)
    ids, (smooth, _, flat) = scene.drawn(samples, place="sample" if samples == 4 else "")
    where = (ids >= 0) & (ids == np.asarray(fragments.triangle_id))
    # They snap a cut corner where their own clipper puts it.
    assert where.mean() > 0.998 * (ids >= 0).mean()
    cut = where & (clip[:, 2].reshape(-1, 3) < 0).any(axis=1)[np.maximum(ids, 0)]
    behind = (clip[:, 3].reshape(-1, 3) < 0).any(axis=1)[np.maximum(ids, 0)]
    assert len(np.unique(ids[cut])) >= 8 and (cut & behind).sum() > 1000
    ours = ip.interpolate(fragments, jnp.asarray(values))
    plane = Plane(scene, values, ids, *places_px(fragments), "perspective")
    check(ours, unbiased(smooth), plane, where, snap_px=SNAP_PX)
    ours = np.asarray(ip.interpolate(fragments, jnp.asarray(values), mode="flat_last"))
    np.testing.assert_array_equal(ours[where], flat[where])


def test_noperspective_values_of_triangles_cut_by_the_near_plane(rng):
    """Corners between the eye and the near plane, and inside the picture: elsewhere they have no numbers."""
    ndc, w = rng.uniform(-0.98, 0.98, (NUM, 3, 2)), rng.uniform(0.3, 4.0, (NUM, 3))
    near, far = 1.0, 50.0
    z = far / (far - near) * (w - near)
    clip = np.concatenate([ndc * w[..., None], z[..., None], w[..., None]], axis=-1).reshape(-1, 4).astype(np.float32)
    values = rng.normal(size=(len(clip), 4)).astype(np.float32)
    scene = Scene(clip, np.arange(3 * NUM).reshape(-1, 3).astype(np.int32), values)
    fragments = scene.seen()
    ids, (_, linear, _) = scene.drawn()
    where = (ids >= 0) & (ids == np.asarray(fragments.triangle_id))
    assert where.mean() > 0.998 * (ids >= 0).mean()
    cut = where & (clip[:, 2].reshape(-1, 3) < 0).any(axis=1)[np.maximum(ids, 0)]
    assert cut.sum() > 1000
    ours = ip.interpolate(fragments, jnp.asarray(values), mode="noperspective")
    plane = Plane(scene, values, ids, *places_px(fragments), "noperspective")
    check(ours, linear, plane, where, snap_px=SNAP_PX)


# --- Derivatives


class Steps:
    """Planes at the two ends of a difference in each sample's quad: the rounding of both counts."""

    def __init__(self, scene, ids, x, y, mode, axis, *, fine=True):
        left, top = x - np.floor(x) % 2, y - np.floor(y) % 2
        across, down = (left + 1, y if fine else top), (x if fine else left, top + 1)
        ends = ((left, across[1]), across) if axis == 0 else ((down[0], top), down)
        self.planes = [Plane(scene, scene.values, ids, *end, mode) for end in ends]
        self.rounding = sum(plane.rounding for plane in self.planes)
        self.value = self.planes[1].value - self.planes[0].value
        self.per_px = 0.0


def silhouettes(ids):
    """Covered samples whose quad holds another triangle, or nothing, or is cut by the border: it has helper lanes."""
    h, w, s = ids.shape
    quads = np.pad(ids, ((0, h % 2), (0, w % 2), (0, 0)), constant_values=-1)
    quads = quads.reshape((h + 1) // 2, 2, (w + 1) // 2, 2, s)
    mixed = (quads != quads[:, :1, :, :1]).any(axis=(1, 3))
    return mixed.repeat(2, axis=0).repeat(2, axis=1)[:h, :w] & (ids >= 0)


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("mode", VARYINGS)
def test_fine_derivatives_of_attributes(mode, samples):
    """Every difference, helper lanes included, some of which lie where a triangle's 1/w is nearly 0."""
    scene = overlapping()
    fragments = scene.seen(FOUR if samples == 4 else CENTER)
    value = f"({VARYINGS[mode]} / {VARYINGS[mode]}.w)"
    ids, theirs = scene.drawn(
        samples,
        place="sample" if samples == 4 else "",
        body=f"first = {value}; second = dFdxFine({value}); third = dFdyFine({value});",
    )
    where = same_triangles(fragments, ids)
    assert silhouettes(ids).sum() > 900 * samples
    ours = quad_derivatives(fragments, jnp.asarray(scene.values), mode=mode)
    for axis in (0, 1):
        if mode == "flat_last":
            assert (np.asarray(ours[axis])[where] == 0).all() and (theirs[1 + axis][where] == 0).all()
        else:
            steps = Steps(scene, ids, *places_px(fragments), mode, axis)
            check(ours[axis], theirs[1 + axis], steps, where)
            # What is compared is far above rounding.
            assert np.median(np.abs(steps.value)[where]) > 100 * np.median(steps.rounding[where])


def test_coarse_derivatives_of_attributes():
    """Ours are the fine ones of the top row and the left column, whose pixels the triangle need not cover."""
    scene = overlapping()
    fragments = scene.seen()
    ids, (_, right, down) = scene.drawn(body=llvmpipe.DERIVATIVES)
    where = same_triangles(fragments, ids)
    ours = quad_derivatives(fragments, jnp.asarray(scene.values), fine=False)
    row, column = np.indices(ids.shape[:2])
    for axis, theirs, lane in ((0, right, (row // 2 * 2, column)), (1, down, (row, column // 2 * 2))):
        covered = where & (ids[lane] == ids)
        steps = Steps(scene, ids, *places_px(fragments), "perspective", axis, fine=False)
        check(ours[axis], theirs[lane], steps, covered)


# Rational, so that both sides round it the same few times; its slopes are known.
EXPRESSION = "vec4(v.x * v.y / (1.0 + v.z * v.z))"


def expression(v):
    return (v[..., 0] * v[..., 1] / (1.0 + v[..., 2] * v[..., 2]))[..., None]


class ExpressionSteps:
    """`Steps` of the expression: first-order rounding of its arguments, and a few roundings of its own."""

    def __init__(self, scene, ids, x, y, axis):
        self.rounding = 0.0
        for plane in Steps(scene, ids, x, y, "perspective", axis).planes:
            a, b, c = np.moveaxis(plane.value[..., :3], -1, 0)
            f = expression(plane.value)
            bend = 1.0 + c * c
            slopes = np.stack([np.abs(b) / bend, np.abs(a) / bend, np.abs(2 * a * b * c) / bend**2], axis=-1)
            own = (plane.rounding[..., :3] * slopes).sum(axis=-1, keepdims=True)
            self.rounding = self.rounding + own + ROUNDINGS * np.abs(f)
        self.per_px = 0.0


def drawn_expression(scene):
    body = f"vec4 v = smooth_value; vec4 f = {EXPRESSION}; first = f; second = dFdxFine(f); third = dFdyFine(f);"
    ids, images = scene.drawn(body=body)
    return ids, [image[..., :1] for image in images]


def test_derivatives_of_an_expression():
    """`ddx` and `ddy` of the image of it, in the quads that one triangle holds."""
    scene = overlapping()
    fragments = scene.seen()
    ids, (_, *theirs) = drawn_expression(scene)
    whole = same_triangles(fragments, ids) & ~silhouettes(ids)
    image = expression(ip.interpolate(fragments, jnp.asarray(scene.values)))
    for axis, difference in enumerate((ddx, ddy)):
        steps = ExpressionSteps(scene, ids, *places_px(fragments), axis)
        check(difference(image), theirs[axis], steps, whole)


def test_derivatives_of_an_expression_at_silhouettes():
    """With the expression evaluated in the helper lanes as well: attributes go on, then the expression, then `ddx`."""
    scene = overlapping()
    fragments = scene.seen()
    ids, (_, *theirs) = drawn_expression(scene)
    same_triangles(fragments, ids)
    where = silhouettes(ids)
    assert where.sum() > 900
    x, y = ip.sample_places(fragments)
    px, py = places_px(fragments)
    for axis, (step_x, step_y) in enumerate(((256, 0), (0, 256))):
        first = np.floor((px, py)[axis]).astype(np.int32) % 2 * 256
        x0, y0 = (x - first, y) if axis == 0 else (x, y - first)
        ends = [ip.weights_at(fragments, x0 + i * step_x, y0 + i * step_y) for i in (0, 1)]
        low, high = (expression(ip.blend(fragments, jnp.asarray(scene.values), end)) for end in ends)
        check(high - low, theirs[axis], ExpressionSteps(scene, ids, px, py, axis), where)
