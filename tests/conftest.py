"""Strict settings for every test, and the fixtures that several folders share."""

import pathlib
from collections.abc import Iterator

import jax
import numpy as np
import pytest

from jaxrender.machine import keep_xla_to_one_thread

keep_xla_to_one_thread()

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_nans", True)

SHARED_DATA = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> pathlib.Path:
    """The folder of real characters, motion capture and environment maps; skips where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the shared test data (../shared/data) is not here")
    return SHARED_DATA


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20081)


@pytest.fixture
def x64():
    """The test runs in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float32", "float64"])
def dtype(request) -> Iterator[np.dtype]:
    """The test runs in either precision."""
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


@pytest.fixture(scope="module", autouse=True)
def _forget_programs() -> Iterator[None]:
    """Thousands of compiled programs in one process come to the limit of its memory maps, and XLA crashes there."""
    yield
    jax.clear_caches()
