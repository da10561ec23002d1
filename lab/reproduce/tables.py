"""Tables from results: means over lenses in the paper's order, and what is good or bad for each lens."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from lensmodel.core.types import CHANNELS, ZONES

Result = Mapping[str, Any]

TOLERATED_DB: Final = 0.05  # dB of a zone (chosen): less counts as equal

MEASURABLE_DB: Final = 0.2
"""A gain of the true PSF below this says nothing of a lens."""

FEWER: Final = "2"
MORE: Final = "5"
"""Numbers of photos that are compared: the larger may be worse in nothing."""


SMALL_GAIN: Final = 0.05
"""Where the true PSF raises MTF50 by a smaller share, the share of its gain says nothing."""

EDGE_FIGURES: Final = ("mtf50", "tangential_mtf50", "sagittal_mtf50", "mtf_max", "overshoot")

BEFORE: Final = "without correction"
DENOISED: Final = "denoised only"
GENERAL: Final = "general profile of the lens model"
RIVAL: Final = "Schuler et al. 2012, n = 1"
PAPER_WAY: Final = "the paper's own way"
MEASURED: Final = "measured with a target"
TRUE: Final = "true PSF"

DECONVOLUTIONS: Final = {"paper": "Richardson-Lucy", "standard": "standard"}
"""How pages call non-blind methods: `paper` is one of them, and the paper's own way another thing."""


def deconvolution(method: str) -> str:
    """Name of a non-blind method on pages."""
    return DECONVOLUTIONS.get(method, method)


def shown(state: str) -> str:
    """Name of a state on pages: what was learned by default says so."""
    return f"default, {state}" if state.startswith("n = ") else state


def groups(result: Result) -> dict[str, Result]:
    """Split the lenses by family: means over both would compare nothing."""
    found: dict[str, list[Result]] = {}
    for case in result["cases"]:
        found.setdefault(case["family"], []).append(case)
    return {family: {**result, "cases": cases} for family, cases in found.items()}


def counts(result: Result) -> list[int]:
    """Numbers of photos that occur, ascending."""
    return sorted({int(n) for case in result["cases"] for n in case["learned"]})


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of those that are known; None where none is."""
    known = [v for v in values if v is not None and math.isfinite(v)]
    return sum(known) / len(known) if known else None


def summary(result: Result) -> dict[str, Any]:
    """Return everything that the tables show, by figure, method, number of photos and zone."""
    methods = result["plan"]["methods"]
    return {
        "lenses": len(result["cases"]),
        "mtf": {method: _mtf(result, method) for method in methods},
        "share": {method: _by_count(result, partial(shares, method=method)) for method in methods},
        "highest_mtf": {method: _highest_mtf(result, method) for method in methods},
        "psnr": {method: _psnr(result, method) for method in methods},
        "psnr_kept": {method: _by_count(result, partial(kept, method=method)) for method in methods},
        "worse": {method: worse(result, method) for method in methods},
        "psf_others": _psf_of_others(result),
        "psf": _by_count(result, partial(_psf, channel="g")),
        "psf_by_channel": {c: _by_count(result, partial(_psf, channel=c)) for c in CHANNELS},
        "predicted_right": {
            str(n): mean(get(c["learned"][str(n)]["psf"], "predicted_right") for c in _having(result, n))
            for n in counts(result)
        },
        "forecast_off": {method: _forecast_off(result, method) for method in methods},
    }


def _forecast_off(result: Result, method: str) -> dict[str, float | None]:
    """Mean over zones of lenses of what the expected gain is off by, for each number of photos."""
    found: dict[str, float | None] = {}
    for n in counts(result):
        zones = [
            zone
            for case in _having(result, n)
            for zone in case["learned"][str(n)]["methods"][method].get("forecast", {}).values()
        ]
        found[str(n)] = mean(abs(z["expected"] - z["true"]) for z in zones if z["expected"] is not None)
    return found


def _psf_of_others(result: Result) -> dict[str, dict[str, float | None]]:
    """Error of green PSFs that are not the default's, by the names of their states."""
    found: dict[str, list[Result]] = {}
    for case in result["cases"]:
        for name, unit in others(case).items():
            if unit["psf"] is not None:
                found.setdefault(name, []).append(_rel_l2(unit["psf"], "g"))
    return {name: _zones(partial(_column_mean, found[name])) for name in _names([found])}


def others(case: Result) -> dict[str, Result]:
    """Units of a lens whose PSFs are not the default's, by the names of their states."""
    found = {RIVAL: case["rival"]} if case.get("rival") else {}
    if case.get("general"):
        found[GENERAL] = case["general"]
    for n, unit in sorted(case.get("paper", {}).items(), key=lambda item: int(item[0])):
        found[f"{PAPER_WAY}, n = {n}"] = unit
    if case.get("measured"):
        found[MEASURED] = case["measured"]
    return found


def shares(case: Result, n: int, method: str) -> dict[str, float | None]:
    """Share of the gain of the true PSF in MTF50 that one lens reaches; None where that gain is small."""
    found: dict[str, float | None] = {}
    for zone in ZONES:
        before = _edge(case["truth"]["before"], zone, "mtf50")
        true = _edge(case["truth"]["true"][method], zone, "mtf50")
        after = _edge(case["learned"][str(n)]["methods"][method], zone, "mtf50")
        if before is None or true is None or after is None or true - before < SMALL_GAIN * before:
            found[zone] = None
        else:
            found[zone] = (after - before) / (true - before)
    return found


def kept(case: Result, n: int, method: str) -> dict[str, float | None]:
    """Share of the gain of the true PSF in PSNR; None where that gain is small."""
    found: dict[str, float | None] = {}
    for zone in ZONES:
        true = gain(case, case["truth"]["true"][method], zone)
        after = gain(case, case["learned"][str(n)]["methods"][method], zone)
        found[zone] = None if true is None or after is None or true < MEASURABLE_DB else after / true
    return found


def _highest_mtf(result: Result, method: str) -> dict[str, dict[str, float | None]]:
    """The highest corrected MTF of any lens, by number of photos and zone: a mean would hide it."""

    def highest(n: int, zone: str) -> float | None:
        states = [case["learned"][str(n)]["methods"][method] for case in _having(result, n)]
        found = [get((state.get("edges") or {}).get(zone), "mtf_max") for state in states]
        return max((value for value in found if value is not None), default=None)

    return {str(n): _zones(partial(highest, n)) for n in counts(result)}


def worse(result: Result, method: str) -> dict[str, dict[str, int]]:
    """Count zones of lenses whose PSNR fell."""
    return {
        str(n): counted(
            (case, zone, case["learned"][str(n)]["methods"][method])
            for case in _having(result, n)
            for zone in ZONES
        )
        for n in counts(result)
    }


def paths(result: Result) -> dict[str, dict[str, Any]]:
    """What other kinds of files gain, by their names."""
    method = result["plan"]["methods"][0]
    found: dict[str, dict[str, Any]] = {}
    for name in sorted({name for case in result["cases"] for name in case["paths"]}):
        cases = [case for case in result["cases"] if name in case["paths"]]
        units = [case["paths"][name] for case in cases]
        own = [{"truth": {"before": unit["before"]}} for unit in units]
        gained = {z: mean(gain(o, u["after"], z) for o, u in zip(own, units, strict=True)) for z in ZONES}
        raw = {z: mean(gain(c, c["learned"]["1"]["methods"][method], z) for c in cases) for z in ZONES}
        found[name] = {
            "lenses": len(cases),
            "refused": sum(len(unit["refused"]) for unit in units),
            "gain": gained,
            "true": {z: mean(gain(o, u["true"], z) for o, u in zip(own, units, strict=True)) for z in ZONES},
            "share": {z: None if not (r := raw[z]) else (gained[z] or 0.0) / r for z in ZONES},
            "counts": counted((o, z, u["after"]) for o, u in zip(own, units, strict=True) for z in ZONES),
        }
    return found


def states(case: Result, method: str) -> dict[str, Mapping[str, Any]]:
    """Versions of a lens's photos by name, from untouched to the true PSF."""
    learned = {
        f"n = {n}": unit["methods"][method]
        for n, unit in sorted(case["learned"].items(), key=lambda item: int(item[0]))
    }
    return {
        BEFORE: case["truth"]["before"],
        **({DENOISED: case["truth"]["control"]} if case["truth"]["control"] else {}),
        **learned,
        **{name: found for name, unit in others(case).items() if (found := _of(unit, name, method))},
        TRUE: case["truth"]["true"][method],
    }


def _of(unit: Result, name: str, method: str) -> Mapping[str, Any] | None:
    """Corrected with a method; what is done the paper's own way has none but its own."""
    methods: Mapping[str, Mapping[str, Any]] = unit["methods"]
    return next(iter(methods.values())) if name.startswith(PAPER_WAY) else methods.get(method)


def number(value: float | None, digits: int = 0) -> str:
    """Format a number; a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def _names(every: Iterable[Mapping[str, Any]]) -> list[str]:
    """Names of all states: untouched, denoised, others, the paper's way, photos ascending, the true PSF."""
    found = dict.fromkeys(name for one in every for name in one)

    def place(name: str) -> tuple[int, int]:
        fixed = {BEFORE: 0, DENOISED: 1, GENERAL: 3, MEASURED: 6, TRUE: 7}
        if name in fixed:
            return fixed[name], 0
        if name.startswith(PAPER_WAY):
            return 4, int(name.rpartition(" = ")[2])
        return (5, int(name[4:])) if name.startswith("n = ") else (2, 0)

    return sorted(found, key=place)


def _mtf(result: Result, method: str) -> list[dict[str, Any]]:
    every = [states(case, method) for case in result["cases"]]
    rows = []
    for name in _names(every):
        row: dict[str, Any] = {"state": name}
        for zone in ZONES:
            here = [one[name]["edges"].get(zone, {}) for one in every if name in one]
            row[zone] = {field: mean(get(edge, field) for edge in here) for field in EDGE_FIGURES}
        rows.append(row)
    return rows


def _psnr(result: Result, method: str) -> list[dict[str, Any]]:
    every = [states(case, method) for case in result["cases"]]
    return [
        {
            "state": name,
            **{zone: mean(get(one[name]["psnr"], zone) for one in every if name in one) for zone in ZONES},
        }
        for name in _names(every)
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
    return _rel_l2(case["learned"][str(n)]["psf"], channel)


def _rel_l2(found: Result | None, channel: str) -> dict[str, float | None]:
    return {zone: None if found is None else found["rel_l2"][channel].get(zone) for zone in ZONES}


def _edge(state: Result, zone: str, name: str) -> float | None:
    value: float | None = get(state["edges"].get(zone, {}), name)
    return value


def counted(rows: Iterable[tuple[Result, str, Result]]) -> dict[str, int]:
    """Count zones that fell, of rows `(case, zone, corrected)`; see `worse`."""
    gains = [db for case, zone, after in rows if (db := gain(case, after, zone)) is not None]
    return {
        "zones": len(gains),
        "worse": sum(db < 0.0 for db in gains),
        "clearly_worse": sum(db < -TOLERATED_DB for db in gains),
    }


def more_photos(cases: Iterable[Result], method: str) -> dict[str, int]:
    """Count `zones` of lenses that learned from two photos and from five, and those that five make worse."""
    changes = []
    for case in cases:
        if {FEWER, MORE} <= case["learned"].keys():
            states = [case["learned"][n]["methods"][method] for n in (FEWER, MORE)]
            pairs = [[get(state["psnr"], zone) for state in states] for zone in ZONES]
            changes += [more - fewer for fewer, more in pairs if fewer is not None and more is not None]
    return {"zones": len(changes), "psnr_worse": sum(change < -TOLERATED_DB for change in changes)}


def gain(case: Result, state: Result, zone: str) -> float | None:
    """Gain in PSNR (dB) over the photo as it was; None where the zone is not there."""
    before, after = get(case["truth"]["before"]["psnr"], zone), get(state["psnr"], zone)
    return None if before is None or after is None else after - before


def get(row: Mapping[str, Any] | None, name: str) -> float | None:
    """Value of a row; None where there is no row, or none of that name."""
    return None if row is None else row.get(name)
