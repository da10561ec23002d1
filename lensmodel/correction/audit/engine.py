"""Which loops audit: compiled ones if Numba and rocket-fft are installed, else NumPy and SciPy."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import threading
from functools import cache
from types import ModuleType
from typing import Literal, TypeAlias

Engine: TypeAlias = Literal["auto", "numpy"]

logger = logging.getLogger(__name__)

_loading = threading.Lock()


def compiled(engine: Engine) -> ModuleType | None:
    """Return the compiled loops, or None where NumPy is wanted or something is not installed."""
    if engine == "numpy":
        return None
    with _loading:  # threads that all start at once must not compile the same loop twice
        return _load()


@cache
def _load() -> ModuleType | None:
    if any(importlib.util.find_spec(name) is None for name in ("numba", "rocket_fft")):
        logger.info("numba or rocket-fft is missing: auditing with SciPy, some three times slower")
        return None
    return importlib.import_module("lensmodel.correction.audit.compiled")
