"""How much a report would change with other photos: drawn again from those that there are.

Photos are drawn with replacement, as many as there are, and the model is fitted anew to the samples of each
draw; the standard deviation over the draws is the standard error (B. Efron and R. Tibshirani, "An
Introduction to the Bootstrap", 1993, ch. 6). What all photos have in common, such as a bias of the estimate,
does not show.
"""

from __future__ import annotations

import contextlib
import math
from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition
from lensmodel.model import LensModel
from lensmodel.quality import mtf_from_kernel, tangential_sagittal_mtf50
from lensmodel.report.lens_report import LensReport
from lensmodel.report.places import ring
from lensmodel.report.units import NYQUIST

DRAWS: Final = 16
"""A standard deviation over so few is known to a fifth (chosen for time)."""

FEWEST_PHOTOS: Final = 3
"""With fewer, patches are drawn instead of photos, which share their photo's focus: too small an error
(chosen: two photos have but three different draws)."""

_RING: Final = 2  # places of a ring, whose mean is its value (chosen: fewer than in the report, for time)

Drawn = Literal["photos", "patches"]


@dataclass(frozen=True, slots=True)
class CurveSpread:
    """Standard errors of a curve, one for each radius of the report."""

    tangential: tuple[float, ...]
    sagittal: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard errors of a report's MTF50 map and curves.

    Parameters
    ----------
    drawn : {"photos", "patches"}
        What was drawn again.
    draws : int
    tangential, sagittal : tuple of float
        Of MTF50 in cycles/pixel, one for each place of the map.
    curves : tuple of CurveSpread
        Of contrast, one for each curve.
    """

    drawn: Drawn
    draws: int
    tangential: tuple[float, ...]
    sagittal: tuple[float, ...]
    curves: tuple[CurveSpread, ...]


def spreads_of(
    model: LensModel, reports: Sequence[LensReport], size: int, rng: np.random.Generator, draws: int = DRAWS
) -> list[Spread | None]:
    """Tell how far reports are known, all from the same draws.

    Parameters
    ----------
    model : LensModel
        That the reports are of.
    reports : sequence of LensReport
        Of one channel.
    size : int
        Odd side of the kernels.
    rng : Generator
    draws : int

    Returns
    -------
    list of Spread or None
        None where there is nothing to draw from, or hardly a draw could be fitted.
    """
    channel = reports[0].settings.channel
    excluded = model.settings.excluded
    samples = [s for s in model.samples if s.photo not in excluded and s.settings.channel == channel]
    by_report: dict[int, Spread | None] = {}
    kinds: tuple[Drawn, ...] = ("photos", "patches")
    for drawn in kinds:
        those = [i for i, report in enumerate(reports) if _drawn(samples, report) == drawn]
        if those:
            spreads = _spreads(model, [reports[i] for i in those], samples, drawn, size, rng, draws)
            by_report |= dict(zip(those, spreads, strict=True))
    return [by_report[i] for i in range(len(reports))]


def _drawn(samples: Sequence[PsfSample], report: LensReport) -> Drawn:
    """Photos where enough of them were taken at the aperture of a report: others say little of it."""
    at = report.settings.aperture
    photos = {s.photo for s in samples if at is None or s.settings.aperture == at}
    return "photos" if len(photos) >= FEWEST_PHOTOS else "patches"


def _spreads(
    model: LensModel,
    reports: Sequence[LensReport],
    samples: Sequence[PsfSample],
    drawn: Drawn,
    size: int,
    rng: np.random.Generator,
    draws: int,
) -> list[Spread | None]:
    groups = _groups(samples, drawn)
    if len(groups) < FEWEST_PHOTOS:
        return [None] * len(reports)
    drawn_maps: list[list[_Draw]] = [[] for _ in reports]
    for _ in range(draws):
        chosen = rng.integers(0, len(groups), len(groups))
        try:
            replica = LensModel.fit([s for k in chosen for s in groups[k]], model.settings)
        except LensModelError:
            continue
        for own, report in zip(drawn_maps, reports, strict=True):
            with contextlib.suppress(LensModelError):  # a draw may lack the very samples that are asked for
                own.append(_ask(replica, report, size))
    return [_spread(drawn, own, draws) for own in drawn_maps]


_Draw = tuple[NDArray[np.float64], NDArray[np.float64]]
"""MTF50 of the map, `(place, 2)`, and contrast of the curves, `(frequency, 2, radius)`."""


def _ask(replica: LensModel, report: LensReport, size: int) -> _Draw:
    rings = [list(ring(r, _RING, report.aspect)) for r in report.radii]
    places = [point.position for point in report.field] + [place for places in rings for place in places]
    kernels = replica.kernels(places, report.settings, size)
    count = len(report.field)
    frequencies = [curve.frequency for curve in report.curves]
    return _map(kernels[:count], places), _curves(kernels[count:], rings, frequencies)


def _spread(drawn: Drawn, drawings: Sequence[_Draw], draws: int) -> Spread | None:
    if len(drawings) < max(draws // 2, 2):
        return None
    maps, curves = ([draw[k] for draw in drawings] for k in (0, 1))
    spread, over = np.std(maps, axis=0, ddof=1), np.std(curves, axis=0, ddof=1)
    return Spread(
        drawn,
        len(drawings),
        tuple(spread[:, 0].tolist()),
        tuple(spread[:, 1].tolist()),
        tuple(CurveSpread(tuple(t.tolist()), tuple(s.tolist())) for t, s in over),
    )


def _groups(samples: Sequence[PsfSample], drawn: Drawn) -> list[list[PsfSample]]:
    """Samples that are drawn together: those of a photo, or those of a patch in all colours."""
    groups: defaultdict[Hashable, list[PsfSample]] = defaultdict(list)
    for sample in samples:
        patch = (sample.photo, sample.position)
        groups[sample.photo if drawn == "photos" else patch].append(sample)
    return list(groups.values())


def _map(kernels: NDArray[np.float64], places: Sequence[FieldPosition]) -> NDArray[np.float64]:
    """MTF50 along u and v, `(place, 2)`, none beyond what a sensor shows."""
    pairs = [tangential_sagittal_mtf50(k, p.phi) for k, p in zip(kernels, places, strict=False)]
    return np.minimum(np.array(pairs), NYQUIST)


def _curves(
    kernels: NDArray[np.float64], rings: Sequence[Sequence[FieldPosition]], frequencies: Sequence[float]
) -> NDArray[np.float64]:
    """Contrast `(frequency, 2, radius)`, mean over the places of a radius."""
    out = np.empty((len(frequencies), 2, len(rings)))
    at = 0
    for column, places in enumerate(rings):
        own = kernels[at : at + len(places)]
        at += len(places)
        for row, turn in enumerate((0.0, math.pi / 2.0)):
            mtf = [mtf_from_kernel(k, p.phi + turn, frequencies) for k, p in zip(own, places, strict=True)]
            out[:, row, column] = np.mean(mtf, axis=0)
        if len(places) == 1:
            out[:, :, column] = out[:, :, column].mean(axis=1, keepdims=True)  # u has no direction there
    return out
