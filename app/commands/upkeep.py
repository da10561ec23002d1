"""`lensmodel doctor` and `backup`: an operator's work besides start and stop."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from app.commands.service import Data, opened
from lensmodel.cli.console import Display, Json, Quiet


def doctor(
    data: Data = None,
    deep: Annotated[
        bool, typer.Option("--deep", help="Also read each photo and kernel, and compare checksums.")
    ] = False,
    json_output: Json = False,
    quiet: Quiet = False,
) -> None:
    """Check an installation, running or not.

    Checked are tables, blobs, and whether a worker is running.

    Examples:

        lensmodel doctor

        lensmodel doctor --deep --json

    Exit status: 0 all is well, 1 something is not, 2 wrong usage.
    """
    from app.runtime.doctor import examine  # noqa: PLC0415 - the list of commands does not wait for it

    shown = Display(quiet=quiet, as_json=json_output)
    with opened(data, existing=True) as (settings, store, storage):
        findings = examine(settings, store, storage, deep=deep)
    if json_output:
        shown.document({"findings": [asdict(finding) for finding in findings]})
    else:
        for finding in findings:
            shown.result(f"{finding.check}: {finding.subject}: {finding.says}; {finding.remedy}")
        shown.result(f"{len(findings)} findings")
    if findings:
        raise typer.Exit(1)


def backup(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder of the backup; an older one there is updated.")
    ],
    data: Data = None,
    quiet: Quiet = False,
) -> None:
    """Copy an installation into a folder, even while it runs.

    The folder is a complete backup at every moment: the last step replaces the old one by the new one.
    Only blobs that are not there yet are copied. It is a data folder itself: `lensmodel serve --data FOLDER`
    goes on from it, or from a copy of it.

    Examples:

        lensmodel backup my-backup

        lensmodel backup my-backup --data lensmodel-data

    Exit status: 0 there is a new backup, 1 there is none, 2 wrong usage.
    """
    from app.runtime import backup as copies  # noqa: PLC0415 - the list of commands does not wait for it

    shown = Display(quiet=quiet)
    with opened(data, existing=True) as (_, store, storage), shown.progress("blobs") as bar:
        result = copies.backup(
            store.database, storage, folder, lambda done, total: bar.show(completed=done, total=total)
        )
    shown.result(f"{folder}: {result['photos']} photos and {result['blobs']} blobs of {result['made_at']}")
