"""By what two photos are known to show the same copy of a lens."""

from __future__ import annotations

from lensmodel.core.names import name_key, serial_key


def identity_key(maker: str | None, model: str | None, serial: str | None) -> str:
    """Return the key by which two photos are known to show the same copy."""
    return f"{name_key(maker)}|{name_key(model)}|{serial_key(serial)}"
