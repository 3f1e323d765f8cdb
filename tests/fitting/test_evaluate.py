"""The evaluation on made-up data: one round occluder that moves with the pose before each point."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from fitting import errors
from fitting.checkpoint import Checkpoint
from fitting.config import FitSettings
from fitting.evaluate import evaluate
from fitting.fit import fit_model, model_components, predict_sh
from fitting.motion import MIXED, SEGMENT, TRAIN
from fitting.study import ground as ground_of
from fitting.study import lobes, without_lobes
from fitting.study.features import joint_distances
from jaxrender.console import to_jsonable
from jaxrender.harmonics.sh import sh_basis
from jaxrender.harmonics.visibility import hemisphere_directions
from tests.fitting.made_up import NUM_DIRECTIONS, NUM_POINTS, PART, made_up_basis

FIT = FitSettings(num_components=8, refine_steps=0, mixed_weight=0.2)


@pytest.fixture(scope="module")
def model(data):
    return fit_model(data, FIT, ridge=0.01)


@pytest.fixture(scope="module")
def full(data, model):
    angles = data.raw[:, :1] * np.float32(0.5), made_up_basis("exponential_map", 1)
    return evaluate(data, model, FIT, ridge=0.01, angles=angles, clip_names=("walk", "turn"))


@pytest.fixture(scope="module")
def ground(data):
    return ground_of.make_ground(ground_of.thin(data, np.flatnonzero(data.visible)), FIT, 0.01)


def test_model_errors_are_those_of_its_predictions(data, model, full):
    points, real = np.flatnonzero(data.visible), data.part != MIXED
    predicted = predict_sh(model, model_components(model, data.raw[real]), points).astype(np.float64)
    baked = data.sh(points)[real].astype(np.float64)
    error, truth = np.sum((predicted - baked) ** 2, axis=(1, 2)), np.sum(baked**2, axis=(1, 2))
    # Squares of float32 differences of O(0.1) numbers of O(1): relative error about 10 eps.
    close = {"rtol": 1e-5}
    np.testing.assert_allclose(full.frames.curve["global"], np.sqrt(error / truth), **close)
    for name, number in (("train", TRAIN), ("segments", SEGMENT)):
        of = full.frames.part == number
        np.testing.assert_allclose(full.errors[name]["global"], np.sqrt(error[of].sum() / truth[of].sum()), **close)
        np.testing.assert_allclose(full.errors[name]["mean_relative"], full.frames.curve["mean"][of].mean(), **close)
    relative = np.linalg.norm(predicted - baked, axis=-1) / np.maximum(np.linalg.norm(baked, axis=-1), 0.2)
    np.testing.assert_allclose(full.frames.curve["std"], relative.std(axis=1), rtol=1e-4)
    held_out = np.sqrt(np.mean(relative[full.frames.part == SEGMENT] ** 2, axis=0))
    np.testing.assert_allclose(full.point_errors[points], held_out, **close)


def test_what_is_not_there_is_none(data, model, full):
    assert full.errors["clips"] is None and full.baseline["clips"] is None
    assert all(row.sh["clips"] is None and row.environment["clips"] is None for row in full.study.rows)
    assert np.isnan(full.point_errors[4]) and np.isfinite(np.delete(full.point_errors, 4)).all()
    assert full.invisible_share == pytest.approx(1 / NUM_POINTS)
    assert evaluate(data, model, FIT, ridge=0.01, study=False).study is None


def test_everything_goes_into_strict_json(full):
    record = json.loads(json.dumps(to_jsonable(full.as_dict()), allow_nan=False))
    assert record["study"]["rows"][0]["method"] == "unoccluded"
    json.dumps(full.summary(), allow_nan=False)


def test_only_training_frames_left_paints_on_them(data, model):
    keep = data.part == TRAIN
    short = dataclasses.replace(data, bits=data.bits[keep], raw=data.raw[keep], part=PART[keep], clip=data.clip[keep])
    found = evaluate(short, model, FIT, ridge=0.01, study=False)
    assert found.errors["segments"] is None and found.painted_on == "training frames"
    assert {row["clip"] for row in found.clips} == {"clip 0", "clip 1"}


def test_bands_make_up_the_whole(full, data):
    row = full.errors["train"]
    baked = data.sh(np.flatnonzero(data.visible))[PART == TRAIN].astype(np.float64)
    squares = [np.sum(baked[..., l * l : (l + 1) ** 2] ** 2) for l in range(4)]
    whole = sum(b**2 * s for b, s in zip(row["bands"], squares, strict=True)) / sum(squares)
    assert np.sqrt(whole) == pytest.approx(row["global"], rel=1e-5)


def test_error_sums_add_up_over_points():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 5, 6, 16)).astype(np.float32)
    both = errors.sum_errors(a[:, :2], b[:, :2]) + errors.sum_errors(a[:, 2:], b[:, 2:])
    np.testing.assert_allclose(both.frame_curve()["std"], errors.sum_errors(a, b).frame_curve()["std"], rtol=1e-5)
    assert both.num_points == 6


def test_an_interrupted_study_continues_and_ends_with_the_same_numbers(data, model, full, tmp_path):
    angles = data.raw[:, :1] * np.float32(0.5), made_up_basis("exponential_map", 1)
    options = {"ridge": 0.01, "angles": angles, "clip_names": ("walk", "turn")}

    class Stop(Exception):
        pass

    def stop_in(label, number):
        def track(items, _count, own, _done):
            for index, item in enumerate(items):
                if own == label and index == number:
                    raise Stop
                yield item

        return track

    for label, number in (("measure", 0), ("2 lobes", 1), ("3 lobes", 0), ("fits per frame", 2)):
        with pytest.raises(Stop):
            parts = Checkpoint(tmp_path / "c")
            evaluate(data, model, FIT, track=stop_in(label, number), checkpoint=parts, **options)
    seen = {}

    def count(items, total, label, done):
        seen.setdefault(label, []).append((total, done))
        return items

    found = evaluate(data, model, FIT, track=count, checkpoint=Checkpoint(tmp_path / "c"), **options)
    assert seen["fits per frame"] == [(3, 2)] and all(total == done for total, done in seen["2 lobes"])
    assert to_jsonable(found.as_dict()) == to_jsonable(full.as_dict())


def test_study_knows_better_from_worse(full):
    train = {row.method: row.sh["train"] for row in full.study.rows}
    assert train["baked, order 4"] == 0.0
    assert train["linear, 16 SH"] < train["mean visibility"] < train["unoccluded"]
    assert train["3 lobes, axes fixed per point"] < train["1 lobe, axes fixed per point"]
    alone = {row.method: row.sh["train"] for row in full.study.subset_rows}
    fits = [alone[f"{lobes.count_lobes(c)}, fit per frame, no pose model"] for c in (1, 2, 3)]
    assert fits[0] > fits[1] > fits[2]
    errors = [row["train"] for row in full.study.ridge_curve]
    assert errors == sorted(errors)


def test_study_figures_and_goals_fit_the_table(full):
    rows = {row.method: row for row in full.study.rows}
    figure3 = full.study.figure3
    assert figure3[0]["segments"] == pytest.approx(rows["linear, 16 SH"].sh["segments"], rel=1e-6)
    assert len(figure3[0]["curve"]["mean"]) == len(full.frames.index)
    assert figure3[2]["target"] != figure3[3]["target"] and len(full.study.figure5) == 6
    goals = {goal.name: goal for goal in full.study.goals}
    two = goals["2 lobes / linear-16, SH, segments"]
    ratio = rows["2 lobes, refined + offset"].sh["segments"] / rows["linear, 16 SH"].sh["segments"]
    assert two.value == pytest.approx(ratio) and two.met == (ratio <= 1.2)
    assert goals["trained model, SH, unseen clips"].met is None
    assert len(full.study.gains) == 6


def test_without_penalty_the_linear_model_interpolates(data):
    rng = np.random.default_rng(1)
    rich = dataclasses.replace(data, raw=rng.normal(size=(len(PART), 2, 60)).astype(np.float32))
    linear = ground_of.linear_pose(rich, dataclasses.replace(FIT, num_components=60), 0.0)
    targets = rng.normal(size=(len(PART), NUM_POINTS, 3))
    # Axes in float32 leave the components orthogonal to about 1e-7, times the 34 components' spread in size.
    used = linear.weights > 0
    np.testing.assert_allclose(linear.predict(targets)[used], targets[used], atol=1e-4)


def test_principal_components_lose_nothing_when_all_are_kept(ground):
    linear = ground.linear.predict(ground.sh)
    # Orthonormal float32 axes: tens of roundings of numbers up to 2.5.
    np.testing.assert_allclose(without_lobes.point_pca(ground, 16), linear, atol=2e-5)
    np.testing.assert_allclose(without_lobes.global_pca(ground, ground.sh, 16), linear, atol=2e-5)
    assert np.abs(without_lobes.point_pca(ground, 2) - linear).max() > 1e-2


def test_shading_truth_is_the_sum_over_the_bits(data, ground):
    directions = hemisphere_directions(NUM_DIRECTIONS)
    free = np.unpackbits(data.bits[5, 0], count=NUM_DIRECTIONS).astype(np.float64)
    for lights in ground_of.light_sets().values():
        radiance = np.asarray(sh_basis(jnp.asarray(directions, jnp.float32), order=4)) @ lights.T
        shade = (free * directions[:, 2] / np.pi) @ radiance * (2 * np.pi / NUM_DIRECTIONS)
        # 64 float32 terms of the size of the light.
        np.testing.assert_allclose(ground.cosine[5, 0] @ lights.T, shade, atol=1e-5 * np.abs(radiance).max())


def test_perfect_transfer_has_no_shading_error_and_none_has_all(ground):
    part = ground.data.part
    assert ground_of.shading_errors(ground.cosine, ground.cosine, part)["directional"]["train"] == 0.0
    black = ground_of.shading_errors(np.zeros_like(ground.cosine), ground.cosine, part)
    assert black["environment"]["segments"] == pytest.approx(1.0) and black["directional"]["clips"] is None


def test_fit_rows_finds_lobes_near_the_start():
    rng = np.random.default_rng(5)
    axes = np.tile(np.array([[0.0, 0.6, 0.8], [0.8, -0.6, 0.0]], np.float32), (20, 1, 1))
    numbers = np.concatenate([rng.uniform(-0.2, 0.2, (20, 4)), rng.uniform(0.5, 1.5, (20, 8))], axis=1).astype(
        np.float32
    )
    sh = np.asarray(lobes._from_charts(numbers[None], axes))[0]
    found = lobes.fit_rows(sh, axes, penalty=np.full(12, 1e-8, np.float32), num_steps=20)
    again = np.asarray(lobes._from_charts(found[None], axes))[0]
    # An exact fit exists; Levenberg-Marquardt in float32 ends where squared errors stop falling, near sqrt(eps).
    np.testing.assert_allclose(again, sh, atol=1e-3)


def test_angles_and_charts_name_the_same_lobes():
    rng = np.random.default_rng(6)
    axes = np.tile(np.eye(3, dtype=np.float32)[[2, 0]], (7, 1, 1))
    numbers = rng.uniform(-0.5, 0.5, (7, 12)).astype(np.float32)
    from_angles = lobes._from_angles(lobes._angles_from_charts(numbers, axes))
    # Angles near the pole are good to sqrt(eps) in float32, and axes turn by as much.
    np.testing.assert_allclose(from_angles, lobes._from_charts(numbers[None], axes)[0], atol=2e-3)


def test_joint_distances_undo_the_falloff():
    basis = made_up_basis("surroundings", 2)
    found = joint_distances(basis, np.array([1, 3, 99]))
    # A float32 exponential and its logarithm.
    np.testing.assert_allclose(found[:, :2], np.linspace(0, 1, 8).reshape(2, 4)[:, [1, 3]], atol=1e-5)
    np.testing.assert_allclose(found[:, 2], np.linspace(0, 1, 8).reshape(2, 4).mean(axis=1), atol=1e-5)


def test_kernel_reference_follows_the_training_frames(ground):
    predicted = without_lobes.KernelPose(ground.data, ground.linear.weights).predict(ground.sh)
    linear = ground.linear.predict(ground.sh)
    train = ground.train
    assert np.sum((predicted - ground.sh)[train] ** 2) < np.sum((linear - ground.sh)[train] ** 2)
