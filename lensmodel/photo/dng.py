"""Write DNG: a Bayer mosaic as a camera would, and a linear image for any raw converter.

Source: Adobe, "Digital Negative (DNG) Specification" 1.4, 2012, and 1.6, 2021.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.photo.metadata import exif_tags, main_tags
from lensmodel.photo.tiff import (
    BYTE,
    EXIF,
    GPS,
    Value,
    Written,
    longs,
    rationals,
    shorts,
    signed_rationals,
    text,
    write_strip,
)
from lensmodel.photo.values import PhotoMetadata

BAYER_PATTERNS: Final = ("RGGB", "BGGR", "GRBG", "GBRG")

XYZ_TO_SRGB: Final = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
"""CIE XYZ (D65) to linear sRGB, IEC 61966-2-1."""

_CFA, _LINEAR_RAW = 32803, 34892  # PhotometricInterpretation of TIFF/EP and of DNG 1.6, chapter 3
_D65: Final = 21  # CalibrationIlluminant1 of DNG 1.6, chapter 4, in the numbers of Exif's LightSource
UNKNOWN: Final = PhotoMetadata()
NONE: Final[Written] = MappingProxyType({})


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
    tags = {
        262: shorts(_CFA),
        33421: shorts(2, 2),  # CFARepeatPatternDim
        33422: (BYTE, bytes("RGB".index(letter) for letter in pattern)),  # CFAPattern
        50710: (BYTE, b"\x00\x01\x02"),  # CFAPlaneColor: red, green, blue
        50711: shorts(1),  # CFALayout: rectangular
        **_colour_tags((black,), (white,), color_matrix, as_shot_neutral),
        **_common_tags(metadata, description, baseline_exposure),
    }
    with atomic(Path(path)) as file:
        write_strip(file, tags, {EXIF: exif_tags(metadata)}, mosaic)


def write_linear_dng(
    path: str | Path,
    planes: NDArray[np.uint16],
    *,
    color_matrix: ArrayLike = XYZ_TO_SRGB,
    as_shot_neutral: Sequence[float] = (1.0, 1.0, 1.0),
    metadata: PhotoMetadata = UNKNOWN,
    description: str = "",
    baseline_exposure: float | None = None,
    more: Written = NONE,
    gps: Written = NONE,
) -> None:
    """Write a demosaiced linear image, with `more` tags, as a DNG (LinearRaw); whole or not at all."""
    if planes.ndim != 3 or planes.shape[0] != 3 or planes.dtype != np.uint16:
        raise InvalidInputError(f"planes are uint16 of shape (3, H, W), got {planes.dtype} {planes.shape}")
    tags = {
        262: shorts(_LINEAR_RAW),
        # LibRaw 0.22 takes a black level of linear images off the values but not off the white level
        **_colour_tags((0,) * 3, (65535,) * 3, color_matrix, as_shot_neutral),
        **_common_tags(metadata, description, baseline_exposure),
        **more,
    }
    with atomic(Path(path)) as file:
        write_strip(file, tags, {EXIF: exif_tags(metadata), GPS: gps}, planes.transpose(1, 2, 0))


def _common_tags(
    metadata: PhotoMetadata, description: str, baseline_exposure: float | None
) -> Mapping[int, Value | None]:
    # Most models carry their maker already; programs look cameras up by this name.
    maker, model = metadata.camera_maker or "", metadata.camera_model or ""
    unique = model if model.lower().startswith(maker.lower()) else f"{maker} {model}"
    return {
        **main_tags(metadata, metadata.orientation, description),
        254: longs(0),  # NewSubfileType: the full image
        50706: (BYTE, bytes((1, 4, 0, 0))),  # DNGVersion
        50707: (BYTE, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        50708: text(unique.strip() or "Unknown"),  # UniqueCameraModel
        50730: None if baseline_exposure is None else signed_rationals([baseline_exposure]),
        50735: text(metadata.body_serial),  # CameraSerialNumber
    }


def _colour_tags(
    black: Sequence[int], white: Sequence[int], color_matrix: ArrayLike, as_shot_neutral: Sequence[float]
) -> Mapping[int, Value | None]:
    matrix = np.asarray(color_matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise InvalidInputError(f"the colour matrix must be 3 x 3 and finite, got {matrix.shape}")
    if len(as_shot_neutral) != 3 or not all(math.isfinite(v) and v > 0 for v in as_shot_neutral):
        raise InvalidInputError(f"the neutral must be three positive numbers, got {tuple(as_shot_neutral)}")
    if not 0 <= black[0] < white[0] <= 65535:
        raise InvalidInputError(
            f"levels must satisfy 0 <= black < white <= 65535, got {black[0]}, {white[0]}"
        )
    return {
        50713: shorts(1, 1),  # BlackLevelRepeatDim
        50714: shorts(*black),
        50717: shorts(*white),
        50721: signed_rationals(matrix.ravel().tolist()),  # ColorMatrix1
        50728: rationals(*as_shot_neutral),
        50778: shorts(_D65),  # CalibrationIlluminant1
    }
