"""Linear planes to files: complete or not at all, with profile and the safe part of EXIF."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeAlias, get_args

import imagecodecs
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.core.types import Planes
from lensmodel.photo import opcodes
from lensmodel.photo.colour import (
    D65_TO_D50,
    SRGB_TO_XYZ_D65,
    Curve,
    Matrix,
    curves_of,
    encode,
    icc_space,
    inverse,
    linear_profile,
    matrix3,
    matrix_profile,
    named_profile,
)
from lensmodel.photo.dng import NONE, write_linear_dng
from lensmodel.photo.metadata import exif_tags, main_tags
from lensmodel.photo.tiff import BYTE, EXIF, GPS, UNDEFINED, Written, laid_out, shorts, write_strip
from lensmodel.photo.values import ColorSpace, Encoding, OutputFormat, PhotoMetadata, remarks_log
from lensmodel.photo.xmp import xmp_packet

_ROWS: Final = 256
"""Rows that are encoded at a time: bounds the memory of the conversion."""

_PNG_OPTIONS: Final = {"level": 2, "strategy": 3, "filter": 128}
"""Paeth filter and run lengths: on photos as small as the default search, three times faster."""

XMP_TAG: Final = 700  # XMP specification, part 3
ICC_TAG: Final = 34675  # ICC.1:2022, annex B.4

Pixels: TypeAlias = NDArray[Any]
"""Numbers of a file, `(row, col, channel)`, uint8 or uint16."""


@dataclass(frozen=True, slots=True)
class _Target:
    """How linear planes become the numbers of the file: gain, matrix, curve, and the profile that says so."""

    gain: tuple[float, float, float]
    matrix: Matrix | None
    curves: tuple[Curve, Curve, Curve]
    icc: bytes


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
    gps: Written = NONE,
) -> None:
    """Write planes as a file that shows the picture as its input did, complete or not at all.

    It carries an ICC profile, and of the metadata camera, lens, exposure, time, maker, rights, rating
    and keywords; never maker notes or serials, and the place only where its owner wants it (`gps`).
    Light is clipped to 0..1 but in "tiff32", which holds floating-point numbers. TIFF, JPEG and DNG
    keep the sensor orientation and say how to turn it; PNG, where programs ignore that, is written
    upright.

    The colour space "same" is profile and curve of the input, and for RAW sRGB with the camera's white
    balance; "srgb" is converted to sRGB; "camera-linear" is the planes' own numbers and primaries, with
    a profile that describes them, which DNG is by its nature. `lens` is what its owner calls it.
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
    path = Path(path)
    carried = _Carried(encoding.metadata.without_serials(), description, lens, gps)
    if format == "dng":
        _write_dng(path, planes, encoding, carried)
        return
    steps = [step.name for block in (encoding.opcodes_2, encoding.opcodes_3) for step in opcodes.read(block)]
    if steps:
        remarks_log.warning(
            "%s: the corrections that the DNG leaves to raw converters (%s) are not in it; only DNG output "
            "keeps them",
            path.name,
            ", ".join(steps),
        )
    if encoding.bit_depth == 32 and format != "tiff32" and (beyond := float((planes > 1.0).mean())) > 0.0:
        remarks_log.warning(
            "%s: %.1f %% of its samples lie beyond white and are clipped; only tiff32 keeps them",
            path.name,
            100.0 * beyond,
        )
    if format == "tiff32" and color_space == "same" and encoding.transfer == "linear":
        color_space = "camera-linear"
    target = _target(encoding, color_space)
    top = {"tiff32": None, "jpeg": 255, "png8": 255}.get(format, 65535)
    with atomic(path) as file:
        pixels = _encoded(planes, target, top)
        if format == "jpeg":
            Image.fromarray(pixels).save(
                file,
                "JPEG",
                quality=quality,
                subsampling=0,
                optimize=True,
                icc_profile=target.icc,
                exif=b"Exif\0\0" + carried.exif(encoding.orientation),
                xmp=carried.xmp,
            )
        elif format.startswith("tiff"):
            _write_tiff(file, pixels, carried, target.icc)
        else:
            _write_png(file, np.ascontiguousarray(upright(pixels, encoding.orientation)), carried, target.icc)


# --- colour ------------------------------------------------------------------------------------


def _target(encoding: Encoding, color_space: ColorSpace) -> _Target:
    rgb_icc = _rgb_profile(encoding)
    if color_space == "camera-linear":
        profile = linear_profile(_to_xyz_d50(encoding), "lensmodel linear")
        return _Target((1.0, 1.0, 1.0), None, curves_of("linear"), profile)
    if encoding.to_srgb is None and rgb_icc is not None and color_space == "same":
        return _Target((1.0, 1.0, 1.0), None, curves_of(encoding.transfer, rgb_icc), rgb_icc)
    # White must stay white: where all channels clip, no multiplier may be below 1.
    r, g, b = (float(w) / min(encoding.white_balance) for w in encoding.white_balance)
    return _Target((r, g, b), _to_srgb(encoding), curves_of("srgb"), named_profile("srgb"))


def _rgb_profile(encoding: Encoding) -> bytes | None:
    return encoding.icc if encoding.icc is not None and icc_space(encoding.icc) == "RGB" else None


def _to_srgb(encoding: Encoding) -> Matrix | None:
    if encoding.to_srgb is not None:
        return np.asarray(encoding.to_srgb)
    rgb_icc = _rgb_profile(encoding)
    profile = None if rgb_icc is None else matrix_profile(rgb_icc)
    return None if profile is None else np.linalg.inv(D65_TO_D50 @ SRGB_TO_XYZ_D65) @ profile.to_xyz


def _to_xyz_d50(encoding: Encoding) -> Matrix:
    """Planes to XYZ under D50, white balance included."""
    to_srgb = _to_srgb(encoding)
    balanced = D65_TO_D50 @ SRGB_TO_XYZ_D65 @ (np.eye(3) if to_srgb is None else to_srgb)
    matrix: Matrix = balanced * np.asarray(encoding.white_balance)
    return matrix


def _encoded(planes: Planes, target: _Target, top: int | None) -> Pixels:
    """File numbers `(row, col, channel)` of planes; whole ones up to `top`, else any, of any size."""
    _, height, width = planes.shape
    kind = {255: np.uint8, 65535: np.uint16, None: np.float32}[top]
    out: Pixels = np.empty((height, width, 3), dtype=kind)
    tables = [inverse(curve) for curve in target.curves]
    gain = np.asarray(target.gain, dtype=np.float32)[:, None, None]
    for row in range(0, height, _ROWS):
        part = planes[:, row : row + _ROWS] * gain
        if top is not None:
            np.clip(part, 0.0, 1.0, out=part)
        if target.matrix is not None:
            part = np.tensordot(target.matrix.astype(np.float32), part, axes=1)
        for k, table in enumerate(tables):
            numbers = encode(part[k], table)
            if top is None:  # as `decode` takes them
                numbers = np.where((part[k] < 0.0) | (part[k] > 1.0), part[k], numbers)
            else:
                numbers = np.rint(numbers * np.float32(top))
            out[row : row + _ROWS, :, k] = numbers
    return out


# --- files -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Carried:
    """What a file carries beside its pixels."""

    metadata: PhotoMetadata
    description: str
    lens: str
    gps: Written

    @property
    def xmp(self) -> bytes:
        return xmp_packet(self.metadata, self.description, self.lens)

    def exif(self, orientation: int) -> bytes:
        below = {EXIF: exif_tags(self.metadata), GPS: self.gps}
        return laid_out(main_tags(self.metadata, orientation, self.description), below)


def _write_tiff(file: BinaryIO, pixels: Pixels, carried: _Carried, icc: bytes) -> None:
    metadata = carried.metadata
    tags = {
        **main_tags(metadata, metadata.orientation, carried.description),
        262: shorts(2),  # RGB
        339: shorts(*(3 if pixels.dtype.kind == "f" else 1,) * 3),  # SampleFormat
        XMP_TAG: (BYTE, carried.xmp),
        ICC_TAG: (UNDEFINED, icc),
    }
    write_strip(file, tags, {EXIF: exif_tags(metadata), GPS: carried.gps}, pixels)


def _write_png(file: BinaryIO, pixels: Pixels, carried: _Carried, icc: bytes) -> None:
    data = imagecodecs.png_encode(pixels, **_PNG_OPTIONS)
    header_end = 33  # signature and IHDR; the profile must come before the pixels
    file.write(data[:header_end])
    file.write(_chunk(b"iCCP", b"ICC\0\0" + zlib.compress(icc)))
    file.write(_chunk(b"eXIf", carried.exif(1)))
    file.write(_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + carried.xmp))
    if carried.description:
        file.write(_chunk(b"tEXt", b"Description\0" + carried.description.encode("latin-1", "replace")))
    file.write(data[header_end:])


def _write_dng(path: Path, planes: Planes, encoding: Encoding, carried: _Carried) -> None:
    to_camera = encoding.xyz_to_camera
    if to_camera is None:
        # To XYZ under D50, and back from D65, which is what the DNG tag means.
        to_xyz = np.linalg.inv(D65_TO_D50) @ _to_xyz_d50(encoding)
        to_camera = matrix3(np.linalg.inv(to_xyz).astype(np.float64))
    r, g, b = encoding.white_balance
    numbers = np.empty(planes.shape, dtype=np.uint16)
    for row in range(0, planes.shape[1], _ROWS):
        part = np.clip(planes[:, row : row + _ROWS], 0.0, 1.0)
        numbers[:, row : row + _ROWS] = np.rint(part * np.float32(65535))
    write_linear_dng(
        path,
        numbers,
        color_matrix=to_camera,
        as_shot_neutral=(1 / r, 1 / g, 1 / b),
        metadata=carried.metadata,
        description=carried.description,
        baseline_exposure=encoding.baseline_exposure,
        more={
            XMP_TAG: (BYTE, carried.xmp),
            51009: (UNDEFINED, encoding.opcodes_2) if encoding.opcodes_2 else None,  # OpcodeList2
            51022: (UNDEFINED, encoding.opcodes_3) if encoding.opcodes_3 else None,
        },
        gps=carried.gps,
    )


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


_UPRIGHT: Final[Mapping[int, Callable[[Pixels], Pixels]]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: np.rot90,
}
"""EXIF orientation -> how to turn the stored pixels upright (EXIF 2.3, tag Orientation)."""


def upright(pixels: Pixels, orientation: int) -> Pixels:
    """Turn an array `(row, col, ...)` from sensor orientation to upright, by its EXIF orientation."""
    return _UPRIGHT.get(orientation, _UPRIGHT[1])(pixels)


def shown(planes: Planes, encoding: Encoding) -> NDArray[np.uint8]:
    """Encode planes for a screen: 8-bit sRGB `(row, col, 3)`, white-balanced, in sensor orientation."""
    return np.asarray(_encoded(planes, _target(encoding, "srgb"), 255), dtype=np.uint8)
