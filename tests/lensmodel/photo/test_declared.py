"""Colours are those of a profile, of EXIF, or sRGB; others are refused, and a lost profile is told."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from lensmodel import photo
from lensmodel.core.errors import UnsupportedFormatError
from lensmodel.photo.colour import matrix_profile, named_profile

REPORTS = Path(__file__).parents[2] / "data" / "reports"
NO_EXIF = Image.Exif()
ADOBE_RGB = named_profile("adobergb")
PIXELS = np.kron(
    np.random.default_rng(5).integers(60, 200, (12, 16, 3), np.uint8), np.ones((4, 4, 1), np.uint8)
)


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


PROFILE = chunk(b"iCCP", b"x\0\0" + zlib.compress(ADOBE_RGB))


def png_with(*chunks: bytes) -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(out, "PNG")
    return out.getvalue()[:33] + b"".join(chunks) + out.getvalue()[33:]


def chrm(*places: float) -> bytes:
    return chunk(b"cHRM", struct.pack(">8I", *(round(100_000 * v) for v in places)))


def gama(value: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(100_000 * value)))


def exif(color_space: int) -> Image.Exif:
    block = Image.Exif()
    block.get_ifd(0x8769)[0xA001] = color_space
    return block


def jpeg_with(segments: bytes = b"", block: Image.Exif = NO_EXIF) -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(out, "JPEG", quality=100, subsampling=0, exif=block)
    return out.getvalue()[:2] + segments + out.getvalue()[2:]


def parts_of(profile: bytes, marks: list[tuple[int, int]]) -> bytes:
    """Segments of a JPEG with the parts of a profile, each with a number and a count."""
    ends = [len(profile) * k // len(marks) for k in range(len(marks) + 1)]
    bodies = [
        b"ICC_PROFILE\0" + bytes(mark) + profile[first:last]
        for mark, first, last in zip(marks, ends, ends[1:], strict=False)
    ]
    return b"".join(struct.pack(">BBH", 0xFF, 0xE2, len(body) + 2) + body for body in bodies)


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
