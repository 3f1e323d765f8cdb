"""A trained character as one jitted function, and the ray-traced truth beside it."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from fitting.dataset import ShadingPoints, choose_points
from jaxrender.animation.skeleton import Pose, global_matrices
from jaxrender.animation.skinning import Character, Skin, SkinnedMesh, skin_mesh
from jaxrender.checks import check_one_of
from jaxrender.harmonics.pose_model import PoseModel, predict_lobes, project_features, raw_features
from jaxrender.harmonics.relight import membrane, relight, relight_diffuse, shade_transfer
from jaxrender.harmonics.sh import basis_columns
from jaxrender.harmonics.visibility import hemisphere_directions, trace_visibility
from jaxrender.vecmath import normalize

MATERIALS = ("phong", "diffuse", "membrane")


def make_shader(character: Character, model: PoseModel, *, material: str = "phong") -> Callable:
    """The whole run-time path: pose -> skinned mesh and lobes -> vertex colors.

    Args:
      material: "phong", "diffuse" or "membrane".
    Returns:
      a jitted function (pose, *, eye, light, exponent, albedo, transmission) -> positions (v, 3), colors (v, 3). `pose`
      is one pose; `eye` (3,) in world space; `light` (3, 16); `exponent` a scalar or one per vertex (Phong only);
      `albedo` (v, 3), by default the character's; `transmission` (3,), for the membrane only. Differentiable in all of
      them. Points that see next to nothing in all training poses are given no visibility at all.
    """
    check_one_of("material", material, MATERIALS)

    def shade(pose: Pose, *, eye, light, exponent=1.0, albedo=None, transmission=(0.0, 0.0, 0.0)):
        albedo = character.albedo if albedo is None else albedo
        rest = (jnp.asarray(x, jnp.float32) for x in (eye, light, exponent, albedo, transmission))
        return _shade(character.skin, model, pose, *rest, parents=character.skeleton.parents, material=material)

    return shade


# Skin and model are arguments, not constants of the program: one compilation serves every model of a shape.
@functools.partial(jax.jit, static_argnames=("parents", "material"))
def _shade(skin: Skin, model: PoseModel, pose: Pose, eye, light, exponent, albedo, transmission, *, parents, material):
    globals = global_matrices(pose, parents=parents)
    mesh = skin_mesh(skin, globals)
    lobes = predict_lobes(model, project_features(model.features, raw_features(model.features, pose, globals)))
    # Every vertex has the lobes of its point, but a frame and place of its own: shading stays smooth where one
    # point stands for several vertices.
    axes, coefficients = (numbers[model.points] for numbers in lobes)
    # What is never seen has no trained lobes.
    seen = model.visible[model.points]
    coefficients = jnp.where(seen[:, None, None], coefficients, jnp.zeros_like(coefficients))
    offset = jnp.where(seen[:, None], model.offset[model.points], jnp.zeros((), model.offset.dtype))
    if material == "phong":
        colors = relight(axes, coefficients, mesh.frames, mesh.positions, light, exponent, albedo, eye, offset=offset)
    elif material == "diffuse":
        colors = relight_diffuse(axes, coefficients, mesh.frames, light, albedo, offset=offset)
    else:
        colors = membrane(axes, coefficients, mesh.frames, light, albedo, transmission, offset=offset)
    return mesh.positions, colors


def posed_mesh(character: Character, pose: Pose) -> SkinnedMesh:
    """The skinned mesh of one pose, as NumPy arrays."""
    return jax.tree.map(np.asarray, _posed(character.skin, pose, character.skeleton.parents))


@functools.partial(jax.jit, static_argnums=2)
def _posed(skin, pose, parents):
    return skin_mesh(skin, global_matrices(pose, parents=parents))


def traced_visibility(
    character: Character, mesh: SkinnedMesh, *, num_directions: int = 1024
) -> tuple[ShadingPoints, UInt8[np.ndarray, "p bytes"]]:
    """Visibility by rays of a posed mesh: vertices that move alike share a point, and each point's bits."""
    points = choose_points(character, 0)
    directions = hemisphere_directions(num_directions)
    positions, frames, faces = (np.asarray(x) for x in (mesh.positions, mesh.frames, character.faces))
    return points, trace_visibility(positions, frames, faces, directions, points=points.vertices)


def truth_colors(
    mesh: SkinnedMesh,
    points: ShadingPoints,
    bits: UInt8[np.ndarray, "p bytes"],
    *,
    material: str,
    eye: Float[Array, "3"],
    light: Float[Array, "3 16"],
    albedo: Float[Array, "v 3"],
    exponent: float = 1.0,
    transmission: tuple[float, float, float] = (0.0, 0.0, 0.0),
    num_directions: int = 1024,
) -> Float[np.ndarray, "v 3"]:
    """Vertex colors by quadrature over traced visibility, under the same light: Σ_s V(s) f(s) L(s) 2π / d.

    Neither visibility nor reflection is cut to four bands here. The light is the model's own, of order 4: what differs
    is the model's error alone. The directions cover the hemisphere of the normal, as visibility does.

    Args:
      points, bits: from `traced_visibility` with the same number of directions, or `open_sky`.
    """
    check_one_of("material", material, MATERIALS)
    at, frames = mesh.positions[points.vertices], jnp.asarray(mesh.frames[points.vertices])
    local = hemisphere_directions(num_directions).astype(np.float32)
    # Σ V f y 2π/d first, in the frame of the point: it is dotted with the light at the end, and can be of low order
    # because the light is.
    basis = np.stack(basis_columns(*local.T, order=4), axis=-1) * np.float32(2 * math.pi / num_directions)
    if material == "phong":
        transfer = _phong_transfer(bits, at, np.asarray(frames), np.asarray(eye, np.float32), exponent, local, basis)
    else:
        transfer = _weighted_sum(bits, local[:, 2] / np.float32(math.pi), basis)
    white = jnp.ones((len(at), 3), jnp.float32)
    light = jnp.asarray(light, jnp.float32)
    colors = shade_transfer(jnp.asarray(transfer), frames, light, white)
    if material == "membrane":
        # Through the back comes the cosine lobe of the other hemisphere, unshadowed.
        mirrored = np.stack(basis_columns(*-local.T, order=4), axis=-1) * np.float32(2 * math.pi / num_directions)
        through = jnp.asarray(np.broadcast_to(local[:, 2] / np.float32(math.pi) @ mirrored, transfer.shape))
        tau = jnp.broadcast_to(jnp.asarray(transmission, jnp.float32), white.shape)
        colors = colors + shade_transfer(through, frames, light, tau)
    return np.asarray(colors)[points.of_vertex] * np.asarray(albedo)


def open_sky(points: ShadingPoints, *, num_directions: int = 1024) -> UInt8[np.ndarray, "p bytes"]:
    """The bits of points that nothing shadows: the whole hemisphere of the normal."""
    row = np.packbits(np.ones(num_directions, np.uint8))
    return np.broadcast_to(row, (len(points.vertices), len(row)))


_CHUNK = 1024  # points at a time: 4 MB of float32 at 1,024 directions


def _weighted_sum(bits, weights, basis):
    """Σ_d V_d w_d y_d for each point."""
    return np.concatenate([_unpacked(own, len(basis)) @ (basis * weights[:, None]) for own in _chunks(bits)])


def _phong_transfer(bits, at, frames, eye, exponent, local, basis):
    """Σ_d V_d (α+1)/2π max(0, s_d·r)^α y_d, r the eye's direction mirrored at the normal of the point."""
    wo = np.asarray(normalize(jnp.asarray(eye - at)))
    # In the frame of a point the normal is z.
    mirrored = np.einsum("pij,pi->pj", frames, wo) * np.array([-1.0, -1.0, 1.0], np.float32)
    sums = []
    for own, r in zip(_chunks(bits), _chunks(mirrored), strict=True):
        cosine = r @ local.T
        kernel = np.where(cosine > 0, np.maximum(cosine, 0.0) ** np.float32(exponent), np.float32(0.0))
        sums.append((_unpacked(own, len(local)) * kernel) @ basis)
    return np.concatenate(sums) * np.float32((exponent + 1.0) / (2 * math.pi))


def _chunks(rows):
    return [rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK)]


def _unpacked(bits, num_directions):
    return np.unpackbits(bits, axis=-1, count=num_directions).astype(np.float32)
