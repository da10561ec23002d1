"""The audit's map of a correction, where the library has an audit."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Planes
from lensmodel.photo import LinearPhoto

AUDIT: Final = "lensmodel.correction.audit"


def audit_map(developed: LinearPhoto, corrected: Planes) -> NDArray[np.float32] | None:
    """Share of the correction that the audit would keep at each pixel, `(row, col)`; None without an audit.

    It is asked as of any other program's picture: it is told the noise, and no PSF.

    Parameters
    ----------
    developed : LinearPhoto
        The original.
    corrected : Planes, shape (3, row, col)
        Linear light.
    """
    if find_spec(AUDIT) is None:
        return None
    audit = import_module(AUDIT)
    evidence = audit.Evidence(noise=developed.noise, clip=developed.clip)

    def known(*place_and_window: object) -> Any:  # noqa: ANN401 - of a module that may be missing
        del place_and_window
        return evidence

    return np.asarray(audit.audit_photo(developed.planes, corrected, known).keep, dtype=np.float32)
