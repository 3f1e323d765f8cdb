"""Light as SH coefficients per colour channel: environment maps and lamps.

A light has shape (c, order**2), world axes (right-handed, +Y up), radiance per channel. All is differentiable in its
arrays.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrender.checks import check_at_least, check_order
from jaxrender.harmonics.sh import bands, basis_columns, order_of, sh_basis
from jaxrender.harmonics.zh import zh_to_sh
from jaxrender.latlong import azimuths, environment_directions, solid_angles
from jaxrender.vecmath import constant_like, einsum


def _waves(phi: np.ndarray, order: int) -> np.ndarray:
    """1, cos φ, sin φ, cos 2φ, ... up to order-1: (n, 2·order-1)."""
    m = (np.arange(2 * order - 1) + 1) // 2
    angles = phi[:, None] * m
    return np.where(np.arange(2 * order - 1) % 2, np.cos(angles), np.sin(angles) + (m == 0))


def _row_table(height: int, order: int) -> np.ndarray:
    """T[row, wave, k]: y_k along a row of the map is Σ T · wave(φ), a trigonometric polynomial of order-1.

    Its 2·order-1 terms are found exactly from as many azimuths.
    """
    count = 2 * order - 1
    directions, _ = environment_directions(height, count)
    basis = np.stack(basis_columns(*np.moveaxis(directions, -1, 0), order=order), axis=-1)
    norm = np.where(np.arange(count) == 0, 1.0, 2.0) / count
    return np.einsum("hjk,jt->htk", basis, _waves(azimuths(count), order) * norm)


def project_environment(image: Float[Array, "h w c"], *, order: int) -> Float[Array, "c k"]:
    """Projects a latitude-longitude radiance map on SH, one vector per channel: Σ pixel · solid angle · y.

    Rows first go into Fourier sums of their azimuth, of which the harmonics of a row are made: 2·order-1
    numbers per pixel row instead of order² per pixel, and no array larger than the image.

    Args:
      image: linear radiance; row 0 is +Y, the middle looks down -Z, columns turn towards +X. It must be
        finite (`jaxrender.io.read_environment` sees to that).
    Raises:
      ValueError: if order < 1, or the image has not three axes.
    """
    check_order(order)
    if image.ndim != 3:
        raise ValueError(f"image: expected shape (h, w, c), got {tuple(image.shape)}")
    height, width = image.shape[:2]
    waves = _waves(azimuths(width), order)
    table = _row_table(height, order) * solid_angles(height, width)[:, None, None]
    rows = einsum("hwc,wt->htc", image, jnp.asarray(waves, dtype=image.dtype))
    return einsum("htc,htk->ck", rows, jnp.asarray(table, dtype=image.dtype))


def sh_directional_light(
    direction: Float[Array, "*#b 3"], radiance: Float[Array, "*#b c"], *, order: int
) -> Float[Array, "*b c k"]:
    """A lamp at infinity: `radiance` · δ(s - direction), as radiance · y(direction).

    Args:
      direction: unit vector towards the lamp.
      radiance: irradiance on a plane that faces the lamp, per channel.
    Raises:
      ValueError: if order < 1, or a direction has not three components.
    """
    return radiance[..., :, None] * sh_basis(direction, order=order)[..., None, :]


def sh_area_light(
    direction: Float[Array, "*#b 3"],
    radius_radians: Float[Array, "*#b"],
    radiance: Float[Array, "*#b c"],
    *,
    order: int,
) -> Float[Array, "*b c k"]:
    """A disc of sky: constant radiance within `radius_radians` (0..π) of a unit direction.

    z_l = 2π √((2l+1)/4π) ∫_{cos r}^1 P_l, written with sin² r and P'_l so that a small disc does not cancel.

    Raises:
      ValueError: if order < 1, or a direction has not three components.
    """
    check_order(order)
    x = jnp.cos(radius_radians)
    sine2 = jnp.sin(radius_radians) ** 2
    # p' obeys P'_{l+1} = P'_{l-1} + (2l+1) P_l, and ∫_x^1 P_l = (1-x²) P'_l(x) / (l(l+1)).
    p, dp = [jnp.ones_like(x), x], [jnp.zeros_like(x), jnp.ones_like(x)]
    for l in range(1, order):
        p.append(((2 * l + 1) * x * p[l] - l * p[l - 1]) / (l + 1))
        dp.append(dp[l - 1] + (2 * l + 1) * p[l])
    caps = [2.0 * jnp.sin(0.5 * radius_radians) ** 2]
    caps += [sine2 * dp[l] / (l * (l + 1)) for l in range(1, order)]
    factors = 2 * math.pi * np.sqrt((2 * np.arange(order) + 1) / (4 * math.pi))
    zh = jnp.stack(caps, axis=-1)
    zh = zh * constant_like(factors, zh)
    return radiance[..., :, None] * zh_to_sh(zh, direction)[..., None, :]


def sh_window(sh: Float[Array, "*b k"], *, width: float) -> Float[Array, "*b k"]:
    """Damps ringing: band l times (1 + cos(π l / width)) / 2, and 0 from band `width` on.

    Args:
      width: in bands, > 0; the number of bands or somewhat above is usual.
    Raises:
      ValueError: if width is not above 0, or the number of coefficients is no square.
    References:
      Sloan, "Stupid Spherical Harmonics (SH) Tricks", 2008, section on windowing.
    """
    check_at_least("width", width, 1e-6)
    l = bands(order_of(sh))
    window = np.where(l < width, 0.5 * (1 + np.cos(math.pi * l / width)), 0.0)
    return sh * constant_like(window, sh)


def rotate_environment(image: Float[Array, "h w c"], angle_radians: float) -> Float[Array, "h w c"]:
    """Turns a map about +Y by whole columns, counter-clockwise seen from above for a positive angle."""
    shift = -round(angle_radians / (2 * math.pi) * image.shape[1])
    return jnp.roll(image, shift, axis=1)
