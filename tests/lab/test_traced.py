"""Grids of traced lenses: what stands at a node comes back, and cameras photograph through them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from lab.kernels import distance, gaussian
from lab.scenes import dead_leaves
from lab.traced import GridField, GridLens, read_grid
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import centroid
from lensmodel.core.types import CHANNELS, FieldPosition, Frame, LensSettings
from lensmodel.photo import develop
from lensmodel.simulate import SimulatedCamera, blurred, photograph, write_photo

DATA = Path(__file__).parents[1] / "lensmodel" / "data"
GRIDS = sorted(DATA.glob("traced-*.npz"))


def linear_field(f_number: float = 2.8) -> GridField:
    """Gaussians that widen to the right, with lateral colour of red."""
    axis = np.linspace(-1.5, 1.5, 7)
    kernels = np.zeros((3, 7, 7, 15, 15), dtype=np.float16)
    centers = np.zeros((3, 7, 7, 2), dtype=np.float32)
    for i, up in enumerate(axis):
        for j, right in enumerate(axis):
            kernels[:, i, j] = gaussian(15, [[1.0 + 0.2 * up, 0.0], [0.0, 2.0 + 0.5 * right]])
            centers[0, i, j] = 0.8 * right, 0.8 * up
    facts = {"design": "gaussian", "f_number": f_number, "focal_mm": 50.0, "pitch_um": 4.5}
    return GridField(axis, kernels, centers, {**facts, "half_diagonal_mm": 0.45})


@pytest.mark.parametrize("path", GRIDS, ids=lambda path: path.stem)
def test_stored_grids_hold_kernels_that_differ_between_corners_and_channels(path: Path) -> None:
    grid = read_grid(path)
    rng = np.random.default_rng(3)
    for channel in 20 * CHANNELS:
        place = FieldPosition(math.sqrt(rng.random()), float(rng.uniform(-math.pi, math.pi)))
        kernel = grid.kernel_at(place, channel, grid.size)
        assert kernel.sum() == pytest.approx(1.0)
        assert kernel.min() >= 0.0
        assert np.hypot(*centroid(kernel)) < 0.05
    right, left = (grid.kernel_at(FieldPosition(1.0, a), "g", grid.size) for a in (0.6, math.pi - 0.6))
    center = {c: grid.kernel_at(FieldPosition(0.0, 0.0), c, grid.size) for c in CHANNELS}
    assert distance(np.fliplr(left), right).rel_l2 > 0.05
    assert distance(right, center["g"]).rel_l2 > 0.15
    assert distance(center["r"], center["b"]).rel_l2 > 0.05
    assert path.stat().st_size < 300 * 1024


def test_node_comes_back_as_it_was_stored_and_up_is_up() -> None:
    field = linear_field()
    kernel = field.kernel_at_field((0.5, -1.0), "g", 15)
    stored = field.kernels[1, 1, 4].astype(np.float64)

    np.testing.assert_allclose(kernel, stored / stored.sum(), atol=1e-6)


def test_grid_between_nodes_is_near_the_truth() -> None:
    wanted = gaussian(15, [[1.0 + 0.2 * 0.3, 0.0], [0.0, 2.0 - 0.5 * 0.7]])
    kernel = linear_field().kernel_at_field((-0.7, 0.3), "b", 15)

    assert distance(kernel, wanted).rel_l2 < 0.01


def test_grid_survives_its_file_and_files_of_another_form_are_refused(tmp_path: Path) -> None:
    field = linear_field()
    field.write(tmp_path / "a.npz")
    again = read_grid(tmp_path / "a.npz")

    np.testing.assert_array_equal(again.kernels, field.kernels)
    assert again.facts == field.facts

    np.savez(tmp_path / "a.npz", format=np.array(99))
    with pytest.raises(InvalidInputError, match="format 99"):
        read_grid(tmp_path / "a.npz")


def points_at(*places: tuple[int, int]) -> np.ndarray:
    """A frame of points of light behind the lens."""
    scene = np.zeros((3, 134, 174), dtype=np.float32)
    for row, col in places:
        scene[:, 7 + row, 7 + col] = 1.0
    return blurred(scene, GridLens(linear_field()), LensSettings(), Frame(120, 160), size=15, step=0.25)


def test_point_light_becomes_the_kernel_of_its_place_and_red_lies_further_out() -> None:
    image, frame = points_at((30, 120), (60, 140)), Frame(120, 160)
    expected = linear_field().kernel_at(frame.position(30, 120), "g", 15)
    red, green = (centroid(image[c, 53:68, 133:148].astype(np.float64)) for c in (0, 1))

    np.testing.assert_allclose(image[1, 23:38, 113:128], expected, atol=2e-3)
    assert red[1] - green[1] == pytest.approx(0.8 * frame.position(60, 140).r, abs=0.02)
    assert red[0] - green[0] == pytest.approx(0.0, abs=0.02)


def test_camera_writes_raw_photos_through_a_traced_lens(tmp_path: Path) -> None:
    grid, camera = read_grid(GRIDS[0]), SimulatedCamera(height=160, width=240)
    scene, rng = dead_leaves(160, 240, np.random.default_rng(1)), np.random.default_rng(2)
    settings = LensSettings(aperture=grid.f_number)
    photo = photograph(scene, GridLens(grid), settings, camera, rng, size=25, step=0.5)
    write_photo(tmp_path / "a.dng", photo)

    assert develop(tmp_path / "a.dng").planes.shape == (3, 160, 240)
    assert photo.clean.std() < photo.sharp.std()


def test_lens_answers_only_for_what_it_was_traced_for() -> None:
    lens = GridLens(linear_field(2.8))

    assert lens.f_number(LensSettings()) == lens.field(LensSettings(aperture=2.82)).f_number == 2.8
    with pytest.raises(InvalidInputError, match=r"f/2\.8, got f/4"):
        lens.f_number(LensSettings(aperture=4.0))
    with pytest.raises(InvalidInputError, match="pitch"):
        lens.kernel_at_field((0.0, 0.0), LensSettings(), 15, pitch_um=6.0)
