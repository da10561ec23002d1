"""Corrected files: what they are called, and how one is made, whichever way the command goes."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import lensmodel
from lensmodel.api import FORMATS, SEEN_DB
from lensmodel.cli import files
from lensmodel.cli.console import Display, PacedProgress, gain_words
from lensmodel.cli.ending import UsageError
from lensmodel.core.errors import (
    InvalidInputError,
    LensModelError,
    NotEnoughEvidenceError,
    UnreadablePhotoError,
)
from lensmodel.core.types import ZONE_WORDS, StepHook
from lensmodel.correction.audit import HELD
from lensmodel.lens import Lens
from lensmodel.model.identity import Identity, difference
from lensmodel.photo import OutputFormat, inspect
from lensmodel.photo.values import CORRECTED, PhotoMetadata

EXTENSION: Final[dict[OutputFormat | None, str]] = {None: ".tif", "tiff32": ".tif", "png8": ".png"} | {
    written: ending for ending, written in reversed(FORMATS.items())
}

FOLDER: Final = "corrected"  # Default folder of results, beside the photos
# Expected error of the PSFs from which on a small gain is for want of knowledge (chosen)
_UNSURE: Final = 0.5
_SAID: Final = 3  # photos of a group that are left for one reason and named (chosen); -v names all


def targets_of(
    paths: Sequence[Path], output: str | None, file_format: OutputFormat | None
) -> tuple[dict[Path, Path], dict[Path, list[Path]]]:
    """Return the file that each photo becomes; and the files that several would become, with these.

    `output` is that file itself where there is one photo and the name ends as a picture's does; where it ends
    in a separator or is a folder already, it is a folder.
    """
    extension = EXTENSION[file_format]
    if output is not None and len(paths) == 1 and _names_a_picture(output):
        target = Path(output).expanduser()
        if file_format is not None and EXTENSION[FORMATS[target.suffix.lower()]] != extension:
            raise UsageError(f"{target.name} is no name for --format {file_format}; end it in {extension}")
        return {paths[0]: target}, {}
    sources: dict[Path, list[Path]] = {}
    for path in paths:
        folder = path.parent / FOLDER if output is None else Path(output).expanduser()
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"{folder} is a file; give a folder to -o")
        sources.setdefault(folder / f"{path.stem}{CORRECTED}{extension}", []).append(path)
    twice = {target: group for target, group in sources.items() if len(group) > 1}
    return {group[0]: target for target, group in sources.items() if len(group) == 1}, twice


def _names_a_picture(output: str) -> bool:
    return (
        Path(output).suffix.lower() in FORMATS
        and not output.endswith(tuple(filter(None, (os.sep, os.altsep))))
        and not Path(output).expanduser().is_dir()
    )


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


@dataclass(frozen=True, slots=True)
class Correction:
    """What a run of the command is to do with its photos."""

    targets: Mapping[Path, Path]  # which file each photo becomes
    options: Mapping[str, Any]  # of `lensmodel.correct`
    sorted: bool  # by their lens; only those that gain are corrected
    any_lens: bool
    force: bool
    display: Display
    refused: dict[Path, LensModelError | OSError] = field(default_factory=dict)  # photos that taught nothing

    def photos(
        self,
        paths: Sequence[Path],
        lens: Lens | None,
        bar: PacedProgress,
        *,
        begin: int = 0,
        more: bool = False,
    ) -> list[dict[str, Any]]:
        """Correct the photos of a lens, one after the other; return what became of each, and tell it."""
        results: list[dict[str, Any]] = []
        tell = self.display.detail if self.sorted else self.display.note
        left: Counter[str] = Counter()
        for number, path in enumerate(paths, start=begin):
            bar.show(description=f"correcting {path.name}", more=more)
            target = self.targets[path]
            result = self._photo(path, target, lens, partial(bar.part, number, more=more))
            match result["state"]:
                case "failed":
                    self.display.error(f"{path}: {result['reason']}")
                case "left":
                    left[result["reason"]] += 1
                    few = left[result["reason"]] <= _SAID
                    (self.display.note if few else tell)(f"{path}: left as it is: {result['reason']}")
                case "kept":
                    tell(f"{target} is there already and was left alone; --force replaces it")
                case _:
                    if self.sorted:
                        tell(f"{target}: {gain_words(result['expected_gain_db'])} expected")
                    else:
                        self.display.result(str(target))
                    for remark in _remarks(result):
                        tell(f"{path.name}, {remark}")
            results.append({"photo": str(path), "output": str(target), **result})
            bar.show(completed=number + 1, more=more)
        return results

    def _photo(self, path: Path, target: Path, lens: Lens | None, on_step: StepHook) -> dict[str, Any]:
        """Correct one photo; return what became of it: `corrected`, `kept`, `left` or `failed`."""
        refused = self.refused.get(path)
        little = refused is None or isinstance(refused, NotEnoughEvidenceError)
        if isinstance(refused, UnreadablePhotoError) or (lens is None and refused is not None and not little):
            return files.failed(refused)
        if lens is None:
            return {"state": "left", "reason": "no photo of its lens shows enough to learn the blur from"}
        try:
            if path.stem.endswith(CORRECTED):
                raise InvalidInputError("it was corrected already; give the original")
            if target.exists() and not self.force:
                return {"state": "kept"}
            info = inspect(path)
            self._require_lens(path, info.metadata, lens)
            target.parent.mkdir(parents=True, exist_ok=True)
            lossy = info.kind == "jpeg"
            least = SEEN_DB if self.sorted or (lossy and not self.force) else None
            corrected = lensmodel.correct(
                path, lens, target, least_gain_db=least, on_step=on_step, **self.options
            )
        except (LensModelError, OSError) as error:
            return files.failed(error)
        result = {
            "state": "corrected",
            "expected_gain_db": corrected.expected_gain_db,
            "zones": corrected.zones,
            "nothing_to_correct": corrected.nothing_to_correct,
            "audit": corrected.audit,
            "chroma_step": corrected.chroma_step,
        }
        if least is not None and corrected.expected_gain_db < least:
            insist = "" if self.sorted else "; --force corrects it all the same"
            result |= {"state": "left", "reason": f"{_why_left(corrected, lossy=lossy)}{insist}"}
        return result

    def _require_lens(self, path: Path, said: PhotoMetadata, lens: Lens) -> None:
        """Refuse a photo of another lens, unless it is asked for; tell what the photo does not say."""
        identity = Identity.of(said)
        why = difference(Identity.of_profile(lens.profile), identity)
        if why is not None and not (self.any_lens or self.force):
            raise InvalidInputError(
                f"it seems to be of another lens: {why}; use the profile of its own lens, or add --any-lens"
            )
        if why is not None:
            self.display.note(
                f"{path}: it seems to be of another lens: {why}; it is corrected all the same, as you asked"
            )
        elif not identity.names_lens and not self.sorted:  # else it was sorted by its camera
            self.display.note(f"{path} does not name its lens; it is taken for a photo of the profile's lens")
        if self.options["aperture"] is None and said.aperture is None:
            self.display.note(
                f"{path} does not say its aperture; all apertures of the profile are taken together"
            )


def _why_left(corrected: lensmodel.Corrected, *, lossy: bool) -> str:
    """Say in a sentence why a photo is not worth correcting."""
    zones = corrected.zones.values()
    error = sum(zone.cells * zone.psf_error for zone in zones) / max(sum(zone.cells for zone in zones), 1)
    why = (
        "not enough is known about its lens yet; take more photos that are full of detail"
        if error > _UNSURE
        else "the camera has sharpened and compressed it, and no more can be restored safely"
        if lossy
        else "at this aperture the lens is about as sharp as its pixels, or the photo shows little detail"
    )
    return f"a correction would gain too little to be seen (less than {SEEN_DB:g} dB): {why}"


def _remarks(result: Mapping[str, Any]) -> Iterator[str]:
    """Say where nothing was done, where the audit held back more than a tenth, and where colour is coarse."""
    if result["nothing_to_correct"]:
        yield "nothing to correct: its pixels stayed as they were"
        return
    for zone, audit in result["audit"].zones.items():
        if audit.held_back > HELD and audit.checks:
            most = sorted(audit.checks, key=lambda name: -audit.checks[name])[:3]
            part = f"{audit.held_back:.0%} of the correction was held back"
            yield f"{ZONE_WORDS[zone]}: {part} ({', '.join(most)})"
    rows, cols = result["chroma_step"]
    if max(rows, cols) > 1:
        yield (
            f"the JPEG stores one colour for {rows} x {cols} pixels: "
            "brightness is corrected pixel by pixel, colour no more finely than that"
        )
