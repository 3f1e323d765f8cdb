"""A small scene with one of everything, as NumPy data: the input of shading tests in either package.

A floor of two triangles, of which one reaches behind the eye; a crumpled sheet with two sides, of which some triangles
show their back; shards of a masked material, and shards without textures.
"""

import numpy as np

#: Names of the materials by id.
FLOOR, SHEET, MASKED, PLAIN = range(4)
SIZE = {"height": 10, "width": 12}


def unit(v: np.ndarray) -> np.ndarray:
    """Vectors of length 1."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def meshes(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Positions, faces and material ids of the scene's triangles."""
    floor = np.array([[-6.0, 0.0, -4.0], [5.0, 0.0, -4.0], [4.0, 0.0, 2.5], [-3.0, 0.0, 9.0]])
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 4), np.linspace(0.3, 1.6, 4))
    sheet = np.stack([x, y, 0.4 * np.sin(3.0 * x)], axis=-1).reshape(-1, 3) + 0.08 * rng.normal(size=(16, 3))
    corner = np.arange(16).reshape(4, 4)
    quads = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], axis=-1).reshape(-1, 4)
    folded = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    folded[::3] = folded[::3, ::-1]
    shards = rng.uniform([-1.8, 0.2, -0.5], [1.8, 1.8, 1.2], (6, 1, 3)) + 0.5 * rng.normal(size=(6, 3, 3))
    parts = [floor, sheet, shards.reshape(-1, 3)]
    faces = [np.array([[0, 3, 2], [0, 2, 1]]), folded, np.arange(18).reshape(-1, 3)]
    start = np.cumsum([0, *(len(part) for part in parts)])[:-1]
    ids = [FLOOR] * 2 + [SHEET] * len(folded) + [MASKED, PLAIN] * 3
    return {
        "positions": np.concatenate(parts),
        "faces": np.concatenate([f + s for f, s in zip(faces, start, strict=True)]).astype(np.int32),
        "material_id": np.array(ids, np.int32),
    }


def scene(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The arrays of a `Scene`; normals bend away from those of the faces, tangents are orthogonal to them."""
    mesh = meshes(rng)
    p, count = mesh["positions"][mesh["faces"]], len(mesh["positions"])
    normals = np.zeros((count, 3))
    for k in range(3):
        np.add.at(normals, mesh["faces"][:, k], unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])))
    # Where faces of either winding meet, their sum means nothing.
    normals = np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0.5, normals, [0.0, 0.6, 0.8])
    normals = unit(unit(normals) + 0.2 * rng.normal(size=(count, 3)))
    tangents = unit(np.cross(normals, [0.3, 0.2, 0.93]))
    return mesh | {
        "normals": normals,
        "tangents": np.concatenate([tangents, np.ones((count, 1))], axis=1),
        "uv": mesh["positions"][:, [0, 2]] * 0.4 + 0.1 * rng.normal(size=(count, 2)),
        "colors": rng.uniform(0.3, 1.0, (count, 4)),
    }


def material(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The fields of a `Material`, by id; layer 0 is colors, 1 data, 2 a normal map."""
    integers = lambda *values: np.array(values, np.int32)  # noqa: E731
    return {
        "base_color": rng.uniform(0.4, 1.0, (4, 4)),
        "metallic": np.array([0.0, 1.0, 0.0, 1.0]),
        "roughness": np.array([0.9, 0.7, 0.6, 1.0]),
        "emissive": rng.uniform(0.0, 0.3, (4, 3)),
        "normal_scale": np.array([0.8, 1.0, 1.5, 1.0]),
        "occlusion_strength": np.array([0.7, 1.0, 1.0, 0.3]),
        "alpha_mode": integers(0, 0, 1, 0),
        "alpha_cutoff": np.full(4, 0.5),
        "double_sided": np.array([False, True, True, False]),
        "base_color_texture": integers(0, -1, 0, -1),
        "metallic_roughness_texture": integers(-1, 1, -1, -1),
        "normal_texture": integers(2, -1, 2, -1),
        "occlusion_texture": integers(1, 1, -1, -1),
        "emissive_texture": integers(-1, 0, 0, -1),
    }


def textures(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The fields of `Textures`: 7 x 5, 4 x 8 and 6 x 6 texels (w x h) wrapped in three ways, the last a normal map.

    In the data layer green is at least a half, so that no roughness is near 0; blue, the metallic part, is whole.
    """
    levels = [[(7, 5), (3, 2), (1, 1), (1, 1)], [(4, 8), (2, 4), (1, 2), (1, 1)], [(6, 6), (3, 3), (1, 1), (1, 1)]]
    num_levels, offset, sizes = [3, 4, 3], [], []
    for layer, count in zip(levels, num_levels, strict=True):
        starts = sum(sizes) + np.cumsum([0, *(w * h for w, h in layer[: count - 1])])
        offset.append([*starts, *[starts[-1]] * (4 - count)])
        sizes.append(sum(w * h for w, h in layer[:count]))
    color, data = (rng.uniform(0.1, 1.0, (size, 4)) for size in sizes[:2])
    data[:, 1], data[:, 2] = 0.5 + 0.5 * data[:, 1], 1.0
    normal_map = rng.uniform([0.3, 0.3, 0.8, 1.0], [0.7, 0.7, 1.0, 1.0], (sizes[2], 4))
    width, height = np.moveaxis(np.array(levels, np.int32), -1, 0)
    return {
        "texels": np.concatenate([color, data, normal_map]),
        "offset": np.array(offset, np.int32),
        "width": width.copy(),
        "height": height.copy(),
        "num_levels": np.array(num_levels, np.int32),
        "wrap": np.array([[0, 0], [2, 0], [1, 2]], np.int32),
    }


def lights() -> dict[str, np.ndarray]:
    """The fields of `Lights`: a sun, a lamp without end, one with, a spot, and a low sun that grazes surfaces."""
    inf = np.inf
    travels = np.array([[-0.35, -1.0, -0.45], [0, 0, -1], [0, 0, -1], [-0.2, -1.0, -0.7], [-1.0, -0.1, 0.2]])
    return {
        "kind": np.array([0, 1, 1, 2, 0], np.int32),
        "position": np.array([[0.0, 0, 0], [1.5, 2.5, 1.5], [-1.0, 1.5, 1.0], [0.5, 3.0, 2.0], [0.0, 0, 0]]),
        "direction": unit(travels),
        "intensity": np.array([[1.2, 1.0, 0.8], [4.0, 5.0, 6.0], [2.0, 1.0, 1.5], [9.0, 8.0, 7.0], [0.9, 0.5, 0.3]]),
        "range": np.array([inf, inf, 3.0, inf, inf]),
        "cos_inner": np.array([-1.0, -1.0, -1.0, 0.95, -1.0]),
        "cos_outer": np.array([-1.0, -1.0, -1.0, 0.6, -1.0]),
    }


EYE = np.array([0.4, 1.3, 3.2])


def clip(positions: np.ndarray, *, eye: np.ndarray = EYE) -> np.ndarray:
    """Float32 clip positions (v, 4) seen from `eye` towards (0, 0.7, 0), about 50° upwards, near 0.1 and far 20."""
    backward = unit(eye - np.array([0.0, 0.7, 0.0]))
    right = unit(np.cross([0.0, 1.0, 0.0], backward))
    view = (positions - eye) @ np.stack([right, np.cross(backward, right), backward], axis=1)
    x, y, z = view.T
    aspect, near, far = SIZE["width"] / SIZE["height"], 0.1, 20.0
    rows = [2.1 * x / aspect, 2.1 * y, far / (near - far) * z + near * far / (near - far), -z]
    return np.stack(rows, axis=-1).astype(np.float32)
