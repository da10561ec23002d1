"""By what two lenses are known to be the same copy, or of one kind."""

from __future__ import annotations

from lensmodel.core.names import name_key, serial_key


def identity_key(maker: str | None, model: str | None, serial: str | None) -> str:
    """Return the key by which two photos are known to show the same copy."""
    return f"{name_key(maker)}|{name_key(model)}|{serial_key(serial)}"


def kind_key(maker: str | None, model: str | None) -> str | None:
    """Return the key by which two lenses are known to be of one kind; None where the model is not known."""
    return None if model is None else f"{name_key(maker)}|{name_key(model)}"
