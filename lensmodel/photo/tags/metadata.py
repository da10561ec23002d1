"""What the file says about camera, lens and exposure, from EXIF, maker note and XMP.

CRW files, which are older than all three, name their camera here; LibRaw tells the rest.

The order of trust is EXIF, maker note, XMP. A serial that the camera fills in without knowing
one is no serial, and an f-number or focal length of zero is unknown: manual lenses say so.

Source: CIPA DC-008-2023 (Exif 3.0), section 4.6.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from lensmodel.photo.colour import profile_by_tags
from lensmodel.photo.headers.header import Header
from lensmodel.photo.headers.ifd import Directory, IfdEntry
from lensmodel.photo.headers.opening import opened_header
from lensmodel.photo.tags.makernote import MakerNote, read_maker_note
from lensmodel.photo.tags.xmp import read_xmp
from lensmodel.photo.values import LensIdentity, Limits, PhotoMetadata, SerialSource

_PLACEHOLDER: Final = re.compile(
    r"[0.\-_ x?]*|(.)\1{5,}|none|no lens|n/?a|unknown|null|manual", re.IGNORECASE
)
_NO_LENS: Final = re.compile(
    r"(?<![\d.])0+(\.0+)?(-0+(\.0+)?)?\s*mm|-{2,}\s*mm"
    r"|\b(no (cpu|lens|data)|not attached|(unknown|manual) lens)\b"
    r"|^\W*(none|n/?a|unknown|null|undefined)\b[\W\d]*$|^\W*lens\W*$|^65535$",
    re.IGNORECASE,
)
"""Focal lengths of zero, and the words in which cameras say that they know no lens."""

_SENSOR_WIDTHS_MM: Final = (
    (12.8, 13.4),
    (17.2, 18.1),
    (22.0, 24.1),
    (27.5, 29.0),
    (35.4, 36.4),
    (43.0, 54.1),
)
"""One inch, Four Thirds, APS-C, APS-H, 24 x 36 and medium format."""

_LARGEST_SENSOR_MM: Final = max(high for _, high in _SENSOR_WIDTHS_MM)
_FILM_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)  # 36 x 24 mm
_CROP_FACTORS: Final = (0.5, 15.0)  # from medium format to the smallest phones
_PITCHES_UM: Final = (0.3, 60.0)  # micrometres: what sensors have, with room on either side
_APERTURES: Final = (0.5, 128.0)  # what lenses have, with room on either side
_FOCALS_MM: Final = (0.1, 20000.0)  # the same
_SPEEDS: Final = (1.0, 1e7)  # the same
_EXPOSURES_S: Final = (1e-7, 1e6)  # the same, seconds


def read_metadata(path: Path | str) -> PhotoMetadata:
    """Read what a photo file says, without decoding it.

    Unreadable metadata are unknown metadata; only a file that is no photo raises.
    """
    with opened_header(Path(path), Limits()) as header:
        return metadata_of(header)


def is_placeholder(serial: str) -> bool:
    """Tell whether a serial is only what a camera writes when it knows none."""
    return _PLACEHOLDER.fullmatch(serial.strip()) is not None


def is_centred(header: Header, metadata: PhotoMetadata) -> bool:
    """Tell whether a picture shows its whole sensor or the middle of it, not what a program cut.

    Cameras leave widths of common sensors (DX, APS-C, 16:9), a square of the full height, or a digital zoom.
    """
    pitch = metadata.pixel_pitch_um
    if header.kind in {"raw", "dng"} or pitch is None:
        return True
    if read_xmp(header.xmp).get("crs:HasCrop") == "True":
        return False
    width_mm = max(header.width, header.height) * pitch / 1000.0
    exif = _Exif.of(header)
    film = exif.film_pitch_um(math.hypot(header.width, header.height))
    whole = film is not None and abs(pitch / film - 1.0) < 0.05
    square = abs(header.width / header.height - 1.0) < 0.01
    widths = [width_mm, *((width_mm * 3.0 / 2.0, width_mm * 4.0 / 3.0) if square else ())]
    common = any(low <= width <= high for low, high in _SENSOR_WIDTHS_MM for width in widths)
    return whole or common or exif.zoom() > 1.01


def names_no_lens(model: str) -> bool:
    """Tell whether a lens's name is only what a camera writes when it knows none, such as "DT 0mm F0 SAM"."""
    return is_placeholder(model) or _NO_LENS.search(model) is not None


def metadata_of(header: Header) -> PhotoMetadata:
    """Put together what a parsed header holds; see `read_metadata`."""
    if header.camera is not None:
        return PhotoMetadata(header.camera[0], header.camera[1] or None)
    exif = _Exif.of(header)
    xmp = read_xmp(header.xmp)
    note = (
        read_maker_note(exif.text(0x010F) or "", exif.tags.get(0x927C), header.tiff[exif.block])
        if header.tiff
        else MakerNote()
    )
    return PhotoMetadata(
        camera_maker=exif.text(0x010F) or xmp.get("tiff:Make"),
        camera_model=exif.text(0x0110) or xmp.get("tiff:Model"),
        body_serial=_body_serial(exif, note, xmp),
        lens=_lens(exif, note, xmp),
        aperture=_first_within(*_APERTURES, exif.aperture(), _quotient(xmp.get("exif:FNumber"))),
        focal_mm=_first_within(*_FOCALS_MM, exif.number(0x920A), _quotient(xmp.get("exif:FocalLength"))),
        focus_m=_focus(exif, note, xmp),
        iso=_first_within(*_SPEEDS, exif.iso(), note.iso, _quotient(xmp.get("exif:ISOSpeedRatings"))),
        exposure_s=_first_within(*_EXPOSURES_S, exif.number(0x829A), _quotient(xmp.get("exif:ExposureTime"))),
        taken_at=exif.taken_at(),
        orientation=exif.orientation(),
        pixel_pitch_um=exif.pixel_pitch_um(header, cut=xmp.get("crs:HasCrop") == "True"),
        artist=exif.text(0x013B) or ", ".join(_lines(xmp.get("dc:creator"))) or exif.wide_text(0x9C9D),
        copyright=exif.text(0x8298) or xmp.get("dc:rights"),
        rating=_rating(xmp.get("xmp:Rating"), exif.number(0x4746)),
        keywords=tuple(_lines(xmp.get("dc:subject")) or _lines(exif.wide_text(0x9C9E), ";")),
    )


def _lines(text: str | None, separator: str = "\n") -> list[str]:
    return [word for part in (text or "").split(separator) if (word := part.strip())]


def _rating(said: str | None, tag: float | None) -> int | None:
    """Stars by XMP, where -1 is rejected, else by the tag that Windows writes."""
    stars = tag if (of_xmp := _quotient(said)) is None else of_xmp
    return int(stars) if stars is not None and -1 <= stars <= 5 else None


def baseline_exposure_of(header: Header) -> float | None:
    """Stops by which a DNG asks to be brightened (tag 50730), None where it does not say or is absurd."""
    return _first_within(-10.0, 10.0, _Exif.of(header).number(0xC62A))


def declared_by_tags(header: Header) -> bytes | None:
    """Profile of the colour space that a TIFF or JPEG declares by its tags; None is sRGB."""
    exif = _Exif.of(header)
    interoperability = [
        entry.text()
        for reader in header.tiff
        if (entry := reader.below(exif.tags.get(0xA005)).get(1)) is not None
    ]

    def numbers(tag: int) -> tuple[float, ...]:
        entry = exif.tags.get(tag)
        return () if entry is None else entry.numbers()

    space = exif.number(0xA001)
    return profile_by_tags(
        None if space is None else int(space),
        next(iter(interoperability), None),
        numbers(318),
        numbers(319),
        exif.number(0xA500),
        numbers(301),
    )


@dataclass(frozen=True, slots=True)
class _Exif:
    """The tags of IFD0 and the EXIF directory together; the latter win."""

    tags: Directory
    block: int = 0

    @classmethod
    def of(cls, header: Header) -> _Exif:
        tags: dict[int, IfdEntry] = {}
        block = 0
        for index, reader in enumerate(header.tiff):
            main, _ = reader.directory(reader.first)
            if header.directory:  # a preview may stand before the photo
                main |= reader.directory(header.directory)[0]
            directory = {**main, **reader.below(main.get(0x8769))}
            if 0x927C in directory:
                block = index
            tags = {**directory, **tags}
        return cls(tags, block)

    def text(self, tag: int) -> str | None:
        entry = self.tags.get(tag)
        return None if entry is None else entry.text() or None

    def wide_text(self, tag: int) -> str | None:
        """Text in two bytes a sign, as Windows writes it."""
        entry = self.tags.get(tag)
        return None if entry is None else entry.raw().decode("utf-16-le", "replace").strip("\0 ") or None

    def number(self, tag: int) -> float | None:
        entry = self.tags.get(tag)
        return None if entry is None else entry.number()

    def aperture(self) -> float | None:
        """FNumber, else the APEX value A_v of tag 0x9202: N = 2^(A_v / 2)."""
        direct, apex = self.number(0x829D), self.number(0x9202)
        if direct or apex is None or not 0 < apex < 14:
            return direct
        return round(2.0 ** (apex / 2.0), 1)

    def iso(self) -> float | None:
        speed = self.number(0x8827)
        # The tag has 16 bits; above them cameras say 65535 and use the newer ones.
        return speed if speed and speed < 65535 else self.number(0x8832) or self.number(0x8831) or speed

    def orientation(self) -> int:
        value = self.number(0x0112)
        return int(value) if value is not None and 1 <= value <= 8 else 1

    def taken_at(self) -> datetime | None:
        for tag in (0x9003, 0x9004, 0x0132):
            try:
                return datetime.strptime((self.text(tag) or "")[:19], "%Y:%m:%d %H:%M:%S")  # noqa: DTZ007  the camera's clock has no zone
            except ValueError:
                continue
        return None

    def zoom(self) -> float:
        """How much of the picture is enlarged from the middle of the sensor: DigitalZoomRatio."""
        return _first_within(1.0, 20.0, self.number(0xA404)) or 1.0

    def pixel_pitch_um(self, header: Header, *, cut: bool = False) -> float | None:
        """Pitch from the focal plane resolution, else from the focal length for 35 mm film.

        Programs that scale a photo down rarely correct the former; then width times pitch is the
        width of no common sensor, and it says nothing. A mosaic was never scaled, only cut.

        Source: CIPA DC-008-2023, tags FocalPlaneXResolution and FocalLengthIn35mmFilm.
        """
        pitch = _first_within(*_PITCHES_UM, self._focal_plane_pitch_um())
        if pitch is not None:
            pitch /= self.zoom()
            width_mm = max(header.width, header.height) * pitch / 1000.0
            mosaic = header.kind == "raw" or (header.kind == "dng" and header.channels == 1)
            if mosaic and width_mm <= _LARGEST_SENSOR_MM:
                return pitch
            if any(low <= width_mm <= high for low, high in _SENSOR_WIDTHS_MM):
                return pitch
            whole = _is_shape_of_sensor(header.width, header.height)
            if width_mm <= _LARGEST_SENSOR_MM and not mosaic and (cut or not whole):
                return pitch  # cut by a program, which left the pixels as they were
        film = self.film_pitch_um(math.hypot(header.width, header.height))
        return None if film is None else film / self.zoom()

    def _focal_plane_pitch_um(self) -> float | None:
        per_unit, unit = self.number(0xA20E), self.number(0xA210) or 2.0
        unit_um = {2.0: 25400.0, 3.0: 10000.0, 4.0: 1000.0, 5.0: 1.0}.get(unit)
        return None if not per_unit or per_unit <= 0 or unit_um is None else unit_um / per_unit

    def film_pitch_um(self, diagonal_px: float) -> float | None:
        """Pitch of a frame whose diagonal is that of 35 mm film over the crop factor."""
        focal, film = self.number(0x920A), self.number(0xA405)
        if not focal or not film or focal <= 0 or film <= 0 or diagonal_px <= 0:
            return None
        crop = _first_within(*_CROP_FACTORS, film / focal)
        if crop is None:
            return None
        return _first_within(*_PITCHES_UM, 1000.0 * _FILM_DIAGONAL_MM / crop / diagonal_px)


def _is_shape_of_sensor(width: int, height: int) -> bool:
    """Whether a picture has the shape of a sensor, 3 : 2 or 4 : 3: scaled down, it keeps it."""
    shape = max(width, height) / max(min(width, height), 1)
    return any(abs(shape / whole - 1.0) < 0.01 for whole in (3.0 / 2.0, 4.0 / 3.0))


def _lens(exif: _Exif, note: MakerNote, xmp: Mapping[str, str]) -> LensIdentity:
    models = exif.text(0xA434), note.lens_model, xmp.get("aux:Lens"), xmp.get("exifEX:LensModel")
    model = next((name for name in models if name and not names_no_lens(name)), None)
    makers = exif.text(0xA433), xmp.get("exifEX:LensMake")
    maker = next((name for name in makers if name and not is_placeholder(name)), None)
    serial, source = _serial(exif, note, xmp)
    return LensIdentity(maker, model, serial, source)


def _serial(exif: _Exif, note: MakerNote, xmp: Mapping[str, str]) -> tuple[str | None, SerialSource]:
    declared = exif.text(0xA435)
    if declared and not is_placeholder(declared):
        return declared, "exif"
    # A camera that fills the EXIF tag with zeros has looked and found no serial; what its maker
    # note holds beside it (seen: 1c00000000) is no serial either.
    if not declared and note.lens_serial and not is_placeholder(note.lens_serial):
        return note.lens_serial, "makernote"
    for name in ("aux:LensSerialNumber", "exifEX:LensSerialNumber"):
        value = xmp.get(name, "")
        if not is_placeholder(value):
            return value, "xmp"
    return None, "none"


def _body_serial(exif: _Exif, note: MakerNote, xmp: Mapping[str, str]) -> str | None:
    candidates = (
        exif.text(0xA431),
        exif.text(0xC62F),
        note.body_serial,
        xmp.get("aux:SerialNumber"),
        xmp.get("exifEX:BodySerialNumber"),
    )
    return next((c for c in candidates if c and not is_placeholder(c)), None)


def _focus(exif: _Exif, note: MakerNote, xmp: Mapping[str, str]) -> float | None:
    # 0xffffffff is EXIF's word for infinity; as a plain number it also stands in XMP.
    subject = exif.tags.get(0x9206)
    values = [
        math.inf if subject is not None and subject.raw()[:4] == b"\xff\xff\xff\xff" else exif.number(0x9206),
        note.focus_m,
        _quotient(xmp.get("aux:ApproximateFocusDistance")),
    ]
    plain = [math.inf if v is not None and v >= 4294967295 else v for v in values]
    return next((v for v in plain if v is not None and v > 0), None)


def _quotient(text: str | None) -> float | None:
    """Value of an XMP rational such as "71/10"."""
    if text is None:
        return None
    over, _, under = text.partition("/")
    try:
        return float(over) / float(under or 1)  # a Fraction would write 1e1000000000 out
    except (ValueError, ZeroDivisionError):
        return None


def _first_within(low: float, high: float, *candidates: float | None) -> float | None:
    return next((c for c in candidates if c is not None and low <= c <= high), None)
