"""Photos whose pixels a program has turned upright: how they lay on the sensor."""

from __future__ import annotations

import io
import math
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel import photo
from lensmodel.api import _Posteriors
from lensmodel.blind.sampling import find_patches
from lensmodel.core.errors import TurnedPixelsError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel, ModelSettings

Picture = NDArray[np.uint8]


def scene(seed: int = 0) -> Picture:
    """Something that looks different from each side, as the sensor sees it: 200 rows of 300 pixels."""
    noise = np.random.default_rng(seed).normal(size=(200, 300, 3))
    smooth = ndimage.gaussian_filter(noise, (12, 12, 0))
    return np.uint8(np.clip(128 + 60 * smooth / smooth.std() + 4 * noise, 0, 255))


def thumbnail(picture: Picture, *, bars: bool = False) -> bytes:
    """A JPEG of 160 pixels, as cameras embed it; with black bars of the shape 4 : 3."""
    small = Image.fromarray(picture)
    small.thumbnail((160, 160))
    if bars:
        framed = Image.new("RGB", (160, 120))
        framed.paste(small, (0, (120 - small.height) // 2))
        small = framed
    out = io.BytesIO()
    small.save(out, "JPEG", quality=80)
    return out.getvalue()


def exif(small: bytes | None, orientation: int | None = 1) -> bytes:
    """Camera, orientation and thumbnail."""
    first = [(0x0110, 2, 4, b"T-1\0")]
    first += [] if orientation is None else [(0x0112, 3, 1, struct.pack("<HH", orientation, 0))]
    second = 8 + 2 + 12 * len(first) + 4
    data = second + 2 + 12 * 2 + 4
    numbers = [] if small is None else [(0x0201, data), (0x0202, len(small))]
    entries = [(tag, 4, 1, struct.pack("<I", value)) for tag, value in numbers]
    out = b"II*\0" + struct.pack("<I", 8)
    for directory, following in ((first, second if entries else 0), (entries, 0)):
        out += struct.pack("<H", len(directory))
        out += b"".join(struct.pack("<HHI", *entry[:3]) + entry[3] for entry in directory)
        out += struct.pack("<I", following)
    return b"Exif\0\0" + out + (small or b"")


def written(path: Path, picture: Picture, block: bytes) -> photo.PhotoInfo:
    Image.fromarray(picture).save(path, exif=block, **({"quality": 95} if path.suffix == ".jpg" else {}))
    return photo.inspect(path)


def large_jpeg() -> bytes:
    """A JPEG of 24 megapixels in few bytes."""
    out = io.BytesIO()
    Image.new("L", (6000, 4000)).save(out, "JPEG", quality=20)
    return out.getvalue()[:60_000]


@pytest.mark.parametrize("small", [large_jpeg(), b"\x89PNG\r\n\x1a\n\0\0", b"\xff\xd8\xff\xd9", b""])
def test_a_hostile_thumbnail_tells_nothing_and_is_not_unpacked(small: bytes, tmp_path: Path) -> None:
    upright = np.ascontiguousarray(np.rot90(scene(), -1))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert written(tmp_path / "x.jpg", upright, exif(small)).turns is None


@pytest.mark.parametrize("name", ["x.png", "x.jpg"])
@pytest.mark.parametrize("bars", [False, True])
@pytest.mark.parametrize("tag", [1, None])
@pytest.mark.parametrize(("turns", "orientation"), [(1, 6), (3, 8)])
def test_the_cameras_thumbnail_tells_how_a_turned_photo_lay_on_the_sensor(
    name: str, bars: bool, tag: int | None, turns: int, orientation: int, tmp_path: Path
) -> None:
    sensor = scene()
    upright = np.ascontiguousarray(np.rot90(sensor, -turns))

    info = written(tmp_path / name, upright, exif(thumbnail(sensor, bars=bars), tag))
    turned = photo.develop(tmp_path / name)

    assert (info.width, info.height, info.metadata.orientation, info.turns) == (300, 200, orientation, turns)
    written(tmp_path / f"as-it-was-{name}", sensor, exif(thumbnail(sensor), orientation))
    straight = photo.develop(tmp_path / f"as-it-was-{name}")
    assert turned.remarks == straight.remarks == ()
    assert np.abs(turned.planes - straight.planes).mean() < (0.02 if name == "x.jpg" else 1e-9)
    photo.write_image(
        tmp_path / "again.png", turned.planes, turned.encoding, format="png8", color_space="srgb"
    )
    with Image.open(tmp_path / "again.png") as again, Image.open(tmp_path / name) as given:
        assert np.abs(np.int16(again) - np.int16(given)).max() <= 1  # it stands upright, as it was given


@pytest.mark.parametrize("case", ["no thumbnail", "turned along", "of another picture"])
def test_where_nothing_tells_it_is_not_learned_from_and_the_reason_is_said(case: str, tmp_path: Path) -> None:
    upright = np.ascontiguousarray(np.rot90(scene()))
    small = {
        "no thumbnail": None,
        "turned along": thumbnail(upright),
        "of another picture": thumbnail(scene(1)),
    }[case]

    info = written(tmp_path / "x.jpg", upright, exif(small))
    developed = photo.develop(tmp_path / "x.jpg")

    assert (info.width, info.height, info.turns) == (200, 300, None)
    assert any("turned its pixels" in remark for remark in developed.remarks)
    with pytest.raises(TurnedPixelsError, match="give the file as the camera wrote it"):
        find_patches(developed, count=4)


@pytest.mark.parametrize(
    ("rows", "cols", "orientation", "model"),
    [(300, 200, 6, True), (200, 300, 1, True), (200, 200, 1, True), (300, 200, 1, False)],
)
def test_other_photos_lie_as_they_are_stored(
    rows: int, cols: int, orientation: int, model: bool, tmp_path: Path
) -> None:
    block = exif(None, orientation) if model else b""

    info = written(tmp_path / "x.jpg", np.zeros((rows, cols, 3), np.uint8), block)

    assert (info.width, info.height, info.turns) == (cols, rows, 0)


def posterior(softer_right: float, turns: tuple[int, ...], place: FieldPosition) -> tuple[Picture, float]:
    samples = [
        PsfSample(
            gaussian(15, np.eye(2) * (1.0 + softer_right * max(math.cos(phi), 0.0))),
            FieldPosition(r, float(phi)),
            LensSettings(aperture=2.0),
            photo=str(photo_number),
        )
        for photo_number in range(3)
        for r in (0.2, 0.5, 0.8)
        for phi in np.linspace(-math.pi, math.pi, 16, endpoint=False)
    ]
    field = LensModel.fit(samples, ModelSettings(mode="paper")).field(LensSettings(aperture=2.0))
    found = _Posteriors(field, turns).posterior_at(place, "g")
    return found.kernel, found.error


def test_of_two_turns_that_may_be_the_mean_is_taken_and_the_error_covers_both() -> None:
    top, right, left = (FieldPosition(0.8, phi) for phi in (math.pi / 2, 0.0, math.pi))

    alike, error_alike = posterior(0.0, (1, 3), top)
    mean, error = posterior(3.0, (1, 3), top)
    sides = [posterior(3.0, (0,), place) for place in (right, left)]

    single, error_single = posterior(0.0, (0,), top)
    assert alike == pytest.approx(single, abs=1e-3)  # where all sides are alike, nothing is lost
    assert error_alike == pytest.approx(error_single, abs=0.02)
    side = max(kernel.shape[0] for kernel, _ in sides)
    padded = [np.pad(kernel, (side - kernel.shape[0]) // 2) for kernel, _ in sides]
    distance = np.linalg.norm(padded[0] - padded[1]) / 2.0 / np.linalg.norm(mean)
    assert error >= distance > 0.2
