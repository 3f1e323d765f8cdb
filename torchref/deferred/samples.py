"""Sample layouts of a pixel; offsets in 1/16 px from its centre, x right and y down."""

from dataclasses import dataclass

# As printed in the Direct3D 11 functional specification, 19.2.4, in sixteenths.
_TWO = "4,4 -4,-4"
_FOUR = "-2,-6 6,-2 -6,2 2,6"
_EIGHT = "1,-3 -1,3 5,1 -3,-5 -5,5 -7,-1 3,7 7,-7"
_SIXTEEN = "1,1 -1,-3 -3,2 4,-1 -5,-2 2,5 5,3 3,-5 -2,6 0,-7 -4,-6 -6,4 -8,0 7,-4 6,7 -7,-8"


@dataclass(frozen=True)
class Samples:
    """An ordered grid of `grid` x `grid` cells, or a multisample pattern of `offsets`."""

    grid: int = 1
    offsets: tuple[tuple[int, int], ...] = ((0, 0),)

    @property
    def count(self) -> int:
        return len(self.offsets) * self.grid * self.grid

    @property
    def positions_px(self) -> list[tuple[float, float]]:
        """Positions (x, y) from the pixel's upper left corner."""
        if self.grid == 1:
            return [(0.5 + x / 16, 0.5 + y / 16) for x, y in self.offsets]
        m = self.grid
        return [((2 * i + 1) / (2 * m), (2 * j + 1) / (2 * m)) for j in range(m) for i in range(m)]


CENTER = Samples()


def ordered_grid(size: int) -> Samples:
    """m x m samples, row by row."""
    return Samples(grid=size)


def standard_pattern(count: int) -> Samples:
    """The standard patterns of 1, 2, 4, 8 and 16 samples."""
    if count == 1:
        return CENTER
    text = {2: _TWO, 4: _FOUR, 8: _EIGHT, 16: _SIXTEEN}[count]
    return Samples(offsets=tuple(tuple(int(n) for n in pair.split(",")) for pair in text.split()))  # type: ignore
