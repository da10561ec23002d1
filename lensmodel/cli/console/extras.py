"""Which extra of the package brings a module that is missing."""

from __future__ import annotations

from typing import Final

EXTRAS: Final = {
    "service": (
        "alembic",
        "dbos",
        "fastapi",
        "httpx2",
        "jinja2",
        "obstore",
        "prometheus_client",
        "pydantic",
        "pydantic_settings",
        "python_multipart",
        "sqlalchemy",
        "sse_starlette",
        "starlette",
        "structlog",
        "uvicorn",
    ),
    "report": ("matplotlib",),
}
"""Modules by extra, as far as commands import them."""

_WHAT: Final = {
    "service": "the service",
    "report": "drawing",
}


def remedy(missing: ModuleNotFoundError) -> str | None:
    """Say what to install for a missing module; None where no extra brings it."""
    name = missing.name or ""
    if name.partition(".")[0] in {"app", "lab"}:
        return "this command is no part of the package: it runs in the source tree" + (
            " or in the container image" if name.partition(".")[0] == "app" else ""
        )
    top = name.partition(".")[0]
    for extra, modules in EXTRAS.items():
        if top in modules:
            return (
                f"this command needs {_WHAT[extra]}, which is not installed ({top} is missing): "
                f"pip install 'lensmodel[{extra}]'"
            )
    return None
