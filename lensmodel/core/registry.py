"""Named factories: how anything swappable is chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from lensmodel.core.errors import InvalidInputError, UnknownMethodError

T = TypeVar("T")


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Named factories of one kind."""

    kind: str  # what the entries are, for error messages
    entries: Mapping[str, Callable[..., T]]  # by name; each returns an entry from keyword parameters

    def create(self, name: str, **params: object) -> T:
        """Build the entry called `name` from keyword parameters."""
        if name not in self:
            raise UnknownMethodError(f"no {self.kind} {name!r}; known: {', '.join(self)}")
        return self.entries[name](**params)

    def resolve(self, method: str | T) -> T:
        """Return an entry that was given by its name, with its default parameters, or as an object."""
        return self.create(method) if isinstance(method, str) else method

    def register(self, name: str, factory: Callable[..., T]) -> None:
        """Add an entry for as long as this process lives."""
        if not name or name in self:
            raise InvalidInputError(f"the {self.kind} {name!r} exists already, or is no name; choose another")
        object.__setattr__(self, "entries", {**self.entries, name: factory})

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self.entries))

    def __contains__(self, name: object) -> bool:
        return name in self.entries
