"""Scenes with clips: each pose against a file that has it at rest, which is read without any skinning kernel."""

import copy
import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from jaxrender.animation.skeleton import global_matrices, sample_clip
from jaxrender.animation.skinning import skin_mesh
from jaxrender.checks import InputError
from jaxrender.io import load_animated_scene, load_character, load_scene
from jaxrender.scene import scene_bounds, with_ground
from tests.support.gltf_builder import QUARTER_TURN, GltfBuilder, tetrahedron

SQUARE = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], np.float64)

#: At the clip's last key: node -> its transform.
END = {
    1: {"rotation": QUARTER_TURN},
    3: {"translation": [0.5, -1.0, 2.0], "scale": [-2.0, 1.0, 0.5]},
    5: {"rotation": [0.0, float(np.sin(0.3)), 0.0, float(np.cos(0.3))], "translation": [1.0, 2.0, 3.0]},
}


def stage() -> GltfBuilder:
    """A skinned tetrahedron, a mirrored square with a normal map on a moving node, and there a lamp; a moving camera.

    Nodes 0 to 2 as in `tetrahedron`; 3 the square, 4 the lamp below it, 5 camera and sun. One clip, from 0.5 to 1.5 s.
    """
    b = tetrahedron()
    stream = io.BytesIO()
    Image.fromarray(np.full((2, 2, 3), (128, 128, 255), np.uint8)).save(stream, "PNG")
    b.add("images", {"bufferView": b.view(stream.getvalue()), "mimeType": "image/png"})
    texture = b.add("textures", {"source": 0})
    b.add("materials", {"normalTexture": {"index": texture}})
    attributes = {
        "POSITION": b.accessor(SQUARE),
        "NORMAL": b.accessor(np.tile([[0.0, 1.0, 0.0]], (4, 1))),
        "TEXCOORD_0": b.accessor([[0, 0], [0, 1], [1, 1], [1, 0]]),
    }
    indices = b.accessor([0, 1, 2, 0, 2, 3], "u2")
    b.add("meshes", {"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]})
    lamp = {"type": "spot", "intensity": 5.0, "spot": {"outerConeAngle": 0.6}}
    sun = {"type": "directional", "intensity": 2.0}
    b.json["extensions"] = {"KHR_lights_punctual": {"lights": [lamp, sun]}}
    b.json["extensionsUsed"] = ["KHR_lights_punctual"]
    b.add("cameras", {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}})
    shines = lambda index: {"KHR_lights_punctual": {"light": index}}  # noqa: E731
    b.json["nodes"] += [
        {"mesh": 1, "scale": [-1.0, 1.0, 1.0], "children": [4]},
        {"translation": [0.0, 3.0, 0.0], "rotation": QUARTER_TURN, "extensions": shines(0)},
        {"camera": 0, "extensions": shines(1)},
    ]
    b.json["scenes"][0]["nodes"] += [3, 5]
    start = {"translation": [0.0, 0.0, 0.0], "scale": [-1.0, 1.0, 1.0], "rotation": [0.0, 0.0, 0.0, 1.0]}
    animation = b.json["animations"][0]
    for node in (3, 5):
        for path, value in END[node].items():
            sampler = {"input": 6, "output": b.accessor([start[path], value])}
            animation["samplers"].append(sampler)
            target = {"node": node, "path": path}
            animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})
    return b


def at_rest(b: GltfBuilder, folder) -> object:
    """The same file with the clip's last pose as its nodes' own."""
    baked = copy.deepcopy(b)
    baked.json["animations"] = []
    for node, transform in END.items():
        baked.json["nodes"][node] |= transform
    folder.mkdir()
    return load_scene(baked.write(folder))


def test_a_pose_is_the_scene_that_has_it_at_rest(tmp_path):
    """Surfaces with normals and tangents, mirrors included; lights and cameras on moving nodes."""
    b = stage()
    moving = load_animated_scene(b.write(tmp_path))
    truth = at_rest(b, tmp_path / "baked")
    found = moving.at("turn", 1.0)
    for name in ("positions", "normals", "uv", "colors", "faces", "material_id"):
        np.testing.assert_allclose(getattr(found, name), getattr(truth, name), rtol=0, atol=2e-6, err_msg=name)
    # Those of the tetrahedron, which has no texture coordinates, are any.
    np.testing.assert_allclose(found.tangents[4:], truth.tangents[4:], rtol=0, atol=2e-6)
    assert found.images == moving.rest.images and len(found.images) == 1
    for name in ("kind", "position", "direction", "intensity", "cos_outer"):
        np.testing.assert_allclose(getattr(found.lights, name), getattr(truth.lights, name), rtol=0, atol=2e-6)
    for name in ("eye", "target", "up", "fov_y_radians"):
        np.testing.assert_allclose(getattr(found.cameras[0], name), getattr(truth.cameras[0], name), rtol=0, atol=2e-6)
    # The test would say nothing of a scene that stands still.
    assert np.abs(np.asarray(found.positions - moving.rest.positions)).max() > 0.5
    assert np.abs(np.asarray(found.lights.position - moving.rest.lights.position)).max() > 0.5
    assert np.abs(np.asarray(found.cameras[0].eye - moving.rest.cameras[0].eye)).max() > 0.5


def test_at_rest_it_is_the_scene_that_stands_still(tmp_path):
    path = stage().write(tmp_path)
    moving, still = load_animated_scene(path), load_scene(path)
    for name in ("positions", "normals", "tangents", "faces"):
        np.testing.assert_array_equal(getattr(moving.rest, name), getattr(still, name))
    start = moving.at(0, 0.0)
    np.testing.assert_allclose(start.positions, still.positions, rtol=0, atol=1e-6)


def test_clips_by_name_and_number_and_over_and_over(tmp_path):
    moving = load_animated_scene(stage().write(tmp_path))
    half = moving.at("turn", 0.5).positions
    np.testing.assert_array_equal(moving.at("0", 0.5).positions, half)
    np.testing.assert_array_equal(moving.at(moving.clips[0], 2.5).positions, half)
    assert np.abs(np.asarray(moving.at(0, 1.0).positions - half)).max() > 0.1
    message = "character: clip: expected one of turn, or 0 to 0, got walk"
    for wanted in ("walk", 1, "-1"):
        with pytest.raises(InputError, match=message.replace("walk", str(wanted))):
            moving.at(wanted, 0.0)
    for seconds in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="seconds: expected a finite number >= 0"):
            moving.at(0, seconds)
    with pytest.raises(InputError, match="clip: expected none, as nothing moves in this file, got 0"):
        dataclasses.replace(moving, clips=()).clip(0)


def test_bounds_hold_all_poses(tmp_path):
    moving = load_animated_scene(stage().write(tmp_path))
    low, high = moving.bounds(0, [0.0, 0.5, 1.0])
    boxes = [scene_bounds(moving.at(0, t)) for t in (0.0, 0.5, 1.0)]
    np.testing.assert_array_equal(low, np.min([box[0] for box in boxes], axis=0))
    np.testing.assert_array_equal(high, np.max([box[1] for box in boxes], axis=0))


def test_morph_channels_are_left_out_with_a_note_and_others_refused(tmp_path):
    b = stage()
    animation = b.json["animations"][0]
    animation["channels"].append({"sampler": 0, "target": {"node": 3, "path": "weights"}})
    assert load_animated_scene(b.write(tmp_path)).rest.notes == ("channels of morph weights left out: 1",)
    animation["channels"][-1]["target"]["path"] = "color"
    with pytest.raises(InputError, match=r"target\.path: expected translation"):
        load_animated_scene(b.write(tmp_path))
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match=r"expected a scene with clips \(glTF or GLB\), got ending \.obj"):
        load_animated_scene(tmp_path / "a.obj")


def test_the_ground_lies_under_all_poses(tmp_path):
    moving = load_animated_scene(stage().write(tmp_path))
    low, high = moving.bounds(0, [0.0, 1.0])
    grounded = dataclasses.replace(moving, rest=with_ground(moving.rest, low, high, color=0.25))
    scene = grounded.at(0, 0.5)
    assert len(scene.faces) == len(moving.rest.faces) + 2 and scene.material_names[-1] == "ground"
    np.testing.assert_array_equal(scene.positions[-4:, 1], np.full(4, low[1]))
    corners = np.asarray(scene.positions)[np.asarray(scene.faces[-2:])]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1] > 0).all()
    np.testing.assert_array_equal(scene.positions[:-4], moving.at(0, 0.5).positions)
    assert (scene.material_id[-2:] == len(moving.rest.material.metallic)).all()
    np.testing.assert_array_equal(scene.material.base_color[-1], [0.25, 0.25, 0.25, 1.0])


@pytest.mark.data
def test_a_character_moves_as_its_skin_does(shared_data):
    path = shared_data / "characters" / "Fox.glb"
    moving, character = load_animated_scene(path), load_character(path)
    assert moving.rest.images and [clip.name for clip in moving.clips] == [clip.name for clip in character.clips]
    clip = character.clips[-1]
    pose = sample_clip(clip, character.skeleton, np.array([clip.start + 0.3], np.float32))
    mesh = skin_mesh(character.skin, global_matrices(pose, parents=character.skeleton.parents))
    truth = np.asarray(mesh.positions)[0][np.asarray(character.faces)]
    scene = moving.at(clip.name, 0.3)
    found = np.asarray(scene.positions)[np.asarray(scene.faces)]
    size = np.abs(truth).max()
    np.testing.assert_allclose(found, truth, rtol=0, atol=2e-6 * size)
    # Faces are flat: their normals and those of their corners agree.
    flat = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
    corner = np.asarray(scene.normals)[np.asarray(scene.faces)].sum(axis=1)
    assert (np.sum(flat * corner, axis=1) > 0).mean() > 0.98
