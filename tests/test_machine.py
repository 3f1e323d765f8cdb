"""What is switched off in the compiler because it computes wrong numbers, and how much memory there is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender import machine


def test_sums_of_products_with_a_broadcast_factor_are_right():
    """jaxlib 0.10.2 alone is off by 10 here; see `machine.avoid_wrong_sums`."""
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(k, 40, 50, 3)).astype(np.float32) for k in (1, 9))

    def both(xp, a, b):
        return xp.maximum(xp.sum(a * b, axis=-1), 0.0) + xp.sum(b * b, axis=-1)

    np.testing.assert_allclose(jax.jit(lambda a, b: both(jnp, a, b))(a, b), both(np, a, b), rtol=1e-5, atol=1e-5)


def test_memory_is_the_smaller_of_machine_and_group(tmp_path, monkeypatch):
    """A container's limit counts where it is below what the machine has; "max" is none."""
    machine_alone = machine.available_memory()
    for limit, expected in (("3000\n", 2000), ("500\n", 0), ("max\n", None)):
        (tmp_path / "limit").write_text(limit)
        (tmp_path / "used").write_text("1000\n")
        monkeypatch.setattr(machine, "_GROUP_FILES", ((str(tmp_path / "limit"), str(tmp_path / "used")),))
        found = machine.available_memory()
        assert found == expected if expected is not None else (found is None) == (machine_alone is None)
    monkeypatch.setattr(machine, "available_memory", lambda: 2_000_000_000)
    machine.check_memory("a picture", 2_000_000_000)
    with pytest.raises(MemoryError, match=r"a picture: about 3\.5 GB needed, 2\.0 GB available"):
        machine.check_memory("a picture", 3_500_000_000)
