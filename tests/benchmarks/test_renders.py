"""Renders with a known reference: paths against Mitsuba's own integrator, layers against each other, the cache.

Where light is random it is judged by its own variance.
"""

import dataclasses
import json
import sys

import numpy as np
import pytest

from benchmarks import renders
from benchmarks.renders import NoRenders, load_renders

pytestmark = pytest.mark.data

HEIGHT, WIDTH = 24, 32
TINY = {"height": HEIGHT, "width": WIDTH, "spp": 64, "seed": 0, "reference_spp": 512}


@pytest.fixture(scope="module")
def tracer(shared_data):
    pytest.importorskip("mitsuba")
    from benchmarks import mitsuba_scenes

    try:
        mitsuba_scenes.prepare()
    except mitsuba_scenes.NoMitsuba as error:
        pytest.skip(str(error))
    return mitsuba_scenes


@pytest.fixture(scope="module")
def folder(tracer, tmp_path_factory):
    return tmp_path_factory.mktemp("renders")


@pytest.fixture(scope="module")
def statue(folder):
    return load_renders("statue", **TINY, folder=folder)


def path_traced(tracer, view, *, num_samples, seed):
    """The means over the same primary rays by Mitsuba's `path`, which also samples emitters by the BSDF (MIS)."""
    import drjit as dr
    import mitsuba as mi

    rays = tracer.primary_rays(view, height=HEIGHT, width=WIDTH)
    rays = dr.gather(mi.Ray3f, rays, dr.repeat(dr.arange(mi.UInt32, HEIGHT * WIDTH), num_samples))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, HEIGHT * WIDTH * num_samples)
    integrator = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 100})
    radiance, _, _ = integrator.sample(view.scene, sampler, rays)
    return np.asarray(radiance).T.reshape(HEIGHT, WIDTH, num_samples, 3).mean(axis=2)


def blocks(images):
    """Means over 4 x 4 pixels; (k, h, w, 3)."""
    return images.reshape(len(images), HEIGHT // 4, 4, WIDTH // 4, 4, 3).mean(axis=(2, 4))


def z_scores(ours, theirs):
    """Differences of means over their standard errors, estimated from equal and independent batches (leading axis)."""
    error = np.sqrt((ours.var(axis=0, ddof=1) + theirs.var(axis=0, ddof=1)) / len(ours))
    difference = ours.mean(axis=0) - theirs.mean(axis=0)
    return difference / np.where(error > 0.0, error, 1.0)


# --- Paths


@pytest.mark.parametrize("name", ["cornell", "atrium"])
def test_light_is_that_of_mitsubas_path_tracer(tracer, name):
    """An area light; a sun with a sky. Direct and indirect times albedo, and emission, make up the whole."""
    view = tracer.build(name)
    first = tracer.first_hits(view, height=HEIGHT, width=WIDTH)
    guides = tracer.guides(first, view.camera)
    batches, count = 16, 128
    ours, theirs = [], []
    for batch in range(batches):
        sums = tracer.light_sums(view, first, num_samples=count, seed=1000 + batch, radii=(1.0, 1.0, 1.0))
        ours.append(guides["albedo"] * (sums["direct"] + sums["indirect"]) / count + guides["emission"])
        theirs.append(path_traced(tracer, view, num_samples=count, seed=batch))
    ours, theirs = np.array(ours, np.float64), np.array(theirs, np.float64)
    # Where the shading normal looks away from the eye, Mitsuba turns it to the other side of the face, and we do not.
    wo = np.asarray(view.camera.eye) - guides["position"]
    same = (np.sum(wo * guides["normal"], axis=-1, keepdims=True) > 0.0) | (guides["depth"] == 0.0)
    assert same.mean() > 0.97
    ours, theirs = ours * same, theirs * same
    # Of so many blocks the largest z is about 3; whole images differ by 0.2 % at one standard error.
    assert np.abs(z_scores(blocks(ours), blocks(theirs))).max() < 5.0
    whole = z_scores(ours.mean(axis=(1, 2)), theirs.mean(axis=(1, 2)))
    assert np.abs(whole).max() < 4.0


def test_rays_pass_through_holes(tracer):
    """In Sponza no first hit is a hole, and without the search for what is behind some are."""
    view = tracer.build("sponza")
    holes = []
    for cutouts in (True, False):
        surface = tracer.first_hits(dataclasses.replace(view, cutouts=cutouts), height=96, width=128).surface
        holes.append(float(np.asarray(surface.bsdf().eval_null_transmission(surface).x).sum()))
    assert holes[0] == 0.0
    assert holes[1] > 50.0


# --- Layers


def test_layers_are_finite_images(statue):
    for name in ("normal", "position", "albedo", "emission", "ao8", "ao64", "direct", "indirect", "ao"):
        assert getattr(statue, name).shape == (HEIGHT, WIDTH, 3), name
        assert np.isfinite(getattr(statue, name)).all(), name
    assert (statue.spp, statue.seed, statue.reference_spp) == (64, 0, 512)
    for name in ("direct", "indirect"):
        whole, a, b = (getattr(statue, name + half) for half in ("", "_a", "_b"))
        np.testing.assert_allclose(whole, 0.5 * (a + b), rtol=1e-6)
        assert (a != b).mean() > 0.9


def test_guides_agree_with_each_other(tracer, statue):
    camera = tracer.build("statue").camera
    eye, target = np.asarray(camera.eye), np.asarray(camera.target)
    assert (statue.depth > 0.0).all()
    along = (statue.position - eye) @ (target - eye) / np.linalg.norm(target - eye)
    np.testing.assert_allclose(statue.depth[..., 0], along, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(statue.normal, axis=-1), 1.0, rtol=1e-5)
    assert (np.sum((eye - statue.position) * statue.normal, axis=-1) > 0.0).mean() > 0.98
    # The floor is below and grey, the red wall on the left, the top row above everything else.
    np.testing.assert_allclose(statue.albedo[-1, WIDTH // 2], 0.6, rtol=1e-6)
    np.testing.assert_allclose(statue.albedo[0, 0], [0.7, 0.12, 0.06], rtol=1e-6)
    assert statue.position[0, 16, 1] > statue.position[12, 16, 1] > statue.position[-1, 16, 1]


def test_occlusion_is_the_same_from_paths_and_from_rays_of_its_own(statue):
    for ao in (statue.ao, statue.ao8, statue.ao64):
        assert ao.min() >= 0.0 and ao.max() <= 1.0
        # A longer radius sees more.
        assert (np.diff(ao, axis=-1) <= 1e-6).all()
    assert statue.ao_radii[0] < statue.ao_radii[1] < statue.ao_radii[2]
    # A value in [0, 1] has a standard deviation of at most 0.5; over all pixels and 64 samples 0.002.
    assert abs(statue.ao.mean() - statue.ao64.mean()) < 0.008
    assert np.abs(statue.ao - statue.ao64).max() < 0.4
    assert statue.ao64.min() < 0.8


def test_variance_is_that_of_the_difference(statue):
    """To the reference, whose random numbers are others."""
    variance = statue.indirect_variance + statue.reference_indirect_variance
    ratio = np.mean((statue.indirect - statue.reference_indirect) ** 2) / np.mean(variance)
    assert 0.85 < ratio < 1.15
    share = np.mean(statue.reference_indirect_variance) / np.mean(statue.indirect_variance)
    assert 0.8 < share / (64 / 512) < 1.25


# --- Cache


def test_files_are_used_again(statue, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "benchmarks.mitsuba_scenes", None)
    again = load_renders("statue", **TINY, folder=folder)
    np.testing.assert_array_equal(again.indirect, statue.indirect)
    # A reference of more samples than asked is good enough; one of fewer is not.
    fewer = load_renders("statue", **{**TINY, "reference_spp": 64}, folder=folder)
    assert fewer.reference_spp == 512
    with pytest.raises(NoRenders, match="peers"):
        load_renders("statue", **{**TINY, "reference_spp": 1024}, folder=folder)


def test_same_call_makes_the_same_files(statue, folder, tmp_path):
    load_renders("statue", **TINY, folder=tmp_path)
    for file in ("guides.exr", "noisy_64_0.exr", "reference.exr"):
        first, second = (root / f"statue_{WIDTH}x{HEIGHT}" / file for root in (folder, tmp_path))
        assert first.read_bytes() == second.read_bytes(), file
    other = load_renders("statue", **{**TINY, "seed": 1}, folder=tmp_path)
    errors = [(r.indirect - r.reference_indirect).ravel() for r in (statue, other)]
    # Both errors hold that of the reference, of 8 times the samples: a correlation of 1/9.
    assert np.corrcoef(errors)[0, 1] < 0.25


def test_one_sample_has_no_halves(folder):
    one = load_renders("statue", **{**TINY, "spp": 1}, folder=folder)
    assert one.indirect_a is None and one.direct_b is None and one.indirect_variance is None
    assert one.direct.shape == (HEIGHT, WIDTH, 3)


def test_files_of_another_version_are_made_anew(folder, monkeypatch, statue):
    monkeypatch.setattr(renders, "VERSION", renders.VERSION + 1)
    monkeypatch.setitem(sys.modules, "benchmarks.mitsuba_scenes", None)
    with pytest.raises(NoRenders):
        load_renders("statue", **TINY, folder=folder)


def test_damaged_settings_are_no_settings(tmp_path):
    shelf = renders._Shelf("atrium", 8, 8, tmp_path)
    assert shelf.settings() == {}
    shelf.folder.mkdir()
    for text in ("{", "[1]", json.dumps({"guides.exr": 3})):
        (shelf.folder / "settings.json").write_text(text)
        assert shelf.settings() == {}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"scene": "bathroom"}, "scene"), ({"height": 0}, "height"), ({"spp": 0}, "spp"), ({"seed": -1}, "seed")],
)
def test_bad_arguments(folder, statue, wrong, message):
    with pytest.raises(ValueError, match=message):
        load_renders(**{"scene": "statue", **TINY, **wrong}, folder=folder)
