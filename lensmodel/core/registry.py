"""Named factories: how anything swappable is chosen by name."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from typing import Generic, TypeVar

from lensmodel.core.errors import InvalidInputError, UnknownMethodError

T = TypeVar("T")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Named factories of one kind, and those of installed packages: loaded when first asked for."""

    kind: str  # what the entries are, for error messages
    entries: Mapping[str, Callable[..., T]]  # by name; each returns an entry from keyword parameters
    group: str = ""  # of the entry points of installed packages; they never replace an entry

    def __post_init__(self) -> None:
        object.__setattr__(self, "entries", dict(self.entries))  # our own, never the caller's

    def create(self, name: str, **params: object) -> T:
        """Build the entry called `name` from keyword parameters."""
        if name not in self:
            raise UnknownMethodError(f"no {self.kind} {name!r}; known: {', '.join(self)}")
        return (self.entries.get(name) or self._installed(name))(**params)

    def load_installed(self) -> None:
        """Load the methods of installed packages now: before a process gives up the right to read files."""
        for name in _entry_points(self.group):
            try:
                self._installed(name)
            except UnknownMethodError as error:  # said again to whoever asks for it
                log.warning("%s", error)

    def _installed(self, name: str) -> Callable[..., T]:
        point = _entry_points(self.group)[name]
        try:
            factory: Callable[..., T] = point.load()
        except Exception as error:
            package = point.dist.name if point.dist else point.value
            raise UnknownMethodError(
                f"the {self.kind} {name!r} of the package {package} cannot be loaded: {error}; "
                "mend or remove that package"
            ) from error
        return factory

    def resolve(self, method: str | T) -> T:
        """Return an entry that was given by its name, with its default parameters, or as an object."""
        return self.create(method) if isinstance(method, str) else method

    def register(self, name: str, factory: Callable[..., T]) -> None:
        """Add an entry for as long as this process lives."""
        if not name or name in self:
            raise InvalidInputError(f"the {self.kind} {name!r} exists already, or is no name; choose another")
        assert isinstance(self.entries, dict)
        self.entries[name] = factory

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self.entries, *_entry_points(self.group)}))

    def __contains__(self, name: object) -> bool:
        return name in self.entries or name in _entry_points(self.group)


@lru_cache
def _entry_points(group: str) -> dict[str, metadata.EntryPoint]:
    """What installed packages bring; looked up once in a process, since it reads many files."""
    return {point.name: point for point in metadata.entry_points(group=group)} if group else {}
