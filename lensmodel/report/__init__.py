"""What a lens model says in words, numbers and pictures, and how to take it elsewhere.

Figures are drawn by `lensmodel.report.plots`, which needs matplotlib, and is imported where they are wanted.
"""

from lensmodel.report.centring import centring
from lensmodel.report.export import EXPORTERS, PsfGrid, place_table, psf_grid, to_csv
from lensmodel.report.lens_report import (
    LensReport,
    Unit,
    caution,
    compare,
    filled_aspect,
    lens_report,
    provenance,
    sharpness,
    widest,
)

__all__ = [
    "EXPORTERS",
    "LensReport",
    "PsfGrid",
    "Unit",
    "caution",
    "centring",
    "compare",
    "filled_aspect",
    "lens_report",
    "place_table",
    "provenance",
    "psf_grid",
    "sharpness",
    "to_csv",
    "widest",
]
