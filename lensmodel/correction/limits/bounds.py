"""Bounds on what a correction may do: halos beside edges, grain in flat areas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Planes
from lensmodel.correction.engine import compiled
from lensmodel.correction.limits.plateaus import plateau_reach, plateaus_held

WINDOW: Final = 2
"""Pixels around each one in which the photo is looked at."""
_SIDE: Final = 2 * WINDOW + 1
_FREE: Final = 0.16
"""Error of a kernel from which on a result may not leave the photo's range by more than it: the least that
costs no gain behind a lens that is known to a quarter (chosen)."""
_WIDEST: Final = 4.0  # share of the range beyond which a bound would cut nothing but noise
_DARKEST, _DARKER = 0.5, 0.2  # of the darkest light nearby where no room is left, and per room


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a photographer lets a correction do.

    Parameters
    ----------
    halo : float or None
        By how much of the photo's range within 2 pixels the result may leave it: 0 not at all, infinity
        without bound. None takes it from the expected error of the kernels, and holds clean steps between
        their plateaus besides.
    texture : float
        0 to 1: how much of what the correction leaves unexplained the photo keeps, its faint texture and
        its grain.
    denoise : float
        0 to 1: how much of that is taken away where it looks like noise alone.
    """

    halo: float | None = None
    texture: float = 1.0
    denoise: float = 0.0

    def __post_init__(self) -> None:
        if not (self.halo is None or self.halo >= 0.0):
            raise InvalidInputError(f"halo must not be negative, got {self.halo}")
        if not (0.0 <= self.texture <= 1.0 and 0.0 <= self.denoise <= 1.0):
            raise InvalidInputError(f"texture and denoise must lie in 0..1, got {self}")

    @property
    def described(self) -> str:
        """What was asked for, for the tag of a corrected photo; nothing where nothing was."""
        halo = "" if self.halo is None else f", halo {self.halo:g}"
        texture = f", texture {self.texture:g}" if self.texture < 1.0 else ""
        return halo + texture + (f", denoised {self.denoise:g}" if self.denoise > 0.0 else "")

    def hold(
        self,
        planes: Planes,
        at: tuple[int, int],
        restored: Planes,
        errors: Sequence[float],
        spread: int,
    ) -> Planes:
        """Hold what was made of the part of a photo that begins at `at` within these bounds.

        `spread` says how far the blur there spreads light, in pixels.
        """
        if self.halo is None and max(errors) > 0.0:
            photo = photo_around(planes, at, restored, plateau_reach(spread))
            restored = plateaus_held(photo, restored, errors, spread)
        shares = [allowance(error) if self.halo is None else self.halo for error in errors]
        if not np.isfinite(shares).any():
            return restored
        return limited(photo_around(planes, at, restored, WINDOW), restored, shares, compiled("auto"))


def photo_around(planes: Planes, at: tuple[int, int], part: Planes, margin: int) -> Planes:
    """Cut what lies around a part of a photo that begins at `at`; at the border its last pixels again."""
    rows, cols = (
        np.clip(np.arange(first - margin, first + extent + margin), 0, end - 1)
        for first, extent, end in zip(at, part.shape[1:], planes.shape[1:], strict=True)
    )
    photo = np.asarray(planes[:, rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1], dtype=np.float32)
    return photo[:, (rows - rows[0])[:, None], (cols - cols[0])[None, :]]


def allowance(error: float) -> float:
    """By how much of the photo's local range a result may leave it, for a kernel with a relative error.

    Beside an edge the picture is all kernel: what a wrong one makes there leaves the range of light
    that the photo shows around, in one colour more than in the others. A right one does so as well, on
    details narrower than itself, so the bound is wide where the kernel is sure: ( 0.16 / error )².
    """
    share = (_FREE / error) ** 2 if error > 0.0 else np.inf
    return float(share) if share <= _WIDEST else float("inf")


def limited(
    photo: Planes, restored: Planes, allowances: Sequence[float], loops: ModuleType | None = None
) -> Planes:
    """Hold `restored` within the photo's range in windows of 5 pixels, widened by a share of it.

    The less room, the less it may also fall below a share of the darkest light there.

    Parameters
    ----------
    photo : Planes, shape (channels, rows + 4, cols + 4)
        With the pixels around.
    restored : Planes, shape (channels, rows, cols)
        What was made of its middle.
    allowances : sequence of float
        Share of the range by colour; infinite for no bound.
    loops : module or None
        Compiled loops; None for SciPy, with the same numbers.
    """
    made = np.ascontiguousarray(restored).copy()
    for c, share in enumerate(allowances):
        if np.isfinite(share):
            if loops is None:
                low = _middle(ndimage.minimum_filter(photo[c], _SIDE))
                high = _middle(ndimage.maximum_filter(photo[c], _SIDE))
                room = np.float32(share) * (high - low)
                np.clip(made[c], np.maximum(low - room, _dark(share) * low), high + room, out=made[c])
            else:
                loops.hold(photo[c], np.float32(share), _dark(share), made[c])
    return made


def _middle(wide: NDArray[np.floating]) -> NDArray[np.floating]:
    """Cut off the pixels around."""
    return wide[..., WINDOW:-WINDOW, WINDOW:-WINDOW]


def _dark(share: float) -> np.float32:
    """Share of the darkest light nearby below which nothing falls: black lines are seen before all else."""
    return np.float32(max(_DARKEST - _DARKER * share, 0.0))
