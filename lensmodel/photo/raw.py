"""RAW files through LibRaw: linear camera colours, the true saturation level at 1."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
import rawpy
from numpy.typing import NDArray
from PIL import Image

from lensmodel.core.errors import LensModelError, RawDecodeError, TruncatedImageError, UnsupportedFormatError
from lensmodel.core.geometry import Frame
from lensmodel.core.types import NoiseModel, Planes
from lensmodel.photo import opcodes
from lensmodel.photo.colour import SRGB_TO_XYZ_D65, Matrix, camera_to_srgb, curves_of, matrix3, srgb_to_linear
from lensmodel.photo.jpeg import JpegSegments, opened_jpeg
from lensmodel.photo.metadata import Said
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.noise import coding_noise, estimate_noise, grain_of
from lensmodel.photo.raster import UNDECODABLE
from lensmodel.photo.values import Encoding, LensIdentity, LinearPhoto, PhotoInfo, PhotoMetadata, PlaneNoise

log = logging.getLogger(__name__)

_NOISE_MIX: Final = np.array([[0.53, 0.54, 0.0], [0.03, 0.77, 0.03], [0.0, 0.54, 0.53]])
"""Share of the variance of each colour's pixels (column) in each plane that AHD makes (row): measured on flat
fields, as the tests do again.

The noise of the planes is not white: its power at low frequencies is about 3.7 times that of the sensor in
red and blue and 1.9 times in green, and at the highest it is about half.
"""

_FULL: Final = 65535.0  # 16 bits
_ORIENTATIONS: Final = {3: 3, 5: 8, 6: 6}  # how LibRaw says that a picture is turned -> EXIF orientation

_LEAST_SHARE: Final = 0.25
"""No channel is balanced by more than this relative to the strongest: it costs two of 16 bits."""


# CRW, CR2, MRW: LibRaw reads every camera that wrote them, so that one it does not know is damaged.
_KNOWN_WHOLE: Final = ((6, b"HEAPCCDR"), (8, b"CR\x02"), (0, b"\0MRM"))


@contextmanager
def opened_raw(path: Path) -> Iterator[rawpy.RawPy]:
    """Open a RAW file with LibRaw's header parser; foreign errors become ours."""
    try:
        with rawpy.RawPy() as raw:
            raw.open_file(str(path))
            yield raw
    except (LensModelError, MemoryError):
        raise
    except (rawpy.LibRawFileUnsupportedError, rawpy.LibRawIOError) as error:
        with path.open("rb") as file:
            head = file.read(16)
        if isinstance(error, rawpy.LibRawIOError) or any(head.startswith(m, at) for at, m in _KNOWN_WHOLE):
            raise TruncatedImageError(
                "the RAW file is damaged, or ends before its data do; copy it again from the camera or card"
            ) from error
        raise UnsupportedFormatError(
            "this kind of RAW is not supported by LibRaw; convert it to DNG or TIFF"
        ) from error
    except Exception as error:
        raise RawDecodeError(
            f"LibRaw cannot decode this file ({error}); convert it to DNG or TIFF"
        ) from error


def exposure_of(raw: rawpy.RawPy, camera: PhotoMetadata) -> PhotoMetadata:
    """What LibRaw knows of a photo whose header names the camera alone; 0 is its word for unknown."""
    said = raw.other
    return replace(
        camera,
        lens=LensIdentity(model=raw.lens.model or None),
        aperture=round(said.aperture, 1) or None,
        focal_mm=said.focal_length or None,
        iso=said.iso_speed or None,
        exposure_s=said.shutter_speed or None,
        # the camera's clock has no zone; LibRaw takes its seconds for those of this machine
        taken_at=said.timestamp and said.timestamp.astimezone(UTC).replace(tzinfo=None),
        orientation=_ORIENTATIONS.get(raw.sizes.flip, 1),
        artist=said.artist or None,
    )


def develop_raw(raw: rawpy.RawPy, said: Said, info: PhotoInfo) -> LinearPhoto:
    """Develop an open RAW file to linear camera RGB, once its defective pixels are replaced.

    No white balance, no colour matrix, no rotation: 1.0 is the level at which the sensor saturates.
    """
    header, mosaic = said.header, Mosaic.of(raw)
    # LibRaw has done the steps of a lossy DNG, without which its numbers mean nothing
    kept, lost = [] if header.coarseness else opcodes.read(header.opcodes_2), list[opcodes.Opcode]()
    white, clip, defects = int(raw.white_level), (1.0, 1.0, 1.0), 0
    sensor_noise, cfa, stated = None, None, header.white
    if mosaic is not None:
        white, clip = mosaic.saturation()
        sensor_noise, cfa, stated = mosaic.noise(white), mosaic.bayer_pattern(), ()
        kept, lost = opcodes.demosaiced(kept, cfa)
        defects = mosaic.repair()
    balance = _white_balance(raw, mosaic)
    planes = _developed(raw, white, balance, stated)
    _, height, width = planes.shape
    noise = _plane_noise(planes, sensor_noise, balance)
    to_srgb, xyz_to_camera = _colour(raw, balance)
    many = " of its sensor is" if defects == 1 else "s of its sensor are"
    return LinearPhoto(
        planes=planes,
        frame=Frame(height, width),
        noise=noise,
        clip=clip,
        info=replace(info, width=width, height=height),
        encoding=Encoding(
            bit_depth=max(1, white.bit_length()),
            metadata=info.metadata.without_serials(),
            white_balance=balance,
            to_srgb=matrix3(to_srgb),
            xyz_to_camera=matrix3(xyz_to_camera),
            baseline_exposure=said.baseline_exposure(),
            opcodes_2=opcodes.written(kept),
            opcodes_3=opcodes.written(opcodes.read(header.opcodes_3)),
        ),
        sensor_noise=sensor_noise,
        coding_noise=coding_noise(header.coarseness, curves_of("srgb")[1]),
        cfa=cfa,
        grain=(1.0, 1.0, 1.0) if sensor_noise is not None else grain_of(planes, noise, clip),
        remarks=(
            *(f"its {step.name} is for the mosaic only and is dropped" for step in lost),
            *((f"{defects} defective pixel{many} replaced",) if defects else ()),
        ),
    )


def _developed(
    raw: rawpy.RawPy, white: int, balance: tuple[float, float, float], stated: tuple[int, ...]
) -> Planes:
    """Demosaic with white balance, then take the balance off again.

    Demosaicing fills in the fine detail of red and blue from green as if their contrasts were equal, as they
    roughly are after white balance only. `stated` is the white that a DNG without a mosaic states: LibRaw
    takes the black of such files off their values, but not off their white.
    """
    share = np.maximum(np.asarray(balance) / max(balance), _LEAST_SHARE)
    full, colours = share, min(raw.num_colors, 3)
    # LibRaw applies this after it took the black level off, so it counts from black.
    saturation = None if white == raw.white_level else white - min(raw.black_level_per_channel)
    if stated:
        black = np.array(raw.black_level_per_channel[:colours], dtype=float)
        spans = np.resize(np.resize(stated, colours) - black, 3)
        if spans.min() > 0.0:
            saturation, full = round(spans.max()), share * (spans / spans.max())
    rgb = np.asarray(
        raw.postprocess(
            demosaic_algorithm=rawpy.DemosaicAlgorithm.AHD,
            gamma=(1, 1),
            no_auto_bright=True,
            output_bps=16,
            output_color=rawpy.ColorSpace.raw,
            user_wb=[float(share[0]), float(share[1]), float(share[2]), float(share[1])],
            user_flip=0,
            user_sat=saturation,
            adjust_maximum_thr=0.0,  # else LibRaw makes the brightest pixel of each photo the white
            highlight_mode=rawpy.HighlightMode.Ignore,  # the strongest channel reaches 65535, none is cut
            median_filter_passes=0,
            fbdd_noise_reduction=rawpy.FBDDNoiseReductionMode.Off,
        )
    )
    if rgb.ndim != 3 or rgb.shape[2] not in {1, 3}:
        raise UnsupportedFormatError("only RAW files of three colours, or none, are read")
    planes: Planes = np.empty((3, *rgb.shape[:2]), dtype=np.float32)
    for k, plane in enumerate(planes):
        # LibRaw rounds down, and so do we: saturated pixels become 1.0 and not a little less.
        scale = np.float32(1 / np.floor(_FULL * full[k]))
        np.multiply(rgb[:, :, min(k, rgb.shape[2] - 1)], scale, out=plane)
        np.minimum(plane, np.float32(1.0), out=plane)
    if float(planes.max()) <= 0.0:
        raise RawDecodeError("the developed photo is black everywhere; the file holds no picture")
    return planes


def _plane_noise(
    planes: Planes, sensor: PlaneNoise | None, balance: tuple[float, float, float]
) -> PlaneNoise:
    """Variance of each plane's pixels, from that of the sensor where it is known.

    Demosaicing adds detail of colour s, noise included, to plane c after white balance w::

        read_c = sum_s M_cs read_s (w_s / w_c)^2
        shot_c = sum_s M_cs shot_s  w_s / w_c      (where the scene is grey)
    """
    if sensor is None:
        r, g, b = (estimate_noise(plane, step=1 / _FULL) for plane in planes)
        return r, g, b
    weight = np.asarray(balance)[None, :] / np.asarray(balance)[:, None]
    shot = (_NOISE_MIX * weight) @ np.array([model.shot for model in sensor])
    read = (_NOISE_MIX * weight**2) @ np.array([model.read for model in sensor])
    r, g, b = (NoiseModel(float(a), float(c)) for a, c in zip(shot, read, strict=True))
    return r, g, b


def _white_balance(raw: rawpy.RawPy, mosaic: Mosaic | None) -> tuple[float, float, float]:
    """Multipliers of the camera, green 1: as written, else as its own JPEG shows, else daylight."""
    if known := _relative(*raw.camera_whitebalance[:3]):
        return known
    table = np.asarray(raw.rgb_xyz_matrix, dtype=np.float64)[:3]
    shown = balance_of_rendition(raw, mosaic, camera_to_srgb(table) if table.any() else None)
    if shown is not None and (known := _relative(shown[0], 1.0, shown[1])):
        return known
    if known := _relative(*raw.daylight_whitebalance[:3]):
        log.info("the RAW file does not say its white balance; daylight is assumed")
    return known or (1.0, 1.0, 1.0)


def _relative(r: float, g: float, b: float) -> tuple[float, float, float] | None:
    """Multipliers relative to that of green; None where they are absurd."""
    sound = min(r, g, b) > 0 and max(r, g, b) / min(r, g, b) < 20
    return (float(r) / float(g), 1.0, float(b) / float(g)) if sound else None


def _colour(
    raw: rawpy.RawPy, white_balance: tuple[float, float, float]
) -> tuple[Matrix | None, Matrix | None]:
    """White-balanced camera to linear sRGB, and CIE XYZ to camera; from the file, else LibRaw's table."""
    of_file = np.asarray(raw.color_matrix, dtype=np.float64)[:3, :3]
    of_table = np.asarray(raw.rgb_xyz_matrix, dtype=np.float64)[:3]
    if np.abs(of_table).sum() > 0:
        return camera_to_srgb(of_table), of_table
    if abs(np.linalg.det(of_file)) < 1e-6:
        return None, None
    balanced = np.linalg.inv(SRGB_TO_XYZ_D65 @ of_file)
    return of_file, balanced / np.asarray(white_balance)[:, None]


# --- white balance as the camera applied it, out of its own JPEG of the photo ---------------------

_Grid: TypeAlias = NDArray[np.float64]
"""Means over blocks, `(row, col, colour)`."""

_BLOCKS: Final = 96  # along the longer side: a few pixels of misplacement do not matter then
_SMALLEST_JPEG: Final = 2 * _BLOCKS  # pixels; the shorter side may have half, one to a block (chosen)
_MOST_JPEG_PIXELS: Final = 64_000_000  # against files made to fill the memory: so many take 200 MB (chosen)
_ASPECT: Final = 0.03  # how much the shapes of the two may differ: JPEGs lack the rim that demosaicing needs
_LIKENESS: Final = 0.8  # least correlation of the lightness of both; a JPEG of something else stays far below
_MIDTONES: Final = (0.15, 0.8)  # of the JPEG's numbers, in which a camera's tone curve is nearest to sRGB
_UNCLIPPED: Final = 0.5  # largest mean of a block, full is 1 (chosen): leaves brighter pixels room
_NEUTRAL: Final = 1.6  # largest over smallest colour: settings of the camera change strong colours more
_LEAST_BLOCKS: Final = 24  # fewer near-neutral blocks than this may all be of one object that is not grey


def balance_of_rendition(
    raw: rawpy.RawPy, mosaic: Mosaic | None, to_srgb: Matrix | None
) -> tuple[float, float] | None:
    """Estimate the white balance from the JPEG that the camera put beside its RAW data.

    Some cameras, as the EOS D30, write no multipliers into their RAW files. With J the JPEG in linear light,
    C the matrix from balanced camera colours to sRGB, and s the means of the sensor over the same block, the
    multipliers of red and blue relative to green are::

        m_k = median over near-neutral blocks of (C^-1 J)_k s_g / ((C^-1 J)_g s_k)
    """
    if mosaic is None or not mosaic.is_bayer or (picture := _jpeg_of(raw)) is None:
        return None
    planes = mosaic.sites(mosaic.white)
    rows, cols = (min(sides) for sides in zip(*(plane.shape for plane in planes), strict=True))
    sites = np.stack([plane[:rows, :cols] for plane in planes], axis=-1)  # of odd sides the rest is cut off
    height, width, _ = sites.shape
    rows, cols = (round(_BLOCKS * side / max(height, width)) for side in (height, width))
    stretched = abs(np.log(picture.width * height / (picture.height * width))) > _ASPECT
    if stretched or min(rows, cols) < 8 or min(height, width) < _SMALLEST_JPEG // 2:
        return None
    pixels = np.asarray(picture.resize((4 * cols, 4 * rows), Image.Resampling.BOX), dtype=np.float64) / 255.0
    numbers, shown, sensor = (
        _block_means(values, rows, cols) for values in (pixels, srgb_to_linear(pixels), sites)
    )
    greens = [np.sqrt(np.maximum(grid[..., 1], 0.0)).ravel() for grid in (shown, sensor)]
    if min(float(green.std()) for green in greens) < 1e-6 or np.corrcoef(np.stack(greens))[0, 1] < _LIKENESS:
        return None
    balanced = shown if to_srgb is None else shown @ np.linalg.inv(to_srgb).T
    most = numbers.max(axis=-1)
    used = (most > _MIDTONES[0]) & (most < _MIDTONES[1]) & (sensor.max(axis=-1) < _UNCLIPPED)
    used &= (shown.max(axis=-1) < _NEUTRAL * shown.min(axis=-1)) & (sensor.min(axis=-1) > 0.0)
    used &= balanced.min(axis=-1) > 0.0
    if used.sum() < _LEAST_BLOCKS:
        return None
    red, green, blue = (balanced[used] / sensor[used]).T
    return float(np.median(red / green)), float(np.median(blue / green))


def _jpeg_of(raw: rawpy.RawPy) -> Image.Image | None:
    """Decode the embedded JPEG, scaled down where it is large; `None` without a sound one."""
    try:
        thumb = raw.extract_thumb()
        if thumb.format != rawpy.ThumbFormat.JPEG or not isinstance(thumb.data, bytes):
            return None
        picture = opened_jpeg(JpegSegments(thumb.data))
        if picture.width * picture.height > _MOST_JPEG_PIXELS or min(picture.size) < _SMALLEST_JPEG // 2:
            return None
        picture.draft("RGB", (4 * _BLOCKS, 4 * _BLOCKS))
        return picture.convert("RGB") if picture.mode in {"RGB", "L"} else None
    except (rawpy.LibRawError, *UNDECODABLE):
        return None


def _block_means(values: NDArray[np.floating], rows: int, cols: int) -> _Grid:
    """Means over `rows` x `cols` blocks that cover the whole, none of them empty."""
    height, width = values.shape[:2]
    tops, lefts = np.arange(rows) * height // rows, np.arange(cols) * width // cols
    sums = np.add.reduceat(np.add.reduceat(values.astype(np.float64), tops, axis=0), lefts, axis=1)
    counts = np.diff(np.append(tops, height))[:, None] * np.diff(np.append(lefts, width))[None, :]
    return np.asarray(sums / counts[:, :, None])
