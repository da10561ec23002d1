"""From a photo file to what is known of it without decoding it, and to linear light."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
import rawpy

from lensmodel.core.errors import (
    LensModelError,
    MetadataMissingError,
    NotAnImageError,
    TruncatedImageError,
    UnreadablePhotoError,
    UnsupportedFormatError,
)
from lensmodel.core.geometry import Frame
from lensmodel.core.names import name_key, serial_key
from lensmodel.core.types import Planes
from lensmodel.photo import opcodes
from lensmodel.photo.colour import CODES, curves_of, decode, icc_space, matrix_profile
from lensmodel.photo.defects import Suspects
from lensmodel.photo.headers.header import Header, check_size
from lensmodel.photo.headers.opening import opened_header
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.noise import coding_noise, estimate_noise, graininess
from lensmodel.photo.raster import Pixels, read_pixels
from lensmodel.photo.raw import develop_raw, exposure_of, opened_raw
from lensmodel.photo.tags.metadata import baseline_exposure_of, declared_by_tags, is_centred, metadata_of
from lensmodel.photo.turned import ORIENTATION, turns_to_sensor
from lensmodel.photo.values import (
    Encoding,
    Limits,
    LinearPhoto,
    PhotoInfo,
    PhotoMetadata,
    PlaneNoise,
    Transfer,
    remarks_log,
)

MIN_SIDE = 16
"""Smaller pictures are icons, not photos."""


_UNDECODED: Final = {9: "VC-5 (GoPro GPR)", 52546: "JPEG XL"}
"""Compressions of DNG that LibRaw, as built for Python, opens but cannot decode."""


def inspect(path: Path | str, limits: Limits | None = None) -> PhotoInfo:
    """Read kind, size and metadata from the header, and refuse what cannot be developed."""
    path, limits = Path(path), limits or Limits()
    with opened_header(path, limits) as header:
        if header.kind not in {"raw", "dng"}:
            return info_of(path, header, limits)
        with opened_raw(path) as raw:
            return info_of(path, header, limits, raw)


def info_of(path: Path, header: Header, limits: Limits, raw: rawpy.RawPy | None = None) -> PhotoInfo:
    """Put together what a parsed header says, and LibRaw where it has a RAW file open; see `inspect`."""
    width, height, metadata = header.width, header.height, metadata_of(header)
    if raw is not None:
        if (packing := _UNDECODED.get(header.compression)) is not None:
            raise UnsupportedFormatError(
                f"RAW data packed as {packing} are not read; convert it to a plain DNG or TIFF"
            )
        width, height = raw.sizes.width, raw.sizes.height
        if header.camera is not None:
            metadata = exposure_of(raw, metadata)
        check_size(width, height, path.stat().st_size, limits)
    if header.kind == "jpeg" and header.channels == 4:
        raise UnsupportedFormatError("the JPEG is CMYK, made for print; convert it to RGB")
    if not header.whole:
        raise TruncatedImageError(
            f"the {header.kind.upper()} ends before its picture does; the upload was cut off"
        )
    if min(width, height) < MIN_SIDE:
        raise NotAnImageError(
            f"{width} x {height} pixels are no photo; the smallest side allowed is {MIN_SIDE}"
        )
    turns = turns_to_sensor(path, header, metadata) if raw is None else 0
    if turns:
        width, height, metadata = height, width, replace(metadata, orientation=ORIENTATION[turns])
    return PhotoInfo(header.kind, width, height, metadata, is_centred(header, metadata), turns)


_MOST: Final = 7
"""Photos that are asked (chosen): with eight a pixel that stands out in one of three pictures is found."""

_KEPT: Final = 256  # answers (chosen): each is some thousand numbers
_RAW: Final = {"raw", "dng"}


def suspects_of_siblings(
    path: Path, metadata: PhotoMetadata, siblings: Iterable[Path], limits: Limits
) -> list[Suspects]:
    """Ask other RAW photos of the same body; what cannot be read, or is of another body, is passed over."""
    told: list[Suspects] = []
    for sibling in siblings:
        if len(told) == _MOST:
            break
        try:
            status = sibling.stat()
            if os.path.samestat(status, path.stat()):
                continue
            one = _suspects(sibling, status.st_mtime_ns, status.st_size, limits)
        except (LensModelError, OSError):
            continue
        if one is not None and one[0] == _body(metadata):
            told.append(one[1])
    return told


@lru_cache(maxsize=_KEPT)
def _suspects(
    path: Path, changed_ns: int, size: int, limits: Limits
) -> tuple[tuple[str, ...], Suspects] | None:
    """The body of a photo and what its mosaic shows; None without a mosaic or a known body."""
    del changed_ns, size  # a file that changed is another one
    with opened_header(path, limits) as header:
        body = _body(metadata_of(header))
        if header.kind not in _RAW or not body[0]:
            return None
        with opened_raw(path) as raw:
            mosaic = Mosaic.of(raw)
            return None if mosaic is None else (body, mosaic.suspects())


def _body(metadata: PhotoMetadata) -> tuple[str, ...]:
    return name_key(metadata.camera_model), serial_key(metadata.body_serial)


def develop(
    path: Path | str,
    *,
    limits: Limits | None = None,
    on_info: Callable[[PhotoInfo], None] | None = None,
    siblings: Iterable[Path] = (),
) -> LinearPhoto:
    """Develop a photo: RAW through LibRaw, TIFF, PNG and JPEG through their transfer curve.

    The planes are in sensor orientation, whatever the file says about turning them; RAW is in
    camera colors before white balance, others in the primaries of their profile. Curves are those of
    sRGB [1]_ or of the file's own profile [2]_; noise is measured on flat places, of RAW on its mosaic too.

    Parameters
    ----------
    path : Path or str
        The file.
    limits : Limits, optional
        How large it may be; checked before decoding.
    on_info : callable, optional
        Called with what `inspect` returns before anything is decoded; raising there refuses the photo.
    siblings : iterable of Path
        Other photos, which tell of the defective pixels of the sensor: RAW files of the same body are read,
        others passed over.

    Returns
    -------
    LinearPhoto
        `.planes` is float32 of shape (3, height, width): linear light, black 0 and saturation 1, in sensor
        orientation; with the noise of each plane, metadata and encoding.

    Raises
    ------
    FileNotFoundError
        If there is no such file; another `OSError` if it may not be read.
    UnreadablePhotoError
        One of its kinds, if the file cannot be decoded or holds no picture.
    ImageTooLargeError
        If it is larger than the limits allow.

    References
    ----------
    .. [1] IEC 61966-2-1:1999.
    .. [2] ICC.1:2022, sections 10.6 and 10.18.
    """
    path, limits = Path(path), limits or Limits()
    with opened_header(path, limits) as header:
        if header.kind in {"raw", "dng"}:
            with opened_raw(path) as raw:
                info = _accepted(info_of(path, header, limits, raw), on_info, lambda: Mosaic.of(raw))
                others = suspects_of_siblings(path, info.metadata, siblings, limits)
                developed = _develop_raw(raw, header, info, others)
        else:
            info = _accepted(info_of(path, header, limits), on_info, lambda: read_pixels(path, header))
            developed = _develop_raster(path, header, info)
    for remark in developed.remarks:
        remarks_log.warning("%s: %s", path.name, remark)
    return developed


def _accepted(
    info: PhotoInfo, on_info: Callable[[PhotoInfo], None] | None, decode: Callable[[], object]
) -> PhotoInfo:
    """Ask the caller; nobody shall look up what a photo does not say that is damaged."""
    try:
        if on_info is not None:
            on_info(info)
    except MetadataMissingError:
        decode()
        raise
    return info


def _develop_raw(
    file: rawpy.RawPy, header: Header, info: PhotoInfo, others: Sequence[Suspects]
) -> LinearPhoto:
    raw = develop_raw(file, header.white, others)
    _, height, width = raw.planes.shape
    # LibRaw has done the steps of a lossy DNG, without which its numbers mean nothing
    steps = [] if header.coarseness else opcodes.read(header.opcodes_2)
    kept, lost = (steps, []) if raw.pipeline.startswith("raw/none") else opcodes.demosaiced(steps, raw.cfa)
    encoding = Encoding(
        bit_depth=raw.bits,
        metadata=info.metadata.without_serials(),
        white_balance=raw.white_balance,
        to_srgb=raw.to_srgb,
        xyz_to_camera=raw.xyz_to_camera,
        baseline_exposure=baseline_exposure_of(header),
        opcodes_2=opcodes.written(kept),
        opcodes_3=opcodes.written(opcodes.read(header.opcodes_3)),
    )
    return LinearPhoto(
        planes=raw.planes,
        frame=Frame(height, width),
        noise=raw.noise,
        clip=raw.clip,
        info=replace(info, width=width, height=height),
        encoding=encoding,
        pipeline=raw.pipeline,
        white_balance=raw.white_balance,
        sensor_noise=raw.sensor_noise,
        coding_noise=coding_noise(header.coarseness, curves_of("srgb")[1][::257])
        if header.coarseness
        else None,
        cfa=raw.cfa,
        grain=(1.0, 1.0, 1.0) if raw.sensor_noise is not None else _grain(raw.planes, raw.noise, raw.clip),
        remarks=(
            *(f"its {step.name} is for the mosaic only and is dropped" for step in lost),
            *(_of_defects(raw.defects)),
        ),
    )


def _of_defects(count: int) -> tuple[str, ...]:
    if count < 2:
        return ("1 defective pixel of its sensor is replaced",) * count
    return (f"{count} defective pixels of its sensor are replaced",)


def _develop_raster(path: Path, header: Header, info: PhotoInfo) -> LinearPhoto:
    pixels, transparent = read_pixels(path, header)
    pixels = np.ascontiguousarray(np.rot90(pixels, info.turns or 0))
    height, width = pixels.shape[:2]
    if (height, width) != (info.height, info.width):
        raise UnreadablePhotoError(
            f"the header says {info.width} x {info.height}, the decoder gave {width} x {height}; save it anew"
        )
    transfer, icc = _transfer_of(header, pixels)
    planes = _linear(pixels, transfer, icc)
    curve = curves_of(transfer, icc)[1]
    code = {1: CODES // 255, 2: 1}.get(pixels.dtype.itemsize, 1)
    codes = curve[::code] if pixels.dtype.itemsize == 1 else None
    clip = max(1.0, float(planes.max())) if pixels.dtype.kind == "f" else 1.0
    step = float(curve[code] - curve[0])
    noise = [estimate_noise(plane, clip, step, codes) for plane in planes]
    return LinearPhoto(
        planes=planes,
        frame=Frame(height, width),
        noise=(noise[0], noise[1], noise[2]),
        clip=(clip,) * 3,
        info=info,
        encoding=Encoding(
            bit_depth=8 * pixels.dtype.itemsize,
            transfer=transfer,
            icc=icc,
            metadata=info.metadata.without_serials(),
        ),
        pipeline=f"{info.kind}/{transfer}/1",
        grain=_grain(planes, (noise[0], noise[1], noise[2]), (clip,) * 3),
        coding_noise=coding_noise(header.coarseness, curve[::257]) if header.coarseness else None,
        chroma_step=header.chroma_step[::-1] if info.turns else header.chroma_step,
        remarks=(
            *(("its transparency is dropped",) if transparent else ()),
            *((_TURNED,) if info.turns is None else ()),
        ),
    )


_TURNED: Final = (
    "a program has turned its pixels upright, and nothing tells which way: the PSFs of both are averaged, "
    "and the more these differ, the less is corrected"
)


def _grain(planes: Planes, noise: PlaneNoise, clip: tuple[float, float, float]) -> tuple[float, float, float]:
    r, g, b = (graininess(*of_plane) for of_plane in zip(planes, noise, clip, strict=True))
    return r, g, b


def _transfer_of(header: Header, pixels: Pixels) -> tuple[Transfer, bytes | None]:
    """Which curve the file's numbers follow, and the profile that goes back into the output."""
    icc = header.icc
    if icc is not None and matrix_profile(icc) is not None:
        return "icc", icc
    if pixels.dtype.kind == "f":
        return "linear", None
    if icc is None and (declared := declared_by_tags(header)) is not None:
        return "icc", declared
    return "srgb", icc if icc is not None and icc_space(icc) == "RGB" else None


def _linear(pixels: Pixels, transfer: Transfer, icc: bytes | None) -> Planes:
    planes = np.empty((3, *pixels.shape[:2]), dtype=np.float32)
    for k, curve in enumerate(curves_of(transfer, icc)):
        planes[k] = (
            pixels[:, :, k]
            if pixels.dtype.kind == "f" and transfer == "linear"
            else decode(pixels[:, :, k], curve)
        )
    return planes
