"""What ray queries are held against: a plain loop over triangles in float64, and meshes and rays to try."""

import numpy as np
import trimesh

from tests.support import oracles


def brute_force(vertices, faces, origins, directions):
    """Face, distance and (u, v) of the first hit of each ray, in float64, triangle by triangle."""
    best = np.full(len(origins), np.inf)
    face, uv = np.full(len(origins), -1), np.zeros((len(origins), 2))
    for index, (a, b, c) in enumerate(vertices[faces].astype(np.float64)):
        # o + t d = a + u (b - a) + v (c - a), a 3x3 system per ray.
        columns = np.stack(np.broadcast_arrays(-directions, b - a, c - a), axis=-1).astype(np.float64)
        t, u, v = np.linalg.solve(columns, (origins - a).astype(np.float64)[..., None])[..., 0].T
        nearer = (t > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t < best)
        best[nearer], face[nearer] = t[nearer], index
        uv[nearer] = np.stack([u, v], axis=-1)[nearer]
    return face, best, uv


def triangle_soup(rng, num_rays=500):
    """60 triangles of size about 1 in a box of 4, and rays through it: vertices, faces, origins, directions."""
    corners = rng.uniform(-2, 2, (60, 1, 3)) + rng.uniform(-0.6, 0.6, (60, 3, 3))
    vertices = corners.reshape(-1, 3).astype(np.float32)
    faces = np.arange(180, dtype=np.int32).reshape(-1, 3)
    origins = rng.uniform(-3, 3, (num_rays, 3)).astype(np.float32)
    directions = oracles.unit(rng.uniform(-2, 2, (num_rays, 3)) - origins).astype(np.float32)
    return vertices, faces, origins, directions


def sphere(subdivisions=3):
    """A closed mesh of 20 · 4^subdivisions faces: vertices and faces."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def rays_at_edges(rng, vertices, faces, inside, count):
    """Rays from a point to points of edges, a quarter of them to corners; directions reach there (t = 1)."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    chosen, share = edges[rng.integers(0, len(edges), count)], rng.uniform(0, 1, (count, 1))
    share[: count // 4] = np.round(share[: count // 4])
    targets = share * vertices[chosen[:, 0]] + (1 - share) * vertices[chosen[:, 1]]
    origins = np.broadcast_to(inside, targets.shape).astype(np.float32)
    return origins, (targets - origins).astype(np.float32)
