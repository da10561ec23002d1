"""What is asked of the whole chain, each bar with its value and whether it holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from lensmodel.core.types import ZONES
from lensmodel.lab.reproduce.pages.tables import (
    BEFORE,
    DENOISED,
    MEASURED,
    TRUE,
    groups,
    hard_rows,
    summary,
)

PLACES: Final = ("center", "corner")

_SHARE = {"1": (0.85, 1.05), "5": (0.93, 1.04)}
_SHARE_STRETCH = {"5": (0.97, 1.02)}
_HIGHEST_MTF = (1.10, 1.05)
_HALO_PERCENT = 3.0
_PSF = {"1": (0.22, 0.36), "5": (0.16, 0.26)}
_PSF_STRETCH = {"5": (0.10, 0.17)}
_MORE_HELPS = (0.75, 0.6)
_PREDICTED = 0.8
_KEPT = (0.80, 0.92)


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar.

    Parameters
    ----------
    name : str
        What is asked.
    place : str
        Zone, or the part of the run.
    value : float or None
        What was measured; None where this run does not tell.
    low, high : float or None
        The band in which it has to lie.
    stretch : tuple or None
        The narrower band that is aimed at.
    """

    name: str
    place: str
    value: float | None
    low: float | None = None
    high: float | None = None
    stretch: tuple[float | None, float | None] | None = None

    @property
    def met(self) -> bool | None:
        """Whether it holds; None where this run does not tell."""
        return _within(self.value, self.low, self.high)

    @property
    def stretched(self) -> bool | None:
        """Whether the narrower band holds; None where there is none, or no value."""
        return None if self.stretch is None else _within(self.value, *self.stretch)

    def plain(self) -> dict[str, Any]:
        """As values for JSON."""
        return {
            "name": self.name,
            "place": self.place,
            "value": self.value,
            "low": self.low,
            "high": self.high,
            "met": self.met,
            "stretch": None if self.stretch is None else list(self.stretch),
            "stretch_met": self.stretched,
        }


def _within(value: float | None, low: float | None, high: float | None) -> bool | None:
    if value is None:
        return None
    return (low is None or value >= low) and (high is None or value <= high)


def bars(result: Mapping[str, Any]) -> list[Bar]:
    """Evaluate every bar on the lenses wide open, raw, at base ISO, and on what hurts.

    Parameters
    ----------
    result : mapping
        What `run_reproduction` returned.
    """
    found = groups(result)
    if not found:
        return []
    # the first group: lenses wide open on the frames that all sizes of a run have
    group = next(iter(found.values()))
    return [*_mtf(group), *_psf(group), *_photos(group), *_peers(group), *_hard(result)]


def _mtf(group: Mapping[str, Any]) -> Iterator[Bar]:
    made = summary(group)
    method = "paper" if "paper" in made["mtf"] else next(iter(made["mtf"]))
    for n, (low, high) in _SHARE.items():
        for zone in PLACES:
            yield Bar(
                f"share of the true-PSF gain in MTF50, method {method}, n = {n}",
                zone,
                made["share"][method].get(n, {}).get(zone),
                low,
                high,
                _SHARE_STRETCH.get(n),
            )
    for name, rows in made["mtf"].items():
        last = [row for row in rows if row["state"].startswith("n = ")][-1]
        for zone in PLACES:
            value = last[zone]["mtf_max"]
            yield Bar(
                f"highest corrected MTF, method {name}, {last['state']}",
                zone,
                value,
                high=_HIGHEST_MTF[0],
                stretch=(None, _HIGHEST_MTF[1]),
            )
        n = last["state"].removeprefix("n = ")
        for zone in PLACES:
            yield Bar(
                f"overshoot beyond the true PSF's, percent of the step, method {name}, n = {n}",
                zone,
                made["halo"][name][n][zone],
                high=_HALO_PERCENT,
            )


def _psf(group: Mapping[str, Any]) -> Iterator[Bar]:
    made = summary(group)
    for n, limits in _PSF.items():
        for zone, limit in zip(PLACES, limits, strict=True):
            stretch = _PSF_STRETCH.get(n)
            yield Bar(
                f"relative L2 of the PSF, green, n = {n}",
                zone,
                made["psf"].get(n, {}).get(zone),
                high=limit,
                stretch=None if stretch is None else (None, stretch[PLACES.index(zone)]),
            )
    for zone in PLACES:
        one, five = (made["psf"].get(n, {}).get(zone) for n in ("1", "5"))
        yield Bar(
            "relative L2 after n = 5 over that after n = 1",
            zone,
            None if one is None or five is None else five / one,
            high=_MORE_HELPS[0],
            stretch=(None, _MORE_HELPS[1]),
        )
    for n, value in made["predicted_right"].items():
        yield Bar(f"prediction right within a factor of 1.5, n = {n}", "field", value, low=_PREDICTED)


def _photos(group: Mapping[str, Any]) -> Iterator[Bar]:
    made = summary(group)
    for method, table in made["worse"].items():
        for n, row in table.items():
            yield Bar(
                f"zones where PSNR or SSIM does not rise despite measurable blur, method {method}, n = {n}",
                f"of {row['zones']}",
                row["unimproved"],
                high=0,
            )
            yield Bar(
                f"zones where PSNR falls by more than 0.05 dB, method {method}, n = {n}",
                f"of {row['zones']}",
                row["clearly_worse"],
                high=0,
            )
    for zone in ZONES:
        for method, table in made["psnr_kept"].items():
            yield Bar(
                f"share of the true-PSF gain in PSNR, method {method}, n = 5",
                zone,
                table.get("5", {}).get(zone),
                low=_KEPT[0],
                stretch=(_KEPT[1], None),
            )


def _peers(group: Mapping[str, Any]) -> Iterator[Bar]:
    """Ahead of each peer: PSNR in every zone, and MTF50 at equal overshoot."""
    made = summary(group)
    for method, rows in made["psnr"].items():
        psnr = {row["state"]: row for row in rows}
        edges = {row["state"]: row for row in made["mtf"][method]}
        for name in psnr:
            if name in {BEFORE, DENOISED, MEASURED, TRUE} or name.startswith("n = "):
                continue
            peer = name.removesuffix(", n = 1")
            for zone in ZONES:
                ahead = _minus(psnr["n = 1"][zone], psnr[name][zone])
                yield Bar(f"PSNR ahead of {peer}, dB, method {method}, n = 1", zone, ahead, low=0.0)
            for zone in PLACES:
                ahead = _minus(edges["n = 1"][zone]["mtf50_fair"], edges[name][zone]["mtf50_fair"])
                what = f"MTF50 ahead of {peer} at equal overshoot, LP/PH, method {method}, n = 1"
                yield Bar(what, zone, ahead, low=0.0)


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _hard(result: Mapping[str, Any]) -> Iterator[Bar]:
    for row in hard_rows(result):
        counts = row["counts"]
        yield Bar(
            f"{row['title']}: zones where PSNR falls by more than 0.05 dB",
            f"of {counts['zones']}",
            counts["clearly_worse"],
            high=0,
        )


def held(found: Sequence[Bar]) -> dict[str, int]:
    """Count bars: `held`, `missed`, `unknown`."""
    return {
        "held": sum(bar.met is True for bar in found),
        "missed": sum(bar.met is False for bar in found),
        "unknown": sum(bar.met is None for bar in found),
    }
