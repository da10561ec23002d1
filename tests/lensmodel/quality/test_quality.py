"""Slanted edges and kernels against closed forms; edges of a chart are found, other pictures have none."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, optimize, special

from lab.images import by_zone, measure_edges
from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.psf import delta
from lensmodel.core.types import Frame, LensSettings, NoiseModel, zone_of
from lensmodel.quality import (
    crossing,
    edge_area,
    find_edges,
    mtf50_from_kernel,
    mtf_from_kernel,
    slanted_edge,
)
from lensmodel.simulate import Aberrations, SimulatedLens, blurred, demo_scene, edge_chart

STEP = 0.6


def blurred_edge(
    sigma: float, degrees: float, shape: tuple[int, int] = (100, 80), *, dark: float = 0.2
) -> NDArray[np.float64]:
    """Edge with a Gaussian blur, then integrated over the pixels by quadrature; bright along `degrees`."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    normal = math.radians(degrees)
    rows = (np.arange(shape[0]) - (shape[0] - 1) / 2)[:, None]
    cols = (np.arange(shape[1]) - (shape[1] - 1) / 2)[None, :]
    total = np.zeros(shape)
    for a, wa in zip(nodes / 2, weights / 2, strict=True):
        for b, wb in zip(nodes / 2, weights / 2, strict=True):
            distance = (cols + b) * math.cos(normal) - (rows + a) * math.sin(normal)
            total += wa * wb * special.ndtr(distance / sigma)
    return dark + STEP * total


def theory(sigma: float, degrees: float) -> float:
    """MTF50 of exp(-2 pi^2 s^2 f^2) sinc(f cos) sinc(f sin)."""
    n = math.radians(degrees)

    def contrast(f: float) -> float:
        gauss = math.exp(-2 * math.pi**2 * sigma**2 * f**2)
        return float(gauss * np.sinc(f * math.cos(n)) * np.sinc(f * math.sin(n)) - 0.5)

    return float(optimize.brentq(contrast, 1e-4, 0.9))


# published check values of the procedure: sigma, theory, measured without noise, with 1 percent
CHECK_VALUES = [
    (0.5, 0.3231, 0.3240, 0.333),
    (0.8, 0.2201, 0.2207, 0.221),
    (1.0, 0.1800, 0.1804, 0.180),
    (1.5, 0.1227, 0.1229, 0.123),
    (2.0, 0.0927, 0.0931, 0.093),
    (3.0, 0.0622, 0.0627, 0.063),
]


@pytest.mark.parametrize(("sigma", "wanted", "table", "noisy"), CHECK_VALUES)
def test_slanted_edge_reproduces_the_check_values_and_in_noise(
    sigma: float, wanted: float, table: float, noisy: float
) -> None:
    rng, edge = np.random.default_rng(0), blurred_edge(sigma, 5.0)
    quiet = slanted_edge(edge).mtf50
    loud = np.mean([slanted_edge(edge + rng.normal(0.0, 0.01 * STEP, edge.shape)).mtf50 for _ in range(10)])

    assert theory(sigma, 5.0) == pytest.approx(wanted, abs=1e-4)
    assert (quiet, loud) == (pytest.approx(wanted, rel=0.013), pytest.approx(wanted, rel=0.02))
    assert (quiet, loud) == (pytest.approx(table, rel=0.007), pytest.approx(noisy, rel=0.04))


@pytest.mark.parametrize("degrees", [5.0, -5.0, 95.0, 175.0, -84.0, 33.0, -52.0, 124.0, -151.0])
def test_slanted_edge_finds_any_direction_and_the_bright_side(degrees: float) -> None:
    measured = slanted_edge(blurred_edge(0.8, degrees))

    turn = (measured.normal - math.radians(degrees) + math.pi) % (2 * math.pi) - math.pi
    assert abs(turn) < 2e-3
    assert measured.mtf50 == pytest.approx(theory(0.8, degrees), rel=0.015)
    assert measured.step == pytest.approx(STEP, rel=1e-3)
    folded = abs(degrees) % 90
    assert measured.angle_deg == pytest.approx(min(folded, 90 - folded), abs=0.1)


def pixel_mtf(frequencies: np.ndarray, angle: float) -> np.ndarray:
    """Contrast that a square pixel leaves of a wave whose normal has this angle."""
    return np.abs(np.sinc(frequencies * math.cos(angle)) * np.sinc(frequencies * math.sin(angle)))


@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_mtf_curve_agrees_with_theory_up_to_nyquist(sigma: float) -> None:
    f, normal = np.linspace(0.0, 0.5, 26), math.radians(5.0)
    rows, cols = np.mgrid[-79.5:80, -59.5:60]
    edge = blurred_edge(sigma, 5.0, (160, 120)) if sigma else 0.2 + 0.6 * edge_area(rows, cols, normal)
    measured = slanted_edge(edge)
    wanted = np.exp(-2 * math.pi**2 * sigma**2 * f**2) * pixel_mtf(f, normal)

    np.testing.assert_allclose(
        np.interp(f, measured.frequencies, measured.mtf), wanted, atol=0.015 - 0.006 * sigma
    )


def test_sharpened_edge_shows_overshoot_and_an_mtf_above_one() -> None:
    edge = blurred_edge(1.2, 5.0)
    sharpened = edge + 1.5 * (edge - ndimage.gaussian_filter(edge, 2.0, mode="nearest"))
    plain, over = slanted_edge(edge), slanted_edge(sharpened)

    assert plain.overshoot < 0.1
    assert plain.mtf[plain.frequencies <= 0.5].max() == pytest.approx(1.0, abs=1e-3)
    assert over.overshoot > 5.0
    assert over.mtf[over.frequencies <= 0.5].max() > 1.1


def test_slanted_edge_refuses_what_holds_no_edge() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(NotEnoughEvidenceError):
        slanted_edge(0.5 + rng.normal(0.0, 0.01, (80, 80)))
    with pytest.raises(NotEnoughEvidenceError, match="lean"):
        slanted_edge(blurred_edge(0.5, 0.0))
    with pytest.raises(InvalidInputError, match="finite"):
        slanted_edge(np.full((80, 80), np.nan))
    with pytest.raises(InvalidInputError, match="16 x 16"):
        slanted_edge(np.zeros((8, 80)))


@pytest.mark.tools
def test_published_edge_of_known_angle_and_width_is_measured_right(shared_data: Path) -> None:
    edge = tifffile.imread(shared_data / "edges" / "simulated_edge_known_fwhm.tif")
    measured = slanted_edge(edge.astype(np.float64))

    assert measured.angle_deg == pytest.approx(16.776550, abs=5e-3)
    assert 0.216 < measured.mtf50 < 0.226  # two independent tools say 0.218 and 0.224


@pytest.mark.tools
def test_a_real_edge_is_as_sharp_as_other_tools_say(shared_data: Path) -> None:
    measured = slanted_edge(np.asarray(Image.open(shared_data / "edges" / "slant.png").convert("L")) / 255.0)

    assert measured.angle_deg == pytest.approx(6.0, abs=0.01)
    assert measured.mtf50 == pytest.approx(0.478, rel=0.05)  # another says 0.454; the edge is nearly ideal


def test_crossing_interpolates_and_says_the_end_when_there_is_none() -> None:
    assert crossing([0.0, 0.1, 0.2], [1.0, 0.6, 0.4], 0.5) == pytest.approx(0.15)
    assert crossing([0.0, 0.1, 0.2], [1.0, 0.9, 0.8], 0.5) == 0.2


def test_mtf_of_a_gaussian_kernel_is_the_closed_form_along_both_axes() -> None:
    kernel = gaussian(41, [[4.0, 0.0], [0.0, 1.0]])  # rows wide, columns narrow
    f = np.linspace(0.0, 0.4, 9)

    for angle, variance in ((0.0, 1.0), (math.pi / 2, 4.0)):
        wanted = np.exp(-2 * math.pi**2 * variance * f**2) * np.sinc(f)
        np.testing.assert_allclose(mtf_from_kernel(kernel, angle, f), wanted, atol=2e-3)


def test_tangential_is_along_u_and_sagittal_along_v() -> None:
    phi = 0.6
    c, s = math.cos(phi), math.sin(phi)
    u, v = np.array([-s, c]), np.array([-c, -s])  # (row, col) of the local frame
    kernel = gaussian(41, 4.0 * np.outer(u, u) + 1.0 * np.outer(v, v))  # stretched along u
    tangential, sagittal = (mtf50_from_kernel(kernel, phi + turn) for turn in (0.0, math.pi / 2))

    assert tangential == pytest.approx(theory(2.0, math.degrees(phi)), rel=0.01)
    assert sagittal == pytest.approx(theory(1.0, math.degrees(phi)), rel=0.01)


def test_photographed_chart_agrees_with_the_kernels_own_mtf() -> None:
    terms = {"coma": 3.0, "astigmatism": 1.5, "field_curvature": -0.5, "defocus": 1.2}
    comatic = SimulatedLens((Aberrations(2.8, decentring=(0.1, 0.1), **terms),))
    frame = Frame(720, 960)
    chart = edge_chart(frame, margin=16, guard=16)
    image = blurred(chart.scene, comatic, LensSettings(), frame, size=31, step=0.16)[1]
    measured = measure_edges(image, [edge.box for edge in chart.edges])

    assert len(measured) == len(chart.edges)
    ratios = []
    for edge, seen in zip(chart.edges, measured, strict=True):
        exact = mtf50_from_kernel(comatic.kernel(edge.position, size=31), edge.normal)
        response = seen.response
        # the chart was integrated over the pixel once already
        mtf = response.mtf / np.maximum(pixel_mtf(response.frequencies, response.normal), 0.1)
        ratios.append(crossing(response.frequencies, mtf, 0.5) / exact)
        assert seen.direction == edge.direction
        assert seen.zone == zone_of(edge.position.r)
        assert abs(math.sin(seen.response.normal - edge.normal)) < 0.01
    assert np.abs(np.array(ratios) - 1.0).max() < 0.03

    table = by_zone(measured)
    assert {zone: row.edges for zone, row in table.items()} == {"center": 2, "mid": 8, "corner": 8}
    assert table["corner"].mtf50 < table["center"].mtf50
    assert table["corner"].mtf_max < 1.01


def test_delta_kernel_passes_everything() -> None:
    kernel = delta(15)

    np.testing.assert_allclose(mtf_from_kernel(kernel, 0.3, [0.0, 0.2, 0.5]), 1.0)
    assert mtf50_from_kernel(kernel, 0.3) == 1.0


# ---- edges that are found without being told where

FRAME = Frame(900, 1200)
CHART = edge_chart(FRAME)
BOXES = [edge.box for edge in CHART.edges]


def noisy(plane: NDArray[np.floating], noise: NoiseModel) -> NDArray[np.float32]:
    rng = np.random.default_rng(3)
    seen = plane + rng.normal(size=plane.shape) * np.sqrt(noise.variance(plane))
    return seen.astype(np.float32)


@cache
def soft(sigma: float) -> NDArray[np.float32]:
    rows = (CHART.scene.shape[1] - FRAME.height) // 2
    return ndimage.gaussian_filter(CHART.scene[1], sigma)[rows:-rows, rows:-rows]


@pytest.mark.parametrize("sigma", [0.6, 1.5, 3.0])
@pytest.mark.parametrize("noise", [NoiseModel(1 / 50000, 1e-6), NoiseModel(1 / 2500, 9e-6)])
def test_found_edges_are_as_sharp_as_those_in_known_boxes(sigma: float, noise: NoiseModel) -> None:
    photo = noisy(soft(sigma), noise)

    table = by_zone(measure_edges(photo, [edge.box for edge in find_edges(photo, noise=noise)]))

    known = by_zone(measure_edges(photo, BOXES))
    assert table.keys() == known.keys() == {"center", "mid", "corner"}
    for zone, row in table.items():
        assert row.edges >= 2
        assert row.mtf50 == pytest.approx(known[zone].mtf50, rel=0.05)


def test_found_boxes_lie_in_the_frame_and_every_edge_is_found_once() -> None:
    found = find_edges(soft(1.0))

    for edge in found:
        row, col, height, width = edge.box
        assert min(row, col) >= 0
        assert row + height <= FRAME.height
        assert col + width <= FRAME.width
    middles = np.array([edge.middle for edge in found])
    apart = np.hypot(*(middles[:, None] - middles).transpose(2, 0, 1)) + 1e9 * np.eye(len(found))
    assert len(found) >= len(BOXES)
    assert apart.min() > 40.0


@pytest.mark.parametrize("name", ["city", "lake"])
@pytest.mark.parametrize("sigma", [0.0, 1.5])
def test_photographs_of_other_things_have_none(name: str, sigma: float) -> None:
    plane = ndimage.gaussian_filter(demo_scene(name)[1], sigma)

    assert find_edges(plane) == ()


def test_one_strong_edge_is_no_chart() -> None:
    photo = np.full((FRAME.height, FRAME.width), 0.2, dtype=np.float32)
    row, col, height, width = BOXES[0]
    photo[row : row + height, col : col + width] = soft(1.0)[row : row + height, col : col + width]

    assert find_edges(photo) == ()


def test_clipped_edges_are_left_alone() -> None:
    photo = soft(1.0)

    assert find_edges(photo)
    assert find_edges(photo, clip=float(photo.max())) == ()
    assert find_edges(np.minimum(photo, 0.6), clip=0.6) == ()


@pytest.mark.parametrize(
    "plane",
    [
        np.zeros((0, 5)),
        np.zeros((1, 1)),
        np.zeros((300, 400)),
        np.full((64, 64), -3.0),
        np.full((64, 3000), 1e30),
        np.full((200, 200), 1e-38),
        np.random.default_rng(4).random((200, 200)) * 1e30,
        np.indices((200, 200)).sum(axis=0) % 2 * 0.5,
        np.tri(300) * 0.5 + 0.1,
        np.linspace(0.0, 1.0, 300)[:, None] * np.ones(300),
        np.where(np.random.default_rng(2).random((300, 300)) > 0.999, 1e18, 0.0),
    ],
    ids=lambda plane: f"{plane.shape}",
)
def test_strange_planes_have_no_edges_and_no_errors(plane: NDArray[np.float64]) -> None:
    plane = plane.astype(np.float32)

    assert find_edges(plane) == ()
