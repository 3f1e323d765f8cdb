"""The suite `harmonics` at tiny sizes: that every case runs and its numbers mean what they say. No times are judged."""

import os
import time

import jax
import numpy as np
import pytest

from benchmarks import harmonics as suite
from benchmarks.suites import Options

TINY = suite.Sizes(
    vertices=600,
    directions=16,
    bake_frames=2,
    bake_runs=1,
    memory_frames=(1, 2),
    lobe_vertices=3,
    lobe_frames=2,
    solve_frames=30,
    solve_features=12,
    train_frames=20,
    num_mixed=4,
    refine_steps=3,
    num_components=4,
    sh_vectors=30,
    sh_orders=(4,),
    twin_points=20,
    min_runs=1,
    min_seconds=0.0,
)


@pytest.fixture
def rows(monkeypatch):
    """Runs one case at tiny sizes, in this process throughout."""
    monkeypatch.setattr(suite, "QUICK", TINY)
    monkeypatch.setattr(suite, "_in_fresh_process", lambda function, *args, **_: function(*args))
    return lambda case: list(suite.run(Options(cases=(case,), quick=True, seed=3)))


def check_numbers(rows, case):
    assert {row.case for row in rows} == {case}
    for row in rows:
        assert all(np.isfinite(value) for value in row.metrics.values()), row
        assert all(isinstance(value, str | int | bool) for value in row.params.values()), row
    return {row.variant: row for row in rows}


def test_only_the_asked_cases_run(monkeypatch):
    ran = []
    cases = {name: lambda sizes, seed, name=name: ran.append((name, sizes, seed)) or [] for name in suite.CASES}
    monkeypatch.setattr(suite, "CASES", cases)
    assert list(suite.run(Options(cases=("bake*", "twin"), seed=5))) == []
    assert ran == [("bake", suite.FULL, 5), ("bake_memory", suite.FULL, 5), ("twin", suite.FULL, 5)]


def test_bake_beside_embree_on_the_same_rays(rows):
    found = check_numbers(rows("bake"), "bake")
    ours, embree = found["jaxrender"].metrics, found["embree"].metrics
    assert ours["mismatched_rays"] == 0  # Embree was given the very rays
    assert ours["overhead_share"] == pytest.approx(ours["ms_median"] / embree["ms_median"] - 1)
    rays = 2 * found["jaxrender"].params["num_points"] * 16
    assert ours["rays_per_second"] * ours["ms_median"] == pytest.approx(1e3 * rays)


def test_bake_memory_per_frame_count(rows):
    found = rows("bake_memory")
    assert [row.params["num_frames"] for row in found] == [1, 2]
    assert found[1].metrics["rays"] == 2 * found[0].metrics["rays"] > 0
    assert all(row.metrics["peak_bytes"] >= 0 for row in found)


def test_lobe_fit(rows):
    found = rows("lobe_fit")
    check_numbers(found, "lobe_fit")
    assert [row.params["num_lobes"] for row in found] == [1, 2, 3]
    errors = [row.metrics["relative_l2"] for row in found]
    assert errors[2] < errors[0] < 1  # more lobes, less error
    first = found[0].metrics
    assert first["us_per_vertex_frame"] == pytest.approx(1e3 * first["ms_median"] / 6)


def test_linear_solve(rows):
    found = rows("linear_solve")
    check_numbers(found, "linear_solve")
    assert [row.params["num_columns"] for row in found] == [600 * 12, 600 * 16]
    for row in found:
        # Singular values over four decades, the ridge cuts at about 0.3 % of the largest: a condition below 1e3,
        # times a few float32 roundings (6e-8).
        assert row.metrics["relative_l2"] < 5e-4
        assert row.metrics["rank"] == 12


@pytest.mark.parametrize(("refine_steps", "num_mixed"), [(0, 0), (3, 4)])
def test_training_stages_errors_and_size(refine_steps, num_mixed):
    metrics, params = suite._train(TINY, refine_steps, num_mixed, 3)
    stages = {name for name in metrics if name.startswith("seconds_")} - {"seconds_total"}
    assert "seconds_bake" in stages
    assert metrics["seconds_total"] == pytest.approx(sum(metrics[name] for name in stages))
    # Of so few frames and directions neither error has to be the larger one; predicting nothing has error 1.
    assert 0 < metrics["relative_l2_training"] < 1 and 0 < metrics["relative_l2"] < 1
    # float16 has 11 bits: it moves a prediction by far less than the model is off.
    assert metrics["relative_l2_float16"] == pytest.approx(metrics["relative_l2"], rel=1e-2)
    assert 0.5 < metrics["model_bytes_float16"] / metrics["model_bytes_float32"] < 0.95
    assert params["num_mixed"] == num_mixed and params["num_components"] == 4 and params["num_frames"] <= 20


def test_training_variants(rows, monkeypatch):
    monkeypatch.setattr(suite, "_train", lambda sizes, steps, mixed, seed: ({"x": 1.0}, {"s": steps, "m": mixed}))
    found = [(row.variant, row.params["s"], row.params["m"]) for row in rows("training")]
    assert found == [
        ("linear", 0, 0), ("refined", 3, 0), ("linear, mixed poses", 0, 4), ("refined, mixed poses", 3, 4),
    ]  # fmt: skip


def test_runtime_step_by_step_and_together(rows, monkeypatch):
    monkeypatch.setattr(suite, "num_cores", lambda: 2)
    monkeypatch.setattr(suite, "_xla_threads", lambda: "one")
    found = suite._runtime_rows(TINY, 3)
    check_numbers(found, "runtime")
    assert {row.variant[:6] for row in found} >= {"step 1", "step 2", "step 3", "step 4", "step 5", "steps "}
    together = [row for row in found if "relative_l2" in row.metrics]
    settings = {(row.variant, row.params["offset"], row.params["exponent"]) for row in together}
    assert len(settings) == len(together) == 8
    for row in together:
        # The same sum in another order. About a thousand products each; colors cancel to a tenth of their terms.
        assert row.metrics["relative_l2"] < 1e-4, row
        assert row.metrics["hz"] == pytest.approx(1e3 / row.metrics["ms_median"])
    (flight,) = [row for row in found if "in flight" in row.variant]
    assert flight.metrics["hz"] == pytest.approx(suite.IN_FLIGHT * 1e3 / flight.metrics["ms_median"])


def test_a_thread_pool_that_locks_up_is_left_out(monkeypatch, capsys):
    def locked(*args, **kwargs):
        assert kwargs["pool_of_threads"]
        raise TimeoutError("no answer within 1 s")

    monkeypatch.setattr(suite, "_runtime_rows", lambda sizes, seed: ["row"])
    monkeypatch.setattr(suite, "_xla_threads", lambda: "one")
    monkeypatch.setattr(suite, "_in_fresh_process", locked)
    assert list(suite._runtime(TINY, 0)) == ["row"]
    assert "no answer within 1 s; left out" in capsys.readouterr().err


def test_sh_kernels_and_peer(rows, monkeypatch, capsys):
    found = rows("sh")
    check_numbers(found, "sh")
    for row in found:
        assert row.metrics["relative_l2"] < 1e-5, row  # float32, 16 terms
    ours = {row.params["kernel"] for row in found if row.variant == "jaxrender"}
    assert ours == {"sh_basis", "sh_rotate", "phong_operator"}
    monkeypatch.setattr(suite.importlib.util, "find_spec", lambda name: None)
    assert {row.variant for row in rows("sh")} == {"jaxrender"}
    assert "e3nn_jax is not installed" in capsys.readouterr().err


def test_twin(rows):
    pytest.importorskip("torch")
    found = check_numbers(rows("twin"), "twin")
    assert set(found) == {"jaxrender", "torchref"}
    assert found["torchref"].metrics["relative_l2"] < 1e-5  # float32 against float64 inside


def test_fresh_process(monkeypatch):
    if jax.default_backend() != "cpu":
        pytest.skip("other devices are not shared between processes")
    monkeypatch.setenv("XLA_FLAGS", f"{suite.POOL_SWITCH}false")
    flags = suite._in_fresh_process(os.getenv, "XLA_FLAGS", pool_of_threads=True).split()
    assert [flag for flag in flags if flag.startswith(suite.POOL_SWITCH)] == [f"{suite.POOL_SWITCH}true"]
    assert os.environ["XLA_FLAGS"] == f"{suite.POOL_SWITCH}false"
    with pytest.raises(TimeoutError, match=r"no answer within 0\.01 s"):
        suite._in_fresh_process(time.sleep, 60, timeout_seconds=0.01)
    with pytest.raises(RuntimeError, match="_exit died"):
        suite._in_fresh_process(os._exit, 3)
