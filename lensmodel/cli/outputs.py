"""Corrected files: what they are called, and how one is made, whichever way the command goes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import lensmodel
from lensmodel import correction
from lensmodel.api import FORMATS
from lensmodel.cli import files
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.types import ZONE_WORDS, LensSettings, StepHook
from lensmodel.correction.audit import HELD, AuditReport
from lensmodel.photo import OutputFormat, inspect
from lensmodel.photo.values import CORRECTED
from lensmodel.workflow.calibrating import Identity, difference
from lensmodel.workflow.lens import Lens

EXTENSION: Final[dict[OutputFormat | None, str]] = {
    None: ".tif",
    "tiff16": ".tif",
    "tiff32": ".tif",
    "png16": ".png",
    "png8": ".png",
    "jpeg": ".jpg",
    "dng": ".dng",
}

FOLDER: Final = "corrected"  # Default folder of results, beside the photos


@dataclass(frozen=True, slots=True)
class CorrectionOptions:
    """The options of the command."""

    aperture: float | None
    method: str | None
    strength: float
    bounds: correction.Bounds
    file_format: OutputFormat | None
    workers: int | None
    any_lens: bool
    force: bool
    least_gain_db: float | None = None
    keep_location: bool = False


def targets_of(
    paths: Sequence[Path], output: str | None, file_format: OutputFormat | None
) -> tuple[dict[Path, Path], dict[Path, list[Path]]]:
    """Return the photos by the file that each becomes; and those of which several would become the same.

    `output` is that file itself where there is one photo and the name ends as a picture's does; where it ends
    in a separator or is a folder already, it is a folder.
    """
    extension = EXTENSION[file_format]
    if output is not None and len(paths) == 1 and _names_a_picture(output):
        target = Path(output).expanduser()
        named = EXTENSION[FORMATS[target.suffix.lower()]]
        if file_format is not None and named != extension:
            raise UsageError(f"{target.name} is no name for --format {file_format}; end it in {extension}")
        return {target: paths[0]}, {}
    sources: dict[Path, list[Path]] = {}
    for path in paths:
        folder = path.parent / FOLDER if output is None else Path(output).expanduser()
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"{folder} is a file; give a folder to -o")
        sources.setdefault(folder / f"{path.stem}{CORRECTED}{extension}", []).append(path)
    twice = {target: group for target, group in sources.items() if len(group) > 1}
    return {target: group[0] for target, group in sources.items() if target not in twice}, twice


def clashes(twice: Mapping[Path, Sequence[Path]], display: Display) -> list[dict[str, Any]]:
    """Tell which photos would become the same file; return a failed result for each of them."""
    results = []
    for target, paths in twice.items():
        why = (
            f"{' and '.join(map(str, paths))} would {'both' if len(paths) == 2 else 'all'} become {target}; "
            "name each by itself, and correct them into different folders"
        )
        display.error(why)
        failed = files.failed(InvalidInputError(why))
        results += [{"photo": str(path), "output": str(target), **failed} for path in paths]
    return results


def _names_a_picture(output: str) -> bool:
    return (
        Path(output).suffix.lower() in FORMATS
        and not output.endswith(tuple(filter(None, (os.sep, os.altsep))))
        and not Path(output).expanduser().is_dir()
    )


def check(options: CorrectionOptions) -> None:
    """Refuse a method or an aperture that there is not, before any work."""
    with files.as_usage():
        if options.method is not None:
            correction.deconvolvers.create(options.method)
        LensSettings(aperture=options.aperture)


def correct_one(
    path: Path,
    target: Path,
    lens: Lens,
    options: CorrectionOptions,
    display: Display,
    on_step: StepHook,
    siblings: Iterable[Path] = (),
) -> dict[str, Any]:
    """Correct one photo; return what became of it: `corrected`, `kept`, `left` or `failed`."""
    try:
        return _corrected(path, target, lens, options, display, on_step, siblings)
    except (LensModelError, OSError) as error:
        return files.failed(error)


def _corrected(
    path: Path,
    target: Path,
    lens: Lens,
    options: CorrectionOptions,
    display: Display,
    on_step: StepHook,
    siblings: Iterable[Path],
) -> dict[str, Any]:
    if path.stem.endswith(CORRECTED):
        raise InvalidInputError("it was corrected already; give the original")
    if target.exists() and not options.force:
        return {"state": "kept"}
    said = inspect(path).metadata
    identity = Identity.of(said)
    why = difference(lens.profile.lens, lens.profile.cameras, identity)
    if why is not None and not (options.any_lens or options.force):
        raise InvalidInputError(f"{why}; use the profile of its own lens, or add --any-lens")
    if why is not None:
        display.note(f"{path}: {why}; it is corrected all the same, as you asked")
    elif not identity.names_lens and options.least_gain_db is None:  # else it was sorted by its camera
        display.note(f"{path} does not name its lens; it is taken for a photo of the profile's lens")
    if options.aperture is None and said.aperture is None:
        display.note(f"{path} does not say its aperture; all apertures of the profile are taken together")
    target.parent.mkdir(parents=True, exist_ok=True)
    corrected = lensmodel.correct(
        path,
        lens,
        target,
        aperture=options.aperture,
        method=options.method,
        strength=options.strength,
        bounds=options.bounds,
        file_format=options.file_format,
        least_gain_db=options.least_gain_db,
        keep_location=options.keep_location,
        workers=options.workers,
        siblings=siblings,
        on_step=on_step,
    )
    gain = corrected.expected_gain_db
    left = options.least_gain_db is not None and gain < options.least_gain_db
    return {
        "state": "left" if left else "corrected",
        "expected_gain_db": gain,
        "zones": corrected.zones,
        "nothing_to_correct": corrected.nothing_to_correct,
        "audit": corrected.audit,
        "chroma_step": corrected.chroma_step,
    }


def say(
    path: Path, target: Path, result: Mapping[str, Any], display: Display, tell: Callable[[str], None]
) -> None:
    """Tell what became of a photo, but for the name of the file that was written."""
    if result["state"] == "failed":
        display.error(f"{path}: {result['reason']}")
    elif result["state"] == "left":
        tell(f"{path}: left as it is: {result['reason']}")
    elif result["state"] == "kept":
        tell(f"{target} is there already and was left alone; --force replaces it")
    elif result["nothing_to_correct"]:
        tell(f"{path.name}, nothing to correct: its pixels stayed as they were")
    else:
        for line in (*audited(result["audit"]), *colour_remarks(result["chroma_step"])):
            tell(f"{path.name}, {line}")


def colour_remarks(step: tuple[int, int]) -> list[str]:
    """Tell in words where a file stores colour too coarsely to be corrected pixel by pixel."""
    if max(step) == 1:
        return []
    return [
        f"the JPEG stores one colour for {step[0]} x {step[1]} pixels: "
        "brightness is corrected pixel by pixel, colour no more finely than that"
    ]


def audited(audit: AuditReport) -> list[str]:
    """Tell in words where the audit held back more than a tenth of the correction."""
    return [
        f"{ZONE_WORDS[zone]}: {zone_audit.held_back:.0%} of the correction was held back ({', '.join(most)})"
        for zone, zone_audit in audit.zones.items()
        if zone_audit.held_back > HELD
        and (most := sorted(zone_audit.checks, key=lambda name: -zone_audit.checks[name])[:3])
    ]
