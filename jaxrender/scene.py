"""What goes into the methods: meshes, meshes that move, and scenes with materials, lights and cameras."""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxrender.camera import Camera, frame_bounds
from jaxrender.vecmath import frame_from_normal_tangent, normalize

#: Values of `Material.alpha_mode`.
OPAQUE, MASK, BLEND = 0, 1, 2
#: Values of `Lights.kind`.
DIRECTIONAL, POINT, SPOT = 0, 1, 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mesh:
    """One triangle mesh. Faces are counter-clockwise seen from outside."""

    vertices: Float[Array, "v 3"]
    normals: Float[Array, "v 3"]
    faces: Int[Array, "t 3"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MeshSequence:
    """One mesh in f frames, and for each frame the numbers that drive it.

    `frames[f, v]` is the world-from-local rotation of a vertex: local z is its normal, local x is a
    tangent that moves with the surface. Visibility is stored in these frames, so that it does not
    change when the body only turns.
    """

    vertices: Float[Array, "f v 3"]
    frames: Float[Array, "f v 3 3"]
    faces: Int[Array, "t 3"]
    features: Float[Array, "f j"]

    @property
    def normals(self) -> Float[Array, "f v 3"]:
        return self.frames[..., 2]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Material:
    """Metallic-roughness materials in the terms of glTF 2.0: by id (m leading), or gathered at pixels (h, w leading).

    Factors multiply what the texture of the same name gives, and colors are linear. A `*_texture` is an index into
    `Scene.images`, which is a layer of the textures built from them; -1 is none.

    Attributes:
      base_color: RGB and alpha, in [0, 1]; vertex colors multiply it as well.
      metallic, roughness: in [0, 1]; blue and green of their texture. roughness is perceptual: alpha is its square.
      emissive: radiance, >= 0, unbounded.
      normal_scale: of x and y of the normal map. occlusion_strength: in [0, 1]; the red of its texture.
      alpha_mode: OPAQUE (alpha means nothing), MASK (discard where alpha < alpha_cutoff) or BLEND.
      double_sided: back faces are seen, with their normal turned round.
    """

    base_color: Float[Array, "*m 4"]
    metallic: Float[Array, "*m"]
    roughness: Float[Array, "*m"]
    emissive: Float[Array, "*m 3"]
    normal_scale: Float[Array, "*m"]
    occlusion_strength: Float[Array, "*m"]
    alpha_mode: Int[Array, "*m"]
    alpha_cutoff: Float[Array, "*m"]
    double_sided: Bool[Array, "*m"]
    base_color_texture: Int[Array, "*m"]
    metallic_roughness_texture: Int[Array, "*m"]
    normal_texture: Int[Array, "*m"]
    occlusion_texture: Int[Array, "*m"]
    emissive_texture: Int[Array, "*m"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lights:
    """n lights without extent, as in KHR_lights_punctual; every field is there for every kind.

    Attributes:
      kind: DIRECTIONAL, POINT or SPOT.
      position: in the world; 0 for a directional light.
      direction: unit, the way the light travels (from the lamp); (0, 0, -1) for a point light.
      intensity: linear RGB. Of a directional light the irradiance on a surface that faces it (lux in photometric
        files, else W/m2); of the others the radiant intensity (candela, else W/sr): irradiance times distance squared.
      range: the distance at which the light ends, smoothly (see the extension); inf for none.
      cos_inner, cos_outer: of the angles from the axis of a spot where it begins to fall and is 0; -1 otherwise.
    """

    kind: Int[Array, " n"]
    position: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    intensity: Float[Array, "n 3"]
    range: Float[Array, " n"]
    cos_inner: Float[Array, " n"]
    cos_outer: Float[Array, " n"]


@dataclass(frozen=True, eq=False)
class SceneImage:
    """A decoded picture as a file has it. It stays on the host; `jit` tells two apart by identity.

    Attributes:
      texels: row 0 on top, where v = 0.
      wrap: in u and v: "repeat", "clamp" or "mirror".
      srgb: the RGB channels are sRGB (colors), not linear (data such as normals); alpha is always linear.
    """

    name: str
    texels: UInt8[np.ndarray, "h w c"]
    wrap: tuple[str, str]
    srgb: bool


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """Everything a file says about a scene, as one triangle mesh in world space, with its materials and lights.

    Attributes:
      normals: unit shading normals, on the side from which faces are counter-clockwise.
      tangents: unit, orthogonal to the normal, along growing u; the bitangent (green of a normal map, towards
        decreasing v) is w cross(normal, tangent), w = 1 or -1.
      uv: (0, 0) is the upper left corner of an image. Not limited to [0, 1].
      colors: linear RGBA by vertex, 1 where the file has none.
      material_id: by triangle, into the fields of `material`.
      cameras: those of the file, in its order.
      images: what the texture indices of `material` refer to; `material_names` is by id.
      notes: what was repaired or left out, for people to read.
    """

    positions: Float[Array, "v 3"]
    normals: Float[Array, "v 3"]
    tangents: Float[Array, "v 4"]
    uv: Float[Array, "v 2"]
    colors: Float[Array, "v 4"]
    faces: Int[Array, "t 3"]
    material_id: Int[Array, " t"]
    material: Material
    lights: Lights
    cameras: tuple[Camera, ...]
    name: str = field(metadata={"static": True})
    images: tuple[SceneImage, ...] = field(default=(), metadata={"static": True})
    material_names: tuple[str, ...] = field(default=(), metadata={"static": True})
    notes: tuple[str, ...] = field(default=(), metadata={"static": True})


def scene_bounds(scene: Scene) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """The smallest box that holds all triangles: its lowest and its highest corner."""
    used = jnp.zeros(len(scene.positions), bool).at[scene.faces].set(True)[:, None]
    lowest, highest = (jnp.where(used, scene.positions, bound) for bound in (jnp.inf, -jnp.inf))
    return jnp.min(lowest, axis=0), jnp.max(highest, axis=0)


def whole_scene_camera(
    scene: Scene, *, aspect: int | float = 1.0, azimuth_radians: float = 0.6, elevation_radians: float = 0.35,
    bounds: tuple[Float[Array, "3"], Float[Array, "3"]] | None = None,
) -> Camera:  # fmt: skip
    """A camera outside the scene that sees all of it, from the right and above; the angles as in `frame_bounds`.

    Args:
      bounds: the box to be seen, of all poses for example; None is that of the scene.
    """
    low, high = scene_bounds(scene) if bounds is None else bounds
    return frame_bounds(low, high, azimuth_radians=azimuth_radians, elevation_radians=elevation_radians, aspect=aspect)


def with_ground(
    scene: Scene, low: Float[Array, "3"], high: Float[Array, "3"], *, width: float = 40.0, color: float = 0.3
) -> Scene:
    """The scene on a level matt plane, for a character that comes without one. Not for use inside `jit`.

    The plane is the last two triangles and the last material. It passes through `low`.

    Args:
      low, high: the box around the scene, or around all its poses; the plane lies under its middle.
      width: of the plane, over the diagonal of that box.
      color: its reflectance.
    """
    box = np.asarray([low, high], np.float64)
    half = 0.5 * width * (float(np.linalg.norm(box[1] - box[0])) or 1.0)
    x, height, z = 0.5 * (box[0, 0] + box[1, 0]), box[0, 1], 0.5 * (box[0, 2] + box[1, 2])
    signs = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    corners = np.stack([x + half * signs[:, 0], np.full(4, height), z + half * signs[:, 1]], axis=1)
    row = lambda *numbers: np.tile(np.array(numbers, np.float32), (4, 1))  # noqa: E731
    added = {
        "positions": corners.astype(np.float32), "normals": row(0, 1, 0), "tangents": row(1, 0, 0, 1),
        "uv": row(0, 0), "colors": row(1, 1, 1, 1),
        "faces": len(scene.positions) + np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        "material_id": np.full(2, len(scene.material.metallic), np.int32),
    }  # fmt: skip
    below: dict[str, Any] = {name: jnp.concatenate([getattr(scene, name), rows]) for name, rows in added.items()}
    material = jax.tree.map(lambda own, new: jnp.concatenate([own, new[None]]), scene.material, _matt(color))
    return replace(scene, **below, material=material, material_names=(*scene.material_names, "ground"))


def _matt(color: float) -> Material:
    """One material without textures or gloss."""
    number, none = (lambda x: jnp.asarray(x, jnp.float32)), jnp.asarray(-1, jnp.int32)
    return Material(
        base_color=number([color, color, color, 1.0]), metallic=number(0.0), roughness=number(1.0),
        emissive=number([0.0, 0.0, 0.0]), normal_scale=number(1.0), occlusion_strength=number(1.0),
        alpha_mode=jnp.asarray(OPAQUE, jnp.int32), alpha_cutoff=number(0.5), double_sided=jnp.asarray(False),
        base_color_texture=none, metallic_roughness_texture=none, normal_texture=none, occlusion_texture=none,
        emissive_texture=none,
    )  # fmt: skip


def inside_camera(scene: Scene, *, fov_y_radians: float = 1.05) -> Camera:
    """A camera inside a building: near one end of its longer side, a fifth up, looking to the other end."""
    low, high = scene_bounds(scene)
    x_is_longer = high[0] - low[0] >= high[2] - low[2]
    along = jnp.where(x_is_longer, jnp.asarray([1.0, 0.0, 0.0], low.dtype), jnp.asarray([0.0, 0.0, 1.0], low.dtype))
    size = high - low
    foot = jnp.stack([0.5 * (low[0] + high[0]), low[1] + 0.2 * size[1], 0.5 * (low[2] + high[2])])
    return Camera(
        foot + 0.35 * size * along, foot - 0.35 * size * along, jnp.asarray([0.0, 1.0, 0.0], low.dtype),
        jnp.asarray(fov_y_radians, low.dtype),
    )  # fmt: skip


def vertex_normals(vertices: Float[Array, "*b v 3"], faces: Int[Array, "t 3"]) -> Float[Array, "*b v 3"]:
    """Unit normals: the sum of the face normals around each vertex, weighted by area; 0 at a vertex without faces."""
    a, b, c = (vertices[..., faces[:, i], :] for i in range(3))
    weighted = jnp.cross(b - a, c - a)
    total = jnp.zeros_like(vertices)
    for corner in range(3):
        total = total.at[..., faces[:, corner], :].add(weighted)
    return normalize(total)


def make_mesh_sequence(
    vertices: Float[Array, "f v 3"], faces: Int[Array, "t 3"], features: Float[Array, "f j"]
) -> MeshSequence:
    """A mesh sequence from bare vertices: normals from the faces, tangents along one fixed edge of each vertex.

    The edge moves with the surface, so the frames turn with the body and do not spin against it.

    Args:
      features: what drives the shape, one row per frame; the model is linear in them.
    Raises:
      ValueError: if the numbers of frames differ, or an index in `faces` is out of range.
    """
    if len(vertices) != len(features):
        raise ValueError(f"features: expected {len(vertices)} frames as in vertices, got {len(features)}")
    index = np.asarray(faces)
    if index.size == 0 or index.min() < 0 or index.max() >= vertices.shape[1]:
        got = f"{index.min(initial=0)}..{index.max(initial=0)}"
        raise ValueError(f"faces: expected indices below {vertices.shape[1]}, got {got}")
    neighbour = np.arange(vertices.shape[1])
    for corner in (2, 1, 0):
        neighbour[index[:, corner]] = index[:, (corner + 1) % 3]
    normals = vertex_normals(vertices, faces)
    frames = frame_from_normal_tangent(normals, vertices[:, neighbour] - vertices)
    return MeshSequence(vertices, frames, faces, features)
