"""Which picture of a file is the photo, and what its numbers and colours are; what is no photo is refused."""

from __future__ import annotations

import io
import struct
import tracemalloc
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from lensmodel import photo
from lensmodel.core.errors import NotAnImageError, TruncatedImageError, UnsupportedFormatError
from lensmodel.photo.colour import matrix_profile, named_profile
from lensmodel.photo.mosaic import require_known_mosaic
from lensmodel.photo.tiff import BYTE, laid_out, longs, shorts

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
        (np.zeros((48, 64, 6), np.uint8), {"photometric": "rgb", "planarconfig": "contig"}, "6 channels"),
        (np.zeros((48, 64), np.int16), {"photometric": "minisblack"}, "signed"),
        (np.zeros((48, 64), np.complex64), {"photometric": "minisblack"}, "complex"),
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
    data, at = jpeg_with(block=camera("T-1")), 2
    for _ in range(segment):
        at += 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    (tmp_path / "x.jpg").write_bytes(data[:at] + stray + data[at:])

    with Image.open(tmp_path / "x.jpg") as image:
        assert np.abs(numbers(tmp_path / "x.jpg") - np.int16(image)).max() <= 1
    assert photo.inspect(tmp_path / "x.jpg").metadata.camera_model == "T-1"


def test_a_jpeg_of_stray_bytes_alone_ends_inside_its_header(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(b"\xff\xd8\xff\xe0\0\x04ab" + b"\0\xff\0" * 20_000)

    with pytest.raises(TruncatedImageError):
        photo.inspect(tmp_path / "x.jpg")


@pytest.mark.parametrize("rows", [["RG", "G"], ["R", "GB"], ["RG", ""], []])
def test_a_mosaic_that_names_too_few_colours_is_refused(rows: list[str]) -> None:
    with pytest.raises(UnsupportedFormatError):
        require_known_mosaic(rows)


@pytest.mark.parametrize("parts", [segments_of(0xE5, *[b""] * 50_000), b"\0".join([b""] * 200_000)])
def test_a_jpeg_header_of_very_many_parts_is_refused(parts: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(jpeg_with(segments_of(0xE5, b"") + parts))

    with pytest.raises(NotAnImageError, match="within 32768 segments"):
        photo.inspect(tmp_path / "x.jpg")


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
@pytest.mark.parametrize("beside", [b"iCCP", b"zTXt", b"gAMA"])
def test_what_stands_beside_a_png_is_not_unpacked_to_decode_it(
    mode: str, beside: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    body = b"" if beside == b"gAMA" else b"x\0\0" + zlib.compress(bytes(12 << 20))
    (tmp_path / "x.png").write_bytes(png_with(chunk(beside, body), mode=mode))

    shown = numbers(tmp_path / "x.png")

    assert (shown == np.asarray(Image.fromarray(PIXELS).convert(mode).convert("RGB"))).all()
    assert capfd.readouterr() == ("", "")  # libpng prints what it finds amiss


# --- colours: of a profile, of EXIF, or sRGB; others are refused, and a lost profile is told -----------

NO_EXIF = Image.Exif()
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
    known = matrix_profile(icc or b"")
    return (
        known is not None
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
