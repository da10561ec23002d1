"""Steps between even levels, behind kernels that are not sure."""

import numpy as np
import pytest
from scipy import ndimage

from lensmodel.core.types import Planes
from lensmodel.correction.limits.plateaus import plateau_reach, plateau_share, plateaus_held

SPREAD = 4
LOW, HIGH = 0.05, 0.5


def padded(planes: Planes) -> Planes:
    """With what `plateaus_held` must see around."""
    m = plateau_reach(SPREAD)
    return np.pad(planes, ((0, 0), (m, m), (m, m)), mode="edge")


def seen(light: np.ndarray) -> np.ndarray:
    return np.maximum(light, 0.0) ** (1 / 2.2)


def step(height: int = 48, width: int = 64, slope: float = 0.2) -> np.ndarray:
    """Distance from a slanted edge in pixels, dark at the left."""
    rows, cols = np.mgrid[:height, :width]
    return cols - width / 2 + slope * (rows - height / 2) + 0.3


def blurred(plane: np.ndarray, width: float = 1.4) -> np.ndarray:
    return ndimage.gaussian_filter(plane, width, mode="nearest").astype(np.float32)


def sharpened(plane: np.ndarray, amount: float = 1.6, width: float = 1.8) -> np.ndarray:
    """What a kernel that is too wide does to an edge: halos on both sides."""
    return plane + amount * (plane - blurred(plane, width))


def overshoot(made: np.ndarray) -> float:
    """Share of the step, as seen, by which the plateaus are left on the worse side."""
    low, high = seen(np.array([LOW, HIGH]))
    return float(max(seen(made).max() - high, low - seen(made).min()) / (high - low))


def test_halo_of_a_clean_step_is_held_to_a_small_share_of_it() -> None:
    photo = blurred(np.where(step() > 0, HIGH, LOW))[None]
    made = sharpened(photo[0])[None]

    held = plateaus_held(padded(photo), made, [0.3], SPREAD)

    assert overshoot(made) > 0.3
    assert overshoot(held) == pytest.approx(0.06, abs=0.02)


def test_edge_itself_gets_as_steep_as_it_was_made() -> None:
    photo = blurred(np.where(step() > 0, HIGH, LOW))[None]
    made = sharpened(photo[0])[None]

    held = plateaus_held(padded(photo), made, [0.3], SPREAD)

    between = (made > LOW) & (made < HIGH)
    np.testing.assert_array_equal(held[between], made[between])


@pytest.mark.parametrize("width", [1.0, 2.0])
def test_line_that_blur_made_faint_comes_back_whole(width: float) -> None:
    line = np.abs(step()) < width / 2
    sharp = np.where(line, LOW, HIGH)[None].astype(np.float32)

    held = plateaus_held(padded(blurred(sharp[0])[None]), sharp, [0.3], SPREAD)

    np.testing.assert_array_equal(held, sharp)


def test_texture_is_not_touched() -> None:
    rng = np.random.default_rng(0)
    sharp = blurred(0.3 + 0.25 * rng.standard_normal((48, 64)), 0.7)
    photo = blurred(sharp)

    held = plateaus_held(padded(photo[None]), sharp[None], [0.3], SPREAD)

    assert np.mean(held[0] != sharp) < 0.02


def test_grain_beside_a_step_stays() -> None:
    rng = np.random.default_rng(1)
    noise = 0.004 * rng.standard_normal((48, 64)).astype(np.float32)
    photo = blurred(np.where(step() > 0, HIGH, LOW)) + noise
    level = np.abs(step()) > 8

    held = plateaus_held(padded(photo[None]), photo[None], [0.3], SPREAD)

    assert held[0][level].std() > 0.98 * photo[level].std()


def test_kernel_that_is_known_is_not_bound_and_a_surer_one_less() -> None:
    photo = blurred(np.where(step() > 0, HIGH, LOW))[None]
    made = sharpened(photo[0])[None]

    assert plateaus_held(padded(photo), made, [0.0], SPREAD) is made
    shares = [plateau_share(error) for error in (0.0, 0.02, 0.05, 0.1, 0.5)]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] == shares[-2]


def test_what_was_made_is_not_changed_in_place() -> None:
    photo = blurred(np.where(step() > 0, HIGH, LOW))[None]
    made = sharpened(photo[0])[None]
    copy = made.copy()

    plateaus_held(padded(photo), made, [0.3], SPREAD)

    np.testing.assert_array_equal(made, copy)
