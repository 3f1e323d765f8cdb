"""The whole way of adaptive supersampling: against the reference, a larger picture, and other sources."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.checks import InputError
from jaxrender.deferred import (
    Clusters,
    Lighting,
    QuadBudget,
    SampleMetrics,
    Uniform,
    canvas,
    draw_gbuffer,
    fit_budget,
    fit_psnr,
    gbuffer_from_layers,
    gbuffer_layers,
    gbuffer_view,
    group_samples,
    ordered_grid,
    picture_psnr,
    render_adaptive,
    render_scene,
    render_supersampled,
    resolve_samples,
    scene_material_textures,
    scene_textures,
    scene_view,
    see,
    shade_adaptive,
    shade_adaptive_within,
    supersample,
)
from jaxrender.deferred.material_textures import MaterialTextures, material_slots
from jaxrender.io import read_exr_layers, write_exr
from jaxrender.io.builtin_scene import builtin_scene
from jaxrender.io.layer_names import known_layers
from jaxrender.scene import whole_scene_camera

SIZE = {"height": 36, "width": 48}
# Where compiling is nearly all of the time.
QUICKLY = {"xla_backend_optimization_level": 0}


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(num_vertices=600)


@pytest.fixture(scope="module")
def camera(scene):
    whole = whole_scene_camera(scene, aspect=4 / 3)
    return dataclasses.replace(whole, fov_y_radians=0.5 * whole.fov_y_radians)


@pytest.fixture(scope="module")
def view(scene, camera):
    return scene_view(scene, camera, size=3, **SIZE)


@pytest.fixture(scope="module")
def reference(view):
    return supersample(*view)


def same(a, b) -> None:
    np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(a.alpha, b.alpha)


# --- The two ends


@pytest.mark.parametrize(
    "method",
    [
        Uniform(9),
        SampleMetrics(depth=None, normal=1e9, shading=None, scale=1.0),
        Clusters(normal=1e9, contrast=1e9, detail=1e9),
    ],
    ids=["uniform", "printed", "clusters"],
)
def test_all_samples_are_the_reference_bit_for_bit(view, reference, method):
    """Where every sub-sample is chosen, nothing tells the picture from full supersampling."""
    found = shade_adaptive(*view, method=method)
    n = view[0].covered.shape[-1]
    every = found.count == np.asarray(view[0].covered).sum(axis=-1)
    if isinstance(method, Uniform):
        assert every.all() and n == 9
    # Windows without any variation keep one sample, rightly.
    assert every[found.alpha > 0].mean() > 0.3
    np.testing.assert_array_equal(found.image[every], reference.image[every])


def test_all_metrics_off_are_one_sample_a_pixel(view):
    off = shade_adaptive(*view, method=SampleMetrics(depth=None, normal=None, shading=None))
    same(off, shade_adaptive(*view, method=Uniform(1)))
    assert off.num_shaded == np.count_nonzero(off.count) == np.count_nonzero(off.alpha)


def test_one_sub_sample_a_pixel_is_plain_deferred_shading(scene, camera):
    plain = render_scene(scene, camera, **SIZE)
    for picture in (
        render_supersampled(scene, camera, size=1, **SIZE),
        render_adaptive(scene, camera, size=1, **SIZE),
        render_adaptive(scene, camera, size=1, method=SampleMetrics(), **SIZE),
    ):
        assert picture.sample_share == 1.0
        np.testing.assert_allclose(picture.image, plain.image, atol=2e-5)
        np.testing.assert_array_equal(picture.alpha, plain.alpha)


def test_the_reference_is_a_larger_picture_made_smaller(scene, camera, reference):
    large = render_scene(scene, camera, height=3 * SIZE["height"], width=3 * SIZE["width"])
    blocks = lambda v: v.reshape(SIZE["height"], 3, SIZE["width"], 3, -1).sum(axis=(1, 3))  # noqa: E731
    radiance, share = blocks(large.image * large.alpha[..., None]), blocks(large.alpha)
    np.testing.assert_allclose(share[..., 0] / 9.0, reference.alpha, atol=1e-6)
    np.testing.assert_allclose(radiance / np.maximum(share, 1.0), reference.image, atol=5e-5)


# --- In between


def test_clusters_are_nearer_to_the_reference_than_as_many_samples_anywhere(view, reference):
    found = shade_adaptive(*view)
    assert found.sample_share < 0.75
    more = next(k for k in range(1, 10) if k / 9.0 >= found.sample_share)
    uniform = shade_adaptive(*view, method=Uniform(more))
    assert picture_psnr(found, reference) > picture_psnr(uniform, reference) + 3.0


def test_more_scale_is_more_samples_and_less_error(view, reference):
    pictures = [shade_adaptive(*view, method=Clusters(scale=scale)) for scale in (0.1, 0.5, 2.0, 10.0)]
    shares = [picture.sample_share for picture in pictures]
    errors = [-picture_psnr(picture, reference) for picture in pictures]
    assert shares == sorted(shares) and errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("strategy", ["tiled", "masked", "per_count", "sorted"])
def test_strategies_make_one_image(view, strategy):
    same(
        shade_adaptive(*view, method=SampleMetrics(), strategy=strategy), shade_adaptive(*view, method=SampleMetrics())
    )


def test_low_resolution_counts_are_the_largest_of_their_tile(view):
    fine = shade_adaptive(*view, method=SampleMetrics())
    coarse = shade_adaptive(*view, method=SampleMetrics(), strategy="low_resolution")
    tiles = fine.count[:36, :48].reshape(6, 6, 8, 6).max(axis=(1, 3)).repeat(6, 0).repeat(6, 1)
    covered = np.asarray(view[0].covered).sum(axis=-1)
    full = covered == 9
    assert (coarse.count >= fine.count).all()
    assert (coarse.count[full] >= tiles[full]).all()


def test_balanced_counts_only(view):
    found = shade_adaptive(*view, method=SampleMetrics(balanced=True))
    full = np.asarray(view[0].covered).all(axis=-1)
    assert set(np.unique(found.count[full])) <= {1, 5, 9}


def test_empty_sub_samples_are_never_shaded(view, reference):
    covered = np.asarray(view[0].covered)
    assert not covered.all(), "the view should show some background"
    for picture in (reference, shade_adaptive(*view), shade_adaptive(*view, method=SampleMetrics())):
        assert picture.num_covered == covered.sum()
        assert (picture.count <= covered.sum(axis=-1)).all()
        assert (picture.count[~covered.any(axis=-1)] == 0).all()
        assert np.isfinite(picture.image).all()
        np.testing.assert_allclose(picture.alpha, covered.mean(axis=-1), rtol=1e-6)


def test_an_empty_view(scene, camera):
    away = dataclasses.replace(camera, target=camera.eye + (camera.eye - camera.target))
    for method in (Clusters(), SampleMetrics(), Uniform(2)):
        picture = render_adaptive(scene, away, size=2, method=method, **SIZE)
        assert picture.num_shaded == 0 and not picture.image.any() and not picture.alpha.any()


def test_what_cannot_be_is_said(view, scene, camera):
    with pytest.raises(ValueError, match="strategy: expected one of compacted"):
        shade_adaptive(*view, method=SampleMetrics(), strategy="random")
    with pytest.raises(ValueError, match="compacted"):
        shade_adaptive(*view, strategy="sorted")
    with pytest.raises(ValueError, match="size"):
        render_adaptive(scene, camera, size=0, **SIZE)
    with pytest.raises(ValueError, match="count"):
        shade_adaptive(*view, method=Uniform(0))


# --- Beyond the paper


def test_a_quad_budget_is_spent_and_never_exceeded(view, reference):
    covered = np.asarray(view[0].covered)
    per_quad = covered.reshape(18, 2, 24, 2, 9).sum(axis=(1, 3, 4))
    for count in (4, 8, 20):
        found = shade_adaptive(*view, method=QuadBudget(count))
        assert found.num_shaded <= np.minimum(per_quad, count).sum()
        assert ((found.count > 0) == covered.any(axis=-1)).all()
        assert np.isfinite(found.image).all()
    # Where whole quads are covered, and no two sub-samples are at one place, it is spent to the last sample.
    assert found.num_shaded > 0.9 * np.minimum(per_quad, count).sum()
    worse = shade_adaptive(*view, method=Uniform(1))
    assert picture_psnr(found, reference) > picture_psnr(worse, reference) + 3.0


def test_a_budget_of_all_samples_is_the_reference(view, reference):
    same(shade_adaptive(*view, method=QuadBudget(36)), reference)


def test_quads_at_odd_borders(scene, camera):
    samples, lighting = scene_view(scene, camera, size=2, height=7, width=9)
    reference = supersample(samples, lighting)
    found = shade_adaptive(samples, lighting, method=QuadBudget(16))
    np.testing.assert_allclose(found.image, reference.image, atol=1e-6)
    with pytest.raises(ValueError, match="count: expected a number from 4 to 16, got 3"):
        shade_adaptive(samples, lighting, method=QuadBudget(3))


@pytest.mark.parametrize("method", [Clusters(), SampleMetrics()], ids=["clusters", "printed"])
def test_a_second_look_from_the_same_place_shades_less_again(view, reference, method):
    """What the frame before went by is believed: fewer samples are shaded twice, and none are missing."""
    one = shade_adaptive(*view, method=method)
    two = shade_adaptive(*view, method=method, previous=one)
    assert one.evidence.shape == (*one.count.shape, 2 if isinstance(method, Clusters) else 1)
    assert (two.evidence >= 0.8 * one.evidence - 1e-6).all()
    assert two.num_shaded - two.count.sum() < one.num_shaded - one.count.sum()
    assert picture_psnr(two, reference) > picture_psnr(one, reference) - 0.5
    with pytest.raises(ValueError, match="previous: expected a picture of"):
        other = dataclasses.replace(one, evidence=one.evidence[:4])
        shade_adaptive(*view, method=method, previous=other)


@pytest.mark.parametrize("method", [Clusters(), SampleMetrics()], ids=["clusters", "printed"])
def test_a_film_of_one_picture_settles(view, reference, method):
    """What a frame cannot measure, because it shades finely, must not be forgotten and found again in turns."""
    film = [shade_adaptive(*view, method=method)]
    for _ in range(11):
        film.append(shade_adaptive(*view, method=method, previous=film[-1]))
    quality = [picture_psnr(picture, reference) for picture in film]
    assert min(quality[1:]) > quality[0] - 0.5
    last = [picture.count for picture in film[-4:]]
    moved = [np.mean(a != b) for a, b in itertools.pairwise(last)]
    assert max(moved) < 0.05, moved
    assert film[-1].num_shaded < 1.1 * film[-1].count.sum()


@pytest.fixture
def nans_are_meant():
    """In all threads, unlike `jax.debug_nans`."""
    jax.config.update("jax_debug_nans", False)
    yield
    jax.config.update("jax_debug_nans", True)


@pytest.mark.usefixtures("nans_are_meant")
def test_what_is_not_a_number_stays_where_it_is(scene, camera):
    """One covered sub-sample of a G-buffer has lost its depth, its normal, and its position."""
    gbuffer = draw_gbuffer(scene, see(scene, camera, samples=ordered_grid(3), **SIZE))
    y, x = np.argwhere(np.asarray(gbuffer.coverage).all(axis=-1))[40]
    spoilt = dataclasses.replace(
        gbuffer, depth=gbuffer.depth.at[y, x, 2].set(jnp.nan), normal=gbuffer.normal.at[y, x, 2].set(jnp.nan),
        position=gbuffer.position.at[y, x, 2].set(jnp.nan),
    )  # fmt: skip
    _, lighting = scene_view(scene, camera, size=1, height=4, width=4)
    lighting = dataclasses.replace(lighting, textures=None, slots=())
    far_away = np.hypot(*np.ogrid[-y : SIZE["height"] - y, -x : SIZE["width"] - x]) > 2.0
    for method in (Clusters(), SampleMetrics(), Uniform(2)):
        whole, holed = (
            shade_adaptive(gbuffer_view(g, scene.material, size=3), lighting, method=method) for g in (gbuffer, spoilt)
        )
        np.testing.assert_allclose(holed.image[far_away], whole.image[far_away], atol=1e-5)
        np.testing.assert_array_equal(holed.count[far_away], whole.count[far_away])
        assert np.isfinite(holed.image[far_away]).all() and holed.count[y, x] >= 1


def test_lists_are_summed_as_the_kernel_does(view, rng):
    """What the canvas adds up in order of rows is `resolve_samples`."""
    drawn = canvas.Canvas(*view)
    pixel = rng.permutation(36 * 48)[:50].astype(np.int32)
    row = np.sort(rng.integers(0, 50, 300))
    radiance, weight = rng.uniform(0, 2, (300, 3)).astype(np.float32), rng.uniform(0, 1, 300).astype(np.float32)
    drawn.put(pixel, row, radiance, weight)
    arrays = jnp.asarray(radiance), jnp.asarray(weight), jnp.asarray(pixel[row])
    np.testing.assert_allclose(drawn.image, resolve_samples(*arrays, num_pixels=36 * 48), atol=1e-5)
    np.testing.assert_array_equal(drawn.count, np.bincount(pixel[row], minlength=36 * 48))


def test_large_pictures_are_listed_in_pieces(view, reference, monkeypatch):
    monkeypatch.setattr(canvas, "SUBSAMPLES_AT_ONCE", 9 * 500)
    same(supersample(*view), reference)


def test_settings_that_mean_nothing_are_refused(view):
    for method, name in ((Clusters(scale=float("nan")), "Clusters.scale"), (SampleMetrics(depth=-1.0), "depth")):
        with pytest.raises(ValueError, match=rf"{name}: expected a number >= 0"):
            shade_adaptive(*view, method=method)
    with pytest.raises(ValueError, match="method: expected Clusters or SampleMetrics, got Uniform"):
        fit_budget(*view, Uniform(2), budget=0.5)
    with pytest.raises(ValueError, match="fewer than 2\\^31 sub-samples"):
        scene_view(None, None, height=16384, width=16384, size=3)


def test_least_is_a_floor(view):
    found = shade_adaptive(*view, method=SampleMetrics(depth=None, normal=None, shading=None, least=3))
    same(found, shade_adaptive(*view, method=Uniform(3)))
    # Without the shading metric, which sees another first shading.
    plain, floored = (shade_adaptive(*view, method=SampleMetrics(shading=None, least=k)) for k in (1, 4))
    covered = np.asarray(view[0].covered).sum(axis=-1)
    np.testing.assert_array_equal(floored.count, np.minimum(covered, np.maximum(plain.count, 4 * (covered > 0))))


def test_normal_maps_ask_for_samples(scene, camera):
    """A floor that is flat but for its normal map, of bumps wider than a pixel."""
    u = np.sin(np.linspace(0.0, 40.0 * np.pi, 128, endpoint=False))[None, :, None] * np.ones((128, 1, 1))
    texels = np.concatenate([0.5 + 0.3 * u, 0.5 + 0.0 * u, 0.9 + 0.0 * u], axis=-1).astype(np.float32)
    bumps = dataclasses.replace(scene.images[0], texels=texels, srgb=False)
    slot = jnp.where(scene.material.base_color_texture >= 0, len(scene.images), -1)
    bumpy = dataclasses.replace(
        scene, images=(*scene.images, bumps), material=dataclasses.replace(scene.material, normal_texture=slot)
    )
    samples, lighting = scene_view(bumpy, camera, size=3, **SIZE)
    settings = SampleMetrics(depth=None, shading=None, normal=30.0)
    mapped = dataclasses.replace(settings, mapped_normals=True)
    smooth, seen = (shade_adaptive(samples, lighting, method=method) for method in (settings, mapped))
    assert seen.count.sum() > 1.2 * smooth.count.sum()
    bare = dataclasses.replace(lighting, slots=tuple(s for s in lighting.slots if s != "normal_texture"))
    same(shade_adaptive(samples, bare, method=mapped), shade_adaptive(samples, bare, method=settings))


def test_highlights_ask_for_samples_where_light_is(view):
    samples, lighting = view
    only = SampleMetrics(depth=None, normal=None, shading=None, highlight=200.0)
    lit = shade_adaptive(samples, lighting, method=only)
    dark = dataclasses.replace(lighting.lights, intensity=jnp.zeros_like(lighting.lights.intensity))
    unlit = shade_adaptive(samples, dataclasses.replace(lighting, lights=dark), method=only)
    assert lit.count.max() > 1 and unlit.count.max() == 1


# --- The dial


def test_a_budget_is_kept(view):
    method, picture = fit_budget(*view, Clusters(), budget=0.3, steps=6)
    assert (
        picture.sample_share
        <= 0.3
        < shade_adaptive(*view, method=dataclasses.replace(method, scale=2 * method.scale)).sample_share
    )
    same(picture, shade_adaptive(*view, method=method))


def test_a_quality_is_reached(view, reference):
    method, picture = fit_psnr(*view, SampleMetrics(), psnr_db=38.0, steps=6)
    assert picture_psnr(picture, reference) >= 38.0
    less = shade_adaptive(*view, method=dataclasses.replace(method, scale=0.4 * method.scale))
    assert less.sample_share < picture.sample_share


def test_budgets_that_no_scale_fits(view):
    with pytest.raises(InputError, match="budget: share: expected at least"):
        fit_budget(*view, Clusters(), budget=0.02, steps=2)
    with pytest.raises(InputError, match="expected a number in"):
        fit_budget(*view, Clusters(), budget=1.5)
    with pytest.raises(InputError, match="decibels"):
        fit_psnr(*view, Clusters(), psnr_db=-1.0)


# --- Other sources


def test_a_gbuffer_gives_what_its_scene_gives(scene, camera, view):
    """The same surface looked up from a G-buffer; only the shift of a sample stays in the texture there."""
    samples, lighting = view
    fragments = see(scene, camera, samples=ordered_grid(3), textures=scene_textures(scene), **SIZE)
    stored = gbuffer_view(draw_gbuffer(scene, fragments), scene.material, size=3)
    lighting = dataclasses.replace(lighting, slots=tuple(s for s in lighting.slots if s != "normal_texture"))
    np.testing.assert_allclose(supersample(stored, lighting).image, supersample(samples, lighting).image, atol=2e-5)
    for method in (Clusters(), SampleMetrics(), Uniform(4)):
        ours, theirs = (shade_adaptive(source, lighting, method=method) for source in (stored, samples))
        assert abs(ours.sample_share - theirs.sample_share) < 0.02
        assert np.sqrt(np.mean((ours.image - theirs.image) ** 2)) < 0.02


def test_a_gbuffer_from_a_file(tmp_path, scene, camera):
    """Of three times the picture's size, written and read as EXR; a file has no colors, so all is white."""
    large = {"height": 3 * SIZE["height"], "width": 3 * SIZE["width"]}
    gbuffer = draw_gbuffer(scene, see(scene, camera, transparency="none", **large))
    write_exr(tmp_path / "g.exr", gbuffer_layers(gbuffer))
    read = gbuffer_from_layers(known_layers(read_exr_layers(tmp_path / "g.exr")))
    white = jax.tree.map(lambda v: v, scene.material)
    _, lighting = scene_view(scene, camera, size=1, height=4, width=4)
    lighting = dataclasses.replace(lighting, textures=None, slots=())
    pictures = [
        supersample(gbuffer_view(g, white, size=3), lighting)
        for g in (read, dataclasses.replace(gbuffer, color=jnp.ones_like(gbuffer.color)))
    ]
    np.testing.assert_array_equal(pictures[0].alpha, pictures[1].alpha)
    np.testing.assert_allclose(pictures[0].image, pictures[1].image, atol=1e-3)
    found = shade_adaptive(gbuffer_view(read, white, size=3), lighting)
    assert picture_psnr(found, pictures[0]) > 35.0 and found.sample_share < 0.6


def test_grouped_samples_keep_their_places():
    values = jnp.arange(4 * 6, dtype=jnp.float32).reshape(4, 6, 1)
    vector = jnp.stack([values] * 3, axis=-1)
    pair = vector[..., :2]
    from jaxrender.deferred import GBuffer

    gbuffer = GBuffer(
        position=vector, normal=vector, geometric_normal=vector, uv=pair, duv_dx=pair, duv_dy=pair,
        color=jnp.stack([values] * 4, axis=-1), depth=values, material_id=values.astype(int),
        triangle_id=values.astype(int), motion=pair,
    )  # fmt: skip
    found = group_samples(gbuffer, size=2)
    np.testing.assert_array_equal(found.depth[1, 2], [16, 17, 22, 23])
    np.testing.assert_array_equal(found.duv_dx[1, 2, :, 0], [32, 34, 44, 46])
    np.testing.assert_array_equal(found.motion[1, 2, :, 0], [8, 8.5, 11, 11.5])
    with pytest.raises(InputError, match="multiples of 4"):
        group_samples(gbuffer, size=4)


# --- Packed textures


def test_packed_textures_look_like_single_ones(scene, camera, reference):
    packed, single = scene_material_textures(scene), scene_textures(scene)
    if not isinstance(packed, MaterialTextures):
        pytest.fail("the built-in scene's textures should be of one size in each material")
    assert packed.slots == material_slots(scene.material)
    plain = render_supersampled(scene, camera, size=3, textures=single, **SIZE)
    np.testing.assert_allclose(reference.image, plain.image, atol=1e-4)


# --- The pure form


def test_the_pure_form_makes_the_same_picture(view):
    expected = shade_adaptive(*view)
    draw = jax.jit(shade_adaptive_within, static_argnames=("capacity", "method"))
    image, alpha, count, demand = draw(*view, capacity=12_000, method=Clusters())
    assert int(demand) == expected.count.sum() <= 12_000
    np.testing.assert_array_equal(count, expected.count)
    np.testing.assert_allclose(image, expected.image, atol=2e-4)
    np.testing.assert_allclose(alpha, expected.alpha, atol=1e-6)
    small = jax.jit(shade_adaptive_within, static_argnames=("capacity", "method"), compiler_options=QUICKLY)
    *_, wanted = small(*view, capacity=100, method=Clusters())
    assert int(wanted) > 100


def test_gradients_to_the_light_are_finite_differences(view):
    samples, lighting = view

    def total(intensity: jax.Array) -> jax.Array:
        lights = dataclasses.replace(lighting.lights, intensity=intensity)
        lit = dataclasses.replace(lighting, lights=lights)
        return jnp.mean(shade_adaptive_within(samples, lit, 12_000, method=Clusters(contrast=0.0, detail=0.0))[0])

    intensity = lighting.lights.intensity
    slope = jax.jit(jax.grad(total), compiler_options=QUICKLY)(intensity)
    total = jax.jit(total, compiler_options=QUICKLY)
    step = 0.05 * jnp.ones_like(intensity)
    # Light is linear in intensity, so differences are exact but for rounding.
    expected = (total(intensity + step) - total(intensity - step)) / 2.0
    np.testing.assert_allclose(jnp.sum(slope * step), expected, rtol=1e-3)


def test_batches_by_vmap(view):
    samples, lighting = view
    scales = jnp.asarray([0.5, 2.0])

    def draw(scale: jax.Array) -> jax.Array:
        lights = dataclasses.replace(lighting.lights, intensity=lighting.lights.intensity * scale)
        lit: Lighting = dataclasses.replace(lighting, lights=lights)
        return shade_adaptive_within(samples, lit, 12_000, method=Clusters())[0]

    batch = jax.jit(jax.vmap(draw), compiler_options=QUICKLY)(scales)
    draw = jax.jit(draw, compiler_options=QUICKLY)
    for scale, image in zip(scales, batch, strict=True):
        np.testing.assert_allclose(image, draw(scale), atol=1e-4)
