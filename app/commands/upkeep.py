"""`lensmodel doctor`, `backup`, `restore` and `migrate`: an operator's work besides start and stop."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.commands.service import Data, settings_from
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.cli.options import Json, Quiet

if TYPE_CHECKING:
    from app.blobs.storage import Storage
    from app.runtime.settings import Settings
    from app.store import Store


def doctor(
    context: typer.Context,
    data: Data = None,
    repair: Annotated[bool, typer.Option("--repair", help="Mend what can be mended.")] = False,
    deep: Annotated[
        bool, typer.Option("--deep", help="Also read each photo and kernel, and compare checksums.")
    ] = False,
    json_output: Json = False,
    quiet: Quiet = False,
) -> None:
    """Check an installation, running or not: tables, blobs, and whether a worker is running.

    Examples:

        lensmodel doctor

        lensmodel doctor --deep --json

        lensmodel doctor --repair

    Exit status: 0 all is well or mended, 1 something is not, 2 called wrongly.
    """
    from dataclasses import asdict  # noqa: PLC0415 - only these commands need the service

    from app.runtime import doctor as examination  # noqa: PLC0415 - same
    from app.store.upkeep import transfer  # noqa: PLC0415 - same

    shown = Display.of(context, quiet=quiet, verbose=0)
    settings = _existing(data)
    with _opened(settings) as (store, storage):
        transfer.check_schema(store.database)
        report = examination.examine(settings, store, storage, repair=repair, deep=deep)
    if json_output:
        findings = [asdict(finding) for finding in report.findings]
        shown.document({"checks": list(report.checks), "findings": findings, "open": len(report.open)})
    else:
        for finding in report.findings:
            end = "mended" if finding.mended else finding.remedy
            shown.result(f"{finding.check}: {finding.subject}: {finding.says}; {end}")
        shown.result(f"{len(report.checks)} checks, {len(report.findings)} findings, {len(report.open)} open")
    if report.open:
        raise typer.Exit(1)


def backup(
    context: typer.Context,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder of the backup; an older one there is updated.")
    ],
    data: Data = None,
    json_output: Json = False,
    quiet: Quiet = False,
) -> None:
    """Copy all rows and blobs of an installation into a folder, even while it runs.

    The folder is a complete backup at every moment: the last step replaces the old one by the new one.
    Only blobs that are not there yet are copied.

    Examples:

        lensmodel backup my-backup

        lensmodel backup my-backup --data lensmodel-data --json

    Exit status: 0 there is a new backup, 1 there is none, 2 called wrongly.
    """
    from dataclasses import asdict  # noqa: PLC0415 - only these commands need the service

    from app.runtime import backup as copies  # noqa: PLC0415 - same

    shown = Display.of(context, quiet=quiet, verbose=0)
    settings = _existing(data)
    with _opened(settings) as (store, storage), shown.progress() as bars:
        task = bars.add_task("blobs", total=None)
        result = copies.backup(
            store.database,
            storage,
            folder,
            lambda done, total: bars.update(task, completed=done, total=total),
        )
    if json_output:
        shown.document(asdict(result))
    else:
        rows = sum(result.rows.values())
        shown.result(f"{folder}: {rows} rows and {result.blobs} blobs of {result.made_at}")


def restore(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the backup.")],
    data: Data = None,
    quiet: Quiet = False,
) -> None:
    """Fill an empty installation from a backup.

    The settings say which installation: it may use a different database or storage from the one that was
    backed up. Its workers resume the photos that were being worked on.

    Examples:

        lensmodel restore my-backup --data restored

    Exit status: 0 restored, 1 not, 2 called wrongly.
    """
    from app.runtime import backup as copies  # noqa: PLC0415 - only this command needs it

    shown = Display.of(context, quiet=quiet, verbose=0)
    settings = settings_from(data)
    with _stopped(settings), _opened(settings) as (store, storage), shown.progress() as bars:
        task = bars.add_task("blobs", total=None)
        rows = copies.restore(
            folder,
            store.database,
            storage,
            lambda done, total: bars.update(task, completed=done, total=total),
        )
    shown.result(f"restored {sum(rows.values())} rows: {rows['photo']} photos, {rows['lens']} lenses")


def migrate(
    context: typer.Context,
    to: Annotated[str, typer.Option("--to", metavar="URL", help="SQLAlchemy address of an empty database.")],
    storage_url: Annotated[
        str | None,
        typer.Option(
            "--storage", metavar="URL", help="file:// or s3:// address; default: storage is not moved."
        ),
    ] = None,
    data: Data = None,
    quiet: Quiet = False,
) -> None:
    """Move a stopped installation to another database, and to another storage.

    The old one is only read, and stays as it is. The settings for the new one are printed at the end. A
    database server has an address such as postgresql+psycopg://lens@db/lens, an object store s3://lenses.

    Examples:

        lensmodel migrate --to sqlite:///elsewhere.db

    Exit status: 0 moved, 1 not, 2 called wrongly.
    """
    from app.blobs.storage import Storage  # noqa: PLC0415 - same
    from app.runtime import backup as copies  # noqa: PLC0415 - only this command needs it
    from app.store.database import Database  # noqa: PLC0415 - same

    shown = Display.of(context, quiet=quiet, verbose=0)
    settings = _existing(data)
    if to == settings.database:
        raise UsageError("--to is the database that is in use already")
    with _stopped(settings), _opened(settings) as (store, blobs), shown.progress() as bars:
        task = bars.add_task("blobs", total=None)
        other = blobs if storage_url is None else Storage(storage_url, patience_s=settings.storage_seconds)
        with contextlib.closing(Database(to)) as database:
            rows = copies.move(
                (store.database, blobs),
                (database, other),
                lambda done, total: bars.update(task, completed=done, total=total),
            )
    shown.note(f"moved {sum(rows.values())} rows: {rows['photo']} photos, {rows['lens']} lenses")
    shown.result(f"LENS_DATABASE_URL={to}")
    shown.result(f"LENS_STORAGE_URL={settings.storage if storage_url is None else storage_url}")


def _existing(data: Path | None) -> Settings:
    """Read the settings; a folder that is not there would be made, and found empty."""
    settings = settings_from(data)
    path = settings.data_dir / "app.db"
    if settings.database.startswith("sqlite") and not settings.database_url and not path.is_file():
        raise UsageError(f"{settings.data_dir} holds no installation; give its folder by --data")
    return settings


@contextlib.contextmanager
def _opened(settings: Settings) -> Iterator[tuple[Store, Storage]]:
    from app.blobs.storage import Storage  # noqa: PLC0415 - only these commands need it
    from app.store import Store  # noqa: PLC0415 - same

    settings.data_dir.mkdir(parents=True, exist_ok=True)
    store = Store(settings)
    try:
        yield store, Storage(settings.storage, patience_s=settings.storage_seconds, create=False)
    finally:
        store.close()


@contextlib.contextmanager
def _stopped(settings: Settings) -> Iterator[None]:
    """Make sure that no service works on the data, neither here nor elsewhere."""
    from app.runtime.supervisor import alone  # noqa: PLC0415 - same
    from app.store import Store  # noqa: PLC0415 - only these commands need it
    from app.store.upkeep import migrate  # noqa: PLC0415 - only these commands need it

    settings.data_dir.mkdir(parents=True, exist_ok=True)
    with alone(settings.data_dir):
        with contextlib.closing(Store(settings)) as store:
            migrate.upgrade(store.database)
            live = store.workers.live(settings.lease_seconds)
        if live:
            raise UsageError(f"{len(live)} workers are at work, {live[0].host} first: stop them all")
        yield
