"""RAW files through LibRaw: linear camera colours, the true saturation level at 1."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import rawpy
from numpy.typing import NDArray

from lensmodel.errors import (
    InvalidInputError,
    LensModelError,
    RawDecodeError,
    TruncatedImageError,
    UnsupportedFormatError,
)
from lensmodel.photo.colour import SRGB_TO_XYZ_D65, Matrix, camera_to_srgb, matrix3
from lensmodel.photo.model import Matrix3
from lensmodel.photo.noise import estimate_noise
from lensmodel.types import NoiseModel, Planes

Demosaic = Literal["default", "ahd", "dht", "linear", "half"]

_ALGORITHMS: Final = {
    "ahd": rawpy.DemosaicAlgorithm.AHD,
    "dht": rawpy.DemosaicAlgorithm.DHT,
    "linear": rawpy.DemosaicAlgorithm.LINEAR,
    "half": rawpy.DemosaicAlgorithm.LINEAR,
}
_FULL: Final = 65535.0


@dataclass(frozen=True, slots=True)
class DevelopedRaw:
    """What LibRaw made of a file; fields as in `LinearPhoto`."""

    planes: Planes
    noise: tuple[NoiseModel, NoiseModel, NoiseModel]
    white_balance: tuple[float, float, float]
    to_srgb: Matrix3 | None
    xyz_to_camera: Matrix3 | None
    bits: int
    pipeline: str


@contextmanager
def opened_raw(path: Path) -> Iterator[rawpy.RawPy]:
    """Open a RAW file with LibRaw's header parser; foreign errors become ours.

    Raises
    ------
    UnsupportedFormatError
        If LibRaw does not know the format.
    TruncatedImageError
        If the file ends early.
    RawDecodeError
        If it fails in any other way.
    """
    try:
        with rawpy.RawPy() as raw:
            raw.open_file(str(path))
            yield raw
    except LensModelError:
        raise
    except rawpy.LibRawFileUnsupportedError as error:
        raise UnsupportedFormatError(
            "this kind of RAW is not supported by LibRaw; convert it to DNG or TIFF"
        ) from error
    except rawpy.LibRawIOError as error:
        raise TruncatedImageError("the RAW file ends before its data do; the upload was cut off") from error
    except MemoryError:
        raise
    except Exception as error:
        raise RawDecodeError(
            f"LibRaw cannot decode this file ({error}); convert it to DNG or TIFF"
        ) from error


def raw_size(path: Path) -> tuple[int, int]:
    """Width and height that LibRaw develops, in sensor orientation; the header only is read."""
    with opened_raw(path) as raw:
        return raw.sizes.width, raw.sizes.height


def develop_raw(path: Path, demosaic: Demosaic = "default") -> DevelopedRaw:
    """Develop a RAW file to linear camera RGB.

    No white balance, no colour matrix, no rotation and no stretching to the brightest pixel:
    1.0 is the level at which the sensor saturates.

    Raises
    ------
    InvalidInputError
        For an unknown demosaicing method.
    UnsupportedFormatError, TruncatedImageError, RawDecodeError
        If the file cannot be decoded, or what comes out is no photograph.
    """
    method = "ahd" if demosaic == "default" else demosaic
    if method not in _ALGORITHMS:
        raise InvalidInputError(
            f"no demosaicing {demosaic!r}; known: default, {', '.join(sorted(_ALGORITHMS))}"
        )
    with opened_raw(path) as raw:
        mosaic = _mosaic(raw)
        colours = None if mosaic is None else raw.raw_colors_visible
        white = _saturation(mosaic, raw)
        if mosaic is not None:
            _check_mosaic(mosaic)
        rgb = raw.postprocess(
            demosaic_algorithm=_ALGORITHMS[method],
            half_size=method == "half",
            gamma=(1, 1),
            no_auto_bright=True,
            output_bps=16,
            output_color=rawpy.ColorSpace.raw,
            user_wb=[1.0, 1.0, 1.0, 1.0],
            user_flip=0,
            user_sat=white,
            adjust_maximum_thr=0.0,  # else LibRaw makes the brightest pixel of each photo the white
            highlight_mode=rawpy.HighlightMode.Clip,
            median_filter_passes=0,
            fbdd_noise_reduction=rawpy.FBDDNoiseReductionMode.Off,
        )
        if rgb.ndim != 3 or rgb.shape[2] != 3:
            raise UnsupportedFormatError("only RAW files of three colours are read")
        planes = np.ascontiguousarray(np.moveaxis(rgb, -1, 0), dtype=np.float32)
        planes /= np.float32(_FULL)
        _check_planes(planes)
        wb = _white_balance(raw)
        to_srgb, xyz_to_camera = _colour(raw, wb)
        name = f"raw/{method}/1" if mosaic is not None else "raw/none/1"
        return DevelopedRaw(
            planes,
            _noise(planes, mosaic, colours, raw, white),
            wb,
            None if to_srgb is None else matrix3(to_srgb),
            None if xyz_to_camera is None else matrix3(xyz_to_camera),
            max(1, int(white).bit_length()),
            name,
        )


def _mosaic(raw: rawpy.RawPy) -> NDArray[np.uint16] | None:
    """The Bayer mosaic without margins; `None` where the file holds full colour already."""
    if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern is None:
        return None
    return raw.raw_image_visible


def _saturation(mosaic: NDArray[np.uint16] | None, raw: rawpy.RawPy) -> int:
    """Level at which the sensor clips, in raw units.

    The level that the file states is often too high. Where the photo has clipped pixels they
    pile up at one level, and that level is the truth.
    """
    stated = int(raw.white_level)
    if mosaic is None:
        return stated
    counts = np.bincount(mosaic.ravel(), minlength=2)
    top = int(np.flatnonzero(counts)[-1])
    black = float(np.mean(raw.black_level_per_channel))
    below = counts[max(top - 64, 0) : top]
    piled = counts[top] > max(50, 1e-5 * mosaic.size) and counts[top] > 20 * max(np.median(below), 1)
    if piled and black + 0.5 * (stated - black) < top < stated:
        return top
    return stated


def _check_mosaic(mosaic: NDArray[np.uint16]) -> None:
    """Refuse data that no sensor gives.

    Raises
    ------
    RawDecodeError
        If all is constant.
    TruncatedImageError
        If many rows at the end are constant: the data were cut off and LibRaw filled up.
    """
    rows = np.ptp(mosaic, axis=1) == 0
    if rows.all():
        raise RawDecodeError(
            f"every pixel of the RAW data is {int(mosaic.flat[0])}; the file holds no picture"
        )
    dead = float(rows.mean())
    if dead > 0.02:
        raise TruncatedImageError(f"{dead:.0%} of the rows of the RAW data are empty; the file was cut off")


def _check_planes(planes: Planes) -> None:
    if float(planes.max()) <= 0.0:
        raise RawDecodeError("the developed photo is black everywhere; the file holds no picture")


def _white_balance(raw: rawpy.RawPy) -> tuple[float, float, float]:
    """Multipliers of the camera, green 1; daylight where the camera gave none."""
    for source in (raw.camera_whitebalance, raw.daylight_whitebalance):
        r, g, b = (float(v) for v in source[:3])
        if min(r, g, b) > 0 and max(r, g, b) / min(r, g, b) < 20:
            return r / g, 1.0, b / g
    return 1.0, 1.0, 1.0


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


def _noise(
    planes: Planes,
    mosaic: NDArray[np.uint16] | None,
    colours: NDArray[np.uint8] | None,
    raw: rawpy.RawPy,
    white: int,
) -> tuple[NoiseModel, NoiseModel, NoiseModel]:
    if mosaic is None or colours is None:
        r, g, b = (estimate_noise(plane) for plane in planes)
        return r, g, b
    sites = site_planes(mosaic, colours, np.asarray(raw.black_level_per_channel, dtype=np.float64), white)
    models = {channel: estimate_noise(site) for channel, site in sites.items()}
    return models[0], models[1], models[2]


def site_planes(
    mosaic: NDArray[np.uint16], colours: NDArray[np.uint8], black: NDArray[np.float64], white: int
) -> dict[int, NDArray[np.float32]]:
    """Split a Bayer mosaic into planes of half the size, one of each colour, black 0 and white 1."""
    planes: dict[int, NDArray[np.float32]] = {}
    for row in (0, 1):
        for col in (0, 1):
            index = int(colours[row, col])
            channel = 1 if index == 3 else index
            values = mosaic[row::2, col::2].astype(np.float32)
            planes.setdefault(channel, (values - np.float32(black[index])) / np.float32(white - black[index]))
    return planes
