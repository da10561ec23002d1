"""Where a photo was taken is found wherever a file says it, and nothing else is touched."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from lensmodel.photo import tiff
from lensmodel.photo.metadata import find_location

LATITUDE = (47.0, 13.0, 14.159)
SECRET = struct.pack(">II", 14159, 1000), struct.pack("<II", 14159, 1000)
PIXELS = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description exif:GPSLatitude="47,13.236N" '
    b'drone-dji:GpsLongitude = "+11.376" exif:FNumber="14/10"><exif:GPSAltitude>519/1</exif:GPSAltitude>'
    b"</rdf:Description></rdf:RDF></x:xmpmeta>"
)


def with_gps() -> Image.Exif:
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8769)[0x829D] = 1.4
    exif.get_ifd(0x8825).update({1: "N", 2: LATITUDE, 3: "E", 4: (11.0, 22.0, 33.0)})
    return exif


def saved(kind: str, **options: Any) -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(out, kind, **options)
    return out.getvalue()


def cleaned(data: bytes) -> bytes:
    overwrites, complete = find_location(data)
    changed = bytearray(data)
    for start, written in overwrites:
        changed[start : start + len(written)] = written
    assert (len(changed), complete) == (len(data), True)
    return bytes(changed)


def tiff_with_gps() -> bytes:
    """Write a grey TIFF with our own hand: image libraries leave GPS directories out of TIFF files."""
    out = io.BytesIO()
    places = {1: tiff.text("N"), 2: tiff.rationals(*LATITUDE)}
    below = {tiff.EXIF: {0x829D: tiff.rationals(1.4)}, tiff.GPS: places}
    tiff.write_strip(out, {262: tiff.shorts(1), 271: tiff.text("Maker")}, below, PIXELS[:, :, 0])
    return out.getvalue()


FILES = {
    "jpeg": saved("jpeg", exif=with_gps(), quality=95),
    "tiff": tiff_with_gps(),
    "png": saved("png", exif=with_gps()),
}


@pytest.mark.parametrize("kind", FILES)
def test_the_place_goes_and_the_rest_stays(kind: str) -> None:
    data = FILES[kind]
    assert Image.open(io.BytesIO(data)).getexif().get_ifd(0x8825)[2][0] == LATITUDE[0]

    after = cleaned(data)

    assert not any(secret in after for secret in SECRET)
    before, now = Image.open(io.BytesIO(data)), Image.open(io.BytesIO(after))
    assert not now.getexif().get_ifd(0x8825)
    assert now.getexif()[0x010F] == "Maker"
    assert now.getexif().get_ifd(0x8769)[0x829D] == before.getexif().get_ifd(0x8769)[0x829D]
    assert np.array_equal(np.asarray(now), np.asarray(before))
    assert find_location(after) == ([], True)  # nothing is left to find


def test_values_in_xmp_become_blanks_and_other_values_stay() -> None:
    after = cleaned(saved("jpeg", xmp=XMP))

    assert b"47,13" not in after
    assert b"11.376" not in after
    assert b"519/1" not in after
    assert b'exif:FNumber="14/10"' in after
    Image.open(io.BytesIO(after)).load()


def test_the_checksums_of_a_png_are_right_afterwards_and_packed_metadata_are_hidden() -> None:
    info = PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", XMP.decode(), zip=True)
    info.add_text("Raw profile type exif", "\nexif\n 4\n47474747\n", zip=True)
    info.add_text("Title", "stays")

    after = cleaned(saved("png", exif=with_gps(), pnginfo=info))

    at = 8
    names = []
    while at < len(after):
        length, name = struct.unpack(">I4s", after[at : at + 8])
        end = at + 8 + length
        assert zlib.crc32(after[at + 4 : end]) == struct.unpack(">I", after[end : end + 4])[0]
        names.append(name)
        at = end + 4
    assert names.count(b"prVt") == 2
    read = Image.open(io.BytesIO(after))
    assert np.array_equal(np.asarray(read), PIXELS)
    assert read.info["Title"] == "stays"


def test_the_place_in_a_preview_inside_a_raw_file_goes_too() -> None:
    raw = b"FUJIFILMCCD-RAW " + bytes(100) + FILES["jpeg"] + bytes(100)

    after = cleaned(raw)

    assert not any(secret in after for secret in SECRET)


def test_a_gps_box_of_canons_cr3_is_emptied() -> None:
    box = b"CMT4" + tiff.laid_out({1: tiff.text("N"), 2: tiff.rationals(*LATITUDE)}, {})
    data = b"\0\0\0\x18ftypcrx " + bytes(40) + box + bytes(40)
    assert SECRET[1] in data

    after = cleaned(data)

    assert SECRET[1] not in after


def test_photos_that_say_nothing_are_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "plain.tif"
    tifffile.imwrite(path, PIXELS)

    assert find_location(path.read_bytes()) == ([], True)
    assert find_location(saved("jpeg")) == ([], True)


def test_a_file_of_nothing_but_exif_blocks_is_said_to_be_more_than_was_looked_at() -> None:
    assert find_location(b"Exif\0\0II*\0" * 1000)[1] is False


@given(
    kind=st.sampled_from(sorted(FILES)),
    places=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=30),
    length=st.integers(0, 4000),
)
def test_damaged_files_are_searched_without_harm(
    kind: str, places: list[tuple[int, int]], length: int
) -> None:
    damaged = bytearray(FILES[kind])
    for at, value in places:
        damaged[at % len(damaged)] = value
    data = bytes(damaged[: max(len(damaged) - length, 0)])

    overwrites, _ = find_location(data)

    assert all(start >= 0 and start + len(written) <= len(data) for start, written in overwrites)
