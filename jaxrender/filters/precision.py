"""What filters compute in: float32 at least, planes apart."""

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float


def working(dtype: DTypeLike) -> np.dtype:
    """float32 for half precision, else the dtype itself."""
    return jnp.dtype(jnp.float32 if jnp.finfo(dtype).bits < 32 else dtype)


def planes_of(image: Float[Array, "h w c"]) -> Float[Array, "c h w"]:
    """The channels as planes, in the precision to compute in."""
    return jnp.moveaxis(image.astype(working(image.dtype)), -1, 0)
