"""Which loops run: compiled ones where Numba is installed, NumPy and SciPy elsewhere."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import threading
from functools import cache
from types import ModuleType

logger = logging.getLogger(__name__)

_loading = threading.Lock()


def compiled(name: str) -> ModuleType | None:
    """Import a module of compiled loops; None where Numba is missing."""
    with _loading:  # threads that all start at once must not compile the same loop twice
        return _load(name)


@cache
def _load(name: str) -> ModuleType | None:
    if importlib.util.find_spec("numba") is None:
        logger.info("numba is missing: lens models answer without %s, some times slower", name)
        return None
    return importlib.import_module(name)
