"""`lensmodel keys`: who may use a service that others can reach."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from app.commands.service import Data, opened
from lensmodel.cli.console import Json, UsageError
from lensmodel.core.errors import InvalidInputError

if TYPE_CHECKING:
    from app.store.tables import KeyRow

keys = typer.Typer(
    help="""Make, list and revoke the keys of a service that others can reach.

Examples:

    lensmodel keys create --owner anna

    lensmodel keys list

Exit status: 0 done, 1 it failed, 2 wrong usage.""",
    no_args_is_help=True,
)

HOURS: Final = {"h": 1, "d": 24, "w": 24 * 7, "y": 24 * 365}  # hours of each unit of a span
GIB: Final = 1 << 30  # bytes of a GiB


def _span(text: str) -> timedelta:
    """Read a span of time as people write it: 12h, 90d, 6w, 1y."""
    match = re.fullmatch(r"(\d{1,6})([hdwy])", text.strip().lower(), re.ASCII)
    if match is None:
        raise UsageError(f"a span of time is a number and h, d, w or y, such as 90d; got {text!r}")
    return timedelta(hours=int(match[1]) * HOURS[match[2]])


@keys.command()
def create(
    owner: Annotated[
        str, typer.Option(metavar="NAME", help="Whose photos the key opens; a new owner is created.")
    ] = "local",
    scope: Annotated[
        Literal["read", "write", "admin"],
        typer.Option(
            help="What it allows: read only reads, write also changes, admin may also erase the account."
        ),
    ] = "write",
    expires: Annotated[
        str, typer.Option(metavar="SPAN", help="When it expires: 12h, 90d, 6w, 1y or never.")
    ] = "1y",
    label: Annotated[
        str | None, typer.Option(metavar="TEXT", help="What it is for, shown by keys list.")
    ] = None,
    quota_gb: Annotated[
        float | None,
        typer.Option(min=0.0, metavar="GIB", help="Limit on this owner's stored photos, in GiB."),
    ] = None,
    quota_photos: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Limit on the number of this owner's photos.")
    ] = None,
    data: Data = None,
) -> None:
    """Make a key and print it, once.

    Photos of a service that had no keys yet belong to the owner "local", whose key opens them.

    Examples:

        lensmodel keys create

        lensmodel keys create --owner anna --scope read --expires 90d --label notebook

    Exit status: 0 made, 1 it failed, 2 wrong usage.
    """
    name = owner.strip()
    if not (0 < len(name) <= 100 and name.isprintable() and "|" not in name):
        raise UsageError(
            f"an owner's name has 1 to 100 printable characters and no vertical bar, got {owner!r}"
        )
    lasts = None if expires == "never" else _span(expires)
    with opened(data) as (_, store, _):
        text = store.accounts.create_key(
            name,
            [scope],
            label=label,
            lasts=lasts,
            quota_bytes=None if quota_gb is None else int(quota_gb * GIB),
            quota_photos=quota_photos,
        )
    typer.echo("Shown once and stored nowhere: keep it where you keep passwords.", err=True)
    typer.echo(text)  # alone on the standard output, so that it can be passed on


@keys.command(name="list")
def listed(
    owner: Annotated[str | None, typer.Option(metavar="NAME", help="Only those of this owner.")] = None,
    data: Data = None,
    json_output: Json = False,
) -> None:
    """List the keys, without showing the keys themselves.

    Examples:

        lensmodel keys list

        lensmodel keys list --owner anna --json

    Exit status: 0 listed, 1 it failed, 2 wrong usage.
    """
    from app.store.owners import ANY_OWNER  # noqa: PLC0415 - the list of commands does not wait for it

    with opened(data) as (_, store, _):
        rows = [_described(key) for key in store.accounts.keys(owner or ANY_OWNER)]
    if json_output:
        typer.echo(json.dumps(rows, indent=2))
        return
    for row in rows:
        words = (f"{name} {value}" for name, value in row.items() if value is not None and name != "prefix")
        typer.echo(f"{row['prefix']}  {', '.join(words)}")
    if not rows:
        typer.echo("no keys: lensmodel keys create makes one", err=True)


def _described(key: KeyRow) -> dict[str, str | None]:
    ended = key.expires_at is not None and key.expires_at <= datetime.now(UTC)
    times = {"created": key.created_at, "expires": key.expires_at, "used": key.last_used_at}
    return {
        "prefix": key.prefix,
        "owner": key.owner.name,
        "state": "revoked" if key.revoked_at else "expired" if ended else "valid",
        "scope": key.scopes,
        "label": key.label,
        **{name: at.isoformat(timespec="seconds") if at else None for name, at in times.items()},
    }


@keys.command()
def revoke(
    prefix: Annotated[
        str, typer.Argument(metavar="PREFIX", help="The characters after lpk_, or the whole key.")
    ],
    data: Data = None,
) -> None:
    """Revoke a key and sign out all browsers that signed in with it, within a second.

    Example:

        lensmodel keys revoke abcd2345

    Exit status: 0 ended, 1 there is no such key, 2 wrong usage.
    """
    short = prefix.removeprefix("lpk_").partition("_")[0]
    with opened(data) as (_, store, _):
        if not store.accounts.revoke_key(short):
            raise InvalidInputError(f"no key begins with {short}: lensmodel keys list shows them")
    typer.echo(f"key {short} is revoked")
