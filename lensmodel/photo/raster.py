"""TIFF, PNG and JPEG pixels in full precision, as `(row, col, channel)` of the file's numbers."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeAlias

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from lensmodel.core.errors import (
    ImageTooLargeError,
    LensModelError,
    NotAnImageError,
    TruncatedImageError,
    UnsupportedFormatError,
)
from lensmodel.photo.headers.header import Header

Pixels: TypeAlias = NDArray[Any]
"""Numbers of a file, `(row, col)` or `(row, col, channel)`."""

_PLAIN_MODES: Final = {"1", "L", "LA", "P", "PA", "RGB", "RGBA"}


def read_pixels(path: Path, header: Header) -> Pixels:
    """Decode a TIFF, PNG or JPEG.

    Returns
    -------
    ndarray, shape (height, width, 3)
        uint8, uint16 or float32; grey as three equal planes, alpha dropped, palettes applied.

    Raises
    ------
    UnsupportedFormatError
        For CMYK, CIE Lab and the like.
    TruncatedImageError, NotAnImageError
        If the pixel data end early or are damaged.
    """
    if header.kind == "tiff":
        pixels = _read_tiff(path)
    elif header.kind == "png" and header.bits == 16:
        pixels = _guarded(lambda: imagecodecs.png_decode(path.read_bytes()), "PNG")
    else:
        pixels = _read_with_pillow(path, header)
    return _three_channels(pixels)


def _read_with_pillow(path: Path, header: Header) -> Pixels:
    if header.channels == 4 and header.kind == "jpeg":
        raise UnsupportedFormatError("the JPEG is CMYK, made for print; convert it to RGB")
    try:
        with warnings.catch_warnings():
            # Our own limit was checked on the header, before this.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=("JPEG", "PNG")) as image:
                if image.mode not in _PLAIN_MODES:
                    raise UnsupportedFormatError(
                        f"pictures of kind {image.mode} are not read; convert it to RGB"
                    )
                return np.asarray(image.convert("RGB"))
    except Image.DecompressionBombError as error:
        raise ImageTooLargeError(
            f"{header.width} x {header.height} pixels are more than the decoder takes"
        ) from error
    except (OSError, SyntaxError, ValueError) as error:
        if "truncated" in str(error):
            raise TruncatedImageError(
                f"the {header.kind.upper()} ends before its picture does ({error})"
            ) from error
        raise NotAnImageError(f"the {header.kind.upper()}'s pixel data are damaged ({error})") from error


def _guarded(decoder: Callable[[], Pixels], name: str) -> Pixels:
    """Decoders meet hostile files with exceptions of any kind: all mean the same."""
    try:
        return np.asarray(decoder())
    except (MemoryError, LensModelError):
        raise
    except Exception as error:
        raise NotAnImageError(f"the {name}'s pixel data are damaged ({error})") from error


def _read_tiff(path: Path) -> Pixels:
    def decoded() -> Pixels:
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            assert isinstance(page, tifffile.TiffPage)  # the first is always read in full
            return _tiff_page(page)

    return _guarded(decoded, "TIFF")


def _tiff_page(page: tifffile.TiffPage) -> Pixels:
    kind = page.photometric
    if kind not in {0, 1, 2, 3, 6}:
        raise UnsupportedFormatError(
            f"TIFFs of kind {getattr(kind, 'name', kind)} are not read; convert it to RGB"
        )
    pixels = page.asarray()
    if pixels.ndim == 3 and page.planarconfig == 2:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * 255
    elif kind != 3 and pixels.dtype.kind == "u" and page.bitspersample not in {8, 16, 32}:
        pixels = _widened(pixels, page.bitspersample)
    if kind == 0:
        pixels = np.invert(pixels) if pixels.dtype.kind == "u" else 1 - pixels
    if kind == 3 and page.colormap is not None:
        pixels = _colours_of(page.colormap)[pixels]
    return pixels


def _colours_of(table: NDArray[np.uint16]) -> Pixels:
    """Palette as `(index, channel)`; many programs write 8-bit colours times 256, so that white is 65280."""
    colours = np.moveaxis(table, 0, -1)
    return colours if (colours & 255).any() else (colours >> 8).astype(np.uint8)


def _widened(pixels: Pixels, bits: int) -> Pixels:
    """Stretch samples of an odd number of bits to 8 or 16, so that full stays full."""
    top = 255 if bits < 8 else 65535
    scaled = np.rint(pixels * (top / (2.0**bits - 1.0)))
    return scaled.astype(np.uint8 if bits < 8 else np.uint16)


def _three_channels(pixels: Pixels) -> Pixels:
    if pixels.dtype == np.uint32:
        pixels = (pixels >> 16).astype(np.uint16)
    elif pixels.dtype.kind == "f":
        pixels = np.nan_to_num(pixels.astype(np.float32), posinf=1.0, neginf=0.0)
    elif pixels.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise UnsupportedFormatError(
            f"samples of type {pixels.dtype} are not read; save it with 8 or 16 bits"
        )
    if pixels.ndim == 2:
        return np.repeat(pixels[:, :, None], 3, axis=2)
    if pixels.ndim != 3:
        raise UnsupportedFormatError(f"a picture of {pixels.ndim} dimensions is no photo; give one page")
    if pixels.shape[2] in {1, 2}:
        return np.repeat(pixels[:, :, :1], 3, axis=2)
    if pixels.shape[2] > 4:
        raise UnsupportedFormatError(f"a picture of {pixels.shape[2]} channels is no photo; give RGB")
    return pixels[:, :, :3]
