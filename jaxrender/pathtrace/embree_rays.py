"""Rays of a scene on the host: on all cores through Embree, holes of masked materials included."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.pathtrace.embree import EmbreeScene
from jaxrender.pathtrace.hit_points import SurfaceTable
from jaxrender.pathtrace.hits import Hits
from jaxrender.pathtrace.paths import Rays, ShadowRays
from jaxrender.pathtrace.ray_scene import is_hole, masked_triangles
from jaxrender.scene import Scene

#: Holes that a ray may pass; then it stops.
MOST_HOLES = 64

#: Relative to the size of coordinates, how far behind a hole a ray goes on.
_STEP = 4e-6


class EmbreeRays:
    """A `RayScene` on the calling thread.

    Solid and masked triangles are kept apart for shadow tests, so that only rays that meet a masked one are followed
    through holes.
    """

    def __init__(self, scene: Scene, table: SurfaceTable):
        vertices, faces = np.asarray(scene.positions), np.asarray(scene.faces)
        masked = masked_triangles(scene)
        self._table = table
        self._masked_faces = np.flatnonzero(masked).astype(np.int32)
        self._all = EmbreeScene(vertices, faces)
        self._solid = self._all if not masked.any() else None
        if self._solid is None:
            self._holed = EmbreeScene(vertices, faces[masked])
            self._solid = EmbreeScene(vertices, faces[~masked]) if not masked.all() else None

    def closest(self, rays: Rays, wanted: Bool[Array, " n"], *, reach: float = float("inf")) -> Hits:
        """See `RayScene`."""
        origins, directions, asked = _rows(rays.origin), _rows(rays.direction), np.asarray(wanted)
        bounded = reach < np.inf or not asked.all()
        limit = np.where(asked, np.float32(reach), np.float32(0.0)) if bounded else None
        hits = self._all.closest_hit(origins, directions, max_distance=limit)
        if not len(self._masked_faces):
            return hits
        return self._through_holes(self._all, hits, origins, directions, None)

    def blocked(self, shadow: ShadowRays) -> Bool[np.ndarray, " n"]:
        """See `RayScene`."""
        tried = np.flatnonzero(np.any([np.asarray(c) != 0.0 for c in shadow.light], axis=0))
        origins, directions = (_rows([np.asarray(c)[tried] for c in v]) for v in (shadow.origin, shadow.direction))
        found = np.zeros(len(shadow.distance), bool)
        found[tried] = self._between(origins, directions, np.asarray(shadow.distance)[tried])
        return found

    def moved(self, scene: Scene, table: SurfaceTable) -> "EmbreeRays":
        """Built anew, which is quick."""
        return EmbreeRays(scene, table)

    def _between(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"], distance: Float[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        found = np.zeros(len(origins), bool)
        if self._solid is not None:
            found = self._solid.any_hit(origins, directions, max_distance=distance)
        if not len(self._masked_faces):
            return found
        open_ = np.flatnonzero(~found)
        o, d, t = (np.ascontiguousarray(x[open_]) for x in (origins, directions, distance))
        hits = self._holed.closest_hit(o, d, max_distance=t)
        hits = self._through_holes(self._holed, hits, o, d, self._masked_faces)
        found[open_] = (hits.triangle >= 0) & (hits.t < t)
        return found

    def _through_holes(
        self, scene: EmbreeScene, hits: Hits, origins: np.ndarray, directions: np.ndarray,
        names: Int[np.ndarray, " m"] | None,
    ) -> Hits:  # fmt: skip
        """Hits with rays that hit a hole traced on; `names` are the scene's triangles by those of `scene`."""
        triangle, t, uv = np.array(hits.triangle), np.array(hits.t), np.array(hits.barycentrics)
        origin = np.array(origins)
        begun = np.zeros(len(t), np.float32)
        rest = np.flatnonzero(triangle >= 0)
        for _ in range(MOST_HOLES):
            own = triangle[rest] if names is None else names[triangle[rest]]
            rest = rest[self._is_hole(own, uv[rest])]
            if not len(rest):
                break
            step = t[rest] + _STEP * (np.abs(origin[rest]).max(axis=1) + t[rest])
            begun[rest] += step
            origin[rest] += step[:, None] * directions[rest]
            next_hits = scene.closest_hit(np.ascontiguousarray(origin[rest]), np.ascontiguousarray(directions[rest]))
            triangle[rest], t[rest], uv[rest] = next_hits.triangle, next_hits.t, next_hits.barycentrics
            rest = rest[triangle[rest] >= 0]
        return Hits(triangle, t + begun, uv)

    def _is_hole(self, triangle: np.ndarray, barycentrics: np.ndarray) -> np.ndarray:
        """Padded to a power of two, so that few programs are compiled."""
        count = len(triangle)
        padded = max(256, 1 << max(count - 1, 0).bit_length())
        triangle = np.pad(triangle, (0, padded - count), constant_values=-1)
        barycentrics = np.pad(barycentrics, [(0, padded - count), (0, 0)])
        return np.asarray(_is_hole(self._table, triangle, barycentrics))[:count]


def _rows(v: Sequence[Array | np.ndarray]) -> Float[np.ndarray, "n 3"]:
    """Components side by side, as Embree wants them."""
    return np.stack([np.asarray(c) for c in v], axis=-1)


_is_hole = jax.jit(is_hole)
