"""The run-time model: pose features against SciPy and geometry, prediction by loops, and what its file refuses."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation

from jaxrender import harmonics
from jaxrender.animation.skeleton import Pose
from jaxrender.checks import InputError
from jaxrender.harmonics import pose_model
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import ROUNDING, TIGHT

# --- Surroundings

NUM_JOINTS, SIZE = 5, 1.8
JOINTS, BONES = np.array([0, 3, 4], np.int32), np.array([1, 3], np.int32)
FALLOFF = np.array([[0.2, 0.5, 1.0], [0.3, 1.0, 0.7]])


@jax.jit
def surroundings(globals):
    falloff = jnp.asarray(FALLOFF, globals.dtype)
    return harmonics.surroundings(globals, bones=BONES, joints=JOINTS, falloff=falloff, size=SIZE)


def body(rng, *lead, scale=1.0):
    matrices = np.zeros((*lead, NUM_JOINTS, 4, 4))
    count = int(np.prod([*lead, NUM_JOINTS]))
    turns = Rotation.random(count, random_state=int(rng.integers(1000))).as_matrix()
    matrices[..., :3, :3] = scale * turns.reshape(*lead, NUM_JOINTS, 3, 3)
    matrices[..., :3, 3] = rng.normal(size=(*lead, NUM_JOINTS, 3))
    matrices[..., 3, 3] = 1.0
    return matrices


def test_surroundings_by_hand(rng, x64):
    """Position, nearness and axes of each joint in the frame of each bone."""
    matrices, a = body(rng), SIZE / 9.0
    got = np.asarray(surroundings(matrices)).reshape(len(BONES), len(JOINTS), 13)
    for g, bone in enumerate(BONES):
        for i, joint in enumerate(JOINTS):
            local = np.linalg.inv(matrices[bone]) @ matrices[joint]
            p, r = local[:3, 3], np.linalg.norm(local[:3, 3])
            turned = 0.25 * FALLOFF[g, i] * local[:3, :3]
            expected = np.concatenate([a * p / (r * r + a * a), [a / (2 * r + a)], turned.ravel()])
            assert_close(got[g, i], expected, ulps=TIGHT, what=f"{bone} sees {joint}")


def test_surroundings_do_not_feel_a_rigid_motion(rng, x64):
    matrices, motion = body(rng, 2), np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.random(random_state=4).as_matrix(), [3.0, -20.0, 7.0]
    assert_close(surroundings(motion @ matrices), surroundings(matrices), ulps=TIGHT)


def test_surroundings_take_leading_axes(rng):
    matrices = jnp.asarray(body(rng, 3, 2), jnp.float32)
    got = surroundings(matrices)
    assert got.shape == (3, 2, 2, 39)
    assert got.dtype == jnp.float32
    assert_close(surroundings(matrices[2, 1]), got[2, 1], ulps=16, dtype=np.float32)
    assert_close(jax.vmap(jax.vmap(surroundings))(matrices), got, ulps=16, dtype=np.float32)


def test_surroundings_ignore_scales_even_zero(rng, x64):
    """A joint of zero scale has no axes; the numbers stay finite, and so do the slopes."""
    matrices = body(rng)
    scaled = matrices.copy()
    scaled[:, :3, :3] *= np.array([0.5, 2.0, 3.0, 1.5, 0.1])[:, None, None]
    assert_close(surroundings(scaled), surroundings(matrices), ulps=TIGHT)
    scaled[4, :3, :3] = 0.0
    assert np.isfinite(surroundings(scaled)).all()
    assert np.isfinite(jax.jacrev(surroundings)(jnp.asarray(scaled))).all()


def test_a_bone_sees_itself_at_the_origin(rng, x64):
    itself = np.asarray(surroundings(body(rng))).reshape(2, 3, 13)[1, 1]
    assert_close(itself, np.r_[0, 0, 0, 1, 0.25 * np.eye(3).ravel()], ulps=8)


def test_surroundings_gradient(rng, x64):
    check_grads(surroundings, (body(rng),), order=1, modes=["rev"])


# --- Joint angles

REFERENCE = Rotation.random(len(JOINTS), random_state=11)
TRANSLATIONS = np.array([[0.0, 0.1, 0.2], [0.5, 0.0, 0.0], [0.0, 0.0, -0.3]])


def joint_angles(pose, *, euler=False):
    return harmonics.joint_angles(
        pose,
        joints=JOINTS,
        reference=jnp.asarray(REFERENCE.as_quat(), pose.rotation.dtype),
        translations=jnp.asarray(TRANSLATIONS, pose.rotation.dtype),
        size=SIZE,
        euler=euler,
    )


def random_pose(rng, *lead):
    q = oracles.unit(rng.normal(size=(*lead, NUM_JOINTS, 4)))
    t, s = rng.normal(size=(*lead, NUM_JOINTS, 3)), rng.uniform(0.5, 2.0, size=(*lead, NUM_JOINTS, 3))
    return Pose(jnp.asarray(t), jnp.asarray(q), jnp.asarray(s))


@pytest.mark.parametrize("euler", [False, True])
def test_joint_angles_are_scipys(euler, rng, x64):
    pose = random_pose(rng, 6)
    got = np.asarray(jax.jit(lambda p: joint_angles(p, euler=euler))(pose)).reshape(6, len(JOINTS), 9)
    for i, joint in enumerate(JOINTS):
        turn = REFERENCE[i].inv() * Rotation.from_quat(pose.rotation[:, joint])
        # Intrinsic x-y-z, R = Rx Ry Rz.
        expected = turn.as_euler("XYZ") if euler else turn.as_rotvec()
        assert_close(got[:, i, :3], expected, ulps=TIGHT)
        assert_close(got[:, i, 3:6], (np.asarray(pose.translation[:, joint]) - TRANSLATIONS[i]) / SIZE, ulps=TIGHT)
        assert_close(got[:, i, 6:], np.log(pose.scale[:, joint]), ulps=TIGHT)


def test_joint_angles_vanish_at_the_reference(x64):
    q, t = np.tile([0.0, 0.0, 0.0, 1.0], (NUM_JOINTS, 1)), np.zeros((NUM_JOINTS, 3))
    q[JOINTS], t[JOINTS] = -REFERENCE.as_quat(), TRANSLATIONS  # q and -q are one rotation
    pose = Pose(jnp.asarray(t), jnp.asarray(q), jnp.ones((NUM_JOINTS, 3)))
    for euler in (False, True):
        assert np.abs(joint_angles(pose, euler=euler)).max() < 1e-15


def test_euler_angles_are_finite_in_gimbal_lock(x64):
    q = Rotation.from_euler("XYZ", [0.3, np.pi / 2, 0.0]).as_quat()
    angles = np.asarray(pose_model._euler_angles(jnp.asarray(q)))
    # asin loses half the digits next to 1; the first and last angle turn about one axis there.
    assert np.isfinite(angles).all()
    assert angles[1] == pytest.approx(np.pi / 2, abs=1e-7)


# --- Prediction

NUM_POINTS, NUM_GROUPS, WIDTH, NUM_COMPONENTS, NUM_LOBES = 6, 2, 39, 4, 2


def arrays(seed=0, kind="surroundings"):
    """The tensors of a small model, as they stand in its file."""
    rng = np.random.default_rng(seed)
    groups = NUM_GROUPS if kind == "surroundings" else 1
    width = {"surroundings": 39, "given": 5}.get(kind, 27)

    def normal(*shape):
        return rng.normal(size=shape).astype(np.float32)

    return {
        "weights": normal(NUM_COMPONENTS + 1, 6 * NUM_LOBES, NUM_POINTS),
        "axes": oracles.unit(normal(NUM_POINTS, NUM_LOBES, 3)),
        "offset": normal(NUM_POINTS, 16),
        "groups": rng.integers(0, groups, NUM_POINTS).astype(np.int32),
        "points": rng.integers(0, NUM_POINTS, 10).astype(np.int32),
        "visible": np.array([True, True, False, True, True, True]),
        "features.joints": JOINTS.astype(np.int32),
        "features.bones": BONES[:groups].astype(np.int32),
        "features.falloff": FALLOFF[:groups].astype(np.float32),
        "features.reference": REFERENCE.as_quat().astype(np.float32),
        "features.translations": TRANSLATIONS.astype(np.float32),
        "features.mean": normal(groups, width),
        "features.basis": normal(groups, width, NUM_COMPONENTS),
    }


def header(kind="surroundings"):
    return {
        "format": pose_model.FORMAT,
        "version": pose_model.FORMAT_VERSION,
        "feature_kind": kind,
        "feature_size": SIZE,
        "errors": {"train": 0.1},
    }


def write(path, tensors, head):
    save_file(tensors, path, metadata={"header": head if isinstance(head, str) else json.dumps(head)})
    return path


@pytest.fixture
def model(tmp_path):
    return harmonics.load_pose_model(write(tmp_path / "m.safetensors", arrays(), header()))[0]


def test_prediction_by_loops(model, rng):
    components = rng.normal(size=(NUM_GROUPS, NUM_COMPONENTS)).astype(np.float32)
    axes, coefficients = jax.jit(harmonics.predict_lobes)(model, jnp.asarray(components))
    assert axes.shape == (NUM_POINTS, NUM_LOBES, 3)
    assert coefficients.shape == (NUM_POINTS, NUM_LOBES, 4)
    a = arrays()
    for p in range(NUM_POINTS):
        w = a["weights"][..., p].astype(np.float64)
        numbers = w[0] + components[a["groups"][p]] @ w[1:]
        for lobe in range(NUM_LOBES):
            q, c = numbers[2 * lobe : 2 * lobe + 2] / 2, numbers[2 * NUM_LOBES + 4 * lobe :][:4]
            frame = np.asarray(harmonics.zh_fit.reference_frames(jnp.asarray(a["axes"][p, lobe])))
            axis = frame @ np.r_[2 * q, 1 - q @ q] / (1 + q @ q)
            assert_close(axes[p, lobe], axis, ulps=ROUNDING, dtype=np.float32)
            assert_close(coefficients[p, lobe], c, ulps=ROUNDING, dtype=np.float32)


def test_zero_chart_is_the_reference_axis(model):
    numbers = jnp.zeros((NUM_POINTS, 6 * NUM_LOBES))
    axes, coefficients = pose_model.lobes_from_numbers(numbers, model.axes)
    assert_close(axes, model.axes, ulps=1, dtype=np.float32)
    assert not np.any(coefficients)


def test_half_precision_weights_are_summed_in_full(tmp_path, rng):
    tensors = arrays()
    tensors["weights"] = tensors["weights"].astype(np.float16)
    half, _ = harmonics.load_pose_model(write(tmp_path / "half", tensors, header()))
    assert half.weights.dtype == jnp.float16
    tensors["weights"] = tensors["weights"].astype(np.float32)
    full, _ = harmonics.load_pose_model(write(tmp_path / "full", tensors, header()))
    # Components of this size would overflow float16.
    components = jnp.asarray(1e5 * rng.normal(size=(NUM_GROUPS, NUM_COMPONENTS)), jnp.float32)
    got, expected = (harmonics.predict_lobes(m, components) for m in (half, full))
    assert got[0].dtype == got[1].dtype == jnp.float32
    assert_close(got, expected, ulps=8, dtype=np.float32)


def test_prediction_has_gradients(model, rng):
    components = rng.normal(size=(NUM_GROUPS, NUM_COMPONENTS))
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, model)
        check_grads(jax.jit(lambda c: harmonics.predict_lobes(wide, c)), (components,), order=1, modes=["rev"])


def test_features_of_each_kind(tmp_path, rng):
    pose = jax.tree.map(lambda x: x.astype(jnp.float32), random_pose(rng))
    globals = jnp.asarray(body(rng), jnp.float32)
    raw = {}
    for kind in ("surroundings", "exponential_map", "euler"):
        basis = harmonics.load_pose_model(write(tmp_path / kind, arrays(kind=kind), header(kind)))[0].features
        raw[kind] = harmonics.raw_features(basis, pose, globals)
        assert raw[kind].shape == basis.mean.shape
        components = harmonics.project_features(basis, raw[kind])
        expected = np.einsum("gn,gnk->gk", raw[kind] - basis.mean, basis.basis)
        assert_close(components, expected, ulps=ROUNDING, dtype=np.float32)
        assert not np.any(harmonics.project_features(basis, basis.mean))
    assert_close(raw["surroundings"], surroundings(globals), ulps=16, dtype=np.float32)
    for kind, euler in (("exponential_map", False), ("euler", True)):
        assert_close(raw[kind][0], joint_angles(pose, euler=euler), ulps=16, dtype=np.float32)


def test_projection_takes_leading_axes(model, rng):
    raw = jnp.asarray(rng.normal(size=(3, NUM_GROUPS, WIDTH)), jnp.float32)
    got = harmonics.project_features(model.features, raw)
    assert got.shape == (3, NUM_GROUPS, NUM_COMPONENTS)
    assert_close(harmonics.project_features(model.features, raw[1]), got[1], ulps=16, dtype=np.float32)


# --- Files


@pytest.mark.parametrize("kind", pose_model.FEATURE_KINDS)
def test_a_model_file_round_trips(kind, tmp_path):
    tensors = arrays(kind=kind)
    path = write(tmp_path / "m.safetensors", tensors | {"extra": np.ones(3)}, header(kind))
    model, head = harmonics.load_pose_model(str(path))
    assert head == header(kind)
    assert model.num_lobes == NUM_LOBES
    assert (model.features.kind, model.features.size) == (kind, SIZE)
    back = pose_model.model_arrays(model)
    assert back.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert back[name].dtype == tensor.dtype
        assert (back[name] == tensor).all()
    # The whole model is one pytree, static where it must be.
    assert len(jax.tree.leaves(model)) == len(tensors)


def test_hash_tells_models_apart(tmp_path):
    models = [harmonics.load_pose_model(write(tmp_path / f"{s}", arrays(s), header()))[0] for s in (0, 1)]
    hashes = [pose_model.model_hash(m) for m in (*models, models[0])]
    assert hashes[0] == hashes[2] != hashes[1]


def refused(path, field, message=""):
    with pytest.raises(InputError) as caught:
        harmonics.load_pose_model(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: {field}: expected "), text
    assert message in text
    assert "\n" not in text
    return text


def test_missing_and_unreadable_files(tmp_path):
    refused(tmp_path / "none.safetensors", "file", "a readable file")
    refused(tmp_path, "file", "a readable file")


def test_truncated_at_any_place(tmp_path):
    whole = write(tmp_path / "whole", arrays(), header()).read_bytes()
    for length in (0, 5, 8, 200, len(whole) // 2, len(whole) - 1):
        path = tmp_path / f"cut{length}"
        path.write_bytes(whole[:length])
        refused(path, "file", "a safetensors file with a JSON header")


def test_other_files(tmp_path, rng):
    path = tmp_path / "noise"
    path.write_bytes(rng.bytes(4000))
    refused(path, "file")
    path.write_text("glTF and nothing else, long enough for a header")
    refused(path, "file")


@pytest.mark.parametrize("text", ["", "{", "[1, 2", "[" * 100_000, '{"format": NaN,}'])
def test_header_that_is_no_json(text, tmp_path):
    refused(write(tmp_path / "m", arrays(), text), "file", "JSON header")


@pytest.mark.parametrize("text", ["null", "[]", "3", '"x"', "{}"])
def test_header_that_is_no_model(text, tmp_path):
    refused(write(tmp_path / "m", arrays(), text), "format", pose_model.FORMAT)


def test_no_header(tmp_path):
    save_file(arrays(), tmp_path / "m")
    refused(tmp_path / "m", "format", "got no header")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("format", "other"), ("version", 3), ("version", None), ("version", "1"), ("feature_kind", "angles"),
        ("feature_kind", None), ("feature_size", 0), ("feature_size", -1.0), ("feature_size", float("nan")),
        ("feature_size", float("inf")), ("feature_size", "2"), ("feature_size", True), ("feature_size", None),
    ],
)  # fmt: skip
def test_bad_header_fields(field, value, tmp_path):
    refused(write(tmp_path / "m", arrays(), header() | {field: value}), field, f"got {value}")


@pytest.mark.parametrize("name", arrays())
def test_missing_tensors_and_shapes(name, tmp_path):
    tensors = arrays()
    path = write(tmp_path / "missing", {k: v for k, v in tensors.items() if k != name}, header())
    refused(path, name, "got none")
    refused(write(tmp_path / "rank", tensors | {name: tensors[name][None]}, header()), name, "axes, got shape")


# One row too many; where the array defines a size, the one that has to follow it is named.
NAMED_FOR = {
    "weights": "features.basis",
    "axes": "weights",
    "groups": "groups",
    "features.joints": "features.falloff",
    "features.mean": "features.bones",
}


@pytest.mark.parametrize("name", [k for k in arrays() if k != "points"])
def test_one_row_too_many(name, tmp_path):
    tensors = arrays()
    longer = np.concatenate([tensors[name], tensors[name][:1]])
    kind = "surroundings"
    if name == "features.joints":  # whose number is in the width of the features, too
        tensors |= {"features.mean": np.zeros((2, 52), np.float32)}
    path = write(tmp_path / "m", tensors | {name: longer}, header(kind))
    refused(path, NAMED_FOR.get(name, name), "expected shape")


def test_types_are_checked(tmp_path):
    tensors = arrays()
    for name, dtype in [
        ("weights", np.float64), ("weights", np.int32), ("axes", np.complex64), ("groups", np.float32),
        ("points", np.uint8), ("visible", np.uint8), ("features.joints", np.int16),
    ]:  # fmt: skip
        path = write(tmp_path / "m", tensors | {name: tensors[name].astype(dtype)}, header())
        refused(path, name, f"got {np.dtype(dtype).name}")
    for name in ("groups", "points", "features.joints", "features.bones"):
        wide = tensors | {name: tensors[name].astype(np.int64)}
        harmonics.load_pose_model(write(tmp_path / "m", wide, header()))


@pytest.mark.parametrize("kind", ["BF16", "F8_E4M3"])
def test_number_types_that_numpy_lacks(kind, tmp_path):
    size = 2 if kind == "BF16" else 1
    head = {"weights": {"dtype": kind, "shape": [4], "data_offsets": [0, 4 * size]}}
    head["__metadata__"] = {"header": json.dumps(header())}
    text = json.dumps(head).encode()
    path = tmp_path / "m"
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(4 * size))
    # Where a library has taught NumPy the type it is named as the wrong one for this tensor.
    with pytest.raises(InputError, match=r": (weights: expected float32 or float16|tensors: expected types)"):
        harmonics.load_pose_model(path)


@pytest.mark.parametrize("name", [k for k, v in arrays().items() if v.dtype == np.float32])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_must_be_finite(name, value, tmp_path):
    tensors = arrays()
    tensors[name].flat[-1] = value
    refused(write(tmp_path / "m", tensors, header()), name, "got 1 NaN or Inf, first at ")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("groups", NUM_GROUPS, "indices from 0 to 1"),
        ("groups", -1, "indices from 0 to 1"),
        ("points", NUM_POINTS, "indices from 0 to 5"),
        ("points", -3, "indices from 0 to 5, got -3"),
        ("features.joints", -1, "indices from 0"),
        ("features.bones", -1, "indices from 0"),
        ("features.bones", 2**40, "indices from 0"),
    ],
)
def test_indices_stay_inside(name, value, message, tmp_path):
    tensors = arrays()
    tensors[name] = tensors[name].astype(np.int64)
    tensors[name][0] = value
    refused(write(tmp_path / "m", tensors, header()), name, message)


def test_shapes_must_fit_together(tmp_path):
    tensors = arrays()

    def changed(**change):
        return write(tmp_path / "m", tensors | {k.replace("__", "."): v for k, v in change.items()}, header())

    refused(changed(axes=tensors["axes"][:, :1]), "weights", "shape (5, 6, 6)")
    refused(changed(axes=tensors["axes"][:, :0]), "weights", "at least one lobe")
    refused(changed(weights=tensors["weights"][:0]), "weights", "a bias row")
    refused(changed(offset=tensors["offset"][:, :9]), "offset", "shape (6, 16), got shape (6, 9)")
    refused(changed(features__mean=tensors["features.mean"][:, :38]), "features.mean", "shape (2, 39)")
    refused(changed(features__basis=tensors["features.basis"][..., :3]), "features.basis", "shape (2, 39, 4)")
    path = write(tmp_path / "m", tensors, header("euler"))
    refused(path, "features.mean", "one group for euler, got 2 groups")


def test_file_is_plain_safetensors(tmp_path):
    """Other programs can read it without this package."""
    path = write(tmp_path / "m", arrays(), header())
    assert load_file(path).keys() == arrays().keys()
