"""Images that a renderer made -> the channels that guide a filter, each with what counts as the same in it.

Scales are such that one regulariser serves all scenes: normals from [-1, 1] to [0, 1], lengths over the extent of what
is seen, ambient occlusion as it is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender.filters.aovs import Aovs
from jaxrender.filters.atrous import atrous_filter

#: Regularisers of the guided filter, sigmas of the others. The paper's (1e-2 for normals and depth) smooth too much:
#: with them the error hardly falls with the number of samples.
EPS = {"normal": 1e-3, "depth": 1e-4, "position": 1e-4, "ao": 1e-3, "patch": 1e-4}
SIGMA = {"normal": 0.15, "depth": 0.01, "position": 0.02, "ao": 0.2, "patch": 0.1}

#: Ambient occlusion of few rays is noisy, and a guide's noise goes into the picture: so many à-trous levels before use.
_AO_LEVELS = 2


class Guides(NamedTuple):
    """Channels (h, w, g), and by channel the regulariser of a guided filter and the sigma of a bilateral one."""

    channels: Float[Array, "h w g"]
    eps: Float[np.ndarray, " g"]
    sigma: Float[np.ndarray, " g"]


def make_guides(aovs: Aovs) -> Guides:
    """Normals, depth (positions if there is none) and ambient occlusion, as far as they are given.

    Runs on the host: the extent of the scene is read off the images. Pixels that are not finite stay so: see `gaps`.

    Raises:
      ValueError: if none of normal, depth and position is given.
    """
    extent = scene_extent(aovs)
    found: dict[str, Float[Array, "h w _"]] = {}
    if aovs.normal is not None:
        seen = jnp.any(jnp.asarray(aovs.normal) != 0.0, axis=-1, keepdims=True)
        found["normal"] = jnp.where(seen, 0.5 * (jnp.asarray(aovs.normal, jnp.float32) + 1.0), 0.0)
    if aovs.depth is not None:
        found["depth"] = jnp.asarray(aovs.depth, jnp.float32) / extent
    elif aovs.position is not None:
        found["position"] = jnp.asarray(aovs.position, jnp.float32) / extent
    if not found:
        raise ValueError("aovs: expected normal, depth or position, got none of them")
    if aovs.ao is not None:
        by = jnp.concatenate(list(found.values()), axis=-1)
        sigma = jnp.asarray(_each(found, SIGMA), jnp.float32)
        found["ao"] = _smooth_ao(jnp.asarray(aovs.ao, jnp.float32), by, sigma)
    return Guides(jnp.concatenate(list(found.values()), axis=-1), _each(found, EPS), _each(found, SIGMA))


def scene_extent(aovs: Aovs) -> float:
    """The diagonal of the box around the positions that are seen; without them, about the largest depth."""
    if aovs.position is not None:
        points = np.asarray(aovs.position, np.float64).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=-1) & points.any(axis=-1)]
        size = np.linalg.norm(np.ptp(points, axis=0)) if len(points) else 0.0
    else:
        depth = np.asarray(0.0 if aovs.depth is None else aovs.depth, np.float64)
        depth = depth[np.isfinite(depth) & (depth > 0.0)]
        size = np.quantile(depth, 0.99) if depth.size else 0.0
    return float(size) if size > 0.0 else 1.0


def with_patches(guides: Guides, patches: Bool[np.ndarray, "h w"]) -> Guides:
    """Guides with one more, if there are patches: 1 in them, 0 elsewhere, so that each is filtered by itself."""
    if not patches.any():
        return guides
    mask = jnp.asarray(patches[..., None], jnp.float32)
    more = (guides.eps, EPS["patch"]), (guides.sigma, SIGMA["patch"])
    eps, sigma = (np.append(values, np.float32(value)) for values, value in more)
    return Guides(jnp.concatenate([guides.channels, mask], axis=-1), eps, sigma)


def _each(found: dict, table: dict[str, float]) -> Float[np.ndarray, " g"]:
    return np.concatenate([np.full(image.shape[-1], table[name], np.float32) for name, image in found.items()])


@jax.jit
def _smooth_ao(ao, by, sigma):
    return atrous_filter(ao, by, num_levels=_AO_LEVELS, sigma_features=sigma)
