"""Adaptive supersampling in a fixed amount of room: pure, for `jit`, `vmap` and gradients.

`adaptive.shade_adaptive` makes lists as long as they have to be; here a list has a length of its own, and a picture
that wants more says so. Differentiable in lights, materials, textures and attributes for fixed clusters; which samples
are chosen has no gradient.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxrender.checks import check_at_least
from jaxrender.deferred.clusters import Clusters, cluster_samples, is_uneven, shading_slope
from jaxrender.deferred.fxaa import luma
from jaxrender.deferred.metrics import shading_steps
from jaxrender.deferred.point_shading import TAPS, Lighting, shade_points
from jaxrender.deferred.sampling import cluster_points, first_sample, resolve_samples
from jaxrender.deferred.subsamples import SubSamples
from jaxrender.srgb import encode_srgb


def shade_adaptive_within(
    samples: SubSamples, lighting: Lighting, capacity: int, *, method: Clusters
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Int[Array, "h w"], Int[Array, ""]]:
    """The picture of `shade_adaptive` with `Clusters`; all samples of the second pass are shaded anew.

    Args:
      capacity: samples that may be shaded in a pass.
    Returns:
      image, alpha and count as in `AdaptiveImage`, and the demand: samples that a pass wanted. If it is above the
      capacity, the last pixels of the image are missing samples.
    """
    check_at_least("capacity", capacity, 1)
    height, width, n = samples.depth.shape
    fixed = jax.lax.stop_gradient(samples)
    covered = fixed.covered.reshape(-1, n)
    found, _ = fixed.look(jnp.arange(height * width * n, dtype=jnp.int32).reshape(-1, n))

    def clusters(slope: Float[Array, "p 2"]) -> Int[Array, "p n"]:
        return cluster_samples(
            found.normal, found.position, found.depth, found.material_id, covered, slope,
            normal_scale=method.normal * method.scale, plane_scale=method.plane * method.scale,
        )  # fmt: skip

    owner = clusters(jnp.zeros((height * width, 2), found.depth.dtype))
    whole = jnp.where(covered, first_sample(covered)[:, None], -1)
    owner = jnp.where(fixed.one_surface.reshape(-1, 1), whole, owner)
    image, detail = jax.lax.stop_gradient(_resolved(fixed, lighting, owner, capacity))
    light = luma(encode_srgb(image.reshape(height, width, 3)))
    steps = shading_steps(light, covered=covered.any(axis=-1).reshape(height, width))
    slope = shading_slope(
        steps.reshape(-1, 2), detail, light.reshape(-1), contrast_scale=method.contrast * method.scale,
        detail_scale=method.detail * method.scale,
    )  # fmt: skip
    finer = clusters(slope)
    more = is_uneven(slope, n) & (jnp.sum(_leads(finer), axis=-1) > jnp.sum(_leads(owner), axis=-1))
    demand = jnp.sum(_leads(owner))
    owner = jnp.where(more[:, None], finer, owner)
    image, _ = _resolved(samples, lighting, owner, capacity)
    count = jnp.sum(_leads(owner), axis=-1).reshape(height, width)
    alpha = jnp.mean(samples.covered.astype(image.dtype), axis=-1)
    return image.reshape(height, width, 3), alpha, count, jnp.maximum(demand, jnp.sum(count))


def _leads(owner: Int[Array, "p n"]) -> Array:
    """Which sub-samples stand for themselves."""
    return owner == jax.lax.broadcasted_iota(owner.dtype, owner.shape, 1)


def _resolved(
    samples: SubSamples, lighting: Lighting, owner: Int[Array, "p n"], capacity: int
) -> tuple[Float[Array, "p 3"], Float[Array, " p"]]:
    """Mean radiance and material detail of the pixels; what is beyond the capacity counts as black."""
    num_pixels, n = owner.shape
    (place,) = jnp.nonzero(_leads(owner).reshape(-1), size=capacity, fill_value=num_pixels * n)
    place = place.astype(jnp.int32)
    used = place < num_pixels * n
    pixel, sample = jnp.minimum(place // n, num_pixels - 1), place % n
    owners = owner[pixel]
    points = cluster_points(owners, sample)
    place = jnp.minimum(place, num_pixels * n - 1)
    alone = jnp.sum(owners == sample[:, None], axis=-1) == 1
    exact, *_ = shade_points(samples, lighting, place, points)
    wide, detail, _ = shade_points(samples, lighting, place, points, taps=TAPS)
    values = jnp.concatenate([jnp.where(alone[:, None], exact, wide), jnp.where(alone, 0.0, detail)[:, None]], axis=-1)
    sums = resolve_samples(values, points.weight, jnp.where(used, pixel, num_pixels), num_pixels=num_pixels)
    return sums[:, :3], sums[:, 3]
