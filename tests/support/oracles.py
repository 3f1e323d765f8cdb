"""Slow, plain NumPy and exact arithmetic: the third opinion that both packages are held against.

Everything is float64 and works from definitions: derivatives of Legendre polynomials, products of quadrature
rules, fractions. Conventions as in `jaxrender`: real, orthonormal, Condon-Shortley sign, index l(l+1)+m.
"""

import functools
import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
from numpy.polynomial import legendre


def sphere_rule(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and weights (n,): Gauss-Legendre in z times equal azimuths, exact up to `degree`."""
    z, w = legendre.leggauss(degree // 2 + 1)
    return product_rule(z, w, degree + 1)


def product_rule(z: np.ndarray, w: np.ndarray, num_azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and weights (n,) from a rule in z and equally spaced azimuths."""
    phi = 2.0 * np.pi * np.arange(num_azimuths) / num_azimuths
    s = np.sqrt(1.0 - z * z)
    directions = [(s[i] * np.cos(p), s[i] * np.sin(p), z[i]) for i in range(len(z)) for p in phi]
    return np.array(directions), np.repeat(w, num_azimuths) * 2.0 * np.pi / num_azimuths


def real_harmonics(directions: np.ndarray, order: int) -> np.ndarray:
    """y_lm (..., order²) from P_l^m = (-1)^m (1-z²)^(m/2) d^m P_l / dz^m and the azimuth φ."""
    z = directions[..., 2]
    s, phi = (
        np.hypot(directions[..., 0], directions[..., 1]),
        np.arctan2(directions[..., 1], directions[..., 0]),
    )
    columns = []
    for l in range(order):
        for m in range(-l, l + 1):
            mu = abs(m)
            derivative = legendre.legder([0.0] * l + [1.0], mu)
            p = (-s) ** mu * legendre.legval(z, derivative)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - mu) / math.factorial(l + mu))
            turn = math.sqrt(2.0) * (np.cos(mu * phi) if m > 0 else np.sin(mu * phi)) if m else 1.0
            columns.append(norm * p * turn)
    return np.stack(columns, axis=-1)


def project(function: Callable[[np.ndarray], np.ndarray], order: int, degree: int = 60) -> np.ndarray:
    """SH coefficients of f(directions (n, 3)) -> (n,), by a rule exact for f·y of total degree `degree`."""
    directions, weights = sphere_rule(degree)
    return (weights * function(directions)) @ real_harmonics(directions, order)


def zonal_coefficients(profile: Callable[[np.ndarray], np.ndarray], order: int, low: float, high: float) -> np.ndarray:
    """z_l of a function of x = cos θ that is smooth on [low, high] and zero elsewhere."""
    t, w = legendre.leggauss(200)
    x, w = (low + high + (high - low) * t) / 2.0, w * (high - low) / 2.0
    values = w * profile(x)
    return np.array(
        [
            2.0 * np.pi * math.sqrt((2 * l + 1) / (4 * np.pi)) * values @ legendre.legval(x, [0.0] * l + [1.0])
            for l in range(order)
        ]
    )


@functools.lru_cache(maxsize=4)
def triple_products(order: int) -> np.ndarray:
    """C_ijk = ∫ y_i y_j y_k by 64 × 64 nodes."""
    directions, weights = product_rule(*legendre.leggauss(64), 64)
    y = real_harmonics(directions, order)
    return np.einsum("q,qi,qj,qk->ijk", weights, y, y, y, optimize=True)


def operator_matrix(profile: Callable[[np.ndarray], np.ndarray], order: int, num_nodes: int = 400) -> np.ndarray:
    """∫ over the upper hemisphere of f(cos θ) y_i y_j, node by node on the sphere.

    Nodes are placed in t with cos θ = t⁴, which smooths an f like cos^0.37 at the horizon.
    """
    t, w = legendre.leggauss(num_nodes)
    t, w = (1.0 + t) / 2.0, w / 2.0
    directions, weights = product_rule(t**4, w * 4.0 * t**3, 2 * order)
    y = real_harmonics(directions, order)
    return y.T @ ((weights * profile(directions[:, 2]))[:, None] * y)


def phong_entry(alpha: Fraction, l: int, k: int, m: int) -> float:
    """M^α[lm, km], correctly rounded but for two roots: the Beta sum of the closed form, in fractions.

    The factor B(a, μ+1)/2 = μ! / (2 a (a+1) .. (a+μ)) is rational in α.
    """
    mu = abs(m)
    total = Fraction(0)
    for i in range((l - mu) // 2 + 1):
        for j in range((k - mu) // 2 + 1):
            a = (alpha + (l - mu - 2 * i) + (k - mu - 2 * j) + 1) / 2
            beta = Fraction(math.factorial(mu)) / math.prod(a + n for n in range(mu + 1))
            total += _legendre_term(l, mu, i) * _legendre_term(k, mu, j) * beta / 2
    norms = [Fraction((2 * b + 1) * math.factorial(b - mu), 2 * math.factorial(b + mu)) for b in (l, k)]
    return math.sqrt(norms[0]) * math.sqrt(norms[1]) * float(total)


def _legendre_term(l: int, mu: int, k: int) -> Fraction:
    """Coefficient of x^(l-μ-2k) in d^μ P_l / dx^μ."""
    below = 2**l * math.factorial(k) * math.factorial(l - k) * math.factorial(l - mu - 2 * k)
    return Fraction((-1) ** k * math.factorial(2 * l - 2 * k), below)


def phong_matrix(alpha: float, order: int) -> np.ndarray:
    """M^α (order², order²), each entry exact to a few units of float64 rounding."""
    matrix = np.zeros((order**2, order**2))
    for l in range(order):
        for k in range(order):
            for m in range(-min(l, k), min(l, k) + 1):
                matrix[l * (l + 1) + m, k * (k + 1) + m] = phong_entry(Fraction(alpha), l, k, m)
    return matrix


# The table of reference values of M^α, order 4, hexadecimal row and column, printed to seven decimals.
PHONG_TABLE = {
    1.0: {
        "00": 0.2500000, "02": 0.2886751, "06": 0.1397542, "0C": 0.0, "22": 0.3750000, "26": 0.2581989,
        "2C": 0.0954703, "66": 0.3125000, "6C": 0.2535463, "CC": 0.3281250, "11": 0.1875000, "15": 0.2236068,
        "1B": 0.1169268, "55": 0.3125000, "5B": 0.2390457, "BB": 0.3007813, "44": 0.1562500, "4A": 0.1889822,
        "AA": 0.2734375, "99": 0.1367188,
    },
    2.5: {
        "00": 0.1428571, "02": 0.1924501, "06": 0.1451992, "0C": 0.0678398, "22": 0.2727273, "26": 0.2317170,
        "2C": 0.1388659, "66": 0.2467532, "6C": 0.2052335, "CC": 0.2344498, "11": 0.0779221, "15": 0.1146702,
        "1B": 0.0971859, "55": 0.1818182, "5B": 0.1766703, "BB": 0.2105263, "44": 0.0519481, "4A": 0.0798115,
        "AA": 0.1339713, "99": 0.0382775,
    },
    20.0: {
        "00": 0.0238095, "06": 0.0462954, "0C": 0.0476035, "66": 0.0917184, "CC": 0.1025765, "11": 0.0031056,
        "BB": 0.0285024, "44": 0.0006211, "99": 0.0001610,
    },
}  # fmt: skip


def phong_closed_forms(alpha: float) -> dict[str, float]:
    """The 20 distinct entries of M^α, order 4, as rational functions: appendix A, errata put right."""
    a = alpha
    a1, a2, a3, a4, a5, a6, a7 = (a + i for i in range(1, 8))
    s = math.sqrt
    return {
        "00": 1 / (2 * a1),
        "02": s(3) / (2 * a2),
        "06": s(5) * a / (2 * a1 * a3),
        "0C": s(7) * (a - 1) / (2 * a2 * a4),
        "22": 3 / (2 * a3),
        "26": s(15) * a1 / (2 * a2 * a4),
        "2C": s(21) * a / (2 * a3 * a5),
        "66": 5 * (a * a + 2 * a + 3) / (2 * a1 * a3 * a5),
        "6C": s(35) * (a * a + 2 * a + 6) / (2 * a2 * a4 * a6),
        "CC": 7 * (a * a + 2 * a + 15) / (2 * a3 * a5 * a7),
        "11": 3 / (2 * a1 * a3),
        "15": 3 * s(5) / (2 * a2 * a4),
        "1B": 3 * s(14) * a / (2 * a1 * a3 * a5),
        "55": 15 / (2 * a3 * a5),
        "5B": 3 * s(70) * a1 / (2 * a2 * a4 * a6),
        "BB": 21 * (2 * a * a + 4 * a + 5) / (2 * a1 * a3 * a5 * a7),
        "44": 15 / (2 * a1 * a3 * a5),
        "4A": 15 * s(7) / (2 * a2 * a4 * a6),
        "AA": 105 / (2 * a3 * a5 * a7),
        "99": 105 / (2 * a1 * a3 * a5 * a7),
    }


# --- Random input


def unit(v: np.ndarray) -> np.ndarray:
    """Vectors along the last axis, of length 1."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def visibilities(rng: np.random.Generator, n: int) -> np.ndarray:
    """SH of order 4 of n hemispheres with one to four round occluders."""
    directions, weights = sphere_rule(60)
    y = real_harmonics(directions, 4)
    vectors = []
    for _ in range(n):
        seen = (directions[:, 2] > 0).astype(float)
        for _ in range(rng.integers(1, 5)):
            axis = rng.normal(size=3)
            axis *= np.sign(axis[2]) / np.linalg.norm(axis)
            seen *= directions @ axis < np.cos(rng.uniform(0.2, 0.8))
        vectors.append((weights * seen) @ y)
    return np.stack(vectors)
