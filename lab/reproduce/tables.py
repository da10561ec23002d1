"""Tables from results: means over lenses in the paper's order, and what is good or bad for each lens."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from lab.reproduce.cases import BEFORE, GENERAL, MEASURED, PAPER_WAY, RIVAL, TRUE, learned
from lensmodel.core.types import CHANNELS, ZONES

Result = Mapping[str, Any]
Zones = dict[str, float | None]
"""A figure in each zone; None where nothing tells it."""

TOLERATED_DB: Final = 0.05  # dB of a zone (chosen): less counts as equal

MEASURABLE_DB: Final = 0.2
"""A gain of the true PSF below this says nothing of a lens."""

FEWER: Final = "2"
MORE: Final = "5"
"""Numbers of photos that are compared: the larger may be worse in nothing."""

SMALL_GAIN: Final = 0.05
"""Where the true PSF raises MTF50 by a smaller share, the share of its gain says nothing."""

EDGE_FIGURES: Final = ("mtf50", "tangential_mtf50", "sagittal_mtf50", "mtf_max", "overshoot")

_ORDER: Final = (BEFORE, RIVAL, GENERAL, PAPER_WAY, "n = ", MEASURED, TRUE)
"""How names of states begin, in the order of the tables."""


def groups(result: Result) -> dict[str, Result]:
    """Split the lenses by family: means over both would compare nothing."""
    found: dict[str, list[Result]] = {}
    for case in result["cases"]:
        found.setdefault(case["family"], []).append(case)
    return {family: {**result, "cases": cases} for family, cases in found.items()}


def names(every: Iterable[Iterable[str]]) -> list[str]:
    """Names of all states in the order of the tables, numbers of photos ascending."""

    def place(name: str) -> tuple[int, int]:
        first = next(i for i, start in enumerate(_ORDER) if name.startswith(start))
        number = name.rpartition(" = ")[2]
        return first, int(number) if number.isdigit() else 0

    return sorted({name for one in every for name in one}, key=place)


def counts(cases: Sequence[Result]) -> list[str]:
    """Numbers of photos that occur, ascending."""
    found = {
        name.removeprefix("n = ") for case in cases for name in case["states"] if name.startswith("n = ")
    }
    return sorted(found, key=int)


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of those that are known; None where none is."""
    known = [v for v in values if v is not None and math.isfinite(v)]
    return sum(known) / len(known) if known else None


def get(case: Result, *path: str) -> Any:  # noqa: ANN401 - of a JSON document
    """What lies under some keys; None where one of them is not there."""
    found: Any = case
    for key in path:
        found = None if found is None else found.get(key)
    return found


def gain(case: Result, state: str, zone: str) -> float | None:
    """Gain in PSNR (dB) over the photo as it was."""
    before, after = (get(case, "states", name, "psnr", zone) for name in (BEFORE, state))
    return None if before is None or after is None else after - before


def share(case: Result, state: str, zone: str) -> float | None:
    """Share of the gain of the true PSF in MTF50; None where that gain is small."""
    found = [get(case, "states", name, "edges", zone, "mtf50") for name in (BEFORE, state, TRUE)]
    if None in found or found[2] - found[0] < SMALL_GAIN * found[0]:
        return None
    before, after, true = found
    return float((after - before) / (true - before))


def kept(case: Result, state: str, zone: str) -> float | None:
    """Share of the gain of the true PSF in PSNR; None where that gain is small."""
    true, after = gain(case, TRUE, zone), gain(case, state, zone)
    return None if true is None or after is None or true < MEASURABLE_DB else after / true


def summary(result: Result) -> dict[str, Any]:
    """Return everything that the tables show, by figure, state or number of photos, and zone."""
    cases = result["cases"]
    states, known = names(case["states"] for case in cases), names(case["psf"] for case in cases)
    numbers = counts(cases)

    def by_count(of: Callable[[Result, str, str], float | None]) -> dict[str, Zones]:
        return {n: {z: mean(of(case, learned(n), z) for case in cases) for z in ZONES} for n in numbers}

    def edge(state: str, zone: str, figure: str) -> float | None:
        return mean(get(case, "states", state, "edges", zone, figure) for case in cases)

    return {
        "lenses": len(cases),
        "mtf": {s: {z: {name: edge(s, z, name) for name in EDGE_FIGURES} for z in ZONES} for s in states},
        "share": by_count(share),
        "highest_mtf": {n: {z: _highest_mtf(cases, n, z) for z in ZONES} for n in numbers},
        "psnr": {s: {z: mean(get(c, "states", s, "psnr", z) for c in cases) for z in ZONES} for s in states},
        "psnr_kept": by_count(kept),
        "worse": {n: counted(gain(c, learned(n), z) for c in cases for z in ZONES) for n in numbers},
        "psf": {
            s: {
                c: {z: mean(get(one, "psf", s, "rel_l2", c, z) for one in cases) for z in ZONES}
                for c in CHANNELS
            }
            for s in known
        },
        "predicted_right": {
            n: mean(get(case, "psf", learned(n), "predicted_right") for case in cases) for n in numbers
        },
        "forecast_off": {n: _forecast_off(cases, n) for n in numbers},
    }


def _forecast_off(cases: Sequence[Result], n: str) -> float | None:
    """Mean over zones of lenses of what the expected gain is off by."""
    told = [get(case, "states", learned(n), "forecast") or {} for case in cases]
    zones = [zone for one in told for zone in one.values()]
    return mean(abs(zone["expected"] - zone["true"]) for zone in zones if zone["expected"] is not None)


def _highest_mtf(cases: Sequence[Result], n: str, zone: str) -> float | None:
    """The highest corrected MTF of any lens: a mean would hide it."""
    found = [get(case, "states", learned(n), "edges", zone, "mtf_max") for case in cases]
    return max((value for value in found if value is not None), default=None)


def paths(result: Result) -> dict[str, dict[str, Any]]:
    """What other kinds of files gain, by their names: its share of raw files' gain, and zones that fell."""
    found: dict[str, dict[str, Any]] = {}
    for name in sorted({name for case in result["cases"] for name in case["paths"]}):
        cases = [case for case in result["cases"] if name in case["paths"]]
        own = [{"states": case["paths"][name]} for case in cases]
        raw = {z: mean(gain(case, learned("1"), z) for case in cases) for z in ZONES}
        gained = {z: mean(gain(one, "after", z) for one in own) for z in ZONES}
        found[name] = {
            "share": {z: None if not (r := raw[z]) else (gained[z] or 0.0) / r for z in ZONES},
            "counts": counted(gain(one, "after", z) for one in own for z in ZONES),
        }
    return found


def counted(gains: Iterable[float | None]) -> dict[str, int]:
    """Count zones that are known, and those that fell by more than is tolerated."""
    known = [db for db in gains if db is not None]
    return {"zones": len(known), "clearly_worse": sum(db < -TOLERATED_DB for db in known)}


def more_photos(cases: Iterable[Result]) -> dict[str, int]:
    """Count zones of lenses that learned from two photos and from five, and those that five make worse."""
    pairs = [[gain(case, learned(n), z) for n in (FEWER, MORE)] for case in cases for z in ZONES]
    return counted(None if None in pair else pair[1] - pair[0] for pair in pairs)  # type: ignore[operator]


def number(value: float | None, digits: int = 0) -> str:
    """Format a number; a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"
