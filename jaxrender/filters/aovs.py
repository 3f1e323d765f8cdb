"""What a denoiser is given: a noisy picture, and the images its renderer made beside it."""

import dataclasses
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float

#: Depths and positions from here on mean that nothing is there: Blender writes 1e10, others infinity.
FAR_AWAY = 1e9

#: Fields with one channel; all others but `ao` have three.
_SINGLE = ("depth",)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Aovs:
    """Images of one size, linear, None where there is none. Values are as they came: `check` looks at shapes only.

    Attributes:
      color: the noisy picture, not encoded for a display.
      direct, indirect, emission: light that came straight from a light, by way of other surfaces, and from lamps and
        background that are seen themselves. Each contains the albedo. Direct and indirect come together, and all
        that are given add up to `color`.
      albedo: reflectance in [0, 1], 0 where nothing is.
      normal: of length 1 in any frame, 0 where nothing is.
      depth: along the axis or along the ray, in any unit; where nothing is 0, infinite or at least `FAR_AWAY`.
      position: in any frame and unit; where nothing is as depth.
      ao: ambient occlusion, 1 for an open place; one channel, or several, of rays of different lengths.
    """

    color: Float[np.ndarray | Array, "h w 3"]
    direct: Float[np.ndarray | Array, "h w 3"] | None = None
    indirect: Float[np.ndarray | Array, "h w 3"] | None = None
    emission: Float[np.ndarray | Array, "h w 3"] | None = None
    albedo: Float[np.ndarray | Array, "h w 3"] | None = None
    normal: Float[np.ndarray | Array, "h w 3"] | None = None
    depth: Float[np.ndarray | Array, "h w 1"] | None = None
    position: Float[np.ndarray | Array, "h w 3"] | None = None
    ao: Float[np.ndarray | Array, "h w k"] | None = None

    def check(self) -> None:
        """Raises ValueError, naming the field, if shapes do not fit together or direct or indirect is alone."""
        height_width = np.shape(self.color)[:2]
        for name, image in self.given().items():
            num_channels = image.shape[-1] if name == "ao" and image.ndim == 3 else 1 if name in _SINGLE else 3
            expected = (*height_width, num_channels)
            if len(expected) != 3 or image.shape != expected or 0 in expected:
                raise ValueError(f"{name}: expected shape {expected}, as color has it, got {tuple(image.shape)}")
            if not np.issubdtype(image.dtype, np.floating) and image.dtype.name != "bfloat16":
                raise ValueError(f"{name}: expected floating point, got {image.dtype}")
        lit = [name for name in ("direct", "indirect") if getattr(self, name) is not None]
        if len(lit) == 1:
            raise ValueError(f"direct, indirect: expected both or none, got {lit[0]} alone")

    def given(self) -> dict[str, Float[np.ndarray | Array, "h w c"]]:
        """The images that are there, by the names of their fields."""
        images = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: image for name, image in images.items() if image is not None}
