"""Simulated lenses against closed forms of diffraction and of ray optics; photos through them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import exifread
import numpy as np
import pytest
import rawpy
from numpy.typing import NDArray
from PIL import Image

from lab.kernels import distance
from lab.model_benchmark import pixel_to_local
from lensmodel.core.errors import InvalidInputError, NotAnImageError
from lensmodel.core.psf import centroid, rms_width
from lensmodel.core.types import Channel, FieldPosition, Frame, Kernel, LensSettings, Planes, zone_of
from lensmodel.quality import edge_area
from lensmodel.simulate import (
    DEMO_SCENES,
    LENS_KINDS,
    Aberrations,
    SimulatedCamera,
    SimulatedLens,
    blurred,
    demo_data_path,
    demo_scene,
    draw_lens,
    edge_chart,
    load_scene,
    photograph,
    write_photo,
)
from lensmodel.simulate.lens import PixelOtf, Pupil, pixel_otf

PITCH = 4.5
CENTER = FieldPosition(0.0, 0.0)
ANGLES = (0.0, 0.7, 1.9, -2.6, -1.2)


def lens(**terms: object) -> SimulatedLens:
    return SimulatedLens((Aberrations(**terms),))  # type: ignore[arg-type]


def diffraction_mtf(frequency: NDArray[np.float64], cutoff: float) -> NDArray[np.float64]:
    """Goodman, Introduction to Fourier Optics, eq. 6-31."""
    x = np.clip(frequency / cutoff, 0.0, 1.0)
    return 2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x * x))


def otf_of(f_number: float, wavelength_um: float, size: int = 55, **terms: object) -> PixelOtf:
    optics = Aberrations(f_number=f_number, **terms)  # type: ignore[arg-type]
    pupil = Pupil.of(optics, (0.0, 0.0), f_number)
    return pixel_otf(pupil, [(wavelength_um, 1.0)], size=size, pitch_um=PITCH, f_number=f_number)


def moments(kernel: Kernel, phi: float, order: int) -> tuple[float, float]:
    """Moment of a centred kernel along u and along v, within its core."""
    kernel = np.where(kernel > 0.01 * kernel.max(), kernel, 0.0)
    t = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    u, v = pixel_to_local(t[:, None], t[None, :], phi)
    return float((kernel * u**order).sum()), float((kernel * v**order).sum())


@pytest.mark.parametrize(("f_number", "size"), [(2.8, 101), (4.0, 151), (11.0, 151)])
def test_transfer_function_of_a_perfect_lens_is_the_closed_form(f_number: float, size: int) -> None:
    wave = 0.54
    otf = otf_of(f_number, wave, size)
    frequency = np.arange(otf.values.shape[1]) / otf.period
    wanted = diffraction_mtf(frequency, PITCH / (wave * f_number)) * np.sinc(frequency)

    assert np.abs(otf.values[0].real - wanted)[1:].max() < 1.5e-3
    assert 0.99 < otf.values[0, 0].real < 1.0  # diffraction throws light beyond any finite array
    assert np.abs(otf.values[0].imag).max() < 1e-5


def test_half_a_wave_of_defocus_makes_the_strehl_ratio_of_theory() -> None:
    # on the axis of a defocused lens I / I0 = sinc^2(W020), whatever the aperture
    peak = []
    for otf in (otf_of(16.0, 0.54), otf_of(16.0, 0.54, defocus=0.5)):
        rows, half = otf.values.shape
        pixel = np.sinc(np.fft.fftfreq(rows, 1.0 / rows) / otf.period)[:, None]
        pixel = pixel * np.sinc(np.arange(half) / otf.period)
        bare = otf.values.real / np.where(np.abs(pixel) > 1e-3, pixel, 1.0)
        peak.append(bare[:, 0].sum() + 2.0 * bare[:, 1:].sum())

    assert peak[1] / peak[0] == pytest.approx(np.sinc(0.5) ** 2, rel=0.01)


def test_width_of_a_defocused_point_is_that_of_the_ray_cone() -> None:
    # blur disc of radius 4 lambda N W020; rms width per axis = radius / 2
    f_number, waves = 2.0, 4.0
    kernel = lens(f_number=f_number, defocus=waves).kernel(CENTER)
    radius_px = 4.0 * 0.54 * f_number * waves / PITCH

    assert rms_width(kernel) == pytest.approx(math.hypot(radius_px / 2.0, math.sqrt(1 / 12)), rel=0.04)


@pytest.mark.parametrize(
    ("terms", "r", "phi"),
    [
        *(({"coma": 9.0}, 0.9, phi) for phi in ANGLES),
        ({"uniform_coma": (9.0, 0.0)}, 0.0, 0.0),
        ({"uniform_coma": (0.0, 9.0)}, 0.0, math.pi / 2),  # u of phi = pi/2 points towards row 0
    ],
)
def test_positive_coma_throws_light_outwards_and_uniform_coma_as_named(
    terms: dict[str, object], r: float, phi: float
) -> None:
    kernel = lens(f_number=2.0, **terms).kernel(FieldPosition(r, phi), size=41)
    along_u, along_v = moments(kernel, phi, 3)

    assert along_u > 1.0
    assert abs(along_v) < 0.05 * along_u


@pytest.mark.parametrize("phi", ANGLES)
def test_astigmatism_stretches_along_u_at_every_angle(phi: float) -> None:
    kernel = lens(f_number=2.8, astigmatism=2.5).kernel(FieldPosition(0.9, phi), size=41)
    along_u, along_v = moments(kernel, phi, 2)

    assert along_u > 3.0 * along_v


@pytest.mark.parametrize("phi", ANGLES)
def test_a_quarter_turn_of_the_field_turns_the_kernel(phi: float) -> None:
    centred_lens = lens(f_number=2.8, coma=2.0, astigmatism=1.0, spherical=0.5, vignetting=(1.1, 0.3))
    kernel = centred_lens.kernel(FieldPosition(0.8, phi), size=31)
    turned = centred_lens.kernel(FieldPosition(0.8, phi + math.pi / 2), size=31)

    # each is centred to 5e-4 px; a kernel turned the wrong way differs by far more
    assert np.linalg.norm(np.rot90(kernel) - turned) < 2e-3 * np.linalg.norm(turned)
    assert np.linalg.norm(np.rot90(kernel, -1) - turned) > 0.1 * np.linalg.norm(turned)


def test_decentring_moves_the_place_of_symmetry() -> None:
    shifted = lens(f_number=2.0, coma=3.0, field_curvature=2.0, decentring=(0.3, -0.2))
    r, phi = math.hypot(0.3, 0.2), math.atan2(-0.2, 0.3)
    clean = lens(f_number=2.0).kernel(CENTER, size=31)

    assert distance(shifted.kernel(FieldPosition(r, phi), size=31), clean).rel_l2 < 1e-3
    assert distance(shifted.kernel(CENTER, size=31), clean).rel_l2 > 0.1


@pytest.mark.parametrize(
    ("terms", "sharp", "soft"),
    [
        ({"tilt": (2.0, 0.0)}, (FieldPosition(0.8, math.pi), "g"), (FieldPosition(0.8, 0.0), "g")),
        ({"colour_focus": (2.0, 0.0)}, (CENTER, "g"), (CENTER, "r")),
        ({"colour_focus": (2.0, 0.0)}, (CENTER, "g"), (CENTER, "b")),
    ],
)
def test_tilt_blurs_the_side_that_it_names_and_longitudinal_colour_red_and_blue(
    terms: dict[str, object], sharp: tuple[FieldPosition, Channel], soft: tuple[FieldPosition, Channel]
) -> None:
    faulty = lens(f_number=2.0, defocus=1.0 if "tilt" in terms else 0.0, **terms)
    least, most = (
        rms_width(faulty.kernel(place, LensSettings(channel=c), size=41)) for place, c in (sharp, soft)
    )

    assert most > 1.25 * least


OPTICS = Aberrations(
    f_number=2.0, spherical=2.0, coma=1.5, astigmatism=0.7, defocus=-1.0, tilt=(0.2, 0.1),
    uniform_astigmatism=(0.3, 0.4),
)  # fmt: skip


def test_stopped_down_wavefront_is_the_inner_part_of_the_open_one() -> None:
    whole, closed = (Pupil.of(OPTICS, (0.5, -0.4), n).wavefront for n in (2.0, 4.0))
    px, py = (
        np.linspace(-1, 1, 9, dtype=np.float32)[None, :],
        np.linspace(-1, 1, 7, dtype=np.float32)[:, None],
    )

    np.testing.assert_allclose(closed(px, py, 0.6), whole(px / 2, py / 2, 0.6), atol=1e-5)


def test_ray_gradient_is_the_derivative_of_the_wavefront() -> None:
    pupil = Pupil.of(OPTICS, (0.6, 0.3), 2.0)
    x, y, e = np.array([0.4]), np.array([-0.3]), 1e-3
    ahead, behind = ((pupil.wavefront(x + d, y, 0.54), pupil.wavefront(x, y + d, 0.54)) for d in (e, -e))
    slopes = np.subtract(ahead, behind) / (2 * e)

    np.testing.assert_allclose(pupil.gradient(x, y, 0.54), slopes, rtol=1e-3)


def test_finer_pixels_show_the_same_kernel_larger() -> None:
    comatic = lens(f_number=2.0, coma=3.0)
    h = (0.9, 0.4)
    fine = comatic.kernel_at_field(h, LensSettings(), 63, pitch_um=2.0)
    binned = fine.reshape(21, 3, 21, 3).sum(axis=(1, 3))
    coarse = comatic.kernel_at_field(h, LensSettings(), 21, pitch_um=6.0, offset=centroid(binned))

    assert np.linalg.norm(binned - coarse) < 0.01 * np.linalg.norm(coarse)


def test_zoom_passes_through_its_ends_and_lies_between() -> None:
    zoom = draw_lens(1, "zoom")
    short, long = zoom.focal_mm
    middle = zoom.at_focal(math.sqrt(short * long))

    assert (zoom.at_focal(short), zoom.at_focal(long)) == zoom.optics
    assert middle.coma == pytest.approx((zoom.optics[0].coma + zoom.optics[1].coma) / 2)


@pytest.mark.parametrize("kind", LENS_KINDS)
def test_drawn_lenses_have_centred_kernels_of_realistic_widths(kind: str) -> None:
    for seed in (11, 12):
        drawn = draw_lens(seed, kind)
        assert drawn == draw_lens(seed, kind) != draw_lens(seed + 1, kind)
        corners = [drawn.kernel(FieldPosition(0.95, phi)) for phi in (0.6, 2.5, -2.5, -0.6)]
        center = rms_width(drawn.kernel(CENTER))

        assert all(max(map(abs, centroid(kernel))) < 1e-3 for kernel in corners)
        assert 0.2 < center < 1.6
        assert max(0.5, center) < np.mean([rms_width(kernel) for kernel in corners]) < 5.0


# ---- photos: blur by exact kernels, sensor, scenes, files

FRAME = Frame(240, 360)
SIZE = 31
HALF = SIZE // 2
COARSE = {"size": SIZE, "step": 0.5}


class Grey(SimulatedLens):
    """A lens that blurs all colours as it blurs green: kernels take long, and are made once for all."""

    def kernel_at_field(
        self, h: tuple[float, float], settings: LensSettings, size: int, **options: Any
    ) -> Kernel:
        return _kernel_at_field(self, h, settings.with_channel("g"), size, **options)


_kernel_at_field = cache(SimulatedLens.kernel_at_field)
PERFECT = Grey((Aberrations(f_number=4.0),))


def constant(height: int, width: int, level: float = 0.5) -> Planes:
    return np.full((3, height, width), level, dtype=np.float32)


@pytest.fixture(scope="module")
def comatic() -> SimulatedLens:
    return Grey((Aberrations(f_number=2.8, coma=4.0, astigmatism=1.5, decentring=(0.1, 0.1)),))


@pytest.fixture(scope="module")
def lights(comatic: SimulatedLens) -> tuple[Planes, list[tuple[int, int]]]:
    """Point lights through a lens, and where they stand in the frame."""
    scene = np.zeros((3, FRAME.height + 2 * HALF, FRAME.width + 2 * HALF), dtype=np.float32)
    scene[:, 24::48, 24::48] = 1.0
    inside = [
        (row - HALF, col - HALF)
        for row, col in np.argwhere(scene[0]).tolist()
        if 2 * HALF <= row < FRAME.height and 2 * HALF <= col < FRAME.width
    ]
    image = blurred(scene, comatic, LensSettings(), FRAME, size=SIZE, step=0.12)
    return image, inside


def test_a_point_light_becomes_the_kernel_of_its_place(
    comatic: SimulatedLens, lights: tuple[Planes, list[tuple[int, int]]]
) -> None:
    image, places = lights
    errors = []
    for row, col in places:
        seen = image[1, row - HALF : row + HALF + 1, col - HALF : col + HALF + 1]
        exact = comatic.kernel(FRAME.position(row, col), size=SIZE)
        errors.append(float(np.linalg.norm(seen - exact) / np.linalg.norm(exact)))
        assert seen.sum() == pytest.approx(1.0, abs=1e-4)

    assert len(places) >= 20
    assert np.median(errors) < 0.01
    assert max(errors) < 0.03
    mirrored = comatic.kernel(FRAME.position(FRAME.height - 1 - row, col), size=SIZE)
    assert np.linalg.norm(seen - mirrored) > 0.3 * np.linalg.norm(mirrored)  # that would be noticed


def test_lateral_colour_moves_red_and_blue_as_the_lens_says() -> None:
    fringed = SimulatedLens((Aberrations(f_number=4.0, lateral_red=(4e-3, 0.0), lateral_blue=(0.0, -4e-3)),))
    scene = np.zeros((3, FRAME.height, FRAME.width), dtype=np.float32)
    row, col = 45, 300
    scene[:, row, col] = 1.0
    image = blurred(scene, fringed, LensSettings(), FRAME, size=SIZE, step=0.2)
    position = FRAME.position(row, col)
    seen = {
        c: np.array(centroid(image[i, row - HALF : row + HALF + 1, col - HALF : col + HALF + 1]))
        for i, c in enumerate("rgb")
    }
    outwards = np.array([-math.sin(position.phi), math.cos(position.phi)]) * FRAME.half_diagonal

    np.testing.assert_allclose(seen["r"], 4e-3 * position.r * outwards, atol=0.03)
    np.testing.assert_allclose(seen["g"], 0.0, atol=0.01)
    np.testing.assert_allclose(seen["b"], -4e-3 * position.r**3 * outwards, atol=0.03)


def test_photo_of_a_constant_is_constant() -> None:
    # defocused, since the centre of mass of a kernel much sharper than a pixel jumps between
    # places by a tenth of a pixel, and that distortion is brightness
    soft = Grey((Aberrations(f_number=2.8, astigmatism=1.0, coma=1.0, defocus=2.0),))
    image = blurred(constant(FRAME.height, FRAME.width), soft, LensSettings(), FRAME, size=SIZE, step=0.25)

    assert np.abs(image / 0.5 - 1.0).max() < 1e-3


def test_scene_beyond_the_frame_shines_into_it() -> None:
    soft, scene = Grey((Aberrations(f_number=4.0, defocus=4.0),)), constant(96 + 2 * HALF, 96 + 2 * HALF, 0.0)
    scene[:, :, : HALF - 2] = 1.0  # a bright wall that ends three pixels left of the frame

    assert blurred(scene, soft, LensSettings(), Frame(96, 96), **COARSE)[1, 48, 0] > 0.02


def test_noise_has_the_variance_of_the_noise_model() -> None:
    camera = SimulatedCamera(256, 256, full_well_electrons=2000.0, read_noise=8.0, white_balance=(1, 1, 1))
    rng = np.random.default_rng(0)
    for level in (0.05, 0.5):
        numbers = camera.mosaic(constant(256, 256, level), rng).astype(float)
        light = (numbers - camera.black) / (camera.white - camera.black)

        assert light.mean() == pytest.approx(level, rel=2e-3)
        assert light.var() == pytest.approx(camera.noise.variance(np.array(level)), rel=0.03)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_mosaic_shows_each_colour_where_the_pattern_says(pattern: str) -> None:
    camera = SimulatedCamera(16, 16, pattern=pattern, black=100, white=4000)
    planes = np.stack([np.full((16, 16), level, dtype=np.float32) for level in (0.1, 0.5, 0.9)])
    mosaic = camera.mosaic(planes, None)

    for i, letter in enumerate(pattern):
        level = {"R": 0.1, "G": 0.5, "B": 0.9}[letter]
        assert (mosaic[i // 2 :: 2, i % 2 :: 2] == round(100 + level * 3900)).all()


def test_overexposure_clips_at_the_white_level() -> None:
    camera = SimulatedCamera(64, 64, white_balance=(1, 1, 1))
    scene = constant(64, 64, 0.7)
    photo = photograph(
        scene, PERFECT, LensSettings(), camera, np.random.default_rng(1), exposure=2.0, **COARSE
    )

    assert photo.mosaic.max() == camera.white
    assert photo.clean.max() > 1.3
    np.testing.assert_allclose(photo.sharp, 1.4, rtol=1e-6)


def test_written_photo_opens_in_libraw_with_its_lens_and_its_colours(tmp_path: Path) -> None:
    camera = SimulatedCamera(64, 96, pattern="GBRG")
    scene = np.empty((3, 64, 96), dtype=np.float32)
    scene[:] = np.array([0.6, 0.3, 0.1])[:, None, None]
    zoom = draw_lens(1, "zoom")
    settings = LensSettings(aperture=5.6, focal_mm=zoom.focal_mm[1], focus_m=math.inf)
    photo = photograph(scene, zoom, settings, camera, None, **COARSE)
    write_photo(tmp_path / "photo.dng", photo)

    with rawpy.imread(str(tmp_path / "photo.dng")) as raw:
        np.testing.assert_array_equal(raw.raw_image, photo.mosaic)
        developed = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, adjust_maximum_thr=0.0, use_camera_wb=True, output_bps=16
        )
    np.testing.assert_allclose(developed[32, 48] / 65535, [0.6, 0.3, 0.1], atol=3e-3)
    with (tmp_path / "photo.dng").open("rb") as file:
        tags = exifread.process_file(file)
    assert str(tags["EXIF LensSerialNumber"]) == zoom.identity.serial
    assert str(tags["EXIF LensModel"]) == zoom.identity.model
    assert str(tags["EXIF ISOSpeedRatings"]) == "200"


@pytest.mark.parametrize("normal", [0.0, 0.3, 1.2, -2.0, 2.9])
@pytest.mark.parametrize(("row", "col"), [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.4)])
def test_edge_pixels_hold_the_exact_area(normal: float, row: float, col: float) -> None:
    t = (np.arange(400) + 0.5) / 400 - 0.5
    distance = (col + t)[None, :] * math.cos(normal) - (row + t)[:, None] * math.sin(normal)

    area = edge_area(np.array(row), np.array(col), normal)
    assert area == pytest.approx((distance > 0).mean(), abs=2e-3)


def test_chart_has_edges_of_both_directions_in_every_zone_and_all_corners() -> None:
    chart = edge_chart(Frame(480, 720), margin=10, guard=20)
    places = [(zone_of(edge.position.r), edge.position.phi) for edge in chart.edges]
    boxes = np.zeros((480, 720), dtype=int)

    assert chart.scene.shape == (3, 500, 740)
    assert {(zone, edge.direction) for (zone, _), edge in zip(places, chart.edges, strict=True)} == {
        (zone, d) for zone in ("center", "mid", "corner") for d in ("tangential", "sagittal")
    }
    assert len({math.floor(phi / (math.pi / 2)) for zone, phi in places if zone == "corner"}) == 4
    for edge in chart.edges:
        along = edge.position.phi if edge.direction == "tangential" else edge.position.phi + math.pi / 2
        assert abs(math.cos(edge.normal - along)) > math.cos(math.radians(10))
        row, col, height, width = edge.box
        boxes[row : row + height, col : col + width] += 1
    assert boxes.max() == 1


@pytest.mark.parametrize("name", DEMO_SCENES)
def test_demo_scenes_load_as_linear_light_and_are_listed_with_their_licence(name: str) -> None:
    scene, path = demo_scene(name), demo_data_path(f"{name}.jpg")

    assert scene.shape[0] == 3
    assert min(scene.shape[1:]) >= 900
    assert scene.dtype == np.float32
    assert 0.0 <= scene.min() <= scene.max() <= 1.0
    assert path.stat().st_size < 0.9 * 2**20
    assert path.name in demo_data_path("README.md").read_text(encoding="utf-8")


def test_pictures_load_with_the_srgb_curve_undone_and_other_files_not(tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 6, 3), 188, dtype=np.uint8)).save(tmp_path / "grey.png")
    (tmp_path / "text.png").write_bytes(b"no picture")

    assert load_scene(tmp_path / "grey.png") == pytest.approx(0.5029, abs=1e-3)
    with pytest.raises(NotAnImageError):
        load_scene(tmp_path / "text.png")


# ---- what is refused


def light(level: float = 0.5, *, exposure: float = 1.0) -> None:
    photograph(
        constant(64, 96, level), PERFECT, LensSettings(), SimulatedCamera(64, 96), None, exposure=exposure
    )


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (lambda: draw_lens(0).kernel(CENTER, LensSettings(aperture=1.0)), "the lens works from"),
        (lambda: draw_lens(0).kernel(CENTER, LensSettings(focal_mm=500.0)), "covers"),
        (lambda: draw_lens(0).kernel(CENTER, pitch_um=0.0), "pitch"),
        (lambda: Aberrations(coma=math.nan), "finite"),
        (lambda: Aberrations(f_number=-2.0), "f_number"),
        (lambda: SimulatedLens((Aberrations(), Aberrations()), (70.0, 24.0)), "ascending"),
        (lambda: SimulatedLens((Aberrations(),), (24.0, 70.0)), "one for each"),
        (lambda: draw_lens(1, "magic"), "known"),
        (lambda: SimulatedCamera(height=15), "height"),
        (lambda: SimulatedCamera(pattern="RGBG"), "pattern"),
        (lambda: SimulatedCamera(black=20000), "black"),
        (lambda: SimulatedCamera(white_balance=(0.5, 1.0, 1.0)), "white_balance"),
        (lambda: SimulatedCamera(read_noise=math.nan), "read_noise"),
        (lambda: light(exposure=0.0), "exposure"),
        (lambda: light(-1.0), "scene"),
        (lambda: blurred(constant(100, 100), PERFECT, LensSettings(), FRAME, **COARSE), "must exceed"),
        (lambda: blurred(constant(240, 360)[0], PERFECT, LensSettings(), FRAME, **COARSE), "shape"),
        (lambda: blurred(constant(200, 300), PERFECT, LensSettings(), FRAME, step=0.0), "step"),
        (lambda: edge_chart(Frame(200, 300)), "at least"),
        (lambda: demo_scene("nowhere"), "colosseum"),
        (lambda: demo_data_path("nowhere.png"), "known"),
    ],
)
def test_impossible_requests_are_refused_with_the_reason(request_: Callable[[], object], said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        request_()
