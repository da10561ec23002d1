"""What a photo carries beside its pixels goes into the corrected one: rights, rating, opcodes, place."""

from __future__ import annotations

import struct
from pathlib import Path

import exifread
import numpy as np
import pytest
import tifffile
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from lensmodel import photo
from lensmodel.photo.metadata import gps_directory
from lensmodel.photo.writing import Opcode, demosaiced, packed_opcodes, read_opcodes, write_bayer_dng

REPORTS = Path(__file__).parents[2] / "data" / "reports"
FORMATS = ("tiff16", "tiff32", "png16", "png8", "jpeg", "dng")
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:dc="http://purl.org/dc/elements/1.1/" xmlns:xmp="http://ns.adobe.com/xap/1.0/"
xmp:Rating="{rating}">
<dc:rights><rdf:Alt><rdf:li xml:lang="x-default">© Ä. Example</rdf:li></rdf:Alt></dc:rights>
<dc:creator><rdf:Seq><rdf:li>Ä. Example</rdf:li><rdf:li>B. Example</rdf:li></rdf:Seq></dc:creator>
<dc:subject><rdf:Bag><rdf:li>holiday</rdf:li><rdf:li>café &amp; sea</rdf:li></rdf:Bag></dc:subject>
</rdf:Description></rdf:RDF></x:xmpmeta>"""


def corrected(source: Path, target: Path, output: photo.OutputFormat, **options: object) -> Path:
    """Write what was developed, as a correction does."""
    developed = photo.develop(source)
    photo.write_image(target, developed.planes, developed.encoding, format=output, **options)
    return target


@pytest.mark.parametrize("output", FORMATS)
def test_copyright_and_artist_are_kept(output: photo.OutputFormat, tmp_path: Path) -> None:
    result = corrected(REPORTS / "copyright.jpg", tmp_path / "x", output)
    said = photo.inspect(result).metadata

    assert (said.copyright, said.artist) == ("(c) 2024 Example", "Example")
    if not output.startswith("png"):
        with result.open("rb") as file:
            tags = exifread.process_file(file)
        assert (str(tags["Image Copyright"]), str(tags["Image Artist"])) == ("(c) 2024 Example", "Example")


@pytest.mark.parametrize("rating", [-1, 0, 4])
@pytest.mark.parametrize("output", FORMATS)
def test_rights_authors_rating_and_keywords_of_xmp_are_kept(
    output: photo.OutputFormat, rating: int, tmp_path: Path
) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "x.jpg", xmp=XMP.format(rating=rating).encode())

    said = photo.inspect(corrected(tmp_path / "x.jpg", tmp_path / "out", output)).metadata

    assert (said.copyright, said.artist, said.rating) == ("© Ä. Example", "Ä. Example, B. Example", rating)
    assert said.keywords == ("holiday", "café & sea")


@pytest.mark.parametrize("output", FORMATS)
@pytest.mark.parametrize("order", ["big", "little"])
def test_the_place_is_kept_where_its_owner_wants_it_and_nowhere_else(
    output: photo.OutputFormat, order: str, tmp_path: Path
) -> None:
    block = Image.Exif()
    block.endian = ">" if order == "big" else "<"
    place = (IFDRational(52), IFDRational(30), IFDRational(1234, 100))
    block.get_ifd(0x8825).update({0: b"\2\3\0\0", 1: "N", 2: place, 3: "E", 4: place, 5: b"\0"})
    Image.new("RGB", (64, 48), "grey").save(tmp_path / "x.jpg", exif=block)

    kept = corrected(tmp_path / "x.jpg", tmp_path / "kept", output, gps=gps_directory(tmp_path / "x.jpg"))
    left = corrected(tmp_path / "x.jpg", tmp_path / "left", output)

    found = gps_directory(kept)
    assert found == gps_directory(tmp_path / "x.jpg")
    assert found[2] == (5, struct.pack("<6I", 52, 1, 30, 1, 617, 50))
    assert gps_directory(left) == {}


def opcode_lists(path: Path) -> list[list[Opcode]]:
    with tifffile.TiffFile(path) as file:
        tags = file.pages[0].tags
        return [read_opcodes(bytes(tags[tag].value)) if tag in tags else [] for tag in (51009, 51022)]


def test_gain_map_and_warp_go_into_the_corrected_dng(tmp_path: Path) -> None:
    ((gain,), (warp,)) = opcode_lists(corrected(REPORTS / "gainmap-warp.dng", tmp_path / "x.dng", "dng"))
    (source,), (source_warp,) = opcode_lists(REPORTS / "gainmap-warp.dng")

    assert (warp.name, warp.data) == ("WarpRectilinear", source_warp.data)
    assert gain.name == "GainMap"
    assert struct.unpack(">8I", gain.data[:32]) == (0, 0, 224, 360, 0, 3, 1, 1)  # of all three planes
    assert gain.data[32:] == source.data[32:]


def test_a_file_that_cannot_keep_them_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    corrected(REPORTS / "gainmap-warp.dng", tmp_path / "x.tif", "tiff16")

    assert "GainMap, WarpRectilinear" in caplog.text


def gain_map(top: int, left: int, pitch: int, gains: list[float]) -> Opcode:
    head = struct.pack(">10I4dI", top, left, 48, 64, 0, 1, pitch, pitch, 2, 2, 1.0, 1.0, 0.0, 0.0, 1)
    return Opcode(9, 0x01030000, 1, head + struct.pack(">4f", *gains))


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_gain_maps_of_the_four_sites_of_a_mosaic_become_those_of_three_colours(
    pattern: str, tmp_path: Path
) -> None:
    sites = [gain_map(row, col, 2, [1.0 + row, 2.0, 3.0, 4.0 + col]) for row in (0, 1) for col in (0, 1)]
    mosaic = np.random.default_rng(0).integers(2000, 2900, (48, 64), dtype=np.uint16)
    with_lists(
        tmp_path / "x.dng", mosaic, pattern, packed_opcodes([*sites, Opcode(4, 0x01030000, 1, b"\0" * 8)])
    )

    kept, _ = opcode_lists(corrected(tmp_path / "x.dng", tmp_path / "out.dng", "dng"))

    of_plane = {struct.unpack(">8I", step.data[:32])[4:]: step.data[-16:] for step in kept}
    assert sorted(of_plane) == [(0, 1, 1, 1), (1, 1, 1, 1), (2, 1, 1, 1)]
    greens = [site for site, letter in zip(sites, pattern, strict=True) if letter == "G"]
    mean = np.mean([np.frombuffer(step.data[-16:], ">f4") for step in greens], axis=0)
    assert np.frombuffer(of_plane[1, 1, 1, 1], ">f4") == pytest.approx(mean)
    assert of_plane[0, 1, 1, 1] == sites[pattern.index("R")].data[-16:]
    remarks = photo.develop(tmp_path / "x.dng").remarks
    assert remarks[0] == "its FixBadPixelsConstant is for the mosaic only and is dropped"


def with_lists(path: Path, mosaic: np.ndarray, pattern: str, block: bytes) -> None:
    """Write a DNG with an OpcodeList2 in the place of its XMP."""
    write_bayer_dng(path, mosaic, black=512, white=15000, pattern=pattern)
    data = bytearray(path.read_bytes())
    at = next(i for i in range(10, 600, 12) if data[i : i + 2] == struct.pack("<H", 50708))
    data[at : at + 12] = struct.pack("<HHII", 51009, 7, len(block), len(data))
    path.write_bytes(bytes(data) + block)


@pytest.mark.parametrize("cut", [0, 3, 4, 19, 30, 410])
def test_a_damaged_list_gives_what_came_before_the_damage(cut: int) -> None:
    with tifffile.TiffFile(REPORTS / "gainmap-warp.dng") as file:
        block = bytes(file.pages[0].tags[51009].value)

    assert read_opcodes(block[:cut]) == []
    assert len(read_opcodes(struct.pack(">I", 2**32 - 1) + block[4:])) == 1
    assert demosaiced([Opcode(9, 0, 0, block[20:60])], None)[0] == []
