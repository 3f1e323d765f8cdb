"""The spherical-harmonic basis itself, for every room: real, orthonormal, Condon-Shortley sign, index l(l+1)+m."""

import math
from typing import Any

import numpy as np
from jaxtyping import Array, Float


def basis_columns(
    x: Float[Array | np.ndarray, "*b"],
    y: Float[Array | np.ndarray, "*b"],
    z: Float[Array | np.ndarray, "*b"],
    *,
    order: int,
) -> list[Float[Array | np.ndarray, "*b"]]:
    """The order**2 basis functions as a list of arrays shaped like x; from NumPy or JAX arrays alike.

    With (x + iy)^m = c_m + i s_m and the Legendre part Q_l^m(z) = P_l^m(z) / (1 - z²)^{m/2}, normalised,
    y_{l,m} = √2 (-1)^m Q_l^m c_m and y_{l,-m} = √2 (-1)^m Q_l^m s_m. Q obeys the usual three-term
    recurrence upward in l, which is stable.
    """
    columns: list = [None] * order**2
    c: Any = 1.0
    s: Any = 0.0
    q: Any
    previous: Any
    diagonal = 1.0 / math.sqrt(4.0 * math.pi)
    for m in range(order):
        # Q of l = m is a number, of l = m+1 a multiple of z; the factors of both columns go in here.
        previous, q = 0.0, diagonal * ((-1) ** m * math.sqrt(2.0) if m else 1.0)
        for l in range(m, order):
            if l == m + 1:
                previous, q = q, math.sqrt(2 * m + 3) * q * z
            elif l > m + 1:
                a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
                b = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
                previous, q = q, a * (z * q - b * previous)
            columns[l * (l + 1) + m] = q * c if m or l else z * 0.0 + q
            if m:
                columns[l * (l + 1) - m] = q * s
        c, s = (x, y) if m == 0 else (x * c - y * s, x * s + y * c)
        diagonal *= math.sqrt((2 * m + 3) / (2 * m + 2))
    return columns
