"""Broken and hostile files against the running service: a clear answer each, and it goes on working."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from running import LIGHT, running, write_photo

from lensmodel.blind import sampling
from lensmodel.core.errors import LensModelError, NoUsablePatchesError
from lensmodel.core.types import LensSettings
from lensmodel.simulate import demo_data_path

KNOWN_CODES = {
    *("malformed_upload", "not_an_image", "truncated_image", "unsupported_format", "image_too_large"),
    *("decompression_bomb", "raw_decode_failed", "metadata_missing", "no_usable_patches", "turned_pixels"),
    *("memory_limit", "time_limit"),
}
TOLD = {"lens_serial": "L-1", "lens_model": "Test lens", "aperture": "4"}
"""What the owner says, so that a file is taken as far as its pixels allow."""


def png(width: int, height: int, data: bytes = b"") -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    bodies = {b"IHDR": header, b"IDAT": zlib.compress(data), b"IEND": b""}
    chunks = ((len(body), name + body) for name, body in bodies.items())
    packed = (struct.pack(">I", size) + body + struct.pack(">I", zlib.crc32(body)) for size, body in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def tiff(entries: list[tuple[int, int, int, int]], following: int = 0) -> bytes:
    fields = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + fields + struct.pack("<I", following)


def thumbnail() -> Image.Image:
    """A real photograph as small as a file's preview: sharp all over, and says nothing of a lens."""
    with Image.open(demo_data_path("city.jpg")) as picture:
        return picture.resize((88, 64), Image.Resampling.LANCZOS)


def one_window() -> Image.Image:
    """Detail in one place only, as of a moth on a wall: one window of hundreds tells anything."""
    pixels = np.full((900, 1200), 120.0)
    pixels[400:500, 600:700] += 60.0 * np.random.default_rng(1).standard_normal((100, 100))
    return Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)).convert("RGB")


OWN = {
    "empty.dng": b"",
    "text.jpg": b"this is no picture at all\n" * 40,
    "zip.nef": b"PK\x03\x04" + bytes(100),
    "svg.png": b'<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>',
    "half_a_header.png": png(100, 100)[:20],
    "bomb.png": png(60000, 60000),
    "tall.png": png(1, 2**31 - 1),
    "no_pixels.png": png(200, 200),
    "grey.png": png(300, 300, (b"\0" + b"\x80" * 900) * 300),
    "only_a_start.jpg": b"\xff\xd8\xff\xe0\x00\x10JFIF\0" + bytes(9),
    "no_frame.jpg": b"\xff\xd8\xff\xd9",
    "directory_of_itself.tif": tiff([(256, 4, 1, 100), (257, 4, 1, 100)], following=8),
    "huge.tif": tiff([(256, 4, 1, 2**31), (257, 4, 1, 2**31), (273, 4, 1, 8)]),
    "outside.tif": tiff([(256, 4, 1, 64), (257, 4, 1, 64), (273, 4, 1, 2**31), (279, 4, 1, 12288)]),
    "many_entries.tif": b"II*\0" + struct.pack("<IH", 8, 65535) + bytes(64),
    "beyond_the_end.tif": b"II*\0" + struct.pack("<I", 2**31),
}


@pytest.mark.parametrize("name", OWN)
def test_a_bad_file_is_refused_by_whoever_reads_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(OWN[name])

    with pytest.raises(LensModelError) as refusal:
        sampling.samples_of_photo(path, sampling.configured("default", LensSettings(4.0), patches=2))

    assert refusal.value.code in KNOWN_CODES
    assert len(str(refusal.value)) > 15
    if name in {"bomb.png", "tall.png", "huge.tif"}:  # by its header
        assert refusal.value.code in {"decompression_bomb", "image_too_large"}


@pytest.mark.parametrize("photo", [thumbnail, one_window])
def test_a_thumbnail_and_detail_in_one_place_tell_nothing(
    photo: Callable[[], Image.Image], tmp_path: Path
) -> None:
    photo().save(tmp_path / "p.jpg", quality=95)
    # the fewest patches of which as much evidence is asked as of the default
    strict = sampling.configured("default", LensSettings(4.0), patches=18)

    with pytest.raises(NoUsablePatchesError):
        sampling.samples_of_photo(tmp_path / "p.jpg", strict)


@pytest.mark.slow  # as the tests before, which need no service
def test_bad_files_are_refused_and_a_good_photo_still_goes_through_in_the_same_worker(tmp_path: Path) -> None:
    limits = {"LENS_TASK_SECONDS": "5400", "LENS_WORKER_MEMORY_MB": "3000", "LENS_MAX_MEGAPIXELS": "50"}
    with running(tmp_path / "data", LIGHT, **limits) as service:
        for name, content in OWN.items():
            answer = service.http.post("/v1/photos", files={"file": (name, content)}, data=TOLD)
            problem = answer.json()
            if answer.status_code < 300:
                service.job(problem["id"])
                problem = service.get(f"/v1/photos/{problem['id']}")["error"]
            assert problem["code"] in KNOWN_CODES, (name, problem)
            assert len(problem["detail"]) > 15, name
            assert "Traceback" not in problem["detail"], name

        assert service.calibrated(write_photo(tmp_path / "good.dng", 77))["state"] == "counted"
        assert "started again" not in service.log.read_text()
