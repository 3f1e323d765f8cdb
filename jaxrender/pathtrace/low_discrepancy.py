"""Uniform numbers that fill the square evenly: Owen-scrambled Sobol points, by hashing alone.

Every pixel has a sequence of its own, and every pair of dimensions a scrambling and an order of its own ("padding"), so
that pairs are independent of one another and each fills its square. Nothing is stored: point i of a sequence is
computed from i. All functions are pointwise over any leading axes and exact integer arithmetic: the same everywhere.

References:
  Burley, "Practical Hash-based Owen Scrambling", JCGT 9(4), 2020.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

Words = UInt32[Array, "*b"]


def pixel_seeds(pixel: Int[Array, "*b"], seed: int | Int[Array, ""]) -> Words:
    """A seed for each pixel from its number and that of the picture."""
    return hash_words(pixel.astype(jnp.uint32) ^ hash_words(jnp.asarray(seed).astype(jnp.uint32)))


def uniform_pair(
    index: Int[Array, "*b"], seed: Words, *, dimension: int | Int[Array, ""]
) -> tuple[Float[Array, "*b"], ...]:
    """Two numbers in [0, 1): point `index` of the sequence of a seed.

    Any 2^k points from a multiple of 2^k on are stratified: one falls in each of the 2^k elementary boxes of every
    shape.

    Args:
      index: below 2^31, broadcast against `seed`.
      dimension: which pair of dimensions; each is a sequence of its own.
    """
    own = hash_words(seed ^ ((jnp.asarray(dimension).astype(jnp.uint32) + jnp.uint32(1)) * jnp.uint32(0x9E3779B9)))
    shuffled = reverse_bits(_permuted(reverse_bits(index.astype(jnp.uint32)), own))
    first = reverse_bits(_permuted(shuffled, hash_words(own + jnp.uint32(1))))
    second = reverse_bits(_permuted(_pascal(shuffled), hash_words(own + jnp.uint32(2))))
    return _fraction(first), _fraction(second)


def hash_words(x: Words) -> Words:
    """A well mixed bijection of 32-bit words.

    References:
      Wellons, "Prospecting for Hash Functions", 2018 (lowbias32).
    """
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)


def reverse_bits(x: Words) -> Words:
    """Bit 0 becomes bit 31, and so on."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> shift) & jnp.uint32(mask)) | ((x & jnp.uint32(mask)) << shift)
    return (x >> 16) | (x << 16)


def _permuted(x: Words, seed: Words) -> Words:
    """Owen scrambling of reversed digits: every bit is flipped or not by a hash of those below it (Burley, sec. 3).

    References:
      Constants: Vegdahl, "Building a Better LK Hash", 2021.
    """
    x = x ^ (x * jnp.uint32(0x3D20ADEA))
    x = (x + seed) * ((seed >> 16) | jnp.uint32(1))
    x = x ^ (x * jnp.uint32(0x05526C56))
    return x ^ (x * jnp.uint32(0x53A22864))


def _pascal(x: Words) -> Words:
    """The second Sobol dimension, reversed: Pascal's triangle modulo 2, the Kronecker power of [[1, 1], [0, 1]]."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        x = x ^ ((x >> shift) & jnp.uint32(mask))
    return x


def _fraction(x: Words) -> Float[Array, "*b"]:
    """The upper 24 bits as a number in [0, 1)."""
    return (x >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)
