from __future__ import annotations

import contextlib
import io
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

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
from lensmodel.photo.tiff import BYTE, Tag, Tags, Value, laid_out
from lensmodel.photo.writing import write_bayer_dng


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png_claiming(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )


def encoded(kind: str, image: Image.Image | None = None) -> bytes:
    out = io.BytesIO()
    noise = np.random.default_rng(3).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    (image or Image.fromarray(noise)).save(out, kind)
    return out.getvalue()


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (b"\xff\xd8\xff\xe0", "jpeg"),
        (b"\x89PNG\r\n\x1a\n", "png"),
        (b"II*\0\x08\0\0\0", "tiff"),
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


@pytest.mark.parametrize("head", [b"", b"hello world", b"%!PS", b"\0" * 64, b"PK\x03\x04", b"\xff\xd8"])
def test_sniff_refuses_what_is_no_image(head: bytes) -> None:
    with pytest.raises(NotAnImageError):
        photo.sniff(head)


@pytest.mark.parametrize("head", [b"GIF89a", b"RIFF\0\0\0\0WEBPVP8 ", b"\0\0\0\x1cftypheic", b"8BPS\0\x01"])
def test_sniff_says_which_image_formats_it_does_not_read(head: bytes) -> None:
    with pytest.raises(UnsupportedFormatError, match="not read"):
        photo.sniff(head)


@given(st.binary(max_size=64))
def test_sniff_never_raises_anything_else(head: bytes) -> None:
    with contextlib.suppress(LensModelError):
        photo.sniff(head)


@pytest.mark.parametrize(
    ("kind", "size"), [("JPEG", (60, 40)), ("PNG", (60, 40)), ("TIFF", (60, 40)), ("DNG", (128, 96))]
)
def test_inspect_tells_kind_and_size(kind: str, size: tuple[int, int], tmp_path: Path) -> None:
    (tmp_path / "photo").write_bytes(_whole(kind, tmp_path / "photo"))
    info = photo.inspect(tmp_path / "photo")

    assert (info.kind, (info.width, info.height)) == (kind.lower(), size)


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


@pytest.mark.parametrize("version", [None, (BYTE, b"\1\4\0\0")], ids=["tiff", "dng"])
def test_a_size_that_is_no_whole_number_is_no_size(tmp_path: Path, version: Value | None) -> None:
    double = (12, struct.pack("<d", 1e300))
    (tmp_path / "x").write_bytes(laid_out({256: double, 257: double, 50706: version}, {}))

    with pytest.raises(LensModelError):
        photo.inspect(tmp_path / "x")


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data(), kind=st.sampled_from(["JPEG", "PNG", "TIFF", "DNG"]))
def test_a_damaged_header_gives_our_errors_or_a_photo(
    data: st.DataObject, kind: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "x"
    if kind == "DNG":
        write_bayer_dng(path, np.full((32, 32), 900, dtype=np.uint16), black=512, white=15000)
    else:
        path.write_bytes(encoded(kind))
    damaged = bytearray(path.read_bytes())
    places = st.tuples(st.integers(0, min(len(damaged), 600) - 1), st.integers(0, 255))
    for at, value in data.draw(st.lists(places, min_size=1, max_size=6)):
        damaged[at] = value
    path.write_bytes(bytes(damaged))
    with contextlib.suppress(LensModelError):
        photo.inspect(path)
