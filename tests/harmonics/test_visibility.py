"""Visibility by rays: closed surfaces, analytic occluders, the quality of the directions, bits and chunks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from jaxrender import harmonics, vecmath
from jaxrender.checks import InputError
from jaxrender.harmonics import visibility as module
from jaxrender.harmonics.visibility import unpack_visibility
from jaxrender.pathtrace import embree
from tests.support import oracles
from tests.support.asserts import assert_close
from tests.support.tolerances import ROUNDING

NUM_DIRECTIONS = 256
DIRECTIONS = harmonics.hemisphere_directions(NUM_DIRECTIONS)

_frames = jax.jit(lambda n: vecmath.frame_from_normal_tangent(n, vecmath.orthonormal_tangent(n)))


def frames_around(normals):
    return np.asarray(_frames(jnp.asarray(normals, jnp.float32)))


def icosphere(subdivisions):
    """Vertices, which are the normals too, and faces of the unit sphere."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return normals, np.asarray(mesh.faces)


def visible(*arguments, directions=DIRECTIONS, **options):
    """The packed answer as booleans (p, d)."""
    bits = harmonics.trace_visibility(*arguments, directions, **options)
    return np.unpackbits(bits, axis=1, count=len(directions)).astype(bool)


# --- Directions


def test_directions_are_equal_area_points_of_the_upper_hemisphere():
    for count in (1, 7, 256):
        d = harmonics.hemisphere_directions(count)
        assert d.shape == (count, 3)
        assert (d[:, 2] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0, atol=1e-15)
        # z is uniform in (0, 1): each of the bands of equal area holds one point.
        assert (np.floor(np.sort(d[:, 2]) * count) == np.arange(count)).all()
    assert np.abs(DIRECTIONS.mean(0) - [0, 0, 0.5]).max() < 2e-3
    with pytest.raises(ValueError, match="num_directions: expected a value >= 1, got 0"):
        harmonics.hemisphere_directions(0)


def jittered_strata(rng, side):
    u, v = (np.indices((side, side)).reshape(2, -1) + rng.uniform(size=(2, side * side))) / side
    r = np.sqrt(1.0 - u * u)
    return np.stack([r * np.cos(2 * np.pi * v), r * np.sin(2 * np.pi * v), u], axis=-1)


def random_occluders(rng, count):
    """Functions of direction: visible unless within one of up to four caps."""
    for _ in range(count):
        number = rng.integers(1, 5)
        axes = rng.normal(size=(number, 3)) + [0, 0, 0.5]
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        cosines = np.cos(rng.uniform(0.2, 0.8, size=number))
        yield lambda d, axes=axes, cosines=cosines: (d @ axes.T < cosines).all(axis=1)


def test_directions_beat_jittered_strata_by_two(rng):
    reference = harmonics.hemisphere_directions(1 << 16)
    errors = {"fibonacci": [], "jittered": []}
    for sees in random_occluders(rng, 40):
        truth = sees(reference) @ harmonics.projection_table(reference, order=4)
        sets = {"fibonacci": DIRECTIONS, "jittered": jittered_strata(rng, 16)}
        for name, d in sets.items():
            left = sees(d) @ harmonics.projection_table(d, order=4) - truth
            errors[name].append(np.linalg.norm(left) / np.linalg.norm(truth))
    assert np.mean(errors["fibonacci"]) < 0.03
    assert np.mean(errors["fibonacci"]) < 0.6 * np.mean(errors["jittered"])


def test_projection_of_the_open_hemisphere():
    """Sum over 256 points against the exact integral of each harmonic."""
    got = harmonics.projection_table(DIRECTIONS, order=4).sum(0)
    expected = np.zeros(16)
    expected[[0, 2, 6, 12]] = np.asarray(harmonics.hemisphere_zh(order=4))
    np.testing.assert_allclose(got, expected, atol=0.02)
    assert np.linalg.norm(got - expected) < 0.01 * np.linalg.norm(expected)


# --- Closed convex surfaces see their whole hemisphere


@pytest.mark.parametrize("subdivisions", [0, 1, 2, 3, 4])
def test_closed_sphere_sees_everything(subdivisions):
    normals, faces = icosphere(subdivisions)
    assert visible(normals, frames_around(normals), faces).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("centre", [0.0, 1e3])
def test_closed_sphere_at_any_scale_and_place(scale, centre):
    normals, faces = icosphere(3)
    positions = scale * normals + np.array([centre, -centre, 0.5 * centre])
    assert visible(positions, frames_around(normals), faces).all()


def test_closed_sphere_far_away_in_float32():
    """Vertices are rounded to a grid of 6e-5 there; the offset, 3e-4, stands above it."""
    normals, faces = icosphere(3)
    positions = (normals + 1e3).astype(np.float32)
    assert visible(positions, frames_around(normals), faces).all()


def test_sphere_with_slivers_sees_everything():
    mesh = trimesh.creation.uv_sphere(count=[24, 64])
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert visible(normals, frames_around(normals), np.asarray(mesh.faces)).all()


def test_without_the_offset_rays_hit_their_own_faces():
    normals, faces = icosphere(3)
    assert visible(normals, frames_around(normals), faces, relative_offset=0.0).mean() < 0.5


def test_inner_surfaces_see_nothing():
    normals, faces = icosphere(2)
    n = len(normals)
    positions = np.concatenate([2.0 * normals, 0.5 * normals])
    frames = frames_around(np.concatenate([normals, normals]))
    seen = visible(positions, frames, np.concatenate([faces, faces + n]))
    assert seen[:n].all()
    assert not seen[n:].any()


def test_empty_and_degenerate_meshes_hide_nothing(rng):
    positions, frames = rng.normal(size=(3, 3)), frames_around(np.eye(3))
    assert visible(positions, frames, np.zeros((0, 3), int)).all()
    assert visible(np.zeros((3, 3)), frames, np.array([[0, 1, 2]])).all()
    assert visible(positions, frames, np.array([[0, 0, 1]])).all()


# --- Analytic occluders


def hidden_by_ball(points, directions, centre):
    """Whether rays meet a unit ball, and how far (radians) each direction is from its rim. Shapes (p, d)."""
    to_centre = centre - points
    distance = np.linalg.norm(to_centre, axis=-1, keepdims=True)
    angle = np.arccos(np.clip(np.einsum("pdi,pi->pd", directions, to_centre / distance), -1, 1))
    rim = np.arcsin(np.minimum(1.0 / distance, 1.0))
    return angle < rim, np.abs(angle - rim)


def test_two_touching_spheres_hide_a_cap():
    """A ball at distance D hides the cap of radius asin(1/D) about its centre, at the touching point half the sky."""
    normals, faces = icosphere(4)
    n, centre = len(normals), np.array([0.0, 0.0, 2.0])
    positions, frames = np.concatenate([normals, normals + centre]), frames_around(np.tile(normals, (2, 1)))
    seen = visible(positions, frames, np.concatenate([faces, faces + n]), points=np.arange(n))
    world = np.einsum("vij,dj->vdi", frames[:n].astype(np.float64), DIRECTIONS)
    hidden, from_rim = hidden_by_ball(normals, world, centre)
    # The faces lie up to 3.3e-3 inside the ball; near the touching point the offset of 5e-4 counts as well.
    near_the_touch = np.linalg.norm(normals - 0.5 * centre, axis=1) < 0.3
    clear = np.where(near_the_touch[:, None], from_rim > 0.1, from_rim > 0.015)
    assert (seen[clear] == ~hidden[clear]).all()
    assert clear.mean() > 0.95
    assert (~seen).any(axis=1).sum() > n / 4


def test_touching_spheres_as_harmonics():
    """Against the hemisphere without the cap, by dense quadrature: the error is that of 256 directions."""
    normals, faces = icosphere(4)
    n, centre = len(normals), np.array([0.0, 0.0, 2.0])
    points = np.flatnonzero(np.abs(normals[:, 2] - 0.75) < 0.15)[::4]
    frames = frames_around(np.tile(normals, (2, 1)))
    bits = harmonics.trace_visibility(
        np.concatenate([normals, normals + centre]),
        frames,
        np.concatenate([faces, faces + n]),
        DIRECTIONS,
        points=points,
    )
    table = jnp.asarray(harmonics.projection_table(DIRECTIONS, order=4), jnp.float32)
    got = np.asarray(harmonics.project_visibility(bits, table))
    dense = harmonics.hemisphere_directions(20000)
    hidden, _ = hidden_by_ball(normals[points], np.einsum("vij,dj->vdi", frames[points], dense), centre)
    truth = ~hidden @ harmonics.projection_table(dense, order=4)
    errors = np.linalg.norm(got - truth, axis=1) / np.linalg.norm(truth, axis=1)
    assert len(points) > 20
    assert errors.mean() < 0.03
    assert errors.max() < 0.06


def test_wall_on_a_floor_hides_its_solid_angle():
    """A wall of height h at distance x hides the directions whose line passes through it."""
    floor = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    wall = np.array([[1.0, -2, 0], [1, 2, 0], [1, 2, 1.5], [1, -2, 1.5]])
    points = np.array([[0.0, 0, 0], [-2, 1, 0], [0.5, -3, 0], [3, 0, 0]])
    positions = np.concatenate([floor, wall, points])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    frames = np.tile(np.eye(3), (len(positions), 1, 1))
    seen = visible(positions, frames, faces, points=np.arange(8, 12))
    with np.errstate(divide="ignore"):
        t = (1.0 - points[:, :1]) / DIRECTIONS[None, :, 0]
    y, z = (points[:, i : i + 1] + t * DIRECTIONS[None, :, i] for i in (1, 2))
    margin = np.minimum(np.abs(np.abs(y) - 2.0), np.abs(z - 1.5))
    hidden = (t > 0) & (np.abs(y) < 2.0) & (z < 1.5)
    clear = (t < 0) | (margin > 0.01)
    assert (seen[clear] == ~hidden[clear]).all()
    assert hidden.any(axis=1).all()


# --- Frames, subsets, chunks


@pytest.fixture(scope="module")
def two_balls():
    normals, faces = icosphere(2)
    positions = np.concatenate([normals, 0.8 * normals + [0.0, 0.5, 1.9]])
    return positions, frames_around(np.tile(normals, (2, 1))), np.concatenate([faces, faces + len(normals)])


def test_visibility_is_kept_in_the_local_frame(two_balls):
    """It does not change when the body moves as a whole, and turns with the tangent."""
    positions, frames, faces = two_balls
    still = visible(positions, frames, faces)
    turn = Rotation.random(random_state=3).as_matrix()
    moved = visible(positions @ turn.T + [5.0, -3.0, 1.0], turn @ frames, faces)
    # Rays that graze an edge may fall on either side.
    assert (moved != still).mean() < 2e-3
    about_normal = Rotation.from_euler("z", 0.9).as_matrix()
    turned = visible(positions, frames @ about_normal, faces, directions=DIRECTIONS @ about_normal)
    assert (turned != still).mean() < 2e-3


def test_points_choose_rows(two_balls):
    positions, frames, faces = two_balls
    whole = harmonics.trace_visibility(positions, frames, faces, DIRECTIONS)
    assert whole.shape == (len(positions), NUM_DIRECTIONS // 8)
    assert whole.dtype == np.uint8
    chosen = np.array([7, 3, 3, 200])
    part = harmonics.trace_visibility(positions, frames, faces, DIRECTIONS, points=chosen)
    assert (part == whole[chosen]).all()
    none = harmonics.trace_visibility(positions, frames, faces, DIRECTIONS, points=np.zeros(0, int))
    assert none.shape == (0, NUM_DIRECTIONS // 8)


def test_the_tree_gives_the_bits_of_embree_also_refitted_and_in_chunks(two_balls, monkeypatch):
    """But for rays that graze an edge."""
    positions, frames, faces = two_balls
    points, directions = np.arange(0, len(positions), 3), harmonics.hemisphere_directions(20)
    monkeypatch.setattr(module, "RAYS_PER_TASK", 1000)
    casters = [harmonics.VisibilityCaster(faces, directions, points=points, rays=rays) for rays in ("embree", "jax")]
    for squeeze in (1.0, 0.8, 0.9):
        pose = positions * np.array([1.0, 1.0, squeeze])
        theirs, ours = (np.unpackbits(caster.cast(pose, frames), axis=1, count=20) for caster in casters)
        assert 0.05 < 1.0 - theirs.mean() < 0.6
        assert (ours != theirs).mean() < 1e-3
    assert len(casters[1].cast(positions, frames)) == len(points)
    with pytest.raises(ValueError, match="rays: expected one of auto, embree, jax, got gpu"):
        harmonics.VisibilityCaster(faces, directions, rays="gpu")


@pytest.mark.parametrize("rays_per_task", [1, 1000, 1 << 20])
def test_memory_is_bounded_by_the_chunk_not_the_mesh(rays_per_task, two_balls, monkeypatch):
    positions, frames, faces = two_balls
    whole = harmonics.trace_visibility(positions, frames, faces, DIRECTIONS)
    sizes = []
    run = embree.EmbreeScene.run

    def counted(self, origins, *arguments, **options):
        sizes.append(len(origins))
        return run(self, origins, *arguments, **options)

    monkeypatch.setattr(embree.EmbreeScene, "run", counted)
    monkeypatch.setattr(module, "RAYS_PER_TASK", rays_per_task)
    assert (harmonics.trace_visibility(positions, frames, faces, DIRECTIONS) == whole).all()
    # One vertex at least, and otherwise no more rays at a time than a task may have.
    assert max(sizes) <= max(rays_per_task, NUM_DIRECTIONS)
    assert sum(sizes) >= len(positions) * NUM_DIRECTIONS


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": np.full((3, 3), np.nan)}, "mesh: positions: expected finite numbers, got 9 NaN or Inf"),
        ({"frames": np.full((3, 3, 3), np.inf)}, "mesh: frames: expected finite numbers"),
        ({"faces": np.array([[0, 1, 3]])}, r"mesh: faces: expected indices from 0 to 2, got 0\.\.3"),
        ({"faces": np.array([[0, 1, -1]])}, r"mesh: faces: expected indices from 0 to 2, got -1\.\.1"),
    ],
)
def test_bad_meshes_are_refused(change, message):
    mesh = {"positions": np.eye(3), "frames": np.tile(np.eye(3), (3, 1, 1)), "faces": np.array([[0, 1, 2]])}
    with pytest.raises(InputError, match=message):
        harmonics.trace_visibility(**(mesh | change), directions=DIRECTIONS)


def test_bad_directions_are_refused():
    mesh = np.eye(3), np.tile(np.eye(3), (3, 1, 1)), np.array([[0, 1, 2]])
    with pytest.raises(ValueError, match="directions: expected shape"):
        harmonics.trace_visibility(*mesh, np.zeros((4, 2)))
    with pytest.raises(ValueError, match="number of directions: expected a value >= 1"):
        harmonics.trace_visibility(*mesh, np.zeros((0, 3)))


# --- Bits


@pytest.mark.parametrize("num_directions", [1, 8, 13, 256])
def test_bits_unpack_in_order(num_directions, rng):
    seen = rng.uniform(size=(2, 3, num_directions)) < 0.5
    bits = jnp.asarray(np.packbits(seen, axis=-1))
    assert bits.shape == (2, 3, -(-num_directions // 8))
    got = jax.jit(unpack_visibility, static_argnames="num_directions")(bits, num_directions=num_directions)
    assert got.dtype == jnp.float32
    assert (np.asarray(got) == seen).all()


def test_projection_of_bits_is_a_sum_over_what_is_seen(rng):
    directions = harmonics.hemisphere_directions(45)
    seen = rng.uniform(size=(4, 45)) < 0.5
    bits, table = np.packbits(seen, axis=1), harmonics.projection_table(directions, order=5)
    expected = [oracles.real_harmonics(directions[row], 5).sum(0) * 2 * np.pi / 45 for row in seen]
    got = jax.jit(harmonics.project_visibility)(jnp.asarray(bits), jnp.asarray(table, jnp.float32))
    assert_close(got, np.stack(expected), ulps=ROUNDING, dtype=np.float32)
    assert_close(harmonics.project_visibility(bits, table), got, ulps=16, dtype=np.float32)
    one = jax.vmap(harmonics.project_visibility, in_axes=(0, None))(jnp.asarray(bits), jnp.asarray(table))
    assert_close(one, got, ulps=16, dtype=np.float32)
