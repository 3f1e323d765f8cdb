"""The indirect light of an eye ray, from the guide ray around it that saw the most similar surface."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxrender.checks import check_last_axis, check_same_shape

#: Largest distances below these are taken for these: on a wall, rounding of depth must not fill the range.
NORMAL_FLOOR, DEPTH_FLOOR = 1e-3, 1e-3

#: Scores that differ by less are tied: depths a millionth apart on a wall, or 1 - d / max d for the largest d, which
#: is not exactly 0.
TIE = 1e-3


def guide_lookup(
    image: Float[Array, "h w c"],
    normal: Float[Array, "h w 3"],
    depth: Float[Array, "h w 1"],
    *,
    places_px: Float[Array, "n 2"],
    sample_normal: Float[Array, "n 3"],
    sample_depth: Float[Array, "n 1"],
) -> tuple[Float[Array, "n c"], Int[Array, "n 2"]]:
    """Looks up an image of guide rays (through pixel centres) for rays through other places.

    Of the four pixel centres around a place, the one with the largest s_i = s_N,i s_D,i is taken:
    s_N,i = 1 - ||N_a - N_i|| / max_j ||N_a - N_j|| and s_D,i = 1 - |D_a - D_i| / max_j |D_a - D_j|. Where a maximum is
    below a floor (`NORMAL_FLOOR`; `DEPTH_FLOOR` times the sample's depth) the floor stands for it. Ties (scores within
    `TIE`) go to the more similar normal, then to the nearer centre. Guides without a surface (normal 0) are taken only
    if all four are.

    Differentiable in `image`; which pixel is taken has no gradient.

    Args:
      places_px: (x, y) on the image, pixel centres at + 0.5; beyond the outer centres the border counts.
      sample_normal, sample_depth: of the surface that the other ray sees; unit, and linear view depth.
    Returns:
      values, and (row, column) where they were taken.
    References:
      Bauszat, Eisemann, Magnor, "Guided Image Filtering for Interactive High-quality Global Illumination", 2011,
      section 5, eqs. 3-5.
    """
    check_last_axis("places_px", places_px, 2)
    check_same_shape("normal and image without channels", normal[..., 0], image[..., 0])
    height, width = image.shape[:2]
    first = jnp.floor(places_px - 0.5).astype(jnp.int32)
    shifts = jnp.asarray([[0, 0], [1, 0], [0, 1], [1, 1]], jnp.int32)
    column, row = (
        jnp.clip(first[:, None, k] + shifts[None, :, k], 0, size - 1) for k, size in ((0, width), (1, height))
    )
    normals, depths = normal[row, column], depth[row, column][..., 0]
    normal_distance = jnp.sqrt(jnp.sum((sample_normal[:, None, :] - normals) ** 2, axis=-1))
    depth_distance = jnp.abs(sample_depth - depths)
    by_normal = _similarity(normal_distance, jnp.full_like(sample_depth, NORMAL_FLOOR))
    by_depth = _similarity(depth_distance, DEPTH_FLOOR * jnp.abs(sample_depth))
    seen = jnp.any(normals != 0.0, axis=-1)
    centers = jnp.stack([column, row], axis=-1).astype(places_px.dtype) + 0.5
    away = jnp.sum((centers - places_px[:, None, :]) ** 2, axis=-1)
    best = _first_of_largest(jnp.where(seen, by_normal * by_depth, -1.0), by_normal, -away)
    row, column = (jnp.take_along_axis(values, best[:, None], axis=1)[:, 0] for values in (row, column))
    return image[row, column], jnp.stack([row, column], axis=-1)


def _similarity(distance: Float[Array, "n 4"], floor: Float[Array, "n 1"]) -> Float[Array, "n 4"]:
    largest = jnp.maximum(jnp.max(distance, axis=1, keepdims=True), floor)
    return jnp.where(largest > 0.0, 1.0 - distance / jnp.where(largest > 0.0, largest, 1.0), 1.0)


def _first_of_largest(*scores: Float[Array, "n 4"]) -> Int[Array, " n"]:
    """The index with the largest first score; ties (within `TIE`) go by the next one."""
    tied = jnp.ones_like(scores[0], bool)
    for score in scores:
        among = jnp.where(tied, score, -jnp.inf)
        tied = tied & (among >= jnp.max(among, axis=1, keepdims=True) - TIE)
    return jnp.argmax(tied, axis=1).astype(jnp.int32)
