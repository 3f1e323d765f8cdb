"""glTF 2.0 and GLB -> `AnimatedScene`: the scene of `read_gltf_scene`, and the clips that move it.

Nodes that carry a mesh, a light or a camera, joints of skins and all nodes above them are one skeleton. Morph targets
and animated properties other than the transforms of nodes are left out, with a note.
"""

import dataclasses
import os

import jax.numpy as jnp
import numpy as np

from jaxrender.animation.animated_scene import AnimatedScene
from jaxrender.animation.skinning import Skin
from jaxrender.io.gltf_clips import read_clips
from jaxrender.io.gltf_nodes import build_skeleton
from jaxrender.io.gltf_scene import GltfPart, open_gltf_scene, rest_scene
from jaxrender.io.surfaces import merged_scene, no_lights


def read_gltf_animated(path: str | os.PathLike) -> AnimatedScene:
    """Reads a scene with its clips from a .gltf or .glb file.

    The file may be anything, as in `read_gltf_scene`; at rest the scene is the one that this gives.

    Raises:
      InputError: naming the file, the field, what was expected and what came.
    """
    opened = open_gltf_scene(path)
    source, palette = opened.source, opened.palette
    rest = rest_scene(opened)
    carriers = [*opened.light_nodes, *opened.camera_nodes]
    skeleton, joint_of = build_skeleton(source, opened.graph, [*palette.nodes, *carriers])
    # Tangents that the file leaves open are found where the mesh is still flat on its own axes.
    local = merged_scene(
        [part.surface for part in opened.parts], material=rest.material, lights=no_lights(), cameras=(), name=rest.name
    )
    joints, weights = _side_by_side(opened.parts)
    source.spend(2 * joints.size, "meshes")
    skin = Skin(
        vertices=local.positions,
        normals=local.normals,
        joint_indices=jnp.asarray(joints, jnp.int32),
        weights=jnp.asarray(weights, jnp.float32),
        palette_joints=jnp.asarray([joint_of[node] for node in palette.nodes], jnp.int32),
        inverse_binds=jnp.asarray(palette.inverse_binds(), jnp.float32),
    )
    clips = read_clips(source, joint_of, leave_out_morphs=True)
    return AnimatedScene(
        rest=dataclasses.replace(rest, notes=source.notes),
        skeleton=skeleton,
        skin=skin,
        tangents=local.tangents[:, :3],
        light_joints=tuple(joint_of[node] for node in opened.light_nodes),
        camera_joints=tuple(joint_of[node] for node in opened.camera_nodes),
        clips=clips,
    )


def _side_by_side(parts: list[GltfPart]) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights of all vertices, as many a vertex as any needs."""
    width = max(part.weights.shape[1] for part in parts)
    joints: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    for part in parts:
        shape = len(part.surface.positions), part.weights.shape[1]
        for rows, values in ((joints, part.joints), (weights, part.weights)):
            rows.append(np.pad(np.broadcast_to(values, shape), ((0, 0), (0, width - shape[1]))))
    return np.concatenate(joints), np.concatenate(weights)
