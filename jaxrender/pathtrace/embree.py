"""The CPU ray backend: Intel Embree through embreex, one scene object per mesh and all cores per query.

NumPy in, NumPy out: ray casting is not differentiable and happens outside `jit`.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxrender.machine import num_cores

RAYS_PER_TASK = 1 << 17


@dataclass(frozen=True)
class Hits:
    """Closest hits of n rays.

    `triangle[i]` is the face index or -1; the other fields are meaningless where it is -1. The hit point is
    (1 - u - v) a + u b + v c of the face's corners (a, b, c), at distance t along the (unit) ray.
    """

    triangle: Int[np.ndarray, " n"]
    t: Float[np.ndarray, " n"]
    barycentrics: Float[np.ndarray, "n 2"]


class EmbreeScene:
    """A triangle mesh ready for rays; build one per pose.

    Queries are cut into pieces of `RAYS_PER_TASK` rays and run on a pool of threads (embreex releases the
    interpreter lock), so memory for the pieces stays bounded whatever the number of rays.
    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "t 3"]):
        try:
            from embreex import mesh_construction, rtcore_scene
        except ImportError as error:
            raise RuntimeError("ray casting needs embreex, which has no wheel for this platform") from error
        self._scene = rtcore_scene.EmbreeScene(robust=True)
        self._mesh = mesh_construction.TriangleMesh(
            self._scene, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32)
        )
        # Embree builds its hierarchy lazily at the first query, which is not safe from several threads.
        self.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), "OCCLUDED")

    def run(
        self, origins: np.ndarray, directions: np.ndarray, query: str, *, full: bool = False,
        max_distance: np.ndarray | None = None,
    ):  # fmt: skip
        """One embreex call on the calling thread; C-contiguous float32 (n, 3) in, (n,) for the distance."""
        return self._scene.run(origins, directions, max_distance, query=query, output=True if full else None)

    def any_hit(
        self,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        *,
        max_distance: Float[np.ndarray, " n"] | None = None,
    ) -> Bool[np.ndarray, " n"]:
        """True where the ray meets the mesh anywhere in front of its origin, nearer than `max_distance`."""
        hit = np.empty(len(origins), bool)

        def piece(span: slice) -> None:
            # Embree writes into the distances.
            reach = None if max_distance is None else np.array(max_distance[span], np.float32)
            hit[span] = self.run(origins[span], directions[span], "OCCLUDED", max_distance=reach) == 0

        _run_pieces(piece, len(origins))
        return hit

    def closest_hit(
        self,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        *,
        max_distance: Float[np.ndarray, " n"] | None = None,
    ) -> Hits:
        """The first face along each ray, nearer than `max_distance`. Directions are unit, so that t is a distance."""
        n = len(origins)
        hits = Hits(np.empty(n, np.int32), np.empty(n, np.float32), np.empty((n, 2), np.float32))

        def piece(span: slice) -> None:
            reach = None if max_distance is None else np.array(max_distance[span], np.float32)
            found = self.run(origins[span], directions[span], "INTERSECT", full=True, max_distance=reach)
            hits.triangle[span] = found["primID"]
            hits.t[span] = found["tfar"]
            hits.barycentrics[span] = np.stack([found["u"], found["v"]], axis=-1)

        _run_pieces(piece, n)
        return hits


_pool: ThreadPoolExecutor | None = None


def pool() -> ThreadPoolExecutor:
    """The threads that all scenes share, one per core."""
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(num_cores(), thread_name_prefix="rays")
    return _pool


def _run_pieces(piece, count: int) -> None:
    spans = [slice(start, start + RAYS_PER_TASK) for start in range(0, count, RAYS_PER_TASK)]
    if len(spans) == 1:
        piece(spans[0])
    else:
        list(pool().map(piece, spans))
