"""Simulated photos: blur by exact kernels, sensor, scenes, files."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import exifread
import numpy as np
import pytest
import rawpy
from numpy.typing import NDArray
from PIL import Image

from lensmodel.core.errors import InvalidInputError, NotAnImageError
from lensmodel.core.psf import centroid
from lensmodel.core.types import Frame, Kernel, LensSettings, Planes, zone_of
from lensmodel.quality import edge_area
from lensmodel.simulate import (
    DEMO_SCENES,
    Aberrations,
    BlurOptions,
    SimulatedCamera,
    SimulatedLens,
    blurred,
    demo_data_path,
    demo_scene,
    draw_lens,
    edge_chart,
    load_scene,
    photograph,
    srgb_to_linear,
    write_photo,
)

FRAME = Frame(240, 360)
SIZE = 31
HALF = SIZE // 2
COARSE = BlurOptions(size=SIZE, step=0.5)


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


def point_lights(height: int, width: int, spacing: int) -> tuple[Planes, NDArray[np.intp]]:
    """Single bright pixels on a square grid over a black scene, and their rows and columns."""
    rows = np.arange(spacing // 2, height, spacing)
    cols = np.arange(spacing // 2, width, spacing)
    places = np.stack(np.meshgrid(rows, cols, indexing="ij"), axis=-1).reshape(-1, 2)
    scene = np.zeros((3, height, width), dtype=np.float32)
    scene[:, places[:, 0], places[:, 1]] = 1.0
    return scene, places


@pytest.fixture(scope="module")
def comatic() -> SimulatedLens:
    return Grey((Aberrations(f_number=2.8, coma=4.0, astigmatism=1.5, decentring=(0.1, 0.1)),))


@pytest.fixture(scope="module")
def lights(comatic: SimulatedLens) -> tuple[Planes, list[tuple[int, int]]]:
    """Point lights through a lens, and where they stand in the frame."""
    scene, places = point_lights(FRAME.height + 2 * HALF, FRAME.width + 2 * HALF, 48)
    inside = [
        (int(r) - HALF, int(c) - HALF)
        for r, c in places
        if 2 * HALF <= r < FRAME.height and 2 * HALF <= c < FRAME.width
    ]
    image = blurred(scene, comatic, LensSettings(), FRAME, BlurOptions(size=SIZE, step=0.12))
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
    assert np.linalg.norm(seen - mirrored) > 0.3 * np.linalg.norm(
        mirrored
    )  # it would not pass for the exact one


def test_lateral_colour_moves_red_and_blue_as_the_lens_says() -> None:
    fringed = SimulatedLens((Aberrations(f_number=4.0, lateral_red=(4e-3, 0.0), lateral_blue=(0.0, -4e-3)),))
    scene = np.zeros((3, FRAME.height, FRAME.width), dtype=np.float32)
    row, col = 45, 300
    scene[:, row, col] = 1.0
    image = blurred(scene, fringed, LensSettings(), FRAME, BlurOptions(size=SIZE, step=0.2))
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
    options = BlurOptions(size=SIZE, step=0.25)
    image = blurred(constant(FRAME.height, FRAME.width, 0.5), soft, LensSettings(), FRAME, options)

    assert np.abs(image / 0.5 - 1.0).max() < 1e-3


def test_scene_beyond_the_frame_shines_into_it() -> None:
    soft = Grey((Aberrations(f_number=4.0, defocus=4.0),))
    frame = Frame(96, 96)
    scene = np.zeros((3, 96 + 2 * HALF, 96 + 2 * HALF), dtype=np.float32)
    scene[:, :, : HALF - 2] = 1.0  # a bright wall that ends three pixels left of the frame
    image = blurred(scene, soft, LensSettings(), frame, COARSE)
    mirrored = blurred(np.zeros((3, 96, 96), dtype=np.float32), soft, LensSettings(), frame, COARSE)

    assert image[1, 48, 0] > 0.02
    assert mirrored.max() == 0.0


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (constant(100, 100), "must exceed"),
        (constant(FRAME.height, FRAME.width)[0], "shape"),
    ],
)
def test_blur_refuses_scenes_that_do_not_fit(scene: Planes, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        blurred(scene, PERFECT, LensSettings(), FRAME, COARSE)


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
        scene, PERFECT, LensSettings(), camera, np.random.default_rng(1), exposure=2.0, options=COARSE
    )

    assert photo.mosaic.max() == camera.white
    assert photo.clean.max() > 1.3
    np.testing.assert_allclose(photo.sharp, 1.4, rtol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        {"height": 15},
        {"width": 8},
        {"pattern": "RGBG"},
        {"black": 20000},
        {"white_balance": (0.5, 1.0, 1.0)},
        {"full_well_electrons": 0.0},
        {"read_noise": math.nan},
        {"pitch_um": 0.0},
    ],
)
def test_impossible_cameras_are_refused_by_name(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        SimulatedCamera(**wrong)


@pytest.mark.parametrize("wrong", [{"exposure": 0.0}, {"scene": -1.0}, {"scene": math.nan}])
def test_impossible_light_is_refused(wrong: dict[str, float]) -> None:
    camera, lens = SimulatedCamera(64, 96), draw_lens(1)
    scene = np.full((3, 64, 96), wrong.get("scene", 0.5), dtype=np.float32)
    settings = LensSettings(aperture=lens.widest())
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        photograph(scene, lens, settings, camera, None, exposure=wrong.get("exposure", 1.0))


def test_no_step_between_exact_kernels_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="step"):
        BlurOptions(step=0.0)


def test_written_photo_opens_in_libraw_with_its_lens_and_its_colours(tmp_path: Path) -> None:
    camera = SimulatedCamera(64, 96, pattern="GBRG")
    scene = np.empty((3, 64, 96), dtype=np.float32)
    scene[:] = np.array([0.6, 0.3, 0.1])[:, None, None]
    zoom = draw_lens(1, "zoom")
    settings = LensSettings(aperture=5.6, focal_mm=zoom.focal_mm[1], focus_m=math.inf)
    photo = photograph(scene, zoom, settings, camera, None, options=COARSE)
    write_photo(tmp_path / "photo.dng", photo)

    with rawpy.imread(str(tmp_path / "photo.dng")) as raw:
        np.testing.assert_array_equal(raw.raw_image, photo.mosaic)
        developed = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, adjust_maximum_thr=0.0, use_camera_wb=True, output_bps=16
        )
    np.testing.assert_allclose(developed[32, 48] / 65535, [0.6, 0.3, 0.1], atol=3e-3)
    with (tmp_path / "photo.dng").open("rb") as file:
        tags = exifread.process_file(file)
    assert str(tags["EXIF LensSerialNumber"]) == zoom.serial
    assert str(tags["EXIF LensModel"]) == zoom.model
    assert str(tags["EXIF ISOSpeedRatings"]) == "200"


def test_edge_pixels_hold_the_exact_area() -> None:
    fine = 400
    t = (np.arange(fine) + 0.5) / fine - 0.5
    for normal in (0.3, 1.2, -2.0, 2.9):
        for row, col in ((0.0, 0.0), (0.3, -0.2), (-0.5, 0.4)):
            distance = (col + t)[None, :] * math.cos(normal) - (row + t)[:, None] * math.sin(normal)
            area = edge_area(np.array(row), np.array(col), normal)
            assert area == pytest.approx((distance > 0).mean(), abs=2e-3)


def test_edge_along_the_grid_is_the_limit_of_a_slanted_one() -> None:
    cols = np.linspace(-1.5, 1.5, 13)
    np.testing.assert_allclose(
        edge_area(np.zeros(13), cols, 0.0), edge_area(np.zeros(13), cols, 1e-6), atol=1e-5
    )


def test_chart_has_edges_of_both_directions_in_every_zone_and_all_corners() -> None:
    frame = Frame(480, 720)
    chart = edge_chart(frame, margin=10, guard=20)

    zones = [zone_of(edge.position.r) for edge in chart.edges]
    seen = {(zone, edge.direction) for zone, edge in zip(zones, chart.edges, strict=True)}
    assert seen == {(z, d) for z in ("center", "mid", "corner") for d in ("tangential", "sagittal")}
    corners = {
        (e.position.phi > 0, abs(e.position.phi) > math.pi / 2)
        for zone, e in zip(zones, chart.edges, strict=True)
        if zone == "corner"
    }
    assert len(corners) == 4
    assert chart.scene.shape == (3, 500, 740)
    for edge in chart.edges:
        along = edge.position.phi if edge.direction == "tangential" else edge.position.phi + math.pi / 2
        assert abs(math.cos(edge.normal - along)) > math.cos(math.radians(10))
    boxes = np.zeros((480, 720), dtype=int)
    for edge in chart.edges:
        row, col, height, width = edge.box
        boxes[row : row + height, col : col + width] += 1
    assert boxes.max() == 1


def test_chart_refuses_frames_that_are_too_small() -> None:
    with pytest.raises(InvalidInputError, match="at least"):
        edge_chart(Frame(200, 300))


@pytest.mark.parametrize("name", DEMO_SCENES)
def test_demo_scenes_load_as_linear_light(name: str) -> None:
    scene = demo_scene(name)

    assert scene.shape[0] == 3
    assert min(scene.shape[1:]) >= 900
    assert scene.dtype == np.float32
    assert scene.min() >= 0.0
    assert scene.max() <= 1.0
    assert demo_data_path(f"{name}.jpg").stat().st_size < 0.9 * 2**20


def test_demo_files_are_listed_with_their_licence() -> None:
    readme = demo_data_path("README.md").read_text(encoding="utf-8")
    names = [entry.name for entry in demo_data_path("README.md").parent.iterdir() if entry.suffix != ".md"]

    assert len(names) == 5
    assert all(name in readme for name in names)


def test_unknown_scenes_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="colosseum"):
        demo_scene("nowhere")
    with pytest.raises(InvalidInputError, match="known"):
        demo_data_path("nowhere.png")
    (tmp_path / "text.png").write_bytes(b"no picture")
    with pytest.raises(NotAnImageError):
        load_scene(tmp_path / "text.png")


def test_srgb_curve_is_undone(tmp_path: Path) -> None:
    np.testing.assert_allclose(
        srgb_to_linear(np.array([0.0, 0.04045, 0.5, 1.0])), [0, 0.0031308, 0.214041, 1], atol=1e-6
    )
    Image.fromarray(np.full((4, 6, 3), 188, dtype=np.uint8)).save(tmp_path / "grey.png")
    assert load_scene(tmp_path / "grey.png") == pytest.approx(0.5029, abs=1e-3)
