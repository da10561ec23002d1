"""Figures of results: means over lenses in the paper's order, what hurts each lens, and the bars."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple

from lab.reproduce.cases import BEFORE, GENERAL, MEASURED, PAPER_WAY, RIVAL, SOFT_SEED, TRUE, learned
from lensmodel.core.types import CHANNELS, ZONES

Result = Mapping[str, Any]
Zones = dict[str, float | None]  # a figure in each zone; None where nothing tells it
TOLERATED_DB: Final = 0.05  # dB of a zone (chosen): less counts as equal
MEASURABLE_DB: Final = 0.2  # a gain of the true PSF below this says nothing of a lens

FEWER: Final = "2"
MORE: Final = "5"  # numbers of photos that are compared: the larger may be worse in nothing
SMALL_GAIN: Final = 0.05  # where the true PSF raises MTF50 by less, the share of its gain says nothing

EDGE_FIGURES: Final = ("mtf50", "tangential_mtf50", "sagittal_mtf50", "mtf_max", "overshoot")

_ORDER: Final = (BEFORE, RIVAL, GENERAL, PAPER_WAY, "n = ", MEASURED, TRUE)  # how names of states begin


def groups(result: Result) -> dict[str, Result]:
    """Split the lenses by family: means over both would compare nothing."""
    families = dict.fromkeys(case["family"] for case in result["cases"])
    own = {name: [case for case in result["cases"] if case["family"] == name] for name in families}
    return {name: {**result, "cases": cases} for name, cases in own.items()}


def names(every: Iterable[Iterable[str]]) -> list[str]:
    """Names of all states in the order of the tables, numbers of photos ascending."""

    def place(name: str) -> tuple[int, int]:
        first = next(i for i, start in enumerate(_ORDER) if name.startswith(start))
        number = name.rpartition(" = ")[2]
        return first, int(number) if number.isdigit() else 0

    return sorted({name for one in every for name in one}, key=place)


def counts(cases: Sequence[Result]) -> list[str]:
    """Numbers of photos that occur, ascending."""
    every = {name for case in cases for name in case["states"] if name.startswith("n = ")}
    return sorted((name.removeprefix("n = ") for name in every), key=int)


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of those that are known; None where none is."""
    known = [v for v in values if v is not None and math.isfinite(v)]
    return sum(known) / len(known) if known else None


def get(case: Result, *path: str) -> Any:  # noqa: ANN401 - of a JSON document
    """What lies under some keys; None where one of them is not there."""
    found: Any = case
    for key in path:
        found = (found or {}).get(key)
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
    states, known = (names(case[part] for case in cases) for part in ("states", "psf"))
    numbers = counts(cases)

    def by_count(of: Callable[[Result, str, str], float | None]) -> dict[str, Zones]:
        return {n: {z: mean(of(case, learned(n), z) for case in cases) for z in ZONES} for n in numbers}

    def edge(state: str, zone: str, figure: str) -> float | None:
        return mean(get(case, "states", state, "edges", zone, figure) for case in cases)

    def psf(figure: str, state: str, *path: str) -> float | None:
        return mean(get(case, "psf", state, figure, *path) for case in cases)

    return {
        "lenses": len(cases),
        "mtf": {s: {z: {name: edge(s, z, name) for name in EDGE_FIGURES} for z in ZONES} for s in states},
        "share": by_count(share),
        "highest_mtf": {n: {z: _highest_mtf(cases, n, z) for z in ZONES} for n in numbers},
        "psnr": {s: {z: mean(get(c, "states", s, "psnr", z) for c in cases) for z in ZONES} for s in states},
        "psnr_kept": by_count(kept),
        "worse": {n: counted(gain(c, learned(n), z) for c in cases for z in ZONES) for n in numbers},
        "psf": {s: {c: {z: psf("rel_l2", s, c, z) for z in ZONES} for c in CHANNELS} for s in known},
        "predicted_right": {n: psf("predicted_right", learned(n)) for n in numbers},
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
    found = {}
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


class Asked(NamedTuple):
    """What is asked (chosen) of a number of photos; where there are three limits, of the three zones."""

    psf: tuple[float, float, float]  # relative L2 of green
    colours: float  # that of red and of blue over green's
    kept: tuple[float, float, float]  # share of the true PSF's gain
    told: float
    highest_mtf: float
    forecast_db: float


ASKED: Final = {  # by numbers of photos
    "1": Asked((0.12, 0.18, 0.38), 1.6, (0.75, 0.70, 0.55), 0.75, 1.10, 0.6),
    "2": Asked((0.10, 0.15, 0.32), 1.4, (0.80, 0.75, 0.65), 0.75, 1.10, 0.5),
    "5": Asked((0.08, 0.11, 0.27), 1.3, (0.85, 0.80, 0.70), 0.8, 1.08, 0.4),
}

_SOFT: Final = (0.30, 0.35, 0.50)
_MORE_HARMS: Final = 0.02
_PATHS: Final = {"tiff": 0.5, "jpeg": 1.0 / 3.0}
_GREEN: Final = "relative L2 of the PSF, green"
_FALLS: Final = "zones where PSNR falls by more than 0.05 dB"


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar."""

    name: str  # what is asked
    place: str  # zone, or the part of the run
    value: float | None  # what was measured; None where this run does not tell
    low: float | None = None  # the band in which it has to lie
    high: float | None = None
    n: str = "1"  # how many photos the lens was learned from
    family: str = ""  # family of the lenses

    @property
    def met(self) -> bool | None:
        """Whether it holds; None where this run does not tell."""
        if self.value is None:
            return None
        return (self.low is None or self.value >= self.low) and (self.high is None or self.value <= self.high)

    @property
    def asked(self) -> str:
        """What is asked, in words."""
        return f"at most {self.high:g}" if self.low is None else f"at least {self.low:.2g}"

    def plain(self) -> dict[str, Any]:
        """As values for JSON."""
        return {**asdict(self), "met": self.met}


def bars(result: Mapping[str, Any]) -> list[Bar]:
    """Evaluate every bar on the lenses of each family, the soft fast one apart."""
    soft = [case for case in result["cases"] if case["settings"]["seed"] == SOFT_SEED]
    usual = [case for case in result["cases"] if case["settings"]["seed"] != SOFT_SEED]
    found: list[Bar] = []
    for family, group in groups({**result, "cases": usual}).items():
        found += [replace(bar, family=family) for bar in _of_family(group)]
    if soft:
        made = summary({**result, "cases": soft})
        of_soft = [
            *_zoned(_GREEN, get(made, "psf", learned(1), "g"), _SOFT),
            _counted(_FALLS, made["worse"].get("1")),
        ]
        found += [replace(bar, family="soft fast lens") for bar in of_soft]
    return found


def _of_family(group: Result) -> Iterator[Bar]:
    made = summary(group)
    for n, asked in ASKED.items():
        errors = get(made, "psf", learned(n)) or {}
        told, off = (made[name].get(n) for name in ("predicted_right", "forecast_off"))
        yield from _zoned(_GREEN, errors.get("g"), asked.psf, n=n)
        for word, channel in (("red", "r"), ("blue", "b")):
            ratios = {zone: _over(get(errors, channel, zone), get(errors, "g", zone)) for zone in ZONES}
            yield from _zoned(f"relative L2 of the PSF, {word} over green", ratios, [asked.colours] * 3, n=n)
        yield Bar("share of PSF errors told right within a factor of 1.5", "field", told, low=asked.told, n=n)
        kept_, highest = (made[name].get(n) for name in ("psnr_kept", "highest_mtf"))
        yield from _zoned("share of the true-PSF gain in PSNR", kept_, asked.kept, least=True, n=n)
        yield from _zoned("highest corrected MTF of any lens", highest, [asked.highest_mtf] * 3, n=n)
        yield _counted(_FALLS, made["worse"].get(n), n=n)
        words = "what the forecast of the gain by zone is off by, dB"
        yield Bar(words, "all zones", off, high=asked.forecast_db, n=n)
    two, five = (get(made, "psf", learned(n), "g") for n in (FEWER, MORE))
    more = {zone: None if two is None or five is None else five[zone] - two[zone] for zone in ZONES}
    yield from _zoned("relative L2 of green above that of two photos", more, [_MORE_HARMS] * 3, n=MORE)
    words = "zones where five photos give a PSNR below that of two by more than 0.05 dB"
    yield _counted(words, more_photos(group["cases"]), n=MORE)
    for name, row in paths(group).items():
        words = f"{name.upper()}: gain in PSNR over that of raw"
        yield from _zoned(words, row["share"], [_PATHS[name]] * 3, least=True)
        yield _counted(f"{name.upper()}: {_FALLS}", row["counts"])


def _zoned(
    name: str,
    row: Mapping[Any, float | None] | None,
    limits: Sequence[float],
    *,
    least: bool = False,
    n: str = "1",
) -> Iterator[Bar]:
    """A bar for each zone, with the least or the most that it may be."""
    for zone, limit in zip(ZONES, limits, strict=True):
        yield Bar(name, zone, get(row or {}, zone), limit if least else None, None if least else limit, n)


def _counted(name: str, counts: Mapping[str, int] | None, *, n: str = "1") -> Bar:
    """No zone may fall; where none is known, nothing is told."""
    if not counts or not counts["zones"]:
        return Bar(name, "zones", None, high=0, n=n)
    return Bar(name, f"of {counts['zones']} zones", counts["clearly_worse"], high=0, n=n)


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or other is None else value / other


def held(found: Sequence[Bar]) -> dict[str, int]:
    """Count bars: `held`, `missed`, `unknown`."""
    verdicts = {"held": True, "missed": False, "unknown": None}
    return {name: sum(bar.met is verdict for bar in found) for name, verdict in verdicts.items()}


def missed(result: Mapping[str, Any]) -> list[str]:
    """Say which bars are missed, a line each."""
    return [
        f"{bar.family}, n = {bar.n}: {bar.name}, {bar.place}: {bar.value:.4g}, {bar.asked} is asked"
        for bar in bars(result)
        if bar.met is False
    ]
