"""What compiled code shares: types, constants, and how it is compiled.

Imported only where Numba and rocket-fft are installed; `lensmodel.deconv.engine` decides.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])
Real = NDArray[np.float32]
Complex = NDArray[np.complex64]

ONE: Final = np.float32(1.0)
ZERO: Final = np.float32(0.0)
FORWARD: Final = True
BACK: Final = False


def jit(function: F) -> F:
    """Compile without the interpreter's lock, keep the machine code on disk."""
    return cast(
        "F",
        numba.njit(
            cache=True, nogil=True, fastmath={"nsz", "contract", "reassoc", "arcp"}, error_model="numpy"
        )(function),
    )
