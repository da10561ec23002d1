"""RAW files through LibRaw: linear camera colours, the true saturation level at 1."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Final

import numpy as np
import rawpy

from lensmodel.core.errors import LensModelError, RawDecodeError, TruncatedImageError, UnsupportedFormatError
from lensmodel.core.geometry import Frame
from lensmodel.core.types import NoiseModel, Planes
from lensmodel.photo.colour import SRGB_TO_XYZ_D65, Matrix, camera_to_srgb, curves_of, matrix3
from lensmodel.photo.dng import Opcode, demosaiced, packed_opcodes, read_opcodes
from lensmodel.photo.metadata import Said
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.noise import coding_noise, estimate_noise, grain_of
from lensmodel.photo.values import Encoding, LensIdentity, LinearPhoto, PhotoInfo, PhotoMetadata, PlaneNoise

_NOISE_MIX: Final = np.array([[0.53, 0.54, 0.0], [0.03, 0.77, 0.03], [0.0, 0.54, 0.53]])
"""Share of the variance of each colour's pixels (column) in each plane that AHD makes (row): measured on flat
fields, as the tests do again. The noise of the planes is not white: at low frequencies it has about 3.7 times
the power of the sensor's in red and blue and 1.9 times in green, at the highest about half."""

_FULL: Final = 65535.0  # 16 bits
_ORIENTATIONS: Final = {3: 3, 5: 8, 6: 6}  # how LibRaw says that a picture is turned -> EXIF orientation

_LEAST_SHARE: Final = 0.25  # of the strongest that a channel is balanced by: it costs two of 16 bits

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
    kept, lost = [] if header.coarseness else read_opcodes(header.opcodes_2), list[Opcode]()
    white, clip, defects = int(raw.white_level), (1.0, 1.0, 1.0), 0
    sensor_noise, cfa, stated = None, None, header.white
    if mosaic is not None:
        white, clip = mosaic.saturation()
        sensor_noise, cfa, stated = mosaic.noise(white), mosaic.bayer_pattern(), ()
        kept, lost = demosaiced(kept, cfa)
        defects = mosaic.repair()
    balance, own_balance = _white_balance(raw)
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
            opcodes_2=packed_opcodes(kept),
            opcodes_3=packed_opcodes(read_opcodes(header.opcodes_3)),
        ),
        sensor_noise=sensor_noise,
        coding_noise=coding_noise(header.coarseness, curves_of("srgb")[1]),
        cfa=cfa,
        grain=(1.0, 1.0, 1.0) if sensor_noise is not None else grain_of(planes, noise, clip),
        remarks=(
            *(f"its {step.name} is for the mosaic only and is dropped" for step in lost),
            *((f"{defects} defective pixel{many} replaced",) if defects else ()),
            *(() if own_balance else ("it does not say its white balance, and that of daylight is taken",)),
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


def _white_balance(raw: rawpy.RawPy) -> tuple[tuple[float, float, float], bool]:
    """Multipliers of r, g, b, that of green 1, and whether they are the camera's own, not daylight's."""
    for own, multipliers in ((True, raw.camera_whitebalance), (False, raw.daylight_whitebalance)):
        r, g, b = multipliers[:3]
        if min(r, g, b) > 0 and max(r, g, b) / min(r, g, b) < 20:  # others are absurd
            return (float(r) / float(g), 1.0, float(b) / float(g)), own
    return (1.0, 1.0, 1.0), False


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
