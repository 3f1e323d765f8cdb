"""The guided filter, window by window: a ridge regression in each, and the mean of what they predict."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchref._precision import in_float64
from torchref.filters._windows import windows
from torchref.filters.sat import box_mean, box_variance
from torchref.filters.valid import valid_pixels

Planes = Float[Tensor, "c h w"]
GuidePlanes = Float[Tensor, "g h w"]


@in_float64
def guided_filter(
    guide: Float[Tensor, "h w g"],
    image: Float[Tensor, "h w c"],
    *,
    radius: int,
    eps: float | Float[Tensor, "..."],
    subsample: int = 1,
    edge_aware: bool = False,
) -> Float[Tensor, "h w c"]:
    """He, Sun, Tang 2013, eqs. 14 to 16. Pixels that are not finite belong to no window.

    Where the guide is not finite, its mean stands for it. A window without pixels predicts the image's mean, in 8 bits.
    """
    valid, known = valid_pixels(guide, image), valid_pixels(guide)
    ridge = _per_window(edge_aware_eps(guide, eps=eps) if edge_aware else eps, guide)
    guide = torch.where(known[..., None], guide, box_mean(guide, radius=radius))
    mean = image[valid].mean(0) if valid.any() else torch.zeros_like(image[0, 0])
    mean = mean.detach().to(torch.bfloat16).to(image.dtype)
    image = torch.where(valid[..., None], image - mean, torch.zeros_like(image))
    if subsample == 1:
        a, b = _mean_fits(guide, image, valid, ridge, radius)
    else:
        blocks = [_block_means(x, valid, subsample) for x in (guide, image)]
        small_ridge = _block_means(ridge, torch.ones_like(valid), subsample)
        some = _block_means(valid[..., None].to(image.dtype), torch.ones_like(valid), subsample)[..., 0] > 0
        fits = _mean_fits(*blocks, some, small_ridge, max(1, round(radius / subsample)))
        a, b = (_enlarged(x, subsample, valid.shape) for x in fits)
    return torch.einsum("hwgc,hwg->hwc", a, guide) + b + mean


@in_float64
def edge_aware_eps(guide: Float[Tensor, "h w g"], *, eps: float | Float[Tensor, "..."]) -> Float[Tensor, "h w g"]:
    """eps / Γ, Γ(p) = mean over q of (v(p) + λ) / (v(q) + λ). Li et al. 2015, eqs. 5 and 9."""
    valid = valid_pixels(guide)
    values = guide[valid].detach()
    extent = values.max() - values.min() if len(values) else 0.0
    v = box_variance(guide, radius=1).sum(-1) + (0.001 * (extent if extent > 0 else 1.0)) ** 2
    gamma = torch.stack([(here / v[valid]).sum() for here in v.flatten()]).reshape(v.shape) / max(len(values), 1)
    return _per_window(eps, guide) / gamma[..., None]


@in_float64
def filter_planes(
    guide: GuidePlanes, image: Planes, valid: Bool[Tensor, "h w"], eps: Float[Tensor, "g #h #w"], *, radius: int
) -> Planes:
    """The filter of planes without NaN, where a window without pixels predicts 0."""
    guide, image = (x.movedim(0, -1) for x in (guide, image))
    a, b = _mean_fits(guide, image, valid, eps.movedim(0, -1).expand(guide.shape), radius)
    return (torch.einsum("hwgc,hwg->hwc", a, guide) + b).movedim(-1, 0)


def _mean_fits(guide, image, valid, eps, radius):
    """a (h, w, g, c) and b (h, w, c), the means over the windows that cover a pixel."""
    height, width, g = guide.shape
    around = list(windows(height, width, radius=radius))
    fits = [
        _ridge_regression(guide[window][valid[window]], image[window][valid[window]], ridge)
        for window, ridge in zip(around, eps.reshape(-1, g), strict=True)
    ]
    found = [torch.stack(x).reshape(height, width, *x[0].shape) for x in zip(*fits, strict=True)]
    return [torch.stack([x[window].mean((0, 1)) for window in around]).reshape(x.shape) for x in found]


def _ridge_regression(guide, image, eps):
    """(a (g, c), b (c,)) that minimise Σ |aᵀ I + b - N|² + Σ_k eps_k |a_k|², over pixels I (n, g), N (n, c)."""
    n, g = guide.shape
    if n == 0:
        return torch.zeros(g, image.shape[1], dtype=image.dtype), torch.zeros_like(image.sum(0))
    mu, mean = guide.mean(0), image.mean(0)
    sigma = (guide - mu).T @ (guide - mu) / n
    a = torch.linalg.solve(sigma + torch.diag(eps), (guide - mu).T @ (image - mean) / n)
    return a, mean - mu @ a


def _block_means(values, valid, step):
    """Means of the valid pixels of step x step pixels, 0 if there are none."""
    height, width, channels = values.shape
    blocks = [(slice(y, y + step), slice(x, x + step)) for y in range(0, height, step) for x in range(0, width, step)]
    means = [values[b][valid[b]].sum(0) / valid[b].sum().clamp(min=1) for b in blocks]
    return torch.stack(means).reshape(-(-height // step), -(-width // step), channels)


def _enlarged(coefficients, step, size):
    """Bilinear, from a grid whose sample j lies at (j + 1/2) step - 1/2; beyond the outer ones, their values."""
    height, width = size
    rows, columns = _tents(height, coefficients.shape[0], step), _tents(width, coefficients.shape[1], step)
    return torch.einsum("yi,xj,ij...->yx...", rows, columns, coefficients)


def _tents(size, small, step):
    place = ((torch.arange(size, dtype=torch.float64) + 0.5) / step - 0.5).clamp(0, small - 1)
    return (1 - (place[:, None] - torch.arange(small)).abs()).clamp(min=0)


def _per_window(eps, guide):
    """eps (h, w, g) from a number, or one per guide channel, or one or g per window."""
    return torch.as_tensor(eps, dtype=guide.dtype).expand(guide.shape)
