"""What is known of a photo without decoding it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import rawpy

from lensmodel.core.errors import NotAnImageError, UnsupportedFormatError
from lensmodel.photo.headers.header import Header, check_size
from lensmodel.photo.headers.opening import opened_header
from lensmodel.photo.raw import exposure_of, opened_raw
from lensmodel.photo.tags.metadata import is_centred, metadata_of
from lensmodel.photo.turned import ORIENTATION, turns_to_sensor
from lensmodel.photo.values import Limits, PhotoInfo

MIN_SIDE = 16
"""Smaller pictures are icons, not photos."""


_UNDECODED: Final = {9: "VC-5 (GoPro GPR)", 52546: "JPEG XL"}
"""Compressions of DNG that LibRaw, as built for Python, opens but cannot decode."""


def inspect(path: Path | str, limits: Limits | None = None) -> PhotoInfo:
    """Read kind, size and metadata from the header, and refuse what cannot be developed.

    Parameters
    ----------
    path : Path or str
        The file; its name does not matter, its content decides.
    limits : Limits, optional
        How large it may be.

    Raises
    ------
    NotAnImageError, UnsupportedFormatError
        If it is no photo, or none that we read.
    TruncatedImageError, RawDecodeError
        If the header already shows that it ends early or is damaged.
    ImageTooLargeError, DecompressionBombError
        If it is larger than the limits allow, or claims to be out of all proportion.
    """
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
    if min(width, height) < MIN_SIDE:
        raise NotAnImageError(
            f"{width} x {height} pixels are no photo; the smallest side allowed is {MIN_SIDE}"
        )
    turns = turns_to_sensor(path, header, metadata) if raw is None else 0
    if turns:
        width, height, metadata = height, width, replace(metadata, orientation=ORIENTATION[turns])
    return PhotoInfo(header.kind, width, height, metadata, is_centred(header, metadata), turns)
