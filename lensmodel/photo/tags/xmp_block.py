"""XMP: camera and lens, and what was done to a photo, within its file.

Sources: ISO 16684-1:2019, sections 7 and 8 (packet, `dc`, `xmp`, `xmpMM`); Adobe, "XMP Specification Part 2",
2016 (`aux`); CIPA DC-010-2024 (`exif`, `exifEX`, `tiff`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final
from xml.etree import ElementTree as ET

from lensmodel.photo.tags.exif_block import SOFTWARE
from lensmodel.photo.values import PhotoMetadata

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
