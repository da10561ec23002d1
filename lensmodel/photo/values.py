"""The values that travel: what a photo file is, what it says, and its pixels in linear light."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Final, Literal, TypeAlias

from numpy.typing import ArrayLike

from lensmodel.core.errors import MetadataMissingError, TurnedPixelsError
from lensmodel.core.types import BayerPattern, Frame, LensSettings, NoiseModel, Planes

_RAW: Final = (
    "3fr ari arw bay cap cr2 cr3 crw cs1 dc2 dcr dcs dng drf eip erf fff gpr ia iiq k25 kc2 kdc mdc mef mfw "
    "mos mrw nef nrw orf ori pef ptx pxn qtk r3d raf raw rdc rw2 rwl rwz sr2 srf srw sti x3f"
)
RAW_ENDINGS: Final = frozenset(f".{ending}" for ending in _RAW.split())
"""Of RAW files that LibRaw 0.22 knows or may refuse: what a file is, its content tells."""

ENDINGS: Final = RAW_ENDINGS | {".jpg", ".jpeg", ".tif", ".tiff", ".png"}

SOFTWARE: Final = "lensmodel"  # names this program in the files that it writes

CORRECTED: Final = "-corrected"
"""Ends the names of what `lensmodel correct` wrote: it says nothing about its lens any more."""

FileKind: TypeAlias = Literal["raw", "dng", "tiff", "png", "jpeg"]
SerialSource: TypeAlias = Literal["exif", "makernote", "xmp", "user", "none"]
Transfer: TypeAlias = Literal["srgb", "linear", "icc"]
OutputFormat: TypeAlias = Literal["tiff16", "png16", "png8", "jpeg", "tiff32", "dng"]
ColorSpace: TypeAlias = Literal["same", "srgb", "camera-linear"]
PlaneNoise: TypeAlias = tuple[NoiseModel, ...]  # of red, green and blue
remarks_log = logging.getLogger("lensmodel.remarks")
"""Where what was left out of a photo or replaced in it is told, with the name of its file."""

_PROCESSED: Final = 16.0  # noise variance of a photo without its mosaic over what its flat places show
# Coarseness of grain above which more of it counts, and how much more at most; demosaicing has 6 to 9.
_USUAL_GRAIN, _COARSEST = 14.0, 4.0
# Noise power of demosaiced planes at low frequencies over that of the sensor: see `development._NOISE_MIX`.
_DEMOSAICED: Final = (3.7, 1.9, 3.7)
_COARSEST_POWER: Final = 64.0  # largest `noise.graininess` believed: cameras reach 60, texture far more


@dataclass(frozen=True, slots=True)
class Limits:
    """How large a photo may be; checked on the header, before anything is decoded."""

    max_megapixels: float = 160.0  # width times height, in millions
    max_bytes: int = 2 << 30  # size of the file


@dataclass(frozen=True, slots=True)
class LensIdentity:
    """Which lens it was, as far as the file says; a placeholder such as "0000000000" is no serial."""

    maker: str | None = None  # as the file names them
    model: str | None = None
    serial: str | None = None
    serial_source: SerialSource = "none"  # which tag the serial is from, or "none"


@dataclass(frozen=True, slots=True)
class PhotoMetadata:
    """What the file says about camera, lens and exposure; `None` is unknown, never zero."""

    camera_maker: str | None = None
    camera_model: str | None = None
    body_serial: str | None = None
    lens: LensIdentity = LensIdentity()
    aperture: float | None = None  # f-number
    focal_mm: float | None = None  # not the equivalent of 35 mm film
    focus_m: float | None = None
    iso: float | None = None
    exposure_s: float | None = None
    taken_at: datetime | None = None  # by the camera's clock, without a zone
    orientation: int = 1  # EXIF's, 1 to 8; planes are in sensor orientation, whatever it says
    pixel_pitch_um: float | None = None  # of the pixels of this file
    artist: str | None = None
    copyright: str | None = None
    rating: int | None = None  # stars, 0 to 5; -1 rejected
    keywords: tuple[str, ...] = ()

    def settings(self, given: LensSettings | None = None) -> LensSettings:
        """Settings of the lens as the file says; a caller's, meant for a folder, fill what it leaves open."""
        given = given or LensSettings()
        return LensSettings(
            aperture=given.aperture if self.aperture is None else self.aperture,
            focal_mm=given.focal_mm if self.focal_mm is None else self.focal_mm,
            focus_m=given.focus_m if self.focus_m is None else self.focus_m,
        )

    def require_aperture(self, given: LensSettings | None = None) -> None:
        """Refuse a photo whose aperture neither the file nor the caller says."""
        if self.settings(given).aperture is None:
            said = "it does not say its aperture; give its f-number by --aperture, 2.8 for f/2.8"
            raise MetadataMissingError(said)

    def without_serials(self) -> PhotoMetadata:
        """Return the same without the serials of body and lens, which are personal data."""
        return replace(self, body_serial=None, lens=replace(self.lens, serial=None, serial_source="none"))


@dataclass(frozen=True, slots=True)
class PhotoInfo:
    """What is known of a photo without decoding it."""

    kind: FileKind  # by its content
    width: int  # as developed, in sensor orientation
    height: int
    metadata: PhotoMetadata = PhotoMetadata()
    centred: bool = True  # whether it shows all or the middle of its sensor: not what a program has cut
    turned: bool = False  # whether a program has turned its pixels upright: nothing tells which way

    def require_known_turn(self) -> None:
        """Refuse to learn from a photo of which nobody can tell how it lay on the sensor."""
        if self.turned:
            said = "a program has turned its pixels upright, and nothing tells which way"
            raise TurnedPixelsError(f"{said}; give the file as the camera wrote it")


@dataclass(frozen=True, slots=True, eq=False)
class Encoding:
    """How linear planes become a file like the one that they came from."""

    bit_depth: int = 8  # of one sample of the input: 8, 14, 16, 32, ...
    transfer: Transfer = "srgb"  # curve between the file's numbers and linear light; "icc" = those of `icc`
    icc: bytes | None = None  # the input's profile
    metadata: PhotoMetadata = PhotoMetadata()  # what is written into the output
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)  # multipliers that make grey grey; green is 1
    # white-balanced planes to linear sRGB; None: primaries of `icc`, or sRGB
    to_srgb: ArrayLike | None = None
    xyz_to_camera: ArrayLike | None = None  # CIE XYZ (D65) to camera RGB, for DNG output
    baseline_exposure: float | None = None  # stops by which a DNG asks raw converters to brighten it
    opcodes_2: bytes = b""  # what a DNG asks raw converters to do with a linear image of three colours,
    opcodes_3: bytes = b""  # and with the developed one


@dataclass(frozen=True, slots=True, eq=False)
class LinearPhoto:
    """A developed photo: linear light in sensor orientation.

    Parameters
    ----------
    planes : ndarray of float32, shape (3, height, width)
        Black 0, saturation 1, not white balanced; RAW stays in the camera's own colors.
    frame, info, encoding : Frame, PhotoInfo, Encoding
        Size of the planes; what the file says; the way back to a file.
    noise, sensor_noise, coding_noise : tuple of three NoiseModel, the same or None, NoiseModel or None
        Variance of the pixels of each plane; where there is a mosaic, that of the sensor itself in each
        colour: white, unlike that of demosaiced planes; what lossy compression adds where there is detail.
    clip : tuple of three float
        Level of each plane at which the sensor, or the file, clips.
    cfa : BayerPattern or None
        Which pixels of each plane were measured, and not filled in by demosaicing. `None` where
        the planes are no longer on the sensor's grid, or there was no Bayer mosaic.
    grain, chroma_step : tuple of three float, tuple of two int
        How much coarser than white the noise of each plane is (`noise.graininess`); rows and columns of
        pixels that share one value of chroma: (2, 2) in most JPEGs.
    remarks : tuple of str
        What was left out of the file or replaced in it, each a clause about "it".
    """

    planes: Planes
    frame: Frame
    noise: PlaneNoise
    clip: tuple[float, float, float]
    info: PhotoInfo
    encoding: Encoding
    sensor_noise: PlaneNoise | None = None
    coding_noise: NoiseModel | None = None
    cfa: BayerPattern | None = None
    grain: tuple[float, ...] = (1.0, 1.0, 1.0)
    chroma_step: tuple[int, int] = (1, 1)
    remarks: tuple[str, ...] = ()

    @property
    def lossy(self) -> bool:
        """Whether compression made errors of its own, and perhaps a camera sharpened: JPEG and lossy DNG."""
        return self.info.kind == "jpeg" or self.coding_noise is not None

    @property
    def coarse_noise(self) -> PlaneNoise:
        """Noise power of each plane at 0.1 to 0.4 cycles/pixel, above which detail tells of the lens."""
        if self.sensor_noise is not None:
            return self._noise_of(self.sensor_noise, _DEMOSAICED)
        return self._noise_of(self.noise, [min(max(grain, 1.0), _COARSEST_POWER) for grain in self.grain])

    @property
    def correction_noise(self) -> PlaneNoise:
        """Noise of each plane as a correction must count it, as if it were white.

        That of the sensor where it is known; else processing left less of it in a pixel than there is in a
        patch, and where a camera took the fine grain, the coarse one would be sharpened as if it were scene.
        """
        if self.sensor_noise is not None:
            return self.sensor_noise
        coarser = [min(max(grain / _USUAL_GRAIN, 1.0), _COARSEST) for grain in self.grain]
        return self._noise_of(self.noise, [_PROCESSED * factor for factor in coarser])

    def _noise_of(self, base: PlaneNoise, factors: Sequence[float]) -> PlaneNoise:
        """Noise of each plane times a factor, and no less than compression adds."""
        coded = self.coding_noise or NoiseModel(0.0, 0.0)
        return tuple(
            NoiseModel(max(factor * n.shot, coded.shot), max(factor * n.read, coded.read))
            for n, factor in zip(base, factors, strict=True)
        )
