"""Linear blend skinning against NumPy loops, geometry and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxrender.animation import skinning
from jaxrender.animation.skeleton import Pose, global_matrices, rotation_vector_to_quaternion
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import ROUNDING

skin_mesh = jax.jit(skinning.skin_mesh)
transform_normals = jax.jit(skinning.transform_normals)

NUM_JOINTS, PALETTE = 4, (3, 0, 2, 2, 1)


def affine(rng, *shape):
    matrices = np.zeros((*shape, 4, 4))
    matrices[..., :3, :] = rng.normal(size=(*shape, 3, 4))
    matrices[..., 3, 3] = 1.0
    return matrices


def random_skin(rng, *, num_vertices=30, num_influences=3, dtype=np.float32):
    weights = rng.uniform(size=(num_vertices, num_influences))
    return skinning.Skin(
        vertices=jnp.asarray(rng.normal(size=(num_vertices, 3)), dtype=dtype),
        normals=jnp.asarray(oracles.unit(rng.normal(size=(num_vertices, 3))), dtype=dtype),
        joint_indices=jnp.asarray(rng.integers(0, len(PALETTE), (num_vertices, num_influences)), dtype=jnp.int32),
        weights=jnp.asarray(weights / weights.sum(-1, keepdims=True), dtype=dtype),
        palette_joints=jnp.asarray(PALETTE, dtype=jnp.int32),
        inverse_binds=jnp.asarray(affine(rng, len(PALETTE)), dtype=dtype),
    )


def blended_by_loops(skin, world):
    """The blended 4x4 matrix of every frame and vertex in float64."""
    frames, v = world.shape[0], skin.weights.shape[0]
    blended = np.zeros((frames, v, 4, 4))
    for f in range(frames):
        for i in range(v):
            for entry, weight in zip(skin.joint_indices[i], skin.weights[i], strict=True):
                joint = int(skin.palette_joints[entry])
                bind = np.asarray(skin.inverse_binds[entry], dtype=np.float64)
                blended[f, i] += float(weight) * np.asarray(world[f, joint], dtype=np.float64) @ bind
    return blended


@pytest.mark.parametrize("num_influences", [1, 3, 7])
def test_positions_and_frames_against_loops(rng, dtype, num_influences):
    skin = random_skin(rng, num_influences=num_influences, dtype=dtype)
    world = jnp.asarray(affine(rng, 2, NUM_JOINTS), dtype=dtype)
    mesh = skin_mesh(skin, world)
    assert mesh.positions.shape == (2, 30, 3) and mesh.frames.shape == (2, 30, 3, 3)
    assert mesh.positions.dtype == mesh.frames.dtype == dtype

    blended = blended_by_loops(skin, world)
    vertices = np.asarray(skin.vertices, dtype=np.float64)
    positions = np.einsum("fvij,vj->fvi", blended[..., :3, :3], vertices) + blended[..., :3, 3]
    assert_close(mesh.positions, positions, ulps=ROUNDING, dtype=dtype)
    inverse_transposes = np.linalg.inv(blended[..., :3, :3]).swapaxes(-1, -2)
    normals = oracles.unit(np.einsum("fvij,vj->fvi", inverse_transposes, np.asarray(skin.normals, dtype=np.float64)))
    # Random matrices have condition numbers up to a few hundred, and cofactors lose as many ulps.
    assert_close(mesh.frames[..., 2], normals, ulps=64 * ROUNDING, dtype=dtype)


def test_frames_are_right_handed_rotations_whatever_the_matrices(rng, dtype):
    skin = random_skin(rng, dtype=dtype)
    frames = skin_mesh(skin, jnp.asarray(affine(rng, 3, NUM_JOINTS), dtype=dtype)).frames
    gram = np.einsum("...ji,...jk->...ik", frames, frames)
    assert_close(gram, np.broadcast_to(np.eye(3), gram.shape), ulps=ROUNDING, dtype=dtype)
    assert (np.linalg.det(np.asarray(frames)) > 0).all()


def test_frames_turn_with_a_rigid_motion(rng):
    """Moving the whole skeleton by R turns every frame by R: a frame carries no memory of world axes."""
    skin = random_skin(rng)
    world = affine(rng, NUM_JOINTS)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=3).as_matrix()
    motion[:3, 3] = [0.3, -2.0, 1.0]
    still = skin_mesh(skin, jnp.asarray(world, dtype=jnp.float32))
    moved = skin_mesh(skin, jnp.asarray(motion @ world, dtype=jnp.float32))
    expected = motion[:3, :3] @ np.asarray(still.frames, dtype=np.float64)
    # Tangents nearly along the normal (random matrices squeeze some) lose digits when made orthogonal.
    assert_close(moved.frames, expected, ulps=256 * ROUNDING, dtype=np.float32)


def test_rest_pose_is_the_rest_surface(rng):
    skin = random_skin(rng)
    world = jnp.asarray(affine(rng, NUM_JOINTS), dtype=jnp.float32)
    binds = np.linalg.inv(np.asarray(world, dtype=np.float64))[list(PALETTE)]
    skin = skinning.Skin(
        vertices=skin.vertices,
        normals=skin.normals,
        joint_indices=skin.joint_indices,
        weights=skin.weights,
        palette_joints=skin.palette_joints,
        inverse_binds=jnp.asarray(binds, dtype=jnp.float32),
    )
    mesh = skin_mesh(skin, world)
    # G B = 1 holds to the condition of G, below 100 here.
    assert_close(mesh.positions, skin.vertices, ulps=100 * ROUNDING, dtype=np.float32)
    assert_close(mesh.frames[..., 2], skin.normals, ulps=100 * ROUNDING, dtype=np.float32)


def test_normals_stay_orthogonal_to_the_surface_under_any_scale_and_shear(rng, dtype):
    linear = rng.normal(size=(200, 3, 3)) * np.array([1.0, 0.03, 30.0])
    edges = rng.normal(size=(2, 200, 3))
    normals = oracles.unit(np.cross(edges[0], edges[1]))
    mapped = transform_normals(jnp.asarray(linear, dtype=dtype), jnp.asarray(normals, dtype=dtype))
    expected = oracles.unit(np.linalg.solve(linear.swapaxes(1, 2), normals[..., None])[..., 0])
    # Conditioning: axes of 0.03 and 30 put a factor of 1000 on the rounding of the inputs.
    assert_close(mapped, expected, ulps=1000 * ROUNDING, dtype=dtype)


def test_mirrored_surface_keeps_its_outside():
    mirror = jnp.asarray(np.diag([-2.0, 1.0, 1.0]), dtype=jnp.float32)
    normal = transform_normals(mirror, jnp.asarray([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(normal, oracles.unit(np.array([-0.3, 0.0, 0.8])), rtol=0, atol=1e-7)


def test_flattened_surface_has_a_normal_and_a_vanished_one_has_none():
    flat = jnp.asarray(np.diag([1.0, 1.0, 0.0]), dtype=jnp.float32)
    np.testing.assert_array_equal(transform_normals(flat, jnp.asarray([0.6, 0.0, 0.8])), [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(transform_normals(jnp.zeros((3, 3)), jnp.asarray([0.0, 0.0, 1.0])), np.zeros(3))


def test_batches_and_jit(rng):
    skin = random_skin(rng)
    world = jnp.asarray(affine(rng, 2, 3, NUM_JOINTS), dtype=jnp.float32)
    mesh = skin_mesh(skin, world)
    assert mesh.frames.shape == (2, 3, 30, 3, 3)
    one = skinning.skin_mesh(skin, world[1, 2])
    assert_close(mesh.positions[1, 2], one.positions, ulps=8, dtype=np.float32)
    mapped = jax.jit(jax.vmap(jax.vmap(lambda w: skinning.skin_mesh(skin, w))))(world)
    assert_close(mapped, mesh, ulps=ROUNDING, dtype=np.float32)


def bend(skin, rotation_vectors):
    """Positions and normals of a chain of joints bent by rotation vectors."""
    num_joints = rotation_vectors.shape[0]
    pose = Pose(
        translation=jnp.tile(jnp.asarray([[0.0, 0.5, 0.1]], dtype=rotation_vectors.dtype), (num_joints, 1)),
        rotation=rotation_vector_to_quaternion(rotation_vectors),
        scale=jnp.ones((num_joints, 3), dtype=rotation_vectors.dtype),
    )
    world = global_matrices(pose, parents=tuple(range(-1, num_joints - 1)))
    mesh = skinning.skin_mesh(skin, world)
    return jnp.concatenate([mesh.positions, mesh.frames.reshape(-1, 9)], axis=-1)


def test_gradient_in_joint_rotations_by_finite_differences(rng):
    with jax.enable_x64(True):
        skin = random_skin(rng, num_vertices=8, dtype=np.float64)
        angles = jnp.asarray(rng.normal(size=(NUM_JOINTS, 3)))
        angles = angles.at[0].set(0.0)  # the hard point of the exponential map
        direction = jnp.asarray(rng.normal(size=(NUM_JOINTS, 3)))
        f = jax.jit(lambda a: bend(skin, a))
        _, slope = jax.jvp(f, (angles,), (direction,))
        h = 1e-6
        difference = (f(angles + h * direction) - f(angles - h * direction)) / (2 * h)
        # Central differences at h = 1e-6: rounding 1e-10 of values up to 10, times curvature of the frames.
        np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-7)
        # Reverse mode is the transpose of forward mode.
        weights = jnp.asarray(rng.normal(size=slope.shape))
        gradient = jax.grad(lambda a: jnp.sum(weights * f(a)))(angles)
        np.testing.assert_allclose(jnp.sum(gradient * direction), jnp.sum(weights * slope), rtol=1e-10)


def test_gradient_is_finite_where_matrices_vanish(rng):
    skin = random_skin(rng, num_vertices=4)
    world = jnp.zeros((NUM_JOINTS, 4, 4))
    gradient = jax.jit(jax.grad(lambda w: jnp.sum(skinning.skin_mesh(skin, w).frames)))(world)
    assert np.isfinite(gradient).all()
