"""XMP packets, read and written: camera, lens, settings, maker, rights, rating, and what was done to a photo.

What is read comes from strangers: a document type declaration, the door to entity expansion, is refused, and
only flat properties are read.

Sources: ISO 16684-1:2019, sections 7 and 8 (packet, `dc`, `xmp`, `xmpMM`); Adobe, "XMP Specification Part 2",
2016 (`aux`); CIPA DC-010-2024 (`exif`, `exifEX`, `tiff`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final
from xml.etree import ElementTree as ET
from xml.parsers import expat

from lensmodel.photo.tags.exif_block import SOFTWARE
from lensmodel.photo.values import PhotoMetadata

log = logging.getLogger(__name__)

MAX_XMP_BYTES: Final = 1 << 20  # against files made to fill the memory; real ones are some kilobytes
MAX_ELEMENTS: Final = 20_000  # the same; real ones have some hundred

_PREFIXES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "http://ns.adobe.com/exif/1.0/aux/": "aux",
        "http://ns.adobe.com/exif/1.0/": "exif",
        "http://cipa.jp/exif/1.0/": "exifEX",
        "http://ns.adobe.com/tiff/1.0/": "tiff",
        "http://ns.adobe.com/xap/1.0/": "xmp",
        "http://ns.adobe.com/camera-raw-settings/1.0/": "crs",
        "http://purl.org/dc/elements/1.1/": "dc",
    }
)


_LISTS: Final = {"dc:creator", "dc:subject"}
_MOST_OF_A_LIST: Final = 16_384  # characters (chosen): some hundred keywords


class _RefusedPacketError(Exception):
    """The packet has what no honest one has."""


class _Collector:
    """Gathers `prefix:name` -> text, from attributes and from elements without children."""

    def __init__(self) -> None:
        self.properties: dict[str, str] = {}
        self.elements = 0
        self.name: str | None = None
        self.text = ""

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self.elements += 1
        if self.elements > MAX_ELEMENTS:
            raise _RefusedPacketError("too many elements")
        for key, value in attributes.items():
            self._keep(key, value)
        # The items of a list belong to the property around it: <exif:ISO><Seq><li>100.
        if not name.startswith("http://www.w3.org/1999/02/22-rdf-syntax-ns#"):
            self.name = name
        self.text = ""

    def data(self, text: str) -> None:
        if len(self.text) < 1024:
            self.text += text

    def end(self, _name: str) -> None:
        if self.name is not None and self.text.strip():
            self._keep(self.name, self.text)
        self.text = ""

    def _keep(self, qualified: str, value: str) -> None:
        space, _, local = qualified.rpartition("|")
        if space in _PREFIXES and value.strip():
            name, text = f"{_PREFIXES[space]}:{local}", value.strip()[:1024]
            if name in _LISTS and name in self.properties and len(self.properties[name]) < _MOST_OF_A_LIST:
                self.properties[name] += f"\n{text}"
            self.properties.setdefault(name, text)

    def refuse(self, *_: object) -> None:
        raise _RefusedPacketError("a document type declaration")


def read_xmp(packet: bytes | None) -> Mapping[str, str]:
    """Read the `aux:`, `crs:`, `dc:`, `exif:`, `exifEX:`, `tiff:` and `xmp:` properties of a packet.

    Of a list the first item counts, of the authors and keywords all, one a line.

    A packet that is damaged gives what came before the damage, a refused one nothing:
    metadata that cannot be read are unknown, and no reason to refuse the photo.
    """
    if not packet or len(packet) > MAX_XMP_BYTES:
        return {}
    collector, parser = _Collector(), expat.ParserCreate(namespace_separator="|")
    parser.StartElementHandler = collector.start
    parser.EndElementHandler = collector.end
    parser.CharacterDataHandler = collector.data
    parser.StartDoctypeDeclHandler = collector.refuse
    parser.EntityDeclHandler = collector.refuse
    try:
        parser.Parse(packet.strip(b"\0 \r\n"), True)
    except _RefusedPacketError as reason:
        log.warning("an XMP packet was refused: %s", reason)
        return {}
    except (expat.ExpatError, ValueError) as damage:
        log.info("an XMP packet is damaged: %s", damage)
    return MappingProxyType(collector.properties)


_SPACES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "x": "adobe:ns:meta/",
        "xml": "http://www.w3.org/XML/1998/namespace",
        "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
        "dc": "http://purl.org/dc/elements/1.1/",
        "xmp": "http://ns.adobe.com/xap/1.0/",
        "xmpMM": "http://ns.adobe.com/xap/1.0/mm/",
        "stEvt": "http://ns.adobe.com/xap/1.0/sType/ResourceEvent#",
        "tiff": "http://ns.adobe.com/tiff/1.0/",
        "exif": "http://ns.adobe.com/exif/1.0/",
        "exifEX": "http://cipa.jp/exif/1.0/",
        "aux": "http://ns.adobe.com/exif/1.0/aux/",
    }
)
for _prefix, _uri in _SPACES.items():
    ET.register_namespace(_prefix, _uri)  # else they are written as ns0, ns1: legal, and unreadable

_PACKET: Final = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n{}\n<?xpacket end="r"?>'
_CHARACTERS: Final = str.maketrans(dict.fromkeys((*range(9), 11, 12, *range(14, 32), 0xFFFE, 0xFFFF), " "))
"""What XML has no way to write; cameras put it into names."""


def xmp_packet(metadata: PhotoMetadata, description: str, lens: str = "") -> bytes:
    """Return a packet, UTF-8; serial numbers, places (GPS) and maker notes stay out."""
    root = ET.Element(_name("x:xmpmeta"), {_name("x:xmptk"): SOFTWARE})
    whole = ET.SubElement(ET.SubElement(root, _name("rdf:RDF")), _name("rdf:Description"))
    whole.set(_name("rdf:about"), "")
    for key, value in _taken(metadata, lens).items():
        whole.set(_name(key), _plain(value))
    _list(whole, "dc:rights", "rdf:Alt", [metadata.copyright] if metadata.copyright else [])
    _list(whole, "dc:creator", "rdf:Seq", [metadata.artist] if metadata.artist else [])
    _list(whole, "dc:subject", "rdf:Bag", metadata.keywords)
    _list(whole, "dc:description", "rdf:Alt", [description] if description else [])
    if description:
        steps = ET.SubElement(ET.SubElement(whole, _name("xmpMM:History")), _name("rdf:Seq"))
        step = ET.SubElement(steps, _name("rdf:li"))
        step.set(_name("stEvt:action"), "filtered")
        step.set(_name("stEvt:softwareAgent"), SOFTWARE)
        step.set(_name("stEvt:parameters"), _plain(description))
    ET.indent(root, " ")
    return _PACKET.format(ET.tostring(root, encoding="unicode")).encode()


def _list(whole: ET.Element, name: str, kind: str, items: Sequence[str]) -> None:
    if not items:
        return
    container = ET.SubElement(ET.SubElement(whole, _name(name)), _name(kind))
    for item in items:
        entry = ET.SubElement(container, _name("rdf:li"))
        if kind == "rdf:Alt":
            entry.set(_name("xml:lang"), "x-default")
        entry.text = _plain(item)


def _taken(metadata: PhotoMetadata, lens: str) -> dict[str, str]:
    named = lens or metadata.lens.model
    values = {
        "xmp:CreatorTool": SOFTWARE,
        "xmp:Rating": None if metadata.rating is None else str(metadata.rating),
        "tiff:Make": metadata.camera_maker,
        "tiff:Model": metadata.camera_model,
        "exifEX:LensMake": metadata.lens.maker,
        "exifEX:LensModel": metadata.lens.model or named,
        "aux:Lens": named,
        "exif:FNumber": _rational(metadata.aperture),
        "exif:FocalLength": _rational(metadata.focal_mm),
        "exif:DateTimeOriginal": None if metadata.taken_at is None else metadata.taken_at.isoformat(),
    }
    return {name: value for name, value in values.items() if value}


def _rational(value: float | None) -> str | None:
    return None if value is None else f"{round(value * 1000)}/1000"


def _plain(text: str) -> str:
    return text.translate(_CHARACTERS)


def _name(qualified: str) -> str:
    prefix, _, local = qualified.partition(":")
    return f"{{{_SPACES[prefix]}}}{local}"
