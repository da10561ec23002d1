"""What a file says about camera, lens and exposure: read from EXIF, maker note and XMP, written, erased.

The order of trust is EXIF, maker note, XMP. The place where a photo was taken is overwritten where it stands,
in TIFF structures wherever they lie and in XMP that is not compressed: no length changes.

Sources: CIPA DC-008-2023 (Exif 3.0), section 4.6; ISO 16684-1:2019 (XMP); Adobe, "XMP Specification Part 2",
2016 (`aux`); CIPA DC-010-2024 (`exif`, `exifEX`, `tiff`); for maker notes, which no maker documents,
ExifTool's tag tables (P. Harvey), checked against files of these cameras.
"""

from __future__ import annotations

import contextlib
import html
import math
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape, quoteattr

from lensmodel.core.errors import TruncatedImageError
from lensmodel.photo import containers
from lensmodel.photo.containers import ASCII, RATIONAL, Buffer, Header, Tag, Tags, TiffReader, Value, Written
from lensmodel.photo.values import SOFTWARE, LensIdentity, Limits, PhotoMetadata, SerialSource

_PLACEHOLDER: Final = re.compile(r"(?i)[0.\-_ x?]*|(.)\1{5,}|none|no lens|n/?a|unknown|null|manual")
_NO_LENS: Final = re.compile(
    r"(?<![\d.])0+(\.0+)?(-0+(\.0+)?)?\s*mm|-{2,}\s*mm"
    r"|\b(no (cpu|lens|data)|not attached|(unknown|manual) lens)\b"
    r"|^\W*(none|n/?a|unknown|null|undefined)\b[\W\d]*$|^\W*lens\W*$|^65535$",
    re.IGNORECASE,
)
"""Focal lengths of zero, and the words in which cameras say that they know no lens."""

# Widths of one inch, Four Thirds, APS-C, APS-H, 24 x 36 and medium format
_SENSORS_MM: Final = ((12.8, 13.4), (17.2, 18.1), (22.0, 24.1), (27.5, 29.0), (35.4, 36.4), (43.0, 54.1))

_FILM_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)
_CROP_FACTORS: Final = (0.5, 15.0)  # from medium format to the smallest phones
_PITCHES_UM: Final = (0.3, 60.0)  # what sensors have, with room on either side


def is_placeholder(serial: str) -> bool:
    """Tell whether a serial is only what a camera writes when it knows none."""
    return _PLACEHOLDER.fullmatch(serial.strip()) is not None


def names_no_lens(model: str) -> bool:
    """Tell whether a lens's name is only what a camera writes when it knows none, such as "DT 0mm F0 SAM"."""
    return is_placeholder(model) or _NO_LENS.search(model) is not None


@dataclass(frozen=True, slots=True)
class Said:
    """What a file says of itself, read once."""

    header: Header
    tags: Tags  # of IFD0 and the EXIF directory together; the latter win
    xmp: Mapping[str, str]
    note: PhotoMetadata  # what the maker note adds to EXIF

    @classmethod
    def of(cls, header: Header) -> Said:
        """Read the directories, the maker note and the XMP packet that a header tells of."""
        tags, note_in = Tags(), None
        for reader in header.tiff:
            main, _ = reader.directory(reader.first)
            if header.directory:  # a preview may stand before the photo
                main.update(reader.directory(header.directory)[0])
            main.update(reader.below(main, containers.EXIF))
            note_in = note_in or (reader if 0x927C in main else None)
            tags = Tags({**main, **tags})
        note = _maker_note(tags.text(0x010F) or "", tags[0x927C], note_in) if note_in else PhotoMetadata()
        return cls(header, tags, read_xmp(header.xmp), note)

    def metadata(self) -> PhotoMetadata:
        """Put it together; what cannot be read is unknown, and of a CRW file LibRaw tells the rest."""
        text, number, xmp, note = self.tags.text, self.tags.number, self.xmp, self.note
        if self.header.camera is not None:
            return PhotoMetadata(self.header.camera[0], self.header.camera[1] or None)
        # The tag has 16 bits; above them cameras say 65535 and use the newer ones.
        speeds = _first_within(1.0, 65534.0, number(0x8827)), number(0x8832), number(0x8831), note.iso
        serials = text(0xA431), text(0xC62F), note.body_serial, xmp.get("aux:SerialNumber")
        stars = _first_within(-1, 5, _quotient(xmp.get("xmp:Rating")), number(0x4746))  # -1 is rejected
        words = xmp.get("dc:subject", "").split("\n")
        return PhotoMetadata(
            camera_maker=text(0x010F) or xmp.get("tiff:Make"),
            camera_model=text(0x0110) or xmp.get("tiff:Model"),
            body_serial=_first(is_placeholder, *serials, xmp.get("exifEX:BodySerialNumber")),
            lens=self._lens(),
            aperture=_first_within(0.5, 128.0, number(0x829D), _quotient(xmp.get("exif:FNumber"))),
            focal_mm=_first_within(0.1, 2e4, number(0x920A), _quotient(xmp.get("exif:FocalLength"))),
            focus_m=self._focus_m(),
            iso=_first_within(1.0, 1e7, *speeds, _quotient(xmp.get("exif:ISOSpeedRatings"))),
            exposure_s=_first_within(1e-7, 1e6, number(0x829A), _quotient(xmp.get("exif:ExposureTime"))),
            taken_at=self._taken_at(),
            orientation=int(_first_within(1.0, 8.0, number(0x0112)) or 1),
            pixel_pitch_um=self.placed()[0],
            artist=text(0x013B) or xmp.get("dc:creator", "").replace("\n", ", ") or None,
            copyright=text(0x8298) or xmp.get("dc:rights"),
            rating=None if stars is None else int(stars),
            keywords=tuple(word for word in words if word and not _OF_PLACE.match(word)),
        )

    @property
    def adobe_rgb(self) -> bool:
        """Whether EXIF declares Adobe RGB, by its ColorSpace or as DCF 2.0 does; what says less is sRGB."""
        space, readers = self.tags.number(0xA001), self.header.tiff
        return space == 2 or (space != 1 and "R03" in [r.below(self.tags, 0xA005).text(1) for r in readers])

    def _taken_at(self) -> datetime | None:
        for tag in (0x9003, 0x9004, 0x0132):
            with contextlib.suppress(ValueError):
                return datetime.strptime((self.tags.text(tag) or "")[:19], "%Y:%m:%d %H:%M:%S")  # noqa: DTZ007  the camera's clock has no zone
        return None

    def _lens(self) -> LensIdentity:
        tags, xmp, noted = self.tags, self.xmp, self.note.lens
        makers = tags.text(0xA433), xmp.get("exifEX:LensMake")
        models = tags.text(0xA434), noted.model, xmp.get("aux:Lens"), xmp.get("exifEX:LensModel")
        declared = tags.text(0xA435)
        # A camera that fills the EXIF tag with zeros has looked and found no serial; what its maker
        # note holds beside it (seen: 1c00000000) is no serial either.
        sources: tuple[tuple[str | None, SerialSource], ...] = (
            (declared, "exif"),
            (None if declared else noted.serial, "makernote"),
            (xmp.get("aux:LensSerialNumber"), "xmp"),
            (xmp.get("exifEX:LensSerialNumber"), "xmp"),
        )
        unknown: tuple[str | None, SerialSource] = None, "none"
        serials = (one for one in sources if one[0] and not is_placeholder(one[0]))
        maker, model = _first(is_placeholder, *makers), _first(names_no_lens, *models)
        return LensIdentity(maker, model, *next(serials, unknown))

    def _focus_m(self) -> float | None:
        # 0xffffffff is EXIF's word for infinity; as a plain number it also stands in XMP.
        infinite = self.tags.raw(0x9206)[:4] == b"\xff\xff\xff\xff"
        subject = math.inf if infinite else self.tags.number(0x9206)
        values = subject, self.note.focus_m, _quotient(self.xmp.get("aux:ApproximateFocusDistance"))
        plain = (math.inf if value is not None and value >= 4294967295 else value for value in values)
        return next((value for value in plain if value is not None and value > 0), None)

    def placed(self) -> tuple[float | None, bool]:
        """Pitch of the pixels in micrometres, and whether they are all of the sensor or its middle.

        Programs that scale a photo down rarely correct the focal plane resolution; then width times pitch is
        the width of no common sensor, and the focal length for 35 mm film tells. A mosaic is only ever cut.
        """
        number, header = self.tags.number, self.header
        zoom = _first_within(1.0, 20.0, number(0xA404)) or 1.0  # of the middle, enlarged: DigitalZoomRatio
        focal, of_film = number(0x920A), number(0xA405)
        crop = _first_within(*_CROP_FACTORS, of_film / focal if focal and of_film else None)
        frame_px = max(math.hypot(header.width, header.height), 1.0)
        film = crop and _first_within(*_PITCHES_UM, 1000.0 * _FILM_DIAGONAL_MM / crop / frame_px)
        # FocalLengthIn35mmFilm above, FocalPlaneXResolution below: CIPA DC-008-2023
        per_unit, unit = number(0xA20E), number(0xA210) or 2.0
        unit_um = {2.0: 25400.0, 3.0: 10000.0, 4.0: 1000.0, 5.0: 1.0}.get(unit, 0.0)
        plane = _first_within(*_PITCHES_UM, unit_um / per_unit if per_unit else None)
        shorter, longer = sorted((header.width, header.height))
        mosaic = header.kind == "raw" or (header.kind == "dng" and header.channels == 1)
        cut = self.xmp.get("crs:HasCrop") == "True"
        # scaled down, a picture keeps the shape of its sensor, 3 : 2 or 4 : 3
        scaled = any(abs(longer / max(shorter, 1) / shape - 1.0) < 0.01 for shape in (1.5, 4.0 / 3.0))
        width_mm = longer * (plane or math.inf) / zoom / 1000.0
        unscaled = (mosaic or cut or not scaled) and width_mm <= _SENSORS_MM[-1][1]
        pitch = plane if unscaled or _is_width_of_sensor(width_mm) else film
        if pitch is None or header.kind in {"raw", "dng"}:
            return pitch and pitch / zoom, True
        whole = film is not None and abs(pitch / zoom / film - 1.0) < 0.05
        uncut = (1.0, 1.5, 4.0 / 3.0) if longer < 1.01 * shorter else (1.0,)  # cameras crop to a square, too
        widths = (times * longer * pitch / zoom / 1000.0 for times in uncut)
        known = whole or zoom > 1.01 or any(map(_is_width_of_sensor, widths))
        return pitch / zoom, known and not cut


def _is_width_of_sensor(width_mm: float) -> bool:
    return any(low <= width_mm <= high for low, high in _SENSORS_MM)


def _quotient(text: str | None) -> float | None:
    """Value of an XMP rational such as "71/10"."""
    over, _, under = (text or "").partition("/")
    try:
        return float(over) / float(under or 1)  # a Fraction would write 1e1000000000 out
    except (ValueError, ZeroDivisionError):
        return None


def _first_within(low: float, high: float, *candidates: float | None) -> float | None:
    return next((c for c in candidates if c is not None and low <= c <= high), None)


def _first(refused: Callable[[str], bool], *candidates: str | None) -> str | None:
    return next((c for c in candidates if c and not refused(c)), None)


# --- maker notes --------------------------------------------------------------------------------


def _maker_note(maker: str, note: Tag, reader: TiffReader) -> PhotoMetadata:
    """Read the maker note of EXIF tag 0x927C by its first bytes, or the maker's name."""
    buffer, start = reader.buffer, note.offset
    head, at = bytes(buffer[start : start + 16]), start - reader.base
    if head.startswith((b"OLYMPUS\0", b"OM SYSTEM\0\0\0")):
        first = 12 if head[:8] == b"OLYMPUS\0" else 16
        order = {b"II": "<", b"MM": ">"}.get(head[first - 4 : first - 2])
        return _olympus(TiffReader(buffer, start, order, first), first) if order else PhotoMetadata()
    if head.startswith(b"Panasonic\0\0\0"):
        tags = reader.directory(at + 12)[0]
        return PhotoMetadata(lens=LensIdentity(model=tags.text(0x0051), serial=tags.text(0x0052)))
    if maker.lower().startswith("canon"):
        return _canon(note, reader)
    inner = head.startswith(b"Nikon\0\x02") and TiffReader.open(buffer, start + 10)
    if inner or (maker.lower().startswith("nikon") and not head.startswith(b"Nikon\0")):
        tags = (inner.directory(inner.first) if inner else reader.directory(at))[0]
        speed = [*tags.numbers(0x0002, 2), 0.0, 0.0][1]
        return PhotoMetadata(body_serial=tags.text(0x001D), iso=speed or None)
    return PhotoMetadata()


def _canon(note: Tag, reader: TiffReader) -> PhotoMetadata:
    # Canon ends its notes with a TIFF header of its own byte order whose offset is the note's original place:
    # a program may have moved the note without rewriting its offsets.
    footer = TiffReader.open(reader.buffer, note.offset + note.size - 8)
    if footer.first:
        reader = TiffReader(reader.buffer, note.offset - footer.first, footer.order, footer.first)
    tags, _ = reader.directory(note.offset - reader.base)
    # Five bytes, of which exiftool prints ten hexadecimal digits; the number is in the last
    # four, and all zero (as "1c00000000") where the lens has none.
    serial, focus_m = tags.raw(0x4019)[:5], None
    for tag, index in ((0x0093, 20), (0x0004, 19)):
        # The far and near bounds of focus in centimetres, of which the geometric mean is taken.
        raw = tags.raw(tag)[2 * index : 2 * index + 4]
        far, near = struct.unpack(tags[tag].order + "HH", raw) if len(raw) == 4 else (0, 0)
        if focus_m is None and far >= near > 0:
            focus_m = math.inf if far == 65535 else math.sqrt(far * near) / 100.0
    known = serial.hex() if len(serial) == 5 and any(serial[1:]) else None
    return PhotoMetadata(lens=LensIdentity(model=tags.text(0x0095), serial=known), focus_m=focus_m)


def _olympus(reader: TiffReader, first: int) -> PhotoMetadata:
    tags, _ = reader.directory(first)
    equipment, focus = reader.below(tags, 0x2010), reader.below(tags, 0x2050)
    # Millimetres over 1 in some models, centimetres over 10 in others: the numerator is in mm.
    millimetres = int.from_bytes(focus.raw(0x0305)[:4], "little" if reader.order == "<" else "big")
    return PhotoMetadata(
        lens=LensIdentity(model=equipment.text(0x0203), serial=equipment.text(0x0202)),
        body_serial=equipment.text(0x0101),
        focus_m=(math.inf if millimetres == 0xFFFFFFFF else millimetres / 1000.0) or None,
    )


# --- XMP ----------------------------------------------------------------------------------------

MAX_XMP_BYTES: Final = 1 << 20  # against files made to cost time; real packets are some kilobytes
_PROPERTY: Final = re.compile(
    rb"(?<=[<\s])((?:aux|crs|dc|exif|exifEX|tiff|xmp):\w{1,40}+)\s{0,99}+"
    rb"(?:=\s{0,99}+\"([^\"<]{0,1024}+)\"|=\s{0,99}+'([^'<]{0,1024}+)'"
    rb"|[^<>=]{0,99}+>(?:\s{0,99}+<rdf:[^<>]{0,200}+>){0,3}([^<]{0,1024}+)<)"
)
"""A property as attribute or element, under the prefix that all programs use: no entities, no recursion."""
MAX_LIST: Final = 1 << 13  # bytes of authors or keywords (chosen: five times as many fit into a JPEG)
_OF_PLACE: Final = re.compile(r"(?i)geo(:|tagged)")  # keywords of machines


def read_xmp(packet: bytes | None) -> Mapping[str, str]:
    """Read the properties of a packet in UTF-8 by prefix and name; of a list the first, or lines."""
    properties = dict[str, str]()
    if packet and len(packet) <= MAX_XMP_BYTES and b"<!DOCTYPE" not in packet:
        for match in _PROPERTY.finditer(packet):
            if value := html.unescape(match[match.lastindex or 0].decode("utf-8", "replace")).strip():
                properties.setdefault(match[1].decode(), value)
        for name in ("dc:creator", "dc:subject"):
            listed = packet.partition(f"<{name}>".encode())[2].partition(f"</{name}>".encode())[0][:MAX_LIST]
            if items := re.findall(r"<rdf:li[^<>]*>([^<]{1,1024})<", listed.decode("utf-8", "replace")):
                properties[name] = "\n".join(" ".join(html.unescape(item).split()) for item in items)
    return properties


_PACKET: Final = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:aux="http://ns.adobe.com/exif/1.0/aux/"
 xmlns:dc="http://purl.org/dc/elements/1.1/"
 xmlns:xmp="http://ns.adobe.com/xap/1.0/" xmlns:xmpMM="http://ns.adobe.com/xap/1.0/mm/"
 xmlns:stEvt="http://ns.adobe.com/xap/1.0/sType/ResourceEvent#" xmp:CreatorTool={software}{lens}>
<xmpMM:History><rdf:Seq>
<rdf:li stEvt:action="filtered" stEvt:softwareAgent={software} stEvt:parameters={done}/>
</rdf:Seq></xmpMM:History><dc:subject><rdf:Bag>{keywords}</rdf:Bag></dc:subject></rdf:Description></rdf:RDF></x:xmpmeta>
<?xpacket end="r"?>"""
_CHARACTERS: Final = str.maketrans(dict.fromkeys((*range(9), 11, 12, *range(14, 32), 0xFFFE, 0xFFFF), " "))
"""What XML has no way to write; cameras put it into names."""


def xmp_packet(metadata: PhotoMetadata, description: str, lens: str = "") -> bytes:
    """Return what EXIF has no tags for, and what was done; `lens` is what its owner calls it."""
    software, named, done = (
        quoteattr((text or "").translate(_CHARACTERS))
        for text in (SOFTWARE, lens or metadata.lens.model, description)
    )
    said = f" aux:Lens={named}" if lens or metadata.lens.model else ""
    said += "" if metadata.rating is None else f' xmp:Rating="{metadata.rating}"'
    words = "".join(f"<rdf:li>{escape(word.translate(_CHARACTERS))}</rdf:li>" for word in metadata.keywords)
    return _PACKET.format(software=software, lens=said, done=done, keywords=words).encode()


# --- as EXIF tags of a written file -------------------------------------------------------------


def written_tags(metadata: PhotoMetadata, description: str = "") -> dict[int, Value | Written]:
    """Tags with those of EXIF: no maker notes, and serials only where the metadata have them.

    Names of people are UTF-8, as most programs read them.
    """
    taken_at = ASCII, f"{metadata.taken_at:%Y:%m:%d %H:%M:%S}" if metadata.taken_at else None
    pitch, iso = metadata.pixel_pitch_um, metadata.iso
    per_cm = RATIONAL, pitch and 10_000.0 / pitch
    exif: dict[int, Value | Written] = {
        0x829A: (RATIONAL, metadata.exposure_s),
        0x829D: (RATIONAL, metadata.aperture),
        0x8827: (containers.SHORT, iso and min(round(iso), 65535)),
        0x9000: (containers.UNDEFINED, b"0232"),  # ExifVersion
        0x9003: taken_at,
        0x9206: (RATIONAL, metadata.focus_m),
        0x920A: (RATIONAL, metadata.focal_mm),
        0xA20E: per_cm,  # FocalPlaneXResolution
        0xA20F: per_cm,
        0xA210: (containers.SHORT, pitch and 3),  # per centimetre
        0xA431: (ASCII, metadata.body_serial),
        0xA433: (ASCII, metadata.lens.maker),
        0xA434: (ASCII, metadata.lens.model),
        0xA435: (ASCII, metadata.lens.serial),
    }
    return {
        0x010E: (ASCII, description),
        0x010F: (ASCII, metadata.camera_maker),
        0x0110: (ASCII, metadata.camera_model),
        0x0112: (containers.SHORT, metadata.orientation),
        0x0131: (ASCII, SOFTWARE),
        0x0132: taken_at,
        0x013B: (ASCII, metadata.artist and metadata.artist.encode() + b"\0"),
        0x8298: (ASCII, metadata.copyright and metadata.copyright.encode() + b"\0"),
        containers.EXIF: exif,
    }


# --- location ---

# Bounds against files made to cost time (chosen): Exif blocks, of which a photo has one and each preview;
# tags of GPS, of which there are 32; bytes of a value, of which honest ones have some dozen; words of XMP.
MAX_BLOCKS, MAX_TAGS, MAX_VALUE, MAX_WORDS = 64, 64, 1 << 16, 1000
MAX_KEPT: Final = 512  # bytes of a value that is kept: all together must fit into the 64 KiB of a JPEG

_BLOCKS: Final = re.compile(rb"Exif\0\0|CMT4")  # before a TIFF structure; the latter in CR3, of GPS alone
_VALUE: Final = rb'(?:\s*=\s*(?:"([^"<>]{0,200})"|\'([^\'<>]{0,200})\')|\s*>([^<>]{0,200})<)'
_XMP_GPS: Final = re.compile(rb":[Gg][Pp][Ss]\w{1,40}" + _VALUE)
"""`exif:GPSLatitude` as attribute or element, and the like that drones write in names of their own."""

_PACKED: Final = re.compile(rb"Raw profile type |XML:com\.adobe\.xmp\x00\x01")
"""How the text of a PNG chunk begins that holds metadata in a form that cannot be searched."""

_MOST_OF_CHUNK: Final = 2 * containers.MAX_BLOCK_BYTES  # bytes of a chunk of a PNG that is searched
_HIDDEN: Final = b"prVt"  # type of a chunk that every reader skips: ancillary, private, safe to copy


def find_location(buffer: Buffer) -> tuple[list[tuple[int, bytes]], bool]:
    """Find where to write which bytes to remove the place of a photo, and whether all of the file was seen.

    Not found: names of places in IPTC blocks and maker notes, and anything inside compressed blocks other
    than those of PNG.
    """
    spans, chunks = list[tuple[int, bytes]](), list[tuple[bytes, int, int]]()
    if buffer[:4] == b"\x89PNG":
        with contextlib.suppress(TruncatedImageError):
            chunks.extend(chunk for chunk in containers.png_chunks(buffer) if chunk[0] != b"IDAT")
    blocks = list(islice(_BLOCKS.finditer(buffer), MAX_BLOCKS + 1))
    places = [(0, False), *((start, False) for name, start, _ in chunks if name == b"eXIf")]
    places += [(block.end(), block[0] == b"CMT4") for block in blocks[:MAX_BLOCKS]]
    for place, is_of_gps in places:
        reader = TiffReader.open(buffer, place)
        # the chain of a structure, and what hangs on it
        directories = reader.walk(containers.SUB_DIRECTORIES, containers.EXIF)
        pointers = (tags.integer(containers.GPS) for _, tags in directories)
        for offset in [reader.first] if is_of_gps else pointers:
            spans += _directory(buffer, reader, offset)
    words = list(islice(_XMP_GPS.finditer(buffer), MAX_WORDS + 1))
    for match in words[:MAX_WORDS]:
        start, end = match.span(match.lastindex or 0)
        spans.append((start, b" " * (end - start)))
    spans = [(at, data) for at, data in spans if bytes(buffer[at : at + len(data)]) != data]
    seen = len(blocks) <= MAX_BLOCKS and len(words) <= MAX_WORDS
    return _with_checksums(buffer, chunks, spans), seen and all(n <= _MOST_OF_CHUNK for *_, n in chunks)


def gps_directory(path: Path) -> dict[int, Value]:
    """Read the GPS directory of a photo, to be written into another file of it; empty without one."""
    values = dict[int, Value]()
    with containers.opened_header(path, Limits()) as header:
        for reader in header.tiff:
            gps = reader.below(reader.directory(reader.first)[0], containers.GPS)
            for tag, entry in gps.items():
                if tag >= MAX_TAGS or entry.size > MAX_KEPT:
                    continue
                numbers = gps.numbers(tag)  # of texts none
                if all(abs(number) < 2**31 for number in numbers):  # and not NaN
                    values.setdefault(tag, (entry.kind, numbers or gps.raw(tag)))
    return values


def _directory(buffer: Buffer, reader: TiffReader, offset: int) -> Iterator[tuple[int, bytes]]:
    """Yield what empties a GPS directory: its values that lie elsewhere, then its tags."""
    tags, _ = reader.directory(offset)
    start = reader.base + offset
    head = bytes(buffer[start : start + 2]) if tags else b""
    count = int.from_bytes(head, "little" if reader.order == "<" else "big")
    end = start + 2 + count * containers.ENTRY
    if not 0 < count <= MAX_TAGS or end > len(buffer):
        return
    for number, entry in tags.items():
        if not start <= entry.offset < end and 0 < entry.size <= MAX_VALUE and tags.raw(number):
            yield entry.offset, bytes(entry.size)
    yield start, bytes(end - start)


def _with_checksums(
    buffer: Buffer, chunks: Iterable[tuple[bytes, int, int]], spans: list[tuple[int, bytes]]
) -> list[tuple[int, bytes]]:
    """Renew the checksums of a PNG's chunks that change; hide those whose metadata cannot be searched."""
    renewed = list(spans)
    for name, start, length in chunks:
        if length > _MOST_OF_CHUNK:
            continue
        chunk = bytearray(buffer[start - 4 : start + length])
        inside = [(at - start + 4, data) for at, data in spans if start <= at < start + length]
        if name in {b"tEXt", b"zTXt", b"iTXt"} and _PACKED.match(chunk, 4):
            inside = [(0, _HIDDEN + bytes(length))]
            renewed.append((start - 4, inside[0][1]))
        for at, data in inside:
            chunk[at : at + len(data)] = data
        if inside:
            renewed.append((start + length, struct.pack(">I", zlib.crc32(chunk[: length + 4]))))
    return renewed
