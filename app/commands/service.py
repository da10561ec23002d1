"""`lensmodel serve` and its two parts."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from app.settings import Settings

Data = Annotated[
    Path | None, typer.Option("--data", help="Folder for the database and the photos.", show_default="./data")
]


def _settings(data: Path | None) -> Settings:
    if data is not None:
        os.environ["LENS_DATA_DIR"] = str(data.resolve())
    return Settings()


def serve(
    port: Annotated[
        int, typer.Option("--port", "-p", min=0, max=65535, help="0 takes any free port.")
    ] = 8000,
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    data: Data = None,
) -> None:
    """Run the whole service: the API, a worker, and a guard that restarts them.

    Open the printed address in a browser. Stop with Ctrl-C: running work resumes at the next start.

    Examples
    --------
        lensmodel serve

        lensmodel serve --port 9000 --data ~/lenses
    """
    from app import supervisor  # noqa: PLC0415 - only this command needs the service

    raise typer.Exit(supervisor.serve(_settings(data), host=host, port=port))


def api(port: int = 8000, host: str = "127.0.0.1", data: Data = None) -> None:
    """Run only the API process, for installations on many machines."""
    from app import supervisor  # noqa: PLC0415

    supervisor.run_api(_settings(data), host=host, port=port)


def worker(data: Data = None) -> None:
    """Run only a worker process, for installations on many machines."""
    from app import supervisor  # noqa: PLC0415

    supervisor.run_worker(_settings(data))


def config(data: Data = None) -> None:
    """Print the effective settings; secrets are masked."""
    for name, value in sorted(_settings(data).model_dump(mode="json").items()):
        shown = "********" if "secret" in name or "password" in name else value
        typer.echo(f"LENS_{name.upper()}={shown}")
