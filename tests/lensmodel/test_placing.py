"""Frames in crop mode, on smaller sensors and cut by programs are put where they lie in the image circle."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel import api, correction, photo, simulate
from lensmodel.api import placed
from lensmodel.core.errors import InvalidInputError, OutsideSupportError
from lensmodel.core.psf import PsfField, PsfSample, resized, rms_width
from lensmodel.core.types import FieldPosition, Frame, LensSettings, NoiseModel, Planes
from lensmodel.model import LensModel
from lensmodel.model.camera_bodies import circle_mm, on_one_circle
from lensmodel.photo.development import photo_from_array
from lensmodel.photo.lateral import LateralColour

WHOLE, CROPPED, PITCH = Frame(480, 720), Frame(320, 480), 6.0


def samples_on(frame: Frame, pitch: float = PITCH, photo_name: str = "x") -> list[PsfSample]:
    """Kernels that widen with the distance in millimetres, as a frame of that size sees them."""
    return [
        PsfSample(
            gaussian(15, np.eye(2) * width_at(r * frame.half_diagonal * pitch / 1000.0)),
            FieldPosition(r, phi),
            LensSettings(2.8),
            photo=photo_name,
            pixel_pitch_um=pitch,
            half_diagonal_px=frame.half_diagonal,
        )
        for r in (0.05, 0.3, 0.6, 0.95)
        for phi in (-2.5, -1.0, 0.5, 2.0)
    ]


def width_at(mm: float) -> float:
    """Variance in square pixels at a distance from the axis."""
    return 0.4 + 1.2 * mm**2


@cache
def scene() -> Planes:
    """A scene behind a lens that is soft everywhere."""
    light = simulate.demo_scene("city")[:, 100 : 100 + WHOLE.height, 100 : 100 + WHOLE.width]
    return ndimage.gaussian_filter(light, (0.0, 1.0, 1.0))


def developed_of(frame: Frame, pitch: float | None = PITCH, **info: object) -> photo.LinearPhoto:
    planes = scene()
    top, left = (WHOLE.height - frame.height) // 2, (WHOLE.width - frame.width) // 2
    part = planes[:, top : top + frame.height, left : left + frame.width]
    made = photo_from_array(part, pixel_pitch_um=pitch, aperture=2.8, noise=NoiseModel(1e-5, 1e-7))
    return replace(made, info=replace(made.info, **info))


def test_the_middle_of_a_frame_keeps_its_places() -> None:
    middle = Frame(320, 480, circle_px=WHOLE.half_diagonal)

    for row, col in ((0, 0), (319, 479), (40, 300)):
        inside, outside = middle.position(row, col), WHOLE.position(row + 80, col + 120)
        assert (inside.r, inside.phi) == pytest.approx((outside.r, outside.phi))
        assert middle.pixel(inside) == pytest.approx((row, col))
    rows, cols = np.arange(320)[:, None], np.arange(480)[None, :]
    assert middle.polar(rows, cols)[0] == pytest.approx(WHOLE.polar(rows + 80, cols + 120)[0])
    with pytest.raises(InvalidInputError, match="do not lie"):
        Frame(320, 480, circle_px=200.0)


@pytest.mark.parametrize("first", ["whole", "cropped", "smaller sensor"])
def test_a_lens_seen_on_two_sizes_of_frame_is_one_lens_whichever_came_first(first: str) -> None:
    """A smaller sensor has other pixels too; its kernels are narrower in pixels, but not in millimetres."""
    cropped = samples_on(CROPPED, PITCH if first != "smaller sensor" else 4.0, "a")
    whole = samples_on(WHOLE, photo_name="b")
    order = (whole, cropped) if first == "whole" else (cropped, whole)

    model = LensModel.fit(order[0]).added(order[1])

    assert circle_mm(model.samples) == pytest.approx(WHOLE.half_diagonal * PITCH / 1000.0)
    for sample in model.samples:
        mm = sample.position.r * WHOLE.half_diagonal * PITCH / 1000.0
        assert sample.kernel == pytest.approx(gaussian(15, np.eye(2) * width_at(mm)), abs=1e-9)
    assert on_one_circle(model.samples) == tuple(model.samples)


def test_samples_that_do_not_say_their_size_stay_where_they_are() -> None:
    unknown = [replace(sample, pixel_pitch_um=None) for sample in samples_on(CROPPED)]

    assert [s.position for s in on_one_circle([*samples_on(WHOLE), *unknown])[16:]] == [
        s.position for s in unknown
    ]


def test_a_frame_in_crop_mode_is_corrected_by_the_kernels_of_the_middle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, asked = LensModel.fit(samples_on(WHOLE)), {}
    run = correction.correct_planes

    def recorded(planes: Planes, field: PsfField, frame: Frame, **options: object) -> correction.Corrected:
        asked.update(field=field, frame=frame, lateral=options["lateral"])
        return run(planes, field, frame, **options)

    monkeypatch.setattr(api.correction, "correct_planes", recorded)
    own = LateralColour((1e-3, -2e-3, 1e-3, 1.002), (0.0, 0.0, 0.0, 0.999), CROPPED.half_diagonal)
    done = api.correct_photo(developed_of(CROPPED), model, LensSettings(2.8), method="fast", lateral=own)

    place = asked["frame"].position(0.0, 0.0)
    assert place.r == pytest.approx(2.0 / 3.0, abs=0.01)
    of_whole = api.psfs_for(developed_of(WHOLE, kind="jpeg"), model, LensSettings(2.8))
    same = of_whole.kernel_at(WHOLE.position(80.0, 120.0), "g", 15)
    used = resized(asked["field"].posterior_at(place, "g").kernel, 15)
    assert used == pytest.approx(same, abs=1e-3)
    assert rms_width(same) < 0.9 * rms_width(of_whole.kernel_at(WHOLE.position(0.0, 0.0), "g", 15))
    for r, channel in ((1.0, "r"), (0.3, "r"), (0.7, "b")):
        assert asked["lateral"].displacement(r * 2.0 / 3.0, channel) == pytest.approx(
            own.displacement(r, channel)
        )
    assert np.isfinite([report.expected_gain_db for report in done.zones.values()]).all()


def test_a_frame_larger_than_all_that_is_known_is_refused_by_both_sizes() -> None:
    model = LensModel.fit(samples_on(CROPPED))

    with pytest.raises(OutsideSupportError, match=r"5\.2 mm diagonal.*3\.5 mm"):
        api.correct_photo(developed_of(WHOLE), model, LensSettings(2.8), method="fast")


def test_what_a_program_cut_is_refused_by_both_sizes() -> None:
    model = LensModel.fit(samples_on(WHOLE))

    with pytest.raises(OutsideSupportError, match=r"cut to 3\.5 mm diagonal.*5\.2 mm"):
        placed(developed_of(CROPPED, kind="jpeg", centred=False), model)


@pytest.mark.parametrize("of_photo", [PITCH, None])
@pytest.mark.parametrize("of_lens", [PITCH, None])
def test_a_photo_of_unknown_pitch_is_placed_by_its_size_alone(
    of_photo: float | None, of_lens: float | None
) -> None:
    samples = [replace(sample, pixel_pitch_um=of_lens) for sample in samples_on(WHOLE)]
    model = LensModel.fit(samples)

    assert placed(developed_of(WHOLE, of_photo), model).frame == WHOLE
    if of_photo is None or of_lens is None:
        with pytest.raises(OutsideSupportError, match=r"480 x 320 .* 577 pixels.* known on 865"):
            placed(developed_of(CROPPED, of_photo), model)
    else:
        assert placed(developed_of(CROPPED, of_photo), model).frame.circle_px is not None


# --- what a file says of its frame -------------------------------------------------------------


def jpeg(
    size: tuple[int, int], *, pitch: float = 12.0, film: int | None = 50, xmp: str = "", **exif: object
) -> bytes:
    """A JPEG of a 24 x 36 mm sensor of 3000 x 2000 pixels."""
    block = Image.Exif()
    block.get_ifd(0x8769).update(
        {0x920A: IFDRational(50), 0xA20E: IFDRational(round(1e7 / pitch), 1000), 0xA210: 3}
    )
    if film:
        block.get_ifd(0x8769)[0xA405] = film
    block.get_ifd(0x8769).update({int(tag[1:], 16): value for tag, value in exif.items()})
    out = io.BytesIO()
    Image.new("RGB", size, "grey").save(out, "JPEG", exif=block, xmp=xmp.encode())
    return out.getvalue()


CROP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/" crs:HasCrop="True"/>'
    "</rdf:RDF></x:xmpmeta>"
)
FRAMES = {
    "whole": (jpeg((3000, 2000), pitch=12.0), 12.0, True),
    "crop mode": (jpeg((2000, 1333), pitch=12.0, film=75), 12.0, True),
    "square": (jpeg((2000, 2000), pitch=12.0), 12.0, True),
    "16 : 9": (jpeg((3000, 1688), pitch=12.0), 12.0, True),
    "scaled down": (jpeg((1200, 800), pitch=12.0), 30.0, True),
    "cut by a program": (jpeg((2250, 1250), pitch=12.0), 12.0, False),
    "cut in the shape of a sensor": (jpeg((2250, 1500), pitch=12.0, xmp=CROP), 12.0, False),
    "digital zoom": (jpeg((3000, 2000), pitch=12.0, _A404=IFDRational(2)), 6.0, True),
    "nothing known": (jpeg((2250, 1250), pitch=6000.0, film=None), None, True),
}


@pytest.mark.parametrize("case", FRAMES)
def test_a_file_says_which_part_of_its_sensor_it_shows(case: str, tmp_path: Path) -> None:
    data, pitch, centred = FRAMES[case]
    (tmp_path / "x.jpg").write_bytes(data)

    info = photo.inspect(tmp_path / "x.jpg")

    assert info.metadata.pixel_pitch_um == (None if pitch is None else pytest.approx(pitch, rel=0.01))
    assert info.centred == centred


def bayer_dng(path: Path, mosaic: NDArray[np.uint16], **areas: tuple[int, ...]) -> Path:
    """A DNG that names its ActiveArea, or where its DefaultCrop begins and its size."""
    tags = {"active": 50829, "crop_origin": 50719, "crop_size": 50720}
    extra = [
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, bytes((0, 1, 1, 2)), True),
        (50706, 1, 4, b"\1\4\0\0", True),
        (50708, 2, 5, "T-1", True),
        (50714, 4, 1, 512, True),
        (50717, 4, 1, 15000, True),
        (50721, 10, 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        *((tags[name], 4, len(area), area, True) for name, area in areas.items()),
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=extra, metadata=None)
    return path


@pytest.mark.parametrize("crop", [{}, {"crop_origin": (8, 60), "crop_size": (200, 90)}])
def test_places_are_counted_from_the_middle_of_the_active_area_whatever_a_dng_would_crop(
    crop: dict[str, tuple[int, ...]], tmp_path: Path
) -> None:
    light = np.clip(scene()[1, :300, :400], 0.0, 1.0)
    mosaic = (512 + 14_000 * light).astype(np.uint16)
    mosaic[:20], mosaic[:, :30] = 512, 512  # covered by a mask
    top, left, bottom, right = 20, 30, 296, 398
    alone = bayer_dng(tmp_path / "alone.dng", mosaic[top:bottom, left:right].copy())
    active = bayer_dng(tmp_path / "active.dng", mosaic, active=(top, left, bottom, right), **crop)

    expected, developed = photo.develop(alone), photo.develop(active)

    assert developed.frame == expected.frame == Frame(276, 368)
    assert np.abs(developed.planes - expected.planes)[:, 4:-4, 4:-4].max() < 1e-6
    assert developed.cfa == expected.cfa
