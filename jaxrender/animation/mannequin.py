"""A body for any skeleton: spread limbs -> parts -> one implicit surface -> mesh -> weights.

NumPy float64 inside, float32 records out; metres.
"""

import hashlib
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float, Int

from jaxrender.animation.anatomy import find_landmarks, recognize
from jaxrender.animation.bind_pose import joint_hops, rest_matrices, spread_limbs
from jaxrender.animation.body_parts import tree_parts
from jaxrender.animation.body_surface import Body, assemble, grid_step, mesh_body, part_distances
from jaxrender.animation.builtin_clips import builtin_clips, builtin_skeleton
from jaxrender.animation.human_parts import human_parts
from jaxrender.animation.skeleton import Clip, Skeleton
from jaxrender.animation.skinning import Character, Skin
from jaxrender.checks import check_at_least

ALBEDO = 0.6
"""Linear reflectance of a mannequin."""


def grow_mannequin(
    skeleton: Skeleton, *, num_vertices: int = 5000, max_influences: int = 4
) -> tuple[Skin, Int[Array, "t 3"]]:
    """A closed, smooth, skinned surface around a skeleton, and its triangles.

    A skeleton with the joint names of a human (or an animal named like one) gets a body with torso, head,
    hands and feet; any other one a tapered round limb along each bone, or a ball if it has no bone. The
    surface is grown and bound in a pose with the limbs spread (`spread_limbs`), so `skin.vertices` need not
    be the surface at rest. It is watertight and, around one tree, in one piece; limbs that cannot be spread
    apart melt into each other. Parts thinner than the triangles are made as thick: the fingers of a skeleton
    that has them are a mitten below some 40,000 vertices, and webbed above where they lie close.

    Args:
      num_vertices: at least 500; what comes is within 10 % of it.
      max_influences: joints that move one vertex.
    Raises:
      ValueError: if num_vertices or max_influences is too small, or the skeleton is empty or not finite.
    """
    check_at_least("num_vertices", num_vertices, 500)
    check_at_least("max_influences", max_influences, 1)
    check_at_least("skeleton: number of joints", len(skeleton.parents), 1)
    parents = skeleton.parents
    rest = rest_matrices(skeleton)
    if not np.isfinite(rest).all():
        raise ValueError("skeleton: expected a finite rest pose, got NaN or Inf")
    roles = recognize(skeleton.names, parents)
    landmarks = find_landmarks(parents, roles)

    # A coarse grid makes limbs thick and joins those with a small gap: they must be further apart.
    hops = joint_hops(rest[:, :3, 3], parents)
    step = grid_step(assemble(tree_parts(rest[:, :3, 3], parents), hops), num_vertices)
    bind = spread_limbs(rest, parents, landmarks, step=step)
    positions = bind[:, :3, 3]
    parts = human_parts(positions, parents, roles, landmarks) if landmarks is not None else None
    body = assemble(parts or tree_parts(positions, parents), hops)
    vertices, faces, body = mesh_body(body, num_vertices=num_vertices)
    joints, weights = bone_weights(body, vertices, faces, hops)
    columns, weights = strongest(weights, max_influences)
    skin = Skin(
        vertices=_float32(vertices),
        normals=_float32(vertex_normals(vertices, faces)),
        joint_indices=jnp.asarray(columns, dtype=jnp.int32),
        weights=_float32(weights),
        palette_joints=jnp.asarray(joints, dtype=jnp.int32),
        inverse_binds=_float32(np.linalg.inv(bind[joints])),
    )
    return skin, jnp.asarray(faces, dtype=jnp.int32)


def mannequin_character(
    name: str,
    skeleton: Skeleton,
    clips: Sequence[Clip],
    *,
    num_vertices: int = 5000,
    content_hash: str | None = None,
    unit_scale: float = 1.0,
    notes: Sequence[str] = (),
) -> Character:
    """A grey mannequin with the motions of `clips`.

    Args:
      content_hash: of the bytes the skeleton was read from; None for that of the arrays themselves.
      unit_scale: metres per unit of the file the skeleton was read from; only passed on.
    """
    skin, faces = grow_mannequin(skeleton, num_vertices=num_vertices)
    return Character(
        name=name,
        skeleton=skeleton,
        skin=skin,
        faces=faces,
        clips=tuple(clips),
        albedo=jnp.full((skin.vertices.shape[0], 3), ALBEDO, dtype=jnp.float32),
        content_hash=_hash(skeleton, clips) if content_hash is None else content_hash,
        unit_scale=unit_scale,
        notes=tuple(notes),
    )


def builtin_character(*, num_vertices: int = 5000) -> Character:
    """The built-in human with the clips "walk", "turn" and "reach" (`builtin_clips`)."""
    return mannequin_character("mannequin", builtin_skeleton(), builtin_clips(), num_vertices=num_vertices)


def bone_weights(
    body: Body,
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "t 3"],
    hops: Int[np.ndarray, "j j"],
) -> tuple[Int[np.ndarray, " p"], Float[np.ndarray, "v p"]]:
    """Joints that move some part, and their shares of every vertex, which sum to 1.

    Each vertex first belongs to the parts nearest to it, then the shares spread over the surface as heat
    does, over half the thickness of the limb and one edge at least. Heat does not jump from a hand to the
    thigh beside it; and joints more than two bones from that of the nearest part get nothing.

    References:
      Baran and Popović, "Automatic Rigging and Animation of 3D Characters", SIGGRAPH 2007, section 4, for
      weights as a heat equilibrium; here the spread is a set length.
    """
    joints, column = np.unique(body.joints, return_inverse=True)
    chunks = np.array_split(vertices, -(-len(vertices) * len(body.joints) // 15000))
    distance = np.concatenate([part_distances(body, chunk)[0] for chunk in chunks])
    nearest = np.argmin(distance, axis=1)
    thickness = body.radius.mean(axis=1)[nearest]
    gap = np.full((len(joints), len(vertices)), np.inf)
    np.minimum.at(gap, column, distance.T)
    gap = gap.T - distance[np.arange(len(vertices)), nearest][:, None]
    bones_away = hops[np.ix_(body.joints[nearest], joints)]
    shares = np.where(bones_away <= 1, np.exp(-gap / (0.1 * thickness[:, None])), 0.0)
    shares /= shares.sum(axis=1, keepdims=True)
    shares = np.where(bones_away <= 2, np.maximum(_spread_heat(shares, vertices, faces, 0.5 * thickness), 0.0), 0.0)
    return joints, shares / shares.sum(axis=1, keepdims=True)


def _spread_heat(values: np.ndarray, vertices: np.ndarray, faces: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Solves (1 - w² Δ) u = values on the surface: a step spreads as exp(-x / w) to both sides.

    w is `width`, and no less than the mean edge.
    """
    pairs = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    i, j = pairs.T
    size = len(vertices)
    # On triangles of like size the mean of the neighbours, less the vertex, is edge² / 4 times Δ.
    edge2 = np.mean(np.sum((vertices[i] - vertices[j]) ** 2, axis=1))
    flow = 4.0 * np.maximum((0.5 * (width[i] + width[j])) ** 2 / edge2, 1.0)
    flows = scipy.sparse.coo_matrix((flow, (i, j)), shape=(size, size))
    flows = flows + flows.T
    degree = np.bincount(pairs.ravel(), minlength=size).astype(np.float64)
    system = scipy.sparse.diags(degree + np.asarray(flows.sum(axis=1)).ravel()) - flows
    return scipy.sparse.linalg.splu(system.tocsc()).solve(degree[:, None] * values)


def strongest(weights: Float[np.ndarray, "v p"], count: int) -> tuple[Int[np.ndarray, "v k"], Float[np.ndarray, "v k"]]:
    """Columns and values of the largest weights of every row, which sum to 1 again.

    The first weight that is left out is taken off those that stay, so that they fade in and out over the
    surface and do not jump where the choice changes.
    """
    count = min(count, weights.shape[1])
    order = np.argsort(-weights, axis=1, kind="stable")
    values = np.take_along_axis(weights, order[:, : count + 1], axis=1)
    values = values[:, :count] - (values[:, count:] if weights.shape[1] > count else 0.0)
    total = values.sum(axis=1, keepdims=True)
    values[total[:, 0] == 0] = np.eye(count)[0]
    return order[:, :count], values / values.sum(axis=1, keepdims=True)


def vertex_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "v 3"]:
    """Unit normals, the mean of those of the faces around weighted by area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    face_normals = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(face_normals[:, axis], 3), len(vertices)) for axis in range(3)],
        axis=-1,
    )
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def _hash(skeleton: Skeleton, clips: Sequence[Clip]) -> str:
    digest = hashlib.sha256(repr((skeleton.names, skeleton.parents)).encode())
    rest = skeleton.rest
    for array in (
        rest.translation,
        rest.rotation,
        rest.scale,
        *(a for clip in clips for channel in clip.channels for a in (channel.times, channel.values)),
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _float32(x: np.ndarray) -> Float[Array, "..."]:
    return jnp.asarray(x, dtype=jnp.float32)
