"""Keys: generation, format, hashes and verification.

A key is `lpk_<prefix>_<secret>`. The prefix finds its row and may be shown; the secret is 32 random bytes,
shown once, and only its hash is kept.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

Scope: TypeAlias = Literal["read", "write", "admin"]
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)
"""Each includes those before it: read, write to change data, admin to erase the account."""

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
    return NewKey(text, prefix, digest_of(text))


def prefix_of(text: str) -> str | None:
    """Return the prefix of a text in the format of a key, None of any other."""
    match = _KEY.fullmatch(text)
    return None if match is None else match[1]


def digest_of(text: str) -> str:
    """Return the hash of a key or session token, which have 256 random bits: a slow one would add nothing."""
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()


def covers(held: Iterable[str], wanted: Scope) -> bool:
    """Say whether scopes include one of them."""
    ranks = [SCOPES.index(scope) for scope in SCOPES if scope in set(held)]
    return bool(ranks) and max(ranks) >= SCOPES.index(wanted)
