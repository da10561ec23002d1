"""Which picture of a file is the photo, its numbers and colours, and what is refused by its header."""

from __future__ import annotations

import contextlib
import io
import struct
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms

from lensmodel import photo
from lensmodel.core.errors import (
    DecompressionBombError,
    ImageTooLargeError,
    LensModelError,
    MetadataMissingError,
    NotAnImageError,
    TruncatedImageError,
    UnreadablePhotoError,
    UnsupportedFormatError,
)
from lensmodel.photo.colour import named_profile, read_profile
from lensmodel.photo.containers import BYTE, LONG, Tag, Tags, laid_out, require_known_mosaic
from lensmodel.photo.writing import write_bayer_dng

REPORTS = Path(__file__).parents[2] / "data" / "reports"
RNG = np.random.default_rng(5)
COLOURS = RNG.integers(0, 65535, (3, 256), dtype=np.uint16)
PIXELS = np.kron(RNG.integers(60, 200, (12, 16, 3), dtype=np.uint8), np.ones((4, 4, 1), np.uint8))
NO_EXIF = Image.Exif()


def segments_of(code: int, *bodies: bytes) -> bytes:
    return b"".join(struct.pack(">BBH", 0xFF, code, len(body) + 2) + body for body in bodies)


def jpeg_with(segments: bytes = b"", block: Image.Exif = NO_EXIF) -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(out, "JPEG", quality=100, subsampling=0, exif=block)
    return out.getvalue()[:2] + segments + out.getvalue()[2:]


def camera(name: str) -> Image.Exif:
    block = Image.Exif()
    block[0x0110] = name
    return block


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png_with(*chunks: bytes, mode: str = "RGB") -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).convert(mode).save(out, "PNG")
    return out.getvalue()[:33] + b"".join(chunks) + out.getvalue()[33:]


def numbers(path: Path) -> np.ndarray:
    """The sRGB numbers of a developed photo, for comparison by eye and by sum."""
    developed = photo.develop(path)
    assert developed.planes.shape[1:] == (developed.info.height, developed.info.width)
    return photo.shown(developed.planes, developed.encoding)


PICTURES: dict[str, list[tuple[np.ndarray, dict]]] = {
    "preview without a mark": [(PIXELS[::4, ::4], {}), (PIXELS, {})],
    "below its preview": [(PIXELS[::2, ::2], {"subifds": 1, "subfiletype": 1}), (PIXELS, {"subfiletype": 0})],
    "larger mask": [(PIXELS, {}), (np.ones((96, 128), bool), {"photometric": "mask", "subfiletype": 4})],
    "enlarged copy": [(PIXELS, {}), (np.kron(PIXELS, np.ones((2, 2, 1), np.uint8)), {"subfiletype": 1})],
    "several pages": [(PIXELS, {}), (255 - PIXELS, {}), (255 - PIXELS, {})],
}


@pytest.mark.parametrize("case", PICTURES)
def test_the_largest_picture_that_derives_from_no_other_is_the_photo(case: str, tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "x.tif") as file:
        for pixels, options in PICTURES[case]:
            file.write(pixels, metadata=None, **{"photometric": "rgb", **options})

    assert (numbers(tmp_path / "x.tif") == PIXELS).all()


def test_what_the_photos_own_directory_says_goes_before_the_previews(tmp_path: Path) -> None:
    preview, own = {"extratags": [(272, 2, 0, "T-1", True)]}, {"extratags": [(274, 3, 1, 6, True)]}
    with tifffile.TiffWriter(tmp_path / "x.tif") as file:
        file.write(PIXELS[::4, ::4], photometric="rgb", metadata=None, subfiletype=1, **preview)
        file.write(PIXELS, photometric="rgb", metadata=None, **own)

    said = photo.inspect(tmp_path / "x.tif").metadata

    assert (said.camera_model, said.orientation) == ("T-1", 6)


@pytest.mark.parametrize(
    ("pixels", "options", "word"),
    [
        (np.zeros((48, 64, 4), np.uint8), {"photometric": "separated"}, "CMYK"),
        (np.zeros((48, 64, 3), np.uint8), {"photometric": "cielab"}, "Lab"),
        (np.zeros((48, 64, 3), np.uint8), {"photometric": "ycbcr"}, "YCbCr"),
        (np.zeros((48, 64, 3), np.uint8), {"photometric": "rgb", "compression": "jpeg"}, "YCbCr"),
        (np.zeros((48, 64, 6), np.uint8), {"photometric": "rgb", "planarconfig": "contig"}, "6 samples"),
        (np.zeros((48, 64), np.int16), {"photometric": "minisblack"}, "unsigned .* SampleFormat 2"),
        (np.zeros((48, 64), np.complex64), {"photometric": "minisblack"}, "SampleFormat 6"),
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


def test_a_tiff_of_a_volume_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "x.tif", np.zeros((48, 48, 48), np.uint8), volumetric=True)

    with pytest.raises(UnsupportedFormatError, match="one page"):
        photo.develop(tmp_path / "x.tif")


@pytest.mark.parametrize(
    ("rows", "columns", "colours"),
    [
        (2, 2, "RGRG"),
        (2, 4, "RGGBGRBG"),
        (2, 2, "CYGM"),
        (2, 2, "RWGB"),
        (8, 2, "RGGBRGGBRGGBRGGB"),
        (1 << 31, 0, "RG"),
    ],
)
def test_every_mosaic_that_is_not_demosaiced_here_is_refused(
    rows: int, columns: int, colours: str, tmp_path: Path
) -> None:
    pattern = bytes("RGBCMYW".index(letter) for letter in colours)
    tags = {256: (LONG, 64), 257: (LONG, 48), 33421: (LONG, (rows, columns)), 33422: (BYTE, pattern)}
    (tmp_path / "x.dng").write_bytes(laid_out({**tags, 50706: (BYTE, b"\1\4\0\0")}))

    with pytest.raises(UnsupportedFormatError, match=f"{min(rows, 256)} x {columns} pixels"):
        photo.inspect(tmp_path / "x.dng")


@pytest.mark.parametrize("stray", [b"\0", b"ab\0c", b"\xff\xff\xff", b"\xff\0\0", b"\xff\xd0"])
@pytest.mark.parametrize("segment", [1, 2])
def test_stray_bytes_hide_nothing_that_follows_them(stray: bytes, segment: int, tmp_path: Path) -> None:
    data, at = jpeg_with(block=camera("T-1")), 2
    for _ in range(segment):
        at += 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    (tmp_path / "x.jpg").write_bytes(data[:at] + stray + data[at:])

    with Image.open(tmp_path / "x.jpg") as image:
        assert np.abs(numbers(tmp_path / "x.jpg") - np.int16(image)).max() <= 1
    assert photo.inspect(tmp_path / "x.jpg").metadata.camera_model == "T-1"


@pytest.mark.parametrize("rows", [["RG", "G"], ["R", "GB"], ["RG", ""], []])
def test_a_mosaic_that_names_too_few_colours_is_refused(rows: list[str]) -> None:
    with pytest.raises(UnsupportedFormatError):
        require_known_mosaic(rows)


def overlapping(kind: bytes, tags: int = 4000, most: int = 16_000) -> bytes:
    """A directory whose values are each all that follows it."""
    entries = b"".join(struct.pack("<HHII", 2000 + tag, 7, most, 8) for tag in range(tags))
    return kind + b"II*\0\x08\0\0\0" + struct.pack("<H", tags) + entries + bytes(4)


HOSTILE = {
    "Exif": segments_of(0xE1, overlapping(b"Exif\0\0")),
    "Exif in many parts": segments_of(0xE1, overlapping(b"Exif\0\0"), *[b"Exif\0\0" + bytes(65_000)] * 100),
    "Exif of values beyond the file": segments_of(0xE1, overlapping(b"Exif\0\0", most=1 << 30)),
    "large header": segments_of(0xE5, *[bytes(65_000)] * 140),
    "list of pictures": segments_of(0xE2, overlapping(b"MPF\0")),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_stands_beside_a_jpeg_costs_nothing_while_it_is_decoded(case: str, tmp_path: Path) -> None:
    path, hostile = tmp_path / "x.jpg", jpeg_with(HOSTILE[case], camera("T-1"))
    path.write_bytes(jpeg_with())
    photo.develop(path)  # compiles
    path.write_bytes(hostile)

    tracemalloc.start()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        developed = photo.develop(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert developed.planes.shape == (3, 48, 64)
    assert developed.info.metadata.camera_model == "T-1"
    assert most < 4 * len(hostile) + (16 << 20)


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "1"])
@pytest.mark.parametrize("beside", [b"iCCP", b"zTXt", b"tIME"])
def test_what_stands_beside_a_png_is_not_unpacked_to_decode_it(
    mode: str, beside: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    body = b"" if beside == b"tIME" else b"x\0\0" + zlib.compress(bytes(12 << 20))
    (tmp_path / "x.png").write_bytes(png_with(chunk(beside, body), mode=mode))

    shown = numbers(tmp_path / "x.png")

    assert (shown == np.asarray(Image.fromarray(PIXELS).convert(mode).convert("RGB"))).all()
    assert capfd.readouterr() == ("", "")  # libpng prints what it finds amiss


# --- colours: of a profile, of EXIF, or sRGB; others are refused, and a lost profile is told -----------

ADOBE_RGB = named_profile("adobergb")


PROFILE = chunk(b"iCCP", b"x\0\0" + zlib.compress(ADOBE_RGB))


def chrm(*places: float) -> bytes:
    return chunk(b"cHRM", struct.pack(">8I", *(round(100_000 * v) for v in places)))


def gama(value: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(100_000 * value)))


def exif(color_space: int) -> Image.Exif:
    block = Image.Exif()
    block.get_ifd(0x8769)[0xA001] = color_space
    return block


def parts_of(profile: bytes, marks: list[tuple[int, int]]) -> bytes:
    """Segments of a JPEG with the parts of a profile, each with a number and a count."""
    ends = [len(profile) * k // len(marks) for k in range(len(marks) + 1)]
    bodies = [
        b"ICC_PROFILE\0" + bytes(mark) + profile[first:last]
        for mark, first, last in zip(marks, ends, ends[1:], strict=False)
    ]
    return segments_of(0xE2, *bodies)


def is_adobe_rgb(icc: bytes | None) -> bool:
    """Whether a profile has the green of Adobe RGB (1998), under D50, and its exponent."""
    known = read_profile(icc)
    return (
        known is not None
        and known.to_xyz is not None
        and known.to_xyz[:, 1] == pytest.approx([0.2053, 0.6257, 0.0609], abs=2e-3)
        and known.curves[1][32768] == pytest.approx(0.5**2.2, abs=2e-3)
    )


JPEGS = {
    "R03": ((REPORTS / "adobergb-by-exif-only.jpg").read_bytes(), True),
    "ColorSpace 2": (jpeg_with(block=exif(2)), True),
    "ColorSpace 1": (jpeg_with(block=exif(1)), False),
    "nothing": (jpeg_with(), False),
}


@pytest.mark.parametrize("case", JPEGS)
def test_adobe_rgb_that_only_exif_declares_stays_adobe_rgb(case: str, tmp_path: Path) -> None:
    data, is_wide = JPEGS[case]
    (tmp_path / "x.jpg").write_bytes(data)
    developed = photo.develop(tmp_path / "x.jpg")
    photo.write_image(tmp_path / "x.png", developed.planes, developed.encoding, format="png8")

    with Image.open(tmp_path / "x.png") as image, Image.open(tmp_path / "x.jpg") as given:
        assert np.abs(np.int16(image) - np.int16(given)).max() <= 1
        assert is_adobe_rgb(image.info["icc_profile"]) == is_wide


def test_a_profile_goes_before_what_else_is_declared(tmp_path: Path) -> None:
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    (tmp_path / "x.jpg").write_bytes(jpeg_with(parts_of(srgb, [(1, 1)]), exif(2)))
    (tmp_path / "x.png").write_bytes(png_with(PROFILE, gama(1.0)))

    assert photo.develop(tmp_path / "x.jpg").encoding.icc == srgb
    assert photo.develop(tmp_path / "x.png").encoding.icc == ADOBE_RGB


@pytest.mark.parametrize(
    "chunks",
    [
        chunk(b"cICP", bytes((1, 13, 0, 1))),
        chunk(b"sRGB", b"\0") + gama(1.0),
        gama(0.45455) + chrm(0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06),
        gama(0.45),
        gama(0.0) + chrm(*(0.0,) * 8),
    ],
    ids=["cICP", "sRGB before gAMA", "as sRGB is approximated", "rounded", "nonsense"],
)
def test_a_png_that_declares_srgb_is_read(chunks: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(png_with(chunks))
    developed = photo.develop(tmp_path / "x.png")

    assert (developed.encoding.icc, developed.remarks) == (None, ())
    assert (photo.shown(developed.planes, developed.encoding) == PIXELS).all()


@pytest.mark.parametrize(
    ("data", "name"),
    [
        ((REPORTS / "adobergb-chrm-gama.png").read_bytes(), "cHRM"),
        (png_with(gama(1.0)), "gAMA"),
        (png_with(chrm(0.3127, 0.3290, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)), "cHRM"),
        (png_with(chunk(b"sRGB", b"\0"), chunk(b"cICP", bytes((9, 16, 0, 1)))), "cICP"),
        (png_with(chunk(b"cICP", bytes((9, 18, 0, 1))), PROFILE), "cICP"),
        (png_with(chunk(b"cICP", bytes((1, 13, 0, 0)))), "cICP"),  # limited range
    ],
)
def test_colours_that_only_chunks_declare_are_refused_before_the_file_is_stored(
    data: bytes, name: str, tmp_path: Path
) -> None:
    (tmp_path / "x.png").write_bytes(data)

    with pytest.raises(UnsupportedFormatError, match=name):
        photo.inspect(tmp_path / "x.png")


@pytest.mark.parametrize(
    "segments",
    [
        parts_of(ADOBE_RGB, [(1, 2), (2, 2)]),
        parts_of(ADOBE_RGB, [(1, 0), (2, 0)]),
        parts_of(ADOBE_RGB, [(1, 9), (2, 9), (3, 9)]),
        parts_of(ADOBE_RGB, [(0, 2), (1, 2)]),
        parts_of(ADOBE_RGB, [(1, 1), (1, 1), (1, 1)]),
        2 * parts_of(ADOBE_RGB, [(1, 2), (2, 2)]),
    ],
    ids=["right", "none", "nine", "from zero", "all first", "twice"],
)
def test_a_profile_whose_parts_are_miscounted_is_honoured_all_the_same(
    segments: bytes, tmp_path: Path
) -> None:
    (tmp_path / "x.jpg").write_bytes(jpeg_with(segments))
    developed = photo.develop(tmp_path / "x.jpg")

    assert (developed.encoding.icc, developed.remarks) == (ADOBE_RGB, ())


def tiff_with(profile: bytes, pixels: np.ndarray) -> bytes:
    out = io.BytesIO()
    tifffile.imwrite(out, pixels, photometric="rgb", iccprofile=profile, metadata=None)
    return out.getvalue()


UNUSABLE = {
    "x.jpg, a part is missing": jpeg_with(
        parts_of(ADOBE_RGB, [(1, 3), (2, 3), (3, 3)])[: -len(ADOBE_RGB) // 3 - 18]
    ),
    "x.jpg, without a number": jpeg_with(segments_of(0xE2, b"ICC_PROFILE\0")),
    "x.jpg, nonsense": jpeg_with(parts_of(bytes(200), [(1, 1)])),
    "x.jpg, CMYK": jpeg_with(parts_of(ADOBE_RGB[:16] + b"CMYK" + ADOBE_RGB[20:], [(1, 1)])),
    "x.png, not packed": png_with(chunk(b"iCCP", b"x\0\0" + ADOBE_RGB)),
    "x.png, cut": png_with(chunk(b"iCCP", b"x\0\0" + zlib.compress(ADOBE_RGB[:300]))),
    "x.tif, cut": tiff_with(ADOBE_RGB[:300], PIXELS),
    "x.tif, float": tiff_with(ADOBE_RGB[:300], PIXELS.astype(np.float32) / 255),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_a_profile_that_cannot_be_used_is_left_out_with_a_word(case: str, tmp_path: Path) -> None:
    path = tmp_path / case.split(",", maxsplit=1)[0]
    path.write_bytes(UNUSABLE[case])
    developed = photo.develop(path)

    (remark,) = developed.remarks
    floating = "float" in case
    assert remark.endswith("read as linear light" if floating else "read as sRGB")
    assert developed.encoding.transfer == ("linear" if floating else "srgb")
    assert developed.encoding.icc is None


def test_where_a_profile_cannot_be_used_exif_may_still_say_the_colours(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(jpeg_with(parts_of(bytes(200), [(1, 1)]), exif(2)))
    developed = photo.develop(tmp_path / "x.jpg")

    assert is_adobe_rgb(developed.encoding.icc)
    assert developed.remarks[0].endswith("read as its other tags say")


# --- headers: kind, size and limits; damage --------------------------------------------------------


def png_claiming(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"")), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def encoded(kind: str, image: Image.Image | None = None) -> bytes:
    out = io.BytesIO()
    noise = np.random.default_rng(3).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    (image or Image.fromarray(noise)).save(out, kind)
    return out.getvalue()


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (b"MM\0*\0\0\0\x08", "tiff"),
        (b"II*\0\x10\0\0\0CR\x02\0", "raw"),
        (b"FUJIFILMCCD-RAW 0201", "raw"),
        (b"IIU\0\x18\0\0\0", "raw"),
        (b"IIRO\x08\0\0\0", "raw"),
        (b"\0\0\0\x18ftypcrx \0\0\0\x01", "raw"),
    ],
)
def test_sniff_names_the_kind_by_the_first_bytes(head: bytes, kind: str) -> None:
    assert photo.sniff(head) == kind


@pytest.mark.parametrize(
    ("error", "heads"),
    [
        (NotAnImageError, [b"", b"hello world", b"%!PS", b"\0" * 64, b"PK\x03\x04", b"\xff\xd8"]),
        (UnsupportedFormatError, [b"GIF89a", b"RIFF\0\0\0\0WEBPVP8 ", b"\0\0\0\x1cftypheic", b"8BPS\0\x01"]),
    ],
)
def test_sniff_tells_other_formats_from_what_is_no_image(error: type[Exception], heads: list[bytes]) -> None:
    for head in heads:
        with pytest.raises(error) as caught:
            photo.sniff(head)
        assert caught.type is error, head


def _stack() -> bytes:
    out = io.BytesIO()
    pages = np.zeros((100, 32, 32), dtype=np.uint8)
    tifffile.imwrite(out, pages, photometric="minisblack", metadata=None)
    return out.getvalue()


REFUSED: dict[str, tuple[Callable[[], bytes], type[LensModelError], str]] = {
    "a size without the bytes for it": (
        lambda: png_claiming(20000, 20000),
        DecompressionBombError,
        "20000 x 20000",
    ),
    "a bomb below the limit": (lambda: png_claiming(10000, 10000), DecompressionBombError, "10000"),
    "nothing": (bytes, NotAnImageError, "empty"),
    "CMYK": (lambda: encoded("JPEG", Image.new("CMYK", (64, 48))), UnsupportedFormatError, "convert it to"),
    "an icon": (lambda: encoded("PNG", Image.new("RGB", (8, 8))), NotAnImageError, "8 x 8"),
    "a hundred pictures": (_stack, UnsupportedFormatError, "pictures"),
    "12 bits": (lambda: encoded("JPEG").replace(b"\0\x11\x08", b"\0\x11\x0c"), NotAnImageError, "of 8 bits"),
    "stray bytes": (
        lambda: b"\xff\xd8\xff\xe0\0\x04ab" + b"\0\xff\0" * 20_000,
        TruncatedImageError,
        "header",
    ),
    "many segments": (
        lambda: jpeg_with(segments_of(0xE5, *[b""] * 50_001)),
        NotAnImageError,
        "within 32768 segments",
    ),
    "many stray bytes": (
        lambda: jpeg_with(segments_of(0xE5, b"") + bytes(200_000)),
        NotAnImageError,
        "within 32768 segments",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_photo_is_refused_with_the_reason(case: str, tmp_path: Path) -> None:
    content, error, text = REFUSED[case]
    (tmp_path / "really.nef").write_bytes(content())
    with pytest.raises(error, match=text):
        photo.inspect(tmp_path / "really.nef")


@pytest.mark.parametrize(
    ("limits", "most"),
    [(photo.Limits(max_bytes=100), "100$"), (photo.Limits(max_megapixels=0.001), r"0\.001 MP")],
)
@pytest.mark.parametrize("kind", ["PNG", "TIFF", "DNG"])
def test_the_limits_hold_for_every_kind_and_an_honest_photo_is_no_bomb(
    limits: photo.Limits, most: str, kind: str, tmp_path: Path
) -> None:
    (tmp_path / "x").write_bytes(_whole(kind, tmp_path / "x"))
    with pytest.raises(ImageTooLargeError, match=f"the limit is {most}") as caught:
        photo.inspect(tmp_path / "x", limits)

    assert not isinstance(caught.value, DecompressionBombError)


def _whole(kind: str, path: Path) -> bytes:
    """A photo's bytes; TIFF is told from DNG by what it holds."""
    if kind != "DNG":
        return encoded(kind)
    mosaic = np.random.default_rng(0).integers(600, 9000, (96, 128), dtype=np.uint16)
    write_bayer_dng(path, mosaic, black=512, white=15000)
    return path.read_bytes()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "DNG"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_a_file_that_was_cut_off_is_refused_before_it_is_decoded(
    tmp_path: Path, kind: str, share: float
) -> None:
    path = tmp_path / "cut"
    data = _whole(kind, path)
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises((TruncatedImageError, NotAnImageError)):
        photo.inspect(path)


@pytest.mark.parametrize("kind", ["PNG", "DNG"])
def test_of_a_damaged_photo_the_damage_is_said_and_not_what_else_it_lacks(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "damaged"
    data = bytearray(_whole(kind, path))
    middle = len(data) // 3
    data[middle:-30] = bytes(len(data) - 30 - middle)  # not the end chunk
    path.write_bytes(data)
    photo.inspect(path)  # nothing in its header shows it

    def refused(info: photo.PhotoInfo) -> None:
        raise MetadataMissingError("it does not say its aperture")

    with pytest.raises(UnreadablePhotoError):
        photo.develop(path, on_info=refused)


def test_a_tiff_whose_directories_form_a_loop_is_read_once(tmp_path: Path) -> None:
    data = bytearray(encoded("TIFF"))
    first = struct.unpack("<I", data[4:8])[0]
    count = struct.unpack("<H", data[first : first + 2])[0]
    data[first + 2 + 12 * count : first + 6 + 12 * count] = struct.pack("<I", first)
    path = tmp_path / "loop.tif"
    path.write_bytes(bytes(data))

    assert photo.inspect(path).width == 60


def test_one_number_of_a_huge_tag_unpacks_no_other() -> None:
    entry = Tag(kind=5, count=1 << 20, offset=0, order="<", buffer=struct.pack("<II", 7, 2) * (1 << 20))
    tracemalloc.start()
    found = Tags({1: entry}).number(1)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert found == 3.5
    assert peak < 2 * entry.count * 8  # a copy of the bytes; as numbers they take seven times as much


@pytest.mark.parametrize("version", [b"", b"\1\4\0\0"], ids=["tiff", "dng"])
def test_a_size_that_is_no_whole_number_is_no_size(tmp_path: Path, version: bytes) -> None:
    double = (12, struct.pack("<d", 1e300))
    (tmp_path / "x").write_bytes(laid_out({256: double, 257: double, 50706: (BYTE, version)}))

    with pytest.raises(LensModelError):
        photo.inspect(tmp_path / "x")


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data(), kind=st.sampled_from(["JPEG", "PNG", "TIFF", "DNG"]))
def test_a_damaged_header_gives_our_errors_or_a_photo(
    data: st.DataObject, kind: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "x"
    damaged = bytearray(_whole(kind, path))
    places = st.tuples(st.integers(0, min(len(damaged), 600) - 1), st.integers(0, 255))
    for at, value in data.draw(st.lists(places, min_size=1, max_size=6)):
        damaged[at] = value
    path.write_bytes(bytes(damaged))
    with contextlib.suppress(LensModelError):
        photo.inspect(path)
