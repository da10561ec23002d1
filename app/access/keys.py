"""Keys: generation, format, hashes and verification.

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
"""Each includes those before it: read, write to change data, admin to erase the account."""

_HASHER: Final = PasswordHasher(time_cost=2, memory_cost=19 * 1024, parallelism=1)
"""Argon2id with 19 MiB and two passes, the least of OWASP's "Password Storage Cheat Sheet" (2024). More is
needed only for secrets that people choose; these have 256 random bits."""

_KEY: Final = re.compile(r"lpk_([a-z0-9]{8})_([A-Za-z0-9_-]{43})", re.ASCII)
_PREFIX_SIGNS: Final = "abcdefghijkmnpqrstuvwxyz23456789"
"""Characters of a prefix, without those that look alike."""


@dataclass(frozen=True, slots=True)
class NewKey:
    """A new key: `text` is shown once, the others are stored."""

    text: str
    prefix: str
    key_hash: str


def make() -> NewKey:
    """Generate a key."""
    prefix = "".join(secrets.choice(_PREFIX_SIGNS) for _ in range(8))
    text = f"lpk_{prefix}_{secrets.token_urlsafe(32)}"
    return NewKey(text, prefix, _HASHER.hash(text))


def prefix_of(text: str) -> str | None:
    """Return the prefix of a text in the format of a key, None of any other."""
    match = _KEY.fullmatch(text)
    return None if match is None else match[1]


def matches(text: str, key_hash: str) -> bool:
    """Verify a key against a hash. Takes some 20 ms and 19 MiB."""
    try:
        return _HASHER.verify(key_hash, text)
    except (Argon2Error, InvalidHashError):
        return False


def covers(held: Iterable[str], wanted: Scope) -> bool:
    """Say whether scopes include one of them."""
    ranks = [SCOPES.index(scope) for scope in SCOPES if scope in set(held)]
    return bool(ranks) and max(ranks) >= SCOPES.index(wanted)
