"""Windows of a G-buffer -> sub-samples that look alike, one of which is shaded for all of them.

Pointwise over windows, as in `sampling`. Not differentiable.

The mean of K samples by a fixed order is a poor estimate where a window holds several surfaces: one of them may get
too many of the K. Here the first sample is the one of the index matrix, each next one the sub-sample that is most
unlike all those taken, until none is more unlike than 1; every sub-sample then belongs to the taken one it is most
like, and a sample counts as much as belongs to it.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_same_shape
from jaxrender.deferred.sampling import first_sample, sample_positions, window_size

Vector = tuple[Array, ...]


@dataclass(frozen=True)
class Clusters:
    """How unlike two sub-samples are: the root of the sum of the squares of all of the following.

    What is more unlike than 1 makes a new cluster, and so does another material.

    Attributes:
      normal: times the distance of unit normals.
      plane: times the smaller of the distances of either from the tangent plane of the other, as a share of the depth
        of the one that is taken.
      contrast: times the step of the first shading from pixel to pixel (display-encoded luma), times the distance in
        pixels along the step. 0 leaves the first shading out.
      detail: times what the material varies within the pixel (`material_detail`), times luma, times the distance in
        pixels.
      scale: multiplies them all; the dial.
    """

    normal: float = 9.0
    plane: float = 2400.0
    contrast: float = 7.5
    detail: float = 34.0
    scale: float = 1.0


def cluster_samples(
    normal: Float[Array, "*b n 3"],
    position: Float[Array, "*b n 3"],
    depth: Float[Array, "*b n"],
    material_id: Int[Array, "*b n"],
    covered: Bool[Array, "*b n"],
    slope: Float[Array, "*b 2"],
    *,
    normal_scale: float | Float[Array, ""],
    plane_scale: float | Float[Array, ""],
) -> Int[Array, "*b n"]:
    """For each sub-sample the one that stands for it; -1 where empty.

    Args:
      normal: unit; position: in the world; depth: linear.
      slope: what the shading changes by per pixel in x and y, in units of the tolerance.
      normal_scale, plane_scale: of `Clusters`, times its `scale`.
    """
    check_same_shape("normal and position", normal, position)
    features = _features(normal, position, depth, material_id, slope, normal_scale, plane_scale)
    first = first_sample(covered)
    nearest = jnp.where(covered, _unlike(features, first), -1.0)
    owner = jnp.broadcast_to(first[..., None], covered.shape)
    return _grown(features, covered, nearest, owner, turns=covered.shape[-1] - 1, tolerance=1.0)


def cluster_quads(
    normal: Float[Array, "*b q 3"],
    position: Float[Array, "*b q 3"],
    depth: Float[Array, "*b q"],
    material_id: Int[Array, "*b q"],
    covered: Bool[Array, "*b q"],
    seeds: Int[Array, "*b 4"],
    *,
    count: int,
    normal_scale: float | Float[Array, ""],
    plane_scale: float | Float[Array, ""],
    apart_scale: float | Float[Array, ""],
) -> Int[Array, "*b q"]:
    """`cluster_samples` of q = 2m x 2m sub-samples of 2 x 2 pixels: until `count` are taken, whatever is left.

    Args:
      seeds: sub-samples that are taken first, one of each pixel; -1 for a pixel without.
      count: at least 4.
      normal_scale, plane_scale, apart_scale: of `QuadBudget`.
    """
    check_same_shape("normal and position", normal, position)
    # A window is two pixels wide.
    slope = jnp.full((*depth.shape[:-1], 2), 2.0 * jnp.asarray(apart_scale, depth.dtype))
    features = _features(normal, position, depth, material_id, slope, normal_scale, plane_scale)
    nearest, owner = jnp.where(covered, jnp.inf, -1.0), jnp.full_like(material_id, -1)
    for k in range(seeds.shape[-1]):
        seed = seeds[..., k, None]
        unlike = jnp.where(seed >= 0, _unlike(features, jnp.maximum(seeds[..., k], 0)), jnp.inf)
        # Another material is infinitely unlike, and has an owner all the same.
        owner = jnp.where((unlike < nearest) | (owner < 0), seed, owner)
        nearest = jnp.minimum(nearest, unlike)
    return _grown(features, covered, nearest, owner, turns=count - seeds.shape[-1], tolerance=0.0)


def _grown(
    features: "_Features", covered: Bool[Array, "*b n"], nearest: Float[Array, "*b n"], owner: Int[Array, "*b n"], *,
    turns: int, tolerance: float,
) -> Int[Array, "*b n"]:  # fmt: skip
    """Takes the sub-sample that is farthest from all owners, again and again while it is beyond the tolerance."""

    def unfinished(state) -> Bool[Array, ""]:
        nearest, _, turn = state
        return (turn < turns) & jnp.any(nearest > tolerance)

    def take(state):
        nearest, owner, turn = state
        farthest = jnp.argmax(nearest, axis=-1).astype(jnp.int32)
        unlike = _unlike(features, farthest)
        won = (unlike < nearest) & (jnp.max(nearest, axis=-1, keepdims=True) > tolerance)
        return jnp.where(won, unlike, nearest), jnp.where(won, farthest[..., None], owner), turn + 1

    _, owner, _ = jax.lax.while_loop(unfinished, take, (nearest, owner, 0))
    return jnp.where(covered, owner, -1)


def shading_slope(
    steps: Float[Array, "*b 2"],
    detail: Float[Array, "*b"],
    luma: Float[Array, "*b"],
    *,
    contrast_scale: float | Float[Array, ""],
    detail_scale: float | Float[Array, ""],
) -> Float[Array, "*b 2"]:
    """How much the shading of pixels is expected to change over a pixel in x and y, in units of the tolerance.

    0 where that is not a finite number.

    Args:
      steps: of `shading_steps`; detail: of `material_detail`; luma: display-encoded.
      contrast_scale, detail_scale: of `Clusters`, times its `scale`.
    """
    textured = detail_scale * detail * luma
    slope = jnp.sqrt((contrast_scale * steps) ** 2 + (textured * textured)[..., None])
    return jnp.where(jnp.isfinite(slope), slope, 0.0)


def is_uneven(slope: Float[Array, "*b 2"], n: int) -> Bool[Array, "*b"]:
    """Whether the shading may change by more than the tolerance between two sub-samples of a pixel."""
    reach = 1.0 - 1.0 / window_size(n)
    return jnp.sum(slope * slope, axis=-1) * reach**2 > 1.0


@dataclass(frozen=True)
class _Features:
    """What is compared; each component is an array of its own. `place` is in units of the tolerance."""

    normal: Vector
    position: Vector
    nearness: Float[Array, "*b n"]
    material_id: Int[Array, "*b n"]
    place: Vector
    normal_scale: float | Float[Array, ""]
    plane_scale: float | Float[Array, ""]


def _features(normal, position, depth, material_id, slope, normal_scale, plane_scale) -> _Features:
    x, y = (jnp.asarray(v, depth.dtype) for v in sample_positions(window_size(depth.shape[-1])).T)
    x, y = (jnp.broadcast_to(v, depth.shape) for v in (x, y))
    return _Features(
        normal=_parts(normal), position=_parts(position), nearness=1.0 / jnp.where(depth > 0.0, depth, 1.0),
        material_id=material_id, place=(slope[..., :1] * x, slope[..., 1:] * y), normal_scale=normal_scale,
        plane_scale=plane_scale,
    )  # fmt: skip


def _unlike(features: _Features, sample: Int[Array, "*b"]) -> Float[Array, "*b n"]:
    """Squared distance of all sub-samples from one."""
    index = jax.lax.broadcasted_iota(jnp.int32, features.material_id.shape, features.material_id.ndim - 1)
    mine = index == sample[..., None]
    chosen = lambda values: jnp.where(mine, values, jnp.zeros_like(values))  # noqa: E731
    at = lambda values: jnp.sum(chosen(values), axis=-1, keepdims=True, dtype=values.dtype)  # noqa: E731
    normal = tuple(at(values) for values in features.normal)
    apart = tuple(values - at(values) for values in features.position)
    off = jnp.minimum(jnp.abs(_dot(apart, normal)), jnp.abs(_dot(apart, features.normal)))
    distance2 = (off * at(features.nearness) * features.plane_scale) ** 2
    distance2 += features.normal_scale**2 * sum((a - b) ** 2 for a, b in zip(features.normal, normal, strict=True))
    distance2 += sum((values - at(values)) ** 2 for values in features.place)
    # What is not a number is like everything else, and keeps nobody from being taken.
    distance2 = jnp.where(jnp.isnan(distance2), 0.0, distance2)
    return jnp.where(features.material_id == at(features.material_id), distance2, jnp.inf)


def _dot(a: Vector, b: Vector) -> Float[Array, "*b n"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _parts(values: Float[Array, "*b n 3"]) -> Vector:
    return tuple(values[..., i] for i in range(3))
