"""Windows around pixels, cropped at the border."""

from collections.abc import Iterator

Window = tuple[slice, slice]


def windows(height: int, width: int, *, radius: int) -> Iterator[Window]:
    """The window of each pixel, row by row: image[window] is its pixels."""
    for y in range(height):
        for x in range(width):
            yield slice(max(y - radius, 0), y + radius + 1), slice(max(x - radius, 0), x + radius + 1)
