"""Tables from results: means over lenses, in the paper's order."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from lensmodel.types import ZONES

Result = Mapping[str, Any]

SMALL_GAIN: Final = 0.05
"""Where the true PSF raises MTF50 by a smaller share, the share of its gain says nothing."""

TOLERATED_DB: Final = 0.05


def groups(result: Result) -> dict[str, Result]:
    """Split the lenses by aperture and frame: means over different ones would compare nothing."""
    found: dict[str, list[Result]] = {}
    for case in result["cases"]:
        settings = case["settings"]
        stops = "wide open" if case["stops"] < 0.1 else f"{case['stops']:.0f} stops down"
        label = f"{stops}, frames of {settings['width']} x {settings['height']}"
        found.setdefault(label, []).append(case)
    return {label: {**result, "cases": cases} for label, cases in found.items()}


def counts(result: Result) -> list[int]:
    """Numbers of photos that occur, ascending."""
    return sorted({int(n) for case in result["cases"] for n in case["learned"]})


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of those that are known; None where none is."""
    known = [v for v in values if v is not None and math.isfinite(v)]
    return sum(known) / len(known) if known else None


def summary(result: Result) -> dict[str, Any]:
    """Return everything that the tables show, as plain values.

    Returns
    -------
    dict
        `rows`: state (before, n, true PSF) by method, with the mean over the lenses that have it;
        `share`: share of the true-PSF gain in MTF50; `psf`; `psnr_worse`.
    """
    methods = result["plan"]["methods"]
    return {
        "lenses": len(result["cases"]),
        "mtf": {method: _mtf(result, method) for method in methods},
        "share": {method: _by_count(result, partial(shares, method=method)) for method in methods},
        "psnr": {method: _psnr(result, method) for method in methods},
        "psnr_control": _zones(
            lambda z: mean(_psnr_gain(c, c["truth"]["control"], z) for c in result["cases"])
        ),
        "psnr_kept": {method: _by_count(result, partial(kept, method=method)) for method in methods},
        "worse": {method: worse(result, method) for method in methods},
        "psf": _by_count(result, partial(_psf, channel="g")),
        "psf_all_channels": _by_count(result, _psf_mean),
        "predicted_right": {
            str(n): mean(_get(c["learned"][str(n)]["psf"], "predicted_right") for c in _having(result, n))
            for n in counts(result)
        },
    }


def shares(case: Result, n: int, method: str) -> dict[str, float | None]:
    """Share of the gain of the true PSF in MTF50 that one lens reaches; None where that gain is small."""
    found: dict[str, float | None] = {}
    for zone in ZONES:
        before = _mtf50(case["truth"]["before"], zone)
        true = _mtf50(case["truth"]["true"][method], zone)
        after = _mtf50(case["learned"][str(n)]["methods"][method], zone)
        if before is None or true is None or after is None or true - before < SMALL_GAIN * before:
            found[zone] = None
        else:
            found[zone] = (after - before) / (true - before)
    return found


def kept(case: Result, n: int, method: str) -> dict[str, float | None]:
    """Share of the PSNR gain of the true PSF; None where that is below 0.2 dB."""
    found: dict[str, float | None] = {}
    for zone in ZONES:
        true = _psnr_gain(case, case["truth"]["true"][method], zone)
        after = _psnr_gain(case, case["learned"][str(n)]["methods"][method], zone)
        found[zone] = None if true is None or after is None or true < 0.2 else after / true
    return found


def worse(result: Result, method: str) -> dict[str, dict[str, int]]:
    """Count zones of lenses whose PSNR fell, at all and by more than is tolerated."""
    table = {}
    for n in counts(result):
        gains = [
            gain
            for case in _having(result, n)
            for zone in ZONES
            if (gain := _psnr_gain(case, case["learned"][str(n)]["methods"][method], zone)) is not None
        ]
        table[str(n)] = {
            "zones": len(gains),
            "worse": sum(gain < 0.0 for gain in gains),
            "clearly_worse": sum(gain < -TOLERATED_DB for gain in gains),
        }
    return table


def states(case: Result, method: str) -> dict[str, Mapping[str, Any]]:
    """Versions of a lens's photos by name, from untouched to the true PSF."""
    learned = {
        f"n = {n}": unit["methods"][method]
        for n, unit in sorted(case["learned"].items(), key=lambda item: int(item[0]))
    }
    return {
        "without correction": case["truth"]["before"],
        **learned,
        "true PSF": case["truth"]["true"][method],
    }


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def number(value: float | None, digits: int = 0) -> str:
    """Format a number; a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def _mtf(result: Result, method: str) -> list[dict[str, Any]]:
    every = [states(case, method) for case in result["cases"]]
    names = list(dict.fromkeys(name for one in every for name in one))
    # the true PSF last, numbers ascending before it
    names.sort(key=lambda name: (name == "true PSF", int(name[4:]) if name.startswith("n = ") else 0))
    rows = []
    for name in names:
        row: dict[str, Any] = {"state": name}
        for zone in ZONES:
            here = [one[name]["edges"].get(zone, {}) for one in every if name in one]
            row[zone] = {
                field: mean(_get(edge, field) for edge in here)
                for field in ("mtf50", "tangential_mtf50", "sagittal_mtf50", "mtf_max", "overshoot")
            }
        rows.append(row)
    return rows


def _psnr(result: Result, method: str) -> list[dict[str, Any]]:
    every = [states(case, method) for case in result["cases"]]
    names = [row["state"] for row in _mtf(result, method)]
    return [
        {
            "state": name,
            **{zone: mean(_get(one[name]["psnr"], zone) for one in every if name in one) for zone in ZONES},
        }
        for name in names
    ]


def _by_count(
    result: Result, of: Callable[[Result, int], Mapping[str, float | None]]
) -> dict[str, dict[str, float | None]]:
    table: dict[str, dict[str, float | None]] = {}
    for n in counts(result):
        rows = [of(case, n) for case in _having(result, n)]
        table[str(n)] = _zones(partial(_column_mean, rows))
    return table


def _column_mean(rows: Sequence[Mapping[str, float | None]], zone: str) -> float | None:
    return mean(row.get(zone) for row in rows)


def _zones(of: Callable[[str], float | None]) -> dict[str, float | None]:
    return {zone: of(zone) for zone in ZONES}


def _having(result: Result, n: int) -> list[Result]:
    return [case for case in result["cases"] if str(n) in case["learned"]]


def _psf(case: Result, n: int, channel: str) -> dict[str, float | None]:
    found = case["learned"][str(n)]["psf"]
    return {zone: None if found is None else found["rel_l2"][channel].get(zone) for zone in ZONES}


def _psf_mean(case: Result, n: int) -> dict[str, float | None]:
    every = [_psf(case, n, channel) for channel in ("r", "g", "b")]
    return {zone: mean(one[zone] for one in every) for zone in ZONES}


def _mtf50(state: Result, zone: str) -> float | None:
    value: float | None = _get(state["edges"].get(zone, {}), "mtf50")
    return value


def _psnr_gain(case: Result, state: Result, zone: str) -> float | None:
    before, after = _get(case["truth"]["before"]["psnr"], zone), _get(state["psnr"], zone)
    return None if before is None or after is None else after - before


def _get(row: Mapping[str, Any] | None, name: str) -> float | None:
    return None if row is None else row.get(name)
