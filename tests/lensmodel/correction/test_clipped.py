"""Light beyond saturation: where it is looked for, and what is found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Frame, Kernel, NoiseModel
from lensmodel.correction import correct_planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.richardson_lucy import Lights, compact, regions

REACH = 4
KERNEL = gaussian(2 * REACH + 1, np.eye(2) * 1.2)


def lamps(*places: tuple[int, int], shape: tuple[int, int] = (160, 200), radius: float = 3.0) -> np.ndarray:
    """Light of lamps of 8 times saturation over a dim slope, wider than `shape` by the reach."""
    rows, cols = np.mgrid[: shape[0] + 2 * REACH, : shape[1] + 2 * REACH]
    light = 0.1 + 0.1 * rows / shape[0]
    for row, col in places:
        light[np.hypot(rows - row - REACH, cols - col - REACH) < radius] = 8.0
    return light.astype(np.float32)


@pytest.mark.parametrize(("coarse", "share"), [(2, 0.995), (8, 0.8), (16, 0.5)])
def test_the_light_of_each_clipped_pixel_and_around_it_is_estimated_once(coarse: int, share: float) -> None:
    field = ndimage.gaussian_filter(np.random.default_rng(coarse).standard_normal((170, 210)), coarse)
    clipped = field > np.quantile(field, share)
    count = np.zeros([side + 2 * REACH for side in clipped.shape], dtype=int)

    for window, own in regions(clipped, REACH):
        count[tuple(slice(part.start, part.stop + 2 * REACH) for part in window)] += own

    near = ndimage.maximum_filter(np.pad(clipped, REACH), 2 * REACH + 1)
    np.testing.assert_array_equal(count, near.astype(int))


def test_lamps_far_apart_are_regions_of_their_own_and_cost_less() -> None:
    clipped = np.zeros((400, 400), dtype=bool)
    clipped[20:24, 30:33] = clipped[350:360, 340:350] = True

    found = regions(clipped, REACH)

    assert len(found) == 2
    pixels = sum((w[0].stop - w[0].start) * (w[1].stop - w[1].start) for w, _ in found)
    assert pixels < 0.05 * clipped.size


def test_nothing_is_to_be_found_where_nothing_is_clipped() -> None:
    assert regions(np.zeros((40, 50), dtype=bool), REACH) == []
    assert not compact(np.ones((40, 50), dtype=bool), REACH).any()


def test_lamps_far_apart_shine_as_each_does_alone() -> None:
    blur, sensor = UniformBlur(KERNEL), Sensor(NoiseModel(1e-5, 1e-6), 1.0)
    both = np.minimum(blur.forward(lamps((40, 50), (120, 150))), 1.0)
    one = np.minimum(blur.forward(lamps((40, 50))), 1.0)

    found, alone = (Lights.of(plane[None], [blur], [sensor], 20) for plane in (both, one))

    assert found is not None
    assert alone is not None
    here = (0, slice(0, 80), slice(0, 100))
    np.testing.assert_allclose(found.beyond[here], alone.beyond[here], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.rest[here], alone.rest[here], atol=1e-5)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4)])
def test_lights_behind_next_to_no_blur_do_not_run_away(shift: tuple[float, float]) -> None:
    # eight bits just below clipping, as a JPEG of a white wall has them, and lateral colour
    levels = np.array([0.973, 0.982, 0.991, 1.0], dtype=np.float32)
    tile = levels[np.random.default_rng(0).integers(0, 4, (1, 12, 12))].repeat(8, 1).repeat(8, 2)
    sensor = Sensor(NoiseModel(shot=6e-6, read=2e-7), clip=1.0)

    found = Lights.of(tile, [UniformBlur(np.ones((1, 1)), shift)], [sensor], 20)

    assert found is not None
    assert np.abs(found.rest).max() < 4.0
    assert found.beyond.max() < 4.0


@dataclass(frozen=True)
class Lens:
    """One kernel, and red and blue images that are larger and smaller than the green one."""

    kernel: np.ndarray
    shift: float

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        return as_kernel(np.pad(self.kernel, (size - self.kernel.shape[0]) // 2))

    def displacement(self, r: float, channel: Channel) -> float:
        return {"r": self.shift, "g": 0.0, "b": -self.shift}[channel] * r


def surface(clipped: int) -> np.ndarray:
    """A lacquered surface in the sun, grooved, with a bright label, of which `clipped` colours saturate."""
    rows, cols = np.mgrid[:160, :200].astype(np.float64)
    rng = np.random.default_rng(7)
    grooves = 1.0 + 0.25 * (np.sin(rows / 1.9) > 0.4) + 0.05 * rng.standard_normal(rows.shape)
    label = (abs(cols - 120) < 22) & (abs(rows - 80) < 60) & ~((rows % 16 < 4) & (cols % 12 < 8))
    colour = np.array([1.1, 1.1 if clipped > 1 else 0.4, 1.1 if clipped > 2 else 0.25])
    light = colour[:, None, None] * (0.72 + 0.25 * (cols < 60)) * grooves
    return np.where(label, 1.15 * colour[:, None, None], light).astype(np.float32)


SURFACE = Frame(120, 160)


@cache
def taken(clipped: int, width: float, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Photo of the surface through a `Lens`, and the light that it shows."""
    scene, frame = surface(clipped), SURFACE
    lens = Lens(gaussian(19, np.eye(2) * width**2), shift)
    middle = np.array(frame.center)[:, None, None]
    places = np.indices((frame.height, frame.width)) - middle
    truth, light = scene[:, 20:-20, 20:-20], []
    for plane, channel in zip(scene.astype(np.float64), CHANNELS, strict=True):
        # a round Gaussian is one along the rows after one along the columns
        soft = ndimage.convolve1d(plane, lens.kernel.sum(axis=1), axis=0)
        soft = ndimage.convolve1d(soft, lens.kernel.sum(axis=0), axis=1)
        size = 1.0 + lens.displacement(1.0, channel) / frame.half_diagonal
        light.append(ndimage.map_coordinates(soft, places / size + middle + 20, order=3))
    seen = np.stack(light) + np.random.default_rng(8).standard_normal(truth.shape) * 4e-3
    return np.minimum(seen, 1.0).astype(np.float32), truth


@pytest.mark.parametrize(
    ("method", "clipped"),
    [
        *(("standard", clipped) for clipped in (1, 2, 3)),
        *((method, 2) for method in ("fast", "paper")),
        *(pytest.param(m, c, marks=pytest.mark.slow) for m in ("fast", "paper") for c in (1, 3)),
    ],
)
@pytest.mark.parametrize(
    ("width", "shift"), [(0.05, 1.0001), (0.5, 0.0), (0.5, 1.0001), (1.5, 0.3), (1.5, 3.0), (4.0, 1.0001)]
)
def test_clipped_surfaces_beside_lateral_colour_show_no_dots(
    method: str, clipped: int, width: float, shift: float
) -> None:
    lens, (photo, truth) = Lens(gaussian(19, np.eye(2) * width**2), shift), taken(clipped, width, shift)

    noise, lateral = [NoiseModel(2e-5, 1e-6)] * 3, lens if shift > 0.0 else None
    made = correct_planes(
        photo, lens, SURFACE, noise=noise, method=method, lateral=lateral, clip=(0.995,) * 3
    ).planes

    lost = ndimage.binary_dilation((photo >= 0.995).any(axis=0), iterations=2)
    window = (1, 9, 9)  # a dot is out of range of all that the blur reaches
    low, high = ndimage.minimum_filter(photo, window), ndimage.maximum_filter(photo, window)
    shown, wanted = np.minimum(made, 1.0), np.minimum(truth, 1.0)
    dots = (shown < low - 0.05) | (shown > high + 0.05)
    assert dots[:, lost].mean() < 0.001
    assert np.sqrt(np.mean((shown - wanted) ** 2)) < 1.02 * np.sqrt(np.mean((photo - wanted) ** 2))


def test_clipped_areas_that_demosaicing_has_perforated_are_broad_all_the_same() -> None:
    clipped = np.zeros((60, 60), dtype=bool)
    clipped[10:50, 10:50] = True
    clipped[11:49:2, 11:49:2] = False  # filled in, hardly below saturation

    assert not compact(clipped, reach=8).any()

    clipped[:] = False
    clipped[20:26, 20:26] = True
    clipped[22, 23] = False
    assert compact(clipped, reach=8).sum() == 35
