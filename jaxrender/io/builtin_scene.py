"""The scene of commands without a file: the mannequin in mid-stride on a tiled floor."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrender.animation.animated_scene import AnimatedScene
from jaxrender.animation.mannequin import builtin_character
from jaxrender.animation.skeleton import global_matrices, sample_clip
from jaxrender.animation.skinning import skin_mesh
from jaxrender.io.surfaces import SceneSurface, merged_scene, no_lights, on_device
from jaxrender.scene import OPAQUE, Material, Scene, SceneImage
from jaxrender.vecmath import orthonormal_tangent

#: Side of the floor in metres, and of one of its tiles.
_FLOOR, _TILE = 2.4, 0.3


def builtin_scene(*, num_vertices: int = 6000) -> Scene:
    """A closed smooth body, and a floor with one texture: enough for every stage of a renderer."""
    character = builtin_character(num_vertices=num_vertices)
    clip = character.clips[0]
    at = clip.start + 0.3 * clip.duration
    pose = jax.tree.map(lambda x: x[0], sample_clip(clip, character.skeleton, jnp.asarray([at], jnp.float32)))
    mesh = skin_mesh(character.skin, global_matrices(pose, parents=character.skeleton.parents))
    positions, normals = np.asarray(mesh.positions), np.asarray(mesh.frames)[..., 2]
    count = len(positions)
    body = SceneSurface(
        positions, normals, None, np.zeros((count, 2)), np.ones((count, 4)), np.asarray(character.faces),
        np.zeros(len(character.faces), int),
    )  # fmt: skip
    half, height = 0.5 * _FLOOR, float(positions[:, 1].min())
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    floor = SceneSurface(
        np.stack([corners[:, 0] * half, np.full(4, height), corners[:, 1] * half], axis=1),
        np.tile([0.0, 1.0, 0.0], (4, 1)), None, (corners + 1) * (0.5 * _FLOOR / (2 * _TILE)), np.ones((4, 4)),
        np.array([[0, 1, 2], [0, 2, 3]]), np.ones(2, int),
    )  # fmt: skip
    tiles = np.kron([[200, 110], [110, 200]], np.ones((64, 64))).astype(np.uint8)
    image = SceneImage("tiles", np.repeat(tiles[..., None], 3, axis=2), ("repeat", "repeat"), True)
    return merged_scene(
        [body, floor], material=_materials(), lights=no_lights(), cameras=(), name="mannequin", images=(image,),
        material_names=("clay", "tiles"),
    )  # fmt: skip


def builtin_animated_scene(*, num_vertices: int = 6000) -> AnimatedScene:
    """The same, with the clips of the mannequin; the floor stays."""
    character = builtin_character(num_vertices=num_vertices)
    return AnimatedScene(
        builtin_scene(num_vertices=num_vertices), character.skeleton, character.skin,
        orthonormal_tangent(character.skin.normals), clips=character.clips,
    )  # fmt: skip


def _materials() -> Material:
    two = lambda a, b: on_device(np.array([a, b]))  # noqa: E731
    none = jnp.full(2, -1, jnp.int32)
    return Material(
        base_color=two([0.72, 0.66, 0.6, 1.0], [1.0, 1.0, 1.0, 1.0]), metallic=two(0.0, 0.0), roughness=two(0.5, 0.7),
        emissive=two([0.0] * 3, [0.0] * 3), normal_scale=two(1.0, 1.0), occlusion_strength=two(1.0, 1.0),
        alpha_mode=two(OPAQUE, OPAQUE), alpha_cutoff=two(0.5, 0.5), double_sided=two(False, True),
        base_color_texture=jnp.asarray([-1, 0], jnp.int32), metallic_roughness_texture=none, normal_texture=none,
        occlusion_texture=none, emissive_texture=none,
    )  # fmt: skip
