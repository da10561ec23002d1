"""DNG: a Bayer mosaic as a camera would write it, what a linear image says of its colours, and opcode lists.

Source: Adobe, "Digital Negative (DNG) Specification" 1.4, 2012, and 1.6, 2021 (chapter 7: opcodes).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.core.types import BayerPattern
from lensmodel.photo.metadata import exif_tags, main_tags
from lensmodel.photo.tiff import (
    BYTE,
    EXIF,
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

UNKNOWN: Final = PhotoMetadata()


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
    if not 0 <= black < white <= 65535:
        raise InvalidInputError(f"levels must satisfy 0 <= black < white <= 65535, got {black}, {white}")
    tags = {
        **main_tags(metadata, description),
        **dng_tags(metadata, color_matrix, as_shot_neutral, baseline_exposure),
        262: shorts(32803),  # PhotometricInterpretation: a colour filter array (TIFF/EP)
        33421: shorts(2, 2),  # CFARepeatPatternDim
        33422: (BYTE, bytes("RGB".index(letter) for letter in pattern)),  # CFAPattern
        50710: (BYTE, b"\x00\x01\x02"),  # CFAPlaneColor: red, green, blue
        50711: shorts(1),  # CFALayout: rectangular
        50714: shorts(black),
        50717: shorts(white),
    }
    with atomic(Path(path)) as file:
        write_strip(file, tags, {EXIF: exif_tags(metadata)}, mosaic)


def dng_tags(
    metadata: PhotoMetadata,
    color_matrix: ArrayLike,
    as_shot_neutral: Sequence[float],
    baseline_exposure: float | None,
) -> Written:
    """Tags that make a TIFF a DNG: its version, camera and colours."""
    matrix = np.asarray(color_matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise InvalidInputError(f"the colour matrix must be 3 x 3 and finite, got {matrix.shape}")
    if len(as_shot_neutral) != 3 or not all(math.isfinite(v) and v > 0 for v in as_shot_neutral):
        raise InvalidInputError(f"the neutral must be three positive numbers, got {tuple(as_shot_neutral)}")
    # Most models carry their maker already; programs look cameras up by this name.
    maker, model = metadata.camera_maker or "", metadata.camera_model or ""
    unique = model if model.lower().startswith(maker.lower()) else f"{maker} {model}"
    return {
        254: longs(0),  # NewSubfileType: the full image
        50706: (BYTE, bytes((1, 4, 0, 0))),  # DNGVersion
        50707: (BYTE, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        50708: text(unique.strip() or "Unknown"),  # UniqueCameraModel
        50713: shorts(1, 1),  # BlackLevelRepeatDim
        50721: signed_rationals(matrix.ravel().tolist()),  # ColorMatrix1
        50728: rationals(*as_shot_neutral),
        50730: None if baseline_exposure is None else signed_rationals([baseline_exposure]),
        50735: text(metadata.body_serial),  # CameraSerialNumber
        50778: shorts(21),  # CalibrationIlluminant1: D65, in the numbers of Exif's LightSource
    }


# --- opcodes: what raw converters are to do with the image, kept for a demosaiced one --------------

_OPCODES: Final = (
    *("", "WarpRectilinear", "WarpFisheye", "FixVignetteRadial", "FixBadPixelsConstant", "FixBadPixelsList"),
    *("TrimBounds", "MapTable", "MapPolynomial", "GainMap", "DeltaPerRow", "DeltaPerColumn", "ScalePerRow"),
    *("ScalePerColumn", "WarpRectilinear2"),
)
_GAIN_MAP: Final = _OPCODES.index("GainMap")
_GAIN_HEAD: Final = struct.Struct(">10I4dI")
_MOST: Final = 64  # opcodes of a list (chosen): cameras write below ten


class Opcode(NamedTuple):
    """One step: its number, the DNG version it asks for, flags, and parameters."""

    number: int
    version: int
    flags: int
    data: bytes

    @property
    def name(self) -> str:
        """Name by the specification."""
        return _OPCODES[self.number] if 0 < self.number < len(_OPCODES) else f"opcode {self.number}"


def read_opcodes(block: bytes) -> list[Opcode]:
    """Take a list apart; one that is damaged gives what came before the damage."""
    steps, at = list[Opcode](), 4
    for _ in range(min(int.from_bytes(block[:4], "big"), _MOST)):
        head, start = block[at : at + 16], at + 16
        number, version, flags, size = struct.unpack(">4I", head.ljust(16, b"\xff"))
        at = start + size
        if at > len(block):
            break
        steps.append(Opcode(number, version, flags, block[start:at]))
    return steps


def packed_opcodes(steps: list[Opcode]) -> bytes:
    """Put a list together; nothing for no step."""
    body = b"".join(struct.pack(">4I", *step[:3], len(step.data)) + step.data for step in steps)
    return struct.pack(">I", len(steps)) + body if steps else b""


def demosaiced(steps: list[Opcode], cfa: BayerPattern | None) -> tuple[list[Opcode], list[Opcode]]:
    """Rewrite the steps of OpcodeList2, which are for a mosaic, for an image of three colours.

    A gain map of every second pixel of a mosaic is that of a colour; of the two greens the mean is taken.
    """
    kept, lost, green = list[Opcode](), list[Opcode](), -1
    for step in steps:
        mapped = _gain_of_colours(step, cfa) if step.number == _GAIN_MAP else None
        if mapped is None:
            lost.append(step)
            continue
        colour, whole = mapped
        if colour == 1 and green >= 0 and len(kept[green].data) == len(whole.data):
            pair = kept[green], whole
            gains = [np.frombuffer(each.data, ">f4", offset=_GAIN_HEAD.size).astype(float) for each in pair]
            mean = ((gains[0] + gains[1]) / 2.0).astype(">f4").tobytes()
            kept[green] = whole._replace(data=kept[green].data[: _GAIN_HEAD.size] + mean)
            continue
        green = len(kept) if colour == 1 else green
        kept.append(whole)
    return kept, lost


def _gain_of_colours(step: Opcode, cfa: BayerPattern | None) -> tuple[int | None, Opcode] | None:
    """Return the colour that a gain map of a mosaic is for, None for all, and the map for planes."""
    if len(step.data) < _GAIN_HEAD.size:
        return None
    top, left, bottom, right, _, _, *pitch, across, down = _GAIN_HEAD.unpack_from(step.data)[:10]
    colour = cfa[top % 2][left % 2] if pitch == [2, 2] and cfa is not None else None
    if colour is None and pitch != [1, 1]:
        return None
    if colour is not None:  # the two rows and columns between whose pixels the others stood
        top, left, bottom, right = top - top % 2, left - left % 2, bottom + bottom % 2, right + right % 2
    planes = (0, 3) if colour is None else (colour, 1)
    area = struct.pack(">10I", top, left, bottom, right, *planes, 1, 1, across, down)
    return colour, step._replace(data=area + step.data[len(area) :])
