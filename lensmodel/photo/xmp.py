"""XMP packets, read and written: camera, lens, settings, maker, rights, rating, and what was done to a photo.

Sources: ISO 16684-1:2019, sections 7 and 8 (packet, `dc`, `xmp`, `xmpMM`); Adobe, "XMP Specification Part 2",
2016 (`aux`); CIPA DC-010-2024 (`exif`, `exifEX`, `tiff`).
"""

from __future__ import annotations

import io
import logging
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final
from xml.etree import ElementTree as ET

from lensmodel.photo.values import SOFTWARE, PhotoMetadata

log = logging.getLogger(__name__)

MAX_XMP_BYTES: Final = 1 << 20  # against files made to fill the memory; real ones are some kilobytes

_SPACES: Final[Mapping[str, str]] = {
    "aux": "http://ns.adobe.com/exif/1.0/aux/",
    "crs": "http://ns.adobe.com/camera-raw-settings/1.0/",
    "dc": "http://purl.org/dc/elements/1.1/",
    "exif": "http://ns.adobe.com/exif/1.0/",
    "exifEX": "http://cipa.jp/exif/1.0/",
    "tiff": "http://ns.adobe.com/tiff/1.0/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "stEvt": "http://ns.adobe.com/xap/1.0/sType/ResourceEvent#",
    "x": "adobe:ns:meta/",
    "xml": "http://www.w3.org/XML/1998/namespace",
    "xmpMM": "http://ns.adobe.com/xap/1.0/mm/",
}
for _prefix, _uri in _SPACES.items():
    ET.register_namespace(_prefix, _uri)  # else they are written as ns0, ns1: legal, and unreadable

_READ: Final = {_SPACES[prefix]: prefix for prefix in ("aux", "crs", "dc", "exif", "exifEX", "tiff", "xmp")}
_LISTS: Final = {"dc:creator", "dc:subject"}
_MOST_OF_A_LIST: Final = 16_384  # characters (chosen): some hundred keywords


def read_xmp(packet: bytes | None) -> Mapping[str, str]:
    """Read the `aux:`, `crs:`, `dc:`, `exif:`, `exifEX:`, `tiff:` and `xmp:` properties of a packet.

    Of a list the first item counts, of the authors and keywords all, one a line.

    A packet that is damaged gives what came before the damage, one with a document type, the door to entity
    expansion, nothing: metadata that cannot be read are unknown, and no reason to refuse the photo.
    """
    if not packet or len(packet) > MAX_XMP_BYTES or b"<!DOCTYPE" in packet.replace(b"\0", b""):
        return {}
    elements, properties = list[ET.Element](), dict[str, str]()
    try:
        for _, element in ET.iterparse(io.BytesIO(packet.strip(b"\0 \r\n")), events=["start"]):  # noqa: S314  no entities: see above
            elements.append(element)  # their texts come later
    except (ET.ParseError, ValueError) as damage:
        log.info("an XMP packet is damaged: %s", damage)
    name = ""
    for element in elements:
        # The items of a list belong to the property around it: <exif:ISO><Seq><li>100.
        name = name if element.tag.startswith("{" + _SPACES["rdf"]) else element.tag
        for qualified, value in [*element.items(), (name, element.text or "")]:
            space, _, local = qualified.removeprefix("{").rpartition("}")
            if not (value := value.strip()[:1024]) or space not in _READ:
                continue
            key = f"{_READ[space]}:{local}"
            if key in _LISTS and key in properties and len(properties[key]) < _MOST_OF_A_LIST:
                properties[key] += f"\n{value}"
            properties.setdefault(key, value)
    return properties


_PACKET: Final = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n{}\n<?xpacket end="r"?>'
_CHARACTERS: Final = str.maketrans(dict.fromkeys((*range(9), 11, 12, *range(14, 32), 0xFFFE, 0xFFFF), " "))
"""What XML has no way to write; cameras put it into names."""

_NONE: Final[Mapping[str, str | None]] = MappingProxyType({})


def xmp_packet(metadata: PhotoMetadata, description: str, lens: str = "") -> bytes:
    """Return a packet, UTF-8; serial numbers, places (GPS) and maker notes stay out."""
    named, taken, rating = lens or metadata.lens.model, metadata.taken_at, metadata.rating
    root = ET.Element(_name("x:xmpmeta"), {_name("x:xmptk"): SOFTWARE})
    whole = _below(
        _below(root, "rdf:RDF"),
        "rdf:Description",
        {
            "rdf:about": "",
            "xmp:CreatorTool": SOFTWARE,
            "xmp:Rating": None if rating is None else str(rating),
            "tiff:Make": metadata.camera_maker,
            "tiff:Model": metadata.camera_model,
            "exifEX:LensMake": metadata.lens.maker,
            "exifEX:LensModel": metadata.lens.model or named,
            "aux:Lens": named,
            "exif:FNumber": _rational(metadata.aperture),
            "exif:FocalLength": _rational(metadata.focal_mm),
            "exif:DateTimeOriginal": None if taken is None else taken.isoformat(),
        },
    )
    done = {"stEvt:action": "filtered", "stEvt:softwareAgent": SOFTWARE, "stEvt:parameters": description}
    default = {"xml:lang": "x-default"}
    for name, kind, items, attributes in (
        ("dc:rights", "rdf:Alt", [metadata.copyright], default),
        ("dc:creator", "rdf:Seq", [metadata.artist], {}),
        ("dc:subject", "rdf:Bag", metadata.keywords, {}),
        ("dc:description", "rdf:Alt", [description], default),
        ("xmpMM:History", "rdf:Seq", [description], done),
    ):
        if any(items):
            container = _below(_below(whole, name), kind)
            for item in items:
                entry = _below(container, "rdf:li", attributes)
                entry.text = None if attributes is done else _plain(item or "")
    ET.indent(root, " ")
    return _PACKET.format(ET.tostring(root, encoding="unicode")).encode()


def _below(parent: ET.Element, name: str, attributes: Mapping[str, str | None] = _NONE) -> ET.Element:
    known = {_name(key): _plain(value) for key, value in attributes.items() if value is not None}
    return ET.SubElement(parent, _name(name), known)


def _rational(value: float | None) -> str | None:
    return None if value is None else f"{round(value * 1000)}/1000"


def _plain(text: str) -> str:
    return text.translate(_CHARACTERS)


def _name(qualified: str) -> str:
    prefix, _, local = qualified.partition(":")
    return f"{{{_SPACES[prefix]}}}{local}"
