"""Band by band, as on the whole image, bit for bit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.filters import (
    atrous_filter,
    box_mean,
    cross_bilateral_filter,
    guided_filter,
    guided_filter_in_bands,
    in_bands,
)
from jaxrender.filters.guided_rows import restart_rows


@pytest.fixture(autouse=True)
def nan_in_all_threads():
    """Unlike `jax.debug_nans`: bands are computed by threads, and images here have NaN pixels."""
    jax.config.update("jax_debug_nans", False)
    yield
    jax.config.update("jax_debug_nans", True)


def images(height: int, width: int, *, g: int, c: int) -> tuple[np.ndarray, np.ndarray]:
    """Guide, and an image of large numbers with spikes; some pixels of either are NaN."""
    rng = np.random.default_rng(height)
    guide = rng.random((height, width, g), dtype=np.float32)
    image = 1e3 * rng.random((height, width, c), dtype=np.float32) ** 8
    guide[rng.random((height, width)) < 0.02] = np.nan
    image[rng.random((height, width)) < 0.02, 0] = np.inf
    return guide, image


def whole(guide, image, *, radius: int, eps) -> np.ndarray:
    return np.asarray(jax.jit(functools.partial(guided_filter, radius=radius, eps=eps))(guide, image))


@pytest.mark.parametrize(
    ("size", "radius", "rows"),
    [
        ((150, 33), 3, 50),  # rounded up to 64, where sums start afresh at every 32
        ((270, 21), 40, 100),  # 128, and the last band lies within the halo of the first
        ((40, 7), 1, None),  # by cores
    ],
)
def test_the_guided_filter_is_the_same(size, radius, rows, tmp_path):
    """From files that are cut, not read as a whole."""
    guide, image = images(*size, g=2, c=1)
    eps = np.array([0.01, 0.03], np.float32)
    for name, array in (("guide", guide), ("image", image)):
        np.save(tmp_path / f"{name}.npy", array)
    files = [np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in ("guide", "image")]
    assert all(isinstance(file, np.memmap) for file in files)
    bands = list(guided_filter_in_bands(*files, radius=radius, eps=[0.01, 0.03], rows=rows))
    found = np.concatenate(bands)
    if rows is not None:
        step = restart_rows(radius)
        assert {len(band) for band in bands[:-1]} == {-(-rows // step) * step} and len(bands) > 1
    np.testing.assert_array_equal(found, whole(guide, image, radius=radius, eps=eps))
    assert np.isfinite(found).all()


def test_float64_stays_float64(x64):
    guide, image = (x.astype(np.float64) for x in images(40, 7, g=1, c=1))
    found = np.concatenate(list(guided_filter_in_bands(guide, image, radius=1, eps=0.01, rows=40)))
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, whole(guide, image, radius=1, eps=0.01))


def test_restarts_are_further_apart_than_windows_are_high():
    for radius in range(300):
        step = restart_rows(radius)
        assert step >= max(32, 2 * radius) and step & (step - 1) == 0


@pytest.mark.parametrize("rows", [1, 7, 16, 100])
def test_any_filter_with_its_halo(rows):
    _, image = images(45, 11, g=1, c=2)
    mean = jax.jit(functools.partial(box_mean, radius=3), compiler_options={"xla_backend_optimization_level": 0})
    bands = list(in_bands(mean, (image,), rows=rows, halo=3))
    assert [len(band) for band in bands] == [min(rows, 45 - start) for start in range(0, 45, rows)]
    np.testing.assert_array_equal(np.concatenate(bands), mean(image))


@pytest.mark.parametrize(
    ("function", "halo"),
    [
        (functools.partial(cross_bilateral_filter, radius=4, sigma_spatial=2.0, sigma_features=0.3), 4),
        (functools.partial(atrous_filter, num_levels=3, sigma_features=0.3), 14),
        (functools.partial(atrous_filter, num_levels=2, sigma_features=0.3, sigma_color=0.5), 6),
    ],
    ids=["bilateral", "atrous", "atrous with colour"],
)
def test_the_halos_that_rivals_need(function, halo):
    """Those in the docstring of `in_bands`: enough for the same bits, and one row less is not."""
    guide, image = images(60, 13, g=2, c=1)
    image = np.clip(image, 0.0, 1e3)
    compiled = jax.jit(function, compiler_options={"xla_backend_optimization_level": 0})
    whole = np.asarray(compiled(image, guide))
    found = np.concatenate(list(in_bands(compiled, (image, guide), rows=20, halo=halo)))
    np.testing.assert_array_equal(found, whole)
    short = np.concatenate(list(in_bands(compiled, (image, guide), rows=20, halo=halo - 1)))
    assert (short != whole).any()


def test_halos_and_channels_may_differ():
    """A pixel minus the one 2 rows above and the one below, of images with other channels."""
    a, b = np.arange(30.0, dtype=np.float32).reshape(10, 3, 1) ** 2, np.ones((10, 3, 2), np.float32)

    def function(a, b):
        padded = jnp.pad(a, ((2, 1), (0, 0), (0, 0)))
        return (a - padded[:-3] - padded[3:]) * b

    bands = in_bands(function, (a, b), rows=4, halo=(2, 1))
    np.testing.assert_array_equal(np.concatenate(list(bands)), function(a, b))
    wrong = np.concatenate(list(in_bands(function, (a, b), rows=4, halo=1)))
    assert (wrong != function(a, b)).any()


def test_bands_come_one_by_one():
    """Nothing is read before the first band is asked for."""
    seen = []

    class Recorder:
        shape = (8, 2, 1)

        def __getitem__(self, rows):
            seen.append((rows.start, rows.stop))
            return np.zeros((rows.stop - rows.start, 2, 1), np.float32)

    bands = in_bands(lambda x: x, (Recorder(),), rows=4, halo=1)
    assert seen == []
    next(bands)
    assert seen[0] == (0, 5)
    assert len(list(bands)) == 1 and seen[1:] == [(3, 8)]


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        ([(4, 3, 1), (5, 3, 1)], {"rows": 2, "halo": 1}, r"images: expected one height, got \[4, 5\]"),
        ([(4, 3, 1)], {"rows": 0, "halo": 1}, "rows: expected a value >= 1, got 0"),
        ([(4, 3, 1)], {"rows": 2, "halo": -1}, "halo: expected a value >= 0, got -1"),
        ([(4, 3, 1)], {"rows": 2, "halo": (0, -2)}, "halo: expected a value >= 0, got -2"),
    ],
)
def test_bad_input_is_refused(images, options, message):
    with pytest.raises(ValueError, match=message):
        in_bands(lambda x: x, [np.zeros(shape, np.float32) for shape in images], **options)


@pytest.mark.parametrize(
    ("shapes", "options", "message"),
    [
        ([(4, 3, 1), (5, 3, 1)], {}, "guide and image: expected one height and width"),
        ([(4, 3, 1), (4, 3, 1)], {"rows": 0}, "rows: expected a value >= 1"),
        ([(4, 3, 1), (4, 3, 1)], {"radius": -1}, "radius: expected a value >= 0"),
        ([(4, 3, 1), (4, 2, 1)], {}, "guide and image: expected one height and width"),
        ([(4, 3, 1), (4, 3, 1)], {"eps": [0.1, 0.2]}, "eps: expected shape"),
    ],
)
def test_bad_input_of_the_guided_filter_is_refused(shapes, options, message):
    arrays = [np.zeros(shape, np.float32) for shape in shapes]
    with pytest.raises(ValueError, match=message):
        list(guided_filter_in_bands(*arrays, **{"radius": 1, "eps": 0.1} | options))
