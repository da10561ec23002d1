"""Write DNG: a Bayer mosaic as a camera would, and a linear image for any raw converter.

Source: Adobe, "Digital Negative (DNG) Specification" 1.4, 2012, and 1.6, 2021.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.photo.tags.exif_block import (
    BYTE,
    EXIF_POINTER,
    GPS_POINTER,
    UNDEFINED,
    Directory,
    exif_directory,
    laid_out,
    main_directory,
)
from lensmodel.photo.values import PhotoMetadata

BAYER_PATTERNS: Final = ("RGGB", "BGGR", "GRBG", "GBRG")

XYZ_TO_SRGB: Final = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
"""CIE XYZ (D65) to linear sRGB, IEC 61966-2-1."""

_STRIP_OFFSETS: Final = 273  # tag, TIFF 6.0, section 8
_OPCODE_LISTS: Final = (51009, 51022)  # OpcodeList2 and 3: DNG 1.6, chapter 7
_CFA, _LINEAR_RAW = 32803, 34892  # PhotometricInterpretation of TIFF/EP and of DNG 1.6, chapter 3
UNKNOWN: Final = PhotoMetadata()
_D65: Final = 21  # CalibrationIlluminant1 of DNG 1.6, chapter 4, in the numbers of Exif's LightSource


def write_bayer_dng(
    path: str | Path,
    mosaic: NDArray[np.uint16],
    *,
    black: int,
    white: int,
    pattern: str = "RGGB",
    color_matrix: ArrayLike = XYZ_TO_SRGB,
    as_shot_neutral: Sequence[float] = (1.0, 1.0, 1.0),
    metadata: PhotoMetadata = UNKNOWN,
    description: str = "",
    baseline_exposure: float | None = None,
) -> None:
    """Write a raw mosaic as an uncompressed DNG; the file appears whole or not at all."""
    if mosaic.ndim != 2 or mosaic.dtype != np.uint16 or mosaic.shape[0] % 2 or mosaic.shape[1] % 2:
        raise InvalidInputError(f"a mosaic is uint16 with even sides, got {mosaic.dtype} {mosaic.shape}")
    if pattern not in BAYER_PATTERNS:
        raise InvalidInputError(f"pattern must be one of {', '.join(BAYER_PATTERNS)}, got {pattern!r}")
    colours = bytes("RGB".index(letter) for letter in pattern)
    tags = _common_tags(1, _CFA, metadata, description, baseline_exposure)
    tags.shorts(33421, 2, 2)  # CFARepeatPatternDim
    tags.raw(33422, BYTE, colours)  # CFAPattern
    tags.raw(50710, BYTE, b"\x00\x01\x02")  # CFAPlaneColor: red, green, blue
    tags.shorts(50711, 1)  # CFALayout: rectangular
    _colour_tags(
        tags, 1, black=black, white=white, color_matrix=color_matrix, as_shot_neutral=as_shot_neutral
    )
    _write(Path(path), tags, {EXIF_POINTER: _exif(metadata)}, mosaic)


def write_linear_dng(
    path: str | Path,
    planes: NDArray[np.uint16],
    *,
    color_matrix: ArrayLike = XYZ_TO_SRGB,
    as_shot_neutral: Sequence[float] = (1.0, 1.0, 1.0),
    metadata: PhotoMetadata = UNKNOWN,
    description: str = "",
    baseline_exposure: float | None = None,
    xmp: bytes = b"",
    opcodes_2: bytes = b"",
    opcodes_3: bytes = b"",
    gps: Directory | None = None,
) -> None:
    """Write a demosaiced linear image as a DNG (LinearRaw); the file appears whole or not at all."""
    if planes.ndim != 3 or planes.shape[0] != 3 or planes.dtype != np.uint16:
        raise InvalidInputError(f"planes are uint16 of shape (3, H, W), got {planes.dtype} {planes.shape}")
    tags = _common_tags(3, _LINEAR_RAW, metadata, description, baseline_exposure)
    # LibRaw 0.22 takes a black level of linear images off the values but not off the white level
    _colour_tags(tags, 3, black=0, white=65535, color_matrix=color_matrix, as_shot_neutral=as_shot_neutral)
    if xmp:
        tags.raw(700, BYTE, xmp)
    for tag, opcodes in zip(_OPCODE_LISTS, (opcodes_2, opcodes_3), strict=True):
        if opcodes:
            tags.raw(tag, UNDEFINED, opcodes)
    below = {EXIF_POINTER: _exif(metadata), GPS_POINTER: gps or Directory()}
    _write(Path(path), tags, below, planes.transpose(1, 2, 0))


def _common_tags(
    samples: int,
    photometric: int,
    metadata: PhotoMetadata,
    description: str,
    baseline_exposure: float | None,
) -> Directory:
    tags = main_directory(metadata, metadata.orientation, description)
    tags.longs(254, 0)  # NewSubfileType: the full image
    tags.shorts(258, *(16,) * samples)
    tags.shorts(259, 1)  # not compressed
    tags.shorts(262, photometric)
    tags.shorts(277, samples)
    tags.shorts(284, 1)  # interleaved
    tags.raw(50706, BYTE, bytes((1, 4, 0, 0)))  # DNGVersion
    tags.raw(50707, BYTE, bytes((1, 1, 0, 0)))  # DNGBackwardVersion
    # Most models carry their maker already; programs look cameras up by this name.
    maker, model = metadata.camera_maker or "", metadata.camera_model or ""
    unique = model if model.lower().startswith(maker.lower()) else f"{maker} {model}"
    tags.text(50708, unique.strip() or "Unknown")  # UniqueCameraModel
    if baseline_exposure is not None:
        tags.signed_rationals(50730, [baseline_exposure])
    tags.text(50735, metadata.body_serial)  # CameraSerialNumber
    return tags


def _colour_tags(
    tags: Directory,
    samples: int,
    *,
    black: int,
    white: int,
    color_matrix: ArrayLike,
    as_shot_neutral: Sequence[float],
) -> None:
    matrix = np.asarray(color_matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise InvalidInputError(f"the colour matrix must be 3 x 3 and finite, got {matrix.shape}")
    if len(as_shot_neutral) != 3 or not all(math.isfinite(v) and v > 0 for v in as_shot_neutral):
        raise InvalidInputError(f"the neutral must be three positive numbers, got {tuple(as_shot_neutral)}")
    if not 0 <= black < white <= 65535:
        raise InvalidInputError(f"levels must satisfy 0 <= black < white <= 65535, got {black}, {white}")
    tags.shorts(50713, 1, 1)  # BlackLevelRepeatDim
    tags.shorts(50714, *(black,) * samples)
    tags.shorts(50717, *(white,) * samples)
    tags.signed_rationals(50721, matrix.ravel().tolist())  # ColorMatrix1
    tags.rationals(50728, *as_shot_neutral)
    tags.shorts(50778, _D65)  # CalibrationIlluminant1


def _exif(metadata: PhotoMetadata) -> Directory:
    tags = exif_directory(metadata)
    tags.text(0xA431, metadata.body_serial)
    tags.text(0xA435, metadata.lens.serial)
    return tags


def _write(path: Path, tags: Directory, below: Mapping[int, Directory], pixels: NDArray[np.uint16]) -> None:
    with atomic(path) as file:
        write_strip(file, tags, below, pixels)


def write_strip(
    file: BinaryIO, tags: Directory, below: Mapping[int, Directory], pixels: NDArray[np.generic]
) -> None:
    """Write a TIFF structure and the pixels that it describes, as one strip that is not compressed."""
    height, width = pixels.shape[:2]
    tags.longs(256, width)
    tags.longs(257, height)
    tags.longs(278, height)
    tags.longs(279, pixels.nbytes)
    tags.longs(_STRIP_OFFSETS, 0)
    at = len(laid_out(tags, below))
    at += -at % 16
    tags.longs(_STRIP_OFFSETS, at)
    file.write(laid_out(tags, below).ljust(at, b"\0"))
    file.write(np.ascontiguousarray(pixels).astype(pixels.dtype.newbyteorder("<"), copy=False).data)
