"""`lensmodel serve`, its two parts, and what they are set to."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import ValidationError

from app.runtime.settings import PREFIX, Settings, described
from lensmodel.cli.console import UsageError

if TYPE_CHECKING:
    from app.blobs.storage import Storage
    from app.store import Store

Data = Annotated[
    Path | None,
    typer.Option("--data", help="Folder of the database and the photos.", show_default="lensmodel-data"),
]
Port = Annotated[
    int | None,
    typer.Option(
        "--port", "-p", min=0, max=65535, help="Port to listen on; 0 takes any free one.", show_default="8000"
    ),
]
Host = Annotated[str | None, typer.Option("--host", help="Address to listen on.", show_default="127.0.0.1")]


def settings_from(data: Path | None, host: str | None = None, port: int | None = None) -> Settings:
    """Read the settings of a service; what the command line says goes before the environment."""
    given = {"data_dir": data, "host": host, "port": port}
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]  # checked by pydantic
    except ValidationError as error:
        problems = [
            "".join(f"{PREFIX}{str(part).upper()}: " for part in problem["loc"])
            + str(problem["msg"]).removeprefix("Value error, ")
            for problem in error.errors()
        ]
        raise UsageError("; ".join(problems)) from error


@contextlib.contextmanager
def opened(data: Path | None, *, existing: bool = False) -> Iterator[tuple[Settings, Store, Storage]]:
    """Open an installation, its schema brought up to date; or an `existing` one, which must have it."""
    from app.blobs.storage import Storage  # noqa: PLC0415 - the list of commands does not wait for it
    from app.store import Store, database  # noqa: PLC0415 - same

    settings = settings_from(data)
    if existing and not settings.database_url and not (settings.data_dir / "app.db").is_file():
        raise UsageError(f"{settings.data_dir} holds no installation; give its folder by --data")
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    with contextlib.closing(Store(settings)) as store:
        (database.check if existing else database.upgrade)(store.database)
        yield settings, store, Storage(settings.storage, patience_s=settings.storage_seconds, create=False)


def serve(port: Port = None, host: Host = None, data: Data = None) -> None:
    """Run the whole service: the API and a worker.

    Open the printed address in a browser. Stop with Ctrl-C: running work resumes at the next start.
    Each LENS_ setting of `lensmodel config` can be given in the environment.

    Examples:

        lensmodel serve

        lensmodel serve --port 9000 --data ~/lenses

    Exit status: 0 stopped by Ctrl-C or SIGTERM, 1 it could not run, 2 wrong usage.
    """
    settings = settings_from(data, host, port)
    typer.echo("lensmodel is starting ...", err=True)
    from app.runtime import supervisor  # noqa: PLC0415 - the list of commands does not wait for it

    raise typer.Exit(supervisor.serve(settings))


def api(port: Port = None, host: Host = None, data: Data = None) -> None:
    """Run only the API process, for installations on many machines."""
    from app.runtime import supervisor  # noqa: PLC0415 - the list of commands does not wait for it

    supervisor.run_api(settings_from(data, host, port))


def worker(data: Data = None) -> None:
    """Run only a worker process, for installations on many machines."""
    from app.runtime import supervisor  # noqa: PLC0415 - the list of commands does not wait for it

    supervisor.run_worker(settings_from(data))


def config(data: Data = None) -> None:
    """Print the settings as environment variables.

    The last lines tell which measures of this machine's kernel confine the processes that decode photos.

    Example:

        lensmodel config

    Exit status: 0 printed, 2 a setting is wrong.
    """
    from app.sandbox import confine  # noqa: PLC0415 - the list of commands does not wait for it

    settings = settings_from(data)
    # up to the last @: a password may hold any sign, and need not be quoted everywhere
    for name, value in sorted(settings.model_dump(mode="json").items()):
        shown = re.sub(r"(://[^:/@]*):.*@", r"\1:********@", str(value))
        typer.echo(f"# {described()[name]}\n{PREFIX}{name.upper()}={shown}")
    for name, in_force in confine.available(settings.task_user, settings.data_dir).items():
        typer.echo(f"# sandbox {name}: {'in force' if in_force else 'not available here'}")
