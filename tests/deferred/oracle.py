"""A rasteriser in plain NumPy: every triangle against every sample, 64-bit integers, float64 depth.

It takes unclipped input only (all corners in front of the eye and inside the guard band) and is told nothing of tiles.
"""

import numpy as np


def snap(clip, *, height, width):
    """Snapped corner positions from the middle of the image, y down, in 1/256 px."""
    clip = np.asarray(clip, np.float32)
    ndc = clip[:, :2] / clip[:, 3:]
    half = np.array([0.5 * width * 256, -0.5 * height * 256], np.float32)
    return np.round(ndc * half).astype(np.int64)


def sample_positions(height, width, positions_px):
    """(h, w, s, 2) in 1/256 px from the middle; exact where the layout's offsets are multiples of 1/256."""
    y, x = np.mgrid[:height, :width]
    at = np.stack([x, y], axis=-1)[:, :, None] + np.asarray(positions_px)
    return at * 256.0 - np.array([width, height]) * 128.0


def covers(corners, at):
    """Top-left rule with exact integers; `corners` (3, 2) in any winding, `at` (..., 2)."""
    a, b, c = corners
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if area == 0:
        return np.zeros(at.shape[:-1], bool), area
    if area < 0:
        b, c = c, b
    inside = np.ones(at.shape[:-1], bool)
    for p, q in ((a, b), (b, c), (c, a)):
        e = (q[0] - p[0]) * (at[..., 1] - p[1]) - (q[1] - p[1]) * (at[..., 0] - p[0])
        top_or_left = (p[1] == q[1] and q[0] > p[0]) or q[1] < p[1]
        inside &= (e > 0) | ((e == 0) & top_or_left)
    return inside, area


def rasterize(clip, faces, *, height, width, positions_px, grid=1, cull="none"):
    """Triangle ids, window depth and the number of triangles over each sample."""
    xy = snap(clip, height=height * grid, width=width * grid)
    z = np.asarray(clip, np.float64)[:, 2] / np.asarray(clip, np.float64)[:, 3]
    at = sample_positions(height, width, positions_px) * grid
    assert (at == np.round(at)).all()
    at = at.astype(np.int64)
    shape = at.shape[:-1]
    ids, depth, layers = np.full(shape, -1), np.full(shape, np.inf), np.zeros(shape, int)
    for t, face in enumerate(np.asarray(faces)):
        corners = xy[face]
        inside, area = covers(corners, at)
        if area == 0 or (cull == "back" and area > 0) or (cull == "front" and area < 0):
            continue
        a, b, c = corners
        l1 = ((c[0] - a[0]) * (a[1] - at[..., 1]) - (c[1] - a[1]) * (a[0] - at[..., 0])) / area
        l2 = ((b[0] - a[0]) * (at[..., 1] - a[1]) - (b[1] - a[1]) * (at[..., 0] - a[0])) / area
        own = z[face[0]] + l1 * (z[face[1]] - z[face[0]]) + l2 * (z[face[2]] - z[face[0]])
        inside &= (own >= 0) & (own <= 1)
        layers += inside
        nearer = inside & (own < depth)
        ids[nearer], depth[nearer] = t, own[nearer]
    return ids, np.where(ids >= 0, depth, 1.0), layers
