"""CRW files: what is known of them, and the white balance that only their JPEG shows."""

from __future__ import annotations

import io
import os
import struct
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import rawpy
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from lensmodel import photo
from lensmodel.core.errors import TruncatedImageError
from lensmodel.photo.containers import opened_header
from lensmodel.photo.metadata import Said
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.raw import balance_of_rendition, opened_raw

DATA = Path(os.environ.get("LENSMODEL_TEST_DATA", "no data"))
HEAP = b"II" + struct.pack("<I", 26) + b"HEAPCCDR" + bytes(12)


def read_metadata(path: Path) -> photo.PhotoMetadata:
    """What the header says, also of a file that holds no picture."""
    with opened_header(path, photo.Limits()) as header:
        return Said.of(header).metadata()


@pytest.mark.parametrize(
    ("record", "model"),
    [(b"Canon\0Canon EOS D30\0\0\xfb\x7f", "Canon EOS D30"), (b"Ca\x14non\0\x01\0", None)],
)
def test_the_camera_of_a_crw_is_named(record: bytes, model: str | None, tmp_path: Path) -> None:
    (tmp_path / "x.crw").write_bytes(HEAP + record)

    seen = read_metadata(tmp_path / "x.crw")

    assert (seen.camera_maker, seen.camera_model) == ("Canon", model)


@given(rest=st.binary(max_size=400), order=st.sampled_from([b"II", b"MM"]))
def test_any_bytes_after_the_mark_are_survived(
    rest: bytes, order: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.crw"  # a folder for each would take longer than all else
    path.write_bytes(order + struct.pack("<I", 14) + b"HEAPCCDR" + rest)

    assert read_metadata(path).camera_maker == "Canon"


@pytest.mark.skipif(not (DATA / "real/canon_d30_xmas_tree.crw").exists(), reason="needs the real file")
def test_a_real_crw_names_its_settings_and_is_balanced_for_its_light() -> None:
    path = DATA / "real/canon_d30_xmas_tree.crw"
    seen = photo.inspect(path).metadata

    assert (seen.aperture, seen.focal_mm, seen.iso) == (5.6, 31.0, 100.0)
    assert (seen.camera_model, seen.taken_at) == (
        "Canon EOS D30",
        datetime.fromisoformat("2018-01-01T13:03:32"),
    )
    # The scene is lit by bulbs; the camera's own multipliers for them, in its table, are 1.20 and 1.93.
    assert photo.develop(path).encoding.white_balance == pytest.approx((1.2, 1.0, 1.93), rel=0.05)


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
    rows, cols = np.indices(light.shape[:2]) % 2
    colours = np.array([[0, 1], [3, 2]], dtype=np.uint8)[rows, cols]
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


def test_balance_is_read_of_a_mosaic_of_odd_sides_too() -> None:
    light, balance = scene()[:-1, :-1], (1.2, 1.0, 1.9)
    opened = Opened(jpeg_of(1.5 * light))

    seen = balance_of_rendition(opened, mosaic_of(light, balance), None)  # type: ignore[arg-type]  # as above

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


@pytest.mark.parametrize("head", [HEAP, b"II*\0\x10\0\0\0CR\x02\0", b"\0MRM"], ids=["CRW", "CR2", "MRW"])
def test_a_kind_that_no_camera_writes_anew_is_damaged_and_not_unknown(head: bytes, tmp_path: Path) -> None:
    path = tmp_path / "photo.raw"
    path.write_bytes(head + bytes(400))
    with pytest.raises(TruncatedImageError, match="damaged"), opened_raw(path):
        pass
