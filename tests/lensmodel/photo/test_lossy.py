"""Photos whose compression lost something: lossy DNG beside JPEG and lossless files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from lensmodel import photo
from lensmodel.photo.colour import srgb_to_linear
from lensmodel.photo.containers import opened_header

SIDE = 256


def scene(seed: int = 0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    fine = ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 1.0)
    grey = np.clip(120 + 150 * fine, 5, 250).astype(np.uint8)
    return np.stack([grey] * 3, axis=-1)


def even_scene() -> NDArray[np.uint8]:
    """As much detail at all frequencies, far above the rounding of the coefficients."""
    light = np.clip(0.2 + 0.06 * np.random.default_rng(3).standard_normal((SIDE, SIDE)), 0.05, 0.5)
    levels = srgb_to_linear(np.arange(256) / 255)
    grey = np.rint(np.interp(light, levels, np.arange(256.0))).astype(np.uint8)
    return np.stack([grey] * 3, axis=-1)


def jpeg_tile(pixels: NDArray[np.uint8], quality: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()


def write_lossy_dng(
    path: Path, pixels: NDArray[np.uint8], quality: int, *, tile: bytes | None = None
) -> None:
    """One tile of eight-bit LinearRaw, as a converter with lossy compression writes it."""
    tile = jpeg_tile(pixels, quality) if tile is None else tile
    matrix = (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)
    tifffile.imwrite(
        path,
        iter([tile]),
        shape=pixels.shape,
        dtype=np.uint8,
        photometric=34892,
        compression=34892,
        tile=pixels.shape[:2],
        metadata=None,
        extratags=[
            (50706, "B", 4, (1, 4, 0, 0), True),
            (50708, "s", 0, "Made Up", True),
            (50721, "2i", 9, matrix, True),
            (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
        ],
    )


@pytest.mark.parametrize("kind", ["dng", "jpeg"])
@pytest.mark.parametrize("quality", [92, 85, 75, 70])
@pytest.mark.parametrize(
    ("pixels", "least", "most"),
    [
        (scene(), 1 / 3, 1 / 0.3),  # of smooth detail fewer coefficients are left to be rounded
        (even_scene(), 0.3, 1.2),  # the middle step stands for all 64, of which some are twice as coarse
    ],
    ids=["smooth", "even"],
)
def test_the_noise_of_a_lossy_file_is_the_error_that_rounding_made(
    kind: str, quality: int, pixels: NDArray[np.uint8], least: float, most: float, tmp_path: Path
) -> None:
    planes = []
    for each in (100, quality):
        if kind == "dng":
            write_lossy_dng(tmp_path / "x", pixels, each)
        else:
            (tmp_path / "x").write_bytes(jpeg_tile(pixels, each))
        developed = photo.develop(tmp_path / "x")
        planes.append(developed.planes[1])
    coded = developed.coding_noise
    assert coded is not None
    assert (developed.info.kind, developed.lossy) == (kind, True)
    for noise in (*developed.correction_noise, *developed.coarse_noise):
        assert noise.variance(np.array(0.2)) >= 0.999 * coded.variance(np.array(0.2))
    error = float(np.square(planes[1] - planes[0]).mean())
    assert least < float(coded.variance(planes[0]).mean()) / error < most


@pytest.mark.parametrize(
    "tile", [b"\xff\xd8\xff\xdb\x00\x43\x00", b"no JPEG at all", b"\xff\xd8" + b"\xff" * 40]
)
def test_a_damaged_tile_of_a_lossy_dng_leaves_its_noise_unknown(tmp_path: Path, tile: bytes) -> None:
    write_lossy_dng(tmp_path / "x.dng", scene(), 90, tile=tile)
    with opened_header(tmp_path / "x.dng", photo.Limits()) as header:
        assert (header.kind, header.coarseness) == ("dng", 0.0)


@pytest.mark.tools
def test_a_converters_lossy_dng_is_known_as_such(shared_data: Path) -> None:
    developed = photo.develop(shared_data / "raw" / "canon_6d_ef24-105_serial.dng")
    assert developed.info.kind == "dng"
    assert developed.lossy
    coded = developed.coding_noise
    assert coded is not None
    # tables of a median of 5 at about 1/340 of white a number in the middle tones
    assert float(coded.variance(np.array(0.18))) == pytest.approx((5 * 0.0029) ** 2 / 12, rel=0.9)
