"""The audit of one tile: every check, and one smooth map of what is kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import Plane, Planes
from lensmodel.correction.audit import blocks, nearby
from lensmodel.correction.audit.check import Evidence, Finding, Severity, TileAudit, TilePair
from lensmodel.correction.audit.grain import amplified
from lensmodel.correction.audit.hue import foreign_area, foreign_spots
from lensmodel.correction.audit.light import isolated, too_bright, too_dark
from lensmodel.correction.audit.reblur import misfit
from lensmodel.correction.audit.ringing import swing
from lensmodel.correction.audit.spectrum import comb, overcorrected
from lensmodel.correction.engine import Engine

Check: TypeAlias = Callable[[TilePair], Severity]
"""Severity on a grid of places of a tile; above 1 is a fault."""

CHECKS: Final[Mapping[str, Check]] = MappingProxyType(
    {
        "too dark": too_dark,
        "too bright": too_bright,
        "isolated pixels": isolated,
        "hue, spots": foreign_spots,
        "hue, area": foreign_area,
        "re-blur": misfit,
        "spectrum": overcorrected,
        "comb": comb,
        "ringing": swing,
        "grain": amplified,
    }
)
"""Every check by name."""

_SOFTNESS: Final = 1.0
"""Standard deviation in pixels of the Gaussian that smooths the map: a fault of one pixel leaves no edge
(chosen)."""
GROWN: Final = 5
"""Side in pixels of the square over which the least share kept spreads first: wide enough that smoothing
restores nothing of a faulty pixel itself."""

Inner: TypeAlias = tuple[slice, slice]


def audit_tile(
    original: Planes,
    corrected: Planes,
    evidence: Evidence,
    *,
    inner: Inner | None = None,
    engine: Engine = "auto",
) -> TileAudit:
    """Audit the correction of a tile.

    A check's severity s is the multiple of its limit: of a correction within it, s <= 1, all is kept, from
    s = 2 on nothing, and 2 - s between.

    Parameters
    ----------
    original, corrected : Planes, shape (3, rows, cols)
        Linear light, saturation 1, with surrounding pixels if there are any: the more, the surer the
        verdict on the rim.
    evidence : Evidence
        What else is known.
    inner : tuple of slice or None
        The part that is judged; the rest is context. None for all.
    engine : {"auto", "numpy"}
        Compiled loops where available, or NumPy and SciPy: figures differ by rounding.

    Returns
    -------
    TileAudit
        Of the inner part.

    Raises
    ------
    InvalidInputError
        If the planes have different sizes.
    """
    pair = TilePair.of(original, corrected, evidence, engine=engine)
    inner = inner or (slice(None), slice(None))
    findings = []
    grids: dict[tuple[int, float, tuple[int, ...]], NDArray[np.float32]] = {}
    for name, check in CHECKS.items():
        severity = check(pair)
        findings.append(_finding(name, severity, inner, pair.shape))
        if findings[-1].worst > 1.0 or severity.values.max(initial=0.0) > 1.0:
            key = (severity.step, severity.first, severity.values.shape)
            worst = grids.get(key)
            grids[key] = severity.values if worst is None else np.maximum(worst, severity.values)
    keep = np.ones(pair.shape, dtype=np.float32)
    for (step, first, _), values in grids.items():
        share = _share(values)
        if step > 1:
            share = blocks.to_pixels(share, pair.shape, first=first, step=step)
        np.minimum(keep, share, out=keep)
    if grids:
        keep = softened(keep)
    return TileAudit.of(keep[inner], tuple(findings))


def held_back(
    original: Planes, corrected: Planes, evidence: Evidence, *, inner: Inner | None = None
) -> tuple[Planes, TileAudit]:
    """Audit the correction of a tile and mix it back towards the original as far as it fails.

    Parameters and errors as `audit_tile`.

    Returns
    -------
    planes : Planes, shape (3, rows, cols) of the inner part
        original + keep (corrected - original); where all is kept, exactly the correction.
    audit : TileAudit
        Why.
    """
    audit = audit_tile(original, corrected, evidence, inner=inner)
    part = (slice(None), *(inner or (slice(None), slice(None))))
    before, after = original[part], corrected[part]
    if audit.keep.min(initial=1.0) == 1.0:
        return after, audit
    return np.asarray(before + audit.keep * (after - before), dtype=np.float32), audit


def softened(keep: Plane) -> Plane:
    """Spread the least share kept over its neighbours and smooth it, so that it changes nowhere abruptly."""
    grown = nearby.lowest(keep, GROWN)
    return np.clip(ndimage.gaussian_filter(grown, _SOFTNESS, mode="nearest"), 0.0, 1.0)


def _share(severity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Share of the correction that is kept: all up to a severity of 1, nothing from 2 on."""
    return np.clip(np.float32(2.0) - severity, np.float32(0.0), np.float32(1.0))


def _finding(name: str, severity: Severity, inner: Inner, shape: tuple[int, int]) -> Finding:
    """Sum up one check in the inner part, before it is smoothed."""
    part = severity.part(inner, shape)
    values = severity.values[part]
    row, col = np.unravel_index(int(values.argmax()), values.shape)
    worst = float(values[row, col])
    place = (int(row) + part[0].start, int(col) + part[1].start)
    at = [
        int(np.clip(round(severity.first + severity.step * k) - (s.start or 0), 0, extent - 1))
        for k, s, extent in zip(place, inner, shape, strict=True)
    ]
    if worst <= 1.0:
        return Finding(name, 0.0, 0.0, worst, (at[0], at[1]))
    share = _share(values)
    return Finding(
        name,
        float(1.0 - share.mean(dtype=np.float64)),
        float((share < 0.5).mean()),
        worst,
        (at[0], at[1]),
    )
