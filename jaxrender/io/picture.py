"""Pictures for people: linear images to sRGB bytes, PNG, animations, and labelled rows of images.

Images are `(h, w, c)` or `(h, w)`: floating point is linear with 1 as display white, `uint8` is taken as
already encoded for the display. NumPy only; nothing here is differentiable.
"""

import os
import pathlib
from collections.abc import Iterable, Sequence

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from jaxtyping import Float, UInt8

from jaxrender import checks
from jaxrender.io.atomic import atomic_path
from jaxrender.srgb import decode_srgb, encode_srgb

#: PNG files with more pixels than this are refused before decoding.
MAX_PIXELS = 2**27


# --- Linear light and display bytes


def tone_map(image: Float[np.ndarray, "h w 3"], *, exposure_stops: float = 0.0) -> Float[np.ndarray, "h w 3"]:
    """Brings radiance of any height into [0, 1], linear; values below about 0.75 keep their color.

    Multiplies by 2^exposure_stops, removes the pedestal of a 4 % reflection, compresses the peak of R, G, B
    above 0.76 towards 1, and lets what was compressed strongly fade to white.

    References:
      Khronos Group, "PBR Neutral Tone Mapper" specification, 2024.
    """
    start, desaturation, pedestal = 0.8 - 0.04, 0.15, 0.04
    # The ceiling keeps an infinity from meeting another one below.
    color = np.clip(np.asarray(image, np.float32) * np.float32(2.0**exposure_stops), 0.0, 1e9)
    low = color.min(axis=-1, keepdims=True)
    color = color - np.where(low < 2 * pedestal, low - low * low / (4 * pedestal), pedestal)
    peak = color.max(axis=-1, keepdims=True)
    room = 1.0 - start
    squeezed = 1.0 - room * room / np.maximum(peak + room - start, room)
    white = 1.0 - 1.0 / (desaturation * (peak - squeezed) + 1.0)
    bright = color * (squeezed / np.maximum(peak, start)) * (1.0 - white) + squeezed * white
    return np.where(peak < start, color, bright).astype(np.float32)


def to_bytes(image: np.ndarray) -> UInt8[np.ndarray, "h w c"]:
    """An image as display bytes: `uint8` as it is, linear floating point through sRGB, rounded.

    Pixels with a NaN become magenta, so that they are seen; infinities are clamped like any other value.

    Raises:
      ValueError: if the image is not (h, w) or (h, w, c) with 1, 3 or 4 channels, or is empty.
    """
    image = np.asarray(image)
    image = image[..., None] if image.ndim == 2 else image
    if image.ndim != 3 or 0 in image.shape or image.shape[-1] not in (1, 3, 4):
        raise ValueError(f"image: expected shape (h, w) or (h, w, c) with 1, 3 or 4 channels, got {image.shape}")
    if image.dtype == np.uint8:
        return image
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"image: expected uint8 or floating point, got {image.dtype}")
    lost = np.isnan(image).any(axis=-1)
    encoded = encode_srgb(np.where(np.isnan(image), 0.0, image))
    if image.shape[-1] == 4:
        encoded[..., 3] = np.clip(np.nan_to_num(image[..., 3]), 0.0, 1.0)  # coverage is not light
    pixels = np.round(encoded * 255.0).astype(np.uint8)
    if lost.any():
        pixels = np.repeat(pixels, 3, axis=-1) if pixels.shape[-1] == 1 else pixels
        pixels[lost] = (255, 0, 255) if pixels.shape[-1] == 3 else (255, 0, 255, 255)
    return pixels


# --- Files


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Writes an image as an 8-bit PNG; floating point goes through `to_bytes`, so `tone_map` HDR first.

    Raises:
      ValueError: as `to_bytes`. OSError: if the file cannot be written.
    """
    with atomic_path(path) as temporary:
        as_pillow(to_bytes(image)).save(temporary, format="PNG")


def read_png(path: str | os.PathLike) -> Float[np.ndarray, "h w 3"]:
    """Reads a PNG as linear RGB float32. Gray is repeated; alpha is dropped, not multiplied in.

    Raises:
      InputError: if the file is no PNG, is damaged, or is too large.
    """
    try:
        with PIL.Image.open(path, formats=("PNG",)) as image:
            width, height = image.size
            if width * height > MAX_PIXELS:
                checks.bad_input(path, "size", expected=f"at most {MAX_PIXELS} pixels", got=f"{width} x {height}")
            if image.mode.startswith("I"):  # 16 bits, which pillow would clip to 8
                gray = np.asarray(image, np.float32) / 65535.0
                return np.repeat(decode_srgb(gray)[..., None], 3, axis=-1).astype(np.float32)
            pixels = np.asarray(image.convert("RGB"), np.float32)
    except (PIL.UnidentifiedImageError, PIL.Image.DecompressionBombError, SyntaxError, ValueError) as error:
        if isinstance(error, checks.InputError):
            raise
        checks.bad_input(path, "content", expected="an intact PNG image", got=str(error).split(": ")[0])
    except OSError as error:
        if error.errno is not None:
            raise
        checks.bad_input(path, "content", expected="an intact PNG image", got=error)
    return decode_srgb(pixels / 255.0).astype(np.float32)


def write_animation(path: str | os.PathLike, frames: Iterable[np.ndarray], *, fps: int | float = 30.0) -> None:
    """Writes frames as one picture that moves and repeats: WebP, GIF or animated PNG, by the ending.

    WebP is the one to choose: all browsers show it, and it is many times smaller than the others. GIF has 256
    colors a frame and steps of 10 ms; PNG is lossless and large.

    Raises:
      ValueError: if the ending is none of .webp, .gif, .png, there is no frame, or the frames differ in size.
      OSError: if the file cannot be written.
    """
    path = pathlib.Path(path)
    checks.check_one_of("animation ending", path.suffix.lower(), (".webp", ".gif", ".png"))
    if not fps > 0:
        raise ValueError(f"fps: expected a value > 0, got {fps}")
    images = [as_pillow(to_bytes(frame)) for frame in frames]
    if not images:
        raise ValueError("frames: expected at least one, got none")
    if len({image.size for image in images}) > 1:
        raise ValueError(f"frames: expected one size, got {sorted({image.size for image in images})}")
    # Times are rounded as a whole, so that the length of the clip stays right.
    edges = np.round(np.arange(len(images) + 1) * (1000.0 / fps)).astype(int)
    durations = np.diff(edges).tolist()
    options: dict = {
        ".webp": {"quality": 85, "method": 4},
        ".png": {},
        ".gif": {"optimize": False, "disposal": 1},
    }[path.suffix.lower()]
    if path.suffix.lower() == ".gif":
        images = [image.convert("RGB").quantize(256, dither=PIL.Image.Dither.FLOYDSTEINBERG) for image in images]
        durations = (10 * np.diff(np.round(edges / 10)).astype(int)).tolist()
    kind = {".webp": "WEBP", ".gif": "GIF", ".png": "PNG"}[path.suffix.lower()]
    with atomic_path(path) as temporary:
        images[0].save(
            temporary,
            format=kind,
            save_all=True,
            append_images=images[1:],
            duration=durations,
            loop=0,
            **options,
        )


# --- Rows of images


def contact_sheet(
    images: Sequence[np.ndarray],
    *,
    labels: Sequence[str] = (),
    columns: int | None = None,
    gap_px: int = 8,
    background: tuple[int, int, int] = (24, 26, 30),
    text_color: tuple[int, int, int] = (222, 225, 230),
) -> UInt8[np.ndarray, "h w 3"]:
    """Images in a grid, row by row, each with its label above it; display bytes.

    Cells are as large as the largest image and images sit in the middle of theirs; alpha is laid over the
    background. A label too long for its cell is cut with an ellipsis.

    Raises:
      ValueError: if there is no image, or labels are given and are not one per image.
    """
    if not images:
        raise ValueError("images: expected at least one, got none")
    if labels and len(labels) != len(images):
        raise ValueError(f"labels: expected one per image ({len(images)}), got {len(labels)}")
    columns = len(images) if columns is None else min(columns, len(images))
    checks.check_at_least("columns", columns, 1)
    pictures = [as_pillow(to_bytes(image)).convert("RGBA") for image in images]
    width, height = (max(picture.size[axis] for picture in pictures) for axis in (0, 1))
    size = int(np.clip(width // 24, 11, 26))
    font = PIL.ImageFont.load_default(size)
    bar = round(1.6 * size) if any(labels) else 0
    rows = -(-len(pictures) // columns)
    sheet = PIL.Image.new(
        "RGB",
        (columns * (width + gap_px) + gap_px, rows * (height + bar + gap_px) + gap_px),
        background,
    )
    draw = PIL.ImageDraw.Draw(sheet)
    for index, picture in enumerate(pictures):
        left = gap_px + index % columns * (width + gap_px)
        top = gap_px + index // columns * (height + bar + gap_px)
        if labels:
            text = _fit_text(labels[index], font, width)
            draw.text((left + width / 2, top + bar / 2), text, fill=text_color, font=font, anchor="mm")
        place = (left + (width - picture.width) // 2, top + bar + (height - picture.height) // 2)
        sheet.paste(picture, place, picture)
    return np.asarray(sheet)


def side_by_side(images: Sequence[np.ndarray], labels: Sequence[str] = ()) -> UInt8[np.ndarray, "h w 3"]:
    """One row of `contact_sheet`."""
    return contact_sheet(images, labels=labels)


def with_color_bar(
    image: np.ndarray,
    colors: Float[np.ndarray, "n 3"],
    *,
    title: str,
    low: str,
    high: str,
    background: tuple[int, int, int] = (24, 26, 30),
    text_color: tuple[int, int, int] = (222, 225, 230),
) -> UInt8[np.ndarray, "h w 3"]:
    """An image with a strip below it that says what its colors mean: title, lowest value, bar, highest; display bytes.

    A title too long for the image is cut with an ellipsis.

    Args:
      colors: of the bar, from low to high, linear.
      low, high: the values at its ends, as text.
    """
    pixels = to_bytes(image)
    width = pixels.shape[1]
    size = int(np.clip(width // 56, 11, 26))
    font = PIL.ImageFont.load_default(size)
    gap, bar_width = round(0.6 * size), max(width // 4, 1)
    strip = PIL.Image.new("RGB", (width, round(2.2 * size)), background)
    draw, middle = PIL.ImageDraw.Draw(strip), strip.height / 2
    right = width - gap - round(font.getlength(high))
    left = right - gap - bar_width
    bar = as_pillow(to_bytes(colors[None])).resize((bar_width, size), PIL.Image.Resampling.BILINEAR)
    strip.paste(bar, (left, (strip.height - size) // 2))
    draw.text((right, middle), high, fill=text_color, font=font, anchor="lm")
    draw.text((left - gap, middle), low, fill=text_color, font=font, anchor="rm")
    room = left - 3 * gap - font.getlength(low)
    draw.text((gap, middle), _fit_text(title, font, room), fill=text_color, font=font, anchor="lm")
    return np.concatenate([np.asarray(as_pillow(pixels).convert("RGB")), np.asarray(strip)])


def _fit_text(text: str, font, width: int | float) -> str:
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


def as_pillow(pixels: UInt8[np.ndarray, "h w c"]) -> PIL.Image.Image:
    """Display bytes as a pillow image."""
    return PIL.Image.fromarray(np.ascontiguousarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels))
