"""How inner loops are compiled; imported only where Numba is installed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile without the interpreter's lock, keep the machine code on disk."""
    return cast(
        "F",
        numba.njit(
            cache=True, nogil=True, fastmath={"nsz", "contract", "reassoc", "arcp"}, error_model="numpy"
        )(function),
    )
