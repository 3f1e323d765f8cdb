"""GBuffer <-> layers of an image file, by the usual names; also those that other renderers wrote.

Nothing here opens a file: `io.read_exr_layers` and `io.write_exr` do, and `io.known_layers` sorts out the names.
"""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxrender.camera import Camera, camera_rays
from jaxrender.checks import bad_input, check_one_of
from jaxrender.deferred.gbuffer import GBuffer
from jaxrender.deferred.packing import positions_from_depth
from jaxrender.deferred.texture import texture_derivatives
from jaxrender.filters.aovs import FAR_AWAY
from jaxrender.vecmath import dot, normalize

# Fields of `GBuffer` that are layers of the same name, and layers of ids with their field.
_FIELDS = ("normal", "geometric_normal", "position", "depth", "uv", "motion")
_IDS = {"materialid": "material_id", "triangleid": "triangle_id"}


def gbuffer_layers(gbuffer: GBuffer, *, sample: int | None = None) -> dict[str, Num[np.ndarray, "h w c"]]:
    """Layers for `io.write_exr`: normal, geometric_normal, position, depth, uv, motion, color and ids.

    Ids are counted from 1, as unsigned numbers: 0 is nothing.

    Args:
      sample: whose values; by default means over the covered samples (unit vectors again), and the ids of the first
        covered sample.
    """
    covered = np.asarray(gbuffer.coverage)
    chosen = covered if sample is None else covered[:, :, sample : sample + 1]

    def layer(values: Any) -> np.ndarray:
        values = np.asarray(values).reshape(*covered.shape, -1)
        if sample is not None:
            return values[:, :, sample]
        return np.sum(values * chosen[..., None], axis=2) / np.maximum(chosen.sum(axis=-1, keepdims=True), 1)

    layers = {name: layer(getattr(gbuffer, name)) for name in _FIELDS if getattr(gbuffer, name) is not None}
    for name in ("normal", "geometric_normal"):
        length = np.linalg.norm(layers[name], axis=-1, keepdims=True)
        layers[name] = layers[name] / np.where(length > 0.0, length, 1.0)
    layers["vertexcolor"] = layer(gbuffer.color)
    first = np.argmax(covered, axis=-1)[..., None] if sample is None else np.full((*covered.shape[:2], 1), sample)
    for name, field in _IDS.items():
        ids = np.take_along_axis(np.asarray(getattr(gbuffer, field)), first, axis=2)
        layers[name] = (ids + 1).astype(np.uint32)
    return layers


def gbuffer_from_layers(
    layers: Mapping[str, Num[np.ndarray, "h w c"]],
    *,
    camera: Camera | None = None,
    depth_kind: str = "planar",
    name: str = "layers",
) -> GBuffer:
    """A G-buffer of one sample a pixel from layers of any renderer.

    What is missing is filled in: the geometric normal from the shading normal, positions from depth and camera, depth
    from positions and camera, derivatives of uv from its differences within a material; uv and colors are 0 and 1; ids
    are 0 where something is there.
    Something is there where the triangle id says so, else where depth is positive and below `FAR_AWAY`, else where
    there is a normal. Values that are not finite count as nothing.

    Args:
      layers: of `io.known_layers`.
      camera: of the picture; needed unless there are both position and depth.
      depth_kind: "planar", along the camera's axis, as Blender, Arnold and this library have it; or "distance" along
        the ray, as Mitsuba has it (needs the camera).
      name: of the file, for messages.
    Raises:
      InputError: if there is no normal, or neither depth nor position, or a camera is missing.
    """
    check_one_of("depth_kind", depth_kind, ("planar", "distance"))
    if "normal" not in layers and "geometric_normal" in layers:
        layers = {**layers, "normal": layers["geometric_normal"]}
    if "normal" not in layers or not {"depth", "position"} & set(layers):
        bad_input(name, "layers", expected="normal, and depth or position", got=", ".join(layers) or "none of them")
    if camera is None and not {"depth", "position"} <= set(layers):
        bad_input(name, "layers", expected="both depth and position, if no camera is given", got=", ".join(layers))
    normal = _finite(layers["normal"])
    some = _covered(layers, normal)
    field = lambda values: jnp.asarray(np.where(some, values, 0.0)[:, :, None], jnp.float32)  # noqa: E731
    height, width, _ = normal.shape
    zeros = np.zeros((height, width, 2))
    if "depth" in layers:
        depth = field(_finite(layers["depth"]))[..., 0]
        if depth_kind == "distance":
            depth = depth * _axis_share(camera, height, width, name)
    else:
        assert camera is not None
        ahead = np.asarray(camera.target - camera.eye, np.float64)
        along = (_finite(layers["position"]) - np.asarray(camera.eye)) @ (ahead / np.linalg.norm(ahead))
        depth = field(along[..., None])[..., 0]
    if "position" in layers:
        position = field(_finite(layers["position"]))
    else:
        assert camera is not None
        position = jnp.where(depth[..., None] > 0.0, positions_from_depth(depth, camera), 0.0)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    ids = {key: _ids(layers, key, some) for key in ("material_id", "triangle_id")}
    uv = field(_finite(layers.get("uv", zeros)))
    duv_dx, duv_dy = texture_derivatives(uv[:, :, 0], ids["material_id"][..., 0])
    return GBuffer(
        position=position,
        normal=field(normal / np.where(length > 0.0, length, 1.0)),
        geometric_normal=field(_finite(layers.get("geometric_normal", normal))),
        uv=uv,
        duv_dx=duv_dx[:, :, None],
        duv_dy=duv_dy[:, :, None],
        color=field(np.ones((height, width, 4))),
        depth=depth,
        motion=field(_finite(layers["motion"])) if "motion" in layers else None,
        **ids,
    )


def _axis_share(camera: Camera | None, height: int, width: int, name: str) -> Float[Array, "h w 1"]:
    """Depth along the axis of a point one unit away, for each pixel."""
    if camera is None:
        bad_input(name, "camera", expected="the camera of a depth along rays", got="none")
    _, directions = camera_rays(camera, height=height, width=width)
    return dot(directions, normalize(camera.target - camera.eye).reshape(1, 1, 3))


def _finite(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, np.float32)
    return np.where(np.isfinite(values), values, 0.0)


def _covered(layers: Mapping[str, np.ndarray], normal: np.ndarray) -> np.ndarray:
    if "triangle_id" in layers:
        return layers["triangle_id"] > 0
    if "depth" in layers:
        depth = layers["depth"]
        return np.isfinite(depth) & (depth > 0.0) & (depth < FAR_AWAY)
    return np.any(normal != 0.0, axis=-1, keepdims=True)


def _ids(layers: Mapping[str, np.ndarray], name: str, some: np.ndarray):
    ids = _finite(layers[name]) - 1 if name in layers else np.zeros(some.shape)
    return jnp.asarray(np.where(some, np.maximum(ids, 0), -1).astype(np.int32))
