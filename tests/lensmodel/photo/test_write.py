"""Developed photos as files: numbers, colours, metadata, and what a photo carries beside its pixels."""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
import subprocess
from dataclasses import replace
from datetime import datetime
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import exifread
import imagecodecs
import numpy as np
import pytest
import rawpy
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageOps
from PIL.TiffImagePlugin import IFDRational

from lab.images import to_srgb
from lensmodel import photo
from lensmodel.core.errors import InvalidInputError
from lensmodel.photo.colour import D65_TO_D50, SRGB_TO_XYZ_D65, linear_profile, srgb_to_linear
from lensmodel.photo.containers import ASCII, GPS, RATIONAL, SRATIONAL, UNDEFINED, laid_out
from lensmodel.photo.metadata import gps_directory, xmp_packet
from lensmodel.photo.writing import XYZ_TO_SRGB, opcodes_of_planes, write_bayer_dng

METADATA = photo.PhotoMetadata(
    camera_maker="Canon",
    camera_model="EOS 6D",
    body_serial="BODY1",
    lens=photo.LensIdentity("Canon", "EF24mm f/1.4L", "LENS1", "exif"),
    aperture=2.8,
    focal_mm=24.0,
    iso=400,
    exposure_s=1 / 160,
    taken_at=datetime(2020, 2, 3, 4, 5, 6),  # noqa: DTZ001  the camera's clock has no zone
    focus_m=math.inf,
)
PLAIN = photo.Encoding(metadata=METADATA)
FORMATS = ("tiff16", "png16", "png8", "jpeg", "dng")
agree = partial(np.testing.assert_allclose, rtol=0.0, equal_nan=False)
"""Of planes: `pytest.approx` looks at one number after the other."""


def planes(height: int = 48, width: int = 64) -> NDArray[np.float32]:
    rows, cols = np.mgrid[:height, :width]
    ramp = np.stack([rows / height, cols / width, (rows + cols) / (height + width)])
    return (0.05 + 0.9 * ramp).astype(np.float32)


def read_numbers(path: Path) -> NDArray[np.generic]:
    """Numbers of a written file, of any depth."""
    if path.read_bytes()[:2] == b"II":
        return tifffile.imread(path, key=0)
    return np.asarray(imagecodecs.png_decode(path.read_bytes()))


def orientation_of(encoding: photo.Encoding, value: int) -> photo.Encoding:
    return replace(encoding, metadata=replace(encoding.metadata, orientation=value))


@pytest.mark.parametrize("profile", [False, True])
@pytest.mark.parametrize("output", ["tiff16", "png16", "png8"])
def test_what_was_developed_is_written_with_the_same_numbers_and_profile(
    tmp_path: Path, output: photo.OutputFormat, profile: bool
) -> None:
    dtype = np.uint8 if output == "png8" else np.uint16
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, (256, 256, 3), dtype=dtype)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    tifffile.imwrite(tmp_path / "in.tif", pixels, photometric="rgb", iccprofile=srgb if profile else None)
    developed = photo.develop(tmp_path / "in.tif")
    photo.write_image(tmp_path / "out", developed.planes, developed.encoding, format=output)

    assert (read_numbers(tmp_path / "out") == pixels).all()
    assert (icc_of(tmp_path / "out") == srgb) == profile


@pytest.mark.parametrize("output", ["tiff16", "png16", "png8", "jpeg"])
@pytest.mark.parametrize("color_space", ["same", "srgb", "camera-linear"])
def test_every_output_has_a_profile_that_littlecms_can_use(
    tmp_path: Path, output: photo.OutputFormat, color_space: photo.ColorSpace
) -> None:
    path = tmp_path / "x"
    photo.write_image(path, planes(), PLAIN, format=output, color_space=color_space)
    icc = icc_of(path)
    seen = ImageCms.applyTransform(
        Image.new("RGB", (1, 1), (188, 128, 64)),
        ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(BytesIO(icc)), ImageCms.createProfile("sRGB"), "RGB", "RGB"
        ),
    )
    expected = np.array([188, 128, 64])
    if color_space == "camera-linear":
        expected = 255 * to_srgb(expected / 255)

    assert np.asarray(seen)[0, 0] == pytest.approx(expected, abs=2)


def icc_of(path: Path) -> bytes:
    data = path.read_bytes()
    if data[:2] == b"II":
        with tifffile.TiffFile(path) as file:
            return bytes(file.pages[0].tags[34675].value)
    with Image.open(path) as image:
        return bytes(image.info["icc_profile"])


@pytest.mark.parametrize("level", [0.4, 1.0])
@pytest.mark.parametrize("balance", [(2.0, 1.0, 1.6), (0.7, 1.0, 1.6)])
def test_white_balance_and_matrix_make_a_raw_photo_srgb_and_what_is_saturated_white(
    tmp_path: Path, balance: tuple[float, float, float], level: float
) -> None:
    to_srgb = ((1.5, -0.4, -0.1), (-0.2, 1.4, -0.2), (0.0, -0.5, 1.5))
    encoding = replace(PLAIN, white_balance=balance, to_srgb=to_srgb)
    neutral = np.ones(3) if level == 1.0 else level * min(balance) / np.array(balance)
    grey = np.broadcast_to(neutral.astype(np.float32)[:, None, None], (3, 32, 32))
    photo.write_image(tmp_path / "x", grey, encoding)

    back = srgb_to_linear(read_numbers(tmp_path / "x")[5, 5] / 65535)
    assert back == pytest.approx([level] * 3, abs=1e-4 if level < 1.0 else 0.0)


def test_a_wide_gamut_is_converted_when_srgb_is_asked_for(tmp_path: Path) -> None:
    # Primaries of Adobe RGB (1998) under D50, as its profile gives them.
    adobe = np.array([[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]])
    encoding = replace(PLAIN, transfer="icc", icc=linear_profile(adobe))
    green = (
        np.zeros((3, 32, 32), dtype=np.float32) + np.array([0.2, 0.5, 0.3], dtype=np.float32)[:, None, None]
    )
    photo.write_image(tmp_path / "x", green, encoding, color_space="srgb")

    expected = np.linalg.inv(D65_TO_D50 @ SRGB_TO_XYZ_D65) @ adobe @ [0.2, 0.5, 0.3]
    assert expected[0] < 0.1  # far from the numbers of the input
    assert srgb_to_linear(read_numbers(tmp_path / "x")[5, 5] / 65535) == pytest.approx(expected, abs=1e-4)


def test_camera_linear_keeps_the_numbers_of_the_planes(tmp_path: Path) -> None:
    encoding = replace(
        PLAIN, white_balance=(2.0, 1.0, 1.6), to_srgb=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    )
    photo.write_image(tmp_path / "x", planes(), encoding, color_space="camera-linear")

    agree(np.moveaxis(read_numbers(tmp_path / "x"), -1, 0) / 65535, planes(), atol=0.75 / 65535)


def test_a_linear_dng_is_read_back_by_libraw_with_its_numbers(tmp_path: Path) -> None:
    encoding = replace(PLAIN, white_balance=(2.0, 1.0, 1.6))
    photo.write_image(tmp_path / "x.dng", planes(), encoding, format="dng")
    developed = photo.develop(tmp_path / "x.dng")

    agree(developed.planes, planes(), atol=1e-4)
    assert (developed.sensor_noise, developed.coding_noise, developed.lossy) == (None, None, False)
    assert developed.encoding.white_balance == pytest.approx((2.0, 1.0, 1.6), rel=1e-4)
    with rawpy.imread(str(tmp_path / "x.dng")) as raw:
        shown = raw.postprocess(use_camera_wb=True, no_auto_bright=True)
    assert shown.shape == (48, 64, 3)


# Tone curve and exposure of darktable's usual workflow depend on the kind of file, not on its numbers: filmic
# is left out where the pixels are no mosaic.
OPENERS = {
    "rawtherapee-cli": "-Y -t -b16 -o {to} -c {of}",
    "darktable-cli": "{of} {to} --core --configdir {folder}/darktable --library :memory: "
    "--conf plugins/imageio/format/tiff/bpp=16 --conf plugins/darkroom/workflow=none "
    "--conf plugins/darkroom/chromatic-adaptation=legacy",
}


@pytest.mark.tools
@pytest.mark.parametrize("stops", [None, 0.75])
@pytest.mark.parametrize("program", OPENERS)
def test_raw_converters_show_a_linear_dng_as_bright_as_the_mosaic_it_came_from(
    tmp_path: Path, program: str, stops: float | None
) -> None:
    if shutil.which(program) is None:
        pytest.skip(f"the program {program} is not installed")
    smooth = planes(240, 320) * np.array([0.45, 0.9, 0.55], dtype=np.float32)[:, None, None]
    mosaic = np.rint(512 + 15360 * smooth[1]).astype(np.uint16)
    mosaic[::2, ::2] = np.rint(512 + 15360 * smooth[0, ::2, ::2])
    mosaic[1::2, 1::2] = np.rint(512 + 15360 * smooth[2, 1::2, 1::2])
    neutral = (0.5, 1.0, 0.6)
    write_bayer_dng(
        tmp_path / "mosaic.dng",
        mosaic,
        black=512,
        white=15872,
        as_shot_neutral=neutral,
        baseline_exposure=stops,
    )
    developed = photo.develop(tmp_path / "mosaic.dng")
    photo.write_image(tmp_path / "linear.dng", developed.planes, developed.encoding, format="dng")

    def shown(name: str) -> NDArray[np.float64]:
        target = tmp_path / f"{name}.tif"
        fixed = {"of": str(tmp_path / f"{name}.dng"), "to": str(target), "folder": str(tmp_path)}
        words = [program, *(word.format(**fixed) for word in OPENERS[program].split())]
        subprocess.run(words, check=True, capture_output=True, env=os.environ | {"HOME": str(tmp_path)})
        picture = tifffile.imread(target)[..., :3].astype(np.float64)
        return srgb_to_linear(picture[20:-20, 20:-20].mean(axis=(0, 1)) / 65535)

    assert shown("linear") == pytest.approx(shown("mosaic"), rel=0.01)


@pytest.mark.parametrize("stops", [None, -1.25, 0.35])
def test_a_linear_dng_asks_for_the_baseline_exposure_of_the_dng_it_came_from(
    tmp_path: Path, stops: float | None
) -> None:
    mosaic = np.rint(512 + 15360 * planes(32, 48)[1]).astype(np.uint16)
    write_bayer_dng(tmp_path / "mosaic.dng", mosaic, black=512, white=15872, baseline_exposure=stops)
    developed = photo.develop(tmp_path / "mosaic.dng")
    photo.write_image(tmp_path / "linear.dng", developed.planes, developed.encoding, format="dng")

    assert developed.encoding.baseline_exposure == stops
    assert photo.develop(tmp_path / "linear.dng").encoding.baseline_exposure == stops
    with tifffile.TiffFile(tmp_path / "linear.dng") as file:
        assert (50730 in file.pages[0].tags) == (stops is not None)


@pytest.mark.parametrize("output", FORMATS)
def test_our_own_reader_finds_the_safe_metadata_again(tmp_path: Path, output: photo.OutputFormat) -> None:
    path, again, turned = tmp_path / "x", tmp_path / "again", orientation_of(PLAIN, 6)
    for target in (path, again):
        photo.write_image(target, planes(), turned, format=output, description="corrected")
    seen, upright = photo.inspect(path), output.startswith("png")

    assert seen.metadata == replace(METADATA.without_serials(), orientation=1 if upright else 6)
    assert (seen.width, seen.height) == ((48, 64) if upright else (64, 48))
    assert not [word for word in (b"BODY1", b"LENS1", b"GPS") if word in path.read_bytes()]
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.tools
def test_exiftool_finds_no_fault_and_the_same_values(tmp_path: Path) -> None:
    program = shutil.which("exiftool")
    if program is None:
        pytest.skip("the program exiftool is not installed")
    turned = orientation_of(PLAIN, 6)
    for output in FORMATS:
        photo.write_image(tmp_path / output, planes(), turned, format=output, description="corrected")
    run = subprocess.run([program, "-j", "-n", tmp_path], capture_output=True, check=True, text=True)

    for read in json.loads(run.stdout):
        assert not {"Error", "Warning", "SerialNumber"} & read.keys()
        assert (read["FNumber"], read["FocalLength"], read["ISO"]) == (2.8, 24, 400)
        assert (read["LensModel"], read["DateTimeOriginal"]) == ("EF24mm f/1.4L", "2020:02:03 04:05:06")
        assert read["Orientation"] == (1 if read["FileName"].startswith("png") else 6)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pngs_are_written_upright(tmp_path: Path, orientation: int) -> None:
    photo.write_image(tmp_path / "x.png", planes(), orientation_of(PLAIN, orientation), format="png8")
    photo.write_image(tmp_path / "flat.png", planes(), PLAIN, format="png8")
    turned = Image.open(tmp_path / "flat.png").convert("RGB")
    block = turned.getexif()
    block[0x0112] = orientation
    turned.info["exif"] = block.tobytes()
    expected = np.asarray(ImageOps.exif_transpose(turned))

    assert (np.asarray(Image.open(tmp_path / "x.png")) == expected).all()


def test_jpeg_keeps_the_colour_of_single_pixels(tmp_path: Path) -> None:
    checks = np.zeros((3, 32, 32), dtype=np.float32)
    checks[0, ::2] = 1.0  # red lines, one pixel wide
    photo.write_image(tmp_path / "x.jpg", checks, PLAIN, format="jpeg", quality=95)
    with Image.open(tmp_path / "x.jpg") as image:
        back = np.asarray(image)

    assert back[10, 10, 0] > 230
    assert back[11, 10, 0] < 25


@pytest.mark.parametrize("output", ["tiff16", "png16", "jpeg"])
def test_a_failed_write_leaves_the_old_file_and_no_remains(
    tmp_path: Path, output: photo.OutputFormat, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"old")

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        photo.write_image(path, planes(), PLAIN, format=output)

    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"format": "bmp"}, "tiff16, png16"),
        ({"color_space": "lab"}, "camera-linear"),
        ({"format": "jpeg", "quality": 0}, "1..100"),
    ],
)
def test_impossible_requests_are_refused(tmp_path: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        photo.write_image(tmp_path / "x", planes(), PLAIN, **options)  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="shape"):
        photo.write_image(tmp_path / "x", planes()[0], PLAIN)

    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("output", FORMATS)
def test_the_xmp_packet_says_what_was_done_and_which_lens_it_was(
    tmp_path: Path, output: photo.OutputFormat
) -> None:
    path = tmp_path / "x"
    done = 'corrected, strength <.5> & "more"'
    photo.write_image(path, planes(), PLAIN, format=output, description=done, lens="My 24 mm & adapter")

    data = path.read_bytes()
    begin, end = data.index(b"<x:xmpmeta"), data.index(b"</x:xmpmeta>") + len(b"</x:xmpmeta>")
    packet = ET.fromstring(data[begin:end])
    rdf, aux, events = (
        "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}",
        "{http://ns.adobe.com/exif/1.0/aux/}",
        "{http://ns.adobe.com/xap/1.0/sType/ResourceEvent#}",
    )
    described = next(packet.iter(f"{rdf}Description"))
    assert described.get(f"{aux}Lens") == "My 24 mm & adapter"
    event = next(one for one in packet.iter(f"{rdf}li") if one.get(f"{events}action"))
    assert event.get(f"{events}parameters") == done


def test_a_packet_of_names_that_xml_cannot_write_is_still_xml() -> None:
    strange = replace(PLAIN.metadata, keywords=("X\x01T\x1f-3 <&\ufffe>",))

    packet = ET.fromstring(xmp_packet(strange, "done\x0b", "x\x02"))

    described = next(packet.iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"))
    assert described.get("{http://ns.adobe.com/exif/1.0/aux/}Lens") == "x "
    assert [item.text for item in packet.iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}li")][1:] == [
        "X T -3 <& >"
    ]


# --- DNG of a mosaic ----------------------------------------------------------------------------

SHOT = replace(
    METADATA,
    lens=photo.LensIdentity("Glass", "Güte 24-70mm f/2.8", "L0045", "exif"),
    focus_m=3.25,
    pixel_pitch_um=4.5,
    orientation=6,
    artist="Example",
    copyright="(c) Example",
)


def mosaic(height: int = 64, width: int = 96) -> NDArray[np.uint16]:
    return np.random.default_rng(0).integers(400, 15873, (height, width), dtype=np.uint16)


def test_colours_come_out_as_the_matrix_and_the_neutral_say(tmp_path: Path) -> None:
    balance = np.array([2.0, 1.0, 1.6])
    colour = np.array([0.6, 0.3, 0.1])
    planes = np.broadcast_to((colour / balance)[:, None, None], (3, 32, 48))
    to_camera = XYZ_TO_SRGB / balance[:, None]
    encoding = photo.Encoding(white_balance=tuple(balance), xyz_to_camera=to_camera)
    photo.write_image(tmp_path / "c.dng", planes, encoding, format="dng")

    with rawpy.imread(str(tmp_path / "c.dng")) as raw:
        developed = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, adjust_maximum_thr=0.0, use_camera_wb=True, output_bps=16
        )
        assert raw.camera_whitebalance[:3] == pytest.approx(balance.tolist())
    np.testing.assert_allclose(developed[16, 24] / 65535, colour, atol=1e-3)


def test_every_tag_comes_back_and_unknown_ones_are_left_out(tmp_path: Path) -> None:
    def tags_of(metadata: photo.PhotoMetadata) -> dict[str, Any]:
        path = tmp_path / "tags.dng"
        write_bayer_dng(path, mosaic(), black=512, white=15872, metadata=metadata)
        with path.open("rb") as file:
            return exifread.process_file(file)

    tags = tags_of(SHOT)
    named = replace(SHOT.lens, model="G?te 24-70mm f/2.8")
    assert photo.inspect(tmp_path / "tags.dng").metadata == replace(SHOT, lens=named)
    wanted = {
        "Image Make": "Canon",
        "Image Model": "EOS 6D",
        "Image Artist": "Example",
        "Image Copyright": "(c) Example",
        "Image DateTime": "2020:02:03 04:05:06",
        "Image Orientation": "Rotated 90 CW",
        "EXIF FNumber": "14/5",
        "EXIF FocalLength": "24",
        "EXIF SubjectDistance": "13/4",
        "EXIF ISOSpeedRatings": "400",
        "EXIF ExposureTime": "1/160",
        "EXIF DateTimeOriginal": "2020:02:03 04:05:06",
        "EXIF BodySerialNumber": "BODY1",
        "EXIF LensMake": "Glass",
        "EXIF LensModel": "G?te 24-70mm f/2.8",
        "EXIF LensSerialNumber": "L0045",
        "EXIF FocalPlaneResolutionUnit": "3",
    }
    assert {name: str(tags[name]) for name in wanted} == wanted
    per_cm = tags["EXIF FocalPlaneXResolution"].values[0]
    assert 10_000 / (per_cm.num / per_cm.den) == pytest.approx(4.5)
    bare = tags_of(photo.PhotoMetadata(focus_m=math.inf))
    assert str(bare["EXIF SubjectDistance"]) == str(2**32 - 1)  # infinity, as EXIF says it
    assert not {"LensModel", "LensSerialNumber", "FNumber", "FocalLength", "ISOSpeedRatings"} & {
        name.removeprefix("EXIF ") for name in bare
    }


def test_files_are_as_private_as_their_writer_asks(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        write_bayer_dng(tmp_path / "x.dng", mosaic(), black=512, white=15872)
    finally:
        os.umask(before)

    assert (tmp_path / "x.dng").stat().st_mode & 0o777 == 0o600


# --- what a photo carries beside its pixels: rights, rating, opcodes, place ---------------------------

REPORTS = Path(__file__).parents[2] / "data" / "reports"
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:dc="http://purl.org/dc/elements/1.1/" xmlns:xmp="http://ns.adobe.com/xap/1.0/"
xmp:Rating="{rating}">
<dc:rights><rdf:Alt><rdf:li xml:lang="x-default">© Ä. Example</rdf:li></rdf:Alt></dc:rights>
<dc:creator><rdf:Seq><rdf:li>Ä. Example</rdf:li><rdf:li>B. Example</rdf:li></rdf:Seq></dc:creator>
<dc:subject><rdf:Bag><rdf:li>holiday</rdf:li>
<rdf:li>geo:lat=52.5163</rdf:li><rdf:li>Geotagged</rdf:li>
<rdf:li>café &amp; sea</rdf:li></rdf:Bag></dc:subject>
</rdf:Description></rdf:RDF></x:xmpmeta>"""


def corrected(source: Path, target: Path, output: photo.OutputFormat, **options: object) -> Path:
    """Write what was developed, as a correction does."""
    developed = photo.develop(source)
    photo.write_image(target, developed.planes, developed.encoding, format=output, **options)
    return target


@pytest.mark.parametrize("rating", [-1, 0, 4])
@pytest.mark.parametrize("output", [*FORMATS, "tiff32"])
def test_rights_authors_rating_and_keywords_of_xmp_are_kept(
    output: photo.OutputFormat, rating: int, tmp_path: Path
) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "x.jpg", xmp=XMP.format(rating=rating).encode())

    said = photo.inspect(corrected(tmp_path / "x.jpg", tmp_path / "out", output)).metadata

    assert (said.copyright, said.artist, said.rating) == ("© Ä. Example", "Ä. Example, B. Example", rating)
    assert said.keywords == ("holiday", "café & sea")


@pytest.mark.parametrize("output", [*FORMATS, "tiff32"])
@pytest.mark.parametrize("order", ["big", "little"])
def test_the_place_is_kept_where_its_owner_wants_it_and_nowhere_else(
    output: photo.OutputFormat, order: str, tmp_path: Path
) -> None:
    block = Image.Exif()
    block.endian = ">" if order == "big" else "<"
    place = (IFDRational(52), IFDRational(30), IFDRational(1234, 100))
    block.get_ifd(0x8825).update({0: b"\2\3\0\0", 1: "N", 2: place, 3: "E", 4: place, 5: b"\0"})
    Image.new("RGB", (64, 48), "grey").save(tmp_path / "x.jpg", exif=block)

    kept = corrected(tmp_path / "x.jpg", tmp_path / "kept", output, gps=gps_directory(tmp_path / "x.jpg"))
    left = corrected(tmp_path / "x.jpg", tmp_path / "left", output)

    found = gps_directory(kept)
    assert found == gps_directory(tmp_path / "x.jpg")
    assert found[2] == (5, (52.0, 30.0, 12.34))
    assert gps_directory(left) == {}


def test_of_a_place_what_cannot_be_written_is_left_out(tmp_path: Path) -> None:
    hostile = {
        1: (ASCII, "N"),
        2: (SRATIONAL, struct.pack("<2i", -(2**31), 1)),
        3: (RATIONAL, struct.pack("<2I", 1, 0)),
        4: (12, [math.inf]),
        5: (12, [1e308]),
        6: (UNDEFINED, bytes(60_000)),
        7: (9, [-5]),
        99: (ASCII, "N"),
    }
    Image.new("RGB", (64, 48), "grey").save(tmp_path / "x.jpg", exif=b"Exif\0\0" + laid_out({GPS: hostile}))

    found = gps_directory(tmp_path / "x.jpg")

    assert found == {1: (ASCII, b"N\0"), 7: (9, (-5,))}
    assert gps_directory(corrected(tmp_path / "x.jpg", tmp_path / "kept", "jpeg", gps=found)) == found


def opcode_lists(path: Path) -> list[bytes]:
    with tifffile.TiffFile(path) as file:
        tags = file.pages[0].tags
        return [bytes(tags[tag].value) if tag in tags else b"" for tag in (51009, 51022)]


def test_gain_map_and_warp_go_into_the_corrected_dng(tmp_path: Path) -> None:
    source = opcode_lists(REPORTS / "gainmap-warp.dng")
    gain, warp = opcode_lists(corrected(REPORTS / "gainmap-warp.dng", tmp_path / "x.dng", "dng"))

    assert warp == source[1]
    assert struct.unpack(">8I", gain[20:52]) == (0, 0, 224, 360, 0, 3, 1, 1)  # of all three planes
    assert gain[52:] == source[0][52:]
    # those of a linear DNG are for its planes
    assert opcode_lists(corrected(tmp_path / "x.dng", tmp_path / "y.dng", "dng")) == [gain, warp]


def test_a_file_that_cannot_keep_them_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    corrected(REPORTS / "gainmap-warp.dng", tmp_path / "x.tif", "tiff16")

    assert "only DNG output keeps that" in caplog.text


def opcode(number: int, data: bytes) -> bytes:
    return struct.pack(">4I", number, 0x01030000, 1, len(data)) + data


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_gain_maps_of_the_four_sites_of_a_mosaic_become_those_of_three_colours(
    pattern: str, tmp_path: Path
) -> None:
    sites = [(row, col, [1.0 + row, 2.0, 3.0, 4.0 + col]) for row in (0, 1) for col in (0, 1)]
    maps = [
        struct.pack(">10I4dI4f", row, col, 48, 64, 0, 1, 2, 2, 2, 2, 1.0, 1.0, 0.0, 0.0, 1, *gains)
        for row, col, gains in sites
    ]
    block = struct.pack(">I", 5) + b"".join([*(opcode(9, each) for each in maps), opcode(4, b"\0" * 8)])
    path = tmp_path / "x.dng"
    mosaic = np.random.default_rng(0).integers(2000, 2900, (48, 64), dtype=np.uint16)
    write_bayer_dng(path, mosaic, black=512, white=15000, pattern=pattern)
    data = bytearray(path.read_bytes())
    at = next(i for i in range(10, 600, 12) if data[i : i + 2] == struct.pack("<H", 50708))
    data[at : at + 12] = struct.pack("<HHII", 51009, 7, len(block), len(data))  # in the place of its camera
    path.write_bytes(bytes(data) + block)

    kept, _ = opcode_lists(corrected(path, tmp_path / "out.dng", "dng"))

    gains = np.ones((3, 4))  # of a plane: greens of both sites, one after the other, are their geometric mean
    for step in np.split(np.frombuffer(kept[4:], np.uint8), 4):
        area = struct.unpack(">8I", step.tobytes()[16:48])
        assert area[5:] == (1, 1, 1)
        gains[area[4]] *= np.frombuffer(step.tobytes()[-16:], ">f4")
    seen, of_green = np.array([each for *_, each in sites]), np.array([letter == "G" for letter in pattern])
    assert gains[1] == pytest.approx(np.sqrt(seen[of_green].prod(axis=0)), rel=1e-6)
    assert gains[0] == pytest.approx(seen[pattern.index("R")])
    assert photo.develop(path).remarks[0] == "what its OpcodeList2 asks of the mosaic alone is dropped (1)"


@pytest.mark.parametrize("cut", [0, 3, 4, 19, 30, 410])
def test_a_damaged_list_gives_what_came_before_the_damage(cut: int) -> None:
    block = opcode_lists(REPORTS / "gainmap-warp.dng")[0]

    assert opcodes_of_planes(block[:cut], None) == (b"", 0)
    assert opcodes_of_planes(struct.pack(">I", 2**32 - 1) + block[4:], None) == opcodes_of_planes(block, None)
    assert opcodes_of_planes(struct.pack(">I", 1) + opcode(9, block[20:60]), None) == (b"", 1)


@pytest.mark.parametrize("output", [*FORMATS, "tiff32"])
def test_copyright_and_artist_are_kept(output: photo.OutputFormat, tmp_path: Path) -> None:
    said = photo.inspect(corrected(REPORTS / "copyright.jpg", tmp_path / "x", output)).metadata

    assert (said.copyright, said.artist) == ("(c) 2024 Example", "Example")
