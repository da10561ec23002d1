"""`lensmodel correct`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import typer
from rich.progress import Progress, TaskID

from app.commands import files
from app.commands.display import Display
from app.commands.failure import UsageError
from app.identity import difference
from app.words import gain_words
from lensmodel import deconv, pipeline
from lensmodel.audit import HELD, AuditReport
from lensmodel.errors import InvalidInputError, LensModelError
from lensmodel.photo import OutputFormat
from lensmodel.regression import LensProfile
from lensmodel.types import LensSettings, Zone

EXTENSION: Final[dict[OutputFormat, str]] = {
    "tiff16": ".tif",
    "png16": ".png",
    "png8": ".png",
    "jpeg": ".jpg",
    "dng": ".dng",
}


@dataclass(frozen=True, slots=True)
class Wishes:
    """What the options said."""

    aperture: float | None
    method: str
    strength: float
    bounds: deconv.Bounds
    file_format: OutputFormat
    workers: int | None
    any_lens: bool
    force: bool


def run(
    names: Sequence[str], source: Path, output: Path, wishes: Wishes, display: Display, *, as_json: bool
) -> None:
    """Correct photos into a folder, one after the other.

    Raises
    ------
    UsageError
        If something is wrong that can be seen before any work.
    typer.Exit
        With 1 if a photo could not be corrected.
    """
    targets = _targets(files.photos(names), output, EXTENSION[wishes.file_format])
    with files.as_usage():
        deconv.deconvolvers.create(wishes.method)
        settings = LensSettings(aperture=wishes.aperture)
    profile = files.profile_at(source)
    if output.exists() and not output.is_dir():
        raise UsageError(f"{output} is a file; give a folder to -o")
    output.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    with display.progress() as bars:
        task = bars.add_task("", total=len(targets))
        for number, (target, path) in enumerate(targets.items()):
            bars.update(task, description=path.name)
            try:
                result = _one(
                    path, target, profile, settings, wishes, display, partial(_show, bars, task, number)
                )
            except (LensModelError, OSError) as error:
                code = error.code if isinstance(error, LensModelError) else "unreadable"
                result = {"state": "failed", "code": code, "reason": files.reason(error)}
                display.error(f"{path}: {result['reason']}")
            if result["state"] == "kept":
                display.note(f"{target} is there already and was left alone; --force replaces it")
            elif result["state"] == "corrected" and not as_json:
                display.result(str(target))
            if result["state"] == "corrected":
                for line in remarks(result):
                    display.note(f"{path.name}, {line}")
            results.append({"photo": str(path), "output": str(target), **result})
            bars.update(task, completed=number + 1)
    if as_json:
        display.document({"profile": str(source), "results": results})
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _targets(paths: Sequence[Path], output: Path, extension: str) -> dict[Path, Path]:
    """Name the file that each photo becomes; no two may become the same."""
    found: dict[Path, Path] = {}
    for path in paths:
        target = output / f"{path.stem}{files.CORRECTED}{extension}"
        if target in found:
            raise UsageError(
                f"{found[target]} and {path} would both become {target}; "
                "name each by itself, and correct them into different folders"
            )
        found[target] = path
    return found


def _one(
    path: Path,
    target: Path,
    profile: LensProfile,
    settings: LensSettings,
    wishes: Wishes,
    display: Display,
    on_step: Any,  # noqa: ANN401 - a partial of `_show`
) -> dict[str, Any]:
    if path.stem.endswith(files.CORRECTED):
        raise InvalidInputError("it was corrected already; give the original")
    if target.exists() and not wishes.force:
        return {"state": "kept"}
    seen = files.identity(path)
    why = difference(profile.lens, profile.cameras, seen)
    if why is not None and not (wishes.any_lens or wishes.force):
        raise InvalidInputError(f"{why}; use the profile of its own lens, or add --any-lens")
    if why is not None:
        display.note(f"{path}: {why}; it is corrected all the same, as you asked")
    elif not seen.names_lens:
        display.note(f"{path} does not name its lens; it is taken for a photo of the profile's lens")
    needs_help = not files.says_aperture(path)
    if needs_help and settings.aperture is None:
        display.note(f"{path} does not say its aperture; all apertures of the profile are taken together")
    corrected = pipeline.correct(
        path,
        profile.model,
        target,
        settings=settings if needs_help else LensSettings(),
        method=wishes.method,
        strength=wishes.strength,
        bounds=wishes.bounds,
        lens=_named(profile),
        file_format=wishes.file_format,
        workers=wishes.workers or os.cpu_count() or 1,
        on_step=on_step,
    )
    return {
        "state": "corrected",
        "zones": corrected.zones,
        "nothing_to_correct": corrected.nothing_to_correct,
        "audit": corrected.audit,
    }


def remarks(result: Mapping[str, Any]) -> list[str]:
    """What is worth saying of a corrected photo, in words."""
    if result["nothing_to_correct"]:
        return ["nothing to correct: its pixels stayed as they were"]
    return [*measured(result["zones"]), *audited(result["audit"])]


def measured(zones: Mapping[Zone, deconv.ZoneReport]) -> list[str]:
    """Tell in words what the edges of a chart gained; nothing of any other photo."""
    return [
        f"{zone} of the chart: MTF50 from {seen.mtf50_before:.3f} to {seen.mtf50_after:.3f} cycles/pixel, "
        f"{seen.gain:.1f} times (median of {seen.edges} edges), overshoot {seen.overshoot_after:.1f} %; "
        f"predicted for a usual scene {gain_words(report.expected_gain_db)}"
        for zone, report in zones.items()
        if (seen := report.measured) is not None
    ]


def audited(audit: AuditReport) -> list[str]:
    """Tell in words where the audit held back more than a tenth of the correction."""
    return [
        f"{zone}: {zone_audit.held_back:.0%} of the correction was held back ({', '.join(most)})"
        for zone, zone_audit in audit.zones.items()
        if zone_audit.held_back > HELD
        and (most := sorted(zone_audit.checks, key=lambda name: -zone_audit.checks[name])[:3])
    ]


def _named(profile: LensProfile) -> str:
    """Which lens, and how many photos its profile has seen, for the tag of a corrected photo."""
    words = [profile.lens[key] for key in ("maker", "model") if profile.lens.get(key)]
    count = len(profile.photos)
    return f"{' '.join(words) or 'unknown lens'}, profile of {count} photo{'' if count == 1 else 's'}"


def _show(bars: Progress, task: TaskID, number: int, done: int, total: int) -> None:
    bars.update(task, completed=number + done / max(total, 1))
