"""From a photo file, or an array, to linear light; and what is known of a file without decoding it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import rawpy
from numpy.typing import ArrayLike

from lensmodel.core.errors import (
    InvalidInputError,
    MetadataMissingError,
    NotAnImageError,
    TruncatedImageError,
    UnsupportedFormatError,
)
from lensmodel.core.geometry import Frame
from lensmodel.core.types import CHANNELS, LensSettings, NoiseModel
from lensmodel.photo.containers import check_size, opened_header
from lensmodel.photo.metadata import Said
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.noise import estimate_noise
from lensmodel.photo.raster import develop_raster, read_pixels
from lensmodel.photo.raw import develop_raw, exposure_of, opened_raw
from lensmodel.photo.values import Encoding, Limits, LinearPhoto, PhotoInfo, PhotoMetadata, remarks_log

MIN_SIDE = 16  # smaller pictures are icons, not photos

# Compressions of DNG that LibRaw, as built for Python, opens but cannot decode.
_UNDECODED: Final = {9: "VC-5 (GoPro GPR)", 52546: "JPEG XL"}


def inspect(path: Path | str, limits: Limits | None = None) -> PhotoInfo:
    """Read kind, size and metadata from the header, and refuse what cannot be developed."""
    path, limits = Path(path), limits or Limits()
    with _opened(path, limits) as (said, raw):
        return _info_of(path, said, raw, limits)


@contextlib.contextmanager
def _opened(path: Path, limits: Limits) -> Iterator[tuple[Said, rawpy.RawPy | None]]:
    """Open a file once: what its header says, and LibRaw where it is a RAW file."""
    with contextlib.ExitStack() as stack:
        said = Said.of(stack.enter_context(opened_header(path, limits)))
        is_raw = said.header.kind in {"raw", "dng"}
        yield said, stack.enter_context(opened_raw(path)) if is_raw else None


def _info_of(path: Path, said: Said, raw: rawpy.RawPy | None, limits: Limits) -> PhotoInfo:
    header, metadata = said.header, said.metadata()
    width, height = header.width, header.height
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
            f"the {header.kind.upper()} ends before its picture does; copy it again from the camera or card"
        )
    if min(width, height) < MIN_SIDE:
        raise NotAnImageError(
            f"{width} x {height} pixels are no photo; the smallest side allowed is {MIN_SIDE}"
        )
    # no camera stores a picture higher than wide and says that it lies
    upright = raw is None and height > width and metadata.orientation == 1
    turned = upright and metadata.camera_model is not None
    return PhotoInfo(header.kind, width, height, metadata, said.is_centred(metadata), turned)


def develop(
    path: Path | str,
    *,
    limits: Limits | None = None,
    on_info: Callable[[PhotoInfo], None] | None = None,
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
    with _opened(path, limits) as (said, raw):
        info = _info_of(path, said, raw, limits)
        try:
            if on_info is not None:
                on_info(info)
        except MetadataMissingError:  # of a photo that is damaged nobody shall look up what it does not say
            read_pixels(path, said.header) if raw is None else Mosaic.of(raw)
            raise
        developed = develop_raster(path, said, info) if raw is None else develop_raw(raw, said, info)
    for remark in developed.remarks:
        remarks_log.warning("%s: %s", path.name, remark)
    return developed


def photo_from_array(
    planes: ArrayLike,
    *,
    noise: NoiseModel | Sequence[NoiseModel] | None = None,
    clip: float = 1.0,
    aperture: float | None = None,
    focal_mm: float | None = None,
    focus_m: float | None = None,
    pixel_pitch_um: float | None = None,
) -> LinearPhoto:
    """Make a developed photo of an array.

    Parameters
    ----------
    planes : array_like of float, shape (3, height, width)
        Red, green and blue in linear light: black 0, saturation at `clip`; kept as float32.
    noise : NoiseModel or sequence of three, optional
        Variance of the pixels against their level; None measures it on the flat places of each plane
        (`estimate_noise`).
    clip : float
        Level at which the sensor saturates.
    aperture : float, optional
        f-number, 0.5 to 128; `focal_mm` in mm and `focus_m` in metres as far as they are known.
    pixel_pitch_um : float, optional
        Pitch of the pixels in micrometres, above 0.

    Returns
    -------
    LinearPhoto

    Raises
    ------
    InvalidInputError
        If the shape is another, a pixel is not finite, or another value is out of its range.
    """
    array = np.ascontiguousarray(planes, dtype=np.float32)
    if array.ndim != 3 or array.shape[0] != len(CHANNELS) or array.size == 0:
        raise InvalidInputError(f"a photo must have the shape (3, height, width), got {array.shape}")
    if not np.isfinite(array).all():
        raise InvalidInputError("a photo must be finite; mask or replace NaN and infinity first")
    if not clip > 0.0:
        raise InvalidInputError(f"clip must be a positive level, got {clip}")
    LensSettings(aperture, focal_mm, focus_m)  # refuses what no lens has
    if pixel_pitch_um is not None and not (math.isfinite(pixel_pitch_um) and pixel_pitch_um > 0.0):
        raise InvalidInputError(
            f"the pixel pitch must be positive micrometres, got {pixel_pitch_um}; leave it out if unknown"
        )
    if isinstance(noise, NoiseModel):
        noise = (noise,) * 3
    known = tuple(noise) if noise is not None else tuple(estimate_noise(plane, clip) for plane in array)
    if len(known) != len(CHANNELS):
        raise InvalidInputError(f"noise needs one model, or one for each of three planes, got {len(known)}")
    _, height, width = array.shape
    metadata = PhotoMetadata(
        aperture=aperture, focal_mm=focal_mm, focus_m=focus_m, pixel_pitch_um=pixel_pitch_um
    )
    return LinearPhoto(
        planes=array,
        frame=Frame(height, width),
        noise=(known[0], known[1], known[2]),
        clip=(clip,) * 3,
        info=PhotoInfo("tiff", width, height, metadata),
        encoding=Encoding(bit_depth=32, transfer="linear", metadata=metadata),
    )
