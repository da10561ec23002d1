from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageCms
from scipy import ndimage

from lensmodel import photo
from lensmodel.core.errors import RawDecodeError, TruncatedImageError, UnsupportedFormatError
from lensmodel.photo.colour import D65_TO_D50, SRGB_TO_XYZ_D65, linear_profile, srgb_to_linear
from lensmodel.photo.containers import SHORT, write_strip
from lensmodel.photo.writing import dng_tags, write_bayer_dng

BLACK, WHITE = 512, 15000
agree = partial(np.testing.assert_allclose, rtol=0.0, equal_nan=False)
"""Of planes: `pytest.approx` looks at one number after the other."""


def raw_numbers(linear: NDArray[np.floating]) -> NDArray[np.uint16]:
    return np.rint(BLACK + linear * (WHITE - BLACK)).astype(np.uint16)


def textured(height: int, width: int, seed: int = 0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(rng.standard_normal((height, width)), 3)
    return np.clip(0.3 + 1.2 * smooth, 0.05, 0.8)


def shot(tmp_path: Path, mosaic: NDArray[np.uint16], **options: object) -> photo.LinearPhoto:
    """Develop a mosaic that a camera wrote."""
    write_bayer_dng(tmp_path / "x.dng", mosaic, black=BLACK, white=WHITE, **options)
    return photo.develop(tmp_path / "x.dng")


def save(tmp_path: Path, kind: str, pixels: NDArray[np.generic], **options: object) -> Path:
    path = tmp_path / f"x.{kind}"
    if kind == "tiff":
        tifffile.imwrite(path, pixels, **options)
    elif kind == "png":
        path.write_bytes(imagecodecs.png_encode(pixels))
    return path


# --- RAW ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_developed_planes_say_which_pixels_the_sensor_measured(tmp_path: Path, pattern: str) -> None:
    mosaic = raw_numbers(textured(64, 96))
    developed = shot(tmp_path, mosaic, pattern=pattern)

    assert developed.cfa is not None
    assert developed.planes.max() < 0.85  # the brightest pixel does not become the white
    assert "".join("RGB"[c] for row in developed.cfa for c in row) == pattern
    rows, cols = np.indices(mosaic.shape)
    channel = np.asarray(developed.cfa)[rows % 2, cols % 2]
    at_sites = np.take_along_axis(developed.planes, channel[None], axis=0)[0]
    inside = (slice(8, -8), slice(8, -8))
    np.testing.assert_allclose(at_sites[inside], ((mosaic - BLACK) / (WHITE - BLACK))[inside], atol=2e-4)


def test_saturation_is_where_the_clipped_pixels_pile_up_and_not_where_the_file_says(tmp_path: Path) -> None:
    scene = textured(128, 128) * 1.0
    scene[40:80, 40:80] = 2.0
    mosaic = np.minimum(raw_numbers(scene), 13000)
    planes = shot(tmp_path, mosaic).planes

    assert (planes[:, 60, 60] == 1.0).all()
    expected = (textured(128, 128)[10, 10] * (WHITE - BLACK)) / (13000 - BLACK)
    assert planes[:, 10, 10] == pytest.approx(expected, rel=0.05)


def test_full_wells_that_differ_by_a_hundredth_are_one_pile_although_hot_pixels_shine_beyond(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(5)
    scene = textured(128, 128) * 1.0
    scene[40:80, 40:80] = 2.0
    wells = 0.93 + 0.003 * np.clip(rng.standard_normal(scene.shape), -3.0, 3.0)
    wells[41, 42] = wells[60, 60] = 0.97
    mosaic = BLACK + np.rint(np.minimum(scene, wells) * (WHITE - BLACK)).astype(np.uint16)
    developed = shot(tmp_path, mosaic)

    blown = developed.planes[:, 44:76, 44:76]
    assert (blown >= np.array(developed.clip)[:, None, None] - 0.005).mean() > 0.97
    assert developed.planes[:, 90:, 90:].max() < min(developed.clip)


def test_a_colour_that_clips_below_the_others_says_so(tmp_path: Path) -> None:
    scene = textured(128, 128)
    scene[40:80, 40:80] = 1.0
    mosaic = raw_numbers(scene)
    green = np.zeros(mosaic.shape, dtype=bool)
    green[::2, 1::2] = green[1::2, ::2] = True
    mosaic[green] = np.minimum(mosaic[green], BLACK + round(0.95 * (WHITE - BLACK)))

    assert shot(tmp_path, mosaic).clip == pytest.approx((1.0, 0.95, 1.0), abs=1e-3)


def test_white_balance_is_told_but_not_applied(tmp_path: Path) -> None:
    mosaic = raw_numbers(np.full((64, 64), 0.4) + 0.001 * np.arange(64))
    developed = shot(tmp_path, mosaic, as_shot_neutral=(0.5, 1.0, 0.625))

    assert developed.encoding.white_balance == pytest.approx((2.0, 1.0, 1.6), rel=1e-4)
    r, g, b = developed.planes[:, 32, 32]
    assert (r, b) == pytest.approx((g, g), abs=2e-3)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_raw_stays_in_sensor_orientation(tmp_path: Path, orientation: int) -> None:
    scene = np.full((64, 96), 0.2) + 0.0005 * np.arange(96)
    scene[:32, :48] += 0.5  # bright at the upper left of the sensor
    metadata = photo.PhotoMetadata(orientation=orientation)
    developed = shot(tmp_path, raw_numbers(scene), metadata=metadata)

    assert developed.planes.shape == (3, 64, 96)
    assert developed.planes[1, 10, 10] > 0.6
    assert developed.planes[1, 50, 80] < 0.3
    assert developed.encoding.metadata.orientation == orientation


def test_detail_of_a_weak_red_is_no_stronger_than_it_was(tmp_path: Path) -> None:
    neutral = np.array([0.4, 1.0, 0.6])
    rows, cols = np.mgrid[:128, :128]
    grey = 0.4 + 0.2 * np.sin(2 * np.pi * cols / 5.0) * np.cos(2 * np.pi * rows / 7.0)  # 0.24 cycles/pixel
    mosaic = raw_numbers(grey * neutral[np.tile([[0, 1], [1, 2]], (64, 64))])
    planes = shot(tmp_path, mosaic, as_shot_neutral=neutral).planes

    for plane, share in zip(planes[:, 16:-16, 16:-16], neutral, strict=True):
        truth = (grey * share)[16:-16, 16:-16]
        slope = np.polyfit(truth.ravel(), plane.ravel(), 1)[0]
        assert slope == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("black", [(512,) * 3, (2048,) * 3, (512, 600, 700)])
@pytest.mark.parametrize("white", [(15872,), (15872, 16000, 15000)])
def test_white_of_a_linear_dng_with_black_levels_is_one(
    tmp_path: Path, black: tuple[int, ...], white: tuple[int, ...]
) -> None:
    planes = np.stack([textured(64, 96, seed) for seed in range(3)])
    planes[:, 10:20, 10:20] = 1.0
    low, high = np.array(black), np.resize(white, 3)
    codes = np.rint(low + np.moveaxis(planes, 0, -1) * (high - low)).astype(np.uint16)
    tags = dng_tags(photo.PhotoMetadata(), np.eye(3), (1.0, 1.0, 1.0), None)
    levels = {262: (SHORT, 34892), 50714: (SHORT, black), 50717: (SHORT, white)}
    with (tmp_path / "x.dng").open("wb") as file:
        write_strip(file, {**tags, **levels}, codes)
    developed = photo.develop(tmp_path / "x.dng")

    agree(developed.planes, planes, atol=2e-4)
    assert developed.planes[:, 15, 15] == pytest.approx(1.0, abs=1e-4)


def test_a_saturated_sky_is_no_damage(tmp_path: Path) -> None:
    mosaic = raw_numbers(textured(64, 64))
    mosaic[:20] = WHITE

    assert shot(tmp_path, mosaic).planes[1, 5, 5] == 1.0


DARK = np.random.default_rng(0).integers(BLACK - 40, BLACK + 1, (96, 96))
RANDOM = np.random.default_rng(0).integers(0, WHITE, (64, 96))


@pytest.mark.parametrize(
    ("first", "spoiled", "error", "text"),
    [
        (0, 3000, RawDecodeError, "3000"),
        (0, DARK, RawDecodeError, "black"),
        (60, 0, TruncatedImageError, "38% of the rows"),
        (32, RANDOM, RawDecodeError, "random"),
    ],
    ids=["even", "dark", "cut off", "random"],
)
def test_raw_data_that_are_no_picture_are_refused(
    first: int, spoiled: NDArray[np.integer] | int, error: type[Exception], text: str, tmp_path: Path
) -> None:
    mosaic = raw_numbers(textured(96, 96))
    mosaic[first:] = spoiled
    with pytest.raises(error, match=text):
        shot(tmp_path, mosaic)


# --- TIFF, PNG, JPEG ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["tiff", "png"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_srgb_is_decoded_in_full_precision_grey_to_three_planes_and_alpha_dropped_with_a_word(
    tmp_path: Path, kind: str, dtype: type, channels: int, caplog: pytest.LogCaptureFixture
) -> None:
    top = np.iinfo(dtype).max
    pixels = np.rint(np.stack([textured(40, 60, k) for k in range(channels)], axis=-1) * top).astype(dtype)
    clear = {"photometric": "rgb", "extrasamples": ["unassalpha"]} if (kind, channels) == ("tiff", 4) else {}
    stored = pixels[..., 0] if channels == 1 else pixels
    developed = photo.develop(save(tmp_path, kind, stored, **clear))

    truth = srgb_to_linear(np.moveaxis(pixels[..., :3], -1, 0) / top)
    agree(developed.planes, np.broadcast_to(truth, (3, 40, 60)), atol=1e-6)
    assert developed.encoding.bit_depth == 8 * np.dtype(dtype).itemsize
    assert developed.clip == (1.0, 1.0, 1.0)
    assert developed.remarks == (("its transparency is dropped",) if channels == 4 else ())
    assert (f"x.{kind}: its transparency" in caplog.text) == (channels == 4)


@pytest.mark.parametrize("mode", ["P", "RGB", "L", "opaque"])
def test_transparency_said_in_other_ways_is_told_too(tmp_path: Path, mode: str) -> None:
    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8))
    image = image.convert("RGBA" if mode == "opaque" else mode)
    clear = {} if mode == "opaque" else {"transparency": image.getpixel((5, 5))}
    image.save(tmp_path / "x.png", **clear)

    assert bool(photo.develop(tmp_path / "x.png").remarks) == (mode != "opaque")


@pytest.mark.parametrize("compression", [None, "lzw", "zlib"])
@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_tiffs_of_all_layouts_are_read(tmp_path: Path, compression: str | None, planar: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 65535, (40, 60, 3), dtype=np.uint16)
    stored = pixels if planar == "contig" else np.ascontiguousarray(np.moveaxis(pixels, -1, 0))
    path = save(tmp_path, "tiff", stored, photometric="rgb", planarconfig=planar, compression=compression)

    truth = srgb_to_linear(np.moveaxis(pixels, -1, 0) / 65535)
    agree(photo.develop(path).planes, truth, atol=1e-6)


def test_float_tiffs_are_linear_light(tmp_path: Path) -> None:
    pixels = np.stack([textured(40, 60, k) for k in range(3)], axis=-1).astype(np.float32)
    pixels[0, 0] = np.nan
    pixels[1, 1] = 3.0
    developed = photo.develop(save(tmp_path, "tiff", pixels, photometric="rgb"))

    agree(developed.planes[:, 2:], np.moveaxis(pixels, -1, 0)[:, 2:])
    assert np.isfinite(developed.planes).all()
    assert developed.clip == (3.0, 3.0, 3.0)


def test_only_the_first_picture_of_a_stereo_jpeg_is_the_photo(tmp_path: Path) -> None:
    left, right = (Image.new("RGB", (64, 48), grey) for grey in ("white", "black"))
    left.save(tmp_path / "x.jpg", "MPO", save_all=True, append_images=[right])

    assert photo.develop(tmp_path / "x.jpg").planes.min() > 0.99


@pytest.mark.parametrize("linear", [True, False])
def test_the_curve_of_an_icc_profile_is_used_and_its_primaries_are_kept(tmp_path: Path, linear: bool) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    if linear:
        profile = linear_profile(D65_TO_D50 @ SRGB_TO_XYZ_D65)
    pixels = np.random.default_rng(0).integers(0, 65535, (40, 60, 3), dtype=np.uint16)
    developed = photo.develop(save(tmp_path, "tiff", pixels, photometric="rgb", iccprofile=profile))

    truth = np.moveaxis(pixels, -1, 0) / 65535
    agree(developed.planes, truth if linear else srgb_to_linear(truth), atol=1e-6 if linear else 2e-4)
    assert (developed.encoding.transfer, developed.encoding.icc) == ("icc", profile)


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_turned_jpeg_is_developed_as_the_sensor_saw_it(tmp_path: Path, orientation: int) -> None:
    pixels = np.zeros((48, 64, 3), dtype=np.uint8)
    pixels[:24, :32] = 255
    block = Image.Exif()
    block[0x0112] = orientation
    Image.fromarray(pixels).save(tmp_path / "x.jpg", exif=block)
    developed = photo.develop(tmp_path / "x.jpg")

    assert (developed.planes[1, 8, 8] > 0.9, developed.planes[1, 40, 56] < 0.1) == (True, True)
    assert developed.info.metadata.orientation == orientation


# --- real files --------------------------------------------------------------------------------


real_raw = cache(photo.develop)  # two tests look at one of them


@pytest.mark.tools
@pytest.mark.parametrize(
    ("name", "size", "bayer"),
    [
        ("nikon_d1.nef", (1324, 2012), True),
        ("canon_kissx4_colorchart.dng", (1156, 1734), True),
        ("canon_6d_ef24-105_serial.dng", (816, 1224), False),
    ],
)
def test_real_raw_files_become_photos(
    shared_data: Path, name: str, size: tuple[int, int], bayer: bool
) -> None:
    developed = real_raw(shared_data / "raw" / name)
    info = photo.inspect(shared_data / "raw" / name)

    assert developed.planes.shape[1:] == size == (info.height, info.width)
    assert (developed.cfa is not None) == bayer
    assert 0.01 < developed.planes.mean() < 0.5
    # A picture: neighbours are alike, in each plane and between the planes.
    for plane in developed.planes:
        assert np.corrcoef(plane[::4, 1:].ravel(), plane[::4, :-1].ravel())[0, 1] > 0.9
    assert np.corrcoef(developed.planes[0, ::4].ravel(), developed.planes[1, ::4].ravel())[0, 1] > 0.5


@pytest.mark.tools
def test_the_greens_of_the_nikon_d1_clip_below_its_red(shared_data: Path) -> None:
    red, green, _ = real_raw(shared_data / "raw" / "nikon_d1.nef").clip

    assert red == 1.0
    assert green == pytest.approx(0.973, abs=0.003)


@pytest.mark.tools
def test_a_raw_kind_that_libraw_lacks_is_refused_politely(shared_data: Path) -> None:
    with pytest.raises(UnsupportedFormatError, match="VC-5"):
        photo.inspect(shared_data / "raw" / "gopro_hero6_unsupported.gpr")


@pytest.mark.parametrize("profile", [False, True])
def test_light_beyond_white_is_kept_in_a_float_tiff_and_told_of_where_it_is_clipped(
    tmp_path: Path, profile: bool, caplog: pytest.LogCaptureFixture
) -> None:
    pixels = np.stack([2.0 * textured(40, 60, k) for k in range(3)], axis=-1).astype(np.float32)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    options = {"iccprofile": srgb} if profile else {}
    developed = photo.develop(save(tmp_path, "tiff", pixels, photometric="rgb", **options))

    photo.write_image(tmp_path / "out.tif", developed.planes, developed.encoding, format="tiff32")
    kept = tifffile.imread(tmp_path / "out.tif")
    again = photo.develop(tmp_path / "out.tif").planes
    quiet = caplog.text
    photo.write_image(tmp_path / "out.jpg", developed.planes, developed.encoding, format="jpeg")

    agree(kept, pixels, atol=1e-4)
    agree(again, developed.planes, atol=1e-4)
    assert (quiet, f"{100 * (pixels > 1).mean():.1f} % of its samples" in caplog.text) == ("", True)
