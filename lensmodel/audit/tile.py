"""The audit of one tile: every check, one smooth map of what is kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.audit import near
from lensmodel.audit.base import Evidence, Finding, Pair, TileAudit
from lensmodel.audit.grain import amplified
from lensmodel.audit.hue import foreign_hue
from lensmodel.audit.light import isolated, too_bright, too_dark
from lensmodel.audit.reblur import misfit
from lensmodel.audit.ringing import swing
from lensmodel.audit.spectrum import comb, overcorrected
from lensmodel.types import Plane, Planes

Check: TypeAlias = Callable[[Pair], Plane]
"""Severity at each pixel of a tile; above 1 is a fault."""

CHECKS: Final[Mapping[str, Check]] = MappingProxyType(
    {
        "too dark": too_dark,
        "too bright": too_bright,
        "isolated pixels": isolated,
        "hue": foreign_hue,
        "re-blur": misfit,
        "spectrum": overcorrected,
        "comb": comb,
        "ringing": swing,
        "grain": amplified,
    }
)
"""Every check by name."""

_SOFTNESS: Final = 1.0
"""Standard deviation in pixels of what makes the map smooth: a fault of one pixel leaves no edge."""
GROWN: Final = 5
"""Side of the square over which the least that is kept spreads before: wide enough that of a faulty pixel
itself nothing comes back when the map is smoothed."""

Inner: TypeAlias = tuple[slice, slice]


def audit_tile(
    original: Planes, corrected: Planes, evidence: Evidence, *, inner: Inner | None = None
) -> TileAudit:
    """Audit the correction of a tile.

    A check's severity s says how many times what is allowed was found: of a correction that is in order,
    s <= 1, all is kept, of one twice beyond nothing, and 2 - s between.

    Parameters
    ----------
    original, corrected : Planes, shape (3, rows, cols)
        Linear light, saturation 1, with the pixels around if there are any: the more, the surer the
        verdict on the rim.
    evidence : Evidence
        What is known besides.
    inner : tuple of slice or None
        The part that is judged; the rest is context. None for all.

    Returns
    -------
    TileAudit
        Of the inner part.

    Raises
    ------
    InvalidInputError
        If the planes have different sizes.
    """
    pair = Pair.of(original, corrected, evidence)
    inner = inner or (slice(None), slice(None))
    keep = np.ones(original.shape[1:], dtype=np.float32)
    findings = []
    for name, check in CHECKS.items():
        severity = check(pair)
        one = kept(severity)
        findings.append(_finding(name, severity[inner], one[inner]))
        np.minimum(keep, one, out=keep)
    return TileAudit.of(keep[inner], tuple(findings))


def held_back(
    original: Planes, corrected: Planes, evidence: Evidence, *, inner: Inner | None = None
) -> tuple[Planes, TileAudit]:
    """Audit the correction of a tile and mix it back towards the original as far as it fails.

    Parameters and errors as `audit_tile`.

    Returns
    -------
    planes : Planes, shape (3, rows, cols) of the inner part
        original + keep (corrected - original); where all is kept, the very values of the correction.
    audit : TileAudit
        Why.
    """
    audit = audit_tile(original, corrected, evidence, inner=inner)
    part = (slice(None), *(inner or (slice(None), slice(None))))
    before, after = original[part], corrected[part]
    if audit.keep.min(initial=1.0) == 1.0:
        return after, audit
    return np.asarray(before + audit.keep * (after - before), dtype=np.float32), audit


def kept(severity: NDArray[np.floating]) -> Plane:
    """Share of the correction that is kept at each pixel: 2 - s of a severity s in 1..2, smooth.

    The least spreads over its neighbours before it is smoothed, so that a fault of one pixel is gone.
    """
    share = np.clip(np.float32(2.0) - severity, 0.0, 1.0).astype(np.float32)
    if share.min(initial=1.0) == 1.0:
        return share
    grown = near.lowest(share, GROWN)
    return np.minimum(ndimage.gaussian_filter(grown, _SOFTNESS, mode="nearest"), np.float32(1.0))


def _finding(name: str, severity: Plane, keep: Plane) -> Finding:
    row, col = np.unravel_index(int(severity.argmax()), severity.shape)
    return Finding(
        name,
        float(1.0 - keep.mean(dtype=np.float64)),
        float((keep < 0.5).mean()),
        float(severity[row, col]),
        (int(row), int(col)),
    )
