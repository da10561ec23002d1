"""What is asked of the whole chain, each bar with its value and whether it holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from lab.reproduce.cases import FAMILIES
from lab.reproduce.tables import (
    BEFORE,
    DENOISED,
    MEASURED,
    MORE,
    TRUE,
    groups,
    hard_rows,
    more_photos,
    nothing_said,
    summary,
)
from lensmodel.core.types import ZONES

PLACES: Final = ("center", "corner")

COUNTS: Final = ("1", "2", "5")
"""Numbers of photos that bars are of."""

DECONVOLUTION: Final = "standard"
"""What a user gets who chooses nothing; bars are of its corrections."""

# What is asked (chosen); three values are of 1, 2 and 5 photos, pairs of `PLACES` or ends of a band.
_PSF: Final = {
    "g": ((0.25, 0.40), (0.20, 0.32), (0.15, 0.25)),
    "rb": ((0.30, 0.45), (0.25, 0.38), (0.20, 0.30)),
}
_HIGHEST_MTF: Final = (1.25, 1.15, 1.10)
_KEPT: Final = (0.55, 0.70, 0.80)
_PREDICTED: Final = 0.8
_FORECAST_DB: Final = 0.5
_SHARE: Final = {"1": (0.85, 1.05), "5": (0.93, 1.04)}
_HALO_PERCENT: Final = 3.0
_MORE_HELPS: Final = 0.75


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar."""

    name: str  # what is asked
    place: str  # zone, or the part of the run
    value: float | None  # what was measured; None where this run does not tell
    low: float | None = None  # the band in which it has to lie
    high: float | None = None
    n: str = "1"  # how many photos the lens was learned from
    family: str = ""  # family of the lenses; empty for scenes and paths that hurt

    @property
    def met(self) -> bool | None:
        """Whether it holds; None where this run does not tell."""
        return _within(self.value, self.low, self.high)

    def plain(self) -> dict[str, Any]:
        """As values for JSON."""
        return {**asdict(self), "met": self.met}


def _within(value: float | None, low: float | None, high: float | None) -> bool | None:
    if value is None:
        return None
    return (low is None or value >= low) and (high is None or value <= high)


def bars(result: Mapping[str, Any]) -> list[Bar]:
    """Evaluate every bar on each family's lenses wide open, raw, at base ISO, and on what hurts."""
    found: list[Bar] = []
    method = _method(result)
    for family in FAMILIES:
        cases = [case for case in result["cases"] if case["family"] == family]
        if not cases:
            continue
        # the first group: lenses wide open on the frames that all sizes of a run have
        made = summary(next(iter(groups({**result, "cases": cases}).values())))
        of_all = {**result, "cases": cases}
        parts = (
            _psf(made),
            _mtf(made, method),
            _photos(made, method),
            _each_lens(of_all, method),
            _peers(made, method),
        )
        found += [replace(bar, family=family) for part in parts for bar in part]
    return [*found, *_hard(result)]


def _method(result: Mapping[str, Any]) -> str:
    """Deconvolution that bars are of; the first of a run without it."""
    methods: Sequence[str] = result["plan"]["methods"]
    return DECONVOLUTION if DECONVOLUTION in methods else methods[0]


def _psf(made: Mapping[str, Any]) -> Iterator[Bar]:
    for channel, word in (("g", "green"), ("r", "red"), ("b", "blue")):
        limits = _PSF["g" if channel == "g" else "rb"]
        for i, zone in enumerate(PLACES):
            for n, limit in zip(COUNTS, limits, strict=True):
                value = made["psf_by_channel"][channel].get(n, {}).get(zone)
                yield Bar(f"relative L2 of the PSF, {word}", zone, value, high=limit[i], n=n)
    for zone in PLACES:
        one, five = (made["psf"].get(n, {}).get(zone) for n in ("1", "5"))
        ratio = None if one is None or five is None else five / one
        yield Bar("relative L2 over that after n = 1", zone, ratio, high=_MORE_HELPS, n="5")
    for n in COUNTS:
        value = made["predicted_right"].get(n)
        yield Bar(
            "share of PSF errors told right within a factor of 1.5", "field", value, low=_PREDICTED, n=n
        )


def _mtf(made: Mapping[str, Any], method: str) -> Iterator[Bar]:
    for zone in ZONES:
        for n, limit in zip(COUNTS, _HIGHEST_MTF, strict=True):
            value = made["highest_mtf"][method].get(n, {}).get(zone)
            yield Bar("highest corrected MTF of any lens", zone, value, high=limit, n=n)
    for zone in PLACES:
        for n, (low, high) in _SHARE.items():
            value = made["share"][method].get(n, {}).get(zone)
            yield Bar("share of the true-PSF gain in MTF50", zone, value, low, high, n=n)
        beyond = made["halo"][method].get("5", {}).get(zone)
        words = "overshoot beyond the true PSF's, percent of the step"
        yield Bar(words, zone, beyond, high=_HALO_PERCENT, n="5")


def _photos(made: Mapping[str, Any], method: str) -> Iterator[Bar]:
    for zone in ZONES:
        for n, limit in zip(COUNTS, _KEPT, strict=True):
            value = made["psnr_kept"][method].get(n, {}).get(zone)
            yield Bar("share of the true-PSF gain in PSNR", zone, value, low=limit, n=n)
    zones = next((f"of {row['zones']} zones" for row in made["worse"][method].values()), "zones")
    for name, key in (
        ("zones where PSNR falls by more than 0.05 dB", "clearly_worse"),
        ("zones where PSNR or SSIM does not rise despite measurable blur", "unimproved"),
    ):
        for n in COUNTS:
            yield Bar(name, zones, made["worse"][method].get(n, {}).get(key), high=0, n=n)
    for n in COUNTS:
        off = made["forecast_off"][method].get(n)
        words = "what the forecast of the gain by zone is off by, dB"
        yield Bar(words, "all zones", off, high=_FORECAST_DB, n=n)


def _each_lens(result: Mapping[str, Any], method: str) -> Iterator[Bar]:
    """Of every lens of a family, stopped down or not: verdicts that no mean can hide."""
    said = nothing_said(result, method)
    for name, key in (
        ("lenses said to have nothing to correct though the true PSF gains 0.3 dB somewhere", "wrongly"),
        ("lenses not said to, though the true PSF gains less in all zones", "unsaid"),
    ):
        for n in COUNTS:
            row = said.get(n)
            yield Bar(name, "lenses", None if row is None else row[key], high=0, n=n)
    more = more_photos(result["cases"], method)
    for name, key in (
        ("zones where five photos give a PSF error above that of two by more than 0.01", "psf_worse"),
        ("zones where five photos give a PSNR below that of two by more than 0.05 dB", "psnr_worse"),
    ):
        value = more[key] if more["zones"] else None
        yield Bar(name, f"of {more['zones']} zones" if more["zones"] else "zones", value, high=0, n=MORE)


def _peers(made: Mapping[str, Any], method: str) -> Iterator[Bar]:
    """Ahead of each peer: PSNR in every zone, and MTF50 at equal overshoot."""
    psnr = {row["state"]: row for row in made["psnr"][method]}
    edges = {row["state"]: row for row in made["mtf"][method]}
    for name in psnr:
        peer = name.removesuffix(", n = 1")
        if name in {BEFORE, DENOISED, MEASURED, TRUE} or "n = " in peer or "n = 1" not in psnr:
            continue
        for zone in ZONES:
            ahead = _minus(psnr["n = 1"][zone], psnr[name][zone])
            yield Bar(f"PSNR ahead of {peer}, dB", zone, ahead, low=0.0)
        for zone in PLACES:
            ahead = _minus(edges["n = 1"][zone]["mtf50_fair"], edges[name][zone]["mtf50_fair"])
            yield Bar(f"MTF50 ahead of {peer} at equal overshoot, LP/PH", zone, ahead, low=0.0)


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _hard(result: Mapping[str, Any]) -> Iterator[Bar]:
    for row in hard_rows(result):
        title, counts = f"{row['title']}, {row['family']}", row["counts"]
        yield Bar(
            f"{title}: zones where PSNR falls by more than 0.05 dB",
            f"of {counts['zones']} zones",
            counts["clearly_worse"],
            high=0,
        )
        wrong = row["nothing"]["wrongly"] + row["nothing"]["unsaid"]
        yield Bar(
            f'{title}: lenses where "nothing to correct" was wrongly said or left out',
            f"of {row['nothing']['lenses']} lenses",
            wrong if row["nothing"]["lenses"] else None,
            high=0,
        )


def held(found: Sequence[Bar]) -> dict[str, int]:
    """Count bars: `held`, `missed`, `unknown`."""
    return {
        "held": sum(bar.met is True for bar in found),
        "missed": sum(bar.met is False for bar in found),
        "unknown": sum(bar.met is None for bar in found),
    }


def missed(result: Mapping[str, Any]) -> list[str]:
    """Say which bars are missed, a line each, and of five photos that are worse than two, where."""
    lines = []
    for bar in bars(result):
        if bar.met is False:
            asked = " and ".join(
                f"{words} {limit:g}"
                for words, limit in (("at least", bar.low), ("at most", bar.high))
                if limit is not None
            )
            family = f"{bar.family}, " if bar.family else ""
            lines.append(f"{family}n = {bar.n}: {bar.name}, {bar.place}: {bar.value:.4g}, {asked} is asked")
    for row in more_photos(result["cases"], _method(result))["rows"]:
        psf = "" if row["psf"] is None else f"PSF error {row['psf'][0]:.2f} to {row['psf'][1]:.2f}, "
        gained = row["psnr"][1] - row["psnr"][0]
        lines.append(f"five photos worse than two: {row['lens']}, {row['zone']}: {psf}PSNR {gained:+.2f} dB")
    return lines
