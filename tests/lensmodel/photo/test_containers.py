"""Which picture of a file is the photo, and what its numbers are; what is no photo is refused by name."""

from __future__ import annotations

import struct
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from lensmodel import photo
from lensmodel.core.errors import NotAnImageError, TruncatedImageError, UnsupportedFormatError
from lensmodel.photo.mosaic import require_known_mosaic
from lensmodel.photo.tiff import BYTE, laid_out, longs, shorts

REPORTS = Path(__file__).parents[2] / "data" / "reports"
RNG = np.random.default_rng(5)
COLOURS = RNG.integers(0, 65535, (3, 256), dtype=np.uint16)
PIXELS = np.kron(RNG.integers(20, 230, (12, 16, 3), dtype=np.uint8), np.ones((4, 4, 1), np.uint8))


def numbers(path: Path) -> np.ndarray:
    """The sRGB numbers of a developed photo, for comparison by eye and by sum."""
    developed = photo.develop(path)
    assert developed.planes.shape[1:] == (developed.info.height, developed.info.width)
    return photo.shown(developed.planes, developed.encoding)


def _previews_without_a_mark(path: Path) -> None:
    with tifffile.TiffWriter(path) as file:
        file.write(PIXELS[::4, ::4], photometric="rgb", metadata=None)
        file.write(PIXELS, photometric="rgb", metadata=None)


def _photo_below_its_preview(path: Path) -> None:
    with tifffile.TiffWriter(path) as file:
        file.write(PIXELS[::2, ::2], photometric="rgb", metadata=None, subifds=1, subfiletype=1)
        file.write(PIXELS, photometric="rgb", metadata=None, subfiletype=0)


def _larger_mask(path: Path) -> None:
    with tifffile.TiffWriter(path) as file:
        file.write(PIXELS, photometric="rgb", metadata=None)
        mask = np.ones((96, 128), dtype=bool)
        file.write(mask, photometric="mask", subfiletype=4, metadata=None)


def _enlarged_copy(path: Path) -> None:
    with tifffile.TiffWriter(path) as file:
        file.write(PIXELS, photometric="rgb", metadata=None, subfiletype=0)
        file.write(
            np.kron(PIXELS, np.ones((2, 2, 1), np.uint8)), photometric="rgb", subfiletype=1, metadata=None
        )


@pytest.mark.parametrize(
    "write", [_previews_without_a_mark, _photo_below_its_preview, _larger_mask, _enlarged_copy]
)
def test_the_largest_picture_that_derives_from_no_other_is_the_photo(
    write: Callable[[Path], None], tmp_path: Path
) -> None:
    write(tmp_path / "x.tif")

    assert (numbers(tmp_path / "x.tif") == PIXELS).all()


def test_what_the_photos_own_directory_says_goes_before_the_previews(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "x.tif") as file:
        file.write(
            PIXELS[::4, ::4],
            photometric="rgb",
            metadata=None,
            subfiletype=1,
            extratags=[(272, 2, 0, "T-1", True)],
        )
        file.write(PIXELS, photometric="rgb", metadata=None, extratags=[(274, 3, 1, 6, True)])

    said = photo.inspect(tmp_path / "x.tif").metadata

    assert (said.camera_model, said.orientation) == ("T-1", 6)


@pytest.mark.parametrize(
    ("pixels", "options", "word"),
    [
        (np.zeros((48, 64, 4), np.uint8), {"photometric": "separated"}, "CMYK"),
        (np.zeros((48, 64, 3), np.uint8), {"photometric": "cielab"}, "Lab"),
        (np.zeros((48, 64, 3), np.uint8), {"photometric": "ycbcr"}, "YCbCr"),
        (np.zeros((48, 64, 3), np.uint8), {"photometric": "rgb", "compression": "jpeg"}, "YCbCr"),
        (np.zeros((48, 64, 6), np.uint8), {"photometric": "rgb", "planarconfig": "contig"}, "6 channels"),
        (np.zeros((48, 64), np.int16), {"photometric": "minisblack"}, "signed"),
        (np.zeros((48, 64), np.complex64), {"photometric": "minisblack"}, "complex"),
        (np.zeros((48, 64), np.uint32), {"photometric": "minisblack"}, "32 bits"),
        (np.zeros((48, 64), bool), {"photometric": "minisblack"}, "1 bits"),
        (np.zeros((48, 64), np.uint8), {"photometric": "miniswhite"}, "inverted"),
        (np.zeros((48, 64), np.uint8), {"photometric": "palette", "colormap": COLOURS}, "palette"),
        (np.zeros((48, 64), np.uint8), {"bigtiff": True}, "BigTIFF"),
    ],
)
def test_a_tiff_that_could_only_fail_is_refused_before_it_is_stored(
    pixels: np.ndarray, options: dict, word: str, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "x.tif", pixels, metadata=None, **options)

    with pytest.raises(UnsupportedFormatError, match=word):
        photo.inspect(tmp_path / "x.tif")


def test_chroma_of_several_pixels_is_named_and_not_taken_for_a_file_that_was_cut_off(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "x.tif", PIXELS, photometric="ycbcr", metadata=None)
    with tifffile.TiffFile(tmp_path / "x.tif", mode="r+") as file:
        file.pages[0].tags[279].overwrite(PIXELS.size // 2)  # StripByteCounts of 4:2:0

    with pytest.raises(UnsupportedFormatError, match="YCbCr"):
        photo.inspect(tmp_path / "x.tif")


def test_a_quad_bayer_mosaic_is_refused_by_its_pattern_and_nothing_is_printed() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for read in (photo.inspect, photo.develop):
            with pytest.raises(UnsupportedFormatError, match=r"4 x 4 pixels \(RRGG RRGG GGBB GGBB\)"):
                read(REPORTS / "quad-bayer.dng")


@pytest.mark.parametrize(
    ("rows", "columns", "colours"),
    [(2, 2, "RGRG"), (2, 4, "RGGBGRBG"), (2, 2, "CYGM"), (2, 2, "RWGB"), (8, 2, "RGGBRGGBRGGBRGGB")],
)
def test_every_mosaic_that_is_not_demosaiced_here_is_refused(
    rows: int, columns: int, colours: str, tmp_path: Path
) -> None:
    pattern = bytes("RGBCMYW".index(letter) for letter in colours)
    tags = {256: longs(64), 257: longs(48), 33421: shorts(rows, columns), 33422: (BYTE, pattern)}
    (tmp_path / "x.dng").write_bytes(laid_out({**tags, 50706: (BYTE, b"\1\4\0\0")}, {}))

    with pytest.raises(UnsupportedFormatError, match=f"{rows} x {columns} pixels"):
        photo.inspect(tmp_path / "x.dng")


@pytest.mark.parametrize("stray", [b"\0", b"ab\0c", b"\xff\xff\xff", b"\xff\0\0", b"\xff\xd0"])
@pytest.mark.parametrize("segment", [1, 2])
def test_stray_bytes_hide_nothing_that_follows_them(stray: bytes, segment: int, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0110] = "T-1"
    Image.fromarray(PIXELS).save(tmp_path / "x.jpg", exif=exif, quality=95)
    data = (tmp_path / "x.jpg").read_bytes()
    at = 2
    for _ in range(segment):
        at += 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    (tmp_path / "x.jpg").write_bytes(data[:at] + stray + data[at:])

    developed = photo.develop(tmp_path / "x.jpg")

    with Image.open(tmp_path / "x.jpg") as image:
        assert np.abs(photo.shown(developed.planes, developed.encoding) - np.int16(image)).max() <= 1
    assert developed.info.metadata.camera_model == "T-1"


def test_a_jpeg_of_stray_bytes_alone_ends_inside_its_header(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(b"\xff\xd8\xff\xe0\0\x04ab" + b"\0\xff\0" * 20_000)

    with pytest.raises(TruncatedImageError):
        photo.inspect(tmp_path / "x.jpg")


@pytest.mark.parametrize("rows", [["RG", "G"], ["R", "GB"], ["RG", ""], []])
def test_a_mosaic_that_names_too_few_colours_is_refused(rows: list[str]) -> None:
    with pytest.raises(UnsupportedFormatError):
        require_known_mosaic(rows)


def _segments(code: int, *bodies: bytes) -> bytes:
    return b"".join(struct.pack(">BBH", 0xFF, code, len(body) + 2) + body for body in bodies)


def _with_segments(path: Path, segments: bytes, camera: str | None = None) -> Path:
    exif = Image.Exif()
    if camera:
        exif[0x0110] = camera
    Image.fromarray(PIXELS).save(path, "JPEG", exif=exif)
    data = path.read_bytes()
    path.write_bytes(data[:2] + segments + data[2:])
    return path


@pytest.mark.parametrize("parts", [_segments(0xE5, *[b""] * 50_000), b"\0".join([b""] * 200_000)])
def test_a_jpeg_header_of_very_many_parts_is_refused(parts: bytes, tmp_path: Path) -> None:
    first = _segments(0xE5, b"")

    with pytest.raises(NotAnImageError, match="within 32768 segments"):
        photo.inspect(_with_segments(tmp_path / "x.jpg", first + parts))


def overlapping(kind: bytes, tags: int = 4000, most: int = 16_000) -> bytes:
    """A directory whose values are each all that follows it."""
    entries = b"".join(struct.pack("<HHII", 2000 + tag, 7, most, 8) for tag in range(tags))
    return kind + b"II*\0\x08\0\0\0" + struct.pack("<H", tags) + entries + bytes(4)


HOSTILE = {
    "Exif": _segments(0xE1, overlapping(b"Exif\0\0")),
    "Exif in many parts": _segments(0xE1, overlapping(b"Exif\0\0"), *[b"Exif\0\0" + bytes(65_000)] * 100),
    "Exif of values beyond the file": _segments(0xE1, overlapping(b"Exif\0\0", most=1 << 30)),
    "large header": _segments(0xE5, *[bytes(65_000)] * 140),
    "list of pictures": _segments(0xE2, overlapping(b"MPF\0")),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_stands_beside_a_jpeg_costs_nothing_while_it_is_decoded(case: str, tmp_path: Path) -> None:
    path = _with_segments(tmp_path / "x.jpg", HOSTILE[case], camera="T-1")
    size = path.stat().st_size
    photo.develop(_with_segments(tmp_path / "first.jpg", b""))  # compiles

    tracemalloc.start()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        developed = photo.develop(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert developed.planes.shape == (3, 48, 64)
    assert developed.info.metadata.camera_model == "T-1"
    assert most < 4 * size + (16 << 20)


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "1"])
@pytest.mark.parametrize("beside", [b"iCCP", b"zTXt", b"gAMA"])
def test_what_stands_beside_a_png_is_not_unpacked_to_decode_it(
    mode: str, beside: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    image = Image.fromarray(PIXELS).convert(mode)
    image.save(tmp_path / "x.png")
    data = (tmp_path / "x.png").read_bytes()
    body = b"" if beside == b"gAMA" else b"x\0\0" + zlib.compress(bytes(12 << 20))
    chunk = struct.pack(">I", len(body)) + beside + body + struct.pack(">I", zlib.crc32(beside + body))
    (tmp_path / "x.png").write_bytes(data[:33] + chunk + data[33:])

    shown = numbers(tmp_path / "x.png")

    assert (shown == np.asarray(image.convert("RGB"))).all()
    assert capfd.readouterr() == ("", "")  # libpng prints what it finds amiss
