"""The node graph of a glTF -> a `Skeleton`, with the way from a node to its joint."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxrender.animation.skeleton import Pose, Skeleton
from jaxrender.io.gltf_accessors import LARGEST_NUMBER, read_floats
from jaxrender.io.gltf_container import Container, printable

_SHEAR_TOLERANCE = 1e-4


@dataclass(frozen=True)
class NodeGraph:
    """All nodes of a file: `order` has parents first; local transforms are T, R (x, y, z, w) and S."""

    parents: list[int]
    order: list[int]
    translation: Float64[np.ndarray, "n 3"]
    rotation: Float64[np.ndarray, "n 4"]
    scale: Float64[np.ndarray, "n 3"]

    def world_matrices(self) -> Float64[np.ndarray, "n 4 4"]:
        """World from node, at rest. Entries may be infinite, for a hostile file."""
        local = np.zeros((len(self.parents), 4, 4))
        local[:, :3, :3] = _matrices(self.rotation) * self.scale[:, None, :]
        local[:, :3, 3] = self.translation
        local[:, 3, 3] = 1.0
        world = local.copy()
        with np.errstate(all="ignore"):
            for node in self.order:
                if self.parents[node] >= 0:
                    world[node] = world[self.parents[node]] @ local[node]
        return world


def read_nodes(source: Container) -> NodeGraph:
    """Every node and its transform.

    Raises:
      InputError: if the nodes are not a forest, or one has no transform of the form T R S.
    """
    nodes = source.gltf.nodes
    parents = [-1] * len(nodes)
    for i, node in enumerate(nodes):
        for child in node.children:
            source.item("nodes", child, f"nodes[{i}].children")
            if parents[child] >= 0:
                got = f"nodes {parents[child]} and {i}"
                source.bad(f"nodes[{child}]", expected="one parent", got=got)
            parents[child] = i
    order = [i for i, parent in enumerate(parents) if parent < 0]
    for node in order:  # grows while it is walked
        order.extend(nodes[node].children)
    if len(order) < len(nodes):
        lost = min(set(range(len(nodes))) - set(order))
        source.bad(f"nodes[{lost}]", expected="a node below a root", got="a cycle of children")
    transforms = [_transform(source, i) for i in range(len(nodes))]
    t, r, s = (np.array([part[i] for part in transforms]).reshape(-1, n) for i, n in enumerate((3, 4, 3)))
    return NodeGraph(parents, order, t, unit_quaternions(source, r, "nodes.rotation"), s)


def scene_nodes(source: Container, graph: NodeGraph) -> list[int]:
    """The nodes of the default scene, parents first; all nodes of a file without scenes."""
    gltf = source.gltf
    if not gltf.scenes:
        return graph.order
    roots = source.item("scenes", 0 if gltf.scene is None else gltf.scene, "scene").nodes
    for root in roots:
        source.item("nodes", root, "scene.nodes")
    inside = set(roots)
    for node in graph.order:
        if graph.parents[node] in inside:
            inside.add(node)
    return [node for node in graph.order if node in inside]


def build_skeleton(source: Container, graph: NodeGraph, needed: Iterable[int]) -> tuple[Skeleton, dict[int, int]]:
    """A skeleton of the needed nodes and all above them, and the joint of each of these nodes."""
    wanted: set[int] = set()
    for node in needed:
        while node >= 0 and node not in wanted:
            wanted.add(node)
            node = graph.parents[node]
    order = [node for node in graph.order if node in wanted]
    joint_of = {node: joint for joint, node in enumerate(order)}
    rest = Pose(
        translation=jnp.asarray(graph.translation[order], dtype=jnp.float32),
        rotation=jnp.asarray(graph.rotation[order], dtype=jnp.float32),
        scale=jnp.asarray(graph.scale[order], dtype=jnp.float32),
    )
    names = tuple(printable(source.gltf.nodes[node].name or f"node_{node}") for node in order)
    return Skeleton(names, tuple(joint_of.get(graph.parents[node], -1) for node in order), rest), joint_of


def read_inverse_binds(source: Container, skin: Any, field: str) -> Float64[np.ndarray, "j 4 4"]:
    """Inverse bind matrices of a skin's joints, which are checked; the identity where the file has none."""
    count, where = len(skin.joints), f"{field}.inverseBindMatrices"
    if not skin.joints:
        source.bad(f"{field}.joints", expected="at least one joint", got="none")
    for node in skin.joints:
        source.item("nodes", node, f"{field}.joints")
    if skin.inverseBindMatrices is None:
        source.spend(16 * count, where)
        return np.broadcast_to(np.eye(4), (count, 4, 4))
    columns = read_floats(source, skin.inverseBindMatrices, ("MAT4",), where)
    if len(columns) < count:
        source.bad(where, expected=f"{count} matrices, one a joint", got=len(columns))
    matrices = columns[:count].reshape(-1, 4, 4).swapaxes(1, 2).astype(np.float64)
    if not np.allclose(matrices[:, 3], [0, 0, 0, 1], rtol=0, atol=1e-3):
        source.bad(where, expected="affine matrices (last row 0 0 0 1)", got="others")
    matrices[:, 3] = [0, 0, 0, 1]
    return matrices


class Palette:
    """Palette entries as they are asked for: one block for each skin, one entry for each rigid node."""

    def __init__(self, source: Container):
        self._source = source
        self._first_entry: dict[tuple[str, int], int] = {}
        self._inverse_binds: list[np.ndarray] = []
        self.nodes: list[int] = []

    def rigid(self, node: int) -> int:
        """The entry of a node that carries a mesh without a skin."""
        return self._block(("node", node), [node], np.eye(4)[None])

    def skin(self, index: Any, where: str) -> tuple[int, int]:
        """The first entry of a skin and the number of its joints."""
        skin = self._source.item("skins", index, where)
        if ("skin", index) not in self._first_entry:
            inverse_binds = read_inverse_binds(self._source, skin, f"skins[{index}]")
            self._block(("skin", index), skin.joints, inverse_binds)
        return self._first_entry["skin", index], len(skin.joints)

    def inverse_binds(self) -> Float64[np.ndarray, "p 4 4"]:
        """The inverse bind matrix of each entry; the identity for a rigid node."""
        return np.concatenate(self._inverse_binds)

    def _block(self, key: tuple[str, int], nodes: list[int], inverse_binds: np.ndarray) -> int:
        if key not in self._first_entry:
            self._first_entry[key] = len(self.nodes)
            self.nodes.extend(nodes)
            self._inverse_binds.append(inverse_binds)
        return self._first_entry[key]


def unit_quaternions(source: Container, q: np.ndarray, where: str) -> np.ndarray:
    """The rows normalised; says so if that was more than rounding. Zero is no rotation and refused."""
    length = np.linalg.norm(q.astype(np.float64), axis=-1, keepdims=True)
    if (length < 1e-6).any():
        row = int(np.argwhere(length < 1e-6)[0][0])
        source.bad(where, expected="unit quaternions", got=f"{q[row].tolist()} at {row}")
    # Quantised keys (8 bits) are off by up to 1 %.
    off = int((np.abs(length - 1.0) > 1e-2).sum())
    source.note("rotations that were not unit quaternions, normalized", off)
    return (q / length).astype(q.dtype)


def _transform(source: Container, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    node = source.gltf.nodes[index]
    where = f"nodes[{index}]"
    if node.matrix is not None:
        matrix = _numbers(source, node.matrix, 16, f"{where}.matrix").reshape(4, 4).T
        return _decomposed(source, matrix, f"{where}.matrix")
    return (
        _numbers(source, node.translation or [0, 0, 0], 3, f"{where}.translation"),
        _numbers(source, node.rotation or [0, 0, 0, 1], 4, f"{where}.rotation"),
        _numbers(source, node.scale or [1, 1, 1], 3, f"{where}.scale"),
    )


def _numbers(source: Container, values: list, count: int, where: str) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (count,) or not (np.abs(array) <= LARGEST_NUMBER).all():
        source.bad(where, expected=f"{count} finite numbers up to {LARGEST_NUMBER:g}", got=values)
    return array


def _decomposed(source: Container, m: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T, R and S of a matrix; a mirror becomes a negative x scale."""
    scale = np.linalg.norm(m[:3, :3], axis=0)
    if not np.allclose(m[3], [0, 0, 0, 1], rtol=0, atol=1e-5) or not (scale > 1e-12).all():
        source.bad(where, expected="an affine matrix without a zero axis", got=m.T.ravel().tolist())
    rotation = m[:3, :3] / scale
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _SHEAR_TOLERANCE:
        source.bad(where, expected="translation, rotation and scale", got="a matrix that shears")
    if np.linalg.det(rotation) < 0:
        scale[0], rotation[:, 0] = -scale[0], -rotation[:, 0]
    return m[:3, 3], _quaternion(rotation), scale


def _quaternion(r: np.ndarray) -> np.ndarray:
    """Of a rotation matrix: 4 q qᵀ has entries linear in R, and its longest row is the safe one to use.

    References:
      Shepperd, "Quaternion from Rotation Matrix", J. Guidance and Control 1(3), 1978.
    """
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    products = np.empty((4, 4))
    products[:3, :3] = r + r.T + (1.0 - np.trace(r)) * np.eye(3)
    products[3] = products[:, 3] = [x, y, z, 1.0 + np.trace(r)]
    row = products[np.argmax(np.diag(products))]
    return row / np.linalg.norm(row)


def _matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices of unit quaternions, R v = v + 2 w (u × v) + 2 u × (u × v), in float64."""
    cross = np.cross(q[:, None, :3], np.eye(3)[None]).swapaxes(1, 2)
    return np.eye(3) + 2.0 * q[:, 3, None, None] * cross + 2.0 * cross @ cross
