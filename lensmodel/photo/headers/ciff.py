"""CIFF heaps: how the first Canon RAW files (CRW) say what EXIF says elsewhere.

A heap is a block of bytes whose last four tell where its directory begins; a record of the
directory is a value, or a heap of its own. All that is read is bounded, so that no file can make us
loop, recurse or allocate: a damaged directory gives what came before the damage.

The format was published by its maker ("CIFF Specification on Image Data File", version 1.0, 1997);
what the records of shooting conditions hold was not. Their numbers are as published by ExifTool's tag
tables (P. Harvey) and checked against a file of an EOS D30.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from lensmodel.photo.headers.ifd import Buffer

MAGIC: Final = b"HEAPCCDR"
MAGIC_AT: Final = 6  # bytes before it: byte order, and where the root heap begins

MAX_RECORDS: Final = 1024
"""Records read of one file; cameras write below 100."""

MAX_HEAPS: Final = 32
"""Heaps opened in one file; cameras write five."""

MAX_RECORD_BYTES: Final = 4096
"""Bytes read of one record; those that say something of the exposure have fewer than 300."""

# Directories of CIFF 1.0: bytes of a record; of its type code the mark of a value inside the record, the bits
# that say where the value lies, the kinds that are heaps, and the bits of the kind.
_RECORD: Final = 10
_INLINE: Final = 0x4000
_STORAGE: Final = 0xC000
_HEAPS: Final = (0x2800, 0x3000)
_KIND: Final = 0x3800

# Type codes: of CIFF 1.0, and 0x1029 to 0x102D, the maker's own, as ExifTool's tables have them.
_MAKE_MODEL: Final = 0x080A
_FOCAL: Final = 0x1029
_SHOT: Final = 0x102A
_SETTINGS: Final = 0x102D
_SERIAL: Final = 0x180B
_TIME: Final = 0x180E
_IMAGE: Final = 0x1810
_EXPOSURE: Final = 0x1818

_TURNS: Final[Mapping[int, int]] = {0: 1, 90: 6, 180: 3, 270: 8}
"""Clockwise degrees to the EXIF orientation."""

_INCH_UM: Final = 25400.0  # by definition
_THIRDS: Final[Mapping[int, float]] = {0x0C: 32.0 / 3.0, 0x14: 64.0 / 3.0}
"""In steps of a 32nd Canon rounds a third of a stop to 12 and two thirds to 20."""


@dataclass(frozen=True, slots=True)
class CiffShot:
    """What the heap says of camera, lens and exposure; `None` is unknown.

    Nothing is judged here: whether a number can be true is for the caller to say.
    """

    maker: str | None = None
    model: str | None = None
    body_serial: str | None = None
    # the range of the lens in mm, such as "16-35 mm": these files hold no name of it
    lens_model: str | None = None
    aperture: float | None = None
    focal_mm: float | None = None
    focus_m: float | None = None  # geometric mean of the near and far bound
    iso: float | None = None
    exposure_s: float | None = None
    taken_at: datetime | None = None
    orientation: int = 1
    pitch_um: float | None = None  # width of the sensor over that of the picture


def read_ciff(buffer: Buffer) -> CiffShot | None:
    """Read the records of a CRW file."""
    head = bytes(buffer[: MAGIC_AT + len(MAGIC)])
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None or head[MAGIC_AT:] != MAGIC:
        return None
    records = _Records(order, {})
    start = struct.unpack_from(f"{order}I", head, 2)[0]
    for tag, value in _walk(buffer, order, start):
        records.values.setdefault(tag, value)
    return _shot(records)


def _walk(buffer: Buffer, order: str, start: int) -> Iterator[tuple[int, bytes]]:
    """Yield tag and value of every record, heap by heap, nearest to the root first."""
    waiting, opened, read = [(start, len(buffer))], 0, 0
    while waiting and opened < MAX_HEAPS:
        first, end = waiting.pop(0)
        opened += 1
        if not 0 <= first <= end - 4 or end > len(buffer):
            continue
        at = first + struct.unpack_from(f"{order}I", buffer, end - 4)[0]
        if not first <= at <= end - 6:
            continue
        count = struct.unpack_from(f"{order}H", buffer, at)[0]
        for index in range(count):
            entry = at + 2 + index * _RECORD
            if entry + _RECORD > end or read >= MAX_RECORDS:
                break
            read += 1
            tag, size, offset = struct.unpack_from(f"{order}HII", buffer, entry)
            if tag & _STORAGE == _INLINE:
                yield tag & ~_STORAGE, bytes(buffer[entry + 2 : entry + _RECORD])
                continue
            low, high = first + offset, first + offset + size
            if tag & _STORAGE or high > end:
                continue
            if tag & _KIND in _HEAPS:
                waiting.append((low, high))
            elif size <= MAX_RECORD_BYTES:
                yield tag, bytes(buffer[low:high])


@dataclass(frozen=True, slots=True)
class _Records:
    """Values by tag; a number that is not there is `None`."""

    order: str
    values: dict[int, bytes]

    def texts(self, tag: int) -> list[str]:
        parts = [part.decode("latin-1").strip() for part in self.values.get(tag, b"").split(b"\0")]
        return [part if part.isprintable() else "" for part in parts]

    def number(self, tag: int, code: str, index: int) -> float | None:
        size = struct.calcsize("=" + code)
        value = self.values.get(tag, b"")[index * size : (index + 1) * size]
        if len(value) < size:
            return None
        as_float = float(struct.unpack(self.order + code, value)[0])
        return as_float if math.isfinite(as_float) else None


def _shot(records: _Records) -> CiffShot:
    maker, model, *_ = [*records.texts(_MAKE_MODEL), "", ""]
    unit = records.number(_SETTINGS, "H", 25) or 1.0
    return CiffShot(
        maker=maker or None,
        model=model or None,
        body_serial=_serial(records.number(_SERIAL, "I", 0), model),
        lens_model=_range(records.number(_SETTINGS, "H", 24), records.number(_SETTINGS, "H", 23), unit),
        aperture=_aperture(records),
        focal_mm=_over(records.number(_FOCAL, "H", 1), unit),
        focus_m=_focus(records.number(_SHOT, "H", 19), records.number(_SHOT, "H", 20)),
        iso=_iso(records.number(_SHOT, "h", 1), records.number(_SHOT, "h", 2)),
        exposure_s=_exposure(records),
        taken_at=_time(records.number(_TIME, "I", 0)),
        orientation=_TURNS.get(int(records.number(_IMAGE, "i", 3) or 0), 1),
        pitch_um=_pitch(records.number(_FOCAL, "H", 2), records.number(_IMAGE, "I", 0)),
    )


def _over(value: float | None, unit: float) -> float | None:
    return None if not value else value / unit


def _serial(number: float | None, model: str) -> str | None:
    """Write a body's serial as it stands on its underside: the D30 has four digits, a dash and five."""
    if not number:
        return None
    value = int(number)
    return f"{value >> 16:04x}-{value & 0xFFFF:05d}" if model.endswith(" D30") else f"{value:010d}"


def _range(short: float | None, long: float | None, unit: float) -> str | None:
    if not short or not long or short > long:
        return None
    ends = [f"{end / unit:g}" for end in ((short,) if short == long else (short, long))]
    return f"{'-'.join(ends)} mm"


def _stops(value: float | None) -> float | None:
    """Canon's exposure values: 32nds of a stop, thirds rounded; 0 is unknown."""
    if not value:
        return None
    size = abs(int(value))
    part = size & 0x1F
    return math.copysign((size - part + _THIRDS.get(part, part)) / 32.0, value)


def _aperture(records: _Records) -> float | None:
    """f-number N = 2^(A_v / 2): as measured, as aimed at, or of newer cameras."""
    for stops in (
        _stops(records.number(_SHOT, "h", 21)),
        _stops(records.number(_SHOT, "h", 4)),
        records.number(_EXPOSURE, "f", 2),
    ):
        if stops is not None and 0.0 < stops < 14.0:
            return round(2.0 ** (stops / 2.0), 1)
    return None


def _exposure(records: _Records) -> float | None:
    """Seconds t = 2^-T_v."""
    for stops in (_stops(records.number(_SHOT, "h", 22)), records.number(_EXPOSURE, "f", 1)):
        if stops is not None and abs(stops) < 20.0:
            return 2.0**-stops
    return None


def _iso(automatic: float | None, base: float | None) -> float | None:
    """Speed S = (100 / 32) 2^(b / 32) times the automatic gain 2^(a / 32)."""
    if not base or automatic is None or abs(base + automatic) > 1000:
        return None
    return float(round(100.0 / 32.0 * 2.0 ** ((base + automatic) / 32.0)))


def _focus(far_cm: float | None, near_cm: float | None) -> float | None:
    if not near_cm or not far_cm or far_cm < near_cm:
        return None
    return math.inf if far_cm == 0xFFFF else math.sqrt(far_cm * near_cm) / 100.0


def _pitch(width: float | None, pixels: float | None) -> float | None:
    """Pitch from the sensor's width in thousandths of an inch."""
    return None if not width or not pixels else width / 1000.0 * _INCH_UM / pixels


def _time(seconds: float | None) -> datetime | None:
    """Turn the camera's clock, seconds since 1970 in its own zone, into a date without one."""
    return None if not seconds else datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None)
