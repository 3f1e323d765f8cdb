"""glTF 2.0 and GLB -> `Character`: container -> nodes -> meshes -> one skin -> clips.

Every mesh of the default scene becomes part of one surface, whose palette has an entry for each joint of each
skin and for each node that carries a rigid mesh. Supported: every accessor type, sparse and normalised
accessors, interleaved data, KHR_mesh_quantization; triangles, strips and fans; any number of
influences; STEP, LINEAR and CUBICSPLINE. Refused by name: morph targets and required extensions such as
Draco or meshopt compression.
"""

import os
import pathlib
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from jaxrender.animation.skinning import Character, Skin
from jaxrender.io.gltf_accessors import LARGEST_NUMBER
from jaxrender.io.gltf_clips import read_clips
from jaxrender.io.gltf_container import Container, printable
from jaxrender.io.gltf_meshes import Surface, read_surface
from jaxrender.io.gltf_nodes import Palette, build_skeleton, read_nodes, scene_nodes


def read_gltf(path: str | os.PathLike) -> Character:
    """Reads a character from a .gltf or .glb file.

    The file may be anything: what cannot be read is refused with one line, and no size in it is believed
    before it is checked. External buffers and images are read from the file's own folder only.

    Returns:
      The character; its `notes` say what was repaired (zero-area faces dropped, weights renormalised) or
      left out (points and lines, unreadable textures).
    Raises:
      InputError: naming the file, the field, what was expected and what came.
    """
    source = Container(pathlib.Path(path))
    graph = read_nodes(source)
    palette = Palette(source)
    surfaces = []
    for node in scene_nodes(source, graph):
        surfaces += _read_instance(source, node, palette)
    if not surfaces:
        left_out = "; ".join(source.notes) or "no mesh in the scene"
        source.bad("meshes", expected="at least one triangle", got=left_out)
    skeleton, joint_of = build_skeleton(source, graph, palette.nodes)
    surface = _merged(source, surfaces)
    surface = _oriented(source, surface, graph.world_matrices()[palette.nodes] @ palette.inverse_binds())
    return Character(
        name=printable(source.path.stem),
        skeleton=skeleton,
        skin=Skin(
            vertices=jnp.asarray(surface.vertices),
            normals=jnp.asarray(surface.normals),
            joint_indices=jnp.asarray(surface.joints, dtype=jnp.int32),
            weights=jnp.asarray(surface.weights),
            palette_joints=jnp.asarray([joint_of[node] for node in palette.nodes], dtype=jnp.int32),
            inverse_binds=jnp.asarray(palette.inverse_binds(), dtype=jnp.float32),
        ),
        faces=jnp.asarray(surface.faces, dtype=jnp.int32),
        clips=read_clips(source, joint_of),
        albedo=jnp.asarray(surface.albedo),
        content_hash=source.content_hash(),
        unit_scale=1.0,
        notes=source.notes,
    )


def _read_instance(source: Container, node_index: int, palette: Palette) -> list[Surface]:
    """The surfaces of the mesh on a node, if it has one, with joints counted in the palette."""
    node = source.gltf.nodes[node_index]
    if node.mesh is None:
        return []
    mesh = source.item("meshes", node.mesh, f"nodes[{node_index}].mesh")
    first = num_joints = None
    if node.skin is not None:
        first, num_joints = palette.skin(node.skin, f"nodes[{node_index}].skin")
    surfaces = []
    for i, primitive in enumerate(mesh.primitives):
        where = f"meshes[{node.mesh}].primitives[{i}]"
        surface = read_surface(source, primitive, num_joints, where)
        if surface is not None:
            entry = palette.rigid(node_index) if first is None else first
            surfaces.append(replace(surface, joints=surface.joints + entry))
    return surfaces


def _merged(source: Container, surfaces: list[Surface]) -> Surface:
    """One surface of all, with as many influences a vertex as any vertex needs."""
    starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces])
    width = max(surface.weights.shape[1] for surface in surfaces)
    source.spend(2 * width * int(starts[-1]), "meshes")

    def padded(values: np.ndarray) -> np.ndarray:
        return np.pad(values, ((0, 0), (0, width - values.shape[1])))

    return Surface(
        vertices=np.concatenate([surface.vertices for surface in surfaces]),
        normals=np.concatenate([surface.normals for surface in surfaces]),
        faces=np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=False)]),
        albedo=np.concatenate([surface.albedo for surface in surfaces]),
        joints=np.concatenate([padded(surface.joints) for surface in surfaces]),
        weights=np.concatenate([padded(surface.weights) for surface in surfaces]),
    )


def _oriented(source: Container, surface: Surface, palette: np.ndarray) -> Surface:
    """The surface with the faces turned round that the rest pose mirrors, as the outside stays outside.

    Also the place where a character that its own rest pose throws out of the range of numbers is refused.
    """
    with np.errstate(all="ignore"):
        blended = np.zeros((len(surface.vertices), 3, 4))
        for k in range(surface.weights.shape[1]):
            blended += surface.weights[:, k, None, None] * palette[surface.joints[:, k], :3]
        posed = np.einsum("vij,vj->vi", blended[..., :3], surface.vertices) + blended[..., 3]
        if not (np.abs(posed) <= LARGEST_NUMBER).all():
            source.bad("rest pose", expected=f"vertices within {LARGEST_NUMBER:g}", got="some beyond or NaN")
        handedness = np.linalg.det(blended[..., :3])[surface.faces].mean(axis=1)
    return replace(surface, faces=np.where(handedness[:, None] < 0, surface.faces[:, ::-1], surface.faces))
