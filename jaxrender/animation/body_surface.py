"""Parts of a body melted into one implicit surface, and its mesh.

The field f is negative inside, close to a distance near the surface, and smooth except where parts meet that
must not melt. NumPy float64, metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import skimage.measure
import trimesh
from jaxtyping import Bool, Float, Int

from jaxrender.animation.body_parts import Part

_MAX_CELLS = 1 << 25
"""Grid cells that are held at once; a finer mesh is made by splitting triangles."""


@dataclass(frozen=True, eq=False)
class Body:
    """Parts as columns, sorted by group. `axis` is unit; groups where `melts` is 1 flow into each other."""

    joints: Int[np.ndarray, " p"]
    origin: Float[np.ndarray, "p 3"]
    axis: Float[np.ndarray, "p 3"]
    wide: Float[np.ndarray, "p 3"]
    length: Float[np.ndarray, " p"]
    radius: Float[np.ndarray, "p 2"]
    stretch: Float[np.ndarray, "p 2"]
    group: Int[np.ndarray, " p"]
    blend: Float[np.ndarray, " g"]
    melts: Float[np.ndarray, "g g"]

    def resolved_by(self, step: float) -> "Body":
        """The body as thick and as blunt as a grid of that spacing can show.

        A grid finds a part that is thicker than the diagonal of a cell, 0.87 steps each way, and follows the
        edge of a flat part, where a radius r under a stretch s curves by s / r, up to about 5 / 3 per step.
        What is made thicker keeps its width.
        """
        radius = np.maximum(self.radius, 0.9 * step)
        stretch = np.clip(self.stretch * self.radius / radius, 1.0, radius / (0.6 * step))
        return replace(self, radius=radius, stretch=stretch)

    def where(self, few: Bool[np.ndarray, " p"]) -> "Body":
        """The groups with a part where the mask is true."""
        groups = np.unique(self.group[few])
        kept = np.isin(self.group, groups)
        names = ("joints", "origin", "axis", "wide", "length", "radius", "stretch")
        return Body(
            **{name: getattr(self, name)[kept] for name in names},
            group=np.searchsorted(groups, self.group[kept]),
            blend=self.blend[groups],
            melts=self.melts[np.ix_(groups, groups)],
        )


def assemble(parts: Sequence[Part], hops: Int[np.ndarray, "j j"]) -> Body:
    """The body of some parts. Groups melt if their joints are the same or have one bone between them.

    Args:
      hops: bones between every two joints (`joint_hops`).
    """
    parts = sorted(parts, key=lambda part: part.group)
    origin, end = np.stack([part.a for part in parts]), np.stack([part.b for part in parts])
    length = np.linalg.norm(end - origin, axis=1)
    up = np.array([0.0, 1.0, 0.0])
    axis = np.where(length[:, None] > 0, (end - origin) / np.maximum(length, 1e-12)[:, None], up)
    _, group = np.unique([part.group for part in parts], return_inverse=True)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    joints = np.asarray([part.joint for part in parts])
    apart = hops[np.ix_(joints, joints)]
    apart = np.minimum.reduceat(np.minimum.reduceat(apart, first, axis=0), first, axis=1)
    return Body(
        joints=joints,
        origin=origin,
        axis=axis,
        wide=_square_to(axis, np.stack([part.wide for part in parts])),
        length=length,
        radius=np.asarray([(part.radius_a, part.radius_b) for part in parts], dtype=np.float64),
        stretch=np.asarray([(part.stretch_a, part.stretch_b) for part in parts], dtype=np.float64),
        group=group,
        blend=np.asarray([parts[i].blend for i in first], dtype=np.float64),
        melts=(apart <= 1).astype(np.float64),
    )


def _square_to(axis: Float[np.ndarray, "p 3"], wide: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    """Unit vectors square to `axis` and otherwise as near to `wide` as can be."""
    any_other = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    parallel = np.linalg.norm(np.cross(axis, wide), axis=1, keepdims=True) < 1e-3
    side = np.where(parallel, any_other, wide)
    side = side - np.sum(side * axis, axis=1, keepdims=True) * axis
    return side / np.linalg.norm(side, axis=1, keepdims=True)


# The field.


def part_distances(body: Body, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n p"], ...]:
    """Signed distance to every part, to first order at its surface, and the gradient of it.

    The gradient is c (x - a) + d n + e w, with a the origin, n the axis and w the wide axis of the part. c, d
    and e are returned, so that a blend of gradients is three small matrix products.
    """
    # Every array here is (n, p): a third axis for x, y and z would take three times the time.
    along = points @ body.axis.T - np.sum(body.origin * body.axis, axis=1)
    sideways = points @ body.wide.T - np.sum(body.origin * body.wide, axis=1)
    square = np.sum(points**2, axis=1)[:, None] - 2.0 * points @ body.origin.T + np.sum(body.origin**2, axis=1)
    rest2 = np.maximum(square - along**2 - sideways**2, 0.0)
    length = np.maximum(body.length, 1e-12)
    share = np.clip(along / length, 0.0, 1.0)
    shrink = 1.0 / (body.stretch[:, 0] + share * (body.stretch[:, 1] - body.stretch[:, 0]))

    # With the stretch undone, the nearest of the swept spheres: its centre is where the slant of the cone
    # meets the axis.
    slope = np.clip((body.radius[:, 0] - body.radius[:, 1]) / length, -0.95, 0.95)
    across2 = rest2 + (sideways * shrink) ** 2
    center = np.clip(along - np.sqrt(across2) * (slope / np.sqrt(1.0 - slope**2)), 0.0, body.length)
    beyond = along - center
    rho = np.maximum(np.sqrt(across2 + beyond**2), 1e-12)
    radius = body.radius[:, 0] + (body.radius[:, 1] - body.radius[:, 0]) * (center / length)

    # Undoing the stretch shortens the gradient, so the distance is divided by its length.
    pull = sideways * shrink**2
    steepness = np.maximum(np.sqrt(rest2 + pull**2 + beyond**2) / rho, shrink)
    scale = 1.0 / (rho * steepness)
    return (rho - radius) / steepness, scale, (beyond - along) * scale, (pull - sideways) * scale


def evaluate(body: Body, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """The field f and a vector close to its gradient (exactly so on a single part)."""
    value, gradient = np.empty(len(points)), np.empty((len(points), 3))
    # Points are taken cell by cell, with the parts that matter in the cell; few parts need no cells.
    size = np.ptp(body.origin, axis=0).max() / 8.0 + body.radius.max()
    size = size if len(body.joints) > 24 else np.inf
    low = points.min(axis=0)
    cells = ((points - low) / size).astype(np.int64)
    order = np.argsort(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), kind="stable")
    first = np.flatnonzero(np.any(np.diff(cells[order], axis=0, prepend=-1), axis=1))
    for inside in np.split(order, first[1:]):
        local = body
        if np.isfinite(size):
            distance = part_distances(body, low + (cells[inside[:1]] + 0.5) * size)[0][0]
            local = body.where(distance < distance.min() + np.sqrt(3.0) * size + 8.0 * body.blend.max())
        # Small chunks, for two reasons: temporaries stay in cache (2.8 against 18 microseconds a point), and
        # a product this small does not wake the threads of the BLAS.
        step = max(1, min(15000 // len(local.joints), 250000 // len(local.blend) ** 2))
        for start in range(0, len(inside), step):
            chunk = inside[start : start + step]
            value[chunk], gradient[chunk] = _melt(local, points[chunk])
    return value, gradient


def _melt(body: Body, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The smooth union of groups that may melt.

    With depths x_g = -d_g / k_g and shares s = softmax(x), the usual smooth union is
    log Σ exp x = Σ s x + H(s), H the entropy. H lifts the surface by k log 2 wherever two parts overlap,
    which leaves a knob at every joint of a straight limb. It is wanted only in a notch between parts, so it
    is weighted by how much their gradients disagree, 1 - |Σ s ∇d|². The largest value over all sets of
    groups that melt with one group is taken: a plain union of limbs that only happen to be close.
    """
    distance, c, d, e = part_distances(body, points)
    first = np.flatnonzero(np.diff(body.group, prepend=-1))
    nearest = np.minimum.reduceat(distance, first, axis=1)
    depth = -nearest / body.blend
    strength = np.exp(depth - depth.max(axis=1, keepdims=True))
    strength *= body.melts[np.argmax(strength @ body.melts, axis=1)]
    share = strength / strength.sum(axis=1, keepdims=True)

    part_share = np.where(distance == nearest[:, body.group], share[:, body.group], 0.0)
    pull = part_share * c
    gradient = pull.sum(axis=1, keepdims=True) * points - pull @ body.origin
    gradient += (part_share * d) @ body.axis + (part_share * e) @ body.wide
    notch = np.clip(1.0 - np.sum(gradient**2, axis=1), 0.0, 1.0)
    entropy = -np.sum(share * np.log(np.maximum(share, 1e-300)), axis=1)
    return -(share @ body.blend) * (np.sum(share * depth, axis=1) + notch * entropy), gradient


# The mesh.


def mesh_body(body: Body, *, num_vertices: int) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"], Body]:
    """A closed mesh with about `num_vertices` vertices (within 10 %), well-shaped triangles, outside seen
    counter-clockwise; and the body it is the mesh of, whose parts are at least as thick as its grid.

    Marching cubes at a spacing that is searched for, then vertices slide on the surface to the middle of
    their neighbours.

    References:
      Lewiner et al., "Efficient Implementation of Marching Cubes' Cases with Topological Guarantees", 2003.
    """
    step = grid_step(body, num_vertices)
    low, high = _bounds(body)
    num_splits = 0
    while np.prod((high - low) / step) * 8.0**-num_splits > _MAX_CELLS:
        num_splits += 1
    # Splitting each triangle in four makes 4 n - 6 vertices of n on a surface without holes.
    wanted = num_vertices / 4**num_splits
    # The first, coarse mesh only measures the area. Vertices go with step⁻² on a surface that is given, and
    # with a lower power where parts grow as thick as the step; the power is taken from the last two meshes.
    step *= 2.0 ** (num_splits + 1)
    meshes: list[tuple[np.ndarray, np.ndarray, Body]] = []
    steps: list[float] = []
    power = 2.0
    for _ in range(8):
        steps.append(step)
        thick = body.resolved_by(step)
        meshes.append((*_march(thick, step), thick))
        share = len(meshes[-1][0]) / wanted
        if abs(share - 1.0) < 0.04:
            break
        if len(steps) > 2:
            growth = np.log(len(meshes[-1][0]) / len(meshes[-2][0]))
            power = float(np.clip(growth / np.log(steps[-2] / steps[-1]), 1.0, 3.0))
        step *= share ** (1.0 / power)
    vertices, faces, thick = min(meshes, key=lambda mesh: abs(len(mesh[0]) - wanted))
    for _ in range(num_splits):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return _relax(thick, vertices, faces), faces, thick


def grid_step(body: Body, num_vertices: int) -> float:
    """About the grid spacing that gives so many vertices, from the area of the parts."""
    radius = body.radius.mean(axis=1)
    area = 2.0 * np.pi * np.sum(radius * body.stretch.mean(axis=1) * (body.length + radius))
    return float(np.sqrt(area / num_vertices))


def _bounds(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """A box around the surface."""
    ends = np.stack([body.origin, body.origin + body.length[:, None] * body.axis])
    reach = (body.radius * body.stretch).max(axis=1)[:, None] + 2.0 * body.blend.max()
    return (ends.min(axis=0) - reach).min(axis=0), (ends.max(axis=0) + reach).max(axis=0)


def _march(body: Body, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes on a grid of that spacing, symmetric about the middle of the box.

    The middle always lies between grid points: how many vertices a thin straight part gets depends on that.
    """
    low, high = _bounds(body)
    counts = 2 * np.ceil(0.5 * (high - low) / step).astype(np.int64) + 2
    origin = 0.5 * (low + high) - 0.5 * step * (counts - 1)
    values = _sample_grid(body, origin, step, counts)
    vertices, faces, _, _ = skimage.measure.marching_cubes(values, 0.0, gradient_direction="descent")
    return _drop_crumbs(origin + step * vertices.astype(np.float64), faces.astype(np.int64))


def _sample_grid(body: Body, origin: np.ndarray, step: float, counts: np.ndarray, block: int = 4) -> np.ndarray:
    """The field on a grid; in blocks far from the surface, the value in the middle of the block."""
    blocks = -(-counts // block)
    corners = np.stack(np.meshgrid(*map(np.arange, blocks), indexing="ij"), axis=-1).reshape(-1, 3) * block
    # By the distance to the nearest part: f itself is no distance far from the surface.
    centers = origin + step * (corners + 0.5 * (block - 1))
    chunks = np.array_split(centers, -(-len(centers) * len(body.joints) // 15000))
    middle = np.concatenate([part_distances(body, chunk)[0].min(axis=1) for chunk in chunks])
    near = np.abs(middle) < 0.5 * np.sqrt(3.0) * block * step * 1.2 + 2.0 * body.blend.max()
    values = np.repeat(middle.astype(np.float32)[:, None], block**3, axis=1)
    cells = np.stack(np.meshgrid(*[np.arange(block)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = origin + step * (corners[near][:, None] + cells)
    values[near] = evaluate(body, points.reshape(-1, 3))[0].reshape(-1, block**3)
    values = values.reshape(*blocks, block, block, block).transpose(0, 3, 1, 4, 2, 5).reshape(blocks * block)
    values = values[: counts[0], : counts[1], : counts[2]]
    # A surface right through grid points would give triangles without area.
    smallest = np.float32(0.02 * step)
    return np.where(np.abs(values) < smallest, np.where(values < 0, -smallest, smallest), values)


def _drop_crumbs(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without the pieces that have less than a twentieth of the vertices: bubbles of the field, if any."""
    pairs = (faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel())
    graph = scipy.sparse.coo_matrix((np.ones(3 * len(faces)), pairs), shape=(len(vertices),) * 2)
    _, piece = scipy.sparse.csgraph.connected_components(graph, directed=False)
    kept = np.bincount(piece)[piece] >= 0.05 * len(vertices)
    index = np.cumsum(kept) - 1
    return vertices[kept], index[faces[kept[faces[:, 0]]]]


def _relax(body: Body, vertices: np.ndarray, faces: np.ndarray, num_rounds: int = 10) -> np.ndarray:
    """Vertices slid along the surface towards the mean of their neighbours, and put back on it by Newton."""
    rows, columns = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    size = len(vertices)
    ring = scipy.sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(size, size)).tocsr()
    degree = np.bincount(rows, minlength=size)[:, None]
    edge = float(np.mean(np.linalg.norm(vertices[rows] - vertices[columns], axis=1)))
    for num_left in reversed(range(num_rounds + 2)):
        value, gradient = evaluate(body, vertices)
        # The gradient is short in a notch, where the field of a blend is flat.
        square = np.maximum(np.sum(gradient**2, axis=1), 0.1)
        back = (value / square)[:, None] * gradient
        back *= np.minimum(1.0, 0.5 * edge / np.maximum(np.linalg.norm(back, axis=1), 1e-12))[:, None]
        vertices = vertices - back
        if num_left > 1:  # the last two rounds only put the vertices back
            normal = gradient / np.sqrt(square)[:, None]
            move = ring @ vertices / degree - vertices
            move -= np.sum(move * normal, axis=1, keepdims=True) * normal
            vertices = vertices + 0.6 * move
    return vertices
