"""What is switched off in the compiler because it computes wrong numbers."""

import jax
import jax.numpy as jnp
import numpy as np


def test_sums_of_products_with_a_broadcast_factor_are_right():
    """jaxlib 0.10.2 alone is off by 10 here; see `machine.avoid_wrong_sums`."""
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(k, 40, 50, 3)).astype(np.float32) for k in (1, 9))

    def both(xp, a, b):
        return xp.maximum(xp.sum(a * b, axis=-1), 0.0) + xp.sum(b * b, axis=-1)

    np.testing.assert_allclose(jax.jit(lambda a, b: both(jnp, a, b))(a, b), both(np, a, b), rtol=1e-5, atol=1e-5)
