"""Direct and indirect light of two scenes, pixel by pixel, against Mitsuba's paths."""

import numpy as np
import pytest

from benchmarks.path_scenes import STAGES
from jaxrender.pathtrace import TraceSettings, prepare
from jaxrender.pathtrace.guide_rays import trace_guides

SIZE, SAMPLES, RUNS = {"height": 18, "width": 24}, 64, 8


def their_light(scene: str) -> dict[str, np.ndarray]:
    """Means over `SAMPLES` paths, for `RUNS` seeds: over the albedo, with the albedo beside."""
    scenes = pytest.importorskip("benchmarks.mitsuba_scenes", reason="Mitsuba is not installed")
    try:
        view = scenes.build(scene)
    except scenes.NoMitsuba as reason:
        pytest.skip(str(reason))
    first = scenes.first_hits(view, **SIZE)
    sums = [scenes.light_sums(view, first, num_samples=SAMPLES, seed=s, radii=(1.0, 1.0, 1.0)) for s in range(RUNS)]
    guides = scenes.guides(first, view.camera)
    return {name: np.stack([run[name] for run in sums]) / SAMPLES for name in ("direct", "indirect")} | {
        "albedo": guides["albedo"], "normal": guides["normal"]
    }  # fmt: skip


def our_light(scene: str) -> dict[str, np.ndarray]:
    stage = STAGES[scene]()
    world = prepare(stage.scene, environment=stage.environment)
    traces = [
        trace_guides(
            world, stage.camera, **SIZE,
            settings=TraceSettings(samples_per_pixel=SAMPLES, model="lambert", ao_rays=0, seed=seed, direct="ratio"),
        )
        for seed in range(RUNS)
    ]  # fmt: skip
    over = np.maximum(traces[0].albedo, 1e-3)
    return {
        "direct": np.stack([trace.direct / over for trace in traces]),
        "indirect": np.stack([trace.incident for trace in traces]), "albedo": traces[0].albedo,
        "normal": traces[0].normal, "lamp": traces[0].emission.any(axis=-1),
    }  # fmt: skip


@pytest.mark.data
@pytest.mark.parametrize("scene", ["cornell", "statue"])
def test_light_is_that_of_mitsuba(shared_data, scene):
    """The difference of means over its standard error, by pixel: of variance 1 or so, and never far out."""
    theirs, ours = their_light(scene), our_light(scene)
    on = ours["normal"].any(axis=-1) & ~ours["lamp"]
    assert on.mean() > 0.8
    np.testing.assert_allclose(ours["albedo"][on], theirs["albedo"][on], atol=1e-5)
    np.testing.assert_allclose(ours["normal"][on], theirs["normal"][on], atol=1e-3)
    for name in ("direct", "indirect"):
        a, b = (light[name].mean(axis=-1)[:, on] for light in (ours, theirs))
        error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / RUNS)
        # What is 0 or alike in all runs, such as light from a lamp that is wholly hidden, has no error to go by.
        z = (a.mean(axis=0) - b.mean(axis=0)) / np.maximum(error, 1e-3 * b.mean())
        assert np.abs(z.mean()) < 0.25, name
        assert np.mean(z * z) < 1.6 and np.abs(z).max() < 7.0, name
        # And the mean over all pixels, where errors average out.
        assert abs(a.mean() - b.mean()) < 4.0 * np.sqrt((error**2).sum()) / len(error) + 1e-3 * b.mean(), name
