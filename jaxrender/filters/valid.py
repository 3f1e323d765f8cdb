"""Which pixels a filter may use. One image `(h, w, c)`; batches by `vmap`."""

import functools
import operator

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrender.checks import bad_input


def valid_pixels(*images: Float[Array, "h w _"]) -> Bool[Array, "h w"]:
    """True where every channel of every image is finite: what the filters of this room count as a pixel.

    Raises:
      ValueError: if there is no image, one is empty or not (h, w, c), or they differ in height or width.
      TypeError: if one does not hold floating-point numbers.
    """
    if not images:
        raise ValueError("images: expected at least one, got none")
    check_images(**{f"images[{i}]": image for i, image in enumerate(images)})
    return functools.reduce(operator.and_, [jnp.all(jnp.isfinite(image), axis=-1) for image in images])


def check_images(**images: Array) -> None:
    """Holds images, by their names, to (h, w, c), not empty, of one height and width and of floating-point numbers.

    An image without channels is allowed: features that tell nothing.

    Raises:
      ValueError: if one has another shape.
      TypeError: if one has another type.
    """
    first, *_ = images.values()
    for name, image in images.items():
        if image.ndim != 3 or 0 in image.shape[:2]:
            bad_input(name, "shape", expected="(h, w, c), not empty", got=tuple(image.shape))
        if image.shape[:2] != first.shape[:2]:
            bad_input(name, "height and width", expected=first.shape[:2], got=image.shape[:2])
        if not jnp.issubdtype(image.dtype, jnp.floating):
            raise TypeError(f"{name}: expected floating-point numbers, got {image.dtype}")
