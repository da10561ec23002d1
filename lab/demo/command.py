"""`lensmodel demo`."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import Annotated, Final

import typer

from lensmodel import blind
from lensmodel.cli import files
from lensmodel.cli.calibrate import Estimator
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.cli.options import Quiet, Verbose
from lensmodel.core.files import write_atomically

MARKER: Final = ".lensmodel-demo.json"
"""Lists the files that a demo wrote into its folder, each with its SHA-256."""


def demo(
    context: typer.Context,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the pictures and the report.")
    ] = Path("demo-output"),
    estimator: Estimator = "default",
    json_output: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Use a folder that holds other files too.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Run the whole process on a real RAW file and on a simulated lens whose true blur is known.

    Starts a service of its own, uploads photos, calibrates their lens, corrects a photo, measures,
    and stops the service: about six minutes on two cores. What an earlier demo left in the folder
    is renewed; a folder with anything else in it is refused without --force.

    Example:

        lensmodel demo --output demo-output

    Exit status: 0 the figures show an improvement, 1 they do not or something failed, 2 called wrongly.
    """
    shown = Display.of(context, quiet=quiet, verbose=verbose)
    with files.as_usage():
        blind.estimators.create(estimator)
    _refuse_what_others_wrote(output, force=force)
    from lab.demo.run import run  # noqa: PLC0415 - only this command needs the simulation

    before = _digests(output)
    began = time.monotonic()
    try:
        improved = run(
            output,
            lambda text, left: shown.progress_line(text, time.monotonic() - began, left),
            estimator=estimator,
        )
    finally:
        _mark(output, before)
    if json_output:
        shown.document(json.loads((output / "report.json").read_text(encoding="utf-8")))
    else:
        shown.result((output / "report.md").read_text(encoding="utf-8"))
    if not improved:
        shown.error("the corrected photo did not become better; see the report")
        raise typer.Exit(1)


def _refuse_what_others_wrote(folder: Path, *, force: bool) -> None:
    """Make sure that nothing is replaced but what an earlier demo wrote and nobody changed since."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; give a folder to -o")
    if force or not folder.is_dir():
        return
    ours = _marked(folder)
    for path in sorted(folder.iterdir()):
        if path.name != MARKER and (path.is_dir() or ours.get(path.name) != _digest(path)):
            raise UsageError(
                f"{path} is not as a demo left it; give a new folder to -o, or --force, which may replace it"
            )


def _mark(folder: Path, before: dict[str, str]) -> None:
    """Note what is the demo's: what it noted earlier, and what changed since `before`."""
    if not folder.is_dir():
        return
    earlier = _marked(folder)
    ours = {
        name: digest
        for name, digest in _digests(folder).items()
        if name in earlier or before.get(name) != digest
    }
    write_atomically(folder / MARKER, (json.dumps(ours, indent=1) + "\n").encode())


def _marked(folder: Path) -> dict[str, str]:
    try:
        digests = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return digests if isinstance(digests, dict) else {}


def _digests(folder: Path) -> dict[str, str]:
    if not folder.is_dir():
        return {}
    return {p.name: _digest(p) for p in folder.iterdir() if p.is_file() and p.name != MARKER}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
