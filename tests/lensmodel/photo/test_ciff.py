"""CRW files: what their heap says, and the white balance that only their JPEG shows."""

from __future__ import annotations

import io
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import rawpy
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from lensmodel import photo
from lensmodel.core.errors import TruncatedImageError
from lensmodel.photo.headers.ciff import MAX_HEAPS, MAX_RECORDS, read_ciff
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.raw import raw_size
from lensmodel.photo.rendition import balance_of_rendition
from lensmodel.photo.tags.metadata import read_metadata

DATA = Path(os.environ.get("LENSMODEL_TEST_DATA", "no data"))
Value = bytes | dict[int, "Value"]

SHOT = 0x102A
D30: dict[int, Value] = {
    0x2807: {0x080A: b"Canon\0Canon EOS D30\0\0\xfb\x7f", 0x3004: {0x180B: struct.pack("<I", 0x123509AA)}},
    0x300A: {
        0x180E: struct.pack("<III", 1514811812, 0, 0),
        0x1810: struct.pack("<IIfi", 2160, 1440, 1.0, 90),
        0x300B: {
            0x1029: struct.pack("<4H", 0, 31, 914, 610),
            SHOT: struct.pack("<25h", 50, 0, 160, -96, 159, -74, *([0] * 13), 157, 119, 160, -76, 70, 0),
            0x102D: struct.pack("<32H", 64, *([0] * 22), 35, 16, 1, *([0] * 6)),
        },
    },
}


def heap(records: Mapping[int, Value], order: str = "<") -> bytes:
    """Lay a heap out: values, directory, and where that begins. What fits goes into the directory."""
    body, entries = b"", b""
    for tag, value in records.items():
        data = heap(value, order) if isinstance(value, dict) else value
        if isinstance(value, bytes) and len(value) <= 8 and not tag & 0x2000:
            entries += struct.pack(f"{order}H", tag | 0x4000) + data.ljust(8, b"\0")
        else:
            entries += struct.pack(f"{order}HII", tag, len(data), len(body))
            body += data
    return body + struct.pack(f"{order}H", len(records)) + entries + struct.pack(f"{order}I", len(body))


def crw(records: Mapping[int, Value] = D30, order: str = "<") -> bytes:
    mark = b"II" if order == "<" else b"MM"
    return mark + struct.pack(f"{order}I", 26) + b"HEAPCCDR" + bytes(12) + heap(records, order)


def test_heap_says_camera_lens_and_exposure() -> None:
    shot = read_ciff(crw())

    assert shot is not None
    assert (shot.maker, shot.model, shot.body_serial) == ("Canon", "Canon EOS D30", "1235-02474")
    assert (shot.lens_model, shot.focal_mm, shot.aperture, shot.iso) == ("16-35 mm", 31.0, 5.7, 100.0)
    assert shot.taken_at == datetime.fromisoformat("2018-01-01T13:03:32")
    assert shot.exposure_s == pytest.approx(2 ** (7 / 3))  # 76 is two stops and a third
    assert shot.focus_m == pytest.approx(math.sqrt(1.57 * 1.19))
    assert shot.orientation == 6
    assert shot.pitch_um == pytest.approx(0.914 * 25400 / 2160)


def test_both_byte_orders_are_read() -> None:
    shot = read_ciff(crw({0x1029: struct.pack(">4H", 0, 200, 0, 0)}, ">"))

    assert shot is not None
    assert shot.focal_mm == 200.0


@pytest.mark.parametrize(
    ("stops", "aperture"), [(96, 2.8), (107, 3.2), (0x6C, 3.2), (0x74, 3.6), (64, 2.0), (0, None)]
)
def test_aperture_counts_thirds_of_a_stop(stops: int, aperture: float | None) -> None:
    shot = read_ciff(crw({SHOT: struct.pack("<25h", 50, *([0] * 20), stops, 0, 0, 0)}))

    assert shot is not None
    assert shot.aperture == aperture


def test_newer_cameras_say_exposure_in_apex_units() -> None:
    shot = read_ciff(crw({0x1818: struct.pack("<fff", 0.0, 7.0, 4.0)}))

    assert shot is not None
    assert (shot.aperture, shot.exposure_s) == (4.0, 1 / 128)


def test_focal_length_is_in_the_units_of_its_camera() -> None:
    compact: dict[int, Value] = {
        0x1029: struct.pack("<4H", 2, 682, 0, 0),
        0x102D: struct.pack("<32H", 64, *([0] * 22), 682, 227, 32, *([0] * 6)),
    }
    shot = read_ciff(crw(compact))

    assert shot is not None
    assert shot.focal_mm == 682 / 32
    assert shot.lens_model == "7.09375-21.3125 mm"


def test_what_no_camera_says_is_unknown(tmp_path: Path) -> None:
    path = tmp_path / "odd.crw"
    path.write_bytes(crw({0x1029: struct.pack("<4H", 0, 31, 65535, 0), 0x080A: b"Ca\x14non\0\x01\x02\0"}))
    seen = read_metadata(path)

    assert seen.focal_mm == 31.0
    assert (seen.camera_maker, seen.camera_model) == (None, None)
    assert (seen.aperture, seen.pixel_pitch_um, seen.iso, seen.taken_at) == (None, None, None, None)


def test_a_heap_inside_itself_ends() -> None:
    # the only record is a heap that begins and ends where its parent does
    whole = bytearray(crw({0x300A: b"x" * 4096}))
    at = 26 + struct.unpack_from("<I", whole, len(whole) - 4)[0]
    struct.pack_into("<HII", whole, at + 2, 0x300A, len(whole) - 26, 0)

    assert read_ciff(bytes(whole)) is not None


def test_records_and_heaps_are_bounded() -> None:
    late: dict[int, Value] = dict.fromkeys(range(MAX_RECORDS), b"12345678")
    assert read_ciff(crw({**late, 0x1029: struct.pack("<4H", 0, 31, 0, 0)})) == read_ciff(crw({}))

    deep: dict[int, Value] = {0x1029: struct.pack("<4H", 0, 31, 0, 0)}
    for _ in range(MAX_HEAPS):
        deep = {0x300A: deep}
    assert read_ciff(crw(deep)) == read_ciff(crw({}))
    assert read_ciff(crw(deep[0x300A])) != read_ciff(crw({}))  # type: ignore[arg-type]  # one less is read


@settings(max_examples=150)
@given(cut=st.integers(0, len(crw())))
def test_a_cut_file_says_less_and_raises_nothing(cut: int) -> None:
    assert cut < 14 or read_ciff(crw()[:cut]) is not None


@settings(max_examples=200)
@given(changes=st.lists(st.tuples(st.integers(14, len(crw()) - 1), st.integers(0, 255)), max_size=12))
def test_damage_raises_nothing_and_gives_finite_numbers(
    changes: list[tuple[int, int]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = bytearray(crw())
    for at, value in changes:
        data[at] = value
    path = tmp_path_factory.getbasetemp() / "damaged.crw"  # a folder for each would take longer than all else
    path.write_bytes(data)
    seen = read_metadata(path)

    for value in (seen.aperture, seen.focal_mm, seen.iso, seen.exposure_s, seen.pixel_pitch_um):
        assert value is None or (math.isfinite(value) and value > 0)


@given(rest=st.binary(max_size=400), order=st.sampled_from([b"II", b"MM"]))
def test_any_bytes_after_the_mark_are_survived(rest: bytes, order: bytes) -> None:
    start = struct.pack("<I" if order == b"II" else ">I", 14)
    assert read_ciff(order + start + b"HEAPCCDR" + rest) is not None


@given(data=st.binary(max_size=64))
def test_other_files_are_no_heap(data: bytes) -> None:
    assert data[6:14] == b"HEAPCCDR" or read_ciff(data) is None


@pytest.mark.skipif(not (DATA / "real/canon_d30_xmas_tree.crw").exists(), reason="needs the real file")
def test_a_real_crw_names_its_settings_and_is_balanced_for_its_light() -> None:
    path = DATA / "real/canon_d30_xmas_tree.crw"
    seen = photo.inspect(path).metadata

    assert (seen.aperture, seen.focal_mm, seen.iso) == (5.7, 31.0, 100.0)
    assert (seen.body_serial, seen.taken_at) == ("1235-02474", datetime.fromisoformat("2018-01-01T13:03:32"))
    # The scene is lit by bulbs; the camera's own multipliers for them, in its table, are 1.20 and 1.93.
    assert photo.develop(path).white_balance == pytest.approx((1.2, 1.0, 1.93), rel=0.05)


@dataclass(frozen=True)
class Opened:
    """As much of an opened RAW file as the estimate looks at."""

    jpeg: bytes

    def extract_thumb(self) -> rawpy.Thumbnail:
        if not self.jpeg:
            raise rawpy.LibRawNoThumbnailError
        return rawpy.Thumbnail(rawpy.ThumbFormat.JPEG, self.jpeg)


def scene(seed: int = 0, *, grey: bool = True) -> np.ndarray:
    """Linear light of 32 x 48 even squares, grey ones among coloured ones."""
    rng = np.random.default_rng(seed)
    colour = rng.uniform(0.05, 0.5, (32, 48, 1)) * rng.uniform(0.2, 1.0, (32, 48, 3))
    if grey:
        colour[::2] = rng.uniform(0.05, 0.4, (16, 48, 1)) * rng.normal(1.0, 0.03, (16, 48, 3))
    return np.repeat(np.repeat(colour, 16, axis=0), 16, axis=1)


def mosaic_of(light: np.ndarray, balance: tuple[float, float, float]) -> Mosaic:
    colours = np.tile(np.array([[0, 1], [3, 2]], dtype=np.uint8), (light.shape[0] // 2, light.shape[1] // 2))
    channel = np.where(colours == 3, 1, colours)
    values = np.take_along_axis(light / np.array(balance), channel[:, :, None], axis=2)[..., 0]
    return Mosaic((128 + values * 3900).astype(np.uint16), colours, (128.0,) * 4, 4028, is_bayer=True)


def jpeg_of(light: np.ndarray) -> bytes:
    out = io.BytesIO()
    gamma = np.where(light < 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    Image.fromarray((np.clip(gamma, 0, 1) * 255).astype(np.uint8)).save(out, "JPEG", quality=92)
    return out.getvalue()


@pytest.mark.parametrize("balance", [(1.2, 1.0, 1.9), (2.1, 1.0, 1.1), (0.9, 1.0, 2.4)])
def test_balance_is_read_off_the_cameras_own_jpeg(balance: tuple[float, float, float]) -> None:
    light = scene()
    seen = balance_of_rendition(
        Opened(jpeg_of(1.5 * light)),  # type: ignore[arg-type]  # a brighter rendering changes no hue
        mosaic_of(light, balance),
        None,
    )

    assert seen == pytest.approx((balance[0], balance[2]), rel=0.03)


@pytest.mark.parametrize(
    "jpeg",
    [b"", b"\xff\xd8\xff", jpeg_of(scene())[:2000], jpeg_of(scene(1)), jpeg_of(scene()[:, :512])],
    ids=["none", "damaged", "cut", "another picture", "another shape"],
)
def test_balance_is_unknown_without_a_jpeg_of_the_photo(jpeg: bytes) -> None:
    mosaic = mosaic_of(scene(), (1.2, 1.0, 1.9))
    assert balance_of_rendition(Opened(jpeg), mosaic, None) is None  # type: ignore[arg-type]  # as above


def test_balance_is_unknown_where_nothing_is_grey() -> None:
    light = scene(grey=False) * np.array([1.0, 0.3, 0.1])
    mosaic = mosaic_of(light, (1.2, 1.0, 1.9))
    assert balance_of_rendition(Opened(jpeg_of(light)), mosaic, None) is None  # type: ignore[arg-type]  # as above


@pytest.mark.parametrize("kept", [0.5, 0.99])
def test_a_crw_that_is_cut_off_is_damaged_not_of_an_unknown_kind(kept: float, tmp_path: Path) -> None:
    whole = crw({**D30, 0x2005: bytes(4096)})
    for name, data in (("whole.crw", whole), ("cut.crw", whole[: int(len(whole) * kept)])):
        (tmp_path / name).write_bytes(data)

    raw_size(tmp_path / "whole.crw")
    with pytest.raises(TruncatedImageError, match="damaged"):
        raw_size(tmp_path / "cut.crw")


@pytest.mark.parametrize("head", [b"II*\0\x10\0\0\0CR\x02\0", b"\0MRM"], ids=["CR2", "MRW"])
def test_other_kinds_that_no_camera_writes_anew_are_damaged_too(head: bytes, tmp_path: Path) -> None:
    path = tmp_path / "photo.raw"
    path.write_bytes(head + bytes(400))
    with pytest.raises(TruncatedImageError, match="damaged"):
        raw_size(path)
