"""The guided filter with any number of guide and image channels.

One image at a time, (h, w, c). In each window the image is fitted by a linear function of the guide, by ridge
regression; a pixel gets the mean of what the windows that cover it predict. With u = (1, guide) at a pixel, the normal
equations of a window are (Σ u uᵀ + n diag(0, eps)) x = Σ u imageᵀ, x = (b, a): the paper's a and b at once.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrender import checks
from jaxrender.filters.guided_rows import filter_rows
from jaxrender.filters.precision import planes_of, working
from jaxrender.filters.sat import box_mean, box_variance, mean_of
from jaxrender.filters.valid import valid_pixels
from jaxrender.filters.windows import box_sums, window_counts

Planes = Float[Array, "c h w"]
GuidePlanes = Float[Array, "g h w"]


def guided_filter(
    guide: Float[Array, "h w g"],
    image: Float[Array, "h w c"],
    *,
    radius: int,
    eps: float | Float[Array, "..."],
    subsample: int = 1,
    edge_aware: bool = False,
) -> Float[Array, "h w c"]:
    """Smooths `image` but keeps the edges of `guide`.

    Windows are (2 radius + 1)² pixels, cropped at the border; every mean is over the pixels that are there. (OpenCV's
    filter mirrors the border instead and has the same radius; kornia's wants 2 radius + 1 and mirrors too. Away from
    the border, from 2 radius on, all three are one.) The result is linear in `image`, and a constant passes. It can
    overshoot: weights of single pixels may be negative.

    Pixels with a NaN or an infinity in any channel of guide or image are out of all windows. Such a pixel gets what the
    windows that cover it predict from its guide, or, if that is not finite either, from the mean guide around it; a
    window without any valid pixel predicts the mean of the image (to 8 bits). Time does not depend on the radius. Half
    precision is computed in float32; the result has the image's dtype.

    In float32, eps should not be far below 1e-5 times the squared range of the guide. A CPU keeps running sums down the
    columns, so the rounding of a spike stays below it for some dozen rows: of one 10⁶ times as bright as the rest a few
    hundredths of the rest. Clamp spikes first (`clamp_fireflies`).

    Where guide and image are the same array (`guided_filter(x, x, ...)`, also of one traced `x`), each window sum is
    taken once, with the same result up to rounding.

    Differentiable in guide, image and eps, by a rule of its own that keeps only the arguments and makes about
    5 (g + 1) (g + c + 1) planes on the way back.

    Args:
      radius: in pixels, >= 0; may exceed the image.
      eps: > 0, in guide units squared: contrast below its root is smoothed away. One number, one per guide channel
        (g,), or one per window (h, w, 1) or (h, w, g), by the window's middle.
      subsample: fits to means of s x s pixels instead, with a radius of radius / s, and enlarges the coefficients
        bilinearly: about s² times quicker, a little softer.
      edge_aware: eps as given by `edge_aware_eps`: more on flat parts of the guide, less at its edges.
    Raises:
      ValueError: if guide and image differ in size, radius, subsample or the shape of eps do not fit, or eps is a
        number, or an array of NumPy's, not all of it above 0.
    References:
      He, Sun, Tang, "Guided Image Filtering", PAMI 35(6), 2013, eqs. 5, 6, 8 and 14-16 (with eps inside the sum).
      He, Sun, "Fast Guided Filter", arXiv:1505.00996, 2015. Bauszat, Eisemann, Magnor, "Guided Image Filtering for
      Interactive High-quality Global Illumination", EGSR 2011, sec. 4.
    """
    _check(guide, image, radius=radius, subsample=subsample)
    checks.check_above_0("eps", eps)
    centers = center_of(guide, image)
    centers = (centers[0], centers[0]) if guide is image else centers
    ridge = edge_aware_eps(guide, eps=eps) if edge_aware else eps
    return filter_centered(guide, image, *centers, radius=radius, eps=ridge, subsample=subsample)


def center_of(
    guide: Float[Array, "h w g"], image: Float[Array, "h w c"]
) -> tuple[Float[Array, " g"], Float[Array, " c"]]:
    """What guide and image are filtered relative to: their means over the pixels that are valid in both, to 8 bits.

    The filter commutes with an offset, its rounding does not. The 8 bits make pieces of an image agree about it,
    however they add it up. Not differentiated.
    """
    valid = valid_pixels(guide, image)
    means = (mean_of(planes_of(jnp.where(valid[..., None], x, jnp.zeros_like(x))), valid) for x in (guide, image))
    first, second = (lax.stop_gradient(lax.reduce_precision(mean, 8, 7)) for mean in means)
    return first, second


def filter_centered(
    guide: Float[Array, "h w g"],
    image: Float[Array, "h w c"],
    guide_center: Float[Array, " g"],
    image_center: Float[Array, " c"],
    *,
    radius: int,
    eps: float | Float[Array, "..."],
    subsample: int = 1,
) -> Float[Array, "h w c"]:
    """`guided_filter` relative to given centers, those of `center_of`: for pieces of an image (`bands.py`)."""
    eps_planes = _eps_planes(eps, guide)
    valid = valid_pixels(guide, image)
    guide_planes, image_planes = _centered(guide, guide_center, valid), _centered(image, image_center, valid)
    # Nearly always nothing is masked, and the window means need not be taken.
    seen = lax.cond(
        jnp.all(valid),
        lambda: guide_planes,
        lambda: _filled(guide, radius) - guide_center[:, None, None],
    )
    # Where the image is its own guide; masked pixels, which differ, are in no sum.
    image_planes = seen if guide is image and guide_center is image_center else image_planes
    if subsample == 1 and image_planes is seen:
        planes = _filtered_by_itself(seen, valid, eps_planes, radius)
    elif subsample == 1:
        planes = _filtered(seen, image_planes, valid, eps_planes, radius)
    else:
        planes = _fast(seen, image_planes, valid, eps_planes, radius, subsample)
    return jnp.moveaxis(planes + image_center[:, None, None], 0, -1).astype(image.dtype)


def edge_aware_eps(guide: Float[Array, "h w g"], *, eps: float | Float[Array, "..."]) -> Float[Array, "h w g"]:
    """eps for each window, divided by how much more the guide varies there than elsewhere: for `guided_filter`.

    v is the sum over the guide's channels of the variance in 3 x 3 pixels; eps is divided by
    Γ = (v + λ) · mean(1 / (v + λ)) over the image, λ = (0.001 · range of the guide)². Differentiable but for the range.
    In float32 for a guide of half precision, which has no room for eps / Γ.

    References:
      Li, Zheng, Zhu, Yao, Wu, "Weighted Guided Image Filtering", IEEE TIP 24(1), 2015, eqs. 5 and 9; the sum over
      channels is ours.
    """
    checks.check_above_0("eps", eps)
    guide = guide.astype(working(guide.dtype))
    valid = valid_pixels(guide)
    planes = planes_of(jnp.where(valid[..., None], guide, jnp.zeros_like(guide)))
    low = jnp.min(jnp.where(valid[None], planes, jnp.full_like(planes, jnp.inf)))
    high = jnp.max(jnp.where(valid[None], planes, jnp.full_like(planes, -jnp.inf)))
    extent = jnp.where(jnp.any(valid) & (high > low), high - low, jnp.ones_like(high))
    variance = jnp.sum(planes_of(box_variance(guide, radius=1)), axis=0) + lax.stop_gradient(0.001 * extent) ** 2
    weight = valid.astype(planes.dtype)
    mean = jnp.sum(weight / variance) / jnp.maximum(jnp.sum(weight), jnp.ones((), planes.dtype))
    return jnp.moveaxis(_eps_planes(eps, guide) / (variance * mean)[None], 0, -1)


def filter_planes(
    guide: GuidePlanes, image: Planes, valid: Bool[Array, "h w"], eps: Float[Array, "g #h #w"], *, radius: int
) -> Planes:
    """The filter of planes without NaN, each stage on the whole image: what a GPU runs."""
    x = _coefficients(guide, image, valid, eps, radius)
    return _applied(x, guide) * _share(x, radius)


def _coefficients(guide: GuidePlanes, image: Planes, valid, eps, radius: int) -> Float[Array, "n c h w"]:
    """b and a, summed over the windows that cover each pixel."""
    weight = valid.astype(guide.dtype)[None]
    u = jnp.concatenate([jnp.ones_like(guide[:1]), guide]) * weight
    if image is guide:
        sums = box_sums(u[:, None] * u[None], radius=radius)
        sums = jnp.concatenate([sums, sums[:, 1:]], axis=1)
    else:
        sums = box_sums(u[:, None] * jnp.concatenate([u, image * weight])[None], radius=radius)
    return box_sums(_solve(sums, eps), radius=radius)


def _applied(x: Float[Array, "n c h w"], guide: GuidePlanes) -> Planes:
    return x[0] + jnp.sum(x[1:] * guide[:, None], axis=0)


@partial(jax.custom_vjp, nondiff_argnums=(4,))
def _filtered(guide: GuidePlanes, image: Planes, valid: Bool[Array, "h w"], eps: Float[Array, "g #h #w"], radius: int):
    return lax.platform_dependent(
        guide,
        image,
        valid,
        eps,
        cpu=partial(filter_rows, radius=radius),
        default=partial(filter_planes, radius=radius),
    )


def _forward(guide, image, valid, eps, radius):
    return _filtered(guide, image, valid, eps, radius), (guide, image, valid, eps)


def _backward(radius, saved, slope):
    """With P x = R for each window, and y = P⁻¹ dx: dR = y, dP = -y xᵀ; u and image enter P and R as products."""
    guide, image, valid, eps = saved
    n, c = guide.shape[0] + 1, image.shape[0]
    ones = jnp.ones_like(guide[:1])
    everywhere = jnp.concatenate([ones, guide])
    weight = valid.astype(guide.dtype)[None]
    u = everywhere * weight
    slope = slope * _share(slope[None], radius)
    sums = box_sums(u[:, None] * jnp.concatenate([u, image * weight])[None], radius=radius)
    slope_x = box_sums(everywhere[:, None] * slope[None], radius=radius)
    count = sums[0, 0]
    slope_x = jnp.where((count > 0.0)[None, None], slope_x, jnp.zeros_like(slope_x))
    both = _solve(jnp.concatenate([sums, slope_x], axis=1), eps)
    x, y = both[:, :c], both[:, c:]
    slope_p = -jnp.sum(y[:, None] * x[None], axis=2)
    slope_eps = jnp.stack([slope_p[j, j] for j in range(1, n)]) * count[None]
    near = box_sums(jnp.concatenate([x, y, slope_p + jnp.swapaxes(slope_p, 0, 1)], axis=1), radius=radius)
    x, y, slope_p = near[:, :c], near[:, c : 2 * c], near[:, 2 * c :]
    slope_image = jnp.sum(y * u[:, None], axis=0)
    of_products = jnp.sum(y * image[None], axis=1) + jnp.sum(slope_p * u[None], axis=1)
    slope_guide = jnp.sum(x[1:] * slope[None], axis=1) + of_products[1:] * weight
    over = tuple(axis for axis in (1, 2) if eps.shape[axis] == 1)
    return slope_guide, slope_image, None, jnp.sum(slope_eps, axis=over, keepdims=True)


_filtered.defvjp(_forward, _backward)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _filtered_by_itself(guide: GuidePlanes, valid: Bool[Array, "h w"], eps: Float[Array, "g #h #w"], radius: int):
    return lax.platform_dependent(
        guide,
        valid,
        eps,
        cpu=lambda guide, *rest: filter_rows(guide, None, *rest, radius=radius),
        default=lambda guide, *rest: filter_planes(guide, guide, *rest, radius=radius),
    )


def _forward_by_itself(guide, valid, eps, radius):
    return _filtered_by_itself(guide, valid, eps, radius), (guide, valid, eps)


def _backward_by_itself(radius, saved, slope):
    guide, valid, eps = saved
    of_guide, of_image, _, of_eps = _backward(radius, (guide, guide, valid, eps), slope)
    return of_guide + of_image, None, of_eps


_filtered_by_itself.defvjp(_forward_by_itself, _backward_by_itself)


def _fast(guide: GuidePlanes, image: Planes, valid, eps, radius: int, step: int) -> Planes:
    """Coefficients from means of step x step pixels, enlarged to the whole guide."""
    weight = valid.astype(guide.dtype)[None]
    count = _block_sums(weight, step)
    inverse = 1.0 / jnp.maximum(count, jnp.ones_like(count))
    small_guide = _block_sums(guide * weight, step) * inverse
    small_image = small_guide if image is guide else _block_sums(image * weight, step) * inverse
    if eps.shape[1:] != (1, 1):
        eps = _block_sums(eps, step) / _block_sums(jnp.ones_like(weight), step)
    small_radius = max(1, round(radius / step))
    x = _coefficients(small_guide, small_image, count[0] > 0.0, eps, small_radius)
    x = x * _share(x, small_radius)[None]
    shape = (*x.shape[:2], *guide.shape[1:])
    scale, shift = jnp.full(2, step, x.dtype), jnp.zeros(2, x.dtype)
    x = jax.image.scale_and_translate(x, shape, (2, 3), scale, shift, method="linear", antialias=False)
    return _applied(x, guide)


def _block_sums(planes: Planes, step: int) -> Float[Array, "c hs ws"]:
    """Sums over blocks of step x step pixels, cropped at the border."""
    c, height, width = planes.shape
    planes = jnp.pad(planes, ((0, 0), (0, -height % step), (0, -width % step)))
    return jnp.sum(planes.reshape(c, -(-height // step), step, -(-width // step), step), axis=(2, 4))


def _solve(sums: Float[Array, "n k h w"], eps: Float[Array, "g #h #w"]) -> Float[Array, "n m h w"]:
    """Gauss-Jordan elimination of the n normal equations of each window, for its m = k - n right-hand sides.

    Without exchange of rows, as the matrix is positive definite; its ridge is added when its turn comes, so that the
    pivot is never below it, whatever the rounding. 0 for a window without pixels.
    """
    n = sums.shape[0]
    count = jnp.maximum(sums[0, 0], jnp.ones_like(sums[0, 0]))
    ridge = jnp.concatenate([jnp.zeros_like(count)[None], eps * count[None]])

    def pivot(j, m):
        own = m[j, j]
        divisor = jnp.maximum(own, jnp.zeros_like(own)) + ridge[j]
        divisor = jnp.where(j == 0, count, divisor)
        line = m[j] / divisor[None]
        return jnp.where((jnp.arange(n) == j)[:, None, None, None], line[None], m - m[:, j][:, None] * line[None])

    return lax.fori_loop(0, n, pivot, sums)[:, n:]


def _share(planes, radius: int) -> Float[Array, "1 h w"]:
    """1 / the number of windows that cover each pixel."""
    rows, columns = window_counts(*planes.shape[-2:], radius=radius)
    return 1.0 / (rows[:, None] * columns[None]).astype(planes.dtype)[None]


def _centered(image, center, valid) -> Planes:
    """Planes less their center, 0 where masked."""
    planes = planes_of(jnp.where(valid[..., None], image, jnp.zeros_like(image)))
    return jnp.where(valid[None], planes - center[:, None, None], jnp.zeros_like(planes))


def _filled(guide, radius: int) -> Planes:
    """The guide, and the mean of the guide around it where it is not finite."""
    valid = valid_pixels(guide)
    own = planes_of(jnp.where(valid[..., None], guide, jnp.zeros_like(guide)))
    return jnp.where(valid[None], own, planes_of(box_mean(guide, radius=radius)))


def _eps_planes(eps, guide) -> Float[Array, "g #h #w"]:
    """eps as planes, one per guide channel, of the guide's size or of one pixel."""
    height, width, g = guide.shape
    eps = jnp.asarray(eps, planes_of(guide[:1, :1]).dtype)
    if eps.shape in ((), (g,)):
        return jnp.broadcast_to(eps, (g,))[:, None, None]
    if eps.shape in ((height, width, 1), (height, width, g)):
        return jnp.moveaxis(jnp.broadcast_to(eps, (height, width, g)), -1, 0)
    raise ValueError(f"eps: expected shape (), ({g},), or ({height}, {width}, 1 or {g}), got {eps.shape}")


def _check(guide, image, *, radius: int, subsample: int) -> None:
    if guide.ndim != 3 or image.ndim != 3 or guide.shape[:2] != image.shape[:2]:
        raise ValueError(f"guide and image: expected (h, w, g) and (h, w, c), got {guide.shape} and {image.shape}")
    checks.check_whole("radius", radius, 0)
    checks.check_whole("subsample", subsample, 1)
