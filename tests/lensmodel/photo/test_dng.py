"""DNG files: what is written is what LibRaw and ExifRead give back."""

from __future__ import annotations

import math
import os
from datetime import datetime
from pathlib import Path
from typing import Any

import exifread
import numpy as np
import pytest
import rawpy
from numpy.typing import NDArray

from lensmodel import photo
from lensmodel.core.errors import InvalidInputError
from lensmodel.photo.colour import matrix3
from lensmodel.photo.dng import BAYER_PATTERNS, XYZ_TO_SRGB, write_bayer_dng
from lensmodel.photo.values import LensIdentity, PhotoMetadata

SHOT = PhotoMetadata(
    camera_maker="Maker",
    camera_model="Body 1",
    body_serial="B123",
    lens=LensIdentity("Glass", "Güte 24-70mm f/2.8", "L0045", "exif"),
    aperture=2.8,
    focal_mm=35.0,
    focus_m=3.25,
    iso=400,
    exposure_s=1 / 320,
    taken_at=datetime(2026, 3, 4, 5, 6, 7),  # noqa: DTZ001 -- EXIF times have no zone
    pixel_pitch_um=4.5,
    orientation=6,
)


def mosaic(height: int = 64, width: int = 96) -> NDArray[np.uint16]:
    return np.random.default_rng(0).integers(400, 15873, (height, width), dtype=np.uint16)


@pytest.mark.parametrize("pattern", BAYER_PATTERNS)
def test_raw_numbers_and_pattern_come_back(tmp_path: Path, pattern: str) -> None:
    written = mosaic()
    write_bayer_dng(tmp_path / "a.dng", written, black=512, white=15872, pattern=pattern, metadata=SHOT)

    with rawpy.imread(str(tmp_path / "a.dng")) as raw:
        np.testing.assert_array_equal(raw.raw_image, written)
        letters = "".join(raw.color_desc.decode()[i] for i in raw.raw_pattern.ravel())
        assert letters == pattern
        assert raw.black_level_per_channel == [512] * 4
        assert raw.white_level == 15872


def test_colours_come_out_as_the_matrix_and_the_neutral_say(tmp_path: Path) -> None:
    balance = np.array([2.0, 1.0, 1.6])
    colour = np.array([0.6, 0.3, 0.1])
    planes = np.broadcast_to((colour / balance)[:, None, None], (3, 32, 48))
    to_camera = matrix3(np.asarray(XYZ_TO_SRGB) / balance[:, None])
    encoding = photo.Encoding(white_balance=tuple(balance), xyz_to_camera=to_camera)
    photo.write_image(tmp_path / "c.dng", planes, encoding, format="dng")

    with rawpy.imread(str(tmp_path / "c.dng")) as raw:
        developed = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, adjust_maximum_thr=0.0, use_camera_wb=True, output_bps=16
        )
        assert raw.camera_whitebalance[:3] == pytest.approx(balance.tolist())
    np.testing.assert_allclose(developed[16, 24] / 65535, colour, atol=1e-3)


def test_every_tag_comes_back_and_unknown_ones_are_left_out(tmp_path: Path) -> None:
    def tags_of(metadata: PhotoMetadata) -> dict[str, Any]:
        path = tmp_path / "tags.dng"
        write_bayer_dng(path, mosaic(), black=512, white=15872, metadata=metadata, description="a test")
        with path.open("rb") as file:
            return exifread.process_file(file)

    tags = tags_of(SHOT)
    wanted = {
        "Image Make": "Maker",
        "Image Model": "Body 1",
        "Image ImageDescription": "a test",
        "Image DateTime": "2026:03:04 05:06:07",
        "Image Orientation": "Rotated 90 CW",
        "EXIF FNumber": "14/5",
        "EXIF FocalLength": "35",
        "EXIF SubjectDistance": "13/4",
        "EXIF ISOSpeedRatings": "400",
        "EXIF ExposureTime": "1/320",
        "EXIF DateTimeOriginal": "2026:03:04 05:06:07",
        "EXIF BodySerialNumber": "B123",
        "EXIF LensMake": "Glass",
        "EXIF LensModel": "G?te 24-70mm f/2.8",
        "EXIF LensSerialNumber": "L0045",
        "EXIF FocalPlaneResolutionUnit": "3",
    }
    assert {name: str(tags[name]) for name in wanted} == wanted
    per_cm = tags["EXIF FocalPlaneXResolution"].values[0]
    assert 10_000 / (per_cm.num / per_cm.den) == pytest.approx(4.5)
    bare = tags_of(PhotoMetadata(focus_m=math.inf))
    assert str(bare["EXIF SubjectDistance"]) == str(2**32 - 1)  # infinity, as EXIF says it
    assert not {"LensModel", "LensSerialNumber", "FNumber", "FocalLength", "ISOSpeedRatings"} & {
        name.removeprefix("EXIF ") for name in bare
    }


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"mosaic": mosaic(63, 96)}, "even sides"),
        ({"pattern": "RGBW"}, "pattern"),
        ({"black": 100}, "black < white"),
        ({"color_matrix": np.eye(2)}, "3 x 3"),
        ({"as_shot_neutral": (0.0, 1.0, 1.0)}, "positive"),
    ],
    ids=str,
)
def test_wrong_arguments_are_refused(change: dict[str, Any], text: str, tmp_path: Path) -> None:
    given: dict[str, Any] = {"mosaic": mosaic(), "black": 0, "white": 100, **change}
    with pytest.raises(InvalidInputError, match=text):
        write_bayer_dng(tmp_path / "no.dng", **given)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("maker", "model", "unique"),
    [("Maker", "Body 1", "Maker Body 1"), ("Maker", "Maker Body 1", "Maker Body 1"), ("", "Body", "Body")],
)
def test_camera_is_named_with_its_maker_once(tmp_path: Path, maker: str, model: str, unique: str) -> None:
    path = tmp_path / "n.dng"
    metadata = PhotoMetadata(camera_maker=maker, camera_model=model)

    write_bayer_dng(path, mosaic(), black=256, white=15872, metadata=metadata)

    assert unique.encode() + b"\0" in path.read_bytes()
    assert b"Maker Maker" not in path.read_bytes()


def test_files_are_as_private_as_their_writer_asks(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        write_bayer_dng(tmp_path / "x.dng", mosaic(), black=512, white=15872)
    finally:
        os.umask(before)

    assert (tmp_path / "x.dng").stat().st_mode & 0o777 == 0o600
