"""What is asked of the whole chain, each bar with its value and whether it holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from lab.reproduce.cases import SOFT_SEED, learned
from lab.reproduce.tables import FEWER, MORE, get, groups, more_photos, paths, summary
from lensmodel.core.types import CHANNELS, ZONES

COUNTS: Final = ("1", "2", "5")
"""Numbers of photos that bars are of."""

# What is asked (chosen): of 1, 2 and 5 photos, and of those in centre, mid and corner.
_PSF: Final = ((0.12, 0.18, 0.38), (0.10, 0.15, 0.32), (0.08, 0.11, 0.27))
_COLOURS: Final = (1.6, 1.4, 1.3)
_KEPT: Final = ((0.75, 0.70, 0.55), (0.80, 0.75, 0.65), (0.85, 0.80, 0.70))
_TOLD: Final = (0.75, 0.75, 0.8)
_HIGHEST_MTF: Final = (1.10, 1.10, 1.08)
_FORECAST_DB: Final = (0.6, 0.5, 0.4)
_SOFT: Final = (0.30, 0.35, 0.50)
_MORE_HARMS: Final = 0.02
_PATHS: Final = {"tiff": 0.5, "jpeg": 1.0 / 3.0}


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

    def plain(self) -> dict[str, Any]:
        """As values for JSON."""
        return {**asdict(self), "met": self.met}


def bars(result: Mapping[str, Any]) -> list[Bar]:
    """Evaluate every bar on the lenses of each family, the soft fast one apart."""
    soft = [case for case in result["cases"] if case["settings"]["seed"] == SOFT_SEED]
    usual = [case for case in result["cases"] if case["settings"]["seed"] != SOFT_SEED]
    found: list[Bar] = []
    for family, group in groups({**result, "cases": usual}).items():
        made = summary(group)
        parts = (_psf(made), _photos(made), _more(group, made), _paths(group))
        found += [replace(bar, family=family) for part in parts for bar in part]
    if soft:
        made = summary({**result, "cases": soft})
        for zone, limit in zip(ZONES, _SOFT, strict=True):
            value = get(made, "psf", learned(1), "g", zone)
            found.append(
                Bar("relative L2 of the PSF, green", zone, value, high=limit, family="soft fast lens")
            )
        worse = made["worse"].get("1", {})
        found.append(Bar(_FALLS, _zones(worse), worse.get("clearly_worse"), high=0, family="soft fast lens"))
    return found


_FALLS: Final = "zones where PSNR falls by more than 0.05 dB"


def _zones(counts: Mapping[str, int]) -> str:
    return f"of {counts['zones']} zones" if counts else "zones"


def _psf(made: Mapping[str, Any]) -> Iterator[Bar]:
    for i, n in enumerate(COUNTS):
        errors = {c: [get(made, "psf", learned(n), c, zone) for zone in ZONES] for c in CHANNELS}
        for zone, green, limit in zip(ZONES, errors["g"], _PSF[i], strict=True):
            yield Bar("relative L2 of the PSF, green", zone, green, high=limit, n=n)
        for word, others in (("red", errors["r"]), ("blue", errors["b"])):
            for zone, other, green in zip(ZONES, others, errors["g"], strict=True):
                ratio = None if None in (other, green) else other / green
                yield Bar(f"relative L2 of the PSF, {word} over green", zone, ratio, high=_COLOURS[i], n=n)
        told = made["predicted_right"].get(n)
        yield Bar("share of PSF errors told right within a factor of 1.5", "field", told, low=_TOLD[i], n=n)


def _photos(made: Mapping[str, Any]) -> Iterator[Bar]:
    for i, n in enumerate(COUNTS):
        for zone, limit in zip(ZONES, _KEPT[i], strict=True):
            value = get(made, "psnr_kept", n, zone)
            yield Bar("share of the true-PSF gain in PSNR", zone, value, low=limit, n=n)
        for zone in ZONES:
            value = get(made, "highest_mtf", n, zone)
            yield Bar("highest corrected MTF of any lens", zone, value, high=_HIGHEST_MTF[i], n=n)
        worse = made["worse"].get(n, {})
        yield Bar(_FALLS, _zones(worse), worse.get("clearly_worse"), high=0, n=n)
        off = made["forecast_off"].get(n)
        words = "what the forecast of the gain by zone is off by, dB"
        yield Bar(words, "all zones", off, high=_FORECAST_DB[i], n=n)


def _more(group: Mapping[str, Any], made: Mapping[str, Any]) -> Iterator[Bar]:
    for zone in ZONES:
        pair = [get(made, "psf", learned(n), "g", zone) for n in (FEWER, MORE)]
        more = None if None in pair else pair[1] - pair[0]
        yield Bar("relative L2 of green above that of two photos", zone, more, high=_MORE_HARMS, n=MORE)
    compared = more_photos(group["cases"])
    value = compared["clearly_worse"] if compared["zones"] else None
    words = "zones where five photos give a PSNR below that of two by more than 0.05 dB"
    yield Bar(words, _zones(compared) if compared["zones"] else "zones", value, high=0, n=MORE)


def _paths(group: Mapping[str, Any]) -> Iterator[Bar]:
    for name, row in paths(group).items():
        for zone in ZONES:
            share = row["share"][zone]
            yield Bar(f"{name.upper()}: gain in PSNR over that of raw", zone, share, low=_PATHS[name])
        counts = row["counts"]
        yield Bar(f"{name.upper()}: {_FALLS}", _zones(counts), counts["clearly_worse"], high=0)


def held(found: Sequence[Bar]) -> dict[str, int]:
    """Count bars: `held`, `missed`, `unknown`."""
    return {
        "held": sum(bar.met is True for bar in found),
        "missed": sum(bar.met is False for bar in found),
        "unknown": sum(bar.met is None for bar in found),
    }


def missed(result: Mapping[str, Any]) -> list[str]:
    """Say which bars are missed, a line each."""
    lines = []
    for bar in bars(result):
        if bar.met is False:
            asked = f"at most {bar.high:g}" if bar.low is None else f"at least {bar.low:g}"
            lines.append(
                f"{bar.family}, n = {bar.n}: {bar.name}, {bar.place}: {bar.value:.4g}, {asked} is asked"
            )
    return lines
