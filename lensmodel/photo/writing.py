"""Linear planes to files: complete or not at all, with profile and the safe part of EXIF; DNG.

Source: Adobe, "Digital Negative (DNG) Specification" 1.4, 2012, and 1.6, 2021 (chapter 7: opcodes).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeAlias, get_args

import imagecodecs
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.core.names import full_name
from lensmodel.core.types import BayerPattern, Planes
from lensmodel.photo import colour, containers
from lensmodel.photo.colour import D65_TO_D50, SRGB_TO_XYZ_D65, Curve, Matrix
from lensmodel.photo.containers import BYTE, LONG, SHORT, UNDEFINED, Written, write_strip
from lensmodel.photo.metadata import written_tags, xmp_packet
from lensmodel.photo.values import ColorSpace, Encoding, OutputFormat, PhotoMetadata, remarks_log

_ROWS: Final = 256  # rows that are encoded at a time: bounds the memory of the conversion

_PNG_OPTIONS: Final = {"level": 2, "strategy": 3, "filter": 128}
"""Paeth filter and run lengths: on photos as small as the default search, three times faster."""

# XMP specification, part 3; ICC.1:2022, annex B.4; DNG 1.6, chapter 6.
_XMP_TAG, _ICC_TAG, OPCODES_2, OPCODES_3 = 700, 34675, 51009, 51022

_FROM_SRGB: Final = D65_TO_D50 @ SRGB_TO_XYZ_D65  # to XYZ under D50

Pixels: TypeAlias = NDArray[Any]
"""Numbers of a file, `(row, col, channel)`, uint8, uint16 or float32."""


def write_image(
    path: Path | str,
    planes: Planes,
    encoding: Encoding,
    *,
    format: OutputFormat = "tiff16",  # noqa: A002  the word of the HTTP interface
    color_space: ColorSpace = "same",
    quality: int = 95,
    description: str = "",
    lens: str = "",
    gps: Written | None = None,
) -> None:
    """Write planes as a file that shows the picture as its input did, complete or not at all.

    It never carries maker notes or serials, and the place only where its owner wants it (`gps`). Light is
    clipped to 0..1 but in "tiff32". TIFF, JPEG and DNG keep the sensor orientation and say how to turn it;
    PNG, where programs ignore that, is written upright. The colour space "same" is profile and curve of the
    input, and for RAW sRGB with the camera's white balance; "camera-linear", as in DNG, the planes' own
    numbers.
    """
    if planes.ndim != 3 or planes.shape[0] != 3:
        raise InvalidInputError(f"planes must have the shape (3, height, width), got {planes.shape}")
    if format not in get_args(OutputFormat) or color_space not in get_args(ColorSpace):
        raise InvalidInputError(
            f"no output {format!r} in {color_space!r}; formats: {', '.join(get_args(OutputFormat))}; "
            f"colour spaces: {', '.join(get_args(ColorSpace))}"
        )
    if not 1 <= quality <= 100:
        raise InvalidInputError(f"JPEG quality must lie in 1..100, got {quality}")
    path, metadata = Path(path), encoding.metadata.without_serials()
    if format.startswith("png"):
        metadata = replace(metadata, orientation=1)
    tags = {**written_tags(metadata, description), containers.GPS: gps or {}}
    xmp = xmp_packet(metadata, description, lens)
    if (encoding.opcodes_2 or encoding.opcodes_3) and format != "dng":
        said = "%s: what the DNG leaves to raw converters to correct is not in it; only DNG output keeps that"
        remarks_log.warning(said, path.name)
    clipped = encoding.bit_depth == 32 and format != "tiff32"
    if clipped and (beyond := 100.0 * float((planes > 1.0).mean())):
        said = "%s: %.1f %% of its samples lie beyond white and are clipped; only tiff32 keeps them"
        remarks_log.warning(said, path.name, beyond)
    linear = format == "tiff32" and color_space == "same" and encoding.transfer == "linear"
    target = _target(encoding, "camera-linear" if linear or format == "dng" else color_space)
    pixels = _encoded(planes, target, {"tiff32": None, "jpeg": 255, "png8": 255}.get(format, 65535))
    with atomic(path) as file:
        if format == "jpeg":
            exif = b"Exif\0\0" + containers.laid_out(tags)
            options: dict[str, Any] = {"quality": quality, "subsampling": 0, "optimize": True}
            Image.fromarray(pixels).save(file, "JPEG", icc_profile=target.icc, exif=exif, xmp=xmp, **options)
        elif format.startswith("png"):
            chunks = {
                b"iCCP": b"ICC\0\0" + zlib.compress(target.icc),
                b"eXIf": containers.laid_out(tags),
                b"iTXt": b"XML:com.adobe.xmp\0\0\0\0\0" + xmp,
            }
            _write_png(file, upright(pixels, encoding.metadata.orientation), chunks)
        else:
            numbers = SHORT, [3 if format == "tiff32" else 1] * 3  # SampleFormat: floating-point, or whole
            of_rgb: Written = {262: (SHORT, 2), 339: numbers, _ICC_TAG: (UNDEFINED, target.icc)}
            tags |= _linear_dng_tags(encoding) if format == "dng" else of_rgb
            write_strip(file, {**tags, _XMP_TAG: (BYTE, xmp)}, pixels)


# --- colour ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Target:
    """How linear planes become the numbers of the file: gain, matrix, curve, and the profile that says so."""

    icc: bytes
    curves: tuple[Curve, Curve, Curve] | None = None  # None: the numbers are light
    gain: Sequence[float] = (1.0, 1.0, 1.0)
    matrix: Matrix | None = None


def _target(encoding: Encoding, color_space: ColorSpace) -> _Target:
    if color_space == "camera-linear":
        return _Target(colour.linear_profile(_to_xyz_d50(encoding)))
    icc, balance = encoding.icc, encoding.white_balance
    if encoding.to_srgb is None and icc is not None and icc[16:20] == b"RGB " and color_space == "same":
        return _Target(icc, colour.curves_of(encoding.transfer, icc))
    # White must stay white: where all channels clip, no multiplier may be below 1.
    gain = [float(weight) / min(balance) for weight in balance]
    return _Target(colour.named_profile("srgb"), colour.curves_of("srgb"), gain, _to_srgb(encoding))


def _to_srgb(encoding: Encoding) -> Matrix | None:
    if encoding.to_srgb is not None:
        return np.asarray(encoding.to_srgb)
    profile = colour.read_profile(encoding.icc)
    return None if profile is None or profile.to_xyz is None else np.linalg.inv(_FROM_SRGB) @ profile.to_xyz


def _to_xyz_d50(encoding: Encoding) -> Matrix:
    """Planes to XYZ under D50, white balance included."""
    to_srgb = _to_srgb(encoding)
    matrix: Matrix = _FROM_SRGB if to_srgb is None else _FROM_SRGB @ to_srgb
    return matrix * np.asarray(encoding.white_balance)


def _encoded(planes: Planes, target: _Target, top: int | None) -> Pixels:
    """File numbers `(row, col, channel)` of planes; whole ones up to `top`, else any, of any size."""
    _, height, width = planes.shape
    kind = {255: np.uint8, 65535: np.uint16, None: np.float32}[top]
    out: Pixels = np.empty((height, width, 3), dtype=kind)
    tables = None if target.curves is None else [colour.inverse(curve) for curve in target.curves]
    gain = np.asarray(target.gain, dtype=np.float32)[:, None, None]
    for row in range(0, height, _ROWS):
        part = planes[:, row : row + _ROWS] * gain
        if top is not None:
            np.clip(part, 0.0, 1.0, out=part)
        if target.matrix is not None:
            part = np.tensordot(target.matrix.astype(np.float32), part, axes=1)
        for k, light in enumerate(part):
            numbers = light if tables is None else colour.encode(light, tables[k])
            if top is None:  # as `decode` takes them
                numbers = np.where((light < 0.0) | (light > 1.0), light, numbers)
            else:
                numbers = np.rint(numbers * np.float32(top))
            out[row : row + _ROWS, :, k] = numbers
    return out


# --- files -------------------------------------------------------------------------------------


def _linear_dng_tags(encoding: Encoding) -> Written:
    to_camera = encoding.xyz_to_camera
    if to_camera is None:
        # To XYZ under D50, and back from D65, which is what the DNG tag means.
        to_camera = np.linalg.inv(np.linalg.inv(D65_TO_D50) @ _to_xyz_d50(encoding))
    neutral = [1.0 / balance for balance in encoding.white_balance]
    return {
        **dng_tags(encoding.metadata.without_serials(), to_camera, neutral, encoding.baseline_exposure),
        262: (SHORT, 34892),  # PhotometricInterpretation: linear RAW
        # LibRaw 0.22 takes a black level of linear images off the values but not off the white level
        50714: (SHORT, (0, 0, 0)),
        50717: (SHORT, (65535, 65535, 65535)),
        OPCODES_2: (UNDEFINED, encoding.opcodes_2),
        OPCODES_3: (UNDEFINED, encoding.opcodes_3),
    }


def _write_png(file: BinaryIO, pixels: Pixels, chunks: dict[bytes, bytes]) -> None:
    data = imagecodecs.png_encode(np.ascontiguousarray(pixels), **_PNG_OPTIONS)
    header_end = 33  # signature and IHDR; the profile must come before the pixels
    file.write(data[:header_end])
    for name, body in chunks.items():
        check = struct.pack(">I", zlib.crc32(name + body))
        file.write(struct.pack(">I", len(body)) + name + body + check)
    file.write(data[header_end:])


_TURNS: Final = {3: 2, 4: 2, 5: 1, 6: -1, 7: -1, 8: 1}
"""EXIF orientation -> quarter turns, counter-clockwise, after 2, 4, 5 and 7 are mirrored (EXIF 2.3)."""


def upright(pixels: Pixels, orientation: int) -> Pixels:
    """Turn an array `(row, col, ...)` from sensor orientation to upright, by its EXIF orientation."""
    return np.rot90(pixels[:, ::-1] if orientation in {2, 4, 5, 7} else pixels, _TURNS.get(orientation, 0))


def shown(planes: Planes, encoding: Encoding) -> NDArray[np.uint8]:
    """Encode planes for a screen: 8-bit sRGB `(row, col, 3)`, white-balanced, in sensor orientation."""
    return np.asarray(_encoded(planes, _target(encoding, "srgb"), 255), dtype=np.uint8)


BAYER_PATTERNS: Final = ("RGGB", "BGGR", "GRBG", "GBRG")

XYZ_TO_SRGB: Final = np.linalg.inv(SRGB_TO_XYZ_D65)


def write_bayer_dng(
    path: str | Path,
    mosaic: NDArray[np.uint16],
    *,
    black: int,
    white: int,
    pattern: str = "RGGB",
    color_matrix: ArrayLike = XYZ_TO_SRGB,
    as_shot_neutral: Sequence[float] = (1.0, 1.0, 1.0),
    metadata: PhotoMetadata | None = None,
    baseline_exposure: float | None = None,
) -> None:
    """Write a raw mosaic as an uncompressed DNG; the file appears whole or not at all."""
    metadata = metadata or PhotoMetadata()
    tags = {
        **written_tags(metadata),
        **dng_tags(metadata, color_matrix, as_shot_neutral, baseline_exposure),
        262: (SHORT, 32803),  # PhotometricInterpretation: a colour filter array (TIFF/EP)
        33421: (SHORT, (2, 2)),  # CFARepeatPatternDim
        33422: (BYTE, bytes("RGB".index(letter) for letter in pattern)),  # CFAPattern
        50714: (SHORT, black),
        50717: (SHORT, white),
    }
    with atomic(Path(path)) as file:
        write_strip(file, tags, mosaic)


def dng_tags(
    metadata: PhotoMetadata,
    color_matrix: ArrayLike,
    as_shot_neutral: Sequence[float],
    baseline_exposure: float | None,
) -> Written:
    """Tags that make a TIFF a DNG: its version, camera and colours."""
    # programs look cameras up by this name
    unique = full_name(metadata.camera_maker, metadata.camera_model) or "Unknown"
    return {
        254: (LONG, 0),  # NewSubfileType: the full image
        50706: (BYTE, bytes((1, 4, 0, 0))),  # DNGVersion
        50707: (BYTE, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        50708: (containers.ASCII, unique),  # UniqueCameraModel
        50721: (containers.SRATIONAL, np.ravel(color_matrix).tolist()),  # ColorMatrix1
        50728: (containers.RATIONAL, np.ravel(as_shot_neutral).tolist()),
        50730: (containers.SRATIONAL, baseline_exposure),
        50735: (containers.ASCII, metadata.body_serial),  # CameraSerialNumber
        50778: (SHORT, 21),  # CalibrationIlluminant1: D65, in the numbers of Exif's LightSource
    }


_GAIN_MAP: Final = 9  # number of an opcode
_GAIN_HEAD: Final = struct.Struct(">10I4dI")
_MOST: Final = 64  # opcodes of a list (chosen): cameras write below ten


def opcodes_of_planes(block: bytes, cfa: BayerPattern | None) -> tuple[bytes, int]:
    """Rewrite an OpcodeList2, which is for a mosaic, for planes, and say how many opcodes are lost.

    A gain map of every second pixel is that of a colour; each of the two of green gives its square root.
    Others mean nothing without the mosaic; a list that is damaged gives what came before the damage.
    """
    kept, lost, at = list[bytes](), 0, 4
    for _ in range(min(int.from_bytes(block[:4], "big"), _MOST)):
        number, version, flags, size = struct.unpack(">4I", block[at : at + 16].ljust(16, b"\xff"))
        data, at = block[at + 16 : at + 16 + size], at + 16 + size
        if at > len(block):
            break
        known = number == _GAIN_MAP and size >= _GAIN_HEAD.size
        head = _GAIN_HEAD.unpack_from(data) if known else (0,) * 15
        (top, left, bottom, right), pitch, gains = head[:4], head[6:8], data[_GAIN_HEAD.size :]
        if pitch == (2, 2) and cfa is not None:
            channel = cfa[top % 2][left % 2]
            if channel == 1:
                whole = np.frombuffer(gains[: len(gains) // 4 * 4], ">f4")
                gains = np.sqrt(np.maximum(whole, 0.0)).astype(">f4").tobytes()
            # the two rows and columns between whose pixels the others stood
            area = (top - top % 2, left - left % 2, bottom + bottom % 2, right + right % 2, channel, 1)
        elif pitch == (1, 1):
            area = (top, left, bottom, right, 0, 3)
        else:
            lost += 1
            continue
        body = _GAIN_HEAD.pack(*area, 1, 1, *head[8:]) + gains
        kept.append(struct.pack(">4I", number, version, flags, len(body)) + body)
    return struct.pack(">I", len(kept)) + b"".join(kept) if kept else b"", lost
