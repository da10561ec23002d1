"""Colours that a file declares otherwise than by an ICC profile are honoured, and the result says so."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms
from PIL.TiffImagePlugin import IFDRational

from lensmodel import photo
from lensmodel.core.errors import UnsupportedFormatError
from lensmodel.photo.colour import matrix_profile, named_profile

REPORTS = Path(__file__).parents[2] / "data" / "reports"
ADOBE = (0.3127, 0.3290, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)
SRGB = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
P3 = (0.3127, 0.3290, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
PIXELS = np.kron(
    np.random.default_rng(5).integers(60, 200, (12, 16, 3), np.uint8), np.ones((4, 4, 1), np.uint8)
)


def to_xyz(space: tuple[float, ...], numbers: np.ndarray, gamma: float) -> np.ndarray:
    """XYZ of numbers 0..1 in a space, relative to its own white: the textbook's way, in our own hand."""
    xy = np.reshape(space, (4, 2))
    columns = np.column_stack([xy[:, 0] / xy[:, 1], np.ones(4), (1 - xy.sum(axis=1)) / xy[:, 1]]).T
    return (numbers**gamma) @ (columns[:, 1:] * np.linalg.solve(columns[:, 1:], columns[:, 0])).T


def shown_in_srgb(path: Path) -> np.ndarray:
    """What the corrected file shows, asked of its profile, to a program that honours it."""
    with Image.open(path) as image:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(image.info["icc_profile"]))
        return np.asarray(ImageCms.profileToProfile(image, profile, ImageCms.createProfile("sRGB")))


def srgb_of(space: tuple[float, ...], gamma: float | None) -> np.ndarray:
    """What sRGB shows of the pixels in a space with an exponent, or sRGB's own curve."""
    levels = PIXELS / 255.0
    if gamma is None:
        levels = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    linear = to_xyz(space, levels, gamma or 1.0) @ np.linalg.inv(to_xyz(SRGB, np.eye(3), 1.0))
    linear = np.clip(linear, 0.0, 1.0)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def written(source: Path, folder: Path) -> Path:
    developed = photo.develop(source)
    photo.write_image(folder / "out.png", developed.planes, developed.encoding, format="png8")
    return folder / "out.png"


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png_with(*chunks: bytes) -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(out, "PNG")
    return out.getvalue()[:33] + b"".join(chunks) + out.getvalue()[33:]


def chrm(space: tuple[float, ...]) -> bytes:
    return chunk(b"cHRM", struct.pack(">8I", *(round(100_000 * v) for v in space)))


def gama(value: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(100_000 * value)))


@pytest.mark.parametrize("name", ["adobergb-by-exif-only.jpg", "adobergb-chrm-gama.png"])
def test_adobergb_that_only_exif_or_chunks_declare_stays_adobergb(name: str, tmp_path: Path) -> None:
    source = REPORTS / name
    with Image.open(source) as image:
        numbers = np.asarray(image)

    result = written(source, tmp_path)

    with Image.open(result) as image:
        assert np.abs(np.asarray(image).astype(int) - numbers).max() <= 1
        known = matrix_profile(image.info["icc_profile"])
    assert known is not None
    assert known.to_xyz[:, 1] == pytest.approx([0.2053, 0.6257, 0.0609], abs=2e-3)  # AdobeRGB's green, D50
    assert known.curves[1][32768] == pytest.approx(0.5**2.2, abs=2e-3)


PNGS = {
    "cICP P3": (chunk(b"cICP", bytes((12, 13, 0, 1))), P3, None),
    "cICP before all others": (
        chunk(b"cICP", bytes((12, 8, 0, 1))) + chunk(b"sRGB", b"\0") + gama(0.45),
        P3,
        1.0,
    ),
    "cHRM alone": (chrm(P3), P3, 1 / 0.45455),
    "gAMA alone": (gama(1.0), SRGB, 1.0),
    "sRGB before both": (chunk(b"sRGB", b"\0") + chrm(ADOBE) + gama(1.0), SRGB, None),
    "as sRGB is approximated": (chrm(SRGB) + gama(0.45455), SRGB, None),
    "nonsense": (chrm((0.0,) * 8) + chunk(b"gAMA", bytes(4)), SRGB, None),
}


@pytest.mark.parametrize("case", PNGS)
def test_pngs_are_shown_as_their_chunks_say(case: str, tmp_path: Path) -> None:
    chunks, space, gamma = PNGS[case]
    (tmp_path / "x.png").write_bytes(png_with(chunks))

    shown = shown_in_srgb(written(tmp_path / "x.png", tmp_path))

    assert np.abs(shown - srgb_of(space, gamma)).max() < 3.0


@pytest.mark.parametrize(
    ("coded", "word"), [((9, 16, 0, 1), "PQ"), ((9, 18, 0, 1), "HLG"), ((1, 13, 1, 1), "1/13/1/1")]
)
def test_colours_that_are_not_read_are_refused_before_the_file_is_stored(
    coded: tuple[int, ...], word: str, tmp_path: Path
) -> None:
    (tmp_path / "x.png").write_bytes(png_with(chunk(b"cICP", bytes(coded))))

    with pytest.raises(UnsupportedFormatError, match=word):
        photo.inspect(tmp_path / "x.png")


def quotients(values: tuple[float, ...]) -> tuple[IFDRational, ...]:
    return tuple(IFDRational(round(10_000 * v), 10_000) for v in values)


JPEGS = {
    "ColorSpace 2": ({}, {0xA001: 2}, ADOBE, 563 / 256),
    "primaries and Gamma": (
        {318: quotients(P3[:2]), 319: quotients(P3[2:])},
        {0xA500: IFDRational(22, 10), 0xA001: 65535},
        P3,
        2.2,
    ),
    "ColorSpace 1 before primaries": (
        {318: quotients(P3[:2]), 319: quotients(P3[2:])},
        {0xA001: 1},
        SRGB,
        None,
    ),
    "nothing": ({}, {}, SRGB, None),
}


@pytest.mark.parametrize("case", JPEGS)
def test_jpegs_are_shown_as_their_exif_says(case: str, tmp_path: Path) -> None:
    main, exif, space, gamma = JPEGS[case]
    block = Image.Exif()
    for tag, value in main.items():
        block[tag] = value
    block.get_ifd(0x8769).update(exif)
    Image.fromarray(PIXELS).save(tmp_path / "x.jpg", quality=100, subsampling=0, exif=block)

    shown = shown_in_srgb(written(tmp_path / "x.jpg", tmp_path))

    expected = srgb_of(space, gamma)
    assert np.abs(shown - expected).max() < 8.0
    assert np.abs(shown - expected).mean() < 1.0


def test_a_profile_goes_before_what_else_is_declared(tmp_path: Path) -> None:
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    block = Image.Exif()
    block.get_ifd(0x8769)[0xA001] = 2
    Image.fromarray(PIXELS).save(tmp_path / "x.jpg", exif=block, icc_profile=srgb)

    assert photo.develop(tmp_path / "x.jpg").encoding.icc == srgb


def parts_of(profile: bytes, marks: list[tuple[int, int]]) -> bytes:
    """Segments of a JPEG with the parts of a profile, each with a number and a count."""
    ends = [len(profile) * k // len(marks) for k in range(len(marks) + 1)]
    bodies = [
        b"ICC_PROFILE\0" + bytes(mark) + profile[first:last]
        for mark, first, last in zip(marks, ends, ends[1:], strict=False)
    ]
    return b"".join(struct.pack(">BBH", 0xFF, 0xE2, len(body) + 2) + body for body in bodies)


def jpeg_with(segments: bytes, exif: Image.Exif | None = None) -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(
        out, "JPEG", quality=100, subsampling=0, exif=Image.Exif() if exif is None else exif
    )
    return out.getvalue()[:2] + segments + out.getvalue()[2:]


ADOBE_PROFILE = named_profile("adobergb")


@pytest.mark.parametrize(
    "marks",
    [
        [(1, 2), (2, 2)],
        [(1, 0), (2, 0)],
        [(1, 9), (2, 9), (3, 9)],
        [(0, 2), (1, 2)],
        [(1, 1), (1, 1), (1, 1)],
    ],
)
def test_a_profile_whose_parts_are_miscounted_is_honoured_all_the_same(
    marks: list[tuple[int, int]], tmp_path: Path
) -> None:
    (tmp_path / "x.jpg").write_bytes(jpeg_with(parts_of(ADOBE_PROFILE, marks)))
    developed = photo.develop(tmp_path / "x.jpg")

    assert (developed.encoding.icc, developed.remarks) == (ADOBE_PROFILE, ())
    assert np.abs(shown_in_srgb(written(tmp_path / "x.jpg", tmp_path)) - srgb_of(ADOBE, 563 / 256)).mean() < 1


def test_a_profile_that_stands_twice_in_a_jpeg_is_one(tmp_path: Path) -> None:
    twice = 2 * parts_of(ADOBE_PROFILE, [(1, 2), (2, 2)])
    (tmp_path / "x.jpg").write_bytes(jpeg_with(twice))

    assert photo.develop(tmp_path / "x.jpg").encoding.icc == ADOBE_PROFILE


def of_cmyk() -> bytes:
    profile = bytearray(ADOBE_PROFILE)
    profile[16:20] = b"CMYK"
    return bytes(profile)


def png_icc(packed: bytes) -> bytes:
    return png_with(chunk(b"iCCP", b"x\0\0" + packed))


def tiff_icc(profile: bytes, pixels: np.ndarray) -> bytes:
    out = io.BytesIO()
    tifffile.imwrite(out, pixels, photometric="rgb", iccprofile=profile, metadata=None)
    return out.getvalue()


UNUSABLE = {
    "x.jpg, a part is missing": jpeg_with(
        parts_of(ADOBE_PROFILE, [(1, 3), (2, 3), (3, 3)])[: -len(ADOBE_PROFILE) // 3 - 18]
    ),
    "x.jpg, nonsense": jpeg_with(parts_of(bytes(200), [(1, 1)])),
    "x.jpg, CMYK": jpeg_with(parts_of(of_cmyk(), [(1, 1)])),
    "x.png, not packed": png_icc(ADOBE_PROFILE),
    "x.png, cut": png_icc(zlib.compress(ADOBE_PROFILE[:300])),
    "x.tif, cut": tiff_icc(ADOBE_PROFILE[:300], PIXELS),
    "x.tif, float": tiff_icc(ADOBE_PROFILE[:300], PIXELS.astype(np.float32) / 255),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_a_profile_that_cannot_be_used_is_left_out_with_a_word(case: str, tmp_path: Path) -> None:
    path = tmp_path / case.split(",", maxsplit=1)[0]
    path.write_bytes(UNUSABLE[case])
    developed = photo.develop(path)

    (remark,) = developed.remarks
    assert remark.endswith("read as linear light" if "float" in case else "read as sRGB")
    assert (developed.encoding.transfer, developed.encoding.icc) == (
        "linear" if "float" in case else "srgb",
        None,
    )


@pytest.mark.parametrize("name", ["x.jpg", "x.png"])
def test_where_a_profile_cannot_be_used_the_file_says_its_colours_otherwise(
    name: str, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 2  # AdobeRGB
    data = jpeg_with(parts_of(bytes(200), [(1, 1)]), exif)
    if name == "x.png":
        data = png_with(chunk(b"iCCP", b"x\0\0" + ADOBE_PROFILE), chrm(ADOBE), gama(256 / 563))
    (tmp_path / name).write_bytes(data)
    developed = photo.develop(tmp_path / name)

    known = matrix_profile(developed.encoding.icc or b"")
    assert known is not None
    assert known.to_xyz[:, 1] == pytest.approx([0.2053, 0.6257, 0.0609], abs=2e-3)  # AdobeRGB's green, D50
    assert developed.remarks[0].endswith("read as its other tags say")
