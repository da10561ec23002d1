"""Write DNG: a Bayer mosaic as a camera would, and a linear image for any raw converter.

A small TIFF writer of our own, because the general ones do not write the EXIF directory that says
which lens a photo was taken with. Sources: Adobe, "Digital Negative (DNG) Specification" 1.4,
2012; TIFF revision 6.0, 1992; CIPA DC-008 (Exif 2.32), 2019.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic

BAYER_PATTERNS: Final = ("RGGB", "BGGR", "GRBG", "GBRG")

XYZ_TO_SRGB: Final = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
"""CIE XYZ (D65) to linear sRGB, IEC 61966-2-1."""

# Types of TIFF 6.0, section 2, and their bytes.
_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_SIZES: Final = {_BYTE: 1, _ASCII: 1, _SHORT: 2, _LONG: 4, _RATIONAL: 8, _UNDEFINED: 1, _SRATIONAL: 8}

_EXIF_IFD: Final = 34665  # tag, Exif 2.32, section 4.6.3
_STRIP_OFFSETS: Final = 273  # tag, TIFF 6.0, section 8
_MAX_UINT32: Final = 2**32 - 1  # largest number of a LONG
_CFA, _LINEAR_RAW = 32803, 34892  # PhotometricInterpretation of TIFF/EP and of DNG 1.6, chapter 3
_D65: Final = 21  # CalibrationIlluminant1 of DNG 1.6, chapter 4, in the numbers of Exif's LightSource


@dataclass(frozen=True, slots=True)
class ShotInfo:
    """What a photo says about how it was taken; None or an empty text is left out of the file.

    Parameters
    ----------
    camera_maker, camera_model, body_serial : str
        The camera.
    lens_maker, lens_model, lens_serial : str
        The lens (EXIF 0xA433 to 0xA435).
    aperture : float or None
        The f-number.
    focal_mm : float or None
        Focal length in millimetres.
    focal_range_mm : tuple of float or None
        Shortest and longest focal length of the lens.
    widest_aperture : tuple of float or None
        Smallest f-number at the shortest and longest focal length.
    focus_m : float or None
        Subject distance in metres; infinity is allowed.
    iso : int or None
        Photographic sensitivity.
    exposure_s : float or None
        Exposure time in seconds.
    taken_at : datetime or None
        When the photo was taken.
    pixel_pitch_um : float or None
        Written as the focal plane resolution.
    orientation : int
        EXIF orientation, 1 to 8.
    software, description : str
        Free texts.
    baseline_exposure : float or None
        Stops by which a raw converter is asked to brighten the picture.
    """

    camera_maker: str = ""
    camera_model: str = ""
    body_serial: str = ""
    lens_maker: str = ""
    lens_model: str = ""
    lens_serial: str = ""
    aperture: float | None = None
    focal_mm: float | None = None
    focal_range_mm: tuple[float, float] | None = None
    widest_aperture: tuple[float, float] | None = None
    focus_m: float | None = None
    iso: int | None = None
    exposure_s: float | None = None
    taken_at: datetime | None = None
    pixel_pitch_um: float | None = None
    orientation: int = 1
    software: str = "lensmodel"
    description: str = ""
    baseline_exposure: float | None = None

    def __post_init__(self) -> None:
        if self.orientation not in range(1, 9):
            raise InvalidInputError(f"EXIF orientation must be 1 to 8, got {self.orientation}")
        for name in ("aperture", "focal_mm", "exposure_s", "pixel_pitch_um"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InvalidInputError(f"{name} must be positive or None, got {value}")
        if self.focus_m is not None and not self.focus_m > 0:
            raise InvalidInputError(f"focus_m must be positive metres or None, got {self.focus_m}")


def write_bayer_dng(
    path: str | Path,
    mosaic: NDArray[np.uint16],
    *,
    black: int,
    white: int,
    pattern: str = "RGGB",
    color_matrix: ArrayLike = XYZ_TO_SRGB,
    as_shot_neutral: Sequence[float] = (1.0, 1.0, 1.0),
    shot: ShotInfo | None = None,
) -> None:
    """Write a raw mosaic as an uncompressed DNG; the file appears whole or not at all.

    Parameters
    ----------
    path : str or Path
        Where to; an existing file is replaced.
    mosaic : ndarray, shape (H, W), uint16
        Raw numbers, even sides.
    black, white : int
        Black level and saturation.
    pattern : {"RGGB", "BGGR", "GRBG", "GBRG"}
        Colours of the top left 2 x 2 cell, row by row.
    color_matrix : array_like, shape (3, 3)
        CIE XYZ (D65) to camera colours (DNG ColorMatrix1).
    as_shot_neutral : sequence of float
        Camera colours of a grey scene: one over the white balance multipliers.
    shot : ShotInfo, optional
        Metadata.

    Raises
    ------
    InvalidInputError
        If an argument is out of its range.
    """
    if mosaic.ndim != 2 or mosaic.dtype != np.uint16 or mosaic.shape[0] % 2 or mosaic.shape[1] % 2:
        raise InvalidInputError(f"a mosaic is uint16 with even sides, got {mosaic.dtype} {mosaic.shape}")
    if pattern not in BAYER_PATTERNS:
        raise InvalidInputError(f"pattern must be one of {', '.join(BAYER_PATTERNS)}, got {pattern!r}")
    shot = shot or ShotInfo()
    colours = bytes("RGB".index(letter) for letter in pattern)
    tags = _Directory(_common_tags(mosaic.shape[0], mosaic.shape[1], 1, _CFA, shot))
    tags.shorts(33421, 2, 2)  # CFARepeatPatternDim
    tags.raw(33422, _BYTE, colours)  # CFAPattern
    tags.raw(50710, _BYTE, b"\x00\x01\x02")  # CFAPlaneColor: red, green, blue
    tags.shorts(50711, 1)  # CFALayout: rectangular
    _colour_tags(
        tags, 1, black=black, white=white, color_matrix=color_matrix, as_shot_neutral=as_shot_neutral
    )
    _write(Path(path), tags, _exif(shot), mosaic)


def write_linear_dng(
    path: str | Path,
    planes: NDArray[np.uint16],
    *,
    white: int = 65535,
    color_matrix: ArrayLike = XYZ_TO_SRGB,
    as_shot_neutral: Sequence[float] = (1.0, 1.0, 1.0),
    shot: ShotInfo | None = None,
    xmp: bytes = b"",
) -> None:
    """Write a demosaiced linear image as a DNG (LinearRaw); the file appears whole or not at all.

    Parameters
    ----------
    path : str or Path
        Where to; an existing file is replaced.
    planes : ndarray, shape (3, H, W), uint16
        Camera colours, linear, not white balanced, black at 0: LibRaw 0.22 takes a black level of
        linear images off the values but not off the white level.
    white, color_matrix, as_shot_neutral, shot
        See `write_bayer_dng`.
    xmp : bytes
        A packet to put in.

    Raises
    ------
    InvalidInputError
        If an argument is out of its range.
    """
    if planes.ndim != 3 or planes.shape[0] != 3 or planes.dtype != np.uint16:
        raise InvalidInputError(f"planes are uint16 of shape (3, H, W), got {planes.dtype} {planes.shape}")
    shot = shot or ShotInfo()
    tags = _Directory(_common_tags(planes.shape[1], planes.shape[2], 3, _LINEAR_RAW, shot))
    _colour_tags(tags, 3, black=0, white=white, color_matrix=color_matrix, as_shot_neutral=as_shot_neutral)
    if xmp:
        tags.raw(700, _BYTE, xmp)
    _write(Path(path), tags, _exif(shot), planes.transpose(1, 2, 0))


class _Directory:
    """Entries of one image file directory, by tag."""

    def __init__(self, other: _Directory | None = None) -> None:
        self.entries: dict[int, tuple[int, bytes]] = dict(other.entries) if other else {}

    def raw(self, tag: int, kind: int, data: bytes) -> None:
        self.entries[tag] = (kind, data)

    def shorts(self, tag: int, *values: int) -> None:
        self.raw(tag, _SHORT, struct.pack(f"<{len(values)}H", *values))

    def longs(self, tag: int, *values: int) -> None:
        self.raw(tag, _LONG, struct.pack(f"<{len(values)}I", *values))

    def text(self, tag: int, value: str) -> None:
        """Texts are ASCII by the standard; what does not fit becomes a question mark."""
        if value:
            self.raw(tag, _ASCII, value.encode("ascii", "replace") + b"\x00")

    def rationals(self, tag: int, *values: float | None) -> None:
        parts = [_rational(value) for value in values if value is not None]
        if len(parts) == len(values):
            self.raw(tag, _RATIONAL, b"".join(struct.pack("<2I", *part) for part in parts))

    def signed_rationals(self, tag: int, values: Sequence[float]) -> None:
        parts = [Fraction(float(value)).limit_denominator(1_000_000) for value in values]
        self.raw(
            tag, _SRATIONAL, b"".join(struct.pack("<2i", part.numerator, part.denominator) for part in parts)
        )

    def size(self) -> int:
        return 2 + 12 * len(self.entries) + 4

    def packed(self, offset: int) -> bytes:
        """Directory that starts at `offset` of the file, its longer values right behind it."""
        position = offset + self.size()
        head, tail = [struct.pack("<H", len(self.entries))], b""
        for tag in sorted(self.entries):
            kind, data = self.entries[tag]
            count = len(data) // _SIZES[kind]
            if len(data) <= 4:
                field = data.ljust(4, b"\x00")
            else:
                tail += b"\x00" * (len(tail) % 2)  # values begin on a word boundary
                field = struct.pack("<I", position + len(tail))
                tail += data
            head.append(struct.pack("<HHI", tag, kind, count) + field)
        return b"".join(head) + struct.pack("<I", 0) + tail


def _rational(value: float) -> tuple[int, int]:
    if math.isinf(value):
        return _MAX_UINT32, 1  # Exif 2.32: a distance of infinity
    for largest in (1_000_000, 10_000, 100, 1):
        part = Fraction(value).limit_denominator(largest)
        if part.numerator <= _MAX_UINT32:
            return part.numerator, part.denominator
    raise InvalidInputError(f"{value} does not fit a TIFF rational")


def _common_tags(height: int, width: int, samples: int, photometric: int, shot: ShotInfo) -> _Directory:
    tags = _Directory()
    tags.longs(254, 0)  # NewSubfileType: the full image
    tags.longs(256, width)
    tags.longs(257, height)
    tags.shorts(258, *(16,) * samples)
    tags.shorts(259, 1)  # not compressed
    tags.shorts(262, photometric)
    tags.text(270, shot.description)
    tags.text(271, shot.camera_maker)
    tags.text(272, shot.camera_model)
    tags.longs(_STRIP_OFFSETS, 0)
    tags.shorts(274, shot.orientation)
    tags.shorts(277, samples)
    tags.longs(278, height)  # one strip
    tags.longs(279, height * width * samples * 2)
    tags.shorts(284, 1)  # interleaved
    tags.text(305, shot.software)
    if shot.taken_at is not None:
        tags.text(306, shot.taken_at.strftime("%Y:%m:%d %H:%M:%S"))
    tags.longs(_EXIF_IFD, 0)
    tags.raw(50706, _BYTE, bytes((1, 4, 0, 0)))  # DNGVersion
    tags.raw(50707, _BYTE, bytes((1, 1, 0, 0)))  # DNGBackwardVersion
    # Most models carry their maker already; programs look cameras up by this name.
    named = shot.camera_model.lower().startswith(shot.camera_maker.lower())
    unique = shot.camera_model if named else f"{shot.camera_maker} {shot.camera_model}"
    tags.text(50708, unique.strip() or "Unknown")  # UniqueCameraModel
    if shot.baseline_exposure is not None:
        tags.signed_rationals(50730, [shot.baseline_exposure])
    tags.text(50735, shot.body_serial)  # CameraSerialNumber
    return tags


def _colour_tags(
    tags: _Directory,
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


def _exif(shot: ShotInfo) -> _Directory:
    tags = _Directory()
    tags.raw(0x9000, _UNDEFINED, b"0232")  # ExifVersion
    tags.rationals(0x829A, shot.exposure_s)
    tags.rationals(0x829D, shot.aperture)
    if shot.iso is not None:
        tags.shorts(0x8827, min(shot.iso, 65535))
    if shot.taken_at is not None:
        tags.text(0x9003, shot.taken_at.strftime("%Y:%m:%d %H:%M:%S"))
    tags.rationals(0x9206, shot.focus_m)
    tags.rationals(0x920A, shot.focal_mm)
    if shot.pixel_pitch_um is not None:
        per_cm = 10_000.0 / shot.pixel_pitch_um
        tags.rationals(0xA20E, per_cm)  # FocalPlaneXResolution
        tags.rationals(0xA20F, per_cm)
        tags.shorts(0xA210, 3)  # per centimetre
    tags.text(0xA431, shot.body_serial)
    if shot.focal_range_mm is not None:
        tags.rationals(0xA432, *shot.focal_range_mm, *(shot.widest_aperture or (0.0, 0.0)))
    tags.text(0xA433, shot.lens_maker)
    tags.text(0xA434, shot.lens_model)
    tags.text(0xA435, shot.lens_serial)
    return tags


def _write(path: Path, tags: _Directory, exif: _Directory, pixels: NDArray[np.uint16]) -> None:
    start = 8
    exif_at = start + len(tags.packed(start))
    exif_at += exif_at % 2
    tags.longs(_EXIF_IFD, exif_at)
    pixels_at = exif_at + len(exif.packed(exif_at))
    pixels_at += -pixels_at % 16
    tags.longs(_STRIP_OFFSETS, pixels_at)
    head = (struct.pack("<2sHI", b"II", 42, start) + tags.packed(start)).ljust(exif_at, b"\x00")
    head = (head + exif.packed(exif_at)).ljust(pixels_at, b"\x00")
    with atomic(path) as file:
        file.write(head)
        file.write(np.ascontiguousarray(pixels).astype("<u2", copy=False).data)
