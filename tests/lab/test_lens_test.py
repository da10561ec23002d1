"""The lens test: all edges of a chart belong to their squares, and T and S agree with the truth."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from lab.images import direction_of
from lab.lens_test import MARGIN, Square, squares_chart, true_mtf50
from lensmodel.core.types import Frame, LensSettings
from lensmodel.measured.edges import SlantedEdges, chart_edges, squares_of
from lensmodel.photo import LinearPhoto, develop
from lensmodel.quality import find_edges, mtf50_from_kernel
from lensmodel.simulate import Aberrations, SimulatedCamera, SimulatedLens, photograph, write_photo

CAMERA = SimulatedCamera(height=1000, width=1500)
# off the axis S is up to 2.3 times as sharp as T; on the left T is softer than on the right
FAULTS = Aberrations(
    2.8, spherical=2.0, defocus=-1.0, astigmatism=3.0, field_curvature=-2.6, tilt=(-0.4, 0.0)
)
ASTIGMATIC = SimulatedLens((FAULTS,))


@pytest.fixture(scope="module")
def chart(tmp_path_factory: pytest.TempPathFactory) -> tuple[LinearPhoto, tuple[Square, ...]]:
    scene, squares = squares_chart(CAMERA.frame)
    shot = photograph(scene, ASTIGMATIC, LensSettings(), CAMERA, np.random.default_rng(0))
    path = tmp_path_factory.mktemp("chart") / "chart.dng"
    write_photo(path, shot)
    return develop(path), squares


def truth(photo: LinearPhoto, pixel: tuple[float, float], normal: float) -> float:
    return min(true_mtf50(ASTIGMATIC, photo.frame.position(*pixel), normal, CAMERA.pitch_um), 0.5)


@pytest.mark.slow
def test_every_square_of_the_chart_is_one_place(chart: tuple[LinearPhoto, tuple[Square, ...]]) -> None:
    photo, squares = chart

    groups = squares_of(chart_edges(photo))

    assert len(groups) == len(squares) == 35
    for group in groups:
        middle = np.mean([edge.middle for edge in group], axis=0)
        near = [s for s in squares if math.dist(middle, (s.row, s.col)) < s.side / 2]
        assert len(near) == 1
        for edge in group:  # each lies on a side of its own square
            away = math.dist(edge.middle, (near[0].row, near[0].col))
            assert away == pytest.approx(near[0].side / 2, rel=0.15)
    assert sum(map(len, groups)) >= 0.95 * 4 * len(squares)


@pytest.mark.slow
def test_tangential_and_sagittal_are_not_mixed(chart: tuple[LinearPhoto, tuple[Square, ...]]) -> None:
    photo, _ = chart

    psfs = SlantedEdges().measure([photo], size=31, channels=("g",))

    tangential, sagittal, apart = [], [], []
    for psf in psfs:
        phi = psf.position.phi
        pixel = photo.frame.pixel(psf.position)
        true = truth(photo, pixel, phi), truth(photo, pixel, phi + math.pi / 2)
        seen = [min(mtf50_from_kernel(psf.kernel, phi + turn), 0.5) for turn in (0.0, math.pi / 2)]
        tangential.append(seen[0] / true[0] - 1.0)
        sagittal.append(seen[1] / true[1] - 1.0)
        apart.append(true[1] / true[0])
    assert max(apart) > 1.8  # else the test would say nothing
    for errors in (tangential, sagittal):
        assert np.median(np.abs(errors)) < 0.04
        assert np.quantile(np.abs(errors), 0.8) < 0.1


@cache
def blurred_page(sigma: float, lean_deg: float, invert: bool = False) -> np.ndarray:
    scene, _ = squares_chart(Frame(800, 1100), rows=3, cols=4, lean_deg=lean_deg)
    plane = 0.82 - scene[1] if invert else scene[1]
    return ndimage.gaussian_filter(plane, sigma)[MARGIN:-MARGIN, MARGIN:-MARGIN].astype(np.float32)


@pytest.mark.parametrize(("lean", "invert"), [(-7.0, False), (12.0, False), (5.0, True)])
def test_pages_that_lean_otherwise_and_bright_squares_are_whole_too(lean: float, invert: bool) -> None:
    groups = squares_of(find_edges(blurred_page(1.0, lean, invert)))

    assert len(groups) == 12
    assert min(map(len, groups)) >= 3  # the frame cuts a side of some


def test_a_fold_in_the_paper_is_no_edge() -> None:
    page = blurred_page(1.0, 5.0).copy()
    whole = find_edges(page)
    rows, cols = np.indices(page.shape)
    page *= 1.0 - 0.03 * ndimage.gaussian_filter((cols - 0.1 * rows > 1000).astype(np.float32), 1.0)

    assert len(find_edges(page)) == len(whole)


def test_an_edge_between_the_two_directions_is_neither() -> None:
    place = Frame(800, 1100).position(50.0, 1050.0)

    assert direction_of(place.phi, place) == "tangential"
    assert direction_of(place.phi + math.pi, place) == "tangential"
    assert direction_of(place.phi + math.pi / 2 + 0.1, place) == "sagittal"
    assert direction_of(place.phi + math.radians(30.0), place) == "oblique"
    assert direction_of(0.0, replace(place, phi=math.radians(-5.0))) == "tangential"
