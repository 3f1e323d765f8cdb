"""The CPU ray backend: Intel Embree through embreex, one scene object per mesh and all cores per query.

NumPy in, NumPy out: ray casting is not differentiable and happens outside `jit`.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_last_axis, check_same_shape
from jaxrender.machine import num_cores
from jaxrender.pathtrace.hits import Hits

RAYS_PER_TASK = 1 << 17


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
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        query: str,
        *,
        full: bool = False,
        max_distance: np.ndarray | None = None,
    ):
        """One embreex call on the calling thread; C-contiguous float32 (n, 3) in, and (n,) for max_distance.

        Embree counts hits at t <= max_distance, and takes a ray with a negative one for a ray that has hit.
        """
        return self._scene.run(origins, directions, dists=max_distance, query=query, output=True if full else None)

    def any_hit(
        self,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        *,
        max_distance: Float[Array | np.ndarray, " n"] | None = None,
    ) -> Bool[np.ndarray, " n"]:
        """Whether each ray meets the mesh with 0 <= t < max_distance."""
        origins, directions, limit = _ready(origins, directions, max_distance)
        hit = np.empty(len(origins), bool)

        def piece(span: slice) -> None:
            found = self.run(origins[span], directions[span], "OCCLUDED", max_distance=_up_to(limit, span))
            hit[span] = (found == 0) & _may_hit(limit, span)

        _run_pieces(piece, len(origins))
        return hit

    def closest_hit(
        self,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        *,
        max_distance: Float[Array | np.ndarray, " n"] | None = None,
    ) -> Hits:
        """The first face along each ray with 0 <= t < max_distance; t is in units of the direction's length."""
        origins, directions, limit = _ready(origins, directions, max_distance)
        n = len(origins)
        hits = Hits(np.empty(n, np.int32), np.empty(n, np.float32), np.empty((n, 2), np.float32))

        def piece(span: slice) -> None:
            found = self.run(origins[span], directions[span], "INTERSECT", full=True, max_distance=_up_to(limit, span))
            hit = (found["primID"] >= 0) & _may_hit(limit, span)
            hits.triangle[span] = np.where(hit, found["primID"], -1)
            # Embree's t can be -0.
            hits.t[span] = np.where(hit, np.maximum(found["tfar"], 0.0), np.inf)
            hits.barycentrics[span] = np.where(hit[:, None], np.stack([found["u"], found["v"]], axis=-1), 0.0)

        _run_pieces(piece, n)
        return hits


def _ready(origins, directions, max_distance) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """What embreex needs: C-contiguous float32 of the right shapes, which it does not check."""
    origins, directions = (np.ascontiguousarray(x, np.float32) for x in (origins, directions))
    check_last_axis("origins", origins, 3)
    check_same_shape("origins and directions", origins, directions)
    if max_distance is None:
        return origins, directions, None
    limit = np.ascontiguousarray(max_distance, np.float32)
    check_same_shape("max_distance and origins without the last axis", limit, origins[:, 0])
    return origins, directions, limit


def _up_to(limit: np.ndarray | None, span: slice) -> np.ndarray | None:
    """The largest t that counts; 0 for rays that can meet nothing."""
    if limit is None:
        return None
    return np.where(limit[span] > 0, np.nextafter(limit[span], np.float32(0)), np.float32(0))


def _may_hit(limit: np.ndarray | None, span: slice) -> np.ndarray | bool:
    return True if limit is None else limit[span] > 0


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
