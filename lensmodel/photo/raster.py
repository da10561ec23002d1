"""TIFF, PNG and JPEG: their numbers in full precision, laid as on the sensor, developed to linear light."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, TypeAlias

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from lensmodel.core.errors import (
    LensModelError,
    NotAnImageError,
    TruncatedImageError,
    UnreadablePhotoError,
    UnsupportedFormatError,
)
from lensmodel.core.geometry import Frame
from lensmodel.core.types import Planes
from lensmodel.photo.colour import CODES, curves_of, decode, is_of_rgb, matrix_profile, named_profile
from lensmodel.photo.containers import Header, JpegSegments, opened_jpeg, png_picture
from lensmodel.photo.metadata import Said
from lensmodel.photo.noise import coding_noise, estimate_noise, grain_of
from lensmodel.photo.values import Encoding, LinearPhoto, PhotoInfo, Transfer

Pixels: TypeAlias = NDArray[Any]
"""Numbers of a file, `(row, col)` or `(row, col, channel)`."""

_TURNED: Final = (
    "a program has turned its pixels upright, and nothing tells which way: the PSFs of both are averaged, "
    "and the more these differ, the less is corrected"
)


def develop_raster(path: Path, said: Said, info: PhotoInfo) -> LinearPhoto:
    """Decode a picture and turn its numbers into linear light by its transfer curve."""
    header, (pixels, transparent) = said.header, read_pixels(path, said.header)
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
        chroma_step=header.chroma_step,
        remarks=(
            *(("its transparency is dropped",) if transparent else ()),
            *without,
            *((_TURNED,) if info.turned else ()),
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
                page = tifffile.TiffPage(file, 0)
                pixels = page.asarray()
            if pixels.ndim == 3 and page.planarconfig == 2:
                pixels = np.moveaxis(pixels, 0, -1)
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


def _three_channels(pixels: Pixels) -> Pixels:
    if pixels.dtype.kind == "f":
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
