"""What is good or bad for one lens: zones that fell, what was said of them, photos that did harm."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

from lensmodel.core.types import CHANNELS, ZONES

Result = Mapping[str, Any]

TOLERATED_DB: Final = 0.05  # dB of a zone (chosen): less counts as equal

MEASURABLE: Final = {"psnr": 0.2, "ssim": 0.002}
"""Gains of the true PSF below these say nothing of a lens."""

NOTHING_DB: Final = 0.3
"""Where the true PSF gains less than this in every zone, there is nothing to correct (chosen: a bar)."""

FEWER: Final = "2"
MORE: Final = "5"
"""Numbers of photos that are compared: the larger may be worse in nothing."""

TOLERATED_L2: Final = 0.01
"""Of the PSF error, by which more photos may be worse (chosen: a bar)."""


def counted(rows: Iterable[tuple[Result, str, Result, Result]]) -> dict[str, int]:
    """Count zones that fell, of rows `(case, zone, corrected, with the true PSF)`; see `tables.worse`."""
    found = dict.fromkeys(("zones", "worse", "clearly_worse", "ssim_worse", "unimproved"), 0)
    for case, zone, after, true in rows:
        psnr, ssim = gain(case, after, zone), gain(case, after, zone, "ssim")
        possible = gain(case, true, zone)
        if psnr is None or ssim is None or possible is None:
            continue
        found["zones"] += 1
        found["worse"] += psnr < 0.0
        found["clearly_worse"] += psnr < -TOLERATED_DB
        found["ssim_worse"] += ssim < 0.0
        found["unimproved"] += possible >= MEASURABLE["psnr"] and (psnr <= 0.0 or ssim <= 0.0)
    return found


def said_nothing(rows: Iterable[tuple[Result, Result, Result]]) -> dict[str, int]:
    """Count lenses said to have nothing to correct, of rows `(case, corrected, with the true PSF)`.

    Returns
    -------
    dict
        `lenses` that were corrected, not those of which no photo counted; `said`; `wrongly`, of these, though
        the true PSF gains 0.3 dB or more of PSNR in some zone; `unsaid`, not said though it gains less.
    """
    found = dict.fromkeys(("lenses", "said", "wrongly", "unsaid"), 0)
    for case, corrected, true in rows:
        said = corrected.get("nothing_to_correct")
        gains = [g for zone in ZONES if (g := gain(case, true, zone)) is not None]
        if said is None or not gains:
            continue
        nothing = max(gains) < NOTHING_DB
        found["lenses"] += 1
        found["said"] += bool(said)
        found["wrongly"] += bool(said) and not nothing
        found["unsaid"] += nothing and not said
    return found


def more_photos(cases: Iterable[Result], method: str) -> dict[str, Any]:
    """Compare what five photos give of each lens with what two of them gave.

    Returns
    -------
    dict
        `zones` of lenses that have both; `psf_worse`, where the median PSF error of some channel is larger by
        more than 0.01; `psnr_worse`, where PSNR of the corrected picture is lower by more than 0.05 dB;
        `rows`, one for each of these zones: `lens`, `zone`, and with two and five photos `psf` (largest
        difference of a channel, its error before and after) and `psnr`.
    """
    found: dict[str, Any] = {"zones": 0, "psf_worse": 0, "psnr_worse": 0, "rows": []}
    for case in cases:
        if not {FEWER, MORE} <= case["learned"].keys():
            continue
        fewer, more = case["learned"][FEWER], case["learned"][MORE]
        for zone in ZONES:
            psf = _largest_rise(fewer["psf"], more["psf"], zone)
            psnr = [get(unit["methods"][method]["psnr"], zone) for unit in (fewer, more)]
            if psnr[0] is None or psnr[1] is None:
                continue
            psf_worse = psf is not None and psf[1] - psf[0] > TOLERATED_L2
            psnr_worse = psnr[1] - psnr[0] < -TOLERATED_DB
            found["zones"] += 1
            found["psf_worse"] += psf_worse
            found["psnr_worse"] += psnr_worse
            if psf_worse or psnr_worse:
                found["rows"].append({"lens": case["title"], "zone": zone, "psf": psf, "psnr": psnr})
    return found


def _largest_rise(fewer: Result | None, more: Result | None, zone: str) -> list[float] | None:
    """PSF error of the channel that became worse by most, before and after."""
    if fewer is None or more is None:
        return None
    pairs = [[fewer["rel_l2"][c][zone], more["rel_l2"][c][zone]] for c in CHANNELS]
    return max(pairs, key=lambda pair: pair[1] - pair[0])


def gain(case: Result, state: Result, zone: str, of: str = "psnr") -> float | None:
    """Gain in PSNR (dB) or SSIM over the photo as it was; None where the zone is not there."""
    before, after = get(case["truth"]["before"][of], zone), get(state[of], zone)
    return None if before is None or after is None else after - before


def get(row: Mapping[str, Any] | None, name: str) -> float | None:
    """Value of a row; None where there is no row, or none of that name."""
    return None if row is None else row.get(name)
