"""The one function that asks any backend about rays: Embree on the CPU, or trees of this package on any device."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender.checks import check_one_of
from jaxrender.pathtrace.bvh import Bvh
from jaxrender.pathtrace.embree import EmbreeScene
from jaxrender.pathtrace.hits import Hits
from jaxrender.pathtrace.instances import InstancedScene, any_hit_of_instances, closest_hit_of_instances
from jaxrender.pathtrace.traversal import any_hit, checked_limit, closest_hit
from jaxrender.pathtrace.wavefront import padded_count


def trace_rays(
    geometry: EmbreeScene | Bvh | InstancedScene,
    origins: Float[Array | np.ndarray, "n 3"],
    directions: Float[Array | np.ndarray, "n 3"],
    *,
    query: Literal["closest", "any"] = "closest",
    max_distance: Float[Array | np.ndarray, " n"] | None = None,
) -> Hits | Bool[Array | np.ndarray, " n"]:
    """The first hit of each ray, or whether there is one, with 0 <= t < max_distance; both sides of faces count.

    An `EmbreeScene` takes what NumPy can read and gives NumPy arrays, on all cores; it cannot be inside `jit`. The
    trees are pure JAX: see `closest_hit` for precision, memory, derivatives and rays that are not finite. Batches
    are filled up to a few sizes, so that a program is compiled once for many numbers of rays. The backends agree but
    for rays within rounding of an edge, where they may name either neighbour, and of a silhouette.

    Args:
      directions: of any length other than 0; t and max_distance are in units of it.
      query: "closest" for `Hits`, "any" for one boolean per ray, which is faster.
      max_distance: none means inf.
    Raises:
      ValueError: for other queries, and for shapes other than those above.
    """
    check_one_of("query", query, ("closest", "any"))
    if isinstance(geometry, EmbreeScene):
        ask = geometry.closest_hit if query == "closest" else geometry.any_hit
        return ask(np.asarray(origins), np.asarray(directions), max_distance=max_distance)
    o, d = jnp.asarray(origins), jnp.asarray(directions)
    limit = checked_limit(o, d, None if max_distance is None else jnp.asarray(max_distance))
    count = o.shape[0]
    added = padded_count(count) - count
    # Rays with a limit of 0 meet nothing.
    o, d, limit = (jnp.pad(x, [(0, added)] + [(0, 0)] * (x.ndim - 1)) for x in (o, d, limit))
    found = _ask_tree(geometry, o, d, limit, closest=query == "closest")
    return jax.tree.map(lambda x: x[:count], found)


def _ask_tree(geometry: Bvh | InstancedScene, origins, directions, limit, *, closest: bool) -> Hits | Array:
    if isinstance(geometry, InstancedScene):
        ask_instances = closest_hit_of_instances if closest else any_hit_of_instances
        return ask_instances(geometry, origins, directions, max_distance=limit)
    ask = closest_hit if closest else any_hit
    return ask(geometry, origins, directions, max_distance=limit)
