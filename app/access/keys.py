"""Keys: how they are made, written, hashed and compared.

A key is `lpk_<prefix>_<secret>`. The prefix finds its row and may be shown; the secret is 32 random bytes,
shown once, and only its hash is kept.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

from argon2 import PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError

Scope: TypeAlias = Literal["read", "write", "admin"]
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)
"""Each contains those before it: read asks, write also changes, admin also erases the account."""

_HASHER: Final = PasswordHasher(time_cost=2, memory_cost=19 * 1024, parallelism=1)
"""Argon2id with 19 MiB and two passes, the least of OWASP's "Password Storage Cheat Sheet" (2024). More would
guard secrets that a person made up; these have 256 random bits."""

_KEY: Final = re.compile(r"lpk_([a-z0-9]{8})_([A-Za-z0-9_-]{43})", re.ASCII)
_PREFIX_SIGNS: Final = "abcdefghijkmnpqrstuvwxyz23456789"
"""Without those that look like others."""


@dataclass(frozen=True, slots=True)
class NewKey:
    """A key that was just made: `text` is shown once, the others are kept."""

    text: str
    prefix: str
    key_hash: str


def make() -> NewKey:
    """Make a key."""
    prefix = "".join(secrets.choice(_PREFIX_SIGNS) for _ in range(8))
    text = f"lpk_{prefix}_{secrets.token_urlsafe(32)}"
    return NewKey(text, prefix, _HASHER.hash(text))


def prefix_of(text: str) -> str | None:
    """Return the prefix of what looks like a key, None of anything else."""
    match = _KEY.fullmatch(text)
    return None if match is None else match[1]


def matches(text: str, key_hash: str) -> bool:
    """Say whether a key is the one of a hash. Takes some 20 ms and 19 MiB."""
    try:
        return _HASHER.verify(key_hash, text)
    except (Argon2Error, InvalidHashError):
        return False


def covers(held: Iterable[str], wanted: Scope) -> bool:
    """Say whether scopes allow what one of them does."""
    ranks = [SCOPES.index(scope) for scope in SCOPES if scope in set(held)]
    return bool(ranks) and max(ranks) >= SCOPES.index(wanted)
