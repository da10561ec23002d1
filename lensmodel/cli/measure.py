"""`lensmodel measure` and `lensmodel target`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from lensmodel import measured as measuring
from lensmodel.blind.sampling import configured
from lensmodel.calibration import Admit, Calibration
from lensmodel.cli import files, options
from lensmodel.cli.console import Display, PacedProgress
from lensmodel.cli.ending import UsageError
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample, places_of
from lensmodel.core.types import LensSettings
from lensmodel.photo import develop

KINDS: Final = ("target", "pair", "points", "edges")
# What comes before the first place, by the way of measuring
PREPARING: Final = {
    "target": "finding the page",
    "pair": "aligning the photos",
    "points": "finding the points",
    "edges": "finding the edges",
}
PAPERS: Final = ("a2", "a3", "a4", "letter", "tabloid")
# Default of `target --detail` (chosen): for a page that spans most of a 24-megapixel photo
USUAL_DETAIL: Final = 4000


def measure(
    context: typer.Context,
    kind: Annotated[
        str,
        typer.Argument(
            metavar=f"<{'|'.join(KINDS)}>",
            parser=options.one_of("measure", KINDS),
            help="What the photos show.",
        ),
    ],
    photos: options.Photos,
    profile: options.Profile = None,
    aperture: options.Aperture = None,
    size: Annotated[
        int,
        typer.Option(
            min=9, max=101, metavar="N", callback=options.odd, help="Side of a PSF in pixels, an odd number."
        ),
    ] = 31,
    replace_blind: Annotated[
        bool,
        typer.Option(
            "--replace", help="Drop what was learned blindly at the same aperture and focal length."
        ),
    ] = False,
    any_lens: options.AnyLens = False,
    json_output: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
) -> None:
    """Measure the blur of a lens from photos made for the purpose.

    An existing profile is added to: measured samples stand beside the blind ones and count for more.

    - target: the page that `lensmodel target` prints, photographed flat, nearly filling the frame.

    - pair: one scene from a tripod, wide open and at about f/8. Photos are given in pairs.

    - points: stars, or pinholes in front of a lamp; not saturated.

    - edges: a chart of dark squares or a checkerboard, turned by 5 degrees.

    Examples:

        lensmodel measure target page.dng --profile my-24mm.lensprofile

        lensmodel measure pair open.dng closed.dng --profile my-24mm.lensprofile --replace

    Exit status: 0 all photos were used, 1 some were not, 2 wrong usage.
    """
    shown = Display.of(context, quiet=quiet, verbose=verbose, as_json=json_output)
    target = files.named(profile)
    paths = files.photos(photos)
    files.refuse_photo(target, paths)
    with files.as_usage():
        groups = measuring.measurements_of(kind, paths)
        store = files.ProfileFile(target)
        config = configured(store.model, LensSettings(aperture=aperture))
        calibration = Calibration(store, config, any_lens=any_lens, replace=replace_blind)
    results: list[dict[str, Any]] = []
    with shown.progress(total=len(groups)) as bar:
        for number, group in enumerate(groups):
            on_step = partial(_show_step, bar, group[0].name, kind, number, len(groups))
            on_step(0, 1)
            method = partial(
                measuring.samples_of_developed,
                kind,
                settings=config.settings,
                size=size,
                on_step=on_step,
            )
            try:
                result = _added(calibration, group, method)
            except (LensModelError, OSError) as error:
                result = {"state": "failed", "reason": files.reason(error)}
                shown.error(f"{group[0]}: {result['reason']}")
            results.append({"photos": [str(path) for path in group], **result})
            bar.show(description=f"{group[0].name}: {result['state']}", completed=number + 1)
    shown.document({"profile": str(target) if target.exists() else None, "results": results})
    for result in results:
        if result["state"] == "measured":
            shown.result(
                f"{target}: {result['places']} places measured on {Path(result['photos'][0]).name} "
                f"({result['estimator']}), expected error of a PSF {result['error']:.2f}"
            )
        elif result["state"] == "known":
            shown.note(f"{result['photos'][0]}: the profile has it already")
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _show_step(
    bar: PacedProgress, name: str, kind: str, number: int, photos: int, done: int, total: int
) -> None:
    """Show how far photo `number` is; `done` 0 is before its first place."""
    bar.part(
        number,
        done,
        total,
        description=f"{name}: {'measuring' if done else PREPARING[kind]}",
        # the pace of a single photo is that of its places: reading it and finding the page has another
        more=done == 0 and photos == 1,
    )


def _added(
    calibration: Calibration, group: Sequence[Path], method: Callable[..., list[PsfSample]]
) -> dict[str, Any]:
    """Measure on the photos of one measurement and add to the lens; say what became of it."""
    samples: list[PsfSample] = []

    def measured(key: str, admit: Admit) -> list[PsfSample]:
        first = develop(group[0], on_info=lambda info: admit(info.metadata))
        photos = [first, *map(develop, group[1:])]
        samples.extend(method(photos, photo_id=key))
        return samples

    if calibration.add(group[0], measured) is None:
        return {"state": "known"}
    green = sorted(s.error or 0.0 for s in samples if s.settings.channel == "g") or [1.0]
    return {
        "state": "measured",
        "places": places_of(samples),
        "samples": len(samples),
        "estimator": samples[0].estimator,
        "error": green[len(green) // 2],
    }


def target(
    context: typer.Context,
    output: Annotated[Path, typer.Argument(metavar="FILE", help="Name ending in .pdf.")],
    edges: Annotated[
        bool, typer.Option("--edges", help="35 dark squares, for `lensmodel measure edges`.")
    ] = False,
    paper: Annotated[
        str, options.choice("--paper", PAPERS, "Size of the paper, in landscape orientation.")
    ] = "a3",
    detail: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Samples along the long side: 1000, 1400, 2000, 2800, 4000 or 5600. Choose the one nearest "
            "to the number of pixels that the page will span in the photo.",
        ),
    ] = USUAL_DETAIL,
    force: options.Force = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
) -> None:
    """Write the page to print for `lensmodel measure target`, or with --edges for `measure edges`.

    Print it at full size on matte paper, in grey, without sharpening; fix it flat.

    Examples:

        lensmodel target target.pdf

        lensmodel target target.pdf --paper a4 --detail 2800

        lensmodel target squares.pdf --edges --paper letter

    Exit status: 0 written, 1 failed, 2 wrong usage.
    """
    # takes long
    from lensmodel.measured import DETAILS, TargetPage, print_chart, print_target  # noqa: PLC0415

    shown = Display.of(context, quiet=quiet, verbose=verbose)
    if detail not in DETAILS:
        raise UsageError(f"--detail must be one of {', '.join(map(str, DETAILS))}, got {detail}")
    if output.is_dir():
        raise UsageError(f"{output} is a folder; name a file ending in .pdf")
    files.refuse_existing(output, force=force)
    with files.as_usage():
        if edges:
            print_chart(output, paper=paper)
        else:
            print_target(output, TargetPage(detail), paper=paper)
    shown.result(str(output))
