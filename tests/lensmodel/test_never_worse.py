"""The whole chain, blind: a photo of a lens known from one other photo comes back better, and nowhere worse.

Two lenses of two kinds of optics: one of third-order theory that is nearly perfect, where kernels are easily
too wide, and one traced through a published design.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.images import Gains, gains, to_srgb
from lab.traced import GridLens, read_grid
from lensmodel import api, correction, photo, simulate
from lensmodel.blind import sampling
from lensmodel.core.types import LensSettings, Planes
from lensmodel.model import LensModel

pytestmark = pytest.mark.slow

CAMERA = simulate.SimulatedCamera(height=640, width=960, full_well_electrons=20_000.0)
GRID = Path(__file__).parent / "data" / "traced-heliar-f3.5.npz"
NEARLY_PERFECT = 6
CROP_LENS = simulate.draw_lens(1001)
MARGIN = 64
LEAST_SHARE = 0.3
"""Of what the true PSF gains, which is the most that a correction can; the forecast tells how sure it is."""


def lens_of(name: str) -> tuple[simulate.SimulatedLens | GridLens, float]:
    """A lens and its f-number wide open."""
    if name == "traced":
        grid = read_grid(GRID)
        return GridLens(grid), grid.f_number
    drawn = simulate.draw_lens(NEARLY_PERFECT)
    return drawn, drawn.at_focal().f_number


def shot(lens: simulate.SimulatedLens | GridLens, f_number: float, scene: str) -> simulate.SimulatedPhoto:
    """A photo of the middle of one of the demonstration's scenes."""
    planes = simulate.demo_scene(scene)
    rows, cols = CAMERA.height + MARGIN, CAMERA.width + MARGIN
    top, left = (planes.shape[1] - rows) // 2, (planes.shape[2] - cols) // 2
    part = np.ascontiguousarray(planes[:, top : top + rows, left : left + cols])
    rng = np.random.default_rng([7, len(scene)])
    return simulate.photograph(part, lens, LensSettings(aperture=f_number), CAMERA, rng)


def shown(planes: Planes) -> NDArray[np.float64]:
    balance = np.asarray(CAMERA.white_balance, dtype=np.float32)[:, None, None]
    return np.moveaxis(to_srgb(planes * balance), 0, -1)


def assert_better_and_nowhere_worse(made: Gains, possible: Gains) -> None:
    for zone, most in possible.zones.items():
        assert made.zones[zone] > max(LEAST_SHARE * most, 0.05), zone
    assert made.worst_db > -0.25


@pytest.mark.parametrize("name", ["nearly perfect", "traced"])
def test_photo_of_a_lens_known_from_one_other_photo_is_better_and_nowhere_worse(
    name: str, tmp_path: Path
) -> None:
    lens, f_number = lens_of(name)
    settings = LensSettings(aperture=f_number)
    known, asked = shot(lens, f_number, "city"), shot(lens, f_number, "colosseum")
    simulate.write_photo(tmp_path / "known.dng", known)
    simulate.write_photo(tmp_path / "asked.dng", asked)
    model = LensModel.fit(sampling.samples_of_photo(tmp_path / "known.dng", workers=1))
    developed = photo.develop(tmp_path / "asked.dng")
    lateral = api.lateral_of(developed)

    made = api.correct_photo(developed, model, settings, lateral=lateral).planes

    with_the_truth = correction.correct_planes(
        developed.planes,
        lens.field(settings),
        developed.frame,
        noise=developed.correction_noise,
        clip=developed.clip,
        lateral=lateral,
        cfa=developed.cfa,
    ).planes
    before, truth = shown(developed.planes), shown(asked.sharp)
    found, possible, nothing = (
        gains(before, shown(planes), truth) for planes in (made, with_the_truth, developed.planes)
    )
    assert found is not None
    assert possible is not None
    assert nothing is not None
    assert min(possible.zones.values()) > 0.3  # there is something to gain
    assert_better_and_nowhere_worse(found, possible)
    with pytest.raises(AssertionError):  # a correction that does nothing
        assert_better_and_nowhere_worse(nothing, possible)


@pytest.fixture(scope="module")
def cropped(tmp_path_factory: pytest.TempPathFactory) -> tuple[LensModel, Path, Planes]:
    """A lens known from a whole frame, a photo of the middle of another one, and the truth of that."""
    folder = tmp_path_factory.mktemp("cropped")
    known, asked = (shot(CROP_LENS, CROP_LENS.at_focal().f_number, scene) for scene in ("city", "colosseum"))
    middle = slice(106, 534), slice(160, 800)  # the smaller of two usual sensors, as crop mode cuts it
    simulate.write_photo(folder / "known.dng", known)
    part = replace(asked, mosaic=np.ascontiguousarray(asked.mosaic[middle]))
    simulate.write_photo(folder / "asked.dng", part)
    model = LensModel.fit(sampling.samples_of_photo(folder / "known.dng", workers=1))
    return model, folder / "asked.dng", np.ascontiguousarray(asked.sharp[:, *middle])


@pytest.mark.parametrize(("method", "least_db"), [("standard", 2.2), ("fast", 0.6)])
def test_a_frame_in_crop_mode_gains_in_every_zone_by_the_kernels_of_its_place(
    method: str, least_db: float, cropped: tuple[LensModel, Path, Planes]
) -> None:
    """As if the picture's corners were the lens's, it gains 2.04 and 0.52 dB, and a block loses 0.47."""
    model, path, truth = cropped
    developed = photo.develop(path)

    settings, lateral = LensSettings(aperture=CROP_LENS.at_focal().f_number), api.lateral_of(developed)
    made = api.correct_photo(developed, model, settings, method=method, lateral=lateral).planes

    found = gains(*map(shown, (developed.planes, made, truth)))
    assert found is not None
    assert min(found.zones.values()) > least_db
    assert found.worst_db > -0.25
