"""Named factories: how anything swappable is chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from lensmodel.core.errors import InvalidInputError

T = TypeVar("T")


class Registry(dict[str, Callable[..., T]]):
    """Factories of one kind by name; each returns an entry from keyword parameters."""

    def __init__(self, kind: str, entries: Mapping[str, Callable[..., T]]) -> None:
        super().__init__(sorted(entries.items()))
        self.kind = kind  # what the entries are, for error messages

    def create(self, name: str, **params: object) -> T:
        """Build the entry called `name` from keyword parameters."""
        if name not in self:
            raise InvalidInputError(f"no {self.kind} {name!r}; known: {', '.join(self)}")
        return self[name](**params)

    def resolve(self, method: str | T) -> T:
        """Return an entry that was given by its name, with its default parameters, or as an object."""
        return self.create(method) if isinstance(method, str) else method

    def register(self, name: str, factory: Callable[..., T]) -> None:
        """Add an entry for as long as this process lives."""
        if not name or name in self:
            raise InvalidInputError(f"the {self.kind} {name!r} exists already, or is no name; choose another")
        self[name] = factory
