"""Commands that are imported when they are called: neither `--help` nor `config` waits for SciPy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup


@dataclass(frozen=True, slots=True)
class CommandEntry:
    """What the list of commands says of one, and where it is."""

    # module and name of the function, or of the `typer.Typer` of a command with commands of its own
    home: str
    summary: str  # first sentence of its help
    panel: str | None = None  # under which heading the list has it; None: first, under Commands


class OnDemand(TyperGroup):
    """Commands known by their entries, each imported when it is called or its own help is asked for."""

    entries: ClassVar[Mapping[str, CommandEntry]] = {}
    """The entries by what is typed, in the order of the list."""

    def __init__(self, **given: Any) -> None:  # noqa: ANN401 - what Typer passes
        super().__init__(**given)
        for name, entry in self.entries.items():
            self.add_command(TyperCommand(name, help=entry.summary, rich_help_panel=entry.panel))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:  # noqa: ANN401 - Typer's own
        """Import the command that the words name."""
        name, stand_in, words = super().resolve_command(ctx, args)
        return name, stand_in if name is None else self.imported(name), words

    def imported(self, name: str) -> Any:  # noqa: ANN401 - a command or a group of Typer's
        """Import a command and return it as Typer builds it from its signature."""
        entry = self.entries[name]
        module, _, attribute = entry.home.partition(":")
        value = getattr(import_module(module), attribute)
        alone = typer.Typer(rich_markup_mode=self.rich_markup_mode, add_completion=False)
        if isinstance(value, typer.Typer):
            alone.add_typer(value, name=name)
        else:
            alone.command(name)(value)
        return typer.main.get_group(alone).commands[name]
