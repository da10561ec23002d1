"""TIFF, PNG and JPEG: their numbers in full precision, laid as on the sensor, developed to linear light."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeAlias

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from lensmodel.core.errors import (
    LensModelError,
    NotAnImageError,
    TruncatedImageError,
    TurnedPixelsError,
    UnreadablePhotoError,
    UnsupportedFormatError,
)
from lensmodel.core.geometry import Frame
from lensmodel.core.types import Planes
from lensmodel.photo.colour import CODES, curves_of, decode, is_of_rgb, matrix_profile, named_profile
from lensmodel.photo.containers import Header, JpegSegments, opened_jpeg, png_picture
from lensmodel.photo.metadata import Said
from lensmodel.photo.noise import coding_noise, estimate_noise, grain_of
from lensmodel.photo.values import Encoding, LinearPhoto, PhotoInfo, PhotoMetadata, Transfer

Pixels: TypeAlias = NDArray[Any]
"""Numbers of a file, `(row, col)` or `(row, col, channel)`."""

UNDECODABLE: Final = (NotAnImageError, OSError, SyntaxError, ValueError)
"""What is raised at JPEGs that are damaged or hostile."""

_TURNED: Final = (
    "a program has turned its pixels upright, and nothing tells which way: the PSFs of both are averaged, "
    "and the more these differ, the less is corrected"
)


def develop_raster(path: Path, said: Said, info: PhotoInfo) -> LinearPhoto:
    """Decode a picture and turn its numbers into linear light by its transfer curve."""
    header, (pixels, transparent) = said.header, read_pixels(path, said.header)
    pixels = np.ascontiguousarray(np.rot90(pixels, info.turns or 0))
    height, width = pixels.shape[:2]
    if (height, width) != (info.height, info.width):
        raise UnreadablePhotoError(
            f"the header says {info.width} x {info.height}, the decoder gave {width} x {height}; save it anew"
        )
    transfer, icc, without = _transfer_of(said, pixels)
    curves = curves_of(transfer, icc)
    planes: Planes = np.empty((3, height, width), dtype=np.float32)
    for k, curve in enumerate(curves):
        numbers = pixels[:, :, k]
        planes[k] = numbers if numbers.dtype.kind == "f" and transfer == "linear" else decode(numbers, curve)
    green, code = curves[1], {1: CODES // 255, 2: 1}.get(pixels.dtype.itemsize, 1)
    codes = green[::code] if pixels.dtype.itemsize == 1 else None
    clip = max(1.0, float(planes.max())) if pixels.dtype.kind == "f" else 1.0
    r, g, b = (estimate_noise(plane, clip, float(green[code] - green[0]), codes) for plane in planes)
    return LinearPhoto(
        planes=planes,
        frame=Frame(height, width),
        noise=(r, g, b),
        clip=(clip,) * 3,
        info=info,
        encoding=Encoding(
            bit_depth=8 * pixels.dtype.itemsize,
            transfer=transfer,
            icc=icc,
            metadata=info.metadata.without_serials(),
        ),
        grain=grain_of(planes, (r, g, b), (clip,) * 3),
        coding_noise=coding_noise(header.coarseness, green),
        chroma_step=header.chroma_step[::-1] if info.turns else header.chroma_step,
        remarks=(
            *(("its transparency is dropped",) if transparent else ()),
            *without,
            *((_TURNED,) if info.turns is None else ()),
        ),
    )


def _transfer_of(said: Said, pixels: Pixels) -> tuple[Transfer, bytes | None, tuple[str, ...]]:
    """Which curve the numbers follow, the profile for the output, and a word on one that is left out."""
    icc, lost, floating = said.header.icc, said.header.icc_lost, pixels.dtype.kind == "f"
    if icc is not None and matrix_profile(icc) is not None:
        return "icc", icc, _without_profile("its other tags say") if lost else ()
    if icc is not None and not floating and is_of_rgb(icc):
        return "srgb", icc, ()
    declared = named_profile("adobergb") if said.adobe_rgb and not floating else None
    instead = "its other tags say" if declared else "linear light" if floating else "sRGB"
    without = _without_profile(instead) if lost or icc is not None else ()
    return ("linear" if floating else "icc" if declared else "srgb"), declared, without


def _without_profile(instead: str) -> tuple[str, ...]:
    return (f"its ICC profile is damaged or not for RGB: its colours are read as {instead}",)


def read_pixels(path: Path, header: Header) -> tuple[Pixels, bool]:
    """Decode to numbers `(row, col, 3)`, and say whether alpha was dropped that was not opaque."""
    name = header.kind.upper()
    try:
        if header.kind == "tiff":
            with tifffile.TiffFile(path) as file:
                file.filehandle.seek(header.directory)
                pixels = _tiff_page(tifffile.TiffPage(file, 0))
        elif header.kind == "png":
            pixels = imagecodecs.png_decode(png_picture(path.read_bytes()))
        else:
            with opened_jpeg(JpegSegments(path.read_bytes())) as image:
                pixels = np.asarray(image.convert("RGB"))
        alpha = pixels[:, :, -1] if pixels.ndim == 3 and pixels.shape[2] in {2, 4} else None
        return _three_channels(pixels), alpha is not None and bool((alpha != alpha.max()).any())
    except (MemoryError, LensModelError):
        raise
    except Exception as error:  # decoders meet hostile files with exceptions of any kind
        if "truncated" in str(error):
            raise TruncatedImageError(f"the {name} ends before its picture does ({error})") from error
        raise NotAnImageError(f"the {name}'s pixel data are damaged ({error})") from error


def _tiff_page(page: tifffile.TiffPage) -> Pixels:
    kind, pixels = page.photometric, page.asarray()
    if pixels.ndim == 3 and page.planarconfig == 2:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * (1 if kind == 3 else 255)
    elif kind != 3 and pixels.dtype.kind == "u" and page.bitspersample not in {8, 16, 32}:
        pixels = _widened(pixels, page.bitspersample)
    if kind == 0:
        pixels = np.invert(pixels) if pixels.dtype.kind == "u" else 1 - pixels
    if kind == 3 and page.colormap is not None:
        indices = pixels if pixels.ndim == 2 else pixels[:, :, 0]  # what follows them is alpha
        pixels = _colours_of(page.colormap)[indices]
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
        pixels = pixels.astype(np.float32)
        known = pixels[np.isfinite(pixels)]
        pixels = np.nan_to_num(pixels, posinf=max(1.0, float(known.max(initial=0.0))), neginf=0.0)
    elif pixels.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise UnsupportedFormatError(
            f"samples of type {pixels.dtype} are not read; save it with 8 or 16 bits"
        )
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or pixels.shape[2] > 4:
        raise UnsupportedFormatError(f"a picture of shape {pixels.shape} is no photo; give RGB on one page")
    return np.repeat(pixels[:, :, :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[:, :, :3]


# --- pixels that a program has turned upright ---------------------------------------------------

ORIENTATION: Final = {1: 6, 3: 8}  # of the sensor's pixels, by the quarter turns from upright ones to them
_OFFSET, _LENGTH = 0x0201, 0x0202  # of a JPEG thumbnail in the second directory of EXIF
_MOST_BYTES: Final = 1 << 20  # of a thumbnail: the block of EXIF in a JPEG holds 64 KiB
_MOST_PIXELS: Final = 1 << 20
_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601, as in a JPEG
_ROWS: Final = 48  # of both pictures when they are compared (chosen)
_ALIKE: Final = 0.9  # least correlation with the thumbnail (chosen: compression leaves more than .98)
_CLEARER: Final = 0.2  # by which the other turn correlates less, at least (chosen)


def turns_to_sensor(path: Path, header: Header, metadata: PhotoMetadata) -> int | None:
    """Quarter turns, counter-clockwise, from the stored pixels to the sensor's; None if nothing tells.

    Programs that turn them and set the orientation to 1 mostly leave the camera's thumbnail as it was, wider
    than high: of both quarter turns that one is right which lays the picture over it.
    """
    if header.height <= header.width or metadata.orientation != 1 or metadata.camera_model is None:
        return 0
    thumbnail = _thumbnail(header)
    if thumbnail is None or thumbnail.height >= thumbnail.width:
        return None
    try:
        picture = _lightness(path, header)
    except (LensModelError, *UNDECODABLE):
        return None
    aspect = picture.height / picture.width
    # a thumbnail of 4 : 3 holds a wider picture between black bars
    rows = min(thumbnail.height, round(thumbnail.width / aspect))
    top = (thumbnail.height - rows) // 2
    seen = thumbnail.crop((0, top, thumbnail.width, top + rows))
    lying = [seen, *map(picture.transpose, (Image.Transpose.ROTATE_90, Image.Transpose.ROTATE_270))]
    size = (math.ceil(_ROWS * aspect), _ROWS)
    small = [np.array(each.resize(size, Image.Resampling.BOX), np.float64).ravel() for each in lying]
    if min(float(each.std()) for each in small) == 0.0:
        return None
    alike = dict(zip(ORIENTATION, np.asarray(np.corrcoef(small))[0, 1:], strict=True))
    best, other = sorted(alike, key=alike.__getitem__, reverse=True)
    return best if alike[best] > _ALIKE and alike[best] - alike[other] > _CLEARER else None


def require_known_turn(info: PhotoInfo) -> None:
    """Refuse to learn from a photo of which nobody can tell how it lay on the sensor."""
    if info.turns is None:
        raise TurnedPixelsError(
            "a program has turned its pixels upright, and nothing tells which way: no place of it is "
            "known on the sensor; give the file as the camera wrote it"
        )


def _lightness(path: Path, header: Header) -> Image.Image:
    """The picture in grey, of floating-point numbers; a JPEG is decoded small."""
    if header.kind == "jpeg":
        with opened_jpeg(JpegSegments(path.read_bytes())) as image:
            image.draft("L", (256, 256))
            return image.convert("L").convert("F")
    return Image.fromarray(read_pixels(path, header)[0] @ _LUMA)


def _thumbnail(header: Header) -> Image.Image | None:
    for reader in header.tiff:
        tags, _ = reader.directory(reader.directory(reader.first)[1])
        begin, size = reader.base + tags.integer(_OFFSET), min(tags.integer(_LENGTH), _MOST_BYTES)
        with suppress(*UNDECODABLE):
            image = opened_jpeg(JpegSegments(reader.buffer[begin : begin + size]))
            if image.width * image.height <= _MOST_PIXELS:
                return image.convert("L").convert("F")
    return None
