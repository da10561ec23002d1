"""From a photo file, or an array, to linear light; and what is known of a file without decoding it.

RAW goes through LibRaw; TIFF, PNG and JPEG are decoded to numbers, and these to light by their curve.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Final

import imagecodecs
import numpy as np
import rawpy
import tifffile
from numpy.typing import ArrayLike

from lensmodel.core import errors
from lensmodel.core.types import CHANNELS, Frame, LensSettings, NoiseModel, Planes
from lensmodel.photo import colour, containers, values
from lensmodel.photo.containers import COPY_AGAIN
from lensmodel.photo.metadata import Said
from lensmodel.photo.mosaic import Mosaic, replace_defects
from lensmodel.photo.noise import coding_noise, estimate_noise, graininess
from lensmodel.photo.writing import OPCODES_2, OPCODES_3, Pixels, opcodes_of_planes

MIN_SIDE = 16  # smaller pictures are icons, not photos

# Compressions of DNG that LibRaw, as built for Python, opens but cannot decode.
_UNDECODED: Final = {9: "VC-5 (GoPro GPR)", 52546: "JPEG XL"}


def inspect(path: Path | str, limits: values.Limits | None = None) -> values.PhotoInfo:
    """Read kind, size and metadata from the header, and refuse what cannot be developed."""
    with _opened(Path(path), limits or values.Limits()) as (_, _, info):
        return info


@contextlib.contextmanager
def _opened(path: Path, limits: values.Limits) -> Iterator[tuple[Said, rawpy.RawPy | None, values.PhotoInfo]]:
    """Open a file once: what its header says, LibRaw where it is a RAW file, and both together."""
    with contextlib.ExitStack() as stack:
        said = Said.of(stack.enter_context(containers.opened_header(path, limits)))
        header, metadata, raw = said.header, said.metadata(), None
        kind, width, height = header.kind.upper(), header.width, header.height
        if header.kind in {"raw", "dng"}:
            raw = stack.enter_context(opened_raw(path))
            if packing := _UNDECODED.get(header.compression):
                remedy = "convert it to a plain DNG or TIFF"
                raise errors.UnsupportedFormatError(f"RAW data packed as {packing} are not read; {remedy}")
            width, height = raw.sizes.width, raw.sizes.height
            if header.camera is not None:
                metadata = _exposure_of(raw, metadata)
            containers.check_size(width, height, path.stat().st_size, limits)
        if kind == "JPEG" and header.channels == 4:
            raise errors.UnsupportedFormatError("the JPEG is CMYK, made for print; convert it to RGB")
        if not header.whole:
            raise errors.TruncatedImageError(f"the {kind} ends before its picture does; {COPY_AGAIN}")
        if min(width, height) < MIN_SIDE:
            said_so = f"{width} x {height} pixels are no photo; the smallest side allowed is {MIN_SIDE}"
            raise errors.NotAnImageError(said_so)
        # no camera stores a picture higher than wide and says that it lies
        upright = raw is None and height > width and metadata.orientation == 1
        turned = upright and metadata.camera_model is not None
        yield said, raw, values.PhotoInfo(header.kind, width, height, metadata, said.placed()[1], turned)


def develop(
    path: Path | str,
    *,
    limits: values.Limits | None = None,
    on_info: Callable[[values.PhotoInfo], None] | None = None,
) -> values.LinearPhoto:
    """Develop a photo: RAW through LibRaw, TIFF, PNG and JPEG through their transfer curve.

    RAW is in camera colors before white balance, others in the primaries of their profile. Curves are those
    of sRGB (IEC 61966-2-1:1999) or of the file's own profile (ICC.1:2022, sections 10.6 and 10.18); noise is
    measured on flat places, of RAW on its mosaic too.

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
        orientation, whatever the file says about turning it; with noise, metadata and encoding.

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    UnreadablePhotoError
        One of its kinds, if the file cannot be decoded or holds no picture.
    ImageTooLargeError
        If it is larger than the limits allow.
    """
    path = Path(path)
    with _opened(path, limits or values.Limits()) as (said, raw, info):
        try:
            if on_info is not None:
                on_info(info)
        except errors.MetadataMissingError:
            # of a photo that is damaged nobody shall look up what it does not say
            _read_pixels(path, said.header) if raw is None else Mosaic.of(raw)
            raise
        developed = _develop_raster(path, said, info) if raw is None else _develop_raw(raw, said, info)
    for remark in developed.remarks:
        values.remarks_log.warning("%s: %s", path.name, remark)
    return developed


def photo_from_array(
    planes: ArrayLike,
    *,
    noise: NoiseModel | None = None,
    clip: float = 1.0,
    aperture: float | None = None,
    focal_mm: float | None = None,
    focus_m: float | None = None,
    pixel_pitch_um: float | None = None,
) -> values.LinearPhoto:
    """Make a developed photo of an array.

    Parameters
    ----------
    planes : array_like of float, shape (3, height, width)
        Red, green and blue in linear light: black 0, saturation at `clip`; kept as float32.
    noise : NoiseModel, optional
        Variance of the pixels against their level; None measures it on the flat places of each plane.
    clip : float
        Level at which the sensor saturates.
    aperture, focal_mm, focus_m, pixel_pitch_um : float, optional
        f-number, 0.5 to 128; focal length in mm, focus distance in metres and pitch of the pixels in
        micrometres, as far as they are known.

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
        raise errors.InvalidInputError(f"a photo must have the shape (3, height, width), got {array.shape}")
    if not np.isfinite(array).all():
        raise errors.InvalidInputError("a photo must be finite; mask or replace NaN and infinity first")
    if not clip > 0.0:
        raise errors.InvalidInputError(f"clip must be a positive level, got {clip}")
    LensSettings(aperture, focal_mm, focus_m)  # refuses what no lens has
    if pixel_pitch_um is not None and not 0.0 < pixel_pitch_um < math.inf:
        raise errors.InvalidInputError(f"the pixel pitch must be positive micrometres, got {pixel_pitch_um}")
    metadata = values.PhotoMetadata(
        aperture=aperture, focal_mm=focal_mm, focus_m=focus_m, pixel_pitch_um=pixel_pitch_um
    )
    frame = Frame(*array.shape[1:])
    return values.LinearPhoto(
        planes=array,
        frame=frame,
        noise=tuple(noise or estimate_noise(plane, clip) for plane in array),
        clip=(clip,) * 3,
        info=values.PhotoInfo("tiff", frame.width, frame.height, metadata),
        encoding=values.Encoding(bit_depth=32, transfer="linear", metadata=metadata),
    )


# --- RAW ---------------------------------------------------------------------------------------

_NOISE_MIX: Final = np.array([[0.53, 0.54, 0.0], [0.03, 0.77, 0.03], [0.0, 0.54, 0.53]])
"""Share of the variance of each colour's pixels (column) in each plane that AHD makes (row): measured on flat
fields, as the tests do again. The noise of the planes is not white: at low frequencies it has about 3.7 times
the power of the sensor's in red and blue and 1.9 times in green, at the highest about half."""

_FULL: Final = 65535.0  # 16 bits
# Tags of a DNG: white level of all channels or of each, and stops by which to brighten it: DNG 1.6, chapter 4
_WHITE, _BASELINE_EXPOSURE = 50717, 50730
_ORIENTATIONS: Final = {3: 3, 5: 8, 6: 6}  # how LibRaw says that a picture is turned -> EXIF orientation

_LEAST_SHARE: Final = 0.25  # of the strongest that a channel is balanced by: it costs two of 16 bits

# CRW, CR2, MRW: LibRaw reads every camera that wrote them, so that one it does not know is damaged.
_KNOWN_WHOLE: Final = ((6, b"HEAPCCDR"), (8, b"CR\x02"), (0, b"\0MRM"))


@contextlib.contextmanager
def opened_raw(path: Path) -> Iterator[rawpy.RawPy]:
    """Open a RAW file with LibRaw's header parser; foreign errors become ours."""
    try:
        with rawpy.RawPy() as raw:
            raw.open_file(str(path))
            yield raw
    except (errors.LensModelError, MemoryError):
        raise
    except (rawpy.LibRawFileUnsupportedError, rawpy.LibRawIOError) as error:
        with path.open("rb") as file:
            head = file.read(16)
        if isinstance(error, rawpy.LibRawIOError) or any(head.startswith(m, at) for at, m in _KNOWN_WHOLE):
            said = f"the RAW file is damaged, or ends before its data do; {COPY_AGAIN}"
            raise errors.TruncatedImageError(said) from error
        said = "this kind of RAW is not supported by LibRaw; convert it to DNG or TIFF"
        raise errors.UnsupportedFormatError(said) from error
    except Exception as error:
        said = f"LibRaw cannot decode this file ({error}); convert it to DNG or TIFF"
        raise errors.RawDecodeError(said) from error


def _exposure_of(raw: rawpy.RawPy, camera: values.PhotoMetadata) -> values.PhotoMetadata:
    """What LibRaw knows of a photo whose header names the camera alone; 0 is its word for unknown."""
    said = raw.other
    return replace(
        camera,
        aperture=round(said.aperture, 1) or None,
        focal_mm=said.focal_length or None,
        iso=said.iso_speed or None,
        exposure_s=said.shutter_speed or None,
        # the camera's clock has no zone; LibRaw takes its seconds for those of this machine
        taken_at=said.timestamp and said.timestamp.astimezone(UTC).replace(tzinfo=None),
        orientation=_ORIENTATIONS.get(raw.sizes.flip, 1),
        artist=said.artist or None,
    )


def _develop_raw(raw: rawpy.RawPy, said: Said, info: values.PhotoInfo) -> values.LinearPhoto:
    """Develop an open RAW file to linear camera RGB, once its defective pixels are replaced."""
    tags, mosaic, white, clip = said.tags, Mosaic.of(raw), int(raw.white_level), (1.0, 1.0, 1.0)
    # LibRaw has done the steps of a lossy DNG, without which its numbers mean nothing, and stretches them
    lossy = said.header.compression == containers.LOSSY_DNG
    opcodes = b"" if lossy else tags.raw(OPCODES_2)
    stated = () if lossy else tags.integers(_WHITE, 3)
    sensor_noise, cfa, remarks = None, None, list[str]()
    if mosaic is not None:
        white, clip = mosaic.saturation()
        sensor_noise, cfa, stated = mosaic.noise(white), mosaic.bayer_pattern(), ()
        opcodes, lost = opcodes_of_planes(opcodes, cfa)
        if lost:
            remarks.append(f"what its OpcodeList2 asks of the mosaic alone is dropped ({lost})")
        if count := replace_defects(mosaic.values, mosaic.colours, mosaic.period):  # in LibRaw's own memory
            many = " of its sensor is" if count == 1 else "s of its sensor are"
            remarks.append(f"{count} defective pixel{many} replaced")
    balance, own_balance = _white_balance(raw)
    if not own_balance:
        remarks.append("it does not say its white balance: its picture is made grey on average")
    planes = _developed(raw, white, balance, stated)
    _, height, width = planes.shape
    noise = _plane_noise(planes, sensor_noise, balance)
    (to_srgb, xyz_to_camera), stops = _colour(raw, balance), tags.number(_BASELINE_EXPOSURE)
    return values.LinearPhoto(
        planes=planes,
        frame=Frame(height, width),
        noise=noise,
        clip=clip,
        info=replace(info, width=width, height=height),
        encoding=values.Encoding(
            bit_depth=max(1, white.bit_length()),
            metadata=info.metadata.without_serials(),
            white_balance=balance,
            to_srgb=to_srgb,
            xyz_to_camera=xyz_to_camera,
            baseline_exposure=stops if stops is not None and abs(stops) <= 10.0 else None,  # others: absurd
            opcodes_2=opcodes,
            opcodes_3=tags.raw(OPCODES_3),
        ),
        sensor_noise=sensor_noise,
        coding_noise=coding_noise(said.header.coarseness, colour.curves_of("srgb")[1]),
        cfa=cfa,
        grain=(1.0,) * 3 if sensor_noise is not None else tuple(map(graininess, planes, noise, clip)),
        remarks=tuple(remarks),
    )


def _developed(
    raw: rawpy.RawPy, white: int, balance: tuple[float, float, float], stated: tuple[int, ...]
) -> Planes:
    """Demosaic with white balance, then take the balance off again; white becomes 1.0."""
    # Demosaicing fills in the fine detail of red and blue from green as if their contrasts were equal, as
    # they roughly are after white balance only.
    share = np.maximum(np.asarray(balance) / max(balance), _LEAST_SHARE)
    full, colours = share, min(raw.num_colors, 3)
    # LibRaw applies this after it took the black level off, so it counts from black.
    saturation = None if white == raw.white_level else white - min(raw.black_level_per_channel)
    if stated:  # by a DNG without a mosaic: LibRaw takes its black off the values, but not off the white
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
        raise errors.UnsupportedFormatError("only RAW files of three colours, or none, are read")
    planes: Planes = np.empty((3, *rgb.shape[:2]), dtype=np.float32)
    for k, plane in enumerate(planes):
        # LibRaw rounds down, and so do we: saturated pixels become 1.0 and not a little less.
        scale = np.float32(1 / np.floor(_FULL * full[k]))
        np.multiply(rgb[:, :, min(k, rgb.shape[2] - 1)], scale, out=plane)
        np.minimum(plane, np.float32(1.0), out=plane)
    if float(planes.max()) <= 0.0:
        raise errors.RawDecodeError("the developed photo is black everywhere; the file holds no picture")
    return planes


def _plane_noise(
    planes: Planes, sensor: values.PlaneNoise | None, balance: tuple[float, float, float]
) -> values.PlaneNoise:
    """Variance of each plane's pixels, from that of the sensor where it is known.

    Demosaicing adds detail of colour s, noise included, to plane c after white balance w::

        read_c = sum_s M_cs read_s (w_s / w_c)^2
        shot_c = sum_s M_cs shot_s  w_s / w_c      (where the scene is grey)
    """
    if sensor is None:
        return tuple(estimate_noise(plane, step=1 / _FULL) for plane in planes)
    weight = np.asarray(balance)[None, :] / np.asarray(balance)[:, None]
    shot = (_NOISE_MIX * weight) @ np.array([model.shot for model in sensor])
    read = (_NOISE_MIX * weight**2) @ np.array([model.read for model in sensor])
    return tuple(NoiseModel(float(a), float(c)) for a, c in zip(shot, read, strict=True))


def _white_balance(raw: rawpy.RawPy) -> tuple[tuple[float, float, float], bool]:
    """Multipliers of r, g, b, that of green 1, and whether they are the camera's own."""

    def balanced(r: float, g: float, b: float, *_: float) -> tuple[float, float, float] | None:
        usable = min(r, g, b) > 0 and max(r, g, b) / min(r, g, b) < 20  # others are absurd
        return (float(r) / float(g), 1.0, float(b) / float(g)) if usable else None

    if own := balanced(*raw.camera_whitebalance):
        return own, True
    # what is not saturated becomes grey on average; of the dark, daylight's serve
    raw.postprocess(use_auto_wb=True, half_size=True, output_bps=8)
    of_the_picture = balanced(*(raw.auto_whitebalance or (0.0, 0.0, 0.0)))
    return of_the_picture or balanced(*raw.daylight_whitebalance) or (1.0, 1.0, 1.0), False


def _colour(
    raw: rawpy.RawPy, white_balance: tuple[float, float, float]
) -> tuple[colour.Matrix | None, colour.Matrix | None]:
    """White-balanced camera to linear sRGB, and CIE XYZ to camera; from the file, else LibRaw's table."""
    of_file = np.asarray(raw.color_matrix, dtype=np.float64)[:3, :3]
    of_table = np.asarray(raw.rgb_xyz_matrix, dtype=np.float64)[:3]
    if np.abs(of_table).sum() > 0:
        return colour.camera_to_srgb(of_table), of_table
    if abs(np.linalg.det(of_file)) < 1e-6:
        return None, None
    balanced = np.linalg.inv(colour.SRGB_TO_XYZ_D65 @ of_file)
    return of_file, balanced / np.asarray(white_balance)[:, None]


# --- TIFF, PNG and JPEG ------------------------------------------------------------------------


def _develop_raster(path: Path, said: Said, info: values.PhotoInfo) -> values.LinearPhoto:
    """Decode a picture and turn its numbers into linear light by its transfer curve."""
    header, (pixels, transparent) = said.header, _read_pixels(path, said.header)
    height, width = pixels.shape[:2]
    if (height, width) != (info.height, info.width):
        said_so = f"the header says {info.width} x {info.height}, the decoder gave {width} x {height}"
        raise errors.UnreadablePhotoError(f"{said_so}; save it anew")
    floating, depth, remarks = pixels.dtype.kind == "f", pixels.dtype.itemsize, list[str]()
    transfer, icc = _transfer_of(said, floating, remarks)
    if transparent:
        remarks.append("its transparency is dropped")
    if info.turned:
        said_so = "a program has turned its pixels upright, and nothing tells which way"
        remarks.append(f"{said_so}: the more the PSFs of both differ, the less is corrected")
    curves = colour.curves_of(transfer, icc)
    planes: Planes = np.empty((3, height, width), dtype=np.float32)
    for k, curve in enumerate(curves):
        planes[k] = pixels[:, :, k] if transfer == "linear" else colour.decode(pixels[:, :, k], curve)
    green, code = curves[1], colour.CODES // 255 if depth == 1 else 1
    clip = (max(1.0, float(planes.max())) if floating else 1.0,) * 3
    codes, step = green[::code] if depth == 1 else None, float(green[code] - green[0])
    noise = tuple(estimate_noise(plane, clip[0], step, codes) for plane in planes)
    return values.LinearPhoto(
        planes=planes,
        frame=Frame(height, width),
        noise=noise,
        clip=clip,
        info=info,
        encoding=values.Encoding(8 * depth, transfer, icc, info.metadata.without_serials()),
        grain=tuple(map(graininess, planes, noise, clip)),
        coding_noise=coding_noise(header.coarseness, green),
        chroma_step=header.chroma_step,
        remarks=tuple(remarks),
    )


def _transfer_of(said: Said, floating: bool, remarks: list[str]) -> tuple[values.Transfer, bytes | None]:
    """Which curve the numbers follow, and the profile for the output; one that is left out is remarked on."""
    icc = said.header.icc
    if colour.read_profile(icc) is not None:
        return "icc", icc
    declared = colour.named_profile("adobergb") if said.adobe_rgb and not floating else None
    if icc is not None:
        instead = "its other tags say" if declared else "linear light" if floating else "sRGB"
        remarks.append(f"its ICC profile is damaged or not for RGB: its colours are read as {instead}")
    return "linear" if floating else "icc" if declared else "srgb", declared


def _read_pixels(path: Path, header: containers.Header) -> tuple[Pixels, bool]:
    """Decode to numbers `(row, col, 3)`, and say whether transparency that differs was dropped."""
    name = header.kind.upper()
    try:
        if header.kind == "tiff":
            with tifffile.TiffFile(path) as file:
                file.filehandle.seek(header.directory)
                page = tifffile.TiffPage(file, 0)
                pixels = page.asarray()
            if pixels.ndim == 3 and page.planarconfig == 2:
                pixels = np.moveaxis(pixels, 0, -1)
        elif header.kind == "png":
            pixels = imagecodecs.png_decode(containers.png_picture(path.read_bytes()))
        else:
            with containers.opened_jpeg(containers.JpegSegments(path.read_bytes())) as image:
                pixels = np.asarray(image.convert("RGB"))
        transparent = pixels.shape[2:] in {(2,), (4,)} and bool(np.ptp(pixels[..., -1]) > 0)
        return _three_channels(pixels), transparent
    except (MemoryError, errors.LensModelError):
        raise
    except Exception as error:  # decoders meet hostile files with exceptions of any kind
        if "truncated" in str(error):
            raise errors.TruncatedImageError(f"the {name} ends before its picture does ({error})") from error
        raise errors.NotAnImageError(f"the {name}'s pixel data are damaged ({error})") from error


def _three_channels(pixels: Pixels) -> Pixels:
    if pixels.dtype.kind == "f":
        pixels = pixels.astype(np.float32)
        known = pixels[np.isfinite(pixels)]
        pixels = np.nan_to_num(pixels, posinf=max(1.0, float(known.max(initial=0.0))), neginf=0.0)
    elif pixels.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        said = f"samples of type {pixels.dtype} are not read; save it with 8 or 16 bits"
        raise errors.UnsupportedFormatError(said)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or pixels.shape[2] > 4:
        said = f"a picture of shape {pixels.shape} is no photo; give RGB on one page"
        raise errors.UnsupportedFormatError(said)
    return np.repeat(pixels[:, :, :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[:, :, :3]
