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


def compiled(name: str, *needs: str) -> ModuleType | None:
    """Import a module of compiled loops; None where Numba, or what else it needs, is missing."""
    with _loading:  # threads that all start at once must not compile the same loop twice
        return _load(name, needs)


@cache
def _load(name: str, needs: tuple[str, ...]) -> ModuleType | None:
    missing = [need for need in ("numba", *needs) if importlib.util.find_spec(need) is None]
    if missing:
        logger.info("%s is missing: the work goes on without %s, some times slower", missing[0], name)
        return None
    return importlib.import_module(name)
