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
"""Radius in pixels of the window of the photo that bounds a pixel (chosen: within one pixel only the blur of
a thin line is seen and not its surroundings; further away lies another object)."""
_SIDE: Final = 2 * WINDOW + 1
_FREE: Final = 0.16
"""Error of a kernel at which a result may leave the photo's range by the width of that range: the least that
costs no gain behind a lens that is known to a quarter (chosen)."""
_WIDEST: Final = 4.0  # share of the range beyond which a bound would cut nothing but noise (chosen)
# Least share of the darkest light nearby at no room beyond the range, and its decrease per room (chosen: a
# half is one stop, by which detail finer than the blur may be darker than it looks; the more room, the less)
_DARKEST, _DARKER = 0.5, 0.2


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a photographer lets a correction do: rules of this project.

    Parameters
    ----------
    halo : float or None
        How far the result may leave the photo's range within 2 pixels, as a share of it: 0 not at all,
        infinity without bound. None derives it from the expected error of the kernels, and also holds clean
        steps between their plateaus.
    texture : float
        0 to 1: how much of what the correction leaves unexplained is added back: faint texture and grain.
    denoise : float
        0 to 1: how much of that is removed where it looks like noise alone.

    Raises
    ------
    InvalidInputError
        If `halo` is negative, or another value lies outside 0..1.
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
        """The settings, for the tag of a corrected photo; empty for the defaults."""
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
        """Hold the correction of a part of a photo within these bounds.

        Parameters
        ----------
        planes : Planes, shape (3, H, W), float32
            The whole photo.
        at : tuple of int
            Row and column at which the part begins.
        restored : Planes, shape (3, h, w), float32
            The part as it was corrected.
        errors : sequence of float
            Expected relative L2 error of the kernel of each channel.
        spread : int
            How far the blur there spreads light, in pixels.

        Returns
        -------
        Planes, shape (3, h, w), float32
            `restored` itself where nothing bounds it.
        """
        if self.halo is None and max(errors) > 0.0:
            photo = photo_around(planes, at, restored, plateau_reach(spread))
            restored = plateaus_held(photo, restored, errors, spread)
        shares = [allowance(error) if self.halo is None else self.halo for error in errors]
        if not np.isfinite(shares).any():
            return restored
        return limited(photo_around(planes, at, restored, WINDOW), restored, shares, compiled("auto"))


def photo_around(planes: Planes, at: tuple[int, int], part: Planes, margin: int) -> Planes:
    """Cut the part at `at` out of a photo, with a margin; beyond the border the last pixels repeat."""
    rows, cols = (
        np.clip(np.arange(first - margin, first + extent + margin), 0, end - 1)
        for first, extent, end in zip(at, part.shape[1:], planes.shape[1:], strict=True)
    )
    photo = np.asarray(planes[:, rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1], dtype=np.float32)
    return photo[:, (rows - rows[0])[:, None], (cols - cols[0])[None, :]]


def allowance(error: float) -> float:
    """By how much of the photo's local range a result may leave it, for a kernel with a relative error.

    Beside an edge the picture is all kernel: with a wrong one it leaves the range of light that the photo
    shows nearby, in one colour more than in the others. With a right one it does so too, on details
    narrower than the kernel, so the bound is wide where the kernel is certain: ( 0.16 / error )².
    """
    share = (_FREE / error) ** 2 if error > 0.0 else np.inf
    return float(share) if share <= _WIDEST else float("inf")


def limited(
    photo: Planes, restored: Planes, allowances: Sequence[float], loops: ModuleType | None = None
) -> Planes:
    """Hold `restored` within the photo's range in windows of 5 pixels, widened by a share of it.

    The less room there is, the larger the share of the darkest light nearby below which nothing may fall.

    Parameters
    ----------
    photo : Planes, shape (channels, rows + 4, cols + 4)
        With 2 pixels around.
    restored : Planes, shape (channels, rows, cols)
        The correction of its middle.
    allowances : sequence of float
        Share of the range by colour; infinite for no bound.
    loops : module or None
        Compiled loops; None for SciPy, with the same numbers.
    """
    held = np.ascontiguousarray(restored).copy()
    for c, share in enumerate(allowances):
        if np.isfinite(share):
            if loops is None:
                low = _middle(ndimage.minimum_filter(photo[c], _SIDE))
                high = _middle(ndimage.maximum_filter(photo[c], _SIDE))
                room = np.float32(share) * (high - low)
                np.clip(held[c], np.maximum(low - room, _dark(share) * low), high + room, out=held[c])
            else:
                loops.hold(photo[c], np.float32(share), _dark(share), held[c])
    return held


def _middle(wide: NDArray[np.floating]) -> NDArray[np.floating]:
    """Cut off the margin."""
    return wide[..., WINDOW:-WINDOW, WINDOW:-WINDOW]


def _dark(share: float) -> np.float32:
    """Share of the darkest light nearby below which nothing falls: black lines are seen before all else."""
    return np.float32(max(_DARKEST - _DARKER * share, 0.0))
