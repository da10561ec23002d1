r"""How much light a lens throws far from the core of its blur, from what its photos' shadows allow.

Each photo bounds the share h of such light by its darkest places (`lensmodel.estimation.darkest`). What a
photo shows beyond that, s, is the scene's own light there,

    U = h + (1 - h) s,        ln s ~ N(ln m, d^2), or s ~ U(0, 1) where there are no shadows.

Photos are independent, a lens has little far light or some, both exponential, and the answer is the posterior
mean of h. One photo of haze says little, of two or five the one with the deepest shadows decides. Over the
field a bound holds for its place and weakens with the distance in r, since far light changes with it: it is
as round as the lens. Green speaks for all colours: in red and blue what demosaicing gets wrong is darker than
shadows are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.files import fitted
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import variables as va
from lensmodel.model.field.kriging import settings_gap

_FITTED: Final = fitted("model")["far_light"]
SHADOW, SCATTER = float(_FITTED["shadow"]), float(_FITTED["scatter"])
"""m and d: median of what scenes show in their shadows, and its scatter (ln); see `data/README.md`."""
SHADOWLESS: Final = float(_FITTED["shadowless"])
"""How often a photo shows no shadow at a place."""
LITTLE, SOME, OFTEN = float(_FITTED["little"]), float(_FITTED["some"]), float(_FITTED["often"])
"""Mean share of far light of lenses with little of it and of those with some, and how often these are."""

_WEAKENS: Final = 0.2  # by which a bound weakens over half a diagonal (chosen: a half of how designs change)
_ALIKE: Final = 1.0
"""Bandwidths of settings within which photos speak of each other: a half more or less changes which aperture
beside a given one counts (chosen)."""
_AT_ONCE: Final = 2048  # bounds that are weighed at once (chosen: some megabytes)
_LEAST: Final = 0.004  # bound of a photo (chosen: below, black level decides)
_SHARES: Final = np.arange(0.0025, 0.7, 0.005)
"""Shares that are weighed, middles of intervals (chosen: no design throws more than seven tenths so far)."""
_FAR_FROM_ALL: Final = 1e-30  # keeps logarithms finite, far below any likelihood that counts


@dataclass(frozen=True, slots=True, eq=False)
class FarLight:
    """Bounds that photos set.

    Parameters
    ----------
    points : ndarray, shape (n, 7)
        Places and settings, see `variables`.
    bounds : ndarray, shape (n,)
        U at each.
    photos : ndarray of int, shape (n,)
        Which photo each is of.
    scale : ndarray, shape (7,)
        Bandwidths.
    """

    points: NDArray[np.float64]
    bounds: NDArray[np.float64]
    photos: NDArray[np.intp]
    scale: NDArray[np.float64]

    def shares(self, positions: Sequence[FieldPosition], settings: LensSettings) -> NDArray[np.float64]:
        """Expected share at some places, shape (q,); 0 where no photo of such settings speaks."""
        nothing = np.zeros(len(positions))
        if not len(self.bounds):
            return nothing
        asked = va.point(FieldPosition(0.0, 0.0), settings.with_channel("g"))
        alike = settings_gap(self.points, asked, self.scale) < _ALIKE**2
        if not alike.any():
            return nothing
        r = np.array([position.r for position in positions])
        own = [alike & (self.photos == photo) for photo in np.unique(self.photos[alike])]
        least = np.stack(
            [
                (self.bounds[mine] + _WEAKENS * np.abs(r[:, None] - self.points[mine, 0])).min(axis=1)
                for mine in own
            ],
            axis=1,
        )
        parts = np.array_split(least, max(least.size // _AT_ONCE, 1))
        return np.concatenate([expected_share(part) for part in parts])


def expected_share(bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Posterior mean of the share behind the bounds of photos, shape (q, photos) to (q,)."""
    h = _SHARES
    prior = (1.0 - OFTEN) * np.exp(-h / LITTLE) / LITTLE + OFTEN * np.exp(-h / SOME) / SOME
    shadow = (np.maximum(bounds, _LEAST)[..., None] - h) / (1.0 - h)
    log_s = np.log(np.maximum(shadow, _FAR_FROM_ALL))
    deep = np.exp(-0.5 * ((log_s - np.log(SHADOW)) / SCATTER) ** 2 - log_s) / (SCATTER * np.sqrt(2.0 * np.pi))
    even = (shadow > 0.0) & (shadow < 1.0)
    likely = np.where(shadow > 0.0, (1.0 - SHADOWLESS) * deep + SHADOWLESS * even, 0.0)
    total = np.log(prior) + np.log(np.maximum(likely, _FAR_FROM_ALL)).sum(axis=-2)
    weight = np.exp(total - total.max(axis=-1, keepdims=True))
    return np.asarray((weight @ h) / weight.sum(axis=-1))


def bounds_of(samples: Sequence[PsfSample]) -> NDArray[np.float64]:
    """Bounds that samples carry, shape (n,); NaN where one carries none."""
    return np.array([np.nan if s.darkest is None else s.darkest for s in samples], dtype=np.float64)
