"""A trained character as one jitted function, and the ray-traced truth beside it."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.animation.skeleton import Pose, global_matrices
from jaxrender.animation.skinning import Character, SkinnedMesh, skin_mesh
from jaxrender.checks import check_one_of
from jaxrender.harmonics.pose_model import PoseModel, predict_lobes, project_features, raw_features
from jaxrender.harmonics.relight import membrane, relight, relight_diffuse
from jaxrender.harmonics.sh import sh_basis
from jaxrender.harmonics.visibility import hemisphere_directions, trace_visibility, unpack_visibility

MATERIALS = ("phong", "diffuse", "membrane")


def make_shader(character: Character, model: PoseModel, *, material: str = "phong") -> Callable:
    """The whole run-time path: pose -> skinned mesh and lobes -> vertex colors.

    Returns:
      a jitted function (pose, *, eye, light, exponent, albedo, transmission) -> positions (v, 3), colors (v, 3). `pose`
      is one pose; `eye` (3,) in world space; `light` (3, 16); `exponent` a scalar or one per vertex; `albedo`
      (v, 3); `transmission` (3,), for the membrane. Differentiable in all of them. Points that see nothing are black.
    """
    check_one_of("material", material, MATERIALS)

    @jax.jit
    def shade(pose: Pose, *, eye, light, exponent=1.0, albedo=None, transmission=(0.0, 0.0, 0.0)):
        globals = global_matrices(pose, parents=character.skeleton.parents)
        mesh = skin_mesh(character.skin, globals)
        lobes = predict_lobes(model, project_features(model.features, raw_features(model.features, pose, globals)))
        eye, light, transmission = (jnp.asarray(x, jnp.float32) for x in (eye, light, transmission))
        # Every vertex has the lobes of its point, but a frame and place of its own: shading stays smooth where one
        # point stands for several vertices.
        axes, coefficients = (numbers[model.points] for numbers in lobes)
        offset, at, frames = model.offset[model.points], mesh.positions, mesh.frames
        white = jnp.ones_like(at)
        if material == "phong":
            exponents = jnp.asarray(exponent, jnp.float32)
            colors = relight(axes, coefficients, frames, at, light, exponents, white, eye, offset=offset)
        elif material == "diffuse":
            colors = relight_diffuse(axes, coefficients, frames, light, white, offset=offset)
        else:
            colors = membrane(axes, coefficients, frames, light, white, transmission, offset=offset)
        colors = jnp.where(model.visible[model.points][:, None], colors, jnp.zeros_like(colors))
        return mesh.positions, colors * jnp.asarray(character.albedo if albedo is None else albedo, jnp.float32)

    return shade


def posed_mesh(character: Character, pose: Pose) -> SkinnedMesh:
    """The skinned mesh of one pose, as NumPy arrays."""
    return jax.tree.map(np.asarray, _posed(character.skin, pose, character.skeleton.parents))


@functools.partial(jax.jit, static_argnums=2)
def _posed(skin, pose, parents):
    return skin_mesh(skin, global_matrices(pose, parents=parents))


def traced_colors(
    character: Character,
    model: PoseModel,
    mesh: SkinnedMesh,
    *,
    material: str,
    eye: Float[Array, "3"],
    light: Float[Array, "3 16"],
    exponent: float = 1.0,
    transmission=(0.0, 0.0, 0.0),
    num_directions: int = 1024,
    shadows: bool = True,
) -> Float[np.ndarray, "v 3"]:
    """Vertex colors with traced visibility under the same order-4 light: Σ_s V(s) f(s) L(s) 2π / d.

    Neither visibility nor reflection is cut to four bands here; the light is the model's, so what differs is the
    model's error. With `shadows` off the visibility is the whole hemisphere of the normal.
    """
    local = hemisphere_directions(num_directions)
    positions, frames = np.asarray(mesh.positions), np.asarray(mesh.frames)
    points = np.arange(len(positions))
    if shadows:
        bits = trace_visibility(positions, frames, np.asarray(character.faces), local, points=points)
    else:
        bits = np.full((len(points), num_directions // 8), 255, np.uint8)
    tau = jnp.asarray(transmission, jnp.float32)
    colors = np.zeros((len(points), 3), np.float32)
    for start in range(0, len(points), 512):
        own = slice(start, start + 512)
        colors[own] = _integrate(
            bits[own], positions[own], frames[own], jnp.asarray(light), jnp.asarray(eye, jnp.float32),
            jnp.float32(exponent), tau,
            jnp.asarray(local, jnp.float32), material,
        )  # fmt: skip
    colors[~np.asarray(model.visible)[np.asarray(model.points)]] = 0.0
    return colors * np.asarray(character.albedo)


@functools.partial(jax.jit, static_argnames="material")
def _integrate(bits, positions, frames, light, eye, exponent, tau, local, material):
    """One chunk of points; see `traced_colors`."""
    directions = jnp.einsum("pij,dj->pdi", frames, local)
    visibility = unpack_visibility(bits, num_directions=len(local))
    radiance = sh_basis(directions, order=4) @ light.T
    solid = 2 * math.pi / len(local)
    if material == "phong":
        wo = eye - positions
        wo = wo / jnp.linalg.norm(wo, axis=-1, keepdims=True)
        n = frames[..., 2]
        mirrored = 2.0 * jnp.sum(n * wo, axis=-1, keepdims=True) * n - wo
        cosine = jnp.maximum(jnp.einsum("pdi,pi->pd", directions, mirrored), 0.0)
        kernel = (exponent + 1.0) / (2 * math.pi) * cosine**exponent
        return jnp.einsum("pd,pd,pdc->pc", visibility, kernel, radiance) * solid
    cosine = local[:, 2] / math.pi
    front = jnp.einsum("pd,d,pdc->pc", visibility, cosine, radiance) * solid
    if material == "diffuse":
        return front
    behind = sh_basis(-directions, order=4) @ light.T
    return front + tau * jnp.einsum("d,pdc->pc", cosine, behind) * solid
