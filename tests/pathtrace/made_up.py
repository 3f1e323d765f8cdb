"""Scenes and surfaces for the tests of this folder, and integrals over the sphere to hold results against."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrender import vec3
from jaxrender.deferred.texture import Textures
from jaxrender.pathtrace.scatter import Reflector
from jaxrender.scene import Lights, Material, Scene
from jaxrender.vec3 import Vec3
from tests.support import scenes


def vec(values) -> Vec3:
    """Rows of three as a `Vec3`, in float32, or in float64 where that is on."""
    return vec3.from_array(jnp.asarray(values, jnp.result_type(float)))


def rows(v: Vec3) -> np.ndarray:
    """A `Vec3` as float64 rows."""
    return np.stack([np.asarray(c, np.float64) for c in v], axis=-1)


def floating(record):
    """A record's arrays for JAX, floating ones in the working precision."""

    def convert(x):
        x = np.asarray(x)
        return jnp.asarray(x, jnp.result_type(float) if x.dtype.kind == "f" else x.dtype)

    return jax.tree.map(convert, record)


def no_lights() -> Lights:
    return floating(Lights(**{name: values[:0] for name, values in scenes.lights().items()}))


def plain_material(count: int = 1, **changed) -> Material:
    """White, rough, dark and one-sided, without textures, but for the fields given."""
    fields = {
        "base_color": np.ones((count, 4)),
        "emissive": np.zeros((count, 3)),
        "double_sided": np.zeros(count, bool),
        "alpha_mode": np.zeros(count, np.int32),
        **{name: np.zeros(count) for name in ("metallic", "occlusion_strength")},
        **{name: np.ones(count) for name in ("roughness", "normal_scale", "alpha_cutoff")},
        **{f"{name}_texture": np.full(count, -1, np.int32)
           for name in ("base_color", "metallic_roughness", "normal", "occlusion", "emissive")},
    }  # fmt: skip
    return floating(Material(**(fields | changed)))


def make_scene(positions, faces, *, material: Material, material_id=None, lights: Lights | None = None, uv=None):
    """A `Scene` of triangles with their own normals."""
    positions, faces = np.asarray(positions, np.float64), np.asarray(faces, np.int32)
    p = positions[faces]
    normals = np.zeros_like(positions)
    np.add.at(normals, faces.reshape(-1), np.repeat(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), 3, axis=0))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(lengths > 0.0, normals / np.where(lengths > 0.0, lengths, 1.0), [0.0, 1.0, 0.0])
    one = np.ones((len(positions), 4))
    return floating(
        Scene(
            positions=positions, normals=normals, tangents=one, uv=np.zeros((len(positions), 2)) if uv is None else uv,
            colors=one, faces=faces, material=material, lights=no_lights() if lights is None else lights, cameras=(),
            material_id=np.zeros(len(faces), np.int32) if material_id is None else np.asarray(material_id, np.int32),
            name="made up",
        )
    )  # fmt: skip


def small_scene(rng: np.random.Generator) -> tuple[Scene, Textures]:
    """That of `tests.support.scenes`, with its textures."""
    parts = {"material": Material(**scenes.material(rng)), "lights": Lights(**scenes.lights())}
    scene = Scene(**scenes.scene(rng), **parts, cameras=(), name="small")
    return floating(scene), floating(Textures(**scenes.textures(rng)))


def reflector(
    normal, wo, *, base=(1.0, 1.0, 1.0), metallic=0.0, roughness=1.0, geometric=None, position=None
) -> dict[str, np.ndarray]:
    """The fields of a `HitSurface` and the direction of the ray, one row for each of `normal`."""
    normal, wo = (np.atleast_2d(np.asarray(x, np.float64)) for x in (normal, wo))
    n = max(len(normal), len(wo))
    full = lambda x, *shape: np.broadcast_to(np.asarray(x, np.float64), (n, *shape))  # noqa: E731
    return {
        "normal": full(normal, 3), "geometric_normal": full(normal if geometric is None else geometric, 3),
        "wo": full(wo, 3), "base_color": full(base, 3), "metallic": full(metallic), "roughness": full(roughness),
        "position": full(np.zeros(3) if position is None else position, 3),
    }  # fmt: skip


def repeated(at: Reflector, count: int) -> Reflector:
    """A reflector of one point, for many directions."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count,)), at)


def directions_around(axis: np.ndarray, *, rings: int = 300, azimuths: int = 128) -> tuple[np.ndarray, np.ndarray]:
    """Directions all over the sphere and their solid angles, the closer together the nearer to an axis.

    The angle from the axis is π t², t by Gauss-Legendre.
    """
    t, w = np.polynomial.legendre.leggauss(rings)
    t, w = 0.5 * (t + 1.0), 0.5 * w
    theta, phi = np.pi * t * t, 2.0 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    solid = np.repeat(np.sin(theta) * 2.0 * np.pi * t * w * 2.0 * np.pi / azimuths, azimuths)
    local = np.stack(
        np.broadcast_arrays(
            np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi), np.cos(theta)[:, None]
        ),
        axis=-1,
    ).reshape(-1, 3)
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.6 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    return local @ np.stack([across, np.cross(axis, across), axis]), solid
