"""Digests that distinguish camera bodies without identifying one."""

from __future__ import annotations

import hashlib

from lensmodel.core.names import name_key, serial_key


def body_key(maker: str | None, model: str | None, serial: str | None) -> str | None:
    """Return a digest of a camera's name and serial; None without a serial."""
    if not serial:
        return None
    identity = "|".join((name_key(maker), name_key(model), serial_key(serial)))
    return hashlib.sha256(identity.encode()).hexdigest()[:16]
