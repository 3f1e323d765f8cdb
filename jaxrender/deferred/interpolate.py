"""Fragments and vertex attributes -> values at samples, in every interpolation mode of a graphics pipeline.

`where` on the pixel and `how` over the triangle are two questions. Where: at each sample, at the centroid of what the
triangle covers of the pixel, or anywhere (the pull model). How: perspective-correct, linear on the screen
(noperspective), or flat. Values and their attributes are differentiable; `differentiable_barycentrics` also carries
gradients to the clip positions. Coverage has no gradient, so silhouettes do not move.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrender.checks import check_one_of
from jaxrender.deferred.raster import Fragments
from jaxrender.deferred.triangles import SUBPIXELS, perspective_weights, screen_barycentrics, weight_steps
from jaxrender.vecmath import safe_div

MODES = ("perspective", "noperspective", "flat_first", "flat_last")


def interpolate(
    fragments: Fragments, attributes: Float[Array, "v c"], *, mode: str = "perspective"
) -> Float[Array, "h w s c"]:
    """Vertex attributes at the samples; 0 where a sample is empty.

    Args:
      mode: "perspective"; "noperspective", linear on the screen; "flat_first" (the value of a triangle's first vertex,
        Direct3D's and Vulkan's leading vertex) or "flat_last" (OpenGL's default).
    References:
      Direct3D 11 functional specification, 16.4; OpenGL 4.6, 14.6.1 eqs. 14.9 and 14.10.
    """
    return blend(fragments, attributes, corner_weights(fragments, mode=mode))


def blend(
    fragments: Fragments, attributes: Float[Array, "v c"], weights: Float[Array, "h w s 3"]
) -> Float[Array, "h w s c"]:
    """Σ weights · attributes of the corners of each sample's triangle; 0 where it is empty."""
    corners = fragments.faces[jnp.maximum(fragments.triangle_id, 0)]
    values = sum(weights[..., k, None] * attributes[corners[..., k]] for k in range(3))
    return jnp.where(fragments.coverage[..., None], values, jnp.zeros_like(values))


def corner_weights(fragments: Fragments, *, mode: str = "perspective") -> Float[Array, "h w s 3"]:
    """What each corner of its triangle counts at a sample."""
    check_one_of("mode", mode, MODES)
    b = fragments.barycentrics
    weights = jnp.concatenate([1.0 - b[..., :1] - b[..., 1:], b], axis=-1)
    return _as_mode(fragments, weights, mode)


def _as_mode(fragments: Fragments, weights: Float[Array, "h w s 3"], mode: str) -> Float[Array, "h w s 3"]:
    """Perspective-correct weights turned into those of another mode."""
    if mode == "perspective":
        return weights
    if mode != "noperspective":
        corner = 0 if mode == "flat_first" else 2
        return jnp.broadcast_to(jnp.eye(3, dtype=weights.dtype)[corner], weights.shape)
    # l_k = b_k w_k / Σ b_i w_i undoes the division by w; it holds for triangles that reach behind the eye as well.
    times_w = weights * source_w(fragments)
    return safe_div(times_w, jnp.broadcast_to(jnp.sum(times_w, axis=-1, keepdims=True), times_w.shape))


def source_w(fragments: Fragments) -> Float[Array, "h w s 3"]:
    """Clip w of the corners of each sample's triangle, in the order of the mesh."""
    triangles, row = fragments.triangles, jnp.maximum(fragments.triangle_id, 0)
    # The corners of a triangle may have been swapped: its weights are the permutation.
    return jnp.sum(triangles.weights[row] * triangles.w[row][..., None], axis=-2)


def weights_at(
    fragments: Fragments, x: Int[Array, "h w s"], y: Int[Array, "h w s"], *, mode: str = "perspective"
) -> Float[Array, "h w s 3"]:
    """Weights of each sample's triangle at another place, inside it or not: the triangle's plane is extended.

    Args:
      x, y: in 1/256 px from the middle of the image, y down.
    """
    check_one_of("mode", mode, MODES)
    triangles, row = fragments.triangles, jnp.maximum(fragments.screen_id, 0)
    screen = screen_barycentrics(triangles.xy[row], triangles.area[row], x, y)
    weights, _ = perspective_weights(screen, triangles.w[row], triangles.weights[row])
    return _as_mode(fragments, weights, mode)


def sample_places(fragments: Fragments) -> tuple[Int[Array, "h w s"], Int[Array, "h w s"]]:
    """Places (x, y) of the samples, in snapped units as `weights_at` takes them.

    In an ordered grid of m x m samples the unit is 1/256 of a sample's cell.
    """
    h, w, s = fragments.triangle_id.shape
    m = fragments.samples.grid
    offsets = np.array(fragments.samples.offsets) * (SUBPIXELS // 16) + SUBPIXELS // 2
    cell = np.stack(np.meshgrid(np.arange(m), np.arange(m), indexing="xy"), axis=-1).reshape(-1, 1, 2) * SUBPIXELS
    in_pixel = (cell + offsets).reshape(s, 2)
    pixel = np.stack(np.meshgrid(np.arange(w), np.arange(h), indexing="xy"), axis=-1)[:, :, None] * (m * SUBPIXELS)
    at = pixel + in_pixel - np.array([w, h]) * (m * SUBPIXELS) // 2
    return jnp.asarray(at[..., 0], jnp.int32), jnp.asarray(at[..., 1], jnp.int32)


# --- The pull model


def interpolate_at_offset(
    fragments: Fragments, attributes: Float[Array, "v c"], offset: Int[Array, "2"], *, mode: str = "perspective"
) -> Float[Array, "h w s c"]:
    """Attributes at an offset from the centre of each sample's pixel (`EvaluateAttributeSnapped`).

    Args:
      offset: (x, y) in 1/16 px; the low four bits count, as a signed number: -8 to 7.
    References:
      Direct3D 11 functional specification, 22.4.7.
    """
    signed = ((jnp.asarray(offset, jnp.int32) + 8) & 15) - 8
    x, y = _pixel_centers(fragments)
    unit = fragments.samples.grid * SUBPIXELS // 16
    weights = weights_at(fragments, x + signed[0] * unit, y + signed[1] * unit, mode=mode)
    return blend(fragments, attributes, weights)


def interpolate_at_sample(
    fragments: Fragments, attributes: Float[Array, "v c"], index: int, *, mode: str = "perspective"
) -> Float[Array, "h w s c"]:
    """Attributes at sample `index` of the pixel, covered or not (`EvaluateAttributeAtSample`)."""
    check_one_of("index", index, range(fragments.samples.count))
    x, y = (jnp.broadcast_to(v[:, :, index, None], v.shape) for v in sample_places(fragments))
    return blend(fragments, attributes, weights_at(fragments, x, y, mode=mode))


def interpolate_at_centroid(
    fragments: Fragments,
    attributes: Float[Array, "v c"],
    *,
    mode: str = "perspective",
    sample_mask: Bool[np.ndarray, " s"] | None = None,
) -> Float[Array, "h w s c"]:
    """Attributes at the centroid of the part of the pixel that the sample's triangle covers, as Direct3D 11 rules.

    The pixel centre if the triangle covers all samples; otherwise its covered sample of lowest index. What a triangle
    covers is what is visible of it here: samples where it lost the depth test do not count.

    Args:
      sample_mask: samples that count at all.
    References:
      Direct3D 11 functional specification, 15.19 (centroid sampling).
    """
    weights = weights_at(fragments, *centroids(fragments, sample_mask=sample_mask), mode=mode)
    return blend(fragments, attributes, weights)


def centroids(
    fragments: Fragments, *, sample_mask: Bool[np.ndarray, " s"] | None = None
) -> tuple[Int[Array, "h w s"], Int[Array, "h w s"]]:
    """Where each sample's triangle is evaluated in centroid mode, in snapped units."""
    ids, s = fragments.triangle_id, fragments.samples.count
    own = ids[..., :, None] == ids[..., None, :]
    mask = np.ones(s, bool) if sample_mask is None else np.asarray(sample_mask)
    counted = own & jnp.asarray(mask)[None, None, None]
    x, y = sample_places(fragments)
    # Without a covered sample it is a helper's turn: the first of a partial mask, or the centre.
    first = jnp.where(counted.any(axis=-1), jnp.argmax(counted, axis=-1), int(np.argmax(mask)))
    center_x, center_y = _pixel_centers(fragments)
    centered = own.all(axis=-1) | (~counted.any(axis=-1) & bool(mask.all()))
    pick = lambda v: jnp.take_along_axis(v, first, axis=-1)  # noqa: E731
    return jnp.where(centered, center_x, pick(x)), jnp.where(centered, center_y, pick(y))


def _pixel_centers(fragments: Fragments) -> tuple[Int[Array, "h w s"], Int[Array, "h w s"]]:
    h, w, s = fragments.triangle_id.shape
    size = fragments.samples.grid * SUBPIXELS
    y, x = jnp.meshgrid(jnp.arange(h, dtype=jnp.int32), jnp.arange(w, dtype=jnp.int32), indexing="ij")
    place = lambda v, count: jnp.broadcast_to(  # noqa: E731
        (v * size + (size // 2 - count * size // 2))[..., None], (h, w, s)
    )
    return place(x, w), place(y, h)


# --- Derivatives


def attribute_gradients(
    fragments: Fragments, attributes: Float[Array, "v c"]
) -> tuple[Float[Array, "h w s c"], Float[Array, "h w s c"]]:
    """Exact d/dx and d/dy, per pixel to the right and downwards, of perspective-correct attributes at the samples.

    With l linear on the screen, A = Σ l_k A_k/w_k / Σ l_k/w_k, hence dA = w Σ dl_k/w_k (A_k - A).
    """
    triangles, row = fragments.triangles, jnp.maximum(fragments.screen_id, 0)
    unit = fragments.samples.grid * SUBPIXELS
    slope_x, slope_y = weight_steps(triangles.xy[row], triangles.area[row], unit=unit)
    corners = fragments.faces[jnp.maximum(fragments.triangle_id, 0)]
    own = jnp.einsum("hwsij,hwsjc->hwsic", triangles.weights[row], attributes[corners], precision="highest")
    value = interpolate(fragments, attributes)
    rest = (own - value[..., None, :]) * safe_div(
        jnp.broadcast_to(fragments.w[..., None], slope_x.shape), triangles.w[row]
    )[..., None]
    some = fragments.coverage[..., None]
    return tuple(jnp.where(some, jnp.sum(s[..., None] * rest, axis=-2), 0.0) for s in (slope_x, slope_y))  # type: ignore


def differentiable_barycentrics(
    fragments: Fragments, clip: Float[Array, "v 4"], *, mode: str = "perspective"
) -> Float[Array, "h w s 3"]:
    """The weights of `corner_weights`, with gradients to the clip positions of the corners.

    Values are those of the snapped triangle. Their gradient is that of the unsnapped one, by the homogeneous form: for
    a pixel at (X, Y) in NDC, b_k is proportional to the cross product of the other two corners' (x - X w, y - Y w).

    References:
      Olano, Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997.
    """
    weights = corner_weights(fragments, mode=mode)
    h, w, _ = fragments.triangle_id.shape
    x, y = sample_places(fragments)
    m = fragments.samples.grid
    ndc = [x.astype(clip.dtype) * (2.0 / (w * m * SUBPIXELS)), y.astype(clip.dtype) * (-2.0 / (h * m * SUBPIXELS))]
    corners = clip[fragments.faces[jnp.maximum(fragments.triangle_id, 0)]]
    px, py = (corners[..., i] - at[..., None] * corners[..., 3] for i, at in enumerate(ndc))
    one, two = np.array([1, 2, 0]), np.array([2, 0, 1])
    a = px[..., one] * py[..., two] - py[..., one] * px[..., two]
    if mode == "noperspective":
        a = a * corners[..., 3]
    some = fragments.coverage[..., None]
    a = jnp.where(some, a, jnp.ones_like(a))
    smooth = a / jnp.sum(a, axis=-1, keepdims=True)
    return weights + jnp.where(some, smooth - jax.lax.stop_gradient(smooth), jnp.zeros_like(smooth))
