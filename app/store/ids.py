"""Public ids: opaque, unguessable enough, and sorted by time."""

from __future__ import annotations

import secrets
import time
from uuid import UUID


def new_id() -> str:
    """Return a UUID of version 7 (RFC 9562, section 5.7) as 32 hexadecimal digits.

    48 bits of milliseconds followed by 74 random bits: ids made later sort later, so lists
    in the order of ids are lists in the order of time.
    """
    millis = time.time_ns() // 1_000_000
    value = (millis & (1 << 48) - 1) << 80 | secrets.randbits(80)
    value = value & ~(0xF << 76) | 7 << 76
    value = value & ~(0b11 << 62) | 0b10 << 62
    return UUID(int=value).hex
