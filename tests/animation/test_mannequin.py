"""The body grown around any skeleton: closed, smooth, in one piece, and it bends as a body does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxrender.animation.anatomy import Role, find_landmarks, recognize
from jaxrender.animation.bind_pose import joint_hops, rest_matrices, spread_limbs
from jaxrender.animation.body_parts import Part
from jaxrender.animation.body_surface import assemble, evaluate
from jaxrender.animation.builtin_clips import FRAMES_PER_SECOND, builtin_clips, builtin_skeleton
from jaxrender.animation.mannequin import builtin_character, grow_mannequin, strongest
from jaxrender.animation.skeleton import Pose, Skeleton, global_matrices
from jaxrender.animation.skinning import skin_mesh
from jaxrender.io.bvh import read_bvh

EPS = np.finfo(np.float32).eps


def make_skeleton(parents, offsets, names=None):
    num_joints = len(parents)
    return Skeleton(
        tuple(names or (f"bone {i}" for i in range(num_joints))),
        tuple(parents),
        Pose(
            translation=jnp.asarray(offsets, dtype=jnp.float32),
            rotation=jnp.tile(jnp.asarray([0, 0, 0, 1], dtype=jnp.float32), (num_joints, 1)),
            scale=jnp.ones((num_joints, 3), dtype=jnp.float32),
        ),
    )


def from_places(places):
    """A skeleton from {name: (parent, place in the world)}."""
    names = list(places)
    parents = [names.index(parent) if parent else -1 for parent, _ in places.values()]
    points = np.asarray([point for _, point in places.values()], dtype=np.float64)
    offsets = [points[i] - (points[p] if p >= 0 else 0.0) for i, p in enumerate(parents)]
    return make_skeleton(parents, offsets, names)


def snake():
    return make_skeleton([-1, *range(20)], [[0, 0, 0], *([0.03 * np.sin(0.7 * i), 0, 0.08] for i in range(20))])


def star():
    parents, offsets = [-1], [[0.0, 0.0, 0.0]]
    for angle in np.linspace(0, 2 * np.pi, 7)[:-1]:
        arm = 0.4 * np.array([np.cos(angle), np.sin(angle), 0.2])
        parents += [0, len(parents)]
        offsets += [arm, arm]
    return make_skeleton(parents, offsets)


def quadruped():
    parents = [-1, 0, 1, 2, 3]
    offsets = [[0, 0.6, -0.4], [0, 0, 0.3], [0, 0, 0.3], [0, 0.15, 0.2], [0, -0.05, 0.2]]
    for side in (1, -1):
        for joint in (0, 2):
            first = len(parents)
            parents += [joint, first, first + 1]
            offsets += [[0.09 * side, -0.08, 0], [0, -0.22, -0.03], [0, -0.25, 0.03]]
    return make_skeleton(parents, offsets)


def doubled_joints():
    return make_skeleton(
        [-1, 0, 0, 1, 2, 3, 5],
        [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0.5, 0], [0, 0.5, 0], [0, 0, 0], [0.2, 0.2, 0]],
    )


def standing_human(named=True):
    """Rests at attention: the arms along the body, the hands on the thighs, the legs closed."""
    places = {
        "Hips": ("", (0, 0.97, 0)),
        "Spine": ("Hips", (0, 1.15, 0)),
        "Neck": ("Spine", (0, 1.48, 0)),
        "Head": ("Neck", (0, 1.57, 0)),
    }
    for side, x in (("Left", 1.0), ("Right", -1.0)):
        places[f"{side}Arm"] = ("Spine", (0.17 * x, 1.42, 0))
        places[f"{side}ForeArm"] = (f"{side}Arm", (0.17 * x, 1.13, 0))
        places[f"{side}Hand"] = (f"{side}ForeArm", (0.16 * x, 0.88, 0))
        places[f"{side}Hand End Site"] = (f"{side}Hand", (0.15 * x, 0.72, 0))
        places[f"{side}UpLeg"] = ("Hips", (0.08 * x, 0.92, 0))
        places[f"{side}Leg"] = (f"{side}UpLeg", (0.06 * x, 0.5, 0))
        places[f"{side}Foot"] = (f"{side}Leg", (0.04 * x, 0.08, 0))
        places[f"{side}Foot End Site"] = (f"{side}Foot", (0.04 * x, 0.02, 0.15))
    skeleton = from_places(places)
    return skeleton if named else make_skeleton(skeleton.parents, skeleton.rest.translation)


ODD = {
    "one bone": lambda: make_skeleton([-1, 0], [[0, 0, 0], [0.1, 0.7, 0]]),
    "one joint": lambda: make_skeleton([-1], [[1, 2, 3]]),
    "snake": snake,
    "star": star,
    "quadruped": quadruped,
    "doubled joints": doubled_joints,
    "human": builtin_skeleton,
    "human at attention": standing_human,
    "stick figure at attention": lambda: standing_human(named=False),
}


def check_body(skin, faces, num_vertices):
    """What every mannequin must be; returns it as a mesh."""
    vertices, faces = np.asarray(skin.vertices, dtype=np.float64), np.asarray(faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert abs(len(vertices) - num_vertices) <= 0.1 * num_vertices
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
    assert mesh.volume > 0
    assert set(np.unique(faces)) == set(range(len(vertices)))

    weights, indices = np.asarray(skin.weights, dtype=np.float64), np.asarray(skin.joint_indices)
    normals = np.asarray(skin.normals, dtype=np.float64)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=4 * EPS)
    assert weights.shape == indices.shape and weights.shape[1] <= 4
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=4 * EPS)
    assert indices.min() >= 0 and indices.max() < len(skin.palette_joints)
    assert all(len(set(row)) == len(row) for row in indices)
    for array in (skin.vertices, skin.normals, skin.weights, skin.inverse_binds):
        assert array.dtype == jnp.float32 and bool(jnp.isfinite(array).all())
    return mesh


def check_shape(mesh, normals):
    """Triangles near to equilateral ones and normals that are those of the faces around."""
    edges = np.linalg.norm(np.roll(mesh.triangles, 1, axis=1) - mesh.triangles, axis=-1)
    cosines = (edges**2).sum(axis=1, keepdims=True) - 2 * edges**2
    cosines /= 2 * edges.prod(axis=1, keepdims=True) / edges
    smallest = np.degrees(np.arccos(np.clip(cosines, -1, 1)).min(axis=1))
    # Marching cubes alone leaves slivers: a first percentile of some 5 degrees and a median near 35.
    assert np.median(smallest) > 42 and np.percentile(smallest, 1) > 18 and smallest.min() > 1
    # A tip as thin as the mesh is coarse has a few faces at more than 78 degrees to their mean.
    agreement = np.einsum("tki,ti->tk", np.asarray(normals, dtype=np.float64)[mesh.faces], mesh.face_normals)
    assert np.mean(agreement > 0.2) > 0.99


def bind_globals(skin, num_joints):
    """World from joint in the pose the skin was bound in; the identity for joints that move nothing."""
    matrices = np.tile(np.eye(4), (num_joints, 1, 1))
    matrices[np.asarray(skin.palette_joints)] = np.linalg.inv(np.asarray(skin.inverse_binds, dtype=np.float64))
    return matrices


def bone_distance(points, positions, parents):
    """Distance of each point to the nearest bone."""
    result = np.linalg.norm(points[:, None] - positions, axis=-1).min(axis=1)
    for joint, parent in enumerate(parents):
        bone = positions[joint] - positions[max(parent, 0)]
        if bone @ bone > 0:
            offset = points - positions[max(parent, 0)]
            share = np.clip(offset @ bone / (bone @ bone), 0, 1)
            result = np.minimum(result, np.linalg.norm(offset - share[:, None] * bone, axis=1))
    return result


@pytest.mark.parametrize("name", ODD)
def test_a_body_grows_around_any_skeleton(name):
    skeleton = ODD[name]()
    skin, faces = grow_mannequin(skeleton, num_vertices=1200)
    mesh = check_body(skin, faces, 1200)
    check_shape(mesh, skin.normals)
    assert mesh.euler_number == 2  # no limb is joined to another
    positions = spread_limbs_of(skeleton)
    # Thickest around a human is the chest, 0.16 m off the spine; a ball of 0.1 m is the body of one joint.
    assert bone_distance(mesh.vertices, positions, skeleton.parents).max() < 0.2
    reached = bone_distance(positions, np.asarray(mesh.vertices), [-1] * len(mesh.vertices))
    assert reached.max() < 0.2


def spread_limbs_of(skeleton):
    body = find_landmarks(skeleton.parents, recognize(skeleton.names, skeleton.parents))
    return spread_limbs(rest_matrices(skeleton), skeleton.parents, body)[:, :3, 3]


@pytest.mark.parametrize("num_vertices", [500, 2000, 10000])
def test_the_number_of_vertices_is_near_what_was_asked_for(num_vertices):
    skin, faces = grow_mannequin(builtin_skeleton(), num_vertices=num_vertices)
    check_shape(check_body(skin, faces, num_vertices), skin.normals)


@settings(max_examples=5, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), num_joints=st.integers(2, 14))
def test_a_random_tree_gets_a_closed_body(seed, num_joints):
    rng = np.random.default_rng(seed)
    parents = [-1, *(int(rng.integers(0, joint)) for joint in range(1, num_joints))]
    offsets = rng.normal(size=(num_joints, 3)) * rng.choice([0.0, 0.05, 0.4], size=(num_joints, 1))
    skin, faces = grow_mannequin(make_skeleton(parents, offsets), num_vertices=700)
    check_body(skin, faces, 700)


def test_the_rest_of_a_scaled_and_turned_skeleton_is_used():
    plain = builtin_skeleton()
    turned = Skeleton(
        plain.names,
        plain.parents,
        Pose(
            translation=plain.rest.translation / 2,
            rotation=plain.rest.rotation.at[0].set(jnp.asarray([0, np.sin(0.5), 0, np.cos(0.5)], dtype=jnp.float32)),
            scale=plain.rest.scale.at[0].set(2.0),
        ),
    )
    np.testing.assert_allclose(
        rest_matrices(turned), np.asarray(global_matrices(turned.rest, parents=turned.parents)), atol=8 * EPS
    )
    skin, faces = grow_mannequin(turned, num_vertices=1500)
    check_body(skin, faces, 1500)
    height = np.ptp(np.asarray(skin.vertices)[:, 1])
    assert height == pytest.approx(1.75, abs=0.1)


def test_the_skin_in_its_bind_pose_is_the_surface_that_was_grown():
    skeleton = standing_human()
    skin, _ = grow_mannequin(skeleton, num_vertices=1000)
    posed = skin_mesh(skin, jnp.asarray(bind_globals(skin, len(skeleton.parents)), dtype=jnp.float32))
    np.testing.assert_allclose(posed.positions, skin.vertices, atol=16 * EPS)


@pytest.mark.parametrize("named", [True, False])
def test_a_hand_on_the_thigh_does_not_hang_on_the_leg(named):
    names = standing_human().names
    skin, _ = grow_mannequin(standing_human(named=named), num_vertices=3000)
    palette = [names[joint] for joint in np.asarray(skin.palette_joints)]
    arm = np.array([any(part in name for part in ("ForeArm", "Hand")) for name in palette])
    leg = np.array([any(part in name for part in ("Leg", "Foot")) for name in palette])
    weights, indices = np.asarray(skin.weights), np.asarray(skin.joint_indices)
    on_arm, on_leg = ((weights * group[indices]).sum(axis=1) for group in (arm, leg))
    assert on_arm.max() > 0.99 and on_leg.max() > 0.99
    assert np.minimum(on_arm, on_leg).max() == 0.0
    left = np.array([name.startswith("Left") for name in palette])
    right = np.array([name.startswith("Right") for name in palette])
    shins = np.array(["Leg" in name and "Up" not in name for name in palette])
    on_left, on_right = ((weights * (group & (arm | shins))[indices]).sum(axis=1) for group in (left, right))
    assert np.minimum(on_left, on_right).max() == 0.0


def test_weights_fade_smoothly_over_the_surface():
    skin, faces = grow_mannequin(builtin_skeleton(), num_vertices=4000)
    dense = np.zeros((len(skin.vertices), len(skin.palette_joints)))
    np.put_along_axis(dense, np.asarray(skin.joint_indices), np.asarray(skin.weights), axis=1)
    a, b = np.asarray(faces)[:, [0, 1, 2]].ravel(), np.asarray(faces)[:, [1, 2, 0]].ravel()
    step = np.abs(dense[a] - dense[b]).max(axis=1)
    # A fade of exp(-x / w) / 2 on both sides, with w at least the mean edge, changes by 1 - exp(-1 / 2) =
    # 0.39 over a mean edge across its middle. A few edges are longer, up to twice: 0.63.
    assert np.percentile(step, 99) < 0.39 and step.max() < 0.63


def test_the_same_skeleton_gives_the_same_body():
    first, second = builtin_character(num_vertices=800), builtin_character(num_vertices=800)
    assert first.content_hash == second.content_hash
    for a, b in zip(jax.tree.leaves(first.skin), jax.tree.leaves(second.skin), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.faces, second.faces)


def test_arguments_are_checked():
    with pytest.raises(ValueError, match="num_vertices: expected a value >= 500, got 499"):
        grow_mannequin(builtin_skeleton(), num_vertices=499)
    with pytest.raises(ValueError, match="max_influences"):
        grow_mannequin(builtin_skeleton(), max_influences=0)
    with pytest.raises(ValueError, match="number of joints"):
        grow_mannequin(make_skeleton([], np.zeros((0, 3))))
    with jax.debug_nans(False), pytest.raises(ValueError, match="finite rest pose"):
        grow_mannequin(make_skeleton([-1, 0], [[0, 0, 0], [0, np.nan, 0]]))


def test_strongest_weights_fade_out_where_the_choice_changes():
    weights = np.array([[0.4, 0.3, 0.2, 0.1], [0.25, 0.25, 0.25, 0.25], [1.0, 0, 0, 0]])
    columns, values = strongest(weights, 2)
    np.testing.assert_array_equal(columns, [[0, 1], [0, 1], [0, 1]])
    np.testing.assert_allclose(values, [[2 / 3, 1 / 3], [1, 0], [1, 0]])
    _, all_values = strongest(weights, 9)
    np.testing.assert_allclose(all_values[0], weights[0])


# Names.


@pytest.mark.parametrize(
    ("names", "roles"),
    [
        ("Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase", "pelvis thigh shin foot toe"),
        ("Hips LowerBack Spine1 Neck1 Head", "pelvis spine spine neck head"),
        ("LeftShoulder LeftArm LeftForeArm LeftHand LeftThumb", "clavicle|upper arm|forearm|hand|thumb"),
        ("LeftHand LeftFingerBase LeftHandIndex1 LeftHandPinky3", "hand finger finger finger"),
        ("Chest LeftCollar LeftShoulder LeftElbow LeftWrist", "spine|clavicle|upper arm|forearm|hand"),
        ("Hips LeftHip LeftKnee LeftAnkle", "pelvis thigh shin foot"),
        ("mixamorig:Hips mixamorig:RightUpLeg mixamorig:RightLeg", "pelvis thigh shin"),
        ("hip abdomen chest lCollar lShldr lForeArm", "pelvis|spine|spine|clavicle|upper arm|forearm"),
        ("pelvis spine thigh.R shin.R foot.R", "pelvis spine thigh shin foot"),
        ("root lfemur ltibia lfoot ltoes", "None thigh shin foot toe"),
        ("Bip01_Pelvis Bip01_L_Thigh Bip01_L_Calf", "pelvis thigh shin"),
        ("Head HeadTop_End bone_7 Tail", "head tip None None"),
    ],
)
def test_joints_are_known_by_their_names(names, roles):
    names = names.split()
    found = recognize(names, [-1, *range(len(names) - 1)])
    expected = roles.split("|") if "|" in roles else roles.split()
    assert [str(role and role.part) for role in found] == expected
    for name, role in zip(names, found, strict=True):
        words = name.lower()
        side = "left" if "left" in words or words[0] == "l" or "_l_" in words else ""
        side = side if side and "lower" not in words else ""
        if "right" in words or words.endswith(".r"):
            side = "right"
        if role is not None:
            assert role == Role(role.part, side)


def test_a_body_needs_more_than_one_limb_of_a_human():
    """A snake with a head is no human: names count only where the whole body is there."""
    named = make_skeleton([-1, 0, 1], [[0, 0, 0], [0, 0, 0.5], [0, 0, 0.5]], ["Hips", "Neck", "Head"])
    plain = make_skeleton([-1, 0, 1], [[0, 0, 0], [0, 0, 0.5], [0, 0, 0.5]])
    for a, b in zip(
        jax.tree.leaves(grow_mannequin(named, num_vertices=500)),
        jax.tree.leaves(grow_mannequin(plain, num_vertices=500)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


# The field.


def one_part(**changes):
    part = {"joint": 0, "a": np.zeros(3), "b": np.array([0, 0.5, 0]), "radius_a": 0.1, "radius_b": 0.06}
    part |= {"group": 0, "blend": 0.02, "wide": np.array([1.0, 0, 0])} | changes
    return Part(**part)


def test_the_field_of_a_round_cone_is_the_distance_to_it(rng):
    points = rng.uniform(-0.4, 0.8, size=(300, 3))
    body = assemble([one_part()], np.zeros((1, 1), dtype=int))
    value, gradient = evaluate(body, points)
    # The sphere-swept segment by brute force: 4001 spheres, half a step of the segment's 0.5 m off at most.
    share = np.linspace(0, 1, 4001)
    centers = share[:, None] * np.array([0, 0.5, 0])
    expected = (np.linalg.norm(points[:, None] - centers, axis=-1) - (0.1 - 0.04 * share)).min(axis=1)
    np.testing.assert_allclose(value, expected, atol=0.5 / 4000)
    step = 1e-6
    for axis in range(3):
        ahead, behind = points.copy(), points.copy()
        ahead[:, axis] += step
        behind[:, axis] -= step
        slope = (evaluate(body, ahead)[0] - evaluate(body, behind)[0]) / (2 * step)
        np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-5)


def test_a_stretched_part_is_as_wide_as_it_says():
    body = assemble([one_part(radius_b=0.1, stretch_a=2.0, stretch_b=2.0)], np.zeros((1, 1), dtype=int))
    value, _ = evaluate(body, np.array([[0.2, 0.25, 0], [0, 0.25, 0.1], [0.21, 0.25, 0], [0, 0.25, 0.09]]))
    # Exact on the axes of the ellipse; rounding of numbers near 1 below 1e-12.
    np.testing.assert_allclose(value, [0, 0, 0.01, -0.01], atol=1e-12)


def test_only_neighbors_melt():
    """Two bars side by side: melted if they share a joint, a plain union if they are far in the skeleton."""
    bars = [
        one_part(radius_b=0.1),
        one_part(joint=1, group=1, radius_b=0.1, a=np.array([0.15, 0, 0]), b=np.array([0.15, 0.5, 0])),
    ]
    notch = np.array([[0.075, 0.25, 0.08]])
    plain, _ = evaluate(assemble(bars, np.array([[0, 9], [9, 0]])), notch)
    melted, _ = evaluate(assemble(bars, np.array([[0, 1], [1, 0]])), notch)
    assert plain == pytest.approx(np.hypot(0.075, 0.08) - 0.1)
    assert melted < plain - 0.002


def test_a_straight_limb_has_no_knob_at_its_joint():
    """Two cones in line are as thick where they meet as one cone is."""
    halves = [
        one_part(radius_b=0.1, b=np.array([0, 0.25, 0])),
        one_part(joint=1, group=1, radius_b=0.1, a=np.array([0, 0.25, 0])),
    ]
    value, _ = evaluate(assemble(halves, np.array([[0, 1], [1, 0]])), np.array([[0.1, 0.25, 0], [0, 0.25, 0.1]]))
    np.testing.assert_allclose(value, 0.0, atol=1e-12)


# The bind pose.


def test_limbs_of_a_human_are_spread():
    skeleton = standing_human()
    positions = dict(zip(skeleton.names, spread_limbs_of(skeleton), strict=True))
    for side, outward in (("Left", 1.0), ("Right", -1.0)):
        arm = positions[f"{side}Hand"] - positions[f"{side}Arm"]
        assert outward * np.degrees(np.arctan2(arm[0], -arm[1])) == pytest.approx(50.0, abs=1e-6)
        leg = positions[f"{side}Foot"] - positions[f"{side}UpLeg"]
        assert outward * np.degrees(np.arctan2(leg[0], -leg[1])) == pytest.approx(8.0, abs=1e-6)
        assert np.linalg.norm(arm) == pytest.approx(np.hypot(0.01, 0.54), rel=1e-6)


def test_bones_of_a_tree_are_pushed_apart_and_keep_their_lengths():
    skeleton = standing_human(named=False)
    rest, spread = rest_matrices(skeleton)[:, :3, 3], spread_limbs_of(skeleton)
    names = standing_human().names
    hand, thigh = names.index("LeftHand"), [names.index("LeftUpLeg"), names.index("LeftLeg")]

    def gap(positions):
        return bone_distance(positions[[hand]], positions[thigh], [-1, 0])[0]

    assert gap(spread) > gap(rest) + 0.01
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            before, after = (np.linalg.norm(p[joint] - p[parent]) for p in (rest, spread))
            assert after == pytest.approx(before, abs=1e-9)


def test_a_tree_without_contacts_stays_as_it_is():
    skeleton = star()
    np.testing.assert_array_equal(spread_limbs_of(skeleton), rest_matrices(skeleton)[:, :3, 3])


def test_hops_count_bones_with_length():
    hops = joint_hops(np.array([[0, 0, 0], [0, 0, 0], [0, 1, 0], [1, 0, 0.0]]), [-1, 0, 1, 0])
    np.testing.assert_array_equal(hops, [[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 0, 2], [1, 1, 2, 0]])


# The built-in character and its clips.


@pytest.fixture(scope="module")
def character():
    return builtin_character(num_vertices=2500)


def pose(skin, skeleton, clip, keys):
    """World from joint and skinned positions at some keys of a clip, by plain loops in float64."""
    local = np.tile(np.eye(4), (len(keys), len(skeleton.parents), 1, 1))
    local[:, :, :3, 3] = skeleton.rest.translation
    for channel in clip.channels:
        if channel.path == "rotation":
            local[:, channel.joint, :3, :3] = Rotation.from_quat(channel.values[keys]).as_matrix()
        else:
            local[:, channel.joint, :3, 3] = channel.values[keys]
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            local[:, joint] = local[:, parent] @ local[:, joint]
    vertices = np.concatenate([skin.vertices, np.ones((len(skin.vertices), 1))], axis=1)
    positions = np.zeros((len(keys), len(vertices), 3))
    palette = local[:, np.asarray(skin.palette_joints)] @ np.asarray(skin.inverse_binds, dtype=np.float64)
    for k in range(skin.weights.shape[1]):
        matrices = palette[:, np.asarray(skin.joint_indices[:, k]), :3]
        positions += np.asarray(skin.weights)[:, k, None] * np.einsum("fvij,vj->fvi", matrices, vertices)
    return local, positions


@pytest.fixture(scope="module")
def motions(character):
    """name -> (times, world from joint, positions of the skin) of every third key."""
    result = {}
    for clip in character.clips:
        keys = np.arange(0, len(clip.channels[0].times), 3)
        result[clip.name] = (
            clip.channels[0].times[keys],
            *pose(character.skin, character.skeleton, clip, keys),
        )
    return result


def test_the_builtin_character_is_an_adult(character):
    mesh = check_body(character.skin, character.faces, 2500)
    check_shape(mesh, character.skin.normals)
    assert len(character.skeleton.names) == 25
    assert [clip.name for clip in character.clips] == ["walk", "turn", "reach"]
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(1.75, abs=0.03)
    assert abs(mesh.vertices[:, 1].min()) < 0.02
    assert 0.04 < mesh.volume < 0.07  # about 50 litres: slim, without hair and clothes
    assert character.skin.weights.shape[1] == 4 and character.unit_scale == 1.0


@pytest.mark.parametrize("clip", builtin_clips(), ids=lambda clip: clip.name)
def test_clips_are_unit_quaternions_in_closed_loops(clip):
    assert 2.0 <= clip.duration <= 4.0
    for channel in clip.channels:
        assert channel.interpolation == "LINEAR"
        assert len(channel.times) == round(clip.duration * FRAMES_PER_SECOND) + 1
        np.testing.assert_allclose(np.diff(channel.times), 1 / FRAMES_PER_SECOND, atol=4 * EPS)
        values = channel.values.astype(np.float64)
        assert np.isfinite(values).all()
        steps = np.linalg.norm(np.diff(values, axis=0), axis=1)
        # The last key is the first, and the loop goes on at the speed it began with: no step at the seam is
        # out of the ordinary, in its change either.
        np.testing.assert_allclose(values[-1], values[0], atol=8 * EPS)
        bends = np.linalg.norm(np.diff(values, n=2, axis=0), axis=1)
        seam = np.linalg.norm(values[1] - values[0] - (values[-1] - values[-2]))
        assert seam <= 1.5 * bends.max() + 8 * EPS
        if channel.path == "rotation":
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1.0, atol=2 * EPS)
            assert np.all(np.sum(values[1:] * values[:-1], axis=1) > 0)
            assert steps.max() < np.radians(20) / 2  # 20 degrees in a 30th of a second is a fast limb


def test_clips_move_every_limb_and_nothing_leaves_the_stage(character, motions):
    still = trimesh.Trimesh(character.skin.vertices, character.faces, process=False).volume
    for name, (_, matrices, positions) in motions.items():
        assert np.isfinite(positions).all()
        assert np.abs(positions[..., [0, 2]]).max() < 1.1 and positions[..., 1].max() < 2.4, name
        assert positions[..., 1].min() > -0.03, f"{name}: a foot goes through the floor"
        travel = np.ptp(matrices[:, :, :3, 3], axis=0).max(axis=1)
        for joint in ("LeftHand", "RightHand", "Head"):
            assert travel[character.skeleton.names.index(joint)] > 0.02
        for frame in positions[::4]:
            share = trimesh.Trimesh(frame, character.faces, process=False).volume / still
            assert 0.9 < share < 1.1, f"{name}: volume {share:.2f} of that at rest"


@pytest.mark.parametrize("name", ["turn", "reach"])
def test_standing_feet_stand_still(character, motions, name):
    _, matrices, _ = motions[name]
    for joint in ("LeftFoot", "RightFoot"):
        places = matrices[:, character.skeleton.names.index(joint)]
        # Keys are float32: three quaternions and the hips, each with a rounding, on a leg of about 1 m.
        np.testing.assert_allclose(places, np.broadcast_to(places[0], places.shape), atol=16 * EPS)


def test_walking_feet_move_back_with_the_ground(character, motions):
    times, matrices, positions = motions["walk"]
    names = character.skeleton.names
    for side, shift in (("Left", 0.0), ("Right", 0.5)):
        ankle = matrices[:, names.index(f"{side}Foot"), :3, 3]
        phase = (times / 1.1 + shift) % 1.0
        flat = (phase > 0.11) & (phase < 0.35)
        ground = ankle[:, 2] + times  # the ground moves back at 1 m/s
        for cycle in range(2):
            one = flat & ((times / 1.1 + shift) // 1.0 == cycle + (1 if shift else 0))
            assert one.sum() >= 2
            assert np.ptp(ground[one]) < 1e-3 and np.ptp(ankle[one, 1]) < 1e-3
        assert np.ptp(ankle[:, 2]) > 0.5 and np.ptp(ankle[:, 1]) > 0.08
    hands = [matrices[:, names.index(f"{side}Hand"), 2, 3] for side in ("Left", "Right")]
    feet = [matrices[:, names.index(f"{side}Foot"), 2, 3] for side in ("Left", "Right")]
    assert np.corrcoef(hands[0] - hands[1], feet[0] - feet[1])[0, 1] < -0.9  # arms swing against the legs
    lowest = positions[..., 1].min(axis=1)
    assert np.abs(lowest).max() < 0.03  # one foot is always on the ground


@pytest.mark.data
@pytest.mark.parametrize("name", ["02_01", "09_01", "02_05", "05_06"])
def test_shared_motion_capture_moves_a_body(shared_data, name):
    skeleton, clip = read_bvh(shared_data / "bvh" / f"{name}.bvh")
    skin, faces = grow_mannequin(skeleton, num_vertices=1500)
    still = check_body(skin, faces, 1500)
    check_shape(still, skin.normals)
    assert still.euler_number == 2
    keys = np.linspace(0, len(clip.channels[0].times) - 1, 7).astype(int)
    matrices, positions = pose(skin, skeleton, clip, keys)
    hips = matrices[:, :1, :3, 3]
    assert np.linalg.norm(positions - hips, axis=-1).max() < 1.5
    shares = [trimesh.Trimesh(frame, faces, process=False).volume / still.volume for frame in positions]
    assert min(shares) > 0.85 and max(shares) < 1.1
