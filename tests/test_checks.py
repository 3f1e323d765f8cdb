"""The checks of arguments and of data: what they let pass, and what they say."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender import checks


def test_bad_input_names_place_field_rule_and_value():
    with pytest.raises(checks.InputError, match=r"^a\.glb: joints\[3\]: expected an index below 4, got 9$"):
        checks.bad_input("a.glb", "joints[3]", expected="an index below 4", got=9)
    # Callers that know nothing of this package still catch it.
    assert issubclass(checks.InputError, ValueError)


def test_last_axis():
    checks.check_last_axis("v", jnp.zeros((2, 3)), 3)
    for array in (jnp.zeros((3, 2)), jnp.zeros(())):
        with pytest.raises(ValueError, match=r"v: expected shape \(\.\.\., 3\), got "):
            checks.check_last_axis("v", array, 3)


def test_same_shape():
    checks.check_same_shape("image and guide", np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"image and guide: expected one shape, got \(2, 3\) and \(3,\)"):
        checks.check_same_shape("image and guide", np.zeros((2, 3)), np.zeros(3))


def test_at_least():
    checks.check_at_least("radius", 1, 1)
    for value in (0, -1.5, float("nan")):
        with pytest.raises(ValueError, match="radius: expected a value >= 1, got"):
            checks.check_at_least("radius", value, 1)


def test_whole():
    checks.check_whole("radius", np.int64(3), 0)
    for value in (2.5, 2.0, True, "2"):
        with pytest.raises(ValueError, match=f"radius: expected a whole number >= 0, got {value}"):
            checks.check_whole("radius", value, 0)
    with pytest.raises(ValueError, match="radius: expected a value >= 0, got -1"):
        checks.check_whole("radius", -1, 0)


def test_above_0():
    for value in (1e-30, [0.1, 2], np.ones((2, 3)), jnp.zeros(3)):  # arrays of JAX are not looked at
        checks.check_above_0("eps", value)
    for value, wrong in ((0, "0"), (-1.0, "-1.0"), ([1.0, 0.0], "0.0"), (np.array([2.0, np.inf]), "inf")):
        with pytest.raises(ValueError, match=f"eps: expected finite numbers above 0, got {wrong}"):
            checks.check_above_0("eps", value)


def test_one_of():
    checks.check_one_of("mode", "flat", ("flat", "linear"))
    with pytest.raises(ValueError, match="mode: expected one of flat, linear, got cubic"):
        checks.check_one_of("mode", "cubic", ("flat", "linear"))


def test_order():
    checks.check_order(1)
    checks.check_order(4, 16)
    with pytest.raises(ValueError, match="order: expected a value >= 1, got 0"):
        checks.check_order(0)
    with pytest.raises(ValueError, match="sh: expected 16 coefficients for order 4, got 15"):
        checks.check_order(4, 15)


def test_finite_counts_and_points():
    checks.check_finite("a.exr", "pixels", np.zeros((2, 2)))
    bad = np.zeros((3, 4))
    bad[1, 2], bad[2, 0] = np.nan, -np.inf
    message = r"a\.exr: pixels: expected finite numbers, got 2 NaN or Inf, first at \(1, 2\)"
    with pytest.raises(checks.InputError, match=message):
        checks.check_finite("a.exr", "pixels", bad)
