"""Surfaces from any kind of file -> one `Scene`."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64, Int

from jaxrender.camera import Camera
from jaxrender.scene import Lights, Material, Scene, SceneImage


@dataclass(frozen=True)
class SceneSurface:
    """A part of a scene, in world space; the fields are those of `Scene`. Tangents may be missing."""

    positions: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    tangents: Float[np.ndarray, "v 4"] | None
    uv: Float[np.ndarray, "v 2"]
    colors: Float[np.ndarray, "v 4"]
    faces: Int[np.ndarray, "t 3"]
    material_id: Int[np.ndarray, " t"]


def merged_scene(
    surfaces: Sequence[SceneSurface],
    *,
    material: Material,
    lights: Lights,
    cameras: tuple[Camera, ...],
    name: str,
    images: tuple[SceneImage, ...] = (),
    material_names: tuple[str, ...] = (),
    notes: tuple[str, ...] = (),
) -> Scene:
    """One scene of all, in order, with tangents derived from uv where there are none."""
    starts = np.cumsum([0] + [len(surface.positions) for surface in surfaces])
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=False)])
    positions, normals, uv, colors = (
        np.concatenate([getattr(s, field) for s in surfaces]) for field in ("positions", "normals", "uv", "colors")
    )
    tangents = np.concatenate([_given_tangents(surface) for surface in surfaces])
    if any(surface.tangents is None for surface in surfaces):
        tangents = np.where(tangents[:, 3:] == 0.0, vertex_tangents(positions, normals, uv, faces), tangents)
    return Scene(
        positions=on_device(positions),
        normals=on_device(normals),
        tangents=on_device(_orthogonal(tangents, normals)),
        uv=on_device(uv),
        colors=on_device(colors),
        faces=on_device(faces),
        material_id=on_device(np.concatenate([s.material_id for s in surfaces])),
        material=material,
        lights=lights,
        cameras=cameras,
        name=name,
        images=images,
        material_names=material_names,
        notes=notes,
    )


def vertex_tangents(
    positions: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    uv: Float[np.ndarray, "v 2"],
    faces: Int[np.ndarray, "t 3"],
) -> Float64[np.ndarray, "v 4"]:
    """Tangents for normal maps: the mean over the faces around a vertex of the direction of growing u, by area.

    w is the sign with which w cross(normal, tangent) points towards decreasing v, up in a glTF image. xyz are not
    made unit or orthogonal to the normal. Unlike MikkTSpace, vertices are not split where the mapping is mirrored:
    there the larger side decides. Without a direction (no area in uv, opposite ones that cancel) xyz are 0, w is 1.
    """
    a, b, c = (positions[faces[:, i]].astype(np.float64) for i in range(3))
    p, q, r = (uv[faces[:, i]].astype(np.float64) for i in range(3))
    e1, e2, d1, d2 = b - a, c - a, q - p, r - p
    area = np.linalg.norm(np.cross(e1, e2), axis=1, keepdims=True)
    # dP/du and dP/dv of a face, up to the length: e = du dP/du + dv dP/dv for both edges.
    sign = np.sign(d1[:, :1] * d2[:, 1:] - d1[:, 1:] * d2[:, :1])
    along_u = _unit(sign * (e1 * d2[:, 1:] - e2 * d1[:, 1:])) * area
    along_v = _unit(sign * (e2 * d1[:, :1] - e1 * d2[:, :1])) * area
    weights = np.concatenate([along_u, along_v], axis=1)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(w, 3), len(positions)) for w in weights.T], axis=1)
    down = np.sum(np.cross(normals, total[:, :3]) * total[:, 3:], axis=1, keepdims=True)
    return np.concatenate([total[:, :3], np.where(down > 0, -1.0, 1.0)], axis=1)


def on_device(array: np.ndarray):
    """A NumPy array as the kernels have it: float32, int32 or bool."""
    return jnp.asarray(array.astype({"f": np.float32, "i": np.int32, "b": np.bool_}[array.dtype.kind]))


def no_lights() -> Lights:
    """The lights of a file that has none."""
    vector, number = on_device(np.zeros((0, 3))), on_device(np.zeros(0))
    return Lights(on_device(np.zeros(0, int)), vector, vector, vector, number, number, number)


def _given_tangents(surface: SceneSurface) -> np.ndarray:
    """The tangents of a surface, zeros if it has none."""
    return np.zeros((len(surface.positions), 4)) if surface.tangents is None else surface.tangents


def _orthogonal(tangents: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Tangents unit and orthogonal to the unit normal; any such vector where that leaves nothing."""
    along = tangents[:, :3] - np.sum(tangents[:, :3] * normals, axis=1, keepdims=True) * normals
    length, before = (np.linalg.norm(x, axis=1, keepdims=True) for x in (along, tangents[:, :3]))
    # Across the axis that is farthest from the normal.
    other = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    return np.concatenate([_unit(np.where(length > 1e-4 * before, along, other)), tangents[:, 3:]], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Rows at length 1; zeros stay zeros."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
