"""Owen-scrambled Sobol points by hashing, word by word, in integers of 64 bits.

References:
  Burley, "Practical Hash-based Owen Scrambling", JCGT 9(4), 2020.
"""

import math

import torch
from jaxtyping import Float, Int, UInt32
from torch import Tensor

Words = UInt32[Tensor, "*b"]

_ALL = 0xFFFFFFFF


def pixel_seeds(pixel: Int[Tensor, "*b"], seed: int | Int[Tensor, ""]) -> Words:
    """The hash of the pixel's number, once the hash of the picture's is mixed in."""
    return _words(_hash(_wide(pixel) ^ _hash(torch.as_tensor(seed).long() & _ALL)))


def uniform_pair(
    index: Int[Tensor, "*b"], seed: Words, *, dimension: int | Int[Tensor, ""]
) -> tuple[Float[Tensor, "*b"], ...]:
    """Point `index` of the sequence of a seed and a pair of dimensions (Burley 2020, sec. 4)."""
    own = _hash(_wide(seed) ^ ((0x9E3779B9 * (dimension + 1)) & _ALL))
    place = _scrambled(_wide(index), own)
    first, second = (_scrambled(_sobol(place, axis), _hash((own + axis + 1) & _ALL)) for axis in (0, 1))
    # A float32 holds 24 bits.
    return tuple(((x >> 8).double() * 2.0**-24).float() for x in (first, second))


def hash_words(x: Words) -> Words:
    """lowbias32 of Wellons, "Prospecting for Hash Functions", 2018."""
    return _words(_hash(_wide(x)))


def reverse_bits(x: Words) -> Words:
    """Bit i becomes bit 31 - i."""
    return _words(_reversed(_wide(x)))


def _wide(x: Tensor) -> Tensor:
    return x.to(torch.int64) & _ALL


def _words(x: Tensor) -> Tensor:
    return x.to(torch.uint32)


def _times(x: Tensor, factor: int | Tensor) -> Tensor:
    """Modulo 2³²: in two halves, so that no product leaves 63 bits."""
    high, low = factor >> 16, factor & 0xFFFF
    return (x * low + (((x * high) & _ALL) << 16)) & _ALL


def _hash(x: Tensor) -> Tensor:
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        x = _times(x ^ (x >> shift), factor)
    return x ^ (x >> 16)


def _bit(x: Tensor, i: int) -> Tensor:
    return (x >> i) & 1


def _reversed(x: Tensor) -> Tensor:
    return sum(_bit(x, i) << (31 - i) for i in range(32))


def _sobol(index: Tensor, axis: int) -> Tensor:
    """Digit i after the point is the sum over j of C_ij times bit j of the index, modulo 2.

    C is the identity in the first dimension; in the second, whose polynomial is x + 1, Pascal's triangle.
    """
    result = torch.zeros_like(index)
    for i in range(32):
        used = [j for j in range(32) if (math.comb(j, i) % 2 if axis else i == j)]
        digit = sum(_bit(index, j) for j in used) % 2
        result = result | (digit << (31 - i))
    return result


def _scrambled(x: Tensor, seed: Tensor) -> Tensor:
    """Nested uniform scrambling, from the first digit on: hash of Laine and Karras, constants of Vegdahl (2021)."""
    x = _reversed(x)
    x = x ^ _times(x, 0x3D20ADEA)
    x = _times((x + seed) & _ALL, (seed >> 16) | 1)
    for factor in (0x05526C56, 0x53A22864):
        x = x ^ _times(x, factor)
    return _reversed(x)
