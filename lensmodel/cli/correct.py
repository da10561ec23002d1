"""`lensmodel correct`: remove the blur of a lens from photos, by its profile or one learned from them."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

import typer

import lensmodel
from lensmodel.api import FORMATS, SEEN_DB, Calibration
from lensmodel.blind.sampling import CalibrationEvent, configured
from lensmodel.cli import console, files
from lensmodel.cli.console import Display, UsageError, gain_words, reason
from lensmodel.core.errors import InvalidInputError, LensModelError, NotEnoughEvidenceError
from lensmodel.core.names import camera_name, name_key, serial_key
from lensmodel.core.types import LensSettings, StepHook
from lensmodel.correction import Bounds, deconvolvers
from lensmodel.lens import Lens
from lensmodel.model.identity import SAME_FOCAL, Identity, difference
from lensmodel.photo import OutputFormat, PhotoMetadata, inspect
from lensmodel.photo.values import CORRECTED

EXTENSION: Final[dict[OutputFormat | None, str]] = {None: ".tif", "tiff32": ".tif", "png8": ".png"} | {
    written: ending for ending, written in reversed(FORMATS.items())
}
FOLDER: Final = "corrected"  # Default folder of results, beside the photos
PROFILES: Final = "lenses"
# Photos that a group is learned from: five are the advice (docs/guide.md), three more for other apertures
# (chosen); each takes about a minute
LEARN_FROM: Final = 8
# Expected error of the PSFs from which on a small gain is for want of knowledge (chosen)
_UNSURE: Final = 0.5
# Facts of a corrected photo that its result repeats
_FOUND: Final = ("expected_gain_db", "zones", "nothing_to_correct", "audit", "chroma_step")
# options that few people need, in panels of their own
learning = partial(typer.Option, rich_help_panel="Learning (--lens auto)")
correcting = partial(typer.Option, rich_help_panel="Correcting")


def correct(
    photos: console.Photos,
    profile: Annotated[
        Path | None, typer.Option("--profile", "-p", help="The profile of their lens.")
    ] = None,
    lens: Annotated[
        Literal["auto"] | None,
        typer.Option(help="auto: sort the photos by lens, learn each, and correct those that visibly gain."),
    ] = None,
    output: Annotated[
        str | None,
        console.output("A folder, or for one photo a file; default: a folder `corrected` beside each photo."),
    ] = None,
    strength: Annotated[float, typer.Option(min=0.0, max=1.0, help="1: all that the noise allows.")] = 1.0,
    file_format: Annotated[
        OutputFormat | None, typer.Option("--format", help="Default: by the name after -o, else tiff16.")
    ] = None,
    aperture: console.Aperture = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace existing files; correct JPEGs whatever they gain.")
    ] = False,
    any_lens: console.AnyLens = False,
    keep_location: Annotated[
        bool, typer.Option("--keep-location", help="Keep where the photo was taken (GPS).")
    ] = False,
    workers: console.Workers = None,
    json_output: console.Json = False,
    quiet: console.Quiet = False,
    verbose: console.Verbose = 0,
    profiles: Annotated[
        Path | None, learning(help="Folder of lens profiles; default: `lenses` in the output.")
    ] = None,
    learn_from: Annotated[
        int, learning(min=1, help="Most photos that a group is learned from.")
    ] = LEARN_FROM,
    method: Annotated[
        str | None, correcting(help=f"{', '.join(deconvolvers)}; default: as the lens was learned.")
    ] = None,
    halo: Annotated[
        float | None,
        correcting(
            help="How far results may exceed the photo's own range beside edges, as a share of it: 0 not at "
            "all, inf without limit. Default: less, the less certain the profile is."
        ),
    ] = None,
    texture: Annotated[float, correcting(help="Share of its faint texture that a photo keeps.")] = 1.0,
    denoise: Annotated[float, correcting(help="Share of the photo's grain to take away.")] = 0.0,
) -> None:
    """Remove the blur of the lens from photos.

    Corrected photos are new files, NAME-corrected; the photos themselves are never changed. Files that
    are already there are left alone, so a run that was stopped can be started again and goes on from
    there. No file is ever half written. The names of the written files go to standard output; with
    --lens auto it is one line per lens instead, and -v reports on every photo.

    Examples:

        lensmodel correct holiday --lens auto

        lensmodel correct holiday --profile my-24mm.lensprofile -o corrected

        lensmodel correct one.dng --profile my-24mm.lensprofile -o linear --format dng --method fast --json

    Exit status: 0 done, 1 some photos failed, 2 wrong usage.
    """
    shown = Display(quiet=quiet, verbose=verbose, as_json=json_output)
    if (profile is None) == (lens is None):
        raise UsageError(
            "give --profile FILE, or --lens auto to learn the lens from these photos; one of them"
        )
    targets = targets_of(files.photos(photos, shown.note), output, file_format)
    with files.as_usage():  # before any work
        if method is not None:
            deconvolvers.create(method)
        LensSettings(aperture=aperture)
        given = {
            "aperture": aperture,
            "method": method,
            "strength": strength,
            "bounds": Bounds(halo, texture, denoise),
            "file_format": file_format,
            "keep_location": keep_location,
            "workers": workers,
        }
    correction = Correction(targets, given, profile is None, any_lens, force, shown)
    if profile is None:
        profiles = profiles or next(iter(targets.values())).parent / PROFILES
        document = correct_groups(correction, profiles, learn_from)
    else:
        known = files.profile_at(profile)
        document = {"profile": str(profile), "results": correction.photos(list(targets), known)}
    shown.document(document)
    if any(result["state"] == "failed" for result in document["results"]):
        raise typer.Exit(1)


def targets_of(
    paths: Sequence[Path], output: str | None, file_format: OutputFormat | None
) -> dict[Path, Path]:
    """Return the file that each photo becomes.

    `output` is that file itself where there is one photo and the name ends as a picture's does; where it ends
    in a separator or is a folder already, it is a folder.
    """
    extension, named = EXTENSION[file_format], Path(output or FOLDER)
    a_file = named.suffix.lower() in FORMATS and not (named.is_dir() or str(output).endswith(os.sep))
    if len(paths) == 1 and a_file:
        if file_format is not None and EXTENSION[FORMATS[named.suffix.lower()]] != extension:
            raise UsageError(f"{named.name} is no name for --format {file_format}; end it in {extension}")
        return {paths[0]: named}
    if output is not None and named.is_file():
        raise UsageError(f"{named} is a file; give a folder to -o")
    folders = {path: path.parent / FOLDER if output is None else named for path in paths}
    return {path: folder / f"{path.stem}{CORRECTED}{extension}" for path, folder in folders.items()}


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

    def photos(self, paths: Sequence[Path], lens: Lens | None) -> list[dict[str, Any]]:
        """Correct the photos of a lens, one after the other; return what became of each, and tell it."""
        results: list[dict[str, Any]] = []
        display, reasons = self.display, set[str]()
        tell = display.detail if self.sorted else display.note
        with display.progress(total=len(paths)) as bar:
            for number, path in enumerate(paths):
                bar.show(description=f"correcting {path.name}")
                target = self.targets[path]
                result = self._photo(path, target, lens, partial(bar.part, number))
                match result["state"]:
                    case "failed":
                        display.error(f"{path}: {result['reason']}")
                    case "left":  # of the photos of a lens, the first for each reason is named
                        known = result["reason"] in reasons
                        (tell if known else display.note)(f"{path}: left as it is: {result['reason']}")
                        reasons.add(result["reason"])
                    case "kept":
                        tell(f"{target} is there already and was left alone; --force replaces it")
                    case _:
                        if self.sorted:
                            tell(f"{target}: {gain_words(result['expected_gain_db'])} expected")
                        else:
                            display.result(str(target))
                        if result["nothing_to_correct"]:
                            tell(f"{path.name}: nothing to correct, its pixels stayed as they were")
                results.append({"photo": str(path), "output": str(target), **result})
                bar.show(number + 1)
        return results

    def _photo(self, path: Path, target: Path, lens: Lens | None, on_step: StepHook) -> dict[str, Any]:
        """Correct one photo; return what became of it: `corrected`, `kept`, `left` or `failed`."""
        if lens is None:
            refused = self.refused.get(path)
            if refused is not None and not isinstance(refused, NotEnoughEvidenceError):
                return files.failed(refused)
            return {"state": "left", "reason": "no photo of its lens shows enough to learn the blur from"}
        try:
            if path.stem.endswith(CORRECTED):
                raise InvalidInputError("it was corrected already; give the original")
            if list(self.targets.values()).count(target) > 1:
                raise InvalidInputError(
                    f"another photo would become {target} too; correct them into different folders"
                )
            if target.exists() and not self.force:
                return {"state": "kept"}
            info = inspect(path)
            self._require_lens(path, info.metadata, lens)
            target.parent.mkdir(parents=True, exist_ok=True)
            least = SEEN_DB if self.sorted or (info.kind == "jpeg" and not self.force) else None
            corrected = lensmodel.correct(
                path, lens, target, least_gain_db=least, on_step=on_step, **self.options
            )
        except (LensModelError, OSError) as error:
            return files.failed(error)
        result = {"state": "corrected", **{name: getattr(corrected, name) for name in _FOUND}}
        if least is not None and corrected.expected_gain_db < least:
            insist = "" if self.sorted else "; --force corrects it all the same"
            result |= {"state": "left", "reason": f"{_why_left(corrected)}{insist}"}
        return result

    def _require_lens(self, path: Path, said: PhotoMetadata, lens: Lens) -> None:
        """Refuse a photo of another lens, unless it is asked for; tell what the photo does not say."""
        identity, note = Identity.of(said), self.display.note
        if why := difference(lens.identity, identity):
            why = f"it seems to be of another lens: {why}"
            if not (self.any_lens or self.force):
                raise InvalidInputError(f"{why}; use the profile of its own lens, or add --any-lens")
            note(f"{path}: {why}; it is corrected all the same, as you asked")
        elif not identity.names_lens and not self.sorted:  # else it was sorted by its camera
            note(f"{path} does not name its lens; it is taken for a photo of the profile's lens")
        if self.options["aperture"] is None and said.aperture is None:
            note(f"{path} does not say its aperture; all apertures of the profile are taken together")


def _why_left(corrected: lensmodel.Corrected) -> str:
    """Say in a sentence why a photo is not worth correcting."""
    zones = corrected.zones.values()
    error = sum(zone.cells * zone.psf_error for zone in zones) / max(sum(zone.cells for zone in zones), 1)
    why = (
        "not enough is known about its lens yet; take more photos that are full of detail"
        if error > _UNSURE
        else "at this aperture the lens is about as sharp as its pixels, the photo shows little detail, or "
        "the camera has compressed it"
    )
    return f"a correction would gain too little to be seen (less than {SEEN_DB:g} dB): {why}"


# --- photos sorted by their lens ---------------------------------------------------------------

# Photos at the same settings that follow each other within this time show the same (chosen)
BURST: Final = timedelta(seconds=2)
# Characters of a file name (chosen): file systems take 255 bytes, and the ending needs some
MOST_IN_NAME: Final = 80


class Shot(NamedTuple):
    """One photo and what its file says."""

    path: Path
    metadata: PhotoMetadata
    half_diagonal_mm: float = 0.0

    @classmethod
    def of(cls, path: Path) -> Shot:
        """Read the header of a photo."""
        info = inspect(path)
        pitch_mm = (info.metadata.pixel_pitch_um or 0.0) / 1000.0
        return cls(path, info.metadata, pitch_mm * math.hypot(info.width, info.height) / 2.0)

    @property
    def owner(self) -> tuple[str, ...]:
        """What two photos of one copy of a lens agree in: its serial, or that of the body it was on."""
        said = self.metadata
        lens = (name_key(said.lens.model), serial_key(said.lens.serial))
        body = () if said.lens.serial else (name_key(said.camera_model), serial_key(said.body_serial))
        return lens + body

    @property
    def focal_mm(self) -> float:
        """The focal length, 0 where the file does not say it."""
        return self.metadata.focal_mm or 0.0


@dataclass(frozen=True, slots=True)
class PhotoGroup:
    """Photos of one lens, of one body where the lens has no serial, and of about one focal length."""

    shots: tuple[Shot, ...]  # by name; at least one
    # Of the lens profile that the group belongs to, without an ending. A lens that the files name has one for
    # all its focal lengths, since a profile tells them apart; photos that name no lens may be of as many
    # lenses as there are focal lengths.
    name: str

    @property
    def words(self) -> dict[str, str]:
        """Bodies, lens and focal length in words; its serial shortened, as people show them around."""
        said = [shot.metadata for shot in self.shots]
        cameras = (camera_name(one.camera_maker, one.camera_model) or "unknown camera" for one in said)
        lens, known = said[0].lens, [shot.focal_mm for shot in self.shots if shot.focal_mm]
        ends = dict.fromkeys(f"{end(known):.3g}" for end in (min, max)) if known else ()
        return {
            "camera": ", ".join(dict.fromkeys(cameras)),
            "lens": (lens.model or "unknown lens") + (f" #{lens.serial[-4:]}" if lens.serial else ""),
            "focal_length": f"{'-'.join(ends)} mm" if known else "unknown focal length",
        }

    def to_learn_from(self) -> tuple[list[Path], int]:
        """Return the photos in the order in which they tell most, and how many different things they show.

        Each aperture's first one comes before any second, a photo whose aperture is unknown last in its turn;
        later frames of a burst, which show the same, come after all.
        """
        repeated, turns = set[Path](), Counter[tuple[bool, float]]()
        last: dict[tuple[float | None, float], datetime] = {}
        timed = [(shot.metadata.taken_at, shot.path, shot) for shot in self.shots if shot.metadata.taken_at]
        for time, path, shot in sorted(timed, key=lambda each: each[:2]):
            settings = shot.metadata.aperture, shot.focal_mm
            if settings in last and time - last[settings] <= BURST:
                repeated.add(path)
            last[settings] = time
        order = []
        # a smaller frame is the middle of what the lens draws: the largest ones tell of all of it
        for shot in sorted(self.shots, key=lambda shot: -round(shot.half_diagonal_mm)):
            again, aperture = shot.path in repeated, shot.metadata.aperture or math.inf
            order.append((again, turns[again, aperture], aperture, shot.path))
            turns[again, aperture] += 1
        return [path for *_, path in sorted(order)], len(order) - len(repeated)


def groups(shots: Iterable[Shot]) -> list[PhotoGroup]:
    """Sort photos by body, lens and focal length; lengths within `SAME_FOCAL` of the shortest are one."""
    runs: list[tuple[str, list[Shot]]] = []
    for shot in sorted(shots, key=lambda shot: (shot.owner, shot.focal_mm)):
        name, run = runs[-1] if runs else ("", [])
        same = bool(run) and run[0].owner == shot.owner
        if same and shot.focal_mm <= run[0].focal_mm * SAME_FOCAL:
            run.append(shot)
            continue
        names_lens = Identity.of(shot.metadata).names_lens
        if not (same and names_lens):
            name = _name(shot.metadata, {taken for taken, _ in runs}, focal=not names_lens)
        runs.append((name, [shot]))
    return [PhotoGroup(tuple(sorted(run, key=lambda shot: shot.path)), name) for name, run in runs]


def _name(said: PhotoMetadata, taken: Collection[str], *, focal: bool) -> str:
    """Name a profile; two copies whose serials end alike get a number."""
    length = f"{said.focal_mm:g}mm" if said.focal_mm and focal else None
    words = [said.camera_model, said.lens.model, said.lens.serial and said.lens.serial[-4:], length]
    plain = re.sub(r"[^\w.+-]+", "-", "-".join(word for word in words if word)).strip("-.")
    name = plain[:MOST_IN_NAME] or "unknown-camera"
    numbered = (f"{name}-{number}" for number in count(2))
    return next(free for free in chain([name], numbered) if free not in taken)


def correct_groups(correction: Correction, profiles: Path, most: int) -> dict[str, Any]:
    """Learn the lens of each group from `most` photos, correct those that gain, and tell of each."""
    shots: list[Shot] = []
    results: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    display = correction.display
    for path in correction.targets:
        try:
            shots.append(Shot.of(path))
        except (LensModelError, OSError) as error:
            results.append({"photo": str(path), "output": None, **files.failed(error)})
            display.error(f"{path}: {reason(error)}")
    lens_groups = [(group, profiles / f"{group.name}.lensprofile") for group in groups(shots)]
    # those of a zoom have one profile: all are learned before any is corrected
    learned = [_learn(group, profile, most, correction) for group, profile in lens_groups]
    for (group, profile), number in zip(lens_groups, learned, strict=True):
        lens = files.profile_at(profile) if profile.exists() else None
        done = correction.photos([shot.path for shot in group.shots], lens)
        results += done
        states = Counter(result["state"] for result in done)
        gains = [result["expected_gain_db"] for result in done if result["state"] == "corrected"]
        gain = sum(gains) / len(gains) if gains else None
        counts = {
            "photos": len(done),
            "learned_from": number,
            "corrected": states["corrected"],
            "corrected_before": states["kept"],
            "left": states["left"],
            "failed": states["failed"],
        }
        where = None if lens is None else str(profile)
        rows.append({**group.words, "profile": where, **counts, "expected_gain_db": gain})
        said = ", ".join(f"{name.replace('_', ' ')} {number}" for name, number in counts.items())
        names = ", ".join(group.words.values())
        display.result(f"{names}: {said}, expected gain {gain_words(gain)}")
        if number == 1:
            display.note(
                "it was learned from one photo; with five or more its blur is known better, and scenes do not"
                " pass for it"
            )
    if any(row["corrected"] for row in rows):
        where = ", ".join(sorted({str(target.parent) for target in correction.targets.values()}))
        display.note(f"corrected photos are in {where}, lens profiles in {profiles}")
    return {"groups": rows, "results": results}


def _learn(group: PhotoGroup, profile: Path, most: int, correction: Correction) -> int:
    """Learn the lens of a group; return from how many photos, now or in an earlier run."""
    display, counted = correction.display, 0
    paths, scenes = group.to_learn_from()
    most = min(most, scenes)
    store = files.ProfileFile(profile)
    config = configured(store.model, LensSettings(aperture=correction.options["aperture"]))
    calibration = Calibration(store, config, any_lens=correction.any_lens)
    with display.progress("learning", total=most) as bar:

        def on_event(event: CalibrationEvent) -> None:
            bar.part(counted, event.done, event.total, f"learning from {event.photo.name}: {event.stage}")

        for event in calibration.learn(paths, on_event=on_event):
            if event.error is None:
                counted += 1
            else:
                correction.refused[event.photo] = event.error
                display.detail(f"{event.photo}: {event.error}")
            if counted == most:
                break
    refused = [correction.refused.get(path) for path in paths]
    if not counted and all(isinstance(error, NotEnoughEvidenceError) for error in refused):
        what = f"{group.words['lens']}, {group.words['focal_length']}"
        display.note(f"{what}: no photo shows enough to learn its blur from ({refused[0]})")
    return counted
