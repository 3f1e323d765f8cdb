"""Recovers the pose, the light and the texture of an object from one picture, by gradients through the renderer.

    python docs/examples/inverse_rendering.py [folder for the pictures]

What is known is the shape, a lumpy egg, and the camera. What is not: how the egg is turned, where the light comes from
and how strong it is, and what is painted on it. Coverage has no gradient, so the egg is rasterised anew for each pose;
between two rasterisations barycentrics, interpolation, texture and shading are differentiable. All
unknowns are refined together, by Levenberg-Marquardt: in turns, the texture would slide after the pose.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jax.scipy.spatial.transform import Rotation

from jaxrender.brdf import lambert
from jaxrender.camera import Camera, clip_from_world
from jaxrender.deferred import Fragments, blend, build_textures, differentiable_barycentrics, rasterize, sample_bilinear
from jaxrender.io import write_png
from jaxrender.scene import vertex_normals
from jaxrender.vecmath import dot, matmul, normalize

HEIGHT, WIDTH, TEXELS = 64, 64, 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Unknown:
    """What is to be found. The light's length is its irradiance; `ambient` comes from all around."""

    rotation: jax.Array  # rotation vector (3,), radians
    light: jax.Array  # (3,), towards the light
    ambient: jax.Array  # ()
    texture: jax.Array  # (n, n, 3), linear


def egg(rows: int = 24, columns: int = 48):
    """Positions, uv and faces of a sphere with lumps, longer than wide."""
    v, u = np.meshgrid(np.linspace(0.0, 1.0, rows + 1), np.linspace(0.0, 1.0, columns + 1), indexing="ij")
    theta, phi = math.pi * v, 2.0 * math.pi * (u - 0.5)
    radius = 1.0 + 0.12 * np.sin(3.0 * phi) * np.sin(theta) ** 3 + 0.1 * np.cos(2.0 * theta + phi) * np.sin(theta)
    positions = radius[..., None] * np.stack(
        [np.sin(theta) * np.sin(phi), 1.3 * np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1
    )
    corner = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = (x.reshape(-1) for x in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return (
        jnp.asarray(positions.reshape(-1, 3), jnp.float32),
        jnp.asarray(np.stack([u, v], axis=-1).reshape(-1, 2), jnp.float32),
        jnp.asarray(faces, jnp.int32),
    )


POSITIONS, UV, FACES = egg()
NORMALS = vertex_normals(POSITIONS, FACES)
CAMERA = Camera(
    jnp.asarray([0.0, 0.6, 4.2]), jnp.zeros(3), jnp.asarray([0.0, 1.0, 0.0]), jnp.asarray(math.radians(40.0))
)
CLIP_FROM_WORLD = clip_from_world(CAMERA, height=HEIGHT, width=WIDTH, near=1.0, far=10.0)


def clip_positions(unknown: Unknown) -> jax.Array:
    turned = matmul(POSITIONS, Rotation.from_rotvec(unknown.rotation).as_matrix().T)
    return matmul(jnp.pad(turned, ((0, 0), (0, 1)), constant_values=1.0), CLIP_FROM_WORLD.T)


def draw(unknown: Unknown, fragments: Fragments) -> jax.Array:
    """The picture (h, w, 3), for triangles that are where `fragments` saw them."""
    weights = differentiable_barycentrics(fragments, clip_positions(unknown))
    normals = matmul(NORMALS, Rotation.from_rotvec(unknown.rotation).as_matrix().T)
    n, uv = normalize(blend(fragments, normals, weights)), blend(fragments, UV, weights)
    albedo = sample_bilinear(build_textures([unknown.texture], wrap="clamp"), 0, uv, level=0)[..., :3]
    irradiance = jnp.maximum(dot(n, jnp.broadcast_to(unknown.light, n.shape)), 0.0) + unknown.ambient
    return jnp.where(fragments.coverage[..., None], lambert(albedo) * irradiance, 0.0)[:, :, 0]


def see(unknown: Unknown) -> Fragments:
    return rasterize(clip_positions(unknown), FACES, height=HEIGHT, width=WIDTH, cull="back")


@jax.jit
def refine(unknown: Unknown, fragments: Fragments, target, seen, prior, weight) -> Unknown:
    """A few steps of Levenberg-Marquardt over all unknowns at once.

    Pixels count where both pictures show the egg; texels that no pixel shows stay with the prior.
    """

    def residuals(guess: Unknown, _):
        image = jnp.where(seen[..., None], draw(guess, fragments) - target, 0.0)
        return image, weight * (guess.texture - prior)

    # LSMR needs products with J and its transpose alone, no dense matrix, and keeps its footing in float32.
    linear = lineax.LSMR(rtol=1e-5, atol=1e-5, max_steps=500)
    solver = optimistix.LevenbergMarquardt(rtol=1e-4, atol=1e-5, linear_solver=linear)
    return optimistix.least_squares(residuals, solver, unknown, max_steps=3, throw=False).value


def recover(target: jax.Array, covered: jax.Array, start: Unknown, *, rounds: int = 12) -> Unknown:
    """Rasterises and refines in turns, while the prior of the texture fades."""
    unknown = start
    for k in range(rounds):
        fragments = see(unknown)
        seen = covered & fragments.coverage[:, :, 0]
        unknown = refine(unknown, fragments, target, seen, start.texture, jnp.float32(0.5 * 0.45**k))
    return unknown


def painted(size: int = TEXELS) -> jax.Array:
    """Stripes and spots in three colors, (size, size, 3) in [0.1, 0.9]."""
    v, u = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size, indexing="ij")
    waves = [
        np.sin(2 * np.pi * (2 * u + v)),
        np.cos(2 * np.pi * (u - 2 * v)),
        np.sin(2 * np.pi * 3 * u) * np.cos(6 * v),
    ]
    return jnp.asarray(0.5 + 0.4 * np.stack(waves, axis=-1), jnp.float32)


def degrees_between(a: jax.Array, b: jax.Array) -> float:
    """The angle of the turn from one rotation vector to the other."""
    turn = Rotation.from_rotvec(a) * Rotation.from_rotvec(b).inv()
    return math.degrees(float(turn.magnitude()))


def main(folder: Path) -> dict[str, float]:
    truth = Unknown(jnp.asarray([0.25, 0.6, -0.1]), jnp.asarray([1.6, 1.8, 1.4]), jnp.asarray(0.5), painted())
    fragments = see(truth)
    target, covered = draw(truth, fragments), fragments.coverage[:, :, 0]
    # The start: turned by 7 degrees, a light from the camera, and a faded, blurred idea of the paint.
    blurred = 0.25 * (jnp.roll(truth.texture, 1, axis=1) + 2.0 * truth.texture + jnp.roll(truth.texture, -1, axis=1))
    start = Unknown(
        jnp.asarray([0.18, 0.5, -0.06]), jnp.asarray([0.0, 0.5, 2.0]), jnp.asarray(0.8), 0.5 + 0.6 * (blurred - 0.5)
    )
    found = recover(target, covered, start)
    pictures = [draw(start, see(start)), draw(found, see(found)), target]
    write_png(folder / "inverse_rendering.png", np.concatenate([np.asarray(p) for p in pictures], axis=1))
    rms = lambda a, b: float(jnp.sqrt(jnp.mean((a - b) ** 2)))  # noqa: E731
    result = {
        "pose before, degrees": degrees_between(start.rotation, truth.rotation),
        "pose after, degrees": degrees_between(found.rotation, truth.rotation),
        "light before, relative": float(jnp.linalg.norm(start.light - truth.light) / jnp.linalg.norm(truth.light)),
        "light after, relative": float(jnp.linalg.norm(found.light - truth.light) / jnp.linalg.norm(truth.light)),
        "picture before, rms": rms(pictures[0], target),
        "picture after, rms": rms(pictures[1], target),
        # The picture shows the middle half of the texture.
        "texture before, rms": rms(start.texture[4:12, 5:11], truth.texture[4:12, 5:11]),
        "texture after, rms": rms(found.texture[4:12, 5:11], truth.texture[4:12, 5:11]),
    }
    for name, value in result.items():
        print(f"{name:24s} {value:.4f}")
    return result


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
