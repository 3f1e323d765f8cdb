"""Scene files, right, odd and hostile, against what was put into them; and the shared scenes against other readers."""

import copy
import io
import json
import math
import pathlib
import random
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pygltflib
import pytest
import trimesh
from PIL import Image

from jaxrender.camera import clip_from_world, depth_range
from jaxrender.checks import InputError
from jaxrender.io import load_scene
from jaxrender.io.gltf import read_gltf
from jaxrender.io.surfaces import vertex_tangents
from jaxrender.scene import BLEND, DIRECTIONAL, MASK, OPAQUE, POINT, SPOT, Scene, scene_bounds, whole_scene_camera
from tests.support import gltf_builder as g
from tests.support.gltf_builder import GltfBuilder, primitive, rigid, tetrahedron

# A square that faces +z, seen as an image is: u to the right, v down.
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float64)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
TINY_TURN = [0.0, float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5))]


def load(builder: GltfBuilder, folder: pathlib.Path) -> Scene:
    return load_scene(builder.write(folder))


def refused(builder: GltfBuilder, folder: pathlib.Path, match: str) -> None:
    with pytest.raises(InputError, match=match) as caught:
        load(builder, folder)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def square(**material: Any) -> GltfBuilder:
    """The square with one material; accessors 0 POSITION, 1 NORMAL, 2 TEXCOORD_0, 3 indices."""
    b = GltfBuilder()
    attributes = {
        "POSITION": b.accessor(SQUARE),
        "NORMAL": b.accessor(np.tile([[0.0, 0.0, 1.0]], (4, 1))),
        "TEXCOORD_0": b.accessor(SQUARE_UV),
    }
    indices = b.accessor(SQUARE_FACES.ravel(), "u2")
    b.json |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"name": "paint", **material}],
    }
    return b


def picture(mode: str = "RGB", size: tuple[int, int] = (3, 2), kind: str = "PNG") -> bytes:
    rng = np.random.default_rng(3)
    texels = rng.integers(0, 256, (size[1], size[0], len(mode)), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(texels, mode).save(stream, kind)
    return stream.getvalue()


def add_texture(b: GltfBuilder, data: bytes, **sampler: int) -> int:
    image = b.add("images", {"bufferView": b.view(data), "mimeType": "image/png", "name": f"image{len(data)}"})
    return b.add("textures", {"source": image, "sampler": b.add("samplers", sampler)})


def corners(scene: Scene) -> np.ndarray:
    return np.asarray(scene.positions)[np.asarray(scene.faces)]


# --- geometry ---


def test_square_arrives_whole(tmp_path):
    scene = load(square(), tmp_path)
    np.testing.assert_array_equal(scene.positions, SQUARE)
    np.testing.assert_array_equal(scene.faces, SQUARE_FACES)
    np.testing.assert_array_equal(scene.uv, SQUARE_UV)
    np.testing.assert_array_equal(scene.colors, np.ones((4, 4)))
    np.testing.assert_array_equal(scene.material_id, [0, 0])
    np.testing.assert_allclose(scene.tangents, np.tile([[1.0, 0, 0, 1.0]], (4, 1)), atol=1e-7)
    assert (scene.name, scene.material_names, scene.notes) == ("character", ("paint",), ())
    assert scene.cameras == () and scene.images == () and scene.lights.kind.shape == (0,)


def test_records_have_the_types_of_the_kernels_and_are_pytrees(tmp_path):
    scene = load(square(), tmp_path)
    for name in ("positions", "normals", "tangents", "uv", "colors"):
        assert getattr(scene, name).dtype == np.float32, name
    assert scene.faces.dtype == scene.material_id.dtype == scene.material.normal_texture.dtype == np.int32
    low, high = jax.jit(scene_bounds)(scene)
    np.testing.assert_array_equal(low, SQUARE.min(axis=0))
    np.testing.assert_array_equal(high, SQUARE.max(axis=0))


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", None])
def test_kinds_of_indices(tmp_path, dtype):
    b = square()
    if dtype is None:
        order = SQUARE_FACES.ravel()
        attributes = {
            "POSITION": SQUARE[order],
            "NORMAL": np.tile([[0, 0, 1.0]], (6, 1)),
            "TEXCOORD_0": SQUARE_UV[order],
        }
        primitive(b)["attributes"] = {name: b.accessor(rows) for name, rows in attributes.items()}
        del primitive(b)["indices"]
    else:
        primitive(b)["indices"] = b.accessor(SQUARE_FACES.ravel(), dtype)
    np.testing.assert_array_equal(corners(load(b, tmp_path)), SQUARE[SQUARE_FACES])


def test_node_transforms_and_several_meshes(tmp_path):
    b = square()
    b.json["nodes"] = [
        {"mesh": 0, "translation": [0, 0, 5], "children": [1]},
        {"mesh": 0, "rotation": TINY_TURN, "scale": [2, 3, 1]},
    ]
    scene = load(b, tmp_path)
    # A quarter turn about y takes x to -z and z to x.
    second = np.stack([0 * SQUARE[:, 0], 3 * SQUARE[:, 1], 5 - 2 * SQUARE[:, 0]], axis=1)
    np.testing.assert_allclose(scene.positions, np.concatenate([SQUARE + [0, 0, 5], second]), atol=1e-6)
    np.testing.assert_allclose(scene.normals[4:], np.tile([[1.0, 0, 0]], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(scene.tangents[4:], np.tile([[0.0, 0, -1, 1]], (4, 1)), atol=1e-6)
    np.testing.assert_array_equal(scene.faces[2:], SQUARE_FACES + 4)


@pytest.mark.parametrize("given", [False, True])
def test_a_mirrored_mesh_keeps_its_outside_and_its_normal_map(tmp_path, given):
    b = square()
    b.json["nodes"] = [{"mesh": 0, "scale": [-2, 1, 1]}]
    if given:
        primitive(b)["attributes"]["TANGENT"] = b.accessor(np.tile([[1.0, 0, 0, 1]], (4, 1)))
    scene = load(b, tmp_path)
    a, p, q = corners(scene)[0]
    assert np.cross(p - a, q - a)[2] > 0
    np.testing.assert_allclose(scene.normals, np.tile([[0, 0, 1.0]], (4, 1)), atol=1e-7)
    # The tangent goes along u, now to -x; up in the image is still +y = w cross(normal, tangent).
    np.testing.assert_allclose(scene.tangents, np.tile([[-1.0, 0, 0, -1]], (4, 1)), atol=1e-7)


def test_normals_follow_the_inverse_transpose(tmp_path):
    b = rigid()
    b.json["nodes"][0]["scale"] = [1, 4, 0.5]
    scene = load(b, tmp_path)
    expected = g.NORMALS / [1, 4, 0.5]
    np.testing.assert_allclose(scene.normals, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-6)


def test_missing_normals_are_flat(tmp_path):
    b = rigid()
    del primitive(b)["attributes"]["NORMAL"]
    scene = load(b, tmp_path)
    c = g.CORNERS[g.FACES]
    normals = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_array_equal(corners(scene), c)
    np.testing.assert_allclose(scene.normals, np.repeat(normals, 3, axis=0), atol=1e-6)


def test_vertex_colors_and_second_texture_coordinates(tmp_path):
    b = square(pbrMetallicRoughness={"baseColorTexture": {"index": 0, "texCoord": 1}})
    add_texture(b, picture())
    rng = np.random.default_rng(5)
    second = rng.normal(size=(4, 2)).astype(np.float32)
    primitive(b)["attributes"]["TEXCOORD_1"] = b.accessor(second)
    primitive(b)["attributes"]["COLOR_0"] = b.accessor(np.full((4, 3), 51), "u1", normalized=True)
    scene = load(b, tmp_path)
    np.testing.assert_array_equal(scene.uv, second)
    np.testing.assert_allclose(scene.colors, np.tile([[0.2, 0.2, 0.2, 1]], (4, 1)), atol=1e-7)


def test_texture_transform(tmp_path):
    transform = {"offset": [0.25, 1.0], "rotation": math.pi / 2, "scale": [2.0, 3.0]}
    b = square(
        pbrMetallicRoughness={"baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform": transform}}}
    )
    add_texture(b, picture())
    u, v = (SQUARE_UV * [2, 3]).T
    # Counter-clockwise for someone who looks at the image, v down: (1, 0) turns to (0, -1).
    np.testing.assert_allclose(load(b, tmp_path).uv, np.stack([v + 0.25, 1 - u], axis=1), atol=1e-6)


def test_a_skinned_mesh_stands_as_its_nodes_do(tmp_path):
    b = tetrahedron()
    b.json["nodes"][1]["rotation"] = g.QUARTER_TURN
    scene, character = load(b, tmp_path), read_gltf(tmp_path / "character.glb")
    # Joint 1 turns by 90 degrees about z at (0, 2, 0): p -> (0, 2) + R (p - (0, 2)).
    x, y, z = g.CORNERS.T
    turned = np.stack([2 - y, 2 + x, z], axis=1)
    share = np.array([[0.25], [0.5], [0.0], [0.25]])
    np.testing.assert_allclose(scene.positions, (1 - share) * g.CORNERS + share * turned, atol=1e-6)
    assert len(character.faces) == len(scene.faces)


def test_tangents_of_a_surface_against_its_derivatives(rng):
    # A height field with sheared and scaled uv: dP/du is known everywhere.
    x, y = (np.linspace(0, 1, 30),) * 2
    x, y = (a.ravel() for a in np.meshgrid(x, y))
    grid = np.arange(900).reshape(30, 30)
    a, b, c, d = (grid[i : 29 + i, j : 29 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    positions = np.stack([x, y, 0.1 * np.sin(2 * x + y)], axis=1)
    slope = 0.1 * np.cos(2 * x + y)
    normals = np.stack([-2 * slope, -slope, np.ones_like(x)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for mirror in (1.0, -1.0):
        uv = np.stack([mirror * (2 * x + y), -3 * y], axis=1)  # at fixed y, u grows with mirror * x
        expected = mirror * np.stack([np.ones_like(x), 0 * x, 2 * slope], axis=1)
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        tangents = vertex_tangents(positions, normals, uv, faces)
        found = tangents[:, :3] / np.linalg.norm(tangents[:, :3], axis=1, keepdims=True)
        # Chords of a curve of curvature 0.4 on a grid of 1/29.
        np.testing.assert_allclose(found, expected, atol=0.4 / 29)
        np.testing.assert_array_equal(tangents[:, 3], mirror)


def test_tangents_without_uv_are_still_a_frame(tmp_path):
    b = square()
    del primitive(b)["attributes"]["TEXCOORD_0"]
    tangents = np.asarray(load(b, tmp_path).tangents)
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :2], axis=1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(tangents[:, 2:], np.tile([[0, 1]], (4, 1)))


# --- materials and textures ---


def test_material_factors(tmp_path):
    b = square(
        pbrMetallicRoughness={"baseColorFactor": [0.1, 0.2, 0.3, 0.4], "metallicFactor": 0.5, "roughnessFactor": 0.25},
        emissiveFactor=[1.0, 0.5, 0.0],
        alphaMode="MASK",
        alphaCutoff=0.75,
        doubleSided=True,
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}, "KHR_materials_ior": {"ior": 1.4}},
    )
    b.json["materials"] += [{"alphaMode": "BLEND"}, {}]
    scene = load(b, tmp_path)
    m = scene.material
    np.testing.assert_allclose(m.base_color, [[0.1, 0.2, 0.3, 0.4], [1] * 4, [1] * 4], atol=1e-7)
    np.testing.assert_array_equal(m.metallic, [0.5, 1, 1])
    np.testing.assert_array_equal(m.roughness, [0.25, 1, 1])
    np.testing.assert_array_equal(m.emissive, [[8, 4, 0], [0] * 3, [0] * 3])
    np.testing.assert_array_equal(m.alpha_mode, [MASK, BLEND, OPAQUE])
    np.testing.assert_array_equal(m.alpha_cutoff, [0.75, 0.5, 0.5])
    np.testing.assert_array_equal(m.double_sided, [True, False, False])
    np.testing.assert_array_equal(m.base_color_texture, [-1, -1, -1])
    assert scene.material_names == ("paint", "material_1", "material_2")
    assert scene.notes == ("material extension KHR_materials_ior ignored: 1",)


def test_a_primitive_without_material_gets_the_default_one(tmp_path):
    b = square(pbrMetallicRoughness={"metallicFactor": 0.0})
    del primitive(b)["material"]
    scene = load(b, tmp_path)
    assert scene.material_names == ("paint", "default")
    np.testing.assert_array_equal(scene.material_id, [1, 1])
    np.testing.assert_array_equal(scene.material.metallic, [0, 1])


def test_images_are_layers_by_wrap_and_transfer(tmp_path):
    b = square(
        pbrMetallicRoughness={"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}},
        normalTexture={"index": 1, "scale": 0.5},
        occlusionTexture={"index": 1, "strength": 0.25},
        emissiveTexture={"index": 1},
    )
    add_texture(b, picture("RGBA"), wrapS=33071, wrapT=33648)
    add_texture(b, picture("RGB", kind="JPEG"))
    scene = load(b, tmp_path)
    m = scene.material
    slots = (
        m.base_color_texture,
        m.metallic_roughness_texture,
        m.normal_texture,
        m.occlusion_texture,
        m.emissive_texture,
    )
    assert [int(slot[0]) for slot in slots] == [0, 1, 1, 1, 2], "emission decodes the same picture another way"
    assert [image.srgb for image in scene.images] == [True, False, True]
    assert [image.wrap for image in scene.images] == [("clamp", "mirror"), ("repeat", "repeat"), ("repeat", "repeat")]
    assert [image.texels.shape for image in scene.images] == [(2, 3, 4), (2, 3, 3), (2, 3, 3)]
    np.testing.assert_array_equal(scene.images[0].texels, np.asarray(Image.open(io.BytesIO(picture("RGBA")))))
    np.testing.assert_allclose([m.normal_scale[0], m.occlusion_strength[0]], [0.5, 0.25])


def test_textures_that_cannot_be_used_are_named_and_left_out(tmp_path, monkeypatch):
    b = square(
        pbrMetallicRoughness={"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}},
        normalTexture={"index": 2},
        occlusionTexture={"index": 3, "texCoord": 1},
        emissiveTexture={"index": 4},
    )
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "bomb.png").write_bytes(picture(size=(40, 30)))
    (tmp_path / "good.png").write_bytes(picture())
    for uri in ("absent.png", "text.png", "bomb.png", "good.png", "good.png"):
        b.add("textures", {"source": b.add("images", {"uri": uri})})
    monkeypatch.setattr("jaxrender.io.gltf_textures.MAX_TEXELS", 1000)
    scene = load(b, tmp_path)
    assert scene.notes == (
        "base color texture absent.png left out (its bytes are missing): 1",
        "metallic roughness texture text.png left out (not a readable PNG, JPEG or WebP): 1",
        "normal texture bomb.png left out (more than 1000 texels): 1",
        "occlusion texture good.png left out (it uses other texture coordinates than the material's first texture): 1",
    )
    assert int(scene.material.base_color_texture[0]) == -1 and int(scene.material.emissive_texture[0]) == 0
    assert [image.name for image in scene.images] == ["good.png"]


# --- cameras and lights ---


def test_cameras(tmp_path):
    b = square()
    b.json["cameras"] = [
        {"type": "perspective", "perspective": {"yfov": 0.75, "znear": 0.1}},
        {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "znear": 0, "zfar": 9}},
    ]
    turn = {"rotation": TINY_TURN, "scale": [2, 2, 2]}
    b.json["nodes"] += [{"camera": 0, "translation": [1, 2, 3], **turn}, {"camera": 1}]
    b.json["scenes"] = [{"nodes": [0, 1, 2]}]
    scene = load(b, tmp_path)
    (camera,) = scene.cameras
    forward = np.asarray(camera.target - camera.eye)
    np.testing.assert_array_equal(camera.eye, [1, 2, 3])
    np.testing.assert_allclose(forward / np.linalg.norm(forward), [-1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(camera.up, [0, 1, 0], atol=1e-6)
    assert float(camera.fov_y_radians) == 0.75
    assert scene.notes == ("orthographic cameras left out: 1",)


def test_lights(tmp_path):
    b = square()
    lights = [
        {"type": "directional", "color": [1, 0.5, 0], "intensity": 3},
        {"type": "point", "range": 7},
        {"type": "spot", "spot": {"innerConeAngle": 0.25, "outerConeAngle": 0.5}, "intensity": 10},
    ]
    b.json["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
    for i in (0, 1, 2):
        place = {"translation": [1, 2, 3], "rotation": TINY_TURN}
        b.json["nodes"].append({"extensions": {"KHR_lights_punctual": {"light": i}}, **place})
    b.json["scenes"] = [{"nodes": [0, 1, 2, 3]}]
    found = load(b, tmp_path).lights
    np.testing.assert_array_equal(found.kind, [DIRECTIONAL, POINT, SPOT])
    np.testing.assert_array_equal(found.position, [[0, 0, 0], [1, 2, 3], [1, 2, 3]])
    np.testing.assert_allclose(found.direction, [[-1, 0, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-6)
    np.testing.assert_array_equal(found.intensity, [[3, 1.5, 0], [1, 1, 1], [10, 10, 10]])
    np.testing.assert_array_equal(found.range, [np.inf, 7, np.inf])
    np.testing.assert_allclose(found.cos_inner, [-1, -1, math.cos(0.25)], atol=1e-7)
    np.testing.assert_allclose(found.cos_outer, [-1, -1, math.cos(0.5)], atol=1e-7)


def test_the_whole_scene_is_in_view_and_in_depth_range(tmp_path):
    scene = load(rigid(), tmp_path)

    @jax.jit
    def clip_positions(scene):
        camera = whole_scene_camera(scene, aspect=1.5)
        near, far = depth_range(camera, *scene_bounds(scene))
        matrix = clip_from_world(camera, height=200, width=300, near=near, far=far)
        return jnp.pad(scene.positions, ((0, 0), (0, 1)), constant_values=1.0) @ matrix.T

    clip = np.asarray(clip_positions(scene))
    assert (np.abs(clip[:, :2]) <= clip[:, 3:]).all() and (clip[:, 2] >= 0).all() and (clip[:, 2] <= clip[:, 3]).all()


# --- bad input ---


def nan_position(b):
    primitive(b)["attributes"]["POSITION"] = b.accessor(np.where(SQUARE == 1, np.nan, SQUARE))


def index_out_of_range(b):
    primitive(b)["indices"] = b.accessor([0, 1, 4], "u2")


def no_mesh(b):
    del b.json["nodes"][0]["mesh"]


def only_points(b):
    primitive(b)["mode"] = 0


def buffer_outside(b):
    b.json["buffers"] = [{"byteLength": len(b.blob), "uri": "../outside.bin"}]


def image_outside(b):
    b.json["materials"][0]["normalTexture"] = {"index": 0}
    b.add("textures", {"source": b.add("images", {"uri": "/etc/hostname"})})


def unknown_material(b):
    primitive(b)["material"] = 7


def bad_factor(b):
    b.json["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": [1, 1]}


def bad_alpha_mode(b):
    b.json["materials"][0]["alphaMode"] = ["MASK"]


def bad_light(b):
    b.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "lamp"}]}}
    b.json["nodes"][0]["extensions"] = {"KHR_lights_punctual": {"light": 0}}


def bad_fov(b):
    b.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 4.0, "znear": 0.1}}]
    b.json["nodes"][0]["camera"] = 0


def far_away(b):
    b.json["nodes"] = [{"scale": [1e8, 1, 1], "children": [1]}, {"mesh": 0, "scale": [1e8, 1, 1]}]


@pytest.mark.parametrize(
    ("bend", "match"),
    [
        (nan_position, r"POSITION: expected finite numbers .* NaN"),
        (index_out_of_range, "indices: expected indices below 4, got 4"),
        (no_mesh, "meshes: expected at least one triangle"),
        (only_points, "got primitives of points or lines left out: 1"),
        (buffer_outside, "expected a file inside the folder"),
        (image_outside, "images.0..uri: expected a file inside the folder"),
        (unknown_material, "material: expected an index into 1 materials, got 7"),
        (bad_factor, r"baseColorFactor: expected 4 finite numbers, got \[1"),
        (bad_alpha_mode, "alphaMode: expected OPAQUE, MASK or BLEND"),
        (bad_light, "type: expected directional, point or spot, got lamp"),
        (bad_fov, "yfov: expected an angle between 0 and π, got 4.0"),
        (far_away, "in world space: expected within 1e"),
    ],
)
def test_bad_gltf_is_refused_in_one_line(tmp_path, bend, match):
    b = square()
    bend(b)
    refused(b, tmp_path, match)


def test_bent_json_is_read_or_refused(tmp_path):
    """Any value anywhere: an InputError, or a scene; never another exception."""
    b = square(
        pbrMetallicRoughness={"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 1]},
        normalTexture={"index": 0, "scale": 0.5},
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}},
    )
    add_texture(b, picture(), wrapS=33071)
    b.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.75, "znear": 0.1}}]
    b.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "spot", "spot": {"outerConeAngle": 0.5}}]}}
    b.json["nodes"][0] |= {"camera": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}}
    odd = [None, -1, 2**40, 1e300, "x", [], {}, True, [1], {"a": 1}, float("nan")]
    original, chance, loaded = copy.deepcopy(b.json), random.Random(11), 0
    for _ in range(150):
        b.json = copy.deepcopy(original)
        for _ in range(chance.randint(1, 2)):
            where: Any = b.json
            while True:
                key = chance.choice(list(where) if isinstance(where, dict) else list(range(len(where))))
                if not isinstance(where[key], dict | list) or not where[key] or chance.random() < 0.1:
                    break
                where = where[key]
            where[key] = chance.choice(odd)
        try:
            load(b, tmp_path)
            loaded += 1
        except InputError:
            pass
    assert 10 < loaded < 140


# --- PLY, OBJ, scene.json ---


def test_ply_with_colors_and_no_normals(tmp_path):
    mesh = trimesh.creation.box()
    colors = np.tile(np.array([[188, 0, 255, 128]], np.uint8), (8, 1))
    trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False).export(tmp_path / "box.ply")
    scene = load_scene(tmp_path / "box.ply")
    np.testing.assert_allclose(corners(scene), mesh.triangles, atol=1e-7)
    # sRGB 188 is 0.503 of the light of 255.
    np.testing.assert_allclose(scene.colors[0], [0.503, 0, 1, 128 / 255], atol=1e-3)
    assert scene.normals.shape == (8, 3), "smooth: vertices stay shared"
    assert (np.sum(np.asarray(scene.normals) * mesh.vertices, axis=1) > 0.7).all()


OBJ = """mtllib paints.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
usemtl red
f 1 2 3 4
usemtl lamp
f 1 5 2
"""
MTL = "newmtl red\nKd 0.8 0.1 0.05\nmap_Kd wall.png\nnewmtl lamp\nKd 0 0 0\nKe 5 6 7\n"


def test_obj_with_material_colors(tmp_path):
    (tmp_path / "room.obj").write_text(OBJ)
    (tmp_path / "paints.mtl").write_text(MTL)
    (tmp_path / "wall.png").write_bytes(picture())
    scene = load_scene(tmp_path / "room.obj")
    assert len(scene.faces) == 3 and sorted(scene.material_names) == ["lamp", "red"]
    red, lamp = (scene.material_names.index(name) for name in ("red", "lamp"))
    np.testing.assert_allclose(scene.material.base_color[red], [0.8, 0.1, 0.05, 1], atol=1e-6)
    np.testing.assert_allclose(scene.material.emissive[lamp], [5, 6, 7])
    assert sorted(np.asarray(scene.material_id)) == sorted([red, red, lamp])
    flat = np.asarray(scene.normals)[np.asarray(scene.faces)[np.asarray(scene.material_id) == red]]
    np.testing.assert_allclose(flat, np.broadcast_to([0.0, 0, 1], (2, 3, 3)), atol=1e-6)
    assert scene.notes == ("texture wall.png left out (textures of an OBJ are not read)",)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "faces: expected at least one triangle"),
        ("a.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertices: expected finite numbers"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "expected"),
        ("a.obj", "mtllib ../x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "inside the folder"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 999999999\nend_header\n", "expected"),
        ("a.ply", "ply\nrubbish", "an intact PLY"),
        ("a.json", "{", "JSON: expected a valid document"),
        ("a.json", "{}", "shapes: expected a list"),
        ("a.json", json.dumps({"shapes": [{"file": "../b.obj"}]}), "expected a file inside the folder"),
        ("a.json", json.dumps({"shapes": [{"file": "b.obj"}]}), "reflectance: expected 3 finite numbers, got None"),
        ("a.txt", "hello", "expected a scene"),
        ("a.gltf", "hello", "expected glTF 2.0"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, name, content, match):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=match) as caught:
        load_scene(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_ply_with_indices_out_of_range(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n")
    with pytest.raises(InputError, match=r"a\.ply: .*expected"):
        load_scene(tmp_path / "a.ply")


# --- the shared scenes ---


@pytest.mark.data
def test_sponza_against_pygltflib(shared_data):
    path = shared_data / "sponza" / "Sponza.gltf"
    scene, gltf = load_scene(path), pygltflib.GLTF2.load_json(str(path))
    assert scene.notes == ()
    assert (len(scene.positions), len(scene.faces)) == (192_870, 262_267)
    assert len(scene.material_names) == len(gltf.materials) == 25
    assert len(scene.images) == len(gltf.textures) == 64
    boxes = [gltf.accessors[p.attributes.POSITION] for p in gltf.meshes[0].primitives]
    low, high = scene_bounds(scene)
    np.testing.assert_allclose(low, np.min([box.min for box in boxes], axis=0), rtol=1e-6)
    np.testing.assert_allclose(high, np.max([box.max for box in boxes], axis=0), rtol=1e-6)
    counts = [gltf.accessors[p.indices].count // 3 for p in gltf.meshes[0].primitives]
    np.testing.assert_array_equal(np.bincount(scene.material_id), counts)
    masked = [scene.material_names[i] for i in np.flatnonzero(np.asarray(scene.material.alpha_mode) == MASK)]
    assert sorted(masked) == ["Material__57", "chain", "leaf"]
    m = scene.material
    for slot, srgb in ((m.base_color_texture, True), (m.normal_texture, False), (m.metallic_roughness_texture, False)):
        used = [int(i) for i in slot if i >= 0]
        assert used and all(scene.images[i].srgb == srgb for i in used)
    assert int((np.asarray(m.base_color_texture) < 0).sum()) == 1, "Material__47 has no texture"
    assert {scene.images[int(m.base_color_texture[scene.material_names.index(n)])].texels.shape[2] for n in masked} == {
        4
    }
    normals, tangents = np.asarray(scene.normals), np.asarray(scene.tangents)
    np.testing.assert_allclose(np.sum(normals * tangents[:, :3], axis=1), 0.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1.0, atol=1e-6)
    assert float(np.abs(scene.uv).max()) > 30


@pytest.mark.data
def test_cornell_box(shared_data):
    scene = load_scene(shared_data / "cornell_box" / "scene.json")
    assert (scene.name, len(scene.faces), len(scene.material_names), scene.notes) == ("cornell_box", 38, 8, ())
    lamp = scene.material_names.index("cbox_luminaire")
    np.testing.assert_allclose(scene.material.emissive[lamp], [18.387, 10.9873, 2.75357], rtol=1e-6)
    lamp_corners = corners(scene)[np.asarray(scene.material_id) == lamp]
    np.testing.assert_allclose(lamp_corners[..., 1], 548.3, rtol=1e-6)
    (camera,) = scene.cameras
    np.testing.assert_array_equal(camera.eye, [278, 273, -800])
    assert math.degrees(float(camera.fov_y_radians)) == pytest.approx(39.3077, abs=1e-4)


@pytest.mark.data
@pytest.mark.parametrize("name", ["meshes/bunny.ply", "dabrovic_sponza/sponza_dabrovic.ply"])
def test_shared_ply_against_trimesh(shared_data, name):
    scene, mesh = load_scene(shared_data / name), trimesh.load_mesh(shared_data / name, process=False)
    np.testing.assert_array_equal(scene.faces, mesh.faces)
    np.testing.assert_allclose(scene.positions, mesh.vertices, rtol=1e-7)
    cosine = np.sum(np.asarray(scene.normals) * mesh.vertex_normals, axis=1)
    # trimesh weighs face normals by angle, we by area: the same side, nearly the same direction.
    assert np.median(cosine) > 0.99
