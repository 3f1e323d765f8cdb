"""What a query for the closest hit gives, whichever backend answers it."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Int


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Hits:
    """Closest hits of n rays; arrays of NumPy (Embree) or JAX.

    Attributes:
      triangle: the face of the mesh (of the instance's object, where there are instances), or -1 for a miss.
      t: origin + t · direction is the hit point, so t is a distance for unit directions; inf for a miss.
      barycentrics: (u, v): the hit point is (1 - u - v) a + u b + v c of the face's corners a, b, c; 0 for a miss.
      instance: which instance was hit, or -1 for a miss; None where the geometry has no instances.
    """

    triangle: Int[Array | np.ndarray, " n"]
    t: Float[Array | np.ndarray, " n"]
    barycentrics: Float[Array | np.ndarray, "n 2"]
    instance: Int[Array | np.ndarray, " n"] | None = None
