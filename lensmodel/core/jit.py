"""How inner loops are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile without the interpreter's lock, keep the machine code on disk."""
    fastmath = {"nsz", "contract", "reassoc", "arcp"}
    compiled = numba.njit(cache=True, nogil=True, fastmath=fastmath, error_model="numpy")(function)
    return cast("F", compiled)
