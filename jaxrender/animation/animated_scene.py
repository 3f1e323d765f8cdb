"""A scene that moves: skinned characters, rigid parts, lights and cameras on one skeleton -> a `Scene` at any time.

The poses of a scene share faces, materials and images, so that what was built for one serves the others
(`pathtrace.move`). On the host but for the kernels of `skeleton` and `skinning`; not for use inside `jit`.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.animation.skeleton import Clip, Pose, Skeleton, global_matrices, sample_clip
from jaxrender.animation.skinning import Skin, SkinnedMesh, skin_mesh
from jaxrender.camera import Camera
from jaxrender.checks import bad_input
from jaxrender.scene import DIRECTIONAL, POINT, Lights, Scene, scene_bounds

#: Most poses that `AnimatedScene.bounds` looks at.
_MOST_POSES = 64


@dataclass(frozen=True, eq=False)
class AnimatedScene:
    """A scene, and how it hangs on a skeleton.

    Attributes:
      rest: the scene where no clip plays. Vertices past those of the skin stay as they are here.
      skin: of the first vertices, each part in the space of its mesh; rigid parts have one entry and weight 1.
      tangents: of the same, in the same space.
      light_joints, camera_joints: the joint that carries each light and each camera of `rest`.
    """

    rest: Scene
    skeleton: Skeleton
    skin: Skin
    tangents: Float[Array, "v 3"]
    light_joints: tuple[int, ...] = ()
    camera_joints: tuple[int, ...] = ()
    clips: tuple[Clip, ...] = ()

    def clip(self, wanted: str | int) -> Clip:
        """A clip by its name, or by its place in `clips`, also as text.

        Raises:
          InputError: if there is none such; it lists those there are.
        """
        for clip in self.clips:
            if clip.name == wanted:
                return clip
        place = int(wanted) if str(wanted).isdecimal() else -1
        if 0 <= place < len(self.clips):
            return self.clips[place]
        names = ", ".join(clip.name for clip in self.clips)
        expected = f"one of {names}, or 0 to {len(self.clips) - 1}" if names else "none, as nothing moves in this file"
        return bad_input(self.rest.name, "clip", expected=expected, got=wanted)

    def at(self, clip: str | int | Clip, seconds: float) -> Scene:
        """The scene as it is so long after a clip's beginning; a clip that has ended begins again.

        Parts that the clip does not move are as at rest, up to rounding. Faces that the pose at rest mirrors were
        turned round; a clip that mirrors others shows their backs.

        Args:
          seconds: >= 0.
        Raises:
          InputError: if there is no such clip. ValueError: if `seconds` is below 0 or not finite.
        """
        clip = clip if isinstance(clip, Clip) else self.clip(clip)
        pose = self._pose(clip, seconds)
        mesh, joints = _posed(self.skin, self.tangents, pose, parents=self.skeleton.parents)
        frames, rest = np.asarray(mesh.frames), self.rest
        count, matrices = len(frames), np.asarray(joints)
        positions, normals, tangents = (np.array(x) for x in (rest.positions, rest.normals, rest.tangents))
        positions[:count], normals[:count], tangents[:count, :3] = mesh.positions, frames[..., 2], frames[..., 0]
        return replace(
            rest, positions=jnp.asarray(positions), normals=jnp.asarray(normals), tangents=jnp.asarray(tangents),
            lights=_lights_at(rest.lights, matrices[list(self.light_joints)]),
            cameras=tuple(
                _camera_at(camera, matrices[joint])
                for camera, joint in zip(rest.cameras, self.camera_joints, strict=True)
            ),
        )  # fmt: skip

    def bounds(self, clip: str | int | Clip, times: Sequence[float]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """The box around all poses at `times`, of which at most 64 evenly chosen ones are looked at."""
        chosen = np.unique(np.linspace(0, len(times) - 1, min(len(times), _MOST_POSES)).round().astype(int))
        boxes = [scene_bounds(self.at(clip, times[k])) for k in chosen]
        low, high = (jnp.stack(corners) for corners in zip(*boxes, strict=True))
        return jnp.min(low, axis=0), jnp.max(high, axis=0)

    def _pose(self, clip: Clip, seconds: float) -> Pose:
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f"seconds: expected a finite number >= 0, got {seconds}")
        if seconds > clip.duration:
            seconds = math.fmod(seconds, clip.duration) if clip.duration > 0.0 else 0.0
        time = jnp.asarray([clip.start + seconds], jnp.float32)
        return jax.tree.map(lambda x: x[0], sample_clip(clip, self.skeleton, time))


def camera_at(eye: np.ndarray, up: np.ndarray, backward: np.ndarray, fov_y_radians: float) -> Camera:
    """The camera of unit axes `up` and `backward`."""
    # The target is a unit away, or as far as the origin: nearer, float32 would turn the view.
    target = eye - max(1.0, float(np.abs(eye).max())) * backward
    return Camera(*(jnp.asarray(x, jnp.float32) for x in (eye, target, up, fov_y_radians)))


@functools.partial(jax.jit, static_argnames="parents")
def _posed(
    skin: Skin, tangents: Float[Array, "v 3"], pose: Pose, *, parents: tuple[int, ...]
) -> tuple[SkinnedMesh, Float[Array, "j 4 4"]]:
    joints = global_matrices(pose, parents=parents)
    return skin_mesh(skin, joints, tangents=tangents), joints


def _axes(matrix: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Origin, and unit axes x, y, z, of a joint."""
    axes = matrix[:3, :3].astype(np.float64)
    length = np.linalg.norm(axes, axis=0)
    x, y, z = (axes / np.where(length > 0.0, length, 1.0)).T
    return matrix[:3, 3].astype(np.float64), x, y, z


def _camera_at(camera: Camera, matrix: Float[np.ndarray, "4 4"]) -> Camera:
    """A camera carried by a joint: it looks along -z."""
    eye, _, up, backward = _axes(matrix)
    return camera_at(eye, up, backward, float(camera.fov_y_radians))


def _lights_at(lights: Lights, matrices: Float[np.ndarray, "n 4 4"]) -> Lights:
    """Lights carried by joints: they shine along -z."""
    if not len(matrices):
        return lights
    position, direction = np.array(lights.position), np.array(lights.direction)
    kinds = np.asarray(lights.kind)
    for k, matrix in enumerate(matrices):
        origin, _, _, backward = _axes(matrix)
        position[k] = position[k] if kinds[k] == DIRECTIONAL else origin
        direction[k] = direction[k] if kinds[k] == POINT else -backward
    return replace(lights, position=jnp.asarray(position), direction=jnp.asarray(direction))
