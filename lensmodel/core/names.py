"""What is compared of names and serials: programs write the same lens in different ways."""

from __future__ import annotations

import re


def name_key(text: str | None) -> str:
    """Return what is compared of a maker or a model.

    Case, punctuation and blanks differ between programs that write the same name.
    """
    return re.sub(r"[\W_]+", "", (text or "").casefold())


def serial_key(text: str | None) -> str:
    """Return what is compared of a serial: with its punctuation, which may be all that tells copies apart."""
    return (text or "").strip().casefold()
