"""Light without the texture it falls on. One image `(h, w, c)`; batches by `vmap`."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrender import checks


def demodulate(
    radiance: Float[Array, "h w c"], albedo: Float[Array, "h w c"], *, floor: float = 1e-3
) -> Float[Array, "h w c"]:
    """Radiance divided by albedo: incident light on a diffuse surface, which varies slower than what it shines on.

    A channel with an albedo below `floor` tells nothing of the light: it gets the mean of those that do, lest its
    neighbours learn that there is none. Where no channel does, or the albedo is not finite, radiance is left as it is.
    Differentiable but for the choice.

    Raises:
      ValueError: if the shapes differ.
    """
    checks.check_same_shape("radiance and albedo", radiance, albedo)
    known = _known(albedo, floor)
    light = jnp.where(known, radiance / jnp.where(known, albedo, jnp.ones_like(albedo)), jnp.zeros_like(radiance))
    count = jnp.sum(known.astype(radiance.dtype), axis=-1, keepdims=True)
    mean = jnp.sum(light, axis=-1, keepdims=True) / jnp.maximum(count, jnp.ones_like(count))
    return jnp.where(known, light, jnp.where(count > 0.0, mean, radiance))


def remodulate(
    light: Float[Array, "h w c"], albedo: Float[Array, "h w c"], *, floor: float = 1e-3
) -> Float[Array, "h w c"]:
    """Light times albedo, where `demodulate` with the same floor has divided by it.

    Undoes `demodulate`, but for channels below the floor beside others above it; there it gives what the light of the
    others would.
    """
    checks.check_same_shape("light and albedo", light, albedo)
    seen = jnp.any(_known(albedo, floor), axis=-1, keepdims=True)
    return jnp.where(seen, light * jnp.where(seen, albedo, jnp.ones_like(albedo)), light)


def _known(albedo, floor: float):
    return jnp.all(jnp.isfinite(albedo), axis=-1, keepdims=True) & (albedo >= floor)
