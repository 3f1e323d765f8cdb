"""The light of a picture by its parts: which of it a denoiser filters, which it leaves, and what of it is no light."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrender.filters.aovs import Aovs

Color = Float[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]

#: Light beyond this is cut to it, so that sums of squares stay finite in float32, whatever the albedo.
LARGEST = 1e12


@dataclass(frozen=True)
class Light:
    """Light by its parts, albedo included. What is not finite is NaN in `filtered` and 0 in `fixed`.

    Attributes:
      filtered: what is to be filtered: "color", "indirect", or "direct" and "indirect". fixed: what stays.
      valid: where all that is to be filtered is finite.
      nan, lost, negative, too_large: where any light is not finite, any that stays is not, the picture is below 0, and
        any light was above `LARGEST`.
    """

    filtered: dict[str, Color]
    fixed: dict[str, Color]
    valid: Mask
    nan: Mask
    lost: Mask
    negative: Mask
    too_large: Mask

    @property
    def separate(self) -> bool:
        """Whether it came in parts that add up to the picture."""
        return "color" not in self.filtered

    @property
    def divided(self) -> bool:
        """Whether it is indirect light alone that is filtered."""
        return set(self.filtered) == {"indirect"}

    def words(self) -> str:
        """What is filtered, for people."""
        if self.separate:
            return "direct and indirect light" if "direct" in self.filtered else "indirect light, direct as it came"
        return "the picture, all light together"


def parts_of(aovs: Aovs, *, whole: bool) -> Light:
    """Indirect light is filtered if it is separate, direct light beside it if `whole`; else the picture is."""
    parts = {"direct": aovs.direct, "indirect": aovs.indirect, "emission": aovs.emission}
    given = {name: np.asarray(image, np.float32) for name, image in parts.items() if image is not None}
    color = np.asarray(aovs.color, np.float32)
    if aovs.indirect is None:
        names, given = ["color"], {"color": color}
    else:
        names = ["direct", "indirect"] if whole else ["indirect"]
    cut = {name: _cut(image) for name, image in given.items()}
    fixed = {name: image for name, image in cut.items() if name not in names}
    valid = np.all([np.isfinite(cut[name]).all(axis=-1) for name in names], axis=0)
    lost = np.any([np.zeros_like(valid), *(~np.isfinite(image).all(axis=-1) for image in fixed.values())], axis=0)
    return Light(
        filtered={name: cut[name] for name in names},
        fixed={name: np.where(np.isfinite(x).all(axis=-1, keepdims=True), x, 0.0) for name, x in fixed.items()},
        valid=valid,
        nan=~valid | lost | ~np.isfinite(color).all(axis=-1),
        lost=lost,
        negative=np.any(color < 0.0, axis=-1),
        too_large=np.any([(np.isfinite(x) & (np.abs(x) > LARGEST)).any(axis=-1) for x in given.values()], axis=0),
    )


def _cut(image: Float[np.ndarray | Array, "h w 3"]) -> Color:
    image = np.asarray(image, np.float32)
    return np.where(np.isfinite(image), image.clip(-LARGEST, LARGEST), np.float32(np.nan))
