"""XMP packets: the few properties that tell camera, lens and settings.

The packet comes from strangers: a document type declaration, the door to entity expansion, is
refused, and only flat properties are read.

Source: ISO 16684-1:2019, section 7.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final
from xml.parsers import expat

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
