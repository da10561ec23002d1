"""Named factories: how anything swappable is chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from lensmodel.errors import UnknownMethodError

T = TypeVar("T")


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Named factories of one kind; never changed, only extended into a new one."""

    kind: str
    entries: Mapping[str, Callable[..., T]]

    def create(self, name: str, **params: object) -> T:
        """Build the entry called `name` from keyword parameters.

        Raises
        ------
        UnknownMethodError
            If no entry has that name; the text lists those that exist.
        """
        if name not in self.entries:
            raise UnknownMethodError(f"no {self.kind} {name!r}; known: {', '.join(sorted(self.entries))}")
        return self.entries[name](**params)

    def extended(self, **entries: Callable[..., T]) -> Registry[T]:
        """Return a registry with more entries; names with a hyphen are given with an underscore."""
        added = {name.replace("_", "-"): factory for name, factory in entries.items()}
        return Registry(self.kind, {**self.entries, **added})

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self.entries))

    def __contains__(self, name: object) -> bool:
        return name in self.entries
