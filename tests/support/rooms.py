"""Small scenes whose light is known in closed form."""

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxrender.io.surfaces import SceneSurface, merged_scene, no_lights, on_device
from jaxrender.scene import OPAQUE, Lights, Material, Scene


def matt(color, *, emissive=(0.0, 0.0, 0.0), double_sided=False, **changed) -> dict:
    """The fields of one material."""
    plain = {
        "base_color": [*color, 1.0], "metallic": 0.0, "roughness": 1.0, "emissive": list(emissive), "normal_scale": 1.0,
        "occlusion_strength": 1.0, "alpha_mode": OPAQUE, "alpha_cutoff": 0.5, "double_sided": double_sided,
        "base_color_texture": -1, "metallic_roughness_texture": -1, "normal_texture": -1, "occlusion_texture": -1,
        "emissive_texture": -1,
    }  # fmt: skip
    return plain | changed


def room(*parts, lights: Lights | None = None, images=()) -> Scene:
    """A scene of (vertices, faces, normals, material), or with uv as a fifth."""
    surfaces = []
    for index, (vertices, faces, normals, _, *uv) in enumerate(parts):
        count = len(vertices)
        surfaces.append(
            SceneSurface(
                np.asarray(vertices, np.float64), np.asarray(normals, np.float64), None,
                np.asarray(uv[0]) if uv else np.zeros((count, 2)), np.ones((count, 4)), np.asarray(faces),
                np.full(len(faces), index),
            )
        )  # fmt: skip
    table = {name: on_device(np.array([part[3][name] for part in parts])) for name in parts[0][3]}
    names = tuple(f"material {index}" for index in range(len(parts)))
    return merged_scene(
        surfaces, material=Material(**table), lights=no_lights() if lights is None else lights, cameras=(),
        name="room", material_names=names, images=tuple(images),
    )  # fmt: skip


def sphere(material: dict, *, radius: float = 1.0, inside: bool = False):
    """A closed sphere of 1280 faces, smooth; with `inside` its front is within."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    faces, normals = np.array(mesh.faces), np.array(mesh.vertices) / radius
    return (mesh.vertices, faces[:, ::-1], -normals, material) if inside else (mesh.vertices, faces, normals, material)


def square(middle, u, v, material: dict):
    """A parallelogram of half-axes u and v; its front is where u x v points. uv runs from 0 to 1."""
    middle, u, v = (np.asarray(x, np.float64) for x in (middle, u, v))
    corners = middle + np.stack([-u - v, u - v, u + v, v - u])
    n = np.cross(u, v)
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]]), np.tile(n / np.linalg.norm(n), (4, 1)), material, uv


def light(kind: int, *, position=(0.0, 0.0, 0.0), direction=(0.0, -1.0, 0.0), intensity=(1.0, 1.0, 1.0),
          cos_inner=-1.0, cos_outer=-1.0) -> Lights:  # fmt: skip
    """One light without extent."""
    row = lambda values: on_device(np.array([values], float))  # noqa: E731
    unit = np.asarray(direction) / np.linalg.norm(direction)
    return Lights(
        kind=jnp.full(1, kind, jnp.int32), position=row(position), direction=row(unit), intensity=row(intensity),
        range=row(np.inf), cos_inner=row(cos_inner), cos_outer=row(cos_outer),
    )  # fmt: skip


def polygon_irradiance(point: np.ndarray, normal: np.ndarray, corners: np.ndarray) -> float:
    """Irradiance on a point from a polygon of radiance 1 that is wholly above its horizon.

    Lambert's formula: half the sum over edges of the angle of the edge times normal . unit (r_i x r_j).
    """
    total = 0.0
    for r, s in zip(corners - point, np.roll(corners, -1, axis=0) - point, strict=True):
        r, s = r / np.linalg.norm(r), s / np.linalg.norm(s)
        across = np.cross(r, s)
        total += np.arccos(np.clip(r @ s, -1.0, 1.0)) * normal @ (across / np.linalg.norm(across))
    return 0.5 * abs(total)
