"""By which endings of their names photo files are known."""

from __future__ import annotations

from typing import Final

_RAW: Final = (
    "3fr ari arw bay cap cr2 cr3 crw cs1 dc2 dcr dcs dng drf eip erf fff gpr ia iiq k25 kc2 kdc mdc mef mfw "
    "mos mrw nef nrw orf ori pef ptx pxn qtk r3d raf raw rdc rw2 rwl rwz sr2 srf srw sti x3f"
)
RAW_ENDINGS: Final = frozenset(f".{ending}" for ending in _RAW.split())
"""Of RAW files that LibRaw 0.22 knows or may refuse: what a file is, its content tells."""

ENDINGS: Final = RAW_ENDINGS | {".jpg", ".jpeg", ".tif", ".tiff", ".png"}

CORRECTED: Final = "-corrected"
"""Ends the names of what `lensmodel correct` wrote: it says nothing about its lens any more."""
