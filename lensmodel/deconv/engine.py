"""Which engine runs the inner loops: compiled where it can, NumPy and SciPy elsewhere."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import threading
from functools import cache
from types import ModuleType
from typing import Literal

Engine = Literal["auto", "numpy"]

logger = logging.getLogger(__name__)
_loading = threading.Lock()


def compiled(engine: Engine) -> ModuleType | None:
    """Return the compiled loops, or None where NumPy shall do or Numba is not installed."""
    if engine == "numpy":
        return None
    with _loading:  # threads that all start at once must not compile the same loop twice
        return _load()


@cache
def _load() -> ModuleType | None:
    if importlib.util.find_spec("numba") is None or importlib.util.find_spec("rocket_fft") is None:
        logger.info("numba or rocket-fft is missing: correcting with SciPy, about half as fast")
        return None
    logger.info("loading the compiled tile engine; the first run on a machine compiles it, some 20 seconds")
    return importlib.import_module("lensmodel.deconv.compiled")
