"""Owen-scrambled Sobol points: every elementary box, independence of pixels and dimensions, hashes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrender.pathtrace.low_discrepancy import _permuted, hash_words, pixel_seeds, reverse_bits, uniform_pair


def points(seed: int, dimension: int, *, start: int = 0, count: int = 256) -> np.ndarray:
    """(count, 2) in float64, which holds the 24 bits and products with powers of two."""
    index = jnp.arange(start, start + count, dtype=jnp.int32)
    pair = uniform_pair(index, jnp.full(count, seed, jnp.uint32), dimension=dimension)
    return np.stack([np.asarray(x, np.float64) for x in pair], axis=1)


@pytest.mark.parametrize("start", [0, 256, 3 * 256, 2**31 - 256])
@pytest.mark.parametrize("dimension", [0, 1, 7, 1001])
@pytest.mark.parametrize("seed", [0, 1, 0xDEADBEEF])
def test_each_elementary_box_of_every_shape_holds_one_point(seed, dimension, start):
    p = points(seed, dimension, start=start)
    assert (p >= 0.0).all() and (p < 1.0).all()
    for k in range(9):
        box = np.floor(p * [2**k, 2 ** (8 - k)]).astype(int)
        counts = np.bincount(box[:, 0] * 2 ** (8 - k) + box[:, 1], minlength=256)
        assert (counts == 1).all(), f"{2**k} x {2 ** (8 - k)}: {(counts == 0).sum()} boxes are empty"


@pytest.mark.parametrize("count", [1, 2, 4, 16, 64])
def test_shorter_runs_are_stratified_too(count):
    """So that the first samples of a picture are as good as they can be."""
    for start in (0, count, 5 * count):
        p = points(11, 2, start=start, count=count)
        for axis in (0, 1):
            np.testing.assert_array_equal(np.sort(np.floor(p[:, axis] * count)), np.arange(count))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Times √n: normal with deviation 1 if independent."""
    a, b = (np.ravel(x - 0.5) / np.sqrt(1 / 12) for x in (a, b))
    return float((a * b).sum() / np.sqrt(a.size))


def test_pixels_and_dimensions_are_not_correlated():
    """4096 neighbouring pixels: 4 deviations are one in 16,000 by chance, of 20 numbers here."""
    seeds = pixel_seeds(jnp.arange(4097, dtype=jnp.int32), 0)
    first = {}
    for dimension in range(4):
        pair = uniform_pair(jnp.zeros(4097, jnp.int32), seeds, dimension=dimension)
        first[dimension] = [np.asarray(x, np.float64) for x in pair]
    numbers = [x for pair in first.values() for x in pair]
    found = [correlation(x[1:], x[:-1]) for x in numbers]
    found += [correlation(numbers[i], numbers[j]) for i in range(8) for j in range(i)]
    assert len(found) == 36 and np.abs(found).max() < 4.0


def test_pairs_of_dimensions_are_not_correlated_within_a_pixel():
    """Their order is shuffled apart: else point i of one would always meet point i of another."""
    products = []
    for seed in range(200):
        a, b = points(seed, 0, count=16), points(seed, 1, count=16)
        products.append([correlation(a[:, i], b[:, j]) for i in (0, 1) for j in (0, 1)])
    # Within a sequence of 16 stratified points a correlation has a deviation of about 1, over 200 of 1/√200.
    assert np.abs(np.mean(products, axis=0)).max() < 4.0 / np.sqrt(200)


def test_another_seed_is_another_picture():
    one, other = (np.asarray(pixel_seeds(jnp.arange(1000, dtype=jnp.int32), seed)) for seed in (0, 1))
    assert len(np.unique(np.concatenate([one, other]))) == 2000


@pytest.mark.parametrize("index", [0, 1, 5])
def test_one_index_of_all_pixels_is_uniform(index):
    """Chi-square over 16 x 16 boxes: 255 degrees of freedom, mean 255, deviation 22.6."""
    seeds = pixel_seeds(jnp.arange(25_600, dtype=jnp.int32), 3)
    u, v = (np.asarray(x) for x in uniform_pair(jnp.full(25_600, index, jnp.int32), seeds, dimension=2))
    counts, _, _ = np.histogram2d(u, v, bins=16, range=[(0, 1), (0, 1)])
    assert abs(((counts - 100.0) ** 2 / 100.0).sum() - 255.0) < 4.0 * np.sqrt(2 * 255)


def test_reverse_bits_is_that_of_numpy(rng):
    x = rng.integers(0, 2**32, 1000, dtype=np.uint32)
    bits = np.unpackbits(x.view(np.uint8).reshape(-1, 4), axis=1, bitorder="little")
    expected = np.packbits(bits[:, ::-1], axis=1, bitorder="little").view(np.uint32)[:, 0]
    np.testing.assert_array_equal(reverse_bits(jnp.asarray(x)), expected)


def unmixed(x: np.ndarray) -> np.ndarray:
    """`hash_words` backwards: shifts undone, factors inverted modulo 2³²."""
    mask = np.uint64(2**32 - 1)
    x = x.astype(np.uint64)
    x = x ^ (x >> np.uint64(16))
    x = (x * np.uint64(pow(0x846CA68B, -1, 2**32))) & mask
    x = x ^ (x >> np.uint64(15)) ^ (x >> np.uint64(30))
    x = (x * np.uint64(pow(0x7FEB352D, -1, 2**32))) & mask
    return (x ^ (x >> np.uint64(16))).astype(np.uint32)


def test_hashing_is_a_bijection(rng):
    x = np.concatenate([np.arange(50_000, dtype=np.uint32), rng.integers(0, 2**32, 50_000, dtype=np.uint32)])
    np.testing.assert_array_equal(unmixed(np.asarray(hash_words(jnp.asarray(x)))), x)


def test_each_bit_of_a_word_turns_half_of_its_hash(rng):
    x = rng.integers(0, 2**32, 2000, dtype=np.uint32)
    for bit in range(32):
        changed = np.asarray(hash_words(jnp.asarray(x)) ^ hash_words(jnp.asarray(x ^ np.uint32(1 << bit))))
        share = np.unpackbits(changed.view(np.uint8).reshape(-1, 4), axis=1).mean(axis=0)
        assert np.abs(share - 0.5).max() < 0.1, bit


def test_scrambling_flips_a_bit_by_those_below_it(rng):
    """What makes it Owen's: words that agree up to a bit still agree there, and their flip is the same."""
    x, seed = (jnp.asarray(rng.integers(0, 2**32, 500, dtype=np.uint32)) for _ in range(2))
    for bit in range(32):
        other = x ^ jnp.uint32(1 << bit)
        differ = np.asarray(_permuted(x, seed) ^ _permuted(other, seed))
        assert (differ & ((1 << bit) - 1) == 0).all() and ((differ >> bit) & 1 == 1).all()


def test_compiled_and_mapped_is_the_same():
    seeds = pixel_seeds(jnp.arange(8, dtype=jnp.int32), 5)
    index = jnp.arange(8, dtype=jnp.int32)
    pair = lambda i, s: uniform_pair(i, s, dimension=4)  # noqa: E731
    for function in (jax.jit(pair), jax.vmap(pair)):
        for a, b in zip(pair(index, seeds), function(index, seeds), strict=True):
            np.testing.assert_array_equal(a, b)
