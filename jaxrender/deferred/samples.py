"""Where a pixel is sampled.

Offsets are in 1/16 px from the pixel's centre, x to the right and y down, in the order of the sample index.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxrender.checks import check_at_least, check_one_of

# Direct3D 11 functional specification, 19.2.4: the standard multisample patterns.
_PATTERNS = {
    2: ((4, 4), (-4, -4)),
    4: ((-2, -6), (6, -2), (-6, 2), (2, 6)),
    8: ((1, -3), (-1, 3), (5, 1), (-3, -5), (-5, 5), (-7, -1), (3, 7), (7, -7)),
    16: (
        (1, 1), (-1, -3), (-3, 2), (4, -1), (-5, -2), (2, 5), (5, 3), (3, -5),
        (-2, 6), (0, -7), (-4, -6), (-6, 4), (-8, 0), (7, -4), (6, 7), (-7, -8),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Samples:
    """A sample layout.

    Attributes:
      grid: m of an ordered m x m grid, whose samples are the pixel centres of an image m times as large; 1 otherwise.
      offsets: of a multisample pattern; the pixel centre otherwise.
    """

    grid: int = 1
    offsets: tuple[tuple[int, int], ...] = ((0, 0),)

    @property
    def count(self) -> int:
        """Samples of a pixel."""
        return self.grid**2 * len(self.offsets)

    @property
    def positions_px(self) -> Int[np.ndarray, "s 2"]:
        """Positions (x, y) in the pixel, from its upper left corner, in pixels."""
        if self.grid > 1:
            steps = (np.arange(self.grid) + 0.5) / self.grid
            return np.stack(np.meshgrid(steps, steps, indexing="xy"), axis=-1).reshape(-1, 2)
        return np.array(self.offsets) / 16.0 + 0.5


CENTER = Samples()


def ordered_grid(size: int) -> Samples:
    """m x m samples, row by row from the upper left; what supersampling at m times the resolution sees."""
    check_at_least("size", size, 1)
    return Samples(grid=size)


def standard_pattern(count: int) -> Samples:
    """The standard multisample pattern of 1, 2, 4, 8 or 16 samples.

    References:
      Direct3D 11 functional specification, 19.2.4.
    """
    check_one_of("count", count, (1, *_PATTERNS))
    return Samples(offsets=_PATTERNS[count]) if count > 1 else CENTER
