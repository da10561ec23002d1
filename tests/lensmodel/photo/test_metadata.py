"""What files say is read; where a photo was taken is found, and nothing else is touched."""

from __future__ import annotations

import csv
import io
import math
import struct
import time
import tracemalloc
import zlib
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin
from PIL.TiffImagePlugin import IFDRational

from lensmodel import photo
from lensmodel.core.errors import TruncatedImageError
from lensmodel.photo import containers
from lensmodel.photo.containers import opened_header
from lensmodel.photo.development import opened_raw
from lensmodel.photo.metadata import Said, find_location, is_placeholder, read_xmp, xmp_packet
from lensmodel.photo.writing import write_bayer_dng

# Lens names that EXPECTED.tsv gives from ExifTool's own tables, not from text in the file.
_LOOKED_UP = {"61182", "Unknown (00 77 48 5C 80 24 24 0E)"}
Read = Callable[[bytes], photo.PhotoMetadata]


def read_metadata(path: Path) -> photo.PhotoMetadata:
    """What the header says, also of a file that holds no picture."""
    with opened_header(path, photo.Limits()) as header:
        return Said.of(header).metadata()


def jpeg_with(
    main: dict[int, object] | None = None, exif: dict[int, object] | None = None, xmp: str = ""
) -> bytes:
    """JPEG of 64 x 48 pixels whose EXIF was written by Pillow, not by us."""
    block = Image.Exif()
    for tag, value in (main or {}).items():
        block[tag] = value
    block.get_ifd(0x8769).update(exif or {})
    out = io.BytesIO()
    Image.new("RGB", (64, 48), "grey").save(out, "JPEG", exif=block, xmp=xmp.encode())
    return out.getvalue()


def xmp_with(properties: str, head: str = "") -> str:
    return (
        f'{head}<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:aux="http://ns.adobe.com/exif/1.0/aux/" '
        'xmlns:exif="http://ns.adobe.com/exif/1.0/" '
        f'xmlns:exifEX="http://cipa.jp/exif/1.0/" {properties}/></rdf:RDF></x:xmpmeta>'
    )


@pytest.fixture
def metadata_of(tmp_path: Path) -> Read:
    def read(data: bytes) -> photo.PhotoMetadata:
        path = tmp_path / "photo.jpg"
        path.write_bytes(data)
        return read_metadata(path)

    return read


@pytest.mark.parametrize(
    ("main", "exif", "known"),
    [
        ({}, {}, {}),
        ({}, {0x829D: IFDRational(0, 1), 0x920A: IFDRational(0, 1), 0x8827: 0}, {}),
        ({}, {0x829D: IFDRational(28, 0)}, {}),
        ({}, {0x9206: IFDRational(0xFFFFFFFF, 1)}, {"focus_m": math.inf}),
        ({0x0112: 77}, {}, {}),
    ],
    ids=str,
)
def test_values_that_say_nothing_are_unknown_and_others_stand_in(
    main: dict[int, object], exif: dict[int, object], known: dict[str, object], metadata_of: Read
) -> None:
    assert metadata_of(jpeg_with(main, exif)) == photo.PhotoMetadata(**known)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("placeholder", "serials"),
    [
        (True, "0000000000|0||  |----|No Lens|n/a|NONE|1111111"),
        (False, "00009f8eeb|AC1205545|100000|0000129324|7|N123456"),
    ],
)
def test_a_placeholder_is_no_serial_but_zeros_may_be_in_one(placeholder: bool, serials: str) -> None:
    assert {is_placeholder(serial) for serial in serials.split("|")} == {placeholder}


def olympus_note(serial: bytes) -> bytes:
    equipment = struct.pack("<HHHII", 1, 0x0202, 2, len(serial), 30 + 18) + bytes(4) + serial
    return b"OLYMPUS\0II\x03\0" + struct.pack("<HHHII", 1, 0x2010, 13, 1, 30) + bytes(4) + equipment


def moved(serial: str) -> dict[int, object]:
    """A Canon note with a lens serial; a program moved it without rewriting its offsets."""
    at, value = 2 + 12 + 4, bytes.fromhex(serial) + b"\0"
    entry = struct.pack("<HHII", 0x4019, 7, 5, at + 5000) + bytes(4)
    return {0x927C: struct.pack("<H", 1) + entry + value + b"II*\0" + struct.pack("<I", 5000)}


SERIALS: dict[str, tuple[str, dict[int, object], str, str | None, str]] = {
    "EXIF before XMP": ("", {0xA435: "EX1"}, 'aux:LensSerialNumber="XM2"', "EX1", "exif"),
    "XMP alone": ("", {}, 'exifEX:LensSerialNumber="XM2"', "XM2", "xmp"),
    "a note that a program moved": ("Canon", moved("00009f8eeb"), "", "00009f8eeb", "makernote"),
    "zeros in EXIF before a note": ("Canon", moved("1c00009f00") | {0xA435: "0000000000"}, "", None, "none"),
    "zeros after the first byte": ("Canon", moved("1c00000000"), "", None, "none"),
    "Olympus": ("OLYMPUS", {0x927C: olympus_note(b"AC1205545\0")}, "", "AC1205545", "makernote"),
}


@pytest.mark.parametrize("case", SERIALS)
def test_the_serial_of_the_lens_is_where_it_is_to_be_believed(case: str, metadata_of: Read) -> None:
    maker, exif, xmp, serial, source = SERIALS[case]

    lens = metadata_of(jpeg_with({0x010F: maker} if maker else {}, exif, xmp_with(xmp))).lens

    assert (lens.serial, lens.serial_source) == (serial, source)


NO_NAMES = (
    "----|None|n/a|0.0 mm f/0.0|Manual Lens No CPU|DT 0mm F0 SAM|0-0mm f/0-0|--- mm f/--|E 0mm F0|  |"
    "Unknown (0)|(none)|Unknown lens|Lens not attached|65535"
)


@pytest.mark.parametrize("name", NO_NAMES.split("|"))
def test_a_placeholder_is_no_name_of_a_lens_and_the_next_place_is_asked(name: str, metadata_of: Read) -> None:
    seen = metadata_of(jpeg_with({}, {0xA434: name}))
    other = metadata_of(jpeg_with({}, {0xA434: name, 0xA433: "----"}, xmp_with('aux:Lens="EF50mm f/1.8"')))

    assert seen.lens == photo.LensIdentity()
    assert (other.lens.maker, other.lens.model) == (None, "EF50mm f/1.8")


@pytest.mark.parametrize(
    "name",
    ["EF50mm f/1.8", "10.0 mm f/2.8", "E 20mm F0.95", "XF100-400mm", "61182", "Nokton 40mm", "70.0-200.0 mm"],
)
def test_what_names_a_lens_is_its_name(name: str, metadata_of: Read) -> None:
    assert metadata_of(jpeg_with({}, {0xA434: name})).lens.model == name


@pytest.mark.parametrize(
    ("written", "width", "pitch"), [(4.5, 96, 4.5), (59.0, 96, 59.0), (352.8, 96, None), (50.0, 1200, None)]
)
def test_the_pitch_of_a_small_mosaic_is_known_because_it_was_never_scaled(
    written: float, width: int, pitch: float | None, tmp_path: Path
) -> None:
    metadata, path = photo.PhotoMetadata(pixel_pitch_um=written), tmp_path / "mosaic.dng"
    write_bayer_dng(path, np.full((64, width), 600, np.uint16), black=512, white=4095, metadata=metadata)

    # 72 pixels to the inch, as some cameras write, is a sensor of nothing, and none is 60 mm wide
    assert photo.inspect(path).metadata.pixel_pitch_um == (pitch and pytest.approx(pitch))


@pytest.mark.parametrize(
    ("focal", "film", "pitch"),
    [
        (IFDRational(50, 1), 75, 1000.0 * math.hypot(36, 24) / 1.5 / math.hypot(1200, 900)),
        (IFDRational(50, 1), 0, None),  # the camera does not know
        (IFDRational(50, 1), 2000, None),  # no sensor is that small
    ],
)
def test_the_focal_length_for_film_tells_the_pitch_where_the_sensor_does_not(
    focal: IFDRational, film: int, pitch: float | None, tmp_path: Path
) -> None:
    block = Image.Exif()
    # 72 pixels to the inch say nothing of a sensor
    block.get_ifd(0x8769).update({0x920A: focal, 0xA405: film, 0xA20E: IFDRational(72, 1), 0xA210: 2})
    Image.new("RGB", (1200, 900)).save(tmp_path / "small.jpg", exif=block)

    assert photo.inspect(tmp_path / "small.jpg").metadata.pixel_pitch_um == (pitch and pytest.approx(pitch))


def test_entities_in_xmp_are_refused(metadata_of: Read) -> None:
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
    packet = xmp_with('aux:LensSerialNumber="&b;"', head=bomb)

    assert read_xmp(packet.encode()) == {}
    assert metadata_of(jpeg_with({}, {}, packet)).lens.serial is None


def test_a_damaged_xmp_packet_gives_what_came_before() -> None:
    packet = xmp_with('aux:LensSerialNumber="77"').encode()

    assert read_xmp(packet[:-20])["aux:LensSerialNumber"] == "77"
    assert read_xmp(b"\xff\xfe nonsense") == {}


def test_keywords_that_grow_when_they_are_written_fit_into_a_jpeg() -> None:
    words = b"".join(b"<rdf:li>" + b"&" * 1000 + b"</rdf:li>" for _ in range(60))
    read = tuple(read_xmp(b"<dc:subject>" + words)["dc:subject"].split("\n"))

    assert 4 < len(read) < 60
    assert len(xmp_packet(photo.PhotoMetadata(keywords=read), "")) < 65_000


def test_keywords_that_never_end_cost_no_time() -> None:
    started = time.process_time()

    assert read_xmp(80_000 * b"<dc:subject>\n") == {}
    assert time.process_time() - started < 2.0


@pytest.mark.parametrize(
    ("text", "value"), [("71/10", 7.1), ("2.8", 2.8), ("1e1000000000", None), ("5/0", None), ("f/2", None)]
)
def test_xmp_numbers_are_read_and_absurd_ones_at_once_refused(
    metadata_of: Read, text: str, value: float | None
) -> None:
    assert metadata_of(jpeg_with({}, {}, xmp_with(f'exif:FNumber="{text}"'))).aperture == value


# --- CRW files, which are older than EXIF -----------------------------------------------------------

HEAP = b"II" + struct.pack("<I", 26) + b"HEAPCCDR" + bytes(12)


@pytest.mark.parametrize(
    ("record", "model"),
    [(b"Canon\0Canon EOS D30\0\0\xfb\x7f", "Canon EOS D30"), (b"Ca\x14non\0\x01\0", None)],
)
def test_the_camera_of_a_crw_is_named(record: bytes, model: str | None, metadata_of: Read) -> None:
    seen = metadata_of(HEAP + record)

    assert (seen.camera_maker, seen.camera_model) == ("Canon", model)


@pytest.mark.tools
def test_a_real_crw_names_its_settings_and_its_missing_white_balance_is_told(shared_data: Path) -> None:
    developed = photo.develop(shared_data / "real" / "canon_d30_xmas_tree.crw")
    seen = developed.info.metadata

    assert (seen.aperture, seen.focal_mm, seen.iso) == (5.6, 31.0, 100.0)
    assert (seen.camera_model, seen.taken_at) == ("Canon EOS D30", datetime(2018, 1, 1, 13, 3, 32))  # noqa: DTZ001  the camera's clock has no zone
    with rawpy.imread(str(shared_data / "real" / "canon_d30_xmas_tree.crw")) as raw:
        raw.postprocess(use_auto_wb=True)  # in full size
        r, g, b = raw.auto_whitebalance[:3]
    assert developed.encoding.white_balance == pytest.approx((r / g, 1.0, b / g), rel=0.02)
    assert any("grey on average" in remark for remark in developed.remarks)


@pytest.mark.parametrize("head", [HEAP, b"II*\0\x10\0\0\0CR\x02\0", b"\0MRM"], ids=["CRW", "CR2", "MRW"])
def test_a_kind_that_no_camera_writes_anew_is_damaged_and_not_unknown(head: bytes, tmp_path: Path) -> None:
    path = tmp_path / "photo.raw"
    path.write_bytes(head + bytes(400))
    with pytest.raises(TruncatedImageError, match="damaged"), opened_raw(path):
        pass


# --- real files --------------------------------------------------------------------------------


@pytest.mark.tools
def test_metadata_of_real_files_agree_with_the_table(shared_data: Path) -> None:
    with (shared_data / "meta" / "EXPECTED.tsv").open(encoding="utf-8") as table:
        rows = list(csv.DictReader(table, delimiter="\t", quoting=csv.QUOTE_NONE))
    assert len(rows) == 21
    for row in rows:
        seen = read_metadata(shared_data / row["file"])
        serials = {
            part.partition("=")[2].strip()
            for part in row["lens_serial_exiftool(group=value)"].split("|")
            if row["serial_verdict"] == "usable"
        }
        assert {seen.lens.serial} == (serials or {None}), row["file"]
        assert (seen.camera_maker or "") == row["make"], row["file"]
        assert (seen.camera_model or "") == row["model"], row["file"]
        assert (seen.aperture or 0.0) == pytest.approx(float(row["f_number"] or 0)), row["file"]
        focal = float(row["focal_length"].removesuffix(" mm") or 0)
        assert (seen.focal_mm or 0.0) == pytest.approx(focal, abs=0.05), row["file"]
        assert (seen.iso or 0) == float(row["iso"] or 0), row["file"]
        if row["body_serial"]:
            assert seen.body_serial == row["body_serial"], row["file"]
        if row["lens"] not in _LOOKED_UP:
            assert (seen.lens.model or "") == row["lens"], row["file"]


# --- location ---------------------------------------------------------------------------------

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
    places = {1: (containers.ASCII, "N"), 2: (containers.RATIONAL, LATITUDE)}
    tags = {
        262: (containers.SHORT, 1),
        271: (containers.ASCII, "Maker"),
        containers.EXIF: {0x829D: (containers.RATIONAL, 1.4)},
    }
    containers.write_strip(out, {**tags, containers.GPS: places}, PIXELS[:, :, 0])
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


BOX = b"CMT4" + containers.laid_out({1: (containers.ASCII, "N"), 2: (containers.RATIONAL, LATITUDE)})


@pytest.mark.parametrize(
    ("head", "part"),
    [(b"FUJIFILMCCD-RAW ", FILES["jpeg"]), (b"\0\0\0\x18ftypcrx ", BOX)],
    ids=["preview", "CR3"],
)
def test_the_place_in_a_part_of_a_raw_file_goes_too(head: bytes, part: bytes) -> None:
    data = head + bytes(100) + part + bytes(100)
    assert any(secret in data for secret in SECRET)

    after = cleaned(data)

    assert not any(secret in after for secret in SECRET)


@pytest.mark.parametrize("kind", FILES)
def test_photos_that_say_nothing_are_not_touched(kind: str) -> None:
    assert find_location(saved(kind)) == ([], True)


def test_a_png_whose_text_is_too_large_to_be_searched_is_not_called_clean() -> None:
    data, text = FILES["png"], bytes(17 << 20)
    part = struct.pack(">I4s", len(text), b"tEXt") + text + struct.pack(">I", zlib.crc32(b"tEXt" + text))
    at = data.index(b"IDAT") - 4

    assert find_location(data)[1]
    assert not find_location(data[:at] + part + data[at:])[1]


def test_a_png_of_countless_empty_parts_costs_no_memory() -> None:
    data, part = FILES["png"], struct.pack(">I4sI", 0, b"IDAT", zlib.crc32(b"IDAT"))
    at = data.index(b"IDAT") - 4

    tracemalloc.start()
    after = cleaned(data[:at] + 30_000 * part + data[at:])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert not any(secret in after for secret in SECRET)
    assert most < 4 * len(after)


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
