"""glTF files, right, odd and hostile, against what was put into them; and the shared characters."""

import copy
import hashlib
import io
import json
import math
import os
import pathlib
import random
import tracemalloc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxrender.animation.skeleton import global_matrices, sample_clip
from jaxrender.animation.skinning import Character, skin_mesh
from jaxrender.checks import InputError
from jaxrender.io.gltf import read_gltf
from jaxrender.io.gltf_materials import sample_bilinear
from tests.support import gltf_builder as g
from tests.support.asserts import assert_close
from tests.support.gltf_builder import GltfBuilder, primitive, rigid, tetrahedron


def load(builder: GltfBuilder, folder: pathlib.Path) -> Character:
    return read_gltf(builder.write(folder))


def refused(builder: GltfBuilder, folder: pathlib.Path, match: str) -> None:
    with pytest.raises(InputError, match=match) as caught:
        load(builder, folder)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def rest_matrices(character: Character) -> np.ndarray:
    """World matrices at rest by plain NumPy products."""
    world: list[np.ndarray] = []
    rest = character.skeleton.rest
    for i, parent in enumerate(character.skeleton.parents):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(rest.rotation[i]).as_matrix() @ np.diag(rest.scale[i])
        local[:3, 3] = rest.translation[i]
        world.append(local if parent < 0 else world[parent] @ local)
    return np.array(world)


def posed(character: Character, world: np.ndarray) -> np.ndarray:
    """Corners of the posed faces (t, 3, 3): comparable however the vertices are ordered or shared."""
    skin = character.skin
    palette = world[np.asarray(skin.palette_joints)] @ np.asarray(skin.inverse_binds, dtype=np.float64)
    blended = (np.asarray(skin.weights)[..., None, None] * palette[np.asarray(skin.joint_indices)]).sum(axis=1)
    points = np.einsum("vij,vj->vi", blended[:, :3, :3], skin.vertices) + blended[:, :3, 3]
    return points[np.asarray(character.faces)]


def at_time(character: Character, time: float) -> np.ndarray:
    """World matrices of the first clip."""
    pose = sample_clip(character.clips[0], character.skeleton, jnp.asarray([time]))
    return np.asarray(global_matrices(pose, parents=character.skeleton.parents)[0], dtype=np.float64)


# --- the plain case, and everything that must not make a difference ---


def test_tetrahedron_arrives_whole(tmp_path):
    character = load(tetrahedron(), tmp_path)
    assert character.name == "character" and character.notes == () and character.unit_scale == 1.0
    assert character.skeleton.names == ("root", "tip") and character.skeleton.parents == (-1, 0)
    np.testing.assert_array_equal(character.skeleton.rest.translation, [[0, 0, 0], [0, 2, 0]])
    np.testing.assert_array_equal(character.skin.vertices, g.CORNERS)
    np.testing.assert_allclose(character.skin.normals, g.NORMALS, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(character.faces, g.FACES)
    np.testing.assert_array_equal(character.skin.inverse_binds, g.BINDS)
    np.testing.assert_array_equal(character.skin.palette_joints, [0, 1])
    assert character.skin.weights.shape == (4, 2), "no vertex has more than two influences"
    dense = np.zeros((4, 2))
    np.add.at(dense, (np.arange(4)[:, None], character.skin.joint_indices), character.skin.weights)
    np.testing.assert_array_equal(dense, [[0.75, 0.25], [0.5, 0.5], [1, 0], [0.75, 0.25]])
    np.testing.assert_array_equal(character.albedo, np.ones((4, 3)))
    (clip,) = character.clips
    assert (clip.name, clip.start, clip.duration) == ("turn", 0.5, 1.0)
    (channel,) = clip.channels
    assert (channel.joint, channel.path, channel.interpolation) == (1, "rotation", "LINEAR")


def test_records_have_the_types_of_the_kernels(tmp_path):
    character = load(tetrahedron(), tmp_path)
    skin = character.skin
    for array in (skin.vertices, skin.normals, skin.weights, skin.inverse_binds, character.albedo):
        assert isinstance(array, jax.Array) and array.dtype == np.float32
    for array in (skin.joint_indices, skin.palette_joints, character.faces):
        assert isinstance(array, jax.Array) and array.dtype == np.int32
    channel = character.clips[0].channels[0]
    assert isinstance(channel.times, np.ndarray) and channel.values.dtype == np.float32
    mesh = jax.jit(skin_mesh)(skin, global_matrices(character.skeleton.rest, parents=(-1, 0)))
    assert_close(mesh.positions, g.CORNERS, ulps=8, dtype=np.float32)


def test_content_hash_is_that_of_the_file_and_follows_an_external_buffer(tmp_path):
    path = tetrahedron().write(tmp_path)
    assert read_gltf(path).content_hash == hashlib.sha256(path.read_bytes()).hexdigest()
    b = tetrahedron()
    path = tmp_path / "c.gltf"
    path.write_bytes(b.gltf("c.bin"))
    (tmp_path / "c.bin").write_bytes(b.blob)
    before = read_gltf(path).content_hash
    assert before == hashlib.sha256(path.read_bytes() + b.blob).hexdigest()
    b.blob[:4] = np.float32(0.125).tobytes()
    (tmp_path / "c.bin").write_bytes(b.blob)
    assert read_gltf(path).content_hash != before


def joints_u16(b):
    primitive(b)["attributes"]["JOINTS_0"] = b.accessor(g.JOINTS, "u2")


def weights_u8(b):
    weights = np.array([[191, 64, 0, 0], [128, 127, 0, 0], [255, 0, 0, 0], [64, 191, 0, 0]])
    primitive(b)["attributes"]["WEIGHTS_0"] = b.accessor(weights, "u1", normalized=True)


def weights_u16(b):
    weights = np.rint(g.WEIGHTS * 65535)
    weights[:, 1] = 65535 - weights[:, 0]
    primitive(b)["attributes"]["WEIGHTS_0"] = b.accessor(weights, "u2", normalized=True)


def indices_u8(b):
    primitive(b)["indices"] = b.accessor(g.FACES.ravel(), "u1")


def indices_u32(b):
    primitive(b)["indices"] = b.accessor(g.FACES.ravel(), "u4")


def no_indices(b):
    corners = g.FACES.ravel()
    primitive(b).pop("indices")
    primitive(b)["attributes"] = {
        "POSITION": b.accessor(g.CORNERS[corners]),
        "NORMAL": b.accessor(g.NORMALS[corners]),
        "JOINTS_0": b.accessor(g.JOINTS[corners], "u1"),
        "WEIGHTS_0": b.accessor(g.WEIGHTS[corners]),
    }


def interleaved(b):
    attributes = primitive(b)["attributes"]
    names = "POSITION", "NORMAL", "WEIGHTS_0"
    attributes |= zip(names, b.interleaved(g.CORNERS, g.NORMALS, g.WEIGHTS), strict=True)


def eight_influences(b):
    attributes = primitive(b)["attributes"]
    second = np.zeros((4, 4))
    second[:, 0] = g.WEIGHTS[:, 1]
    first = np.where(np.arange(4) == 1, 0.0, g.WEIGHTS)
    attributes["WEIGHTS_0"] = b.accessor(first)
    attributes["JOINTS_1"] = b.accessor(g.JOINTS[:, [1, 0, 0, 0]], "u2")
    attributes["WEIGHTS_1"] = b.accessor(second)


def sparse_with_base(b):
    wrong = g.CORNERS.copy()
    wrong[[1, 3]] = 7.0
    sparse = {
        "count": 2,
        "indices": {"bufferView": b.view(np.array([1, 3], "<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": b.view(g.CORNERS[[1, 3]].astype("<f4").tobytes())},
    }
    primitive(b)["attributes"]["POSITION"] = b.accessor(wrong, sparse=sparse)


def sparse_without_base(b):
    sparse = {
        "count": 3,
        "indices": {"bufferView": b.view(b"\x09\x01\x02\x03"), "byteOffset": 1, "componentType": 5121},
        "values": {"bufferView": b.view(g.CORNERS[1:].astype("<f4").tobytes())},
    }
    record = {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse}
    primitive(b)["attributes"]["POSITION"] = b.add("accessors", record)


def quantized(b):
    """KHR_mesh_quantization: normalised 16-bit positions, plain and normalised 8-bit ones elsewhere."""
    b.json["extensionsUsed"] = b.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    rows = np.pad(g.CORNERS * 32767, ((0, 0), (0, 1))).astype("<i2")  # rows of 6 bytes, 8 apart
    view = b.view(rows.tobytes(), byteStride=8)
    record = {"bufferView": view, "componentType": 5122, "count": 4, "type": "VEC3", "normalized": True}
    primitive(b)["attributes"]["POSITION"] = b.add("accessors", record)
    normals = np.rint(g.NORMALS * 127)
    primitive(b)["attributes"]["NORMAL"] = b.accessor(normals, "i1", normalized=True)


def plain_integer_positions(b):
    primitive(b)["attributes"]["POSITION"] = b.accessor(g.CORNERS, "u1")


def strip(b):
    """One strip round the tetrahedron: 1 2 0 3 1 2 has the faces 120, 023 (turned), 031, 132 (turned)."""
    primitive(b)["mode"] = 5
    primitive(b)["indices"] = b.accessor([0, 2, 1, 3, 0, 2], "u1")


def fan(b):
    """A fan about corner 0 and the face opposite, as two primitives."""
    base = copy.deepcopy(primitive(b))
    base["indices"] = b.accessor([1, 2, 3], "u1")
    primitive(b)["mode"] = 6
    primitive(b)["indices"] = b.accessor([0, 2, 1, 3, 2], "u1")
    b.json["meshes"][0]["primitives"].append(base)


def foreign_extras(b):
    b.json["extensionsUsed"] = ["KHR_materials_unlit", "VENDOR_whatever"]
    b.json["extras"] = {"anything": [1, 2, {"x": None}]}
    primitive(b)["attributes"]["_CUSTOM"] = 0
    b.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    b.json["nodes"].append({"name": "camera", "camera": 0})


def leftover_joints_at_weight_zero(b):
    primitive(b)["attributes"]["JOINTS_0"] = b.accessor(np.where(g.WEIGHTS > 0, g.JOINTS, 200), "u1")


ALIKE = [
    joints_u16,
    weights_u8,
    weights_u16,
    indices_u8,
    indices_u32,
    no_indices,
    interleaved,
    eight_influences,
    sparse_with_base,
    sparse_without_base,
    quantized,
    plain_integer_positions,
    strip,
    fan,
    foreign_extras,
    leftover_joints_at_weight_zero,
]


@pytest.mark.parametrize("variant", ALIKE, ids=lambda f: f.__name__)
def test_same_body_however_it_is_stored(tmp_path, variant):
    b = tetrahedron()
    variant(b)
    character = load(b, tmp_path)
    rotation = np.eye(4)
    rotation[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.5, 0.9]).as_matrix()
    world = np.stack([rotation, rest_matrices(character)[1] @ rotation])
    got = posed(character, world)
    expected = posed(load(tetrahedron(), tmp_path), world)

    def sort(faces):
        # The first corner of a face is a matter of storage; its orientation is not.
        start = [np.lexsort(face.T.round(4))[0] for face in faces]
        turned = np.array([np.roll(face, -i, axis=0) for face, i in zip(faces, start, strict=True)])
        return turned[np.lexsort(turned.reshape(len(faces), 9).T.round(4))]

    # 8-bit weights are off by half a step of 1/255, times a lever of up to 3 m.
    tolerance = 8e-3 if variant is weights_u8 else 6e-5 if variant is weights_u16 else 4e-6
    np.testing.assert_allclose(sort(got), sort(expected), rtol=0, atol=tolerance)
    normals = np.asarray(character.skin.normals)
    assert np.abs(np.linalg.norm(normals, axis=-1) - 1).max() < 1e-6


def test_more_than_four_influences_are_kept(tmp_path):
    b = tetrahedron()
    b.json["nodes"] += [{"name": f"extra{i}"} for i in range(4)]
    b.json["skins"] = [{"joints": [0, 1, 3, 4, 5, 6]}]
    b.json["scenes"] = [{"nodes": [0, 2, 3, 4, 5, 6]}]
    weights = np.array([[0.3, 0.2, 0.1, 0.1], [0.2, 0.1, 0.0, 0.0]])
    attributes = primitive(b)["attributes"]
    for n, joints in enumerate(([0, 1, 2, 3], [4, 5, 0, 0])):
        attributes[f"JOINTS_{n}"] = b.accessor(np.tile(joints, (4, 1)), "u1")
        attributes[f"WEIGHTS_{n}"] = b.accessor(np.tile(weights[n], (4, 1)))
    skin = load(b, tmp_path).skin
    assert skin.weights.shape == (4, 6)
    np.testing.assert_allclose(skin.weights[0], [0.3, 0.2, 0.2, 0.1, 0.1, 0.1], rtol=1e-6)
    assert set(np.asarray(skin.joint_indices[2]).tolist()) == set(range(6))


# --- where the bytes come from ---


@pytest.mark.parametrize("name", ["body.bin", "b%20o/d%C3%A4y.bin"])
def test_external_buffer_beside_or_below_the_file(tmp_path, name):
    b = tetrahedron()
    (tmp_path / "b o").mkdir()
    path = tmp_path / "c.gltf"
    path.write_bytes(b.gltf(name))
    plain = name.replace("%20", " ").replace("%C3%A4", "ä")
    (tmp_path / plain).write_bytes(bytes(b.blob) + b"tail")
    np.testing.assert_array_equal(read_gltf(path).skin.vertices, g.CORNERS)


def test_embedded_buffers(tmp_path):
    b = tetrahedron()
    path = tmp_path / "c.gltf"
    path.write_bytes(b"\xef\xbb\xbf  " + b.gltf())
    np.testing.assert_array_equal(read_gltf(path).skin.vertices, g.CORNERS)
    path.write_bytes(b.gltf("data:," + "".join(f"%{byte:02x}" for byte in b.blob)))
    np.testing.assert_array_equal(read_gltf(path).skin.vertices, g.CORNERS)


OUTSIDE = [
    "/etc/hostname",
    "../secret.bin",
    "a/../../secret.bin",
    "..%2Fsecret.bin",
    "%2e%2e/secret.bin",
    "..\\secret.bin",
    "\\\\host\\share",
    "//host/secret.bin",
    "file:///etc/hostname",
    "http://example.org/a.bin",
    "http%3A//example.org/a.bin",
    "C:/secret.bin",
    "link.bin",
    "linked/secret.bin",
]
NOWHERE = ["loop", "a\0b", "x" * 5000, "\ud800.bin", "gone.bin"]


def write_with_uri(folder: pathlib.Path, uri: str, what: str) -> pathlib.Path:
    """A file in a folder with links that lead out of it, whose buffer or image is at `uri`."""
    inside = folder / "inside"
    inside.mkdir()
    b = tetrahedron()
    (folder / "secret.bin").write_bytes(bytes(b.blob))
    (inside / "link.bin").symlink_to(folder / "secret.bin")
    (inside / "linked").symlink_to(folder)
    (inside / "loop").symlink_to(inside / "loop")
    if what == "images":
        textured(b, {"uri": uri})
    (inside / "c.gltf").write_bytes(b.gltf(uri if what == "buffers" else None))
    return inside / "c.gltf"


@pytest.mark.parametrize("uri", OUTSIDE)
@pytest.mark.parametrize("what", ["buffers", "images"])
def test_no_way_out_of_the_folder(tmp_path, uri, what):
    path = write_with_uri(tmp_path, uri, what)
    with pytest.raises(InputError, match=rf"c.gltf: {what}\[0\].uri: expected a file inside the folder"):
        read_gltf(path)


@pytest.mark.parametrize("uri", NOWHERE, ids=["loop", "nul", "long", "surrogate", "gone"])
def test_buffer_that_is_nowhere(tmp_path, uri):
    path = write_with_uri(tmp_path, uri, "buffers")
    with pytest.raises(InputError, match=r"buffers\[0\].*: expected a (readable )?file") as caught:
        read_gltf(path)
    assert len(str(caught.value)) < 400 and str(caught.value).isprintable()


def test_link_inside_the_folder_is_followed(tmp_path):
    b = tetrahedron()
    (tmp_path / "real.bin").write_bytes(bytes(b.blob))
    (tmp_path / "link.bin").symlink_to("real.bin")
    (tmp_path / "c.gltf").write_bytes(b.gltf("link.bin"))
    assert read_gltf(tmp_path / "c.gltf").skin.vertices.shape == (4, 3)


# --- nodes ---


def test_matrix_is_decomposed(tmp_path):
    b = rigid()
    rotation = Rotation.from_euler("xyz", [0.4, 1.1, -2.0])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix() @ np.diag([2.0, 0.5, 3.0])
    matrix[:3, 3] = [1, 2, 3]
    b.json["nodes"][0]["matrix"] = matrix.T.ravel().tolist()
    rest = load(b, tmp_path).skeleton.rest
    np.testing.assert_allclose(rest.translation[0], [1, 2, 3], rtol=1e-6)
    np.testing.assert_allclose(rest.scale[0], [2, 0.5, 3], rtol=1e-6)
    assert abs(np.dot(rest.rotation[0], rotation.as_quat())) > 1 - 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_matrix_of_half_turns_is_decomposed(tmp_path, seed):
    """Each of the four branches from matrix to quaternion."""
    q = np.eye(4)[seed] + 0.1 * np.random.default_rng(seed).normal(size=4)
    q /= np.linalg.norm(q)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(q).as_matrix()
    b = rigid()
    b.json["nodes"][0]["matrix"] = matrix.T.ravel().tolist()
    assert abs(np.dot(load(b, tmp_path).skeleton.rest.rotation[0], q)) > 1 - 1e-6


def volume(corners: np.ndarray) -> float:
    """Signed volume inside posed faces: positive if they are wound outward."""
    a, b, c = corners.swapaxes(0, 1)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("field", ["scale", "matrix"])
def test_mirrored_node_is_turned_right_side_out(tmp_path, field, flat):
    b = rigid()
    b.json["nodes"][0][field] = [-2, 1, 1] if field == "scale" else np.diag([1, -2, 1, 1]).ravel().tolist()
    if flat:
        del primitive(b)["attributes"]["NORMAL"]
    character = load(b, tmp_path)
    world = rest_matrices(character)
    assert volume(posed(character, world)) == pytest.approx(2.0 / 6.0)
    mesh = jax.jit(skin_mesh)(character.skin, jnp.asarray(world, dtype=jnp.float32))
    corners = np.asarray(mesh.positions)[np.asarray(character.faces)]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    of_vertices = np.asarray(mesh.frames[..., 2])[np.asarray(character.faces)].sum(axis=1)
    assert (np.sum(outward * of_vertices, axis=-1) > 0).all()


def test_skin_that_mirrors_twice_is_left_alone(tmp_path):
    """Only the product of joint and inverse bind matrix decides."""
    b = tetrahedron()
    b.json["nodes"][0]["scale"] = [-1, 1, 1]
    binds = np.linalg.inv(np.array([np.diag([-1, 1, 1, 1]), [[-1, 0, 0, 0], [0, 1, 0, 2], [0, 0, 1, 0], [0, 0, 0, 1]]]))
    b.json["skins"][0]["inverseBindMatrices"] = b.accessor(binds.swapaxes(1, 2).reshape(-1, 16))
    character = load(b, tmp_path)
    np.testing.assert_array_equal(character.faces, g.FACES)
    assert volume(posed(character, rest_matrices(character))) == pytest.approx(1.0 / 6.0)


def test_rigid_meshes_hang_on_animated_nodes_that_are_no_joints(tmp_path):
    """A node above a rigid mesh is moved; a node beside it is not part of the skeleton."""
    b = rigid()
    b.json |= {
        "scenes": [{"nodes": [1]}],
        "nodes": [
            {"name": "body", "mesh": 0, "translation": [0, 0, 1]},
            {"name": "carrier", "children": [0, 2], "scale": [2, 2, 2]},
            {"name": "lamp"},
        ],
        "animations": [
            {
                "channels": [
                    {"sampler": 0, "target": {"node": 1, "path": "translation"}},
                    {"sampler": 0, "target": {"node": 2, "path": "translation"}},
                    {"sampler": 0, "target": {"path": "translation"}},
                ],
                "samplers": [{"input": 6, "output": b.accessor([[0, 0, 0], [4, 0, 0]])}],
            }
        ],
    }
    character = load(b, tmp_path)
    assert character.skeleton.names == ("carrier", "body") and character.skeleton.parents == (-1, 0)
    assert character.skin.weights.shape == (4, 1)
    assert [channel.joint for channel in character.clips[0].channels] == [0]
    assert character.notes == ("animation channels without a node left out: 1",)
    expected = 2 * (g.CORNERS + [0, 0, 1]) + [2, 0, 0]
    np.testing.assert_allclose(posed(character, at_time(character, 1.0)), expected[g.FACES], atol=1e-6)


def test_several_skins_primitives_and_instances_become_one_surface(tmp_path):
    b = tetrahedron()
    twin = copy.deepcopy(primitive(b))
    b.json["meshes"][0]["primitives"].append(twin)
    b.json["meshes"].append({"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 4}]})
    b.json["skins"].append({"joints": [4, 0]})
    b.json["nodes"] += [
        {"name": "second body", "mesh": 0, "skin": 1},
        {"name": "second tip", "translation": [5, 0, 0]},
        {"name": "hat", "mesh": 1, "translation": [0, 9, 0]},
        {"name": "same skin", "mesh": 0, "skin": 0},
    ]
    b.json["scenes"] = [{"nodes": [0, 2, 3, 4, 5, 6]}]
    character = load(b, tmp_path)
    # Three instances of two primitives and one of one primitive, four corners each.
    assert character.skin.vertices.shape == (28, 3) and character.faces.shape == (28, 3)
    names = [character.skeleton.names[j] for j in character.skin.palette_joints]
    assert names == ["root", "tip", "second tip", "root", "hat"], "a skin used twice has one block"
    corners = posed(character, rest_matrices(character))
    assert_close(corners[:8], np.tile(g.CORNERS[g.FACES], (2, 1, 1)), ulps=8, dtype=np.float32)
    # The second skin has no inverse binds: joint 0 is the tip at x = 5, joint 1 the root.
    shift = (g.WEIGHTS * (g.JOINTS == 0)).sum(axis=1)[:, None] * [5, 0, 0]
    assert_close(corners[8:12], (g.CORNERS + shift)[g.FACES], ulps=8, dtype=np.float32)
    assert_close(corners[16:20], (g.CORNERS + [0, 9, 0])[g.FACES], ulps=8, dtype=np.float32)


def test_only_the_default_scene_is_read_and_all_nodes_without_scenes(tmp_path):
    b = rigid()
    b.json["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}, {"children": [0]}]
    b.json["scenes"] = [{"nodes": [2]}, {"nodes": [1]}]
    b.json["scene"] = 1
    np.testing.assert_array_equal(load(b, tmp_path).skeleton.rest.translation, [[3, 0, 0]])
    del b.json["scene"], b.json["scenes"]
    character = load(b, tmp_path)
    assert character.skin.vertices.shape == (8, 3)
    assert character.skeleton.names == ("node_1", "node_2", "node_0")
    b.json["scenes"] = []
    assert load(b, tmp_path).skin.vertices.shape == (8, 3)


def test_skinned_mesh_ignores_the_transform_of_its_node(tmp_path):
    b = tetrahedron()
    b.json["nodes"][2] |= {"translation": [100, 0, 0], "scale": [-1, 1, 1]}
    character = load(b, tmp_path)
    assert_close(posed(character, rest_matrices(character)), g.CORNERS[g.FACES], ulps=8, dtype=np.float32)


def test_deep_chain_of_nodes(tmp_path):
    b = rigid()
    depth = 1200
    b.json["nodes"] = [{"children": [i + 1], "translation": [0.5, 0, 0]} for i in range(depth)] + [{"mesh": 0}]
    character = load(b, tmp_path)
    assert len(character.skeleton.names) == depth + 1
    np.testing.assert_allclose(posed(character, rest_matrices(character))[0, 0], [600, 0, 0], rtol=1e-6)


# --- surface ---


def test_without_normals_every_corner_is_a_vertex_with_the_normal_of_its_face(tmp_path):
    b = tetrahedron()
    del primitive(b)["attributes"]["NORMAL"]
    character = load(b, tmp_path)
    np.testing.assert_array_equal(character.faces, np.arange(12).reshape(4, 3))
    np.testing.assert_array_equal(character.skin.vertices, g.CORNERS[g.FACES.ravel()])
    s = 1 / np.sqrt(3)
    expected = np.repeat([[0, 0, -1], [0, -1, 0], [-1, 0, 0], [s, s, s]], 3, axis=0)
    np.testing.assert_allclose(character.skin.normals, expected, rtol=0, atol=1e-6)


def test_faces_without_area_and_vertices_without_faces_are_dropped_and_counted(tmp_path):
    b = tetrahedron()
    extra = np.array([[9, 9, 9], [2, 0, 0], [0.1, 0, 0]])  # unused; in line with corners 0 and 1
    attributes = primitive(b)["attributes"]
    attributes["POSITION"] = b.accessor(np.vstack([g.CORNERS, extra]))
    attributes["NORMAL"] = b.accessor(np.vstack([g.NORMALS, g.NORMALS[:3]]))
    attributes["JOINTS_0"] = b.accessor(np.vstack([g.JOINTS, g.JOINTS[:3]]), "u1")
    attributes["WEIGHTS_0"] = b.accessor(np.vstack([g.WEIGHTS, np.zeros((3, 4))]))
    faces = np.vstack([[[0, 0, 1]], g.FACES, [[0, 1, 5], [6, 0, 1], [2, 2, 2]]])
    primitive(b)["indices"] = b.accessor(faces.ravel(), "u1")
    character = load(b, tmp_path)
    np.testing.assert_array_equal(character.faces, g.FACES)
    np.testing.assert_array_equal(character.skin.vertices, g.CORNERS)
    assert character.notes == ("zero-area faces dropped: 4",)


def test_thin_faces_are_kept(tmp_path):
    b = rigid()
    corners = g.CORNERS * np.array([1.0, 1e-5, 1e-5])
    primitive(b)["attributes"]["POSITION"] = b.accessor(corners)
    character = load(b, tmp_path)
    assert character.faces.shape == (4, 3) and character.notes == ()


def test_normals_of_no_length_are_replaced_and_long_ones_shortened(tmp_path):
    b = tetrahedron()
    normals = g.NORMALS * 3.0
    normals[2] = 0.0
    primitive(b)["attributes"]["NORMAL"] = b.accessor(normals)
    character = load(b, tmp_path)
    got = np.asarray(character.skin.normals)
    np.testing.assert_allclose(got[[0, 1, 3]], g.NORMALS[[0, 1, 3]], rtol=0, atol=1e-6)
    s = 1 / np.sqrt(3)
    candidates = np.array([[0, 0, -1], [-1, 0, 0], [s, s, s]])
    assert np.abs(got[2] - candidates).sum(axis=1).min() < 1e-6
    assert character.notes == ("zero normals replaced by face normals: 1",)


def test_points_and_lines_are_left_out_and_counted(tmp_path):
    b = tetrahedron()
    for mode in (0, 1, 3):
        b.json["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": mode})
    character = load(b, tmp_path)
    assert character.faces.shape == (4, 3)
    assert character.notes == ("primitives of points or lines left out: 3",)


def test_weights_a_little_off_are_renormalized_and_counted(tmp_path):
    b = tetrahedron()
    weights = g.WEIGHTS.copy()
    weights[0] *= 1.009
    weights[3] *= 0.995
    primitive(b)["attributes"]["WEIGHTS_0"] = b.accessor(weights)
    character = load(b, tmp_path)
    np.testing.assert_allclose(character.skin.weights.sum(axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(sorted(character.skin.weights[0]), [0.25, 0.75], rtol=1e-6)
    assert character.notes == ("vertices whose weights were renormalized: 2",)


def test_hostile_names_become_one_printable_line(tmp_path):
    b = tetrahedron()
    b.json["nodes"][1]["name"] = "a\nb\x1b[31m\ud800" + "x" * 1000
    b.json["animations"][0]["name"] = "two\nlines"
    character = load(b, tmp_path)
    name = character.skeleton.names[1]
    assert name.startswith("a\ufffdb\ufffd[31m\ufffdxx") and len(name) == 80
    assert character.clips[0].name == "two\ufffdlines"


# --- clips ---


def test_all_interpolations_arrive_as_stored(tmp_path):
    b = tetrahedron()
    animation = b.json["animations"][0]
    times = b.accessor([0.0, 0.25, 1.0])
    rng = np.random.default_rng(5)
    cubic = rng.normal(size=(3, 3, 3)).astype(np.float32)
    steps = rng.normal(size=(3, 3)).astype(np.float32)
    animation["samplers"] += [
        {"input": times, "output": b.accessor(cubic.reshape(-1, 3)), "interpolation": "CUBICSPLINE"},
        {"input": times, "output": b.accessor(steps), "interpolation": "STEP"},
    ]
    animation["channels"] += [
        {"sampler": 1, "target": {"node": 1, "path": "translation"}},
        {"sampler": 2, "target": {"node": 0, "path": "scale"}},
    ]
    (clip,) = load(b, tmp_path).clips
    assert (clip.start, clip.duration) == (0.0, 1.5)
    turn, move, grow = clip.channels
    assert [c.interpolation for c in clip.channels] == ["LINEAR", "CUBICSPLINE", "STEP"]
    np.testing.assert_array_equal(move.values, cubic)
    np.testing.assert_array_equal(grow.values, steps)
    np.testing.assert_array_equal(grow.times, [0, 0.25, 1])
    np.testing.assert_allclose(turn.values, [[0, 0, 0, 1], g.QUARTER_TURN], rtol=1e-6)


def test_normalized_integer_rotations(tmp_path):
    b = tetrahedron()
    keys = np.rint(np.array([[0, 0, 0, 1], g.QUARTER_TURN]) * 32767)
    b.json["animations"][0]["samplers"][0]["output"] = b.accessor(keys, "i2", normalized=True)
    character = load(b, tmp_path)
    values = character.clips[0].channels[0].values
    np.testing.assert_allclose(values, [[0, 0, 0, 1], g.QUARTER_TURN], rtol=0, atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(values, axis=-1), 1.0, rtol=1e-6)
    assert character.notes == ()


def test_rotations_that_are_no_unit_quaternions_are_normalized_and_counted(tmp_path):
    b = tetrahedron()
    b.json["animations"][0]["samplers"][0]["output"] = b.accessor([[0, 0, 0, 2], [0, 0, 3, 3]])
    b.json["nodes"][1]["rotation"] = [0, 0, 0, 5]
    character = load(b, tmp_path)
    np.testing.assert_allclose(character.clips[0].channels[0].values[1], g.QUARTER_TURN, rtol=1e-6)
    np.testing.assert_array_equal(character.skeleton.rest.rotation[1], [0, 0, 0, 1])
    assert character.notes == ("rotations that were not unit quaternions, normalized: 3",)


def test_of_keys_at_one_time_the_last_counts(tmp_path):
    b = tetrahedron()
    sampler = b.json["animations"][0]["samplers"][0]
    sampler["input"] = b.accessor([0.0, 1.0, 1.0, 2.0])
    sampler["output"] = b.accessor([[0, 0, 0, 1], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
    character = load(b, tmp_path)
    channel = character.clips[0].channels[0]
    np.testing.assert_array_equal(channel.times, [0, 1, 2])
    np.testing.assert_array_equal(channel.values[1], [0, 1, 0, 0])
    assert character.notes == ("animation keys at the time of the next key dropped: 1",)


def test_clip_names_are_distinct_and_idle_clips_left_out(tmp_path):
    b = tetrahedron()
    b.json["animations"] += [copy.deepcopy(b.json["animations"][0]) for _ in range(3)]
    del b.json["animations"][2]["name"]
    b.json["animations"][3]["channels"][0]["target"]["node"] = 2  # the node of a skinned mesh moves nothing
    character = load(b, tmp_path)
    assert [clip.name for clip in character.clips] == ["turn", "turn_1", "clip_2"]
    assert character.notes == ("clips that move nothing left out: 1",)


def test_no_animation_is_fine(tmp_path):
    b = tetrahedron()
    del b.json["animations"]
    assert load(b, tmp_path).clips == ()


# --- albedo ---


def png(pixels: Any, mode: str = "RGB") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.asarray(pixels, dtype=np.uint8), mode=None).convert(mode).save(stream, "PNG")
    return stream.getvalue()


def textured(b: GltfBuilder, image: dict, uv: Any = None, sampler: dict | None = None) -> None:
    """A material whose texture is this image, with the corners of the tetrahedron at `uv`."""
    uv = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]] if uv is None else uv
    primitive(b)["attributes"]["TEXCOORD_0"] = b.accessor(uv)
    primitive(b)["material"] = 0
    texture = {"source": 0} if sampler is None else {"source": 0, "sampler": 0}
    b.json |= {
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [texture],
        "images": [image],
        "samplers": [sampler or {}],
    }


# sRGB 188 is 0.50 of full light (IEC 61966-2-1), not the 0.74 of its code.
PIXELS = [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [188, 188, 188]]]
LINEAR = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5029, 0.5029, 0.5029]]


def test_albedo_is_factor_times_color_times_texture(tmp_path):
    b = tetrahedron()
    textured(b, {"bufferView": b.view(png(PIXELS)), "mimeType": "image/png"})
    b.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 1.0, 0.25, 0.1]
    colors = np.array([[255, 255, 255, 0], [255, 51, 255, 0], [255, 255, 255, 9], [0, 255, 255, 255]])
    primitive(b)["attributes"]["COLOR_0"] = b.accessor(colors, "u1", normalized=True)
    character = load(b, tmp_path)
    expected = np.array(LINEAR) * [0.5, 1.0, 0.25] * [[1, 1, 1], [1, 0.2, 1], [1, 1, 1], [0, 1, 1]]
    np.testing.assert_allclose(character.albedo, expected, rtol=0, atol=1e-4)
    assert character.notes == ()


def test_texture_from_a_file_and_from_a_data_uri(tmp_path):
    import base64

    b = tetrahedron()
    textured(b, {"uri": "data:image/png;base64," + base64.b64encode(png(PIXELS)).decode()})
    np.testing.assert_allclose(load(b, tmp_path).albedo, LINEAR, rtol=0, atol=1e-4)
    b.json["images"] = [{"uri": "skin%20a.png"}]
    (tmp_path / "skin a.png").write_bytes(png(PIXELS, "RGBA"))
    np.testing.assert_allclose(load(b, tmp_path).albedo, LINEAR, rtol=0, atol=1e-4)


def test_texture_follows_the_vertices_of_flat_shading(tmp_path):
    b = tetrahedron()
    textured(b, {"bufferView": b.view(png(PIXELS))})
    del primitive(b)["attributes"]["NORMAL"]
    expected = np.array(LINEAR)[g.FACES.ravel()]
    np.testing.assert_allclose(load(b, tmp_path).albedo, expected, rtol=0, atol=1e-4)


def test_texture_transform_turns_counter_clockwise_in_the_image(tmp_path):
    """A quarter turn takes u to -v (v points down), the offset brings it back into the image."""
    b = tetrahedron()
    textured(b, {"bufferView": b.view(png(PIXELS))}, uv=[[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    info = b.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    transform = {"rotation": math.pi / 2, "offset": [0.0, 1.0]}
    info["extensions"] = {"KHR_texture_transform": transform}
    b.json["extensionsRequired"] = ["KHR_texture_transform"]
    # (u, v) -> (v, 1 - u): the corners see lower left, upper left, lower right, upper right.
    expected = np.array(LINEAR)[[2, 0, 3, 1]]
    np.testing.assert_allclose(load(b, tmp_path).albedo, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("wrap_u", [10497, 33071, 33648, None])
@pytest.mark.parametrize("size", [(1, 1), (3, 4), (5, 2)])
def test_bilinear_lookup_against_a_loop(rng, wrap_u, size):
    image = rng.integers(0, 256, size=(*size, 3), dtype=np.uint8)
    uv = np.vstack([rng.uniform(-3, 3, size=(40, 2)), [[0, 0], [1, 1], [2, -2], [1e6, 0.5]]]).astype(np.float32)
    got = sample_bilinear(image, uv, wrap_u=wrap_u, wrap_v=33071)

    def decoded(c):
        c = c / 255
        return c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4

    def wrapped(i, n, wrap):
        if wrap == 33071:
            return min(max(i, 0), n - 1)
        if wrap == 33648:
            return i % n if (i // n) % 2 == 0 else n - 1 - i % n
        return i % n

    for k, (u, v) in enumerate(uv.astype(np.float64)):
        x, y = u * size[1] - 0.5, v * size[0] - 0.5
        total = np.zeros(3)
        for dy in (0, 1):
            for dx in (0, 1):
                i, j = math.floor(y) + dy, math.floor(x) + dx
                share = (1 - abs(y - i)) * (1 - abs(x - j))
                texel = image[wrapped(i, size[0], 33071), wrapped(j, size[1], wrap_u)]
                total += share * np.array([decoded(float(c)) for c in texel])
        np.testing.assert_allclose(got[k], total, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "image, reason",
    [
        ({"uri": "missing.png"}, "bytes are missing"),
        ({"bufferView": 999}, "bytes are missing"),
        ({"bufferView": 0}, "not a readable"),
        ({"uri": "data:image/png;base64,!!!"}, "bytes are missing"),
        ({"uri": "data:image/png;base64,iVBORw0KGgo="}, "not a readable"),
        ({}, "bytes are missing"),
    ],
)
def test_texture_that_cannot_be_read_leaves_the_factor(tmp_path, image, reason):
    b = tetrahedron()
    textured(b, image)
    b.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.25, 1.0, 1.0]
    character = load(b, tmp_path)
    np.testing.assert_array_equal(character.albedo, np.tile([0.5, 0.25, 1.0], (4, 1)))
    (note,) = character.notes
    assert reason in note


def test_damaged_and_giant_images_leave_the_factor(tmp_path):
    whole = png(np.zeros((64, 64, 3)))
    giant = bytearray(whole)
    giant[16:24] = (60000).to_bytes(4, "big") * 2  # the header's size, without the data
    for data in (whole[: len(whole) // 2], bytes(giant), b"<svg/>", b"\x00" * 100):
        b = tetrahedron()
        textured(b, {"bufferView": b.view(data)})
        tracemalloc.start()
        character = load(b, tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert len(character.notes) == 1 and peak < 20e6
        np.testing.assert_array_equal(character.albedo, np.ones((4, 3)))


def test_texture_without_coordinates_or_source_leaves_the_factor(tmp_path):
    b = tetrahedron()
    textured(b, {"bufferView": b.view(png(PIXELS))})
    b.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 3
    assert load(b, tmp_path).notes == ("base color texture left out (no TEXCOORD_3): 1",)
    b = tetrahedron()
    textured(b, {"bufferView": 0})
    for source in ([], "x", 7):
        b.json["textures"] = [{"extensions": {"EXT_texture_webp": {"source": source}}}]
        refused(b, tmp_path, "textures.source: expected an index into 1 images")
    b.json["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    assert "no image in a supported format" in load(b, tmp_path).notes[0]


@pytest.mark.parametrize(
    "transform",
    [
        {"scale": [1e308, 1e308], "rotation": 1.0},
        {"offset": "x"},
        {"offset": [1, 2, 3]},
        {"rotation": 10**400},
    ],
)
def test_bad_texture_transform_leaves_the_factor(tmp_path, transform):
    b = tetrahedron()
    textured(b, {"bufferView": b.view(png(PIXELS))}, uv=np.full((4, 2), 1e8))
    info = b.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": transform}
    assert load(b, tmp_path).notes == ("base color texture left out (bad KHR_texture_transform): 1",)


def test_colors_out_of_range_are_clipped(tmp_path):
    b = tetrahedron()
    primitive(b)["attributes"]["COLOR_0"] = b.accessor(np.tile([1e9, -5.0, 0.5], (4, 1)))
    primitive(b)["material"] = 0
    b.json["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1e308, 1, 1, 1]}}]
    np.testing.assert_array_equal(load(b, tmp_path).albedo, np.tile([1.0, 0.0, 0.5], (4, 1)))


# --- bad input: one line that names the field ---


def change(*path: Any, to: Any):
    """A function that sets one entry of the JSON."""

    def apply(b: GltfBuilder) -> None:
        target = b.json
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = to

    return apply


def attribute(name: str, array: Any, dtype: str = "f4", **fields: Any):
    def apply(b: GltfBuilder) -> None:
        primitive(b)["attributes"][name] = b.accessor(array, dtype, **fields)

    return apply


def with_entry(array: np.ndarray, index: tuple, value: float) -> np.ndarray:
    array = np.array(array, dtype=np.float64)
    array[index] = value
    return array


def sampler_data(times: Any, values: Any, interpolation: str = "LINEAR"):
    def apply(b: GltfBuilder) -> None:
        b.json["animations"][0]["samplers"] = [
            {"input": b.accessor(times), "output": b.accessor(values), "interpolation": interpolation}
        ]

    return apply


def sparse(**fields: Any):
    def apply(b: GltfBuilder) -> None:
        sparse_with_base(b)
        record = b.json["accessors"][-1]["sparse"]
        for key, value in fields.items():
            target = record
            *above, last = key.split("__")
            for part in above:
                target = target[part]
            target[last] = value

    return apply


def draco(b: GltfBuilder) -> None:
    """Compressed data alone, though the extension is not declared as required."""
    primitive(b)["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    del b.json["accessors"][0]["bufferView"]


def meshopt(b: GltfBuilder) -> None:
    b.json["bufferViews"][0]["buffer"] = 1
    placeholder = {"byteLength": 48, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
    b.json["buffers"] = [{"byteLength": len(b.blob)}, placeholder]


SHEAR = [1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
HUGE = 2**70

BAD = [
    # file level
    (change("asset", "version", to="1.0"), r"asset.version: expected 2.x, got 1.0"),
    (
        change("extensionsRequired", to=["KHR_draco_mesh_compression"]),
        "extensionsRequired.*KHR_draco_mesh_compress",
    ),
    (change("extensionsRequired", to=["EXT_meshopt_compression"]), "got EXT_meshopt_compression"),
    (change("extensionsRequired", to=["VENDOR_x\ny"]), "extensionsRequired: .*got VENDOR_x.y"),
    (change("nodes", to=5), "JSON: expected a valid glTF"),
    (change("nodes", to=[None]), "JSON: expected a valid|nodes.0.: expected an entry"),
    (change("meshes", to=[]), r"nodes\[2\].mesh: expected an index into 0 meshes, got 0"),
    (change("meshes", 0, "primitives", to=[]), "meshes: expected at least one triangle, got no mesh"),
    (change("scenes", to=[{"nodes": []}]), "meshes: expected at least one triangle, got no mesh"),
    (change("scene", to=4), "scene: expected an index into 1 scenes, got 4"),
    (change("scene", to=-1), "scene: expected an index into 1 scenes, got -1"),
    # nodes
    (change("scenes", 0, "nodes", to=[0, 99]), "scene.nodes: expected an index into 3 nodes, got 99"),
    (change("nodes", 0, "children", to=[7]), r"nodes\[0\].children: expected an index into 3 nodes, got 7"),
    (change("nodes", 0, "children", to=[-1]), r"nodes\[0\].children: .* got -1"),
    (change("nodes", 1, "children", to=[0]), r"nodes\[0\]: expected a node below a root, got a cycle"),
    (change("nodes", 0, "children", to=[0]), r"nodes\[0\]: .* a cycle"),
    (change("nodes", 0, "children", to=[1, 1]), r"nodes\[1\]: expected one parent, got nodes 0 and 0"),
    (change("nodes", 2, "children", to=[1]), r"nodes\[1\]: expected one parent, got nodes 0 and 2"),
    (change("nodes", 1, "matrix", to=SHEAR), r"nodes\[1\].matrix: .* got a matrix that shears"),
    (change("nodes", 1, "matrix", to=[0] * 15 + [1]), r"nodes\[1\].matrix: expected an affine matrix"),
    (change("nodes", 1, "matrix", to=[1, 0]), r"nodes\[1\].matrix: expected 16 finite numbers"),
    (change("nodes", 1, "rotation", to=[0, 0, 0, 0]), "nodes.rotation: expected unit quaternions"),
    (change("nodes", 1, "rotation", to=[0, 0, 1]), r"nodes\[1\].rotation: expected 4 finite"),
    (
        change("nodes", 1, "translation", to=[0, float("nan"), 0]),
        r"nodes\[1\].translation: expected 3 finite",
    ),
    (
        change("nodes", 1, "scale", to=[1e30, 1, 1]),
        r"nodes\[1\].scale: expected 3 finite numbers up to 1e\+09",
    ),
    # accessors and views
    (
        change("accessors", 0, "count", to=5),
        r"accessors\[0\]: expected data within its bufferView of 48 bytes",
    ),
    (change("accessors", 0, "count", to=0), r"accessors\[0\].count: expected a whole number >= 1, got 0"),
    (change("accessors", 0, "count", to=-3), r"accessors\[0\].count: .* got -3"),
    (change("accessors", 0, "count", to=HUGE), r"accessors\[0\].count: expected at most"),
    (change("accessors", 0, "count", to=2**24), r"accessors\[0\]: expected data within"),
    (change("accessors", 0, "byteOffset", to=4), r"accessors\[0\]: expected data within"),
    (change("accessors", 0, "byteOffset", to=HUGE), r"accessors\[0\]: expected data within"),
    (change("accessors", 0, "byteOffset", to=-4), r"accessors\[0\].byteOffset: expected a whole number >= 0"),
    (change("accessors", 0, "componentType", to=5130), r"accessors\[0\].componentType: expected one of 5120"),
    (change("accessors", 0, "type", to="VEC5"), r"POSITION -> accessors\[0\].type: expected VEC3, got VEC5"),
    (change("accessors", 0, "type", to="VEC2"), "expected VEC3, got VEC2"),
    (change("accessors", 0, "bufferView", to=99), r"accessors\[0\].bufferView: expected an index into 8"),
    (
        change("bufferViews", 0, "byteStride", to=0),
        r"bufferViews\[0\].byteStride: expected a whole number >= 12",
    ),
    (change("bufferViews", 0, "byteStride", to=HUGE), r"accessors\[0\]: expected data within"),
    (change("bufferViews", 0, "byteLength", to=HUGE), r"bufferViews\[0\]: expected bytes within its buffer"),
    (change("bufferViews", 0, "byteOffset", to=HUGE), r"bufferViews\[0\]: expected bytes within its buffer"),
    (change("bufferViews", 0, "byteOffset", to=-1), r"bufferViews\[0\].byteOffset: .* got -1"),
    (change("bufferViews", 0, "buffer", to=1), r"bufferViews\[0\].buffer: expected an index into 1 buffers"),
    (change("buffers", to=[{"byteLength": 10**6}]), r"buffers\[0\]: expected 1000000 bytes, got"),
    (change("buffers", to=[{}]), r"buffers\[0\].byteLength: expected a whole number >= 1, got None"),
    (sparse(count=5), r"sparse: expected indices and values for at most 4 elements, got 5"),
    (sparse(count=0), "sparse.count: expected a whole number >= 1"),
    (sparse(indices={"bufferView": 0, "componentType": 5123}), "sparse.indices: expected increasing"),
    (sparse(indices__bufferView=77), "sparse.indices.bufferView: expected an index"),
    (sparse(values__byteOffset=8), "sparse.values: expected data within"),
    (sparse(values=None), "sparse: expected indices and values"),
    # surface
    (draco, r"primitives\[0\]: expected uncompressed data, got Draco only"),
    (meshopt, r"buffers\[1\]: expected uncompressed data, got a placeholder \(meshopt"),
    (change("meshes", 0, "primitives", 0, "attributes", to={}), "attributes: expected a POSITION, got none"),
    (change("meshes", 0, "primitives", 0, "mode", to=9), r"primitives\[0\].mode: expected 0 to 6, got 9"),
    (
        change("meshes", 0, "primitives", 0, "mode", to=0),
        "at least one triangle, got primitives of points or lines",
    ),
    (
        change("meshes", 0, "primitives", 0, "targets", to=[{"POSITION": 0}]),
        "targets: expected no morph targets",
    ),
    (change("meshes", 0, "primitives", 0, "material", to=3), "material: expected an index into 0 materials"),
    (
        change("meshes", 0, "primitives", 0, "indices", to=6),
        "indices: expected unsigned integers, got float32",
    ),
    (
        lambda b: change("meshes", 0, "primitives", 0, "indices", to=b.accessor([0, 1, 4], "u1"))(b),
        "below 4, got 4",
    ),
    (
        lambda b: change("meshes", 0, "primitives", 0, "indices", to=b.accessor([0, 1], "u1"))(b),
        "multiple of 3",
    ),
    (
        attribute("POSITION", with_entry(g.CORNERS, (2, 1), np.nan)),
        "POSITION: expected finite.* 1 NaN, .* row 2",
    ),
    (attribute("POSITION", with_entry(g.CORNERS, (0, 0), np.inf)), "POSITION: expected finite numbers"),
    (attribute("POSITION", g.CORNERS * 1e20), "POSITION: expected finite numbers up to 1e\\+09"),
    (attribute("POSITION", np.zeros((4, 3))), "at least one triangle, got zero-area faces dropped: 4"),
    (attribute("NORMAL", g.NORMALS[:3]), "NORMAL: expected 4 elements, as POSITION has, got 3"),
    (attribute("NORMAL", np.full((4, 3), np.nan)), "NORMAL: expected finite"),
    (attribute("COLOR_0", np.ones((3, 3))), "COLOR_0: expected 4 elements"),
    # influences
    (
        attribute("WEIGHTS_0", with_entry(g.WEIGHTS, (1,), 0)),
        r"WEIGHTS: expected a sum of 1, got .* at vertex 1",
    ),
    (attribute("WEIGHTS_0", g.WEIGHTS * 1.02), "WEIGHTS: expected a sum of 1, got .* at vertex 0"),
    (
        attribute("WEIGHTS_0", with_entry(g.WEIGHTS, (3, 2), -0.5)),
        "WEIGHTS: expected weights >= 0, got .* vertex 3",
    ),
    (attribute("WEIGHTS_0", with_entry(g.WEIGHTS, (3, 2), np.nan)), "WEIGHTS_0: expected finite"),
    (attribute("WEIGHTS_0", g.WEIGHTS[:2]), "WEIGHTS_0: expected 4 elements"),
    (
        attribute("JOINTS_0", with_entry(g.JOINTS, (2, 0), 2), "u1"),
        "JOINTS: expected indices below 2, got .* vertex 2",
    ),
    (attribute("JOINTS_0", g.JOINTS), "JOINTS_0: expected unsigned integers, got float32"),
    (attribute("JOINTS_1", g.JOINTS, "u1"), "expected WEIGHTS_1 on a skinned mesh"),
    (lambda b: primitive(b)["attributes"].pop("JOINTS_0"), "expected JOINTS_0 on a skinned mesh"),
    (change("nodes", 2, "skin", to=1), r"nodes\[2\].skin: expected an index into 1 skins"),
    (change("skins", 0, "joints", to=[]), r"skins\[0\].joints: expected at least one joint"),
    (change("skins", 0, "joints", to=[0, 9]), r"skins\[0\].joints: expected an index into 3 nodes, got 9"),
    (
        change("skins", 0, "joints", to=[0, 1, 2]),
        "inverseBindMatrices: expected 3 matrices, one a joint, got 2",
    ),
    (change("skins", 0, "inverseBindMatrices", to=0), "inverseBindMatrices -> .* expected MAT4, got VEC3"),
    # clips
    (
        change("animations", 0, "channels", 0, "sampler", to=4),
        r"channels\[0\].sampler: expected an index into 1",
    ),
    (
        change("animations", 0, "channels", 0, "target", "node", to=50),
        r"target.node: expected an index into 3",
    ),
    (
        change("animations", 0, "channels", 0, "target", "path", to="weights"),
        "morph weights are not supported",
    ),
    (
        change("animations", 0, "samplers", 0, "interpolation", to="BEZIER"),
        "expected STEP, LINEAR or CUBICSPLINE",
    ),
    (
        lambda b: b.json["animations"][0]["channels"].extend(b.json["animations"][0]["channels"]),
        "one channel a node",
    ),
    (sampler_data([0, 1], [[0, 0, 0, 1]]), "output: expected 1 values for each of 2 keys, got 1"),
    (sampler_data([0, 1], np.ones((5, 4)), "CUBICSPLINE"), "expected 3 values for each of 2 keys, got 5"),
    (sampler_data([0, 1], np.ones((2, 3))), "output -> .* expected VEC4, got VEC3"),
    (sampler_data([1, 0.5], np.ones((2, 4))), "input: expected increasing times, got 0.5"),
    (sampler_data([0, np.inf], np.ones((2, 4))), "input: expected finite"),
    (sampler_data([0, 1], np.zeros((2, 4))), "output: expected unit quaternions"),
]


@pytest.mark.parametrize("bend, match", BAD, ids=[match[:50] for _, match in BAD])
def test_bad_input_is_refused_with_one_line_that_names_the_field(tmp_path, bend, match):
    b = tetrahedron()
    bend(b)
    refused(b, tmp_path, r"character.glb: .*" + match)


def test_rest_pose_out_of_range_is_refused(tmp_path):
    b = rigid()
    b.json["nodes"] = [{"children": [i + 1], "scale": [1e9] * 3} for i in range(40)] + [{"mesh": 0}]
    refused(b, tmp_path, "rest pose: expected vertices within 1e")


def test_data_that_is_asked_for_again_and_again_is_refused(tmp_path):
    """Ten kilobytes of file that ask for gigabytes of memory."""
    b = rigid()
    zeros = b.add("accessors", {"componentType": 5126, "count": 2**22, "type": "VEC3"})
    attributes = {"POSITION": zeros}
    b.json["meshes"] = [{"primitives": [{"attributes": attributes, "indices": 4}] * 20}]
    tracemalloc.start()
    refused(b, tmp_path, "numbers in all that is read")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300e6  # one accessor at a time: 2^22 positions in float32, and the check's temporaries


def test_many_influences_on_one_face_are_not_spread_over_a_large_mesh(tmp_path):
    b = tetrahedron()
    wide = copy.deepcopy(primitive(b))
    for n in range(1, 60):
        wide["attributes"] |= {f"JOINTS_{n}": 2, f"WEIGHTS_{n}": 3}
    wide["attributes"] |= {f"WEIGHTS_{n}": b.accessor(g.WEIGHTS / 60) for n in range(60)}
    # A strip without normals: three vertices a face.
    large = {"POSITION": b.accessor(np.random.default_rng(0).uniform(size=(2**18, 3)))}
    b.json["meshes"][0]["primitives"] = [wide]
    b.json["meshes"].append({"primitives": [{"attributes": large, "mode": 5}]})
    b.json["nodes"][0]["mesh"] = 1
    refused(b, tmp_path, "meshes: expected at most")


def test_accessor_without_data_has_a_largest_size(tmp_path):
    b = rigid()
    b.json["accessors"][0] = {"componentType": 5126, "count": 2**23, "type": "VEC3"}
    refused(b, tmp_path, r"accessors\[0\].count: expected at most 4194304 without a bufferView")


@pytest.mark.parametrize(
    "data, match",
    [
        (b"", "file: expected 1 to"),
        (b"glTF", "header: expected at least 20 bytes"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 100, "file: expected glTF 2.0"),
        (b"HIERARCHY\nROOT Hips", "file: expected glTF 2.0"),
        (b"{}", "asset: expected a glTF 2.0 asset, got none"),
        (b'{"asset": {"version": "2.0"}', "JSON: expected a valid glTF"),
        (b'{"asset": {"version": "2.0"}}', "meshes: expected at least one triangle, got no mesh"),
        (b'{"asset": {"version": "2.0"}, "a": "\xff"}', "JSON: expected a valid glTF"),
        (b'{"asset": {"version": "2.0"}, "a": ' + b"[" * 100000, "JSON: expected a valid glTF"),
        (b'{"asset": {"version": "2.0"}, "a": ' + b"9" * 10000 + b"}", "JSON: expected a valid glTF"),
        (b'{"asset": {"version": "2.0"}, "nodes": [' + b"{}," * 400000 + b"{}]}", "JSON: expected at most"),
    ],
)
def test_files_that_are_no_gltf(tmp_path, data, match):
    path = tmp_path / "x.gltf"
    path.write_bytes(data)
    with pytest.raises(InputError, match=match):
        read_gltf(path)


def test_glb_header_and_chunks_are_checked(tmp_path):
    whole = tetrahedron().glb()
    path = tmp_path / "x.glb"

    def with_word(offset: int, value: int) -> bytes:
        return whole[:offset] + value.to_bytes(4, "little") + whole[offset + 4 :]

    for data, match in (
        (with_word(4, 1), "header: expected GLB version 2, got 1"),
        (with_word(8, len(whole) + 4), "truncated"),
        (with_word(8, 0xFFFFFFFF), "truncated"),
        (with_word(8, len(whole) - 4), "chunks: expected an end at byte"),
        (with_word(12, 0xFFFFFFFF), "chunks: expected an end at byte"),
        (with_word(12, 8), "chunks|JSON"),
        (with_word(16, 0x004E4942), "chunk 0: expected JSON"),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=match):
            read_gltf(path)


def test_missing_files_folders_and_pipes(tmp_path):
    with pytest.raises(InputError, match=r"no\.glb: file: expected a readable file, got no file no\.glb"):
        read_gltf(tmp_path / "no.glb")
    with pytest.raises(InputError, match="got a folder"):
        read_gltf(tmp_path)
    if hasattr(os, "mkfifo"):  # not on Windows
        os.mkfifo(tmp_path / "pipe.glb")
        with pytest.raises(InputError, match="expected a readable file"):
            read_gltf(tmp_path / "pipe.glb")
    path = tmp_path / "c.gltf"
    path.write_bytes(tetrahedron().gltf("gone.bin"))
    with pytest.raises(InputError, match=r"buffers\[0\]: expected a readable file, got no file gone.bin"):
        read_gltf(path)


# --- anything at all: InputError or a character ---


def outcome(path: pathlib.Path, data: bytes) -> bool:
    """Reads `data`; True if it was a character, False if it was refused. Anything else fails the test."""
    path.write_bytes(data)
    try:
        character = read_gltf(path)
    except InputError as error:
        assert "\n" not in str(error)
        return False
    skin = character.skin
    assert np.isfinite(skin.vertices).all() and np.isfinite(skin.weights).all()
    assert np.asarray(character.faces).max() < len(skin.vertices)
    assert np.asarray(skin.joint_indices).max() < len(skin.palette_joints)
    assert np.asarray(skin.palette_joints).max() < len(character.skeleton.parents)
    return True


def full_character() -> GltfBuilder:
    b = tetrahedron()
    textured(b, {"bufferView": b.view(png(PIXELS))}, sampler={"wrapS": 33648})
    sparse_with_base(b)
    eight_influences(b)
    return b


def test_every_truncation_is_refused(tmp_path):
    whole = full_character().glb()
    assert outcome(tmp_path / "x.glb", whole)
    for length in {*range(0, 40), *range(40, len(whole), 97), len(whole) - 1}:
        assert not outcome(tmp_path / "x.glb", whole[:length])


def test_random_bytes_changed(tmp_path):
    rng = random.Random(7)
    whole = full_character().glb()
    accepted = 0
    for _ in range(150):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 1, 2, 8])):
            data[rng.randrange(len(data))] = rng.choice([0, 0xFF, 0x7F, rng.randrange(256)])
        accepted += outcome(tmp_path / "x.glb", bytes(data))
    assert 0 < accepted < 150


def leaves_of(value: Any, path: tuple = ()) -> list[tuple]:
    """The paths of all entries of a JSON value, inner ones included."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = [path] if path else []
    for key, item in inner:
        found += leaves_of(item, (*path, key))
    return found


def test_random_values_in_the_json(tmp_path):
    """Wrong types, holes, and numbers at the borders of what integers and floats can hold."""
    rng = random.Random(11)
    odd = [None, -1, 0, 1, 3, 2**31, 2**32 - 1, 2**63, 10**30, 0.5, 1e308, float("nan"), float("inf")]
    odd += ["", "x", "\ud800", True, [], {}, [None], [[]], {"a": 1}, [10**30], "data:,x", [0.0] * 16]
    accepted = 0
    tracemalloc.start()
    for _ in range(80):
        b = full_character()
        path = rng.choice(leaves_of(b.json))
        if rng.random() < 0.15:
            target = b.json
            for key in path[:-1]:
                target = target[key]
            del target[path[-1]]
        else:
            change(*path, to=rng.choice(odd))(b)
        try:
            accepted += outcome(tmp_path / "x.glb", b.glb())
        except Exception as error:
            raise AssertionError(f"after a change of {path}") from error
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0 < accepted < 80
    assert peak < 150e6  # MAX_ZEROS rows of four numbers is the most a change can ask for


# --- the shared characters ---

# vertices, faces, joints, clips, influences: from the table beside the data. Robot's table counts vertices
# and faces before 4 faces without area, and the 8 vertices only they used, are dropped.
SHARED = {
    "Mannequiny": (10366, 13932, 45, 11, "walk"),
    "Robot": (7210, 3234, 43, 14, "Robot_Dance"),
    "CesiumMan": (3273, 4672, 19, 1, "Anim_0"),
    "Fox": (1728, 576, 24, 3, "Survey"),
}


@pytest.mark.data
@pytest.mark.parametrize("name", SHARED)
def test_shared_character(shared_data, name):
    vertices, faces, joints, clips, first_clip = SHARED[name]
    character = read_gltf(shared_data / "characters" / f"{name}.glb")
    skin = character.skin
    assert skin.vertices.shape == (vertices, 3) and character.faces.shape == (faces, 3)
    assert len(set(np.asarray(skin.palette_joints).tolist())) == joints
    assert len(character.clips) == clips and first_clip in [clip.name for clip in character.clips]
    assert character.notes == (("zero-area faces dropped: 4",) if name == "Robot" else ())
    np.testing.assert_allclose(np.asarray(skin.weights).sum(axis=1), 1.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(skin.normals, axis=-1), 1.0, rtol=0, atol=1e-6)
    assert 0.0 <= character.albedo.min() and character.albedo.max() <= 1.0
    assert 0.05 < character.albedo.mean() < 0.95

    clip = max(character.clips, key=lambda clip: clip.duration)
    times = clip.start + clip.duration * jnp.asarray([0.0, 0.3, 0.5, 0.9])

    @jax.jit
    def animate(times):
        pose = sample_clip(clip, character.skeleton, times)
        return skin_mesh(skin, global_matrices(pose, parents=character.skeleton.parents))

    mesh = animate(times.astype(jnp.float32))
    rest = posed(character, rest_matrices(character))
    height = np.ptp(rest.reshape(-1, 3), axis=0).max()
    size = np.ptp(np.asarray(mesh.positions), axis=1).max(axis=1)
    assert (size > 0.5 * height).all() and (size < 1.5 * height).all()
    # Skin stretches a little; a vertex on the wrong joint would draw edges across the body.
    corners = np.asarray(mesh.positions)[:, np.asarray(character.faces)]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=2), axis=-1)
    rest_edges = np.linalg.norm(rest - np.roll(rest, 1, axis=1), axis=-1)
    assert (edges < rest_edges + 0.1 * height).all()
    # Normals agree with the winding nearly everywhere, in every frame.
    normals = np.asarray(mesh.frames[..., 2])[:, np.asarray(character.faces)].sum(axis=2)
    outward = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    assert (np.sum(normals * outward, axis=-1) > 0).mean() > 0.99
    assert (np.abs(np.linalg.norm(mesh.frames, axis=-2) - 1) < 1e-5).all()


@pytest.mark.data
def test_shared_character_with_bytes_changed(shared_data, tmp_path):
    whole = (shared_data / "characters" / "Fox.glb").read_bytes()
    rng = random.Random(3)
    for _ in range(25):
        data = bytearray(whole)
        for _ in range(3):
            data[rng.randrange(12000 if rng.random() < 0.7 else len(data))] = rng.randrange(256)
        outcome(tmp_path / "x.glb", bytes(data if rng.random() < 0.8 else data[: rng.randrange(len(data))]))


def test_builder_writes_what_pygltflib_reads():
    """The builder is no judge of itself: an independent reader sees the same counts."""
    import pygltflib

    gltf = pygltflib.GLTF2.load_from_bytes(tetrahedron().glb())
    assert len(gltf.accessors) == 8 and gltf.meshes[0].primitives[0].attributes.JOINTS_0 == 2
    assert json.loads(tetrahedron().gltf())["nodes"][1]["name"] == "tip"
