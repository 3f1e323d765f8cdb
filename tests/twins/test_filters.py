"""jaxrender.filters against the twin, kernel by kernel: values and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from jaxrender import filters
from tests.twins.agreement import cases_of, check
from torchref import filters as twins


@pytest.mark.parametrize(("case", "dtype"), cases_of("filters."))
def test_twin(case, dtype):
    with jax.debug_nans(False):  # which are in some of the images; results and derivatives are held against numbers
        check(case, dtype)


def test_valid_pixels(rng):
    """It takes its images one after another, which a case cannot."""
    first, second = rng.normal(size=(2, 5, 6, 3)).astype(np.float32)
    first[1, 2, 0], first[3, 3, 2], second[3, 3, 0], second[4, 5, 1] = np.nan, np.inf, -np.inf, np.nan
    for images in ((first,), (first, second), (second[..., :1], first[..., 1:], second)):
        with jax.debug_nans(False):
            ours = filters.valid_pixels(*map(jnp.asarray, images))
        np.testing.assert_array_equal(ours, twins.valid_pixels(*map(torch.tensor, images)))
