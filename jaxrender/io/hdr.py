"""Environment maps: latitude-longitude HDR images, Radiance (.hdr, .pic) or OpenEXR, told by content.

The top row looks up (+y), as in `harmonics.light`. Radiance is linear RGB in the file's own unit.
"""

import os
import pathlib

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float

from jaxrender import checks
from jaxrender.io import exr

#: Maps with more pixels than this (16384 x 8192: 1.6 GB) are refused before decoding.
MAX_PIXELS = 2**27

# Width over height may be off by this share: some maps repeat a column or a row at the seam.
_RATIO_TOLERANCE = 0.05


def read_environment(path: str | os.PathLike, *, clean: bool = False) -> Float[np.ndarray, "h w 3"]:
    """A latitude-longitude environment map, twice as wide as high, as float32 linear radiance.

    Args:
      clean: sets NaN, infinite and negative values to 0 instead of refusing them.
    Raises:
      InputError: if the file is damaged, too large, not about 2:1, or holds a NaN, Inf or negative value.
      OSError: if it cannot be read at all.
    """
    path = pathlib.Path(path)
    with path.open("rb") as file:
        magic = file.read(4)
    if magic == b"\x76\x2f\x31\x01":
        part = exr.read_exr_header(path)[0]
        _check_size(path, part.height, part.width)
        image = exr.read_exr(path)
    elif magic[:2] == b"#?":
        image = _read_radiance(path)
    else:
        got = magic.hex(" ") or "an empty file"
        checks.bad_input(path, "first bytes", expected="a Radiance (.hdr) or OpenEXR image", got=got)
    # A gray map is the same radiance in each color; alpha means nothing on a sphere.
    image = np.repeat(image, 3, axis=-1) if image.shape[-1] == 1 else image[..., :3]
    if image.shape[-1] != 3:
        checks.bad_input(path, "channels", expected="R, G, B or Y", got=f"{image.shape[-1]} channels")
    return _check_radiance(path, np.ascontiguousarray(image, np.float32), clean=clean)


def _read_radiance(path: pathlib.Path) -> np.ndarray:
    source = oiio.ImageInput.open(str(path))
    if source is None:
        checks.bad_input(path, "header", expected="an intact Radiance RGBE image", got=_line(oiio.geterror()))
    try:
        spec = source.spec()
        if source.format_name() != "hdr" or spec.nchannels != 3:
            checks.bad_input(path, "header", expected="a Radiance RGBE image", got=source.format_name())
        _check_size(path, spec.height, spec.width)
        turned = spec.get_int_attribute("Orientation", 1)
        if turned != 1:
            expected = "rows from the top, columns from the left (-Y h +X w)"
            checks.bad_input(path, "header", expected=expected, got=f"orientation {turned}")
        image = source.read_image(oiio.FLOAT)
        if image is None:
            checks.bad_input(path, "pixels", expected="an intact image", got=_line(source.geterror()))
    finally:
        source.close()
    # The header's EXPOSURE has already been multiplied into the pixels; the reader leaves it there.
    exposure = spec.get_float_attribute("hdr:exposure", 1.0)
    if not (np.isfinite(exposure) and exposure > 0):
        checks.bad_input(path, "EXPOSURE", expected="a positive number", got=exposure)
    return image / np.float32(exposure)


def _check_size(path: pathlib.Path, height: int, width: int) -> None:
    if height * width > MAX_PIXELS:
        checks.bad_input(path, "size", expected=f"at most {MAX_PIXELS} pixels", got=f"{width} x {height}")
    if abs(width / height / 2 - 1) > _RATIO_TOLERANCE:
        expected = "a latitude-longitude map, twice as wide as high"
        checks.bad_input(path, "size", expected=expected, got=f"{width} x {height}")


def _check_radiance(path: pathlib.Path, image: np.ndarray, *, clean: bool) -> np.ndarray:
    lost, negative = ~np.isfinite(image), image < 0
    if clean:
        return np.where(lost | negative, np.float32(0), image)
    if lost.any() or negative.any():
        got = f"{lost.sum()} NaN or Inf and {(negative & ~lost).sum()} negative ones"
        checks.bad_input(path, "radiance", expected="finite values of at least 0", got=got)
    return image


def _line(text: str) -> str:
    return " ".join(text.split()) or "an unreadable one"
