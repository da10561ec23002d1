"""Graphics cards and other devices that whole planes may be computed on, by the Python array API standard."""

from __future__ import annotations

import importlib
import os
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError

VARIABLE: Final = "LENSMODEL_DEVICE"
"""Environment variable that names a device: `torch:cuda`, `torch:mps`, `cupy`; unset: compiled loops."""

_MODULES: Final = {
    "torch": "array_api_compat.torch",
    "cupy": "array_api_compat.cupy",
    "numpy": "numpy",
    "array_api_strict": "array_api_strict",
}
Array = Any
"""An array of whatever library the device has."""


@dataclass(frozen=True, slots=True)
class Device:
    """Where whole planes are computed.

    Parameters
    ----------
    xp : module
        Functions of the array API standard, with its extension for Fourier transforms.
    name : str or None
        The library's name of the device; None for its default.
    """

    xp: Any
    name: str | None = None

    def send(self, array: NDArray[Any]) -> Array:
        """Copy an array to the device."""
        array = np.require(array, requirements="W")  # some libraries take no read-only memory
        return self.xp.asarray(array) if self.name is None else self.xp.asarray(array, device=self.name)

    def fetch(self, array: Array) -> NDArray[np.float32]:
        """Copy an array back."""
        if hasattr(array, "get"):
            array = array.get()
        elif hasattr(array, "cpu"):
            array = array.cpu().numpy()
        return np.array(array, dtype=np.float32, order="C")


@lru_cache(maxsize=4)
def device_of(words: str) -> Device | None:
    """The device of `library` or `library:device`; None for no words.

    Raises
    ------
    InvalidInputError
        If the library is not known or not installed.
    """
    library, _, name = words.partition(":")
    if not library:
        return None
    if library not in _MODULES:
        raise InvalidInputError(f"{VARIABLE} must begin with one of {', '.join(_MODULES)}, got {words!r}")
    try:
        return Device(importlib.import_module(_MODULES[library]), name or None)
    except ImportError as error:
        raise InvalidInputError(
            f"{VARIABLE} is {words!r}, but {error.name} is missing; install lensmodel[gpu] and {library}"
        ) from error


def chosen() -> Device | None:
    """The device that the environment names."""
    return device_of(os.environ.get(VARIABLE, ""))
