"""How far an image or a table of numbers is from its reference, and pictures of the difference.

Image metrics expect linear or display-encoded values with peak 1 and say nothing about which: name the
encoding where you report them. All but `ssim` and `flip` are pure and differentiable.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender import checks, vecmath
from jaxrender.srgb import decode_srgb

# The colors of "inferno" at equal steps (Smith and van der Walt, 2015, CC0), as sRGB bytes: dark to bright
# with steady lightness, so a heat map still reads when printed in gray.
_INFERNO = (
    (0, 0, 4), (22, 11, 57), (66, 10, 104), (106, 23, 110), (147, 38, 103), (188, 55, 84),
    (221, 81, 58), (243, 120, 25), (252, 165, 10), (246, 215, 70), (252, 255, 164),
)  # fmt: skip


def mse(image: Float[Array, "*b"], reference: Float[Array, "*b"]) -> Float[Array, ""]:
    """Mean squared error over all values, in the square of their unit."""
    checks.check_same_shape("image and reference", image, reference)
    difference = image - reference
    return jnp.mean(difference * difference)


def psnr(image: Float[Array, "*b"], reference: Float[Array, "*b"], *, peak: float = 1.0) -> Float[Array, ""]:
    """Peak signal-to-noise ratio, 10 log₁₀(peak² / mse), in dB; infinite for equal images.

    Not differentiable where the images are equal.
    """
    return -10.0 * jnp.log10(mse(image, reference) / peak**2)


def relative_l2(values: Float[Array, "*b"], reference: Float[Array, "*b"]) -> Float[Array, ""]:
    """‖values − reference‖ / ‖reference‖ over all values; 0 for an all-zero reference.

    The gradient where both are equal is 0.
    """
    checks.check_same_shape("values and reference", values, reference)
    difference = values - reference
    return vecmath.safe_div(
        vecmath.safe_sqrt(jnp.sum(difference * difference)), vecmath.safe_sqrt(jnp.sum(reference * reference))
    )


def flicker(frames: Float[Array, "f h w c"]) -> Float[Array, ""]:
    """How much the noise of one still view changes from frame to frame: the mean over all values of their variance.

    The variance is that of the population (over f - 1), in the square of the values' unit; display-encoded values in
    0 to 255 give the `flicker_255` of the benchmarks. The frames have the same camera and scene, and other seeds.

    Raises:
      ValueError: if there are fewer than two frames.
    """
    checks.check_at_least("frames: number", len(frames), 2)
    apart = frames - jnp.mean(frames, axis=0, keepdims=True)
    return jnp.sum(apart * apart) / ((len(frames) - 1) * max(frames[0].size, 1))


def warped_flicker(
    image: Float[Array, "h w c"],
    previous: Float[Array, "h w c"],
    *,
    places_px: Float[Array, "h w 2"],
    matches: Bool[Array, "h w"],
) -> Float[Array, ""]:
    """How much an animation changes where it shows the same surface again: the RMS of the differences of two frames.

    The frame before is looked up where the surface of each pixel was then, bilinearly; for a still view with
    independent noise the result is √(2 `flicker`). True changes count as well: highlights, and shadows that wander. In
    the values' unit; 0 where nothing matches. Differentiable in the images.

    Args:
      places_px: where in `previous` the surface was (x, y), pixel centres at +0.5.
      matches: whether it is seen there, in all four pixels around; others do not count.
    Raises:
      ValueError: if the images differ in shape.
    """
    checks.check_same_shape("image and previous", image, previous)
    height, width = image.shape[:2]
    places = jnp.where(matches[..., None], places_px, jnp.full_like(places_px, 0.5)) - 0.5
    whole = jnp.floor(places)
    before = jnp.zeros_like(image)
    for dy in (0, 1):
        for dx in (0, 1):
            offset = whole + jnp.asarray([dx, dy], whole.dtype).reshape(1, 1, 2)
            weight = jnp.prod(1.0 - jnp.abs(places - offset), axis=-1, keepdims=True)
            column, row = (jnp.clip(offset[..., k], 0, size - 1).astype(int) for k, size in ((0, width), (1, height)))
            before = before + weight.astype(image.dtype) * previous[row, column]
    difference = jnp.where(matches[..., None], image - before, jnp.zeros_like(image))
    count = jnp.maximum(jnp.sum(matches), 1).astype(image.dtype) * image.shape[-1]
    return vecmath.safe_sqrt(jnp.sum(difference * difference) / count)


def ssim(
    image: Float[Array | np.ndarray, "h w c"],
    reference: Float[Array | np.ndarray, "h w c"],
    *,
    peak: float = 1.0,
) -> float:
    """Mean structural similarity in [-1, 1]; 1 for equal images. Computed by scikit-image, on the host.

    Gaussian window of sigma 1.5 (11 x 11) and population covariances, as in the paper.

    Raises:
      ValueError: if the images differ in shape or are smaller than 11 pixels.
    References:
      Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural
      similarity", IEEE TIP 13(4), 2004.
    """
    import skimage.metrics  # takes a second to import, and only a report needs it

    checks.check_same_shape("image and reference", image, reference)
    checks.check_at_least("image: height and width", min(image.shape[:2]), 11)
    return float(
        skimage.metrics.structural_similarity(
            np.asarray(image, np.float64),
            np.asarray(reference, np.float64),
            channel_axis=-1,
            data_range=peak,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def flip(
    image: Float[Array | np.ndarray, "h w 3"],
    reference: Float[Array | np.ndarray, "h w 3"],
    *,
    pixels_per_degree: float = 67.0,
) -> float:
    """Mean FLIP error in [0, 1]: how much an eye sees change that flips between two images; 0 for equal ones.

    Unlike the other metrics it wants one encoding: sRGB, in [0, 1]. Equal for image and reference exchanged. Computed
    by the authors' library (the extra "peers"), on the host.

    Args:
      pixels_per_degree: of the eye's field, > 0; the default is a 4k screen, 0.7 m wide and 0.7 m away.
    Raises:
      ValueError: if the images differ in shape, have no pixels or other than three channels.
      ImportError: if flip-evaluator is not installed.
    References:
      Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, "FLIP: A Difference Evaluator for Alternating
      Images", HPG 2020.
    """
    import flip_evaluator  # an extra, and only a report needs it

    checks.check_same_shape("image and reference", image, reference)
    checks.check_last_axis("image", image, 3)
    checks.check_at_least("image: height and width", min(image.shape[:2]), 1)
    if not pixels_per_degree > 0.0:
        raise ValueError(f"pixels_per_degree: expected a value > 0, got {pixels_per_degree}")
    # Copies, since the library refuses arrays that must not be written.
    first, second = (np.array(values, np.float32, order="C") for values in (reference, image))
    _, mean, _ = flip_evaluator.evaluate(
        first, second, "LDR", applyMagma=False, parameters={"ppd": float(pixels_per_degree)}
    )
    return float(mean)


def heatmap(values: Float[Array, "*b"], *, low: float = 0.0, high: float | None = None) -> Float[Array, "*b 3"]:
    """Numbers as colors, black at `low` over red and orange to pale yellow at `high`; linear RGB.

    Values outside are clamped; `high=None` takes the largest value. NaN becomes green, which the scale does
    not hold. Piecewise linear in sRGB, so differentiable between the nodes.
    """
    lost = jnp.isnan(values)
    values = jnp.where(lost, jnp.full_like(values, low), values)
    top = jnp.max(values) if high is None else jnp.asarray(high, values.dtype)
    t = jnp.clip(vecmath.safe_div(values - low, jnp.broadcast_to(top - low, values.shape)), 0.0, 1.0)
    colors = jnp.asarray(_INFERNO, values.dtype) / 255.0
    nodes = jnp.linspace(0.0, 1.0, len(_INFERNO), dtype=values.dtype)
    srgb = jnp.stack([jnp.interp(t, nodes, colors[:, c]) for c in range(3)], axis=-1)
    linear = decode_srgb(srgb)
    green = jnp.broadcast_to(jnp.asarray([0.0, 1.0, 0.0], values.dtype), linear.shape)
    return jnp.where(lost[..., None], green, linear)
