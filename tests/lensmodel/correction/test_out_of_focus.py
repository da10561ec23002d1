"""A scene out of focus holds nothing that a correction could bring back: it must not lose."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel.core.types import BayerPattern, Channel, FieldPosition, Frame, LensSettings, NoiseModel
from lensmodel.correction import PsfPosterior, correct_planes
from lensmodel.correction.expected_gain import noise_power, ring_power
from lensmodel.photo import develop
from lensmodel.simulate import SimulatedCamera, draw_lens, photograph, write_photo

BAYER: Final = ((0, 1), (1, 2))


@dataclass(frozen=True)
class Gaussian:
    """One kernel all over, thought to be of this width; the true one has a s.d. of 1.5 pixels."""

    sigma: float
    error: float

    def posterior_at(self, position: FieldPosition, channel: Channel) -> PsfPosterior:
        return PsfPosterior.of_error(gaussian(25, self.sigma**2 * np.eye(2)), self.error)


@pytest.mark.parametrize("cfa", [None, BAYER])
@pytest.mark.parametrize("kernels", [Gaussian(2.3, 0.4), Gaussian(1.7, 0.1)])
def test_a_scene_out_of_focus_does_not_lose_by_a_kernel_that_is_too_wide(
    kernels: Gaussian, cfa: BayerPattern | None
) -> None:
    rng = np.random.default_rng(5)
    blocks = rng.uniform(0.1, 0.7, (3, 26, 26)).repeat(14, axis=1).repeat(14, axis=2)
    scene = ndimage.gaussian_filter(blocks, (0, 4.0, 4.0))
    seen = ndimage.gaussian_filter(scene, (0, 1.5, 1.5)) + 0.004 * rng.standard_normal(scene.shape)
    photo = seen.astype(np.float32)
    frame = Frame(*photo.shape[1:])

    made = correct_planes(photo, kernels, frame, noise=[NoiseModel(0.0, 0.004**2)] * 3, cfa=cfa)

    inner = np.s_[:, 20:-20, 20:-20]
    before, after = (np.square(planes - scene)[inner].mean() for planes in (photo, made.planes))
    assert after <= 1.01 * before
    seen_fine, made_fine = (
        (planes - ndimage.uniform_filter(planes, (0, 3, 3)))[inner].std() for planes in (photo, made.planes)
    )
    left = all(report.left == report.cells for report in made.zones.values())
    assert left == (kernels.error == 0.4)
    if left:
        np.testing.assert_allclose(made.planes, photo, rtol=1e-6)  # cells fade into each other
    # what the solution amplifies is not added back as well
    assert made_fine < (1.001 if left else 1.14 if cfa is None else 0.93) * seen_fine


def test_noise_of_a_developed_mosaic_is_spread_as_it_is_reckoned_with(tmp_path: Path) -> None:
    camera, lens = SimulatedCamera(height=960, width=960, full_well_electrons=20_000.0), draw_lens(3)
    even = np.full((3, 1040, 1040), 0.1, dtype=np.float32)
    settings = LensSettings(aperture=lens.at_focal().f_number)
    rng = np.random.default_rng(2)
    # no blur shows on an even scene
    write_photo(tmp_path / "even.dng", photograph(even, lens, settings, camera, rng, size=9, step=0.5))
    planes = develop(tmp_path / "even.dng").planes

    parts = [planes[:, i : i + 200, j : j + 200] for i in range(64, 700, 200) for j in range(64, 700, 200)]
    for channel, rings in enumerate(np.mean([ring_power(part).mean(axis=1) for part in parts], axis=0)):
        variance = np.mean([part[channel].var() for part in parts])
        np.testing.assert_allclose(rings, noise_power(float(variance), channel, mosaic=True), rtol=0.1)


def test_an_edge_in_focus_before_what_is_not_is_sharpened() -> None:
    rng, sigma = np.random.default_rng(7), 0.004
    blobs = ndimage.gaussian_filter(rng.standard_normal((3, 300, 300)), (0, 7.0, 7.0))
    scene = 0.2 + 0.06 * blobs / blobs.std()
    scene[:, 150:] += 0.2
    seen = ndimage.gaussian_filter(scene, (0, 1.5, 1.5)) + sigma * rng.standard_normal(scene.shape)

    exact, noise = Gaussian(1.5, 0.0), [NoiseModel(0.0, sigma**2)] * 3
    made = correct_planes(seen.astype(np.float32), exact, Frame(300, 300), noise=noise, cfa=BAYER)

    beside = np.s_[:, 144:156, 30:-30]
    before, after = (np.square(planes - scene)[beside].mean() for planes in (seen, made.planes))
    assert after < 0.25 * before
