"""Quaternions, samplers and forward kinematics against SciPy, closed forms and NumPy matrix products."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from jaxrender.animation import skeleton as sk
from tests.support.asserts import assert_close
from tests.support.tolerances import ROUNDING

# Angles at which the maps between rotation vectors and quaternions change formula, and their ends.
ANGLES = [0.0, 1e-30, 1e-9, 1e-5, 1e-4, 1e-3, 1.8e-2, 1.9e-2, 0.13, 0.14, 1.0, 3.0, np.pi - 1e-5]

# Compiled: a kernel run step by step would compile every step by itself.
to_quaternion = jax.jit(sk.rotation_vector_to_quaternion)
to_rotation_vector = jax.jit(sk.quaternion_to_rotation_vector)
slerp = jax.jit(sk.slerp)
sample_keys = jax.jit(sk.sample_keys, static_argnames=("interpolation", "rotation"))
global_matrices = jax.jit(sk.global_matrices, static_argnames="parents")


def sample_clip(clip, skeleton, times):
    return jax.jit(lambda t: sk.sample_clip(clip, skeleton, t))(times)


def unit_quaternions(rng, *shape):
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def axes(rng, n):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def random_pose(rng, *shape, dtype=np.float32):
    return sk.Pose(
        translation=jnp.asarray(rng.normal(size=(*shape, 3)), dtype=dtype),
        rotation=jnp.asarray(unit_quaternions(rng, *shape), dtype=dtype),
        scale=jnp.asarray(rng.uniform(0.5, 2.0, size=(*shape, 3)), dtype=dtype),
    )


def same_rotation(a, b, *, ulps, dtype):
    """q and -q are one rotation."""
    sign = np.sign((np.asarray(a) * np.asarray(b)).sum(-1, keepdims=True))
    assert_close(np.asarray(a) * sign, np.asarray(b), ulps=ulps, dtype=dtype)


# --- quaternions ---


def test_matrix_is_scipys(rng, dtype):
    q = unit_quaternions(rng, 5, 7)
    matrix = sk.quaternion_to_matrix(jnp.asarray(q, dtype=dtype))
    assert matrix.shape == (5, 7, 3, 3) and matrix.dtype == dtype
    expected = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(5, 7, 3, 3)
    assert_close(matrix, expected, ulps=ROUNDING, dtype=dtype)


def test_product_turns_by_the_right_factor_first(rng, dtype):
    a, b = unit_quaternions(rng, 20), unit_quaternions(rng, 20)
    product = sk.quaternion_multiply(jnp.asarray(a, dtype=dtype), jnp.asarray(b, dtype=dtype))
    expected = (Rotation.from_quat(a) * Rotation.from_quat(b)).as_matrix()
    assert_close(sk.quaternion_to_matrix(product), expected, ulps=ROUNDING, dtype=dtype)


def test_conjugate_is_the_inverse(rng):
    q = jnp.asarray(unit_quaternions(rng, 20), dtype=jnp.float32)
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (20, 1))
    assert_close(sk.quaternion_multiply(q, sk.quaternion_conjugate(q)), identity, ulps=8, dtype=np.float32)


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_map_and_back(rng, dtype, angle):
    r = angle * axes(rng, 8)
    q = to_quaternion(jnp.asarray(r, dtype=dtype))
    expected = Rotation.from_rotvec(r).as_quat(canonical=True)
    assert_close(q, expected, ulps=8, dtype=dtype)
    # Relative to the vector itself, so that small angles keep all their digits.
    back = to_rotation_vector(q)
    assert_close(back, r.astype(dtype), ulps=16, dtype=dtype)


def test_logarithm_takes_the_short_way_and_scipys_angle(rng, dtype):
    q = unit_quaternions(rng, 50)
    r = to_rotation_vector(jnp.asarray(q, dtype=dtype))
    assert_close(r, Rotation.from_quat(q).as_rotvec(), ulps=ROUNDING, dtype=dtype)
    assert_close(r, to_rotation_vector(jnp.asarray(-q, dtype=dtype)), ulps=1, dtype=dtype)
    assert np.linalg.norm(np.asarray(r), axis=-1).max() <= np.pi * (1 + 4 * np.finfo(dtype).eps)


def test_exponential_map_has_its_derivative_at_zero():
    jacobian = jax.jacobian(to_quaternion)(jnp.zeros(3))
    assert_close(jacobian, np.vstack([0.5 * np.eye(3), np.zeros((1, 3))]), ulps=1)
    jacobian = jax.jacobian(to_rotation_vector)(jnp.asarray([0.0, 0.0, 0.0, 1.0]))
    assert_close(jacobian[:, :3], 2.0 * np.eye(3), ulps=1)
    assert np.isfinite(jacobian).all()


@pytest.mark.parametrize("angle", [0.05, 0.2, 1.0, 3.0])
def test_exponential_map_derivative_by_finite_differences(rng, angle):
    with jax.enable_x64(True):
        r = jnp.asarray(angle * axes(rng, 1)[0])
        for f in (
            to_quaternion,
            jax.jit(lambda v: to_rotation_vector(to_quaternion(v))),
        ):
            h = 1e-5
            steps = [(f(r + h * e) - f(r - h * e)) / (2 * h) for e in jnp.eye(3)]
            # Central differences: h² of truncation and eps/h of rounding, both about 1e-10.
            np.testing.assert_allclose(jax.jacobian(f)(r), np.stack(steps, axis=-1), rtol=0, atol=2e-9)


# --- interpolation ---


def test_slerp_is_scipys(rng, dtype):
    a, b = unit_quaternions(rng, 10), unit_quaternions(rng, 10)
    for t in (0.0, 0.3, 0.5, 1.0):
        share = jnp.full((10, 1), t, dtype=dtype)
        got = slerp(jnp.asarray(a, dtype=dtype), jnp.asarray(b, dtype=dtype), share)
        pairs = zip(a, b, strict=True)
        expected = [Slerp([0, 1], Rotation.from_quat([p, q]))(t).as_quat() for p, q in pairs]
        # Half-turns amplify rounding by 1/sin(angle), at most about 10 for these pairs.
        same_rotation(got, np.array(expected), ulps=8 * ROUNDING, dtype=dtype)


def test_slerp_of_opposite_signs_goes_the_short_way(rng):
    a = jnp.asarray(unit_quaternions(rng, 10), dtype=jnp.float32)
    b = jnp.asarray(unit_quaternions(rng, 10), dtype=jnp.float32)
    t = jnp.full((10, 1), 0.4)
    assert_close(slerp(a, -b, t), slerp(a, b, t), ulps=1, dtype=np.float32)
    middle = np.asarray(slerp(a, b, jnp.full((10, 1), 0.5)))
    assert (np.abs((middle * np.asarray(a)).sum(-1)) >= np.cos(np.pi / 4) - 1e-6).all()


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-5, 1e-3, 4e-3, 6e-3, 0.1, 3.0])
def test_slerp_turns_evenly_however_small_the_angle(dtype, angle):
    """About one axis the result is the rotation by t times the angle, to rounding of the angle's sine."""
    a = jnp.asarray([[0.0, 0.0, 0.0, 1.0]], dtype=dtype)
    b = jnp.asarray([[np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2)]], dtype=dtype)
    got = slerp(a, b, jnp.full((1, 1), 0.3, dtype=dtype))
    assert_close(got[:, :1], np.array([[np.sin(0.15 * angle)]]), ulps=ROUNDING, dtype=dtype)


def test_slerp_of_equal_rotations_has_finite_gradients():
    a = jnp.asarray([[0.0, 0.6, 0.0, 0.8]])
    t = jnp.asarray([[0.5]])
    gradients = jax.jit(jax.grad(lambda a, b, t: jnp.sum(slerp(a, b, t)[:, 1]), argnums=(0, 1, 2)))(a, a, t)
    assert all(np.isfinite(g).all() for g in gradients)
    # Moving both keys along moves the result along: the two halves add up to the derivative of q / |q|.
    expected = np.array([0, 1, 0, 0]) - 0.6 * np.array([0.0, 0.6, 0.0, 0.8])
    assert_close(gradients[0] + gradients[1], expected[None], ulps=8, dtype=np.float32)


def test_cubic_spline_is_scipys(rng):
    start, end, out, into = rng.normal(size=(4, 3))
    spline = CubicHermiteSpline([0.0, 0.7], [start, end], [out, into])
    for t in (0.0, 0.25, 0.8, 1.0):
        with jax.enable_x64(True):
            parts = (jnp.asarray(x)[None] for x in (start, out, end, into))
            got = sk.cubic_spline(*parts, jnp.asarray([[t]]), span=jnp.asarray([[0.7]]))
        assert_close(got, spline(0.7 * t)[None], ulps=ROUNDING)


def test_samplers_at_between_and_outside_the_keys():
    times = jnp.asarray([1.0, 2.0, 4.0])
    values = jnp.asarray([[0.0], [10.0], [20.0]])
    at = jnp.asarray([-5.0, 1.0, 1.25, 2.0, 3.0, 4.0, 9.0])
    linear = sample_keys(times, values, at, interpolation="LINEAR", rotation=False)
    np.testing.assert_array_equal(linear[:, 0], [0, 0, 2.5, 10, 15, 20, 20])
    step = sample_keys(times, values, at, interpolation="STEP", rotation=False)
    np.testing.assert_array_equal(step[:, 0], [0, 0, 0, 10, 10, 20, 20])
    # With the tangents of the line itself the spline is the line: slopes 10 then 5.
    cubic = jnp.stack([jnp.asarray([[10.0], [10.0], [5.0]]), values, jnp.asarray([[10.0], [5.0], [5.0]])], 1)
    spline = sample_keys(times, cubic, at, interpolation="CUBICSPLINE", rotation=False)
    assert_close(spline, linear, ulps=8, dtype=np.float32)


def test_spline_of_rotations_is_of_unit_length_and_keeps_its_keys(rng):
    times = jnp.asarray([0.0, 0.5, 1.5])
    values = rng.normal(size=(3, 3, 4))
    values[:, 1] = unit_quaternions(rng, 3)
    values = jnp.asarray(values, dtype=jnp.float32)
    at = jnp.linspace(-0.5, 2.0, 26)
    q = sample_keys(times, values, at, interpolation="CUBICSPLINE", rotation=True)
    assert_close(jnp.linalg.norm(q, axis=-1), np.ones(26), ulps=4, dtype=np.float32)
    at_keys = sample_keys(times, values, times, interpolation="CUBICSPLINE", rotation=True)
    assert_close(at_keys, values[:, 1], ulps=4, dtype=np.float32)


def test_linear_rotations_keep_their_keys_signs_included(rng):
    times = jnp.asarray([0.0, 0.5, 1.5])
    keys = unit_quaternions(rng, 3)
    keys[2] *= -np.sign(keys[1] @ keys[2])  # more than a quarter turn on the sphere of quaternions
    keys = jnp.asarray(keys, dtype=jnp.float32)
    at = jnp.asarray([-1.0, 0.0, 0.5, 1.5, 9.0])
    got = sample_keys(times, keys, at, interpolation="LINEAR", rotation=True)
    assert_close(got, keys[jnp.asarray([0, 0, 1, 2, 2])], ulps=4, dtype=np.float32)


@pytest.mark.parametrize("interpolation", ["STEP", "LINEAR", "CUBICSPLINE"])
def test_one_key_is_a_constant(interpolation):
    value = jnp.asarray([[1.0, 2.0, 3.0]])
    values = jnp.stack([value, value, value], axis=1) if interpolation == "CUBICSPLINE" else value
    got = sample_keys(
        jnp.asarray([2.0]), values, jnp.asarray([0.0, 2.0, 5.0]), interpolation=interpolation, rotation=False
    )
    np.testing.assert_array_equal(got, np.tile(value, (3, 1)))


# --- clips ---


def two_joints(rng):
    return sk.Skeleton(("root", "tip"), (-1, 0), random_pose(rng, 2))


def clip_of_many_kinds(rng):
    """Channels of unequal length and kind, so that batches have to be filled up."""

    def channel(joint, path, interpolation, num_keys):
        size = 4 if path == "rotation" else 3
        shape = (num_keys, 3, size) if interpolation == "CUBICSPLINE" else (num_keys, size)
        values = rng.normal(size=shape)
        if path == "rotation":
            keys = values[:, 1] if interpolation == "CUBICSPLINE" else values
            keys /= np.linalg.norm(keys, axis=-1, keepdims=True)
        times = np.cumsum(rng.uniform(0.1, 0.5, size=num_keys)).astype(np.float32)
        return sk.Channel(joint, path, interpolation, times, values.astype(np.float32))

    channels = (
        channel(0, "translation", "LINEAR", 6),
        channel(1, "translation", "LINEAR", 2),
        channel(0, "rotation", "CUBICSPLINE", 5),
        channel(1, "rotation", "CUBICSPLINE", 3),
        channel(1, "scale", "STEP", 4),
    )
    return sk.Clip("all", channels, 0.0, 3.0)


def test_clip_is_its_channels_and_the_rest_pose_elsewhere(rng):
    skeleton, clip = two_joints(rng), clip_of_many_kinds(rng)
    times = jnp.linspace(-0.5, 30.0, 200)
    pose = sample_clip(clip, skeleton, times)
    assert pose.rotation.shape == (200, 2, 4)
    moved = {(channel.joint, channel.path): channel for channel in clip.channels}
    for path in ("translation", "rotation", "scale"):
        for joint in range(2):
            got = getattr(pose, path)[:, joint]
            channel = moved.get((joint, path))
            if channel is None:
                expected = np.tile(getattr(skeleton.rest, path)[joint], (200, 1))
            else:
                expected = sample_keys(
                    jnp.asarray(channel.times),
                    jnp.asarray(channel.values),
                    times,
                    interpolation=channel.interpolation,
                    rotation=path == "rotation",
                )
            assert_close(got, expected, ulps=8, dtype=np.float32, what=f"{path} of {joint}")


def test_clip_in_float64_keeps_float64(rng):
    skeleton, clip = two_joints(rng), clip_of_many_kinds(rng)
    with jax.enable_x64(True):
        pose = sample_clip(clip, skeleton, jnp.asarray([0.3, 0.4]))
        assert {leaf.dtype for leaf in jax.tree.leaves(pose)} == {np.dtype(np.float64)}


def test_clip_with_late_keys_is_filled_up_without_equal_times():
    """At 2e7 seconds float32 cannot count seconds: the filling has to step further."""
    short = sk.Channel(0, "scale", "LINEAR", np.float32([1e7, 2e7]), np.float32([[1, 1, 1], [2, 2, 2]]))
    times = np.linspace(0, 1, 9, dtype=np.float32)
    long = sk.Channel(1, "scale", "LINEAR", times, np.ones((9, 3), np.float32))
    rest = sk.Pose(jnp.zeros((2, 3)), jnp.tile(jnp.asarray([0.0, 0.0, 0.0, 1.0]), (2, 1)), jnp.ones((2, 3)))
    skeleton = sk.Skeleton(("a", "b"), (-1, -1), rest)
    pose = sample_clip(sk.Clip("late", (short, long), 0.0, 2e7), skeleton, jnp.asarray([1.5e7, 2e7, 3e7]))
    np.testing.assert_array_equal(pose.scale[:, 0, 0], [1.5, 2.0, 2.0])


def test_clip_without_channels_is_the_rest_pose(rng):
    skeleton = two_joints(rng)
    pose = sample_clip(sk.Clip("still", (), 0.0, 0.0), skeleton, jnp.asarray([0.0, 1.0, 2.0]))
    assert_close(pose.rotation, np.tile(skeleton.rest.rotation, (3, 1, 1)), ulps=1, dtype=np.float32)


# --- matrices ---


def test_forward_kinematics_is_the_product_of_matrices(rng, dtype):
    parents = (-1, 0, 1, 1, 0, -1, 5, 3, 6)
    pose = random_pose(rng, 4, len(parents), dtype=dtype)
    world = global_matrices(pose, parents=parents)
    assert world.shape == (4, 9, 4, 4) and world.dtype == dtype
    expected = np.zeros((4, 9, 4, 4))
    for frame in range(4):
        for joint, parent in enumerate(parents):
            local = np.eye(4)
            rotation = Rotation.from_quat(np.asarray(pose.rotation[frame, joint], dtype=np.float64))
            local[:3, :3] = rotation.as_matrix() @ np.diag(pose.scale[frame, joint])
            local[:3, 3] = pose.translation[frame, joint]
            expected[frame, joint] = local if parent < 0 else expected[frame, parent] @ local
    assert_close(world, expected, ulps=ROUNDING, dtype=dtype)


def test_batch_is_a_loop_and_jit_is_eager(rng):
    parents = (-1, 0, 0, 2)
    pose = random_pose(rng, 3, 4)
    world = global_matrices(pose, parents=parents)
    one = sk.global_matrices(jax.tree.map(lambda x: x[1], pose), parents=parents)
    assert_close(world[1], one, ulps=1, dtype=np.float32)
    compiled = jax.jit(lambda p: sk.global_matrices(p, parents=parents))(pose)
    assert_close(compiled, world, ulps=8, dtype=np.float32)


@pytest.mark.parametrize("parents", [(0,), (-1, 2, 0), (-2,)])
def test_parent_after_its_child_is_refused(rng, parents):
    with pytest.raises(ValueError, match="parents: expected -1 or a joint before"):
        sk.global_matrices(random_pose(rng, len(parents)), parents=parents)
